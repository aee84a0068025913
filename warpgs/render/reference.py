"""The picture that rule ``exact`` defines, in float64 and by other means than the kernels: what errors are measured against."""

from __future__ import annotations

import math

import torch

from warpgs.constants import FRUSTUM_MARGIN, RULES
from warpgs.kernels import sh
from warpgs.scene import Camera, Gaussians

BLOCK = 16
"""Side of the blocks of pixels that are composited at a time [px]."""


def _rotations(quats: torch.Tensor) -> torch.Tensor:
    """Rotation matrices [N, 3, 3] of quaternions wxyz [N, 4]."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).view(-1, 3, 3)


def _colors(coefficients: torch.Tensor, directions: torch.Tensor, degree: int) -> torch.Tensor:
    """Colours [N, 3] of coefficients [N, K, 3] at unit directions [N, 3] (docs/sh.md)."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [
        sh.C0 * torch.ones_like(x), -sh.C1 * y, sh.C1 * z, -sh.C1 * x,
        sh.C2 * x * y, -sh.C2 * y * z, sh.C20 * (2 * zz - xx - yy), -sh.C2 * x * z, sh.C22 * (xx - yy),
        -sh.C33 * y * (3 * xx - yy), sh.C32 * x * y * z, -sh.C31 * y * (4 * zz - xx - yy),
        sh.C30 * z * (2 * zz - 3 * xx - 3 * yy), -sh.C31 * x * (4 * zz - xx - yy), sh.C322 * z * (xx - yy),
        -sh.C33 * x * (xx - 3 * yy),
    ]  # fmt: skip
    count = sh.coefficient_count(degree)
    color = torch.einsum("nk,nkc->nc", torch.stack(basis[:count], -1), coefficients[:, :count])
    return (color + 0.5).clamp_min(0)


@torch.no_grad()
def reference_image(
    gaussians: Gaussians, camera: Camera, window: tuple[int, int, int, int], background: torch.Tensor, degree: int
) -> torch.Tensor:
    """Colours in a window of one camera's picture under rule ``exact``, in float64.

    Dense over the pixels of a block and by matrices throughout (Kerbl et al. 2023, section 4 and eq. 3), so for windows of
    some thousand pixels. Gaussians of a window should be few: leave out those that do not reach it.

    Args:
        gaussians: N Gaussians of any scalar type, all finite.
        camera: One camera.
        window: Left, top, width and height [px].
        background: Colour behind the scene, shape [3].
        degree: Spherical-harmonics degree used.

    Returns:
        Shape [h, w, 3].
    """
    rule = RULES["exact"]
    means, quats, log_scales, logits, coefficients = (t.detach().double() for t in gaussians.tensors().values())
    view, K = (torch.as_tensor(t, dtype=torch.float64, device=means.device) for t in (camera.viewmat, camera.K))
    rotation, translation = view[:3, :3], view[:3, 3]
    positions = means @ rotation.T + translation
    opacities = torch.sigmoid(logits)
    drawn = torch.nonzero((positions[:, 2] >= rule.near) & (opacities >= rule.alpha_cut)).squeeze(1)
    drawn = drawn[torch.argsort(positions[drawn, 2], stable=True)]
    positions, opacities = positions[drawn], opacities[drawn]
    z, focal, center = positions[:, 2:], torch.stack([K[0, 0], K[1, 1]]), K[:2, 2]
    pixels = focal * positions[:, :2] / z + center
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64, device=means.device)
    clamped = torch.minimum(torch.maximum(pixels, -FRUSTUM_MARGIN * size), (1 + FRUSTUM_MARGIN) * size)
    jacobians = torch.cat([torch.diag_embed(focal / z), ((center - clamped) / z)[..., None]], -1)
    axes = jacobians @ rotation @ _rotations(quats[drawn]) @ torch.diag_embed(log_scales[drawn].exp())
    covariances = axes @ axes.mT + rule.low_pass * torch.eye(2, dtype=torch.float64, device=means.device)
    inverse = torch.linalg.inv_ex(covariances).inverse
    A, B, C = -0.5 * inverse[:, 0, :1], -inverse[:, 0, 1:], -0.5 * inverse[:, 1, 1:]
    away = means[drawn] + rotation.T @ translation
    colors = _colors(coefficients[drawn], away / away.norm(dim=-1, keepdim=True), degree)
    reach = torch.sqrt(2 * torch.log(opacities / rule.alpha_cut))[:, None] + 0.01  # a hair more than where alpha is the cut
    half = reach * torch.sqrt(torch.diagonal(covariances, dim1=-2, dim2=-1))

    left, top, width, height = window
    image = torch.empty(height, width, 3, dtype=torch.float64, device=means.device)
    steps = torch.arange(BLOCK, dtype=torch.float64, device=means.device) + 0.5
    for v in range(0, height, BLOCK):
        for u in range(0, width, BLOCK):
            w, h = min(BLOCK, width - u), min(BLOCK, height - v)
            corner = torch.tensor([left + u, top + v], dtype=torch.float64, device=means.device)
            extent = torch.tensor([w, h], dtype=torch.float64, device=means.device)
            near = torch.nonzero(((pixels + half >= corner) & (pixels - half <= corner + extent)).all(1)).squeeze(1)
            dx, dy = corner[0] + steps[:w] - pixels[near, :1], corner[1] + steps[:h] - pixels[near, 1:]
            power = (A[near] * dx * dx)[:, None] + (B[near] * dy)[..., None] * dx[:, None] + (C[near] * dy * dy)[..., None]
            alpha = opacities[near, None] * torch.exp(power.flatten(1))
            alpha = torch.where(alpha >= rule.alpha_cut, alpha.clamp_max(rule.alpha_max), 0.0)
            after = torch.cumprod(1 - alpha, 0)
            before = torch.cat([torch.ones_like(alpha[:1]), after[:-1]])
            weights = torch.where(before >= rule.transmittance_stop, alpha * before, 0.0)
            color = weights.T @ colors[near] + (1 - weights.sum(0))[:, None] * background.double()
            image[v : v + h, u : u + w] = color.view(h, w, 3)
    return image


def psnr_of(mean_square: float) -> float:
    """PSNR [dB] of a mean squared error of pictures in [0, 1]; infinite for 0."""
    return float("inf") if mean_square == 0 else -10 * math.log10(mean_square)
