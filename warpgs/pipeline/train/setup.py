"""Preparation of a fit: its initial points, priors of its views, and the views on the device."""

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from warpgs.clock import section
from warpgs.errors import UsageError
from warpgs.geometry import CENTRAL
from warpgs.kernels.cameras import check_camera
from warpgs.pipeline.metrics.scores import fitted_region
from warpgs.pipeline.model.start import Start, check_points, initial_points, seen_points, subsample
from warpgs.pipeline.train.loss import LossTerm, built_in_terms, maps_of
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.base import find_strategy
from warpgs.pipeline.train.views import TrainingView, there, with_alpha
from warpgs.priors.given_depth import any_given, lens_depth, pinhole_view, with_given_depth
from warpgs.priors.views import view_priors
from warpgs.process import Detail, Say, silent
from warpgs.scene import GivenDepth, PointCloud, Prior, View


def prepare(
    train: list[View], points: PointCloud | None, config: FitConfig, device: torch.device, priors: list[Prior] | None,
    ready: Callable[[], object], progress: Say = silent,
) -> tuple[list[View], Start, list[Prior] | None, list[str]]:  # fmt: skip
    """Return views (with depth from a network if it guides the fit), initial points, priors (if needed), and notes.

    With a memory limit the CPU sweeps, since a sweep may need more memory than a step. ``ready`` is called before the device is
    used, and in any case before this function returns.
    """
    for view in train:
        check_camera(view.camera)
    _check_models(train, config)  # before anything takes time
    check_points(train, points, config.init)
    where = device if config.memory_limit is None else torch.device("cpu")

    def usable() -> torch.device:
        with section("kernels"):  # in the thread of the warmup
            ready()
        return where

    @functools.cache
    def start() -> Start:
        progress("finding initial points")
        with section("first points"):
            return _start_of(train, points, config, np.random.default_rng(config.seed), usable, progress)

    notes = []
    if priors is None and needs_priors(config):
        regions = [fitted_region(v)[0] for v in train]
        # semantics come first: they are found while the device is made ready; depth by a network comes before the start
        with section("priors"):
            priors, notes = view_priors(train, config.priors, depths=lambda: start().depths, regions=regions, tell=progress)
    elif priors is None:
        switches = {"depth": "--depth-guides or --strategy paper", "segmentation": "--strategy paper"}
        unused = [kind for kind in switches if getattr(config.priors, f"{kind}_model") is not None]
        notes = [f"--{kind}-model is not used by this fit; to use it, add {switches[kind]}" for kind in unused]
    if config.priors.depth_guides and priors is not None:
        guides = [v.depth or GivenDepth(p.disparity, "disparity") for v, p in zip(train, priors, strict=True)]
        train = [replace(v, depth=guide) for v, guide in zip(train, guides)]
    found = start()
    usable()
    lines = f"start: {found.how}".splitlines()
    # lines on single views are indented
    return train, found, priors, [*(Detail(n.strip()) if n.startswith(" ") else n for n in lines), *notes]


def _start_of(
    train: list[View], points: PointCloud | None, config: FitConfig, generator: np.random.Generator,
    usable: Callable[[], torch.device], progress: Say,
) -> Start:  # fmt: skip
    """Return the initial points and the depths found with them; arguments are those of `prepare` and `initial_points`."""
    # searches along lines need pinhole images; given points need no search
    views = train if config.init.source == "points" else [pinhole_view(v) for v in train]
    found = initial_points(views, points, config.init, generator, usable, progress)
    if found.depths is None and any_given(views):  # a start without a search for depth
        depths, lines = with_given_depth(views, None, seen_points(views, points))
        found = found._replace(depths=depths, how="\n".join((found.how, *lines)))
    if found.depths is not None:
        found = found._replace(depths=[lens_depth(v.camera, d) for v, d in zip(train, found.depths, strict=True)])
    return subsample(found, config.max_gaussians, generator)


def _check_models(train: list[View], config: FitConfig) -> None:
    """Check that every camera has a pinhole of the same K if the settings compare views with each other."""
    others = sorted({v.camera.model for v in train} - {*CENTRAL})
    if others and (config.init.source != "points" or find_strategy(config.strategy).samples):
        fix = "fit with --preset 3dgs --init.source points, or undistort the images"
        raise UsageError(f"camera model {others[0]}: comparing views requires {' or '.join(CENTRAL)}; {fix}")


def needs_priors(config: FitConfig) -> bool:
    """Return whether the strategy, a loss term or depth guidance by a network needs the priors of the views."""
    by_strategy = find_strategy(config.strategy).needs_priors(config.strategy_config)
    return by_strategy or config.priors.depth_guides or any(t.needs_priors for t in terms_of(config))


def terms_of(config: FitConfig, **views: bool) -> tuple[LossTerm, ...]:
    """Return all loss terms of a fit by its settings, and by what the views have, as `built_in_terms` takes it."""
    return (*built_in_terms(config.loss, **views), *config.loss_terms)


def prepared_views(
    train: list[View], start: Start, priors: list[Prior] | None, config: FitConfig, terms: tuple[LossTerm, ...],
    device: torch.device,
) -> tuple[list[TrainingView], list[np.ndarray]]:  # fmt: skip
    """Return the training views on the device, with consistent depth if the strategy samples, and the maps of loss terms.

    If the strategy samples and the views have priors, also returns each view's disparity (relative inverse depth in [0, 1],
    shape [H, W]) for the images of sampling events.
    """
    samples, views = find_strategy(config.strategy).samples, []
    depths, each = start.depths or [None] * len(train), priors or [None] * len(train)
    for given, depth, prior in zip(with_alpha(train), depths, each, strict=True):
        view = TrainingView.of(given, device)
        if samples and depth is not None and depth.valid.any():
            view = replace(view, consistent=there(np.where(depth.valid, depth.depth, 0), device))
        used = depth is not None and depth.given is not None
        mapped = replace(
            view, depth=there(depth.given, device) if used else None, normals=there(given.normals, device),
            depth_weight=there(given.depth.confidence, device) if used and given.depth is not None else None,
        )  # fmt: skip
        views.append(replace(view, maps=maps_of(terms, mapped, prior)))
    return views, [p.disparity for p in priors or ()] if samples else []
