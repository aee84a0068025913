"""Structural similarity for CUDA in float32: both window passes in shared memory, one launch forward and one backward."""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.kernels.ssim_cpu import C1, C2, WINDOW
from warpgs.runtime import interop
from warpgs.runtime.cuda_source import source

SIDE = 16
"""Side [px] of the square that a thread block works on."""
THREADS = 256
"""Threads of a block."""


@functools.cache
def make_kernels():
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
    arrays = [interop.view(t.view(-1), wp.float32) for t in (image, target, result, *partials)]
    inputs = [*arrays[:2], height, columns, int(summed), *arrays[2:]]
    interop.launch(make_kernels().forward, blocks * THREADS, inputs, image.device, block_dim=THREADS)
    return result, *partials


def backward(image: torch.Tensor, target: torch.Tensor, partials, v_result: torch.Tensor, summed: bool) -> torch.Tensor:
    """Return the gradient of the image from the gradient of the similarities [B, H, W, 3] or of the two sums [2]."""
    blocks, height, columns = _shape(image)
    v_image = torch.empty_like(image)
    arrays = [interop.view(t.view(-1), wp.float32) for t in (image, target, v_result.contiguous(), *partials)]
    inputs = [*arrays, height, columns, int(summed), interop.view(v_image.view(-1), wp.float32)]
    interop.launch(make_kernels().backward, blocks * THREADS, inputs, image.device, block_dim=THREADS)
    return v_image
