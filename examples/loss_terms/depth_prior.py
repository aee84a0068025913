"""A loss term from a prior: rendered depth that correlates with the relative depth of each training view.

    warpgs fit scene --out run --loss-terms examples/loss_terms/depth_prior.py:DepthCorrelation --depth-correlation.weight 0.05

The term is 1 - rho, where rho is Pearson's correlation of inverse rendered depth with the view's relative disparity. The term
follows the global depth loss of FSGS (Zhu et al. 2024). Differences: FSGS takes the better of two such correlations, does not
divide depth by alpha and ends with a weight of 0.001. The disparity comes from a network (--depth-model), or from the depth
sweep or flow of the start. Without a disparity, the term and its gradient are 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warpgs
from warpgs.train import LossInputs, Prior, TrainingView, register_loss_term, total

import torch

MIN_ALPHA = 0.5
"""Opacity above which the depth of a pixel is used: elsewhere the background contributes more."""
FLAT = 1e-3
"""Standard deviation at or below which a map counts as constant. The maps are a disparity in [0, 1], and mean depth divided by
depth, with values around 1. The gradient of a correlation grows with the inverse of the standard deviation."""


def centred(values: torch.Tensor, fraction: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """Return values [H, W] minus their mean over the pixels that count; 0 at other pixels."""
    mean = total(values * fraction) / pixels
    # expanded to one number per row: the gradient of a single number would be the sum of a whole tensor (see `total`)
    return (values - (mean if values.is_cuda else mean.expand(len(values), 1))) * fraction


def depth_disagreement(
    depth: torch.Tensor, alpha: torch.Tensor, disparity: torch.Tensor, mask: torch.Tensor | None
) -> torch.Tensor:
    """Compute 1 minus Pearson's correlation of rendered inverse depth with a disparity of any scale and offset.

    The pixels that count have alpha above `MIN_ALPHA` and are kept by the mask. Differentiable in ``depth`` alone. If
    either map is constant over these pixels (`FLAT`), or if no pixel counts, the correlation is undefined. Then the result is
    0, without gradient. The unit of depth does not matter from 1e-30 to 1e30 u: maps are scaled to values around 1 and centred
    before squaring.

    Args:
        depth: Expected z-depth [u], positive where alpha is, shape [H, W].
        alpha: Accumulated opacity, shape [H, W].
        disparity: Relative inverse depth in [0, 1], shape [H, W].
        mask: 1 where a pixel counts, else 0, shape [H, W]; None if all pixels count.

    Returns:
        A number in [0, 2], shape []; NaN if a pixel that counts is NaN.
    """
    counts = ~(alpha <= MIN_ALPHA)  # NaN counts, too: it must not vanish
    counts = counts if mask is None else counts & (mask > 0)
    fraction = counts.to(depth.dtype)
    pixels = fraction.sum().clamp_min(1)
    depth = torch.where(counts, depth, 1)
    mean = total(depth.detach() * fraction) / pixels
    a, b = (centred(m, fraction, pixels) for m in (mean / depth, disparity))
    of_a, of_b = total(a * a) / pixels, total(b * b) / pixels
    flat = (of_a <= FLAT**2) | (of_b <= FLAT**2)
    # roots in float64: the last digits of float32 roots depend on the processor (MKL)
    spread = torch.where(flat, 1, of_a).double().sqrt() * torch.where(flat, 1, of_b).double().sqrt()
    return torch.where(flat, 0, 1 - total(a * b) / pixels / spread.to(a.dtype))


@register_loss_term("depth_correlation")
@dataclass(frozen=True)
class DepthCorrelation(warpgs.LossTerm):
    """The weighted disagreement of rendered depth with the prior of the view, in the first part of a fit."""

    needs_outputs: ClassVar[tuple[str, ...]] = ("alpha", "depth")
    needs_priors: ClassVar[bool] = True
    weight: float = 0.05
    """Weight of the term, in [0, 1000]; 0.05 in FSGS."""
    until: float = 0.95
    """Fraction of the steps, from the first on, in which the term is active, in [0, 1]."""

    def __post_init__(self) -> None:
        if not (0 <= self.weight <= 1000 and 0 <= self.until <= 1):
            raise warpgs.UsageError(
                f"depth-correlation: weight {self.weight} must be between 0 and 1000, until {self.until} between 0 and 1"
            )

    def needs(self, view: TrainingView, prior: Prior | None) -> dict[str, torch.Tensor]:
        """Return the disparity of the view's prior, shape [H, W]."""
        assert prior is not None  # `needs_priors`
        return {"disparity": torch.as_tensor(prior.disparity, dtype=torch.float32, device=view.image.device)}

    def active(self, step: int, steps: int) -> bool:
        """Return whether the step lies in the first fraction ``until`` of all steps."""
        return step <= self.until * steps

    def __call__(self, inputs: LossInputs) -> torch.Tensor:
        """Compute ``weight`` times `depth_disagreement` of the rendered depth and the prior's disparity, shape []."""
        depth, alpha, target = inputs.outputs["depth"], inputs.outputs["alpha"], inputs.target
        return self.weight * depth_disagreement(depth, alpha, target.maps["disparity"], target.mask)
