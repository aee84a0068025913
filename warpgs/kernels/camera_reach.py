"""Largest sizes at which Gaussians do not reach a camera: a fraction of the distance to the nearest camera."""

import functools

import torch
import warp as wp

from warpgs.runtime import interop

SMALLEST = 1e-12
"""Smallest size [u], for a Gaussian at a camera."""


@functools.cache
def make_kernel():
    """Make the kernel."""

    @wp.kernel(enable_backward=False, module="warpgs.kernels.camera_reach")
    def bound(
        begin: int, means: wp.array(dtype=wp.vec3), centers: wp.array(dtype=wp.vec3), fraction: float,
        # outputs
        log_sizes: wp.array(dtype=float),
    ):  # fmt: skip
        i = begin + wp.tid()
        nearest = wp.length_sq(means[i] - centers[0])
        for j in range(1, centers.shape[0]):
            nearest = wp.min(nearest, wp.length_sq(means[i] - centers[j]))
        # in float64, since the rounding of float32's logarithm depends on the processor
        size = wp.sqrt(wp.float64(nearest)) * wp.float64(fraction)
        log_sizes[i] = wp.float32(wp.log(wp.max(size, wp.float64(1e-12))))

    return bound


def camera_reach(means: torch.Tensor, centers: torch.Tensor, fraction: float) -> torch.Tensor:
    """Return log(``fraction`` times the distance from each mean to the nearest camera), at least log(`SMALLEST`).

    Args:
        means: Positions [u], float32, shape [N, 3]; squared distances do not overflow up to 1e18 u.
        centers: Positions of at least one camera [u], float32, shape [C, 3].
        fraction: Positive factor.

    Returns:
        Logarithms of sizes [u], float32, shape [N].

    Raises:
        TypeError: An argument is not a tensor, or a scalar type is wrong.
        ValueError: A shape or a device is wrong.
    """
    interop.check(means=(means, "N 3"), centers=(centers, "C 3"))
    log_sizes = torch.empty(len(means), dtype=torch.float32, device=means.device)
    inputs = [
        interop.view(means, wp.vec3), interop.view(centers, wp.vec3), float(fraction), interop.view(log_sizes, wp.float32)
    ]  # fmt: skip
    interop.launch(make_kernel(), len(means), inputs, means.device)
    return log_sizes
