"""Projection at the ends of what numbers can say; docs/numerics.md lists the rows (P1 to P14) and what else holds them."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch

from bench.lib.kernel_calls import project
from tests.gaussians import SMOOTH, camera, cloud, finite, leaves
from tests.io.scenes import transforms_json, write_transforms
from tests.numerics.fuzz import documented
from tests.reference.low_precision import Frame, Inputs, projected_of
from tests.scenes import three_gaussians
from warpgs.constants import FAR, FARTHEST_PIXEL, LARGEST_AXIS, LARGEST_COEFFICIENT, RULES, SHORTEST_QUAT
from warpgs.export.ply import read_ply, write_ply
from warpgs.io.load import load_scene
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
    base = cloud(1, dtype, device, degree=degree)
    base.means[:], base.quats[:] = torch.tensor(mean), torch.tensor(quat)
    base.log_scales[:], base.logit_opacities[:] = torch.tensor(log_scales), logit
    return base


def image_of(gaussians, cam, rule=EXACT):
    moving = leaves(gaussians)
    r = rasterize(moving, cam, RasterizeOptions(rule=rule))
    gradients = torch.autograd.grad(r.rgb.sum() + r.alpha.sum() + r.depth.sum(), list(moving.tensors().values()))
    return [t.detach() for t in (r.rgb, r.alpha, r.depth, *gradients)], r.visible


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
    assert finite(*(t.grad for t in moving.tensors().values()))


@pytest.mark.parametrize("value", [-200.0, -50.0, -44.4, 0.0, 40.0, 44.4, 59.0, 88.8, 200.0, math.inf, -math.inf, math.nan])
@pytest.mark.parametrize("axes", [(0,), (0, 1, 2)], ids=["one", "all"])
def test_log_scales(device, dtype, value, axes):
    """P3: drawn from -inf, an axis of length 0, while the axes stay within 1e30 px, needles within 1e19 px; else not there."""
    cam = camera(20, 16, cameras=1, dtype=dtype, device=device)
    gaussians = cloud(4, dtype, device)
    gaussians.means[2] = torch.tensor([0.0, 0.0, 3.0])
    gaussians.log_scales[2, list(axes)] = value
    found, visible = image_of(gaussians, cam)
    assert finite(*found)
    assert bool(visible[0, 2]) == (value < (42 if len(axes) == 1 else 66))  # f / z = 8
    if not bool(visible[0, 2]):
        rest = Gaussians(**{n: t[[0, 1, 3]] for n, t in gaussians.tensors().items()})
        assert all(torch.equal(a, b) for a, b in zip(found[:3], image_of(rest, cam)[0]))
        assert not any(bool(v[2].any()) for v in found[3:])


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
    assert finite(*(t for r in results for t in r))
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


def test_documented_ranges_are_those_of_the_kernel(device, dtype):
    """One Gaussian on either side of every limit: drawn inside, not there outside, finite everywhere."""
    cam = camera(20, 16, cameras=1, dtype=dtype, device=device)
    far, long = FARTHEST_PIXEL / float(cam.K[0, 0, 0]), LARGEST_AXIS / float(cam.K[0, 1, 1])

    def at(mean=(0.0, 0.0, 1.0), scales=(-2.0, -2.0, -2.0), length=1.0, coefficient=0.0):
        g = one(mean, scales, (length, 0.0, 0.0, 0.0), dtype=dtype, device=device)
        g.sh[0, 0, 1] = coefficient
        return g

    pairs = [
        tuple(at((0.0, 0.0, f * FAR), [math.log(FAR) - 2] * 3) for f in (0.999, 1.001)),
        tuple(at((f * far, 0.0, 1.0), [math.log(far)] * 3) for f in (0.999, 1.001)),
        (at(scales=[math.log(0.99 * long)] * 3), at(scales=[math.log(1.01 * long)] * 3)),
        (at(length=1.001 * SHORTEST_QUAT), at(length=0.999 * SHORTEST_QUAT)),
        (at(length=0.999 / SHORTEST_QUAT), at(length=1.001 / SHORTEST_QUAT)),
        (at(coefficient=0.999 * LARGEST_COEFFICIENT), at(coefficient=1.001 * LARGEST_COEFFICIENT)),
        (at((0.0, 0.0, 0.0101)), at((0.0, 0.0, 0.005))), (at(), at((0.0, 0.0, -0.5))),  # P6
        (at(scales=(-800.0, -1.0, -1.0)), at(length=0.0)),  # P5: a disc of no thickness; P4: no rotation
    ]  # fmt: skip
    on_cpu = Camera(cam.viewmat.cpu(), cam.K.cpu(), 20, 16)
    for number, pair in enumerate(pairs):
        for g, inside in zip(pair, (True, False)):
            found, visible = image_of(g, cam)
            assert bool(visible.any()) == inside and finite(*found), (number, inside)
            assert inside or not any(bool(t.any()) for t in found), number
            moved = Gaussians(**{n: t.cpu() for n, t in g.tensors().items()})
            assert bool(documented(moved, on_cpu, EXACT.near)[0][0]) == inside, number


def test_corners_of_the_ranges_are_finite(device):
    """Every combination of ends of means, depths, axes, quaternions and coefficients; of gradients, those of the camera too."""
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
        assert finite(r.rgb, r.alpha, r.depth, *found), (off, z, axes)
        count += int(r.visible.sum())
    assert count > 100, count


SIDE = 256
"""Width and height of the image [px]."""
FREE = dataclasses.replace(RULES["exact"], name="free", alpha_cut=0.0, transmittance_stop=0.0)
"""No cut-off, so that no pixel is decided by rounding."""


def needles(length: float, count: int) -> Inputs:
    """Return needles through the middle of the image, at many angles and tilted, with a standard deviation of ``length`` px."""
    focal = 1.2 * SIDE
    generator = torch.Generator().manual_seed(int(length))
    turn = math.pi * (torch.arange(count, dtype=torch.float64) + torch.rand(count, generator=generator)) / count
    tilt = torch.rand(count, generator=generator, dtype=torch.float64) - 0.5
    cz, sz, cy, sy = torch.cos(turn / 2), torch.sin(turn / 2), torch.cos(tilt / 2), torch.sin(tilt / 2)
    quats = torch.stack([cz * cy, -sz * sy, cz * sy, sz * cy], 1)  # about z after about y
    long = length / focal / torch.cos(tilt)
    thin = torch.full_like(long, 1e-3 / focal)
    means = torch.tensor([0.01, -0.02, 1.0], dtype=torch.float64).expand(count, 3)
    K = torch.tensor([[focal, 0, SIDE / 2 + 0.3], [0, focal, SIDE / 2 - 0.4], [0, 0, 1]])
    scales = torch.log(torch.stack([long, thin, thin], 1))
    logits, sh = torch.full((count,), math.log(9.0)), torch.zeros(count, 1, 3)
    return Inputs(means.float(), quats.float(), scales.float(), logits, sh, torch.eye(4), K, torch.zeros(3))


def test_needles_keep_their_weight(device):
    """At 300 px, up to two standard deviations away from each of 400 needles."""
    inputs, frame = needles(300, 400), Frame(SIDE, SIDE, 0, (0, 0, SIDE, SIDE))
    exact = projected_of(inputs.to(torch.float64), frame, FREE)
    xx, xy, yy = exact.conics.detach().unbind(1)
    strengths, axes = torch.linalg.eigh(torch.stack([xx, xy, xy, yy], -1).view(-1, 2, 2))  # the long axis first
    along = torch.tensor([-2.0, -1.0, -0.5, -0.25, 0.25, 0.5, 1.0, 2.0], dtype=torch.float64)
    across = torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0], dtype=torch.float64)
    t, s = (g.flatten() for g in torch.meshgrid(along, across, indexing="ij"))
    long, short = ((strengths[:, k, None].rsqrt() * axes[:, :, k])[:, None] for k in range(2))
    dx, dy = (t[None, :, None] * long + s[None, :, None] * short).float().unbind(-1)
    wanted = torch.exp(
        -0.5 * (xx[:, None] * dx.double() ** 2 + 2 * xy[:, None] * dx.double() * dy + yy[:, None] * dy.double() ** 2)
    )
    there = [v.detach().to(device) for v in inputs]
    projected, _ = project(*there[:5], there[5][None], there[6][None], width=SIDE, height=SIDE, degree=0, rule=FREE)
    u11, u12, u22 = projected[0, exact.ids.to(device), 2:5, None].unbind(1)
    e1, e2 = u11 * dx.to(device) + u12 * dy.to(device), u22 * dy.to(device)
    found = torch.exp(-0.5 * (e1 * e1 + e2 * e2)).double().cpu()
    assert float((found - wanted).abs().max()) < 1e-4  # measured 3.0e-5; a conic errs a hundred times as much
