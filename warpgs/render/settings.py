"""The settings of one render that are no tensors, as every way to render takes them."""

from __future__ import annotations

from dataclasses import dataclass

from warpgs.constants import Rule

Window = tuple[int, int, int, int]
"""Left, top, width and height [px]."""


@dataclass(frozen=True)
class RenderSettings:
    """Image, window and cut-offs of a render."""

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
    tile_size: int
    """Side of a tile [px]."""
    camera_model: str = "pinhole"
    """Name of the camera model."""

    def project_options(self) -> dict:
        """Return the keyword arguments of `project` but for the opacity factors."""
        return {
            "width": self.width, "height": self.height, "window": self.window, "degree": self.degree, "rule": self.rule,
            "tile_size": self.tile_size, "camera_model": self.camera_model,
        }  # fmt: skip
