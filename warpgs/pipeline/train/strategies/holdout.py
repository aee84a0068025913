"""Density strategy that chooses the number of Gaussians by the error of held-out blocks of the training views.

On top of importance sampling it decides when growth ends, and which Gaussians and degrees stay (docs/complexity.md).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import asdict, fields

import torch

from warpgs import schema
from warpgs.errors import DataError
from warpgs.pipeline.metrics.psnr import masked_mse
from warpgs.pipeline.model import compress
from warpgs.pipeline.model.parameter_bounds import bound_columns, enforce_bounds, min_log_scale
from warpgs.pipeline.model.table import Column, DensityUpdate
from warpgs.pipeline.train.schedule import sh_degree
from warpgs.pipeline.train.strategies.base import register
from warpgs.pipeline.train.strategies.holdout_blocks import (
    FLOOR,
    MIN_BLOCKS,
    Blocks,
    Gain,
    Level,
    block_errors,
    decibels,
    gain,
    hide,
    only,
    rendered,
    sample_blocks,
)
from warpgs.pipeline.train.strategies.importance_sampling import EVENT, MAX_VIEWS, ImportanceSampling
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.rasterize import RasterizeOptions
from warpgs.runtime.terminal import Detail
from warpgs.scene import Gaussians

RECOVERED_AGAIN = 0.5
"""Fraction of what training recovered of one trim that it is expected to recover of the next: a smaller model recovers less.
With all of it smooth walls ended up to 1.1 dB below `HoldoutConfig.enough_db`, with half of it there (docs/complexity.md)."""
LATELY = 1.5
"""Factor by which the steps grow while less than `HoldoutConfig.stop_db` is gained, for a fit to end."""
NEAR = 4.0
"""Distance below `HoldoutConfig.enough_db` over which the loss that a trim may cause falls to 0 [dB]. With a threshold instead,
a tenth of a decibel decided whether a smooth wall kept 167 or 696 Gaussians (docs/complexity.md)."""

_COUNT = schema.whole(0)
_LEVEL = {f.name: _COUNT if f.name in ("step", "count") else schema.real for f in fields(Level)}
STATE = schema.fields({
    "was_reset": schema.flag, "events": schema.items(EVENT), "closed": schema.or_null(_COUNT), "why": schema.text,
    "levels": schema.items(schema.fields(_LEVEL, others=False)), "growing": _COUNT, "measured": schema.items(_COUNT),
    "trims": schema.items(schema.fields({
        "step": _COUNT, "before": schema.whole(1), "after": _COUNT, "psnr": schema.items(schema.real, 2),
    })),
})  # fmt: skip
"""Schema of the plain values in a checkpoint."""


@register("holdout")
class Holdout(ImportanceSampling):
    """Importance sampling, or clone and split if ``method.events`` is off, with growth ended by the error of held-out blocks.

    Until growth ends, blocks of every view are held out of the loss and of sampling. The start uses whole images: the
    held-out blocks measure growth, merging and pruning, not the start.
    """

    def __init__(self, trainer):
        """Begin with growth open and nothing measured."""
        super().__init__(trainer)
        self.closed: int | None = None
        """Steps done when growth ended; None before."""
        self.why = ""
        """Reason why growth ended, for the user."""
        self.levels: list[Level] = []
        """Levels of growth that were measured."""
        self.trims: list[dict] = []
        """Step of each trim, and the Gaussians and the training PSNR [dB] before and after it."""
        self.whole: list[TrainingView] = []
        """Views without hidden blocks."""
        self.growing = 0
        """Level of growth that new Gaussians come with."""
        self.before: torch.Tensor | None = None
        """Errors of the blocks when they were measured last, shape [B]."""
        self.measured: list[tuple[int, torch.Tensor]] = []
        """Steps done, and errors of the blocks [B], of every measurement, where the end of the fit follows from them."""

    def columns(self):
        """Return the columns of importance sampling, the bounds of each Gaussian, and the level of growth that it came with."""
        bounds = bound_columns(self.trainer.config.init.max_sh_degree)
        return {**super().columns(), **bounds, "growth_level": Column(0, torch.int32, inherited=False)}

    @classmethod
    def shrinks(cls, config) -> bool:
        """Return whether ``holdout.trim_db`` or ``holdout.degrees`` asks for tries."""
        return config.holdout.trim_db > 0 or config.holdout.degrees

    def kept_views(self):
        """Return the whole views, from the time that blocks are hidden."""
        return self.whole

    def setup(self) -> None:
        """Hold blocks out, where there are enough of them to tell a gain from noise."""
        t, c = self.trainer, self.trainer.config
        begins = t.phases.refine if c.method.events else c.density.times(c.steps)[0]
        ends = self._growth_ends
        levels = c.holdout.levels
        marks = {max(1, begins + round(k * (ends - begins) / levels)) for k in range(levels + 1)}
        if c.method.events:  # right before fine Gaussians are added, which cost up to 3 dB until they have been trained
            marks = {next((e for e in t.phases.events if e >= m), ends) for m in marks}
        self.marks = sorted(marks)
        """Steps done when the blocks are measured: before growth, and after each level."""
        self.whole = t.views
        self.blocks, shown = self.hold_out(t.views)
        held = sum(map(len, self.blocks))
        self.measuring = held >= MIN_BLOCKS and ends < c.steps  # growth is measured on held-out blocks
        if self.measuring:
            t.set_views(shown)
            pixels = sum(len(b) * b.side**2 for b in self.blocks) / sum(v.camera.width * v.camera.height for v in t.views)
            words = f"holdout: {held} blocks, {pixels:.1%} of the pixels, are held out until growth ends, by step {ends}"
            t.notes.append(Detail(words))
        else:
            few = f"the images hold only {held} blocks" if held < MIN_BLOCKS else "growth lasts to the end of the fit"
            t.notes.append(Detail(f"holdout: nothing is held out, since {few}; the fit is as without this strategy"))

    def hold_out(self, views: list[TrainingView]) -> tuple[list[Blocks], list[TrainingView]]:
        """Return what is held out of each view until growth ends, and the views that are trained on until then."""
        blocks = sample_blocks(views, self.trainer.config.holdout.fraction, self.trainer.config.seed)
        return blocks, [hide(v, b) for v, b in zip(views, blocks)]

    @property
    def _growth_ends(self) -> int:
        """Steps done when growth ends by schedule."""
        return super().densify_until

    @property
    def densify_until(self) -> int:
        """Last step after which the set may be refined."""
        ends = self._growth_ends
        return ends if self.closed is None else min(ends, self.closed - 1)

    def sh_degree(self, step: int) -> int:
        """Return the degree in use; the highest is in use when growth begins, so that its use can be measured."""
        c = self.trainer.config
        highest = c.init.max_sh_degree
        if not self.measuring or highest == 0:
            return super().sh_degree(step)
        return sh_degree(step, max(1, min(c.sh_every, self.marks[0] // highest)), highest)

    def dropout(self, step: int) -> float:
        """Return the dropout probability, lower such that a trimmed model shows as many Gaussians as one without trims.

        Dropout makes Gaussians redundant, and a trim has removed the redundant ones.
        """
        kept = math.prod(t["after"] / t["before"] for t in self.trims)
        return max(0.0, 1 - (1 - super().dropout(step)) / kept)

    def samples_after(self, step: int) -> bool:
        """Return whether fine Gaussians are sampled after a step, which ends with growth."""
        return super().samples_after(step) and (self.closed is None or step < self.closed)

    def _measures_after(self, step: int) -> bool:
        return self.measuring and self.closed is None and step in self.marks

    def _trims_after(self, step: int) -> bool:
        c = self.trainer.config.holdout
        if self.closed is None or not c.trim_db > 0:
            return False
        rest = self.trainer.steps - self.closed
        return step in {self.closed + round(k * rest / c.trims) for k in range(1, c.trims + 1)}

    def due(self, step: int) -> bool:
        """Return whether anything is measured, added or trimmed after a step."""
        return super().due(step) or self._measures_after(step) or self._trims_after(step)

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Measure, then grow, then trim, where it is time for each."""
        if self._measures_after(step):
            yield from self._measure(step)
        yield from map(self._of_level, super().update(step))
        if self._trims_after(step):
            self._trim(step)

    def _of_level(self, change: DensityUpdate) -> DensityUpdate:
        return dataclasses.replace(change, columns={**change.columns, "growth_level": self.growing})

    def refine(self, step, growing=None, protected=None):
        """Yield the refinement; Gaussians that only one view sees, or that are as fine as a pixel, do not grow.

        Arguments are those of `CloneSplit.refine`: ``growing`` and ``protected`` are bool [N] or None.
        """
        if self.measuring and self.trainer.config.holdout.bounds:
            self._observe()
        yield from super().refine(step, growing, protected)

    def after_step(self, phase, settings, going):
        """Apply the bounds of each Gaussian, and raise the opacities of protected ones; ``settings`` [6], ``going`` [1]."""
        if self.trainer.config.holdout.bounds or self.shrinks(self.trainer.config):
            enforce_bounds(self.trainer.table)
        super().after_step(phase, settings, going)

    @property
    def _view_set(self) -> compress.ViewSet:
        return compress.ViewSet([v.camera for v in self.whole], self._options(), self.trainer.config.seed)

    def _options(self) -> RasterizeOptions:
        t = self.trainer
        return RasterizeOptions(
            rule=t.config.rule, sh_degree=self.sh_degree(t.step), background=t.background, max_instances=t.max_instances
        )  # fmt: skip

    def _errors(self, gaussians: Gaussians) -> torch.Tensor:
        return block_errors(gaussians, self.whole, self.blocks, self._options())

    def _observe(self) -> None:
        """Set the bounds of every Gaussian by what the views can resolve, and stop growth of what only one view sees."""
        t, columns, seen = self.trainer, self.trainer.table.columns, self._view_set.coverage(self.trainer.gaussians)
        columns["min_log_scale"] = min_log_scale(seen.footprint)
        columns["max_degree"] = torch.minimum(columns["max_degree"], seen.supported_degree().to(torch.int32))
        enforce_bounds(t.table)
        if len(t.views) > 1:
            columns["grad_sum"] = torch.where(seen.views > 1, columns["grad_sum"], 0)
        finest = t.gaussians.log_scales.amax(1) <= columns["min_log_scale"]
        columns["grad_sum"] = torch.where(finest, 0, columns["grad_sum"])

    def _measure(self, step: int) -> Iterator[DensityUpdate]:
        """Measure the held-out blocks; end growth where the last level gained less than its noise, or where its time is up."""
        c, model = self.trainer.config.holdout, self.trainer.gaussians
        last = max((m for m in self.marks if m < step), default=step)
        if last < step < self.marks[-1] and not any(super(Holdout, self).due(s) for s in range(last, step)):
            return  # the set has not changed since
        errors = self._errors(model)
        if self.before is not None:
            fall = own = gain(self.before, errors)
            old = self.trainer.table.columns["growth_level"] < self.growing
            if c.stop_db == 0:  # else the fall alone decides; this renders every view once more
                hidden = self._errors(compress.rows_of(model, old)) if bool(old.any()) and not bool(old.all()) else errors
                own = gain(hidden, errors)
            least: Gain = min(fall, own, key=lambda g: g.mean)
            self.levels.append(Level(step, len(model), decibels(errors), fall.mean, own.mean, least.mean, least.noise))
            if c.stop_db == 0 and least.upper_bound_below(c.least_db, c.noise):
                self.why = (
                    f"level {len(self.levels)} gained {least.mean:+.3f} dB on the held-out blocks, which with {c.noise:g} x "
                    f"its noise of {least.noise:.3f} dB is less than {c.least_db:g} dB"
                )
                if bool(old.all()):
                    self.why = f"no Gaussian came with level {len(self.levels)}: the capacity is used up, or nothing is to add"
                yield from self._close(step)
                return
            since, earlier = next((m for m in reversed(self.measured) if m[0] * LATELY <= step), (0, None))
            lately = Gain(math.inf, 0.0) if earlier is None or self._is_early(step) else gain(earlier, errors)
            if c.stop_db > 0 and lately.upper_bound_below(c.stop_db, c.noise):
                self.why = (
                    f"the held-out blocks gained {lately.mean:+.3f} dB in the last {step - since:,} steps, which with "
                    f"{c.noise:g} x its noise of {lately.noise:.3f} dB is less than {c.stop_db:g} dB"
                )
                yield from self._close(step)
                return
            if step == self.marks[-1]:
                self.why = f"its time was up, after {least.mean:+.3f} dB by level {len(self.levels)}"
                yield from self._close(step)
                return
        self.before = errors
        if c.stop_db > 0:
            self.measured.append((step, errors))
        self.growing += 1

    def _is_early(self, step: int) -> bool:
        """Return whether it is too early to end growth: in the first third of its time, or while views are half their size."""
        c = self.trainer.config
        return 3 * step < self.marks[-1] or step <= c.half_resolution * c.steps

    def _close(self, step: int) -> Iterator[DensityUpdate]:
        """End growth: lower the degrees that held-out blocks do not need, and train on all pixels from here on."""
        t, c = self.trainer, self.trainer.config.holdout
        self.closed = step
        if c.stop_db > 0:
            t.end_growth()
        yield from map(self._of_level, self._catch_up(step))
        if c.bounds:
            self._observe()
        if c.degrees:
            base = self._errors(t.gaussians)
            t.table.columns["max_degree"] = compress.needed_degrees(
                t.gaussians, t.table.columns["max_degree"], self._view_set,
                lambda model: gain(base, self._errors(model)).cost_below(c.keep_db, c.noise),
            )  # fmt: skip
        enforce_bounds(t.table)
        self.forget()
        t.set_views(self.whole)
        self.whole = t.views
        words = f"holdout: growth ended at step {step} with {len(t.table):,} Gaussians, because {self.why}"
        t.messages.append(Detail(f"{words}; all pixels are trained on from here"))

    @torch.no_grad()
    def view_psnr(self, gaussians: Gaussians) -> float:
        """Return the mean over the training views of the PSNR over the pixels that count, the error floor included [dB]."""
        options = self._options()
        errors = [masked_mse(rendered(gaussians, v, options), v.image, v.mask).double() for v in self.whole]
        return float((-10 * torch.log10(torch.stack(errors) + FLOOR)).mean())

    def psnr_budget(self, psnr: float, step: int) -> float:
        """Return the PSNR on the training views that a trim may cost [dB].

        It is ``holdout.trim_db``, plus what the fit has above ``holdout.enough_db``, plus, before the last step, what training
        is expected to recover. Before the last step it falls to 0 over `NEAR` decibels below ``enough_db``.
        """
        c = self.trainer.config.holdout
        over = psnr - c.enough_db
        if step == self.trainer.steps:
            return c.trim_db + max(over, 0.0)
        fraction = 1 + over / NEAR
        if not fraction > 0:
            return 0.0
        recovered = psnr - self.trims[-1]["psnr"][1] if self.trims else 0.0
        return min(fraction, 1.0) * c.trim_db + max(over, 0.0) + RECOVERED_AGAIN * max(recovered, 0.0)

    def _trim(self, step: int) -> None:
        """Prune the model within its PSNR budget on the training views."""
        t = self.trainer
        whole, before = self.view_psnr(t.gaussians), len(t.table)
        budget = self.psnr_budget(whole, step)
        if budget == 0:
            return
        made = compress.prune_model(
            t.gaussians, t.table.columns["level"], self._view_set,
            lambda g, fraction: self.view_psnr(g) >= whole - fraction * budget,
        )  # fmt: skip
        t.table.merge(made.gaussians, made.into)
        t.count_changed()
        t.table.columns["max_degree"] = made.degrees
        self._observe()
        after = self.view_psnr(t.gaussians)
        self.trims.append({"step": step, "before": before, "after": len(made.degrees), "psnr": [whole, after]})
        words = f"holdout: trimmed at step {step} from {before:,} to {len(made.degrees):,} Gaussians"
        t.messages.append(Detail(f"{words} for {whole - after:.3f} dB on the training views"))

    def _catch_up(self, step: int) -> Iterator[DensityUpdate]:
        """Sample as many fine Gaussians per pixel in the blocks, where none were sampled so far, as there are elsewhere."""
        method, pixels = self.method, sum(v.image[..., 0].numel() for v in self.whole)
        held = sum(len(b) * b.side**2 for b in self.blocks)
        fraction = int(self.fine.sum()) / (pixels - held) * held / pixels
        if not method.events or not fraction * pixels >= 1:
            return
        sampler = dataclasses.replace(method.sampler, fraction=min(1.0, fraction), max_fraction=1e6)
        blocks = [only(v, b) for v, b in zip(self.whole, self.blocks)]
        for first in range(0, len(blocks), MAX_VIEWS):
            views = blocks[first : first + MAX_VIEWS]
            yield self.sample(step, views, dataclasses.replace(method, sampler=sampler)).change

    STATE = staticmethod(STATE)

    def state(self):
        """Return the last errors of the blocks [B] and all measurements so far."""
        tensors, plain = super().state()
        if self.before is not None:
            tensors["holdout.before"] = self.before
        if self.measured:
            tensors["holdout.measured"] = torch.stack([e for _, e in self.measured])
        return tensors, plain | {
            "closed": self.closed, "why": self.why, "levels": [asdict(x) for x in self.levels], "trims": self.trims,
            "growing": self.growing, "measured": [s for s, _ in self.measured],
        }  # fmt: skip

    def load(self, tensors, plain):
        """Load what `state` returned, ``tensors`` of shape [...] by name; once growth has ended, whole views are trained on.

        Raises:
            DataError: The errors of the blocks are not of these blocks.
        """
        super().load(tensors, plain)
        self.closed, self.why, self.trims, self.growing = (plain[k] for k in ("closed", "why", "trims", "growing"))
        self.levels = [Level(**x) for x in plain["levels"]]
        self.before = tensors.get("holdout.before")
        blocks = sum(map(len, self.blocks)) if self.measuring else 0
        measured = tensors.get("holdout.measured", torch.zeros(0, blocks))
        for errors, shape in ((self.before, (blocks,)), (measured, (len(plain["measured"]), blocks))):
            if errors is not None and errors.shape != shape:
                raise DataError(
                    f"the stored errors of the held-out blocks have shape {list(errors.shape)}, not {list(shape)}; fit again"
                )
        self.measured = list(zip(plain["measured"], measured))
        if self.closed is not None:
            self.trainer.views = self.whole

    def figures(self) -> dict:
        """Return why growth ended, its levels and the trims."""
        if not self.measuring:
            return {}
        last = self.levels[-1] if self.levels else None
        return {
            "holdout": True, "why": self.why, "marginal_db": last and last.gain, "closed": self.closed,
            "levels": [asdict(x) for x in self.levels], "trims": self.trims,
        }  # fmt: skip
