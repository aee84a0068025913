"""What a fit is prepared with: its first points, and what is believed of its views."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from warpgs.pipeline.metrics.region import counted_region
from warpgs.pipeline.model.init import Start, check_points, initial_points, subsample
from warpgs.pipeline.train.config import FitConfig
from warpgs.priors.cache import cache_folder
from warpgs.priors.view_prior import view_priors
from warpgs.scene import PointCloud, Prior, View


@dataclass(frozen=True)
class Preparation:
    """Found before the first step."""

    start: Start
    """The first points, and the depths that views confirm."""
    priors: list[Prior] | None
    """One a view; None where nothing asks for them."""
    notes: list[str]
    """What was chosen, assumed and missing."""


def prepare(
    train: list[View], points: PointCloud | None, config: FitConfig, generator: np.random.Generator, device: torch.device,
    priors: list[Prior] | None, ready: Callable[[], object],
) -> Preparation:  # fmt: skip
    """Find the first points, and priors where they are not given and sampling or the depth term asks for them.

    Args:
        train: The views to fit.
        points: The reconstruction's points, or None.
        config: Settings.
        generator: For random points.
        device: Where to sweep, unless there is a memory limit: depths take more than a step may.
        priors: What is believed of each view, where that is known.
        ready: Called before the device is used, and in any case before the end.

    Raises:
        DataError: There is nothing to start from.
    """
    check_points(train, points, config.init)  # before anything takes time
    where = device if config.memory_limit is None else torch.device("cpu")

    def usable() -> torch.device:
        ready()
        return where

    @functools.cache
    def start() -> Start:
        found = initial_points(train, points, config.init, generator, usable)
        return subsample(found, config.density.max_gaussians, generator)

    notes = []
    if priors is None and (config.method.events or config.loss.depth_weight > 0):
        regions, cache = [counted_region(v)[0] for v in train], cache_folder()
        # semantics come first: they are found while the device is made ready
        priors, notes = view_priors(train, config.priors, depths=lambda: start().depths, regions=regions, cache=cache)
    found = start()
    ready()
    return Preparation(found, priors, [*(line.strip() for line in f"start: {found.how}".splitlines()), *notes])
