"""Plots of a scene: cameras as pyramids among points, with a legend, rendered by pyvista in a separate process."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass

import numpy as np

from warpgs.errors import ResourceError
from warpgs.report.images import png
from warpgs.report.overview import (
    EDGE,
    OUTSIDE,
    TEST_COLOR,
    TRAIN_COLOR,
    VIEW_ANGLE,
    framing,
    frusta,
    remedy_for,
    run_pyvista,
    within,
)
from warpgs.scene import Camera
from warpgs.temporary import temporary_folder

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


@dataclass(frozen=True)
class ScenePlot:
    """Contents of a plot, in one system of units [u]."""

    points: np.ndarray
    """Positions [u], shape [N, 3], at least one."""
    colors: np.ndarray
    """Colours in [0, 1], shape [N, 3]."""
    axes: np.ndarray | None
    """Principal axes of Gaussians, as columns as long as a standard deviation [u], shape [N, 3, 3]; None for plain points."""
    train: list[Camera]
    """Cameras of the training views; may be empty."""
    test: list[Camera]
    """Cameras of the held-out views; may be empty."""
    up: np.ndarray
    """Upward direction, shape [3]."""
    direction: np.ndarray
    """Direction from the scene to the eye, any length, shape [3]."""
    legend: list[tuple[str, str]]
    """Text and colour (#rrggbb) of each entry besides the cameras."""


def _frustum_size(cameras: list[Camera], reach: float) -> float:
    """Return the height of camera pyramids [u]: 0.8 times the median gap between cameras, in [0.03, 0.12] times ``reach``."""
    if len(cameras) < 2:
        return 0.12 * reach
    centers = np.array([c.center for c in cameras])
    apart = np.sqrt(((centers[:, None] - centers[None]) ** 2).sum(-1)) + np.diag(np.full(len(centers), np.inf))
    return float(np.clip(0.8 * np.median(apart.min(1)), 0.03 * reach, 0.12 * reach))


def _with_legend(data: bytes, entries: list[tuple[str, str]], size: tuple[int, int], background: str) -> bytes:
    """Return a PNG of the size wanted: a render, and below it a strip with a square and text for each entry."""
    from PIL import Image, ImageDraw, ImageFont

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
    pixels = np.asarray(canvas, np.float32) / 255
    return png(pixels)


def render_plot(plot: ScenePlot, size: tuple[int, int], background: str) -> bytes:
    """Render a plot as PNG bytes.

    Args:
        plot: The contents; points far outside are left out.
        size: Width and height [px].
        background: white or black.

    Raises:
        ResourceError: This machine cannot render; the message names the packages to install.
    """
    inside = within(plot.points, OUTSIDE)
    points, colors = plot.points[inside], plot.colors[inside]
    core = points[within(points, EDGE)]
    cameras = [*plot.train, *plot.test]
    everything = np.concatenate([core if len(core) else points, np.array([c.center for c in cameras]).reshape(-1, 3)])
    reach = float(np.sqrt(((everything - everything.mean(0)) ** 2).sum(1)).max())
    length = _frustum_size(cameras, reach)
    arrays = {"train": frusta(plot.train, length), "test": frusta(plot.test, length), "points": points.astype(np.float32)}
    if plot.axes is not None:
        lengths = np.sqrt((plot.axes[inside] ** 2).sum(1))
        shrink = np.minimum(1.0, 0.02 * reach / np.maximum(SHOWN_SIGMAS * lengths, 1e-30))  # the far background would hide all
        arrays["axes"] = (SHOWN_SIGMAS * shrink[:, None] * plot.axes[inside]).astype(np.float32)
    entries = [("training cameras", TRAIN_COLOR)] * bool(plot.train) + [("held-out cameras", TEST_COLOR)] * bool(plot.test)
    entries += plot.legend
    height = size[1] - (round(LEGEND_HEIGHT * size[1]) if entries else 0)
    shown = np.concatenate([everything, arrays["train"].reshape(-1, 3), arrays["test"].reshape(-1, 3)])
    arrays["view"] = framing(shown, plot.direction, plot.up, size[0] / height)
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
