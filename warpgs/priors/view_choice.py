"""Choice of views by their overlap: neighbours to compare a view with, and a few views that together see most of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from warpgs import geometry
from warpgs.geometry import check_pinhole
from warpgs.scene import Camera

SAMPLES = 4
"""Number of sampled pixels along each side of an image."""
DEPTHS = 3
"""Number of depths at each sampled pixel."""
LEAST_ANGLE, MOST_ANGLE, LOST_ANGLE = 1.0, 30.0, 60.0
"""Angles between two rays to a point [deg]. Below the first, depth is uncertain. Above the second, a surface looks different to
both views. From the third on, the views are assumed to share nothing."""


class Sight(NamedTuple):
    """Shared sight of pairs of V views, as fractions of what the first view of a pair sees."""

    overlap: np.ndarray
    """Fraction of what the first view sees that the second sees, too, less at larger angles, in [0, 1], shape [V, V]."""
    matching: np.ndarray
    """Shared fraction, weighted by how well depth can be found at the angle; 0 for a view and itself, shape [V, V]."""


def _sampled(camera: Camera, bounds: tuple[float, float]) -> np.ndarray:
    """Return points [S, 3] that a camera may see: at a grid of pixels, and depths evenly spaced in their logarithm."""
    check_pinhole(camera)
    along = (np.arange(SAMPLES) + 0.5) / SAMPLES
    x, y = (a.ravel() for a in np.meshgrid(along * camera.width, along * camera.height))
    near, far = bounds
    depths = [near * (far / near) ** ((k + 0.5) / DEPTHS) for k in range(DEPTHS)]
    pixels = np.tile(np.stack([x, y], 1), (DEPTHS, 1))
    return geometry.back_project(camera, pixels, np.repeat(depths, len(x)))


def shared_sight(cameras: Sequence[Camera], bounds: Sequence[tuple[float, float]]) -> Sight:
    """Return what pairs of views share, by projecting points sampled in each camera's frustum into all others.

    The method follows the view selection of multi-view stereo (Goesele et al. 2007; angles are weighted as by Yao et al. 2018),
    but samples points instead of using reconstructed ones.

    Args:
        cameras: Pinhole cameras of V views.
        bounds: Nearest and farthest depth of each view [u], 0 < near < far.
    """
    turns, shifts = np.stack([c.viewmat[:3, :3] for c in cameras]), np.stack([c.viewmat[:3, 3] for c in cameras])
    K, centers = np.stack([c.K for c in cameras]), np.stack([c.center for c in cameras])
    sides = np.array([(c.width, c.height) for c in cameras], float)
    least, most, lost = (1 - np.cos(np.radians(a)) for a in (LEAST_ANGLE, MOST_ANGLE, LOST_ANGLE))
    overlap, matching = np.zeros((2, len(cameras), len(cameras)))
    for i, (camera, near_far) in enumerate(zip(cameras, bounds)):
        points = _sampled(camera, near_far)
        local = (turns[:, None] * points[None, :, None, :]).sum(3) + shifts[:, None]  # [V, S, 3]
        ahead = local[..., 2] > 1e-9
        z = np.where(ahead, local[..., 2], 1)
        u = (K[:, None, 0] * local).sum(2) / z
        v = (K[:, None, 1] * local).sum(2) / z
        seen = ahead & (u >= 0) & (v >= 0) & (u < sides[:, :1]) & (v < sides[:, 1:])
        rays = points[None] - centers[:, None]
        rays /= np.maximum(np.sqrt((rays**2).sum(2, keepdims=True)), 1e-12)
        turned = 1 - (rays * rays[i]).sum(2)  # 1 - cosine grows with the square of a small angle
        alike = np.clip((lost - turned) / (lost - most), 0, 1)
        close = np.clip(1 - np.sqrt(np.maximum(turned, 0) / lost), 0, 1)
        overlap[i] = (seen * close).mean(1)
        matching[i] = (seen * alike * np.clip(turned / least, 0, 1)).mean(1)
        matching[i, i] = 0
    return Sight(np.round(overlap, 9), np.round(matching, 9))  # rounding errors must not decide


def matching_views(sight: Sight, cameras: Sequence[Camera], index: int, count: int, among: Sequence[int]) -> list[int]:
    """Return up to ``count`` views to compare a view with: the nearest cameras (ties by order) that share sight with it.

    Views too near for depth are skipped: their angles reduce `Sight.matching` to less than half of `Sight.overlap`. If no view
    is left, the sampled points may have missed the overlap, and the nearest cameras are returned. Choosing the views that share
    most at the best angles gave fewer depths, and mostly lower PSNR (docs/decisions/013-any-capture.md).

    Args:
        sight: What pairs of views share.
        cameras: Cameras of all views.
        index: The view.
        count: Number of views wanted.
        among: Views to choose from; the view itself is left out.
    """
    rest = [j for j in among if j != index]
    matching, overlap = sight.matching[index], sight.overlap[index]
    good = [j for j in rest if matching[j] > 0 and matching[j] >= 0.5 * overlap[j]]
    away = {j: float(np.linalg.norm(cameras[j].center - cameras[index].center)) for j in rest}
    return sorted(good or rest, key=away.get)[:count]


def spread_views(sight: Sight, most: int) -> list[int]:
    """Return up to ``most`` views, in ascending order, chosen to cover as much of the area of all views as possible.

    Each step adds the view that most increases the sum, over all views, of the largest overlap with a chosen view. This greedy
    choice for a submodular sum reaches at least 1 - 1/e of the optimum (Nemhauser et al. 1978).
    """
    count = len(sight.overlap)
    if count <= most:
        return list(range(count))
    shared = np.where(np.eye(count, dtype=bool), 1, sight.overlap)
    covered, taken = np.zeros(count), []
    while len(taken) < most:
        gains = np.maximum(shared - covered[:, None], 0).sum(0).round(9)
        gains[taken] = -1
        taken.append(int(gains.argmax()))
        covered = np.maximum(covered, shared[:, taken[-1]])
    return sorted(taken)
