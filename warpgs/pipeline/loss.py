"""The photometric loss: 0.8 L1 + 0.2 (1 - SSIM), the paper's section on preliminaries and Kerbl et al. 2023, eq. 7."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from warpgs.errors import UsageError
from warpgs.kernels.ssim import differences, ssim


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss."""

    ssim_weight: float = 0.2
    """Share lambda of the structural term, in [0, 1]."""

    def __post_init__(self):
        if not 0 <= self.ssim_weight <= 1:
            raise UsageError(f"loss ssim weight {self.ssim_weight} must lie between 0 and 1")


def photometric_loss(
    rgb: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None, config: LossConfig
) -> tuple[torch.Tensor, torch.Tensor]:
    """Loss of a rendered image, and its L1 part.

    Args:
        rgb: Rendered colours, shape [H, W, 3].
        target: Photographed colours in [0, 1], shape [H, W, 3].
        mask: 1 where a pixel counts, else 0, shape [H, W]; None where all count. Masked pixels are black to the window.
        config: Weights.

    Returns:
        Loss and L1, shape []; both 0 where no pixel counts.
    """
    share = config.ssim_weight
    if mask is None and share > 0:
        unlike, error = differences(rgb, target).unbind()
        l1 = error / target.numel()
        return (1 - share) * l1 + share * unlike / target.numel(), l1.detach()
    if mask is not None:
        rgb, target = rgb * mask[..., None], target * mask[..., None]
    pixels = target.shape[0] * target.shape[1] if mask is None else mask.sum().clamp_min(1)
    l1 = (rgb - target).abs().sum() / (3 * pixels)
    if share == 0:
        return l1, l1.detach()
    structural = ((1 - ssim(rgb, target)) * mask[..., None]).sum() / (3 * pixels)
    return (1 - share) * l1 + share * structural, l1.detach()


def masked_mse(rgb: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Mean squared error of a rendered image clamped to [0, 1], over the pixels that count; shapes as in `photometric_loss`."""
    rgb = rgb.clamp(0, 1)
    if mask is None:
        return torch.nn.functional.mse_loss(rgb, target)
    return ((rgb - target) ** 2 * mask[..., None]).sum() / (3 * mask.sum().clamp_min(1))
