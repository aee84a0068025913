"""Plane sweeps: depths of the planes, their costs, and the scanlines that smooth them."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from warpgs import geometry
from warpgs.kernels import launch
from warpgs.kernels.native import EXACT, Floats, IntRows, Ints, Longs, cuda_kernel, source
from warpgs.scene import Camera

# Depths of a plane sweep on a CPU: the best plane of each pixel, and round trips through another view's depth.
#
# Kernels use float64 and one task per pixel. No operations are fused, so depths are the same bits on any processor.

Shorts, ShortRows = wp.array(dtype=wp.int16), wp.array2d(dtype=wp.int16)
FloatRows, DoubleRows, Points = wp.array2d(dtype=float), wp.array2d(dtype=wp.float64), wp.array(dtype=wp.vec3d)
LongRows, longs = wp.array2d(dtype=wp.int64), wp.types.vector(4, wp.int64)

HOST, ALONE = torch.device("cpu"), 0
"""Device of these kernels; and cost of an item where the calling thread works alone: each view has a thread of its own."""
BEHIND = 1e-9
"""Ratio of a point's depth to its depth in the first view, up to which the point counts as behind a camera."""
ROOT, FARTHEST = math.sqrt(2.0), 2**62
"""Ratio of a width to the power of two from which on the next one is nearer; and more than any coordinate of a cell."""
STEP = 1e-3
"""Step of the central difference that gives the change of depth per pixel, as a fraction of the inverse depth."""


@wp.kernel(enable_backward=False, module="warpgs.kernels.plane_depths")
def best(
    begin: int, costs: ShortRows, planes: int, first: wp.float64, step: wp.float64,
    # outputs
    inverses: wp.array(dtype=wp.float64),
):  # fmt: skip
    """Find the plane of least cost of a pixel, and refine its inverse depth by a parabola."""
    pixel = begin + wp.tid()
    lowest = int(costs[pixel, 0])
    k = int(0)
    for d in range(1, planes):
        cost = int(costs[pixel, d])
        if cost < lowest:
            lowest = cost
            k = d
    k = wp.clamp(k, 1, planes - 2)
    left = wp.float64(costs[pixel, k - 1])
    right = wp.float64(costs[pixel, k + 1])
    bend = left - wp.float64(2.0) * wp.float64(costs[pixel, k]) + right
    offset = wp.float64(0.0)
    if bend > wp.float64(0.0):  # costs are whole numbers
        offset = wp.clamp(wp.float64(0.5) * (left - right) / bend, wp.float64(-1.0), wp.float64(1.0))
    inverses[pixel] = first + (wp.float64(k) + offset) * step


@wp.func
def project(turn: wp.mat33d, shift: wp.vec3d, x: wp.float64, y: wp.float64, w: wp.float64) -> wp.vec3d:
    """Return the position of a pixel at inverse depth w in another view, and whether it is in front of that camera."""
    p = turn * wp.vec3d(x, y, wp.float64(1.0)) + w * shift
    ahead = p[2] > wp.float64(BEHIND)
    z = wp.where(ahead, p[2], wp.float64(1.0))
    return wp.vec3d(p[0] / z, p[1] / z, wp.where(ahead, wp.float64(1.0), wp.float64(0.0)))


@wp.kernel(enable_backward=False, module="warpgs.kernels.plane_depths")
def check(
    begin: int, own: DoubleRows, found: DoubleRows, turn: wp.mat33d, shift: wp.vec3d, turn_back: wp.mat33d,
    shift_back: wp.vec3d, to_ray: wp.mat33d, center: wp.vec3d, most: wp.float64, cosine: wp.float64,
    # outputs
    sensitivity: DoubleRows, agrees: wp.array2d(dtype=wp.uint8),
):  # fmt: skip
    """Follow a pixel into another view and back."""
    i = begin + wp.tid()
    row = i // own.shape[1]
    column = i - row * own.shape[1]
    x = wp.float64(column) + wp.float64(0.5)
    y = wp.float64(row) + wp.float64(0.5)
    w = own[row, column]
    good = int(0)
    there = project(turn, shift, x, y, w)
    if there[2] > wp.float64(0.0) and there[0] >= wp.float64(0.0) and there[1] >= wp.float64(0.0):
        if there[0] < wp.float64(found.shape[1]) and there[1] < wp.float64(found.shape[0]):
            back = project(turn_back, shift_back, there[0], there[1], found[int(there[1]), int(there[0])])
            distance = wp.vec3d(back[0] - x, back[1] - y, wp.float64(0.0))
            point = to_ray * wp.vec3d(x, y, wp.float64(1.0)) / w
            other = point - center
            apart = wp.dot(point, other) < cosine * wp.length(point) * wp.length(other)
            if apart and back[2] > wp.float64(0.0) and wp.length(distance) < most:
                good = 1
    if good == 1:
        near = project(turn, shift, x, y, w + wp.float64(STEP) * w)
        far = project(turn, shift, x, y, w - wp.float64(STEP) * w)
        slide = wp.length(wp.vec3d(near[0] - far[0], near[1] - far[1], wp.float64(0.0)))
        if near[2] * far[2] > wp.float64(0.0):
            moved = wp.float64(2.0) * wp.float64(STEP) / w / slide  # dz = -dw / w^2
            sensitivity[row, column] = wp.min(sensitivity[row, column], moved)
    agrees[row, column] = wp.uint8(good)


@wp.struct
class Pixels:
    """Pixels that become points at their z-depths [u] above 0; or a row of given points, and widths of pixels there [u]."""

    depths: FloatRows
    points: Points
    widths: wp.array(dtype=wp.float64)
    to_ray: wp.mat33d
    turn: wp.mat33d
    shift: wp.vec3d
    focal: wp.float64


@wp.func
def lift(pixels: Pixels, row: wp.int32, column: wp.int32) -> wp.vec3d:
    """Return the world point at the centre of a pixel and at its z-depth."""
    if pixels.points.shape[0] > 0:
        return pixels.points[column]
    x = wp.float64(column) + wp.float64(0.5)
    y = wp.float64(row) + wp.float64(0.5)
    z = wp.float64(pixels.depths[row, column])
    ray = pixels.to_ray
    p = wp.vec3d()
    for k in range(3):
        p[k] = z * (x * ray[k, 0] + y * ray[k, 1] + ray[k, 2]) - pixels.shift[k]
    turn = pixels.turn
    point = wp.vec3d()
    for k in range(3):  # sums in the order of `geometry.back_project`
        point[k] = p[0] * turn[0, k] + p[1] * turn[1, k] + p[2] * turn[2, k]
    return point


@wp.kernel(enable_backward=False, module="warpgs.kernels.plane_depths")
def occlude(
    begin: int, pixels: Pixels, cameras: DoubleRows, maps: LongRows, fraction: float,
    # outputs, added to
    hides: wp.array2d(dtype=wp.uint8),
):  # fmt: skip
    """Flag a row's points at less than a fraction of the depth of their pixel in a camera; maps are addresses and sizes."""
    row = begin + wp.tid()
    last = int(0)
    for column in range(hides.shape[1]):
        hidden = hides[row, column] != wp.uint8(0)
        point = lift(pixels, row, column)
        tried = int(0)
        while tried < cameras.shape[0] and not hidden:
            i = (last + tried) % cameras.shape[0]
            tried += 1
            p = wp.vec3d()
            for k in range(3):  # sums in the order of `geometry.project_points`
                p[k] = point[0] * cameras[i, 4 * k] + point[2] * cameras[i, 4 * k + 2] + point[1] * cameras[i, 4 * k + 1]
                p[k] += cameras[i, 4 * k + 3]
            if p[2] > wp.float64(0.0):
                x = p[0] / p[2] * cameras[i, 12] + cameras[i, 14] + p[1] / p[2] * cameras[i, 13]
                y = p[0] / p[2] * cameras[i, 15] + cameras[i, 17] + p[1] / p[2] * cameras[i, 16]
                inside = x >= wp.float64(0.0) and y >= wp.float64(0.0)
                if inside and x < wp.float64(maps[i, 2]) and y < wp.float64(maps[i, 1]):
                    depths = wp.array(ptr=wp.uint64(maps[i, 0]), shape=(int(maps[i, 1]), int(maps[i, 2])), dtype=float)
                    hidden = p[2] < wp.float64(fraction * depths[int(y), int(x)])
                    last = wp.where(hidden, i, last)  # often hides the next point, too
        hides[row, column] = wp.uint8(wp.where(hidden, 1, 0))


@wp.kernel(enable_backward=False, module="warpgs.kernels.plane_depths")
def find_runs(
    begin: int, pixels: Pixels, factor: wp.float64, low: longs, weights: longs,
    # outputs: of each row the first run, replaced by their number, and the lowest and highest cells; runs, and one more
    rows: LongRows, runs: LongRows,
):  # fmt: skip
    """Find the runs of a row's points in one grid cell: where they begin and end, and the number of the cell."""
    row = begin + wp.tid()
    first = int(rows[row, 0])
    at = first - 1
    scale = wp.float64(1.0)
    level = wp.int64(0)
    corner = wp.vec3d()
    lowest = longs(wp.int64(FARTHEST))
    highest = longs(wp.int64(-FARTHEST))
    goes_on = bool(False)
    for column in range(pixels.depths.shape[1]):
        z = pixels.depths[row, column]
        if z > 0.0:
            width = factor * (wp.float64(z) / pixels.focal)
            if pixels.widths.shape[0] > 0:
                width = factor * pixels.widths[column]
            while width * scale > wp.float64(ROOT):  # a cell is as wide as the nearest power of two, 1 / scale
                scale *= wp.float64(0.5)
                level += wp.int64(1)
                goes_on = False
            while width * scale * wp.float64(ROOT) < wp.float64(1.0):
                scale *= wp.float64(2.0)
                level -= wp.int64(1)
                goes_on = False
            place = lift(pixels, row, column) * scale
            for k in range(3):
                goes_on = goes_on and place[k] >= corner[k] and place[k] < corner[k] + wp.float64(1.0)
            if not goes_on:
                at += 1
                corner = wp.vec3d(wp.floor(place[0]), wp.floor(place[1]), wp.floor(place[2]))
                cell = longs(level, wp.int64(corner[0]), wp.int64(corner[1]), wp.int64(corner[2]))
                lowest = wp.min(lowest, cell)
                highest = wp.max(highest, cell)
                if at + 1 < runs.shape[0]:
                    runs[at, 0] = wp.int64(row * pixels.depths.shape[1] + column)
                    runs[at, 2] = wp.dot(cell - low, weights)
            if at + 1 < runs.shape[0]:
                runs[at, 1] = wp.int64(row * pixels.depths.shape[1] + column + 1)
        goes_on = z > 0.0
    rows[row, 0] = wp.int64(at + 1 - first)
    for k in range(4):
        rows[row, k + 1] = lowest[k]
        rows[row, k + 5] = highest[k]


@wp.kernel(enable_backward=False, module="warpgs.kernels.plane_depths")
def add_runs(
    begin: int, each: int, pixels: Pixels, colors: wp.array(dtype=wp.vec3), runs: LongRows, ranks: Longs,
    # outputs, added to
    places: Points, shades: Points, counts: wp.array(dtype=wp.float64),
):  # fmt: skip
    """Add points and colours to the sums of some cells, in the order of the pixels."""
    low = wp.int64((begin + wp.tid()) * each)
    for run in range(ranks.shape[0]):
        rank = ranks[run]
        if rank >= low and rank < low + wp.int64(each):
            place = places[rank]
            shade = shades[rank]
            row = int(runs[run, 0]) // pixels.depths.shape[1]
            for i in range(int(runs[run, 0]), int(runs[run, 1])):
                place += lift(pixels, row, i - row * pixels.depths.shape[1])
                shade += wp.vec3d(colors[i])
            places[rank] = place
            shades[rank] = shade
            counts[rank] += wp.float64(runs[run, 1] - runs[run, 0])


def _array(values: np.ndarray, dtype: type, axes: int) -> wp.array:
    return launch.as_array(torch.from_numpy(np.ascontiguousarray(values)), dtype, axes)


def _tensors(*inputs: Any) -> list[Any]:
    """Return the inputs of a kernel, numpy arrays as tensors of the same memory."""
    return [torch.from_numpy(np.ascontiguousarray(a)) if isinstance(a, np.ndarray) else a for a in inputs]


def focal_length(camera: Camera) -> float:
    """Return the geometric mean of both focal lengths [px]."""
    return float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))


def lifted(camera: Camera, depths: np.ndarray) -> Pixels:
    """Return the pixels of a pinhole that have z-depths [H, W] [u], 0 if unknown, as points."""
    geometry.check_pinhole(camera)
    pixels = Pixels()
    pixels.depths, pixels.focal = _array(np.asarray(depths, np.float32), wp.float32, 2), focal_length(camera)
    pixels.to_ray = wp.mat33d(*geometry.inverse(camera.K).ravel())
    pixels.turn, pixels.shift = wp.mat33d(*camera.viewmat[:3, :3].ravel()), wp.vec3d(*camera.viewmat[:3, 3])
    return pixels


def given(points: np.ndarray, widths: np.ndarray) -> Pixels:
    """Return points [N, 3] with the widths of a pixel there [N] [u] as one row of pixels."""
    pixels = Pixels()
    pixels.depths = _array(np.ones((1, len(points)), np.float32), wp.float32, 2)
    if len(points):
        pixels.points, pixels.widths = _array(points, wp.vec3d, 2), _array(widths, wp.float64, 1)
    return pixels


def occluding(cameras: Sequence[Camera], depths: Sequence[np.ndarray], pixels: Pixels, fraction: float) -> np.ndarray:
    """Return a mask [H, W], True for no point, and points at less than a fraction of z-depths [h, w] [u], 0 if unknown."""
    hides = (~(pixels.depths.numpy() > 0)).astype(np.uint8)
    for camera in cameras:
        geometry.check_pinhole(camera)
    rows = np.array([(*c.viewmat[:3].ravel(), *c.K[:2].ravel()) for c in cameras], float).reshape(-1, 18)
    depths = [np.ascontiguousarray(d, np.float32) for d in depths]
    maps = np.array([(d.ctypes.data, *d.shape) for d in depths], np.int64).reshape(-1, 3)
    if cameras:
        launch.launch(occlude, len(hides), _tensors(pixels, rows, maps, fraction, hides), HOST, cost=ALONE)
    return hides.astype(bool)


def cell_runs(
    pixels: Pixels, factor: float, rows: np.ndarray, low: Sequence[int], weights: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return of each row of pixels the number of runs, lowest and highest cell, int64 [H, 9]; and the runs, int64 [R, 3].

    A run is points in one grid cell: where it begins and ends, and the number of the cell. There are as many as ``rows`` count.
    """
    runs, rows = np.empty((rows[:, 0].sum() + 1, 3), np.int64), rows.copy()  # one more, since kernels take no empty array
    rows[:, 0] = np.cumsum(rows[:, 0]) - rows[:, 0]
    inputs = _tensors(pixels, factor, longs(*low), longs(*weights), rows, runs)
    launch.launch(find_runs, len(rows), inputs, HOST, cost=ALONE)
    return rows, runs[:-1]


def cell_means(count: int, parts: Iterable[tuple[Any, ...]]) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean points and colours of ``count`` cells, float64 [count, 3] each, added up in the order of the pixels.

    Each part has pixels, colours [H W, 3], runs, and ranks of their cells, int64 [R].
    """
    places, shades, counts = *np.zeros((2, count + 1, 3)), np.zeros(count + 1)
    tasks = 4 * torch.get_num_threads()
    for part in (p for p in parts if len(p[2])):
        inputs = _tensors(-(-count // tasks), *part, places, shades, counts)
        launch.launch(add_runs, tasks, inputs, HOST, cost=launch.SERIAL_WORK)
    return tuple(sums[:count] / counts[:count, None] for sums in (places, shades))


def best_inverses(costs: torch.Tensor, inverses: np.ndarray) -> np.ndarray:
    """Return each pixel's inverse depth [1/u] of least cost, refined by a parabola, float64 [H, W], from costs [H, W, P]."""
    height, width, _ = costs.shape
    found = np.empty((height, width))
    inputs = [costs.contiguous(), len(inverses), float(inverses[0]), float(inverses[1] - inverses[0]), found]
    launch.launch(best, found.size, _tensors(*inputs), costs.device, cost=max(1, len(inverses) // 10))
    return found


def _between(first: Camera, second: Camera) -> tuple[wp.mat33d, wp.vec3d]:
    """Return the turn [3, 3] and shift [3] that map a pixel p = (x, y, 1) at inverse depth w to turn p + w shift."""
    rotation, translation = geometry.relative_pose(first, second)
    turn = geometry.matmul(geometry.matmul(second.K, rotation), geometry.inverse(first.K))
    return wp.mat33d(*turn.ravel()), wp.vec3d(*geometry.matmul(second.K, translation[:, None])[:, 0])


def check_round_trip(
    first: Camera, second: Camera, own: np.ndarray, found: np.ndarray, sensitivity: np.ndarray, *, most: float,
    min_parallax: float,
) -> np.ndarray:  # fmt: skip
    """Return a mask [H, W] of the pixels whose round trip through another view's inverse depth ends within ``most`` px."""
    # ``sensitivity`` [H, W], the change of depth per pixel [u/px], is lowered in place where this pair of views has a smaller
    # value.
    agrees = np.empty(own.shape, np.uint8)
    rotation, translation = geometry.relative_pose(first, second)
    center = wp.vec3d(*-geometry.matmul(rotation.T, translation[:, None])[:, 0])
    ways = *_between(first, second), *_between(second, first), wp.mat33d(*geometry.inverse(first.K).ravel()), center
    limits = most, math.cos(math.radians(min_parallax))
    inputs = _tensors(own, found, *ways, *limits, sensitivity, agrees)
    launch.launch(check, own.size, inputs, HOST, cost=5)
    return agrees.astype(bool)


# Matching costs of a plane sweep on a CPU: other images are warped by a plane's homography and correlated in windows.
#
# A task owns some rows and some planes. Colours and the sums over windows are integers, and no multiplication is fused
# with a sum, so that costs are the same bits on any processor and number of threads. Loops over `LANES` pixels
# vectorise.

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
SILENT = 2 * LOW
"""Bit above the colours, set for masked pixels, which have no vote: their colour counts in windows around others alone."""
MIDDLE = 2048
"""Subtracted from colours before they are multiplied, which keeps sums small."""
NEUTRAL = 0.5
"""Cost of correlation 0: where a plane projects outside of the other image, or a window has no texture."""


ints = wp.types.vector(LANES, wp.int32)
reals = wp.types.vector(LANES, wp.float32)
shorts = wp.types.vector(LANES, wp.int16)


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
    y: wp.int32, pitch: wp.int32, images: Ints, offset: wp.int32, other_width: wp.int32, other_height: wp.int32, h: Floats,
    first: wp.int32, ring: Ints, into: wp.int32,
):  # fmt: skip
    """Write a row of the other image as the first camera sees it: twice the centred colours, plus 1 where it has no vote."""
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
            upper = (a & (SILENT - 1)) * (256 - wx) + ((a >> 16) & (SILENT - 1)) * wx
            lower = (b & (SILENT - 1)) * (256 - wx) + ((b >> 16) & (SILENT - 1)) * wx
            color = ((upper * (256 - wy) + lower * wy + 32768) >> 16) - LOW
            nearest = wp.where(wy < 128, a, b)
            masked = wp.where(wx < 128, nearest, nearest >> 16) & SILENT
            found[lane] = 2 * (color - MIDDLE) + wp.where(color < 0 or masked != 0, 1, 0)
        for lane in range(LANES):
            ring[at(into + x, lane)] = found[lane]


@wp.func
def add_row(
    own: Ints, row: wp.int32, ring: Ints, slot: wp.int32, sign: wp.int32, sums: wp.int32, side: wp.int32, pitch: wp.int32
):
    """Add a row to the sums over the columns of windows, or subtract it; the sums lie behind the rows in ``ring``."""
    s = ints()
    q = ints()
    p = ints()
    for step in range(pitch // LANES):
        x = step * LANES
        for lane in range(LANES):
            w = ring[at(slot + x, lane)] >> 1
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
    own_sums: Ints, roots: Floats, row: wp.int32, ring: Ints, slot: wp.int32, sums: wp.int32, side: wp.int32, pitch: wp.int32,
    radius: wp.int32, noise: wp.float32, number: wp.int32, totals: Floats, total: wp.int32, least: wp.int32,
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
            cost = wp.where((ring[at(slot + x, lane)] & 1) == 0, cost, NEUTRAL)
            before = wp.where(number == 0, 0.0, totals[at(total + x, lane)])
            lowest = wp.where(number == 0, 2.0, totals[at(least + x, lane)])
            sum_out[lane] = before + cost
            least_out[lane] = wp.min(lowest, cost)
        for lane in range(LANES):
            totals[at(total + x, lane)] = sum_out[lane]
            totals[at(least + x, lane)] = least_out[lane]


@wp.func
def mirror_columns(ring: Ints, sums: wp.int32, radius: wp.int32, width: wp.int32):
    """Write the sums over columns beyond both borders of the image."""
    for k in range(1, radius + 1):
        ring[sums - k] = ring[sums + mirror(-k, width)]
        ring[sums + width - 1 + k] = ring[sums + mirror(width - 1 + k, width)]


@wp.kernel(enable_backward=False, module="unique", module_options=EXACT)
def match(
    begin: int, own: Ints, own_sums: Ints, roots: Floats, images: Ints, shapes: Ints, h: Floats, height: int, width: int,
    pitch: int, others: int, planes: int, padded: int, radius: int, noise: float, unit: int,
    # rows of the other image and sums over columns; costs; costs as whole numbers, of a task each
    ring: Ints, totals: Floats, found: Shorts,
    # outputs
    costs: Shorts,
):  # fmt: skip
    """Compute the costs of some rows at some planes."""
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


def _packed(gray: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """Return colours, int32, with a border of one outside pixel; the upper half of each number holds the right neighbour."""
    framed = np.ones((gray.shape[0] + 3, gray.shape[1] + 2), np.int32)
    framed[1:-2, 1:-1] = _whole(gray) + LOW + (0 if mask is None else SILENT * ~mask)
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
    gray: np.ndarray, others: Sequence[tuple[np.ndarray, np.ndarray | None]], homographies: np.ndarray, window: int,
    noise: float, unit: int,
) -> torch.Tensor:  # fmt: skip
    """Return the costs int16 [H, W, P] of an image [H, W] against others and their masks, by homographies [D, N, 3, 3]."""
    # A window has at most 7 px: 49 squares of the largest colour, `WHITE` + `MIDDLE`, fit into 32 bits with a sign.
    # The cost of one other image is 0.5 (1 - correlation), with ``noise`` added to the variance; ``unit`` stands for cost 1.
    # The result is half the mean of these costs plus half the smallest: an image that does not see the point contributes, but
    # cannot outvote one that does. Pixel centres are at integers. P is D rounded up to a multiple of `LANES`; costs past D are
    # ``unit``.
    radius = window // 2
    height, width = gray.shape
    pitch, padded = (-(-n // LANES) * LANES for n in (width, len(homographies)))
    centred = (_whole(gray) - MIDDLE).astype(np.int64)
    own_sums, squares = _window_sums(centred, radius), _window_sums(centred * centred, radius)
    added = noise * window**2 * WHITE**2
    roots = 1 / np.sqrt(squares - own_sums**2 / window**2 + added)
    own, sums, roots = (
        torch.from_numpy(np.pad(a, [(0, 0), (0, pitch - width)]).astype(t).ravel())
        for a, t in ((centred, np.int32), (own_sums, np.int32), (roots, np.float32))
    )
    images = [_packed(*o) for o in others]
    starts = np.cumsum([0, *(len(i) for i in images[:-1])])
    shapes = np.array([(s, g.shape[1], g.shape[0]) for s, (g, _) in zip(starts, others)], np.int32)
    tasks = -(-height // ROWS) * (padded // PLANES)
    ring = torch.empty(tasks * (window * pitch + 3 * (pitch + 2 * radius)), dtype=torch.int32, device="cpu")
    totals = torch.empty(tasks * 2 * ROWS * pitch, dtype=torch.float32, device="cpu")
    found = torch.empty(tasks * ROWS * PLANES * pitch, dtype=torch.int16, device="cpu")
    costs = torch.empty(height, width, padded, dtype=torch.int16, device="cpu")
    h = torch.from_numpy(np.ascontiguousarray(homographies, np.float32))
    inputs = [
        own, sums, roots, torch.from_numpy(np.concatenate(images)), torch.from_numpy(shapes), h, height, width, pitch,
        len(others), len(homographies), padded, radius, added, unit, ring, totals, found, costs,
    ]  # fmt: skip
    launch.launch(match, tasks, inputs, costs.device, cost=ROWS * PLANES * pitch * len(others) // 2)
    return costs


FAR_AWAY_16 = 2**14
"""Number above every path cost to which a penalty can be added in 16 bits."""


@wp.kernel(enable_backward=False, module="unique", module_options=EXACT)
def follow_cpu(
    begin: int, costs: Shorts, bounds: Ints, small: int, planes: int,
    # pixels of a line: where it starts, from one to the next, how many; the same for the steps between them
    line_step: int, pixel_step: int, length: int, line_edge: int, pixel_edge: int,
    # two rows of costs for each line
    path: Shorts,
    # outputs, added to
    total: Shorts,
):  # fmt: skip
    """Add the costs of the paths along a line, both ways, `LANES` planes at a time."""
    line = begin + wp.tid()
    pitch = planes + 2 * LANES
    rows = line * 2 * pitch + LANES
    step = wp.int16(small)
    out = shorts()
    sums = shorts()
    least = shorts()
    for way in range(2):
        for i in range(2 * pitch):
            path[at(rows - LANES, i)] = wp.int16(FAR_AWAY_16)
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
            for lane in range(LANES):
                least[lane] = wp.int16(FAR_AWAY_16)
            for chunk in range(planes // LANES):
                d = chunk * LANES
                for lane in range(LANES):
                    beside = wp.min(path[at(before + d - 1, lane)], path[at(before + d + 1, lane)]) + step
                    best = wp.min(wp.min(path[at(before + d, lane)], most), beside)
                    cost = costs[at(pixel + d, lane)] + best - lowest
                    out[lane] = cost
                    least[lane] = wp.min(least[lane], cost)
                    sums[lane] = total[at(pixel + d, lane)] + cost
                for lane in range(LANES):
                    path[at(to + d, lane)] = out[lane]
                    total[at(pixel + d, lane)] = sums[lane]
            lowest = least[0]
            for lane in range(1, LANES):
                lowest = wp.min(lowest, least[lane])


BLOCK = 32
"""Threads of a block, all for one line: some hundred lines spread over many multiprocessors."""
FAR_AWAY = 2**20
"""Number above every path cost."""
LARGEST = 2**13 - 1
"""Largest cost plus penalties: the sum of four paths then fits into signed 16 bits."""


@cuda_kernel(source("scanlines.cu", FAR_AWAY=FAR_AWAY), f"(begin + wp.tid()) // {BLOCK}", "warpgs.kernels.scanlines")
def follow(
    line: int, costs: ShortRows, bounds: Ints, small: int, planes: int,
    # pixels of a line: where it starts, from one to the next, how many; the same for the steps between them
    line_step: int, pixel_step: int, length: int, line_edge: int, pixel_edge: int,
    # outputs
    path: IntRows, total: ShortRows,
):  # fmt: skip
    """Add the costs of the paths along a line, both ways, to ``total``, on CUDA by `BLOCK` threads per line."""


def scanline_costs(costs: torch.Tensor, down: torch.Tensor, across: torch.Tensor, small: int) -> torch.Tensor:
    """Return the sum of the path costs from above, below, left and right, int16 [H, W, D]. Not differentiable."""
    # A path's cost at pixel k and plane d is L(k, d) = C(k, d) + min(L(k-1, d), L(k-1, d +- 1) + small, min_i L(k-1, i) +
    # limit) - min_i L(k-1, i), with the limit of the step from k - 1 to k (Hirschmüller 2008, eq. 13). Costs, penalties: at
    # most `LARGEST`.
    height, width, planes = costs.shape
    cpu = costs.device.type == "cpu"
    more = -planes % LANES if cpu else 0
    if more:  # extra planes with the worst cost, which no path prefers
        costs = torch.nn.functional.pad(costs, (0, more), value=int(costs.max()))
    costs, padded = costs.contiguous(), planes + more
    total = torch.zeros_like(costs)
    # along rows, then columns: lines, their length, strides of pixels, limits and strides of limits
    ways = (height, width, (width, 1), across, (width - 1, 1)), (width, height, (1, width), down, (1, width))
    for lines, length, steps, bounds, edges in ways:
        inputs = [costs, bounds.contiguous(), small, padded, *steps, length, *edges]
        if cpu:
            path = torch.empty(lines * 2 * (padded + 2 * LANES), dtype=torch.int16, device="cpu")
            launch.launch(follow_cpu, lines, [*inputs, path, total], costs.device, cost=max(1, length * padded // 20))
        else:
            path = torch.empty(lines, 2 * (planes + 2), dtype=torch.int32, device=costs.device)
            launch.launch(follow, BLOCK * lines, [*inputs, path, total], costs.device, block_dim=BLOCK)
    return total[..., :planes]
