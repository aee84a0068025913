"""Mean squared error and PSNR of images."""

from __future__ import annotations

import torch


def masked_mse(rgb: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Return the mean squared error of a rendered image clamped to [0, 1], over the pixels that count.

    Args:
        rgb: Rendered colours, shape [H, W, 3].
        target: Colours in [0, 1], shape [H, W, 3].
        mask: 1 where a pixel counts, else 0, shape [H, W]; None where all count.
    """
    rgb = rgb.clamp(0, 1)
    if mask is None:
        return torch.nn.functional.mse_loss(rgb, target)
    return ((rgb - target) ** 2 * mask[..., None]).sum() / (3 * mask.sum().clamp_min(1))
