"""Loss terms for given depth and normals, for views that have them.

The depth term is the mean of |q / z - q / d|, with rendered depth z, given depth d, and the view's median given depth q. This
difference of inverse depths has no unit. A far surface has less weight than a near one, and an outlier has no larger gradient
than other pixels. The normal term is the mean of 1 - cos of the angle between given normals and normals of rendered depth.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import torch

from warpgs.errors import UsageError
from warpgs.geometry import depth_normals
from warpgs.pipeline.train.loss import LossInputs, LossTerm, register, total
from warpgs.pipeline.train.views import TrainingView
from warpgs.runtime.step_sizes import FLOAT, LOSS, STEP, Needs, StepSizes
from warpgs.scene import Prior

MIN_ALPHA = 0.5
"""Opacity above which a pixel shows a surface, so that its depth is compared."""
DEPTH_MAPS = 8
"""Number of maps with one float per pixel that the depth term and its gradient hold at the loss."""
NORMAL_MAPS = 26
"""Number of maps with one float per pixel for the normal term; points, differences and normals count as three each."""


def inverse_depth_difference(
    depth: torch.Tensor, alpha: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None
) -> torch.Tensor:
    """Compute the weighted mean absolute difference of relative inverse depths, shape []; 0 if no pixel is compared.

    Args:
        depth: Rendered z-depth [u], positive where alpha is, shape [H, W].
        alpha: Rendered opacity, shape [H, W].
        target: Weight times q / d, weight, and weight times q [u], for given depth d and its median q, shape [H, W, 3].
            Averages of pixels keep the weighted means.
        mask: 1 for unmasked pixels, 0 for masked ones, shape [H, W]; None without a mask.
    """
    shown = ~(alpha <= MIN_ALPHA)  # True for a NaN, so that it reaches the loss
    shown = shown if mask is None else shown & (mask > 0)
    weight = torch.where(shown, target[..., 1], 0)
    inverse = target[..., 2] / torch.where(shown & (target[..., 1] > 0), depth, 1)
    off = torch.where(weight > 0, (inverse - target[..., 0]).abs(), 0)
    return total(off) / total(weight).clamp_min(1e-6)


@register("given_depth")
@dataclass(frozen=True)
class GivenDepthDifference(LossTerm):
    """The weighted difference of rendered and given inverse depth, 0 in views without given depth."""

    needs_outputs: ClassVar[tuple[str, ...]] = ("alpha", "depth")
    weight: float = 0.3
    """Weight of the term, in [0, 1000]."""

    def __post_init__(self) -> None:
        if not 0 <= self.weight <= 1000:
            raise UsageError(f"given-depth: `weight` must be between 0 and 1000, not {self.weight}")

    def needs(self, view: TrainingView, prior: Prior | None) -> dict[str, torch.Tensor]:
        """Return weight times q / d, weight, and weight times q, [H, W, 3], for depth d with median q; 0 without depth."""
        given = view.depth
        if given is None:
            return {"given_depth": view.image.new_zeros(*view.image.shape[:2], 3)}
        known = given > 0
        q = given[known].median() if bool(known.any()) else given.new_ones(())
        weight = known.to(given.dtype) if view.depth_weight is None else view.depth_weight * known
        return {"given_depth": torch.stack([weight * q / torch.where(known, given, 1), weight, weight * q], -1)}

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of the term's maps, and of the copy of its target on CUDA."""
        copy = 3 * FLOAT * sizes.pixels * sizes.cuda
        return {**dict.fromkeys(STEP, copy), LOSS: copy + DEPTH_MAPS * FLOAT * sizes.pixels}

    def __call__(self, inputs: LossInputs) -> torch.Tensor:
        """Compute ``weight`` times `inverse_depth_difference`, shape []."""
        depth, alpha, target = inputs.outputs["depth"], inputs.outputs["alpha"], inputs.target
        return self.weight * inverse_depth_difference(depth, alpha, target.maps["given_depth"], target.mask)


def normal_difference(normals: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Compute the weighted mean of 1 - cos of the angle between normals, shape [], in [0, 2]; 0 if no pixel has both.

    Args:
        normals: Unit normals, 0 for missing values, shape [H, W, 3].
        target: Given normals, 0 for missing values, shape [H, W, 3]; the weight is their length, which is below 1 for averages
            over pixels.
        mask: 1 for unmasked pixels, 0 for masked ones, shape [H, W]; None without a mask.
    """
    shown = ~(normals.detach().square().sum(-1) <= 0.5)  # of a NaN too
    shown = shown if mask is None else shown & (mask > 0)
    # the root in float64, since the rounding of float32's depends on the processor (MKL)
    length = target.square().sum(-1).double().sqrt().to(target.dtype)
    weight = torch.where(shown, length, 0)
    off = torch.where(weight > 0, length - (normals * target).sum(-1), 0)
    return total(off) / total(weight).clamp_min(1e-6)


@register("given_normals")
@dataclass(frozen=True)
class GivenNormalsDifference(LossTerm):
    """The weighted 1 - cos of the angle between given and rendered normals, for pinholes; 0 in views without given normals."""

    needs_outputs: ClassVar[tuple[str, ...]] = ("alpha", "depth")
    weight: float = 0.03
    """Weight of the term, in [0, 1000]."""

    def __post_init__(self) -> None:
        if not 0 <= self.weight <= 1000:
            raise UsageError(f"given-normals: `weight` must be between 0 and 1000, not {self.weight}")

    def needs(self, view: TrainingView, prior: Prior | None) -> dict[str, torch.Tensor]:
        """Return the view's normals in its camera's axes [H, W, 3]; 0 where none are given."""
        return {"given_normals": torch.zeros_like(view.image) if view.normals is None else view.normals}

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of points, differences and normals, and of the copy of the target on CUDA."""
        copy = 3 * FLOAT * sizes.pixels * sizes.cuda
        return {**dict.fromkeys(STEP, copy), LOSS: copy + NORMAL_MAPS * FLOAT * sizes.pixels}

    def __call__(self, inputs: LossInputs) -> torch.Tensor:
        """Compute ``weight`` times `normal_difference` of the rendered depth's normals, shape []."""
        depth = torch.where(inputs.outputs["alpha"] <= MIN_ALPHA, 0, inputs.outputs["depth"])
        # in the axes of the camera, like the given normals: a refined pose gets no gradient
        camera = dataclasses.replace(inputs.camera, viewmat=torch.eye(4, dtype=depth.dtype, device=depth.device))
        target = inputs.target
        return self.weight * normal_difference(depth_normals(camera, depth), target.maps["given_normals"], target.mask)
