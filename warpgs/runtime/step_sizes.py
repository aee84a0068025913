"""Sizes of a training step, and the bytes that its parts need at each moment.

Each part declares its bytes beside its allocations, in a function of `StepSizes`; the memory plan only adds them up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

FLOAT = 4
"""Bytes of a float32 or int32."""
BINNING, LOSS, BLENDING, PROJECTION, SAMPLING = "binning", "loss", "blending", "projection", "sampling"
"""Moments at which a step may need the most memory: while instances are sorted, while the loss and its gradient are computed,
in the backward passes of blending and of projection, and while a sampling event renders a view."""
STEP = (BINNING, LOSS, BLENDING, PROJECTION)
"""Moments of every step."""


@dataclass(frozen=True)
class StepSizes:
    """Sizes that determine the memory of a training step."""

    width: int
    """Width of the largest view [px]."""
    height: int
    """Height of the largest view [px]."""
    row: int
    """Bytes of one Gaussian's parameters."""
    views: int = 1
    """Number of views."""
    masked: bool = False
    """True if a view has a mask."""
    cutout: bool = False
    """True if the images have an alpha channel."""
    depth: bool = False
    """True if a loss term reads depth."""
    cuda: bool = False
    """True on a CUDA device."""
    count: int = 0
    """Number of Gaussians."""
    instances: int = 0
    """Number of (Gaussian, tile) instances of the image or, if ``chunked``, of its heaviest chunk."""
    chunked: bool = False
    """True if the image is rendered in chunks."""

    @property
    def pixels(self) -> int:
        """Number of pixels of the largest view."""
        return self.width * self.height


Needs = Mapping[str, int]
"""Bytes by moment."""


def add_needs(parts: Iterable[Callable[[StepSizes], Needs]], sizes: StepSizes) -> dict[str, int]:
    """Return the sum of the bytes that parts declare, by moment."""
    total: dict[str, int] = {}
    for part in parts:
        for moment, needed in part(sizes).items():
            total[moment] = total.get(moment, 0) + needed
    return total
