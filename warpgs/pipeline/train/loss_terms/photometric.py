"""The photometric loss: 0.8 L1 + 0.2 (1 - SSIM), as in the paper's preliminaries and Kerbl et al. 2023, eq. 7."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch

from warpgs.kernels.ssim import difference_bytes, differences
from warpgs.pipeline.train.loss import LossInputs, LossTerm, register, total
from warpgs.runtime.step_sizes import FLOAT, LOSS, Needs, StepSizes


@functools.cache
def _weights(fraction: float, count: int, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """Return the weights [2] of the sums of 1 - SSIM and of absolute differences over ``count`` numbers.

    They stay cached, because CUDA graphs refer to their memory.
    """
    with torch.inference_mode(False):  # a first call may come in inference mode, whose tensors cannot be used in training
        return torch.tensor([fraction / count, (1 - fraction) / count], dtype=dtype, device=device)


def photometric_loss(
    rgb: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None, ssim_weight: float = 0.2
) -> torch.Tensor:
    """Return the loss of a rendered image: (1 - lambda) L1 + lambda (1 - SSIM).

    Args:
        rgb: Rendered colours, shape [H, W, 3].
        target: Photographed colours in [0, 1], shape [H, W, 3].
        mask: 1 for unmasked pixels, 0 for masked ones, shape [H, W]; None without a mask. Masked pixels are black in the
            windows of SSIM around unmasked pixels.
        ssim_weight: lambda, in [0, 1].

    Returns:
        The loss, shape []; 0 if all pixels are masked.
    """
    pixels = target.shape[0] * target.shape[1]
    if mask is not None:
        kept = mask[..., None] > 0
        rgb, target = torch.where(kept, rgb, 0), torch.where(kept, target, 0)
    if ssim_weight > 0:
        sums = differences(rgb, target)
        # one product and one sum, where terms one by one would be a dozen kernels on a GPU
        loss = (sums * _weights(ssim_weight, target.numel(), sums.dtype, sums.device)).sum()
    else:
        loss = total((rgb - target).abs()) / (3 * pixels)
    return loss if mask is None else loss * (pixels / mask.sum().clamp_min(1))


@register("photometric")
@dataclass(frozen=True)
class Photometric(LossTerm):
    """The photometric loss; every fit has it."""

    ssim_weight: float = 0.2
    """Fraction lambda of the SSIM term, in [0, 1]."""

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of the differences and, with a mask, of both masked images."""
        masked = 7 * FLOAT * sizes.pixels if sizes.masked else 0  # two images, and the mask's own
        return {LOSS: difference_bytes(sizes) + masked}

    def __call__(self, inputs: LossInputs) -> torch.Tensor:
        """Compute `photometric_loss` of the render and the view's image, shape []."""
        return photometric_loss(inputs.outputs["rgb"], inputs.target.image, inputs.target.mask, self.ssim_weight)
