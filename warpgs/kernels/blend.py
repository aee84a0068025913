"""Compositing of binned Gaussians front to back: colour, alpha, expected depth, and each Gaussian's blending weight."""

import functools
from collections.abc import Sequence
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.constants import Rule
from warpgs.kernels import blend_cpu, blend_cuda
from warpgs.kernels.blend_records import COLORS, VALUES
from warpgs.kernels.blend_settings import BlendSettings
from warpgs.kernels.compiler import ROLLED
from warpgs.kernels.tiles import Tiles, grid
from warpgs.runtime import interop
from warpgs.runtime.allocator import TORCH, Allocator
from warpgs.runtime.derivatives import first_order, keep, kept
from warpgs.runtime.step_sizes import BINNING, BLENDING, FLOAT, LOSS, PROJECTION, SAMPLING, Needs, StepSizes


def step_bytes(sizes: StepSizes) -> Needs:
    """Return the bytes of images, of data for the backward pass, and of gradient slots at each moment of a step."""
    slots, states = blend_cuda.instance_bytes(sizes) if sizes.cuda else (FLOAT * VALUES * sizes.instances, 0)
    images = (COLORS + 2) * FLOAT * sizes.pixels  # colour, alpha, depth
    kept = 3 * FLOAT * sizes.pixels + states  # transmittance, weight, end
    lean = not (sizes.depth or sizes.cutout)  # only colour has a gradient
    upstream = (COLORS if lean else COLORS + 2) * FLOAT * sizes.pixels
    order = blend_cuda.order_bytes(sizes) if sizes.cuda else 0  # gone before the loss, which takes more
    whole = images + upstream if sizes.chunked else 0  # images of the frame exist beside those of a chunk
    return {
        BINNING: whole, LOSS: images + (0 if sizes.chunked else kept), BLENDING: kept + slots + images + (whole or upstream),
        PROJECTION: images + upstream, SAMPLING: 3 * images + order,
    }  # fmt: skip


SUMMED = 16
"""Number of Gaussians for which one task sums gradients."""


@functools.cache
def make_segments(real, values: int = VALUES, width: int = 9 + COLORS):
    """Make the kernels that sum the gradient slots of each Gaussian, always in slot order, so that sums repeat bit for bit.

    Args:
        real: wp.float32 or wp.float64.
        values: Number of values of a gradient.
        width: Number of values of a projected Gaussian; values without a gradient come last.
    """
    reals = wp.types.vector(values, real)
    record = wp.types.vector(width, real)
    lane_reals = wp.types.vector(SUMMED * values, real)
    count = wp.constant(values)
    lanes = wp.constant(SUMMED)

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def sum_gradients(
        begin: int, v_slots: wp.array(dtype=reals), starts: wp.array(dtype=int), counts: wp.array(dtype=int),
        # outputs
        v_projected: wp.array(dtype=record),
    ):  # fmt: skip
        first = (begin + wp.tid()) * lanes
        used = wp.min(lanes, starts.shape[0] - first)
        totals = lane_reals()
        for lane in range(lanes):  # the first slots in a loop of their own, so that many loads are under way at once
            if lane < used and counts[first + lane] > 0:
                v = v_slots[starts[first + lane]]
                for k in range(wp.static(values)):
                    totals[lane * count + k] = v[k]
        for lane in range(used):
            i = first + lane
            total = record()
            for k in range(wp.static(values)):
                total[k] = totals[lane * count + k]
            for later in range(1, counts[i]):  # without slots, starts are undefined
                v = v_slots[starts[i] + later]
                for k in range(wp.static(values)):
                    total[k] += v[k]
            v_projected[i] = total

    @wp.kernel(enable_backward=False, module=f"warpgs.kernels.blend.{real.__name__}.{values}")
    def gather_weights(
        begin: int, weights: wp.array2d(dtype=real), starts: wp.array(dtype=int), counts: wp.array(dtype=int),
        # outputs
        sums: wp.array(dtype=real), maxima: wp.array(dtype=real),
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


def is_native(projected: torch.Tensor) -> bool:
    """Return whether the CUDA kernels apply to projected Gaussians [C, N, 9 + D]; otherwise the generic kernels do."""
    return projected.is_cuda and projected.dtype == torch.float32


def _launch(kernel, tiles: int, inputs: list, device: torch.device) -> None:
    """Launch a generic kernel, one task per tile."""
    interop.launch(kernel, tiles, inputs, device, cost=10_000, block_dim=32)


def tile_inputs(projected: torch.Tensor, tiles: Tiles, real) -> list[interop.View]:
    """Return the inputs of the generic kernels: projected Gaussians [C, N, 9 + D], and the instances of each tile."""
    return [
        interop.rows(projected, real),
        interop.view(tiles.ranges, wp.int32),
        interop.view(tiles.gaussian_ids, wp.int32),
    ]


def _span(image: torch.Tensor, real) -> tuple[interop.View, int]:
    """Return an image [C, H, W, D], which may be a slice of channels, as one axis, and the stride of its pixels."""
    found = interop.span(image, real)
    return found, found.row_stride()


def composite(
    projected: torch.Tensor,
    tiles: Tiles,
    backgrounds: torch.Tensor,
    settings: BlendSettings,
    *,
    save: bool,
    allocator: Allocator = TORCH,
    image: torch.Tensor | None = None,
) -> tuple[torch.Tensor, ...]:
    """Return the images, and the data for the backward pass. Nothing is checked, and no gradient is recorded.

    Args:
        projected: Projected Gaussians, contiguous, shape [C, N, 9 + D]. D is one of `WIDTHS`: 3 channels of a colour, or more
            channels instead.
        tiles: Their (Gaussian, tile) instances.
        backgrounds: Channels behind everything, contiguous, shape [C, D].
        settings: Settings.
        save: True where gradients will be taken.
        allocator: Provider of the results' memory.
        image: Memory of the channels, shape [C, H, W, D]; it may be a slice of the channels of an image. On CUDA in float32 it
            may have fewer than D channels: then only the first ones are written. None for new memory.

    Returns:
        ``rgb`` [C, H, W, D], or ``image``; ``alpha``, ``depth``, transmittances and weight sums [C, H, W]; the index after that
        of the last blended instance [C, H, W]; states of the chunks (CUDA in float32 only, else empty). Without ``save``,
        transmittances and weight sums may be empty.
    """
    if is_native(projected):
        return blend_cuda.forward(projected, tiles, backgrounds, settings, save=save, allocator=allocator, image=image)
    real, device = interop.real_of(projected), projected.device
    cameras, channels = backgrounds.shape
    shape = (cameras, settings.height, settings.width)
    rgb = allocator.output((*shape, channels), projected.dtype, device) if image is None else image
    alpha, depth = (allocator.output(shape, projected.dtype, device) for _ in range(2))
    transmittances, weights = (allocator.saved(shape, projected.dtype, device) for _ in range(2))
    ends = allocator.saved(shape, torch.int32, device)
    inputs = [
        settings.struct(tiles.size, real), *tile_inputs(projected, tiles, wp.types.vector(9 + channels, real)),
        interop.view(backgrounds, real), *_span(rgb, real),
        *(interop.flat(t, real) for t in (alpha, depth, transmittances, weights)),
        interop.flat(ends, wp.int32),
    ]  # fmt: skip
    _launch(blend_cpu.make_kernels(real, tiles.size, channels).forward, len(tiles.ranges), inputs, device)
    return rgb, alpha, depth, transmittances, weights, ends, allocator.saved((0,), projected.dtype, device)


def _backward(projected, tiles, backgrounds, settings: BlendSettings, saved, v_images, allocator) -> torch.Tensor:
    """Return what `blend_cuda.backward` returns, by the generic kernels."""
    _, depth, transmittances, weights, ends, _ = saved
    v_rgb, v_alpha, v_depth = v_images
    real, device, channels = interop.real_of(projected), projected.device, backgrounds.shape[1]
    values = VALUES + channels - COLORS + 2 * settings.absgrad
    v_projected = allocator.output(projected.shape, projected.dtype, device)
    v_slots = allocator.workspace((len(tiles.slots), values), projected.dtype, device).zero_()
    deep = v_alpha is not None or v_depth is not None
    upstream: list = [*_span(v_rgb, real)]
    for v in (v_alpha, v_depth):
        v = (torch.zeros_like(depth) if deep else depth.new_empty(0)) if v is None else v.contiguous()
        upstream.append(interop.flat(v, real))
    record = wp.types.vector(projected.shape[-1], real)
    inputs = [
        settings.struct(tiles.size, real), *tile_inputs(projected, tiles, record), interop.view(tiles.slots, wp.int32),
        interop.view(backgrounds, real),
        *(interop.flat(t, real) for t in (transmittances, weights, depth)), interop.flat(ends, wp.int32),
        *upstream, interop.view(v_slots, real),
    ]  # fmt: skip
    kernels = blend_cpu.make_kernels(real, tiles.size, channels, settings.absgrad, deep)
    _launch(kernels.backward, len(tiles.ranges), inputs, device)
    inputs = [
        interop.rows(v_slots, wp.types.vector(values, real)), interop.view(tiles.starts, wp.int32),
        interop.view(tiles.counts, wp.int32), interop.rows(v_projected, record),
    ]  # fmt: skip
    tasks, kernel = -(-len(tiles.counts) // SUMMED), make_segments(real, values, projected.shape[-1]).sum_gradients
    interop.launch(kernel, tasks, inputs, device, cost=5 * SUMMED)
    return v_projected


def composite_gradients(
    projected: torch.Tensor,
    tiles: Tiles,
    backgrounds: torch.Tensor,
    settings: BlendSettings,
    saved: Sequence[torch.Tensor],
    v_images: Sequence[torch.Tensor | None],
    allocator: Allocator = TORCH,
) -> torch.Tensor:
    """Return the gradient of ``projected``, shape [C, N, 9 + D]. Nothing is checked.

    Args:
        projected: Projected Gaussians as given to `composite`, shape [C, N, 9 + D].
        tiles: Their tiles.
        backgrounds: Channels behind everything, shape [C, D].
        settings: Settings as given to `composite`.
        saved: Results of `composite` without ``alpha``. Only those channels of ``rgb`` are read that have a gradient in
            ``v_images``.
        v_images: Gradients of ``rgb`` [C, H, W, D], ``alpha`` and ``depth`` [C, H, W], each of which may be None. The gradient
            of ``rgb`` may be a slice of channels of an image. On CUDA in float32 it may have fewer than D channels; the other
            channels have gradient 0.
        allocator: Provider of the gradient's memory.
    """
    v_rgb, v_alpha, v_depth = v_images
    v_rgb = saved[0].new_zeros(*saved[0].shape[:-1], backgrounds.shape[1]) if v_rgb is None else v_rgb
    backward = blend_cuda.backward if is_native(projected) else _backward
    return backward(projected, tiles, backgrounds, settings, saved, (v_rgb, v_alpha, v_depth), allocator)


def background_gradient(transmittances: torch.Tensor, v_rgb: torch.Tensor | None, channels: int = 3) -> torch.Tensor:
    """Return the gradient of the backgrounds, shape [C, D] with D ``channels``; zeros if ``v_rgb`` is None."""
    # a product of matrices would sum the pixels one by one, and err several times as much
    if v_rgb is None:
        return transmittances.new_zeros(len(transmittances), channels)
    return torch.stack([(transmittances * v_rgb[..., k]).sum((1, 2)) for k in range(channels)], 1)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, projected, backgrounds, tiles, settings):
        projected, backgrounds = projected.contiguous(), backgrounds.contiguous()
        save = any(ctx.needs_input_grad)
        if save:
            check_slots(tiles)
        rgb, alpha, depth, *rest = composite(projected, tiles, backgrounds, settings, save=save)
        if save:
            # all as saved tensors, which are freed after the backward pass
            keep(ctx, projected, backgrounds, rgb, depth, *rest, *tiles.tensors())
            ctx.tile_size, ctx.settings = tiles.size, settings
        ctx.set_materialize_grads(False)
        return rgb, alpha, depth

    @staticmethod
    @first_order
    def backward(ctx, *v_images):
        projected, backgrounds, *tensors = kept(ctx)
        saved, tiles = tensors[:6], Tiles(ctx.tile_size, *tensors[6:])
        v_images = [None if v is None else v.contiguous() for v in v_images]
        v_projected = composite_gradients(projected, tiles, backgrounds, ctx.settings, saved, v_images)
        v_backgrounds = background_gradient(saved[2], v_images[0]) if ctx.needs_input_grad[1] else None
        return v_projected, v_backgrounds, None, None


def without_gradients(*tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Return tensors of any shape [...], detached if autograd is off: leaf tensors would otherwise still require gradients."""
    return tensors if torch.is_grad_enabled() else tuple(t.detach() for t in tensors)


def check_slots(tiles: Tiles) -> None:
    """Check that the tiles were made with slots, which gradients need.

    Raises:
        ValueError: The tiles have no slots.
    """
    if len(tiles.slots) != len(tiles.gaussian_ids):
        raise ValueError("gradients and contributions need tiles with slots: make the tiles with bin_tiles(slotted=True)")


def check_tiles(projected: torch.Tensor, tiles: Tiles, width: int, height: int, **backgrounds) -> None:
    """Check that tiles were made for an image of ``width`` x ``height`` px and for projected Gaussians [C, N, 12].

    Raises:
        TypeError: A scalar type is neither float32 nor float64, or scalar types differ.
        ValueError: A shape or device is wrong, or the tiles belong to another image size.
    """
    sizes = interop.check(projected=(projected, "C N 12"), **backgrounds)
    columns, rows = grid(width, height, tiles.size)
    if len(tiles.ranges) != sizes["C"] * columns * rows:
        raise ValueError(
            f"tiles were made for another image: found {len(tiles.ranges)} tiles, but {sizes['C']} images of {width} x "
            f"{height} px have {sizes['C'] * columns * rows} tiles of {tiles.size} px"
        )


def blend(
    projected: torch.Tensor,
    tiles: Tiles,
    backgrounds: torch.Tensor,
    *,
    width: int,
    height: int,
    rule: Rule,
    deterministic: bool = True,
    origin: tuple[int, int] = (0, 0),
    absgrad: bool = False,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Composite C images of H x W pixels (Kerbl et al. 2023, eq. 3), with the cut-offs of ``rule``.

    Differentiable in the first ten values of each projected Gaussian and in ``backgrounds``; a clamped alpha has gradient zero.
    Derivation of the backward pass: docs/blend.md. Images repeat bit for bit, on CUDA and on any number of CPU threads;
    gradients repeat if ``deterministic`` is True.

    Args:
        projected: Projected Gaussians of `project`, shape [C, N, 12].
        tiles: Result of `bin_tiles` for the same image size.
        backgrounds: Colour behind everything, shape [C, 3].
        width: Image width [px].
        height: Image height [px].
        rule: Cut-offs.
        deterministic: True to sum gradients in a fixed order. False adds them atomically on CUDA in float32, which needs less
            memory but is not repeatable to the bit; elsewhere it has no effect.
        origin: Left and top [px] of the window that the tiles were made for.
        absgrad: True to also sum magnitudes of the mean's gradient over pixels. The sums take the place of the gradient of the
            last two values of ``projected``, the half sides of the box.

    Returns:
        ``rgb`` [C, H, W, 3]; ``alpha`` [C, H, W], accumulated opacity; ``depth`` [C, H, W], the mean depth [u] under the
        blending weights (z; the distance for a fisheye), 0 where the weights sum to less than `SMALLEST_WEIGHT`.

    Raises:
        TypeError: A scalar type is neither float32 nor float64, or scalar types differ.
        ValueError: A shape or device is wrong, or the tiles belong to another image size or lack the slots for gradients.
    """
    check_tiles(projected, tiles, width, height, backgrounds=(backgrounds, "C 3"))
    settings = BlendSettings(origin, width, height, rule, deterministic, absgrad)
    return _Blend.apply(*without_gradients(projected, backgrounds), tiles, settings)


def contributions(
    projected: torch.Tensor, tiles: Tiles, *, width: int, height: int, rule: Rule, origin: tuple[int, int] = (0, 0)
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return for each Gaussian and image the sum and maximum of its blending weights alpha * T over pixels. Not differentiable.

    Args:
        projected: Projected Gaussians of `project`, shape [C, N, 12].
        tiles: Result of `bin_tiles` for the same image size.
        width: Image width [px].
        height: Image height [px].
        rule: Cut-offs.
        origin: Left and top [px] of the window that the tiles were made for.

    Returns:
        ``weight_sums`` [C, N] and ``weight_maxima`` [C, N].

    Raises:
        TypeError: The scalar type is neither float32 nor float64.
        ValueError: A shape disagrees, or the tiles belong to another image size or have no slots.
    """
    check_tiles(projected, tiles, width, height)
    projected = projected.detach().contiguous()
    real, device = interop.real_of(projected), projected.device
    settings = BlendSettings(origin, width, height, rule)
    check_slots(tiles)
    ends = composite(projected, tiles, projected.new_zeros(len(projected), 3), settings, save=False)[5]
    if is_native(projected):
        weights = blend_cuda.instance_weights(projected, tiles, settings, ends)
    else:
        weights = projected.new_zeros(len(tiles.slots), 2)
        inputs = [
            settings.struct(tiles.size, real), *tile_inputs(projected, tiles, real), interop.view(tiles.slots, wp.int32),
            interop.flat(ends, wp.int32), interop.view(weights, real),
        ]  # fmt: skip
        _launch(blend_cpu.make_kernels(real, tiles.size).contributions, len(tiles.ranges), inputs, device)
    sums, maxima = projected.new_empty(projected.shape[:2]), projected.new_empty(projected.shape[:2])
    inputs = [
        interop.view(weights, real), interop.view(tiles.starts, wp.int32), interop.view(tiles.counts, wp.int32),
        interop.flat(sums, real), interop.flat(maxima, real),
    ]  # fmt: skip
    interop.launch(make_segments(real).gather_weights, len(tiles.counts), inputs, device)
    return sums, maxima
