"""Overview image of cameras and points in space, rendered by pyvista in a separate process."""

from __future__ import annotations

import subprocess

import numpy as np

from warpgs.runtime.disk_space import disk_is_full
from warpgs.runtime.subprocesses import run_python
from warpgs.scene import Camera
from warpgs.temporary import system_folder, temporary_folder

REMEDY = "install a software renderer: on Debian or Ubuntu `apt-get install libegl1 libgl1 libgl1-mesa-dri libxrender1`"
TIMEOUT = 90
WIDTH, HEIGHT, VIEW_ANGLE = 1280, 640, 40.0  # [px], [px], vertical [deg]
OUTSIDE, EDGE = 1.0, 0.15
"""Margins (see `within`) for the points to show and for the points to frame: they keep walls whole and drop far background."""
TRAIN_COLOR, TEST_COLOR = "#149696", "#e08a2c"

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
    last = done.stderr.strip().splitlines()
    return False, f"pyvista ended with code {done.returncode}" + (f" ({last[-1][:100]})" if last else "")


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


RENDER_SCRIPT = f"""
import sys, numpy as np, pyvista as pv
d = np.load(sys.argv[1])
p = pv.Plotter(off_screen=True, window_size=({WIDTH}, {HEIGHT}))
p.set_background("white")
cloud = pv.PolyData(d["points"])
cloud["rgb"] = d["colors"]
p.add_mesh(cloud, scalars="rgb", rgb=True, point_size=4, render_points_as_spheres=False)
for key, color in (("train", "{TRAIN_COLOR}"), ("test", "{TEST_COLOR}")):
    if len(d[key]):
        p.add_lines(d[key].reshape(-1, 3), color=color, width=2)
p.camera.position, p.camera.focal_point, p.camera.up = d["view"]
p.camera.view_angle = {VIEW_ANGLE}
p.screenshot(sys.argv[2])
"""


def framing(shown: np.ndarray, direction: np.ndarray, up: np.ndarray, aspect: float = WIDTH / HEIGHT) -> np.ndarray:
    """Return eye, focal point and up vector, shape [3, 3], from which all points of ``shown`` are in the image.

    Args:
        shown: Points that must be seen [u], shape [N, 3].
        direction: Direction from the scene to the eye, any length, shape [3].
        up: Rough upward direction, shape [3]; replaced by any perpendicular where it lies along ``direction``.
        aspect: Width of the image over its height.
    """
    length = np.linalg.norm(direction)
    forward = -direction / length if length > 0 else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-3:
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    axes = np.stack([right / np.linalg.norm(right), np.zeros(3), forward])
    axes[1] = np.cross(axes[0], forward)
    slope = np.tan(np.radians(VIEW_ANGLE / 2)) / 1.06
    seen = shown @ axes.T
    low, high = seen.min(0), seen.max(0)
    eye, focus = (low + high) / 2, (low + high) / 2
    eye[2] -= max(float((high - low).max()), 1e-6) * 2
    for _ in range(20):  # move the camera until the content touches the edges: near content looks larger
        depth = np.maximum(seen[:, 2] - eye[2], 1e-9)
        x, y = (seen[:, 0] - eye[0]) / depth, (seen[:, 1] - eye[1]) / depth
        nearest, middle = float(depth.min()), float(np.median(depth))
        half = max((y.max() - y.min()) / slope, (x.max() - x.min()) / (slope * aspect)) / 2
        eye[:2] += 0.5 * middle * np.array([x.max() + x.min(), y.max() + y.min()]) / 2
        eye[2] -= max((half - 1) * middle, -0.5 * nearest)
    focus[:2] = eye[:2]
    focus[2] = max(focus[2], eye[2] + 1e-6)
    return np.stack([eye @ axes, focus @ axes, axes[1]])


def within(points: np.ndarray, margin: float) -> np.ndarray:
    """Return a mask [N] of the points in the box between the 5th and 95th percentiles, enlarged by ``margin`` at each side.

    The margin is a fraction of the box's size.
    """
    low, high = np.percentile(points, [5, 95], axis=0)
    return ((points >= low - margin * (high - low)) & (points <= high + margin * (high - low))).all(1)


def render_overview(
    train: list[Camera], test: list[Camera], points: np.ndarray, colors: np.ndarray, up: np.ndarray
) -> tuple[bytes | None, str]:
    """Render training and held-out cameras among points [N, 3] [u] with colours in [0, 1] [N, 3], ``up`` [3] upwards.

    Returns:
        PNG bytes and an empty string; or None and the reason why there is no image, with a remedy if there is one.
    """
    if not (len(points) and train):
        return None, "no overview image: there are no points or no training cameras to show"
    centers = np.array([c.center for c in train])
    low, high = np.percentile(points, [5, 95], axis=0)
    inside = within(points, OUTSIDE)
    middle, spread = np.median(points, axis=0), float(np.linalg.norm(high - low)) + 1e-9
    forward = np.mean([c.viewmat[2, :3] for c in train], axis=0)
    back = centers.mean(0) - middle
    reach = max(float(np.linalg.norm(back)), 0.5 * spread)
    side = np.cross(forward, up)
    direction = 1.5 * back + 0.7 * reach * side / max(np.linalg.norm(side), 1e-9) + 0.5 * reach * up
    size = 0.12 * max(reach, 1e-6)
    lines = {"train": frusta(train, size), "test": frusta(test, size)}
    core = points[within(points, EDGE)]
    view = framing(np.concatenate([core, *(f.reshape(-1, 3) for f in lines.values())]), direction, up)
    try:
        with temporary_folder() as folder:
            source, target = (folder.path / name for name in ("scene.npz", "overview.png"))
            np.savez(
                source, points=points[inside].astype(np.float32),
                colors=np.round(255 * np.clip(colors[inside], 0, 1)).astype(np.uint8), view=view, **lines,
            )  # fmt: skip
            works, why = run_pyvista(RENDER_SCRIPT, str(source), str(target))
            if works and target.is_file():
                return target.read_bytes(), ""
    except OSError as e:
        return None, f"no overview image: temporary files cannot be written ({e.strerror or e}); free some disk space"
    return None, f"no overview image: {why}; {remedy_for(why)}"
