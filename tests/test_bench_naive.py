"""The naive kernels that the benches compare with compute the same as the real ones."""

import torch

import warpgs
from bench.naive import Naive, rasterize
from tests.gaussians import camera, cloud
from warpgs.constants import RULES
from warpgs.kernels.blend import blend
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles
from warpgs.scene import Gaussians


def test_naive_kernels_equal_the_real_ones(device):
    """Picture and gradients, two cameras, an image that is no multiple of a tile."""
    rule, cam = RULES["exact"], camera(45, 37, cameras=2, dtype=torch.float32, device=device)
    size = {"width": cam.width, "height": cam.height}
    gaussians = cloud(300, torch.float32, device)
    gaussians.logit_opacities[:] += 3  # some alphas are clamped, some pixels stop
    projected, counts = project(*gaussians.tensors().values(), cam.viewmat, cam.K, **size, degree=1, rule=rule)
    tiles = bin_tiles(projected, counts, **size, rule=rule)
    background = torch.rand(2, 3, generator=torch.Generator().manual_seed(1)).to(device)
    leaf = projected.detach().requires_grad_()
    rgb = blend(leaf, tiles, background, **size, rule=rule)[0]
    v_rgb = torch.randn(rgb.shape, generator=torch.Generator().manual_seed(2)).to(device)
    (gradient,) = torch.autograd.grad(rgb, [leaf], v_rgb)
    naive = Naive(projected, tiles, background, **size, rule=rule)
    # an alpha within a rounding of the cut may be drawn by one and not by the other
    for found, wanted in ((naive.forward(), rgb.detach()), (naive.backward(v_rgb), gradient)):
        assert float((found - wanted).norm()) <= 1e-4 * float(wanted.norm())


def test_naive_pictures_equal_the_real_ones(device):
    """Behind the call of the harness, gradients of the parameters included."""
    cam = camera(45, 37, cameras=2, dtype=torch.float32, device=device)
    leaves = [t.requires_grad_() for t in cloud(300, torch.float32, device).tensors().values()]
    gaussians = Gaussians(*leaves)
    ours, theirs = warpgs.rasterize(gaussians, cam).rgb, rasterize(gaussians, cam)
    v_rgb = torch.randn(ours.shape, generator=torch.Generator().manual_seed(2)).to(device)
    pairs = zip(torch.autograd.grad(theirs, leaves, v_rgb), torch.autograd.grad(ours, leaves, v_rgb))
    for found, wanted in [(theirs.detach(), ours.detach()), *pairs]:
        assert float((found - wanted).norm()) <= 1e-4 * float(wanted.norm())
