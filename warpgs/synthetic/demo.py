"""The demo scenes: a room to fit, and an object cut out."""

import functools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from warpgs.errors import ResourceError, UsageError, explained
from warpgs.files import filling, is_empty, make_folder, write_bytes
from warpgs.geometry import look_at, matmul, pose_of
from warpgs.process import Say, counted, silent
from warpgs.report.images import png
from warpgs.scene import Camera
from warpgs.synthetic import raycast
from warpgs.synthetic.raycast import Box, Cylinder, Light, Plane, Shape, Sphere, Texture, Torus

# The demo scene: a textured still life, ray cast here and written as a COLMAP folder, so that a fit needs no download.
#
# Six images suffice to reconstruct it: everything is smooth and matte, and the training views surround the held-out
# ones. But copies of training images do not help: between neighbouring views the pattern moves by more than half its
# period, so neither a training image nor a mean of training images resembles a held-out view pixel by pixel.

TRAIN_VIEWS = 6
MIN_VIEWS = 8
MIN_SIDE = 32  # [px]; below that nothing of the texture is left
CANDIDATES = 4800  # surface points tried at 320 x 240; fewer in smaller images, in proportion to the pixels
TAU = 2 * np.pi
CRISPNESS = 2.8  # gain before the tanh that rounds the checker's edges


def checker_texture(rng: np.random.Generator, low: str, high: str, period: float, kind: str = "solid") -> Texture:
    """Return a rounded checker of ``period`` [u] in two colours (hexadecimal), with five waves of 0.6 to 2.2 times that."""
    directions = rng.normal(size=(5, 3))
    if kind == "flat":
        directions[:, 2] = 0
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    octaves = np.geomspace(0.45, 1.6, 5)
    tints = rng.normal(size=(5, 3))
    tints *= 0.15 * np.sqrt(octaves[0] / octaves)[:, None] / np.linalg.norm(tints, axis=1, keepdims=True)
    waves = directions * (octaves * TAU / period)[:, None]
    colors = np.array([[int(c[i : i + 2], 16) / 255 for i in (0, 2, 4)] for c in (low, high)])
    phases = rng.uniform(0, TAU, 8)
    if kind == "box":
        phases[:3] = TAU / 4

    def albedo(p: np.ndarray) -> np.ndarray:
        dt = p.dtype
        product = np.ones(len(p), dt)
        for axis in range(2 if kind == "flat" else 3):
            product *= np.sin(p[:, axis] * dt.type(TAU / period) + dt.type(phases[axis]))
        mix = (0.5 + 0.5 * np.tanh(dt.type(CRISPNESS) * product))[:, None]
        dark, bright = colors.astype(dt)
        ripple = matmul(np.sin(matmul(p, waves.T.astype(dt)) + phases[3:].astype(dt)), tints.astype(dt))
        return np.clip(dark + mix * (bright - dark) + ripple, 0.0, 1.0)

    return albedo


def _turn(x: float = 0.0, y: float = 0.0) -> np.ndarray:
    """Return the rotation by ``x`` degrees about the x axis, then by ``y`` degrees about the y axis, shape [3, 3]."""
    (cx, cy), (sx, sy) = np.cos(np.radians([x, y])), np.sin(np.radians([x, y]))
    return matmul(np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]), np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]))


def still_life(seed: int = 0) -> list[Shape]:
    """Return the scene's shapes: four planes that fill the frame, then six objects that hide one another."""
    surface = functools.partial(checker_texture, np.random.default_rng(seed))
    return [
        Plane((0, 0, 6.4), surface("1a3a5f", "f7e6c6", 0.92, "flat")),
        Plane((-3.3, 0, 0), surface("7a2a22", "f5be78", 1.1, "flat"), _turn(y=-90)),
        Plane((3.3, 0, 0), surface("1a5c4d", "c2e4a0", 1.1, "flat"), _turn(y=90)),
        Plane((0, 1.3, 0), surface("3a2a24", "f2dfc0", 0.9, "flat"), _turn(x=-90)),
        Sphere((-0.85, 0.6, 4.3), surface("143a9e", "facc40", 0.6), size=0.7),
        Box((0.95, 0.65, 4.9), surface("b22433", "fadbb4", 0.6, "box"), _turn(y=32), half=(0.6, 0.65, 0.6)),
        Torus((0.3, 1.08, 3.5), surface("0d6b66", "faed8c", 0.42), ring=0.5, tube=0.22),
        Cylinder((-2.1, 0.3, 5.3), surface("5c1a75", "f5c4dc", 0.7), size=0.42, half_height=1.0),
        Sphere((0.95, -0.33, 4.9), surface("1a6629", "f2f2bf", 0.42), size=0.33),
        Box((2.05, 0.9, 3.9), surface("1f2973", "b2e6fa", 0.4, "box"), _turn(y=-20), half=(0.4, 0.4, 0.4)),
    ]


def camera_path(views: int, width: int, height: int) -> list[Camera]:
    """Return cameras along a wave from left to right; its crests and troughs are the training views."""
    focal = 0.95 * max(width, height * 4 / 3)
    K = np.array([[focal, 0, 0.515 * width], [0, focal, 0.485 * height], [0, 0, 1]])
    out = []
    for u in np.linspace(0, 1, views):
        sweep, wave = 2 * u - 1, np.cos(np.pi * (TRAIN_VIEWS - 1) * u)
        center = np.array([1.6 * sweep, -0.55 - 0.45 * wave, 0.2 * sweep**2])
        target = np.array([0.4 * center[0], 0.35 + 0.35 * center[1], 5.0])
        out.append(Camera(look_at(center, target, np.array([0, -1, 0])), K, width, height))
    return out


def _split(views: int, train: set[int]) -> str:
    """Return a split by the names of the images, all but those of ``train`` held out."""
    names = [",".join(f"{i:03d}.png" for i in range(views) if (i in train) is wanted) for wanted in (True, False)]
    return f"train={names[0]};test={names[1]}"


def split_spec(views: int) -> str:
    """Return the split of a demo with that many views: six evenly spaced training views, all others held out."""
    return _split(views, {round(i) for i in np.linspace(0, views - 1, TRAIN_VIEWS).tolist()})


def _project(camera: Camera, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return image positions [px], shape [N, 2], and depths [u], shape [N], of world points [u], shape [N, 3]."""
    # as in the demo's first version: `geometry.project_points` rounds otherwise, which would change its files
    p = matmul(x, camera.viewmat[:3, :3].T) + camera.viewmat[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = p[:, :2] / p[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    return xy, p[:, 2]


def _sees(shapes: list[Shape], camera: Camera, x: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return whether a camera sees surface points [N, 3] [u] of the shapes ``index`` [N] well enough for a feature detector."""
    xy, depth = _project(camera, x)
    seen = (depth > 0) & (xy >= 2).all(axis=1) & (xy <= np.array([camera.width, camera.height]) - 2).all(axis=1)
    for offset in ((0, 0), (-1.5, 0), (1.5, 0), (0, -1.5), (0, 1.5)):
        rows = np.flatnonzero(seen)
        t, which = raycast.cast(shapes, camera.center, raycast.pixel_rays(camera.K, camera.viewmat, xy[rows] + offset))
        same = which == index[rows]
        if offset == (0, 0):
            distance = np.linalg.norm(x[rows] - camera.center, axis=1)
            same &= np.abs(t - distance) < 1e-4 * distance
        seen[rows] = same
    return seen


def surface_points(
    shapes: list[Shape], light: Light, cameras: list[Camera], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points [N, 3] [u] that at least two cameras see, colours [N, 3], and which cameras see them [N, C]."""
    width, height = cameras[0].width, cameras[0].height
    count = int(np.clip(CANDIDATES * width * height / (320 * 240), 600, CANDIDATES))
    xs, indices = [], []
    for camera, fraction in zip(cameras, np.array_split(np.arange(count), len(cameras))):
        xy = rng.uniform(2, np.array([width, height]) - 2.0, size=(len(fraction), 2))
        d = raycast.pixel_rays(camera.K, camera.viewmat, xy)
        t, index = raycast.cast(shapes, camera.center, d)
        xs.append((camera.center + t[:, None] * d)[index >= 0])
        indices.append(index[index >= 0])
    x, index = np.concatenate(xs), np.concatenate(indices)
    seen = np.stack([_sees(shapes, c, x, index) for c in cameras], axis=1)
    keep = seen.sum(axis=1) >= 2
    x, index = x[keep], index[keep]
    return x, raycast.shade(shapes, light, x, index), seen[keep]


def _quaternion(R: np.ndarray) -> np.ndarray:
    """Return a unit quaternion wxyz [4] of a rotation [3, 3], from its largest component, so that nothing cancels."""
    w = np.sqrt(max(1 + np.trace(R), 0.0)) / 2
    if w > 0.1:
        return np.array([w, *(np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w))])
    i = int(np.diagonal(R).argmax())
    j, k = (i + 1) % 3, (i + 2) % 3
    q = np.zeros(4)
    q[[0, 1 + i, 1 + j, 1 + k]] = R[k, j] - R[j, k], 1 + R[i, i] - R[j, j] - R[k, k], R[j, i] + R[i, j], R[k, i] + R[i, k]
    return q / np.linalg.norm(q)


def colmap_text(cameras: list[Camera], x: np.ndarray, colors: np.ndarray, seen: np.ndarray) -> dict[str, str]:
    """Return a COLMAP model's text files by name; camera i took ``{i:03d}.png``, and ``seen`` is [N, C]."""

    def join(values, digits: int) -> str:
        return " ".join(f"{v:z.{digits}f}" for v in values)  # z: a zero has no sign

    K, first = cameras[0].K, cameras[0]
    camera_lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    camera_lines.append(f"1 PINHOLE {first.width} {first.height} {join((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), 6)}")
    image_lines = ["# Image list with two lines of data per image:"]
    image_lines += ["#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "#   POINTS2D[] as (X, Y, POINT3D_ID)"]
    tracks: list[list[str]] = [[] for _ in x]
    for c, camera in enumerate(cameras):
        V = camera.viewmat
        image_lines.append(f"{c + 1} {join([*_quaternion(V[:3, :3]), *V[:3, 3]], 12)} 1 {c:03d}.png")
        rows = np.flatnonzero(seen[:, c])
        xy, _ = _project(camera, x[rows])
        image_lines.append(" ".join(f"{join(p, 4)} {row + 1}" for p, row in zip(xy, rows)))
        for k, row in enumerate(rows):
            tracks[row].append(f"{c + 1} {k}")
    point_lines = ["# 3D point list with one line of data per point:"]
    point_lines.append("#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)")
    for i, (p, rgb) in enumerate(zip(x, np.round(255 * colors).astype(int))):
        point_lines.append(f"{i + 1} {join(p, 8)} {rgb[0]} {rgb[1]} {rgb[2]} 0.0 {' '.join(tracks[i])}")
    named = {"cameras.txt": camera_lines, "images.txt": image_lines, "points3D.txt": point_lines}
    return {name: "\n".join(lines) + "\n" for name, lines in named.items()}


def _colmap(shapes: list[Shape], light: Light, cameras: list[Camera], seed: int, most: int = CANDIDATES) -> dict[str, bytes]:
    """Return the files of a COLMAP model with at most ``most`` points, by their path in the scene."""
    x, colors, seen = surface_points(shapes, light, cameras, np.random.default_rng([seed, 1]))
    some = np.linspace(0, len(x) - 1, min(most, len(x))).astype(int)
    return {f"sparse/0/{name}": text.encode() for name, text in colmap_text(cameras, x[some], colors[some], seen[some]).items()}


def _write(folder: Path, views: int, least: int, train: int, size: tuple[int, int], contents: Callable[[], dict[str, bytes]]):
    """Write the files of a demo into a new or empty folder, all or none."""
    if views < least:
        raise UsageError(f"a demo of this kind needs at least {least} views ({train} to fit, the rest held out), not {views}")
    if min(size) < MIN_SIDE:
        raise UsageError(f"a demo image must be at least {MIN_SIDE} px on each side, not {size[0]} x {size[1]}")
    with explained(f"{folder} cannot be read", "name a folder that you may write to", kind=ResourceError):
        if folder.exists() and not (folder.is_dir() and is_empty(folder)):
            raise UsageError(f"{folder} {'is not empty' if folder.is_dir() else 'is a file'}; name a new or an empty folder")
    with filling(folder) as temporary:  # before the work: a folder that cannot be made is reported at once
        for path, content in contents().items():
            make_folder((temporary / path).parent)
            write_bytes(temporary / path, content)


def write_demo(folder: Path, *, views: int = 24, width: int = 320, height: int = 240, seed: int = 0, tell: Say = silent) -> str:
    """Write the demo scene as a COLMAP folder: images, cameras, and exact points with their tracks.

    The same arguments give the same bytes on the same machine and library versions.

    Args:
        folder: Target folder, new or empty.
        views: Number of images, at least 8; six of them are training views.
        width: Image width [px].
        height: Image height [px].
        seed: Seed of the patterns and of the choice of points.
        tell: Called with a line for each view before it is rendered.

    Returns:
        The split to use: six training views along the camera path, all others held out.

    Raises:
        UsageError: The folder is not empty, or the sizes are too small.
        ResourceError: The folder cannot be written.
    """

    def contents() -> dict[str, bytes]:
        shapes, light, cameras = still_life(seed), Light(), camera_path(views, width, height)
        files = {}
        for i, c in enumerate(counted(cameras, tell, "rendering", "views")):
            files[f"images/{i:03d}.png"] = png(raycast.render(shapes, light, c.K, c.viewmat, width, height))
        tell("finding points")
        return files | _colmap(shapes, light, cameras, seed)

    _write(Path(folder), views, MIN_VIEWS, TRAIN_VIEWS, (width, height), contents)
    return split_spec(views)


# Objects cut out of their surroundings: ray cast with true alpha, with thin parts and holes, different for every seed.
#
# The views are written as a transforms.json folder of RGBA images, or as a COLMAP folder with soft masks. The world has
# +z up. Cameras go once around the object on the upper hemisphere, rising and falling, so that a held-out view lies
# between two training views.

OBJECT_TRAIN_VIEWS = 8
OBJECT_MIN_VIEWS = 9
FORMATS = ("transforms", "colmap")
REACH = 1.35
"""Radius of the sphere around the origin that holds every object [u]."""
DISTANCE = 4.2
"""Distance of the cameras from the origin [u]."""
SAMPLES = 4
"""Number of rays along each side of a pixel: alpha has 17 levels."""
MAX_POINTS = 300
"""Largest number of points of a COLMAP folder: as few as a reconstruction finds on a small object."""
LIGHT = Light(direction=(0.5, -0.35, 0.85), sun=0.55, ambient=0.6)
PALETTE = (
    ("143a9e", "facc40"), ("b22433", "fadbb4"), ("0d6b66", "faed8c"), ("5c1a75", "f5c4dc"), ("1a6629", "f2f2bf"),
    ("7a2a22", "f5be78"), ("1f2973", "b2e6fa"), ("8a3d0f", "cfe8f0"), ("2b2b33", "f0d9b8"), ("0f5a8a", "ffd7c2"),
)  # fmt: skip
"""Pairs of colours of a texture, as six hexadecimal digits."""

Surface = Callable[..., Texture]


def _frame(axis: np.ndarray, near: tuple[float, float, float] = (0.31, 0.23, 0.92)) -> np.ndarray:
    """Return a rotation world_from_local [3, 3] with its local y axis along ``axis`` [3]."""
    y = np.asarray(axis, float) / np.linalg.norm(axis)
    z = np.cross(np.asarray(near), y)
    z /= np.linalg.norm(z)
    return np.stack([np.cross(y, z), y, z], axis=1)


def _around(angle: float, radius: float, z: float) -> np.ndarray:
    """Return the point [3] at an angle [rad] around the vertical axis, at distance ``radius`` [u] and height ``z`` [u]."""
    return np.array([radius * np.cos(angle), radius * np.sin(angle), z])


def _rod(a: np.ndarray, b: np.ndarray, size: float, texture: Texture) -> Shape:
    """Return a thin cylinder of radius ``size`` [u] from ``a`` to ``b``, both [3] [u]."""
    half = float(np.linalg.norm(b - a)) / 2
    return Cylinder(tuple((a + b) / 2), texture, _frame(b - a), shading=0, size=size, half_height=half)


def _body(rng: np.random.Generator, surface: Surface) -> Shape:
    """Return the bulky shape in the middle: a ball, a box or a drum within 0.71 u of the vertical axis."""
    size, turn = rng.uniform(0.4, 0.5), rng.uniform(0, TAU)
    kind = rng.integers(3)
    if kind == 0:
        return Sphere((0, 0, 0), surface(0.5), size=size)
    if kind == 1:
        half = (0.8 * size, 0.85 * size, 0.8 * size)
        return Box((0, 0, 0), surface(0.45), matmul(_frame((0, 0, 1)), _frame(_around(turn, 1, 0), (0, 1, 0))), half=half)
    return Cylinder((0, 0, 0), surface(0.45), _frame((0, 0, 1)), shading=0.6, size=0.85 * size, half_height=size)


def _stand(rng: np.random.Generator, surface: Surface) -> list[Shape]:
    """Return three to five slanted rods below the body, and a thin ring or balls at their feet."""
    count, first, size = int(rng.integers(3, 6)), rng.uniform(0, TAU), rng.uniform(0.026, 0.04)
    spread, texture = rng.uniform(0.5, 0.75), surface(0.35)
    angles = first + TAU * np.arange(count) / count
    feet = [_around(a, spread, -0.95) for a in angles]
    shapes = [_rod(_around(a, 0.22, -0.3), foot, size, texture) for a, foot in zip(angles, feet)]
    if rng.random() < 0.5:
        return [*shapes, Torus((0, 0, -0.9), surface(0.4), _frame((0, 0, 1)), shading=0, ring=spread, tube=1.1 * size)]
    return [*shapes, *(Sphere(tuple(f), texture, shading=0, size=0.085) for f in feet)]


def _ring(rng: np.random.Generator, surface: Surface) -> Shape:
    """Return a ring to see through: upright on top of the body, or tilted around it."""
    tube, turn = rng.uniform(0.04, 0.065), rng.uniform(0, TAU)
    if rng.random() < 0.5:
        ring = rng.uniform(0.3, 0.38)
        return Torus((0, 0, 0.38 + ring), surface(0.4), _frame(_around(turn, 1, 0)), shading=0, ring=ring, tube=tube)
    tilt = rng.uniform(0.25, 0.6)
    axis = _around(turn, np.sin(tilt), np.cos(tilt))
    return Torus((0, 0, 0), surface(0.5), _frame(axis), shading=0, ring=rng.uniform(0.8, 0.95), tube=tube)


def _grid(rng: np.random.Generator, surface: Surface) -> list[Shape]:
    """Return an upright grid of crossing bars beside the body, held by a rod."""
    turn, size, texture = rng.uniform(0, TAU), rng.uniform(0.02, 0.03), surface(0.3)
    width, height, low = rng.uniform(0.65, 0.9), rng.uniform(0.5, 0.8), rng.uniform(-0.5, -0.2)
    middle, along = _around(turn, 0.72, low), _around(turn + TAU / 4, 1, 0)
    up = np.array([0, 0, 1.0])
    feet = [middle + s * width * along for s in np.linspace(-0.5, 0.5, int(rng.integers(4, 6)))]
    centers = [middle + s * height * up for s in np.linspace(0, 1, int(rng.integers(3, 5)))]
    bars = [(foot, foot + height * up) for foot in feet]
    bars += [(center - 0.53 * width * along, center + 0.53 * width * along) for center in centers]
    bars.append((_around(turn, 0.2, 0), _around(turn, 0.72, max(0.0, low))))
    return [_rod(a, b, size, texture) for a, b in bars]


def _plates(rng: np.random.Generator, surface: Surface, turn: float) -> list[Shape]:
    """Return two or three thin radial plates at the side of the body, the first at angle ``turn`` [rad]."""
    count, thin = int(rng.integers(2, 4)), rng.uniform(0.012, 0.02)
    long, high = rng.uniform(0.22, 0.3), rng.uniform(0.2, 0.32)
    shapes = []
    for i in range(count):
        angle = turn + 0.75 * i
        outward = _around(angle, 1, 0)
        frame = np.stack([outward, [0, 0, 1], np.cross(outward, [0, 0, 1])], axis=1)
        center = tuple(_around(angle, 0.4 + long, rng.uniform(-0.1, 0.25)))
        shapes.append(Box(center, surface(0.3, "flat"), frame, shading=0, half=(long, high, thin)))
    return shapes


def _antennas(rng: np.random.Generator, surface: Surface) -> list[Shape]:
    """Return two thin rods that rise from the body, each with a ball at its end."""
    shapes: list[Shape] = []
    for angle in rng.uniform(0, TAU) + np.array([0, rng.uniform(1.5, 3.0)]):
        end = _around(angle, rng.uniform(0.4, 0.65), rng.uniform(0.75, 0.95))
        shapes.append(_rod(_around(angle, 0.15, 0.25), end, 0.022, surface(0.3)))
        shapes.append(Sphere(tuple(end), surface(0.2), shading=0, size=rng.uniform(0.08, 0.11)))
    return shapes


def cut_out_object(seed: int = 0) -> list[Shape]:
    """Return an object's shapes, within `REACH`: a body on legs, a ring and a grid, thin plates, rods with balls."""
    rng = np.random.default_rng([seed, 2])
    order = iter(np.tile(rng.permutation(len(PALETTE)), 4))

    def surface(period: float, kind: str = "solid") -> Texture:
        return checker_texture(rng, *PALETTE[next(order)], period, kind)

    shapes = [_body(rng, surface), *_stand(rng, surface), _ring(rng, surface), *_grid(rng, surface)]
    return [*shapes, *_plates(rng, surface, rng.uniform(0, TAU)), *_antennas(rng, surface)]


def ring_cameras(views: int, width: int, height: int) -> list[Camera]:
    """Return cameras around the origin, on a wave 17 to 53 degrees high; training views are its crests and troughs."""
    focal = 0.48 * min(width, height) / np.tan(np.arcsin(REACH / DISTANCE))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    cameras = []
    for u in np.arange(views) / views:
        rise = np.radians(35 + 18 * np.cos(TAU / 2 * OBJECT_TRAIN_VIEWS * u))
        center = DISTANCE * _around(TAU * u, np.cos(rise), np.sin(rise))
        cameras.append(Camera(look_at(center, np.zeros(3), np.array([0, 0, 1.0])), K, width, height))
    return cameras


def _transforms(cameras: list[Camera]) -> str:
    """Return the text of a transforms.json: camera-to-world with OpenGL axes, the lens as a horizontal angle."""
    first, frames = cameras[0], []
    for i, camera in enumerate(cameras):
        pose = pose_of(camera.viewmat[:3, :3].T * np.array([1, -1, -1]), camera.center)
        frames.append({"file_path": f"images/{i:03d}.png", "transform_matrix": np.round(pose, 12).tolist()})
    angle = 2 * float(np.arctan(first.width / (2 * first.K[0, 0])))
    return json.dumps({"camera_angle_x": angle, "w": first.width, "h": first.height, "frames": frames}, indent=1)


def write_object(
    folder: Path, *, form: str = "transforms", views: int = 24, width: int = 320, height: int = 240, seed: int = 0,
    tell: Say = silent,
) -> str:  # fmt: skip
    """Write an object as a scene folder: RGBA images with straight colours, or RGB images with soft masks."""

    def contents() -> dict[str, bytes]:
        shapes, cameras, files = cut_out_object(seed), ring_cameras(views, width, height), {}
        for i, c in enumerate(counted(cameras, tell, "rendering", "views")):
            over_black, name = raycast.render_rgba(shapes, LIGHT, c.K, c.viewmat, width, height, SAMPLES), f"{i:03d}.png"
            color, alpha = over_black[..., :3], over_black[..., 3:]
            color = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 0)
            if form == "transforms":
                files[f"images/{name}"] = png(np.concatenate([color, alpha], axis=2))
            else:
                files[f"images/{name}"] = png(np.where(alpha > 0, color, np.float32(0.5)))
                files[f"masks/{name}"] = png(alpha[..., 0])
        if form == "transforms":
            return files | {"transforms.json": _transforms(cameras).encode()}
        return files | _colmap(shapes, LIGHT, cameras, seed, MAX_POINTS)

    _write(Path(folder), views, OBJECT_MIN_VIEWS, OBJECT_TRAIN_VIEWS, (width, height), contents)
    return _split(views, {i * views // OBJECT_TRAIN_VIEWS for i in range(OBJECT_TRAIN_VIEWS)})
