"""The roughness of a depth map, for the smoothness of rendered depth, and its gradient.

On a plane, inverse depth is a linear function of the pixel. So between two neighbours of depths z' and z'', a pixel of depth z
has the bend t = z/z' + z/z'' - 2 and the roughness e w min(|t|, bound), with the weight w of the pixel and e of its edge along
the row; and the same along the column. With s = e w sign(t), or 0 beyond the bound, the gradients by the three depths are
s (1/z' + 1/z''), -s z/z'^2 and -s z/z''^2. In torch, this would be a hundred small kernels; the gradient has the same bits.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from warpgs.kernels import launch
from warpgs.kernels.native import EXACT

MIN_ALPHA = 0.3
"""Opacity above which the depth of a pixel is used."""
BOUND = 0.1
"""Largest bend that counts; beyond it the gradient is 0."""


@functools.cache
def make_kernels(real):
    """Make the kernels, of one task per pixel, for one scalar type."""
    vec2 = wp.types.vector(2, real)
    Reals, Pairs = (wp.array(dtype=kind) for kind in (real, vec2))
    least_alpha, bound = real(MIN_ALPHA), real(BOUND)
    flags = {"fuse_fp": False, "cpu_compiler_flags": EXACT["cpu_compiler_flags"]}
    options = {"enable_backward": False, "module": "unique", "module_options": flags}

    @wp.func
    def place(i: int, width: int, count: int, axis: int) -> wp.vec3i:
        """Return the entries from a pixel to the next along an axis, its place on that axis, and the last place there."""
        if axis == 0:
            return wp.vec3i(1, i % width, width - 1)
        return wp.vec3i(width, i // width, count // width - 1)

    @wp.func
    def shown(alpha: Reals, mask: Reals, i: int) -> bool:
        """Return whether a pixel is opaque and unmasked; an opacity that is NaN is shown, so that it reaches the loss."""
        return not (alpha[i] <= least_alpha) and (mask.shape[0] == 0 or mask[i] > real(0.0))

    @wp.kernel(**options)
    def forward(
        begin: int, depth: Reals, alpha: Reals, rows: Reals, columns: Reals, weight: Reals, mask: Reals, width: int,
        # outputs
        roughness: Reals, slopes: Pairs,
    ):  # fmt: skip
        i = begin + wp.tid()
        rough = real(0.0)
        slope = vec2()
        for axis in range(2):
            p = place(i, width, depth.shape[0], axis)
            a = i - p[0]
            b = i + p[0]
            if p[1] > 0 and p[1] < p[2] and shown(alpha, mask, a) and shown(alpha, mask, i) and shown(alpha, mask, b):
                if axis == 0:
                    edge = rows[i - 2 * (i // width) - 1]  # without the pixels at the ends of rows
                else:
                    edge = columns[a]
                bend = depth[i] / depth[a] + depth[i] / depth[b] - real(2.0)
                size = wp.abs(bend)
                rough += wp.where(size > bound, bound, size) * edge * weight[i]  # a NaN stays one
                slope[axis] = wp.where(size > bound or size == real(0.0), real(0.0), wp.sign(bend) * edge)
        roughness[i] = rough
        slopes[i] = slope

    @wp.kernel(**options)
    def backward(
        begin: int, depth: Reals, slopes: Pairs, weight: Reals, v_roughness: Reals, width: int,
        # outputs
        v_depth: Reals,
    ):  # fmt: skip
        i = begin + wp.tid()
        z = depth[i]
        v = real(0.0)
        for axis in range(2):
            p = place(i, width, depth.shape[0], axis)
            for side in range(-1, 2):
                j = i + side * p[0]
                if p[1] + side >= 0 and p[1] + side <= p[2]:
                    s = v_roughness[j] * weight[j] * slopes[j][axis]
                    if s != real(0.0):  # else depths may be 0 or infinite
                        if side == 0:
                            v += s / depth[i - p[0]] + s / depth[i + p[0]]
                        else:
                            v += -s * (depth[j] / z / z)
        v_depth[i] = v

    return SimpleNamespace(forward=forward, backward=backward)


class _Roughness(torch.autograd.Function):
    @staticmethod
    def forward(ctx, depth, *others):
        depth, *others = (t.contiguous() for t in (depth, *others))
        rough, slopes = torch.empty_like(depth), depth.new_empty(*depth.shape, 2)
        inputs = [depth, *others, depth.shape[1], rough, slopes]
        launch.launch(make_kernels(launch.real_of(depth)).forward, depth.numel(), inputs, depth.device, cost=5)
        launch.keep(ctx, depth, slopes, others[3])
        return rough

    @staticmethod
    @launch.first_order
    def backward(ctx, v_roughness):
        depth, slopes, weight = launch.kept(ctx)
        v_depth = torch.empty_like(depth)
        inputs = [depth, slopes, weight, v_roughness.contiguous(), depth.shape[1], v_depth]
        launch.launch(make_kernels(launch.real_of(depth)).backward, depth.numel(), inputs, depth.device, cost=5)
        return v_depth, None, None, None, None, None


def roughness(depth: Tensor, alpha: Tensor, rows: Tensor, columns: Tensor, weight: Tensor, mask: Tensor | None) -> Tensor:
    """Return the roughness of each pixel [H, W]: of depth [u], by opacity, weight and mask [H, W].

    ``rows`` [H, W - 2] and ``columns`` [H - 2, W] weigh the edges between the two neighbours of a pixel. The gradient is by
    depth alone. The roughness is 0 along an axis at whose border a pixel is, or where it or a neighbour is hidden.
    """
    height, width = depth.shape
    launch.check(
        depth=(depth, "H W"), alpha=(alpha, "H W"), rows=(rows, f"H {max(0, width - 2)}"),
        columns=(columns, f"{max(0, height - 2)} W"), weight=(weight, "H W"),
    )  # fmt: skip
    shown = depth.new_empty(0) if mask is None else mask.to(depth.dtype)
    return _Roughness.apply(depth, alpha.detach(), rows, columns, weight, shown)
