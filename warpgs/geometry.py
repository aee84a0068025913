"""Geometry: rotations, logit, projection and back-projection of points, the extent and focus of a set of cameras.

Functions that take tensors import torch when they are called, so that readers of scenes need not load it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from warpgs import lenses
from warpgs.errors import UsageError
from warpgs.scene import ActivatedGaussians, Camera, Gaussians

if TYPE_CHECKING:
    import torch


def logit(probability: float) -> float:
    """Return log(p / (1 - p)), the inverse of the sigmoid, for p in [0, 1]; infinite at both ends."""
    if probability in (0, 1):
        return math.copysign(math.inf, probability - 0.5)
    return math.log(probability / (1 - probability))


def rotation_matrices(quats: np.ndarray | torch.Tensor) -> np.ndarray | torch.Tensor:
    """Return the rotation matrices [..., 3, 3] of unit quaternions wxyz [..., 4], as numpy array or tensor like ``quats``."""
    w, x, y, z = (quats[..., i] for i in range(4))
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    if isinstance(quats, np.ndarray):
        return np.stack(entries, -1).reshape(*quats.shape[:-1], 3, 3)
    import torch

    return torch.stack(entries, -1).reshape(*quats.shape[:-1], 3, 3)


def quaternions(rotations: torch.Tensor) -> torch.Tensor:
    """Return unit quaternions wxyz [N, 4] of rotations [N, 3, 3], computed from the largest component to avoid cancellation."""
    import torch

    m = rotations
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    # row i is 4 q_i q
    outer = torch.stack([
        torch.stack([1 + xx + yy + zz, m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], 1),
        torch.stack([m[:, 2, 1] - m[:, 1, 2], 1 + xx - yy - zz, m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0]], 1),
        torch.stack([m[:, 0, 2] - m[:, 2, 0], m[:, 0, 1] + m[:, 1, 0], 1 - xx + yy - zz, m[:, 1, 2] + m[:, 2, 1]], 1),
        torch.stack([m[:, 1, 0] - m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1], 1 - xx - yy + zz], 1),
    ], 1)  # fmt: skip
    largest = outer.diagonal(dim1=1, dim2=2).argmax(1)
    return torch.nn.functional.normalize(outer[torch.arange(len(m), device=m.device), largest], dim=1)


def check_pinhole(camera: Camera) -> None:
    """Check that a camera is a pinhole, for code that assumes that straight lines stay straight.

    Raises:
        UsageError: The camera has another model.
    """
    if camera.model != "pinhole":
        raise UsageError(
            f"only pinhole cameras are supported here, not {camera.model!r}; read the scene with --lenses undistort, or "
            "undistort the images first"
        )


def pinhole_of(camera: Camera) -> Camera:
    """Return a pinhole camera with the same pose, K and size, and no distortion; it sees less than a wide fisheye.

    Raises:
        UsageError: The camera is orthographic, or its model is only supported by the kernels.
    """
    if camera.model not in lenses.CENTRAL:
        check_pinhole(camera)
    return replace(camera, model="pinhole", distortion=None) if camera.model != "pinhole" else camera


def matmul(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a [..., J] times b [J] or [J, K], with the same bits on every x86-64 processor.

    ``@`` calls BLAS; its kernels, and so the order of sums, depend on the processor.
    """
    return np.einsum("...j,j->..." if b.ndim == 1 else "...j,jk->...k", a, b)


def cofactors(m: np.ndarray) -> np.ndarray:
    """Return the cofactor matrix of m [3, 3]; the cofactor matrix of a rotation is the rotation itself."""
    a, b = m[[1, 2, 0]], m[[2, 0, 1]]  # row i is the cross product of the two others
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def inverse(m: np.ndarray) -> np.ndarray:
    """Return the inverse of m [3, 3] by its cofactors: LAPACK's kernels would depend on the processor (see `matmul`)."""
    c = cofactors(m)
    return c.T / (m[0] * c[0]).sum()


def nearest_rotation(m: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to m [3, 3], if det m > 0: its polar factor by Newton's method (Higham 1986)."""
    for _ in range(10):  # five steps suffice for a matrix that is orthogonal to 0.1; further steps change nothing
        c = cofactors(m)
        nearer = 0.5 * (m + c / (m[0] * c[0]).sum())
        if (nearer == m).all():
            break
        m = nearer
    return m


def relative_pose(first: Camera, second: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation [3, 3] and translation [3] from the axes of the first camera to those of the second."""
    rotation = matmul(second.viewmat[:3, :3], first.viewmat[:3, :3].T)
    return rotation, second.viewmat[:3, 3] - matmul(rotation, first.viewmat[:3, 3])


def project_points(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels [N, 2] (pixel centres at +0.5) and depths [N] [u] of world points [N, 3].

    Depths are those of a render: z, or for a fisheye the distance. Lenses other than a pinhole give depth 0 for points that
    they cannot see.

    Raises:
        UsageError: The camera model is only supported by the kernels.
    """
    in_camera = matmul(points, camera.viewmat[:3, :3].T) + camera.viewmat[:3, 3]
    z = in_camera[:, 2]
    if camera.model != "pinhole":
        with np.errstate(all="ignore"):
            plane = lenses.to_plane(camera.model, camera.distortion, in_camera)
            seen = np.isfinite(plane).all(1) & lenses.on_lens(camera.model, camera.distortion, in_camera)
        plane = np.where(seen[:, None], plane, 0) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
        return plane, np.where(seen, lenses.depth_of(camera.model, in_camera), 0)
    safe = np.where(z == 0, np.finfo(float).tiny, z)
    pixels = matmul(in_camera / safe[:, None], camera.K.T)
    return pixels[:, :2], z


def back_project(camera: Camera, pixels: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Return the world points [N, 3] at pixels [N, 2] (centres at +0.5) and depths [N] [u]; inverts `project_points`.

    A pixel that a lens does not reach gives NaN.

    Raises:
        UsageError: The camera model is only supported by the kernels.
    """
    if camera.model == "pinhole":
        homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
        in_camera = depths[:, None] * matmul(homogeneous, inverse(camera.K).T)
    else:
        plane = (pixels - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
        in_camera = _at_depth(camera, lenses.from_plane(camera.model, camera.distortion, plane), depths)
    return matmul(in_camera - camera.viewmat[:3, 3], camera.viewmat[:3, :3])


def back_project_tensors(camera: Camera, pixels: torch.Tensor, depths: torch.Tensor) -> torch.Tensor:
    """Return what `back_project` returns, from tensors and without a matrix product: R^T (d K^-1 [x y 1] - t) for a pinhole.

    A matrix product would load another library on CUDA. Only focal lengths and principal point of K are used, as in projection.

    Args:
        camera: A camera with float32 or float64 tensors, on the device of ``pixels`` and ``depths``.
        pixels: Positions (x, y) with centres at +0.5 [px], shape [S, 2].
        depths: Depths [u], shape [S].

    Returns:
        World points [u], shape [S, 3].

    Raises:
        UsageError: The camera model is only supported by the kernels.
    """
    import torch

    K, viewmat = camera.K, camera.viewmat
    if camera.model == "pinhole":
        x, y = ((pixels[:, i] - K[i, 2]) / K[i, i] * depths for i in range(2))
        in_camera = torch.stack([x, y, depths], 1)
    else:
        plane = torch.stack([(pixels[:, i] - K[i, 2]) / K[i, i] for i in range(2)], 1)
        in_camera = _at_depth(camera, lenses.from_plane(camera.model, camera.distortion, plane), depths)
    return ((in_camera - viewmat[:3, 3])[:, :, None] * viewmat[:3, :3]).sum(1)


def project_tensors(camera: Camera, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what `project_points` returns, from tensors and without a matrix product: pixels [S, 2] and depths [S] [u].

    For a point that the camera cannot see, the depth is at most 0 and the pixel is meaningless.

    Args:
        camera: A camera with float32 or float64 tensors, on the device of the points.
        points: World points [u], shape [S, 3].

    Raises:
        UsageError: The camera model is only supported by the kernels.
    """
    import torch

    K, viewmat = camera.K, camera.viewmat
    in_camera = (points[:, None] * viewmat[:3, :3]).sum(2) + viewmat[:3, 3]
    seen, depth = lenses.on_lens(camera.model, camera.distortion, in_camera), lenses.depth_of(camera.model, in_camera)
    plane = lenses.to_plane(camera.model, camera.distortion, torch.where(seen[:, None], in_camera, torch.ones_like(in_camera)))
    pixels = torch.stack([K[i, i] * plane[:, i] + K[i, 2] for i in range(2)], 1)
    return pixels, torch.where(seen, depth, 0)


def _at_depth(camera: Camera, rays: Any, depths: Any) -> Any:
    """Return positions in camera axes [S, 3] at depths [S]; ``rays`` are the positions at depth 1 [S, 3]."""
    scaled = rays * depths[:, None]
    if camera.model == "orthographic":  # parallel rays
        scaled[:, :2] = rays[:, :2]
    return scaled


def depth_normals(camera: Camera, depth: torch.Tensor) -> torch.Tensor:
    """Compute the normals of the surface of a depth map, from finite differences of its back-projected pixels.

    A normal is perpendicular to two differences: between the right and left neighbour, and between the lower and upper one.
    Normals are exact for planes. Differentiable in ``depth``, and in ``camera.viewmat`` and ``camera.K`` if they require
    gradients. Nothing is read back from the device. A NaN depth gives NaN normals.

    Args:
        camera: One camera, with tensors of the type and device of ``depth``.
        depth: z-depths [u], above 0 where there is a surface, shape [H, W].

    Returns:
        Unit normals in world axes, towards the camera, shape [H, W, 3]; 0 at the border of the image, and where the pixel or
        one of its four neighbours has no depth.

    Raises:
        UsageError: The camera is not a pinhole.
    """
    import torch

    check_pinhole(camera)
    height, width = depth.shape
    if min(height, width) < 3:
        return depth.new_zeros(height, width, 3)
    rows, columns = (torch.arange(n, dtype=depth.dtype, device=depth.device) + 0.5 for n in (height, width))
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).view(-1, 2)
    shown = ~(depth <= 0)  # True for a NaN, so that it reaches the result
    depth = torch.where(shown, depth, 1)
    points = back_project_tensors(camera, pixels, depth.reshape(-1)).view(height, width, 3)
    size = (depth / camera.K[0, 0]).detach()[1:-1, 1:-1, None]  # of a pixel; lengths divided by it are around 1
    right = (points[1:-1, 2:] - points[1:-1, :-2]) / size
    down = (points[2:, 1:-1] - points[:-2, 1:-1]) / size
    normals = torch.linalg.cross(down, right)
    square = normals.square().sum(-1, keepdim=True)
    # the root in float64, since the rounding of float32's depends on the processor (MKL)
    normals = normals / torch.where(square == 0, 1, square).double().sqrt().to(depth.dtype)
    inner = shown[1:-1, 1:-1] & shown[1:-1, 2:] & shown[1:-1, :-2] & shown[2:, 1:-1] & shown[:-2, 1:-1]
    return torch.nn.functional.pad(torch.where(inner[..., None], normals, 0), (0, 0, 1, 1, 1, 1))


def gaussian_normals(gaussians: Gaussians | ActivatedGaussians, camera: Camera) -> torch.Tensor:
    """Compute the normal of each Gaussian: its shortest axis, turned towards the camera.

    Differentiable in ``quats``; the choice of axis and side has no gradient. The normal of a round Gaussian is meaningless.
    Pass the normals as `RasterizeOptions.features` to render an image of normals.

    Args:
        gaussians: N Gaussians.
        camera: One camera, or C of them, with arrays or tensors.

    Returns:
        Unit normals in world axes, shape [N, 3], or [C, N, 3] for C cameras.

    Raises:
        TypeError: The Gaussians are given by covariances.
    """
    import torch

    if not isinstance(gaussians, (Gaussians, ActivatedGaussians)):
        raise TypeError("gaussian_normals needs quats and scales; for covariances, torch.linalg.eigh gives the axes")

    means, quats, scales, *_ = gaussians.tensors().values()
    axes = rotation_matrices(quats / quats.norm(dim=-1, keepdim=True))
    normals = torch.take_along_dim(axes, scales.argmin(-1)[:, None, None], 2)[..., 0]
    viewmat = torch.as_tensor(camera.viewmat).detach().to(means)
    center = -(viewmat[..., :3, :3] * viewmat[..., :3, 3:]).sum(-2)
    away = viewmat[..., 2:3, :3] if camera.model == "orthographic" else means.detach() - center[..., None, :]
    faces = (normals.detach() * away).sum(-1, keepdim=True) <= 0
    return torch.where(faces, normals, -normals)


def in_image(camera: Camera, points: np.ndarray, near: float = 0.0) -> np.ndarray:
    """Return a mask [N], True where a world point [N, 3] is beyond ``near`` [u] and inside the camera's image."""
    pixels, z = project_points(camera, points)
    return _inside(camera, pixels) & (z > near)


def seen_pixels(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return indices, rows, columns and depths [u], shape [S] each, of the world points [N, 3] that a camera sees."""
    pixels, z = project_points(camera, points)
    seen = np.nonzero(_inside(camera, pixels) & (z > 0))[0]
    columns, rows = np.floor(pixels[seen]).astype(int).T
    return seen, rows, columns, z[seen]


def _inside(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    x, y = pixels.T
    return (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)


def camera_extent(cameras: list[Camera]) -> float:
    """Return 1.1 times the largest distance from a camera to the mean centre [u] (Kerbl et al. 2023); 0 for one camera."""
    centers = np.array([c.center for c in cameras])
    return 1.1 * float(np.linalg.norm(centers - centers.mean(0), axis=1).max())


def focus_point(cameras: list[Camera]) -> np.ndarray:
    """Return the point [3] nearest to all optical axes in least squares; for parallel axes the mean camera centre."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for c in cameras:
        axis = c.viewmat[2, :3]
        m = np.eye(3) - np.outer(axis, axis)
        normal += m
        right += matmul(m, c.center)
    # a tiny pull to the mean centre keeps the system solvable when all axes are parallel
    weight = 1e-6 * len(cameras)
    mean = np.mean([c.center for c in cameras], axis=0)
    return matmul(inverse(normal + weight * np.eye(3)), right + weight * mean)


def look_at(center: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return camera_from_world [4, 4] of a camera at ``center`` that looks at ``target`` with ``up`` (all [3]) upwards."""
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross(-up, z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -matmul(rotation, center)
    return viewmat
