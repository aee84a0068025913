"""Backward pass of blending by buckets, a lane per Gaussian with the pixels streaming through: an experiment on CUDA.

It takes the arguments of the product's backward kernel (warpgs/kernels/blend_cuda.py) and leaves the same sums at the same
places; docs/decisions/005-cuda-blending.md says what it takes. Nothing in the product uses it.
"""

import functools
from pathlib import Path

import warp as wp

from warpgs.kernels import blend_cuda
from warpgs.kernels.blend_settings import make_struct
from warpgs.runtime.cuda_source import source

VALUES = 10
"""Sums of an instance."""
SIZES = (32, 64, 128)
"""Instances of a bucket: one, two or four Gaussians a lane. The forward pass must leave states at multiples of it."""


@functools.cache
def make_backward(tile_size: int, with_depth: bool, size: int, skip: bool):
    """The kernel for buckets of ``size`` instances: 32 or a multiple.

    Args:
        tile_size: Side of a tile [px].
        with_depth: With gradients of depth and alpha.
        size: Instances of a bucket, and distance of the states that it is given.
        skip: Leave out blocks of 8 x 4 pixels that none of the bucket's Gaussians touches.

    Raises:
        ValueError: The size is no positive multiple of 32.
    """
    if size % 32 != 0 or size <= 0:
        raise ValueError(f"size must be a multiple of 32, not {size}")
    Blending = make_struct(wp.float32)
    file = str(Path(__file__).with_name("bucket.cu"))  # an absolute path stands for itself
    numbers = {
        "SIDE": tile_size, "STATE": blend_cuda.STATE, "SCALE": blend_cuda.SCALE, "WARPS": blend_cuda.WARPS,
        "VALUES": VALUES, "STRIDE": blend_cuda.STRIDE,
        "PER": size // 32, "SKIP": str(skip).lower(), "WITH_DEPTH": str(with_depth).lower(),
    }  # fmt: skip

    @wp.func_native(source(file, **numbers))
    def bucket_body(
        item: int, settings: Blending, capacity: int, no_tile: int, projected: wp.array(dtype=float),
        keys: wp.array(dtype=int), ranges: wp.array(dtype=int), gaussian_ids: wp.array(dtype=int), slots: wp.array(dtype=int),
        totals: wp.array(dtype=wp.int64), backgrounds: wp.array(dtype=float),
        rgb: wp.array(dtype=float), depth: wp.array(dtype=float), transmittances: wp.array(dtype=float),
        weights: wp.array(dtype=float), ends: wp.array(dtype=int), states: wp.array2d(dtype=float),
        v_rgb: wp.array(dtype=float), v_alpha: wp.array(dtype=float), v_depth: wp.array(dtype=float),
        v_slots: wp.array2d(dtype=float),
    ): ...  # fmt: skip

    name = f"bench.experiments.bucket.{tile_size}.{int(with_depth)}.{size}.{int(skip)}"

    @wp.kernel(enable_backward=False, grid_stride=False, module=name, launch_bounds=32 * blend_cuda.WARPS)
    def bucket(
        begin: int, settings: Blending, capacity: int, no_tile: int, projected: wp.array(dtype=float),
        keys: wp.array(dtype=int), ranges: wp.array(dtype=int), gaussian_ids: wp.array(dtype=int), slots: wp.array(dtype=int),
        totals: wp.array(dtype=wp.int64), backgrounds: wp.array(dtype=float),
        rgb: wp.array(dtype=float), depth: wp.array(dtype=float), transmittances: wp.array(dtype=float),
        weights: wp.array(dtype=float), ends: wp.array(dtype=int), states: wp.array2d(dtype=float),
        v_rgb: wp.array(dtype=float), v_alpha: wp.array(dtype=float), v_depth: wp.array(dtype=float),
        # outputs
        v_slots: wp.array2d(dtype=float),
    ):  # fmt: skip
        bucket_body(
            wp.tid() // 32, settings, capacity, no_tile, projected, keys, ranges, gaussian_ids, slots, totals, backgrounds,
            rgb, depth, transmittances, weights, ends, states, v_rgb, v_alpha, v_depth, v_slots,
        )  # fmt: skip

    return bucket
