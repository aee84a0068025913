"""Matching costs of a plane sweep on a CPU: other images are warped by a plane's homography and correlated in windows.

A task owns some rows and some planes. Colours and the sums over windows are integers, and no multiplication is fused with
a sum, so that costs are the same bits on any processor and number of threads. Loops over `LANES` pixels vectorise.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from warpgs.kernels.compiler import EXACT
from warpgs.runtime import interop

LANES = 16
"""Neighbouring pixels or planes that are computed together, in a loop that vectorises."""
ROWS = 32
"""Rows of a task. Windows also need some rows above and below, which the neighbouring tasks compute as well."""
PLANES = 16
"""Planes of a task: 32 bytes of each pixel's costs, half a cache line."""
WHITE = 4095
"""Brightness 1 as an integer: so fine that rounding is far below the noise of 8-bit images."""
LOW = WHITE + 1
"""Added to colours while they are interpolated, so that the colour outside of an image, -`WHITE`, becomes positive."""
MIDDLE = 2048
"""Subtracted from colours before they are multiplied, which keeps sums small."""
MAX_RADIUS = 3
"""Largest half side of a window [px]: 49 squares of the largest colour, `WHITE` + `MIDDLE`, fit into 32 bits with a sign."""
NEUTRAL = 0.5
"""Cost of correlation 0: where a plane projects outside of the other image, or a window has no texture."""


@functools.cache
def make_kernel():
    """Make the kernel."""
    ints = wp.types.vector(LANES, wp.int32)
    reals = wp.types.vector(LANES, wp.float32)

    @wp.func
    def at(first: wp.int32, lane: wp.int32) -> wp.int32:
        """Return an index that the compiler can see is not negative; else it would load each lane separately."""
        return wp.max(first, 0) + lane

    @wp.func
    def mirror(i: wp.int32, count: wp.int32) -> wp.int32:
        """Return the number in [0, count) of a row or column beyond the border, mirrored at the centre of the last one."""
        period = wp.max(2 * (count - 1), 1)
        i = wp.abs(i) % period
        return wp.min(i, period - i) % count

    @wp.func
    def warp_row(
        y: wp.int32, pitch: wp.int32, images: wp.array(dtype=wp.int32), offset: wp.int32, other_width: wp.int32,
        other_height: wp.int32, h: wp.array(dtype=wp.float32), first: wp.int32, ring: wp.array(dtype=wp.int32), into: wp.int32,
    ):  # fmt: skip
        """Write a row of the other image as the first camera sees it: centred colours, below -MIDDLE outside."""
        fy = float(y)
        cx = h[first + 1] * fy + h[first + 2]
        cy = h[first + 4] * fy + h[first + 5]
        cz = h[first + 7] * fy + h[first + 8]
        ax = h[first]
        ay = h[first + 3]
        az = h[first + 6]
        most_x = float(other_width) + 0.995
        most_y = float(other_height) + 0.995
        stride = other_width + 2
        found = ints()
        for step in range(pitch // LANES):
            x = step * LANES
            for lane in range(LANES):
                fx = float(x + lane)
                z = az * fx + cz
                ahead = z > 1.0e-6
                inverse = 1.0 / wp.where(ahead, z, 1.0)
                # positions in the image with its frame of one pixel
                u = wp.where(ahead, (ax * fx + cx) * inverse + 1.0, 0.0)
                v = wp.where(ahead, (ay * fx + cy) * inverse + 1.0, 0.0)
                iu = int(wp.min(wp.max(u, 0.0), most_x) * 256.0 + 0.5)
                iv = int(wp.min(wp.max(v, 0.0), most_y) * 256.0 + 0.5)
                wx = iu & 255
                wy = iv & 255
                i = wp.max(offset + (iv >> 8) * stride + (iu >> 8), 0)
                a = images[i]
                b = images[i + stride]
                upper = (a & 65535) * (256 - wx) + (a >> 16) * wx
                lower = (b & 65535) * (256 - wx) + (b >> 16) * wx
                found[lane] = ((upper * (256 - wy) + lower * wy + 32768) >> 16) - (LOW + MIDDLE)
            for lane in range(LANES):
                ring[at(into + x, lane)] = found[lane]

    @wp.func
    def add_row(
        own: wp.array(dtype=wp.int32), row: wp.int32, ring: wp.array(dtype=wp.int32), slot: wp.int32, sign: wp.int32,
        sums: wp.int32, side: wp.int32, pitch: wp.int32,
    ):  # fmt: skip
        """Add a row to the sums over the columns of windows, or subtract it; the sums lie behind the rows in ``ring``."""
        s = ints()
        q = ints()
        p = ints()
        for step in range(pitch // LANES):
            x = step * LANES
            for lane in range(LANES):
                w = ring[at(slot + x, lane)]
                signed = sign * w
                s[lane] = ring[at(sums + x, lane)] + signed
                q[lane] = ring[at(sums + side + x, lane)] + signed * w
                p[lane] = ring[at(sums + 2 * side + x, lane)] + signed * own[at(row + x, lane)]
            for lane in range(LANES):
                ring[at(sums + x, lane)] = s[lane]
                ring[at(sums + side + x, lane)] = q[lane]
                ring[at(sums + 2 * side + x, lane)] = p[lane]

    @wp.func
    def correlate_row(
        own_sums: wp.array(dtype=wp.int32), roots: wp.array(dtype=wp.float32), row: wp.int32,
        ring: wp.array(dtype=wp.int32), slot: wp.int32, sums: wp.int32, side: wp.int32, pitch: wp.int32, radius: wp.int32,
        noise: wp.float32, number: wp.int32, totals: wp.array(dtype=wp.float32), total: wp.int32, least: wp.int32,
    ):  # fmt: skip
        """Add the costs of a row to their sum over the other images, and to the smallest."""
        whole = float((2 * radius + 1) * (2 * radius + 1))
        share = 1.0 / whole
        s = ints()
        q = ints()
        p = ints()
        sum_out = reals()
        least_out = reals()
        for step in range(pitch // LANES):
            x = step * LANES
            for lane in range(LANES):
                s[lane] = 0
                q[lane] = 0
                p[lane] = 0
            for k in range(2 * radius + 1):
                for lane in range(LANES):
                    s[lane] = s[lane] + ring[at(sums + x + k - radius, lane)]
                    q[lane] = q[lane] + ring[at(sums + side + x + k - radius, lane)]
                    p[lane] = p[lane] + ring[at(sums + 2 * side + x + k - radius, lane)]
            for lane in range(LANES):
                mean = float(s[lane]) * share
                variance = wp.max(float(q[lane]) - float(s[lane]) * mean, 0.0) + noise
                shared = float(p[lane]) - float(own_sums[at(row + x, lane)]) * mean
                cost = 0.5 - 0.5 * (shared * roots[at(row + x, lane)]) / wp.sqrt(variance)
                cost = wp.where(ring[at(slot + x, lane)] >= -MIDDLE, cost, NEUTRAL)
                before = wp.where(number == 0, 0.0, totals[at(total + x, lane)])
                lowest = wp.where(number == 0, 2.0, totals[at(least + x, lane)])
                sum_out[lane] = before + cost
                least_out[lane] = wp.min(lowest, cost)
            for lane in range(LANES):
                totals[at(total + x, lane)] = sum_out[lane]
                totals[at(least + x, lane)] = least_out[lane]

    @wp.func
    def mirror_columns(ring: wp.array(dtype=wp.int32), sums: wp.int32, radius: wp.int32, width: wp.int32):
        """Write the sums over columns beyond both borders of the image."""
        for k in range(1, radius + 1):
            ring[sums - k] = ring[sums + mirror(-k, width)]
            ring[sums + width - 1 + k] = ring[sums + mirror(width - 1 + k, width)]

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT)
    def match(
        begin: int, own: wp.array(dtype=int), own_sums: wp.array(dtype=int), roots: wp.array(dtype=float),
        images: wp.array(dtype=int), shapes: wp.array(dtype=int), h: wp.array(dtype=float), height: int, width: int,
        pitch: int, others: int, planes: int, padded: int, radius: int, noise: float, unit: int,
        # rows of the other image and sums over columns; costs; costs as whole numbers, of a task each
        ring: wp.array(dtype=int), totals: wp.array(dtype=float), found: wp.array(dtype=wp.int16),
        # outputs
        costs: wp.array(dtype=wp.int16),
    ):  # fmt: skip
        task = begin + wp.tid()
        blocks = padded // PLANES
        top = (task // blocks) * ROWS
        bottom = wp.min(top + ROWS, height)
        first_plane = (task - (task // blocks) * blocks) * PLANES
        window = 2 * radius + 1
        side = pitch + 2 * radius
        rows = task * (window * pitch + 3 * side)
        sums = rows + window * pitch + radius
        base = task * 2 * ROWS * pitch
        whole = task * ROWS * PLANES * pitch
        share = 0.5 / float(others)
        levels = float(unit)
        rounded = ints()
        for k in range(PLANES):
            plane = first_plane + k
            if plane < planes:
                for number in range(others):
                    offset = shapes[3 * number]
                    other_width = shapes[3 * number + 1]
                    other_height = shapes[3 * number + 2]
                    first = 9 * (plane * others + number)
                    for i in range(3 * side):
                        ring[at(sums - radius, i)] = 0
                    for y in range(top - radius, bottom + radius):
                        slot = rows + ((y + radius - top) % window) * pitch
                        if y > top + radius:
                            add_row(own, mirror(y - window, height) * pitch, ring, slot, -1, sums, side, pitch)
                        warp_row(mirror(y, height), pitch, images, offset, other_width, other_height, h, first, ring, slot)
                        add_row(own, mirror(y, height) * pitch, ring, slot, 1, sums, side, pitch)
                        middle = y - radius
                        if middle >= top:
                            mirror_columns(ring, sums, radius, width)
                            mirror_columns(ring, sums + side, radius, width)
                            mirror_columns(ring, sums + 2 * side, radius, width)
                            centre = rows + ((middle + radius - top) % window) * pitch
                            total = base + (middle - top) * pitch
                            correlate_row(
                                own_sums, roots, middle * pitch, ring, centre, sums, side, pitch, radius, noise, number,
                                totals, total, total + ROWS * pitch,
                            )  # fmt: skip
            for y in range(bottom - top):
                total = base + y * pitch
                least = total + ROWS * pitch
                into = whole + (y * PLANES + k) * pitch
                for step in range(pitch // LANES):
                    x = step * LANES
                    for lane in range(LANES):
                        cost = totals[at(total + x, lane)] * share + 0.5 * totals[at(least + x, lane)]
                        scaled = int(wp.min(wp.max(cost, 0.0), 1.0) * levels + 0.5)
                        # planes past the last have the worst cost, so that paths do not change
                        rounded[lane] = wp.where(plane < planes, scaled, unit)
                    for lane in range(LANES):
                        found[at(into + x, lane)] = wp.int16(rounded[lane])
        for y in range(bottom - top):
            for x in range(width):
                pixel = ((top + y) * width + x) * padded + first_plane
                for k in range(PLANES):
                    costs[at(pixel, k)] = found[at(whole + (y * PLANES + k) * pitch, x)]

    return match


def _packed(gray: np.ndarray) -> np.ndarray:
    """Return colours, int32, with a border of one outside pixel; the upper half of each number holds the right neighbour."""
    framed = np.ones((gray.shape[0] + 3, gray.shape[1] + 2), np.int32)
    framed[1:-2, 1:-1] = _whole(gray) + LOW
    framed = framed.ravel()
    return framed | (np.roll(framed, -1) << 16)


def _whole(gray: np.ndarray) -> np.ndarray:
    return np.rint(gray.astype(np.float64) * WHITE).astype(np.int32)


def _window_sums(values: np.ndarray, radius: int) -> np.ndarray:
    """Return the sums over windows, int64, shape [H, W]; the image is mirrored beyond its border."""
    for axis in (0, 1):
        sides = [(radius + 1, radius) if a == axis else (0, 0) for a in (0, 1)]
        total = np.cumsum(np.pad(values, sides, mode="reflect"), axis)
        last, first = (np.take(total, np.arange(values.shape[axis]) + k, axis) for k in (2 * radius + 1, 0))
        values = last - first
    return values


def plane_costs(
    gray: np.ndarray, others: Sequence[np.ndarray], homographies: np.ndarray, window: int, noise: float, unit: int
) -> torch.Tensor:
    """Return the matching costs of an image against others, which are warped to it by the homographies of D planes.

    The cost of one other image is 0.5 (1 - correlation). The result is half the mean of these costs plus half the smallest: an
    image that does not see the point contributes, but cannot outvote one that does.

    Args:
        gray: Brightness in [0, 1], float32, shape [H, W].
        others: Brightness of N other images, of any size.
        homographies: Homographies from pixels of the image to pixels of each other image, shape [D, N, 3, 3]. Pixel centres are
            at integers. The sign makes the third coordinate positive in front of the other camera.
        window: Side of the square in which pixels are correlated [px], odd, at most 2 `MAX_RADIUS` + 1.
        noise: Number that is added to the variance of a window.
        unit: Integer that stands for cost 1, below 2^15.

    Returns:
        Costs, int16, shape [H, W, P]: P is D rounded up to a multiple of `LANES`, and costs past D are ``unit``.

    Raises:
        ValueError: The window is too small or too large.
    """
    radius = window // 2
    if not 1 <= radius <= MAX_RADIUS:
        raise ValueError(f"window must be 3 to {2 * MAX_RADIUS + 1} px, not {window}")
    height, width = gray.shape
    pitch, padded = (-(-n // LANES) * LANES for n in (width, len(homographies)))
    centred = (_whole(gray) - MIDDLE).astype(np.int64)
    own_sums, squares = _window_sums(centred, radius), _window_sums(centred * centred, radius)
    added = noise * window**2 * WHITE**2
    roots = 1 / np.sqrt(squares - own_sums**2 / window**2 + added)
    beside = [(0, 0), (0, pitch - width)]
    own, sums, roots = (
        torch.from_numpy(np.pad(a, beside).astype(t).ravel())
        for a, t in ((centred, np.int32), (own_sums, np.int32), (roots, np.float32))
    )
    images = [_packed(g) for g in others]
    starts = np.cumsum([0, *(len(i) for i in images[:-1])])
    shapes = np.array([(s, g.shape[1], g.shape[0]) for s, g in zip(starts, others)], np.int32)
    blocks = padded // PLANES
    tasks = -(-height // ROWS) * blocks
    ring = torch.empty(tasks * (window * pitch + 3 * (pitch + 2 * radius)), dtype=torch.int32, device="cpu")
    totals = torch.empty(tasks * 2 * ROWS * pitch, dtype=torch.float32, device="cpu")
    found = torch.empty(tasks * ROWS * PLANES * pitch, dtype=torch.int16, device="cpu")
    costs = torch.empty(height, width, padded, dtype=torch.int16, device="cpu")
    h = torch.from_numpy(homographies.astype(np.float32).ravel())
    view = interop.view
    inputs = [
        view(own, wp.int32), view(sums, wp.int32), view(roots, wp.float32),
        view(torch.from_numpy(np.concatenate(images)), wp.int32), view(torch.from_numpy(shapes.ravel()), wp.int32),
        view(h, wp.float32), height, width, pitch, len(others), len(homographies), padded, radius, added, unit,
        view(ring, wp.int32), view(totals, wp.float32), view(found, wp.int16), view(costs.view(-1), wp.int16),
    ]  # fmt: skip
    interop.launch(make_kernel(), tasks, inputs, costs.device, cost=ROWS * PLANES * pitch * len(others) // 2)
    return costs
