"""Planes of a depth sweep and the scale of their costs, which the CPU and the GPU backend share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpgs import geometry
from warpgs.errors import UsageError
from warpgs.geometry import check_pinhole, matmul
from warpgs.priors.epipolar import homogeneous
from warpgs.scene import Camera, View

NOISE = (2 / 255) ** 2
"""Variance below which the pattern in a correlation window counts as noise: correlation fades to 0 there."""
EDGE = 0.06
"""Colour step between neighbouring pixels at which the penalty for a jump in depth falls to 1/e."""
UNIT = 4096
"""Integer that stands for cost 1 in cost volumes of 16 bits. Such volumes need half the memory of float32; the first access
to memory takes as long as the computation."""
MAX_LARGE_STEP = 0.99
"""Largest penalty P2 at which the sum of four path costs, each at most 1 + P2, stays below 2^15 in units of 1 / `UNIT`."""
PLANES_AT_ONCE = 16
"""Number of planes per launch on the GPU."""


@dataclass(frozen=True)
class SweepConfig:
    """Settings of the planes, of the smoothing of costs and of the consistency check."""

    near_count: int = 4
    """Number of other views with which each view is compared: the nearest that see the same surfaces."""
    max_views: int = 30
    """Largest number of views that are swept: those that together see most of the scene. All others serve only for
    comparison."""
    window: int = 7
    """Side of the square in which pixels are correlated [px]: 3, 5 or 7."""
    spacing: float = 0.5
    """Largest step of a match from one plane to the next [px], if `max_planes` allows it."""
    max_planes: int = 256
    """Largest number of planes, at least 8; memory is about 5 bytes per pixel and plane."""
    max_pixels: int = 200_000
    """Largest number of pixels of an image; larger ones are swept at a reduced size."""
    small_step: float = 0.03
    """Penalty for a depth one plane off the neighbouring pixel's (P1); costs are in [0, 1]."""
    large_step: float = 0.5
    """Penalty for any other depth (P2) where the image is uniform; less across the image's edges, but at least 1.5 P1."""
    max_round_trip: float = 0.6
    """Largest error [px] when a pixel is projected into another view and back by that view's depth."""
    min_parallax: float = 0.5
    """Smallest angle between the two rays [deg]; below it depth is noise."""

    def __post_init__(self):
        if self.window not in (3, 5, 7):  # kernels add up squares in 32 bits
            raise UsageError(f"sweep window {self.window} must be 3, 5 or 7")
        if not (self.max_planes >= 8 and self.near_count >= 1 and self.max_pixels >= 1 and self.max_views >= 2):
            raise UsageError(
                "sweep max-planes must be at least 8, near-count and max-pixels at least 1, max-views at least 2; found "
                f"{self.max_planes}, {self.near_count}, {self.max_pixels}, {self.max_views}"
            )
        for name in ("spacing", "small_step", "large_step", "max_round_trip", "min_parallax"):
            if not getattr(self, name) > 0:
                raise UsageError(f"sweep {name.replace('_', '-')} must be above 0, not {getattr(self, name)}")
        if not max(self.large_step, 1.5 * self.small_step) <= MAX_LARGE_STEP:
            raise UsageError(
                f"sweep large-step and 1.5 times small-step must be at most {MAX_LARGE_STEP}, not {self.large_step} and "
                f"{1.5 * self.small_step:g}"
            )


def project_inverse(first: Camera, second: Camera, pixels: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Project pixels [N, 2] at inverse depths [1/u] [N] into the second image; return positions [px] [N, 2], NaN if behind."""
    check_pinhole(first)
    check_pinhole(second)
    rotation, translation = geometry.relative_pose(first, second)
    rays = matmul(homogeneous(pixels), geometry.inverse(first.K).T)
    p = matmul(matmul(rays, rotation.T) + inverse[:, None] * translation, second.K.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(p[:, 2:] > 1e-9, p[:, :2] / p[:, 2:], np.nan)


def inside_image(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return True where pixels [..., 2] [px] are in the image of ``camera``; False for NaN."""
    return (pixels >= 0).all(-1) & (pixels[..., 0] < camera.width) & (pixels[..., 1] < camera.height)


def plane_inverses(
    first: Camera, others: Sequence[Camera], bounds: tuple[float, float], spacing: float, max_planes: int
) -> np.ndarray:
    """Return inverse depths [1/u] of planes, evenly spaced and ascending, from the far to the near bound [u].

    Their number, 8 to ``max_planes``, is the smallest at which no match inside an image moves more than about ``spacing`` px
    between planes.
    """
    near, far = bounds
    x, y = np.meshgrid(np.linspace(0, first.width, 5), np.linspace(0, first.height, 5))
    pixels = np.stack([x.ravel(), y.ravel()], 1)
    ladder = np.linspace(1 / far, 1 / near, 17)
    longest = 0.0
    for other in others:
        found = np.stack([project_inverse(first, other, pixels, np.full(len(pixels), w)) for w in ladder])
        inside = inside_image(other, found)
        steps = np.linalg.norm(np.diff(found, axis=0), axis=2)[inside[1:] & inside[:-1]]
        longest = max(longest, float(steps.max(initial=0)) * (len(ladder) - 1))
    return np.linspace(1 / far, 1 / near, int(np.clip(np.ceil(longest / spacing) + 1, 8, max_planes)))


def plane_homography(first: Camera, second: Camera, inverse: float) -> np.ndarray:
    """Return H [3, 3] from first to second by the plane z = 1 / inverse, for pixel centres at integers (OpenCV)."""
    check_pinhole(first)
    check_pinhole(second)
    rotation, translation = geometry.relative_pose(first, second)
    moved = rotation + inverse * np.outer(translation, [0, 0, 1])
    H = matmul(matmul(second.K, moved), geometry.inverse(first.K))
    back, shift = (np.array([[1, 0, s], [0, 1, s], [0, 0, 1]]) for s in (-0.5, 0.5))
    return matmul(matmul(back, H), shift)


def plane_homographies(first: Camera, others: Sequence[Camera], inverses: np.ndarray) -> np.ndarray:
    """Return `plane_homography` of D inverse depths [1/u] and N other cameras, shape [D, N, 3, 3]."""
    start = np.stack([plane_homography(first, o, 0.0) for o in others])
    slope = np.stack([plane_homography(first, o, 1.0) for o in others]) - start
    return start + inverses[:, None, None, None] * slope


def gray_of(view: View) -> np.ndarray:
    """Return the brightness of a view's pixels in [0, 1], float32, shape [H, W], with the weights of ITU-R BT.601."""
    red, green, blue = (view.image[..., i].astype(float) for i in range(3))
    return (0.299 * red + 0.587 * green + 0.114 * blue).astype(np.float32)


def step_limits(colors: np.ndarray, small_step: float, large_step: float) -> np.ndarray:
    """Return P2 of the steps along the first axis of an image [L, B, 3], in units of 1 / `UNIT`, int16, shape [L - 1, B]."""
    jumps = np.abs(np.diff(colors, axis=0)).max(2).astype(float)  # the rounding of float32's exp depends on the processor
    return np.rint(np.maximum(large_step * np.exp(-jumps / EDGE), 1.5 * small_step) * UNIT).astype(np.int16)
