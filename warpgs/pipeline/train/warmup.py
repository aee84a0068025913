"""A tiny fit beside the preparations of the real one: what a CUDA device loads at first use is there when it is asked for.

Contexts, kernels, libraries and modules of Python are loaded one by one as they are first used, which took two to three seconds
of a fit on an H200. Semantics and matches are found on the CPU meanwhile.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import torch

from warpgs.pipeline.metrics.evaluate import render_view, score
from warpgs.pipeline.model.init import sweeps
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.strategies.base import find_strategy
from warpgs.pipeline.train.trainer import Trainer, run
from warpgs.priors.sweep import SweepConfig, sweep_depths
from warpgs.render.rasterize import RasterizeOptions
from warpgs.scene import Camera, PointCloud, Prior, View

STEPS = 3
"""With phases, one step for each."""
SIDE, POINTS, PLANES = 48, 200, 8
"""Sides of the views [px]; number of points, and of planes."""


def _views(generator: np.random.Generator) -> list[View]:
    K = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
    cameras = []
    for x in (-0.2, 0.2):
        viewmat = np.eye(4)
        viewmat[0, 3] = x
        cameras.append(Camera(viewmat, K, SIDE, SIDE))
    return [View(f"{i}", c, generator.random((SIDE, SIDE, 3), np.float32)) for i, c in enumerate(cameras)]


def warm_up(config: FitConfig, device: torch.device, stopped: Callable[[], bool] = lambda: False) -> Trainer:
    """Fit noise in two small views with the same settings, refinement and sampling included, and score one.

    Args:
        config: Settings of the real fit. Where that sweeps on the device, these views are swept, too.
        device: Where to work.
        stopped: Asked after each step whether nobody waits any more.

    Returns:
        The fit, done.

    Raises:
        KeyboardInterrupt: ``stopped`` said so.
    """
    generator = np.random.default_rng(0)
    views = _views(generator)
    points = generator.uniform([-1, -1, 2], [1, 1, 4], (POINTS, 3))
    cloud = PointCloud(points, generator.random((POINTS, 3), np.float32))
    maps = [generator.random((SIDE, SIDE), np.float32) for _ in range(4)]
    small = replace(
        config, steps=STEPS, memory_limit=None, init=replace(config.init, source="points"),
        density=replace(config.density, every=1),
        strategy_config=find_strategy(config.strategy).warmup_config(config.strategy_config),
    )  # fmt: skip
    black = (0.0, 0.0, 0.0)
    if sweeps(config.init, len(views)) and config.memory_limit is None:
        sweep_depths(views, [(2, 4)] * len(views), SweepConfig(max_planes=PLANES), device)
    fit = Trainer(views, cloud, small, device, black, [Prior(*maps, "noise", "noise") for _ in views])
    run(fit, lambda _: None, lambda _: None, stopped)
    score(views[0], render_view(fit.gaussians, views[0], RasterizeOptions(rule=small.rule, background=fit.background))[0])
    if fit.graphs is not None:
        fit.graphs.clear()  # graphs and trainer refer to each other, which would keep their memory
    return fit


@contextlib.contextmanager
def rehearsal(config: FitConfig, device: torch.device) -> Iterator[Callable[[], object]]:
    """Rehearse in a thread within the block, where the device is a GPU that networks for priors leave alone.

    Gives what waits for the end and raises what went wrong; until then nothing else may use the device, since steps may be
    being recorded. However the block ends, the thread has ended by then.
    """
    if device.type != "cuda" or config.priors.onnx_provider == "cuda":
        yield lambda: None
        return
    stop = threading.Event()

    def on_device() -> None:
        with torch.cuda.device(device):
            warm_up(config, device, stop.is_set)

    with ThreadPoolExecutor(1, thread_name_prefix="rehearsal") as thread:
        done = thread.submit(on_device)
        try:
            yield done.result
        finally:
            stop.set()
