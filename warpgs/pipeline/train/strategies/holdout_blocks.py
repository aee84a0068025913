"""Evidence for the size of a model: blocks of pixels that the loss does not see, and whether they change by more than noise.

docs/complexity.md; leaving views or pixels out to find a size is VGNC's idea (2504.14548) without its generative model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from warpgs.errors import UsageError
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.scene import Gaussians

FLOOR = (2 / 255) ** 2
"""Mean squared error that is added to every block's: below two levels of an 8-bit photograph there is nothing to explain."""
SIDES = 16, 32
"""Least and largest side of a block [px]; between them a sixteenth of the picture's shorter side. In pictures of which an
eighth is less than the least, it is that eighth."""
MAX_COST_FACTOR = 3
"""What is lost within the noise may be this many times what is allowed."""
MIN_BLOCKS = 12
"""With fewer blocks over all views there is no telling a gain from noise."""
MAX_FRACTION = 0.1
"""Small pictures hold out more than was asked for, up to this share, where it takes that to have `MIN_BLOCKS` blocks."""


@dataclass(frozen=True)
class HoldoutConfig:
    """How an adaptive fit finds its size."""

    fraction: float = 0.03
    """Part of the pixels that is held out until growth ends."""
    levels: int = 4
    """Parts of equal length that growth is judged after."""
    noise: float = 1.0
    """Standard errors of the mean gain over the blocks that count as its noise."""
    least_db: float = 0.02
    """Growth ends early where a level's gain with its noise is below this [dB]: only where it surely bought nothing."""
    degrees: bool = True
    """Each Gaussian keeps only the spherical harmonics that its views can tell apart and that the held-out blocks ask for."""
    keep_db: float = 0.1
    """PSNR that lower degrees may cost on the held-out blocks when growth ends, before the rest of the fit mends it [dB]; what
    is within the noise of that difference may go in any case."""
    trims: int = 8
    """Times that the model may be made smaller, at equal distances from the end of growth to the last step. Before the last
    only where the fit is better than `enough_db` or near it: what such a trim takes, training mends."""
    trim_db: float = 0.1
    """PSNR on the training views that a trim may take below what the fit has, or below `enough_db` where it has more [dB];
    before the last step also part of what training will probably mend. 0 for no trims."""
    enough_db: float = 36.0
    """PSNR on the training views, `FLOOR` included, that no Gaussian is spent on improving: size then follows from the content
    and not from how well a fit happened to go [dB]. The default is 37.2 dB without `FLOOR`, an error of 3.5 levels of an 8-bit
    photograph; 42.1 is no error at all, so with more every fit keeps what it has."""

    def __post_init__(self):
        if not 0 < self.fraction <= 0.5:
            raise UsageError(f"holdout fraction {self.fraction} must lie above 0 and be at most 0.5")
        if self.levels < 1 or self.trims < 1:
            raise UsageError(f"holdout: levels {self.levels} and trims {self.trims} must be at least 1")
        for name in ("noise", "least_db", "keep_db", "trim_db", "enough_db"):
            if not 0 <= getattr(self, name) < math.inf:
                raise UsageError(f"holdout {name.replace('_', '-')} must be 0 or more and finite, not {getattr(self, name)}")


@dataclass(frozen=True)
class Blocks:
    """Held-out squares of one view."""

    side: int
    """Width and height [px]."""
    corners: torch.Tensor
    """Row and column of the first pixel of each, int64 on the CPU, shape [B, 2]; no two overlap."""

    def __len__(self) -> int:
        """Number of squares."""
        return len(self.corners)

    def pixels(self, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
        """Rows and columns of all pixels, int64, each of shape [B, side, side] once broadcast."""
        along = torch.arange(self.side)
        rows, columns = (self.corners[:, i, None] + along for i in range(2))
        return rows[:, :, None].to(device), columns[:, None, :].to(device)


def sample_blocks(views: list[TrainingView], fraction: float, seed: int) -> list[Blocks]:
    """Squares of a random grid in every view, about ``fraction`` of its pixels; more than half of each counts by the mask.

    In small pictures it is more: see `MAX_FRACTION`.
    """
    found = []
    for number, view in enumerate(views):
        generator = torch.Generator().manual_seed((seed << 16) + number)
        height, width = view.image.shape[:2]
        short = min(height, width)
        side = max(1, min(max(SIDES[0], min(SIDES[1], round(short / 16))), short // 8))
        first = torch.stack([torch.randint(n % side + 1, (), generator=generator) for n in (height, width)])
        cells = torch.cartesian_prod(torch.arange(height // side), torch.arange(width // side)) * side + first
        if view.mask is not None:
            rows, columns = Blocks(side, cells).pixels(view.mask.device)
            cells = cells[(view.mask[rows, columns].mean((1, 2)) > 0.5).cpu()]
        least = min(math.ceil(MIN_BLOCKS / len(views)), int(MAX_FRACTION * len(cells)))
        wanted = min(len(cells), max(1, least, round(fraction * len(cells))))
        chosen = torch.randperm(len(cells), generator=generator)[:wanted].sort().values
        found.append(Blocks(side, cells[chosen]))
    return found


def hide(view: TrainingView, blocks: Blocks) -> TrainingView:
    """The view whose mask leaves out the blocks."""
    mask = torch.ones_like(view.image[..., 0]) if view.mask is None else view.mask.clone()
    mask[blocks.pixels(mask.device)] = 0
    return replace(view, mask=mask)


def only(view: TrainingView, blocks: Blocks) -> TrainingView:
    """The view whose mask leaves out all but the blocks."""
    mask = torch.zeros_like(view.image[..., 0])
    mask[blocks.pixels(mask.device)] = 1
    return replace(view, mask=mask if view.mask is None else mask * view.mask)


@torch.no_grad()
def block_errors(
    gaussians: Gaussians, views: list[TrainingView], blocks: list[Blocks], options: RasterizeOptions
) -> torch.Tensor:
    """Mean squared error of every block over the pixels that count, float64 on the CPU, shape [B] over all views.

    Args:
        gaussians: The model.
        views: Views with their own masks, not those of `hide`.
        blocks: Blocks of each.
        options: How to draw.
    """
    errors = []
    for view, held in zip(views, blocks, strict=True):
        if len(held) == 0:
            continue
        difference = (rasterize(gaussians, view.camera, options).rgb.clamp(0, 1) - view.image).square().mean(2)
        where = held.pixels(difference.device)
        weights = torch.ones_like(difference) if view.mask is None else view.mask
        errors.append(((difference * weights)[where].sum((1, 2)) / weights[where].sum((1, 2))).double().cpu())
    return torch.cat(errors) if errors else torch.zeros(0, dtype=torch.float64)


def decibels(errors: torch.Tensor) -> float:
    """PSNR of the mean of block errors [B], with the floor; NaN where there is no block [dB]."""
    return -10 * math.log10(float(errors.mean()) + FLOOR) if len(errors) else math.nan


@dataclass(frozen=True)
class Gain:
    """What a change bought on the held-out blocks."""

    mean: float
    """Mean over blocks of the fall of their error [dB]."""
    noise: float
    """Standard error of that mean; infinite with fewer than two blocks [dB]. Blocks of a view are not independent, so it is
    rather too small than too large."""

    def upper_bound_below(self, least: float, noises: float) -> bool:
        """Whether the mean and so many standard errors are together below ``least`` [dB]; a gain that is no number is.

        Few blocks are a weak judge: it may end growth that bought nothing, never growth of which it cannot tell.
        """
        return not self.mean + noises * self.noise >= least

    def cost_below(self, allowed: float, noises: float) -> bool:
        """Return whether no more was lost than ``allowed`` [dB], or than the noise up to `MAX_COST_FACTOR` times that.

        Without the bound few blocks would excuse anything: a large loss differs much from block to block.
        """
        return -self.mean <= max(allowed, min(noises * self.noise, MAX_COST_FACTOR * allowed))


def gain(before: torch.Tensor, after: torch.Tensor) -> Gain:
    """Paired over blocks: ten times the decimal logarithm of the ratio of their errors [B], the floor added to both."""
    each = 10 * torch.log10((before + FLOOR) / (after + FLOOR))
    count = len(each)
    if count == 0:
        return Gain(math.nan, math.inf)
    return Gain(float(each.mean()), float(each.std() / math.sqrt(count)) if count > 1 else math.inf)
