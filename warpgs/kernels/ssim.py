"""The structural similarity of images, and its gradient."""

import functools
import math

import torch
import warp as wp

from warpgs.device import FLOAT, StepSizes
from warpgs.kernels import launch
from warpgs.kernels.native import ROLLED, Floats, cuda_kernel, make_prefetch, source

RADIUS = 5
"""Half size of the window [px]."""
TAPS = 2 * RADIUS + 1
"""Side of the window [px]."""
SIGMA = 1.5
"""Standard deviation of the window [px]."""
C1 = 0.01**2
"""(K1 L)^2 of Wang et al. 2004 for a data range L of 1."""
C2 = 0.03**2
"""(K2 L)^2 of Wang et al. 2004."""


_BELL = [math.exp(-0.5 * (k / SIGMA) ** 2) for k in range(-RADIUS, RADIUS + 1)]
WINDOW = [w / sum(_BELL) for w in _BELL]
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
def make_kernel(real, summed: bool, backward: bool):
    """Make a generic kernel, of one task per block of rows; ``summed`` for sums over the image instead of a map."""
    # The sums of a row are in ``scratch``, where each task has a few rows of its own. A row is processed in steps of `LANES`
    # elements; the last step starts early, to end with the row, and elements that it computes again get the same values.
    vec4, vec5, vec11 = (wp.types.vector(size, real) for size in (4, 5, TAPS))
    values, several = (wp.types.vector(size, real) for size in (LANES, 5 * LANES))
    vec11i, Reals = wp.types.vector(TAPS, wp.int32), wp.array(dtype=real)
    prefetch, fields, channels = make_prefetch(real), 3 if backward else 5, CHANNELS
    window = wp.constant(vec11(*WINDOW))
    w0, w1, w2, w3, w4, w5 = (real(w) for w in WINDOW[RADIUS:])

    @wp.func
    def at(first: wp.int32, lane: wp.int32) -> wp.int32:
        """Return an index that the compiler can see is not negative.

        Warp counts negative ones from the end of the array. Where the compiler cannot exclude negative ones, it loads each lane
        separately.
        """
        return wp.max(first, 0) + lane

    @wp.func
    def across(m: Reals, first: wp.int32, lane: wp.int32) -> real:
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

    # Warp unrolls loops that hold a `wp.static`: inside the loop over lanes, they would keep the latter from vectorising.

    @wp.func
    def down_pairs(a: Reals, b: Reals, o: vec11i, w: vec11, x: wp.int32, lane: wp.int32) -> vec5:
        s = vec5()
        for k in range(TAPS):
            s = add_pair(s, w[wp.static(k)], a[at(o[k] + x, lane)], b[at(o[k] + x, lane)])
        return s

    @wp.func(inline=True)
    def put(s: vec5, lane: wp.int32, sums: wp.ref[several]):
        for k in range(wp.static(5)):
            sums[k * LANES + lane] = s[k]

    @wp.func
    def down(m: Reals, o: vec11i, w: vec11, x: wp.int32, lane: wp.int32) -> real:
        s = w[0] * m[at(o[0] + x, lane)]
        for k in range(1, TAPS):
            s += w[wp.static(k)] * m[at(o[k] + x, lane)]
        return s

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def walk(
        begin: int, a: Reals, b: Reals, height: int, blocks: int, columns: int, scratch: Reals,
        # outputs, in the backward pass inputs: the similarity, or per task the sums of 1 - similarity and of |a - b|; partials
        result: Reals, by_mean: Reals, by_variance: Reals, by_gap: Reals,
        # output of the backward pass
        v_a: Reals,
    ):  # fmt: skip
        task = begin + wp.tid()
        image = task // blocks
        top = (task - image * blocks) * BLOCK
        stride = columns + 2 * PADDING
        first = task * fields * stride
        for field in range(fields):
            padding = first + field * stride
            for k in range(PADDING):
                scratch[padding + k] = real(0.0)
                scratch[padding + PADDING + columns + k] = real(0.0)
        o = vec11i()  # first elements of the rows in the window
        w = vec11()
        sums = several()
        unlike = values()
        error = values()
        for y in range(top, wp.min(top + BLOCK, height)):
            for k in range(TAPS):  # rows outside the image are replaced, and weigh 0
                o[k] = (image * height + wp.clamp(y + k - RADIUS, 0, height - 1)) * columns
                inside = y + k >= RADIUS and y + k < height + RADIUS
                w[k] = wp.where(inside, window[k], real(0.0))
            for step in range((columns + LANES - 1) // LANES):
                x = wp.min(step * LANES, columns - LANES)
                # of the row that the next window adds: too many streams for the processor
                if wp.static(backward):
                    prefetch(by_mean, o[10] + columns + x)
                    prefetch(by_variance, o[10] + columns + x)
                    prefetch(by_gap, o[10] + columns + x)
                    for lane in range(LANES):
                        sums[lane] = down(by_mean, o, w, x, lane)
                        sums[LANES + lane] = down(by_variance, o, w, x, lane)
                        sums[2 * LANES + lane] = down(by_gap, o, w, x, lane)
                else:
                    prefetch(a, o[10] + columns + x)
                    prefetch(b, o[10] + columns + x)
                    for lane in range(LANES):
                        put(down_pairs(a, b, o, w, x, lane), lane, sums)
                for k in range(fields):
                    for lane in range(LANES):
                        scratch[at(first + k * stride + PADDING + x, lane)] = sums[k * LANES + lane]
            row = (image * height + y) * columns
            for step in range((columns + LANES - 1) // LANES):
                x = wp.min(step * LANES, columns - LANES)
                if wp.static(backward):
                    for lane in range(LANES):
                        p = a[at(row + x, lane)]
                        d = p - b[at(row + x, lane)]
                        v = across(scratch, first + stride + x, lane) * p
                        v = v + across(scratch, first + 2 * stride + x, lane) * d
                        v = across(scratch, first + x, lane) + real(2.0) * v
                        if wp.static(summed):
                            sign = wp.where(d > real(0.0), result[1], wp.where(d < real(0.0), -result[1], real(0.0)))
                            v = sign - result[0] * v
                        sums[lane] = v
                    for lane in range(LANES):
                        v_a[at(row + x, lane)] = sums[lane]
                else:
                    fresh = step * LANES - x  # elements before this one were counted in the step before
                    for lane in range(LANES):
                        t = score(
                            across(scratch, first + x, lane), across(scratch, first + stride + x, lane),
                            across(scratch, first + 2 * stride + x, lane), across(scratch, first + 3 * stride + x, lane),
                            across(scratch, first + 4 * stride + x, lane),
                        )  # fmt: skip
                        put(vec5(t[0], t[1], t[2], t[3], real(0.0)), lane, sums)
                        if wp.static(summed):
                            unlike[lane] = unlike[lane] + wp.where(lane >= fresh, real(1.0) - t[0], real(0.0))
                            gap = wp.abs(a[at(row + x, lane)] - b[at(row + x, lane)])
                            error[lane] = error[lane] + wp.where(lane >= fresh, gap, real(0.0))
                    for lane in range(LANES):
                        if not wp.static(summed):
                            result[at(row + x, lane)] = sums[lane]
                        by_mean[at(row + x, lane)] = sums[LANES + lane]
                        by_variance[at(row + x, lane)] = sums[2 * LANES + lane]
                        by_gap[at(row + x, lane)] = sums[3 * LANES + lane]
        if wp.static(summed and not backward):
            unlike_sum = real(0.0)
            error_sum = real(0.0)
            for lane in range(LANES):
                unlike_sum += unlike[lane]
                error_sum += error[lane]
            result[2 * task] = unlike_sum
            result[2 * task + 1] = error_sum

    return walk


SIDE = 16
"""Side [px] of the square that a thread block works on."""
THREADS = 256
"""Threads of a block."""


NUMBERS = {"WINDOW": ", ".join(f"{w!r}f" for w in WINDOW), "C1": f"{C1!r}f", "C2": f"{C2!r}f"}
"""Numbers in the CUDA text."""


@cuda_kernel(source("ssim_forward.cu", **NUMBERS), f"wp.tid() // {THREADS}", "warpgs.kernels.ssim_cuda")
def cuda_forward(
    block: int, a: Floats, b: Floats, height: int, columns: int, summed: int,
    # outputs: the similarities, or two sums per block; and the partials by mean, variance and gap
    result: Floats, by_mean: Floats, by_variance: Floats, by_gap: Floats,
):  # fmt: skip
    """Compute the similarity of a square of pixels; ``summed`` is 1 for the two sums of `differences`, 0 for a map."""


@cuda_kernel(source("ssim_backward.cu", **NUMBERS), f"wp.tid() // {THREADS}", "warpgs.kernels.ssim_cuda")
def cuda_backward(
    block: int, a: Floats, b: Floats, v_result: Floats, by_mean: Floats, by_variance: Floats, by_gap: Floats, height: int,
    columns: int, summed: int,
    # outputs
    v_a: Floats,
):  # fmt: skip
    """Compute the gradient of a square of pixels."""


# Structural similarity with an 11 x 11 Gaussian window (Wang et al. 2004), separable, forward and backward.
#
# For images a and b, the forward pass sums a, b, a^2, b^2 and (a - b)^2 over the window; the backward pass sums three
# fields. Images are flat rows of width * channels.


def difference_bytes(sizes: StepSizes) -> int:
    """Return the bytes of `differences` and its gradient: three partials, the gradient, and on a CPU five sums per block."""
    images = 4 * CHANNELS * FLOAT * sizes.pixels
    return images + (0 if sizes.cuda else 5 * FLOAT * (CHANNELS * sizes.width + 2 * PADDING) * -(-sizes.height // BLOCK))


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, target, summed):
        image, target = image.contiguous(), target.contiguous()
        native, (batch, height, width, _) = launch.is_native(image), image.shape
        columns, blocks = width * CHANNELS, -(-height // (SIDE if native else BLOCK))
        tasks = batch * blocks * (-(-width // SIDE) if native else 1)
        result = image.new_empty(tasks, 2) if summed else torch.empty_like(image)
        partials = [torch.empty_like(image) for _ in range(3)]
        if native:
            inputs = [image, target, height, columns, int(summed), result, *partials]
            launch.launch(cuda_forward, tasks * THREADS, inputs, image.device, block_dim=THREADS)
        else:
            workspace = image.new_empty(tasks * 5 * (columns + 2 * PADDING))
            inputs = [image, target, height, blocks, columns, workspace, result, *partials, image.new_empty(0)]
            launch.launch(make_kernel(launch.real_of(image), summed, False), tasks, inputs, image.device, cost=BLOCK * columns)
        launch.keep(ctx, image, target, *partials)
        ctx.summed, ctx.tasks = summed, tasks
        return result.sum(0) if summed else result

    @staticmethod
    @launch.first_order
    def backward(ctx, v_result):
        image, target, *partials = launch.kept(ctx)
        height, columns, tasks = image.shape[1], image.shape[2] * CHANNELS, ctx.tasks
        v_image, v_result = torch.empty_like(image), v_result.contiguous()
        if launch.is_native(image):
            inputs = [image, target, v_result, *partials, height, columns, int(ctx.summed), v_image]
            launch.launch(cuda_backward, tasks * THREADS, inputs, image.device, block_dim=THREADS)
        else:
            fields = partials if ctx.summed else [v_result * t for t in partials]  # v_result is then not read
            workspace = image.new_empty(tasks * 3 * (columns + 2 * PADDING))
            inputs = [image, target, height, -(-height // BLOCK), columns, workspace, v_result, *fields, v_image]
            kernel = make_kernel(launch.real_of(image), ctx.summed, True)
            launch.launch(kernel, tasks, inputs, image.device, cost=BLOCK * columns)
        return v_image, None, None


def _checked(image: torch.Tensor, target: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Check two images or batches, and return them as batches [B, H, W, 3], the target without gradient."""
    pattern = "B H W 3" if isinstance(image, torch.Tensor) and image.ndim == 4 else "H W 3"
    launch.check(image=(image, pattern), target=(target, pattern))
    return image.reshape(-1, *image.shape[-3:]), target.detach().reshape(-1, *image.shape[-3:])


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
    a, b = _checked(image, target)
    # A row must fill a step; columns of zeros beside the image are what the window finds there anyway.
    missing = max(0, -(-LANES // CHANNELS) - a.shape[2])
    if missing:
        a, b = (torch.nn.functional.pad(t, (0, 0, 0, missing)) for t in (a, b))
    return _Ssim.apply(a, b, False)[:, :, : image.shape[-2]].reshape(image.shape)


def differences(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the sums over pixels and channels of 1 - `ssim` and |image - target| [2], for images [H, W, 3] or [B, H, W, 3]."""
    # One pass computes both sums; for tiny images, torch sums the map of `ssim`.
    a, b = _checked(image, target)
    if not (launch.is_native(a) or a.shape[2] * CHANNELS >= LANES):
        return torch.stack([(1 - ssim(a, b)).sum(), (a - b).abs().sum()])
    return _Ssim.apply(a, b, True)
