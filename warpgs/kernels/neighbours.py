"""Distances: nearest neighbours, the reach of the cameras, and the size of a pixel at a Gaussian."""

import functools
import itertools
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.kernels import launch
from warpgs.kernels.native import FloatRows, Floats, Ints

BOX = 32
"""Number of points in a box, and of boxes in a box of the next level; the highest level has at most this number of boxes. A
query enters a box only if the box is closer than the farthest of the nearest neighbours found so far."""

MAX_NEIGHBORS = 8
"""Largest number of neighbours of a query."""


@functools.cache
def make_knn_kernels(real):
    """Make the kernels for one scalar type; points are sorted along the Morton curve."""
    vec3, vec8 = (wp.types.vector(size, real) for size in (3, MAX_NEIGHBORS))

    @wp.kernel(enable_backward=False, module=f"warpgs.kernels.knn.{real.__name__}")
    def bounds(
        begin: int, lower: wp.array(dtype=vec3), upper: wp.array(dtype=vec3),
        # outputs: the box around each run of BOX boxes (or points, whose lower and upper corner are the same)
        group_lower: wp.array(dtype=vec3), group_upper: wp.array(dtype=vec3),
    ):  # fmt: skip
        box = begin + wp.tid()
        lo = lower[box * BOX]
        hi = upper[box * BOX]
        for i in range(box * BOX + 1, wp.min((box + 1) * BOX, lower.shape[0])):
            lo = wp.min(lo, lower[i])
            hi = wp.max(hi, upper[i])
        group_lower[box] = lo
        group_upper[box] = hi

    @wp.func
    def insert(nearest: vec8, k: wp.int32, squared: real) -> vec8:
        """Return the k smallest squared distances in ascending order, after inserting one more."""
        if squared < nearest[k - 1]:
            j = k - 1
            while j > 0 and nearest[wp.max(j - 1, 0)] > squared:
                nearest[j] = nearest[j - 1]
                j -= 1
            nearest[j] = squared
        return nearest

    @wp.kernel(enable_backward=False, module=f"warpgs.kernels.knn.{real.__name__}")
    def search(
        begin: int, points: wp.array(dtype=vec3), lower: wp.array(dtype=vec3), upper: wp.array(dtype=vec3), starts: Ints,
        k: int,
        # outputs
        mean_squares: wp.array(dtype=real),
    ):  # fmt: skip
        i = begin + wp.tid()
        p = points[i]
        nearest = vec8()
        for j in range(MAX_NEIGHBORS):
            nearest[j] = real(wp.inf)
        # The point's own box first: its distances rule out nearly all other boxes.
        home = i // BOX
        for j in range(home * BOX, wp.min((home + 1) * BOX, points.shape[0])):
            if j != i:
                nearest = insert(nearest, k, wp.length_sq(points[j] - p))
        top = starts.shape[0] - 2
        level = top
        at = int(0)  # number of the box within its level
        while at < starts[level + 1] - starts[level]:
            box = starts[level] + at
            gap = wp.max(wp.max(lower[box] - p, p - upper[box]), vec3())  # from the point to the box
            if wp.length_sq(gap) < nearest[k - 1]:
                if level > 0:
                    level -= 1
                    at = at * BOX
                    continue
                if at != home:
                    for j in range(at * BOX, wp.min((at + 1) * BOX, points.shape[0])):
                        nearest = insert(nearest, k, wp.length_sq(points[j] - p))
            at += 1
            while level < top and (at % BOX == 0 or at == starts[level + 1] - starts[level]):  # leave the enclosing box
                at = (at + BOX - 1) // BOX
                level += 1
        total = real(0.0)
        for j in range(k):
            total += nearest[j]
        mean_squares[i] = total / real(k)

    return SimpleNamespace(bounds=bounds, search=search)


def _spread(bits: torch.Tensor) -> torch.Tensor:
    """Return numbers with two zero bits put between their 21 low bits (Morton order)."""
    for shift, mask in (
        (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
    ):  # fmt: skip
        bits = (bits | (bits << shift)) & mask
    return bits


def morton_codes(points: torch.Tensor) -> torch.Tensor:
    """Return the position of each point [N, 3] along a Morton curve through the cloud's box, int64, shape [N]."""
    lower = points.amin(0)
    extent = (points.amax(0) - lower).clamp_min(torch.finfo(points.dtype).tiny)
    cells = ((points - lower) / extent * (2**21 - 1)).to(torch.int64)
    return _spread(cells[:, 0]) | (_spread(cells[:, 1]) << 1) | (_spread(cells[:, 2]) << 2)


def mean_square_distances(points: torch.Tensor, k: int = 3) -> torch.Tensor:
    """Return the mean squared distance [u^2] of points [N, 3] to their min(k, N - 1) nearest others, [N]; k is 1 to 8."""
    count = launch.check(points=(points, "N 3"))["N"]
    if not 1 <= k <= MAX_NEIGHBORS:
        raise ValueError(f"k must be 1 to {MAX_NEIGHBORS}, not {k}")
    if not bool(torch.isfinite(points).all()):
        raise ValueError("points has non-finite positions")
    if count < 2:
        return points.new_zeros(count)
    real, device = launch.real_of(points), points.device
    kernels = make_knn_kernels(real)
    points = points.detach()
    order = torch.argsort(morton_codes(points), stable=True)
    ordered = points[order].contiguous()
    result, ordered_result = points.new_empty(count), points.new_empty(count)
    starts = [0]  # of each level of boxes, and their number
    size = count
    while len(starts) == 1 or size > BOX:
        size = -(-size // BOX)
        starts.append(starts[-1] + size)
    lower, upper = points.new_empty(2, starts[-1], 3).unbind()
    inside = (ordered, ordered)
    for begin, end in itertools.pairwise(starts):
        level = (lower[begin:end], upper[begin:end])
        launch.launch(kernels.bounds, end - begin, [*inside, *level], device, cost=BOX)
        inside = level
    levels = torch.tensor(starts, dtype=torch.int32, device=device)
    launch.launch(kernels.search, count, [ordered, lower, upper, levels, min(k, count - 1), ordered_result], device, cost=1000)
    result[order] = ordered_result
    return result


SMALLEST = 1e-12
"""Smallest size [u], for a Gaussian at a camera or in no camera's image."""


@wp.kernel(enable_backward=False, module="warpgs.kernels.camera_reach")
def bound_by_reach(
    begin: int, means: wp.array(dtype=wp.vec3), centers: wp.array(dtype=wp.vec3), fraction: float,
    # outputs
    log_sizes: Floats,
):  # fmt: skip
    """Find the size by the distance to the nearest camera."""
    i = begin + wp.tid()
    nearest = wp.length_sq(means[i] - centers[0])
    for j in range(1, centers.shape[0]):
        nearest = wp.min(nearest, wp.length_sq(means[i] - centers[j]))
    # in float64, since the rounding of float32's logarithm depends on the processor
    size = wp.sqrt(wp.float64(nearest)) * wp.float64(fraction)
    log_sizes[i] = wp.float32(wp.log(wp.max(size, wp.float64(SMALLEST))))


def camera_reach(means: torch.Tensor, centers: torch.Tensor, fraction: float) -> torch.Tensor:
    """Return log(``fraction`` x distance of means [N, 3] to the nearest of centers [C, 3]), from log(`SMALLEST`)."""
    return _log_sizes(bound_by_reach, means, centers, fraction)


def _log_sizes(kernel, means: torch.Tensor, cameras: torch.Tensor, fraction: float) -> torch.Tensor:
    log_sizes = torch.empty(len(means), dtype=torch.float32, device=means.device)
    launch.launch(kernel, len(means), [means, cameras, float(fraction), log_sizes], means.device)
    return log_sizes


COLUMNS = 9
"""Number of values of a camera: centre [u] (3), axis of view in the world (3), focal length [px], cosine of the angle between
the axis and the border of the image, and 1 if the size of a pixel grows with distance (fisheye), 0 if with depth."""


@wp.kernel(enable_backward=False, module="warpgs.kernels.pixel_size")
def bound_by_pixel(
    begin: int, means: wp.array(dtype=wp.vec3), cameras: FloatRows, fraction: float,
    # outputs
    log_sizes: Floats,
):  # fmt: skip
    """Find the size of the smallest pixel."""
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
    log_sizes[i] = wp.float32(wp.log(wp.max(size64, wp.float64(SMALLEST))))


def pixel_size(means: torch.Tensor, cameras: torch.Tensor, fraction: float) -> torch.Tensor:
    """Return log(``fraction`` x smallest pixel size at means [N, 3]) over cameras [C, 9] (`COLUMNS`) that see them, [N]."""
    # The pixel size of a camera is depth / focal length, or distance / focal length for a fisheye (Yu et al. 2024,
    # Mip-Splatting, section 4.1). A camera sees the points in the cone around its image.
    return _log_sizes(bound_by_pixel, means, cameras, fraction)
