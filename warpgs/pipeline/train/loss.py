"""The loss: the interface of a term, and the built-in terms."""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from warpgs.device import FLOAT, LOSS, STEP, Needs, StepSizes
from warpgs.errors import UsageError
from warpgs.geometry import depth_normals
from warpgs.kernels.roughness import roughness
from warpgs.kernels.ssim import difference_bytes, differences
from warpgs.pipeline.train.views import TrainingView
from warpgs.plugins import Registry, is_ours, returned
from warpgs.scene import Camera, Gaussians, Prior, Tensors
from warpgs.schema import Checked, Within

SSIM_WEIGHT = 0.2
"""Fraction lambda of the SSIM term (Kerbl et al. 2023)."""
Weight = Annotated[float, Within(0, 1000)]
"""Weight of a term."""
OUTPUTS = ("rgb", "alpha", "depth")
"""Images of `warpgs.Render` for loss terms."""


@dataclass(frozen=True)
class Target:
    """Image, mask and maps of a view, with which a step compares the render."""

    image: Tensor
    """Colours in [0, 1], shape [H, W, 3]."""
    mask: Tensor | None
    """1 for unmasked pixels, 0 for masked ones, shape [H, W]; None without a mask."""
    maps: Tensors
    """Maps that loss terms requested (`LossTerm.needs`), by name, each of shape [H, W] or [H, W, C]."""
    alpha: Tensor | None = None
    """Opacity of the subject, in [0, 1], shape [H, W]; None if no training view has one. ``image`` and the render have the same
    background, which changes at each step."""


class _Outputs(dict[str, Tensor]):
    """Images of a render that a term requested; reading another one raises an error."""

    def __init__(self, term: "LossTerm", images: Tensors):
        super().__init__({n: images[n] for n in term.needs_outputs})
        self.term = term

    def __missing__(self, name: str) -> Tensor:
        raise UsageError(f"the loss term {self.term.name!r} reads the output {name!r}; add it to needs_outputs")


@dataclass(frozen=True)
class LossInputs:
    """Render, view and Gaussians of a step, for computing a loss term; all tensors are on the device of the fit."""

    outputs: Tensors
    """Images of the render named in `LossTerm.needs_outputs`: ``rgb`` [H, W, 3], the colour over the background, after view
    modules; ``alpha`` [H, W], the accumulated opacity in [0, 1]; ``depth`` [H, W], the expected z-depth [u], 0 where nothing is
    blended. Differentiable."""
    target: Target
    """Image, mask and maps of the view."""
    gaussians: Gaussians
    """The Gaussians; differentiable."""
    camera: Camera
    """Camera of the view at the size of the images: ``viewmat`` [4, 4], camera_from_world [u], and ``K`` [3, 3] [px] are
    tensors. If poses are refined, this is the refined pose of the step, and it is differentiable."""
    step: Tensor
    """Number of the step, from 1: an integer as float32, shape []. It is a tensor, because a captured step is replayed
    for later steps; `LossTerm.active` gets the number on the host."""


@dataclass(frozen=True)
class LossTerm(Checked):
    """One term of the loss. To write one, derive a frozen dataclass; its fields are its settings."""

    name: ClassVar[str] = ""
    """Name in the registry."""
    needs_outputs: ClassVar[tuple[str, ...]] = ("rgb",)
    """Images of the render that the term reads (`LossInputs.outputs`). Other images have no gradient."""
    needs_priors: ClassVar[bool] = False
    """True if `needs` reads the priors of the views, which are then computed before the fit."""

    def needs(self, view: TrainingView, prior: Prior | None) -> dict[str, Tensor]:
        """Return the maps of a view that the term reads, by name, each of shape [H, W] or [H, W, C].

        No two terms of a fit may use the same name for a map.
        """
        return {}

    def active(self, step: int, steps: int) -> bool:
        """Return whether the term is active in a step, from 1 to ``steps``."""
        return True

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes that the term needs at the moments of a step.

        By default, a term that reads depth needs four maps when the loss is computed, and other terms need none. Four maps
        suffice to correlate two maps and to compute the gradient. Override this in a term that needs more.
        """
        return {LOSS: 4 * FLOAT * sizes.pixels if "depth" in self.needs_outputs else 0}

    def __call__(self, inputs: LossInputs) -> Tensor:
        """Compute the term, a differentiable value of shape [], or 0; it must not read back from the device.

        Args:
            inputs: The render's outputs that the term needs, the view, the Gaussians, the camera and the number of the step.

        Raises:
            TypeError: The class does not define ``__call__``.
        """
        raise TypeError(f"{type(self).__name__} must define __call__(inputs)")


LOSS_TERMS = Registry("loss term", LossTerm, "warpgs.pipeline.train.loss")
"""Loss terms by name."""
register = register_loss_term = LOSS_TERMS.register


def term_values(terms: Sequence[LossTerm], inputs: LossInputs) -> list[Tensor]:
    """Compute each term from the outputs that it needs; returns values of shape [], in the order of the terms.

    A user-defined term with a constant value other than 0 has no effect, and raises UsageError.
    """
    values = []
    trained = torch.is_grad_enabled() and any(t.requires_grad for t in inputs.outputs.values())
    for term in terms:
        value = term(replace(inputs, outputs=_Outputs(term, inputs.outputs)))
        values.append(returned(term, "__call__", value, Tensor, "a tensor of shape []", shape=()))
        if value.requires_grad or is_ours(type(term)) or not trained:
            continue
        if not (value.is_cuda and torch.cuda.is_current_stream_capturing()) and bool(value != 0):
            raise UsageError(
                f"the loss term {term.name!r} has no gradient, so it changes nothing: {type(term).__name__}.__call__ must "
                "compute it from inputs.outputs, without detach(), item() or no_grad; return 0 in views where it does not apply"
            )
    return values


def outputs_of(terms: Sequence[LossTerm]) -> tuple[str, ...]:
    """Return the names of the outputs that terms need, each once, in the order of `OUTPUTS`."""
    return tuple(n for n in OUTPUTS if any(n in t.needs_outputs for t in terms))


ROW = 1024
"""Values in a row, for sums of values that have no rows."""


def total(values: Tensor) -> Tensor:
    """Return the sum of values [N] or [H, ...], shape [], with the same bits for any number of CPU threads.

    On a CPU, torch's sum of a whole tensor depends on the number of threads, so rows are summed first.
    """
    if values.is_cuda:
        return values.sum()
    if values.dim() == 1:
        values = torch.nn.functional.pad(values, (0, -len(values) % ROW)).view(-1, ROW)
    return values.flatten(1).sum(1).sum()


def check_outputs(terms: Sequence[LossTerm]) -> None:
    """Check that a render has all outputs that loss terms need."""
    for term in terms:
        for name in term.needs_outputs:
            if name not in OUTPUTS:
                needs = f"the loss term {term.name!r} needs the output {name!r}, which no render has"
                raise UsageError(f"{needs}; choose needs_outputs from {', '.join(OUTPUTS)}")


def maps_of(terms: Sequence[LossTerm], view: TrainingView, prior: Prior | None) -> dict[str, Tensor]:
    """Return the maps of a view that terms need, by name, each of shape [H, W] or [H, W, C]."""
    owners: dict[str, str] = {}
    maps: dict[str, Tensor] = {}
    for term in terms:
        own, size = term.needs(view, prior), view.image.shape[:2]
        returned(term, "needs", own, Mapping, "maps [H, W] or [H, W, C] by name", each=Tensor, shape=size)
        for name, values in own.items():
            if name in maps:
                both = f"{owners[name]!r} and {term.name!r}"
                raise UsageError(f"the loss terms {both} both have a map {name!r}; rename it in one of them")
            maps[name], owners[name] = values, term.name
    return maps


# The photometric loss: 0.8 L1 + 0.2 (1 - SSIM), as in the paper's preliminaries and Kerbl et al. 2023, eq. 7.


@functools.cache
def _weights(fraction: float, count: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the weights [2] of the sums of 1 - SSIM and of absolute differences over ``count`` numbers.

    They stay cached, because CUDA graphs refer to their memory.
    """
    with torch.inference_mode(False):  # a first call may come in inference mode, whose tensors cannot be used in training
        return torch.tensor([fraction / count, (1 - fraction) / count], dtype=dtype, device=device)


def photometric_loss(rgb: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float = 0.2) -> Tensor:
    """Return the loss of a rendered image: (1 - lambda) L1 + lambda (1 - SSIM).

    Args:
        rgb: Rendered colours, shape [H, W, 3].
        target: Photographed colours in [0, 1], shape [H, W, 3].
        mask: 1 for unmasked pixels, 0 for masked ones, shape [H, W]; None without a mask. Masked pixels are black in the
            windows of SSIM around unmasked pixels.
        ssim_weight: lambda, in [0, 1].

    Returns:
        The loss, shape []; 0 if all pixels are masked.
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
        loss = total((rgb - target).abs()) / (3 * pixels)
    return loss if mask is None else loss * (pixels / mask.sum().clamp_min(1))


@register("photometric")
@dataclass(frozen=True)
class Photometric(LossTerm):
    """The photometric loss; every fit has it."""

    ssim_weight: float = SSIM_WEIGHT
    """Fraction lambda of the SSIM term, in [0, 1]."""

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of the differences and, with a mask, of both masked images."""
        masked = 7 * FLOAT * sizes.pixels if sizes.masked else 0  # two images, and the mask's own
        return {LOSS: difference_bytes(sizes) + masked}

    def __call__(self, inputs: LossInputs) -> Tensor:
        """Compute `photometric_loss` of the render and the view's image, shape []."""
        return photometric_loss(inputs.outputs["rgb"], inputs.target.image, inputs.target.mask, self.ssim_weight)


def _weighted_mean(values: Tensor, mask: Tensor | None, weight: float) -> Tensor:
    """Return ``weight`` times the mean of values [H, W] over the unmasked pixels, shape []."""
    if mask is None:
        return total(values) * (weight / values.numel())
    return total(values * mask) / mask.sum().clamp_min(1) * weight


@register("alpha")
@dataclass(frozen=True)
class AlphaDifference(LossTerm, group="alpha."):
    """The weighted mean absolute difference of rendered and true opacity, 0 in views without an alpha channel."""

    needs_outputs: ClassVar[tuple[str, ...]] = ("alpha",)
    weight: Weight = 0.1
    """Weight of the term, in [0, 1000]."""

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of the difference, its magnitude and its gradient."""
        return {LOSS: 3 * FLOAT * sizes.pixels}

    def __call__(self, inputs: LossInputs) -> Tensor:
        """Compute ``weight`` times the mean absolute difference of opacities over the unmasked pixels, shape []."""
        alpha, target = inputs.outputs["alpha"], inputs.target
        if target.alpha is None:
            return alpha.new_zeros(())
        return _weighted_mean((alpha - target.alpha).abs(), target.mask, self.weight)


def _map_bytes(sizes: StepSizes, channels: int, maps: int) -> Needs:
    """Return the bytes of maps at the loss, and of the copy of a term's map with ``channels`` on CUDA."""
    copy = channels * FLOAT * sizes.pixels * sizes.cuda
    return {**dict.fromkeys(STEP, copy), LOSS: copy + maps * FLOAT * sizes.pixels}


CERTAIN_WEIGHT, INSIDE = 1.0, 0.1
"""Weight of `CertainOpacity`, as a fraction of that of `AlphaDifference`, and that of pixels inside the object as a fraction of
it (docs/decisions/034-objects-on-black.md)."""
AWAY = 0.005
"""Least distance from the edge of the object at which a pixel is empty or opaque for certain, as a fraction of the image's
diagonal."""


@register("certain")
@dataclass(frozen=True)
class CertainOpacity(LossTerm, group="certain."):
    """The weighted mean absolute difference of opacity where photographs of an object on black leave no doubt.

    Black haze beside the object, and too bright colours of a transparent object, would look the same in these photographs.
    """

    needs_outputs: ClassVar[tuple[str, ...]] = ("alpha",)
    weight: Weight = CERTAIN_WEIGHT
    """Weight of the term, in [0, 1000]."""

    def needs(self, view: TrainingView, prior: Prior | None) -> dict[str, Tensor]:
        """Return 1 for empty pixels at least `AWAY` from the object, -`INSIDE` as far inside, else 0, shape [H, W]."""
        if view.alpha is None:
            return {"certain": torch.zeros_like(view.image[..., 0])}
        reach = max(1, round(AWAY * math.hypot(*view.alpha.shape)))
        sides = torch.stack([view.alpha > 0, view.alpha < 1])[:, None].to(view.alpha.dtype)
        outside, inside = 1 - torch.nn.functional.max_pool2d(sides, 2 * reach + 1, 1, reach)[:, 0]
        return {"certain": outside - INSIDE * inside}

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of the products, the constant part and a gradient, and of the copy of the map on CUDA."""
        return _map_bytes(sizes, 1, 4 + sizes.masked)

    def __call__(self, inputs: LossInputs) -> Tensor:
        """Compute ``weight`` times the sum of weighted differences, divided by the number of unmasked pixels, shape []."""
        sign = inputs.target.maps["certain"]
        return _weighted_mean(sign * inputs.outputs["alpha"] + (-sign).clamp_min(0), inputs.target.mask, self.weight)


# Loss terms for given depth and normals, for views that have them.
#
# The depth term is the mean of |q / z - q / d|, with rendered depth z, given depth d, and the view's median given depth
# q. This difference of inverse depths has no unit. A far surface has less weight than a near one, and an outlier has no
# larger gradient than other pixels. The normal term is the mean of 1 - cos of the angle between given normals and
# normals of rendered depth.

GIVEN_MIN_ALPHA = 0.5
"""Opacity above which a pixel shows a surface, so that its depth is compared."""
DEPTH_MAPS = 8
"""Number of maps with one float per pixel that the depth term and its gradient hold at the loss."""
NORMAL_MAPS = 26
"""Number of maps with one float per pixel for the normal term; points, differences and normals count as three each."""


def inverse_depth_difference(depth: Tensor, alpha: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    """Compute the weighted mean absolute difference of relative inverse depths, shape []; 0 if no pixel is compared.

    ``target`` [H, W, 3] is weight times q / d, weight, and weight times q [u], for given depth d and its median q: averages of
    pixels keep the weighted means. All other maps are [H, W].
    """
    shown = ~(alpha <= GIVEN_MIN_ALPHA)  # True for a NaN, so that it reaches the loss
    shown = shown if mask is None else shown & (mask > 0)
    weight = torch.where(shown, target[..., 1], 0)
    inverse = target[..., 2] / torch.where(shown & (target[..., 1] > 0), depth, 1)
    return total(torch.where(weight > 0, (inverse - target[..., 0]).abs(), 0)) / total(weight).clamp_min(1e-6)


@register("given_depth")
@dataclass(frozen=True)
class GivenDepthDifference(LossTerm, group="given-depth."):
    """The weighted difference of rendered and given inverse depth, 0 in views without given depth."""

    needs_outputs: ClassVar[tuple[str, ...]] = ("alpha", "depth")
    weight: Weight = 0.3
    """Weight of the term, in [0, 1000]."""

    def needs(self, view: TrainingView, prior: Prior | None) -> dict[str, Tensor]:
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
        return _map_bytes(sizes, 3, DEPTH_MAPS)

    def __call__(self, inputs: LossInputs) -> Tensor:
        """Compute ``weight`` times `inverse_depth_difference`, shape []."""
        depth, alpha, target = inputs.outputs["depth"], inputs.outputs["alpha"], inputs.target
        return self.weight * inverse_depth_difference(depth, alpha, target.maps["given_depth"], target.mask)


def normal_difference(normals: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    """Compute the weighted mean of 1 - cos of the angle between normals [H, W, 3], shape [], in [0, 2]; 0 if no pixel has both.

    Missing normals are 0. The weight is the length of the given normals, which is below 1 for averages over pixels.
    """
    shown = ~(normals.detach().square().sum(-1) <= 0.5)  # of a NaN too
    shown = shown if mask is None else shown & (mask > 0)
    # the root in float64, since the rounding of float32's depends on the processor (MKL)
    length = target.square().sum(-1).double().sqrt().to(target.dtype)
    weight = torch.where(shown, length, 0)
    return total(torch.where(weight > 0, length - (normals * target).sum(-1), 0)) / total(weight).clamp_min(1e-6)


@register("given_normals")
@dataclass(frozen=True)
class GivenNormalsDifference(LossTerm, group="given-normals."):
    """The weighted 1 - cos of the angle between given and rendered normals, for pinholes; 0 in views without given normals."""

    needs_outputs: ClassVar[tuple[str, ...]] = ("alpha", "depth")
    weight: Weight = 0.03
    """Weight of the term, in [0, 1000]."""

    def needs(self, view: TrainingView, prior: Prior | None) -> dict[str, Tensor]:
        """Return the view's normals in its camera's axes [H, W, 3]; 0 where none are given."""
        return {"given_normals": torch.zeros_like(view.image) if view.normals is None else view.normals}

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of points, differences and normals, and of the copy of the target on CUDA."""
        return _map_bytes(sizes, 3, NORMAL_MAPS)

    def __call__(self, inputs: LossInputs) -> Tensor:
        """Compute ``weight`` times `normal_difference` of the rendered depth's normals, shape []."""
        depth = torch.where(inputs.outputs["alpha"] <= GIVEN_MIN_ALPHA, 0, inputs.outputs["depth"])
        # in the axes of the camera, like the given normals: a refined pose gets no gradient
        camera = replace(inputs.camera, viewmat=torch.eye(4, dtype=depth.dtype, device=depth.device))
        target = inputs.target
        return self.weight * normal_difference(depth_normals(camera, depth), target.maps["given_normals"], target.mask)


# Smoothness of rendered depth, for few views: ambiguous depth becomes planar instead of fog.
#
# The term is the sum of the roughness of all pixels (`warpgs.kernels.roughness`), divided by their number. It has no unit.
# Weights are lower at edges of colour and at pixels with consistent depth. A bound allows depth to jump where colour does
# not (docs/decisions/024-smooth-depth.md).

EDGE = 0.1
"""Difference of colour between the two neighbours, as mean over the channels, at which the weight falls to 1/e."""
CONFIRMED = 0.2
"""Weight of pixels with consistent depth."""
MAPS = 8
"""Number of maps with one float per pixel that the term and its gradient hold at the loss."""


def depth_roughness(depth: Tensor, alpha: Tensor, image: Tensor, weight: Tensor, mask: Tensor | None) -> Tensor:
    """Compute the mean roughness of depth, shape [], from depth, opacity, weights and a mask [H, W] and colours [H, W, 3]."""
    rows, columns = (torch.exp(-gap.abs().mean(-1) / EDGE) for gap in (image[:, :-2] - image[:, 2:], image[:-2] - image[2:]))
    return total(roughness(depth, alpha, rows, columns, weight, mask)) / depth.numel()


@register("smooth_depth")
@dataclass(frozen=True)
class SmoothDepth(LossTerm, group="smooth-depth."):
    """The weighted roughness of rendered depth."""

    needs_outputs: ClassVar[tuple[str, ...]] = ("alpha", "depth")
    weight: Weight = 1.0
    """Weight of the term, in [0, 1000]."""

    def needs(self, view: TrainingView, prior: Prior | None) -> dict[str, Tensor]:
        """Return the weights of the view's pixels, shape [H, W]: `CONFIRMED` where depth is consistent, else 1."""
        ones = torch.ones_like(view.image[..., 0])
        return {"smooth_depth": ones if view.consistent is None else torch.where(view.consistent > 0, CONFIRMED, ones)}

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of the term's maps, and of the copy of its weights on CUDA."""
        return _map_bytes(sizes, 1, MAPS)

    def __call__(self, inputs: LossInputs) -> Tensor:
        """Compute ``weight`` times `depth_roughness`, shape []."""
        depth, alpha, target = inputs.outputs["depth"], inputs.outputs["alpha"], inputs.target
        return self.weight * depth_roughness(depth, alpha, target.image, target.maps["smooth_depth"], target.mask)


@dataclass(frozen=True)
class LossConfig(Checked, group="loss."):
    """Weights of the loss."""

    alpha_weight: Weight = 1.0
    """Weight of the mean absolute difference of rendered and given opacity, for views with an alpha channel, in [0, 1000]; 0 to
    disable. Where objects on black are empty, rendered opacity has 0.3 times this weight."""
    smooth_weight: Weight | None = 0.0
    """Weight of the roughness of rendered depth (docs/decisions/024-smooth-depth.md), in [0, 1000]; 0 to disable. None: chosen
    by the number of views."""
    depth_weight: Weight = 0.3
    """Weight of the difference of rendered and given inverse depth, for views with given depth, in [0, 1000]; 0 to disable."""
    normal_weight: Weight = 0.03
    """Weight of 1 - cos of the angle between given normals and normals of rendered depth, for views with given normals, in [0,
    1000]; 0 to disable."""


def built_in_terms(
    config: LossConfig, cutout: bool = False, depth: bool = False, normals: bool = False, black: bool = False
) -> tuple[LossTerm, ...]:
    """Return the built-in terms of a fit, by its weights and by whether a view has an alpha channel, depth or normals.

    ``black`` says that an opacity was estimated from black backgrounds.
    """
    terms: list[tuple[bool, Callable[[float], LossTerm], float]] = [
        (cutout, AlphaDifference, config.alpha_weight),
        (black and not cutout, CertainOpacity, CERTAIN_WEIGHT * config.alpha_weight),
        (True, SmoothDepth, config.smooth_weight or 0.0),
        (depth, GivenDepthDifference, config.depth_weight),
        (normals, GivenNormalsDifference, config.normal_weight),
    ]
    return (Photometric(), *(kind(weight) for applies, kind, weight in terms if applies and weight > 0))
