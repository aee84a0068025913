"""Median depth of binned Gaussians: where the transmittance of a pixel falls to one half.

This is a separate pass, so that `blend` does not become slower. The pass over a tile ends as soon as each pixel is half
covered. It computes alpha by the same operations as `blend`, so that both agree exactly on the Gaussian at which a pixel
becomes half covered.
"""

import functools

import torch
import warp as wp

from warpgs.constants import Rule
from warpgs.kernels.blend import check_tiles, tile_inputs
from warpgs.kernels.blend_cuda import SCALE
from warpgs.kernels.blend_settings import BlendSettings, make_struct
from warpgs.kernels.compiler import ROLLED
from warpgs.kernels.falloff import STRIP, make_functions
from warpgs.kernels.project_inputs import PROJECTED_SIZE
from warpgs.kernels.tiles import Tiles
from warpgs.runtime import interop
from warpgs.runtime.cuda_source import source


@functools.cache
def make_kernel(real, tile_size: int):
    """Make the generic kernel, one task per tile, for one scalar type and tile size."""
    f = make_functions(real)
    tile_reals = wp.types.vector(tile_size * tile_size, real)
    strip_reals = wp.types.vector(STRIP, real)
    side = wp.constant(tile_size)
    strip = wp.constant(STRIP)
    parts = wp.constant(tile_size // STRIP)
    half = wp.constant(real(0.5))

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def median(
        begin: int, settings: f.Blending, projected: wp.array2d(dtype=real), ranges: wp.array2d(dtype=int),
        gaussian_ids: wp.array(dtype=int),
        # outputs
        depths: wp.array(dtype=real),
    ):  # fmt: skip
        tile = begin + wp.tid()
        place = f.place_of(tile, side, settings)
        camera = place[0]
        left = place[1]
        top = place[2]
        rows = wp.min(side, settings.height - top)
        lanes = wp.min(side, settings.width - left)
        ramp = strip_reals()
        found = tile_reals()
        t = tile_reals()  # transmittance; 0 once a pixel is finished, and outside the image
        for row in range(rows):
            for lane in range(lanes):
                t[row * side + lane] = real(1.0)
        unfinished = rows * lanes
        instance = ranges[tile, 0]
        while instance < ranges[tile, 1] and unfinished > 0:
            i = gaussian_ids[instance]
            instance += 1
            u11 = projected[i, 2]
            bounds = f.bounds_of(
                projected[i, 0], projected[i, 1], u11, projected[i, 4], projected[i, 10], projected[i, 11], settings.whole_tiles
            )
            for lane in range(strip):
                ramp[lane] = f.apart(u11 * real(lane))
            for row in range(side):
                dy = real(settings.origin_y + top + row) + real(0.5) - projected[i, 1]
                e2 = projected[i, 4] * dy
                e12 = f.apart(projected[i, 3] * dy)
                e22 = f.apart(e2 * e2)
                for part in range(parts):
                    x = real(settings.origin_x + left + part * strip) + real(0.5)
                    start = f.apart(u11 * (x - projected[i, 0])) + e12
                    if f.reaches(start, u11, e22, bounds[0], bounds[1]):
                        for lane in range(strip):
                            p = row * side + part * strip + lane
                            e1 = start + ramp[lane]
                            alpha = wp.min(settings.alpha_max, projected[i, 5] * f.falloff(e1 * e1 + e22))
                            if alpha >= settings.alpha_cut and t[p] > real(0.0):
                                after = t[p] * (real(1.0) - alpha)
                                blended = settings.inclusive != 0 or after >= settings.stop
                                if blended and after <= half:
                                    found[p] = projected[i, 9]
                                finished = after <= half or after < settings.stop
                                t[p] = wp.where(finished, real(0.0), after)
                                unfinished -= wp.where(finished, 1, 0)
        for row in range(rows):
            for lane in range(lanes):
                depths[(camera * settings.height + top + row) * settings.width + left + lane] = found[row * side + lane]

    return median


@functools.cache
def make_native(tile_size: int):
    """Make the CUDA kernel in float32 for one tile size, a thread block per tile."""
    Blending = make_struct(wp.float32)

    @wp.func_native(source("median_depth.cu", SIDE=tile_size, SCALE=SCALE, STRIDE=PROJECTED_SIZE))
    def body(
        tile: int, settings: Blending, projected: wp.array(dtype=float), ranges: wp.array(dtype=int),
        gaussian_ids: wp.array(dtype=int), depths: wp.array(dtype=float),
    ): ...  # fmt: skip

    threads = wp.constant(tile_size * tile_size)

    @wp.kernel(enable_backward=False, grid_stride=False, module=f"warpgs.kernels.median_depth.{tile_size}")
    def median(
        begin: int, settings: Blending, projected: wp.array(dtype=float), ranges: wp.array(dtype=int),
        gaussian_ids: wp.array(dtype=int),
        # outputs
        depths: wp.array(dtype=float),
    ):  # fmt: skip
        body(
            wp.tid() // threads, settings, projected, ranges, gaussian_ids, depths,
        )  # fmt: skip

    return median


def median_depth(
    projected: torch.Tensor, tiles: Tiles, *, width: int, height: int, rule: Rule, origin: tuple[int, int] = (0, 0)
) -> torch.Tensor:
    """Return the depth of the Gaussian at which a pixel's transmittance falls to one half or below. Not differentiable.

    This is the weighted median of depth; the weights are those of blending, and the background has the rest. At an edge it does
    not mix both surfaces, unlike the mean depth of `blend`. A pixel has no median depth if its alpha in `blend` is below 1/2.
    Results repeat bit for bit with any number of threads.

    Args:
        projected: Projected Gaussians of `project`, shape [C, N, 12].
        tiles: Result of `bin_tiles` for the same image size.
        width: Image width [px].
        height: Image height [px].
        rule: Cut-offs.
        origin: Left and top [px] of the window that the tiles were made for.

    Returns:
        Depth of the Gaussian's mean [u] (z; the distance for a fisheye), 0 where alpha is below 1/2, shape [C, H, W].

    Raises:
        TypeError: The scalar type is neither float32 nor float64.
        ValueError: A shape disagrees, or the tiles belong to another image size.
    """
    check_tiles(projected, tiles, width, height)
    projected = projected.detach().contiguous()
    real, device = interop.real_of(projected), projected.device
    settings, count = BlendSettings(origin, width, height, rule), len(tiles.ranges)
    depths = projected.new_empty(len(projected), height, width)
    own, output = settings.struct(tiles.size, real), interop.flat(depths, real)
    native = projected.is_cuda and projected.dtype == torch.float32
    if native:
        lists = [interop.flat(t, wp.int32) for t in (tiles.ranges, tiles.gaussian_ids)]
        inputs, pixels = [own, interop.flat(projected, real), *lists, output], tiles.size * tiles.size
        interop.launch(make_native(tiles.size), count * pixels, inputs, device, block_dim=pixels)
        return depths
    inputs = [own, *tile_inputs(projected, tiles, real), output]
    interop.launch(make_kernel(real, tiles.size), count, inputs, device, cost=10_000, block_dim=32)
    return depths
