"""Warp kernels: one file per op, forward and hand-written backward side by side. Public names are for camera models."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warpgs.faces import lazy

if TYPE_CHECKING:
    from warpgs.kernels.cameras import CameraModel as CameraModel, register_camera_model as register_camera_model
else:
    __getattr__, __dir__ = lazy(__name__)
