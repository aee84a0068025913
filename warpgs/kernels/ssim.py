"""Structural similarity with an 11 x 11 Gaussian window (Wang et al. 2004), separable, forward and backward.

For images a and b, the forward pass sums a, b, a^2, b^2 and (a - b)^2 over the window; the backward pass sums three fields.
Images are flat rows of width * channels.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.kernels import ssim_cpu, ssim_cuda
from warpgs.kernels.ssim_cpu import BLOCK, CHANNELS, LANES, PADDING, RADIUS, make_functions
from warpgs.runtime import interop
from warpgs.runtime.derivatives import first_order, keep, kept
from warpgs.runtime.step_sizes import FLOAT, StepSizes


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
        self.kernels = ssim_cpu.make_kernels(self.real, summed) if self.blocked else make_kernels(self.real)

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
            result, *partials = ssim_cuda.forward(image, target, summed=False)
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
            return ssim_cuda.backward(image, target, partials, v_result, summed=False), None
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
            sums, *partials = ssim_cuda.forward(image, target, summed=True)
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
            return ssim_cuda.backward(image, target, partials, v_sums, summed=True), None
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
