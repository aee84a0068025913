"""Compositing of any number of channels: each Gaussian brings D values of its own in place of a colour.

The kernels of `blend` are compiled for a few numbers of channels (`WIDTHS`). More channels take several passes over the same
instances, and no memory but that of the image and the gradient (docs/blend.md, section 3).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch

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
from warpgs.runtime.derivatives import first_order

GEOMETRY = 6
"""Values of a projected Gaussian before its colour; its depth and its box follow that."""


def width_of(channels: int) -> int:
    """Return the number of channels of a pass: the fewest of `WIDTHS` that keep the number of passes at its least."""
    passes = -(-channels // WIDTHS[-1])
    return next(width for width in WIDTHS if width * passes >= channels)


class _Group(NamedTuple):
    """The channels of one pass."""

    channels: slice
    """Their place among all D."""
    projected: torch.Tensor
    """Projected Gaussians that have them in place of a colour, shape [C, N, 9 + G]. All groups share the memory."""
    backgrounds: torch.Tensor
    """Background of the channels, shape [C, G]."""


def _padded(values: torch.Tensor, channels: slice) -> torch.Tensor:
    """Return a group of channels of values [..., D], contiguous, shape [..., G]: zeros fill up the last group."""
    part, width = values[..., channels], width_of(values.shape[-1])
    return torch.nn.functional.pad(part, (0, width - part.shape[-1])).contiguous()


def _groups(projected: torch.Tensor, colors: torch.Tensor, backgrounds: torch.Tensor) -> Iterator[_Group]:
    """Yield the groups of all channels, in order; each must be done with before the next."""
    count, width = colors.shape[-1], width_of(colors.shape[-1])
    rest = projected[..., GEOMETRY + COLORS :]
    colored = torch.cat([projected[..., :GEOMETRY], projected.new_empty(*projected.shape[:2], width), rest], -1)
    for first in range(0, count, width):
        channels = slice(first, min(first + width, count))
        colored[..., GEOMETRY : GEOMETRY + width] = _padded(colors, channels)
        yield _Group(channels, colored, _padded(backgrounds, channels))


class _BlendChannels(torch.autograd.Function):
    @staticmethod
    def forward(ctx, projected, colors, backgrounds, tiles, settings):
        save = any(ctx.needs_input_grad)
        if save:
            check_slots(tiles)
        image = projected.new_empty(len(projected), settings.height, settings.width, colors.shape[-1])
        found = None
        for group in _groups(projected, colors, backgrounds):
            # the first pass gives all that does not depend on the channels
            rgb, *rest = composite(group.projected, tiles, group.backgrounds, settings, save=save and found is None)
            image[..., group.channels] = rgb[..., : group.channels.stop - group.channels.start]
            found = found or rest
        alpha, depth, *saved = found
        if save:
            ctx.save_for_backward(projected, colors, backgrounds, image, depth, *saved, *tiles.tensors())
            ctx.tile_size, ctx.visible, ctx.settings = tiles.size, tiles.visible, settings
        ctx.set_materialize_grads(False)
        return image, alpha, depth

    @staticmethod
    @first_order
    def backward(ctx, v_image, v_alpha, v_depth):
        projected, colors, backgrounds, image, *tensors = ctx.saved_tensors
        shared, tiles = tensors[:5], Tiles(ctx.tile_size, *tensors[5:], ctx.visible)
        v_projected, v_colors = torch.zeros_like(projected), torch.zeros_like(colors)
        for group in _groups(projected, colors, backgrounds):
            first = group.channels.start == 0
            if v_image is None and not first:
                break
            saved = [_padded(image, group.channels), *shared]
            if is_native(projected) and not first:
                # states hold the channels; to keep those of all groups would take memory for each channel
                rgb, _, *rest = composite(group.projected, tiles, group.backgrounds, ctx.settings, save=True)
                saved = [rgb, *rest]
            v_rgb = None if v_image is None else _padded(v_image, group.channels)
            v_images = (v_rgb, v_alpha, v_depth) if first else (v_rgb, None, None)
            v = composite_gradients(group.projected, tiles, group.backgrounds, ctx.settings, saved, v_images)
            v_geometry, v_own, v_rest = v.split([GEOMETRY, width_of(colors.shape[-1]), 3], -1)
            part = v_colors[..., group.channels]
            part += v_own[..., : part.shape[-1]].sum_to_size(part.shape)
            v_projected[..., :GEOMETRY] += v_geometry
            v_projected[..., GEOMETRY + COLORS :] += v_rest
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

    Differentiable in the projected Gaussians but for their colours and boxes, in ``colors`` and in ``backgrounds``. The
    gradients of position, factor and opacity are sums over passes, in order: as repeatable as those of `blend`.

    Args:
        projected: Projected Gaussians of `project`, shape [C, N, 12].
        tiles: Instances of `bin_tiles` for the same image size.
        colors: Finite values of any size and sign, shape [C, N, D] with D at least 1; or [1, N, D], the same for all images.
        backgrounds: Values behind everything, shape [C, D].
        width: Image width [px].
        height: Image height [px].
        rule: Cut-offs.
        deterministic: Sum gradients in a fixed order, see `blend`.
        origin: Left and top [px] of the window that the tiles were made for.
        absgrad: Sum magnitudes, see `blend`; of several passes (more than 11 channels) those of each.

    Returns:
        The image [C, H, W, D], not clamped; ``alpha`` and ``depth`` [C, H, W], as `blend` returns them.

    Raises:
        TypeError: A scalar type is neither float32 nor float64, or they differ.
        ValueError: A shape or device disagrees, there is no channel, or the tiles belong to another image size.
    """
    shared = "1" if len(colors) == 1 else "C"
    check_tiles(projected, tiles, width, height, colors=(colors, f"{shared} N D"), backgrounds=(backgrounds, "C D"))
    if colors.shape[-1] == 0:
        raise ValueError(f"colors must have at least one channel, not shape {list(colors.shape)}")
    settings = BlendSettings(origin, width, height, rule, deterministic, absgrad)
    return _BlendChannels.apply(*without_gradients(projected, colors, backgrounds), tiles, settings)
