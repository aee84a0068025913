"""Settings that follow from the number of training views and their size: one rule from 3 photographs to 300, on any device.

The constants were chosen by leaving training views out (docs/decisions/013-any-capture.md); docs/results.md lists exceptions.
"""

from __future__ import annotations

import dataclasses
import math

from warpgs.pipeline.model.init import extrapolates
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.schedule import OptimizerConfig, plan_phases
from warpgs.runtime.terminal import Detail
from warpgs.scene import View

MIN_STEPS, OPAQUE_STEPS = 3000, 4500
"""Steps of a fit of up to `FEW` views: first for views with an alpha channel, then for opaque views."""
FEW, STEPS_POWER, MAX_STEPS = 4, 0.75, 30_000
"""Number of views above which steps exceed `MIN_STEPS`; exponent of this growth; and largest number of steps."""
SCALES_LR, SCALES_VIEWS, SCALES_POWER = 0.1, 8, 0.6
"""Learning rate of the log scales for up to `SCALES_VIEWS` views, and exponent with which it falls for more views."""
OPACITIES_LR, MAX_OPACITIES_LR = 0.0125, 0.05
"""Learning rate of the opacities for 3 views, which rises with the square root of the number of views; and its largest
value."""
HALF_RESOLUTION, HALF_VIEWS = 0.5, 4
"""Fraction of the steps at half size for up to `HALF_VIEWS` views; for more views it is inversely proportional to their
number."""
DEGREES = (5, 9, 12)
"""Fewest training views for spherical harmonics of degree 1, 2 and 3. With fewer, colours do not depend on the view: four
photographs cannot distinguish a view-dependent colour from an error of the shape."""
OPACITIES_DECAY, ONE_LAYER_VIEWS = 0.001, 54
"""Fraction by which a step lowers every opacity, and the largest number of views with this decay and one layer. More views
were not measured: they have no decay, and two layers (docs/decisions/023-opacity-decay.md)."""
SMOOTH_STEPS, SMOOTH_WEIGHT, SMOOTH_VIEWS = 3000, 1.0, 4
"""Fewest planned steps of a fit with the roughness of rendered depth in its loss; the weight of this term for opaque
views; and the largest number of such views. The term does not help in 480 steps, and lowers PSNR with 9 opaque views
(docs/decisions/024-smooth-depth.md)."""
ALPHA_SMOOTH_WEIGHT, ALPHA_SMOOTH_VIEWS = 0.5, 8
"""Weight of the roughness for views with alpha, and the largest number of such views (docs/decisions/024-smooth-depth.md)."""
EXTRAPOLATED_VIEWS, EXTRAPOLATED_DECAY = 4, 0.0015
"""Largest number of opaque views for a start with extrapolated points, in fits of at least `SMOOTH_STEPS` steps; and the decay
of opacities with such points. Fits with more views or fewer steps were not measured
(docs/decisions/026-extrapolated-points.md)."""
AVERAGE_LAST, AVERAGED_VIEWS = 0.05, 20
"""Fraction of the steps over which parameters are averaged at the end, and fewest training views with this mean. With 12 views
the gain is at most 0.04 dB (docs/decisions/029-mean-of-the-last-steps.md)."""
MIN_GAIN_DB = 0.1
"""Gain of held-out blocks below which growth ends [dB]. Nothing is held out if the time limit on a CPU shortens the fit: it is
too short to end earlier, and a measurement renders every view (docs/decisions/025-time-on-a-cpu.md)."""
CPU_PIXELS = 1.55e6
"""Pixels per second that two cores of 2.5 GHz train with about as many Gaussians as pixels; with fewer Gaussians, up to three
times as many pixels."""
CPU_SECONDS = 45.0, 4.0, 1200.0
"""Default time limit of a fit on a CPU [s]: constant part, part for each view, and upper bound of the sum."""
ONE_LAYER = 1.1
"""Time of a step on a CPU with one layer of Gaussians, relative to a step with two layers, where there are fewer Gaussians."""
MEANS_LR, SH_LR, CPU_RATES, CPU_RATES_VIEWS = 1.6e-4, 2.5e-3, 2.5, 9
"""Learning rates of the means and of the constant colour; and the factor of both if the time limit on a CPU shortens the fit
and there are more than `CPU_RATES_VIEWS` views (docs/decisions/025-time-on-a-cpu.md)."""
LOST_DB = 0.18
"""Least loss of PSNR for each halving of the steps of a fit on a CPU [dB]; with many views the loss is larger."""


def steps_by_views(views: int, opaque: bool = True) -> int:
    """Return the largest number of steps for a number of views: 4500 up to 4 opaque views, 5511 for 9, 30,000 from 87 on."""
    if opaque and views <= FEW:
        return OPAQUE_STEPS
    return min(MAX_STEPS, round(MIN_STEPS * max(1.0, views / FEW) ** STEPS_POWER))


def cpu_seconds(views: int) -> float:
    """Return the default time limit for the steps of a fit on a CPU [s]."""
    least, each, most = CPU_SECONDS
    return min(least + each * views, most)


def pixels_of_steps(steps: int, half_resolution: float, pixels: int) -> float:
    """Return the number of pixels that ``steps`` render; views have ``pixels``, or a quarter of them at half size."""
    return steps * pixels * (1 - 0.75 * half_resolution)


def steps_on_cpu(wanted: int, views: int, pixels: float) -> tuple[int, str]:
    """Return how many steps fit into the time limit on a CPU, and a sentence for the user; it is empty if all steps fit.

    Args:
        wanted: Steps of the fit without a limit.
        views: Number of training views.
        pixels: Pixels that the wanted steps render, weighted by the time for a pixel.
    """
    seconds, most = pixels / CPU_PIXELS, cpu_seconds(views)
    if seconds <= most:
        return wanted, ""
    steps = max(1, int(wanted * most / seconds))
    lost = LOST_DB * math.log2(wanted / steps)
    return steps, (
        f"to save time on a CPU, the fit takes {steps:,} of {wanted:,} steps: about {most / 60:.1f} min on two cores, besides "
        f"start and report; --no-cpu-limit takes all, about {seconds / 60:.0f} min, and raises PSNR by at least {lost:.1f} dB"
    )


def settings_by_views(config: FitConfig, train: list[View], device: str) -> tuple[FitConfig, list[str]]:
    """Return the settings with all automatic ones (None) chosen, and sentences on the choices.

    Args:
        config: Settings.
        train: Training views.
        device: Kind of device, cpu or cuda: on a CPU the steps are limited to a time, unless ``cpu_limit`` is off.
    """
    views = len(train)
    opaque = all(v.alpha is None for v in train)
    one_layer = views <= ONE_LAYER_VIEWS
    method = config.method
    if method.hier is None:
        method = dataclasses.replace(method, hier=not one_layer)
    degree = config.sh_degree
    if degree is None:
        degree = sum(views >= n for n in DEGREES)
    half = config.half_resolution
    if half is None:
        half = float(f"{HALF_RESOLUTION * min(1.0, HALF_VIEWS / views):.2g}")
    wanted, limit = config.steps, ""
    if wanted is None:
        wanted = min(steps_by_views(views, opaque), config.max_steps)
    steps = wanted
    if config.steps is None and config.cpu_limit and device == "cpu":
        pixels = config.batch * max(v.camera.width * v.camera.height for v in train)
        steps, limit = steps_on_cpu(wanted, views, pixels_of_steps(wanted, half, pixels) * (1.0 if method.hier else ONE_LAYER))
    optimizer = _rates_by_views(config.optimizer, views, bool(limit))
    init = config.init
    if init.extrapolate is None:
        init = dataclasses.replace(init, extrapolate=opaque and views <= EXTRAPOLATED_VIEWS and steps >= SMOOTH_STEPS)
        init = dataclasses.replace(init, extrapolate=extrapolates(init, train))
    if optimizer.opacities_decay is None:
        decay = EXTRAPOLATED_DECAY if extrapolates(init, train) else OPACITIES_DECAY
        optimizer = dataclasses.replace(optimizer, opacities_decay=decay if one_layer else 0.0)
    stopping, sh_every = config.stopping, config.sh_every
    if stopping.min_gain_db is None:
        stopping = dataclasses.replace(stopping, min_gain_db=0.0 if limit else MIN_GAIN_DB)
        if limit and degree:  # as with held-out blocks, all degrees are in use when growth begins
            sh_every = min(sh_every, max(1, plan_phases(config.phases, steps).refine // degree))
    loss = config.loss
    if loss.smooth_weight is None:
        loss = dataclasses.replace(loss, smooth_weight=_smooth_weight_by_views(views, opaque, steps))
    made = dataclasses.replace(
        config, steps=steps, sh_degree=degree, sh_every=sh_every, half_resolution=half, init=init, optimizer=optimizer,
        method=method, loss=loss, stopping=stopping,
    )  # fmt: skip
    words = _words_of_choices(config, made, wanted)
    named = Detail(f"settings for {views} views: {', '.join(words)}") if words else ""
    return made, [note for note in (named, limit) if note]


def _rates_by_views(optimizer: OptimizerConfig, views: int, limited: bool) -> OptimizerConfig:
    """Return the settings with the automatic learning rates and the fraction of averaged steps chosen.

    Args:
        optimizer: Settings.
        views: Number of training views.
        limited: Whether the time limit on a CPU shortens the fit.
    """
    factor = CPU_RATES if limited and views > CPU_RATES_VIEWS else 1.0
    chosen = {
        "scales_lr": SCALES_LR * min(1.0, SCALES_VIEWS / views) ** SCALES_POWER,
        "opacities_lr": min(MAX_OPACITIES_LR, OPACITIES_LR * math.sqrt(views / 3)),
        "means_lr": factor * MEANS_LR,
        "sh_lr": factor * SH_LR,
        "average_last": AVERAGE_LAST if views >= AVERAGED_VIEWS else 0.0,
    }
    return dataclasses.replace(optimizer, **{n: float(f"{v:.3g}") for n, v in chosen.items() if getattr(optimizer, n) is None})


def _smooth_weight_by_views(views: int, opaque: bool, steps: int) -> float:
    """Return the weight of the roughness of rendered depth.

    Args:
        views: Number of training views.
        opaque: Whether no view has an alpha channel.
        steps: Planned steps of the fit.
    """
    weight, most = (SMOOTH_WEIGHT, SMOOTH_VIEWS) if opaque else (ALPHA_SMOOTH_WEIGHT, ALPHA_SMOOTH_VIEWS)
    return weight if views <= most and steps >= SMOOTH_STEPS else 0.0


def _words_of_choices(config: FitConfig, made: FitConfig, wanted: int) -> list[str]:
    """Return a phrase for each setting of ``made`` that is None in ``config``; ``wanted`` is the unlimited number of steps."""
    optimizer, half, last = made.optimizer, made.half_resolution, made.optimizer.average_last
    each = f" of {config.batch} views" if config.batch > 1 else ""
    chosen = {
        f"at most {wanted:,} steps{each}": config.steps, f"SH degree {made.sh_degree}": config.sh_degree,
        f"means_lr {optimizer.means_lr:g}": config.optimizer.means_lr,
        f"scales_lr {optimizer.scales_lr:g}": config.optimizer.scales_lr,
        f"opacities_lr {optimizer.opacities_lr:g}": config.optimizer.opacities_lr,
        f"opacities_decay {optimizer.opacities_decay:g}": config.optimizer.opacities_decay,
        f"sh_lr {optimizer.sh_lr:g}": config.optimizer.sh_lr,
        f"mean of the last {last:.0%} of the steps" if last else "no mean of the last steps": config.optimizer.average_last,
        f"smooth_weight {made.loss.smooth_weight:g}": config.loss.smooth_weight,
        f"{'' if made.init.extrapolate else 'no '}extrapolated points": config.init.extrapolate,
        "held-out blocks" if made.stopping.min_gain_db else "no held-out blocks": config.stopping.min_gain_db,
        "two layers" if made.method.hier else "one layer": config.method.hier,
        f"half-size images for the first {half:.0%} of the steps": config.half_resolution,
    }  # fmt: skip
    return [words for words, given in chosen.items() if given is None]
