"""When a fit stops: scores of held-out blocks of pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any

import torch

from warpgs import schema
from warpgs.errors import DataError
from warpgs.pipeline.metrics.scores import psnr_of
from warpgs.pipeline.model.table import DensityUpdate
from warpgs.pipeline.train.strategies.base import Strategy, StrategyContext
from warpgs.pipeline.train.views import TrainingView
from warpgs.process import Detail
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Gaussians
from warpgs.schema import Checked, Within

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


@dataclass(frozen=True)
class Blocks:
    """Held-out squares of one view."""

    side: int
    """Width and height [px]."""
    corners: torch.Tensor
    """Row and column of the first pixel of each block, int64 on the CPU, shape [B, 2]; no two blocks overlap."""

    def __len__(self) -> int:
        """Return the number of squares."""
        return len(self.corners)

    def pixels(self, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
        """Return rows and columns of all pixels, int64, each of shape [B, side, side] once broadcast."""
        along = torch.arange(self.side, device="cpu")
        rows, columns = (self.corners[:, i, None] + along for i in range(2))
        return rows[:, :, None].to(device), columns[:, None, :].to(device)


def sample_blocks(views: list[TrainingView], fraction: float, seed: int) -> list[Blocks]:
    """Sample squares of a random grid in every view, about ``fraction`` of its pixels; each square is mostly unmasked.

    In small images the fraction is larger, see `MAX_FRACTION`.
    """
    found = []
    for number, view in enumerate(views):
        generator = torch.Generator().manual_seed((seed << 16) + number)
        height, width = view.image.shape[:2]
        short = min(height, width)
        side = max(1, min(max(SIDES[0], min(SIDES[1], round(short / 16))), short // 8))
        first = torch.stack([torch.randint(n % side + 1, (), generator=generator, device="cpu") for n in (height, width)])
        rows, columns = (torch.arange(n // side, device="cpu") for n in (height, width))
        cells = torch.cartesian_prod(rows, columns) * side + first
        if view.mask is not None:
            rows, columns = Blocks(side, cells).pixels(view.mask.device)
            cells = cells[(view.mask[rows, columns].mean((1, 2)) > 0.5).cpu()]
        least = min(math.ceil(MIN_BLOCKS / len(views)), int(MAX_FRACTION * len(cells)))
        wanted = min(len(cells), max(1, least, round(fraction * len(cells))))
        chosen = torch.randperm(len(cells), generator=generator, device="cpu")[:wanted].sort().values
        found.append(Blocks(side, cells[chosen]))
    return found


def rendered(gaussians: Gaussians, view: TrainingView, options: RasterizeOptions) -> torch.Tensor:
    """Return the colours of a model as a training view shows them, shape [H, W, 3]."""
    return view.seen(rasterize(gaussians, view.camera, options).rgb)


def hide(view: TrainingView, blocks: Blocks) -> TrainingView:
    """Return the view with a mask that leaves out the blocks."""
    mask = torch.ones_like(view.image[..., 0]) if view.mask is None else view.mask.clone()
    mask[blocks.pixels(mask.device)] = 0
    return replace(view, mask=mask)


def only(view: TrainingView, blocks: Blocks) -> TrainingView:
    """Return the view with a mask that leaves out all but the blocks."""
    mask = torch.zeros_like(view.image[..., 0])
    mask[blocks.pixels(mask.device)] = 1
    return replace(view, mask=mask if view.mask is None else mask * view.mask)


@torch.no_grad()
def block_errors(
    gaussians: Gaussians, views: list[TrainingView], blocks: list[Blocks], options: RasterizeOptions
) -> torch.Tensor:
    """Return the mean squared error of every block over its unmasked pixels, float64 on the CPU, shape [B] over all views.

    Args:
        gaussians: The model.
        views: Views without the masks of `hide`.
        blocks: Blocks of each view.
        options: Settings of the rasterizer.
    """
    errors = []
    for view, held in zip(views, blocks, strict=True):
        if len(held) == 0:
            continue
        difference = (rendered(gaussians, view, options).clamp(0, 1) - view.image).square().mean(2)
        where = held.pixels(difference.device)
        weights = torch.ones_like(difference) if view.mask is None else view.mask
        errors.append(((difference * weights)[where].sum((1, 2)) / weights[where].sum((1, 2))).double().cpu())
    return torch.cat(errors) if errors else torch.zeros(0, dtype=torch.float64, device="cpu")


def decibels(errors: torch.Tensor) -> float:
    """Return the PSNR [dB] of the mean of block errors [B], including the error floor; NaN without blocks."""
    return psnr_of(float(errors.mean()) + FLOOR) if len(errors) else math.nan


@dataclass(frozen=True)
class Gain:
    """Gain of a change on the left-out blocks."""

    mean: float
    """Mean decrease of the error of a block [dB]."""
    noise: float
    """Standard error of ``mean`` [dB]; infinite with fewer than two blocks. Blocks of a view are not independent, so the true
    error may be larger."""

    def upper_bound_below(self, least: float, noises: float) -> bool:
        """Return whether the mean plus ``noises`` standard errors is below ``least`` [dB]; True for a gain that is NaN.

        With few blocks the noise is large, so a fit whose gain is uncertain continues.
        """
        return not self.mean + noises * self.noise >= least


def gain(before: torch.Tensor, after: torch.Tensor) -> Gain:
    """Compute the gain from the errors of blocks before and after a change, shape [B] each.

    The gain of a block is ten times the decimal logarithm of the ratio of its errors, with the floor added to both.
    """
    each = 10 * torch.log10((before + FLOOR) / (after + FLOOR))
    count = len(each)
    if count == 0:
        return Gain(math.nan, math.inf)
    return Gain(float(each.mean()), float(each.std() / math.sqrt(count)) if count > 1 else math.inf)


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
    0.1, or 0 if --cpu-limit shortens the fit."""


@dataclass(frozen=True)
class Measurement:
    """Left-out blocks at one time, and their gain since the previous measurement; plain values for metrics.json."""

    step: int
    """Steps done."""
    count: int
    """Gaussians at that step."""
    held_out_psnr: float
    """PSNR of the left-out blocks, including the error floor [dB]."""
    gain: float
    """Mean decrease of the blocks' error since the previous measurement, by growth and training together [dB]."""
    noise: float
    """Standard error of ``gain`` over the blocks [dB]."""


_COUNT = schema.whole(0)
_MEASUREMENT = {f.name: _COUNT if f.name in ("step", "count") else schema.real for f in fields(Measurement)}
STATE = schema.fields({
    "ended": schema.or_null(_COUNT), "why": schema.text, "measured": schema.items(_COUNT),
    "measurements": schema.items(schema.fields(_MEASUREMENT, others=False)),
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
        self.measurements: list[Measurement] = []
        """All measurements except the first, which has no gain."""
        self.whole: list[TrainingView] = []
        """Views without hidden blocks; empty if nothing is held out."""
        self.blocks: list[Blocks] = []
        """Held-out blocks of each view."""
        self.marks: list[int] = []
        """Steps done when the blocks are measured: when growth begins, and after each interval."""
        self.earliest = 0.0
        """Last step in which views have half size. Growth ends after it at the earliest."""
        self.measured: list[tuple[int, torch.Tensor]] = []
        """For every measurement, the steps done and the errors of the blocks [B]."""

    def begin(self, context: StrategyContext, strategy: Strategy, half_resolution: float) -> list[str]:
        """Choose the blocks and the times of measurements, and return notes for the user.

        Args:
            context: Parts of the fit, with its views.
            strategy: Density strategy.
            half_resolution: Fraction of the planned steps, from the first step on, in which views have half size.
        """
        assert self.config.min_gain_db is not None  # `settings_by_views` has chosen
        if self.config.min_gain_db == 0:
            return []
        planned, (begins, ends, times) = context.phases.planned, strategy.growth()
        self.earliest = half_resolution * planned
        count = MEASUREMENTS
        marks = {max(1, begins + round(k * (ends - begins) / count)) for k in range(count + 1)}
        if times:
            marks = {next((t for t in times if t >= m), ends) for m in marks}
        self.marks, self.blocks = sorted(marks), sample_blocks(context.views, FRACTION, context.seed)
        held = sum(map(len, self.blocks))
        self.active = held >= MIN_BLOCKS and ends < planned and len(marks) > 1
        if not self.active:
            few = f"the images have only {held} blocks" if held < MIN_BLOCKS else "growth lasts to the end of the fit"
            return [Detail(f"early stopping is off, because {few}; the fit takes all its steps")]
        self.whole = context.views
        pixels = self.held_pixels / sum(v.camera.width * v.camera.height for v in self.whole)
        return [Detail(f"stopping: {held} blocks, {pixels:.1%} of the pixels, are left out until growth ends, by step {ends}")]

    @property
    def held_pixels(self) -> int:
        """Number of pixels in all blocks."""
        return sum(len(b) * b.side**2 for b in self.blocks)

    def hidden(self) -> list[TrainingView]:
        """Return the views with their held-out blocks masked."""
        return [hide(v, b) for v, b in zip(self.whole, self.blocks)]

    def sh_every(self, every: int, highest: int) -> int:
        """Return the steps between rises of the degree, at most ``every``, so that ``highest`` is in use when growth begins."""
        if not self.active or highest == 0:
            return every
        return max(1, min(every, self.marks[0] // highest))

    def due(self, step: int) -> bool:
        """Return whether the blocks are measured after a step."""
        return self.active and self.ended is None and step in self.marks

    def changes(self, step: int, strategy: Strategy, context: StrategyContext, degree: int) -> Iterator[DensityUpdate]:
        """Yield the strategy's changes of the Gaussians after a step, and its last changes when growth ends.

        Args:
            step: Steps done.
            strategy: Density strategy.
            context: Parts of the fit; when growth ends, the fit's third phase begins.
            degree: Degree of the harmonics in use.
        """
        if self.due(step) and self._measured(step, strategy, context, degree):
            self.ended, ends = step, strategy.growth().ends
            if step < ends:
                context.phases = context.phases.stable_from(step, ends)
            yield from strategy.catch_up(step, [only(v, b) for v, b in zip(self.whole, self.blocks)], self.held_pixels)
        if self.ended is None and strategy.due(step):
            yield from strategy.update(step)

    def _measured(self, step: int, strategy: Strategy, context: StrategyContext, degree: int) -> bool:
        """Measure the blocks if the set changed since the previous mark, and at the last mark; return whether growth ends."""
        last = max((m for m in self.marks if m < step), default=step)
        if last < step < self.marks[-1] and not any(strategy.due(s) for s in range(last, step)):
            return False
        options = replace(context.render_options(), sh_degree=degree)
        errors = block_errors(context.gaussians, self.whole, self.blocks, options)
        if self.measured:
            found, psnr = gain(self.measured[-1][1], errors), decibels(errors)
            self.measurements.append(Measurement(step, len(context.table), psnr, found.mean, found.noise))
            self.why = self._reason(step, errors)
        self.measured.append((step, errors))
        return self.why != ""

    def _reason(self, step: int, errors: torch.Tensor) -> str:
        """Return why growth ends after a step with these errors of the blocks [B]; empty if growth continues."""
        c = self.config
        assert c.min_gain_db is not None
        since, earlier = next((m for m in reversed(self.measured) if m[0] * LATELY <= step), (0, None))
        lately = Gain(math.inf, 0.0) if earlier is None or self._is_early(step) else gain(earlier, errors)
        if lately.upper_bound_below(c.min_gain_db, NOISES):
            return (
                f"left-out pixels no longer improve ({lately.mean:+.3f} dB in the last {step - since:,} steps, noise "
                f"{lately.noise:.3f} dB)"
            )
        if step == self.marks[-1]:
            return f"all its planned steps are done ({self.measurements[-1].gain:+.3f} dB since the previous measurement)"
        return ""

    def _is_early(self, step: int) -> bool:
        """Return whether it is too early to end growth: in the first third of its time, or while views are half their size."""
        return 3 * step < self.marks[-1] or step <= self.earliest

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Return the errors of the blocks at every measurement, shape [M, B], and plain values, for resuming."""
        tensors = {"stopping.measured": torch.stack([e for _, e in self.measured])} if self.measured else {}
        return tensors, {
            "ended": self.ended, "why": self.why, "measured": [s for s, _ in self.measured],
            "measurements": [asdict(m) for m in self.measurements],
        }  # fmt: skip

    def load(self, tensors: Mapping[str, torch.Tensor], plain: dict[str, Any]) -> None:
        """Load what `state` returned, ``tensors`` of shape [...] by name.

        Raises:
            DataError: The errors do not belong to these blocks.
        """
        shape = (len(plain["measured"]), sum(map(len, self.blocks)) if self.active else 0)
        measured = tensors.get("stopping.measured", torch.zeros(0, shape[1], dtype=torch.float32, device="cpu"))
        if measured.shape != shape:
            raise DataError(
                f"the stored errors of the left-out blocks have shape {list(measured.shape)}, not {list(shape)}; fit again"
            )
        self.ended, self.why = plain["ended"], plain["why"]
        self.measurements = [Measurement(**m) for m in plain["measurements"]]
        self.measured = list(zip(plain["measured"], measured))

    def figures(self) -> dict[str, Any]:
        """Return the reason why growth ended and the measurements, for metrics.json; empty if nothing was held out."""
        if not self.active:
            return {}
        return {
            "held_out": True, "why": self.why, "ended": self.ended,
            "marginal_db": self.measurements[-1].gain if self.measurements else None,
            "measurements": [asdict(m) for m in self.measurements],
        }  # fmt: skip
