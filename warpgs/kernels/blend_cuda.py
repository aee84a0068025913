"""Blending kernels for CUDA in float32, with native bodies. Warps own 8 x 4 blocks of pixels, and sum gradients in chunks.

Warp has no shuffles, no ballots and no 16-byte loads, so the bodies are CUDA. They compute what the generic kernels of
blend_cpu.py compute (docs/blend.md); tests compare both.
"""

import functools
from collections.abc import Sequence
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.constants import LARGEST_HALF, SMALLEST_WEIGHT, TILE_SIZE
from warpgs.device import FLOAT, StepSizes
from warpgs.kernels import launch
from warpgs.kernels.falloff import COLORS, LARGEST_STOP, Pass, make_struct
from warpgs.kernels.graphs import TORCH, Allocator
from warpgs.kernels.native import SCALE, FloatRows, Floats, Ints, Longs, cuda_kernel, source
from warpgs.kernels.tiles import RECORD_SIZE, Tiles, grid

CHUNKS = (64, 128, 256)
"""Instances for one warp of the backward pass, multiples of 32. Small images use the first number, to have enough warps. Larger
images use the next numbers, to load the pixels less often and to save fewer states. The forward pass saves the state of every
pixel at each multiple of the number in use, so that several warps can share a long list."""
MAX_TILES = (4096, 16384)
"""Numbers of tiles up to which the first and the second of `CHUNKS` are used (docs/decisions/005-cuda-blending.md)."""
STATE = 5
"""Floats of a saved state with three channels: transmittance, colour and depth sum. One more for each further channel."""
WARPS = 2
"""Independent warps in a block."""
LARGE_GAUSSIAN = 8
"""Mean number of tiles per visible Gaussian at which a warp of the forward pass takes two blocks of pixels instead of one. This
halves the instances that are loaded and tested; few instances touch only one block (docs/decisions/005-cuda-blending.md)."""
LARGE_IMAGE, LARGE_TILE = 2**22, 32
"""Pixels above which images with `Pass.max_error` have large tiles, and the side of these [px]."""
RANKS = 33
"""Number of ranks of tiles; the rank of a tile is the number of bits of its list's length, 0 to 32."""
ORDER_THREADS = 256
"""Threads of a block of the kernel that puts tiles in order."""
STRIDE = 12
"""Stride of the sums of an instance, in floats, with three channels: the size of a projected Gaussian, so that rows are
16-byte aligned. There are at most twelve sums: two along the rows of the factor, three for the factor, opacity, colour, depth,
and two of magnitudes. Each further channel adds one."""


def _source(name: str, tile_size: int, channels: int, **numbers) -> str:
    """Return the CUDA text of one body."""
    more = channels - COLORS
    shared = {"SIDE": tile_size, "SCALE": SCALE, "WARPS": WARPS}
    shared |= {"CHANNELS": channels, "STATE": STATE + more, "STRIDE": STRIDE + more}
    shared["SMALLEST_WEIGHT"] = f"{SMALLEST_WEIGHT}f"
    return source(f"blend_{name}.cu", **shared | numbers)


@functools.cache
def make_forward(tile_size: int, save: bool, per: int, channels: int = COLORS, packed: bool = False):
    """Make the compositing kernel; a warp composites ``per`` blocks of 8 x 4 px, 1 or 2, which does not change the image."""
    # Images and projected Gaussians are flat arrays. Arrays with a row per instance have two axes, since a flat one could be
    # too long for 32-bit sizes.
    Blending = make_struct(wp.float32)

    numbers = {"SAVE": str(save).lower(), "PER": per, "PACKED": str(packed).lower()}
    numbers |= {"LARGEST_HALF": f"{LARGEST_HALF}f", "LARGEST_STOP": f"{LARGEST_STOP}f"}
    numbers |= {"STRIDE": RECORD_SIZE} if packed else {}
    module = f"warpgs.kernels.blend_cuda.forward.{tile_size}.{int(save)}.{per}.{channels}{'.packed' * packed}"

    @cuda_kernel(_source("forward", tile_size, channels, **numbers), "wp.tid() // 32", module)
    def forward(
        item: int, settings: Blending, chunk: int, projected: Floats, counts: Ints, order: Ints, ranges: Ints,
        gaussian_ids: Ints, backgrounds: Floats, max_error: float, rounding: float,
        # outputs
        rgb: FloatRows, alpha_out: Floats, depth: Floats, transmittances: Floats, weights: Floats, ends: Ints,
        states: FloatRows, bounds: Floats,
    ): ...  # fmt: skip

    return forward


@functools.cache
def make_kernels(tile_size: int):
    """Make the kernels that order tiles and find contributions, for one tile size."""
    Blending = make_struct(wp.float32)

    module = f"warpgs.kernels.blend_cuda.{tile_size}"

    @cuda_kernel(source("blend_order.cu", RANKS=RANKS), "begin + wp.tid()", module)
    def order_tiles(
        tile: int, ranges: Ints, count: int,
        # outputs; counts are zero on entry
        counts: Ints, order: Ints,
    ): ...  # fmt: skip

    @cuda_kernel(_source("contributions", tile_size, COLORS), f"wp.tid() // {tile_size * tile_size}", module)
    def contributions(
        tile: int, settings: Blending, projected: Floats, ranges: Ints, gaussian_ids: Ints, slots: Ints, ends: Ints,
        # outputs, zero on entry
        instance_weights: Floats,
    ): ...  # fmt: skip

    return SimpleNamespace(order_tiles=order_tiles, contributions=contributions)


def _flags(with_depth: bool, atomic: bool, absgrad: bool) -> dict[str, str]:
    """Return the switches of the backward bodies as CUDA text, by name."""
    flags = {"WITH_DEPTH": with_depth, "ATOMIC": atomic, "ABSGRAD": absgrad}
    return {name: str(flag).lower() for name, flag in flags.items()}


@functools.cache
def make_gather(tile_size: int, with_depth: bool, atomic: bool, channels: int = COLORS, absgrad: bool = False):
    """Make the kernel that sums the gradients of each Gaussian's instances, which `make_backward` computes."""
    # Not in the module of `make_backward`: its blocks have another size, and Warp compiles a module anew for each size.
    name = f"warpgs.kernels.blend_cuda.gather.{tile_size}.{int(with_depth)}.{int(atomic)}.{channels}" + ".absgrad" * absgrad

    @cuda_kernel(_source("gather", tile_size, channels, **_flags(with_depth, atomic, absgrad)), "wp.tid()", name)
    def gather(
        i: int, projected: Floats, starts: Ints, counts: Ints, v_slots: FloatRows,
        # outputs
        v_projected: Floats,
    ): ...  # fmt: skip

    return gather


@functools.cache
def make_backward(tile_size: int, with_depth: bool, chunk: int, atomic: bool, channels: int = COLORS, absgrad: bool = False):
    """Make the backward kernels: sums per instance, then per Gaussian (or ``atomic`` additions, in no fixed order)."""
    Blending = make_struct(wp.float32)
    numbers = {"CHUNK": chunk, **_flags(with_depth, atomic, absgrad)}

    name = f"warpgs.kernels.blend_cuda.backward.{tile_size}.{int(with_depth)}.{chunk}.{int(atomic)}.{channels}"
    name += ".absgrad" * absgrad
    # for many chunks, many warps at a time matter more than registers, unless channels fill the registers
    small = chunk > CHUNKS[0] and not (with_depth or absgrad) and channels == COLORS
    registers = {"cuda_max_registers": 80} if small else {"launch_bounds": 32 * WARPS}

    @cuda_kernel(_source("backward", tile_size, channels, **numbers), "wp.tid() // 32", name, **registers)
    def backward(
        item: int, settings: Blending, capacity: int, no_tile: int, projected: Floats, keys: Ints, ranges: Ints,
        gaussian_ids: Ints, slots: Ints, totals: Longs, backgrounds: Floats, rgb: FloatRows, depth: Floats,
        transmittances: Floats, weights: Floats, ends: Ints, states: FloatRows, v_rgb: FloatRows, v_alpha: Floats,
        v_depth: Floats,
        # outputs
        v_slots: FloatRows,
    ): ...  # fmt: skip

    return SimpleNamespace(backward=backward, gather=make_gather(tile_size, with_depth, atomic, channels, absgrad))


def chunk_of(tiles: int, deterministic: bool) -> int:
    """Return the instances per chunk: more for larger images, and at least CHUNKS[1] if sums have no fixed order."""
    larger = sum(tiles > most for most in MAX_TILES)
    return CHUNKS[larger if deterministic else max(larger, 1)]


def step_bytes(sizes: StepSizes) -> tuple[int, int, int]:
    """Return the bytes of a step's gradient slots, of the states for the backward pass, and of the tile order."""
    columns, rows = grid(sizes.width, sizes.height, TILE_SIZE)
    state = FLOAT * STATE * TILE_SIZE * TILE_SIZE // chunk_of(0 if sizes.chunked else columns * rows, True)
    return FLOAT * STRIDE * sizes.instances, state * sizes.instances, FLOAT * RANKS * columns * rows


def image_tile(settings: Pass) -> int:
    """Return the side of the tiles [px] for an image with `Pass.max_error`: larger for large images, with fewer instances."""
    x, y, width, height = settings.window
    large = width * height > LARGE_IMAGE and x % LARGE_TILE == y % LARGE_TILE == 0
    return LARGE_TILE if large else settings.tile_size


def forward(
    projected: torch.Tensor, tiles: Tiles, backgrounds: torch.Tensor, settings: Pass, *, save: bool,
    allocator: Allocator = TORCH, image: torch.Tensor | None = None,
) -> tuple[torch.Tensor, ...]:  # fmt: skip
    """Return what `blend.composite` returns; states [S, P] have a row for each chunk of instances."""
    device, channels, packed = projected.device, backgrounds.shape[1], tiles.packed is not None
    shape = (backgrounds.shape[0], *settings.window[:1:-1])
    rgb = allocator.output((*shape, channels), torch.float32, device) if image is None else image
    alpha, depth = (allocator.output(shape, torch.float32, device) for _ in range(2))
    transmittances, weights = allocator.saved((2, *(shape if save else (0,))), torch.float32, device).unbind()
    ends = allocator.saved((0,) if packed else shape, torch.int32, device)
    bounds = allocator.output(shape[:1], torch.float32, device) if packed else weights
    pixels = tiles.size * tiles.size
    chunk = chunk_of(tiles.ranges.shape[0], settings.deterministic)
    rows, state = tiles.slots.shape[0] // chunk + 1 if save else 0, STATE + channels - COLORS
    states = allocator.saved((rows, state * pixels), torch.float32, device)
    k, count = make_kernels(tiles.size), tiles.ranges.shape[0]
    counts = allocator.workspace((RANKS,), torch.int32, device).zero_()
    order = allocator.workspace((RANKS, count), torch.int32, device)
    threads = -(-count // ORDER_THREADS) * ORDER_THREADS
    launch.launch(k.order_tiles, threads, [tiles.ranges, count, counts, order], device, block_dim=ORDER_THREADS)
    inputs = [
        settings.struct(tiles.size, wp.float32), chunk, projected if tiles.packed is None else tiles.packed, counts, order,
        tiles.ranges, tiles.gaussian_ids, backgrounds, settings.max_error, settings.rounding() if packed else 0.0,
        rgb, alpha, depth, transmittances, weights, ends, states, bounds,
    ]  # fmt: skip
    per = 2 if packed or tiles.gaussian_ids.shape[0] >= LARGE_GAUSSIAN * tiles.visible else 1
    kernel = make_forward(tiles.size, save, per, channels, packed)
    launch.launch(kernel, count * pixels // per, inputs, device, block_dim=32 * WARPS)
    return (rgb, alpha, depth, bounds) if packed else (rgb, alpha, depth, transmittances, weights, ends, states)


def backward(
    projected: torch.Tensor, tiles: Tiles, backgrounds: torch.Tensor, settings: Pass, saved: Sequence[torch.Tensor],
    v_images: Sequence[torch.Tensor | None], allocator: Allocator = TORCH,
) -> torch.Tensor:  # fmt: skip
    """Return the gradient of ``projected`` [C, N, 9 + D], from `forward`'s results except alpha; None is a zero gradient."""
    rgb, depth, transmittances, weights, ends, states = saved
    v_rgb, v_alpha, v_depth = v_images
    device, count, deterministic = projected.device, tiles.slots.shape[0], settings.deterministic
    with_depth = v_alpha is not None or v_depth is not None
    chunk = chunk_of(tiles.ranges.shape[0], deterministic)
    k = make_backward(tiles.size, with_depth, chunk, not deterministic, backgrounds.shape[1], settings.absgrad)
    if with_depth:
        v_alpha, v_depth = (torch.zeros_like(depth) if v is None else v.contiguous() for v in (v_alpha, v_depth))
    else:
        v_alpha = v_depth = depth  # never read
    v_projected = allocator.output(projected.shape, torch.float32, device)
    if deterministic:
        v_slots = allocator.workspace((count, projected.shape[2]), torch.float32, device)
    else:
        v_slots = v_projected.zero_().view(-1, projected.shape[2])
    inputs = [
        settings.struct(tiles.size, wp.float32), count, tiles.ranges.shape[0], projected,
        tiles.tile_ids, tiles.ranges, tiles.gaussian_ids, tiles.slots, tiles.total, backgrounds,
        rgb, depth, transmittances, weights, ends, states, v_rgb, v_alpha, v_depth, v_slots,
    ]  # fmt: skip
    launch.launch(k.backward, 32 * -(-count // chunk), inputs, device, block_dim=32 * WARPS)
    inputs = [projected, tiles.starts, tiles.counts, v_slots, v_projected]
    launch.launch(k.gather, -(-tiles.counts.shape[0] // 256) * 256, inputs, device)
    return v_projected


def instance_weights(projected: torch.Tensor, tiles: Tiles, settings: Pass, ends: torch.Tensor, weights: torch.Tensor) -> None:
    """Write sum and maximum of each instance's blending weight over its tile's pixels, in slot order, to ``weights`` [M, 2]."""
    inputs = [settings.struct(tiles.size, wp.float32), projected, tiles.ranges, tiles.gaussian_ids, tiles.slots, ends, weights]
    kernel, pixels = make_kernels(tiles.size).contributions, tiles.size * tiles.size
    launch.launch(kernel, tiles.ranges.shape[0] * pixels, inputs, projected.device, block_dim=pixels)
