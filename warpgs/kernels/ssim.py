"""Structural similarity with an 11 x 11 Gaussian window (Wang et al. 2004), separable, forward and backward."""

import functools
import math
from types import SimpleNamespace

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from warpgs.kernels import bridge

RADIUS = 5
"""Half size of the window [px]."""
SIGMA = 1.5
"""Standard deviation of the window [px]."""
C1 = 0.01**2
C2 = 0.03**2
"""(K1 L)^2 and (K2 L)^2 of Wang et al. 2004 for a data range L of 1."""


def _window() -> list[float]:
    weights = [math.exp(-0.5 * (k / SIGMA) ** 2) for k in range(-RADIUS, RADIUS + 1)]
    return [w / sum(weights) for w in weights]


WINDOW = _window()


LANES = 16
"""Neighbouring elements that one task works on, on a CPU: a loop that vectorises. On CUDA a task has one element."""


@functools.cache
def make_kernels(real, lanes: int):
    """Kernels for one scalar type and task size.

    Images are flat [rows, columns] with columns = width * channels. Five sums run through the window: of a, b, a^2, b^2 and
    (a - b)^2; backward, three. Vertical passes write rows with zeros on both sides, so that horizontal ones need no border.
    """
    w0, w1, w2, w3, w4, w5 = (real(w) for w in WINDOW[: RADIUS + 1])
    vec6 = wp.types.vector(6, real)
    values = wp.types.vector(lanes, real)
    count = wp.constant(lanes)
    # unrolled by Warp, the loops over lanes would not vectorise
    kernel = functools.partial(wp.kernel, enable_backward=False, module="unique", module_options={"max_unroll": 0})

    @wp.func
    def tap(k: wp.int32) -> real:
        w = vec6(w5, w4, w3, w2, w1, w0)
        return w[wp.abs(k)]

    @wp.func
    def first_column(task: wp.int32, tasks: wp.int32, columns: wp.int32) -> wp.int32:
        # the last task of a row starts early rather than run over the end; what it repeats comes out the same
        return wp.min((task % tasks) * count, columns - count)

    @kernel
    def vertical(
        begin: int, a: wp.array(dtype=real), b: wp.array(dtype=real), height: int, tasks: int, columns: int, padding: int,
        # outputs, zero on entry
        m0: wp.array(dtype=real), m1: wp.array(dtype=real), m2: wp.array(dtype=real), m3: wp.array(dtype=real),
        m4: wp.array(dtype=real),
    ):  # fmt: skip
        task = begin + wp.tid()
        row = task // tasks
        x = first_column(task, tasks, columns)
        y = row % height
        s0 = values()
        s1 = values()
        s2 = values()
        s3 = values()
        s4 = values()
        for k in range(wp.max(-RADIUS, -y), wp.min(RADIUS + 1, height - y)):
            w = tap(k)
            base = (row + k) * columns + x
            for lane in range(count):
                p = a[base + lane]
                q = b[base + lane]
                s0[lane] = s0[lane] + w * p
                s1[lane] = s1[lane] + w * q
                s2[lane] = s2[lane] + w * p * p
                s3[lane] = s3[lane] + w * q * q
                s4[lane] = s4[lane] + w * (p - q) * (p - q)
        base = row * (columns + 2 * padding) + padding + x
        for lane in range(count):
            m0[base + lane] = s0[lane]
            m1[base + lane] = s1[lane]
            m2[base + lane] = s2[lane]
            m3[base + lane] = s3[lane]
            m4[base + lane] = s4[lane]

    @kernel
    def similarity(
        begin: int, m0: wp.array(dtype=real), m1: wp.array(dtype=real), m2: wp.array(dtype=real), m3: wp.array(dtype=real),
        m4: wp.array(dtype=real), channels: int, tasks: int, columns: int, padding: int,
        # outputs: the similarity, and its partials by mean, variance and gap
        result: wp.array(dtype=real), by_mean: wp.array(dtype=real), by_variance: wp.array(dtype=real),
        by_gap: wp.array(dtype=real),
    ):  # fmt: skip
        task = begin + wp.tid()
        row = task // tasks
        x = first_column(task, tasks, columns)
        s0 = values()
        s1 = values()
        s2 = values()
        s3 = values()
        s4 = values()
        for k in range(-RADIUS, RADIUS + 1):
            w = tap(k)
            base = row * (columns + 2 * padding) + padding + x + k * channels
            for lane in range(count):
                s0[lane] = s0[lane] + w * m0[base + lane]
                s1[lane] = s1[lane] + w * m1[base + lane]
                s2[lane] = s2[lane] + w * m2[base + lane]
                s3[lane] = s3[lane] + w * m3[base + lane]
                s4[lane] = s4[lane] + w * m4[base + lane]
        base = row * columns + x
        for lane in range(count):
            ma = s0[lane]
            mb = s1[lane]
            # rounding can make these differences slightly negative
            raw_va = s2[lane] - ma * ma
            raw_gap = s4[lane] - (ma - mb) * (ma - mb)
            va = wp.max(raw_va, real(0.0))
            vb = wp.max(s3[lane] - mb * mb, real(0.0))
            # variance of a - b: the covariance is (va + vb - gap) / 2, and equal images score 1 whatever is rounded
            gap = wp.max(raw_gap, real(0.0))
            n1 = real(2.0) * ma * mb + real(C1)
            d1 = n1 + (ma - mb) * (ma - mb)
            d2 = va + vb + real(C2)
            luminance = n1 / d1
            structure = real(1.0) - gap / d2
            result[base + lane] = luminance * structure
            v = wp.where(raw_va > real(0.0), luminance * gap / (d2 * d2), real(0.0))
            g = wp.where(raw_gap > real(0.0), -luminance / d2, real(0.0))
            # the mean also acts through the variance, -ma^2, and the gap, -(ma - mb)^2
            by_mean[base + lane] = real(2.0) * (structure * (mb - luminance * ma) / d1 - ma * v - (ma - mb) * g)
            by_variance[base + lane] = v
            by_gap[base + lane] = g

    @kernel
    def vertical_backward(
        begin: int, v_result: wp.array(dtype=real), by_mean: wp.array(dtype=real), by_variance: wp.array(dtype=real),
        by_gap: wp.array(dtype=real), height: int, tasks: int, columns: int, padding: int,
        # outputs, zero on entry
        m0: wp.array(dtype=real), m1: wp.array(dtype=real), m2: wp.array(dtype=real),
    ):  # fmt: skip
        task = begin + wp.tid()
        row = task // tasks
        x = first_column(task, tasks, columns)
        y = row % height
        s0 = values()
        s1 = values()
        s2 = values()
        for k in range(wp.max(-RADIUS, -y), wp.min(RADIUS + 1, height - y)):
            w = tap(k)
            base = (row + k) * columns + x
            for lane in range(count):
                v = w * v_result[base + lane]
                s0[lane] = s0[lane] + v * by_mean[base + lane]
                s1[lane] = s1[lane] + v * by_variance[base + lane]
                s2[lane] = s2[lane] + v * by_gap[base + lane]
        base = row * (columns + 2 * padding) + padding + x
        for lane in range(count):
            m0[base + lane] = s0[lane]
            m1[base + lane] = s1[lane]
            m2[base + lane] = s2[lane]

    @kernel
    def combine(
        begin: int, m0: wp.array(dtype=real), m1: wp.array(dtype=real), m2: wp.array(dtype=real),
        a: wp.array(dtype=real), b: wp.array(dtype=real), channels: int, tasks: int, columns: int, padding: int,
        # outputs
        v_a: wp.array(dtype=real),
    ):  # fmt: skip
        task = begin + wp.tid()
        row = task // tasks
        x = first_column(task, tasks, columns)
        s0 = values()
        s1 = values()
        s2 = values()
        for k in range(-RADIUS, RADIUS + 1):
            w = tap(k)
            base = row * (columns + 2 * padding) + padding + x + k * channels
            for lane in range(count):
                s0[lane] = s0[lane] + w * m0[base + lane]
                s1[lane] = s1[lane] + w * m1[base + lane]
                s2[lane] = s2[lane] + w * m2[base + lane]
        base = row * columns + x
        for lane in range(count):
            p = a[base + lane]
            v_a[base + lane] = s0[lane] + real(2.0) * (p * s1[lane] + (p - b[base + lane]) * s2[lane])

    return SimpleNamespace(vertical=vertical, similarity=similarity, vertical_backward=vertical_backward, combine=combine)


class _Plan:
    """Sizes and launches for one image shape [B, H, W, 3]."""

    def __init__(self, image: torch.Tensor):
        self.device, self.real = image.device, bridge.real_of(image)
        batch, self.height, width, self.channels = image.shape
        self.rows, self.columns = batch * self.height, width * self.channels
        self.padding = RADIUS * self.channels
        lanes = LANES if self.device.type == "cpu" else 1
        self.tasks = -(-self.columns // lanes)
        self.kernels = make_kernels(self.real, lanes)

    def padded(self, count: int, like: torch.Tensor) -> list[wp.array]:
        return [self.flat(m) for m in like.new_zeros(count, self.rows * (self.columns + 2 * self.padding))]

    def flat(self, tensor: torch.Tensor) -> wp.array:
        return bridge.view(tensor.view(-1), self.real)

    def launch(self, kernel, inputs: list, outputs: list) -> None:
        inputs = [*inputs, self.tasks, self.columns, self.padding, *outputs]
        bridge.launch(kernel, self.rows * self.tasks, inputs, self.device, cost=30)


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, target):
        image, target = image.contiguous(), target.contiguous()
        plan = _Plan(image)
        result = torch.empty_like(image)
        partials = [torch.empty_like(image) for _ in range(3)]
        moments = plan.padded(5, image)
        with bridge.stream_of(plan.device):
            plan.launch(plan.kernels.vertical, [plan.flat(image), plan.flat(target), plan.height], moments)
            outputs = [plan.flat(t) for t in (result, *partials)]
            plan.launch(plan.kernels.similarity, [*moments, plan.channels], outputs)
        ctx.save_for_backward(image, target, *partials)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx, v_result):
        image, target, *partials = ctx.saved_tensors
        plan = _Plan(image)
        v_image, sums = torch.empty_like(image), plan.padded(3, image)
        with bridge.stream_of(plan.device):
            inputs = [plan.flat(t) for t in (v_result.contiguous(), *partials)]
            plan.launch(plan.kernels.vertical_backward, [*inputs, plan.height], sums)
            inputs = [*sums, plan.flat(image), plan.flat(target), plan.channels]
            plan.launch(plan.kernels.combine, inputs, [plan.flat(v_image)])
        return v_image, None


def ssim(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Structural similarity at every pixel and channel, the variant of the 3DGS papers.

    Gaussian window of 11 x 11 px with sigma 1.5, zeros outside the image, data range 1; it works for images of any size.
    Differentiable in ``image`` only. A variance that rounding makes negative counts as 0 and passes no
    gradient. Equal images score exactly 1.
    Derivation: docs/ssim.md.

    Args:
        image: Colours in [0, 1], shape [H, W, 3] or [B, H, W, 3].
        target: The same for the image to compare with; no gradient.

    Returns:
        Similarities in [-1, 1], of the images' shape; their mean is the usual figure.

    Raises:
        TypeError: A scalar type is neither float32 nor float64, or they differ.
        ValueError: A shape or device disagrees.
    """
    pattern = "B H W 3" if isinstance(image, torch.Tensor) and image.ndim == 4 else "H W 3"
    bridge.check(image=(image, pattern), target=(target, pattern))
    target = target.detach()
    a, b = (image, target) if image.ndim == 4 else (image[None], target[None])
    # A row must fill a task; columns of zeros beside the image are what the window finds there anyway.
    missing = max(0, -(-LANES // 3) - a.shape[2])
    if missing:
        a, b = (torch.nn.functional.pad(t, (0, 0, 0, missing)) for t in (a, b))
    return _Ssim.apply(a, b)[:, :, : image.shape[-2]].reshape(image.shape)
