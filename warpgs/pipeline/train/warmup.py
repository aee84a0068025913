"""Warmup: a tiny fit during the preparation of the real fit, to load everything that the real fit uses on a CUDA device.

Contexts, kernels, libraries and modules of Python are loaded at their first use, which took two to three seconds of a fit on an
H200. Semantics and matches are found on the CPU at the same time.
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
from warpgs.pipeline.train.loop import run
from warpgs.pipeline.train.strategies.base import find_strategy
from warpgs.pipeline.train.trainer import Trainer
from warpgs.priors.sweep import SweepConfig, sweep_depths
from warpgs.scene import Camera, PointCloud, Prior, View

STEPS = 3
"""Number of steps of the tiny fit, one for each phase."""
SIDE, POINTS, PLANES = 48, 200, 8
"""Side of the tiny fit's views [px], number of its points, and number of its sweep planes."""


def _views(generator: np.random.Generator) -> list[View]:
    K = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
    cameras = []
    for x in (-0.2, 0.2):
        viewmat = np.eye(4)
        viewmat[0, 3] = x
        cameras.append(Camera(viewmat, K, SIDE, SIDE))
    return [View(f"{i}", c, generator.random((SIDE, SIDE, 3), np.float32)) for i, c in enumerate(cameras)]


def warm_up(config: FitConfig, device: torch.device, stopped: Callable[[], bool] = lambda: False) -> Trainer:
    """Fit noise in two small views with the settings of the real fit, including refinement and sampling; score one view.

    Args:
        config: Settings of the real fit. If that fit sweeps on the device, these views are swept, too.
        device: Device to work on.
        stopped: Returns, after each step, whether to stop.

    Returns:
        The trainer, after its last step.

    Raises:
        KeyboardInterrupt: ``stopped`` returned True.
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
    if hasattr(small.strategy_config, "every"):  # a strategy with events of its own, such as mcmc: it has some, too
        small = replace(small, strategy_config=replace(small.strategy_config, every=1))
    black = (0.0, 0.0, 0.0)
    if sweeps(config.init, len(views)) and config.memory_limit is None:
        sweep_depths(views, [(2, 4)] * len(views), SweepConfig(max_planes=PLANES), device)
    fit = Trainer(views, cloud, small, device, black, [Prior(*maps, "noise", "noise") for _ in views])
    run(fit, lambda _: None, lambda _: None, stopped)
    score(views[0], render_view(fit.gaussians, views[0], fit.context.render_options())[0])
    fit.taker.clear()  # their memory is for the fit that follows
    return fit


@contextlib.contextmanager
def background_warmup(config: FitConfig, device: torch.device) -> Iterator[Callable[[], object]]:
    """Run `warm_up` in a thread within the block, if the device is a GPU that networks for priors do not use.

    Yields a function that waits for the end of the warmup and raises its errors. Until the function returns, nothing else may
    use the device, since steps may be captured at that time. The thread ends before the block does, also after an error.
    """
    if device.type != "cuda" or config.priors.onnx_provider == "cuda":
        yield lambda: None
        return
    stop = threading.Event()

    def on_device() -> None:
        with torch.cuda.device(device):
            warm_up(config, device, stop.is_set)

    with ThreadPoolExecutor(1, thread_name_prefix="warmup") as thread:
        done = thread.submit(on_device)
        try:
            yield done.result
        finally:
            stop.set()
