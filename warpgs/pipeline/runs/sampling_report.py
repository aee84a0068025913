"""Report on sampled Gaussians: images of sampling events, and the report's section on all events of a fit."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.errors import ResourceError
from warpgs.files import make_folder, read_file, write_bytes
from warpgs.io.decoding import decode
from warpgs.pipeline.train.schedule import Phases
from warpgs.pipeline.train.strategies.importance_sampling import ImportanceSampling
from warpgs.pipeline.train.strategies.sampler import SUPPORT
from warpgs.pipeline.train.strategies.sampling_event import Event, MethodConfig, SampledView
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import TrainingView
from warpgs.report.contact_sheet import Tile, contact_sheet
from warpgs.report.images import png, webp
from warpgs.report.page import SamplingReport

FOLDER = "sampling"
"""Subfolder of a run with the images, ``STEP.png``."""
SHOWN = 3
"""Number of views in an image."""
SHEET_WIDTH = 1600
"""Largest width of an image on the report page [px]."""
OPEN, CLOSED = (0.97, 0.97, 0.95), (0.17, 0.19, 0.22)
"""Colours of pixels that pass the gate, and of all others."""
FADED = 0.45
"""Contrast of the view's image behind the dots."""


def shown_steps(phases: Phases) -> set[int]:
    """Return the steps of the events that get an image: the first event, and the first event in the second half of phase 2."""
    middle = 0.5 * (phases.refine + phases.stable_start)
    late = [e for e in phases.events if e >= middle]
    return {*phases.events[:1], *late[:1]}


def _open_pixels(consistent: bool, quantile: float) -> str:
    """Describe the pixels that pass a gate."""
    parts = ["with a depth that other views confirm"] * consistent
    parts += [f"with S_geometry above its {quantile:g} quantile"] * (quantile > 0)
    return f"pixels {' and '.join(parts)}" if parts else "all pixels that Gaussians cover"


def view_sheet(
    name: str, step: int, view: TrainingView, disparity: np.ndarray | None, sampled: SampledView, config: MethodConfig
) -> np.ndarray:
    """Return a sheet of one view at one event, colours [rows, columns, 3] in [0, 1]: images, gate, sampled pixels, scores.

    Scores are shown if one of them has a weight above 0, the disparity if the view has a prior.

    Args:
        name: Name of the view.
        step: Steps done.
        view: The view.
        disparity: Relative inverse depth of the view, shape [H, W]; None without a prior.
        sampled: Maps and sampled pixels of the event.
        config: Switches and settings of the fit.
    """
    image, rendered, score = (t.cpu().numpy() for t in (view.image, sampled.rendered, sampled.score))
    at, gate = sampled.at.cpu().numpy(), sampled.gate.cpu().numpy()
    weights = config.weights(view.semantic is not None)
    # each score is shown below its inputs
    tiles = [
        Tile("render before", rendered),
        Tile("image", image),
        *([] if disparity is None else [Tile("disparity, near is 1", disparity, "TURBO")]),
        Tile("gate", np.where(gate[..., None], OPEN, CLOSED).astype(np.float32)),
        Tile("sampled pixels", 1 - FADED * (1 - image.mean(-1, keepdims=True).repeat(3, -1)), dots=at),
    ]
    scored = sum(weights) > 0
    if scored:
        names = ("S_render", "S_semantic", "S_geometry")
        tiles += [Tile(f"{w:.2f} {n}", s.cpu().numpy()) for w, n, s in zip(weights, names, sampled.scores, strict=True)]
        tiles.append(Tile("S_importance", score))
    consistent = config.ra and config.sampler.depth == "consistent" and view.consistent is not None
    widened = f"; too few passed at the {config.asked_quantile:g} quantile" if sampled.quantile < config.asked_quantile else ""
    lines = [
        f"{len(at):,} pixels sampled of the {gate.sum():,} that pass the gate, {gate.mean():.0%} of the view.",
        f"Gate: {_open_pixels(consistent, sampled.quantile)}{widened}.",
    ]
    if scored:
        mean = score[at[:, 0], at[:, 1]].mean() if len(at) else 0
        lines.append(f"Mean importance: {mean:.2f} at the sampled pixels, {score.mean():.2f} over the view.")
    return contact_sheet(f"{name}, step {step:,}", lines, tiles, columns=5, tile_width=320, text=1.25)


def _shown(event: Event) -> list[SampledView]:
    """Return up to three of an event's views, evenly spaced."""
    count = len(event.views)
    return [event.views[i] for i in np.unique(np.linspace(0, count - 1, min(SHOWN, count)).round().astype(int))]


def _on_host(sampled: SampledView) -> SampledView:
    """Return a copy with its maps in host memory."""
    maps = {n: getattr(sampled, n).cpu() for n in ("rendered", "score", "gate", "at")}
    render, semantic, geometry = (s.cpu() for s in sampled.scores)
    return dataclasses.replace(sampled, scores=(render, semantic, geometry), **maps)


@contextlib.contextmanager
def images_kept(fit: Trainer, names: list[str], out: Path) -> Iterator[Callable[[], None]]:
    """Have a fit write images of some of its events into its run folder, ``sampling/STEP.png``, while it continues.

    A separate thread writes the images. The end of the block waits for the images, and so does the yielded function. Call this
    function before a checkpoint, since a fit that continues from the checkpoint does not write earlier images. If an image
    cannot be written, the fit continues, with one message in ``fit.messages``.

    Args:
        fit: The fit, before its first step.
        names: Names of its training views.
        out: Run folder.
    """
    config, steps, strategy = fit.config.method, shown_steps(fit.phases), fit.strategy
    disparities = fit.disparities or [None] * len(names)
    lost: list[int] = []
    writing: list[Future[None]] = []

    def written() -> None:
        for sheet in writing:
            sheet.result()  # or what went wrong

    if not isinstance(strategy, ImportanceSampling) or not config.events:
        yield written
        return

    def write(step: int, views: list[TrainingView], kept: list[SampledView]) -> None:
        sheets = [view_sheet(names[d.view], step, v, disparities[d.view], d, config) for v, d in zip(views, kept)]
        try:
            make_folder(out / FOLDER)
            write_bytes(out / FOLDER / f"{step:06d}.png", png(np.concatenate(sheets)))
        except ResourceError as e:
            if not lost:
                fit.messages.append(f"images of sampling events are missing from the report: {e}")
            lost.append(step)

    with ThreadPoolExecutor(1) as thread:

        def on_event(step: int, event: Event) -> None:
            for sheet in writing:
                if sheet.done():
                    sheet.result()  # or what went wrong
            if step in steps:
                # the thread must not use the device, since steps may be captured at that time
                kept = [_on_host(d) for d in _shown(event)]
                views = [dataclasses.replace(fit.views[d.view], image=fit.views[d.view].image.cpu()) for d in kept]
                writing.append(thread.submit(write, step, views, kept))

        strategy.on_event = on_event
        try:
            yield written
        finally:
            strategy.on_event = None
    written()


def event_figures(fit: Trainer) -> dict[str, Any]:
    """Return the sums over the events of a fit, and the sizes of its two layers, for metrics.json.

    Returns:
        ``events``: numbers of events, of Gaussians added and evicted, of samplings (one for each view of an event), and of
        samplings with a widened gate; ``layers``: number of Gaussians in the coarse and in the fine layer.
    """
    asked = fit.config.method.asked_quantile
    layered = isinstance(fit.strategy, ImportanceSampling)
    events, fine = (fit.strategy.events, int(fit.strategy.fine.sum())) if layered else ([], 0)
    quantiles = [q for e in events for q in e["quantiles"]]
    return {
        "events": {
            "count": len(events), **{k: sum(e[k] for e in events) for k in ("added", "evicted")},
            "samplings": len(quantiles), "widened": sum(q < asked for q in quantiles),
        },
        "layers": {"coarse": len(fit.gaussians) - fine, "fine": fine},
    }  # fmt: skip


def sampling_report_of(fit: Trainer, out: Path) -> SamplingReport | None:
    """Return the report's part on the sampling events of a finished fit; None without events."""
    method, figures = fit.config.method, event_figures(fit)
    events, layers = figures["events"], figures["layers"]
    if not events["count"]:
        return None
    how = "sampled at random in proportion to S_importance," if method.agp else "the highest in S_importance"
    weighted = sum(method.weights()) > 0
    if method.agp and not weighted:
        how = "sampled uniformly at random,"
    consistent = method.sampler.depth == "consistent"
    gate = _open_pixels(consistent and method.ra, method.asked_quantile)
    words = (
        f"Each dot is a pixel behind which a fine Gaussian was added at the {method.sampler.depth} depth, while the layer had "
        f"capacity. These pixels are {how} among {gate} (the gate). "
        + ("S_importance is the weighted sum of the three scores; each score is shown below its source."
           if weighted else "All scores have weight 0, so no score is shown.")
    )  # fmt: skip
    if events["widened"]:
        words += (
            f" In {events['widened']:,} of {events['samplings']:,} samplings the gate was widened, because fewer than "
            f"{SUPPORT} candidates for each sample passed at the {method.asked_quantile:g} quantile."
        )
    table = [
        ["sampling events", "Gaussians added", "evicted", "coarse at the end", "fine at the end"],
        [f"{n:,}" for n in (events["count"], events["added"], events["evicted"], layers["coarse"], layers["fine"])],
    ]
    files = sorted(p for p in (out / FOLDER).glob("*.png") if p.stem.isdecimal())  # others are not ours
    images = [
        (f"sampling after step {int(p.stem):,}", webp(decode(p, data=read_file(p, out))[0], SHEET_WIDTH, 70)) for p in files
    ]
    return SamplingReport(words, images, table)
