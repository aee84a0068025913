"""Depth by sweeping planes: how well do the other views agree with this one at every depth, smoothed along scanlines.

Poses are known, so a match is sought along the epipolar line only: one plane per inverse depth (Collins 1996), zero-mean
normalised correlation over a window, semi-global aggregation (Hirschmüller 2008), a parabola between planes, and depths kept
where another view's own sweep agrees. Compared with optical flow in docs/decisions/007-coarse-start.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch

from warpgs.errors import UsageError
from warpgs.priors.epipolar import nearest_views, pixel_grid
from warpgs.scene import Camera, View, ViewDepth

NOISE = (2 / 255) ** 2
"""Variance of a window below which its pattern is noise: correlation fades to 0 there."""
EDGE = 0.06
"""Step of the picture at which the penalty for a jump in depth falls to 1/e."""
NO_OPINION = 0.5
"""Cost of correlation 0: where a plane leaves the other image, or nothing has texture."""


PLANES_AT_ONCE = 16
"""Planes whose costs are written together: 64 bytes of each pixel."""
MAX_AT_ONCE = 4
"""Views swept at a time; each takes memory for two volumes of costs."""


@dataclass(frozen=True)
class SweepConfig:
    """How planes are laid, costs smoothed and depths confirmed."""

    near_count: int = 4
    """Nearest other views that each view is compared with."""
    window: int = 7
    """Side of the square in which pixels are correlated [px]; odd, at least 3."""
    spacing: float = 0.5
    """Largest step of a match from one plane to the next [px], while `max_planes` allows it."""
    max_planes: int = 256
    """Planes at most, at least 8; memory is 8 bytes per pixel and plane."""
    max_pixels: int = 200_000
    """Larger images are swept at a reduced size."""
    small_step: float = 0.03
    """Penalty for a depth one plane off the neighbouring pixel's (P1); costs lie in [0, 1]."""
    large_step: float = 0.5
    """Penalty for any other depth (P2) where the picture is even; less across its edges, but above 1.5 P1."""
    max_round_trip: float = 0.6
    """A depth counts where the depth that another view found leads back nearer than this [px]."""
    min_parallax: float = 0.5
    """Smallest angle between the two rays [deg]; below it depth is noise."""

    def __post_init__(self):
        if not (self.window >= 3 and self.window % 2 == 1):
            raise UsageError(f"sweep window {self.window} must be odd and at least 3")
        if not (self.max_planes >= 8 and self.near_count >= 1 and self.max_pixels >= 1):
            raise UsageError("sweep needs at least 8 planes, 1 near view and 1 pixel")
        for name in ("spacing", "small_step", "large_step", "max_round_trip", "min_parallax"):
            if not getattr(self, name) > 0:
                raise UsageError(f"sweep {name.replace('_', '-')} must be above 0, not {getattr(self, name)}")


def project_inverse(first: Camera, second: Camera, pixels: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Positions in the second image [px], shape [N, 2], of pixels [N, 2] at inverse depths [N] [1/u]; NaN behind the camera."""
    relative = second.viewmat @ np.linalg.inv(first.viewmat)
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ np.linalg.inv(first.K).T
    p = (rays @ relative[:3, :3].T + inverse[:, None] * relative[:3, 3]) @ second.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(p[:, 2:] > 1e-9, p[:, :2] / p[:, 2:], np.nan)


def _inside(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """True where pixels [..., 2] lie in the image; NaN does not."""
    return (pixels >= 0).all(-1) & (pixels[..., 0] < camera.width) & (pixels[..., 1] < camera.height)


def plane_inverses(
    first: Camera, others: Sequence[Camera], bounds: tuple[float, float], spacing: float, max_planes: int
) -> np.ndarray:
    """Inverse depths [1/u], evenly spaced and ascending, from the far to the near bound [u].

    Their number is the fewest at which no match inside an image moves more than about ``spacing`` px between planes, 8 to
    ``max_planes``.
    """
    near, far = bounds
    x, y = np.meshgrid(np.linspace(0, first.width, 5), np.linspace(0, first.height, 5))
    pixels = np.stack([x.ravel(), y.ravel()], 1)
    ladder = np.linspace(1 / far, 1 / near, 17)
    longest = 0.0
    for other in others:
        found = np.stack([project_inverse(first, other, pixels, np.full(len(pixels), w)) for w in ladder])
        inside = _inside(other, found)
        steps = np.linalg.norm(np.diff(found, axis=0), axis=2)[inside[1:] & inside[:-1]]
        longest = max(longest, float(steps.max(initial=0)) * (len(ladder) - 1))
    return np.linspace(1 / far, 1 / near, int(np.clip(np.ceil(longest / spacing) + 1, 8, max_planes)))


def plane_homography(first: Camera, second: Camera, inverse: float) -> np.ndarray:
    """H [3, 3] from first to second by the plane z = 1 / inverse, for pixels whose centres are whole numbers (OpenCV)."""
    relative = second.viewmat @ np.linalg.inv(first.viewmat)
    H = second.K @ (relative[:3, :3] + inverse * np.outer(relative[:3, 3], [0, 0, 1])) @ np.linalg.inv(first.K)
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    return np.linalg.inv(shift) @ H @ shift


def matching_costs(view: View, others: Sequence[View], inverses: np.ndarray, window: int) -> np.ndarray:
    """Disagreement of views at D inverse depths, in [0, 1], float32, shape [H, W, D].

    Of the costs 0.5 (1 - correlation) of the other views half the mean and half the least: a view that does not see the
    point counts, but cannot outvote one that does.
    """
    import cv2

    size, box = (view.camera.width, view.camera.height), (window, window)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    own, *grays = [cv2.cvtColor(v.image, cv2.COLOR_RGB2GRAY) for v in (view, *others)]
    mean = cv2.blur(own, box)
    variance = np.maximum(cv2.blur(own * own, box) - mean * mean, 0) + NOISE
    out = np.empty((size[1], size[0], len(inverses)), np.float32)
    planes = np.empty((PLANES_AT_ONCE, size[1], size[0]), np.float32)  # neighbours in memory are written together
    for d, inverse in enumerate(inverses):
        least, total = None, 0
        for other, gray in zip(others, grays):
            H = plane_homography(view.camera, other.camera, inverse)
            warped = cv2.warpPerspective(gray, H, size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=-1)
            m = cv2.blur(warped, box)
            v = np.maximum(cv2.blur(warped * warped, box) - m * m, 0) + NOISE
            cost = 0.5 - 0.5 * (cv2.blur(own * warped, box) - mean * m) / np.sqrt(variance * v)
            cost[~(warped >= 0)] = NO_OPINION
            total = total + cost
            least = cost if least is None else np.minimum(least, cost)
        at = d % PLANES_AT_ONCE
        planes[at] = 0.5 * least + total * (0.5 / len(others))
        if at == PLANES_AT_ONCE - 1 or d == len(inverses) - 1:
            out[..., d - at : d + 1] = planes[: at + 1].transpose(1, 2, 0)
    return out


def aggregate(costs: np.ndarray, image: np.ndarray, small_step: float, large_step: float) -> np.ndarray:
    """Sum of the semi-global path costs from left, right, above and below, float32, shape [H, W, D].

    Args:
        costs: Matching costs, float32, shape [H, W, D].
        image: Colours in [0, 1] whose edges allow jumps, shape [H, W, 3].
        small_step: Penalty for a change of one plane.
        large_step: Penalty for any other change, times exp(-step of the picture / EDGE).
    """
    total = np.zeros_like(costs)
    for axes in ((0, 1, 2), (1, 0, 2)):
        c, t, colors = (a.transpose(axes) for a in (costs, total, image))
        jumps = np.abs(np.diff(colors, axis=0)).max(2)
        limits = np.maximum(large_step * np.exp(-jumps / EDGE), 1.5 * small_step).astype(np.float32)
        for order, edge in ((range(len(c)), -1), (range(len(c) - 1, -1, -1), 0)):
            path = None
            for k in order:
                if path is None:
                    path = c[k].copy()
                else:
                    lowest = path.min(1, keepdims=True)
                    step = np.minimum(path, lowest + limits[k + edge, :, None])
                    path += np.float32(small_step)
                    np.minimum(step[:, 1:], path[:, :-1], out=step[:, 1:])
                    np.minimum(step[:, :-1], path[:, 1:], out=step[:, :-1])
                    step -= lowest
                    step += c[k]
                    path = step
                t[k] += path
    return total


def best_inverse(costs: np.ndarray, inverses: np.ndarray) -> np.ndarray:
    """Inverse depth [H, W] of least cost [H, W, D], between planes by the parabola through three costs."""
    k = np.clip(costs.argmin(2), 1, len(inverses) - 2)
    left, middle, right = (np.take_along_axis(costs, (k + o)[..., None], 2)[..., 0].astype(float) for o in (-1, 0, 1))
    bend = left - 2 * middle + right
    offset = np.where(bend > 1e-9, 0.5 * (left - right) / np.maximum(bend, 1e-9), 0).clip(-1, 1)
    return inverses[0] + (k + offset) * (inverses[1] - inverses[0])


def _reduced(view: View, max_pixels: int) -> View:
    """The view at the largest size of at most ``max_pixels``."""
    import cv2

    c = view.camera
    shrink = min(1.0, (max_pixels / (c.width * c.height)) ** 0.5)
    if shrink == 1.0:
        return view
    width, height = max(1, int(c.width * shrink)), max(1, int(c.height * shrink))
    K = np.diag([width / c.width, height / c.height, 1]) @ c.K
    image = cv2.resize(view.image, (width, height), interpolation=cv2.INTER_AREA)
    return View(view.name, Camera(c.viewmat, K, width, height), image)


def confirm(views: Sequence[View], inverses: Sequence[np.ndarray], index: int, config: SweepConfig) -> ViewDepth:
    """Keep the inverse depths [H, W] of one view that the depths of another confirm.

    The point is taken to each other view and back by the depth found there; it must return nearer than ``max_round_trip``
    to its pixel, with both rays at least ``min_parallax`` apart. The sensitivity is the least of the confirming views.
    """
    import cv2

    view, own = views[index], inverses[index]
    camera, pixels, w = view.camera, pixel_grid(view.camera), own.ravel()
    sensitivity = np.full(len(pixels), np.inf)
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(camera.K).T
    world = (rays / w[:, None] - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    notes, own_direction = [], world - camera.center
    own_direction /= np.linalg.norm(own_direction, axis=1, keepdims=True)
    for j in nearest_views(views, index, config.near_count):
        other = views[j].camera
        there = project_inverse(camera, other, pixels, w)
        inside = _inside(other, there)
        at = np.where(inside[:, None], there - 0.5, -10).astype(np.float32).reshape(*own.shape, 2)
        found = cv2.remap(inverses[j].astype(np.float32), at, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT).ravel()
        back = project_inverse(other, camera, np.where(inside[:, None], there, 0), found.astype(float))
        direction = world - other.center
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        parallax = (own_direction * direction).sum(1) < np.cos(np.radians(config.min_parallax))
        good = inside & parallax & (found > 0) & (np.linalg.norm(back - pixels, axis=1) < config.max_round_trip)
        if not good.any():
            notes.append(f"no depth agrees with {views[j].name}")
        step = 1e-3 * w
        slide = project_inverse(camera, other, pixels, w + step) - project_inverse(camera, other, pixels, w - step)
        with np.errstate(divide="ignore"):
            # dz = -dw / w^2
            moved = 2 * step / w**2 / np.linalg.norm(slide, axis=1)
        sensitivity = np.where(good & (moved < sensitivity), moved, sensitivity)
    valid = np.isfinite(sensitivity).reshape(own.shape)
    return ViewDepth(
        np.where(valid, 1 / own, 0).astype(np.float32), valid, sensitivity.astype(np.float32).reshape(own.shape), tuple(notes)
    )


def sweep_depths(views: Sequence[View], bounds: Sequence[tuple[float, float]], config: SweepConfig) -> list[ViewDepth]:
    """Depth of every view by sweeping planes against its nearest others.

    Args:
        views: The views; a single one confirms nothing.
        bounds: Nearest and farthest depth of each view [u], 0 < near < far.
        config: Planes, smoothing and checks.

    Returns:
        One depth per view at its own size; what was reduced or found nothing is in its notes.
    """
    import cv2

    small = [_reduced(v, config.max_pixels) for v in views]

    def sweep(i: int) -> np.ndarray:
        view, others = small[i], [small[j] for j in nearest_views(small, i, config.near_count)]
        planes = plane_inverses(view.camera, [o.camera for o in others], bounds[i], config.spacing, config.max_planes)
        if not others:
            return np.full(view.image.shape[:2], planes[0])
        costs = matching_costs(view, others, planes, config.window)
        return best_inverse(aggregate(costs, view.image, config.small_step, config.large_step), planes)

    # numpy and OpenCV let other threads run meanwhile
    with ThreadPoolExecutor(min(MAX_AT_ONCE, torch.get_num_threads())) as pool:
        inverses = list(pool.map(sweep, range(len(views))))
        confirmed = list(pool.map(lambda i: confirm(small, inverses, i, config), range(len(views))))
    out = []
    for i, view in enumerate(views):
        found, notes = confirmed[i], []
        depth, valid, sensitivity = found.depth, found.valid, found.sensitivity
        size = (view.camera.width, view.camera.height)
        if small[i] is not view:
            notes.append(f"swept at {small[i].camera.width} x {small[i].camera.height} px")
            scale = small[i].camera.width / size[0]
            depth, sensitivity = (cv2.resize(a, size, interpolation=cv2.INTER_NEAREST) for a in (depth, sensitivity * scale))
            valid = cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        if view.mask is not None:
            valid = valid & view.mask
        out.append(ViewDepth(np.where(valid, depth, 0), valid, np.where(valid, sensitivity, np.inf), (*notes, *found.notes)))
    return out
