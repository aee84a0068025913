"""Compositing of any number of channels: each Gaussian has D values instead of a colour.

The kernels of `blend` are compiled for a few numbers of channels (`WIDTHS`). More channels take several passes over the same
instances, but no memory besides the image and the gradient (docs/blend.md, section 3).
"""

import functools
from collections.abc import Iterator
from types import SimpleNamespace
from typing import NamedTuple

import torch
import warp as wp

from warpgs.constants import Rule
from warpgs.kernels.blend import (
    background_gradient,
    check_slots,
    check_tiles,
    composite,
    composite_gradients,
    is_native,
    without_gradients,
)
from warpgs.kernels.blend_records import COLORS, WIDTHS
from warpgs.kernels.blend_settings import BlendSettings
from warpgs.kernels.tiles import Tiles
from warpgs.runtime import interop
from warpgs.runtime.derivatives import first_order, keep, kept

GEOMETRY = 6
"""Number of values of a projected Gaussian before its colour; its depth and its box follow the colour."""


def width_of(channels: int, widths: tuple[int, ...] = WIDTHS) -> int:
    """Return the number of channels of a pass: the smallest of ``widths`` with the least number of passes."""
    passes = -(-channels // widths[-1])
    return next(width for width in widths if width * passes >= channels)


def _width(projected: torch.Tensor, channels: int, absgrad: bool) -> int:
    """Return the number of channels of a pass over projected Gaussians [C, N, 12].

    The generic kernels hold a tile in local memory, which CUDA reserves for every thread that fits the device: 25 GB on an H100
    for float64 and 11 channels, 12 GB for 3. So float64 on CUDA has the smallest width, except with ``absgrad``, which needs a
    single pass.
    """
    narrow = projected.is_cuda and not is_native(projected) and not absgrad
    return width_of(channels, WIDTHS[:1] if narrow else WIDTHS)


@functools.cache
def make_kernels(real, width: int):
    """Make two kernels: one gives Gaussians the ``width`` channels of a pass, the other takes the pass's gradient apart."""
    module = f"warpgs.kernels.blend_channels.{real.__name__}.{width}"
    geometry, box = wp.constant(GEOMETRY), wp.constant(GEOMETRY + COLORS)
    own, rest = wp.constant(width), wp.constant(GEOMETRY + width)

    @wp.kernel(enable_backward=False, module=module)
    def color(
        begin: int, projected: wp.array2d(dtype=real), counts: wp.array(dtype=int), colors: wp.array2d(dtype=real), first: int,
        # outputs
        colored: wp.array2d(dtype=real),
    ):  # fmt: skip
        i = begin + wp.tid()
        if counts[i] > 0:  # rows of others are not read
            row = i % colors.shape[0]
            for c in range(own):
                value = real(0.0)
                if first + c < colors.shape[1]:
                    value = colors[row, first + c]
                colored[i, geometry + c] = value
            if first == 0:
                for k in range(geometry):
                    colored[i, k] = projected[i, k]
                for k in range(3):
                    colored[i, rest + k] = projected[i, box + k]

    @wp.kernel(enable_backward=False, module=module)
    def add(
        begin: int, v: wp.array2d(dtype=real), counts: wp.array(dtype=int), first: int,
        # outputs, which the kernel adds to
        v_projected: wp.array2d(dtype=real), v_colors: wp.array2d(dtype=real),
    ):  # fmt: skip
        row = begin + wp.tid()
        rows = v_colors.shape[0]
        for camera in range(counts.shape[0] // rows):
            i = camera * rows + row
            if counts[i] > 0:  # the gradient of others is 0
                for k in range(geometry):
                    v_projected[i, k] = v_projected[i, k] + v[i, k]
                for k in range(3):
                    v_projected[i, box + k] = v_projected[i, box + k] + v[i, rest + k]
                for c in range(wp.min(own, v_colors.shape[1] - first)):
                    v_colors[row, first + c] = v_colors[row, first + c] + v[i, geometry + c]

    return SimpleNamespace(color=color, add=add)


class _Group(NamedTuple):
    """The channels of one pass."""

    channels: slice
    """Slice of all D channels."""
    projected: torch.Tensor
    """Projected Gaussians that have these channels instead of a colour, shape [C, N, 9 + G]. All groups share the memory."""
    backgrounds: torch.Tensor
    """Background of the channels, shape [C, G]: zeros fill up the last group."""


def _padded(values: torch.Tensor, width: int) -> torch.Tensor:
    """Return values [..., F], filled up with zeros to [..., width]."""
    return torch.nn.functional.pad(values, (0, width - values.shape[-1]))


def _given(v_image: torch.Tensor, width: int, native: bool) -> torch.Tensor:
    """Return the gradient of a pass [..., F] as its kernels take it: generic kernels read ``width`` channels."""
    return v_image if native or v_image.shape[-1] == width else _padded(v_image, width)


def _groups(
    projected: torch.Tensor, tiles: Tiles, colors: torch.Tensor, backgrounds: torch.Tensor, width: int
) -> Iterator[_Group]:  # fmt: skip
    """Yield the groups of ``width`` channels, in order; use each group before you request the next."""
    count, real = colors.shape[-1], interop.real_of(colors)
    colored = projected.new_empty(*projected.shape[:2], GEOMETRY + width + 3)
    inputs = [interop.rows(projected, real), interop.view(tiles.counts, wp.int32), interop.rows(colors, real)]
    for first in range(0, count, width):
        channels = slice(first, min(first + width, count))
        arguments = [*inputs, first, interop.rows(colored, real)]
        interop.launch(make_kernels(real, width).color, len(tiles.counts), arguments, projected.device, cost=5)
        yield _Group(channels, colored, _padded(backgrounds[:, channels], width).contiguous())


class _BlendChannels(torch.autograd.Function):
    @staticmethod
    def forward(ctx, projected, colors, backgrounds, tiles, settings):
        save = any(ctx.needs_input_grad)
        if save:
            check_slots(tiles)
        projected, colors = projected.contiguous(), colors.contiguous()
        image = projected.new_empty(len(projected), settings.height, settings.width, colors.shape[-1])
        found = None
        for group in _groups(projected, tiles, colors, backgrounds, _width(projected, colors.shape[-1], settings.absgrad)):
            # the first pass computes everything that does not depend on the channels
            part = image[..., group.channels]
            whole = part.shape[-1] == group.backgrounds.shape[-1]
            rgb, *rest = composite(
                group.projected, tiles, group.backgrounds, settings, save=save and found is None,
                image=part if whole or is_native(projected) else None,
            )  # fmt: skip
            if rgb is not part:
                part.copy_(rgb[..., : part.shape[-1]])
            found = found or rest
        alpha, depth, *saved = found
        if save:
            keep(ctx, projected, colors, backgrounds, image, depth, *saved, *tiles.tensors())
            ctx.tile_size, ctx.visible, ctx.settings = tiles.size, tiles.visible, settings
        ctx.set_materialize_grads(False)
        return image, alpha, depth

    @staticmethod
    @first_order
    def backward(ctx, v_image, v_alpha, v_depth):
        projected, colors, backgrounds, image, *tensors = kept(ctx)
        shared, tiles = tensors[:5], Tiles(ctx.tile_size, *tensors[5:], ctx.visible)
        v_projected, v_colors = torch.zeros_like(projected), torch.zeros_like(colors)
        v_image, v_alpha, v_depth = (None if v is None else v.contiguous() for v in (v_image, v_alpha, v_depth))
        real, width = interop.real_of(projected), _width(projected, colors.shape[-1], ctx.settings.absgrad)
        outputs = [interop.rows(t, real) for t in (v_projected, v_colors)]
        for group in _groups(projected, tiles, colors, backgrounds, width):
            first = group.channels.start
            if v_image is None and first > 0:
                break
            saved = [image[..., group.channels], *shared]
            if is_native(projected) and first > 0:
                # states hold the channels of one group, so that memory does not grow with the number of channels
                again = composite(
                    group.projected, tiles, group.backgrounds, ctx.settings, save=True, image=image[..., :0]
                )  # fmt: skip
                saved[1:] = again[2:]
            v_rgb = None if v_image is None else _given(v_image[..., group.channels], width, is_native(projected))
            v_images = (v_rgb, v_alpha, v_depth) if first == 0 else (v_rgb, None, None)
            v = composite_gradients(group.projected, tiles, group.backgrounds, ctx.settings, saved, v_images)
            arguments = [interop.rows(v, real), interop.view(tiles.counts, wp.int32), first, *outputs]
            count = v_colors.shape[0] * v_colors.shape[1]
            interop.launch(make_kernels(real, width).add, count, arguments, v.device, cost=5)
        v_backgrounds = background_gradient(shared[1], v_image, colors.shape[-1]) if ctx.needs_input_grad[2] else None
        return v_projected, v_colors, v_backgrounds, None, None


def blend_channels(
    projected: torch.Tensor,
    tiles: Tiles,
    colors: torch.Tensor,
    backgrounds: torch.Tensor,
    *,
    width: int,
    height: int,
    rule: Rule,
    deterministic: bool = True,
    origin: tuple[int, int] = (0, 0),
    absgrad: bool = False,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Composite C images of H x W pixels and D channels, as `blend` does with the colours of projected Gaussians.

    Differentiable in ``colors``, ``backgrounds`` and the projected Gaussians, except their colours and boxes. The channels
    are blended in several passes. The gradients of position, covariance factor and opacity are summed over the passes in a
    fixed order, so they are as repeatable as those of `blend`.

    Args:
        projected: Projected Gaussians of `project`, shape [C, N, 12].
        tiles: Result of `bin_tiles` for the same image size.
        colors: Finite values of any size and sign, shape [C, N, D] with D at least 1; or [1, N, D], the same for all images.
        backgrounds: Values behind everything, shape [C, D].
        width: Image width [px].
        height: Image height [px].
        rule: Cut-offs.
        deterministic: True to sum gradients in a fixed order, see `blend`.
        origin: Left and top [px] of the window that the tiles were made for.
        absgrad: True to also sum magnitudes, see `blend`; with more than 11 channels, the magnitudes of the passes are added.

    Returns:
        The image [C, H, W, D], not clamped; ``alpha`` and ``depth`` [C, H, W], as `blend` returns them.

    Raises:
        TypeError: A scalar type is neither float32 nor float64, or scalar types differ.
        ValueError: A shape or device is wrong, there is no channel, or the tiles belong to another image size.
    """
    shared = "1" if len(colors) == 1 else "C"
    check_tiles(projected, tiles, width, height, colors=(colors, f"{shared} N D"), backgrounds=(backgrounds, "C D"))
    if colors.shape[-1] == 0:
        raise ValueError(f"colors must have at least one channel, not shape {list(colors.shape)}")
    settings = BlendSettings(origin, width, height, rule, deterministic, absgrad)
    return _BlendChannels.apply(*without_gradients(projected, colors, backgrounds), tiles, settings)
