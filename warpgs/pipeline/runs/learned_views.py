"""Cameras of a run's views as its view modules changed them, and values of the modules for the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from warpgs.io.splits import Split
from warpgs.pipeline.train.learned_views import LearnedViews
from warpgs.pipeline.train.view_modules.base import FittedViews
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Camera, Gaussians, Scene, View


def cameras_of(scene: Scene) -> dict[str, Camera]:
    """Return the cameras of the views of a scene by name."""
    return {v.name: v.camera for v in scene.views}


def learned_cameras(scene: Scene, split: Split, learned: LearnedViews) -> Mapping[str, Camera]:
    """Return the cameras of all views of a scene after the view modules, by name."""
    return learned.cameras(cameras_of(scene), split.train, split.test)


def with_cameras(scene: Scene, cameras: Mapping[str, Camera]) -> Scene:
    """Return a scene in which the views named in a mapping have the mapping's cameras; other views are unchanged."""
    return replace(scene, views=tuple(replace(v, camera=cameras.get(v.name, v.camera)) for v in scene.views))


def learned_figures(
    learned: LearnedViews, scene: Scene, split: Split, given: Mapping[str, Camera], test: Sequence[View],
    gaussians: Gaussians, options: RasterizeOptions,
) -> dict[str, dict[str, Any]]:  # fmt: skip
    """Return the figures of each view module by its name, for metrics.json.

    Args:
        learned: View modules with their parameters.
        scene: The scene, with its cameras after the fit.
        split: Its views to fit and those held out.
        given: Cameras before the fit.
        test: Held-out views.
        gaussians: The fitted model.
        options: Options of the rasterizer.
    """
    cameras, scale = cameras_of(scene), scene.normalization.scale
    return {
        m.name: m.figures(FittedViews(learned.params_of(m), split.train, test, given, cameras, scale, gaussians, options))
        for m in learned.modules
    }
