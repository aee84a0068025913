"""A scene with its cameras in one image: the overview of a report, and plots, which VTK draws in a process of its own."""

import io
import json
import math
import subprocess
from dataclasses import replace

import numpy as np
import torch
from PIL import Image, ImageColor, ImageDraw, ImageFont

from warpgs.errors import ResourceError
from warpgs.files import disk_is_full
from warpgs.folders import system_folder, temporary_folder
from warpgs.geometry import pose_of
from warpgs.process import run_python
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.report.images import png
from warpgs.scene import Camera, Gaussians

REMEDY = "install a software renderer: on Debian or Ubuntu `apt-get install libegl1 libgl1 libgl1-mesa-dri libxrender1`"
TIMEOUT = 90
WIDTH, HEIGHT, VIEW_ANGLE = 1280, 640, 40.0  # [px], [px], vertical [deg]
OUTSIDE, EDGE = 1.0, 0.15
"""Margins (see `within`) for the points to show and for the points to frame: they keep walls whole and drop far background."""
TRAIN_COLOR, TEST_COLOR = "#149696", "#e08a2c"
PIECES = 32
"""Pieces of a line of the overview, each of which is shown or hidden."""

PROBE = (
    "import pyvista as pv; p = pv.Plotter(off_screen=True, window_size=(16, 16)); p.add_mesh(pv.Sphere()); p.screenshot(None)"
)


def run_pyvista(code: str, *arguments: str) -> tuple[bool, str]:
    """Run Python code in a separate process, since VTK ends the process where it cannot render; return success and reason."""
    try:
        done = run_python(code, *arguments, timeout=TIMEOUT, environment={"VTK_DEFAULT_OPENGL_WINDOW": "vtkEGLRenderWindow"})
    except subprocess.TimeoutExpired:
        return False, f"pyvista did not finish within {TIMEOUT} s"
    except OSError as e:
        return False, f"no process can be started for pyvista ({e.strerror or e})"
    if done.returncode == 0:
        return True, ""
    last = "".join(f" ({line[:100]})" for line in done.stderr.strip().splitlines()[-1:])
    return False, f"pyvista ended with code {done.returncode}{last}"


def remedy_for(why: str) -> str:
    """Return the fix for a reason that `run_pyvista` returned."""
    if disk_is_full(folder := system_folder(), why):
        return f"free some disk space for temporary files in {folder}, or set the variable TMPDIR to another folder"
    return "`pip install pyvista`" if "No module named" in why else REMEDY


def probe_rendering() -> tuple[bool, str]:
    """Return whether pyvista can render on this machine, and how; or the reason why not, with a remedy."""
    works, why = run_pyvista(PROBE)
    return works, "off-screen through EGL" if works else f"{why}; {remedy_for(why)}"


def frusta(cameras: list[Camera], size: float) -> np.ndarray:
    """Return line segments [S, 2, 3] of camera pyramids, with image planes at distance ``size`` [u]."""
    lines = []
    for c in cameras:
        corners = np.array([[0, 0, 1], [c.width, 0, 1], [c.width, c.height, 1], [0, c.height, 1]], float)
        rays = corners @ np.linalg.inv(c.K).T * size
        world = (rays - c.viewmat[:3, 3]) @ c.viewmat[:3, :3]
        lines += [(c.center, p) for p in world] + [(world[i], world[(i + 1) % 4]) for i in range(4)]
    return np.array(lines)


def framing(shown: np.ndarray, direction: np.ndarray, up: np.ndarray, aspect: float = WIDTH / HEIGHT) -> np.ndarray:
    """Return eye, focal point and up vector [3, 3] of a view along ``-direction`` of all points ``shown`` [N, 3]."""
    length = np.linalg.norm(direction)
    forward = -direction / length if length > 0 else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-3:
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    axes = np.stack([right / np.linalg.norm(right), np.zeros(3), forward])
    axes[1] = np.cross(axes[0], forward)
    slope = np.tan(np.radians(VIEW_ANGLE / 2)) / 1.06
    seen = np.ascontiguousarray((shown @ axes.T).T)
    low, high = seen.min(1), seen.max(1)
    eye, focus = (low + high) / 2, (low + high) / 2
    eye[2] -= max(float((high - low).max()), 1e-6) * 2
    half = (seen.shape[1] - 1) // 2, seen.shape[1] // 2
    middles = np.partition(seen[2], half)[[*half]]  # whose mean is the median
    for _ in range(20):  # move the camera until the content touches the edges: near content looks larger
        depth = np.maximum(seen[2] - eye[2], 1e-9)
        x, y = (seen[0] - eye[0]) / depth, (seen[1] - eye[1]) / depth
        nearest, middle = float(depth.min()), float(np.maximum(middles - eye[2], 1e-9).mean())
        (left, right), (top, bottom) = ((float(a.min()), float(a.max())) for a in (x, y))
        size = max((bottom - top) / slope, (right - left) / (slope * aspect)) / 2
        eye[:2] += 0.5 * middle * np.array([right + left, bottom + top]) / 2
        eye[2] -= max((size - 1) * middle, -0.5 * nearest)
    focus[:2] = eye[:2]
    focus[2] = max(focus[2], eye[2] + 1e-6)
    return np.stack([eye @ axes, focus @ axes, axes[1]])


def within(points: np.ndarray, margin: float) -> np.ndarray:
    """Mask [N] of the points in the box of the 5th to 95th percentiles, enlarged by ``margin`` times its size at each side."""
    low, high = np.percentile(points, [5, 95], axis=0)
    return ((points >= low - margin * (high - low)) & (points <= high + margin * (high - low))).all(1)


def render_overview(
    gaussians: Gaussians, options: RasterizeOptions, train: list[Camera], test: list[Camera], up: np.ndarray
) -> np.ndarray | None:
    """Render training and held-out cameras among Gaussians, ``up`` [3] upwards; colours [H, W, 3], None without Gaussians."""
    points = gaussians.means.detach().cpu().numpy().astype(np.float64)
    if not len(points):
        return None
    low, high = np.percentile(points, [5, 95], axis=0)
    back = np.mean([c.center for c in train], axis=0) - np.median(points, axis=0)
    reach = max(float(np.linalg.norm(back)), 0.5 * float(np.linalg.norm(high - low)), 1e-6)
    side = np.cross(np.mean([c.viewmat[2, :3] for c in train], axis=0), up)
    direction = 1.5 * back + 0.7 * reach * side / max(float(np.linalg.norm(side)), 1e-9) + 0.5 * reach * up
    core = points[within(points, EDGE)]
    size = _frustum_size([*train, *test], _extent(core, [*train, *test])[1])
    lines = [(frusta(cameras, size), color) for cameras, color in ((train, TRAIN_COLOR), (test, TEST_COLOR)) if cameras]
    shown = np.concatenate([core, *(segments.reshape(-1, 3) for segments, _ in lines)])
    eye, focus, top = framing(shown, direction, up)
    axis = (focus - eye) / np.linalg.norm(focus - eye)
    right = np.cross(axis, top) / np.linalg.norm(np.cross(axis, top))
    rotation = np.stack([right, np.cross(axis, right), axis])
    viewmat = pose_of(rotation, -rotation @ eye)
    focal = HEIGHT / 2 / math.tan(math.radians(VIEW_ANGLE / 2))
    camera = Camera(viewmat, np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]]), WIDTH, HEIGHT)
    near = torch.from_numpy(within(points, OUTSIDE)).to(gaussians.means.device)
    inside = Gaussians(**{n: t.detach()[near] for n, t in gaussians.tensors().items()})
    # the first harmonic alone: the others are not trained for directions beside the photographs
    white = torch.ones(3, dtype=torch.float32, device=gaussians.means.device)
    with torch.no_grad():
        render = rasterize(inside, camera, replace(options, background=white, sh_degree=0))
    depth = torch.where(render.alpha > 0.5, render.depth, torch.inf).cpu().numpy()
    image = np.round(255 * render.rgb.clamp(0, 1).cpu().numpy()).astype(np.uint8)
    for segments, color in lines:
        _draw(image, depth, camera, segments, color)
    return image / np.float32(255)


def _draw(image: np.ndarray, depth: np.ndarray, camera: Camera, segments: np.ndarray, color: str) -> None:
    """Draw segments [S, 2, 3] [u] into an 8-bit image [H, W, 3] where nothing nearer hides them; ``depth`` [H, W] [u]."""
    import cv2

    rgb = ImageColor.getrgb(color)
    share = np.linspace(0, 1, PIECES + 1)[:, None]
    for ends in segments:
        points = (ends[0] + share * (ends[1] - ends[0])) @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = (points @ camera.K.T)[:, :2] / points[:, 2:]
        columns, rows = np.clip(pixels.astype(int), 0, [camera.width - 1, camera.height - 1]).T
        seen = points[:, 2] < 1.01 * depth[rows, columns]
        fixed = np.round(16 * (pixels - 0.5)).astype(int).tolist()  # 4 bits after the point
        changes = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]])))
        for first, last in changes.reshape(-1, 2):
            cv2.line(image, fixed[first], fixed[last - 1], rgb, 2, cv2.LINE_AA, 4)


INK = {"white": "#1b1d21", "black": "#e8e9ec"}
"""Colour of letters on each background."""
LEGEND_HEIGHT = 0.06
"""Height of the strip for the legend, as a fraction of the image."""
SHOWN_SIGMAS = 1.3
"""Radius at which the surface of a Gaussian is shown, in standard deviations."""
PLOT_SCRIPT = f"""
import json, sys, numpy as np, pyvista as pv
d, words = np.load(sys.argv[1]), json.loads(sys.argv[2])
p = pv.Plotter(off_screen=True, window_size=words["size"])
p.set_background(words["background"])
points, colors = d["points"], d["colors"]
if "axes" in d:
    ball = pv.Icosphere(radius=1.0, nsub=words["subdivisions"])
    corners = (points[:, None] + np.einsum("vj,nij->nvi", ball.points, d["axes"])).astype(np.float32)
    faces = ball.regular_faces[None] + len(ball.points) * np.arange(len(points))[:, None, None]
    mesh = pv.PolyData.from_regular_faces(corners.reshape(-1, 3), faces.reshape(-1, 3))
    mesh["rgb"] = np.repeat(colors, len(ball.points), axis=0)
    p.add_mesh(mesh, scalars="rgb", rgb=True, smooth_shading=True, ambient=0.6, diffuse=0.55, specular=0.0)
else:
    mesh = pv.PolyData(points)
    mesh["rgb"] = colors
    p.add_mesh(mesh, scalars="rgb", rgb=True, point_size=words["point_size"], render_points_as_spheres=True, lighting=False)
for key, color in (("train", "{TRAIN_COLOR}"), ("test", "{TEST_COLOR}")):
    lines = d[key]
    if len(lines):
        segments = pv.line_segments_from_points(lines.reshape(-1, 3))
        p.add_mesh(segments, color=color, line_width=words["line_width"], lighting=False)
        corners = lines.reshape(-1, 8, 2, 3)[:, :4, 1].reshape(-1, 3)
        faces = np.arange(len(corners)).reshape(-1, 4)
        p.add_mesh(pv.PolyData.from_regular_faces(corners, faces), color=color, opacity=0.15, lighting=False)
p.camera.position, p.camera.focal_point, p.camera.up = d["view"]
p.camera.view_angle = {VIEW_ANGLE}
p.enable_anti_aliasing("ssaa")
p.screenshot(sys.argv[3])
"""


def _extent(points: np.ndarray, cameras: list[Camera]) -> tuple[np.ndarray, float]:
    """Return points [N, 3] and centres of cameras [C, 3] together, shape [N + C, 3], and the radius around their mean [u]."""
    everything = np.concatenate([points, np.array([c.center for c in cameras]).reshape(-1, 3)])
    return everything, float(np.sqrt(((everything - everything.mean(0)) ** 2).sum(1)).max())


def _frustum_size(cameras: list[Camera], reach: float) -> float:
    """Return the height of camera pyramids [u]: 0.8 times the median gap between cameras, in [0.03, 0.12] times ``reach``."""
    if len(cameras) < 2:
        return 0.12 * reach
    centers = np.array([c.center for c in cameras])
    apart = np.sqrt(((centers[:, None] - centers[None]) ** 2).sum(-1)) + np.diag(np.full(len(centers), np.inf))
    return float(np.clip(0.8 * np.median(apart.min(1)), 0.03 * reach, 0.12 * reach))


def _with_legend(data: bytes, entries: list[tuple[str, str]], size: tuple[int, int], background: str) -> bytes:
    """Return a PNG of the size wanted: a render, and below it a strip with a square and text for each entry."""
    canvas = Image.new("RGB", size, background)
    with Image.open(io.BytesIO(data)) as render:
        canvas.paste(render.convert("RGB"), (0, 0))
        strip = size[1] - render.height
    draw, side, gap = ImageDraw.Draw(canvas), 0.32 * strip, 0.5 * strip
    for letters in (0.42 * strip, 0.3 * strip, 0.22 * strip):
        font = ImageFont.load_default(max(letters, 6))
        if sum(side + 2 * gap + font.getlength(words) for words, _ in entries) <= size[0]:
            break
    x, y = gap, size[1] - 0.55 * strip
    for words, color in entries:
        draw.rectangle((x, y - side / 2, x + side, y + side / 2), color)
        draw.text((x + side + 0.5 * gap, y), words, INK[background], font, anchor="lm")
        x += side + 1.5 * gap + font.getlength(words)
    return png(np.asarray(canvas, np.float32) / 255)


def render_plot(
    points: np.ndarray, colors: np.ndarray, *, axes: np.ndarray | None, train: list[Camera], test: list[Camera],
    up: np.ndarray, direction: np.ndarray, legend: list[tuple[str, str]], size: tuple[int, int], background: str,
) -> bytes:  # fmt: skip
    """Render cameras and points [N, 3] [u] with colours [N, 3] in [0, 1] as PNG bytes; points far outside are left out.

    Args:
        points: At least one.
        colors: Colours of the points.
        axes: Principal axes of Gaussians [N, 3, 3], as columns as long as a standard deviation [u]; None for plain points.
        train: Cameras of the training views.
        test: Cameras of the held-out views.
        up: Upward direction [3].
        direction: Direction [3] from the scene to the eye, of any length.
        legend: Text and colour (#rrggbb) of each entry besides the cameras.
        size: Width and height [px].
        background: white or black.
    """
    inside = within(points, OUTSIDE)
    points, colors = points[inside], colors[inside]
    core = points[within(points, EDGE)]
    everything, reach = _extent(core if len(core) else points, [*train, *test])
    length = _frustum_size([*train, *test], reach)
    arrays = {"train": frusta(train, length), "test": frusta(test, length), "points": points.astype(np.float32)}
    if axes is not None:
        lengths = np.sqrt((axes[inside] ** 2).sum(1))
        shrink = np.minimum(1.0, 0.02 * reach / np.maximum(SHOWN_SIGMAS * lengths, 1e-30))  # the far background would hide all
        arrays["axes"] = (SHOWN_SIGMAS * shrink[:, None] * axes[inside]).astype(np.float32)
    entries = [("training cameras", TRAIN_COLOR)] * bool(train) + [("held-out cameras", TEST_COLOR)] * bool(test) + legend
    height = size[1] - (round(LEGEND_HEIGHT * size[1]) if entries else 0)
    shown = np.concatenate([everything, arrays["train"].reshape(-1, 3), arrays["test"].reshape(-1, 3)])
    arrays["view"] = framing(shown, direction, up, size[0] / height)
    arrays["colors"] = np.round(255 * np.clip(colors, 0, 1)).astype(np.uint8)
    words = {
        "size": [size[0], height], "background": background, "point_size": max(2.0, 0.005 * size[1]),
        "line_width": max(1.5, 0.002 * size[1]), "subdivisions": 2 if len(points) < 6000 else 1,
    }  # fmt: skip
    data = _rendered(arrays, words)
    return _with_legend(data, entries, size, background) if entries else data


def _rendered(arrays: dict[str, np.ndarray], words: dict[str, object]) -> bytes:
    """Run `PLOT_SCRIPT` with arrays and settings; return its render as PNG bytes."""
    try:
        with temporary_folder() as folder:
            source, target = (folder.path / name for name in ("scene.npz", "plot.png"))
            np.savez(source, **arrays)
            works, why = run_pyvista(PLOT_SCRIPT, str(source), json.dumps(words), str(target))
            if works and target.is_file():
                return target.read_bytes()
    except OSError as e:
        raise ResourceError(f"no plot: temporary files cannot be written ({e.strerror or e}); free some disk space") from e
    raise ResourceError(f"no plot: {why}; {remedy_for(why)}")
