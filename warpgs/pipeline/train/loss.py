"""The loss: 0.8 L1 + 0.2 (1 - SSIM), as in the paper's preliminaries and Kerbl et al. 2023, eq. 7; on request a depth term."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeVar

import numpy as np
import torch

from warpgs.errors import UsageError
from warpgs.kernels.ssim import differences
from warpgs.pipeline.train.views import TrainingView
from warpgs.plugins import Registry
from warpgs.scene import Gaussians, Prior, Render

MIN_ALPHA = 0.5
"""Opacity above which the depth of a pixel counts: elsewhere the background contributes more."""
BEHIND = 0x62616B67
"""Key that sets random backgrounds apart from other random numbers of a fit."""
FLAT = 1e-3
"""Standard deviation at or below which a map counts as constant, for a disparity in [0, 1] and for mean depth over depth, whose
values lie around 1. The gradient of a correlation grows with the inverse of it."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss."""

    ssim_weight: float = 0.2
    """Fraction lambda of the structural term, in [0, 1]."""
    depth_weight: float = 0.0
    """Weight of the depth term, 1 minus the correlation of rendered inverse depth with the view's prior, in [0, 1000]; 0 for
    none, 0.05 in FSGS (Zhu et al. 2024)."""
    depth_until: float = 0.95
    """Fraction of the steps, from the first, that have the depth term, in [0, 1]."""
    random_background: bool = True
    """True to set views that know their opacity, and their renders, before another colour at each step: what is empty cannot
    be matched by Gaussians in the colour of the background. Opaque views do not have it."""
    alpha_weight: float = 1.0
    """Weight of the mean absolute difference of opacities, in views that know theirs, in [0, 1000]; 0 for no such term."""

    exposure_weight: float = 0.01
    """Weight of the sum of squares of each view's exposure less the identity, where exposures are learned, in [0, 1000]."""

    def __post_init__(self) -> None:
        for name, most in (("depth_weight", 1000), ("depth_until", 1), ("alpha_weight", 1000), ("exposure_weight", 1000)):
            if not 0 <= getattr(self, name) <= most:
                raise UsageError(f"loss {name.replace('_', ' ')} {getattr(self, name)} must lie between 0 and {most}")
        if not 0 <= self.ssim_weight <= 1:
            raise UsageError(f"loss ssim weight {self.ssim_weight} must lie between 0 and 1")


@functools.cache
def _weights(fraction: float, count: int, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """Return the weights [2] of the sums of 1 - SSIM and of absolute differences over ``count`` numbers.

    They are cached for good, as CUDA graphs refer to their memory.
    """
    with torch.inference_mode(False):  # whoever asks first: what is made in that mode cannot be trained with
        return torch.tensor([fraction / count, (1 - fraction) / count], dtype=dtype, device=device)


def _total(values: torch.Tensor) -> torch.Tensor:
    """Return the sum of values [H, ...], on a CPU row by row: that of a whole tensor depends on the number of threads."""
    return values.sum() if values.is_cuda else values.flatten(1).sum(1).sum()


def _centred(values: torch.Tensor, fraction: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """Return values [H, W] less their mean over the pixels that count, and 0 at others."""
    mean = _total(values * fraction) / pixels
    # one number for each row: the gradient of a number for all is the sum of a whole tensor (see `_total`)
    return (values - (mean if values.is_cuda else mean.expand(len(values), 1))) * fraction


def photometric_loss(
    rgb: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None, ssim_weight: float = 0.2
) -> torch.Tensor:
    """Return the loss of a rendered image: (1 - lambda) L1 + lambda (1 - SSIM).

    Args:
        rgb: Rendered colours, shape [H, W, 3].
        target: Photographed colours in [0, 1], shape [H, W, 3].
        mask: 1 where a pixel counts, else 0, shape [H, W]; None where all count. Masked pixels are black to the
            window of SSIM, in which they count where it reaches pixels that do.
        ssim_weight: lambda, in [0, 1].

    Returns:
        The loss, shape []; 0 where no pixel counts.
    """
    pixels = target.shape[0] * target.shape[1]
    if mask is not None:
        kept = mask[..., None] > 0
        rgb, target = torch.where(kept, rgb, 0), torch.where(kept, target, 0)
    if ssim_weight > 0:
        sums = differences(rgb, target)
        # one product and one sum, where terms one by one would be a dozen kernels on a GPU
        loss = (sums * _weights(ssim_weight, target.numel(), sums.dtype, sums.device)).sum()
    else:
        loss = _total((rgb - target).abs()) / (3 * pixels)
    return loss if mask is None else loss * (pixels / mask.sum().clamp_min(1))


def depth_disagreement(
    depth: torch.Tensor, alpha: torch.Tensor, disparity: torch.Tensor, mask: torch.Tensor | None
) -> torch.Tensor:
    """Compute 1 minus Pearson's correlation of rendered inverse depth with a disparity, which may have any scale and offset.

    The pixels that count have alpha above `MIN_ALPHA` and are kept by the mask. Differentiable in ``depth`` alone. Where either
    map is constant over them (`FLAT`), and where none counts, there is no correlation: then it is 0 and has no gradient. The
    unit of depth does not matter from 1e-30 to 1e30 u: maps are scaled to values around 1 and centred before squaring.

    Args:
        depth: Expected z-depth [u], positive where alpha is, shape [H, W].
        alpha: Accumulated opacity, shape [H, W].
        disparity: Relative inverse depth in [0, 1], shape [H, W].
        mask: 1 where a pixel counts, else 0, shape [H, W]; None where all count.

    Returns:
        A number in [0, 2], shape []; NaN where a pixel that counts has one.
    """
    counts = ~(alpha <= MIN_ALPHA)  # of a NaN too: it must not vanish
    counts = counts if mask is None else counts & (mask > 0)
    fraction = counts.to(depth.dtype)
    pixels = fraction.sum().clamp_min(1)
    depth = torch.where(counts, depth, 1)
    mean = _total(depth.detach() * fraction) / pixels
    a, b = (_centred(m, fraction, pixels) for m in (mean / depth, disparity))
    of_a, of_b = _total(a * a) / pixels, _total(b * b) / pixels
    flat = (of_a <= FLAT**2) | (of_b <= FLAT**2)
    # roots in float64: float32's have other last digits on other processors (MKL)
    spread = torch.where(flat, 1, of_a).double().sqrt() * torch.where(flat, 1, of_b).double().sqrt()
    return torch.where(flat, 0, 1 - _total(a * b) / pixels / spread.to(a.dtype))


@dataclass(frozen=True)
class Target:
    """Image, mask, maps and parameters of a view, which a step compares its render with."""

    image: torch.Tensor
    """Colours in [0, 1], shape [H, W, 3]."""
    mask: torch.Tensor | None
    """1 where a pixel counts, else 0, shape [H, W]; None where all count."""
    maps: Mapping[str, torch.Tensor]
    """Maps that loss terms asked for (`LossTerm.needs`), by name, each of shape [H, W] or [H, W, C]."""
    params: Mapping[str, torch.Tensor]
    """The view's own parameters (`LossTerm.view_parameters`), by name, shape [...]; differentiable."""
    alpha: torch.Tensor | None = None
    """Opacity of what was photographed, in [0, 1], shape [H, W]; None where no training view has one. ``image`` and the render
    are over the same colour, another one at each step where `LossConfig.random_background` says so."""


def over(image: torch.Tensor, alpha: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
    """Return an image [H, W, 3] of opacity ``alpha`` [H, W] over another background, its own plus ``shift`` [3]."""
    return image + (1 - alpha)[..., None] * shift


def random_shift(seed: int, step: int, background: Sequence[float]) -> tuple[float, float, float]:
    """Return the colour behind a step's view less the scene's background [3]: uniform in [0, 1], by seed and step alone."""
    red, green, blue = (b - a for a, b in zip(background, np.random.default_rng([seed, step, BEHIND]).random(3).tolist()))
    return red, green, blue


@dataclass(frozen=True)
class ViewParameter:
    """A parameter of each training view, such as an exposure.

    The rows of all views are one tensor under dense Adam, as in `torch.optim.Adam`: a step has a gradient in the row of its own
    view and zeros in the others, which still move by their decaying momentum.
    """

    initial: tuple[float, ...]
    """First value, the same for all views."""
    lr: float
    """Learning rate, the same for all steps."""


@dataclass(frozen=True)
class LossTerm:
    """One term of the loss. A term of your own is a frozen dataclass that derives from this; its fields are its settings."""

    name: ClassVar[str] = ""
    """Name that it is registered by."""
    needs_priors: ClassVar[bool] = False
    """True where `needs` reads the priors of the views, which are then computed before the fit."""

    def needs(self, view: TrainingView, prior: Prior | None) -> dict[str, torch.Tensor]:
        """Return the maps of a view that the term compares with, by name, each of shape [H, W] or [H, W, C].

        No two terms of a fit may use the same name.
        """
        return {}

    def view_parameters(self) -> dict[str, ViewParameter]:
        """Return the parameters that each view learns for this term, by name; no two terms of a fit may use the same name."""
        return {}

    def active(self, step: int, steps: int) -> bool:
        """Return whether a step, from 1 to ``steps``, has the term."""
        return True

    def __call__(self, render: Render, target: Target, gaussians: Gaussians) -> torch.Tensor:
        """Compute the term, a differentiable value of shape []; it must not read back from the device.

        Args:
            render: The render of the step's view: ``rgb`` [H, W, 3], ``alpha`` and ``depth`` [H, W].
            target: Image, mask, maps and parameters of the view.
            gaussians: The Gaussians, parameters as stored.

        Raises:
            TypeError: The class does not define it.
        """
        raise TypeError(f"{type(self).__name__} must define __call__(render, target, gaussians)")


LOSS_TERMS = Registry("loss term", LossTerm, __name__)
"""Loss terms by name."""
register = LOSS_TERMS.register


@register("photometric")
@dataclass(frozen=True)
class Photometric(LossTerm):
    """The photometric loss; every fit has it."""

    ssim_weight: float = 0.2
    """Fraction lambda of the structural term, in [0, 1]."""

    def __call__(self, render: Render, target: Target, gaussians: Gaussians) -> torch.Tensor:
        """Compute `photometric_loss` of the render and the view's image, shape []."""
        return photometric_loss(render.rgb, target.image, target.mask, self.ssim_weight)


@register("depth_correlation")
@dataclass(frozen=True)
class DepthCorrelation(LossTerm):
    """The weighted depth term of `LossConfig`."""

    needs_priors: ClassVar[bool] = True
    weight: float = 0.05
    """Weight of the term."""
    until: float = 0.95
    """Fraction of the steps, from the first, that have the term."""

    def __post_init__(self) -> None:
        if not (0 <= self.weight <= 1e9 and 0 <= self.until <= 1):
            raise UsageError(
                f"depth-correlation: weight {self.weight} must lie between 0 and 1e9, and until {self.until} between 0 and 1"
            )

    def needs(self, view: TrainingView, prior: Prior | None) -> dict[str, torch.Tensor]:
        """Return the disparity of the view's prior, shape [H, W]."""
        assert prior is not None  # `needs_priors`
        return {"disparity": torch.as_tensor(prior.disparity, dtype=torch.float32, device=view.image.device)}

    def active(self, step: int, steps: int) -> bool:
        """Return whether the step is one of the first ``until`` of all."""
        return step <= self.until * steps

    def __call__(self, render: Render, target: Target, gaussians: Gaussians) -> torch.Tensor:
        """Compute ``weight`` times `depth_disagreement` of the rendered depth and the prior's disparity, shape []."""
        return self.weight * depth_disagreement(render.depth, render.alpha, target.maps["disparity"], target.mask)


@register("alpha")
@dataclass(frozen=True)
class AlphaDifference(LossTerm):
    """The weighted mean absolute difference of rendered and true opacity, 0 in views that do not know theirs."""

    weight: float = 0.1
    """Weight of the term, in [0, 1000]."""

    def __post_init__(self) -> None:
        if not 0 <= self.weight <= 1000:
            raise UsageError(f"alpha: weight {self.weight} must lie between 0 and 1000")

    def __call__(self, render: Render, target: Target, gaussians: Gaussians) -> torch.Tensor:
        """Compute ``weight`` times the mean absolute difference of opacities over the pixels that count, shape []."""
        if target.alpha is None:
            return render.alpha.new_zeros(())
        difference = (render.alpha - target.alpha).abs()
        if target.mask is None:
            return _total(difference) * (self.weight / target.alpha.numel())
        return _total(difference * target.mask) / target.mask.sum().clamp_min(1) * self.weight


Part = TypeVar("Part")


def check_terms(terms: Sequence[LossTerm]) -> None:
    """Check that a run folder could name the class of each loss term.

    Raises:
        UsageError: One is no loss term, or its class is not registered, or not by its own name.
    """
    for term in terms:
        kind = type(term)
        if not isinstance(term, LossTerm):
            raise UsageError(f"{term!r} is no loss term: give an instance of a class that derives from warpgs.LossTerm")
        if not LOSS_TERMS.has(kind):
            raise UsageError(
                f"the loss term {kind.__qualname__} has no name of its own, by which a run folder could tell it; register it "
                'with @register("name") of warpgs.pipeline.train.loss above the class, or name it as module:Class'
            )


def collect(terms: Sequence[LossTerm], parts: Callable[[LossTerm], Mapping[str, Part]], what: str) -> dict[str, Part]:
    """Return the named parts of all terms in one dictionary.

    Args:
        terms: Loss terms.
        parts: Function that returns the parts of a term by name.
        what: Word for a part, for the message.

    Raises:
        UsageError: Two terms have a part of one name.
    """
    found: dict[str, Part] = {}
    owners: dict[str, LossTerm] = {}
    for term in terms:
        for name, part in parts(term).items():
            if name in found:
                raise UsageError(
                    f"the loss terms {owners[name].name!r} and {term.name!r} both have a {what} {name!r}; rename it in one of "
                    "them"
                )
            found[name], owners[name] = part, term
    return found


def built_in_terms(config: LossConfig, cutout: bool = False) -> tuple[LossTerm, ...]:
    """Return the terms that every fit has by its settings; ``cutout`` says that its views know their opacity."""
    depth = (DepthCorrelation(config.depth_weight, config.depth_until),) if config.depth_weight > 0 else ()
    alpha = (AlphaDifference(config.alpha_weight),) if config.alpha_weight > 0 and cutout else ()
    return (Photometric(config.ssim_weight), *depth, *alpha)
