"""Geometry of cameras and Gaussians: poses, rotations, lenses, and the units of a scene and its files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from warpgs.constants import POSE_TOLERANCE
from warpgs.errors import DataError, UsageError
from warpgs.scene import ActivatedGaussians, Box, Camera, Gaussians, Normalization

if TYPE_CHECKING:
    import torch

    from warpgs.scene import Array
T = TypeVar("T")


def evenly_spaced(values: Sequence[T], most: int) -> list[T]:
    """Return up to ``most`` of some values."""
    return [values[i] for i in np.unique(np.linspace(0, len(values) - 1, min(most, len(values))).round().astype(int))]


# Camera models outside of the kernels: from positions in camera axes to the image plane and back, for arrays or
# tensors.
#
# The image plane holds points (u, v) that K takes to pixels: x / z and y / z for a pinhole. The kernels have their own
# formulas.

MODELS = ("pinhole", "orthographic", "opencv", "fisheye")
"""Camera models that are known here."""
CENTRAL = ("pinhole", "opencv", "fisheye")
"""Camera models with a centre of projection, which a pinhole of the same K can replace."""
NEWTON_STEPS = 30
"""Steps of Newton's method to invert the distortion. Five reach float64's precision for usual lenses. For a fisheye, a step
that leaves the bracket is replaced by a bisection."""


def check_known(model: str) -> None:
    """Check that a camera model is known here."""
    if model not in MODELS:
        raise UsageError(f"only the lenses {', '.join(MODELS)} are supported here, not {model!r}; undistort the images first")


def _library(array: Array) -> Any:
    """Return the library of the array, numpy or torch."""
    if isinstance(array, np.ndarray):
        return np
    import torch

    return torch


def depth_of(model: str, positions: Array) -> Array:
    """Return the depths [...] [u] of positions in the camera [..., 3], as in renders: distance for a fisheye, else z."""
    return (positions**2).sum(-1) ** 0.5 if model == "fisheye" else positions[..., 2]


def to_plane(model: str, distortion: Array | None, positions: Array) -> Array:
    """Return the points in the image plane [..., 2] of positions in the camera [..., 3].

    Points behind a pinhole or beyond the rim of a lens are meaningless: see `on_lens`.
    """
    check_known(model)
    library, x, y, z = _library(positions), *(positions[..., i] for i in range(3))
    if model == "orthographic":
        return library.stack([x, y], -1)
    if model == "fisheye":
        r = library.hypot(x, y)
        scale = _bent(library.arctan2(r, z), distortion)[0] / library.where(r > 0, r, 1)
        scale = library.where(r > 0, scale, 1 / library.where(z == 0, 1, z))
        return library.stack([x * scale, y * scale], -1)
    a, b = x / z, y / z
    return library.stack(_distorted(a, b, distortion)[:2] if model == "opencv" else (a, b), -1)


def from_plane(model: str, distortion: Array | None, points: Array) -> Array:
    """Return the positions at depth 1 (`depth_of`) that project to points of the image plane; NaN for points off the lens.

    Shapes are [..., 2] for points and [..., 3] for positions. For an orthographic camera the result is (u, v, 1); positions
    (u, v, z) of all other depths share that point.
    """
    check_known(model)
    library, u, v = _library(points), points[..., 0], points[..., 1]
    if model == "fisheye":
        radius = library.hypot(u, v)
        low, high = 0 * radius, 0 * radius + _rim(distortion)
        angle = library.where(radius < high, radius, high)
        for _ in range(NEWTON_STEPS):
            value, slope = _bent(angle, distortion)
            low, high = library.where(value < radius, angle, low), library.where(value < radius, high, angle)
            angle = angle - (value - radius) / library.where(slope > 0, slope, 1)
            angle = library.where((angle > low) & (angle < high), angle, 0.5 * (low + high))
        scale = library.where(radius > 0, library.sin(angle) / library.where(radius > 0, radius, 1), 1)
        found = library.stack([u * scale, v * scale, library.cos(angle)], -1)
    elif model == "opencv":
        a, b = u, v
        for _ in range(NEWTON_STEPS):
            du, dv, aa, ab, bb, _ = _distorted(a, b, distortion)
            determinant = aa * bb - ab * ab
            determinant = library.where(determinant == 0, 1, determinant)
            a, b = a - (bb * (du - u) - ab * (dv - v)) / determinant, b - (aa * (dv - v) - ab * (du - u)) / determinant
        found = library.stack([a, b, library.ones_like(a)], -1)
    else:
        return library.stack([u, v, library.ones_like(u)], -1)
    back = to_plane(model, distortion, found)
    missed = ~(library.hypot(back[..., 0] - u, back[..., 1] - v) <= 1e-4) | ~on_lens(model, distortion, found)
    return library.where(missed[..., None], np.nan, found)


def on_lens(model: str, distortion: Array | None, positions: Array, samples: int = 64) -> Array:
    """Return a mask [...], True where the lens is not folded between its axis and positions in the camera [..., 3].

    The lens is tested at ``samples`` points along the way. Positions behind a pinhole or opencv camera count as folded;
    positions in an orthographic camera never do.
    """
    library, z = _library(positions), positions[..., 2]
    if model == "orthographic":
        return z > -np.inf
    if model == "fisheye":
        angle = library.arctan2(library.hypot(positions[..., 0], positions[..., 1]), z)
        good = angle < np.pi
        for i in range(samples):
            good = good & (_bent(angle * ((i + 1) / samples), distortion)[1] > 0)
        return good
    good = z > 0
    if model == "opencv":
        a, b = (positions[..., i] / library.where(good, z, 1) for i in range(2))
        for i in range(samples):
            part = (i + 1) / samples
            s = (part / (1 + (1 - part) * (a * a + b * b))) ** 0.5  # evenly spaced in the squared sine of the angle
            _, _, aa, ab, bb, denominator = _distorted(s * a, s * b, distortion)
            good = good & (denominator > 0) & (aa + bb > 0) & (aa * bb - ab * ab > 0)
    return good


def _rim(distortion: Array) -> float:
    """Return the angle [rad] at which a fisheye folds back, at most pi."""
    angles = np.linspace(0, np.pi, 4097)[1:]
    folded = angles[_bent(angles, [float(k) for k in distortion])[1] <= 0]
    return float(folded[0]) if len(folded) else math.pi


def _bent(angle: Array, distortion: Sequence[float] | Array) -> tuple[Array, Array]:
    """Return the radius in the image plane at an angle [rad] from a fisheye's axis, and its derivative."""
    t, value, slope = angle * angle, 1.0, 1.0
    powers = t
    for i in range(4):
        value, slope = value + distortion[i] * powers, slope + (2 * i + 3) * distortion[i] * powers
        powers = powers * t
    return angle * value, slope


def _distorted(a: Array, b: Array, distortion: Array) -> tuple[Array, ...]:
    """Return the distorted point of (a, b), the three entries of its symmetric Jacobian, and the radial denominator."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (distortion[i] for i in range(8))
    t = a * a + b * b
    numerator, denominator = 1 + t * (k1 + t * (k2 + t * k3)), 1 + t * (k4 + t * (k5 + t * k6))
    radial = numerator / denominator
    first = (k1 + t * (2 * k2 + 3 * t * k3) - radial * (k4 + t * (2 * k5 + 3 * t * k6))) / denominator
    return (
        a * radial + 2 * p1 * a * b + p2 * (t + 2 * a * a),
        b * radial + p1 * (t + 2 * b * b) + 2 * p2 * a * b,
        radial + 2 * a * a * first + 2 * p1 * b + 6 * p2 * a,
        2 * (a * b * first + p1 * a + p2 * b),
        radial + 2 * b * b * first + 6 * p1 * b + 2 * p2 * a,
        denominator,
    )


# Geometry: rotations, logit, projection and back-projection of points, the extent and focus of a set of cameras.
#
# Functions that take tensors import torch when they are called, so that readers of scenes need not load it.


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
    return _library(quats).stack(entries, -1).reshape(*quats.shape[:-1], 3, 3)


def quaternions(rotations: torch.Tensor) -> torch.Tensor:
    """Return unit quaternions wxyz [N, 4] of rotations [N, 3, 3], computed from the largest component to avoid cancellation."""
    import torch

    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(1) for row in rotations.unbind(1))
    # row i is 4 q_i q
    outer = torch.stack([
        torch.stack([1 + xx + yy + zz, zy - yz, xz - zx, yx - xy], 1),
        torch.stack([zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx], 1),
        torch.stack([xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy], 1),
        torch.stack([yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz], 1),
    ], 1)  # fmt: skip
    largest = outer.diagonal(dim1=1, dim2=2).argmax(1)
    return torch.nn.functional.normalize(outer[torch.arange(len(largest), device=largest.device), largest], dim=1)


def check_pinhole(camera: Camera) -> None:
    """Check that a camera is a pinhole, for code that assumes that straight lines stay straight."""
    if camera.model != "pinhole":
        raise UsageError(f"only pinhole cameras are supported here, not {camera.model!r}; read with --lenses undistort")


def pinhole_of(camera: Camera) -> Camera:
    """Return a pinhole camera with the same pose, K and size, and no distortion; it sees less than a wide fisheye."""
    if camera.model not in CENTRAL:
        check_pinhole(camera)
    return replace(camera, model="pinhole", distortion=None) if camera.model != "pinhole" else camera


def resized(camera: Camera, factor: float) -> Camera:
    """Return the camera of the image at another size, at least one pixel on each side."""
    if factor == 1:
        return camera
    width, height = (max(1, int(factor * n)) for n in (camera.width, camera.height))
    scale = np.array([[width / camera.width], [height / camera.height], [1.0]])
    return replace(camera, K=scale * camera.K, width=width, height=height)


def inside(points: np.ndarray, box: Box) -> np.ndarray:
    """Mask [N] of the points [N, 3] in a box in the same units."""
    center, size, rotation = box
    return (np.abs(matmul(points - center, rotation)) <= np.asarray(size) / 2).all(1)


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
    """
    in_camera = matmul(points, camera.viewmat[:3, :3].T) + camera.viewmat[:3, 3]
    z = in_camera[:, 2]
    if camera.model != "pinhole":
        with np.errstate(all="ignore"):
            plane = to_plane(camera.model, camera.distortion, in_camera)
            seen = np.isfinite(plane).all(1) & on_lens(camera.model, camera.distortion, in_camera)
        plane = np.where(seen[:, None], plane, 0) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
        return plane, np.where(seen, depth_of(camera.model, in_camera), 0)
    return matmul(in_camera / np.where(z == 0, np.finfo(float).tiny, z)[:, None], camera.K.T)[:, :2], z


def back_project(camera: Camera, pixels: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Return the world points [N, 3] at pixels [N, 2] (centres at +0.5) and depths [N] [u]; inverts `project_points`.

    A pixel that a lens does not reach gives NaN.
    """
    if camera.model == "pinhole":
        in_camera = depths[:, None] * matmul(np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1), inverse(camera.K).T)
    else:
        plane = (pixels - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
        in_camera = _at_depth(camera, from_plane(camera.model, camera.distortion, plane), depths)
    return matmul(in_camera - camera.viewmat[:3, 3], camera.viewmat[:3, :3])


def back_project_tensors(camera: Camera, pixels: torch.Tensor, depths: torch.Tensor) -> torch.Tensor:
    """Return what `back_project` returns, from tensors and without a matrix product: R^T (d K^-1 [x y 1] - t) for a pinhole.

    A matrix product would load another library on CUDA. Only focal lengths and principal point of K are used, as in projection.
    """
    import torch

    K, viewmat = camera.K, camera.viewmat
    if camera.model == "pinhole":
        x, y = ((pixels[:, i] - K[i, 2]) / K[i, i] * depths for i in range(2))
        in_camera = torch.stack([x, y, depths], 1)
    else:
        plane = torch.stack([(pixels[:, i] - K[i, 2]) / K[i, i] for i in range(2)], 1)
        in_camera = _at_depth(camera, from_plane(camera.model, camera.distortion, plane), depths)
    return ((in_camera - viewmat[:3, 3])[:, :, None] * viewmat[:3, :3]).sum(1)


def project_tensors(camera: Camera, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what `project_points` returns, from tensors and without a matrix product: pixels [S, 2] and depths [S] [u].

    For a point that the camera cannot see, the depth is at most 0 and the pixel is meaningless.
    """
    import torch

    K, viewmat = camera.K, camera.viewmat
    in_camera = (points[:, None] * viewmat[:3, :3]).sum(2) + viewmat[:3, 3]
    seen, depth = on_lens(camera.model, camera.distortion, in_camera), depth_of(camera.model, in_camera)
    plane = to_plane(camera.model, camera.distortion, torch.where(seen[:, None], in_camera, torch.ones_like(in_camera)))
    return torch.stack([K[i, i] * plane[:, i] + K[i, 2] for i in range(2)], 1), torch.where(seen, depth, 0)


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
        UsageError: The camera is not a pinhole, or its size is not that of the map.
    """
    import torch

    check_pinhole(camera)
    if tuple(depth.shape) != (camera.height, camera.width):
        raise UsageError(f"depth is {list(depth.shape)}, not [{camera.height}, {camera.width}]; scale the camera's size and K")
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
    return torch.where((normals.detach() * away).sum(-1, keepdim=True) <= 0, normals, -normals)


def in_image(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return a mask [N], True where a world point [N, 3] is in front of the camera and inside its image."""
    return np.isin(np.arange(len(points)), seen_pixels(camera, points)[0])


def seen_pixels(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return indices, rows, columns and depths [u], shape [S] each, of the world points [N, 3] that a camera sees."""
    pixels, z = project_points(camera, points)
    x, y = pixels.T
    seen = np.flatnonzero((x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height) & (z > 0))
    columns, rows = np.floor(pixels[seen]).astype(int).T
    return seen, rows, columns, z[seen]


FAR_OFF = 8.0
"""Distance from the middle of all cameras, in median distances, beyond which a camera is an outlier: paths end at about 2."""


def near_cameras(centers: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
    """Return which of the camera centres [N, 3] are not far off the rest and from the points [P, 3], bool [N].

    Cameras closer to each other than to the scene are no outliers, nor is more than a quarter of all cameras. Without points,
    four cameras are too few to tell.
    """
    middle = np.median(centers, axis=0)
    distances = np.linalg.norm(centers - middle, axis=1)
    limit = FAR_OFF * float(np.median(distances))
    if points is not None and len(points):
        with np.errstate(over="ignore"):
            limit = max(limit, 2 * float(np.median(np.linalg.norm(points - middle, axis=1))))
    elif len(centers) < 5:
        limit = math.inf
    near = distances <= limit
    return near if limit > 1e-9 and 4 * int((~near).sum()) <= len(near) else np.ones(len(near), bool)


def camera_extent(cameras: list[Camera], points: np.ndarray | None = None) -> float:
    """Return 1.1 times the largest distance from a camera to the mean centre [u] (Kerbl et al. 2023); 0 for one camera.

    Outliers are ignored (`near_cameras`, with the scene's points [P, 3]).
    """
    centers = np.array([c.center for c in cameras])
    centers = centers[near_cameras(centers, points)]
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
    return matmul(inverse(normal + weight * np.eye(3)), right + weight * np.mean([c.center for c in cameras], axis=0))


def pose_of(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return the pose [4, 4] of a rotation [3, 3] and a translation [3], float64."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


def pose_at(rotation: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return camera_from_world [4, 4] of a camera at ``center`` [3] whose axes are the rows of ``rotation`` [3, 3]."""
    return pose_of(rotation, -matmul(rotation, center))


def look_at(center: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return camera_from_world [4, 4] of a camera at ``center`` that looks at ``target`` with ``up`` (all [3]) upwards."""
    center, target, up = (np.asarray(v, float) for v in (center, target, up))
    with np.errstate(invalid="ignore"):  # NaN if target is the center
        z = (target - center) / np.linalg.norm(target - center)
    x = np.cross(-up, z)
    if not np.linalg.norm(x) > 0:
        raise UsageError("look_at: up and the view must not be parallel, and target must not be the center")
    x /= np.linalg.norm(x)
    return pose_at(np.stack([x, np.cross(z, x), z]), center)


# The two systems of units that Gaussians and cameras come in, and the similarity between them.
#
# ``scene`` units [u] are those of a `Scene` that `load_scene` returned: recentred and rescaled, as the fit sees it.
# ``file`` units are those of the scene's own files and of a run's PLY files. `Normalization` holds the similarity from
# file to scene units: ``x_scene = scale * rotation @ (x_file - offset)``.

UNITS = ("scene", "file")
SH_COUNTS = (1, 4, 9, 16, 25)
"""Numbers of spherical-harmonics coefficients that Gaussians may have."""


def checked_normalization(normalization: Normalization | None, units: str, where: str) -> Normalization:
    """Check and return ``normalization``; with file units, None becomes the identity."""
    _same_units(units, "file")
    if normalization is None and units == "scene":
        raise UsageError(f"{where}: units='scene' requires normalization=scene.normalization; give it, or units='file'")
    n = normalization or Normalization()
    offset, rotation = np.asarray(n.offset), np.asarray(n.rotation)
    finite = math.isfinite(n.scale) and n.scale > 0 and offset.shape == (3,) and np.isfinite(offset).all()
    turns = rotation.shape == (3, 3) and np.abs(matmul(rotation, rotation.T) - np.eye(3)).max() <= POSE_TOLERANCE
    if not (finite and turns and np.linalg.det(rotation) > 0 and (n.up is None or 0.99 < np.linalg.norm(n.up) < 1.01)):
        raise DataError(f"{where}: the scene's normalization is not a similarity: {n}. Read the scene again")
    return n


def check_stored(gaussians: object) -> None:
    """Check that Gaussians have log scales and logits, as in files, and tensors of matching shapes."""
    if not isinstance(gaussians, Gaussians):
        how = "give gaussians.stored()" if hasattr(gaussians, "stored") else "files hold quats, log scales and logits"
        raise TypeError(f"gaussians must be an instance of Gaussians, not {type(gaussians).__name__}; {how}")
    for name, tensor in gaussians.tensors().items():
        if not hasattr(tensor, "detach"):
            raise TypeError(f"{name} must be a torch tensor, not {type(tensor).__name__}")
    count = gaussians.means.shape[0] if gaussians.means.ndim else 0
    for name, rest in {"means": [3], "quats": [4], "log_scales": [3], "logit_opacities": []}.items():
        if (found := list(getattr(gaussians, name).shape)) != [count, *rest]:
            raise ValueError(f"{name} must have shape [{', '.join(map(str, ['N', *rest]))}] (N={count}), not {found}")
    found = list(gaussians.sh.shape)
    if len(found) != 3 or found[1] not in SH_COUNTS or found != [count, found[1], 3]:
        raise ValueError(f"sh must have shape [N, K, 3] (N={count}), where K is 1, 4, 9, 16 or 25, not {found}")


def _same_units(source: str, target: str) -> bool:
    """Return whether two names of units are equal; UsageError for an unknown one."""
    for units in (source, target):
        if units not in UNITS:
            raise UsageError(f"units {units!r} is not one of {', '.join(UNITS)}")
    return source == target


def _converted(points: Array, offset: Array, scale: float, target: str) -> Array:
    """Return points [N, 3] in the other units, ``target``, in unchanged axes."""
    return points / scale + offset if target == "file" else scale * (points - offset)


def convert_points(points: np.ndarray, normalization: Normalization, source: str, target: str) -> np.ndarray:
    """Return points [N, 3] in other units, float64."""
    if _same_units(source, target):
        return points
    offset, scale, rotation = np.asarray(normalization.offset, np.float64), normalization.scale, normalization.rotation
    if target == "file":
        return np.asarray(_converted(matmul(points, rotation), offset, scale, target))
    return matmul(_converted(points, offset, scale, target), rotation.T)


def convert_box(box: Box, normalization: Normalization, source: str, target: str) -> Box:
    """Return a box in other units, float64."""
    ((center,), size, axes), n = (convert_points(box[0][None], normalization, source, target), *box[1:]), normalization
    if target == "file":
        return center, size / n.scale, matmul(n.rotation.T, axes)
    return center, size * n.scale, matmul(n.rotation, axes)


def convert_gaussians(gaussians: Gaussians, normalization: Normalization, source: str, target: str) -> Gaussians:
    """Return Gaussians in other units; tensors that do not change are shared.

    Means and log scales change; quaternions and spherical harmonics only if the similarity has a rotation. Sums are taken in
    float64. In file units, all tensors are float64 if the normalization has an `origin`: float32 would round map coordinates to
    decimetres.
    """
    check_stored(gaussians)
    if _same_units(source, target):
        return gaussians
    if normalization.turned and target == "file":
        gaussians = rotate(gaussians, normalization.rotation.T)
    means, kind = gaussians.means.double(), gaussians.means.dtype
    means = _converted(means, means.new_tensor(np.asarray(normalization.offset, np.float64)), normalization.scale, target)
    longer = math.log(normalization.scale) * (-1 if target == "file" else 1)
    if target == "file" and normalization.origin.any():
        gaussians, kind = Gaussians(**{name: t.double() for name, t in gaussians.tensors().items()}), means.dtype
    gaussians = replace(gaussians, means=means.to(kind), log_scales=(gaussians.log_scales.double() + longer).to(kind))
    return rotate(gaussians, normalization.rotation) if normalization.turned and target == "scene" else gaussians


_NODES = ((0.0, 0.5688888888888889), (0.5384693101056831, 0.47862867049936647), (0.906179845938664, 0.23692688505618908))
"""Nodes and weights of the Gauss-Legendre rule with five points, the last two also mirrored: exact to degree 9."""
_AZIMUTHS = 10
"""Number of azimuths of the quadrature rule, exact to order 9; products of harmonics of degree 4 have degree 8."""


def harmonics(directions: np.ndarray) -> np.ndarray:
    """Return the 25 harmonics of degrees 0 to 4 (docs/sh.md) at unit directions [N, 3], float64 [N, 25]."""
    x, y, z = np.asarray(directions, np.float64).T
    values = []
    for degree in range(5):
        for order in range(-degree, degree + 1):
            m = abs(order)
            square = (2 * degree + 1) * (2 if m else 1) * math.factorial(degree - m) / math.factorial(degree + m)
            turn, polar = (x + 1j * y) ** m, np.polynomial.Legendre.basis(degree).deriv(m)(z)
            values.append((-1) ** m * math.sqrt(square / (4 * math.pi)) * polar * (turn.imag if order < 0 else turn.real))
    return np.stack(values, 1)


def harmonics_rotation(rotation: np.ndarray) -> torch.Tensor:
    """Return the matrix that turns coefficients with the scene, float64 [25, 25] (Wigner's D for degrees 0 to 4, real).

    Entry (j, k) is the integral over the sphere of Y_j(d) Y_k(R^T d), exact by a product rule of 50 points.

    Args:
        rotation: A rotation or a reflection, shape [3, 3].
    """
    import torch

    nodes = [*_NODES, *((-z, w) for z, w in _NODES[1:])]
    points = [(z, math.sqrt(1 - z * z), 2 * math.pi * i / _AZIMUTHS) for z, _ in nodes for i in range(_AZIMUTHS)]
    d = np.array([[radius * math.cos(angle), radius * math.sin(angle), z] for z, radius, angle in points])
    weights = np.array([w * 2 * math.pi / _AZIMUTHS for _, w in nodes]).repeat(_AZIMUTHS)
    here, there = harmonics(d), harmonics(matmul(d, np.asarray(rotation, np.float64)))
    return torch.from_numpy(np.einsum("i,ij,ik->jk", weights, here, there))


def rotate(gaussians: Gaussians, rotation: np.ndarray) -> Gaussians:
    """Return Gaussians turned about the origin by [3, 3]: means, shapes and the directions that colours depend on.

    The matrix may be a reflection, since an ellipsoid is its own mirror image.
    """
    import torch

    means, quats, k = gaussians.means, gaussians.quats, gaussians.sh.shape[1]
    turn = torch.tensor(np.asarray(rotation), dtype=torch.float64, device=means.device)
    coefficients = harmonics_rotation(rotation).to(means.device)[:k, :k]
    axes = torch.as_tensor(rotation_matrices(torch.nn.functional.normalize(quats.double(), dim=1)))
    return replace(
        gaussians,
        means=torch.einsum("ij,nj->ni", turn, means.double()).to(means.dtype),
        quats=quaternions(torch.einsum("ij,njk->nik", turn if np.linalg.det(rotation) > 0 else -turn, axes)).to(quats.dtype),
        sh=torch.einsum("jk,nkc->njc", coefficients, gaussians.sh.double()).to(gaussians.sh.dtype),
    )


def convert_camera(camera: Camera, normalization: Normalization, source: str, target: str) -> Camera:
    """Return a camera, or a batch of them, in other units: its pose changes, its intrinsics do not."""
    if _same_units(source, target):
        return camera
    offset, turn = np.asarray(normalization.offset, np.float64), normalization.rotation
    if isinstance(camera.viewmat, np.ndarray):
        viewmat: Any = camera.viewmat.copy()
    else:
        viewmat = camera.viewmat.clone()
        offset, turn = viewmat.new_tensor(offset), viewmat.new_tensor(turn)
    rotation, translation = viewmat[..., :3, :3], viewmat[..., :3, 3]
    if target == "file":
        rotation = rotation @ turn if normalization.turned else rotation
        viewmat[..., :3, 3] = translation / normalization.scale - rotation @ offset
    else:
        viewmat[..., :3, 3] = normalization.scale * (rotation @ offset + translation)
        rotation = rotation @ turn.T if normalization.turned else rotation
    viewmat[..., :3, :3] = rotation
    return replace(camera, viewmat=viewmat)
