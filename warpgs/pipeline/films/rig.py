"""Rigs: the arrangement of training cameras around their subject, from their poses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warpgs.geometry import focus_point, inverse, matmul
from warpgs.scene import Camera

KINDS = ("forward", "ring", "room", "free")
NAMES = {
    "forward": "on one side of the scene", "ring": "around the scene", "room": "looking outwards, as in a room",
    "free": "without a known layout",
}  # fmt: skip
"""Description of each kind, to follow "training cameras"."""
MIN_AGREEMENT = 0.8
"""Fraction of the cameras that must look at one point, or away from it."""
MIN_COSINE = 0.8
"""Cosine of the largest angle between a camera's axis and the direction to its subject: 37 degrees, about the corner of a
photograph."""
MIN_RING = math.radians(100)
"""Range of azimuths about a point below which cameras photographed it from one side."""
MAX_GAP = math.radians(150)
"""Largest gap between azimuths of neighbouring cameras that a turntable crosses: three even views have gaps of 120 degrees."""
MIN_FORWARD = 0.5
"""Length of the mean viewing direction above which cameras without a common point look to one side."""
MIN_UP = 0.5
"""Length of the mean of the cameras' upward unit directions above which the directions agree."""
FLAT = 0.02
"""Largest variance of positions across the plane of cameras on a circle, as a fraction of the variance in the plane."""
ROLLED = 0.05
"""The limit `FLAT`, but for the horizontal axes of level photographs, which lean by at most 13 degrees (root mean square)."""
MIN_SAME = math.cos(math.radians(15))
"""Cosine of the largest angle between the normals of two planes that count as equal."""
MIN_SWING = math.radians(6)
"""Smallest range of azimuths of a film, for cameras above each other."""


@dataclass(frozen=True)
class Rig:
    """An arrangement of cameras for films: the point of interest, the upward direction, and the positions of the cameras."""

    kind: str
    """One of `KINDS`: forward (from one side), ring (around a point), room (outwards from a place), free (none of these)."""
    center: np.ndarray
    """Point that the film looks at, or from which it looks around in a room [u], shape [3]."""
    up: np.ndarray
    """Upward direction of the film, length 1, shape [3]."""
    first: np.ndarray
    """Level direction of azimuth 0, perpendicular to ``up``, length 1, shape [3]."""
    span: tuple[float, float] | None
    """First and last azimuth of the cameras (of their viewing directions, in a room) [rad]; None if they cover all sides."""
    distance: float
    """Median distance of the cameras from ``center`` [u]."""
    elevation: float
    """Mean elevation of the cameras above ``center``, or of their viewing directions, in a room [rad]."""
    rise: float
    """Standard deviation of the elevations [rad]."""
    turned: bool
    """True if the photographs are rotated by a quarter turn, so that an upright film swaps width and height."""

    def describe(self) -> str:
        """Return a phrase on the positions of the cameras."""
        if self.span is None:
            return f"{NAMES[self.kind]}, from all sides" if self.kind == "ring" else NAMES[self.kind]
        degrees = math.degrees(self.span[1] - self.span[0])
        return f"{NAMES[self.kind]}, over {degrees:.0f} of 360 degrees" if self.kind != "free" else NAMES[self.kind]

    def direction(self, azimuth: float, elevation: float) -> np.ndarray:
        """Return the unit vector [3] at an azimuth and an elevation [rad]."""
        level = math.cos(azimuth) * self.first + math.sin(azimuth) * np.cross(self.up, self.first)
        return math.cos(elevation) * level + math.sin(elevation) * self.up

    def is_watched(self, cameras: list[Camera]) -> bool:
        """Return whether the rig is around or in front of its centre, and all cameras look at the centre."""
        to_center = [self.center - c.center for c in cameras]
        cosines = [(d * c.viewmat[2, :3]).sum() / max(math.sqrt((d * d).sum()), 1e-12) for c, d in zip(cameras, to_center)]
        return self.kind in ("ring", "forward") and min(cosines) > MIN_COSINE

    def reach(self, camera: Camera) -> float:
        """Return the distance along a camera's axis to the rig's subject [u]; 0 if the cameras have no common subject."""
        if self.kind not in ("ring", "forward"):
            return 0.0
        return max(0.0, float(((self.center - camera.center) * camera.viewmat[2, :3]).sum()))


def _unit(v: np.ndarray) -> np.ndarray:
    return v / math.sqrt((v * v).sum())


def _normal_of(vectors: np.ndarray, largest: float) -> np.ndarray | None:
    """Return the unit normal [3] of the plane through the origin that holds vectors [N, 3]; None if there is none.

    The normal is the eigenvector of the smallest eigenvalue of their second moments, computed by squaring the inverse, without
    LAPACK (see `warpgs.geometry.matmul`). There is no plane if the vectors lie on a line, or if the smallest eigenvalue is
    above ``largest`` times the sum of the others.
    """
    covariance = (vectors[:, :, None] * vectors[:, None, :]).mean(0)
    total = float(np.trace(covariance))
    if not total > 0:
        return None
    power = inverse(covariance / total + 1e-9 * np.eye(3))
    for _ in range(12):
        power = matmul(power, power)
        power = power / np.trace(power)
    normal = _unit(power[:, int(np.diagonal(power).argmax())])
    least = float((normal * matmul(covariance, normal)).sum())
    minors = 0.5 * (total**2 - float((covariance * covariance).sum()))  # sum of the products of pairs of eigenvalues
    both, product = total - least, minors - least * (total - least)
    return normal if least < largest * both and product > 0.05 * both**2 else None


def _upward(cameras: list[Camera], looked_at: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the upward direction [3] of a film, and whether the photographs lie on their side.

    For cameras on a level circle, it is the normal of their plane, which does not depend on the rotation of photographs. If the
    cameras' horizontal axes lie in another plane, it is the normal of that plane: then some photographs are nearer or lower
    than the others. Else it is the mean of the cameras' own upward directions.
    """
    rights, ups, forwards = (sign * np.array([c.viewmat[i, :3] for c in cameras]) for i, sign in ((0, 1), (1, -1), (2, 1)))
    centers = np.array([c.center for c in cameras])
    mean = ups.mean(0)
    length = math.sqrt((mean * mean).sum())
    normal = _normal_of(centers - centers.mean(0), FLAT) if len(cameras) > 2 else None
    if normal is not None and np.abs(matmul(forwards, normal)).mean() < 0.9:
        upright, lying = matmul(ups, normal), matmul(rights, normal)
        few = len(cameras) < 5  # any three centres lie in a plane: it must be that of the photographs, too
        turned = bool((np.abs(lying) > 0.9).all()) if few else float(np.abs(lying).mean()) > 0.8
        level = None if few or turned else _normal_of(rights, ROLLED)
        if level is not None and abs(float((normal * level).sum())) < MIN_SAME:
            normal, upright = level, matmul(ups, level)
        if turned or (not few and np.abs(upright).mean() > 0.5):
            sign = float(upright.mean())
            if abs(sign) < 0.3:  # cameras disagree; people photograph from above
                height = float(matmul(centers - looked_at, normal).mean())
                sign = height if height else float(lying.mean())
            return (normal if sign >= 0 else -normal), turned
    return (mean / length if length > 0.2 else ups[0]), False


def _span(azimuths: np.ndarray) -> tuple[float, float] | None:
    """Return the ends of the shortest range that holds all azimuths [N] [rad]; None if no gap is above `MAX_GAP`."""
    ordered = np.sort(azimuths % (2 * np.pi))
    gaps = np.diff(np.append(ordered, ordered[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    if gaps[widest] <= MAX_GAP:
        return None
    begin = float(ordered[(widest + 1) % len(ordered)])
    return begin, begin + float(2 * np.pi - gaps[widest])


def _azimuths(directions: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return azimuths [N] and elevations [N] of directions [N, 3] about ``up`` [rad], and the direction [3] of azimuth 0."""
    heights = matmul(directions, up)
    level = directions - heights[:, None] * up
    first = (
        level[0] if (level[0] ** 2).sum() > 1e-12 * (directions[0] ** 2).sum() else np.cross(up, np.eye(3)[np.abs(up).argmin()])
    )
    first = _unit(first)
    azimuths = np.arctan2(matmul(level, np.cross(up, first)), matmul(level, first))
    return azimuths, np.arctan2(heights, np.sqrt((level * level).sum(1))), first


def _kind(cameras: list[Camera], focus: np.ndarray, depth: float) -> str:
    """Return one of `KINDS`; a ring may still turn out to be from one side."""
    centers, forwards = np.array([c.center for c in cameras]), np.array([c.viewmat[2, :3] for c in cameras])
    to_focus = focus - centers
    distances = np.sqrt((to_focus * to_focus).sum(1))
    cosines = (to_focus * forwards).sum(1) / np.maximum(distances, 1e-12)
    if (cosines > MIN_COSINE).mean() >= MIN_AGREEMENT:
        return "ring"
    offsets = centers - centers.mean(0)
    mean = forwards.mean(0)
    length = math.sqrt((mean * mean).sum())
    if length > MIN_FORWARD:
        along = np.abs(matmul(offsets, mean / length)).max()
        return "forward" if along < depth else "free"
    spread = math.sqrt((offsets * offsets).sum(1).max())
    outwards = (cosines < -MIN_COSINE).mean() >= MIN_AGREEMENT
    return "room" if outwards or spread < 0.5 * depth else "free"


def rig_of(cameras: list[Camera], depth: float) -> Rig:
    """Return the arrangement of cameras around their subject.

    If the optical axes meet, the subject is the point nearest to all axes. If the cameras see it from one side, or the axes are
    nearly parallel, the subject is ``depth`` in front of their mean centre.

    Args:
        cameras: Training cameras, at least one.
        depth: Distance from the cameras to their subject [u], above 0.
    """
    centers, forwards = np.array([c.center for c in cameras]), np.array([c.viewmat[2, :3] for c in cameras])
    focus = focus_point(cameras)
    kind = _kind(cameras, focus, depth)
    if kind == "ring":
        up, turned = _upward(cameras, focus)
        span = _span(_azimuths(centers - focus, up)[0])
        if span is not None and span[1] - span[0] < MIN_RING:
            kind = "forward"
    if kind == "forward":
        focus = centers.mean(0) + depth * _unit(forwards.mean(0))
        up, turned = _upward(cameras, focus)
    elif kind != "ring":
        focus = centers.mean(0) if kind == "room" else (centers + depth * forwards).mean(0)
        up, turned = _upward(cameras, focus)
    directions = forwards if kind == "room" else centers - focus
    azimuths, elevations, first = _azimuths(directions, up)
    distances = np.sqrt(((centers - focus) ** 2).sum(1))
    return Rig(
        kind, focus, up, first, _span(azimuths), float(np.median(distances)), float(elevations.mean()),
        float(elevations.std()), turned,
    )  # fmt: skip


def up_of(cameras: list[Camera], points: np.ndarray) -> np.ndarray:
    """Return the upward direction of a scene for films: of length 1, shape [3].

    Args:
        cameras: Training cameras, at least one.
        points: Points that they show, such as the means of Gaussians [u], shape [N, 3].
    """
    depths = np.concatenate([matmul(points - c.center, c.viewmat[2, :3]) for c in cameras[:: max(1, len(cameras) // 5)]])
    ahead = depths[depths > 0]
    return rig_of(cameras, float(np.median(ahead)) if len(ahead) else 1.0).up


def common_up(cameras: list[Camera]) -> np.ndarray | None:
    """Return the upward unit vector [3] that cameras agree on, as films use it; None if they do not agree."""
    up, turned = _upward(cameras, focus_point(cameras))
    mean = np.mean([c.viewmat[1, :3] for c in cameras], axis=0)
    return up if turned or (mean * mean).sum() >= MIN_UP**2 else None
