"""Antialiasing: opacities times sqrt(det(cov2d) / det(cov2d + low_pass I)), the 2D filter of Mip-Splatting."""

import dataclasses
import math

import pytest
import torch

from tests.gaussians import SMOOTH, camera, hand_placed, leaves
from tests.reference.blend import blend_reference
from tests.reference.project import project_reference
from tests.tolerances import close
from warpgs.constants import ALPHA_CUT, RULES
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

ANTIALIASED = RasterizeOptions(antialiased=True)


def small(dtype=torch.float64, device="cpu"):
    """Six Gaussians with axes from 0.2 to 1 px, as leaves."""
    g = hand_placed(dtype, device)
    return leaves(Gaussians(**{**g.tensors(), "log_scales": g.log_scales - 2}))


def reference(tensors, cam, rule):
    """Opacities [C, N] with the factor from determinants of matrices, and the images of each camera."""
    means, covs, colors, depths, opacities = project_reference(
        *tensors, width=cam.width, height=cam.height, degree=3, low_pass=rule.low_pass
    )
    bare = covs - rule.low_pass * torch.eye(2, dtype=covs.dtype)
    opacities = opacities * torch.sqrt(torch.linalg.det(bare) / torch.linalg.det(covs))
    background, size = torch.zeros(3, dtype=covs.dtype), (cam.width, cam.height)
    found = [blend_reference(*p, background, *size, rule) for p in zip(means, covs, opacities, colors, depths)]
    return opacities, [torch.stack(t) for t in zip(*found)][:3]


@pytest.mark.parametrize("rule", [SMOOTH, RULES["exact"]], ids=lambda rule: rule.name)
def test_opacities_images_and_gradients_equal_reference(device, dtype, rule):
    """By matrices and autograd in float64: Gaussians, poses and intrinsics."""
    gaussians, cam = small(dtype, device), camera(cameras=2, dtype=dtype, device=device)
    views, Ks = cam.viewmat.clone().requires_grad_(), cam.K.clone().requires_grad_()
    r = rasterize(gaussians, dataclasses.replace(cam, viewmat=views, K=Ks), dataclasses.replace(ANTIALIASED, rule=rule))
    own = [*gaussians.tensors().values(), views, Ks]
    other = [t.detach().cpu().double().requires_grad_() for t in own]
    opacities, images = reference(other, cam, rule)
    assert bool((opacities < 0.5 * torch.sigmoid(other[3])).any())  # the factor matters
    seen = r.visible.cpu()
    close("projection", r.projected[..., 5].cpu()[seen], opacities[seen])
    found = (r.rgb, r.alpha, r.depth)
    for a, b in zip(found, images):
        close("image", a, b)
    upstream = [torch.randn(b.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64) for b in images]
    sum((a * v.to(a)).sum() for a, v in zip(found, upstream)).backward()
    sum((b * v).sum() for b, v in zip(images, upstream)).backward()
    other[6].grad[:, 0, 1] = other[6].grad[:, 1, 0] = 0
    for a, b in zip(own, other):
        close("gradient", a.grad, b.grad)


def spots(sigmas, dtype=torch.float32, device="cpu"):
    """Gaussians at the centre of pixel (16, 16), one for each row of standard deviations [N, 3] in px."""
    sigmas = torch.as_tensor(sigmas, dtype=torch.float64)
    n = len(sigmas)
    tensors = {
        "means": torch.tensor([[0.05, 0.05, 10.0]]).expand(n, 3), "quats": torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4),
        "log_scales": torch.log(sigmas / 10), "logit_opacities": torch.zeros(n), "sh": torch.zeros(n, 1, 3),
    }  # fmt: skip
    K = torch.tensor([[100.0, 0, 16], [0, 100, 16], [0, 0, 1]], dtype=dtype, device=device)
    cam = Camera(torch.eye(4, dtype=dtype, device=device), K, 32, 32)
    return Gaussians(**{k: t.to(device, dtype).contiguous().requires_grad_() for k, t in tensors.items()}), cam


def test_the_total_is_that_of_the_gaussian_at_any_size(device, dtype):
    """Alphas sum to opacity x 2 pi sigma^2 from a hundredth of a pixel on; without the option small ones are too bright."""
    for sigma in (0.01, 0.1, 0.5, 2.0):
        g, cam = spots([[sigma] * 3], dtype, device)
        totals = [
            float(rasterize(g, cam, RasterizeOptions(rule=SMOOTH, antialiased=a)).alpha.detach().sum()) / (math.pi * sigma**2)
            for a in (True, False)
        ]  # alpha sums, over those of one Gaussian at opacity 1/2
        # Pixels sample a Gaussian of variance v >= 0.3: their sum is off by at most 2 exp(-2 pi^2 v) = 0.54 % an axis
        assert abs(totals[0] - 1) < 0.012
        assert totals[1] == pytest.approx(1 + 0.3 / sigma**2, rel=0.012)


def test_tiles_follow_from_the_reduced_opacity(device):
    """A Gaussian below the cut is culled, and one just above it gets the box of that opacity."""
    sigma = math.sqrt(0.3 / (0.5 / ALPHA_CUT - 1))  # sigma^2 / (sigma^2 + 0.3) times 1/2 is the cut
    g, cam = spots([[0.99 * sigma] * 3, [1.01 * sigma] * 3], device=device)
    r = rasterize(g, cam, ANTIALIASED)
    assert r.visible[0].tolist() == [False, True] and r.tile_counts[0].tolist() == [0, 1]
    half_widths = [float(found.projected[0, 1, 10].detach()) for found in (r, rasterize(g, cam))]
    assert half_widths[0] < 0.2 < 1 < half_widths[1]
    assert float(r.alpha.detach().max()) >= ALPHA_CUT


def test_float32_keeps_the_digits_of_needles(device):
    """Axes from 1e-4 to 1e4 px in any direction: opacity and gradients beside float64."""
    generator = torch.Generator().manual_seed(5)
    sigmas = 10 ** (8 * torch.rand(400, 3, generator=generator, dtype=torch.float64) - 4)
    turns = torch.randn(400, 4, generator=generator, dtype=torch.float64)
    found = []
    for dtype in (torch.float32, torch.float64):
        g, cam = spots(sigmas.float().double(), dtype, device)
        with torch.no_grad():
            g.log_scales.copy_(g.log_scales.float())
            g.quats.copy_(turns.float())
        r = rasterize(g, cam, dataclasses.replace(ANTIALIASED, rule=SMOOTH))
        r.projected[..., 5].sum().backward()
        found.append((r.projected[0, :, 5].detach(), g.log_scales.grad, g.quats.grad))
    for name, a, b in zip(("opacity", "log_scales", "quats"), *found):
        assert float((a - b).norm() / b.norm()) < 1e-5, name  # measured: 1e-7, 3e-7, 2e-6


@pytest.mark.parametrize("low_pass", [0.3, 0.0])
def test_extremes_are_finite(device, dtype, low_pass):
    """Points, lines, discs seen from the edge, needles up to 1e20 px: finite images and gradients; no area, no brightness."""
    sizes = (0.0, 1e-30, 1e-12, 1e-3, 1.0, 1e3, 1e9, 1e20)
    g, cam = spots([(a, b, c) for a in sizes for b in sizes for c in (0.0, 1.0, 1e9)], dtype, device)
    for rule in (SMOOTH, RULES["exact"]):
        r = rasterize(g, cam, RasterizeOptions(rule=dataclasses.replace(rule, low_pass=low_pass), antialiased=True))
        opacity = r.projected[0, :, 5].detach()
        assert bool((opacity <= 0.5).all()) and bool(r.visible.any())
        (r.rgb.square().sum() + r.alpha.square().sum() + r.depth.sum()).backward()
        assert all(bool(torch.isfinite(t).all()) for t in (r.rgb, r.alpha, r.depth))
        assert all(bool(torch.isfinite(t.grad).all()) for t in g.tensors().values())
    flat = (g.log_scales[:, :2] == -math.inf).any(1) & (g.log_scales[:, 2] == -math.inf)
    assert not bool(r.visible[0, flat.to(r.visible.device)].any())
    if low_pass == 0:  # nothing is added, so nothing is taken back
        plain = rasterize(g, cam, RasterizeOptions(rule=dataclasses.replace(RULES["exact"], low_pass=0.0)))
        assert torch.equal(plain.visible, r.visible)
        close("projection", opacity, plain.projected[0, :, 5])
