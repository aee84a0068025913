"""Chunked rendering: windows of an image, each with at most a given number of (Gaussian, tile) pairs, called instances."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import torch

from warpgs.kernels.ellipse import ProjectInputs
from warpgs.kernels.falloff import Pass
from warpgs.kernels.launch import first_order, keep, kept
from warpgs.kernels.project import project_inputs
from warpgs.kernels.tiles import InstanceMemory, bin_tiles
from warpgs.render.compose import Images, bin_and_blend, further_of


def halves(settings: Pass) -> tuple[Pass, ...]:
    """Split a window into upper and lower rows of tiles, or a single row into left and right; return nothing for one tile."""
    (x, y, width, height), size = settings.window, settings.tile_size
    if height > size:
        first = -(-height // (2 * size)) * size
        windows = (x, y, width, first), (x, y + first, width, height - first)
    elif width > size:
        first = -(-width // (2 * size)) * size
        windows = (x, y, first, height), (x + first, y, width - first, height)
    else:
        return ()
    return tuple(replace(settings, window=w) for w in windows)


def chunks(settings: Pass, most: int, inputs: ProjectInputs) -> Iterator[tuple[Pass, torch.Tensor]]:
    """Yield settings and tile counts [C, N] of windows, top to bottom, with at most ``most`` instances each or of one tile."""
    left = [settings]
    while left:
        part = left.pop()
        counts = project_inputs(inputs, part)[1]
        smaller = halves(part)
        if smaller and int(counts.sum()) > most:
            left += reversed(smaller)
        else:
            yield part, counts


def _place(settings: Pass, part: Pass) -> tuple[slice, slice, slice]:
    """Return the place of a part's window in the images [C, H, W, ...] of the whole."""
    (x0, y0, _, _), (x, y, w, h) = settings.window, part.window
    return slice(None), slice(y - y0, y - y0 + h), slice(x - x0, x - x0 + w)


class _BlendChunked(torch.autograd.Function):
    @staticmethod
    def forward(ctx, projected, backgrounds, colors, settings, most, memory, *inputs):
        _, _, width, height = settings.window
        images = [projected.new_empty(len(projected), height, width, *rest) for rest in (backgrounds.shape[1:], (), ())]
        values = None if colors is None else colors.detach()
        ctx.settings, ctx.memory, ctx.parts = settings, memory, []
        for part, counts in chunks(settings, most, ProjectInputs(*inputs)):
            pieces = bin_and_blend(projected.detach(), counts, backgrounds.detach(), part, memory, colors=values)
            for image, piece in zip(images, pieces):
                image[_place(settings, part)] = piece
            ctx.parts.append(part)
        # the inputs too, so that torch detects changes to them before the backward pass
        keep(ctx, projected, backgrounds, colors, *inputs)
        ctx.set_materialize_grads(False)
        return tuple(images)

    @staticmethod
    @first_order
    def backward(ctx, *upstream):
        projected, backgrounds, colors, *tensors = kept(ctx)
        inputs = ProjectInputs(*tensors).detached()
        blended = [projected, backgrounds] if colors is None else [projected, backgrounds, colors]
        gradients = [torch.zeros_like(t) for t in blended]
        for part in ctx.parts:
            counts = project_inputs(inputs, part)[1]
            with torch.enable_grad():
                own = [t.detach().requires_grad_() for t in blended]
                pieces = bin_and_blend(own[0], counts, own[1], part, ctx.memory, colors=None if colors is None else own[2])
            place = _place(ctx.settings, part)
            images, v_images = zip(*[(p, v[place]) for p, v in zip(pieces, upstream) if v is not None])
            for total, gradient in zip(gradients, torch.autograd.grad(images, own, v_images)):
                total += gradient
        return *gradients, *(None for _ in range(3 + 3 + len(inputs) - len(gradients)))


blend_chunked: Callable[..., Images] = _BlendChunked.apply
"""Composite [C, N, 12] chunk by chunk, to the bits of `blend`; the backward pass renders each chunk again."""
# only the inputs are saved; about 1.5 times the time of `blend`, with memory for one chunk's instances


def further_chunked(
    projected: torch.Tensor, settings: Pass, most: int, inputs: ProjectInputs, memory: InstanceMemory, contributions: bool,
    median: bool, k: int,
) -> dict[str, torch.Tensor]:  # fmt: skip
    """Return what `further_of` does for projected Gaussians [C, N, 12], chunk by chunk; images have the same bits."""
    found: dict[str, torch.Tensor] = {}
    _, _, width, height = settings.window
    for part, counts in chunks(settings, most, inputs):
        tiles = bin_tiles(projected, counts, part, memory, contributions)
        for name, values in further_of(projected, tiles, part, contributions, median, k).items():
            if name == "weight_sums":
                found[name] = found[name] + values if name in found else values
            elif name == "weight_maxima":
                found[name] = torch.maximum(found[name], values) if name in found else values
            else:
                if name not in found:
                    found[name] = values.new_empty(len(projected), height, width, *values.shape[3:])
                found[name][_place(settings, part)] = values
    return found
