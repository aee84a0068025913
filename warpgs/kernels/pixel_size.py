"""Pixel sizes at Gaussians: a fraction of the smallest pixel size [u] of the training cameras that see each Gaussian."""

import functools

import torch
import warp as wp

from warpgs.runtime import interop

SMALLEST = 1e-12
"""Smallest size [u], for a Gaussian at a camera or in no camera's image."""
COLUMNS = 9
"""Number of values of a camera: centre [u] (3), axis of view in the world (3), focal length [px], cosine of the angle between
the axis and the border of the image, and 1 if the size of a pixel grows with distance (fisheye), 0 if with depth."""


@functools.cache
def make_kernel():
    """Make the kernel."""

    @wp.kernel(enable_backward=False, module="warpgs.kernels.pixel_size")
    def bound(
        begin: int, means: wp.array(dtype=wp.vec3), cameras: wp.array2d(dtype=float), fraction: float,
        # outputs
        log_sizes: wp.array(dtype=float),
    ):  # fmt: skip
        i = begin + wp.tid()
        smallest = float(wp.inf)
        for j in range(cameras.shape[0]):
            away = means[i] - wp.vec3(cameras[j, 0], cameras[j, 1], cameras[j, 2])
            depth = wp.dot(away, wp.vec3(cameras[j, 3], cameras[j, 4], cameras[j, 5]))
            distance = wp.length(away)
            size = wp.where(cameras[j, 8] > 0.5, distance, depth) / cameras[j, 6]
            if depth >= cameras[j, 7] * distance and size < smallest:
                smallest = size
        # in float64, since the rounding of float32's logarithm depends on the processor
        size64 = wp.where(smallest < wp.inf, wp.float64(smallest) * wp.float64(fraction), wp.float64(0.0))
        log_sizes[i] = wp.float32(wp.log(wp.max(size64, wp.float64(1e-12))))

    return bound


def pixel_size(means: torch.Tensor, cameras: torch.Tensor, fraction: float) -> torch.Tensor:
    """Return log(``fraction`` times the smallest pixel size at each mean), at least log(`SMALLEST`).

    The pixel size of a camera is depth / focal length, or distance / focal length for a fisheye (Yu et al. 2024, Mip-Splatting,
    section 4.1). Cameras that do not see a mean are ignored. A camera sees the points in the cone around its image.

    Args:
        means: Positions [u], float32, shape [N, 3].
        cameras: Cameras by `COLUMNS`, float32, shape [C, 9].
        fraction: Positive factor.

    Returns:
        Logarithms of sizes [u], float32, shape [N].

    Raises:
        TypeError: An argument is not a tensor, or a scalar type is wrong.
        ValueError: A shape or a device is wrong.
    """
    interop.check(means=(means, "N 3"), cameras=(cameras, "C 9"))
    log_sizes = torch.empty(len(means), dtype=torch.float32, device=means.device)
    inputs = [
        interop.view(means, wp.vec3), interop.view(cameras, wp.float32), float(fraction), interop.view(log_sizes, wp.float32)
    ]  # fmt: skip
    interop.launch(make_kernel(), len(means), inputs, means.device)
    return log_sizes
