"""The settings of blending that are no tensors, as the kernels of every device take them."""

from __future__ import annotations

from dataclasses import dataclass

from warpgs.constants import Rule
from warpgs.kernels.tiles import grid


@dataclass(frozen=True)
class BlendSettings:
    """Window, cut-offs and order of sums."""

    origin: tuple[int, int]
    """Left and top of the window [px]; a tile's corner."""
    width: int
    """Width of the window [px]."""
    height: int
    """Height of the window [px]."""
    rule: Rule
    """Cut-offs."""
    deterministic: bool = True
    """True to sum gradients in a fixed order on every device."""

    def window_inputs(self, tile_size: int) -> list[int]:
        """Return what each kernel takes: left, top, width, height [px], columns of tiles, and tiles of an image."""
        columns, rows = grid(self.width, self.height, tile_size)
        return [*self.origin, self.width, self.height, columns, columns * rows]
