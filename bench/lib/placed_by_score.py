"""Fits whose events sample by a single score: the strategy of the study on importance, and the figures of a fit."""

from __future__ import annotations

import dataclasses
import gc
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch

import warpgs
from bench.lib.importance_scores import (
    Candidates,
    candidates,
    gain_scores,
    held_out_scores,
    image_scores,
    lift,
    opacity_slopes,
    residual_elsewhere,
    spearman,
    warped_gains,
)
from bench.lib.one_fit import Fit, config_of, figures_of, plan
from bench.lib.scenes import row_of, scene_at
from warpgs.io.load import split_views
from warpgs.pipeline.metrics.scores import evaluate
from warpgs.pipeline.model.table import Column, DensityUpdate
from warpgs.pipeline.train.sampling import ImportanceConfig, normalized
from warpgs.pipeline.train.strategies.importance_sampling import Event, ImportanceSampling, MethodConfig
from warpgs.pipeline.train.views import TrainingView
from warpgs.synthetic.demo import split_spec, write_demo

OWN = "own"
"""Score of the settings."""
LOG = "+log"
"""Suffix of a score: all scores are compared with the gains."""
LATER = 300
"""Least number of steps after an event at which its Gaussians are evaluated."""
TOP = 0.02
"""Fraction of the candidates with the highest scores whose mean gain is reported."""


@dataclass(frozen=True)
class StudiedConfig:
    """Settings of the studied strategy."""

    score: str = OWN
    """Score that events sample by."""
    log: bool = False
    """Compare all scores with the gains at the first event, the middle one and the last."""


class Studied(ImportanceSampling):
    """Importance sampling by one score, which may read the left-out views."""

    Config = StudiedConfig
    held: ClassVar[list] = []
    """Left-out views of the fit in this process."""
    told: ClassVar[list[dict[str, Any]]] = []
    """Logged figures."""

    def __init__(self, context):
        """Begin with nothing logged."""
        super().__init__(context)
        self.pending: dict[str, torch.Tensor] | None = None
        self.placed = -1

    @classmethod
    def warmup_config(cls, own):
        """Return settings that read no other view."""
        return StudiedConfig("uniform")

    @classmethod
    def needs_priors(cls, settings):
        """Return True: the scores read priors for any weights."""
        return True

    def columns(self):
        """Return the columns of the method, and the index of each Gaussian in the evaluated event."""
        return {**super().columns(), "birth": Column(-1, torch.int32, inherited=False)}

    def _scores(
        self, views: list[TrainingView], method: MethodConfig, log: bool
    ) -> tuple[list[Candidates], list[dict[str, torch.Tensor]]]:
        """Return the candidates of each view and their scores [K] by name: all, or those that the arm reads."""
        t, wanted = self.context, self.config.score
        g, options = t.gaussians, t.render_options()
        found = [candidates(g, v, method.sampler, method.ra, options) for v in views]
        columns = t.table.columns
        pull = columns["grad_sum"] / columns["seen_count"].clamp_min(1)
        own = torch.Generator().manual_seed(t.seed)
        scores = [image_scores(g, c, pull, method.sampler.footprint, options, own) for c in found]
        if log or wanted.startswith(("gain", "best", "agreed")):
            scores = [a | b for a, b in zip(scores, gain_scores(g, found, views, t.background, own), strict=True)]
        if log or wanted.startswith("warped"):
            warped = warped_gains(g, found, views, method.sampler.footprint, options)
            scores = [a | b for a, b in zip(scores, warped, strict=True)]
        if log or wanted == "residual elsewhere":
            for i, (c, s) in enumerate(zip(found, scores, strict=True)):
                others = [v for k, v in enumerate(views) if k != i]
                s["residual elsewhere"] = residual_elsewhere(g, c.rows["means"], others, options)
        if log or wanted.startswith("oracle"):
            held = [TrainingView.of(v, t.device) for v in self.held]
            oracles = held_out_scores(g, found, held, options, t.background, own)
            scores = [a | b for a, b in zip(scores, oracles, strict=True)]
        return found, scores

    @torch.no_grad()
    def sample(self, step: int, views: list[TrainingView], method: MethodConfig) -> Event:
        """Return an event that samples by the score of the arm."""
        score, log = self.config.score, self.config.log and self._followed(step)
        if score == OWN and not log:
            return super().sample(step, views, method)
        found, scores = self._scores(views, method, log)
        if log:
            self._tell(step, scores)
        if score != OWN:
            maps = [c.whole(s[score].clamp_min(0)) for c, s in zip(found, scores, strict=True)]
            maps = [
                torch.ones_like(m) if score == "uniform" else normalized(m, c.gate) for m, c in zip(maps, found, strict=True)
            ]
            views = [dataclasses.replace(v, geometry=m, semantic=None) for v, m in zip(views, maps, strict=True)]
            alone = ImportanceConfig(render=0.0, semantic=0.0, geometry=1.0)
            method = dataclasses.replace(method, importance=alone, s_geometry=True)
        event = super().sample(step, views, method)
        if log and self.pending is None and len(event.change.parents) == sum(len(v.at) for v in event.views):
            whole = {n: [c.whole(s[n]) for c, s in zip(found, scores, strict=True)] for n in scores[0]}
            at = [(v.view, v.at) for v in event.views]
            self.pending = {n: torch.cat([maps[i][a[:, 0], a[:, 1]] for i, a in at]) for n, maps in whole.items()}
            self.placed = step
        return event

    def _followed(self, step: int) -> bool:
        events = self.context.phases.events
        return step in (events[0], events[len(events) // 2], events[-1])

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Change the set like the method; number the Gaussians of one event, and evaluate them later."""
        if self.pending is not None and step >= self.placed + LATER and self.samples_after(step):
            self._judge(step)
        yield from super().update(step)
        if self.pending is not None and step == self.placed:
            birth, count = self.context.table.columns["birth"], len(next(iter(self.pending.values())))
            birth[-count:] = torch.arange(count, dtype=birth.dtype, device=birth.device)

    @torch.no_grad()
    def _judge(self, step: int) -> None:
        t, birth = self.context, self.context.table.columns["birth"].long()
        held = [TrainingView.of(v, t.device) for v in self.held]
        down, bend = (
            x.sum(0) for x in opacity_slopes(t.gaussians, None, held, t.background, torch.Generator().manual_seed(t.seed))
        )
        opacity = torch.sigmoid(t.gaussians.logit_opacities)
        worth = opacity * down + opacity.square() * bend  # what removing it would cost
        assert self.pending is not None
        truth = worth.new_zeros(len(next(iter(self.pending.values()))))
        alive = birth >= 0
        truth[birth[alive]] = worth[alive]
        self._add(step, "worth later", self.pending, truth)
        self.pending = None

    def _tell(self, step: int, scores: list[dict[str, torch.Tensor]]) -> None:
        whole = {n: torch.cat([s[n] for s in scores]) for n in scores[0]}
        for truth in ("oracle gain", "oracle best"):
            self._add(step, truth, whole, whole[truth])

    def _add(self, step: int, name: str, scores: dict[str, torch.Tensor], truth: torch.Tensor) -> None:
        for score, values in scores.items():
            if score != name:
                figures = {"spearman": spearman(values, truth), "lift": lift(values, truth.clamp_min(0), TOP)}
                self.told.append({"step": step, "truth": name, "score": score} | figures)


def measure(fit: Fit) -> dict:
    """Fit by one arm; return its scores over the views left out and the held-out ones, its size, and what was logged."""
    score, _, preset = fit.preset.partition("/")
    log = score.endswith(LOG)
    config = config_of(preset, fit.seed)
    own = StudiedConfig(score.removesuffix(LOG), log)
    config = dataclasses.replace(config, strategy=Studied, strategy_config=own)
    scene, row = scene_at(fit.folder, fit.downscale), row_of(fit.row)
    Studied.held = [scene.view(name) for name in split_views(scene, fit.split).test]
    Studied.told = []
    try:
        fitted = warpgs.fit(scene, config, split=fit.split, device=fit.device, verbose=False)
        test = [scene.view(name) for name in split_views(scene, row.split).test]
        scores = evaluate(fitted.scene_gaussians, test, fitted.options())
        beside = {"test_psnr": math.fsum(s.psnr for s in scores) / len(scores)}
        return figures_of(fitted.metrics) | beside | {"log": Studied.told}
    finally:
        gc.collect()


def warm_up(folder: str, device: str) -> None:
    """Compile what the fits use, by a tiny one that is logged."""
    spec = split_spec(8)
    write_demo(Path(folder), views=8, width=96, height=64)
    preset = f"uniform{LOG}/default:steps=30,phases.least=1"
    for fit in plan(f"tiny@{spec}", preset, 0, folder, (spec, 1), 1, device)[:1]:
        measure(fit)
