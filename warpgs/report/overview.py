"""A scene with its cameras in one image: the overview of a report, and plots."""

import math
from dataclasses import replace

import numpy as np
import torch
from PIL import Image, ImageColor, ImageDraw, ImageFont

from warpgs.geometry import pose_of
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

SIZE, VIEW_ANGLE = (1280, 640), 40.0  # [px], vertical [deg]
OUTSIDE, EDGE = 1.0, 0.15
"""Margins (see `within`) for the points to show and for the points to frame: they keep walls whole and drop far background."""
TRAIN_COLOR, TEST_COLOR = "#149696", "#e08a2c"
PIECES = 32
"""Pieces of a line of the overview, each of which is shown or hidden."""
INK = {"white": "#1b1d21", "black": "#e8e9ec"}
"""Colour of letters on each background."""
LEGEND_HEIGHT = 0.06
"""Height of the strip for the legend, as a fraction of the image."""


def frusta(cameras: list[Camera], size: float) -> np.ndarray:
    """Return line segments [S, 2, 3] of camera pyramids, with image planes at distance ``size`` [u]."""
    lines = []
    for c in cameras:
        corners = np.array([[0, 0, 1], [c.width, 0, 1], [c.width, c.height, 1], [0, c.height, 1]], float)
        world = (corners @ np.linalg.inv(c.K).T * size - c.viewmat[:3, 3]) @ c.viewmat[:3, :3]
        lines += [(c.center, p) for p in world] + [(world[i], world[(i + 1) % 4]) for i in range(4)]
    return np.array(lines)


def framing(shown: np.ndarray, direction: np.ndarray, up: np.ndarray, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Return axes (right, down, forward) [3, 3] and position [3] of the nearest camera that looks so and sees all points."""
    length = np.linalg.norm(direction)
    forward = -direction / length if length > 0 else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-3:
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right = right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    slope = np.tan(np.radians(VIEW_ANGLE / 2)) / 1.06
    eye, points = [], shown @ axes.T
    for along, steep in ((0, slope * aspect), (1, slope)):
        # two planes through the camera, each touched by a point
        far, near = ((sign * points[:, along] - steep * points[:, 2]).max() for sign in (1, -1))
        eye.append(((far - near) / 2, -(far + near) / (2 * steep)))
    (x, back), (y, aside) = eye
    return axes, np.array([x, y, min(back, aside) - 1e-6]) @ axes


def within(points: np.ndarray, margin: float) -> np.ndarray:
    """Mask [N] of the points in the box of the 5th to 95th percentiles, enlarged by ``margin`` times its size at each side."""
    low, high = np.percentile(points, [5, 95], axis=0)
    return ((points >= low - margin * (high - low)) & (points <= high + margin * (high - low))).all(1)


def render_overview(
    gaussians: Gaussians, options: RasterizeOptions, train: list[Camera], test: list[Camera], up: np.ndarray, *,
    size: tuple[int, int] = SIZE, background: str | None = "white", cameras: bool = True,
) -> np.ndarray | None:  # fmt: skip
    """Render training and held-out cameras among Gaussians, ``up`` [3] upwards; colours [H, W, 3], None without Gaussians.

    A ``background`` of None is that of the options.
    """
    points = gaussians.means.detach().cpu().numpy().astype(np.float64)
    if not len(points):
        return None
    low, high = np.percentile(points, [5, 95], axis=0)
    back = np.mean([c.center for c in train], axis=0) - np.median(points, axis=0)
    reach = max(float(np.linalg.norm(back)), 0.5 * float(np.linalg.norm(high - low)), 1e-6)
    side = np.cross(np.mean([c.viewmat[2, :3] for c in train], axis=0), up)
    direction = 1.5 * back + 0.7 * reach * side / max(float(np.linalg.norm(side)), 1e-9) + 0.5 * reach * up
    core = points[within(points, EDGE)]
    far = _frustum_size([*train, *test], core)
    kinds = ((train, TRAIN_COLOR), (test, TEST_COLOR)) if cameras else ()
    lines = [(frusta(shown, far), color) for shown, color in kinds if shown]
    width, height = size
    shown = np.concatenate([core, *(segments.reshape(-1, 3) for segments, _ in lines)])
    rotation, eye = framing(shown, direction, up, width / height)
    viewmat = pose_of(rotation, -rotation @ eye)
    focal = height / 2 / math.tan(math.radians(VIEW_ANGLE / 2))
    camera = Camera(viewmat, np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), width, height)
    near = torch.from_numpy(within(points, OUTSIDE)).to(gaussians.means.device)
    inside = Gaussians(**{n: t.detach()[near] for n, t in gaussians.tensors().items()})
    # the first harmonic alone: the others are not trained for directions beside the photographs
    if background is not None:
        behind = torch.full((3,), float(background == "white"), dtype=torch.float32, device=gaussians.means.device)
        options = replace(options, background=behind)
    with torch.no_grad():
        render = rasterize(inside, camera, replace(options, sh_degree=0))
    image = np.round(255 * render.rgb.clamp(0, 1).cpu().numpy()).astype(np.uint8)
    depth = torch.where(render.alpha > 0.5, render.depth, torch.inf).cpu().numpy()
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
        for first, last in np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]))).reshape(-1, 2):
            cv2.line(image, fixed[first], fixed[last - 1], rgb, 2, cv2.LINE_AA, 4)


def _frustum_size(cameras: list[Camera], points: np.ndarray) -> float:
    """Return the height of camera pyramids [u]: 0.8 times the median gap between cameras, in [0.03, 0.12] times the extent."""
    centers = np.array([c.center for c in cameras])
    everything = np.concatenate([points, centers])
    reach = float(np.sqrt(((everything - everything.mean(0)) ** 2).sum(1)).max())
    if len(cameras) < 2:
        return 0.12 * reach
    apart = np.sqrt(((centers[:, None] - centers[None]) ** 2).sum(-1)) + np.diag(np.full(len(centers), np.inf))
    return float(np.clip(0.8 * np.median(apart.min(1)), 0.03 * reach, 0.12 * reach))


def with_legend(image: np.ndarray, entries: list[tuple[str, str]], height: int, background: str) -> np.ndarray:
    """Return colours [height, W, 3]: an image [H, W, 3], and below it a strip with a square and text for each entry."""
    rows, width = image.shape[:2]
    canvas, strip = Image.new("RGB", (width, height), background), height - rows
    draw, side, gap = ImageDraw.Draw(canvas), 0.32 * strip, 0.5 * strip
    for letters in (0.42 * strip, 0.3 * strip, 0.22 * strip):
        font = ImageFont.load_default(max(letters, 6))
        if sum(side + 2 * gap + font.getlength(words) for words, _ in entries) <= width:
            break
    x, y = gap, height - 0.55 * strip
    for words, color in entries:
        draw.rectangle((x, y - side / 2, x + side, y + side / 2), color)
        draw.text((x + side + 0.5 * gap, y), words, INK[background], font, anchor="lm")
        x += side + 1.5 * gap + font.getlength(words)
    return np.concatenate([image, (np.asarray(canvas, np.float32) / 255)[rows:]])
