"""Depth by sweeping planes: agreement with other views at every depth, smoothed along scanlines, then cross-checked.

Poses are known, so a match is sought along the epipolar line only: one plane per inverse depth (Collins 1996), zero-mean
normalised correlation over a window, semi-global aggregation (Hirschmüller 2008), a parabola between planes, and depths kept
where another view's own sweep agrees. Compared with optical flow in docs/decisions/007-coarse-start.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import torch

from warpgs import geometry
from warpgs.geometry import matmul
from warpgs.priors import sweep_cpu, sweep_cuda
from warpgs.priors.epipolar import homogeneous, nearest_views, pixel_grid
from warpgs.priors.opencv import single_threaded_opencv, without_ipp
from warpgs.priors.sweep_planes import SweepConfig, inside_image, plane_inverses, project_inverse
from warpgs.runtime.byte_units import format_bytes
from warpgs.runtime.device_memory import installed_bytes
from warpgs.scene import View, ViewDepth

CPU = torch.device("cpu")
GPU_FRACTION = 0.25
"""Fraction of a GPU's memory that a sweep may take."""
MAX_AT_ONCE = 4
"""Views swept at a time on the CPU; each takes memory for three volumes."""


def _reduced(view: View, max_pixels: int) -> View:
    """Return the view, resized to at most ``max_pixels`` where it is larger."""
    import cv2

    c = view.camera
    shrink = min(1.0, (max_pixels / (c.width * c.height)) ** 0.5)
    if shrink == 1.0:
        return view
    width, height = max(1, int(c.width * shrink)), max(1, int(c.height * shrink))
    K = np.diag([width / c.width, height / c.height, 1]) @ c.K
    image = cv2.resize(view.image, (width, height), interpolation=cv2.INTER_AREA)
    return View(view.name, replace(c, K=K, width=width, height=height), image)


def consistent_depth(views: Sequence[View], inverses: Sequence[np.ndarray], index: int, config: SweepConfig) -> ViewDepth:
    """Return the depth of one view where it is geometrically consistent with that of at least one other view.

    A point is projected to each other view and back by the depth found there. It must return nearer than ``max_round_trip``
    to its pixel, with both rays at least ``min_parallax`` apart. The sensitivity is the smallest of the consistent views.

    Args:
        views: All views.
        inverses: Inverse depths of each [1/u], shape [H, W].
        index: Index of the view.
        config: Checks.
    """
    import cv2

    view, own = views[index], inverses[index]
    camera, pixels, w = view.camera, pixel_grid(view.camera), own.ravel()
    sensitivity = np.full(len(pixels), np.inf)
    rays = matmul(homogeneous(pixels), geometry.inverse(camera.K).T)
    world = matmul(rays / w[:, None] - camera.viewmat[:3, 3], camera.viewmat[:3, :3])
    notes, own_direction = [], world - camera.center
    own_direction /= np.linalg.norm(own_direction, axis=1, keepdims=True)
    for j in nearest_views(views, index, config.near_count):
        other = views[j].camera
        there = project_inverse(camera, other, pixels, w)
        inside = inside_image(other, there)
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


def _inverses(views: Sequence[View], bounds: Sequence[tuple[float, float]], config: SweepConfig, device: torch.device, pool):
    """Return the inverse depths [1/u], shape [H, W], of every view, and messages on how they were found."""
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
        if needed > GPU_FRACTION * installed_bytes(device):
            notes.append(f"swept on the CPU: a GPU should have {format_bytes(needed / GPU_FRACTION)} of memory for it")
        elif smallest > config.window // 2:  # torch mirrors no border wider than the image
            found |= {i: sweep_cuda.inverse_depths(views[i], others[i], planes[i], config, device) for i in left}
            left = []
    for first in range(0, len(left), MAX_AT_ONCE):
        some = left[first : first + MAX_AT_ONCE]
        found |= zip(some, sweep_cpu.inverse_depths(views, others, {i: planes[i] for i in some}, config, pool))
    return [found[i] for i in range(len(views))], notes


def sweep_depths(
    views: Sequence[View], bounds: Sequence[tuple[float, float]], config: SweepConfig, device: torch.device = CPU
) -> list[ViewDepth]:
    """Return the depth of every view by sweeping planes against its nearest others.

    Args:
        views: The views; a single one has no consistent depth.
        bounds: Nearest and farthest depth of each view [u], 0 < near < far.
        config: Planes, smoothing and checks.
        device: Device of costs and paths; the CPU computes them where a GPU has too little memory, or images are tiny.

    Returns:
        One depth per view at its own size; its notes name a reduced size and views without a consistent depth.
    """
    import cv2

    small = [_reduced(v, config.max_pixels) for v in views]
    with single_threaded_opencv(), ThreadPoolExecutor(torch.get_num_threads(), initializer=without_ipp) as pool:
        inverses, messages = _inverses(small, bounds, config, device, pool)
        consistent = list(pool.map(lambda i: consistent_depth(small, inverses, i, config), range(len(views))))
    out = []
    for i, view in enumerate(views):
        found, notes = consistent[i], list(messages if i == 0 else ())
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
