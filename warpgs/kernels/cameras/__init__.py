"""Camera models by name: one file per model, found by its presence in this folder."""

from __future__ import annotations

import functools
import importlib
import pkgutil

from warpgs.errors import UsageError
from warpgs.kernels.cameras.base import MODELS, CameraModel, register

__all__ = ["CameraModel", "find_camera_model", "register"]


@functools.cache
def _load_all() -> None:
    """Import every module of this folder, so that each registers its model."""
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")


def find_camera_model(name: str) -> CameraModel:
    """Return the camera model of that name.

    Raises:
        UsageError: No model has this name.
    """
    _load_all()
    if name not in MODELS:
        raise UsageError(
            f"unknown camera model {name!r}: choose one of {', '.join(sorted(MODELS))}, "
            "or undistort the images to a pinhole camera first"
        )
    return MODELS[name]
