"""Opacity dropout: hide random Gaussians for a step and make the others more opaque (DropGaussian, Park et al. 2025)."""

import functools

import torch
import warp as wp

from warpgs.kernels.step_buffers import Setting
from warpgs.runtime import interop


@functools.cache
def make_kernel():
    """Make the kernel; its settings are in memory, so that a CUDA graph can replay it."""

    @wp.kernel(enable_backward=False, module="warpgs.kernels.dropout")
    def sample(
        begin: int, settings: wp.array(dtype=float), seed: int,
        # outputs
        factors: wp.array(dtype=float),
    ):  # fmt: skip
        i = begin + wp.tid()
        p = settings[Setting.DROPOUT]
        # one stream of numbers for each seed and step, one number of it for each Gaussian
        state = wp.rand_init(wp.randi(wp.rand_init(seed, int(settings[Setting.NUMBER]))), i)
        factors[i] = wp.where(wp.randf(state) >= p, 1.0 / (1.0 - p), 0.0)

    return sample


def opacity_dropout(count: int, settings: torch.Tensor, seed: int) -> torch.Tensor:
    """Return factors for the opacities of ``count`` Gaussians: 0 with probability p, else 1 / (1 - p).

    The expected opacity is unchanged. The factors depend only on p, ``seed``, the number of the step or view (`Setting.NUMBER`)
    and the Gaussian's row, so they are the same on every device and in a resumed fit.

    Args:
        count: Number of Gaussians N.
        settings: Settings of the step, float32, shape [7]; `Setting.DROPOUT` is p.
        seed: Any 32-bit integer.

    Returns:
        Factors, float32, shape [N], on the device of ``settings``.

    Raises:
        ValueError: ``settings`` is not of shape [7].
    """
    interop.check(settings=(settings, str(len(Setting))))
    factors = torch.empty(count, dtype=torch.float32, device=settings.device)
    inputs = [interop.view(settings, wp.float32), seed, interop.view(factors, wp.float32)]
    interop.launch(make_kernel(), count, inputs, settings.device)
    return factors
