"""The view modules of a fit with their parameters, and their values for each training view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from warpgs.errors import UsageError
from warpgs.pipeline.model.table import Table
from warpgs.pipeline.train.view_modules.base import Tensors, ViewModule
from warpgs.scene import Camera, View


def seen(modules: Sequence[ViewModule], rgb: torch.Tensor, values: Tensors) -> torch.Tensor:
    """Apply view modules to rendered colours [H, W, 3]; ``values`` are the modules' values for the view, by name, [...]."""
    for module in modules:
        rgb = module.after_render(rgb, values)
    return rgb


@dataclass(frozen=True)
class LearnedView:
    """Camera and learned values of one training view."""

    modules: tuple[ViewModule, ...]
    """View modules of the fit."""
    given: Camera
    """Given camera, which modules change."""
    values: Tensors
    """Current values, by name, [...], overwritten in place."""


class LearnedViews:
    """The view modules of a fit and the table of their parameters, which has a row for each training view."""

    def __init__(self, modules: Sequence[ViewModule], params: Sequence[Tensors], device: torch.device, count: int):
        """Begin with the parameters of each module.

        Args:
            modules: View modules.
            params: Parameters of each of them, by name, shape [V, ...].
            device: Where parameters are kept.
            count: Number V of training views.

        Raises:
            UsageError: Two modules have a parameter of the same name.
        """
        self.modules = tuple(modules)
        self._names: list[tuple[str, ...]] = []
        first: dict[str, torch.Tensor] = {}
        for module, own in zip(modules, params, strict=True):
            for name in own.keys() & first.keys():
                other = next(m.name for m, names in zip(modules, self._names) if name in names)
                raise UsageError(
                    f"the view modules {other!r} and {module.name!r} both have a parameter {name!r}; rename it in one of them"
                )
            first |= {n: t.to(device, torch.float32) for n, t in own.items()}
            self._names.append(tuple(own))
        self.table = Table(first, {}, device, count)
        """Parameters with their Adam moments."""

    @classmethod
    def first(cls, modules: Sequence[ViewModule], views: Sequence[View], device: torch.device) -> LearnedViews:
        """Return the modules with their initial parameters for training views."""
        return cls(modules, [m.parameters(views) for m in modules], device, len(views))

    def params_of(self, module: ViewModule) -> dict[str, torch.Tensor]:
        """Return the parameters of one of the modules, by name, shape [V, ...]."""
        return {n: self.table.params[n] for n in self._names[self.modules.index(module)]}

    def lrs(self, progress: float, extent: float) -> dict[str, float]:
        """Return the learning rate of each parameter; arguments are those of `ViewModule.lrs`."""
        return {n: lr for m in self.modules for n, lr in m.lrs(progress, extent).items()}

    def values(self, numbers: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the values of all modules for views with these indices [B], by name, shape [B, ...]; differentiable."""
        return {n: t for m in self.modules for n, t in m.values(self.params_of(m), numbers).items()}

    def before_render(self, camera: Camera, values: Tensors) -> Camera:
        """Return the camera that views are rendered from; arguments are those of `ViewModule.before_render`."""
        for module in self.modules:
            camera = module.before_render(camera, values)
        return camera

    def regularisation(self, values: Tensors) -> dict[str, torch.Tensor]:
        """Return the terms that modules add to the loss of a view with these values [...], shape [] each, by module name."""
        found = {m.name: m.regularisation(values) for m in self.modules}
        return {n: t for n, t in found.items() if t is not None}

    def cameras(self, given: Mapping[str, Camera], train: Sequence[str], test: Sequence[str]) -> Mapping[str, Camera]:
        """Return the current cameras of all views, by name; arguments are those of `ViewModule.cameras`."""
        for module in self.modules:
            given = module.cameras(given, train, test, self.params_of(module))
        return given
