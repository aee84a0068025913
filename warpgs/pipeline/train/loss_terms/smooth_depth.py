"""Smoothness of rendered depth, for few views: ambiguous depth becomes planar instead of fog.

On a plane, inverse depth is a linear function of the pixel. So the term sums |z/z' + z/z'' - 2| over the pixels, with the
depths z' and z'' of a pixel's two neighbours in its row, adds the same for its column, and divides by the number of pixels. The
term has no unit. Weights are lower at edges of colour and at pixels with consistent depth. A bound allows depth to jump where
colour does not (docs/decisions/024-smooth-depth.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from warpgs.errors import UsageError
from warpgs.pipeline.train.loss import LossInputs, LossTerm, register, total
from warpgs.pipeline.train.views import TrainingView
from warpgs.runtime.step_sizes import FLOAT, LOSS, STEP, Needs, StepSizes
from warpgs.scene import Prior

MIN_ALPHA = 0.3
"""Opacity above which the depth of a pixel is used."""
EDGE = 0.1
"""Difference of colour between the two neighbours, as mean over the channels, at which the weight falls to 1/e."""
BOUND = 0.1
"""Largest value of the term at a pixel; above it the gradient is 0."""
CONFIRMED = 0.2
"""Weight of pixels with consistent depth."""
MAPS = 12
"""Number of maps with one float per pixel that the term and its gradient hold at the loss."""


def depth_roughness(
    depth: torch.Tensor, alpha: torch.Tensor, image: torch.Tensor, weight: torch.Tensor, mask: torch.Tensor | None
) -> torch.Tensor:
    """Compute the roughness of depth: the weighted sum of min(|z/z' + z/z'' - 2|, `BOUND`) divided by pixel count, shape [].

    z' and z'' are the depths of the two neighbours of a pixel of depth z, in its row and again in its column. The sum is over
    pixels that, like both neighbours, are unmasked and more opaque than `MIN_ALPHA`.

    Args:
        depth: Rendered z-depth [u], positive where alpha is, shape [H, W].
        alpha: Rendered opacity, shape [H, W].
        image: Photographed colours in [0, 1], whose edges weaken the term, shape [H, W, 3].
        weight: Weights of the pixels, shape [H, W].
        mask: 1 for unmasked pixels, 0 for masked ones, shape [H, W]; None without a mask.
    """
    shown = ~(alpha <= MIN_ALPHA)  # True for a NaN, so that it reaches the loss
    shown = shown if mask is None else shown & (mask > 0)
    z = torch.where(shown, depth, 1)
    value = z.new_zeros(())
    for axis in (0, 1):
        count = depth.shape[axis] - 2
        if count < 1:
            continue
        (a, b, c), (one, two, three) = ([t.narrow(axis, i, count) for i in range(3)] for t in (z, shown))
        step = (image.narrow(axis, 0, count) - image.narrow(axis, 2, count)).abs().mean(-1)
        rough = torch.where(one & two & three, (b / a + b / c - 2).abs(), 0)
        value = value + total(rough.clamp_max(BOUND) * torch.exp(-step / EDGE) * weight.narrow(axis, 1, count))
    return value / depth.numel()


@register("smooth_depth")
@dataclass(frozen=True)
class SmoothDepth(LossTerm):
    """The weighted roughness of rendered depth."""

    needs_outputs: ClassVar[tuple[str, ...]] = ("alpha", "depth")
    weight: float = 1.0
    """Weight of the term, in [0, 1000]."""

    def __post_init__(self) -> None:
        if not 0 <= self.weight <= 1000:
            raise UsageError(f"smooth-depth: `weight` must be between 0 and 1000, not {self.weight}")

    def needs(self, view: TrainingView, prior: Prior | None) -> dict[str, torch.Tensor]:
        """Return the weights of the view's pixels, shape [H, W]: `CONFIRMED` where depth is consistent, else 1."""
        ones = torch.ones_like(view.image[..., 0])
        return {"smooth_depth": ones if view.consistent is None else torch.where(view.consistent > 0, CONFIRMED, ones)}

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of the term's maps, and of the copy of its weights on CUDA."""
        copy = FLOAT * sizes.pixels * sizes.cuda
        return {**dict.fromkeys(STEP, copy), LOSS: copy + MAPS * FLOAT * sizes.pixels}

    def __call__(self, inputs: LossInputs) -> torch.Tensor:
        """Compute ``weight`` times `depth_roughness`, shape []."""
        depth, alpha, target = inputs.outputs["depth"], inputs.outputs["alpha"], inputs.target
        return self.weight * depth_roughness(depth, alpha, target.image, target.maps["smooth_depth"], target.mask)
