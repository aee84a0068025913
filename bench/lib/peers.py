"""Other programs for the same work, with the same interface: plain torch, the naive Warp kernel, gsplat."""

from __future__ import annotations

import functools

import torch
import torch.nn.functional as F
from torch.utils.checkpoint import checkpoint

from bench.lib import inputs, naive
from warpgs.constants import RULES, Rule
from warpgs.geometry import rotation_matrices
from warpgs.kernels.sh import basis
from warpgs.scene import Camera, Gaussians

TORCH_SSIM = "torch conv2d"
DENSE = "torch dense"
NAIVE = "naive"
GSPLAT = "gsplat"
GSPLAT_STEP = "gsplat + torch"
PIXELS_AT_ONCE = 4096
"""Number of pixels that the dense rasterizer composites at a time, to limit memory."""


@functools.cache
def _window(device: torch.device) -> torch.Tensor:
    """Return the 11 x 11 Gaussian window with sigma 1.5 for three channels, shape [3, 1, 11, 11]."""
    line = torch.exp(-0.5 * (torch.arange(-5.0, 6.0) / 1.5) ** 2)
    line = line / line.sum()
    return torch.outer(line, line).expand(3, 1, 11, 11).contiguous().to(device)


def torch_ssim(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return structural similarity as trainers after Kerbl et al. 2023 compute it; images and result [H, W, 3]."""
    window = _window(image.device)
    a, b = (t.permute(2, 0, 1)[None] for t in (image, target))
    blur = functools.partial(F.conv2d, weight=window, padding=5, groups=3)
    ma, mb = blur(a), blur(b)
    va, vb, covariance = blur(a * a) - ma * ma, blur(b * b) - mb * mb, blur(a * b) - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * ma * mb + c1) * (2 * covariance + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2))
    return similarity[0].permute(1, 2, 0)


def _projected(
    g: Gaussians, view: torch.Tensor, K: torch.Tensor, width: int, height: int, rule: Rule
) -> tuple[torch.Tensor, ...]:
    """Return means [px] [N, 2], inverse covariances [N, 2, 2], opacities [N], colours [N, 3] of visible Gaussians, by depth."""
    R, t = view[:3, :3], view[:3, 3]
    p = g.means @ R.T + t
    order = torch.argsort(p[:, 2])
    order = order[p[order, 2] >= rule.near]
    p, log_scales = p[order], g.log_scales[order]
    rotation = rotation_matrices(F.normalize(g.quats[order], dim=1))
    f, c = torch.stack([K[0, 0], K[1, 1]]), K[:2, 2]
    means = f * p[:, :2] / p[:, 2:] + c
    margin = 0.15 * torch.tensor([width, height], device=p.device)
    clamped = means.clamp(-margin, margin * (1 / 0.15 + 1))
    jacobian = torch.cat([torch.diag_embed(f / p[:, 2:]), ((c - clamped) / p[:, 2:])[..., None]], -1)
    axes = jacobian @ R @ rotation * log_scales.exp()[:, None]
    covariance = axes @ axes.mT + rule.low_pass * torch.eye(2, device=p.device, dtype=p.dtype)
    directions = F.normalize(g.means[order] + R.T @ t, dim=1)
    colors = torch.einsum("nk,nkc->nc", basis(directions)[:, : g.sh.shape[1]], g.sh[order])
    return means, torch.linalg.inv(covariance), g.logit_opacities[order].sigmoid(), (colors + 0.5).clamp_min(0)


def _composite(rule, pixels, means, inverses, opacities, colors):
    """Return the colours [P, 3] of pixel centres [P, 2], with every Gaussian evaluated at every pixel."""
    dx, dy = pixels[:, :1] - means[:, 0], pixels[:, 1:] - means[:, 1]
    a, b, c = inverses[:, 0, 0], inverses[:, 0, 1], inverses[:, 1, 1]
    alpha = (opacities * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp(max=rule.alpha_max)
    alpha = torch.where(alpha >= rule.alpha_cut, alpha, 0)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    looked_at = before if rule.inclusive_stop else after
    return torch.where(looked_at >= rule.transmittance_stop, alpha * before, 0) @ colors


def dense_rasterize(gaussians: Gaussians, camera: Camera, rule: Rule = RULES["exact"]) -> torch.Tensor:
    """Render a rule without a square in plain torch, without tiles: images [C, H, W, 3] over black, for small N only."""
    device, composite = gaussians.means.device, functools.partial(_composite, rule)
    y, x = torch.meshgrid(torch.arange(camera.height, device=device), torch.arange(camera.width, device=device), indexing="ij")
    centers = torch.stack([x, y], -1).reshape(-1, 2) + 0.5
    images = []
    for view, K in zip(camera.viewmat, camera.K):
        projected = _projected(gaussians, view, K, camera.width, camera.height, rule)
        parts = [checkpoint(composite, part, *projected, use_reentrant=False) for part in centers.split(PIXELS_AT_ONCE)]
        images.append(torch.cat(parts).view(camera.height, camera.width, 3))
    return torch.stack(images)


def gsplat_rasterize(gaussians: Gaussians, camera: Camera, packed: bool = False) -> torch.Tensor:
    """Render the same images by gsplat; activations are applied outside, as its interface requires."""
    from gsplat import rasterization

    rgb, _, _ = rasterization(
        gaussians.means, gaussians.quats, gaussians.log_scales.exp(), gaussians.logit_opacities.sigmoid(), gaussians.sh,
        camera.viewmat, camera.K, camera.width, camera.height, sh_degree=gaussians.sh_degree, packed=packed,
    )  # fmt: skip
    return rgb


RASTERIZERS = {DENSE: dense_rasterize, NAIVE: naive.rasterize, GSPLAT: gsplat_rasterize}
"""Peers that render: Gaussians and a batch of cameras in, images [C, H, W, 3] out."""


@functools.cache
def absent(device: torch.device) -> dict[str, str]:
    """Return the peers that cannot render an image and its gradient on a device, each with the reason."""
    reasons = {}
    for name, draw in RASTERIZERS.items():
        try:
            gaussians = inputs.gaussians(10, device)
            image = draw(gaussians, inputs.camera(32, 32, device))
            torch.autograd.grad(image.sum(), [gaussians.means])
        except Exception as e:  # whatever a foreign program fails with, the bench goes on without it
            reasons[name] = " ".join(f"{type(e).__name__}: {e}".split())[:200]
    if GSPLAT in reasons:
        reasons[GSPLAT_STEP] = reasons[GSPLAT]
    return reasons
