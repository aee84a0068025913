"""Chunked rendering: windows of an image, each with at most a given number of (Gaussian, tile) pairs, called instances."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch

from warpgs.kernels.ellipse import ProjectInputs
from warpgs.kernels.launch import first_order, keep, kept
from warpgs.kernels.project import project_inputs
from warpgs.render.compose import (
    Images,
    RenderSettings,
    Window,
    bin_and_blend,
    bin_projected,
    heaviest_of,
    median_depth_of,
    weights_of,
)


@dataclass(frozen=True)
class ChunkedFrame:
    """Settings of a chunked render."""

    settings: RenderSettings
    """Settings of the whole render; its window is divided."""
    max_instances: int
    """Largest number of (Gaussian, tile) instances of a chunk. A single tile is never divided, so it may have more, up to one
    for each projected Gaussian."""
    deterministic: bool = True
    """True to sum gradients in a fixed order."""


def halves(window: Window, tile_size: int) -> tuple[Window, Window] | None:
    """Split a window into upper and lower rows of tiles, or a single row into left and right; return None for one tile."""
    x, y, width, height = window
    if height > tile_size:
        first = -(-height // (2 * tile_size)) * tile_size
        return (x, y, width, first), (x, y + first, width, height - first)
    if width > tile_size:
        first = -(-width // (2 * tile_size)) * tile_size
        return (x, y, first, height), (x + first, y, width - first, height)
    return None


def chunks(frame: ChunkedFrame, inputs: ProjectInputs) -> Iterator[tuple[RenderSettings, torch.Tensor]]:
    """Yield settings and tile counts [C, N] of windows, top to bottom, with at most ``max_instances`` each or of one tile."""
    left = [frame.settings.window]
    while left:
        window = left.pop()
        settings, counts = _part(frame, window, inputs)
        smaller = halves(window, settings.tile_size)
        if smaller is None or int(counts.sum()) <= frame.max_instances:
            yield settings, counts
        else:
            left += reversed(smaller)


def _part(frame: ChunkedFrame, window: Window, inputs: ProjectInputs) -> tuple[RenderSettings, torch.Tensor]:
    """Return the settings of one window, and the number of its tiles that each Gaussian touches, shape [C, N]."""
    settings = replace(frame.settings, window=window)
    return settings, project_inputs(inputs, settings.projection())[1]


def _place(frame: ChunkedFrame, window: Window) -> tuple[slice, slice]:
    """Return rows and columns of a window in the frame's images."""
    (x0, y0, _, _), (x, y, w, h) = frame.settings.window, window
    return slice(y - y0, y - y0 + h), slice(x - x0, x - x0 + w)


class _BlendChunked(torch.autograd.Function):
    @staticmethod
    def forward(ctx, projected, backgrounds, colors, frame, *inputs):
        _, _, width, height = frame.settings.window
        images = [projected.new_empty(len(projected), height, width, *rest) for rest in (backgrounds.shape[1:], (), ())]
        values = None if colors is None else colors.detach()
        ctx.windows = []
        for settings, counts in chunks(frame, ProjectInputs(*inputs)):
            rows, columns = _place(frame, settings.window)
            _, parts = bin_and_blend(
                projected.detach(), counts, backgrounds.detach(), settings, deterministic=frame.deterministic, colors=values
            )
            for image, part in zip(images, parts):
                image[:, rows, columns] = part
            ctx.windows.append(settings.window)
        # the inputs too, so that torch detects changes to them before the backward pass
        keep(ctx, projected, backgrounds, colors, *inputs)
        ctx.frame = frame
        ctx.set_materialize_grads(False)
        return tuple(images)

    @staticmethod
    @first_order
    def backward(ctx, *upstream):
        *blended, colors = (tensors := kept(ctx))[:3]
        inputs, frame = ProjectInputs(*tensors[3:]).detached(), ctx.frame
        blended = blended if colors is None else [*blended, colors]
        gradients = [torch.zeros_like(t) for t in blended]
        for window in ctx.windows:
            settings, counts = _part(frame, window, inputs)
            rows, columns = _place(frame, window)
            with torch.enable_grad():
                own = [t.detach().requires_grad_() for t in blended]
                values = None if colors is None else own[2]
                _, parts = bin_and_blend(
                    own[0], counts, own[1], settings, deterministic=frame.deterministic, colors=values
                )  # fmt: skip
            images, v_images = zip(*[(p, v[:, rows, columns]) for p, v in zip(parts, upstream) if v is not None])
            for total, part in zip(gradients, torch.autograd.grad(images, own, v_images)):
                total += part
        return *gradients, *(None for _ in range(3 + 1 + len(inputs) - len(gradients)))


def contributions_chunked(
    projected: torch.Tensor, frame: ChunkedFrame, inputs: ProjectInputs
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute `contributions` of projected Gaussians [C, N, 12] chunk by chunk: sums and maxima, shape [C, N] each."""
    sums, maxima = torch.zeros_like(projected[..., 0]), torch.zeros_like(projected[..., 0])
    for settings, counts in chunks(frame, inputs.detached()):
        part, part_maxima = weights_of(projected, bin_projected(projected, counts, settings), settings)
        sums += part
        maxima = torch.maximum(maxima, part_maxima)
    return sums, maxima


def median_depth_chunked(projected: torch.Tensor, frame: ChunkedFrame, inputs: ProjectInputs) -> torch.Tensor:
    """Render the `median_depth` [u] chunk by chunk, to the same bits, shape [C, H, W]."""
    _, _, width, height = frame.settings.window
    depths = projected.new_empty(len(projected), height, width)
    for settings, counts in chunks(frame, inputs.detached()):
        rows, columns = _place(frame, settings.window)
        depths[:, rows, columns] = median_depth_of(
            projected, bin_projected(projected, counts, settings, slotted=False), settings
        )
    return depths


def heaviest_chunked(
    projected: torch.Tensor, frame: ChunkedFrame, inputs: ProjectInputs, k: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Find the `heaviest` Gaussians chunk by chunk, to the same bits: ids, weights [C, H, W, k], counts [C, H, W]."""
    _, _, width, height = frame.settings.window
    shape = (len(projected), height, width)
    ids, counts = (projected.new_empty(s, dtype=torch.int32) for s in ((*shape, k), shape))
    weights = projected.new_empty(*shape, k)
    for settings, tile_counts in chunks(frame, inputs.detached()):
        rows, columns = _place(frame, settings.window)
        parts = heaviest_of(projected, bin_projected(projected, tile_counts, settings, slotted=False), settings, k)
        for image, part in zip((ids, weights, counts), parts, strict=True):
            image[:, rows, columns] = part
    return ids, weights, counts


def blend_chunked(
    projected: torch.Tensor, backgrounds: torch.Tensor, frame: ChunkedFrame, inputs: ProjectInputs,
    colors: torch.Tensor | None = None,
) -> Images:  # fmt: skip
    """Composite [C, N, 12] chunk by chunk, to the bits of `images_of`; the backward pass renders each chunk again."""
    # only the inputs are saved; about 1.5 times the time of `blend`, with memory for one chunk's instances
    images: Images = _BlendChunked.apply(projected, backgrounds, colors, frame, *inputs.detached())
    return images
