"""The settings of one render other than tensors, shared by all ways to render."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from warpgs.constants import Rule
from warpgs.kernels import sh
from warpgs.kernels.blend_settings import BlendSettings
from warpgs.kernels.project_inputs import ProjectSettings

Window = tuple[int, int, int, int]
"""Left, top, width and height [px]."""


@dataclass(frozen=True)
class RenderSettings:
    """Image, window, cut-offs and camera model of a render."""

    width: int
    """Width of the whole image [px]."""
    height: int
    """Height of the whole image [px]."""
    window: Window
    """Part of the image to render."""
    degree: int
    """Spherical-harmonics degree used."""
    rule: Rule
    """Cut-offs."""
    tile_size: int = 16
    """Side of a tile [px]."""
    camera_model: str = "pinhole"
    """Name of the camera model."""
    parameters: str = "stored"
    """Kind of the Gaussians' parameters (`ProjectSettings.parameters`)."""
    absgrad: bool = False
    """True to sum magnitudes of the gradients of projected means, too (`BlendSettings.absgrad`)."""
    antialiased: bool = False
    """True to reduce the opacity of Gaussians that the pixel filter widens (`ProjectSettings.antialiased`)."""

    def projection(self) -> ProjectSettings:
        """Return the settings of the projection."""
        size, count = (self.width, self.height), sh.coefficient_count(self.degree)
        variant = (self.camera_model, self.parameters, self.antialiased)
        return ProjectSettings(size, self.window, count, self.rule, self.tile_size, *variant)

    def of_window(self) -> dict[str, Any]:
        """Return the window's size and position, and the rule, as keyword arguments of binning and blending."""
        x, y, width, height = self.window
        return {"width": width, "height": height, "rule": self.rule, "origin": (x, y)}

    def blending(self, deterministic: bool = True) -> BlendSettings:
        """Return the settings of blending; True for ``deterministic`` sums gradients in a fixed order."""
        x, y, width, height = self.window
        return BlendSettings((x, y), width, height, self.rule, deterministic, self.absgrad)
