"""Blending: sorted Gaussians become pixels, front to back, with gradients; colours, depth and further channels."""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.constants import LARGEST_HALF
from warpgs.device import BINNING, BLENDING, FLOAT, LOSS, PROJECTION, SAMPLING, Needs, StepSizes
from warpgs.kernels import blend_cpu, blend_cuda, launch
from warpgs.kernels.falloff import COLORS, LARGEST_STOP, VALUES, WIDTHS, Pass
from warpgs.kernels.graphs import TORCH, Allocator
from warpgs.kernels.native import ROLLED, Ints, make_prefetch
from warpgs.kernels.tiles import Tiles


def step_bytes(sizes: StepSizes) -> Needs:
    """Return the bytes of images, of data for the backward pass, and of gradient slots at each moment of a step."""
    # the tile order is gone before the loss, which takes more
    slots, states, order = blend_cuda.step_bytes(sizes) if sizes.cuda else (FLOAT * VALUES * sizes.instances, 0, 0)
    images = (COLORS + 2) * FLOAT * sizes.pixels  # colour, alpha, depth
    kept = 3 * FLOAT * sizes.pixels + states  # transmittance, weight, end
    lean = not (sizes.depth or sizes.cutout)  # only colour has a gradient
    upstream = (COLORS if lean else COLORS + 2) * FLOAT * sizes.pixels
    whole = images + upstream if sizes.chunked else 0  # images of the frame exist beside those of a chunk
    return {
        BINNING: whole, LOSS: images + (0 if sizes.chunked else kept), BLENDING: kept + slots + images + (whole or upstream),
        PROJECTION: images + upstream, SAMPLING: 3 * images + order,
    }  # fmt: skip


SUMMED = 16
"""Number of Gaussians for which one task sums gradients."""


@functools.cache
def make_segments(real, values: int = VALUES, width: int = 9 + COLORS):
    """Make the kernels that sum gradient slots of ``values`` numbers, always in slot order, into rows of ``width`` numbers."""
    reals, record = (wp.types.vector(size, real) for size in (values, width))
    Reals, Rows = wp.array(dtype=real), wp.array2d(dtype=real)
    prefetch = make_prefetch(reals)
    lanes = SUMMED

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def sum_gradients(
        begin: int, v_slots: wp.array(dtype=reals), starts: Ints, counts: Ints,
        # outputs
        v_projected: wp.array(dtype=record),
    ):  # fmt: skip
        first = (begin + wp.tid()) * lanes
        used = wp.min(lanes, starts.shape[0] - first)
        for later in range(first + 2 * lanes, wp.min(first + 3 * lanes, starts.shape[0])):
            if counts[later] > 0:  # without slots, starts are undefined
                prefetch(v_slots, starts[later])
                prefetch(v_slots, starts[later] + counts[later] - 1)
        for lane in range(used):
            i = first + lane
            total = record()
            for slot in range(starts[i], starts[i] + counts[i]):
                v = v_slots[slot]
                for k in range(wp.static(values)):
                    total[k] += v[k]
            v_projected[i] = total

    @wp.kernel(enable_backward=False, module=f"warpgs.kernels.blend.{real.__name__}.{values}")
    def gather_weights(
        begin: int, weights: Rows, starts: Ints, counts: Ints,
        # outputs
        sums: Reals, maxima: Reals,
    ):  # fmt: skip
        i = begin + wp.tid()
        total = real(0.0)
        largest = real(0.0)
        for slot in range(starts[i], starts[i] + counts[i]):
            total += weights[slot, 0]
            largest = wp.max(largest, weights[slot, 1])
        sums[i] = total
        maxima[i] = largest

    return SimpleNamespace(sum_gradients=sum_gradients, gather_weights=gather_weights)


def composite(
    projected: torch.Tensor, tiles: Tiles, backgrounds: torch.Tensor, settings: Pass, *, save: bool,
    allocator: Allocator = TORCH, image: torch.Tensor | None = None,
) -> tuple[torch.Tensor, ...]:  # fmt: skip
    """Return rgb [C, H, W, D]; alpha, depth, transmittances, weights and ends [C, H, W]; and states. Nothing is checked."""
    # ``image`` may be a slice of the channels of an image; on CUDA in float32 it may have fewer than D channels: then only the
    # first ones are written. Without ``save``, transmittances and weights may be empty. With `Pass.max_error`: rgb, alpha,
    # depth, and bounds of the error of rgb [C].
    if settings.max_error and tiles.packed is None:
        return _rounded(projected, tiles, backgrounds, settings)
    if launch.is_native(projected):
        return blend_cuda.forward(projected, tiles, backgrounds, settings, save=save, allocator=allocator, image=image)
    real, device = launch.real_of(projected), projected.device
    cameras, channels = backgrounds.shape
    shape = (cameras, *settings.window[:1:-1])
    rgb = allocator.output((*shape, channels), projected.dtype, device) if image is None else image
    alpha, depth = (allocator.output(shape, projected.dtype, device) for _ in range(2))
    transmittances, weights = (allocator.saved(shape, projected.dtype, device) for _ in range(2))
    ends = allocator.saved(shape, torch.int32, device)
    inputs = [
        settings.struct(tiles.size, real), projected, tiles.ranges, tiles.gaussian_ids, backgrounds, rgb,
        launch.row_stride(rgb), alpha, depth, transmittances, weights, ends,
    ]  # fmt: skip
    kernel = blend_cpu.make_forward(real, tiles.size, channels)
    launch.launch(kernel, len(tiles.ranges), inputs, device, cost=10_000, block_dim=32)
    return rgb, alpha, depth, transmittances, weights, ends, allocator.saved((0,), projected.dtype, device)


def _rounded(projected: torch.Tensor, tiles: Tiles, backgrounds: torch.Tensor, settings: Pass) -> tuple[torch.Tensor, ...]:
    """Return what blend_forward.cu does of packed Gaussians, with its roundings and, over all cameras, its lowest stop."""
    rounded, rule = projected.clone(), settings.rule
    colors, depths = rounded[..., GEOMETRY : GEOMETRY + COLORS], rounded[..., GEOMETRY + COLORS]
    most = float(colors.amax()) if colors.numel() else 0.0
    colors.copy_(colors.clamp_max(LARGEST_HALF).half())
    depths.copy_(depths.bfloat16())
    low, high = backgrounds.clamp_max(0), backgrounds.clamp_min(most)
    spread, behind, reach = (high - low).amax(1) / 2, (low + high) / 2, torch.maximum(high, -low).amax(1)
    errors = (settings.rounding() if most <= LARGEST_HALF else 1.0) * reach + 3e-8
    stop = ((settings.max_error * 0.999 - errors) / spread).nan_to_num().amin().clamp_max(LARGEST_STOP)
    stop = stop.clamp_min(4 * rule.transmittance_stop)
    coarse = replace(settings, max_error=0.0, rule=replace(rule, transmittance_stop=float(stop)))
    rgb, alpha, depth, left, *_ = composite(rounded, tiles, backgrounds, coarse, save=True)
    rgb += ((behind - backgrounds)[:, None, None] * left[..., None]).where(left[..., None] < stop, 0.0)
    return rgb, alpha, depth, (errors + stop * spread) * 1.001


def composite_gradients(
    projected: torch.Tensor, tiles: Tiles, backgrounds: torch.Tensor, settings: Pass, saved: Sequence[torch.Tensor],
    v_images: Sequence[torch.Tensor | None], allocator: Allocator = TORCH,
) -> torch.Tensor:  # fmt: skip
    """Return the gradient of ``projected`` [C, N, 9 + D], from `composite`'s results except alpha. Nothing is checked."""
    # Only those channels of ``rgb`` are read that have a gradient. On CUDA in float32 the gradient of ``rgb`` may have fewer
    # than D channels; the others have gradient 0.
    v_rgb, v_alpha, v_depth = v_images
    channels = backgrounds.shape[1]
    v_rgb = saved[0].new_zeros(*saved[0].shape[:-1], channels) if v_rgb is None else v_rgb
    if launch.is_native(projected):
        return blend_cuda.backward(projected, tiles, backgrounds, settings, saved, (v_rgb, v_alpha, v_depth), allocator)
    _, depth, transmittances, weights, ends, _ = saved
    real, device, deep = launch.real_of(projected), projected.device, v_alpha is not None or v_depth is not None
    values = VALUES + channels - COLORS + 2 * settings.absgrad
    v_projected = allocator.output(projected.shape, projected.dtype, device)
    v_slots = allocator.workspace((len(tiles.slots), values), projected.dtype, device).zero_()
    nothing = torch.zeros_like(depth) if deep else depth.new_empty(0)
    inputs = [
        settings.struct(tiles.size, real), projected, tiles.ranges, tiles.gaussian_ids, tiles.slots, backgrounds,
        transmittances, weights, depth, ends, v_rgb, launch.row_stride(v_rgb),
        *(nothing if v is None else v.contiguous() for v in (v_alpha, v_depth)), v_slots,
    ]  # fmt: skip
    kernel = blend_cpu.make_backward(real, tiles.size, channels, settings.absgrad, deep)
    launch.launch(kernel, len(tiles.ranges), inputs, device, cost=10_000, block_dim=32)
    inputs = [v_slots, tiles.starts, tiles.counts, v_projected]
    tasks, kernel = -(-len(tiles.counts) // SUMMED), make_segments(real, values, projected.shape[-1]).sum_gradients
    launch.launch(kernel, tasks, inputs, device, cost=5 * SUMMED)
    return v_projected


def background_gradient(transmittances: torch.Tensor, v_rgb: torch.Tensor | None, channels: int = 3) -> torch.Tensor:
    """Return the gradient of the backgrounds, shape [C, D] with D ``channels``; zeros if ``v_rgb`` is None."""
    # a product of matrices would sum the pixels one by one, and err several times as much
    if v_rgb is None:
        return transmittances.new_zeros(len(transmittances), channels)
    return torch.stack([(transmittances * v_rgb[..., k]).sum((1, 2)) for k in range(channels)], 1)


def check_slots(tiles: Tiles) -> None:
    """Raise ValueError unless the tiles have slots, which gradients need."""
    if len(tiles.slots) != len(tiles.gaussian_ids):
        raise ValueError("gradients and contributions need tiles with slots: make the tiles with bin_tiles(slotted=True)")


# Compositing of any number of channels: each Gaussian has D values instead of a colour.
#
# The kernels of `blend` are compiled for a few numbers of channels (`WIDTHS`). More channels take several passes over
# the same instances, but no memory besides the image and the gradient (docs/blend.md, section 3).

GEOMETRY = 6
"""Number of values of a projected Gaussian before its colour; its depth and its box follow the colour."""


def width_of(channels: int, widths: tuple[int, ...] = WIDTHS) -> int:
    """Return the number of channels of a pass: the smallest of ``widths`` with the least number of passes."""
    passes = -(-channels // widths[-1])
    return next(width for width in widths if width * passes >= channels)


def _width(projected: torch.Tensor, channels: int, absgrad: bool) -> int:
    """Return the number of channels of a pass over projected Gaussians [C, N, 12]."""
    # The generic kernels hold a tile in local memory, which CUDA reserves for every thread that fits the device: 25 GB on an
    # H100 for float64 and 11 channels, 12 GB for 3. So float64 on CUDA has the smallest width, except with ``absgrad``, which
    # needs one pass.
    narrow = projected.is_cuda and not launch.is_native(projected) and not absgrad
    return width_of(channels, WIDTHS[:1] if narrow else WIDTHS)


@functools.cache
def make_kernels(real, width: int):
    """Make two kernels: one gives Gaussians the ``width`` channels of a pass, the other takes the pass's gradient apart."""
    module = f"warpgs.kernels.blend_channels.{real.__name__}.{width}"
    geometry, box = GEOMETRY, GEOMETRY + COLORS
    own, rest = width, GEOMETRY + width
    Rows = wp.array2d(dtype=real)

    @wp.kernel(enable_backward=False, module=module)
    def color(
        begin: int, projected: Rows, counts: Ints, colors: Rows, first: int,
        # outputs
        colored: Rows,
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
        begin: int, v: Rows, counts: Ints, first: int,
        # outputs, which the kernel adds to
        v_projected: Rows, v_colors: Rows,
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


def _padded(values: torch.Tensor, width: int) -> torch.Tensor:
    """Return values [..., F], filled up with zeros to [..., width]."""
    return torch.nn.functional.pad(values, (0, width - values.shape[-1]))


def _groups(
    projected: torch.Tensor, tiles: Tiles, colors: torch.Tensor, backgrounds: torch.Tensor, width: int
) -> Iterator[tuple[slice, torch.Tensor, torch.Tensor]]:
    """Yield for each pass a slice of the D channels, Gaussians [C, N, 9 + G] with these channels, and backgrounds [C, G]."""
    # The Gaussians share their memory: use them before you request the next. Zeros fill up the last group.
    count, real = colors.shape[-1], launch.real_of(colors)
    colored = projected.new_empty(*projected.shape[:2], GEOMETRY + width + 3)
    inputs = [projected, tiles.counts, colors]
    for first in range(0, count, width):
        channels = slice(first, min(first + width, count))
        launch.launch(make_kernels(real, width).color, len(tiles.counts), [*inputs, first, colored], projected.device, cost=5)
        yield channels, colored, _padded(backgrounds[:, channels], width).contiguous()


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, projected, colors, backgrounds, tiles, settings):
        save = any(ctx.needs_input_grad)
        if save:
            check_slots(tiles)
        projected, found = projected.contiguous(), None
        if colors is None:
            backgrounds = backgrounds.contiguous()
            image, *found = composite(projected, tiles, backgrounds, settings, save=save)
            if settings.max_error:
                return image, *found
        else:
            colors, width = colors.contiguous(), _width(projected, colors.shape[-1], settings.absgrad)
            image = projected.new_empty(len(projected), *settings.window[:1:-1], colors.shape[-1])
            for channels, colored, behind in _groups(projected, tiles, colors, backgrounds, width):
                # the first pass computes everything that does not depend on the channels
                part = image[..., channels]
                whole = part.shape[-1] == behind.shape[-1]
                rgb, *rest = composite(
                    colored, tiles, behind, settings, save=save and found is None,
                    image=part if whole or launch.is_native(projected) else None,
                )  # fmt: skip
                if rgb is not part:
                    part.copy_(rgb[..., : part.shape[-1]])
                found = found or rest
        alpha, depth, *saved = found
        if save:
            # all as saved tensors, which are freed after the backward pass
            launch.keep(ctx, projected, colors, backgrounds, image, depth, *saved, *tiles.tensors())
            ctx.tile_size, ctx.visible, ctx.settings = tiles.size, tiles.visible, settings
        ctx.set_materialize_grads(False)
        return image, alpha, depth

    @staticmethod
    @launch.first_order
    def backward(ctx, *v_images):
        projected, colors, backgrounds, image, *tensors = launch.kept(ctx)
        shared, tiles = tensors[:5], Tiles(ctx.tile_size, *tensors[5:], ctx.visible)
        v_image, v_alpha, v_depth = v_images = [None if v is None else v.contiguous() for v in v_images]
        v_backgrounds = background_gradient(shared[1], v_image, image.shape[-1]) if ctx.needs_input_grad[2] else None
        if colors is None:
            v_projected = composite_gradients(projected, tiles, backgrounds, ctx.settings, [image, *shared], v_images)
            return v_projected, None, v_backgrounds, None, None
        v_projected, v_colors = torch.zeros_like(projected), torch.zeros_like(colors)
        real, width = launch.real_of(projected), _width(projected, colors.shape[-1], ctx.settings.absgrad)
        for channels, colored, behind in _groups(projected, tiles, colors, backgrounds, width):
            first = channels.start
            if v_image is None and first > 0:
                break
            saved = [image[..., channels], *shared]
            if launch.is_native(projected) and first > 0:
                # states hold the channels of one group, so that memory does not grow with the number of channels
                saved[1:] = composite(colored, tiles, behind, ctx.settings, save=True, image=image[..., :0])[2:]
            v_rgb = None if v_image is None else v_image[..., channels]
            if v_rgb is not None and v_rgb.shape[-1] < width and not launch.is_native(projected):
                v_rgb = _padded(v_rgb, width)  # generic kernels read all channels of a pass
            v_images = (v_rgb, v_alpha, v_depth) if first == 0 else (v_rgb, None, None)
            v = composite_gradients(colored, tiles, behind, ctx.settings, saved, v_images)
            inputs, count = [v, tiles.counts, first, v_projected, v_colors], v_colors.shape[0] * v_colors.shape[1]
            launch.launch(make_kernels(real, width).add, count, inputs, v.device, cost=5)
        return v_projected, v_colors, v_backgrounds, None, None


def blend(
    projected: torch.Tensor, tiles: Tiles, backgrounds: torch.Tensor, settings: Pass, colors: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Composite C images of H x W pixels (Kerbl et al. 2023, eq. 3): return rgb [C, H, W, 3], alpha and depth [C, H, W].

    With ``colors`` [C or 1, N, D], any number of channels, the Gaussians have these instead: images and backgrounds have D.
    """
    # Differentiable in the first ten values of ``projected`` [C, N, 12], in ``backgrounds`` [C, 3] and in ``colors``; a clamped
    # alpha has gradient zero. Derivation: docs/blend.md. Depth is the mean [u] under the blending weights, 0 where they sum to
    # less than SMALLEST_WEIGHT. ``deterministic=False`` adds gradients atomically on CUDA in float32. ``absgrad`` puts sums of
    # magnitudes of the mean's gradient in the place of the gradient of the last two values of ``projected``. Gradients of
    # ``colors`` are summed over the passes in a fixed order.
    tensors = projected, colors, backgrounds
    if not torch.is_grad_enabled():  # leaf tensors would still require gradients
        tensors = (None if t is None else t.detach() for t in tensors)
    return _Blend.apply(*tensors, tiles, settings)
