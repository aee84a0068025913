"""Loss terms: their inputs in a training step, their declarations, and their lookup by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

import torch

from warpgs.errors import UsageError
from warpgs.pipeline.train.views import TrainingView
from warpgs.plugins import Registry
from warpgs.runtime.step_sizes import FLOAT, LOSS, Needs, StepSizes
from warpgs.scene import Camera, Gaussians, Prior

OUTPUTS = ("rgb", "alpha", "depth")
"""Images of `warpgs.Render` for loss terms."""


@dataclass(frozen=True)
class Target:
    """Image, mask and maps of a view, with which a step compares the render."""

    image: torch.Tensor
    """Colours in [0, 1], shape [H, W, 3]."""
    mask: torch.Tensor | None
    """1 for unmasked pixels, 0 for masked ones, shape [H, W]; None without a mask."""
    maps: Mapping[str, torch.Tensor]
    """Maps that loss terms requested (`LossTerm.needs`), by name, each of shape [H, W] or [H, W, C]."""
    alpha: torch.Tensor | None = None
    """Opacity of the subject, in [0, 1], shape [H, W]; None if no training view has one. ``image`` and the render have the same
    background; with `LossConfig.random_background` the background changes at each step."""


class _Outputs(dict[str, torch.Tensor]):
    """Images of a render that a term requested; reading another one raises an error."""

    def __init__(self, term: LossTerm, images: Mapping[str, torch.Tensor]):
        super().__init__({n: images[n] for n in term.needs_outputs})
        self.term = term

    def __missing__(self, name: str) -> torch.Tensor:
        raise UsageError(
            f"the loss term {self.term.name!r} reads the output {name!r}, but did not request it; add it to needs_outputs"
        )


@dataclass(frozen=True)
class LossInputs:
    """Render, view and Gaussians of a step, for computing a loss term; all tensors are on the device of the fit."""

    outputs: Mapping[str, torch.Tensor]
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
    step: torch.Tensor
    """Number of the step, from 1: an integer as float32, shape []. It is a tensor, because a captured step is replayed
    for later steps; `LossTerm.active` gets the number on the host."""

    def of(self, term: LossTerm) -> LossInputs:
        """Return the inputs of one term, with only the outputs that it needs."""
        return replace(self, outputs=_Outputs(term, self.outputs))


@dataclass(frozen=True)
class LossTerm:
    """One term of the loss. To write one, derive a frozen dataclass; its fields are its settings."""

    name: ClassVar[str] = ""
    """Name in the registry."""
    needs_outputs: ClassVar[tuple[str, ...]] = ("rgb",)
    """Images of the render that the term reads (`LossInputs.outputs`). Other images have no gradient."""
    needs_priors: ClassVar[bool] = False
    """True if `needs` reads the priors of the views, which are then computed before the fit."""

    def needs(self, view: TrainingView, prior: Prior | None) -> dict[str, torch.Tensor]:
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

    def __call__(self, inputs: LossInputs) -> torch.Tensor:
        """Compute the term, a differentiable value of shape []; it must not read back from the device.

        Args:
            inputs: The render's outputs that the term needs, the view, the Gaussians, the camera and the number of the step.

        Raises:
            TypeError: The class does not define ``__call__``.
        """
        raise TypeError(f"{type(self).__name__} must define __call__(inputs)")


LOSS_TERMS = Registry("loss term", LossTerm, "warpgs.pipeline.train.loss_terms")
"""Loss terms by name."""
register = LOSS_TERMS.register


def term_values(terms: Sequence[LossTerm], inputs: LossInputs) -> list[torch.Tensor]:
    """Compute each term from the outputs that it needs; returns values of shape [], in the order of the terms.

    Raises:
        UsageError: A term reads an output that it does not name in `LossTerm.needs_outputs`.
    """
    return [term(inputs.of(term)) for term in terms]


def outputs_of(terms: Sequence[LossTerm]) -> tuple[str, ...]:
    """Return the names of the outputs that terms need, each once, in the order of `OUTPUTS`."""
    return tuple(n for n in OUTPUTS if any(n in t.needs_outputs for t in terms))


ROW = 1024
"""Values in a row, for sums of values that have no rows."""


def total(values: torch.Tensor) -> torch.Tensor:
    """Return the sum of values [N] or [H, ...], shape [], with the same bits for any number of CPU threads.

    On a CPU, torch's sum of a whole tensor depends on the number of threads, so rows are summed first.
    """
    if values.is_cuda:
        return values.sum()
    if values.dim() == 1:
        values = torch.nn.functional.pad(values, (0, -len(values) % ROW)).view(-1, ROW)
    return values.flatten(1).sum(1).sum()


Part = TypeVar("Part")


def check_terms(terms: Sequence[LossTerm]) -> None:
    """Check that a run folder can name the class of each loss term, and that a render has all outputs that they need.

    Raises:
        UsageError: An object is not a loss term, its class is not registered, or it needs an unknown output.
    """
    for term in terms:
        kind = type(term)
        if not isinstance(term, LossTerm):
            raise UsageError(f"{term!r} is not a loss term: give an instance of a class that derives from warpgs.LossTerm")
        if not LOSS_TERMS.has(kind):
            raise UsageError(LOSS_TERMS.unnamed(kind))
        unknown = [n for n in term.needs_outputs if n not in OUTPUTS]
        if unknown:
            raise UsageError(
                f"the loss term {term.name!r} needs the output {unknown[0]!r}, which no render has; choose needs_outputs from "
                + ", ".join(OUTPUTS)
            )


def collect(terms: Sequence[LossTerm], parts: Callable[[LossTerm], Mapping[str, Part]], what: str) -> dict[str, Part]:
    """Return the named parts of all terms in one dictionary.

    Args:
        terms: Loss terms.
        parts: Function that returns the parts of a term by name.
        what: Word for a part, for the message.

    Raises:
        UsageError: Two terms have a part of the same name.
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
