"""A model as one HTML file, in the viewer's conventions."""

from __future__ import annotations

import html
import math
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from warpgs import geometry
from warpgs.device import format_bytes
from warpgs.errors import DataError
from warpgs.files import write_text
from warpgs.geometry import CENTRAL, convert_camera, convert_gaussians, look_at, matmul, pose_at, quaternions, rotation_matrices
from warpgs.locks import hold_file
from warpgs.pipeline.films.paths import fov_y, framed, rig_among, rig_of, upright
from warpgs.pipeline.metrics.coverage import coverage_map, depth_views
from warpgs.pipeline.metrics.scores import Renders
from warpgs.pipeline.run.export import NO_FILTERS, Filters, file_gaussians, filtered
from warpgs.pipeline.run.folder import open_run
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Camera, Gaussians, Normalization, base_colors
from warpgs.viewer.server import FIRST, LIMITS, TURNING, open_server, require_viser, stop_server

if TYPE_CHECKING:
    import viser


FIELD_OF_VIEW = math.radians(50)
"""Vertical field of view of the camera that is made for a model without cameras [rad]."""


def wxyz_of(camera: Camera) -> np.ndarray:
    """Return the rotation from camera to world axes as a unit quaternion wxyz, float64, shape [4]."""
    return quaternions(torch.from_numpy(np.asarray(camera.viewmat)[None, :3, :3].transpose(0, 2, 1).copy()))[0].numpy()


def _seen(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which points [N, 3] [u] are in a camera's image, bool [N], and the depths of all [N] [u]."""
    pixels, depths = geometry.project_points(camera, points)
    return (depths > 0) & (pixels > 0).all(1) & (pixels < [camera.width, camera.height]).all(1), depths


def distance_ahead(camera: Camera, gaussians: Gaussians) -> float:
    """Return the median depth [u] of the means that a camera sees, or 1 if it sees none; the view turns about this depth."""
    seen, depths = _seen(camera, gaussians.means.detach().cpu().double().numpy())
    return float(np.median(depths[seen])) if seen.any() else 1.0


def camera_at(wxyz: Any, position: Any, fov: float, width: int, height: int) -> Camera:
    """Return the pinhole camera of a camera-to-world rotation, position [u] and vertical field of view [rad]."""
    rotation = rotation_matrices(np.asarray(wxyz, np.float64)).T
    return _pinhole(pose_at(rotation, np.asarray(position, np.float64)), fov, width, height)


def _pinhole(viewmat: np.ndarray, fov: float, width: int, height: int) -> Camera:
    focal = 0.5 * height / math.tan(0.5 * fov)
    return Camera(viewmat, np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1.0]]), width, height)


def camera_before(gaussians: Gaussians, width: int = 960, height: int = 720) -> Camera:
    """Return a camera at -z that sees the box between the 5th and 95th percentiles of the means, for models without cameras."""
    low, high = np.percentile(gaussians.means.detach().cpu().double().numpy(), [5, 95], axis=0)
    middle, radius = (low + high) / 2, max(0.5 * float(np.linalg.norm(high - low)), 1e-6)
    center = middle - np.array([0, 0, radius / math.sin(0.5 * FIELD_OF_VIEW)])
    return _pinhole(look_at(center, middle, np.array([0.0, -1, 0])), FIELD_OF_VIEW, width, height)


def stands_at(camera: Camera, other: Camera, near: float) -> bool:
    """Return whether two cameras are within ``near`` [u] of each other, and their axes within 1.8 degrees."""
    turned = float(np.trace(matmul(camera.viewmat[:3, :3], other.viewmat[:3, :3].T)))
    return bool(np.linalg.norm(camera.center - other.center) <= near) and turned > 3 - 1e-3


LARGEST_HALF = 65504.0
"""Largest finite number in half precision."""
MEDIAN_AXIS = 1.0
"""Length of the median Gaussian's longest axis in the units of stored covariances. Squares of axes are exact to 0.05 % if they
are at least 6.1e-5, the smallest normal number: for axes from 1/128 of the median to 255 times the median."""


def packed(gaussians: Gaussians) -> tuple[tuple[np.ndarray, ...], float, int]:
    """Return N Gaussians for the browser, scene units per stored unit, and the number of those that are shown shorter.

    Positions [N, 3] and covariances [N, 3, 3] are float32 in stored units, within half precision; colours of degree 0 [N, 3]
    and opacities [N, 1] are uint8.
    """
    # Half precision is too coarse for covariances in scene units: an axis of 0.001 u has the square 1e-6, of which four
    # bits remain; the square of an axis below 0.00017 u becomes 0. In units in which the median of the longest axes is
    # 1, nearly all squares keep eleven bits.
    means, quats, log_scales, logits, sh = (t.detach().cpu().double().numpy() for t in gaussians.tensors().values())
    scale = math.exp(float(np.median(log_scales.max(1))) if len(means) else 0.0) / MEDIAN_AXIS
    longest = 0.5 * math.log(LARGEST_HALF) - 1e-3  # the diagonal of a rotated covariance is no longer than its longest axis
    relative = log_scales - math.log(scale)
    rotations = rotation_matrices(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    covariances = np.einsum("nij,nj,nkj->nik", rotations, np.exp(np.minimum(relative, longest)) ** 2, rotations)
    shown = np.clip(base_colors(sh), 0, 1), torch.sigmoid(torch.from_numpy(logits)).numpy()[:, None]
    colors, opacities = (np.round(255 * values).astype(np.uint8) for values in shown)
    arrays = (means / scale).astype(np.float32), covariances.astype(np.float32), colors, opacities
    return arrays, scale, int((relative > longest).any(1).sum())


POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; worker-src blob: data:; connect-src data: blob:; base-uri 'none'; form-action 'none'"
)
"""Content security policy of the page: it may use its own contents, and request nothing."""
NO_REMARKS = "<style>.mantine-Notifications-root{display:none}</style>"
"""Style that hides viser's remark on browsers without a GPU, which would cover the model."""
NO_SCENE_TREE = '<style>:has(>[aria-label$="scene tree"]){display:none!important}</style>'
"""Style that hides viser's button for the scene tree, which has only one entry."""
LOADING = (
    '<div id="warpgs-loading" style="position:fixed;inset:0;z-index:2;display:grid;place-items:center;pointer-events:none;'
    'font:16px sans-serif;color:#888">Loading the scene ...</div>'
    "<script>{let tries=600;const text=document.querySelector('#warpgs-loading'),wait=()=>{let shown=0;"
    "window.__viserMutable?.scene?.traverse(o=>{shown=Math.max(shown,o.material?.uniforms?.transitionInState?.value??0)});"
    "if(shown>0.5||!--tries)text.remove();else setTimeout(wait,100)};wait()}</script>"
)
"""Text in the empty page until viser fades the Gaussians in, at most for a minute of trying."""
SORT_FROM_DISK = (
    "<script>{const make=URL.createObjectURL;URL.createObjectURL="
    "b=>b instanceof Blob&&b.type.startsWith('text/javascript')?'':make.call(URL,b)}</script>"
)
"""Script for a page opened from disk. Browsers reject its blobs as module workers; without the sorting worker, Gaussians
are blended in the order of the file. The script hides the blob, so viser's page starts the worker from a data:
address, which works."""
LEAST_MARGIN, LARGEST_MARGIN = math.radians(2), math.radians(15)
"""Limits of the angle that a page may turn beyond the photographs [rad]; between them it is a quarter of the captured arc."""
ALL_ROUND = math.radians(100)
"""Largest gap between the azimuths of photographs all round [rad]; four around an object have 90 degrees."""


def place_first_camera(
    server: viser.ViserServer, camera: Camera, gaussians: Gaussians, cameras: Sequence[Camera], level: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Set the camera at which pages start; return its target [3] [u] and the upward direction [3], ``level`` or of films."""
    target = camera.center + distance_ahead(camera, gaussians) * np.asarray(camera.viewmat[2, :3])
    points, own = gaussians.means.detach().cpu().double().numpy(), -np.asarray(camera.viewmat[1, :3])
    up = rig_among(list(cameras), points).up if level is None else level
    up = up if (up * own).sum() > 0.5 else own  # the camera looks along it
    server.scene.set_up_direction(up)
    server.initial_camera.position = camera.center
    server.initial_camera.look_at = target
    server.initial_camera.up = up  # the page turns about it: about the camera's own, a half turn would end below the ground
    server.initial_camera.fov = fov_y(camera)
    server.initial_camera.far = 1e5  # else content beyond 1000 u is clipped
    return target, up


MOST = 0.95
"""A page starts at a photograph that covers at least this part of what the best one covers: not at a close-up in the middle."""


def middle_first(cameras: Sequence[Camera], gaussians: Gaussians) -> list[Camera]:
    """Return cameras that are not far off the rest, first, upright, the one at which a view starts, then the others.

    It is the nearest to their mean centre of those that show most of the Gaussians that the others show.
    """
    if not cameras:
        return []
    centers = np.array([c.center for c in cameras])
    near = geometry.near_cameras(centers)  # what is between a lone camera and the rest, no photograph shows
    cameras, centers = [c for c, kept in zip(cameras, near) if kept], centers[near]
    means = gaussians.means.detach().cpu().double().numpy()
    seen = np.array([_seen(c, means[:: 1 + len(means) // 10_000])[0] for c in cameras], float)
    covered = (seen @ seen.T / np.maximum(seen.sum(1), 1)).sum(1)  # the seen part of each other one, exact
    asides = np.linalg.norm(centers - centers.mean(0), axis=1)
    first = int(np.argmin(np.where(covered >= MOST * covered.max(), asides, math.inf)))
    # no part of whether photographs lie depends on the depth
    return [upright(rig_of(cameras, 1.0), cameras[first]), *cameras[:first], *cameras[first + 1 :]]


def turning_limits(cameras: Sequence[Camera], target: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the captured arc around a target, to the left, right, top and bottom of the first camera, and the margin [rad]."""
    # Beyond the margin, the model shows places that no photograph saw. One camera says nothing about an arc, and
    # photographs all round leave no end to the left and right: infinity.
    arc = np.full(4, math.inf)
    if len(cameras) < 2:
        return arc, LARGEST_MARGIN
    # as seen from the target, and by the axis: cameras in a row look in parallel, those in a room outwards
    ways = np.array([w for c in cameras for w in (c.center - target, -np.asarray(c.viewmat[2, :3]))])
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
    heights = np.clip((ways * up).sum(1), -1, 1)
    flat = ways - heights[:, None] * up
    level = np.abs(heights) < max(0.95, abs(heights[0]) + 1e-9)  # straight down there is no azimuth
    # rounded, since -1e-17 for the first camera itself would be a whole turn
    azimuths = np.sort(np.arctan2((flat * np.cross(up, flat[0])).sum(1), (flat * flat[0]).sum(1))[level].round(9))
    gaps = np.diff(azimuths, append=azimuths[0] + 2 * math.pi)
    widest = int(np.argmax(gaps))  # the arc is all but the widest gap, and has the first camera at 0
    if gaps[widest] > ALL_ROUND:
        arc[:2] = -azimuths[(widest + 1) % len(azimuths)] % (2 * math.pi), azimuths[widest] % (2 * math.pi)
    elevations = np.arcsin(heights) - np.arcsin(heights[0])
    arc[2:] = elevations.max(), -elevations.min()
    return arc, float(np.clip(max(arc[:2].sum(), arc[2:].sum()) / 4, LEAST_MARGIN, LARGEST_MARGIN))


SIDE, TRIED, SUPPORT = 160, 8, 0.8
"""Longer side of the views [px] that are tried on each side of the first camera, their number, and the least part of their
surface that two photographs saw, as a fraction of this part at the first camera: below it, smears prevail."""


def supported(
    gaussians: Gaussians, cameras: Sequence[Camera], target: np.ndarray, up: np.ndarray, arc: np.ndarray, margin: float
) -> tuple[np.ndarray, float]:
    """Return an arc and a margin that end, on each side, before views that show mostly what fewer than two cameras saw."""
    if len(cameras) < 2 or not all(c.model in CENTRAL for c in cameras):
        return arc, margin
    sizes = [-(-SIDE * np.array([c.width, c.height]) // max(c.width, c.height)) for c in cameras]
    renders = Renders(gaussians, RasterizeOptions())
    photographs = depth_views(renders, [framed(c, (int(w), int(h))) for c, (w, h) in zip(cameras, sizes)])
    first = photographs[0][0]

    def share(axis: np.ndarray, angle: float) -> float:
        turn = rotation_matrices(np.array([math.cos(angle / 2), *(math.sin(angle / 2) * axis)]))
        pose = pose_at(matmul(first.viewmat[:3, :3], turn.T), target + matmul(turn, first.center - target))
        ((turned, depth),) = depth_views(renders, [replace(first, viewmat=pose)])
        return float((coverage_map(depth, turned, photographs)[0] > 1).sum() / max(1, int((depth > 0).sum())))

    ends, least, right = arc + margin, SUPPORT * share(up, 0.0), np.asarray(first.viewmat[0, :3])
    for side, axis in enumerate((-up, up, -right, right)):
        angles = min(ends[side], math.pi) * np.linspace(0, 1, TRIED + 1) ** 2
        shares = [share(axis, angle) for angle in angles]
        if i := int(np.argmax(np.less(shares, least))):
            ends[side] = max(LEAST_MARGIN, np.interp(least, [shares[i], shares[i - 1]], [angles[i], angles[i - 1]]))
    margin = min(margin, float(ends.min()))
    return ends - margin, margin


def add_limits(server: viser.ViserServer, away: np.ndarray, arc: np.ndarray, margin: float, on: bool = True) -> None:
    """Give pages the limits about the first camera, ``away`` [u] from the target, as positions of nodes that draw nothing."""
    for name, position in {"": away, "/sides": (*arc[:2], margin), "/tilt": (*arc[2:], on)}.items():
        server.scene.add_frame(LIMITS + name, show_axes=False, position=np.minimum(position, 1e3).astype(float))


def seen_at(cameras: Sequence[Camera], target: np.ndarray) -> tuple[float, float]:
    """Return half the width and height, at distance 1 from the first camera, of what cameras see at the target's depth."""
    first, ends = cameras[0], []
    axis = np.asarray(first.viewmat[2, :3])
    for c in cameras:
        corners = np.array([[x, y, 1.0] for x in (0, c.width) for y in (0, c.height)])
        rays = matmul(matmul(corners, np.linalg.inv(c.K).T), np.asarray(c.viewmat[:3, :3]))
        slopes = (rays * axis).sum(1)
        depths = ((target - c.center) * axis).sum() / np.where(slopes > 0.3, slopes, math.inf)  # not along the plane
        if (depths > 0).any():
            seen = c.center + depths[depths > 0, None] * rays[depths > 0] - first.center
            x, y, z = matmul(seen, np.asarray(first.viewmat[:3, :3]).T).T
            ends.append([(x / z).max(), -(x / z).min(), (y / z).max(), -(y / z).min()])
    right, left, below, above = np.quantile(ends, 0.6, axis=0, method="higher")  # what fewer cameras see is vague
    return float(min(right, left)), float(min(below, above))


def plain_background(color: Sequence[float]) -> np.ndarray:
    """Return an image of one colour in [0, 1], uint8, shape [2, 2, 3], as background of the scene."""
    return np.full((2, 2, 3), np.round(255 * np.clip(color, 0, 1)), np.uint8)


def write_html(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    cameras: Sequence[Camera] = (),
    background: Sequence[float] = (0.0, 0.0, 0.0),
    title: str = "warpgs",
    normalization: Normalization | None = None,
) -> list[str]:
    """Write a model as one HTML file, which appears whole or not at all; return notes on differences from a render.

    The upward direction and the unit of the page's ruler are those of the normalization.
    """
    # The page holds the Gaussians in their own units (`packed`), with colours of degree 0 only. It contains no name of
    # a file, a view or a machine, except ``title``.
    if not len(gaussians):
        raise DataError("a page needs at least one Gaussian; fit the scene for longer")
    (arrays, scale, shortened), normalization = packed(gaussians), normalization or Normalization()
    known, cameras = bool(cameras), cameras or [camera_before(gaussians)]
    first, server = cameras[0], open_server(port=0)
    try:
        target, up = place_first_camera(server, first, gaussians, cameras, normalization.up)
        server.scene.set_background_image(plain_background(background), format="png")
        limits = supported(gaussians, cameras, target, up, *turning_limits(cameras, target, up))
        add_limits(server, first.center - target, *limits)
        server.scene.add_gaussian_splats("/gaussians", *arrays, scale=scale)
        text = server.get_scene_serializer().as_html(dark_mode=True)
    finally:
        stop_server(server)
    head = f'<head><meta http-equiv="Content-Security-Policy" content="{POLICY}" />'
    head += f"<script>{FIRST}{TURNING}</script>{SORT_FROM_DISK}{NO_REMARKS}{NO_SCENE_TREE}"
    text = re.sub(r"<title>[^<]*</title>", lambda _: f"<title>{html.escape(title)}</title>", text, count=1)
    text, end, rest = text.replace("<head>", head, 1).replace("<body>", f"<body>{LOADING}", 1).rpartition("</body>")
    wide, tall = seen_at(cameras, target) if known else (1e3, 1e3)
    values = {"OWN": fov_y(first), "SIDE": 0.5 * first.width / float(first.K[0, 0]), "WIDE": wide, "TALL": tall}
    tools = Path(__file__).with_name("tools.html").read_text("utf-8").replace("UNIT", normalization.unit)
    tools = tools.replace("BACK", " ".join(map(str, plain_background(background)[0, 0])))
    for name, value in (values | {"LENGTH": 1 / normalization.scale}).items():
        tools = tools.replace(name, f"{value:.8g}")
    write_text(Path(path), f"{text}{tools}{end}{rest}")
    notes = ["the page shows no view-dependent colours; the run and its PLY keep them"] if gaussians.sh_degree else []
    return notes + [f"{shortened:,} Gaussians are longer than the page can store, and are shown shorter"] * bool(shortened)


def export_html(folder: Path, target: Path, filters: Filters = NO_FILTERS) -> list[str]:
    """Write a run as one HTML file that starts at a training camera in the middle; returns lines for the user."""
    require_viser()
    run = open_run(folder, "cpu")
    gaussians, rotation, lines = filtered(file_gaussians(run), run, filters, True, run.normalization.origin)
    if not len(gaussians):
        raise DataError(f"{target}: not written, no Gaussian is left. Give a larger box, or --no-clean")
    found = run.normalization.local
    cameras = [convert_camera(run.scene_cameras[n], found, "scene", "file") for n in run.train]
    if rotation is not None:
        cameras = [convert_camera(c, Normalization(rotation=rotation.T), "scene", "file") for c in cameras]
        found = replace(found, up=None if found.up is None else found.rotation @ rotation @ found.rotation.T @ found.up)
    gaussians = convert_gaussians(gaussians, found, "file", "scene")
    cameras = [convert_camera(c, found, "file", "scene") for c in cameras]
    if found.up is None:  # of the cameras as they are: the first one alone is made upright below
        found = replace(found, up=rig_among(cameras, gaussians.means.double().numpy()).up)
    with hold_file(target) as held:
        title = target.stem.encode("utf-8", "replace").decode()  # ? for bytes that are not UTF-8
        notes = write_html(target, gaussians, middle_first(cameras, gaussians), run.background, title, found)
    if run.antialiased:
        notes.append("the page shows the model without antialiasing: too bright from afar and in small windows")
    size = format_bytes(target.stat().st_size)
    last = f"{len(gaussians):,} Gaussians in {target}, {size}; open it in any browser, without a network"
    return [*run.notes(), *held, *lines, *notes, last]
