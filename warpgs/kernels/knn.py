"""Exact mean squared distance of each point to its nearest neighbours, by Morton order and a tree of boxes."""

import functools
import itertools
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.runtime import interop

BOX = 32
"""Number of points in a box, and of boxes in a box of the next level; the highest level has at most this number of boxes. A
query enters a box only if the box is closer than the farthest of the nearest neighbours found so far."""

MAX_NEIGHBORS = 8
"""Largest number of neighbours of a query."""


@functools.cache
def make_kernels(real):
    """Make the kernels for one scalar type; points are sorted along the Morton curve."""
    vec3 = wp.types.vector(3, real)
    vec8 = wp.types.vector(MAX_NEIGHBORS, real)

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
    def gap_squared(lo: vec3, hi: vec3, p: vec3) -> real:
        """Return the squared distance of a point to a box."""
        return wp.length_sq(wp.max(wp.max(lo - p, p - hi), vec3()))

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
        begin: int, points: wp.array(dtype=vec3), lower: wp.array(dtype=vec3), upper: wp.array(dtype=vec3),
        starts: wp.array(dtype=int), k: int,
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
            if gap_squared(lower[box], upper[box], p) < nearest[k - 1]:
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

    return SimpleNamespace(bounds=bounds, search=search, vec3=vec3)


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
    """Return the mean squared distance [u^2] of each point to its min(k, N - 1) nearest other points. Not differentiable.

    Args:
        points: Finite positions [u], shape [N, 3]. Coincident points have distance 0 from each other.
        k: Number of neighbours, 1 to 8.

    Returns:
        Shape [N]; 0 for a single point.

    Raises:
        TypeError: The scalar type is neither float32 nor float64.
        ValueError: The shape is wrong, k is out of range, or a position is not finite.
    """
    count = interop.check(points=(points, "N 3"))["N"]
    if not 1 <= k <= MAX_NEIGHBORS:
        raise ValueError(f"k must be 1 to {MAX_NEIGHBORS}, not {k}")
    if not bool(torch.isfinite(points).all()):
        raise ValueError("points has non-finite positions")
    if count < 2:
        return points.new_zeros(count)
    real, device = interop.real_of(points), points.device
    kernels = make_kernels(real)
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
        interop.launch(
            kernels.bounds, end - begin, [interop.view(t, kernels.vec3) for t in (*inside, *level)], device, cost=BOX
        )
        inside = level
    inputs = [interop.view(t, kernels.vec3) for t in (ordered, lower, upper)]
    inputs += [interop.view(torch.tensor(starts, dtype=torch.int32, device=device), wp.int32), min(k, count - 1)]
    interop.launch(kernels.search, count, [*inputs, interop.view(ordered_result, real)], device, cost=1000)
    result[order] = ordered_result
    return result
