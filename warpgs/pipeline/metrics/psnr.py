"""Mean squared error and PSNR of images."""

from __future__ import annotations

import math

import numpy as np
import torch

from warpgs.kernels.step_buffers import squared_error


def masked_mse(rgb: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Return the mean squared error of a rendered image, clamped to [0, 1], over the unmasked pixels.

    Args:
        rgb: Rendered colours, shape [H, W, 3].
        target: Colours in [0, 1], shape [H, W, 3].
        mask: 1 for unmasked pixels, 0 for masked ones, shape [H, W]; None without a mask.
    """
    if mask is None:
        return squared_error(rgb, target) / rgb.numel()
    return ((rgb.clamp(0, 1) - target) ** 2 * mask[..., None]).sum() / (3 * mask.sum().clamp_min(1))


def psnr_of(mse: float) -> float:
    """Return the PSNR [dB] of a mean squared error of images in [0, 1]; infinite for 0."""
    return float("inf") if mse == 0 else -10 * math.log10(mse)


def psnr(image: np.ndarray, target: np.ndarray, region: np.ndarray | None = None) -> float:
    """Return the PSNR [dB] of two images in [0, 1], over all channels of the pixels in ``region`` [H, W]; infinite if equal.

    Raises:
        TypeError: The region is not bool: integers would select rows.
        ValueError: A shape disagrees.
    """
    if image.shape != target.shape:
        raise ValueError(f"psnr: both images must have one shape, not {list(image.shape)} and {list(target.shape)}; resize one")
    if region is not None and region.dtype != bool:
        raise TypeError(f"psnr: region must be bool, not {region.dtype}; give region > 0")
    if region is not None and region.shape != image.shape[:2]:
        raise ValueError(f"psnr: region must have shape {list(image.shape[:2])}, not {list(region.shape)}; resize it")
    difference = image.astype(np.float64) - target
    if region is not None:
        difference = difference[region]
    mse = float((difference**2).mean())
    # numpy's logarithm, which sometimes rounds differently from math.log10: published figures stay the same
    return float("inf") if mse == 0 else -10 * float(np.log10(mse))
