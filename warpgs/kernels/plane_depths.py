"""Depths of a plane sweep on a CPU: the best plane of each pixel, and round trips through another view's depth.

Kernels use float64 and one task per pixel. No operations are fused, so depths are the same bits on any processor.
"""

from __future__ import annotations

import functools
import math
from types import SimpleNamespace

import numpy as np
import torch
import warp as wp

from warpgs import geometry
from warpgs.runtime import interop
from warpgs.scene import Camera

BEHIND = 1e-9
"""Ratio of a point's depth to its depth in the first view, up to which the point counts as behind a camera."""
STEP = 1e-3
"""Step of the central difference that gives the change of depth per pixel, as a fraction of the inverse depth."""


@functools.cache
def make_kernels():
    """Make the kernels."""
    real = wp.float64
    module = "warpgs.kernels.plane_depths"

    @wp.kernel(enable_backward=False, module=module)
    def best(
        begin: int, costs: wp.array2d(dtype=wp.int16), planes: int, first: real, step: real,
        # outputs
        inverses: wp.array(dtype=real),
    ):  # fmt: skip
        pixel = begin + wp.tid()
        lowest = int(costs[pixel, 0])
        k = int(0)
        for d in range(1, planes):
            cost = int(costs[pixel, d])
            if cost < lowest:
                lowest = cost
                k = d
        k = wp.clamp(k, 1, planes - 2)
        left = real(costs[pixel, k - 1])
        right = real(costs[pixel, k + 1])
        bend = left - real(2.0) * real(costs[pixel, k]) + right
        offset = real(0.0)
        if bend > real(0.0):  # costs are whole numbers
            offset = wp.clamp(real(0.5) * (left - right) / bend, real(-1.0), real(1.0))
        inverses[pixel] = first + (real(k) + offset) * step

    @wp.func
    def project(turn: wp.mat33d, shift: wp.vec3d, x: real, y: real, w: real) -> wp.vec3d:
        """Return the position of a pixel at inverse depth w in another view, and whether it is in front of that camera."""
        p = turn * wp.vec3d(x, y, real(1.0)) + w * shift
        ahead = p[2] > real(BEHIND)
        z = wp.where(ahead, p[2], real(1.0))
        return wp.vec3d(p[0] / z, p[1] / z, wp.where(ahead, real(1.0), real(0.0)))

    @wp.kernel(enable_backward=False, module=module)
    def check(
        begin: int, own: wp.array2d(dtype=real), found: wp.array2d(dtype=real), turn: wp.mat33d, shift: wp.vec3d,
        turn_back: wp.mat33d, shift_back: wp.vec3d, to_ray: wp.mat33d, center: wp.vec3d, most: real, cosine: real,
        # outputs
        sensitivity: wp.array2d(dtype=real), agrees: wp.array2d(dtype=wp.uint8),
    ):  # fmt: skip
        i = begin + wp.tid()
        row = i // own.shape[1]
        column = i - row * own.shape[1]
        x = real(column) + real(0.5)
        y = real(row) + real(0.5)
        w = own[row, column]
        good = int(0)
        there = project(turn, shift, x, y, w)
        if there[2] > real(0.0) and there[0] >= real(0.0) and there[1] >= real(0.0):
            if there[0] < real(found.shape[1]) and there[1] < real(found.shape[0]):
                back = project(turn_back, shift_back, there[0], there[1], found[int(there[1]), int(there[0])])
                distance = wp.vec3d(back[0] - x, back[1] - y, real(0.0))
                point = to_ray * wp.vec3d(x, y, real(1.0)) / w
                other = point - center
                apart = wp.dot(point, other) < cosine * wp.length(point) * wp.length(other)
                if apart and back[2] > real(0.0) and wp.length(distance) < most:
                    good = 1
        if good == 1:
            near = project(turn, shift, x, y, w + real(STEP) * w)
            far = project(turn, shift, x, y, w - real(STEP) * w)
            slide = wp.length(wp.vec3d(near[0] - far[0], near[1] - far[1], real(0.0)))
            if near[2] * far[2] > real(0.0):
                moved = real(2.0) * real(STEP) / w / slide  # dz = -dw / w^2
                sensitivity[row, column] = wp.min(sensitivity[row, column], moved)
        agrees[row, column] = wp.uint8(good)

    return SimpleNamespace(best=best, check=check)


def best_inverses(costs: torch.Tensor, inverses: np.ndarray) -> np.ndarray:
    """Return each pixel's inverse depth [1/u] of least cost, refined by a parabola through three costs, float64, shape [H, W].

    Args:
        costs: Integers, int16, shape [H, W, P] with P at least D.
        inverses: Inverse depths of the D planes, evenly spaced, at least three, shape [D].
    """
    height, width, padded = costs.shape
    found = torch.empty(height, width, dtype=torch.float64, device="cpu")
    inputs = [
        interop.view(costs.reshape(-1, padded), wp.int16), len(inverses), float(inverses[0]),
        float(inverses[1] - inverses[0]), interop.view(found.view(-1), wp.float64),
    ]  # fmt: skip
    interop.launch(make_kernels().best, height * width, inputs, costs.device, cost=max(1, len(inverses) // 10))
    return found.numpy()


def _between(first: Camera, second: Camera) -> tuple[wp.mat33d, wp.vec3d]:
    """Return the turn [3, 3] and shift [3] that map a pixel p = (x, y, 1) at inverse depth w to turn p + w shift."""
    rotation, translation = geometry.relative_pose(first, second)
    turn = geometry.matmul(geometry.matmul(second.K, rotation), geometry.inverse(first.K))
    return wp.mat33d(*turn.ravel()), wp.vec3d(*geometry.matmul(second.K, translation[:, None])[:, 0])


def check_round_trip(
    first: Camera, second: Camera, own: np.ndarray, found: np.ndarray, sensitivity: np.ndarray, *, most: float,
    min_parallax: float,
) -> np.ndarray:  # fmt: skip
    """Return a mask of the pixels with enough parallax to which a round trip through another view's depth leads back.

    Args:
        first: Camera of the view.
        second: Camera of the other view.
        own: Inverse depths of the view [1/u], float64, shape [H, W].
        found: Inverse depths of the other view [1/u], float64, at its size.
        sensitivity: Change of depth per pixel [u/px], float64, contiguous, shape [H, W]; lowered in place where this pair of
            views has a smaller value.
        most: Largest distance [px] between the pixel and the end of the round trip.
        min_parallax: Smallest angle between the two rays [deg].

    Returns:
        Mask, bool, shape [H, W].
    """
    agrees = torch.empty(own.shape, dtype=torch.uint8, device="cpu")
    rotation, translation = geometry.relative_pose(first, second)
    center = -geometry.matmul(rotation.T, translation[:, None])[:, 0]
    maps = [interop.view(torch.from_numpy(np.ascontiguousarray(a)), wp.float64) for a in (own, found, sensitivity)]
    inputs = [
        *maps[:2], *_between(first, second), *_between(second, first), wp.mat33d(*geometry.inverse(first.K).ravel()),
        wp.vec3d(*center), most, math.cos(math.radians(min_parallax)), maps[2], interop.view(agrees, wp.uint8),
    ]  # fmt: skip
    interop.launch(make_kernels().check, own.size, inputs, agrees.device, cost=5)
    return agrees.numpy().astype(bool)
