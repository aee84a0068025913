"""Bytes of the buffers of a render with gradients on CUDA, as the kernels declare them, and the moments at which they exist.

The sizes are for one camera, three channels, and gradients of the five tensors. Upstream gradients and Gaussians are inputs and
are not counted; alpha is not counted because it is not kept. A sort takes memory from Warp's pool before these buffers peak.
"""

from __future__ import annotations

from dataclasses import dataclass

from warpgs.kernels.blend_cuda import STATE, STRIDE, chunk_of
from warpgs.kernels.tiles import grid
from warpgs.render.graphed import CAPACITY_FACTOR, SPARE

REAL = 4
"""Size of a number [bytes]."""
PAIRS = 4 * REAL
"""Bytes of an instance in the lists: tile and slot, each in a sort buffer of twice the size."""
TILE = 16


@dataclass(frozen=True)
class Counts:
    """Sizes of a render."""

    gaussians: int
    visible: int
    instances: int
    """(Gaussian, tile) pairs."""
    width: int
    height: int
    coefficients: int = 16

    @property
    def pixels(self) -> int:
        """Pixels of the image."""
        return self.width * self.height

    @property
    def tiles(self) -> int:
        """Tiles of the image."""
        columns, rows = grid(self.width, self.height, TILE)
        return columns * rows


BLEND = "blending backward"
PROJECT = "projection backward"
MOMENTS = (BLEND, PROJECT)
"""Moments of largest memory: the first with large images, the second with many Gaussians."""


def buffers(n: Counts, deterministic: bool = True) -> dict[str, tuple[int, tuple[str, ...]]]:
    """Return the size of each buffer [bytes], and the moments at which it exists, by name; atomic calls are not recorded."""
    state = STATE * TILE * TILE * REAL // chunk_of(n.tiles, deterministic)
    slot = STRIDE * REAL if deterministic else 0
    spare = (CAPACITY_FACTOR - 1) * n.instances + SPARE, (CAPACITY_FACTOR - 1) * n.visible + SPARE
    return {
        "projected Gaussians and counts": ((STRIDE + 1) * REAL * n.gaussians, MOMENTS),
        "lists of instances": (8 * n.tiles + 8 * n.visible + REAL * n.gaussians + PAIRS * n.instances, (BLEND,)),
        "image": (3 * REAL * n.pixels, MOMENTS),
        "depth, transmittance, weight and end of each pixel": (4 * REAL * n.pixels, (BLEND,)),
        "state of each pixel every few instances": (state * n.instances, (BLEND,)),
        "gradient of each instance": (slot * n.instances, (BLEND,)),
        "spare capacity of a recorded call": (
            int(spare[0] * (PAIRS + state + slot) + spare[1] * 8) if deterministic else 0, (BLEND,)
        ),
        "gradients of projected Gaussians": (STRIDE * REAL * n.gaussians, MOMENTS),
        "gradients of the five tensors": ((11 + 3 * n.coefficients) * REAL * n.gaussians, (PROJECT,)),
    }  # fmt: skip


def at_most(n: Counts, deterministic: bool = True) -> int:
    """Return the bytes at the moment with the most memory."""
    held = buffers(n, deterministic).values()
    return max(sum(size for size, moments in held if moment in moments) for moment in MOMENTS)
