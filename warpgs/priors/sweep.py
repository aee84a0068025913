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

from warpgs import geometry
from warpgs.errors import UsageError
from warpgs.geometry import matmul
from warpgs.kernels.tiles import installed_bytes
from warpgs.priors.epipolar import nearest_views, pixel_grid
from warpgs.priors.opencv import alone, own_code
from warpgs.scene import Camera, View, ViewDepth
from warpgs.sizes import format_bytes

CPU = torch.device("cpu")
NOISE = (2 / 255) ** 2
"""Variance of a window below which its pattern is noise: correlation fades to 0 there."""
EDGE = 0.06
"""Step of the picture at which the penalty for a jump in depth falls to 1/e."""
NO_OPINION = 0.5
"""Cost of correlation 0: where a plane leaves the other image, or nothing has texture."""
UNIT = 4096
"""Cost 1 in the 16-bit whole numbers that volumes hold: to touch memory for the first time takes as long as to compute what
goes there, and this is half of float32's."""
LARGEST_STEP = 0.99
"""P2 up to which the sum of four paths, each at most 1 + P2, stays below 2^15."""
PLANES_AT_ONCE = 16
"""Planes whose costs one thread writes together, 32 bytes of each pixel."""
GPU_SHARE = 0.25
"""Part of a GPU's memory that a sweep may take."""
MAX_AT_ONCE = 4
"""Views swept at a time; each takes memory for three volumes."""


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
    """Planes at most, at least 8; memory is 6 bytes per pixel and plane, for up to four views."""
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
        if not max(self.large_step, 1.5 * self.small_step) <= LARGEST_STEP:
            raise UsageError(f"sweep large-step and 1.5 small-step must be at most {LARGEST_STEP}, where the largest cost is 1")


def project_inverse(first: Camera, second: Camera, pixels: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Positions in the second image [px], shape [N, 2], of pixels [N, 2] at inverse depths [N] [1/u]; NaN behind the camera."""
    rotation, translation = geometry.relative_pose(first, second)
    rays = matmul(np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1), geometry.inverse(first.K).T)
    p = matmul(matmul(rays, rotation.T) + inverse[:, None] * translation, second.K.T)
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
    rotation, translation = geometry.relative_pose(first, second)
    moved = rotation + inverse * np.outer(translation, [0, 0, 1])
    H = matmul(matmul(second.K, moved), geometry.inverse(first.K))
    back, shift = (np.array([[1, 0, s], [0, 1, s], [0, 0, 1]]) for s in (-0.5, 0.5))
    return matmul(matmul(back, H), shift)


def gray_of(view: View) -> np.ndarray:
    """Brightness of its pixels in [0, 1], float32, shape [H, W]."""
    import cv2

    return cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)


def matching_costs(view: View, others: Sequence[View], inverses: np.ndarray, window: int) -> np.ndarray:
    """Disagreement of views at D inverse depths, in [0, 1], float32, shape [D, H, W].

    Of the costs 0.5 (1 - correlation) of the other views half the mean and half the least: a view that does not see the
    point counts, but cannot outvote one that does.
    """
    import cv2

    size, box = (view.camera.width, view.camera.height), (window, window)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    own, *grays = [gray_of(v) for v in (view, *others)]
    mean = cv2.blur(own, box)
    variance = np.maximum(cv2.blur(own * own, box) - mean * mean, 0) + NOISE
    planes = np.empty((len(inverses), *own.shape), np.float32)
    # every step writes into one of these: to make arrays anew takes as long as to fill them
    warped, product, m, v, cost, least = (np.empty_like(own) for _ in range(6))
    outside = np.empty(own.shape, bool)
    for inverse, total in zip(inverses, planes):
        total.fill(0)
        least.fill(np.inf)
        for other, gray in zip(others, grays):
            H = plane_homography(view.camera, other.camera, inverse)
            cv2.warpPerspective(gray, H, size, warped, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=-1)
            cv2.blur(warped, box, m)
            cv2.blur(np.multiply(warped, warped, out=product), box, v)
            v -= np.multiply(m, m, out=product)
            np.maximum(v, 0, out=v)
            v += NOISE
            v *= variance
            np.sqrt(v, out=v)
            cv2.blur(np.multiply(own, warped, out=product), box, cost)
            cost -= np.multiply(mean, m, out=product)
            cost /= v
            cost *= -0.5
            cost += 0.5
            np.logical_not(np.greater_equal(warped, 0, out=outside), out=outside)
            np.copyto(cost, NO_OPINION, where=outside)
            total += cost
            np.minimum(least, cost, out=least)
        total *= 0.5 / len(others)
        least *= 0.5
        total += least
    return planes


def step_limits(colors: np.ndarray, small_step: float, large_step: float) -> np.ndarray:
    """P2 of the steps along the first axis of a picture [L, B, 3], in units of 1 / `UNIT`, int16, shape [L - 1, B]."""
    jumps = np.abs(np.diff(colors, axis=0)).max(2).astype(float)  # float32's exp has other last digits on other processors
    return np.rint(np.maximum(large_step * np.exp(-jumps / EDGE), 1.5 * small_step) * UNIT).astype(np.int16)


def path_costs(costs: np.ndarray, image: np.ndarray, small_step: float, large_step: float, *, down: bool) -> np.ndarray:
    """Sum of the semi-global path costs from above and below, or from left and right.

    Args:
        costs: Matching costs in units of 1 / `UNIT`, int16, shape [H, W, D].
        image: Colours in [0, 1] whose edges allow jumps, shape [H, W, 3].
        small_step: Penalty for a change of one plane.
        large_step: Penalty for any other change, times exp(-step of the picture / EDGE).
        down: Whether paths run along columns; else along rows.

    Returns:
        Sums in units of 1 / `UNIT`, int16, shape [H, W, D].
    """
    total = np.zeros_like(costs)
    c, t, colors = (a if down else a.swapaxes(0, 1) for a in (costs, total, image))
    limits, small = step_limits(colors, small_step, large_step), np.int16(round(small_step * UNIT))
    for order, edge in ((range(len(c)), -1), (range(len(c) - 1, -1, -1), 0)):
        path = None
        for k in order:
            if path is None:
                path = c[k].copy()
            else:
                lowest = path.min(1, keepdims=True)
                step = np.minimum(path, lowest + limits[k + edge, :, None])
                path += small
                np.minimum(step[:, 1:], path[:, :-1], out=step[:, 1:])
                np.minimum(step[:, :-1], path[:, 1:], out=step[:, :-1])
                step -= lowest
                step += c[k]
                path = step
            t[k] += path
    return total


def best_inverse(costs: np.ndarray, inverses: np.ndarray) -> np.ndarray:
    """Inverse depth [H, W] of least cost [H, W, D], in any unit, between planes by the parabola through three costs."""
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
    rays = matmul(np.concatenate([pixels, np.ones((len(pixels), 1))], 1), geometry.inverse(camera.K).T)
    world = matmul(rays / w[:, None] - camera.viewmat[:3, 3], camera.viewmat[:3, :3])
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


def _swept(views: Sequence[View], others: dict[int, list[View]], planes: dict[int, np.ndarray], config: SweepConfig, pool):
    """Inverse depths [H, W] of the views that there are planes for; threads share the planes of all, and then the paths."""
    costs = {i: np.empty((*views[i].image.shape[:2], len(p)), np.int16) for i, p in planes.items()}

    def match(part: tuple[int, int]) -> None:
        i, first = part
        chosen = slice(first, first + PLANES_AT_ONCE)
        found = matching_costs(views[i], others[i], planes[i][chosen], config.window)
        np.rint(np.clip(found, 0, 1, out=found) * np.float32(UNIT), out=found)  # rounding may leave a cost below 0
        costs[i][..., chosen] = found.transpose(1, 2, 0)

    def paths(way: tuple[int, bool]) -> np.ndarray:
        i, down = way
        return path_costs(costs[i], views[i].image, config.small_step, config.large_step, down=down)

    def best(i: int) -> np.ndarray:
        total = summed[i, True]
        total += summed[i, False]
        return best_inverse(total, planes[i])

    ways = [(i, down) for i in planes for down in (True, False)]
    # numpy and OpenCV let other threads run meanwhile
    list(pool.map(match, [(i, first) for i in planes for first in range(0, len(planes[i]), PLANES_AT_ONCE)]))
    summed = dict(zip(ways, pool.map(paths, ways)))
    return list(pool.map(best, planes))


def _inverses(views: Sequence[View], bounds: Sequence[tuple[float, float]], config: SweepConfig, device: torch.device, pool):
    """Inverse depths [H, W] of every view, and what a user must know of how they were found."""
    from warpgs.priors import sweep_cuda

    others = {i: [views[j] for j in nearest_views(views, i, config.near_count)] for i in range(len(views))}
    planes = {
        i: plane_inverses(views[i].camera, [o.camera for o in found], bounds[i], config.spacing, config.max_planes)
        for i, found in others.items()
    }
    found = {i: np.full(views[i].image.shape[:2], planes[i][0]) for i in planes if not others[i]}
    left, notes = [i for i in planes if others[i]], []
    if device.type == "cuda" and left:
        needed = max(sweep_cuda.needed_bytes(views[i], len(planes[i])) for i in left)
        smallest = min(min(v.image.shape[:2]) for v in views)
        # not by what is free now: a fit that is continued must find the same depths again
        if needed > GPU_SHARE * installed_bytes(device):
            notes.append(f"swept on the CPU: a GPU should have {format_bytes(needed / GPU_SHARE)} of memory for it")
        elif smallest > config.window // 2:  # torch mirrors no border wider than the picture
            found |= {i: sweep_cuda.inverse_depths(views[i], others[i], planes[i], config, device) for i in left}
            left = []
    for first in range(0, len(left), MAX_AT_ONCE):
        some = left[first : first + MAX_AT_ONCE]
        found |= zip(some, _swept(views, others, {i: planes[i] for i in some}, config, pool))
    return [found[i] for i in range(len(views))], notes


def sweep_depths(
    views: Sequence[View], bounds: Sequence[tuple[float, float]], config: SweepConfig, device: torch.device = CPU
) -> list[ViewDepth]:
    """Depth of every view by sweeping planes against its nearest others.

    Args:
        views: The views; a single one confirms nothing.
        bounds: Nearest and farthest depth of each view [u], 0 < near < far.
        config: Planes, smoothing and checks.
        device: Where to compute costs and paths; the CPU does it where a GPU has too little memory, or pictures are tiny.

    Returns:
        One depth per view at its own size; what was reduced or found nothing is in its notes.
    """
    import cv2

    small = [_reduced(v, config.max_pixels) for v in views]
    with alone(), ThreadPoolExecutor(torch.get_num_threads(), initializer=own_code) as pool:
        inverses, said = _inverses(small, bounds, config, device, pool)
        confirmed = list(pool.map(lambda i: confirm(small, inverses, i, config), range(len(views))))
    out = []
    for i, view in enumerate(views):
        found, notes = confirmed[i], list(said if i == 0 else ())
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
