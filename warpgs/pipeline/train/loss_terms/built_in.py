"""The loss of every fit: its weights, and its terms."""

from __future__ import annotations

from dataclasses import dataclass

from warpgs.errors import UsageError
from warpgs.pipeline.train.loss import LossTerm
from warpgs.pipeline.train.loss_terms.given import GivenDepthDifference, GivenNormalsDifference
from warpgs.pipeline.train.loss_terms.opacity import AlphaDifference
from warpgs.pipeline.train.loss_terms.photometric import Photometric
from warpgs.pipeline.train.loss_terms.smooth_depth import SmoothDepth


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss."""

    ssim_weight: float = 0.2
    """Fraction lambda of the SSIM term, in [0, 1]."""
    random_background: bool = True
    """Put views with an alpha channel, and their renders, on a random background at each step. Without this, Gaussians of the
    background colour could cover empty areas. No effect on opaque views."""
    alpha_weight: float = 1.0
    """Weight of the mean absolute difference of rendered and given opacity, for views with an alpha channel, in [0, 1000]; 0 to
    disable."""
    smooth_weight: float | None = 0.0
    """Weight of the roughness of rendered depth (docs/decisions/024-smooth-depth.md), in [0, 1000]; 0 to disable. None: chosen
    by the number of views."""
    depth_weight: float = 0.3
    """Weight of the difference of rendered and given inverse depth, for views with given depth, in [0, 1000]; 0 to disable."""
    normal_weight: float = 0.03
    """Weight of 1 - cos of the angle between given normals and normals of rendered depth, for views with given normals, in [0,
    1000]; 0 to disable."""

    def __post_init__(self) -> None:
        for name in ("alpha_weight", "smooth_weight", "depth_weight", "normal_weight"):
            if getattr(self, name) is not None and not 0 <= getattr(self, name) <= 1000:
                raise UsageError(f"loss: `{name.replace('_', '-')}` must be between 0 and 1000, not {getattr(self, name)}")
        if not 0 <= self.ssim_weight <= 1:
            raise UsageError(f"loss: `ssim-weight` must be between 0 and 1, not {self.ssim_weight}")


def built_in_terms(
    config: LossConfig, cutout: bool = False, depth: bool = False, normals: bool = False
) -> tuple[LossTerm, ...]:
    """Return the built-in terms of a fit, by its settings and its views.

    Args:
        config: Weights.
        cutout: True if a view has an alpha channel.
        depth: True if a view has given depth.
        normals: True if a view has given normals.
    """
    terms: list[LossTerm] = [Photometric(config.ssim_weight)]
    if cutout and config.alpha_weight > 0:
        terms.append(AlphaDifference(config.alpha_weight))
    if config.smooth_weight:
        terms.append(SmoothDepth(config.smooth_weight))
    if depth and config.depth_weight > 0:
        terms.append(GivenDepthDifference(config.depth_weight))
    if normals and config.normal_weight > 0:
        terms.append(GivenNormalsDifference(config.normal_weight))
    return tuple(terms)
