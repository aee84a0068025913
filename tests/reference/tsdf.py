"""Fusion of depth maps and colours in numpy, one view and float64, all points at once."""

import numpy as np


def project(points, camera):
    """Pixel positions [..., 2] and depths [...] of points [..., 3]."""
    in_camera = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    homogeneous = in_camera @ camera.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return homogeneous[..., :2] / homogeneous[..., 2:], in_camera[..., 2]


def interpolated(image, uv):
    """Bilinear samples of an image [H, W, ...] at positions [N, 2], clamped to the outermost pixel centres."""
    size = np.array([image.shape[1], image.shape[0]])
    at = np.clip(uv - 0.5, 0, size - 1)
    low = np.minimum(np.floor(at).astype(int), np.maximum(size - 2, 0))
    high = np.minimum(low + 1, size - 1)
    (fx, fy) = np.clip(at - low, 0, 1).T
    rows = [(low[:, 1], 1 - fy), (high[:, 1], fy)]
    columns = [(low[:, 0], 1 - fx), (high[:, 0], fx)]
    shape = (-1, *[1] * (image.ndim - 2))
    return sum((a * b).reshape(shape) * image[v, u] for v, a in rows for u, b in columns)


def seen_depth(points, camera, depth, limit):
    """Depth of the surface [N] at the pixels of points [N, 3], those points' own depths, pixels and whether they are inside."""
    uv, z = project(points, camera)
    inside = (z >= 0.01) & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1)
    uv = np.where(inside[:, None], uv, 0.5)
    column, row = np.floor(uv).astype(int).T
    corners = np.floor(uv - 0.5).astype(int)
    whole = ((corners >= 0) & (corners + 1 < [camera.width, camera.height])).all(1)
    u, v = np.where(whole[:, None], corners, 0).T
    around = np.stack([depth[v + i, u + j] for i in (0, 1) for j in (0, 1)])
    with np.errstate(invalid="ignore"):
        smooth = whole & (around > 0).all(0) & np.isfinite(around).all(0) & (np.ptp(around, 0) < limit)
    between = interpolated(np.where(np.isfinite(depth), depth, 0), uv)
    return np.where(smooth, between, depth[row, column]), z, uv, (row, column), inside


def integrated(origin, voxel, shape, truncation, views):
    """Distances and weights, shape ``shape`` each, after views of (camera, depth, pixel weights)."""
    lattice = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 3)
    points = np.asarray(origin) + voxel * lattice
    total, weights = np.zeros(len(points)), np.zeros(len(points))
    for camera, depth, pixel_weights in views:
        surface, z, _, pixel, inside = seen_depth(points, camera, depth, truncation)
        w = np.where(inside & (surface - z >= -truncation), pixel_weights[pixel], 0)
        total += w * np.minimum((surface - z) / truncation, 1)
        weights += w
    return (total / np.where(weights > 0, weights, 1)).reshape(shape), weights.reshape(shape)


def gathered(points, tolerance, views):
    """Sums of weighted colours [N, 3] and weights [N] after views of (camera, depth, pixel weights, image)."""
    sums, weights = np.zeros((len(points), 3)), np.zeros(len(points))
    for camera, depth, pixel_weights, image in views:
        surface, z, uv, pixel, inside = seen_depth(points, camera, depth, tolerance)
        w = np.where(inside & (np.abs(surface - z) < tolerance), pixel_weights[pixel], 0)
        sums += w[:, None] * interpolated(image, uv)
        weights += w
    return sums, weights


def _slope(depth, axis):
    """Differences along an axis to the neighbour, before or behind, that differs less; 0 where neither has a depth."""
    padded = np.pad(np.where(np.isfinite(depth), depth, 0), 1)
    back, ahead = (np.roll(padded, shift, axis)[1:-1, 1:-1] for shift in (1, -1))
    choices = np.stack([np.where(back > 0, depth - back, np.inf), np.where(ahead > 0, ahead - depth, np.inf)])
    least = np.take_along_axis(choices, np.abs(choices).argmin(0)[None], 0)[0]
    return np.where(np.isfinite(least), least, 0)


def faced(depth, camera):
    """Cosines [H, W] between rays and normals: the cross product of the tangents along rows and columns."""
    height, width = depth.shape
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    inverse = np.linalg.inv(camera.K)
    rays = np.concatenate([pixels, np.ones((height, width, 1))], -1) @ inverse.T
    met = (depth > 0) & np.isfinite(depth)
    z = np.where(met, depth, 1)
    along, down = (_slope(depth, axis)[..., None] * rays + z[..., None] * inverse[:, 1 - axis] for axis in (1, 0))
    normals = np.cross(along, down)
    cosines = np.abs((normals * rays).sum(-1)) / np.linalg.norm(normals, axis=-1) / np.linalg.norm(rays, axis=-1)
    return np.where(met, cosines, np.where(depth > 0, 1, 0))
