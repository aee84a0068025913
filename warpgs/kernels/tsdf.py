"""Fusion of depth maps into a grid of truncated signed distances, and of images into colours of points.

The method of Curless and Levoy 1996 ("A Volumetric Method for Building Complex Models from Range Images"): a grid point keeps
the weighted mean of its truncated distances in front of the surface along the rays of all views. Nothing is
differentiable.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.constants import NEAR
from warpgs.geometry import check_pinhole
from warpgs.kernels import launch
from warpgs.scene import Camera


@functools.cache
def make_kernels(real):
    """Make the kernels for one scalar type."""
    vec3 = wp.types.vector(3, real)
    Reals, Rows = wp.array(dtype=real), wp.array2d(dtype=real)
    mat33, mat44 = (wp.types.matrix((n, n), real) for n in (3, 4))
    module = f"warpgs.kernels.tsdf.{real.__name__}"
    near = real(NEAR)

    @wp.func
    def least_slope(before: real, here: real, after: real) -> real:
        """Return the smaller of the two differences to the neighbours; 0 where neither has a depth."""
        back = here - before
        ahead = after - here
        has_before = before > real(0.0) and wp.isfinite(before)
        has_after = after > real(0.0) and wp.isfinite(after)
        if has_before and (not has_after or wp.abs(back) < wp.abs(ahead)):
            return back
        return wp.where(has_after, ahead, real(0.0))

    @wp.kernel(enable_backward=False, module=module)
    def face(
        begin: int, depth: Rows, Ks: wp.array(dtype=mat33),
        # outputs
        cosines: Rows,
    ):  # fmt: skip
        i = begin + wp.tid()
        K = Ks[0]
        row = i // depth.shape[1]
        column = i - row * depth.shape[1]
        z = depth[row, column]
        cosine = real(0.0)
        if z > real(0.0):
            cosine = real(1.0)
            if wp.isfinite(z):
                last_row = depth.shape[0] - 1
                last_column = depth.shape[1] - 1
                left = wp.where(column > 0, depth[row, wp.max(column - 1, 0)], real(0.0))
                right = wp.where(column < last_column, depth[row, wp.min(column + 1, last_column)], real(0.0))
                above = wp.where(row > 0, depth[wp.max(row - 1, 0), column], real(0.0))
                below = wp.where(row < last_row, depth[wp.min(row + 1, last_row), column], real(0.0))
                along = least_slope(left, z, right)
                down = least_slope(above, z, below)
                x = real(column) + real(0.5) - K[0, 2]
                y = real(row) + real(0.5) - K[1, 2]
                # The normal of the surface z(x, y) in the camera; its product with the ray through the pixel is -z.
                normal = vec3(K[0, 0] * along, K[1, 1] * down, -(z + x * along + y * down))
                ray = vec3(x / K[0, 0], y / K[1, 1], real(1.0))
                cosine = z / (wp.length(normal) * wp.length(ray))
        cosines[row, column] = cosine

    @wp.func
    def depth_at(depth: Rows, u: real, v: real, row: wp.int32, column: wp.int32, most: real) -> real:
        """Return the depth interpolated between four pixels where they show one surface, else that of the pixel itself."""
        nearest = depth[row, column]
        left = int(wp.floor(u - real(0.5)))
        top = int(wp.floor(v - real(0.5)))
        if left < 0 or top < 0 or left + 1 >= depth.shape[1] or top + 1 >= depth.shape[0]:
            return nearest
        a = depth[top, left]
        b = depth[top, left + 1]
        c = depth[top + 1, left]
        d = depth[top + 1, left + 1]
        low = wp.min(wp.min(a, b), wp.min(c, d))
        high = wp.max(wp.max(a, b), wp.max(c, d))
        if not (low > real(0.0) and high - low < most):  # of infinite depths the difference is a NaN
            return nearest
        fx = u - real(0.5) - real(left)
        fy = v - real(0.5) - real(top)
        upper = a + fx * (b - a)
        return upper + fy * (c + fx * (d - c) - upper)

    @wp.kernel(enable_backward=False, module=module)
    def integrate(
        begin: int, origins: wp.array(dtype=vec3), voxel: real, truncation: real, size_y: int, size_z: int,
        viewmats: wp.array(dtype=mat44), Ks: wp.array(dtype=mat33), depth: Rows, pixel_weights: Rows,
        # outputs, read first
        distances: Reals, weights: Reals,
    ):  # fmt: skip
        i = begin + wp.tid()
        column_of_grid = i // size_z
        x = column_of_grid // size_y
        point = origins[0] + voxel * vec3(real(x), real(column_of_grid - x * size_y), real(i - column_of_grid * size_z))
        K = Ks[0]
        p = wp.transform_point(viewmats[0], point)
        if p[2] >= near:
            u = K[0, 0] * p[0] / p[2] + K[0, 2]
            v = K[1, 1] * p[1] / p[2] + K[1, 2]
            if u >= real(0.0) and v >= real(0.0) and u < real(depth.shape[1]) and v < real(depth.shape[0]):
                row = int(v)
                column = int(u)
                w = pixel_weights[row, column]
                distance = depth_at(depth, u, v, row, column, truncation) - p[2]
                if w > real(0.0) and distance >= -truncation:
                    value = wp.min(distance / truncation, real(1.0))
                    before = weights[i]
                    distances[i] = (distances[i] * before + value * w) / (before + w)
                    weights[i] = before + w

    @wp.kernel(enable_backward=False, module=module)
    def gather(
        begin: int, points: wp.array(dtype=vec3), most: real, viewmats: wp.array(dtype=mat44), Ks: wp.array(dtype=mat33),
        depth: Rows, pixel_weights: Rows, image: wp.array2d(dtype=vec3),
        # outputs, added to
        sums: wp.array(dtype=vec3), weights: Reals,
    ):  # fmt: skip
        i = begin + wp.tid()
        K = Ks[0]
        p = wp.transform_point(viewmats[0], points[i])
        if p[2] >= near:
            u = K[0, 0] * p[0] / p[2] + K[0, 2]
            v = K[1, 1] * p[1] / p[2] + K[1, 2]
            if u >= real(0.0) and v >= real(0.0) and u < real(depth.shape[1]) and v < real(depth.shape[0]):
                row = int(v)
                column = int(u)
                if wp.abs(depth_at(depth, u, v, row, column, most) - p[2]) < most:
                    left = wp.clamp(int(wp.floor(u - real(0.5))), 0, depth.shape[1] - 1)
                    top = wp.clamp(int(wp.floor(v - real(0.5))), 0, depth.shape[0] - 1)
                    right = wp.min(left + 1, depth.shape[1] - 1)
                    bottom = wp.min(top + 1, depth.shape[0] - 1)
                    fx = wp.clamp(u - real(0.5) - real(left), real(0.0), real(1.0))
                    fy = wp.clamp(v - real(0.5) - real(top), real(0.0), real(1.0))
                    upper = (real(1.0) - fx) * image[top, left] + fx * image[top, right]
                    lower = (real(1.0) - fx) * image[bottom, left] + fx * image[bottom, right]
                    w = pixel_weights[row, column]
                    sums[i] = sums[i] + w * ((real(1.0) - fy) * upper + fy * lower)
                    weights[i] = weights[i] + w

    return SimpleNamespace(face=face, integrate=integrate, gather=gather)


def _pose(camera: Camera, like: torch.Tensor) -> list[torch.Tensor]:
    """Return viewmat [1, 4, 4] and intrinsics [1, 3, 3] of a numpy camera, of the type and on the device of ``like`` [...]."""
    return [torch.as_tensor(a[None], dtype=like.dtype, device=like.device) for a in (camera.viewmat, camera.K)]


def face_cosines(depth: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Return the cosine of each pixel's ray with the surface's normal [H, W]; 1 where depth is infinite, 0 where unknown."""
    check_pinhole(camera)
    cosines = torch.empty_like(depth)
    inputs = [depth, _pose(camera, depth)[1], cosines]
    launch.launch(make_kernels(launch.real_of(depth)).face, depth.numel(), inputs, depth.device, cost=5)
    return cosines


def integrate(
    distances: torch.Tensor, weights: torch.Tensor, origin: tuple[float, float, float], voxel: float, truncation: float,
    camera: Camera, depth: torch.Tensor, pixel_weights: torch.Tensor,
) -> None:  # fmt: skip
    """Add one view's signed distances to a grid [X, Y, Z], except at points more than ``truncation`` [u] behind the surface."""
    # Distances are means in front of the surface divided by the truncation, in [-1, 1], undefined at weight 0; weights are the
    # sums over the views that saw the point. Both are changed in place.
    inputs = [
        depth.new_tensor([origin]), voxel, truncation, *distances.shape[1:], *_pose(camera, depth), depth, pixel_weights,
        distances, weights,
    ]  # fmt: skip
    launch.launch(make_kernels(launch.real_of(depth)).integrate, distances.numel(), inputs, depth.device, cost=3)


def gather_colors(
    points: torch.Tensor, tolerance: float, camera: Camera, depth: torch.Tensor, pixel_weights: torch.Tensor,
    image: torch.Tensor, sums: torch.Tensor, weights: torch.Tensor,
) -> None:  # fmt: skip
    """Add one view's weighted colours in place to the points [N, 3] on the surface that it sees, within ``tolerance`` [u]."""
    inputs = [points, tolerance, *_pose(camera, points), depth, pixel_weights, image, sums, weights]
    launch.launch(make_kernels(launch.real_of(points)).gather, len(points), inputs, points.device, cost=5)
