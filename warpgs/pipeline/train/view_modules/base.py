"""Base class of view modules, which learn parameters of each training view: of its camera, or of its colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from warpgs.errors import UsageError
from warpgs.plugins import Registry
from warpgs.render.options import RasterizeOptions
from warpgs.runtime.step_sizes import Needs, StepSizes
from warpgs.scene import Camera, Gaussians, View

CAMERA_BYTES = 4 * (16 + 9)
"""Bytes per Gaussian if cameras are learned: its part of the gradients of view matrix and intrinsics, before the sum over
Gaussians."""
Tensors = Mapping[str, torch.Tensor]
"""Parameters of views, or values computed from them, by name."""


@dataclass(frozen=True)
class FittedViews:
    """A finished fit, for `ViewModule.figures`."""

    params: Tensors
    """Parameters of the module, by name, shape [V, ...]."""
    train: tuple[str, ...]
    """Names of the training views, in the order of their parameters."""
    test: Sequence[View]
    """Held-out views, with their cameras after the fit."""
    given: Mapping[str, Camera]
    """Camera of each view before the fit, in scene units [u], by name."""
    cameras: Mapping[str, Camera]
    """Camera of each view after the fit, in scene units [u], by name."""
    scale: float
    """Scene units per unit of the scene's files."""
    gaussians: Gaussians
    """The fitted model."""
    options: RasterizeOptions
    """Options for rendering the model."""


@dataclass(frozen=True)
class ViewModule:
    """Parameters of each training view that a fit learns together with the Gaussians.

    To write a module, derive a frozen dataclass; its fields are its settings.

    The parameters have a row for each training view. Dense Adam updates them, as in `torch.optim.Adam`: a step has gradients
    only in the rows of its own views, and the other rows move by their decaying momentum. Checkpoints store parameters and
    moments; a module has no other state.

    `values`, `before_render`, `after_render` and `regularisation` are part of the captured step: they must not read back
    from the device, and their tensors must have the same shapes at each call.
    """

    name: ClassVar[str] = ""
    """Name in the registry."""

    def check(self, views: Sequence[View]) -> None:
        """Check at the start of a fit that the training views can have the parameters.

        Raises:
            UsageError: The training views cannot have the parameters.
        """

    def parameters(self, views: Sequence[View]) -> dict[str, torch.Tensor]:
        """Return the parameters before the first step, by name, float32, shape [V, ...]: a row for each training view.

        No two modules of a fit may use the same parameter name.
        """
        return {}

    def lrs(self, progress: float, extent: float) -> dict[str, float]:
        """Return the learning rate of each parameter by name.

        Args:
            progress: Fraction of the fit that is done, in [0, 1].
            extent: Size of the scene [u].
        """
        return {}

    def values(self, params: Tensors, numbers: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the values of some views for `before_render` and `after_render`: by default their rows; differentiable.

        Args:
            params: Parameters of all training views, by name, shape [V, ...].
            numbers: Indices of the B views among all training views, int64, shape [B].

        Returns:
            Tensors by the names of the parameters, shape [B, ...].
        """
        return {n: t.index_select(0, numbers) for n, t in params.items()}  # not t[numbers], which reads them back

    def before_render(self, camera: Camera, values: Tensors) -> Camera:
        """Return the camera for rendering the views; viewmat and intrinsics may change, and are differentiable.

        Args:
            camera: Camera of B views as given, viewmat [B, 4, 4] and K [B, 3, 3]; at half the size in some steps.
            values: Result of `values` for these views, [B, ...].
        """
        return camera

    def after_render(self, rgb: torch.Tensor, values: Tensors) -> torch.Tensor:
        """Return the colours [H, W, 3] of one view after the module, which reads its ``values`` [...]; differentiable."""
        return rgb

    def regularisation(self, values: Tensors) -> torch.Tensor | None:
        """Return a loss term for the step's view, shape []; None for no term. ``values`` [...] belong to this view."""
        return None

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes that the module needs at the moments of a step; none by default.

        A module with `before_render` needs `CAMERA_BYTES` for each Gaussian in the backward pass of projection.
        """
        return {}

    def cameras(
        self, given: Mapping[str, Camera], train: Sequence[str], test: Sequence[str], params: Tensors
    ) -> Mapping[str, Camera]:
        """Return the cameras of all views after the fit, for scores and renders; by default the given ones.

        The images of held-out views are not available, so that nothing is learned from them.

        Args:
            given: Camera of each view, numpy, in scene units [u], by name.
            train: Names of the training views.
            test: Names of the held-out views.
            params: Parameters of the training views, by name, shape [V, ...].
        """
        return given

    def figures(self, fitted: FittedViews) -> dict[str, Any]:
        """Return the learned values as plain numbers for metrics.json; ``summary`` is a note for output and report."""
        return {"summary": f"view module {self.name}: {', '.join(fitted.params)} of {len(fitted.train)} training views learned"}


VIEW_MODULES = Registry("view module", ViewModule, __package__)
"""View modules by name; those in the modules of this folder are built in."""
register = VIEW_MODULES.register


def check_modules(modules: Sequence[ViewModule]) -> None:
    """Check that a run folder can name the class of each view module.

    Raises:
        UsageError: An object is not a view module, its class is not registered, or two have the same class.
    """
    for i, module in enumerate(modules):
        kind = type(module)
        if not isinstance(module, ViewModule):
            raise UsageError(
                f"{module!r} is not a view module: give an instance of a class that derives from warpgs.ViewModule"
            )
        if not VIEW_MODULES.has(kind):
            raise UsageError(VIEW_MODULES.unnamed(kind))
        if any(type(m) is kind for m in modules[:i]):
            raise UsageError(f"the view module {module.name!r} is given twice; remove one")
