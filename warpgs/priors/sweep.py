"""Plane-sweep depth: agreement with other views at every depth, smoothed along scanlines, then cross-checked.

Poses are known, so a match is sought only along the epipolar line, with one plane per inverse depth (Collins 1996). The method
is zero-mean normalised correlation over a window, semi-global aggregation (Hirschmüller 2008) and a parabola between planes.
Depths are kept where the sweep of another view agrees. docs/decisions/007-coarse-start.md compares sweeps with optical flow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from warpgs.kernels.plane_depths import check_round_trip
from warpgs.priors import sweep_cpu, sweep_cuda
from warpgs.priors.opencv import single_threaded_opencv
from warpgs.priors.sweep_planes import SweepConfig, plane_inverses
from warpgs.priors.view_choice import matching_views, shared_sight, spread_views
from warpgs.runtime.byte_units import format_bytes
from warpgs.runtime.device_memory import installed_bytes
from warpgs.scene import View, ViewDepth

CPU = torch.device("cpu")
GPU_FRACTION = 0.25
"""Fraction of a GPU's memory that a sweep may take."""


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


def consistent_depth(
    views: Mapping[int, View], inverses: Mapping[int, np.ndarray], index: int, others: Sequence[int], config: SweepConfig
) -> ViewDepth:
    """Return the depth of one view where it is geometrically consistent with the depth of at least one other view.

    A point is projected to each other view and back by the depth found there. It must return to within ``max_round_trip``
    of its pixel, with both rays at least ``min_parallax`` apart. The sensitivity is the smallest among the consistent views.

    Args:
        views: Views by index.
        inverses: Inverse depths of each view [1/u], float64, shape [H, W].
        index: Index of the view.
        others: Indices of the views to check it with.
        config: Checks.
    """
    own, notes = inverses[index], []
    sensitivity = np.full(own.shape, np.inf)
    for j in others:
        agrees = check_round_trip(
            views[index].camera, views[j].camera, own, inverses[j], sensitivity, most=config.max_round_trip,
            min_parallax=config.min_parallax,
        )  # fmt: skip
        if not agrees.any():
            notes.append(f"no depth agrees with {views[j].name}")
    valid = np.isfinite(sensitivity)
    return ViewDepth(np.where(valid, 1 / own, 0).astype(np.float32), valid, sensitivity.astype(np.float32), tuple(notes))


def _backend(
    views: Mapping[int, View], planes: Mapping[int, np.ndarray], config: SweepConfig, device: torch.device
) -> tuple[Callable[[View, Sequence[View], np.ndarray], np.ndarray], list[str]]:
    """Return the function that sweeps a view on the device, or on the CPU if the device cannot, and messages on this."""
    notes: list[str] = []
    if device.type == "cuda":
        needed = max(sweep_cuda.needed_bytes(views[i], len(p)) for i, p in planes.items())
        smallest = min(min(v.image.shape[:2]) for v in views.values())
        # not by the free memory: a resumed fit must find the same depths again
        if needed > GPU_FRACTION * installed_bytes(device):
            notes.append(f"depth is swept on the CPU, since a GPU needs {format_bytes(needed / GPU_FRACTION)} of memory")
        elif smallest > config.window // 2:  # torch mirrors no border wider than the image
            return lambda view, others, p: sweep_cuda.inverse_depths(view, others, p, config, device), notes
    return lambda view, others, p: sweep_cpu.inverse_depths(view, others, p, config), notes


def _at_size(found: ViewDepth, small: View, view: View, notes: Sequence[str]) -> ViewDepth:
    """Return depth found in a smaller image, resized to the view's own size and without masked pixels."""
    import cv2

    depth, valid, sensitivity = found.depth, found.valid, found.sensitivity
    if small is not view:
        size, scale = (view.camera.width, view.camera.height), small.camera.width / view.camera.width
        notes = [*notes, f"swept at {small.camera.width} x {small.camera.height} px"]
        depth, sensitivity = (cv2.resize(a, size, interpolation=cv2.INTER_NEAREST) for a in (depth, sensitivity * scale))
        valid = cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    if view.mask is not None:
        valid = valid & view.mask
    return ViewDepth(np.where(valid, depth, 0), valid, np.where(valid, sensitivity, np.inf), (*notes, *found.notes))


def _unswept(view: View, note: str) -> ViewDepth:
    shape = view.image.shape[:2]
    return ViewDepth(np.zeros(shape, np.float32), np.zeros(shape, bool), np.full(shape, np.inf, np.float32), (note,), False)


def sweep_depths(
    views: Sequence[View], bounds: Sequence[tuple[float, float]], config: SweepConfig, device: torch.device = CPU,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> list[ViewDepth]:  # fmt: skip
    """Return the depth of every view by sweeping planes against views that see the same surfaces.

    At most ``config.max_views`` views are swept, so that the time is bounded. Swept views are compared with their nearest
    neighbours among all views, and checked by round trips to one another.

    Args:
        views: The views; a single one has no consistent depth.
        bounds: Nearest and farthest depth of each view [u], 0 < near < far.
        config: Planes, smoothing and checks.
        device: Device of costs and paths; the CPU is used if a GPU has too little memory, or images are tiny.
        progress: Called after each view with the number of views swept so far, and their total.

    Returns:
        One depth per view at its own size; its notes report a reduced size and views without a consistent depth. A view that
        was not swept has a note, and no valid depth.
    """
    cameras = [v.camera for v in views]
    sight = shared_sight(cameras, bounds)
    swept = spread_views(sight, config.max_views)
    others = {i: matching_views(sight, cameras, i, config.near_count, range(len(views))) for i in swept}
    with single_threaded_opencv():
        small = {i: _reduced(views[i], config.max_pixels) for i in sorted({*swept, *(j for o in others.values() for j in o)})}
        planes = {
            i: plane_inverses(
                small[i].camera, [small[j].camera for j in others[i]], bounds[i], config.spacing, config.max_planes
            )
            for i in swept
        }
        find, messages = _backend(small, planes, config, device)
        inverses = {}
        for done, i in enumerate(swept, 1):
            if others[i]:
                inverses[i] = find(small[i], [small[j] for j in others[i]], planes[i])
            else:
                inverses[i] = np.full(small[i].image.shape[:2], planes[i][0])
            progress(done, len(swept))
        out = [_unswept(v, f"not swept: the {len(swept)} swept views (of {len(views)}) see most of the scene") for v in views]
        for i in swept:
            partners = matching_views(sight, cameras, i, config.near_count, swept)
            found = consistent_depth(small, inverses, i, partners, config)
            out[i] = _at_size(found, small[i], views[i], messages if i == swept[0] else ())
    return out
