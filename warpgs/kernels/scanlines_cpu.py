"""Path costs of semi-global matching on a CPU: a task owns a line, and loops over `LANES` planes vectorise."""

import functools

import warp as wp

from warpgs.kernels.compiler import EXACT
from warpgs.kernels.plane_costs import LANES

FAR_AWAY = 2**14
"""Number above every path cost to which a penalty can be added in 16 bits."""


@functools.cache
def make_kernel():
    """Make the kernel."""
    shorts = wp.types.vector(LANES, wp.int16)

    @wp.func
    def at(first: wp.int32, lane: wp.int32) -> wp.int32:
        """Return an index that the compiler can see is not negative; else it would load each lane separately."""
        return wp.max(first, 0) + lane

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT)
    def follow(
        begin: int, costs: wp.array(dtype=wp.int16), bounds: wp.array(dtype=int), small: int, planes: int,
        # pixels of a line: where it starts, from one to the next, how many; the same for the steps between them
        line_step: int, pixel_step: int, length: int, line_edge: int, pixel_edge: int,
        # whether sums begin with this line; two rows of costs for each line
        fresh: int, path: wp.array(dtype=wp.int16),
        # outputs
        total: wp.array(dtype=wp.int16),
    ):  # fmt: skip
        line = begin + wp.tid()
        pitch = planes + 2 * LANES
        rows = line * 2 * pitch + LANES
        step = wp.int16(small)
        out = shorts()
        sums = shorts()
        least = shorts()
        for way in range(2):
            for i in range(2 * pitch):
                path[at(rows - LANES, i)] = wp.int16(FAR_AWAY)
            for i in range(planes):
                path[at(rows + pitch, i)] = wp.int16(0)
            lowest = wp.int16(0)
            for k in range(length):
                j = wp.where(way == 0, k, length - 1 - k)
                edge = wp.where(way == 0, k - 1, j)
                pixel = (line * line_step + j * pixel_step) * planes
                most = wp.int16(0)  # the most that any change of depth may add to the best of the pixel before
                if k > 0:
                    most = lowest + wp.int16(bounds[line * line_edge + edge * pixel_edge])
                to = rows + (k & 1) * pitch
                before = rows + pitch - (k & 1) * pitch
                set = fresh != 0 and way == 0
                for lane in range(LANES):
                    least[lane] = wp.int16(FAR_AWAY)
                for chunk in range(planes // LANES):
                    d = chunk * LANES
                    for lane in range(LANES):
                        beside = wp.min(path[at(before + d - 1, lane)], path[at(before + d + 1, lane)]) + step
                        best = wp.min(wp.min(path[at(before + d, lane)], most), beside)
                        cost = costs[at(pixel + d, lane)] + best - lowest
                        out[lane] = cost
                        least[lane] = wp.min(least[lane], cost)
                        sums[lane] = wp.where(set, wp.int16(0), total[at(pixel + d, lane)]) + cost
                    for lane in range(LANES):
                        path[at(to + d, lane)] = out[lane]
                        total[at(pixel + d, lane)] = sums[lane]
                lowest = least[0]
                for lane in range(1, LANES):
                    lowest = wp.min(lowest, least[lane])

    return follow
