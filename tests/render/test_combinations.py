"""Every output under each camera model and kind of Gaussians: gradients, rotations, windows, channels, CPU against CUDA."""

import dataclasses
import itertools

import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, hand_placed, leaves
from tests.lens_cameras import LENSES, lens_camera
from tests.tolerances import close
from warpgs.geometry import rotation_matrices
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import ActivatedGaussians, Camera, CovarianceGaussians, Gaussians

MODELS = ["pinhole", *LENSES]
KINDS = ["stored", "activated", "covariances"]
EVERYTHING = {"contributions": True, "median_depth": True, "heaviest": 3, "error_bound": True}
"""Requests for all outputs that are not always there, but features."""
DIFFERENTIABLE = ("rgb", "alpha", "depth", "features")
IMAGES = (*DIFFERENTIABLE, "median_depth", "error_bound", "heaviest_ids", "heaviest_weights", "blend_counts")
SIZE = (50, 37)


def of_kind(kind: str, stored: Gaussians):
    """Return Gaussians held another way; they require gradients."""
    t = {n: v.detach() for n, v in stored.tensors().items()}
    scales, opacities = t["log_scales"].exp(), t["logit_opacities"].sigmoid()
    if kind == "covariances":
        half = rotation_matrices(torch.nn.functional.normalize(t["quats"])) * scales[:, None]
        values = (CovarianceGaussians, t["means"], half @ half.mT, opacities, t["sh"])
    elif kind == "activated":
        values = (ActivatedGaussians, t["means"], t["quats"], scales, opacities, t["sh"])
    else:
        values = (Gaussians, *t.values())
    return values[0](*(v.clone().requires_grad_() for v in values[1:]))


def tensors_of(gaussians) -> list[torch.Tensor]:
    """Return what Gaussians of a kind are made from."""
    return [getattr(gaussians, f.name) for f in dataclasses.fields(gaussians)]


def seen_by(model: str, width: int, height: int, **options) -> Camera:
    """Return a camera of a model."""
    size = {"width": width, "height": height}
    return camera(**size, **options) if model == "pinhole" else lens_camera(model, **size, **options)


def some(*shape, like: torch.Tensor, seed: int = 0) -> torch.Tensor:
    """Return random numbers of either sign."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(like)


QUICK = {*itertools.product(["pinhole"], KINDS, (False, True)), *((model, "stored", False) for model in MODELS)}
CASES = [
    pytest.param(*case, marks=() if case in QUICK else pytest.mark.slow)
    for case in itertools.product(MODELS, KINDS, (False, True))
]


@pytest.mark.parametrize(("model", "kind", "antialiased"), CASES)
def test_gradcheck(device, model, kind, antialiased):
    """Finite differences of every differentiable output, by every tensor that may require gradients."""
    given, cam = of_kind(kind, hand_placed(device=device, degree=1)), seen_by(model, 12, 11, device=device)
    own = tensors_of(given)
    others = [cam.viewmat, cam.K, some(3, like=cam.K), some(6, 2, like=cam.K, seed=1), some(2, like=cam.K, seed=2)]
    inputs = [*own, *(t.detach().clone().requires_grad_() for t in others)]

    def outputs(*tensors):
        viewmat, K, behind, features, behind_features = tensors[len(own) :]
        options = RasterizeOptions(
            rule=SMOOTH, antialiased=antialiased, background=behind, features=features, feature_background=behind_features
        )
        r = rasterize(type(given)(*tensors[: len(own)]), dataclasses.replace(cam, viewmat=viewmat, K=K), options)
        return r.rgb, r.alpha, r.depth, r.features, r.projected[..., :10]

    assert torch.autograd.gradcheck(outputs, inputs, eps=1e-6, atol=1e-6, rtol=1e-5, nondet_tol=0.0, fast_mode=True)


@pytest.mark.parametrize("model", MODELS)
def test_a_turned_scene_with_its_camera_gives_the_same_outputs(device, model):
    """All of them, and gradients turn along; in float64, with colours that do not depend on the direction."""
    given, cam = leaves(cloud(150, torch.float64, device)), seen_by(model, *SIZE, cameras=2, device=device)
    w, x, y, z = quat = torch.nn.functional.normalize(cam.K.new_tensor([0.8, -0.3, 0.5, 0.2]), dim=0)
    Q, shift = rotation_matrices(quat), cam.K.new_tensor([0.7, -2.0, 1.1])
    from_left = torch.stack([w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w]).reshape(4, 4)  # the product with it
    moved = dataclasses.replace(given, means=given.means @ Q.T + shift, quats=given.quats @ from_left.T)
    turned = leaves(moved)
    R, t = cam.viewmat[:, :3, :3] @ Q.T, cam.viewmat[:, :3, 3:]
    viewmat = torch.cat([torch.cat([R, t - R @ shift[:, None]], 2), cam.viewmat[:, 3:]], 1)
    values = some(150, 3, like=given.means)
    options = RasterizeOptions(colors=values, features=values[:, :2], **EVERYTHING)
    found = []
    for g, c in ((given, cam), (turned, dataclasses.replace(cam, viewmat=viewmat))):
        r = rasterize(g, c, options)
        loss = sum((i * some(*i.shape, like=i)).sum() for i in (getattr(r, n) for n in DIFFERENTIABLE))
        found.append((r, *torch.autograd.grad(loss, [g.means, g.quats, g.log_scales, g.logit_opacities])))
    (one, *before), (other, *after) = found
    for name in (*IMAGES, "weight_sums", "weight_maxima", "tile_counts"):
        a, b = getattr(one, name).detach(), getattr(other, name).detach()
        assert bool(a.any()), name
        assert torch.equal(a, b) if a.dtype == torch.int32 else float((a - b).abs().max()) < 1e-11, name  # measured 6e-14
    for a, b, back in zip(before, after, (Q, from_left, None, None)):
        assert float((a - (b if back is None else b @ back)).norm()) < 1e-11 * float(a.norm())


@pytest.mark.parametrize(
    ("model", "kind", "antialiased", "rule"),
    [
        *((m, "stored", False, "exact") for m in MODELS),
        *(("pinhole", k, True, "fast" if k == "stored" else "exact") for k in KINDS),
    ],
)
def test_windows_and_chunks_have_the_bits_of_every_output(device, dtype, model, kind, antialiased, rule):
    """In every image; gradients of what they show are those of the whole, but for the order of sums in chunks."""
    given = of_kind(kind, cloud(200, dtype, device))
    cam = seen_by(model, *SIZE, cameras=2, dtype=dtype, device=device)
    own = [some(200, 2, like=given.means), some(2, like=given.means, seed=1), torch.linspace(0.5, 1, 200).to(given.means)]
    options = RasterizeOptions(
        rule=rule, antialiased=antialiased, features=own[0].requires_grad_(), feature_background=own[1].requires_grad_(),
        opacity_factors=own[2], **EVERYTHING,
    )  # fmt: skip
    x, y, w, h = window = (16, 16, 34, 21)
    whole, part, chunked = (
        rasterize(given, cam, dataclasses.replace(options, **how)) for how in ({}, {"window": window}, {"max_instances": 60})
    )
    assert int(whole.tile_counts.sum()) > 120 and (rule == "fast" or float(whole.error_bound.detach().median()) < 1e-5)
    for name in IMAGES:
        crop = getattr(whole, name)[:, y : y + h, x : x + w]
        assert torch.equal(getattr(part, name), crop) and bool(crop.any()), name
        assert torch.equal(getattr(chunked, name), getattr(whole, name)), name
    assert torch.equal(chunked.weight_maxima, whole.weight_maxima)
    close("image", chunked.weight_sums, whole.weight_sums)
    leaves_of = [*tensors_of(given), *own[:2]]
    gradients = []
    for r, (i, j) in ((whole, (y, x)), (part, (0, 0)), (chunked, (y, x))):
        crops = [getattr(r, n)[:, i : i + h, j : j + w] for n in DIFFERENTIABLE]
        loss = sum((c * some(*c.shape, like=c)).sum() for c in crops)
        gradients.append(torch.autograd.grad(loss, leaves_of))
    for a, b, c in zip(*gradients):
        close("gradient", b, a)
        close("gradient", c, a)


@pytest.mark.parametrize("channels", [6, 9, 32])
def test_channels_are_the_bits_of_calls_of_three(device, dtype, channels):
    """Colours and features of one call against a call for each three of them, and the gradient of each channel."""
    given, cam = cloud(200, dtype, device), camera(*SIZE, cameras=2, dtype=dtype, device=device)
    values, behind = some(200, channels, like=given.means), some(channels, like=given.means, seed=1)
    own = [values.clone().requires_grad_(), behind.clone().requires_grad_()]
    whole = rasterize(given, cam, RasterizeOptions(colors=own[0], background=own[1]))
    beside = rasterize(given, cam, RasterizeOptions(features=values, feature_background=behind))
    assert torch.equal(whole.rgb, beside.features)
    upstream = some(*whole.rgb.shape, like=values, seed=2)
    found = torch.autograd.grad((whole.rgb * upstream).sum(), own)
    for first in range(0, channels, 3):
        part = slice(first, first + 3)
        three = [values[:, part].clone().requires_grad_(), behind[part].clone().requires_grad_()]
        r = rasterize(given, cam, RasterizeOptions(colors=three[0], background=three[1]))
        assert (
            torch.equal(r.rgb, whole.rgb[..., part]) and torch.equal(r.depth, whole.depth) and torch.equal(r.alpha, whole.alpha)
        )
        v = torch.autograd.grad((r.rgb * upstream[..., part]).sum(), three)
        assert torch.equal(v[0], found[0][:, part]) and torch.equal(v[1], found[1][part])


@pytest.mark.cuda
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("model", MODELS)
def test_cpu_equals_cuda(model, kind):
    """Every output and gradient in float32 on CUDA against float64 on the CPU, where no threshold is near."""
    found = []
    for device, dtype in (("cpu", torch.float64), ("cuda:0", torch.float32)):
        given = of_kind(kind, hand_placed(dtype, device, degree=1))
        cam = seen_by(model, 33, 21, cameras=2, dtype=dtype, device=device)
        features = some(6, 5, like=given.means).requires_grad_()
        options = RasterizeOptions(rule=SMOOTH, features=features, antialiased=True, **(EVERYTHING | {"error_bound": False}))
        r = rasterize(given, cam, options)
        loss = sum((i * some(*i.shape, like=i)).sum() for i in (getattr(r, n) for n in DIFFERENTIABLE))
        named = {n: getattr(r, n).detach().cpu().double() for n in IMAGES if n != "error_bound"}
        named |= {n: getattr(r, n).detach().cpu().double() for n in ("weight_sums", "weight_maxima")}
        found.append((named, [v.cpu().double() for v in torch.autograd.grad(loss, [*tensors_of(given), features])]))
    for name, wanted in found[0][0].items():
        other = found[1][0][name]
        if name in ("median_depth", "heaviest_ids", "heaviest_weights", "blend_counts"):  # rounding may decide a pixel
            assert float(((other - wanted).abs() > 1e-4).double().mean()) < 5e-3, name
        else:
            assert float((other - wanted).norm()) < 1e-5 * float(wanted.norm()), name
    for a, b in zip(found[0][1], found[1][1]):
        assert float((a - b).norm()) < 1e-4 * float(a.norm())
