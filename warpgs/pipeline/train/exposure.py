"""Exposure of training views: an affine map of the rendered colours of each, learned with the Gaussians.

A camera that meters every photograph anew shows one colour brighter here and bluer there. With exposures a step compares the
view's image with A rgb + b of its render. What is learned are the 12 numbers of [A - 1 | b], which start at zero. A step uses
them less their mean over all training views, so that the model has their mean exposure: else all of them could turn darker
while the Gaussians turn brighter, and no training image would tell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from warpgs.errors import UsageError
from warpgs.pipeline.train.loss import LossTerm, Target, register
from warpgs.pipeline.train.views import TrainingView
from warpgs.scene import Gaussians, Render, View

EXPOSURE = "exposure_affine"
"""Name of the parameters of each view in `Learned.views`: rows of [A - 1 | b], shape [V, 12]."""
CHANNELS = 3


def check_exposure(views: list[View]) -> None:
    """Check that views may have an exposure each.

    Raises:
        UsageError: One knows its opacity: an exposure would change the background with the object.
    """
    for v in views:
        if v.alpha is not None:
            raise UsageError(
                f"--exposure is for opaque photographs, and {v.name} knows its opacity: its background is no part of the "
                "photograph; leave --exposure out"
            )


def first_exposures(views: int, device: torch.device) -> dict[str, torch.Tensor]:
    """Return the parameters of as many views before the first step, zeros [V, 12], by name."""
    return {EXPOSURE: torch.zeros(views, CHANNELS * (CHANNELS + 1), device=device)}


def exposure_of(rows: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
    """Return the exposure [..., 12] of views with parameters ``own`` [..., 12], among those of all views ``rows`` [V, 12].

    No gradient flows into the mean: only the rows of ``own`` are learned from.
    """
    # in float64, whose rounding no number of threads shows in float32
    return own - rows.detach().mean(0, dtype=torch.float64).to(own.dtype)


class _Exposed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rgb: torch.Tensor, exposure: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(rgb, exposure)
        m = exposure.view(CHANNELS, CHANNELS + 1)
        # sums of products one by one, not a matrix product, whose order of summation is the library's
        found = rgb + m[:, CHANNELS]
        for k in range(CHANNELS):
            found += rgb[..., k : k + 1] * m[:, k]
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        rgb, exposure = ctx.saved_tensors
        m = exposure.view(CHANNELS, CHANNELS + 1)
        v_rgb = v.clone()
        for c in range(CHANNELS):
            v_rgb += v[..., c : c + 1] * m[c, :CHANNELS]
        columns = [(v * rgb[..., k : k + 1]).sum((0, 1), dtype=torch.float64) for k in range(CHANNELS)]
        columns.append(v.sum((0, 1), dtype=torch.float64))
        return v_rgb, torch.stack(columns, -1).reshape(-1).to(exposure.dtype)


def exposed(rgb: torch.Tensor, exposure: torch.Tensor) -> torch.Tensor:
    """Return colours [H, W, 3] under an exposure [12], rows of [A - 1 | b]; differentiable in both."""
    found: torch.Tensor = _Exposed.apply(rgb, exposure)
    return found


def exposed_views(views: list[TrainingView]) -> list[TrainingView]:
    """Return the views with an exposure each, none at first, which `show_exposures` overwrites."""
    return [replace(v, exposure=torch.zeros(CHANNELS * (CHANNELS + 1), device=v.image.device)) for v in views]


def show_exposures(views: list[TrainingView], rows: torch.Tensor) -> None:
    """Write the exposures as they are now, from the parameters of all views [V, 12], into views of `exposed_views`."""
    for view, row in zip(views, exposure_of(rows, rows).detach(), strict=True):
        assert view.exposure is not None
        view.exposure.copy_(row)


def seen_in(view: TrainingView, rgb: torch.Tensor) -> torch.Tensor:
    """Return the colours of a render [H, W, 3] as a training view shows them, under its exposure if it has one."""
    return rgb if view.exposure is None else exposed(rgb, view.exposure)


@register("exposure_penalty")
@dataclass(frozen=True)
class ExposurePenalty(LossTerm):
    """The weighted sum of the squares of a view's exposure, which holds it to the identity."""

    weight: float = 0.01
    """Weight of the term, in [0, 1000]."""

    def __post_init__(self) -> None:
        if not 0 <= self.weight <= 1000:
            raise UsageError(f"exposure-penalty: weight {self.weight} must lie between 0 and 1000")

    def __call__(self, render: Render, target: Target, gaussians: Gaussians) -> torch.Tensor:
        """Compute ``weight`` times the sum of squares of [A - 1 | b], shape []."""
        square = target.params[EXPOSURE].double().square().sum()
        return (self.weight * square).to(render.rgb.dtype)
