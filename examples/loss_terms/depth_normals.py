"""A loss term on normals: neighbouring pixels have similar normals, except at colour edges.

    warpgs fit scene --out run --loss-terms examples/loss_terms/depth_normals.py:NormalSmoothness --normal-smoothness.weight 0.1

The normals come from rendered depth (`warpgs.depth_normals`). The term is the mean of 1 - cos of the angle between the
normals of neighbours, with less weight at colour edges, as in Godard et al. 2017, eq. 5. The weight of the term grows over the
first steps, because depth is noisy at first.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import warpgs
from warpgs.train import LossInputs, register_loss_term, total

import torch

MIN_ALPHA = 0.5
"""Opacity above which a pixel shows a surface."""
EDGE = 10.0
"""Factor of the colour difference between neighbours, in the exponent of a pair's weight."""


def unevenness(normals: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
    """Return the weighted mean of 1 - cos of the angle between neighbours' normals, shape [], in [0, 2]; 0 if no pair counts.

    ``normals`` have length 1, or 0 where a pixel has no normal, shape [H, W, 3]; ``image`` has shape [H, W, 3].
    """
    shown = normals.detach().square().sum(-1) > 0.5
    difference, weights = normals.new_zeros(()), normals.new_zeros(())
    for axis in (0, 1):
        size = normals.shape[axis] - 1
        (a, b), (sa, sb), (ia, ib) = ((t.narrow(axis, 0, size), t.narrow(axis, 1, size)) for t in (normals, shown, image))
        weight = torch.exp(-EDGE * (ia - ib).abs().mean(-1)) * (sa & sb)
        difference = difference + total((1 - (a * b).sum(-1)) * weight)
        weights = weights + total(weight)
    return difference / weights.clamp_min(1)


@register_loss_term("normal_smoothness")
@dataclass(frozen=True)
class NormalSmoothness(warpgs.LossTerm):
    """Edge-aware smoothness of the normals of rendered depth; for pinhole cameras."""

    needs_outputs: ClassVar[tuple[str, ...]] = ("alpha", "depth")
    weight: float = 0.1
    """Weight of the term, in [0, 1000]."""
    growth: int = 500
    """Number of steps, from the first, over which the weight grows from 0 to its full value; at least 1."""

    def __post_init__(self) -> None:
        if not (0 <= self.weight <= 1000 and self.growth >= 1):
            raise warpgs.UsageError(
                f"normal-smoothness: weight {self.weight} must be between 0 and 1000, growth {self.growth} must be at least 1"
            )

    def __call__(self, inputs: LossInputs) -> torch.Tensor:
        """Compute the weighted unevenness of the view's normals, shape []."""
        depth = torch.where(inputs.outputs["alpha"] <= MIN_ALPHA, 0, inputs.outputs["depth"])
        # in the axes of the camera: angles between normals do not depend on the pose, and a refined pose gets no gradient
        camera = dataclasses.replace(inputs.camera, viewmat=torch.eye(4, dtype=depth.dtype, device=depth.device))
        weight = self.weight * (inputs.step / self.growth).clamp_max(1)
        return weight * unevenness(warpgs.depth_normals(camera, depth), inputs.target.image)
