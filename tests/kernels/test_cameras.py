"""Camera models: the seam for a model of one's own, and pixels, Jacobians and gradients of each lens."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from bench.lib.kernel_calls import project
from tests.gaussians import COEFFICIENTS, LENSES, SMOOTH, camera, cloud, hand_placed, leaves, lens_camera, opencv_pixels
from tests.parallel_camera import NAME
from warpgs import geometry
from warpgs.constants import RULES
from warpgs.errors import UsageError
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.render.reference import reference_image
from warpgs.scene import Camera, Gaussians

# The seam for camera models: a model that only this file knows renders, with right gradients.

BENDS = [[0.05, -0.02, 0.03, 0.01], [-0.04, 0.02, 0.01, 0.03]]


def parallel(**options):
    """Return a parallel camera that shows about what `camera` shows at depth 4."""
    cam = camera(**options)
    K = cam.K.clone()
    K[..., 0, 0] /= 4
    K[..., 1, 1] /= 4
    return dataclasses.replace(cam, K=K, model=NAME, distortion=K.new_zeros(*K.shape[:-2], 4))


@pytest.mark.parametrize("max_instances", [None, 100])
def test_another_model_renders(device, dtype, max_instances):
    """Depth does not matter to a parallel projection: Gaussians moved away along its axis give the same colours and alpha."""
    gaussians, cam = cloud(60, dtype, device), parallel(width=40, height=30, dtype=dtype, device=device)
    options = RasterizeOptions(sh_degree=0, max_instances=max_instances)
    moved = dataclasses.replace(gaussians, means=gaussians.means + torch.tensor([0, 0, 4.0]).to(gaussians.means))
    near, far = rasterize(gaussians, cam, options), rasterize(moved, cam, options)
    assert float(near.alpha.max()) > 0.5
    assert torch.allclose(near.rgb, far.rgb, atol=1e-5) and torch.allclose(near.alpha, far.alpha, atol=1e-5)
    pinhole = dataclasses.replace(cam, model="pinhole", distortion=None, K=camera(40, 30, dtype=dtype, device=device).K)
    images = [rasterize(g, pinhole, options).alpha for g in (gaussians, moved)]
    assert not torch.allclose(*images, atol=0.1)


def test_unknown_models_and_coefficients_of_another_number_are_refused():
    cam = dataclasses.replace(camera(dtype=torch.float32), model="fish")
    message = "unknown camera model 'fish'; choose one of fisheye, opencv, orthographic, pinhole.* or import the file"
    with pytest.raises(UsageError, match=message):
        rasterize(cloud(3), cam)
    options = {"width": 18, "height": 17, "degree": 1, "rule": RULES["exact"], "camera_model": "fish"}
    with pytest.raises(UsageError, match="unknown camera model 'fish'"):
        project(*cloud(3).tensors().values(), cam.viewmat[None], cam.K[None], **options)
    cam = parallel(dtype=torch.float32)
    for wrong in (None, 3):
        with pytest.raises(UsageError, match=f"'{NAME}' takes 4 coefficients of distortion, not {wrong or 0}; 0 for none"):
            rasterize(cloud(3), dataclasses.replace(cam, distortion=wrong and cam.K.new_zeros(wrong)))
    with pytest.raises(UsageError, match=r"'pinhole' takes no distortion; give model .* fisheye \(4\)"):
        rasterize(cloud(3), dataclasses.replace(cam, model="pinhole"))
    learned = dataclasses.replace(cam, distortion=cam.K.new_zeros(4).requires_grad_())
    with pytest.raises(UsageError, match="gradients of distortion coefficients are not supported"):
        rasterize(leaves(cloud(3)), learned)


# Orthographic camera, distorted pinhole and fisheye: pixels, Jacobians, gradients, rims and extremes.


def projected(gaussians: Gaussians, cam: Camera, rule=SMOOTH, degree: int = 0) -> torch.Tensor:
    return project(
        *gaussians.tensors().values(), cam.viewmat, cam.K, width=cam.width, height=cam.height, degree=degree, rule=rule,
        camera_model=cam.model, distortion=cam.distortion,
    )[0]  # fmt: skip


def at(positions, dtype=torch.float64, device="cpu") -> Gaussians:
    means = torch.as_tensor(np.array(positions), dtype=dtype, device=device)
    count = len(means)
    quats = means.new_tensor([1.0, 0, 0, 0]).expand(count, 4).contiguous()
    return Gaussians(means, quats, means.new_full((count, 3), -4), means.new_zeros(count), means.new_zeros(count, 1, 3))


def directions(largest: float, count: int = 60) -> np.ndarray:
    """Return positions at angles [degrees] from the axis from nearly 0 to ``largest``, at distances from 0.5 to 5 u."""
    generator = np.random.default_rng(4)
    angle, turn = np.radians(np.linspace(1e-7, largest, count)), generator.uniform(0, 2 * np.pi, count)
    unit = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], 1)
    return unit * generator.uniform(0.5, 5, (count, 1))


@pytest.mark.parametrize("model", [*LENSES, NAME])
def test_gradcheck(model, device):
    gaussians = leaves(hand_placed(device=device))
    if model == NAME:  # each camera has its own coefficients
        cam = parallel(cameras=2, device=device)
        cam = dataclasses.replace(cam, distortion=torch.tensor(BENDS).to(cam.K))
    else:
        cam = lens_camera(model, cameras=2, device=device)
    inputs = [*gaussians.tensors().values(), cam.viewmat.requires_grad_(), cam.K.requires_grad_()]

    def values(*tensors):
        moved = dataclasses.replace(cam, viewmat=tensors[5], K=tensors[6])
        return projected(Gaussians(*tensors[:5]), moved, degree=3)[..., :10]

    assert bool((values(*inputs) != 0).all())
    assert torch.autograd.gradcheck(values, inputs, eps=1e-6, atol=1e-7, rtol=1e-5, nondet_tol=0.0)


def test_gradcheck_of_a_fisheye_near_its_axis_and_behind(device):
    angles = np.radians([0.0, 1e-5, 0.5, 11.30, 11.32, 60, 89.9, 90.1, 150])
    positions = np.stack([0.6 * np.sin(angles), 0.8 * np.sin(angles), np.cos(angles)], 1) * 2
    cam = lens_camera("fisheye", cameras=1, device=device)
    cam = dataclasses.replace(cam, distortion=cam.distortion.abs())
    gaussians = leaves(at(positions, device=device))
    inputs = (gaussians.means, gaussians.log_scales, cam.K.requires_grad_())

    def values(means, log_scales, K):
        moved = dataclasses.replace(gaussians, means=means, log_scales=log_scales)
        return projected(moved, dataclasses.replace(cam, K=K))[..., [0, 1, 2, 3, 4, 9]]

    assert bool((values(*inputs)[..., 9 - 4] > 0).all())
    assert torch.autograd.gradcheck(values, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("model, largest", [("opencv", 50), ("fisheye", 80)])
def test_pixels_are_those_of_opencv(model, largest, dtype):
    positions, cam = directions(largest), lens_camera(model, width=400, height=300, cameras=1)
    wanted = opencv_pixels(model, COEFFICIENTS[model], cam.K[0].numpy(), positions)
    plane = geometry.to_plane(model, np.array(COEFFICIENTS[model]), positions)
    assert np.allclose(plane * np.diag(cam.K[0])[:2] + cam.K[0, :2, 2].numpy(), wanted, atol=1e-9)
    found = projected(at(positions, dtype), Camera(*(t.to(dtype) for t in (cam.viewmat, cam.K)), 400, 300, model,
                                                   cam.distortion.to(dtype)))[0]  # fmt: skip
    # thirty roundings of numbers of up to 1000 px
    assert np.allclose(found[:, :2].numpy(), wanted, atol=30 * 1000 * torch.finfo(dtype).eps, rtol=0)
    depth = np.linalg.norm(positions, axis=1) if model == "fisheye" else positions[:, 2]
    assert np.allclose(found[:, 9].numpy(), depth, rtol=4 * torch.finfo(dtype).eps)


def test_a_lens_without_distortion_is_a_pinhole(device):
    pinhole = camera(cameras=2, device=device)
    opencv = dataclasses.replace(pinhole, model="opencv", distortion=pinhole.K.new_zeros(2, 8))
    found = []
    for cam in (pinhole, opencv):
        gaussians = leaves(hand_placed(device=device))
        K = cam.K.clone().requires_grad_()
        values = projected(gaussians, dataclasses.replace(cam, K=K), degree=3)
        values.square().sum().backward()
        found.append([values.detach(), *(t.grad for t in gaussians.tensors().values()), K.grad])
    for one, other in zip(*found):
        # a hundred roundings of the largest number in a sum
        assert float((one - other).abs().max()) <= 100 * 2.3e-16 * float(one.abs().max())
    # None and an empty array give a pinhole's bits; opencv with zeros differs by rounding (measured 4.7e-6)
    gaussians, cam = cloud(300, torch.float32, device), camera(75, 53, cameras=2, dtype=torch.float32, device=device)
    image = rasterize(gaussians, cam).rgb
    for empty in (cam.K.new_zeros(0), cam.K.new_zeros(2, 0)):
        assert torch.equal(rasterize(gaussians, dataclasses.replace(cam, distortion=empty)).rgb, image)
    zeros = rasterize(gaussians, dataclasses.replace(cam, model="opencv", distortion=cam.K.new_zeros(8))).rgb
    assert float((zeros - image).abs().max()) < 2e-5 and float(image.max()) > 0.3


@pytest.mark.parametrize("model", LENSES)
def test_images_are_those_of_the_reference(model, device):
    """A cloud against the float64 image, the Jacobian of which is found by automatic differentiation."""
    gaussians, cam = cloud(300, torch.float64, device), lens_camera(model, width=75, height=53, device=device)
    gaussians = dataclasses.replace(gaussians, means=gaussians.means * gaussians.means.new_tensor([2.5, 2.5, 1]))
    background = gaussians.means.new_tensor([0.2, 0.5, 0.7])
    wanted = reference_image(gaussians, cam, (0, 0, 75, 53), background, 1)
    found = rasterize(gaussians, cam, RasterizeOptions(background=background)).rgb
    assert float((wanted - background).abs().max()) > 0.3
    assert float((found - wanted).abs().max()) < 1e-11


def test_a_fisheye_sees_behind_itself(device, dtype):
    """At 120 degrees from the axis without coefficients, the pixel lies 120 degrees times the focal length from the centre."""
    angle = math.radians(120)
    gaussians = at([[2 * math.sin(angle), 0, 2 * math.cos(angle)]], dtype, device)
    K = torch.tensor([[30.0, 0, 80], [0, 30, 80], [0, 0, 1]], dtype=dtype, device=device)
    cam = Camera(torch.eye(4, dtype=dtype, device=device), K, 160, 160, "fisheye", K.new_zeros(4))
    render = rasterize(gaussians, cam)
    assert torch.allclose(render.projected[0, 0, :2], K.new_tensor([80 + 30 * angle, 80]), atol=1e-4)
    row, column = divmod(int(render.alpha.argmax()), 160)
    assert (row, column) in ((79, 142), (80, 142)) and float(render.depth[row, column]) == pytest.approx(2, rel=1e-3)


RIMS = {
    # 3 k1 T + 1 = 0 at T = angle^2
    "fisheye": ((-0.15, 0, 0, 0), math.sqrt(1 / 0.45)),
    # the slope is (1 - T)(1 - T / 2)(1 - T / 4): below 0 from 1 rad to sqrt 2, above 0 to 2 rad, below 0 beyond
    "fisheye, rises again": ((-1.75 / 3, 0.875 / 5, -0.125 / 7, 0), 1.0),
    "opencv": ((-0.3, 0, 0, 0, 0, 0, 0, 0), math.atan(math.sqrt(1 / 0.9))),
    # (1 - t)(1 - t / 2) = 1 + 3 k1 t + 5 k2 t^2
    "opencv, rises again": ((-0.5, 0.1, 0, 0, 0, 0, 0, 0), math.atan(1.0)),
}


@pytest.mark.parametrize("name", RIMS)
def test_nothing_is_drawn_beyond_the_rim(name, dtype):
    """A hair inside of the first angle at which the polynomial folds back a Gaussian is drawn, and none beyond."""
    coefficients, rim = RIMS[name]
    model = name.split(",")[0]
    last = 3.1 if model == "fisheye" else 1.56
    angles = np.array([0.5 * rim, (1 - 1e-4) * rim, (1 + 1e-4) * rim, *np.linspace(1.01 * rim, last, 20)])
    positions = 3 * np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], 1)
    K = torch.tensor([[[50.0, 0, 4000], [0, 50, 4000], [0, 0, 1]]], dtype=dtype)
    cam = Camera(torch.eye(4, dtype=dtype)[None], K, 8000, 8000, model, K.new_tensor([coefficients]))
    drawn = projected(at(positions, dtype), cam)[0, :, 5] > 0
    assert drawn.tolist() == [True, True] + [False] * 21
    assert geometry.on_lens(model, np.array(coefficients), positions).tolist() == drawn.tolist()


@pytest.mark.parametrize("model", LENSES)
def test_near_far_and_what_is_no_number(model):
    cam = lens_camera(model, cameras=1, dtype=torch.float32)
    rule = dataclasses.replace(RULES["exact"], alpha_cut=0.0, transmittance_stop=0.0)
    wrong = [[0, 0, 0.5 * rule.near], [0, 0, 2e10], [0, 0, math.nan], [math.nan, 0, 2], [math.inf, 0, 2], [0, 0, math.inf]]
    values = projected(at([[0.1, 0, 2 * rule.near], *wrong], torch.float32), cam, rule)[0]
    assert bool(values[0, 5] > 0) and not bool(values[1:].any())
    if cam.distortion is not None:
        for i in range(cam.distortion.shape[1]):
            lens = cam.distortion.clone()
            lens[0, i] = math.nan
            assert not bool(projected(at([[0.1, 0.2, 2]], torch.float32), dataclasses.replace(cam, distortion=lens)).any())


@pytest.mark.parametrize("model", LENSES)
def test_extremes_give_finite_numbers(model):
    generator = torch.Generator().manual_seed(1)
    count = 20000

    def magnitudes(low: float, high: float, *shape: int) -> torch.Tensor:
        sign = 1 - 2 * torch.randint(2, shape, generator=generator)
        return sign * 10 ** (low + (high - low) * torch.rand(*shape, generator=generator))

    gaussians = Gaussians(
        magnitudes(-12, 11, count, 3), torch.randn(count, 4, generator=generator),
        20 * torch.randn(count, 3, generator=generator), torch.zeros(count), torch.zeros(count, 1, 3),
    )  # fmt: skip
    drawn = 0
    for case in range(4):
        cam = lens_camera(model, cameras=1, dtype=torch.float32)
        if cam.distortion is not None:
            cam = dataclasses.replace(
                cam, distortion=magnitudes(-6, 4, *cam.distortion.shape).abs() if case else cam.distortion
            )
        g, K = leaves(gaussians), cam.K.clone().requires_grad_()
        values = projected(g, dataclasses.replace(cam, K=K), RULES["exact"])
        drawn += int((values[..., 5] > 0).sum())
        assert bool(torch.isfinite(values).all())
        values[..., :10].sum().backward()
        for tensor in (*g.tensors().values(), K):
            assert bool(torch.isfinite(tensor.grad).all())
    assert drawn > 100


@pytest.mark.parametrize("model, largest", [("orthographic", 60), ("opencv", 45), ("fisheye", 110)])
def test_the_way_back_from_the_plane(model, largest):
    positions, lens = directions(largest), np.array(COEFFICIENTS[model])
    plane = geometry.to_plane(model, lens, positions)
    depth = geometry.depth_of(model, positions)[:, None]
    wanted = np.concatenate([plane, np.ones_like(depth)], 1) if model == "orthographic" else positions / depth
    assert np.allclose(geometry.from_plane(model, lens, plane), wanted, atol=1e-9)
    found = geometry.from_plane(model, torch.from_numpy(lens), torch.from_numpy(plane))
    assert np.allclose(found.numpy(), wanted, atol=1e-9)
    if model != "orthographic":
        rim = {"opencv": (-0.3, *[0] * 7), "fisheye": (-0.15, 0, 0, 0)}[model]
        assert np.isnan(geometry.from_plane(model, np.array(rim), np.array([[1.5, 0.0]]))).all()
