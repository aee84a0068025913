"""When a fit stops: scores of held-out blocks of pixels."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Any

import torch
from torch import Tensor

from warpgs.errors import DataError
from warpgs.pipeline.metrics.scores import psnr_of
from warpgs.pipeline.model.table import DensityUpdate
from warpgs.pipeline.train.strategies.base import Growth, Strategy, StrategyContext, changes_of
from warpgs.pipeline.train.views import TrainingView
from warpgs.plugins import returned
from warpgs.process import Detail
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Gaussians, Tensors
from warpgs.schema import Checked, Within, fields, items, or_null, real, text, whole

# Held-out blocks of pixels; the gain on these blocks, compared with its noise, ends a fit early (docs/decisions/020).
#
# VGNC (arXiv 2504.14548) chooses the number of Gaussians by validation views from a generative network; here pixels are
# held out.

FLOOR = (2 / 255) ** 2
"""Constant that is added to the mean squared error of every block, so that errors below two levels of an 8-bit photograph have
little effect."""
SIDES = 16, 32
"""Bounds of the side of a block [px]. The side is a sixteenth of the image's shorter side, within these bounds, and at most an
eighth of that side."""
MIN_BLOCKS = 12
"""Smallest number of blocks over all views for a significant gain."""
MAX_FRACTION = 0.1
"""Largest fraction of the pixels that may be held out in small images to reach `MIN_BLOCKS`, even if less was requested."""


Blocks = tuple[Tensor, Tensor]
"""Rows [B, side, 1] and columns [B, 1, side] of the pixels of squares of one view, int64 on its device; no two overlap."""


def sample_blocks(views: list[TrainingView], fraction: float, seed: int) -> list[Blocks]:
    """Sample squares of a random grid in every view, about ``fraction`` of its pixels; each square is mostly unmasked.

    In small images the fraction is larger, see `MAX_FRACTION`.
    """
    sampled = []
    for number, view in enumerate(views):
        generator = torch.Generator().manual_seed((seed << 16) + number)
        height, width = view.image.shape[:2]
        short = min(height, width)
        side = max(1, min(max(SIDES[0], min(SIDES[1], round(short / 16))), short // 8))
        first = torch.stack([torch.randint(n % side + 1, (), generator=generator, device="cpu") for n in (height, width)])
        grid = torch.cartesian_prod(*(torch.arange(n // side, device="cpu") for n in (height, width)))
        rows, columns = ((grid * side + first)[:, :, None] + torch.arange(side, device="cpu")).to(view.image.device).unbind(1)
        rows, columns = rows[:, :, None], columns[:, None, :]
        if view.mask is not None:
            shown = view.mask[rows, columns].mean((1, 2)) > 0.5
            rows, columns = rows[shown], columns[shown]
        least = min(math.ceil(MIN_BLOCKS / len(views)), int(MAX_FRACTION * len(rows)))
        wanted = min(len(rows), max(1, least, round(fraction * len(rows))))
        chosen = torch.randperm(len(rows), generator=generator, device="cpu")[:wanted].sort().values.to(rows.device)
        sampled.append((rows[chosen], columns[chosen]))
    return sampled


def rendered(gaussians: Gaussians, view: TrainingView, options: RasterizeOptions) -> Tensor:
    """Return the colours of a model as a training view shows them, shape [H, W, 3]."""
    return view.seen(rasterize(gaussians, view.camera, options).rgb)


def masked(view: TrainingView, blocks: Blocks, *, inside: bool) -> TrainingView:
    """Return the view with a mask that leaves out all pixels but those inside of blocks, or outside of them."""
    mask = torch.full_like(view.image[..., 0], not inside)
    mask[blocks] = inside
    return replace(view, mask=mask if view.mask is None else mask * view.mask)


@torch.no_grad()
def block_errors(gaussians: Gaussians, views: list[TrainingView], blocks: list[Blocks], options: RasterizeOptions) -> Tensor:
    """Return the mean squared error of every block over its unmasked pixels, float64 on the CPU, shape [B] over all views."""
    errors = [torch.zeros(0, dtype=torch.float64, device="cpu")]
    for view, held in zip(views, blocks, strict=True):
        if len(held[0]):
            difference = (rendered(gaussians, view, options).clamp(0, 1) - view.image).square().mean(2)
            weights = torch.ones_like(difference) if view.mask is None else view.mask
            errors.append(((difference * weights)[held].sum((1, 2)) / weights[held].sum((1, 2))).double().cpu())
    return torch.cat(errors)


def decibels(errors: Tensor) -> float:
    """Return the PSNR [dB] of the mean of block errors [B], including the error floor; NaN without blocks."""
    return psnr_of(float(errors.mean()) + FLOOR) if len(errors) else math.nan


def gain(before: Tensor, after: Tensor) -> tuple[float, float]:
    """Return the mean decrease of the errors of blocks [B] by a change, and its standard error [dB].

    The gain of a block is ten times the decimal logarithm of the ratio of its errors, with the floor added to both. The
    standard error is infinite with fewer than two blocks; blocks of a view are not independent, so it may be too small.
    """
    each = 10 * torch.log10((before + FLOOR) / (after + FLOOR))
    count = len(each)
    return float(each.mean()) if count else math.nan, float(each.std() / math.sqrt(count)) if count > 1 else math.inf


def falls_short(mean: float, noise: float, least: float) -> bool:
    """Return whether a gain plus its noise is below ``least`` [dB]; a NaN is, while a gain of few blocks hardly ever is."""
    return not mean + NOISES * noise >= least


LATELY = 1.5
"""A gain compares the present step with the latest measurement at or before this step divided by `LATELY`: it covers at least
the last third of the steps."""


FRACTION = 0.03
"""Fraction of the pixels that are left out, in blocks, until growth ends (docs/decisions/020-early-stopping-and-pruning.md)."""
MEASUREMENTS = 12
"""Number of equal intervals of the growth phase; the blocks are measured after each interval."""
NOISES = 1.0
"""Number of standard errors that are added to the gain, which is a mean over the blocks."""


@dataclass(frozen=True)
class StoppingConfig(Checked, group="stopping."):
    """Settings of early stopping."""

    min_gain_db: Annotated[float | None, Within(0, math.inf, ")")] = 0.0
    """Growth, the phase that adds Gaussians, ends when the gain of the left-out blocks over at least the last third of the
    steps, plus its standard error, is below this [dB]. The rest of the fit is then shortened in proportion. Growth does not end
    in its first third, nor while views have half size. 0: no blocks are left out, and the fit takes the planned steps. None:
    0.1; or 0 if --cpu-limit shortens the fit, for objects on black, or if views have half size until growth ends (quick)."""


_COUNT = whole(0)
STATE = fields({
    "ended": or_null(_COUNT), "why": text, "measured": items(_COUNT),
    "measurements": items(fields({
        "step": _COUNT, "count": _COUNT, "held_out_psnr": real, "gain": real, "noise": real,
    }, others=False)),
})  # fmt: skip
"""Schema of the plain values in a checkpoint."""


class Stopping:
    """Held-out blocks of the training views, and the decision to end growth by their error.

    Until growth ends, blocks of every view are held out of the loss and of sampling; afterwards all pixels are used. The start
    uses whole images: the blocks measure growth, not the start.
    """

    def __init__(self, config: StoppingConfig):
        """Begin with nothing held out."""
        self.config = config
        self.active = False
        """True if blocks are held out and measured."""
        self.ended: int | None = None
        """Steps done when growth ended; None before."""
        self.why = ""
        """Reason why growth ended, for the user."""
        self.measurements: list[dict[str, Any]] = []
        """All measurements except the first, for metrics.json: steps done, Gaussians, PSNR of the blocks with the error floor
        [dB], and the gain of growth and training together since the previous measurement, with its noise [dB]."""
        self.whole: list[TrainingView] = []
        """Views without hidden blocks; empty if nothing is held out."""
        self.blocks: list[Blocks] = []
        """Held-out blocks of each view."""
        self.marks: list[int] = []
        """Steps done when the blocks are measured: when growth begins, and after each interval."""
        self.earliest = 0.0
        """Last step in which views have half size. Growth ends after it at the earliest."""
        self.measured: list[tuple[int, Tensor]] = []
        """For every measurement, the steps done and the errors of the blocks [B]."""

    def begin(self, context: StrategyContext, strategy: Strategy, half_resolution: float) -> list[str]:
        """Choose the blocks and the times of measurements, and return notes; the first steps have views of half size."""
        if self.config.min_gain_db == 0:
            return []
        begins, ends, times = returned(strategy, "growth", strategy.growth(), Growth, "a Growth")
        planned = context.phases.planned
        self.earliest = half_resolution * planned
        marks = {max(1, begins + round(k * (ends - begins) / MEASUREMENTS)) for k in range(MEASUREMENTS + 1)}
        if times:
            marks = {next((t for t in times if t >= m), ends) for m in marks}
        self.marks, self.blocks = sorted(marks), sample_blocks(context.views, FRACTION, context.seed)
        held = self.held
        self.active = held >= MIN_BLOCKS and ends < planned and len(marks) > 1
        if not self.active:
            few = f"the images have only {held} blocks" if held < MIN_BLOCKS else "growth lasts to the end of the fit"
            return [Detail(f"early stopping is off, because {few}; the fit takes all its steps")]
        self.whole = context.views
        pixels = self.held_pixels / sum(v.camera.width * v.camera.height for v in self.whole)
        return [Detail(f"stopping: {held} blocks, {pixels:.1%} of the pixels, are left out until growth ends, by step {ends}")]

    @property
    def held(self) -> int:
        """Number of blocks."""
        return sum(len(rows) for rows, _ in self.blocks)

    @property
    def held_pixels(self) -> int:
        """Number of pixels in all blocks."""
        return sum(rows.numel() * rows.shape[1] for rows, _ in self.blocks)

    def hidden(self) -> list[TrainingView]:
        """Return the views with their held-out blocks masked."""
        return [masked(v, b, inside=False) for v, b in zip(self.whole, self.blocks)]

    def sh_every(self, every: int, highest: int) -> int:
        """Return the steps between rises of the degree, at most ``every``, so that ``highest`` is in use when growth begins."""
        return max(1, min(every, self.marks[0] // highest)) if self.active and highest else every

    def due(self, step: int) -> bool:
        """Return whether the blocks are measured after a step."""
        return self.active and self.ended is None and step in self.marks

    def changes(self, step: int, strategy: Strategy, context: StrategyContext, degree: int) -> Iterator[DensityUpdate]:
        """Yield the strategy's changes after a step, with its last additions when growth ends and the third phase begins."""
        if self.due(step) and self._measured(step, strategy, context, degree):
            self.ended, ends = step, strategy.growth().ends
            if step < ends:
                context.phases = context.phases.stable_from(step, ends)
            held = [masked(v, b, inside=True) for v, b in zip(self.whole, self.blocks)]
            yield from changes_of(strategy, "catch_up", strategy.catch_up(step, held, self.held_pixels))
        if self.ended is None and strategy.due(step):
            yield from changes_of(strategy, "update", strategy.update(step))
        if strategy.prunes(step):
            yield from changes_of(strategy, "prune", strategy.prune(step))

    def _measured(self, step: int, strategy: Strategy, context: StrategyContext, degree: int) -> bool:
        """Measure the blocks if the set changed since the previous mark, and at the last mark; return whether growth ends."""
        last = max((m for m in self.marks if m < step), default=step)
        if last < step < self.marks[-1] and not any(strategy.due(s) for s in range(last, step)):
            return False
        options = replace(context.render_options(), sh_degree=degree)
        errors = block_errors(context.gaussians, self.whole, self.blocks, options)
        if self.measured:
            mean, noise = gain(self.measured[-1][1], errors)
            count, psnr = len(context.table), decibels(errors)
            self.measurements.append({"step": step, "count": count, "held_out_psnr": psnr, "gain": mean, "noise": noise})
            self.why = self._reason(step, errors)
        self.measured.append((step, errors))
        return self.why != ""

    def _reason(self, step: int, errors: Tensor) -> str:
        """Return why growth ends after a step with these errors of the blocks [B]; empty if growth continues."""
        since, earlier = next((m for m in reversed(self.measured) if m[0] * LATELY <= step), (0, None))
        # in the first third of its time, or while views are half their size, it is too early
        if earlier is not None and 3 * step >= self.marks[-1] and step > self.earliest:
            mean, noise = gain(earlier, errors)
            if falls_short(mean, noise, self.config.min_gain_db):
                lately = f"{mean:+.3f} dB in the last {step - since:,} steps, noise {noise:.3f} dB"
                return f"left-out pixels no longer improve ({lately})"
        if step == self.marks[-1]:
            return f"all its planned steps are done ({self.measurements[-1]['gain']:+.3f} dB since the previous measurement)"
        return ""

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return the errors of the blocks at every measurement, shape [M, B], and plain values, for resuming."""
        tensors = {"stopping.measured": torch.stack([e for _, e in self.measured])} if self.measured else {}
        return tensors, {
            "ended": self.ended, "why": self.why, "measured": [s for s, _ in self.measured],
            "measurements": list(self.measurements),
        }  # fmt: skip

    def load(self, tensors: Tensors, plain: dict[str, Any]) -> None:
        """Load what `state` returned, or raise DataError if the errors do not belong to these blocks."""
        shape = (len(plain["measured"]), self.held if self.active else 0)
        measured = tensors.get("stopping.measured", torch.zeros(0, shape[1], dtype=torch.float32, device="cpu"))
        if measured.shape != shape:
            raise DataError(f"stored errors of left-out blocks have shape {list(measured.shape)}, not {list(shape)}; fit again")
        self.ended, self.why = plain["ended"], plain["why"]
        self.measurements = list(plain["measurements"])
        self.measured = list(zip(plain["measured"], measured))

    def figures(self) -> dict[str, Any]:
        """Return the reason why growth ended and the measurements, for metrics.json; empty if nothing was held out."""
        if not self.active:
            return {}
        return {
            "held_out": True, "why": self.why, "ended": self.ended,
            "marginal_db": self.measurements[-1]["gain"] if self.measurements else None,
            "measurements": self.measurements,
        }  # fmt: skip
