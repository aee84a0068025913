"""Path costs of semi-global matching (Hirschmüller 2008): each pixel's costs, smoothed along its row and its column."""

import functools

import torch
import warp as wp

from warpgs.kernels import scanlines_cpu
from warpgs.runtime import interop

BLOCK = 32
"""Threads of a block: few, so that some hundred lines spread over many multiprocessors."""
FAR_AWAY = 2**20
"""Number above every path cost."""
LARGEST = 2**13 - 1
"""Largest cost plus penalties: the sum of four paths then fits into signed 16 bits."""


@functools.cache
def make_kernel():
    """Make the kernel; a thread owns a line."""

    @wp.kernel(enable_backward=False, module="warpgs.kernels.scanlines")
    def follow(
        begin: int, costs: wp.array2d(dtype=wp.int16), bounds: wp.array(dtype=int), small: int, planes: int,
        # pixels of a line: where it starts, from one to the next, how many; the same for the steps between them
        line_step: int, pixel_step: int, length: int, line_edge: int, pixel_edge: int,
        # outputs
        path: wp.array2d(dtype=int), total: wp.array2d(dtype=wp.int16),
    ):  # fmt: skip
        line = begin + wp.tid()
        path[line, planes] = FAR_AWAY
        for way in range(2):
            lowest = int(0)
            for k in range(length):
                j = k
                edge = k - 1
                if way == 1:
                    j = length - 1 - k
                    edge = j
                pixel = line * line_step + j * pixel_step
                most = int(0)  # the most that any change of depth may add to the best of the pixel before
                if k > 0:
                    most = lowest + bounds[line * line_edge + edge * pixel_edge]
                left = int(FAR_AWAY)
                here = path[line, 0]
                least = int(FAR_AWAY)
                for d in range(planes):
                    right = path[line, d + 1]
                    cost = int(costs[pixel, d])
                    if k > 0:
                        cost += wp.min(wp.min(here, most), wp.min(left, right) + small) - lowest
                    path[line, d] = cost
                    total[pixel, d] = wp.int16(int(total[pixel, d]) + cost)
                    least = wp.min(least, cost)
                    left = here
                    here = right
                lowest = least

    return follow


def scanline_costs(costs: torch.Tensor, down: torch.Tensor, across: torch.Tensor, small: int) -> torch.Tensor:
    """Return the sum of the path costs from above, below, left and right.

    A path's cost at pixel k and plane d is L(k, d) = C(k, d) + min(L(k-1, d), L(k-1, d +- 1) + small, min_i L(k-1, i) + limit)
    - min_i L(k-1, i), with the limit of the step from k - 1 to k (Hirschmüller 2008, eq. 13). Not differentiable.

    Args:
        costs: C in whole units, at least 0, int16, shape [H, W, D] with D at least 1.
        down: Limits of the steps from a row to the next, at least 0, int32, shape [H - 1, W].
        across: Limits of the steps from a column to the next, at least 0, int32, shape [H, W - 1].
        small: Penalty for a change of one plane, at least 0. Costs and penalties together are at most `LARGEST`.

    Returns:
        The sums, int16, shape [H, W, D].

    Raises:
        ValueError: A shape, type or device disagrees.
    """
    height, width, planes = costs.shape
    for name, tensor, dtype, shape in (
        ("costs", costs, torch.int16, (height, width, planes)),
        ("down", down, torch.int32, (height - 1, width)), ("across", across, torch.int32, (height, width - 1)),
    ):  # fmt: skip
        if tensor.dtype != dtype or tuple(tensor.shape) != shape or tensor.device != costs.device:
            raise ValueError(
                f"{name} must be {dtype} of shape {list(shape)} on {costs.device}, "
                f"not {tensor.dtype} of shape {list(tensor.shape)} on {tensor.device}"
            )
    if costs.device.type == "cpu":
        return _on_cpu(costs, down, across, small)
    total = torch.zeros_like(costs, memory_format=torch.contiguous_format)
    flat = [interop.view(t.contiguous().view(-1, planes), wp.int16) for t in (costs, total)]
    for lines, length, steps, bounds, edges in _ways(height, width, down, across):
        path = torch.empty(lines, planes + 1, dtype=torch.int32, device=costs.device)
        inputs = [
            flat[0], interop.view(bounds.contiguous().view(-1), wp.int32), small, planes, *steps, length, *edges,
            interop.view(path, wp.int32), flat[1],
        ]  # fmt: skip
        interop.launch(make_kernel(), lines, inputs, costs.device, cost=max(1, length * planes // 2), block_dim=BLOCK)
    return total


def _ways(height: int, width: int, down: torch.Tensor, across: torch.Tensor):
    """Return the number of lines, their length, strides of pixels, limits and strides of limits: along rows, then columns."""
    return (height, width, (width, 1), across, (width - 1, 1)), (width, height, (1, width), down, (1, width))


def _on_cpu(costs: torch.Tensor, down: torch.Tensor, across: torch.Tensor, small: int) -> torch.Tensor:
    """Return the sums of `scanline_costs`; a number of planes that is a multiple of `scanlines_cpu.LANES` saves a copy."""
    height, width, planes = costs.shape
    more = -planes % scanlines_cpu.LANES
    if more:  # extra planes with the worst cost, which no path prefers
        costs = torch.nn.functional.pad(costs, (0, more), value=int(costs.max()))
    total, padded = torch.empty_like(costs, memory_format=torch.contiguous_format), planes + more
    flat = [interop.view(t.contiguous().view(-1), wp.int16) for t in (costs, total)]
    for fresh, (lines, length, steps, bounds, edges) in zip((1, 0), _ways(height, width, down, across)):
        path = torch.empty(lines * 2 * (padded + 2 * scanlines_cpu.LANES), dtype=torch.int16, device="cpu")
        inputs = [
            flat[0], interop.view(bounds.contiguous().view(-1), wp.int32), small, padded, *steps, length, *edges, fresh,
            interop.view(path, wp.int16), flat[1],
        ]  # fmt: skip
        interop.launch(scanlines_cpu.make_kernel(), lines, inputs, costs.device, cost=max(1, length * padded // 20))
    return total[..., :planes]
