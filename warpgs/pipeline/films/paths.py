"""Paths of cameras: around a scene, through its views, along keyframes."""

import itertools
import math
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from warpgs import geometry, schema
from warpgs.errors import DataError, explained
from warpgs.files import read_input
from warpgs.scene import Camera, Normalization

NAMES = {
    "forward": "on one side of the scene", "ring": "around the scene", "room": "looking outwards, as in a room",
    "free": "without a known layout",
}  # fmt: skip
"""Kinds of rigs, with descriptions that follow "training cameras"."""
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
FAR = 0.8
"""Quantile of the cameras' distances from the subject at which a film keeps it whole, as a fifth of the photographs do."""
CLOSE = 0.6
"""Distance below which a photograph is a close-up, as a fraction of the distance of a film."""
MIN_SWING = math.radians(6)
"""Smallest range of azimuths of a film, for cameras above each other."""


@dataclass(frozen=True)
class Rig:
    """An arrangement of cameras for films: the point of interest, the upward direction, and the positions of the cameras."""

    kind: str
    """One of `NAMES`: forward (from one side), ring (around a point), room (outwards from a place), free (none of these)."""
    center: np.ndarray
    """Point that the film looks at, or from which it looks around in a room [u], shape [3]."""
    up: np.ndarray
    """Upward direction of the film, length 1, shape [3]."""
    first: np.ndarray
    """Level direction of azimuth 0, perpendicular to ``up``, length 1, shape [3]."""
    span: tuple[float, float] | None
    """First and last azimuth of the cameras (of their viewing directions, in a room) [rad]; None if they cover all sides."""
    distance: float
    """Distance of the farther cameras from ``center`` [u], quantile `FAR`: nearer photographs may cut the subject off."""
    elevation: float
    """Mean elevation of the cameras above ``center``, or of their viewing directions, in a room [rad]."""
    rise: float
    """Standard deviation of the elevations [rad]."""
    turned: bool
    """True if the photographs are rotated by a quarter turn, so that an upright film swaps width and height."""

    def describe(self) -> str:
        """Return a phrase on the positions of the rig's cameras."""
        words = NAMES[self.kind]
        if self.span is None:
            return f"{words}, from all sides" if self.kind == "ring" else words
        over = f", over {math.degrees(self.span[1] - self.span[0]):.0f} of 360 degrees"
        return words + over * (self.kind in ("ring", "room"))

    def direction(self, azimuth: float, elevation: float) -> np.ndarray:
        """Return the unit vector [3] at an azimuth and an elevation [rad]."""
        level = math.cos(azimuth) * self.first + math.sin(azimuth) * np.cross(self.up, self.first)
        return math.cos(elevation) * level + math.sin(elevation) * self.up

    def is_watched(self, cameras: list[Camera]) -> bool:
        """Return whether the rig is around or in front of its centre, and all cameras look at the centre."""
        to_center = [self.center - c.center for c in cameras]
        cosines = [(d * c.viewmat[2, :3]).sum() / max(_length(d), 1e-12) for c, d in zip(cameras, to_center)]
        return self.kind in ("ring", "forward") and min(cosines) > MIN_COSINE

    def reach(self, camera: Camera) -> float:
        """Return the distance along a camera's axis to the rig's subject [u]; 0 if the cameras have no common subject."""
        if self.kind not in ("ring", "forward"):
            return 0.0
        return max(0.0, float(((self.center - camera.center) * camera.viewmat[2, :3]).sum()))


def _length(v: np.ndarray) -> float:
    return math.sqrt((v * v).sum())


def _unit(v: np.ndarray) -> np.ndarray:
    return v / _length(v)


def _normal_of(vectors: np.ndarray, largest: float) -> np.ndarray | None:
    """Return the unit normal [3] of the plane through the origin that holds vectors [N, 3]; None if there is none."""
    # The normal is the eigenvector of the smallest eigenvalue of their second moments, computed by squaring the inverse,
    # without LAPACK (see `warpgs.geometry.matmul`). There is no plane if the vectors lie on a line, or if the smallest
    # eigenvalue is above ``largest`` times the sum of the others.
    covariance = (vectors[:, :, None] * vectors[:, None, :]).mean(0)
    if not (total := float(np.trace(covariance))) > 0:
        return None
    power = geometry.inverse(covariance / total + 1e-9 * np.eye(3))
    for _ in range(12):
        power = geometry.matmul(power, power)
        power = power / np.trace(power)
    normal = _unit(power[:, int(np.diagonal(power).argmax())])
    least = float((normal * geometry.matmul(covariance, normal)).sum())
    minors = 0.5 * (total**2 - float((covariance * covariance).sum()))  # sum of the products of pairs of eigenvalues
    both, product = total - least, minors - least * (total - least)
    return normal if least < largest * both and product > 0.05 * both**2 else None


def _upward(cameras: list[Camera], looked_at: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the upward direction [3] of a film, and whether the photographs lie on their side."""
    # For cameras on a level circle, it is the normal of their plane, which does not depend on the rotation of photographs. If
    # the cameras' horizontal axes lie in another plane, it is the normal of that plane: then some photographs are nearer or
    # lower than the others. Else it is the mean of the cameras' own upward directions.
    rights, ups, forwards = (sign * np.array([c.viewmat[i, :3] for c in cameras]) for i, sign in ((0, 1), (1, -1), (2, 1)))
    centers = np.array([c.center for c in cameras])
    mean, length = ups.mean(0), _length(ups.mean(0))
    normal = _normal_of(centers - centers.mean(0), FLAT) if len(cameras) > 2 else None
    if normal is not None and np.abs(geometry.matmul(forwards, normal)).mean() < 0.9:
        upright, lying = geometry.matmul(ups, normal), geometry.matmul(rights, normal)
        few = len(cameras) < 5  # any three centres lie in a plane: it must be that of the photographs, too
        turned = bool((np.abs(lying) > 0.9).all()) if few else float(np.abs(lying).mean()) > 0.8
        level = None if few or turned else _normal_of(rights, ROLLED)
        if level is not None and abs(float((normal * level).sum())) < MIN_SAME:
            normal, upright = level, geometry.matmul(ups, level)
        if turned or (not few and np.abs(upright).mean() > 0.5):
            sign = float(upright.mean())
            if abs(sign) < 0.3:  # cameras disagree; people photograph from above
                height = float(geometry.matmul(centers - looked_at, normal).mean())
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
    heights = geometry.matmul(directions, up)
    level = directions - heights[:, None] * up
    flat = (level[0] ** 2).sum() > 1e-12 * (directions[0] ** 2).sum()
    first = _unit(level[0] if flat else np.cross(up, np.eye(3)[np.abs(up).argmin()]))
    azimuths = np.arctan2(geometry.matmul(level, np.cross(up, first)), geometry.matmul(level, first))
    return azimuths, np.arctan2(heights, np.sqrt((level * level).sum(1))), first


def _kind(cameras: list[Camera], focus: np.ndarray, depth: float) -> str:
    """Return one of `NAMES`; a ring may still turn out to be from one side."""
    centers, forwards = np.array([c.center for c in cameras]), np.array([c.viewmat[2, :3] for c in cameras])
    to_focus = focus - centers
    cosines = (to_focus * forwards).sum(1) / np.maximum(np.sqrt((to_focus * to_focus).sum(1)), 1e-12)
    if (cosines > MIN_COSINE).mean() >= MIN_AGREEMENT:
        return "ring"
    offsets = centers - centers.mean(0)
    mean = forwards.mean(0)
    if _length(mean) > MIN_FORWARD:
        return "forward" if np.abs(geometry.matmul(offsets, _unit(mean))).max() < depth else "free"
    spread = math.sqrt((offsets * offsets).sum(1).max())
    return "room" if (cosines < -MIN_COSINE).mean() >= MIN_AGREEMENT or spread < 0.5 * depth else "free"


def rig_of(cameras: list[Camera], depth: float, level: np.ndarray | None = None) -> Rig:
    """Return the arrangement of cameras around their subject, ``depth`` [u] in front of them if their axes do not meet.

    ``level`` is the upward direction [3], if it is known.
    """
    # If the optical axes meet, the subject is the point nearest to all axes. If the cameras see it from one side, or the axes
    # are nearly parallel, the subject is ``depth`` in front of their mean centre.
    centers, forwards = np.array([c.center for c in cameras]), np.array([c.viewmat[2, :3] for c in cameras])
    focus = geometry.focus_point(cameras)
    kind = _kind(cameras, focus, depth)
    if kind == "ring":
        span = _span(_azimuths(centers - focus, _upward(cameras, focus)[0] if level is None else level)[0])
        kind = "forward" if span is not None and span[1] - span[0] < MIN_RING else kind
    if kind == "forward":
        focus = centers.mean(0) + depth * _unit(forwards.mean(0))
    elif kind != "ring":
        focus = centers.mean(0) if kind == "room" else (centers + depth * forwards).mean(0)
    up, turned = _upward(cameras, focus)
    up = up if level is None else level
    azimuths, elevations, first = _azimuths(forwards if kind == "room" else centers - focus, up)
    distances = np.sqrt(((centers - focus) ** 2).sum(1))
    return Rig(
        kind, focus, up, first, _span(azimuths), float(np.quantile(distances, FAR)), float(elevations.mean()),
        float(elevations.std()), turned,
    )  # fmt: skip


def rig_among(cameras: list[Camera], points: np.ndarray) -> Rig:
    """Return the arrangement of training cameras around their subject among points [N, 3] [u]."""
    some = cameras[:: max(1, len(cameras) // 5)]
    depths = np.concatenate([geometry.matmul(points - c.center, c.viewmat[2, :3]) for c in some])
    ahead = depths[depths > 0]
    return rig_of(cameras, float(np.median(ahead)) if len(ahead) else 1.0)


def common_up(cameras: list[Camera]) -> np.ndarray | None:
    """Return the upward unit vector [3] that cameras agree on, as films use it; None if they do not agree."""
    up, turned = _upward(cameras, geometry.focus_point(cameras))
    mean = np.mean([c.viewmat[1, :3] for c in cameras], axis=0)
    return up if turned or (mean * mean).sum() >= MIN_UP**2 else None


BY_KIND = {"forward": "spiral", "ring": "turntable", "room": "turntable", "free": "interpolate"}
"""Default path for each kind of rig."""
WIDE_ARC = math.radians(75)
"""Largest range of azimuths [rad] of cameras on one side for a spiral; for wider ranges, a film goes from photograph to
photograph, because a spiral would leave the captured area."""
SWING = 0.9
"""Fraction of the cameras' range that a film swings through: coverage is lower at the ends of the range."""
MAX_ELEVATION = math.radians(80)
"""Largest elevation of a film's cameras: near the zenith, the upward direction is ambiguous."""
LIMITS = {"width": (16, 8192), "fov": (1.0, 170.0)}
"""Smallest and largest value of a film's sides [px], and of its vertical field of view [deg]."""


def framed(camera: Camera, size: tuple[int, int] | None = None, fov_y: float | None = None, turned: bool = False) -> Camera:
    """Return a pinhole camera with the size [px] and vertical field of view [rad] of a film; ``turned`` swaps the sides.

    Without a field of view, a frame of another shape is a part of what the camera sees.
    """
    camera = geometry.pinhole_of(camera)
    K, width, height = camera.K, camera.width, camera.height
    if turned:
        K, width, height = K[[1, 0, 2]][:, [1, 0, 2]], height, width
    if size is None and fov_y is None:
        return replace(camera, K=K, width=width, height=height)
    new = size or (width, height)
    fy = K[1, 1] * max(new[0] / width, new[1] / height) if fov_y is None else 0.5 * new[1] / math.tan(0.5 * fov_y)
    fx, zoom = fy * K[0, 0] / K[1, 1], fy / K[1, 1]
    cx, cy = (0.5 * new[i] + zoom * (K[i, 2] - 0.5 * old) for i, old in enumerate((width, height)))
    return replace(camera, K=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), width=new[0], height=new[1])


def path_of(rig: Rig) -> str:
    """Return the default path of a rig."""
    wide = rig.kind == "forward" and rig.span is not None and rig.span[1] - rig.span[0] > WIDE_ARC
    return "interpolate" if wide else BY_KIND[rig.kind]


def upright(rig: Rig, camera: Camera) -> Camera:
    """Return an upright camera with the same centre and axis, for rotated photographs."""
    if not rig.turned:
        return camera
    pose = geometry.look_at(camera.center, camera.center + camera.viewmat[2, :3], rig.up)
    return replace(framed(camera, turned=True), viewmat=pose)


def _spiral_to_one_side(rig: Rig, cameras: list[Camera], frames: int) -> list[np.ndarray]:
    """Return poses along two turns that widen and narrow again among the cameras, all looking at the rig's centre."""
    center = np.mean([c.center for c in cameras], axis=0)
    depth, forward = rig.distance, _unit(rig.center - center)
    side = _unit(np.cross(forward, rig.up))
    up = np.cross(side, forward)
    offsets = np.array([c.center for c in cameras]) - center
    center = rig.center - depth * forward
    spans = [max(0.7 * float(np.abs(geometry.matmul(offsets, axis)).max()), 0.03 * depth) for axis in (side, up)]
    poses = []
    for t in np.arange(frames) / frames:
        # not nearer, where Gaussians look like needles and the subject is cut off; not farther, where the image border shows
        # unobserved areas
        angle, radius = 4 * np.pi * t, np.sin(np.pi * t)
        eye = center + radius * (spans[0] * np.cos(angle) * side + spans[1] * np.sin(angle) * up)
        poses.append(geometry.look_at(eye, rig.center, up))
    return poses


def _turn(rig: Rig, frames: int, turns: int, rise: float) -> list[np.ndarray]:
    """Return poses on a circle about the rig's centre, or looking around from it, with an elevation of ``rise`` [rad]."""
    poses = []
    for t in np.arange(frames) / frames:
        azimuth = 2 * np.pi * turns * t
        if rig.span is not None:
            reach = SWING * max(rig.span[1] - rig.span[0], MIN_SWING)
            azimuth = 0.5 * (rig.span[0] + rig.span[1]) + 0.5 * reach * math.sin(azimuth)
        elevation = float(np.clip(rig.elevation + rise * math.sin(2 * np.pi * t), -MAX_ELEVATION, MAX_ELEVATION))
        direction = rig.direction(azimuth, elevation)
        inwards = rig.center + rig.distance * direction, rig.center
        poses.append(geometry.look_at(*((rig.center, rig.center + direction) if rig.kind == "room" else inwards), rig.up))
    return poses


def typical(cameras: list[Camera]) -> Camera:
    """Return the first of the cameras that have the most common shape, upright or wide, and size."""
    shapes = [(c.width < c.height, c.width, c.height) for c in cameras]
    upright = 2 * sum(s[0] for s in shapes) > len(shapes)
    counts = Counter(s for s in shapes if s[0] == upright)
    return cameras[shapes.index(max(counts, key=counts.__getitem__))]


def camera_path(kind: str, rig: Rig, cameras: list[Camera], frames: int) -> list[Camera]:
    """Return cameras on a closed path, turntable or spiral, with size and intrinsics of a typical one of ``cameras``."""
    if kind == "turntable":
        poses = _turn(rig, frames, 1, 0.0)
    else:
        poses = _spiral_to_one_side(rig, cameras, frames) if rig.kind == "forward" else _turn(rig, frames, 2, rig.rise)
    template = framed(typical(cameras), turned=rig.turned)
    return [replace(template, viewmat=pose) for pose in poses]


MAX_KEYFRAMES = 10_000
MAX_BYTES = 16 * 2**20
"""Size of the largest file of keyframes [bytes]."""
MAX_SKEW = 1e-3
"""Largest entry of R R^T - I for the upper left 3 x 3 matrix R of a pose in a file."""
MIN_SECONDS, MAX_SECONDS = 1e-3, 86400.0
"""Least and largest time from one keyframe to the next [s]: slopes of the path stay finite."""
MAX_REACH = 1e12
"""Largest coordinate of a camera centre in a file."""


@dataclass(frozen=True)
class Keyframe:
    """A camera that a path passes through at a time."""

    camera: Camera
    """The camera, a pinhole."""
    seconds: float
    """Time at which the path passes through the camera [s]."""
    reach: float = 0.0
    """Distance along the optical axis to the point that the camera looks at [u]; 0 if unknown."""


def fov_y(camera: Camera, aspect: float = math.inf) -> float:
    """Return the vertical field of view [rad] at which a window shows a camera's whole image, centred."""
    return 2 * math.atan(max(0.5 * camera.height / float(camera.K[1, 1]), 0.5 * camera.width / float(camera.K[0, 0]) / aspect))


def _row(keyframe: Keyframe) -> np.ndarray:
    """Return a row [9]: point looked at [u], quaternion wxyz of world_from_camera, vertical field of view [rad], reach [u]."""
    camera = keyframe.camera
    rotation = torch.from_numpy(np.ascontiguousarray(camera.viewmat[:3, :3].T, dtype=np.float64))
    point = camera.center + keyframe.reach * camera.viewmat[2, :3]
    return np.concatenate([point, geometry.quaternions(rotation[None])[0].numpy(), [fov_y(camera), keyframe.reach]])


def _spline(rows: np.ndarray, times: np.ndarray, at: np.ndarray, closed: bool) -> np.ndarray:
    """Return the values [F, 9] at times [F] of a smooth curve through rows [N, 9] at rising times [N]."""
    # The pieces are cubic Hermite. The slope at each row is that of the parabola through this row and its two neighbours
    # (Catmull and Rom 1974, for uneven times). In a closed curve, the last row repeats the first.
    steps = np.diff(times)
    slopes = np.diff(rows, axis=0) / steps[:, None]
    tangents = np.empty_like(rows)
    weights = (steps[:-1] / (steps[:-1] + steps[1:]))[:, None]
    tangents[1:-1] = (1 - weights) * slopes[:-1] + weights * slopes[1:]
    tangents[0], tangents[-1] = slopes[0], slopes[-1]
    if closed:
        weight = steps[-1] / (steps[-1] + steps[0])
        sign = np.ones(rows.shape[1])  # the same rotation may end as the opposite quaternion
        sign[3:7] = 1 if (rows[0, 3:7] * rows[-1, 3:7]).sum() > 0 else -1
        tangents[-1] = (1 - weight) * slopes[-1] + weight * sign * slopes[0]
        tangents[0] = sign * tangents[-1]
    i = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(steps) - 1)
    h = steps[i][:, None]
    s = np.clip((at - times[i])[:, None] / h, 0, 1)
    return (
        (1 + 2 * s) * (1 - s) ** 2 * rows[i] + s * (1 - s) ** 2 * h * tangents[i]
        + s * s * (3 - 2 * s) * rows[i + 1] - s * s * (1 - s) * h * tangents[i + 1]
    )  # fmt: skip


def through(keyframes: list[Keyframe], frames: int, *, closed: bool = False) -> list[Camera]:
    """Return cameras on a smooth curve through keyframes, at even times; a closed path ends one frame before its end."""
    # One spline interpolates the points looked at, the distances to them, rotations and fields of view. So an object that all
    # cameras look at stays in place while they go around it. Rotations are quaternions, normalised at each frame: between
    # neighbours they turn nearly as evenly as by spherical interpolation, and they do not jerk at a keyframe.
    if len(keyframes) == 1:
        return [keyframes[0].camera] * frames
    rows = np.array([_row(k) for k in keyframes])
    for before, row in itertools.pairwise(rows):  # q and -q are one rotation; neighbours take the nearer way
        if (before[3:7] * row[3:7]).sum() < 0:
            row[3:7] *= -1
    times = np.array([k.seconds for k in keyframes])
    at = times[0] + (times[-1] - times[0]) * np.arange(frames) / max(frames if closed else frames - 1, 1)
    template, cameras = typical([k.camera for k in keyframes]), []
    for row in _spline(rows, times, at, closed):
        rotation = geometry.rotation_matrices(row[3:7] / math.sqrt((row[3:7] ** 2).sum())).T
        camera = replace(template, viewmat=geometry.pose_at(rotation, row[:3] - row[8] * rotation[2]))
        same = abs(row[7] - fov_y(template)) < 1e-9
        cameras.append(camera if same else framed(camera, None, float(np.clip(row[7], 0.01, 3.1))))
    return cameras


KEYFRAMES = schema.items(schema.fields({
    "c2w": schema.items(schema.items(schema.number(), 4), 4),
    "fov_y": schema.number(0.01, high=3.1), "seconds": schema.number(0.0),
}))  # fmt: skip


def read_keyframes(path: Path, template: Camera, normalization: Normalization) -> list[Keyframe]:
    """Read keyframes of a JSON file (OpenCV camera-to-world, file units) into scene units, the first at 0 s."""
    with explained(f"{path}: no keyframes", "list objects of c2w (4 x 4), fov_y [rad], seconds", (OSError, schema.SchemaError)):
        values = schema.parse(read_input(path, MAX_BYTES))
        KEYFRAMES(values, "keyframes")
    if not 1 <= len(values) <= MAX_KEYFRAMES:
        raise DataError(f"{path}: holds {len(values)} keyframes; a path needs 1 to {MAX_KEYFRAMES:,}")
    K = np.array([[template.K[0, 0], 0, 0.5 * template.width], [0, template.K[1, 1], 0.5 * template.height], [0, 0, 1.0]])
    template, result = replace(geometry.pinhole_of(template), K=K), []
    for i, value in enumerate(values):
        matrix = np.array(value["c2w"], np.float64)
        rotation = np.clip(matrix[:3, :3], -2, 2)  # so that no square overflows
        square = geometry.matmul(rotation, rotation.T)
        right_handed = float((np.cross(rotation[0], rotation[1]) * rotation[2]).sum()) > 0
        rigid = np.abs(square - np.eye(3)).max() <= MAX_SKEW and right_handed and (matrix[3] == (0, 0, 0, 1)).all()
        if not rigid or np.abs(matrix[:3, 3]).max() > MAX_REACH:
            fix = f"its upper left 3 x 3 a rotation, its last column within {MAX_REACH:g}, and its last row 0 0 0 1"
            raise DataError(f"{path}: c2w of keyframe {i} must be a rigid camera-to-world matrix: {fix}")
        if result and not MIN_SECONDS <= value["seconds"] - values[i - 1]["seconds"] <= MAX_SECONDS:
            raise DataError(f"{path}: keyframe {i} must be {MIN_SECONDS:g} to {MAX_SECONDS:g} s after the last; sort by time")
        viewmat = geometry.pose_at(geometry.nearest_rotation(rotation).T, matrix[:3, 3])
        camera = geometry.convert_camera(replace(template, viewmat=viewmat), normalization, "file", "scene")
        result.append(Keyframe(framed(camera, None, value["fov_y"]), value["seconds"] - values[0]["seconds"]))
    return result


MAX_DETOUR = 1.5
"""Longest accepted tour in the order of names, as a multiple of the length of the tour from neighbour to neighbour."""
MAX_IMPROVED = 200
"""Largest number of views for which every pair of legs is checked; longer tours are smooth enough without the check."""


def _distances(cameras: list[Camera]) -> list[list[float]]:
    """Return how far apart cameras are, N x N: distance in units of their extent, plus the angle between their poses [rad]."""
    centers, rotations = np.array([c.center for c in cameras]), np.array([c.viewmat[:3, :3] for c in cameras]).reshape(-1, 9)
    apart = np.sqrt(((centers[:, None] - centers[None]) ** 2).sum(-1))
    cosines = np.clip((geometry.matmul(rotations, rotations.T) - 1) / 2, -1, 1)
    return (apart / max(float(apart.max()), 1e-12) + np.arccos(cosines) + 1e-6).tolist()


def _neighbour_tour(distances: list[list[float]]) -> list[int]:
    """Return an order of N cameras, each followed by the nearest unvisited one; then crossings are removed (2-opt)."""
    count = len(distances)
    order, left = [0], set(range(1, count))
    while left:
        order.append(min(left, key=lambda j: (distances[order[-1]][j], j)))
        left.remove(order[-1])

    def leg(i: int, j: int) -> float:
        return distances[order[i]][order[j]] if i >= 0 and j < count else 0.0

    improved = count <= MAX_IMPROVED
    while improved:
        improved = False
        for i in range(count - 1):
            for j in range(i + 1, count):
                if leg(i - 1, j) + leg(i, j + 1) < leg(i - 1, i) + leg(j, j + 1) - 1e-9:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    improved = True
    return order


def midways(rig: Rig, cameras: list[Camera], most: int) -> list[tuple[int, int, Camera]]:
    """Return upright cameras midway between up to ``most`` pairs of neighbouring cameras, with the indices of each pair."""
    distances = np.array(_distances(cameras))
    np.fill_diagonal(distances, np.inf)
    pairs = sorted({(min(i, j), max(i, j)) for i, j in enumerate(distances.argmin(1).tolist())}) if len(cameras) > 1 else []
    chosen = geometry.evenly_spaced(pairs, most)
    frames = [framed(upright(rig, c)) for c in cameras]
    ends = [[Keyframe(frames[k], t, rig.reach(cameras[k])) for t, k in enumerate(pair)] for pair in chosen]
    return [(i, j, through(keyframes, 3)[1]) for (i, j), keyframes in zip(chosen, ends)]


def tour_of(cameras: list[Camera], reaches: list[float], seconds: float, most: int) -> tuple[list[Keyframe], bool, bool]:
    """Return a path through at most ``most`` views at an even pace, whether it is closed, and whether it is by their names."""
    # The views are passed in the order of their names if this path is not much longer than one from neighbour to neighbour:
    # then the names probably follow the order of capture. The path is closed if its ends are neighbours.
    distances = _distances(cameras)
    named, near = list(range(len(cameras))), _neighbour_tour(distances)
    lengths = [float(sum(distances[a][b] for a, b in itertools.pairwise(o))) for o in (named, near)]
    by_name = lengths[0] <= MAX_DETOUR * lengths[1]
    order = geometry.evenly_spaced(named if by_name else near, max(most, 2))
    legs = [distances[a][b] for a, b in itertools.pairwise(order)]
    closed = len(order) > 3 and distances[order[-1]][order[0]] < 2 * max(legs)
    if closed:
        legs.append(distances[order[-1]][order[0]])
        order = [*order, order[0]]
    times = np.concatenate([[0.0], np.cumsum(legs)])
    times = times * (seconds / times[-1]) if len(order) > 1 else times
    return [Keyframe(cameras[i], float(t), reaches[i]) for i, t in zip(order, times)], closed, by_name
