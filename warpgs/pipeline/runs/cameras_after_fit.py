"""Poses of a run after refinement: those of its training views, the rule for its held-out views, and what is told of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from warpgs.errors import DataError
from warpgs.geometry import matmul, nearest_rotation
from warpgs.io.splits import Split
from warpgs.pipeline.train.refine_poses import ROTATION, TRANSLATION, increments
from warpgs.scene import Camera, Scene

RULE = (
    "held-out views are moved by the one similarity that takes the given training cameras to the refined ones best; their "
    "own images are not looked at"
)
"""Rule for the poses of held-out views, for people."""


def _motions(tensors: Mapping[str, torch.Tensor], views: int) -> np.ndarray:
    """Return the motion of each training camera in float64, shape [V, 4, 4]; DataError where they are not whole."""
    found = [tensors.get(name) for name in (ROTATION, TRANSLATION)]
    if any(t is None or t.shape != (views, 3) or not t.isfinite().all() for t in found):
        raise DataError(f"the refined poses are not whole: {ROTATION} and {TRANSLATION} must be [{views}, 3]; restore them")
    return increments(*(t.detach().cpu().double() for t in found if t is not None)).numpy()


def _similarity(given: Sequence[Camera], refined: Sequence[Camera]) -> tuple[np.ndarray, float, np.ndarray]:
    """Return rotation [3, 3], scale and translation [3] from the world of given cameras to that of refined ones.

    The rotation is the mean of the cameras' own; scale and translation are least squares over their centres. Where all centres
    are one, the scale is 1.
    """
    turned = sum(matmul(r.viewmat[:3, :3].T, g.viewmat[:3, :3]) for g, r in zip(given, refined))
    R = nearest_rotation(np.asarray(turned) / len(given))
    a, b = (np.array([c.center for c in cameras]) for cameras in (given, refined))
    from_mean, to_mean = matmul(a - a.mean(0), R.T), b - b.mean(0)
    size = (from_mean**2).sum()
    scale = float((from_mean * to_mean).sum() / size) if size > 0 else 1.0
    return R, scale, b.mean(0) - scale * matmul(R, a.mean(0))


def similar_cameras(
    cameras: Mapping[str, Camera], given: Sequence[Camera], refined: Sequence[Camera], names: Sequence[str]
) -> dict[str, Camera]:
    """Return the named cameras after the similarity that takes given cameras to refined ones best, by name.

    Args:
        cameras: Cameras by name, in the world of the given ones.
        given: Cameras before.
        refined: The same cameras after, in the same order.
        names: Names of the cameras to return.
    """
    R, scale, t = _similarity(given, refined)
    found = {}
    for name in names:
        turned, center = matmul(cameras[name].viewmat[:3, :3], R.T), scale * matmul(R, cameras[name].center) + t
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = turned, -matmul(turned, center)
        found[name] = replace(cameras[name], viewmat=viewmat)
    return found


def refined_cameras(
    cameras: Mapping[str, Camera], train: Sequence[str], test: Sequence[str], tensors: Mapping[str, torch.Tensor]
) -> dict[str, Camera]:
    """Return the cameras of a run after refinement, by view: training ones by their own increments, held-out ones by `RULE`.

    Args:
        cameras: Cameras as given, in scene units.
        train: Names of the training views, in the order of the fit.
        test: Names of the held-out views.
        tensors: Parameters of the training views, by name, shape [V, 3] each.

    Raises:
        DataError: The tensors are not those of as many views.
    """
    motions, found = _motions(tensors, len(train)), dict(cameras)
    for name, motion in zip(train, motions):
        found[name] = replace(cameras[name], viewmat=matmul(motion, cameras[name].viewmat))
    found |= similar_cameras(cameras, [cameras[n] for n in train], [found[n] for n in train], test)
    return found


def with_cameras(scene: Scene, cameras: Mapping[str, Camera]) -> Scene:
    """Return a scene whose views have the poses of cameras by name."""
    views = tuple(replace(v, camera=replace(v.camera, viewmat=cameras.get(v.name, v.camera).viewmat)) for v in scene.views)
    return replace(scene, views=views)


def pose_figures(
    given: Mapping[str, Camera], refined: Mapping[str, Camera], train: Sequence[str], test: Sequence[str], scale: float
) -> dict[str, Any]:
    """Return what refinement changed, as metrics.json holds it.

    Args:
        given: Cameras before, in scene units.
        refined: Cameras after.
        train: Names of the training views.
        test: Names of the held-out views.
        scale: Scene units per unit of the scene's files.

    Returns:
        ``views``, the turn [degrees] and the shift of the centre [units of the files] of each training view, and ``summary``.
    """
    rows = []
    for name in train:
        turn = matmul(refined[name].viewmat[:3, :3], given[name].viewmat[:3, :3].T)
        # by the sine of half the angle, since its cosine has no digits left at small angles
        sine = min(1.0, float(np.linalg.norm(turn - np.eye(3))) / np.sqrt(8))
        shift = float(np.linalg.norm(refined[name].center - given[name].center)) / scale
        rows.append({"name": name, "degrees": float(np.degrees(2 * np.arcsin(sine))), "units": shift})
    degrees, units = ([r[key] for r in rows] for key in ("degrees", "units"))
    summary = (
        f"poses refined: {len(train)} training cameras turned by {np.median(degrees):.3f} degrees in the median, "
        f"{max(degrees):.3f} at most, and moved by {np.median(units):.4g} and {max(units):.4g} units; the first one is fixed"
    )
    return {"views": rows, "summary": f"{summary}; {RULE}" if test else summary}


def refined_scene(scene: Scene, split: Split, tensors: Mapping[str, torch.Tensor]) -> tuple[Scene, dict[str, Any]]:
    """Return the scene after refinement, and what that changed, as `pose_figures` has it; ``tensors`` [V, 3] by name."""
    given = {v.name: v.camera for v in scene.views}
    refined = refined_cameras(given, split.train, split.test, tensors)
    return with_cameras(scene, refined), pose_figures(given, refined, split.train, split.test, scene.normalization.scale)
