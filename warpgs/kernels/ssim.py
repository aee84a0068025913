"""The structural similarity of images, and its gradient."""

import functools
import math
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.device import FLOAT, StepSizes
from warpgs.kernels import launch
from warpgs.kernels import launch as interop
from warpgs.kernels.launch import first_order, keep, kept
from warpgs.kernels.native import ROLLED, source

RADIUS = 5
"""Half size of the window [px]."""
SIGMA = 1.5
"""Standard deviation of the window [px]."""
C1 = 0.01**2
"""(K1 L)^2 of Wang et al. 2004 for a data range L of 1."""
C2 = 0.03**2
"""(K2 L)^2 of Wang et al. 2004."""


def _window() -> list[float]:
    """Return the weights of the window along one axis."""
    weights = [math.exp(-0.5 * (k / SIGMA) ** 2) for k in range(-RADIUS, RADIUS + 1)]
    return [w / sum(weights) for w in weights]


WINDOW = _window()
"""Weights of the window along one axis; their sum is 1."""

CHANNELS = 3
"""Channels of a pixel, and so the distance between horizontal neighbours."""
PADDING = RADIUS * CHANNELS
"""Number of zeros beside a row of sums, so that a horizontal pass needs no border."""
LANES = 16
"""Neighbouring elements that are computed together on a CPU, in a loop that vectorises."""
BLOCK = 8
"""Rows that one task computes on a CPU. The sums of a row stay in cache between the vertical and the horizontal pass."""


@functools.cache
def make_functions(real):
    """Make the functions that the kernels of both kinds of device share, for one scalar type."""
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    vec5 = wp.types.vector(5, real)
    w0, w1, w2, w3, w4, w5 = (real(w) for w in WINDOW[RADIUS:])
    vec6 = wp.types.vector(6, real)
    channels = wp.constant(CHANNELS)

    @wp.func
    def tap(k: wp.int32) -> real:
        """Return the weight at a distance of |k| rows or columns, 0 beyond the window."""
        w = vec6(w0, w1, w2, w3, w4, w5)
        return wp.where(wp.abs(k) <= RADIUS, w[wp.min(wp.abs(k), RADIUS)], real(0.0))

    @wp.func
    def at(first: wp.int32, lane: wp.int32) -> wp.int32:
        """Return an index that the compiler can see is not negative.

        Warp counts negative ones from the end of the array. Where the compiler cannot exclude negative ones, it loads each lane
        separately.
        """
        return wp.max(first, 0) + lane

    @wp.func
    def across(m: wp.array(dtype=real), first: wp.int32, lane: wp.int32) -> real:
        """Return the weighted sum over the columns of the window; ``first`` + ``lane`` is the leftmost column."""
        o = at(first, lane)
        s = w5 * (m[o] + m[o + 10 * channels])
        s += w4 * (m[o + channels] + m[o + 9 * channels])
        s += w3 * (m[o + 2 * channels] + m[o + 8 * channels])
        s += w2 * (m[o + 3 * channels] + m[o + 7 * channels])
        s += w1 * (m[o + 4 * channels] + m[o + 6 * channels])
        s += w0 * m[o + 5 * channels]
        return s

    @wp.func
    def add_pair(s: vec5, w: real, p: real, q: real) -> vec5:
        """Return the five sums after adding a pixel."""
        d = p - q
        u = w * p
        v = w * q
        return vec5(s[0] + u, s[1] + v, s[2] + u * p, s[3] + v * q, s[4] + w * d * d)

    @wp.func
    def score(s0: real, s1: real, s2: real, s3: real, s4: real) -> vec4:
        """Return the similarity, and its partials by mean, variance and gap, from the five sums."""
        ma = s0
        mb = s1
        # rounding can make these differences slightly negative
        raw_va = s2 - ma * ma
        raw_gap = s4 - (ma - mb) * (ma - mb)
        va = wp.max(raw_va, real(0.0))
        vb = wp.max(s3 - mb * mb, real(0.0))
        # variance of a - b: the covariance is (va + vb - gap) / 2, and equal images score 1 whatever is rounded
        gap = wp.max(raw_gap, real(0.0))
        square = (ma - mb) * (ma - mb)
        r1 = real(1.0) / (real(2.0) * ma * mb + real(C1) + square)
        r2 = real(1.0) / (va + vb + real(C2))
        luminance = real(1.0) - square * r1
        structure = real(1.0) - gap * r2
        v = wp.where(raw_va > real(0.0), luminance * gap * r2 * r2, real(0.0))
        g = wp.where(raw_gap > real(0.0), -luminance * r2, real(0.0))
        # the mean also acts through the variance, -ma^2, and the gap, -(ma - mb)^2
        by_mean = real(2.0) * (structure * (mb - luminance * ma) * r1 - ma * v - (ma - mb) * g)
        return vec4(luminance * structure, by_mean, v, g)

    return SimpleNamespace(tap=tap, at=at, across=across, add_pair=add_pair, score=score,
                           vec3=vec3, vec4=vec4, vec5=vec5)  # fmt: skip


@functools.cache
def make_cpu_kernels(real, summed: bool):
    """Make the kernels for a CPU, of one task per block of rows.

    The sums of a row are in ``scratch``, where each task has a few rows of its own. A row is processed in steps of `LANES`
    elements; the last step starts early, to end with the row, and elements that it computes again get the same values.

    Args:
        real: wp.float32 or wp.float64.
        summed: True for sums over the image instead of a map.
    """
    f = make_functions(real)
    vec11 = wp.types.vector(2 * RADIUS + 1, real)
    vec11i = wp.types.vector(2 * RADIUS + 1, wp.int32)
    values = wp.types.vector(LANES, real)
    kernel = functools.partial(wp.kernel, enable_backward=False, module="unique", module_options=ROLLED)

    @wp.func
    def starts_of(y: wp.int32, height: wp.int32, image: wp.int32, columns: wp.int32) -> vec11i:
        """Return the first elements of the rows in the window of row y; rows outside the image are replaced, and weigh 0."""
        o = vec11i()
        for k in range(2 * RADIUS + 1):
            o[k] = (image * height + wp.clamp(y + k - RADIUS, 0, height - 1)) * columns
        return o

    @wp.func
    def taps_of(y: wp.int32, height: wp.int32) -> vec11:
        w = vec11()
        for k in range(2 * RADIUS + 1):
            inside = y + k >= RADIUS and y + k < height + RADIUS
            w[k] = wp.where(inside, f.tap(k - RADIUS), real(0.0))
        return w

    @wp.func
    def clear_padding(scratch: wp.array(dtype=real), o: wp.int32, columns: wp.int32):
        for k in range(PADDING):
            scratch[o + k] = real(0.0)
            scratch[o + PADDING + columns + k] = real(0.0)

    # The eleven rows are written out: a loop inside the loop over lanes would keep the latter from vectorising.

    @wp.func
    def down_pairs(
        a: wp.array(dtype=real), b: wp.array(dtype=real), o: vec11i, w: vec11, x: wp.int32, lane: wp.int32
    ) -> f.vec5:
        s = f.vec5()
        s = f.add_pair(s, w[0], a[f.at(o[0] + x, lane)], b[f.at(o[0] + x, lane)])
        s = f.add_pair(s, w[1], a[f.at(o[1] + x, lane)], b[f.at(o[1] + x, lane)])
        s = f.add_pair(s, w[2], a[f.at(o[2] + x, lane)], b[f.at(o[2] + x, lane)])
        s = f.add_pair(s, w[3], a[f.at(o[3] + x, lane)], b[f.at(o[3] + x, lane)])
        s = f.add_pair(s, w[4], a[f.at(o[4] + x, lane)], b[f.at(o[4] + x, lane)])
        s = f.add_pair(s, w[5], a[f.at(o[5] + x, lane)], b[f.at(o[5] + x, lane)])
        s = f.add_pair(s, w[6], a[f.at(o[6] + x, lane)], b[f.at(o[6] + x, lane)])
        s = f.add_pair(s, w[7], a[f.at(o[7] + x, lane)], b[f.at(o[7] + x, lane)])
        s = f.add_pair(s, w[8], a[f.at(o[8] + x, lane)], b[f.at(o[8] + x, lane)])
        s = f.add_pair(s, w[9], a[f.at(o[9] + x, lane)], b[f.at(o[9] + x, lane)])
        s = f.add_pair(s, w[10], a[f.at(o[10] + x, lane)], b[f.at(o[10] + x, lane)])
        return s

    @wp.func
    def down(m: wp.array(dtype=real), o: vec11i, w: vec11, x: wp.int32, lane: wp.int32) -> real:
        s = w[0] * m[f.at(o[0] + x, lane)]
        s += w[1] * m[f.at(o[1] + x, lane)]
        s += w[2] * m[f.at(o[2] + x, lane)]
        s += w[3] * m[f.at(o[3] + x, lane)]
        s += w[4] * m[f.at(o[4] + x, lane)]
        s += w[5] * m[f.at(o[5] + x, lane)]
        s += w[6] * m[f.at(o[6] + x, lane)]
        s += w[7] * m[f.at(o[7] + x, lane)]
        s += w[8] * m[f.at(o[8] + x, lane)]
        s += w[9] * m[f.at(o[9] + x, lane)]
        s += w[10] * m[f.at(o[10] + x, lane)]
        return s

    @kernel
    def forward(
        begin: int, a: wp.array(dtype=real), b: wp.array(dtype=real), height: int, blocks: int, columns: int,
        scratch: wp.array(dtype=real),
        # outputs: the similarity, or per task the sums of 1 - similarity and of |a - b|; the partials
        result: wp.array(dtype=real), by_mean: wp.array(dtype=real), by_variance: wp.array(dtype=real),
        by_gap: wp.array(dtype=real),
    ):  # fmt: skip
        task = begin + wp.tid()
        image = task // blocks
        top = (task - image * blocks) * BLOCK
        stride = columns + 2 * PADDING
        m0 = task * 5 * stride
        m1 = m0 + stride
        m2 = m1 + stride
        m3 = m2 + stride
        m4 = m3 + stride
        clear_padding(scratch, m0, columns)
        clear_padding(scratch, m1, columns)
        clear_padding(scratch, m2, columns)
        clear_padding(scratch, m3, columns)
        clear_padding(scratch, m4, columns)
        s0 = values()
        s1 = values()
        s2 = values()
        s3 = values()
        s4 = values()
        unlike = values()
        error = values()
        for y in range(top, wp.min(top + BLOCK, height)):
            o = starts_of(y, height, image, columns)
            w = taps_of(y, height)
            for step in range((columns + LANES - 1) // LANES):
                x = wp.min(step * LANES, columns - LANES)
                for lane in range(LANES):
                    s = down_pairs(a, b, o, w, x, lane)
                    s0[lane] = s[0]
                    s1[lane] = s[1]
                    s2[lane] = s[2]
                    s3[lane] = s[3]
                    s4[lane] = s[4]
                for lane in range(LANES):
                    scratch[f.at(m0 + PADDING + x, lane)] = s0[lane]
                    scratch[f.at(m1 + PADDING + x, lane)] = s1[lane]
                    scratch[f.at(m2 + PADDING + x, lane)] = s2[lane]
                    scratch[f.at(m3 + PADDING + x, lane)] = s3[lane]
                    scratch[f.at(m4 + PADDING + x, lane)] = s4[lane]
            row = (image * height + y) * columns
            for step in range((columns + LANES - 1) // LANES):
                x = wp.min(step * LANES, columns - LANES)
                fresh = step * LANES - x  # elements before this one were counted in the step before
                for lane in range(LANES):
                    t = f.score(
                        f.across(scratch, m0 + x, lane), f.across(scratch, m1 + x, lane), f.across(scratch, m2 + x, lane),
                        f.across(scratch, m3 + x, lane), f.across(scratch, m4 + x, lane),
                    )  # fmt: skip
                    s0[lane] = t[0]
                    s1[lane] = t[1]
                    s2[lane] = t[2]
                    s3[lane] = t[3]
                    if wp.static(summed):
                        unlike[lane] = unlike[lane] + wp.where(lane >= fresh, real(1.0) - t[0], real(0.0))
                        gap = wp.abs(a[f.at(row + x, lane)] - b[f.at(row + x, lane)])
                        error[lane] = error[lane] + wp.where(lane >= fresh, gap, real(0.0))
                for lane in range(LANES):
                    if not wp.static(summed):
                        result[f.at(row + x, lane)] = s0[lane]
                    by_mean[f.at(row + x, lane)] = s1[lane]
                    by_variance[f.at(row + x, lane)] = s2[lane]
                    by_gap[f.at(row + x, lane)] = s3[lane]
        if wp.static(summed):
            unlike_sum = real(0.0)
            error_sum = real(0.0)
            for lane in range(LANES):
                unlike_sum += unlike[lane]
                error_sum += error[lane]
            result[2 * task] = unlike_sum
            result[2 * task + 1] = error_sum

    @kernel
    def backward(
        begin: int, a: wp.array(dtype=real), b: wp.array(dtype=real), by_mean: wp.array(dtype=real),
        by_variance: wp.array(dtype=real), by_gap: wp.array(dtype=real), v_result: wp.array(dtype=real),
        height: int, blocks: int, columns: int, scratch: wp.array(dtype=real),
        # outputs
        v_a: wp.array(dtype=real),
    ):  # fmt: skip
        task = begin + wp.tid()
        image = task // blocks
        top = (task - image * blocks) * BLOCK
        stride = columns + 2 * PADDING
        m0 = task * 3 * stride
        m1 = m0 + stride
        m2 = m1 + stride
        clear_padding(scratch, m0, columns)
        clear_padding(scratch, m1, columns)
        clear_padding(scratch, m2, columns)
        s0 = values()
        s1 = values()
        s2 = values()
        for y in range(top, wp.min(top + BLOCK, height)):
            o = starts_of(y, height, image, columns)
            w = taps_of(y, height)
            for step in range((columns + LANES - 1) // LANES):
                x = wp.min(step * LANES, columns - LANES)
                for lane in range(LANES):
                    s0[lane] = down(by_mean, o, w, x, lane)
                    s1[lane] = down(by_variance, o, w, x, lane)
                    s2[lane] = down(by_gap, o, w, x, lane)
                for lane in range(LANES):
                    scratch[f.at(m0 + PADDING + x, lane)] = s0[lane]
                    scratch[f.at(m1 + PADDING + x, lane)] = s1[lane]
                    scratch[f.at(m2 + PADDING + x, lane)] = s2[lane]
            row = (image * height + y) * columns
            for step in range((columns + LANES - 1) // LANES):
                x = wp.min(step * LANES, columns - LANES)
                for lane in range(LANES):
                    p = a[f.at(row + x, lane)]
                    d = p - b[f.at(row + x, lane)]
                    v = f.across(scratch, m1 + x, lane) * p + f.across(scratch, m2 + x, lane) * d
                    v = f.across(scratch, m0 + x, lane) + real(2.0) * v
                    if wp.static(summed):
                        sign = wp.where(d > real(0.0), v_result[1], wp.where(d < real(0.0), -v_result[1], real(0.0)))
                        v = sign - v_result[0] * v
                    s0[lane] = v
                for lane in range(LANES):
                    v_a[f.at(row + x, lane)] = s0[lane]

    return SimpleNamespace(forward=forward, backward=backward)


SIDE = 16
"""Side [px] of the square that a thread block works on."""
THREADS = 256
"""Threads of a block."""


@functools.cache
def make_cuda_kernels():
    """Make the forward and backward kernels; their argument ``summed`` is 1 for the two sums of `differences`, 0 for a map."""
    numbers = {"WINDOW": ", ".join(f"{w!r}f" for w in WINDOW), "C1": f"{C1!r}f", "C2": f"{C2!r}f"}

    @wp.func_native(source("ssim_forward.cu", **numbers))
    def forward_body(
        block: int, a: wp.array(dtype=float), b: wp.array(dtype=float), height: int, columns: int, summed: int,
        result: wp.array(dtype=float), by_mean: wp.array(dtype=float), by_variance: wp.array(dtype=float),
        by_gap: wp.array(dtype=float),
    ): ...  # fmt: skip

    @wp.func_native(source("ssim_backward.cu", **numbers))
    def backward_body(
        block: int, a: wp.array(dtype=float), b: wp.array(dtype=float), v_result: wp.array(dtype=float),
        by_mean: wp.array(dtype=float), by_variance: wp.array(dtype=float), by_gap: wp.array(dtype=float),
        height: int, columns: int, summed: int, v_a: wp.array(dtype=float),
    ): ...  # fmt: skip

    kernel = functools.partial(wp.kernel, enable_backward=False, grid_stride=False, module="warpgs.kernels.ssim_cuda")

    @kernel
    def forward(
        begin: int, a: wp.array(dtype=float), b: wp.array(dtype=float), height: int, columns: int, summed: int,
        # outputs: the similarities, or two sums per block; and the partials by mean, variance and gap
        result: wp.array(dtype=float), by_mean: wp.array(dtype=float), by_variance: wp.array(dtype=float),
        by_gap: wp.array(dtype=float),
    ):  # fmt: skip
        forward_body(wp.tid() // THREADS, a, b, height, columns, summed, result, by_mean, by_variance, by_gap)

    @kernel
    def backward(
        begin: int, a: wp.array(dtype=float), b: wp.array(dtype=float), v_result: wp.array(dtype=float),
        by_mean: wp.array(dtype=float), by_variance: wp.array(dtype=float), by_gap: wp.array(dtype=float),
        height: int, columns: int, summed: int,
        # outputs
        v_a: wp.array(dtype=float),
    ):  # fmt: skip
        backward_body(wp.tid() // THREADS, a, b, v_result, by_mean, by_variance, by_gap, height, columns, summed, v_a)

    return SimpleNamespace(forward=forward, backward=backward)


def _shape(image: torch.Tensor) -> tuple[int, int, int]:
    """Return the number of blocks, and height and row length [elements], of images [B, H, W, 3]."""
    batch, height, width, channels = image.shape
    return batch * -(-height // SIDE) * -(-width // SIDE), height, width * channels


def forward(image: torch.Tensor, target: torch.Tensor, summed: bool) -> tuple[torch.Tensor, ...]:
    """Return similarities [B, H, W, 3] or, if ``summed``, two sums per block [blocks, 2]; then three partial derivatives."""
    blocks, height, columns = _shape(image)
    result = image.new_empty(blocks, 2) if summed else torch.empty_like(image)
    partials = [torch.empty_like(image) for _ in range(3)]
    arrays = [launch.view(t.view(-1), wp.float32) for t in (image, target, result, *partials)]
    inputs = [*arrays[:2], height, columns, int(summed), *arrays[2:]]
    launch.launch(make_cuda_kernels().forward, blocks * THREADS, inputs, image.device, block_dim=THREADS)
    return result, *partials


def backward(image: torch.Tensor, target: torch.Tensor, partials, v_result: torch.Tensor, summed: bool) -> torch.Tensor:
    """Return the gradient of the image from the gradient of the similarities [B, H, W, 3] or of the two sums [2]."""
    blocks, height, columns = _shape(image)
    v_image = torch.empty_like(image)
    arrays = [launch.view(t.view(-1), wp.float32) for t in (image, target, v_result.contiguous(), *partials)]
    inputs = [*arrays, height, columns, int(summed), launch.view(v_image.view(-1), wp.float32)]
    launch.launch(make_cuda_kernels().backward, blocks * THREADS, inputs, image.device, block_dim=THREADS)
    return v_image


# Structural similarity with an 11 x 11 Gaussian window (Wang et al. 2004), separable, forward and backward.
#
# For images a and b, the forward pass sums a, b, a^2, b^2 and (a - b)^2 over the window; the backward pass sums three
# fields. Images are flat rows of width * channels.


def difference_bytes(sizes: StepSizes) -> int:
    """Return the bytes of `differences` and its gradient: three partials, the gradient, and on a CPU five sums per block."""
    images = 4 * CHANNELS * FLOAT * sizes.pixels
    return images + (0 if sizes.cuda else 5 * FLOAT * (CHANNELS * sizes.width + 2 * PADDING) * -(-sizes.height // BLOCK))


@functools.cache
def make_kernels(real):
    """Make the kernels for float64 on CUDA, one thread per element; vertical passes write rows padded with zeros."""
    f = make_functions(real)
    kernel = functools.partial(wp.kernel, enable_backward=False, module=f"warpgs.kernels.ssim.{real.__name__}")

    @kernel
    def vertical(
        begin: int, a: wp.array(dtype=real), b: wp.array(dtype=real), height: int, columns: int,
        # outputs, zero on entry
        m0: wp.array(dtype=real), m1: wp.array(dtype=real), m2: wp.array(dtype=real), m3: wp.array(dtype=real),
        m4: wp.array(dtype=real),
    ):  # fmt: skip
        i = begin + wp.tid()
        row = i // columns
        y = row % height
        s = f.vec5()
        for k in range(wp.max(-RADIUS, -y), wp.min(RADIUS + 1, height - y)):
            s = f.add_pair(s, f.tap(k), a[i + k * columns], b[i + k * columns])
        o = i + (2 * row + 1) * PADDING
        m0[o] = s[0]
        m1[o] = s[1]
        m2[o] = s[2]
        m3[o] = s[3]
        m4[o] = s[4]

    @kernel
    def similarity(
        begin: int, m0: wp.array(dtype=real), m1: wp.array(dtype=real), m2: wp.array(dtype=real), m3: wp.array(dtype=real),
        m4: wp.array(dtype=real), columns: int,
        # outputs
        result: wp.array(dtype=real), by_mean: wp.array(dtype=real), by_variance: wp.array(dtype=real),
        by_gap: wp.array(dtype=real),
    ):  # fmt: skip
        i = begin + wp.tid()
        row = i // columns
        o = i + 2 * row * PADDING
        s = f.score(f.across(m0, o, 0), f.across(m1, o, 0), f.across(m2, o, 0), f.across(m3, o, 0), f.across(m4, o, 0))
        result[i] = s[0]
        by_mean[i] = s[1]
        by_variance[i] = s[2]
        by_gap[i] = s[3]

    @kernel
    def vertical_backward(
        begin: int, v_result: wp.array(dtype=real), by_mean: wp.array(dtype=real), by_variance: wp.array(dtype=real),
        by_gap: wp.array(dtype=real), height: int, columns: int,
        # outputs, zero on entry
        m0: wp.array(dtype=real), m1: wp.array(dtype=real), m2: wp.array(dtype=real),
    ):  # fmt: skip
        i = begin + wp.tid()
        row = i // columns
        y = row % height
        s = f.vec3()
        for k in range(wp.max(-RADIUS, -y), wp.min(RADIUS + 1, height - y)):
            j = i + k * columns
            s += f.tap(k) * v_result[j] * f.vec3(by_mean[j], by_variance[j], by_gap[j])
        o = i + (2 * row + 1) * PADDING
        m0[o] = s[0]
        m1[o] = s[1]
        m2[o] = s[2]

    @kernel
    def combine(
        begin: int, m0: wp.array(dtype=real), m1: wp.array(dtype=real), m2: wp.array(dtype=real),
        a: wp.array(dtype=real), b: wp.array(dtype=real), columns: int,
        # outputs
        v_a: wp.array(dtype=real),
    ):  # fmt: skip
        i = begin + wp.tid()
        row = i // columns
        o = i + 2 * row * PADDING
        v_a[i] = f.across(m0, o, 0) + real(2.0) * (a[i] * f.across(m1, o, 0) + (a[i] - b[i]) * f.across(m2, o, 0))

    return SimpleNamespace(vertical=vertical, similarity=similarity, vertical_backward=vertical_backward, combine=combine)


class _Launcher:
    """Sizes, workspace and launches for one image shape [B, H, W, 3]."""

    def __init__(self, image: torch.Tensor, summed: bool = False):
        self.device, self.real = image.device, interop.real_of(image)
        batch, self.height, width, _ = image.shape
        self.rows, self.columns = batch * self.height, width * CHANNELS
        self.blocks = -(-self.height // BLOCK)
        self.tasks = batch * self.blocks
        self.blocked = self.device.type == "cpu"
        self.kernels = make_cpu_kernels(self.real, summed) if self.blocked else make_kernels(self.real)

    def flat(self, tensor: torch.Tensor) -> interop.View:
        """Return a tensor as a flat kernel argument."""
        return interop.view(tensor.view(-1), self.real)

    def padded(self, count: int, like: torch.Tensor) -> list[interop.View]:
        """Return zeros for ``count`` sums at each element, with padding beside each row."""
        return [self.flat(m) for m in like.new_zeros(count, self.rows * (self.columns + 2 * PADDING))]

    def launch(self, kernel, inputs: list, outputs: list) -> None:
        """Launch a kernel of one task per element."""
        interop.launch(kernel, self.rows * self.columns, [*inputs, self.columns, *outputs], self.device)

    def launch_blocks(self, kernel, inputs: list, sums: int, outputs: list, like: torch.Tensor) -> None:
        """Launch a kernel of one task per block of rows, with workspace for ``sums`` sums."""
        workspace = like.new_empty(self.tasks * sums * (self.columns + 2 * PADDING))
        inputs = [*inputs, self.height, self.blocks, self.columns, self.flat(workspace), *map(self.flat, outputs)]
        interop.launch(kernel, self.tasks, inputs, self.device, cost=BLOCK * self.columns)


def _native(image: torch.Tensor) -> bool:
    """Return whether the CUDA kernels apply."""
    return image.is_cuda and image.dtype == torch.float32


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, target):
        image, target = image.contiguous(), target.contiguous()
        if _native(image):
            result, *partials = forward(image, target, summed=False)
            keep(ctx, image, target, *partials)
            return result
        launcher = _Launcher(image)
        result = torch.empty_like(image)
        partials = [torch.empty_like(image) for _ in range(3)]
        pair = [launcher.flat(image), launcher.flat(target)]
        if launcher.blocked:
            launcher.launch_blocks(launcher.kernels.forward, pair, 5, [result, *partials], image)
        else:
            moments = launcher.padded(5, image)
            with interop.stream_of(launcher.device):
                launcher.launch(launcher.kernels.vertical, [*pair, launcher.height], moments)
                launcher.launch(launcher.kernels.similarity, moments, [launcher.flat(t) for t in (result, *partials)])
        keep(ctx, image, target, *partials)
        return result

    @staticmethod
    @first_order
    def backward(ctx, v_result):
        image, target, *partials = kept(ctx)
        if _native(image):
            return backward(image, target, partials, v_result, summed=False), None
        launcher = _Launcher(image)
        v_image, pair = torch.empty_like(image), [launcher.flat(image), launcher.flat(target)]
        if launcher.blocked:
            fields = [launcher.flat(v_result * t) for t in partials]
            inputs = [*pair, *fields, fields[0]]  # the last is read only for sums
            launcher.launch_blocks(launcher.kernels.backward, inputs, 3, [v_image], image)
        else:
            sums = launcher.padded(3, image)
            with interop.stream_of(launcher.device):
                inputs = [launcher.flat(t) for t in (v_result.contiguous(), *partials)]
                launcher.launch(launcher.kernels.vertical_backward, [*inputs, launcher.height], sums)
                launcher.launch(launcher.kernels.combine, [*sums, *pair], [launcher.flat(v_image)])
        return v_image, None


class _Differences(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, target):
        image, target = image.contiguous(), target.contiguous()
        if _native(image):
            sums, *partials = forward(image, target, summed=True)
            keep(ctx, image, target, *partials)
            return sums.sum(0)
        launcher = _Launcher(image, summed=True)
        sums = image.new_empty(launcher.tasks, 2)
        partials = [torch.empty_like(image) for _ in range(3)]
        pair = [launcher.flat(image), launcher.flat(target)]
        launcher.launch_blocks(launcher.kernels.forward, pair, 5, [sums, *partials], image)
        keep(ctx, image, target, *partials)
        return sums.sum(0)

    @staticmethod
    @first_order
    def backward(ctx, v_sums):
        image, target, *partials = kept(ctx)
        if _native(image):
            return backward(image, target, partials, v_sums, summed=True), None
        launcher = _Launcher(image, summed=True)
        v_image = torch.empty_like(image)
        inputs = [launcher.flat(t) for t in (image, target, *partials, v_sums.contiguous())]
        launcher.launch_blocks(launcher.kernels.backward, inputs, 3, [v_image], image)
        return v_image, None


def _check(image: torch.Tensor, target: torch.Tensor) -> None:
    """Check shapes, types and devices of two images or batches."""
    pattern = "B H W 3" if isinstance(image, torch.Tensor) and image.ndim == 4 else "H W 3"
    interop.check(image=(image, pattern), target=(target, pattern))


def ssim(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the structural similarity at every pixel and channel, in the variant of the 3DGS papers.

    The window is a Gaussian of 11 x 11 px with sigma 1.5. Pixels outside the image are zero; the data range is 1; images may
    have any size. Only ``image`` has a gradient. A variance that is negative by rounding counts as 0 and has no gradient. Equal
    images score exactly 1. Derivation: docs/ssim.md.

    Args:
        image: Colours in [0, 1], shape [H, W, 3] or [B, H, W, 3].
        target: Colours of the image to compare with, shape [H, W, 3] or [B, H, W, 3]; no gradient.

    Returns:
        Similarities in [-1, 1], of the images' shape; their mean is the usual score.

    Raises:
        TypeError: A scalar type is neither float32 nor float64, or scalar types differ.
        ValueError: A shape or device is wrong.
    """
    _check(image, target)
    target = target.detach()
    a, b = (image, target) if image.ndim == 4 else (image[None], target[None])
    # A row must fill a step; columns of zeros beside the image are what the window finds there anyway.
    missing = max(0, -(-LANES // CHANNELS) - a.shape[2])
    if missing:
        a, b = (torch.nn.functional.pad(t, (0, 0, 0, missing)) for t in (a, b))
    return _Ssim.apply(a, b)[:, :, : image.shape[-2]].reshape(image.shape)


def differences(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the sums over all pixels and channels of 1 - `ssim` and of |image - target|, for photometric losses.

    One pass computes both sums; the backward pass computes their gradient. For tiny images, and for float64 on CUDA, torch sums
    the map of `ssim`.

    Args:
        image: Colours in [0, 1], shape [H, W, 3] or [B, H, W, 3].
        target: Colours of the image to compare with, shape [H, W, 3] or [B, H, W, 3]; no gradient.

    Returns:
        The two sums, shape [2]. The gradient of |image - target| is 0 where both are equal.

    Raises:
        TypeError: A scalar type is neither float32 nor float64, or scalar types differ.
        ValueError: A shape or device is wrong.
    """
    _check(image, target)
    target = target.detach()
    if not (_native(image) or (image.device.type == "cpu" and image.shape[-2] * CHANNELS >= LANES)):
        return torch.stack([(1 - ssim(image, target)).sum(), (image - target).abs().sum()])
    return _Differences.apply(*(t.reshape(-1, *t.shape[-3:]) for t in (image, target)))
