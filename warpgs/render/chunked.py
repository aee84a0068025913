"""Chunked rendering: an image is rendered in windows, each with at most a given number of (Gaussian, tile) instances."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch.autograd.function import once_differentiable

from warpgs.kernels.blend import blend, contributions
from warpgs.kernels.median_depth import median_depth
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles
from warpgs.render.settings import RenderSettings, Window


@dataclass(frozen=True)
class ChunkedFrame:
    """Settings of a chunked render."""

    settings: RenderSettings
    """Settings of the whole render; its window is divided."""
    max_instances: int
    """Most instances of a chunk. A single tile is never divided, so it may have up to one for each projected Gaussian."""
    deterministic: bool = True
    """True to sum gradients in a fixed order."""


def halves(window: Window, tile_size: int) -> tuple[Window, Window] | None:
    """Split a window at a tile's border: into upper and lower half, or left and right of a single row; None for one tile."""
    x, y, width, height = window
    if height > tile_size:
        first = -(-height // (2 * tile_size)) * tile_size
        return (x, y, width, first), (x, y + first, width, height - first)
    if width > tile_size:
        first = -(-width // (2 * tile_size)) * tile_size
        return (x, y, first, height), (x + first, y, width - first, height)
    return None


def _counts(frame: ChunkedFrame, window: Window, sources: tuple[torch.Tensor, ...]) -> torch.Tensor:
    """Return the number of tiles in a window that each Gaussian touches, shape [C, N]."""
    factors = sources[7] if len(sources) > 7 else None
    settings = dataclasses.replace(frame.settings, window=window)
    return project(*sources[:7], opacity_factors=factors, **settings.project_options())[1]


def chunks(frame: ChunkedFrame, sources: tuple[torch.Tensor, ...]) -> Iterator[tuple[Window, torch.Tensor]]:
    """Yield windows of at most ``frame.max_instances`` instances, from top to bottom, with the tile counts [C, N] in each.

    A window with more is halved.

    Args:
        frame: Settings.
        sources: The seven tensors that `project` takes, with their shapes [...], and the opacity factors [N] if any; detached.
    """
    left = [frame.settings.window]
    while left:
        window = left.pop()
        counts = _counts(frame, window, sources)
        smaller = halves(window, frame.settings.tile_size)
        if smaller is None or int(counts.sum()) <= frame.max_instances:
            yield window, counts
        else:
            left += reversed(smaller)


def _render_chunk(
    projected: torch.Tensor, backgrounds: torch.Tensor, frame: ChunkedFrame, window: Window, counts: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return ``rgb``, ``alpha`` and ``depth`` of one window."""
    x, y, width, height = window
    options = {"width": width, "height": height, "rule": frame.settings.rule, "origin": (x, y)}
    tiles = bin_tiles(projected, counts, tile_size=frame.settings.tile_size, **options)
    return blend(projected, tiles, backgrounds, deterministic=frame.deterministic, **options)


class _BlendChunked(torch.autograd.Function):
    @staticmethod
    def forward(ctx, projected, backgrounds, frame, *sources):
        x0, y0, width, height = frame.settings.window
        images = [projected.new_empty(len(projected), height, width, *rest) for rest in ((3,), (), ())]
        ctx.windows = []
        for window, counts in chunks(frame, sources):
            x, y, w, h = window
            rows, columns = slice(y - y0, y - y0 + h), slice(x - x0, x - x0 + w)
            for image, part in zip(images, _render_chunk(projected.detach(), backgrounds.detach(), frame, window, counts)):
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
                rendered = _render_chunk(*inputs, ctx.frame, window, counts)
            wanted = [(p, v[:, rows, columns]) for p, v in zip(rendered, upstream) if v is not None]
            images, gradients = zip(*wanted)
            part, part_background = torch.autograd.grad(images, inputs, gradients)
            v_projected += part
            v_backgrounds += part_background
        return v_projected, v_backgrounds, *(None for _ in range(1 + len(sources)))


def contributions_chunked(
    projected: torch.Tensor, frame: ChunkedFrame, sources: tuple[torch.Tensor, ...]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute sum and maximum of each projected Gaussian's weights, as `contributions` does, chunk by chunk.

    Args:
        projected: Result of `project` for the frame's window, shape [C, N, 12].
        frame: Settings.
        sources: The seven tensors that ``projected`` was projected from, with their shapes [...], and the opacity factors [N]
            if there were any.

    Returns:
        Sums and maxima, shape [C, N] each.
    """
    sums, maxima = torch.zeros_like(projected[..., 0]), torch.zeros_like(projected[..., 0])
    for (x, y, width, height), counts in chunks(frame, tuple(t.detach() for t in sources)):
        options = {"width": width, "height": height, "rule": frame.settings.rule, "origin": (x, y)}
        tiles = bin_tiles(projected, counts, tile_size=frame.settings.tile_size, **options)
        part, part_maxima = contributions(projected, tiles, **options)
        sums += part
        maxima = torch.maximum(maxima, part_maxima)
    return sums, maxima


def median_depth_chunked(projected: torch.Tensor, frame: ChunkedFrame, sources: tuple[torch.Tensor, ...]) -> torch.Tensor:
    """Render the median depth chunk by chunk: the same bits as `median_depth` gives.

    Args:
        projected: Result of `project` for the frame's window, shape [C, N, 12].
        frame: Settings.
        sources: The seven tensors that ``projected`` was projected from, with their shapes [...], and the opacity factors [N]
            if there were any.

    Returns:
        z-depth [u], 0 where alpha is below 1/2, shape [C, H, W].
    """
    x0, y0, width, height = frame.settings.window
    depths = projected.new_empty(len(projected), height, width)
    for (x, y, w, h), counts in chunks(frame, tuple(t.detach() for t in sources)):
        options = {"width": w, "height": h, "rule": frame.settings.rule, "origin": (x, y)}
        tiles = bin_tiles(projected, counts, tile_size=frame.settings.tile_size, **options)
        depths[:, y - y0 : y - y0 + h, x - x0 : x - x0 + w] = median_depth(projected, tiles, **options)
    return depths


def blend_chunked(
    projected: torch.Tensor, backgrounds: torch.Tensor, frame: ChunkedFrame, sources: tuple[torch.Tensor, ...]
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Composite projected Gaussians chunk by chunk: the same images as `blend` gives, to the bit.

    The backward pass renders each chunk again and adds up the gradients, so nothing but the inputs is saved for it. That
    takes about half as long again as `blend`, and memory for the instances of one chunk only.

    Args:
        projected: Result of `project` for the frame's window, shape [C, N, 12]; differentiable.
        backgrounds: Colour behind everything, shape [C, 3]; differentiable.
        frame: Settings.
        sources: The seven tensors that ``projected`` was projected from, with their shapes [...], and the opacity factors [N]
            if there were any.

    Returns:
        ``rgb`` [C, H, W, 3], ``alpha`` and ``depth`` [C, H, W], as `blend` returns them.
    """
    return _BlendChunked.apply(projected, backgrounds, frame, *(t.detach() for t in sources))
