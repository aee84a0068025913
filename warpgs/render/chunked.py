"""A picture in bands: never more (Gaussian, tile) instances at a time than there is room for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch.autograd.function import once_differentiable

from warpgs.constants import Rule
from warpgs.kernels.blend import blend, contributions
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles

Window = tuple[int, int, int, int]
"""Left, top, width and height [px]."""


@dataclass(frozen=True)
class Frame:
    """What is drawn, and in how large parts."""

    width: int
    """Of the picture [px]."""
    height: int
    """Of the picture [px]."""
    window: Window
    """The part of it that is wanted."""
    degree: int
    rule: Rule
    tile_size: int
    most: int
    """Instances at a time. One tile is not divided, so there may be as many as there are records."""
    deterministic: bool = True


def halves(window: Window, tile_size: int) -> tuple[Window, Window] | None:
    """Upper and lower half of a window at a tile's border; left and right of a single row; None of a single tile."""
    x, y, width, height = window
    if height > tile_size:
        first = -(-height // (2 * tile_size)) * tile_size
        return (x, y, width, first), (x, y + first, width, height - first)
    if width > tile_size:
        first = -(-width // (2 * tile_size)) * tile_size
        return (x, y, first, height), (x + first, y, width - first, height)
    return None


def _counts(frame: Frame, window: Window, sources: tuple[torch.Tensor, ...]) -> torch.Tensor:
    size = {"width": frame.width, "height": frame.height, "tile_size": frame.tile_size, "window": window}
    factors = sources[7] if len(sources) > 7 else None
    return project(*sources[:7], degree=frame.degree, rule=frame.rule, opacity_factors=factors, **size)[1]


def parts(frame: Frame, sources: tuple[torch.Tensor, ...]) -> Iterator[tuple[Window, torch.Tensor]]:
    """Windows of at most ``frame.most`` instances each, from top to bottom, with the tiles that each record touches there.

    A window of too many is halved. ``sources`` are the seven tensors that `project` takes, and opacity factors if there are
    any, detached.
    """
    left = [frame.window]
    while left:
        window = left.pop()
        counts = _counts(frame, window, sources)
        smaller = halves(window, frame.tile_size)
        if smaller is None or int(counts.sum()) <= frame.most:
            yield window, counts
        else:
            left += reversed(smaller)


def _draw(projected: torch.Tensor, backgrounds: torch.Tensor, frame: Frame, window: Window, counts: torch.Tensor):
    x, y, width, height = window
    how = {"width": width, "height": height, "rule": frame.rule, "origin": (x, y)}
    tiles = bin_tiles(projected, counts, tile_size=frame.tile_size, **how)
    return blend(projected, tiles, backgrounds, deterministic=frame.deterministic, **how)


class _Banded(torch.autograd.Function):
    @staticmethod
    def forward(ctx, projected, backgrounds, frame, *sources):
        x0, y0, width, height = frame.window
        images = [projected.new_empty(len(projected), height, width, *rest) for rest in ((3,), (), ())]
        ctx.windows = []
        for window, counts in parts(frame, sources):
            x, y, w, h = window
            rows, columns = slice(y - y0, y - y0 + h), slice(x - x0, x - x0 + w)
            for image, part in zip(images, _draw(projected.detach(), backgrounds.detach(), frame, window, counts)):
                image[:, rows, columns] = part
            ctx.windows.append((window, rows, columns))
        # the sources too, so that torch notices where they are changed before the gradient is taken
        ctx.save_for_backward(projected, backgrounds, *sources)
        ctx.frame = frame
        ctx.set_materialize_grads(False)
        return tuple(images)

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream):
        projected, backgrounds, *sources = ctx.saved_tensors
        sources = tuple(t.detach() for t in sources)
        v_projected, v_backgrounds = torch.zeros_like(projected), torch.zeros_like(backgrounds)
        for window, rows, columns in ctx.windows:
            counts = _counts(ctx.frame, window, sources)
            with torch.enable_grad():
                inputs = [projected.detach().requires_grad_(), backgrounds.detach().requires_grad_()]
                drawn = _draw(*inputs, ctx.frame, window, counts)
            wanted = [(p, v[:, rows, columns]) for p, v in zip(drawn, upstream) if v is not None]
            images, gradients = zip(*wanted)
            part, part_background = torch.autograd.grad(images, inputs, gradients)
            v_projected += part
            v_backgrounds += part_background
        return v_projected, v_backgrounds, *(None for _ in range(1 + len(sources)))


def contributions_in_bands(
    projected: torch.Tensor, frame: Frame, sources: tuple[torch.Tensor, ...]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Sum and maximum of each record's weights, as `contributions` returns them, part by part."""
    sums, maxima = torch.zeros_like(projected[..., 0]), torch.zeros_like(projected[..., 0])
    for (x, y, width, height), counts in parts(frame, tuple(t.detach() for t in sources)):
        how = {"width": width, "height": height, "rule": frame.rule, "origin": (x, y)}
        tiles = bin_tiles(projected, counts, tile_size=frame.tile_size, **how)
        part, part_maxima = contributions(projected, tiles, **how)
        sums += part
        maxima = torch.maximum(maxima, part_maxima)
    return sums, maxima


def blend_in_bands(
    projected: torch.Tensor, backgrounds: torch.Tensor, frame: Frame, sources: tuple[torch.Tensor, ...]
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Composite the records of `project` part by part: the same pictures as at once, to the bit.

    Nothing is kept for the backward pass, which draws each part again; the gradients of the parts add up. That takes about
    half as long again as drawing at once, and memory for the instances of one part only.

    Args:
        projected: Records of `project` for the frame's window, shape [C, N, 12]; differentiable.
        backgrounds: Colour behind everything, shape [C, 3]; differentiable.
        frame: What to draw.
        sources: The seven tensors that ``projected`` were projected from, and the opacity factors if there were any.

    Returns:
        ``rgb``, ``alpha`` and ``depth`` as `blend` returns them.
    """
    return _Banded.apply(projected, backgrounds, frame, *(t.detach() for t in sources))
