"""A fit that finds its own size: growth is judged on held-out blocks, what evidence does not ask for goes, then all is trained.

docs/complexity.md. The fit itself is that of `fit.Fit`; this room decides when growth ends and what is left of it.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import asdict, dataclass

import torch

from warpgs.pipeline.model import compress
from warpgs.pipeline.model.layers import COARSE, FINE, NOT_SAMPLED
from warpgs.pipeline.model.parameter_bounds import ParameterBounds, model_bytes
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.loss import masked_mse
from warpgs.pipeline.train.schedule import sh_degree
from warpgs.pipeline.train.strategies.clone_split import DensityUpdate
from warpgs.pipeline.train.strategies.holdout_blocks import (
    FLOOR,
    MIN_BLOCKS,
    Gain,
    block_errors,
    decibels,
    gain,
    hide,
    only,
    sample_blocks,
)
from warpgs.pipeline.train.strategies.importance_sampling import MAX_VIEWS, sampling_event
from warpgs.pipeline.train.trainer import Fit, Phase
from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.scene import Gaussians

MENDED_AGAIN = 0.5
"""Part of what training mended of one trim that it is expected to mend of the next: a smaller model mends less. With all of it
smooth walls ended up to 1.1 dB below enough, with half of it at enough (docs/complexity.md)."""

NEAR = 4.0
"""Below enough by less than this a trim may take the less the farther [dB]. With an edge there a tenth of a decibel decided
whether a smooth wall kept 167 or 696 Gaussians (docs/complexity.md)."""


@dataclass(frozen=True)
class Level:
    """One level of growth, judged; plain values as metrics.json has them."""

    step: int
    """Steps done when it was judged."""
    count: int
    """Gaussians then."""
    held_out_psnr: float
    """PSNR of the held-out blocks, the judge's floor included [dB]."""
    fall: float
    """What held-out error fell by since the level before, by growth and training together [dB]."""
    own: float
    """What is lost when the Gaussians that came with the level are hidden [dB]."""
    gain: float
    """The smaller of the two, which both are upper bounds of what growth bought [dB]."""
    noise: float
    """Standard error of ``gain`` over the blocks [dB]."""


class AdaptiveFit(Fit):
    """A fit with a judge. Until growth ends, blocks of every view are held out of its loss and of its sampling.

    The start sees whole photographs: its colours and depths come from them, and evidence is about growth, merging and pruning.
    """

    def __init__(self, *args, **kwargs):
        """Set up as `Fit` does, then hold blocks out."""
        self.closed: int | None = None
        self.why = ""
        """Why growth stopped, for the user."""
        self.levels: list[Level] = []
        self.trims: list[dict] = []
        """Step of each trim, and the Gaussians and the training PSNR [dB] before and after it."""
        super().__init__(*args, **kwargs)
        c = self.config
        begins = self.phases.refine if c.method.events else c.density.times(c.steps)[0]
        ends = self._growth_ends
        self.marks = sorted(
            {max(1, begins + round(k * (ends - begins) / c.holdout.levels)) for k in range(c.holdout.levels + 1)}
        )
        """Steps done when the judge looks: before growth, and after each level."""
        self.optimizer.bounds = ParameterBounds(len(self.gaussians), c.init.max_sh_degree, self.device)
        self.whole = self.views
        self.blocks = sample_blocks(self.views, c.holdout.fraction, c.seed)
        self.before: torch.Tensor | None = None
        """Errors of the blocks when the judge looked last, shape [B]."""
        held = sum(map(len, self.blocks))
        self.judging = held >= MIN_BLOCKS and ends < c.steps
        if self.judging:
            self._hide_blocks()
            pixels = sum(len(b) * b.side**2 for b in self.blocks) / sum(v.camera.width * v.camera.height for v in self.views)
            self.notes.append(
                f"adaptive: {held} blocks, {pixels:.1%} of the pixels, are held out until growth ends, by step {ends}"
            )
        else:
            few = f"the pictures hold only {held} blocks" if held < MIN_BLOCKS else "growth lasts to the end of the fit"
            self.notes.append(f"adaptive: no judge, since {few}; the fit is as with --no-adaptive")

    def _hide_blocks(self) -> None:
        self.views = [hide(v, b) for v, b in zip(self.whole, self.blocks)]
        self._plan()

    @property
    def _growth_ends(self) -> int:
        """Steps done when growth ends by schedule."""
        return super()._densify_until

    @property
    def _densify_until(self) -> int:
        ends = self._growth_ends
        return ends if self.closed is None else min(ends, self.closed - 1)

    def _phase(self, step: int) -> Phase:
        """As the fit has it, but the highest degree comes into use when growth begins: else nothing would speak for it."""
        phase, highest = super()._phase(step), self.config.init.max_sh_degree
        if not self.judging or highest == 0:
            return phase
        every = max(1, min(self.config.sh_every, self.marks[0] // highest))
        return dataclasses.replace(phase, degree=sh_degree(step, every, highest))

    def _samples_after(self, step: int) -> bool:
        return super()._samples_after(step) and (self.closed is None or step < self.closed)

    def _settings(self, step: int) -> tuple[float, int]:
        """As the fit has it, but of a trimmed model no fewer Gaussians are shown than would have been of the whole one.

        Hiding some teaches the others to stand in for them, and what could be spared that way has gone.
        """
        probability, number = super()._settings(step)
        kept = math.prod(t["after"] / t["before"] for t in self.trims)
        return max(0.0, 1 - (1 - probability) / kept), number

    def _holds_out_after(self, step: int) -> bool:
        return self.judging and self.closed is None and step in self.marks

    def _trims_after(self, step: int) -> bool:
        c = self.config.holdout
        if self.closed is None or not c.trim_db > 0:
            return False
        rest = self.config.steps - self.closed
        return step in {self.closed + round(k * rest / c.trims) for k in range(1, c.trims + 1)}

    def _changes_after(self, step: int) -> bool:
        return super()._changes_after(step) or self._holds_out_after(step) or self._trims_after(step)

    def _change_set(self, phase: Phase) -> None:
        if self._holds_out_after(self.step):
            self._hold_out()
        super()._change_set(phase)
        if self._trims_after(self.step):
            self._trim()

    def _refine(self, phase: Phase) -> None:
        """Refine as the fit does, but never what one view alone sees, nor what is as fine as a pixel."""
        if self.judging:
            self._observe()
        super()._refine(phase)

    @property
    def _view_set(self) -> compress.ViewSet:
        return compress.ViewSet([v.camera for v in self.whole], self._options(), self.config.seed)

    def _options(self) -> RasterizeOptions:
        degree = self._phase(self.step).degree
        return RasterizeOptions(rule=self.config.rule, sh_degree=degree, background=self.background, max_instances=self.most)

    def _errors(self, gaussians: Gaussians) -> torch.Tensor:
        return block_errors(gaussians, self.whole, self.blocks, self._options())

    def _observe(self) -> None:
        """Limit every Gaussian to what the views can tell of it, and take growth from what one view alone sees."""
        bounds, seen = self.optimizer.bounds, self._view_set.coverage(self.gaussians)
        bounds.set_footprint(seen.footprint)
        bounds.degree = torch.minimum(bounds.degree, seen.supported_degree().to(torch.int32))
        bounds.enforce(self.optimizer.params)
        if len(self.views) > 1:
            self.stats.gradient = torch.where(seen.views > 1, self.stats.gradient, 0)
        finest = self.gaussians.log_scales.amax(1) <= bounds.floor
        self.stats.gradient = torch.where(finest, 0, self.stats.gradient)
        self.graphs.clear()

    def _hold_out(self) -> None:
        """Look at the held-out blocks; end growth where the last level bought less than its noise, or where its time is up."""
        c, bounds = self.config.holdout, self.optimizer.bounds
        last = max((m for m in self.marks if m < self.step), default=self.step)
        if last < self.step < self.marks[-1] and not any(
            super(AdaptiveFit, self)._changes_after(s) for s in range(last, self.step)
        ):
            return  # nothing could have grown
        errors = self._errors(self.gaussians)
        if self.before is not None:
            old = bounds.level < bounds.growing
            hidden = self._errors(compress.rows_of(self.gaussians, old)) if bool(old.any()) and not bool(old.all()) else errors
            fall, own = gain(self.before, errors), gain(hidden, errors)
            least: Gain = min(fall, own, key=lambda g: g.mean)
            count = len(self.gaussians)
            self.levels.append(Level(self.step, count, decibels(errors), fall.mean, own.mean, least.mean, least.noise))
            if least.upper_bound_below(c.least_db, c.noise):
                self.why = (
                    f"level {len(self.levels)} bought {least.mean:+.3f} dB on the held-out blocks, which with {c.noise:g} x "
                    f"its noise of {least.noise:.3f} dB is less than {c.least_db:g} dB"
                )
                if bool(old.all()):
                    self.why = f"no Gaussian came with level {len(self.levels)}: there is no room, or nothing to add"
                self._close()
                return
            if self.step == self.marks[-1]:
                self.why = f"its time was up: level {len(self.levels)} still bought {least.mean:+.3f} dB"
                self._close()
                return
        self.before = errors
        bounds.growing += 1

    def _close(self) -> None:
        """End growth: no harmonics but those that held-out evidence asks for, and all pixels are trained on from here on."""
        c, bounds = self.config.holdout, self.optimizer.bounds
        self.closed = self.step
        self._catch_up()
        self._observe()
        if c.degrees:
            base = self._errors(self.gaussians)
            bounds.degree = compress.needed_degrees(
                self.gaussians, bounds.degree, self._view_set,
                lambda model: gain(base, self._errors(model)).cost_below(c.keep_db, c.noise),
            )  # fmt: skip
        bounds.enforce(self.optimizer.params)
        self.stats = type(self.stats)(len(self.gaussians), self.device)
        self.graphs.clear()
        self.views = self.whole
        self._plan()
        self.messages.append(
            f"adaptive: growth ended at step {self.step} with {len(self.gaussians):,} Gaussians, because {self.why}; all "
            f"pixels are trained on from here"
        )

    @torch.no_grad()
    def _view_psnr(self, gaussians: Gaussians) -> float:
        """Mean over the training views of the PSNR over the pixels that count, the judge's floor included [dB]."""
        options = self._options()
        errors = [masked_mse(rasterize(gaussians, v.camera, options).rgb, v.image, v.mask).double() for v in self.whole]
        return float((-10 * torch.log10(torch.stack(errors) + FLOOR)).mean())

    def _psnr_budget(self, psnr: float) -> float:
        """What a trim may take now of that PSNR on the training views [dB]; 0 before the last step of a fit far from enough.

        That is `holdout.trim_db`, less below enough; what the fit has beyond enough; and before the last step what training is
        expected to mend.
        """
        c, last = self.config.holdout, self.step == self.config.steps
        over = psnr - c.enough_db
        if last:
            return c.trim_db + max(over, 0.0)
        fraction = 1 + over / NEAR
        if not fraction > 0:
            return 0.0
        mended = psnr - self.trims[-1]["psnr"][1] if self.trims else 0.0
        return min(fraction, 1.0) * c.trim_db + max(over, 0.0) + MENDED_AGAIN * max(mended, 0.0)

    def _trim(self) -> None:
        """Make the model smaller, within what the fit can spare on its training views."""
        bounds, whole, before = self.optimizer.bounds, self._view_psnr(self.gaussians), len(self.gaussians)
        spare = self._psnr_budget(whole)
        if spare == 0:
            return
        made = compress.prune_model(
            self.gaussians,
            self.layers.level,
            self._view_set,
            lambda g, fraction: self._view_psnr(g) >= whole - fraction * spare,
        )
        old = torch.arange(before, device=self.device)
        first = old.new_full((len(made.degrees),), before)
        went = made.into >= 0
        first = first.scatter_reduce(0, made.into[went], old[went], "amin")  # age and layer of what was merged: its first's
        nothing = {n: t[:0] for n, t in self.gaussians.tensors().items()}
        moments = self.optimizer.means | {}, self.optimizer.squares | {}
        self._apply(DensityUpdate(first, nothing, first[:0]), COARSE, NOT_SAMPLED)
        self.optimizer.means, self.optimizer.squares = moments
        self.optimizer.regroup(made.gaussians, made.into)
        bounds.degree = made.degrees
        self._observe()
        after = self._view_psnr(self.gaussians)
        self.trims.append({"step": self.step, "before": before, "after": len(made.degrees), "psnr": [whole, after]})
        self.messages.append(
            f"adaptive: trimmed at step {self.step} from {before:,} to {len(made.degrees):,} Gaussians for "
            f"{whole - after:.3f} dB on the training views"
        )

    def _catch_up(self) -> None:
        """Give the blocks, where nothing was sampled so far, as many fine Gaussians a pixel as there are elsewhere."""
        c, pixels = self.config, sum(v.image[..., 0].numel() for v in self.whole)
        held = sum(len(b) * b.side**2 for b in self.blocks)
        fraction = int(self.layers.fine.sum()) / (pixels - held) * held / pixels
        if not c.method.events or not fraction * pixels >= 1:
            return
        sampler = dataclasses.replace(c.method.sampler, fraction=min(1.0, fraction), max_fraction=1e6)
        blocks = [only(v, b) for v, b in zip(self.whole, self.blocks)]
        for first in range(0, len(blocks), MAX_VIEWS):
            event = sampling_event(
                self.gaussians, self.layers, blocks[first : first + MAX_VIEWS], dataclasses.replace(c.method, sampler=sampler),
                step=self.step, capacity=self._room_for - len(self.optimizer.gaussians), rule=c.rule,
                background=self.background, generator=self.generator, max_instances=self.most,
            )  # fmt: skip
            self._apply(event.change, FINE, self.step)

    def state(self) -> tuple[dict[str, torch.Tensor], dict]:
        """As the fit's, with what the judge knows."""
        tensors, plain = super().state()
        if self.before is not None:
            tensors["holdout.before"] = self.before
        holdout = {
            "closed": self.closed, "why": self.why, "levels": [asdict(x) for x in self.levels], "trims": self.trims,
            "growing": self.optimizer.bounds.growing,
        }  # fmt: skip
        return tensors, plain | {"holdout": holdout}

    def load(self, tensors: dict[str, torch.Tensor], plain: dict) -> None:
        """Take over what `state` gave."""
        holdout = plain["holdout"]
        self.closed, self.why, self.trims = holdout["closed"], holdout["why"], holdout["trims"]
        self.levels = [Level(**x) for x in holdout["levels"]]
        self.before = tensors.get("holdout.before")
        self.optimizer.bounds.growing = holdout["growing"]
        if self.closed is not None:
            self.views = self.whole
        super().load(tensors, plain)


def fit_class(config: FitConfig) -> type[Fit]:
    """The kind of fit that a configuration asks for."""
    return AdaptiveFit if config.adaptive else Fit


def complexity_figures(fit: Fit) -> dict:
    """What metrics.json says of the size of a model: ``complexity`` with Gaussians, mean degree, bytes, levels of growth."""
    bounds = fit.optimizer.bounds
    degrees = compress.stored_degrees(fit.gaussians.sh) if bounds is None else bounds.degree
    figures = {
        "count": len(degrees), "mean_degree": float(degrees.double().mean()), "bytes": model_bytes(degrees),
        "cap": fit.config.density.max_gaussians, "adaptive": isinstance(fit, AdaptiveFit) and fit.judging,
    }  # fmt: skip
    if not figures["adaptive"]:
        return {"complexity": figures | {"why": "growth ended by schedule", "marginal_db": None}}
    last = fit.levels[-1] if fit.levels else None
    return {"complexity": figures | {
        "why": fit.why, "marginal_db": last and last.gain, "closed": fit.closed, "levels": [asdict(x) for x in fit.levels],
        "trims": fit.trims,
    }}  # fmt: skip


def complexity_summary(figures: dict) -> str:
    """One line for people from the figures of `complexity_figures`."""
    from warpgs.runtime.byte_units import format_bytes

    f = figures["complexity"]
    text = f"{f['count']:,} Gaussians of mean SH degree {f['mean_degree']:.2f}, {format_bytes(f['bytes'])} uncompressed"
    if f["marginal_db"] is not None:
        text += f"; the last level bought {f['marginal_db']:+.3f} dB on held-out blocks"
    return f"{text}; growth stopped because {f['why']}" if f["adaptive"] else f"{text}; {f['why']}"
