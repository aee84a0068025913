"""Objects cut out of their surroundings: ray cast with true alpha, with thin parts and holes, different for every seed.

The views are written as a transforms.json folder of RGBA images, or as a COLMAP folder with soft masks. The world has +z up.
Cameras go once around the object on the upper hemisphere, rising and falling, so that a held-out view lies between two training
views.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from warpgs.errors import UsageError
from warpgs.geometry import look_at, matmul
from warpgs.runtime.terminal import counted
from warpgs.scene import Camera
from warpgs.synthetic import raycast
from warpgs.synthetic.demo import TAU, checker_texture, colmap_text, surface_points, write_files

TRAIN_VIEWS = 8
MIN_VIEWS = 9
FORMATS = ("transforms", "colmap")
REACH = 1.35
"""Radius of the sphere around the origin that holds every object [u]."""
DISTANCE = 4.2
"""Distance of the cameras from the origin [u]."""
SAMPLES = 4
"""Number of rays along each side of a pixel: alpha has 17 levels."""
MAX_POINTS = 300
"""Largest number of points of a COLMAP folder: as few as a reconstruction finds on a small object."""
LIGHT = raycast.Light(direction=(0.5, -0.35, 0.85), sun=0.55, ambient=0.6)
PALETTE = (
    ("143a9e", "facc40"), ("b22433", "fadbb4"), ("0d6b66", "faed8c"), ("5c1a75", "f5c4dc"), ("1a6629", "f2f2bf"),
    ("7a2a22", "f5be78"), ("1f2973", "b2e6fa"), ("8a3d0f", "cfe8f0"), ("2b2b33", "f0d9b8"), ("0f5a8a", "ffd7c2"),
)  # fmt: skip
"""Pairs of colours of a texture, as six hexadecimal digits."""

Surface = Callable[..., raycast.Texture]


def _frame(axis: np.ndarray, near: tuple[float, float, float] = (0.31, 0.23, 0.92)) -> np.ndarray:
    """Return a rotation world_from_local [3, 3] with its local y axis along ``axis`` [3]."""
    y = np.asarray(axis, float) / np.linalg.norm(axis)
    z = np.cross(np.asarray(near), y)
    z /= np.linalg.norm(z)
    return np.stack([np.cross(y, z), y, z], axis=1)


def _around(angle: float, radius: float, z: float) -> np.ndarray:
    """Return the point [3] at an angle [rad] around the vertical axis, at distance ``radius`` [u] and height ``z`` [u]."""
    return np.array([radius * np.cos(angle), radius * np.sin(angle), z])


def _rod(a: np.ndarray, b: np.ndarray, size: float, texture: raycast.Texture) -> raycast.Shape:
    """Return a thin cylinder of radius ``size`` [u] from ``a`` to ``b``, both [3] [u]."""
    return raycast.Cylinder(
        tuple((a + b) / 2), texture, _frame(b - a), shading=0, size=size, half_height=float(np.linalg.norm(b - a)) / 2
    )


def _body(rng: np.random.Generator, surface: Surface) -> raycast.Shape:
    """Return the bulky shape in the middle: a ball, a box or a drum within 0.71 u of the vertical axis."""
    size, turn = rng.uniform(0.4, 0.5), rng.uniform(0, TAU)
    kind = rng.integers(3)
    if kind == 0:
        return raycast.Sphere((0, 0, 0), surface(0.5), size=size)
    if kind == 1:
        half = (0.8 * size, 0.85 * size, 0.8 * size)
        return raycast.Box(
            (0, 0, 0), surface(0.45), matmul(_frame((0, 0, 1)), _frame(_around(turn, 1, 0), (0, 1, 0))), half=half
        )
    return raycast.Cylinder((0, 0, 0), surface(0.45), _frame((0, 0, 1)), shading=0.6, size=0.85 * size, half_height=size)


def _stand(rng: np.random.Generator, surface: Surface) -> list[raycast.Shape]:
    """Return three to five slanted rods below the body, and a thin ring or balls at their feet."""
    count, first, size = int(rng.integers(3, 6)), rng.uniform(0, TAU), rng.uniform(0.026, 0.04)
    spread, texture = rng.uniform(0.5, 0.75), surface(0.35)
    angles = first + TAU * np.arange(count) / count
    feet = [_around(a, spread, -0.95) for a in angles]
    shapes = [_rod(_around(a, 0.22, -0.3), foot, size, texture) for a, foot in zip(angles, feet)]
    if rng.random() < 0.5:
        return [*shapes, raycast.Torus((0, 0, -0.9), surface(0.4), _frame((0, 0, 1)), shading=0, ring=spread, tube=1.1 * size)]
    return [*shapes, *(raycast.Sphere(tuple(f), texture, shading=0, size=0.085) for f in feet)]


def _ring(rng: np.random.Generator, surface: Surface) -> raycast.Shape:
    """Return a ring to see through: upright on top of the body, or tilted around it."""
    tube, turn = rng.uniform(0.04, 0.065), rng.uniform(0, TAU)
    if rng.random() < 0.5:
        ring = rng.uniform(0.3, 0.38)
        return raycast.Torus((0, 0, 0.38 + ring), surface(0.4), _frame(_around(turn, 1, 0)), shading=0, ring=ring, tube=tube)
    tilt = rng.uniform(0.25, 0.6)
    axis = _around(turn, np.sin(tilt), np.cos(tilt))
    return raycast.Torus((0, 0, 0), surface(0.5), _frame(axis), shading=0, ring=rng.uniform(0.8, 0.95), tube=tube)


def _grid(rng: np.random.Generator, surface: Surface) -> list[raycast.Shape]:
    """Return an upright grid of crossing bars beside the body, held by a rod."""
    turn, size, texture = rng.uniform(0, TAU), rng.uniform(0.02, 0.03), surface(0.3)
    width, height, low = rng.uniform(0.65, 0.9), rng.uniform(0.5, 0.8), rng.uniform(-0.5, -0.2)
    middle, along = _around(turn, 0.72, low), _around(turn + TAU / 4, 1, 0)
    up = np.array([0, 0, 1.0])
    shapes = []
    for s in np.linspace(-0.5, 0.5, int(rng.integers(4, 6))):
        foot = middle + s * width * along
        shapes.append(_rod(foot, foot + height * up, size, texture))
    for s in np.linspace(0, 1, int(rng.integers(3, 5))):
        center = middle + s * height * up
        shapes.append(_rod(center - 0.53 * width * along, center + 0.53 * width * along, size, texture))
    return [*shapes, _rod(_around(turn, 0.2, 0), _around(turn, 0.72, max(0.0, low)), size, texture)]


def _plates(rng: np.random.Generator, surface: Surface, turn: float) -> list[raycast.Shape]:
    """Return two or three thin radial plates at the side of the body, the first at angle ``turn`` [rad]."""
    count, thin = int(rng.integers(2, 4)), rng.uniform(0.012, 0.02)
    long, high = rng.uniform(0.22, 0.3), rng.uniform(0.2, 0.32)
    shapes = []
    for i in range(count):
        angle = turn + 0.75 * i
        outward = _around(angle, 1, 0)
        frame = np.stack([outward, [0, 0, 1], np.cross(outward, [0, 0, 1])], axis=1)
        center = tuple(_around(angle, 0.4 + long, rng.uniform(-0.1, 0.25)))
        shapes.append(raycast.Box(center, surface(0.3, "flat"), frame, shading=0, half=(long, high, thin)))
    return shapes


def _antennas(rng: np.random.Generator, surface: Surface) -> list[raycast.Shape]:
    """Return two thin rods that rise from the body, each with a ball at its end."""
    shapes: list[raycast.Shape] = []
    for angle in rng.uniform(0, TAU) + np.array([0, rng.uniform(1.5, 3.0)]):
        end = _around(angle, rng.uniform(0.4, 0.65), rng.uniform(0.75, 0.95))
        shapes.append(_rod(_around(angle, 0.15, 0.25), end, 0.022, surface(0.3)))
        shapes.append(raycast.Sphere(tuple(end), surface(0.2), shading=0, size=rng.uniform(0.08, 0.11)))
    return shapes


def cut_out_object(seed: int = 0) -> list[raycast.Shape]:
    """Return the shapes of an object: a body on thin legs, a ring and a grid to see through, thin plates, rods with balls.

    Args:
        seed: Decides shapes, places, sizes and patterns.

    Returns:
        The shapes, all within `REACH` of the origin.
    """
    rng = np.random.default_rng([seed, 2])
    order = iter(np.tile(rng.permutation(len(PALETTE)), 4))

    def surface(period: float, kind: str = "solid") -> raycast.Texture:
        return checker_texture(rng, *PALETTE[next(order)], period, kind)

    shapes = [_body(rng, surface), *_stand(rng, surface), _ring(rng, surface), *_grid(rng, surface)]
    return [*shapes, *_plates(rng, surface, rng.uniform(0, TAU)), *_antennas(rng, surface)]


def ring_cameras(views: int, width: int, height: int) -> list[Camera]:
    """Return cameras once around the origin, on a wave 17 to 53 degrees high; training views are its crests and troughs.

    Args:
        views: Number of cameras.
        width: Image width [px].
        height: Image height [px].

    Returns:
        The cameras in the order of the ring; a sphere of radius `REACH` around the origin nearly fills the shorter image side.
    """
    focal = 0.48 * min(width, height) / np.tan(np.arcsin(REACH / DISTANCE))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    cameras = []
    for u in np.arange(views) / views:
        rise = np.radians(35 + 18 * np.cos(TAU / 2 * TRAIN_VIEWS * u))
        center = DISTANCE * _around(TAU * u, np.cos(rise), np.sin(rise))
        cameras.append(Camera(look_at(center, np.zeros(3), np.array([0, 0, 1.0])), K, width, height))
    return cameras


def split_spec(views: int) -> str:
    """Return the split of an object with that many views: eight evenly spaced training views, all others held out."""
    train = {i * views // TRAIN_VIEWS for i in range(TRAIN_VIEWS)}
    names = [[f"{i:03d}.png" for i in range(views) if (i in train) == wanted] for wanted in (True, False)]
    return f"train={','.join(names[0])};test={','.join(names[1])}"


def _png(image: np.ndarray) -> bytes:
    """Return an image with values in [0, 1], RGB [H, W, 3], RGBA [H, W, 4] or grey [H, W], as PNG of 8 bits a channel."""
    import cv2

    order = image if image.ndim == 2 else image[..., [2, 1, 0, 3][: image.shape[2]]]
    return bytes(cv2.imencode(".png", np.round(255 * order).astype(np.uint8))[1].tobytes())


def _transforms(cameras: list[Camera]) -> str:
    """Return the text of a transforms.json: camera-to-world with OpenGL axes, the lens as a horizontal angle."""
    first, frames = cameras[0], []
    for i, camera in enumerate(cameras):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.viewmat[:3, :3].T * np.array([1, -1, -1]), camera.center
        frames.append({"file_path": f"images/{i:03d}.png", "transform_matrix": np.round(pose, 12).tolist()})
    angle = 2 * float(np.arctan(first.width / (2 * first.K[0, 0])))
    return json.dumps({"camera_angle_x": angle, "w": first.width, "h": first.height, "frames": frames}, indent=1)


def _files(form: str, views: int, size: tuple[int, int], seed: int, tell: Callable[[str], object]) -> dict[str, bytes]:
    """Return the contents of the folder by relative path."""
    shapes, cameras = cut_out_object(seed), ring_cameras(views, *size)
    files = {}
    for i, camera in enumerate(counted(cameras, tell, "rendering", "views")):
        over_black = raycast.render_rgba(shapes, LIGHT, camera.K, camera.viewmat, *size, SAMPLES)
        alpha = over_black[..., 3:]
        color = np.divide(over_black[..., :3], alpha, out=np.zeros_like(over_black[..., :3]), where=alpha > 0)
        if form == "transforms":
            files[f"images/{i:03d}.png"] = _png(np.concatenate([color, alpha], axis=2))
        else:
            files[f"images/{i:03d}.png"] = _png(np.where(alpha > 0, color, np.float32(0.5)))
            files[f"masks/{i:03d}.png"] = _png(alpha[..., 0])
    if form == "transforms":
        return files | {"transforms.json": _transforms(cameras).encode()}
    x, colors, seen = surface_points(shapes, LIGHT, cameras, np.random.default_rng([seed, 1]))
    some = np.linspace(0, len(x) - 1, min(MAX_POINTS, len(x))).astype(int)
    texts = colmap_text(cameras, x[some], colors[some], seen[some])
    return files | {f"sparse/0/{name}": text.encode() for name, text in texts.items()}


def write_object(
    folder: Path, *, form: str = "transforms", views: int = 24, width: int = 320, height: int = 240, seed: int = 0,
    tell: Callable[[str], object] = lambda line: None,
) -> str:  # fmt: skip
    """Write an object as a scene folder: RGBA images with straight colours, or RGB images with soft masks.

    The same arguments give the same bytes on the same machine and library versions.

    Args:
        folder: Target folder, new or empty.
        form: ``transforms``: transforms.json with RGBA images. ``colmap``: a COLMAP model with a few exact points, RGB images,
            grey outside the object, and masks that hold the alpha, white for the object.
        views: Number of images, at least 9; eight of them are training views.
        width: Image width [px].
        height: Image height [px].
        seed: Decides the object.
        tell: Called with a line for each view before it is rendered.

    Returns:
        The split to use: eight training views around the object, all others held out.

    Raises:
        UsageError: The folder is not empty, the sizes are too small, or the format is unknown.
        ResourceError: The folder cannot be written.
    """
    if form not in FORMATS:
        raise UsageError(f"a demo object is written as {' or '.join(FORMATS)}, not as {form!r}")
    if views < MIN_VIEWS:
        raise UsageError(
            f"a demo object needs {MIN_VIEWS} views or more ({TRAIN_VIEWS} to fit, the rest held out), not {views}"
        )
    write_files(Path(folder), (width, height), lambda: _files(form, views, (width, height), seed, tell))
    return split_spec(views)
