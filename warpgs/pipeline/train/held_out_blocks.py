"""Held-out blocks of pixels; the gain on these blocks, compared with its noise, ends a fit early (docs/decisions/020).

VGNC (arXiv 2504.14548) chooses the number of Gaussians by validation views from a generative network; here pixels are held out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from warpgs.pipeline.metrics.psnr import psnr_of
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Gaussians

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
