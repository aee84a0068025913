"""The loss: 0.8 L1 + 0.2 (1 - SSIM), as in the paper's preliminaries and Kerbl et al. 2023, eq. 7; on request a depth term."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch

from warpgs.errors import UsageError
from warpgs.kernels.ssim import differences, ssim

MIN_ALPHA = 0.5
"""Depth counts where the picture is more opaque than this: elsewhere the background has the larger share."""
FLAT = 1e-3
"""Standard deviation at or below which a map is constant: of a disparity in [0, 1], and of mean depth over depth, whose values
lie around 1. The gradient of a correlation grows with the inverse of it."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss."""

    ssim_weight: float = 0.2
    """Share lambda of the structural term, in [0, 1]."""
    depth_weight: float = 0.0
    """Weight of the depth term, 1 minus the correlation of rendered inverse depth with the view's prior, in [0, 1000]; 0 for
    none, 0.05 in FSGS (Zhu et al. 2024)."""
    depth_until: float = 0.95
    """Share of the steps, from the first, that have the depth term."""

    def __post_init__(self):
        for name, most in (("depth_weight", 1000), ("depth_until", 1)):
            if not 0 <= getattr(self, name) <= most:
                raise UsageError(f"loss {name.replace('_', ' ')} {getattr(self, name)} must lie between 0 and {most}")
        if not 0 <= self.ssim_weight <= 1:
            raise UsageError(f"loss ssim weight {self.ssim_weight} must lie between 0 and 1")


@functools.cache
def _weights(fraction: float, count: int, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """Of the sums of 1 - SSIM and of absolute differences over ``count`` numbers; kept for good, as graphs refer to it."""
    with torch.inference_mode(False):  # whoever asks first: what is made in that mode cannot be trained with
        return torch.tensor([fraction / count, (1 - fraction) / count], dtype=dtype, device=device)


def photometric_loss(rgb: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None, config: LossConfig) -> torch.Tensor:
    """Loss of a rendered image.

    Args:
        rgb: Rendered colours, shape [H, W, 3].
        target: Photographed colours in [0, 1], shape [H, W, 3].
        mask: 1 where a pixel counts, else 0, shape [H, W]; None where all count. Masked pixels are black to the window.
        config: Weights.

    Returns:
        The loss, shape []; 0 where no pixel counts.
    """
    fraction = config.ssim_weight
    if mask is None and fraction > 0:
        sums = differences(rgb, target)
        # a product and a sum, where terms one by one would be a dozen kernels on a GPU
        return (sums * _weights(fraction, target.numel(), sums.dtype, sums.device)).sum()
    if mask is not None:
        rgb, target = rgb * mask[..., None], target * mask[..., None]
    pixels = target.shape[0] * target.shape[1] if mask is None else mask.sum().clamp_min(1)
    l1 = (rgb - target).abs().sum() / (3 * pixels)
    if fraction == 0:
        return l1
    structural = ((1 - ssim(rgb, target)) * mask[..., None]).sum() / (3 * pixels)
    return (1 - fraction) * l1 + fraction * structural


def depth_disagreement(
    depth: torch.Tensor, alpha: torch.Tensor, disparity: torch.Tensor, mask: torch.Tensor | None
) -> torch.Tensor:
    """1 minus Pearson's correlation of rendered inverse depth with a disparity, which may have any scale and offset.

    Over the pixels that count: alpha above `MIN_ALPHA`, and kept by the mask. Differentiable in ``depth`` alone. Where either
    map is constant over them (`FLAT`), and where none counts, no correlation is known: then it is 0 and has no gradient. The
    unit of depth does not matter from 1e-30 to 1e30 u: maps are brought to values around 1 and centred before squaring.

    Args:
        depth: Expected z-depth [u], positive where alpha is, shape [H, W].
        alpha: Accumulated opacity, shape [H, W].
        disparity: Relative inverse depth in [0, 1], shape [H, W].
        mask: 1 where a pixel counts, else 0, shape [H, W]; None where all count.

    Returns:
        A number in [0, 2], shape []; NaN where a pixel that counts has one.
    """
    counts = ~(alpha <= MIN_ALPHA)  # of a NaN too: it must not vanish
    counts = counts if mask is None else counts & (mask > 0)
    fraction = counts.to(depth.dtype)
    pixels = fraction.sum().clamp_min(1)
    depth = torch.where(counts, depth, 1)
    mean = (depth.detach() * fraction).sum() / pixels
    a, b = ((m - (m * fraction).sum() / pixels) * fraction for m in (mean / depth, disparity))
    of_a, of_b = (a * a).sum() / pixels, (b * b).sum() / pixels
    flat = (of_a <= FLAT**2) | (of_b <= FLAT**2)
    spread = torch.where(flat, 1, of_a).sqrt() * torch.where(flat, 1, of_b).sqrt()
    return torch.where(flat, 0, 1 - (a * b).sum() / pixels / spread)


def training_loss(
    images: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    target: torch.Tensor,
    mask: torch.Tensor | None,
    disparity: torch.Tensor | None,
    config: LossConfig,
) -> torch.Tensor:
    """What a step minimises, shape []: `photometric_loss` and, where a disparity is given, the weighted depth term.

    ``images`` are colour, alpha and depth; the rest is as in `photometric_loss` and `depth_disagreement`.
    """
    rgb, alpha, depth = images
    loss = photometric_loss(rgb, target, mask, config)
    if disparity is None:
        return loss
    return loss + config.depth_weight * depth_disagreement(depth, alpha, disparity, mask)


def masked_mse(rgb: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Mean squared error of a rendered image clamped to [0, 1], over the pixels that count; shapes as in `photometric_loss`."""
    rgb = rgb.clamp(0, 1)
    if mask is None:
        return torch.nn.functional.mse_loss(rgb, target)
    return ((rgb - target) ** 2 * mask[..., None]).sum() / (3 * mask.sum().clamp_min(1))
