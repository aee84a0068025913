"""Number of steps for a fit of a given time, predicted from the measured speed of this machine."""

from __future__ import annotations

import dataclasses
import statistics
import time

import torch

from warpgs.errors import UsageError
from warpgs.pipeline.train.by_views import steps_by_views
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.loss_terms.built_in import LossConfig
from warpgs.pipeline.train.loss_terms.photometric import photometric_loss
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians, View

PIXELS_PER_GAUSSIAN = 4
"""Ratio of pixels to Gaussians in the probe's render, about the mean over a fit of preset `quick`."""
REPEATS = 5
"""Timed renders of a probe, after a first render that compiles and loads kernels."""
STEP, SETUP = 1.6, 11.0
"""Mean time of a step of a fit, and set-up time for each training view, in units of a probe's time (`probe_seconds`). Measured
on a CPU on fern with preset `quick`: 1.54 and 11.2 at 126 x 94 px, 1.56 and 10.8 at 168 x 126 px. On CUDA, where
steps are captured but probes are not, a step takes less, so the prediction is an upper limit."""
MIN_STEPS = 100
"""Fewest steps that are chosen: fewer give no usable scene. `steps_by_views` gives the upper limit."""


def probe_seconds(width: int, height: int, device: torch.device) -> float:
    """Measure the time of a render, its loss and gradients on this machine, for a fixed set of Gaussians [s].

    Returns the median of `REPEATS`; takes some hundred milliseconds.
    """
    count = max(1, width * height // PIXELS_PER_GAUSSIAN)
    real = {"dtype": torch.float32, "device": "cpu"}
    sampled = real | {"generator": torch.Generator().manual_seed(0)}
    depth = 2 + 4 * torch.rand(count, 1, **sampled)
    across = torch.rand(count, 2, **sampled) - 0.5
    means = torch.cat([across * depth * torch.tensor([1.0, height / width], **real), depth], 1)
    tensors = {
        "means": means, "quats": torch.randn(count, 4, **sampled),
        "log_scales": torch.log(depth / width * (1 + 2 * torch.rand(count, 3, **sampled))),
        "logit_opacities": torch.randn(count, **sampled), "sh": 0.3 * torch.randn(count, 4, 3, **sampled),
    }  # fmt: skip
    gaussians = Gaussians(**{n: t.to(device).requires_grad_() for n, t in tensors.items()})
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]], **real)
    camera = Camera(torch.eye(4, **real).to(device), K.to(device), width, height)
    target = torch.rand(height, width, 3, **sampled).to(device)
    seconds = []
    for _ in range(REPEATS + 1):
        began = time.perf_counter()
        loss = photometric_loss(rasterize(gaussians, camera).rgb, target, None, LossConfig().ssim_weight)
        torch.autograd.grad(loss, list(gaussians.tensors().values()))
        loss.item()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds[1:])


def within_budget(config: FitConfig, seconds: float, views: list[View], device: torch.device) -> tuple[FitConfig, str]:
    """Choose the largest number of steps that is predicted to fit into a time budget, set-up included.

    Args:
        config: Settings; the steps are replaced.
        seconds: Budget [s].
        views: Training views.
        device: Device of the fit.

    Returns:
        The configuration with its steps, and a note on the choice.

    Raises:
        UsageError: The budget is not a positive, finite number, or too short for the shortest fit.
    """
    check_budget(seconds)
    largest = max((v.camera for v in views), key=lambda c: c.width * c.height)
    probe = probe_seconds(largest.width, largest.height, device)
    setup, step = probe * SETUP * len(views), probe * STEP * config.batch
    most = steps_by_views(len(views), all(v.alpha is None for v in views))
    steps = min(int((seconds - setup) / step), most)
    if steps < MIN_STEPS:
        raise UsageError(
            f"time-budget {seconds:g} s is too short: {MIN_STEPS} steps would take {setup + MIN_STEPS * step:.0f} s on this "
            f"machine ({1000 * probe:.0f} ms for an image with gradients); give more time, or smaller images with --downscale"
        )
    needed = setup + steps * step
    return dataclasses.replace(config, steps=steps), (
        f"time-budget {seconds:g} s: chose --steps {steps} for preset {config.preset}, predicted to take {needed:.0f} s "
        f"({1000 * probe:.0f} ms for an image with gradients)"
        + (f"; {len(views)} views need no more steps" if steps == most else "")
        + "; poses, start, scores and report take additional time"
    )


def check_budget(seconds: float) -> None:
    """Check a time budget [s].

    Raises:
        UsageError: The budget is not a positive, finite number.
    """
    if not 0 < seconds < float("inf"):
        raise UsageError(f"time-budget must be a positive number of seconds, not {seconds}")
