"""Opacity decay: multiply every opacity by a factor, so that only Gaussians that the views support stay opaque.

After Binocular3DGS (Han et al. 2024, section 3.3), which multiplies by 0.995.
"""

import functools

import torch
import warp as wp

from warpgs.runtime import interop


@functools.cache
def make_kernel():
    """Make the kernel."""

    @wp.kernel(enable_backward=False, module="warpgs.kernels.opacity_decay")
    def decay(
        begin: int, logits: wp.array(dtype=float), factor: wp.float64,
        # outputs
        decayed: wp.array(dtype=float),
    ):  # fmt: skip
        i = begin + wp.tid()
        # in float64, since the rounding of float32's logarithm depends on the processor
        one, x = wp.float64(1.0), wp.float64(logits[i])
        # f o / (1 - f o) with o = 1 / (1 + exp(-x)); each form where its exponential is at most 1
        value = x + wp.log(factor) - wp.log(one + (one - factor) * wp.exp(wp.min(x, wp.float64(0.0))))
        if x > wp.float64(0.0):
            value = wp.log(factor) - wp.log(one - factor + wp.exp(-x))
        decayed[i] = wp.where(wp.isnan(x), logits[i], wp.float32(value))

    return decay


def opacity_decay(logits: torch.Tensor, factor: float) -> torch.Tensor:
    """Return the logits after multiplying the opacities by a factor.

    Args:
        logits: Logits of opacities, float32, shape [N]; a NaN stays NaN.
        factor: Factor, in (0, 1).

    Returns:
        Logits, float32, shape [N].

    Raises:
        ValueError: ``logits`` is not of shape [N], or the factor is out of range.
    """
    interop.check(logits=(logits, "N"))
    if not 0 < factor < 1:
        raise ValueError(f"factor must be above 0 and below 1, not {factor}")
    decayed = torch.empty_like(logits)
    inputs = [interop.view(logits, wp.float32), float(factor), interop.view(decayed, wp.float32)]
    interop.launch(make_kernel(), len(logits), inputs, logits.device)
    return decayed
