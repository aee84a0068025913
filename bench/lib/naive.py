"""Naive blending in Warp, as a baseline: a thread per pixel, scalar code, float atomics.

The rule is `exact`, in float32. On a CPU Warp's atomics are plain additions, so kernels must be launched on one thread only.
"""

import functools

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from bench.lib.kernel_calls import bin_tiles, project
from warpgs.constants import RULES, Rule
from warpgs.kernels import launch
from warpgs.kernels.tiles import Tiles, grid
from warpgs.scene import Camera, Gaussians


@wp.func
def tile_of(i: wp.int32, width: wp.int32, height: wp.int32, columns: wp.int32, tiles: wp.int32, side: wp.int32):
    camera = i // (width * height)
    y = (i // width) % height
    return camera * tiles + (y // side) * columns + (i % width) // side


@functools.cache
def forward_kernel():
    """Return the kernel that blends, a thread per pixel."""

    @wp.kernel(enable_backward=False, module="bench.naive")
    def forward(
        projected: wp.array2d(dtype=float), ranges: wp.array2d(dtype=int), ids: wp.array(dtype=int),
        backgrounds: wp.array2d(dtype=float), width: int, height: int, columns: int, tiles: int, side: int,
        alpha_cut: float, alpha_max: float, stop: float,
        # outputs
        rgb: wp.array2d(dtype=float), transmittances: wp.array(dtype=float), ends: wp.array(dtype=int),
    ):  # fmt: skip
        i = wp.tid()
        x = float(i % width) + 0.5
        y = float((i // width) % height) + 0.5
        tile = tile_of(i, width, height, columns, tiles, side)
        t = float(1.0)
        red = float(0.0)
        green = float(0.0)
        blue = float(0.0)
        end = int(0)
        for k in range(ranges[tile, 0], ranges[tile, 1]):
            s = ids[k]
            dx = x - projected[s, 0]
            dy = y - projected[s, 1]
            e1 = projected[s, 2] * dx + projected[s, 3] * dy
            e2 = projected[s, 4] * dy
            alpha = wp.min(alpha_max, projected[s, 5] * wp.exp(-0.5 * (e1 * e1 + e2 * e2)))
            if alpha < alpha_cut:
                continue
            w = alpha * t
            red += w * projected[s, 6]
            green += w * projected[s, 7]
            blue += w * projected[s, 8]
            t = t * (1.0 - alpha)
            end = k + 1
            if t < stop:
                break
        camera = i // (width * height)
        rgb[i, 0] = red + t * backgrounds[camera, 0]
        rgb[i, 1] = green + t * backgrounds[camera, 1]
        rgb[i, 2] = blue + t * backgrounds[camera, 2]
        transmittances[i] = t
        ends[i] = end

    return forward


@functools.cache
def backward_kernel():
    """Return the kernel of the gradients, which are added by float atomics."""

    @wp.kernel(enable_backward=False, module="bench.naive.backward")
    def backward(
        projected: wp.array2d(dtype=float), ranges: wp.array2d(dtype=int), ids: wp.array(dtype=int),
        backgrounds: wp.array2d(dtype=float), width: int, height: int, columns: int, tiles: int, side: int,
        alpha_cut: float, alpha_max: float, transmittances: wp.array(dtype=float), ends: wp.array(dtype=int),
        v_rgb: wp.array2d(dtype=float),
        # outputs, zero on entry
        v_projected: wp.array2d(dtype=float),
    ):  # fmt: skip
        i = wp.tid()
        x = float(i % width) + 0.5
        y = float((i // width) % height) + 0.5
        tile = tile_of(i, width, height, columns, tiles, side)
        camera = i // (width * height)
        g0 = v_rgb[i, 0]
        g1 = v_rgb[i, 1]
        g2 = v_rgb[i, 2]
        t = transmittances[i]
        behind = t * (backgrounds[camera, 0] * g0 + backgrounds[camera, 1] * g1 + backgrounds[camera, 2] * g2)
        k = ends[i]
        while k > ranges[tile, 0]:
            k -= 1
            s = ids[k]
            dx = x - projected[s, 0]
            dy = y - projected[s, 1]
            e1 = projected[s, 2] * dx + projected[s, 3] * dy
            e2 = projected[s, 4] * dy
            g = wp.exp(-0.5 * (e1 * e1 + e2 * e2))
            alpha = wp.min(alpha_max, projected[s, 5] * g)
            if alpha < alpha_cut:
                continue
            t = t / (1.0 - alpha)
            w = alpha * t
            d = projected[s, 6] * g0 + projected[s, 7] * g1 + projected[s, 8] * g2
            v = t * d - behind / (1.0 - alpha)
            behind += w * d
            wp.atomic_add(v_projected, s, 6, w * g0)
            wp.atomic_add(v_projected, s, 7, w * g1)
            wp.atomic_add(v_projected, s, 8, w * g2)
            if projected[s, 5] * g <= alpha_max:
                v_e1 = -alpha * v * e1
                v_e2 = -alpha * v * e2
                wp.atomic_add(v_projected, s, 0, -projected[s, 2] * v_e1)
                wp.atomic_add(v_projected, s, 1, -projected[s, 3] * v_e1 - projected[s, 4] * v_e2)
                wp.atomic_add(v_projected, s, 2, v_e1 * dx)
                wp.atomic_add(v_projected, s, 3, v_e1 * dy)
                wp.atomic_add(v_projected, s, 4, v_e2 * dy)
                wp.atomic_add(v_projected, s, 5, v * g)

    return backward


class Naive:
    """The kernels bound to one set of inputs; colour only, neither alpha nor depth."""

    def __init__(
        self,
        projected: torch.Tensor,
        tiles: Tiles,
        backgrounds: torch.Tensor,
        width: int,
        height: int,
        rule: Rule,
    ):
        if not rule.inclusive_stop or rule.square_sigma:
            raise ValueError("the naive kernels know only the rule `exact`")
        cameras, pixels = len(backgrounds), len(backgrounds) * height * width
        self.projected, self.device, self.pixels = (
            projected.detach().contiguous(),
            wp.device_from_torch(projected.device),
            pixels,
        )
        self.rgb = projected.new_empty(cameras, height, width, 3)
        self.v_projected = torch.zeros_like(self.projected)
        transmittances = projected.new_empty(pixels)
        ends = torch.empty(pixels, dtype=torch.int32, device=projected.device)
        columns, rows = grid(width, height, tiles.size)
        self.inputs = [
            self.projected.view(-1, 12), tiles.ranges,
            tiles.gaussian_ids, backgrounds, width, height, columns,
            columns * rows, tiles.size, rule.alpha_cut, rule.alpha_max,
        ]  # fmt: skip
        self.stop, self.kept = rule.transmittance_stop, [transmittances, ends]
        self.state = [transmittances, ends]

    def _launch(self, kernel, inputs: list) -> None:
        inputs = [wp.from_torch(a) if isinstance(a, torch.Tensor) else a for a in inputs]
        with launch.stream_of(self.rgb.device):
            wp.launch(kernel, self.pixels, inputs=inputs, device=self.device, record_tape=False)

    def forward(self) -> torch.Tensor:
        """Return the image, shape [C, H, W, 3]."""
        outputs = [self.rgb.view(-1, 3), *self.state]
        self._launch(forward_kernel(), [*self.inputs, self.stop, *outputs])
        return self.rgb

    def backward(self, v_rgb: torch.Tensor) -> torch.Tensor:
        """Return the gradient of the records for an upstream gradient, shape [C, N, 12]; call `forward` first."""
        self.v_projected.zero_()
        arrays = [t.view(-1, t.shape[-1]) for t in (v_rgb.contiguous(), self.v_projected)]
        self._launch(backward_kernel(), [*self.inputs, *self.state, *arrays])
        return self.v_projected


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, projected, tiles, width, height):
        black = projected.new_zeros(len(projected), 3)
        ctx.naive = Naive(projected, tiles, black, width, height, RULES["exact"])
        return ctx.naive.forward()

    @staticmethod
    @once_differentiable
    def backward(ctx, v_rgb):
        return ctx.naive.backward(v_rgb), None, None, None


def _binned(gaussians: Gaussians, camera: Camera) -> tuple[torch.Tensor, Tiles]:
    size = {"width": camera.width, "height": camera.height}
    how = {"degree": gaussians.sh_degree, "rule": RULES["exact"]}
    projected, counts = project(*gaussians.tensors().values(), camera.viewmat, camera.K, **size, **how)
    return projected, bin_tiles(projected, counts, **size, rule=RULES["exact"])


def rasterize(gaussians: Gaussians, camera: Camera) -> torch.Tensor:
    """Return images [C, H, W, 3] of a batch of cameras over black: our projection and lists, the naive blending."""
    return _Blend.apply(*_binned(gaussians, camera), camera.width, camera.height)
