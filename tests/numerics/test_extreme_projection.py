"""Projection at the ends of what numbers can say; docs/numerics.md lists the rows (P1 to P14) and what else holds them."""

import functools
import itertools
import math

import numpy as np
import pytest
import torch
import warp as wp

from tests.gaussians import SMOOTH, camera, cloud, hand_placed, leaves
from tests.io.scenes import transforms_json, write_transforms
from tests.numerics.poison import documented
from tests.reference.blend import blend_reference
from tests.reference.project import project_reference
from tests.scenes import three_gaussians
from warpgs.constants import FAR, FARTHEST_PIXEL, LARGEST_AXIS, LARGEST_COEFFICIENT, RULES, SHORTEST_QUAT
from warpgs.export.ply import read_ply, write_ply
from warpgs.io.load import load_scene
from warpgs.kernels import launch
from warpgs.kernels.ellipse import make_spans
from warpgs.kernels.project import project
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

EXACT = RULES["exact"]


def run(gaussians, cam, degree=1, rule=EXACT):
    return project(
        *gaussians.tensors().values(), cam.viewmat, cam.K, width=cam.width, height=cam.height, degree=degree, rule=rule
    )


def one(mean, log_scales=(-2.0, -2.0, -2.0), quat=(1.0, 0, 0, 0), logit=1.0, dtype=torch.float32, device="cpu", degree=1):
    """A single Gaussian."""
    base = cloud(1, dtype, device, degree=degree)
    base.means[:], base.quats[:] = torch.tensor(mean), torch.tensor(quat)
    base.log_scales[:], base.logit_opacities[:] = torch.tensor(log_scales), logit
    return base


def image_of(gaussians, cam, rule=EXACT):
    """Pictures and gradients of their sum, by the public op."""
    moving = leaves(gaussians)
    r = rasterize(moving, cam, RasterizeOptions(rule=rule))
    gradients = torch.autograd.grad(r.rgb.sum() + r.alpha.sum() + r.depth.sum(), list(moving.tensors().values()))
    return [t.detach() for t in (r.rgb, r.alpha, r.depth, *gradients)], r.visible


def finite(tensors) -> bool:
    return all(bool(torch.isfinite(t).all()) for t in tensors)


def test_needle_determinants_stay_positive_and_right(device):
    """P1: needles of 1 to 1e5 px at 400 angles. The determinant stays positive and right, however thin they are."""
    angles = torch.linspace(0, math.pi, 400, dtype=torch.float64)
    for sigma in (1.0, 10.0, 100.0, 1e3, 1e4, 1e5):
        cams = [camera(640, 480, cameras=1, dtype=dtype, device=device) for dtype in (torch.float32, torch.float64)]
        base = cloud(400, torch.float32, device, degree=0)
        base.means[:] = torch.tensor([0.01, 0.02, 1.0])
        zero = torch.zeros_like(angles)
        base.quats[:] = torch.stack([torch.cos(angles / 2), zero, zero, torch.sin(angles / 2)], 1).to(device)
        base.log_scales[:] = torch.log(torch.tensor([sigma / float(cams[0].K[0, 0, 0]), 1e-30, 1e-30]))
        wide = Gaussians(**{n: t.double() for n, t in base.tensors().items()})
        (found, counts), (wanted, _) = (run(g, c, 0, SMOOTH) for g, c in zip((base, wide), cams))
        assert bool((counts > 0).all()) and bool((found[..., 2:5:2] > 0).all())
        det, exact = ((r[0, :, 2].double() * r[0, :, 4].double()) ** -2 for r in (found, wanted))
        error = float(((det - exact) / exact).abs().max())
        assert error <= 2e-6, (sigma, error)  # measured 0.9e-6 to 1.3e-6


def test_scales_over_sixteen_decades(device):
    """P2: scales log-uniform in 1e-12..1e4, dense at 1e-4. Axes of up to 0.1 u equal float64; all are finite."""
    generator = torch.Generator().manual_seed(0)
    base = cloud(2000, device=device)
    exponents = 16 * torch.rand(2000, 3, generator=generator) - 12
    exponents[1000:] = -4
    base.log_scales[:] = exponents * math.log(10)
    wide = Gaussians(**{n: t.double() for n, t in base.tensors().items()})
    cams = [camera(64, 48, cameras=1, dtype=dtype, device=device) for dtype in (torch.float32, torch.float64)]
    moving = leaves(base)
    (found, counts), (wanted, other) = (run(g, c) for g, c in zip((moving, wide), cams))
    both = ((counts > 0) & (other > 0))[0]
    assert bool((counts == other).all())
    both &= base.log_scales.amax(1) < math.log(0.1)
    assert int(both.sum()) > 800
    # without the third entry of the factor, which is a difference
    a, b = (r[0, both][:, [0, 1, 2, 4, 5, 9]].detach().double() for r in (found, wanted))
    worst = ((a - b).abs() / b.abs()).amax(0)
    # factor, opacity, depth relative (measured 3e-7); pixels absolute (measured 5e-6)
    assert float(worst[2:].max()) <= 2e-6 and float((a - b)[:, :2].abs().max()) <= 2e-5, worst
    found[..., :10].sum().backward()
    assert finite(t.grad for t in moving.tensors().values())


@pytest.mark.parametrize("value", [-200.0, -50.0, -44.4, 0.0, 40.0, 44.4, 59.0, 88.8, 200.0, math.inf, -math.inf, math.nan])
@pytest.mark.parametrize("axes", [(0,), (0, 1, 2)], ids=["one", "all"])
def test_log_scales(device, dtype, value, axes):
    """P3: drawn from -inf, an axis of length 0, while the axes stay within 1e30 px, needles within 1e19 px; else not there."""
    cam = camera(20, 16, cameras=1, dtype=dtype, device=device)
    gaussians = cloud(4, dtype, device)
    gaussians.means[2] = torch.tensor([0.0, 0.0, 3.0])
    gaussians.log_scales[2, list(axes)] = value
    found, visible = image_of(gaussians, cam)
    assert finite(found)
    assert bool(visible[0, 2]) == (value < (42 if len(axes) == 1 else 66))  # f / z = 8
    if not bool(visible[0, 2]):
        rest = Gaussians(**{n: t[[0, 1, 3]] for n, t in gaussians.tensors().items()})
        assert all(torch.equal(a, b) for a, b in zip(found[:3], image_of(rest, cam)[0]))
        assert not any(bool(v[2].any()) for v in found[3:])


def test_a_scale_of_40_is_drawn_by_a_long_lens(device):
    """P3: e^40 u through 1000 px of focal length, on one axis and on all."""
    K = torch.tensor([[[1000.0, 0, 10], [0, 1000, 8], [0, 0, 1]]], device=device)
    cam = Camera(torch.eye(4, device=device)[None], K, 20, 16)
    for log_scales in ((40.0, -3.0, -3.0), (40.0, 40.0, 40.0), (-3.0, 40.0, -200.0)):
        found, visible = image_of(one((0.0, 0.0, 1.0), log_scales, (0.9, 0.1, 0.2, 0.3), device=device), cam)
        assert bool(visible.all()) and finite(found) and float(found[1].max()) > 0.5


def test_zero_quaternion_is_not_there(device, dtype):
    """P4: no rotation can be read from it; bitwise the picture without it, and no gradient."""
    gaussians, cam = cloud(5, dtype, device), camera(20, 16, cameras=1, dtype=dtype, device=device)
    rest = Gaussians(**{n: t[:4] for n, t in gaussians.tensors().items()})
    for length in (0.0, -0.0, 1e-30, 0.9 * SHORTEST_QUAT, 1.1 / SHORTEST_QUAT):
        gaussians.quats[4] = torch.tensor([1.0, 0, 0, 0]) * length
        found, _ = image_of(gaussians, cam)
        assert all(torch.equal(a, b) for a, b in zip(found[:3], image_of(rest, cam)[0][:3]))
        assert not any(bool(v[4].any()) for v in found[3:])


def test_quaternion_length_divides_its_gradient(device):
    """P4: q and 2^k q give the same bits; the gradient shrinks by exactly 2^k, over the whole range of lengths."""
    gaussians, cam = cloud(5, device=device), camera(20, 16, cameras=1, dtype=torch.float32, device=device)
    base, _ = image_of(gaussians, cam)
    assert bool(base[4].any())
    for k in (-48, -20, -1, 1, 20, 48):
        longer = Gaussians(**(gaussians.tensors() | {"quats": gaussians.quats * 2.0**k}))
        found, _ = image_of(longer, cam)
        assert all(torch.equal(a, b) for a, b in zip(found[:4], base[:4]))
        assert torch.equal(found[4] * 2.0**k, base[4])


def test_disc_of_no_thickness(device, dtype):
    """P5: one scale exactly 0 after exp. It is drawn as a disc, and covers no more than its opacity."""
    for axis in range(3):
        log_scales = [-1.0] * 3
        log_scales[axis] = -800.0
        g = one((0.0, 0.0, 2.0), log_scales, (0.8, 0.2, 0.3, -0.1), dtype=dtype, device=device)
        found, visible = image_of(g, camera(20, 16, cameras=1, dtype=dtype, device=device))
        assert bool(visible.all()) and finite(found)
        assert 0.1 < float(found[1].max()) <= float(torch.sigmoid(g.logit_opacities)) * (1 + 1e-6)


@pytest.mark.parametrize("mean", [(0.0, 0.0, 0.0), (0.0, 0.0, -0.5), (0.3, 0.1, 0.005), (0.0, 0.0, 1e30), (1e30, 0.0, 1.0)])
def test_camera_inside_a_gaussian_that_is_culled(device, dtype, mean):
    """P6: a mean before the near plane, beyond FAR or off by more than 1e9 px is not there, however large its Gaussian."""
    g = one(mean, (2.0, 2.0, 2.0), dtype=dtype, device=device)
    found, visible = image_of(g, camera(20, 16, cameras=1, dtype=dtype, device=device))
    assert not bool(visible.any()) and not any(bool(t.any()) for t in found)


def test_camera_inside_a_gaussian_that_is_drawn(device):
    """P6, P11: a mean just behind the near plane, its Gaussian far larger than the image: finite, and equal to float64."""
    cam = camera(24, 20, cameras=1, dtype=torch.float32, device=device)
    for mean, log_scale in (
        ((0.001, 0.0, 0.0101), 0.0),
        ((0.2, -0.1, 0.3), 1.0),
        ((5.0, 2.0, 1.0), 3.0),
        ((0.0, 0.0, 1e9), 20.0),
    ):
        g = one(mean, (log_scale, log_scale - 1, log_scale + 0.5), (0.9, 0.3, -0.2, 0.1), device=device)
        found, visible = image_of(g, cam, SMOOTH)
        assert bool(visible.all()) and finite(found)
        tensors = [t.cpu().double() for t in (*g.tensors().values(), cam.viewmat, cam.K)]
        means, covs, colors, depths, opacities = project_reference(*tensors, width=24, height=20, degree=1, low_pass=0.3)
        black = torch.zeros(3, dtype=torch.float64)
        rgb, alpha, _, _ = blend_reference(means[0], covs[0], opacities, colors[0], depths[0], black, 24, 20, SMOOTH)
        assert float((found[0][0].cpu() - rgb).abs().max()) <= 1e-5 and float((found[1][0].cpu() - alpha).abs().max()) <= 1e-5


def test_gradient_of_the_clamped_jacobian(device):
    """P8: 1.2 to 3 times outside the view but reaching in, the gradient of the mean is that of finite differences, to 1e-6."""
    cam = camera(20, 16, cameras=1, device=device)
    weights = torch.rand(16, 20, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(device)

    def loss(mean):
        g = Gaussians(**(base.tensors() | {"means": mean}))
        r = rasterize(g, cam, RasterizeOptions(rule=SMOOTH))
        return (torch.cat([r.rgb, r.alpha[..., None], r.depth[..., None]], -1)[0] * weights).sum()

    for x, y in ((1.2, 0.0), (-2.0, 0.1), (0.1, 3.0), (0.0, -1.5), (2.0, -2.0)):
        base = one((0.0, 0.0, 0.0), (0.7, 0.9, 0.5), (0.9, 0.2, 0.1, -0.3), dtype=torch.float64, device=device)
        z = 1.7
        at = torch.tensor([[x * 10 / float(cam.K[0, 0, 0]) * z, y * 8 / float(cam.K[0, 1, 1]) * z, z]], dtype=torch.float64)
        mean = at.to(device).requires_grad_()
        (gradient,) = torch.autograd.grad(loss(mean), mean)
        numeric = torch.zeros(3, dtype=torch.float64)
        for k in range(3):
            step = torch.zeros(1, 3, dtype=torch.float64, device=device)
            step[0, k] = 1e-3
            d1, d2 = ((loss(mean.detach() + s * step) - loss(mean.detach() - s * step)) / (2 * s * 1e-3) for s in (1.0, 0.5))
            numeric[k] = float(4 * d2 - d1) / 3  # Richardson
        assert float((gradient[0].cpu() - numeric).norm()) <= 1e-6 * float(numeric.norm()), (x, y)


@pytest.mark.parametrize("distance", [0.0, 1e-20, 1e-8, 0.02, 1.0, 1e4, 1e6, 1e8])
def test_view_directions_of_any_length(device, distance):
    """P9: with harmonics of degree 3 colour and gradient equal float64 from the near plane to 1e8 u; nearer is nothing."""
    along = torch.tensor([0.2, -0.1, 1.0])
    along /= along.norm()
    results = []
    for dtype in (torch.float32, torch.float64):
        cam = camera(20, 16, cameras=1, dtype=dtype, device=device)
        g = one((0.0, 0.0, 1.0), [math.log(max(distance, 1e-9)) - 2] * 3, dtype=dtype, device=device, degree=3)
        g.means[0] = (along * distance).to(dtype)
        g = leaves(g)
        projected, counts = run(g, cam, 3)
        assert (int(counts) > 0) == (distance > 0.01)
        projected[..., 6:9].sum().backward()
        results.append((projected[..., 6:9].detach(), g.means.grad, g.sh.grad))
    assert finite(t for r in results for t in r)
    for a, b in zip(*results):
        assert float((a.double() - b).norm()) <= 1e-5 * float(b.norm())


SHIFTS = (0.0, 1e3, 1e5, 5e6)


def loaded(folder, shift):
    """The five photographs of tests/io/scenes.py, their cameras ``shift`` units from the origin on every axis."""
    content = transforms_json()
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] += shift
    return load_scene(write_transforms(folder / f"{shift:g}", content))


def test_far_from_the_origin(tmp_path):
    """P10: a scene 0 to 5e6 units away has the same cameras, pictures and fit once it is loaded; PLY files go back there."""
    gaussians, images, scores = three_gaussians(), [], []
    config = FitConfig(steps=30, init=InitConfig(source="random", random_count=300))
    for shift in SHIFTS:
        scene = loaded(tmp_path, shift)
        assert np.allclose(scene.normalization.offset - shift, loaded(tmp_path, 0.0).normalization.offset, atol=1e-8)
        images.append(torch.stack([rasterize(gaussians, v.camera).rgb for v in scene.views]))
        fit = Trainer(list(scene.views), scene.points, config, torch.device("cpu"), (0.0, 0.0, 0.0))
        scores.append([fit.advance()[0].loss for _ in range(30)][-1])
        write_ply(tmp_path / "model.ply", gaussians, scene.normalization)
        back = read_ply(tmp_path / "model.ply").means.double().numpy()
        wanted = gaussians.means.double().numpy() / scene.normalization.scale + scene.normalization.offset
        assert np.abs(back - wanted).max() <= np.spacing(np.float32(np.abs(wanted).max()))
    assert all(float((p - images[0]).abs().max()) <= 1e-6 for p in images)
    assert max(scores) - min(scores) <= 1e-3 * scores[0]  # measured 0, 0, 0, 7e-6 of it


def test_far_from_the_origin_without_recentring_jitters():
    """P10: what recentring is for. In float32 the same scene at 1e5 units is off by pixels' worth, at 0 it is not."""
    gaussians, cam = cloud(50), camera(64, 48)
    found = {}
    for shift in (0.0, 1e5):
        view = cam.viewmat.clone()
        view[:3, 3] = -view[:3, :3] @ torch.full((3,), shift, dtype=torch.float64)
        moved = Gaussians(**(gaussians.tensors() | {"means": (gaussians.means.double() + shift).float()}))
        found[shift] = rasterize(moved, Camera(view, cam.K, 64, 48)).projected[0, :, :2]
    assert float((found[1e5] - found[0.0]).abs().max()) > 0.02


@functools.cache
def spans_kernel():
    s = make_spans(wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def spans(
        begin: int, boxes: wp.array2d(dtype=wp.float32),
        # outputs
        found: wp.array2d(dtype=int),
    ):  # fmt: skip
        i = begin + wp.tid()
        rows = s.tile_rows(boxes[i, 1], boxes[i, 3], 0, 100, 16)
        factor = wp.vec3(boxes[i, 4], float(0.0), boxes[i, 4])
        columns = s.tile_columns(
            boxes[i, 0], boxes[i, 1], factor, boxes[i, 5], boxes[i, 2], boxes[i, 3], 1, 0, 200, 16
        )  # fmt: skip
        found[i, 0] = rows[0]
        found[i, 1] = rows[1]
        found[i, 2] = columns[0]
        found[i, 3] = columns[1]

    return spans


def test_tiles_of_impossible_boxes(device):
    """P14: centres and half sides of 1e20, infinity and NaN give tiles of the picture, the same ones on every device."""
    inf, nan = math.inf, math.nan
    # mean x, y, half width, height, factor, reach -> rows, columns of tiles in row 1
    table = [
        ((100.0, 50.0, 5.0, 5.0, 0.6, 3.0), (2, 4, 0, 0)),
        ((100.0, 24.0, 5.0, 5.0, 0.6, 3.0), (1, 2, 5, 7)),
        ((100.0, 50.0, 1e20, 1e20, 1e-20, 3.0), (0, 7, 0, 13)),
        ((100.0, 50.0, inf, inf, 0.0, 3.0), (0, 7, 0, 13)),
        ((-1e9, 1e9, 1e9, 1e9, 1e-9, 3.0), (0, 7, 0, 13)),
        ((1e20, -1e20, 5.0, 5.0, 0.6, 3.0), (0, 0, 0, 0)),
        ((-inf, inf, 5.0, 5.0, 0.6, 3.0), None),
        ((100.0, 50.0, nan, nan, 0.6, 0.0), None),
        ((nan, nan, 5.0, 5.0, 0.6, 0.0), None),
    ]
    boxes = torch.tensor([row for row, _ in table])
    found = {}
    for where in {"cpu", str(device)}:
        result = torch.empty(len(table), 4, dtype=torch.int32, device=where)
        inputs = [boxes.to(where), result]
        with launch.stream_of(torch.device(where)):
            launch.launch(spans_kernel(), len(table), inputs, torch.device(where))
        found[where] = result.cpu()
    rows = found[str(device)]
    assert torch.equal(rows, found["cpu"])
    assert bool((rows >= 0).all()) and bool((rows <= torch.tensor([7, 7, 13, 13])).all())
    for i, (_, wanted) in enumerate(table):
        assert wanted is None or rows[i].tolist() == list(wanted), table[i]


@pytest.mark.parametrize("degree", [0, 2])
def test_coefficients_above_the_degree_are_not_read(device, degree):
    """P14: 16 coefficients, of which a lower degree uses 1 or 9. The others may be NaN, and change no bit of any gradient."""
    cam = camera(cameras=1, dtype=torch.float32, device=device)
    results = []
    for rest in (0.0, 5.0, math.nan):
        g = hand_placed(torch.float32, device)
        g.sh[:, (degree + 1) ** 2 :] = rest
        g = leaves(g)
        projected, counts = run(g, cam, degree)
        assert int((counts > 0).sum()) == 5
        (projected[..., 6:9] * torch.tensor([1.0, -2.0, 0.5], device=device)).sum().backward()
        results.append([projected.detach(), *(t.grad for t in g.tensors().values())])
    assert all(torch.equal(a, b) for r in results[1:] for a, b in zip(results[0], r))
    assert bool(results[0][1].any()) == (degree > 0)


def test_documented_ranges_are_those_of_the_kernel(device, dtype):
    """One Gaussian on either side of every limit: drawn inside, not there outside, finite everywhere."""
    cam = camera(20, 16, cameras=1, dtype=dtype, device=device)
    far, long = FARTHEST_PIXEL / float(cam.K[0, 0, 0]), LARGEST_AXIS / float(cam.K[0, 1, 1])
    cases = [
        one((0.0, 0.0, f * FAR), [math.log(FAR) - 2] * 3, dtype=dtype, device=device) for f in (0.999, 1.001)
    ] + [
        one((f * far, 0.0, 1.0), [math.log(far)] * 3, dtype=dtype, device=device) for f in (0.999, 1.001)
    ] + [
        one((0.0, 0.0, 1.0), [math.log(f * long)] * 3, dtype=dtype, device=device) for f in (0.99, 1.01)
    ] + [
        one((0.0, 0.0, 1.0), quat=(f * SHORTEST_QUAT, 0.0, 0.0, 0.0), dtype=dtype, device=device) for f in (1.001, 0.999)
    ] + [
        one((0.0, 0.0, 1.0), quat=(f / SHORTEST_QUAT, 0.0, 0.0, 0.0), dtype=dtype, device=device) for f in (0.999, 1.001)
    ]  # fmt: skip
    for f in (0.999, 1.001):
        g = one((0.0, 0.0, 1.0), dtype=dtype, device=device)
        g.sh[0, 0, 1] = f * LARGEST_COEFFICIENT
        cases.append(g)
    on_cpu = Camera(cam.viewmat.cpu(), cam.K.cpu(), 20, 16)
    for i, g in enumerate(cases):
        found, visible = image_of(g, cam)
        assert bool(visible.any()) == (i % 2 == 0), i
        assert finite(found), i
        moved = Gaussians(**{n: t.cpu() for n, t in g.tensors().items()})
        assert bool(documented(moved, on_cpu, EXACT.near)[0][0]) == (i % 2 == 0), i


def test_corners_of_the_ranges_are_finite(device):
    """Every combination of ends: mean on screen or 1e9 px off, at `near` or FAR, axes of 1e-30 to 1e30 px, quaternions and
    coefficients at their limits. Pictures and gradients are finite, those of pose and intrinsics too, and many are drawn.
    """
    cam = camera(20, 16, cameras=1, dtype=torch.float32, device=device)
    focal, count = float(cam.K[0, 0, 0]), 0
    weights = torch.randn(16, 20, 5, generator=torch.Generator().manual_seed(0)).to(device)
    lengths = (1e-30, 30.0, 1e9, 3e19, 0.5 * LARGEST_AXIS)  # 30 by 3e19 px has nearly the smallest determinant
    corners = itertools.product((0.0, 0.9 * FARTHEST_PIXEL), (0.0101, 0.99 * FAR), itertools.product(lengths, repeat=3))
    for number, (off, z, axes) in enumerate(corners):
        log_scales = [math.log(a) + math.log(z / focal) for a in axes]
        length = (1.0, 1.1 * SHORTEST_QUAT, 0.9 / SHORTEST_QUAT)[number % 3]
        g = one(
            (off / focal * z, 0.1 * z, z), log_scales, (0.8 * length, 0.1 * length, 0.5 * length, 0.3 * length), device=device
        )
        g.sh[0, number % 4] = 0.99 * LARGEST_COEFFICIENT
        moving, view, K = leaves(g), cam.viewmat.clone().requires_grad_(), cam.K.clone().requires_grad_()
        r = rasterize(moving, Camera(view, K, 20, 16), RasterizeOptions(background=(0.2, 0.5, 0.8)))
        loss = (torch.cat([r.rgb, r.alpha[..., None], r.depth[..., None]], -1) * weights).sum()
        found = torch.autograd.grad(loss, [*moving.tensors().values(), view, K])
        assert finite([r.rgb, r.alpha, r.depth, *found]), (off, z, axes)
        count += int(r.visible.sum())
    assert count > 100, count
