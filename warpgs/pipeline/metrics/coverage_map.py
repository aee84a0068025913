"""Coverage of a render: how many training views saw the point that each pixel shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from warpgs.constants import NEAR
from warpgs.geometry import check_pinhole, pinhole_of, relative_pose
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

TOLERANCE = 0.02
"""Largest difference of two depths of one surface, as a fraction of the depth. Measured on training photographs alone: at this
difference, the squared colour difference of two photographs is twice (3 dB) the value at the best agreement of depths (decision
019)."""
MIN_ALPHA = 0.5
"""Least opacity of a pixel that shows a surface; other pixels have no depth."""
MAX_COUNT = 255
"""Largest number of views that is stored for a pixel; higher counts are clamped."""
GRID = 32
"""Number of points along the longer side of an image that `fraction_outside` checks."""
MAX_PIXELS = 2**26
"""Largest total number of pixels of all depth maps, 256 MiB; above it, maps are rendered at a smaller size."""


@dataclass(frozen=True)
class DepthView:
    """Depth of the model at the pixels of one training view."""

    camera: Camera
    """Camera, arrays of numpy, at the size of ``depth``."""
    depth: torch.Tensor
    """Expected z-depth [u], float32, shape [H, W]; 0 where the model shows no surface, or the mask of the view hides it."""


@dataclass(frozen=True)
class Match:
    """The points of one view's pixels as another view sees them; tensors of the shape of the pixels, [H, W]."""

    u: torch.Tensor
    """Column in the other view [px], pixel centres at +0.5; undefined where ``difference`` is infinite."""
    v: torch.Tensor
    """Row in the other view [px]."""
    difference: torch.Tensor
    """Smallest difference between the point's depth in the other view and the depths seen at the four pixels around the point,
    as a fraction of the depth. Four pixels are compared because depth varies within a pixel on a slanted surface. Infinite
    outside the other image, where the other view sees no surface, and where the pixel itself shows none."""


@torch.no_grad()
def depth_of(gaussians: Gaussians, camera: Camera, options: RasterizeOptions) -> torch.Tensor:
    """Render the expected z-depth [u] of a view, shape [H, W]; 0 where less than `MIN_ALPHA` of a pixel is covered."""
    r = rasterize(gaussians, camera, options)
    return torch.where(r.alpha >= MIN_ALPHA, r.depth, 0)


def depth_views(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    options: RasterizeOptions,
    masks: Sequence[np.ndarray | None] | None = None,
    max_pixels: int = MAX_PIXELS,
) -> list[DepthView]:
    """Render the depth of every training view once.

    Args:
        gaussians: N Gaussians in the units of the cameras.
        cameras: Cameras of the training views, arrays of numpy.
        options: Options of the rasterizer.
        masks: True for pixels of a view that are used, bool, shape [H, W] each; None for a view without a mask, or for no
            masks.
        max_pixels: Largest total number of pixels of all maps; above it, both sides of every map are reduced by the same
            factor.

    Returns:
        The views in the order of the cameras, on the device of the Gaussians.

    Raises:
        UsageError: A camera has no pinhole of the same K, such as an orthographic one.
    """
    pixels = sum(c.width * c.height for c in cameras)
    factor = min(1.0, (max_pixels / max(1, pixels)) ** 0.5)
    views = []
    for i, camera in enumerate(cameras):
        small = _resized(pinhole_of(camera), factor)
        depth = depth_of(gaussians, small, options)
        mask = None if masks is None else masks[i]
        if mask is not None:
            counts = torch.as_tensor(mask, dtype=torch.float32, device=depth.device)[None, None]
            counts = torch.nn.functional.interpolate(counts, depth.shape, mode="area")[0, 0]
            depth = torch.where(counts > 0.5, depth, 0)
        views.append(DepthView(small, depth))
    return views


def _resized(camera: Camera, factor: float) -> Camera:
    """Return the camera of the image at another size, at least one pixel on each side."""
    if factor == 1:
        return camera
    width, height = (max(1, int(factor * n)) for n in (camera.width, camera.height))
    scale = np.array([[width / camera.width], [height / camera.height], [1.0]])
    return replace(camera, K=scale * camera.K, width=width, height=height)


def match(depth: torch.Tensor, camera: Camera, other: DepthView) -> Match:
    """Compare the points that a view's pixels show with the surface that another view sees.

    Args:
        depth: z-depth of the pixels [u], 0 where there is no surface, shape [H, W].
        camera: Their camera, arrays of numpy.
        other: The other view.

    Raises:
        UsageError: ``camera`` is not a pinhole.
    """
    check_pinhole(camera)
    u, v, z = _seen_from(depth, camera, other.camera)
    height, width = other.depth.shape
    inside = (depth > 0) & (z > NEAR) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    left, top = torch.floor(u - 0.5), torch.floor(v - 0.5)
    columns = [(left + i).clamp(0, width - 1).long() for i in (0, 1)]
    rows = [(top + i).clamp(0, height - 1).long() * width for i in (0, 1)]
    flat = other.depth.flatten()
    around = torch.stack([flat[r + c] for r in rows for c in columns])
    distance = torch.where(around > 0, (around - z).abs(), torch.inf).amin(0)
    return Match(u, v, torch.where(inside, distance / z, torch.inf))


def _seen_from(depth: torch.Tensor, camera: Camera, other: Camera) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return column and row [px] and z-depth [u] in another view of the points at a view's pixels, shape [H, W] each.

    No product of matrices is used, because its bits would depend on the processor. For points behind the other view, columns
    and rows are undefined.
    """
    rotation, translation = relative_pose(camera, other)
    K, other_K = camera.K, other.K
    height, width = depth.shape
    x = (torch.arange(width, dtype=depth.dtype, device=depth.device) + 0.5 - float(K[0, 2])) / float(K[0, 0])
    y = (torch.arange(height, dtype=depth.dtype, device=depth.device) + 0.5 - float(K[1, 2])) / float(K[1, 1])
    px, py, z = (
        depth * (x[None] * float(r[0]) + (y[:, None] * float(r[1]) + float(r[2]))) + float(t)
        for r, t in zip(rotation, translation)
    )
    safe = torch.where(z > NEAR, z, torch.inf)
    u, v = (p / safe * float(other_K[i, i]) + float(other_K[i, 2]) for i, p in enumerate((px, py)))
    return u, v, z


@dataclass(frozen=True)
class Coverage:
    """Coverage of the pixels of one render; tensors of shape [H, W]."""

    counts: torch.Tensor
    """Number of training views that saw the point, at most `MAX_COUNT`, uint8; 0 where the render shows no surface."""
    difference: torch.Tensor
    """Least difference of depths to a training view, as in `Match`; infinite where the point is in no training image."""
    empty: torch.Tensor
    """True where the render shows no surface, bool."""


def coverage_map(depth: torch.Tensor, camera: Camera, training: Sequence[DepthView], tolerance: float = TOLERANCE) -> Coverage:
    """Count, for each pixel of a render, the training views that saw the point at this pixel.

    A view saw a point that is in its image, inside its mask, and on its rendered surface: neither behind the surface (occluded)
    nor in front of it (the view looks through). Counts use the model's depth, so they are as accurate as the model's geometry.

    Args:
        depth: z-depth of the render [u], 0 where there is no surface, shape [H, W], as `depth_of` gives it.
        camera: Camera of the render, arrays of numpy.
        training: Training views, from `depth_views`.
        tolerance: Largest difference of depths of one surface, as a fraction of the depth.

    Returns:
        The coverage, on the device of ``depth``.

    Raises:
        UsageError: ``camera`` is not a pinhole.
    """
    counts = torch.zeros(depth.shape, dtype=torch.int32, device=depth.device)
    least = torch.full_like(depth, torch.inf)
    for view in training:
        difference = match(depth, camera, view).difference
        counts += difference <= tolerance
        least = torch.minimum(least, difference)
    return Coverage(counts.clamp_max(MAX_COUNT).to(torch.uint8), least, depth <= 0)


def fraction_outside(depth: torch.Tensor, camera: Camera, photographs: Sequence[Camera], empty: bool = True) -> float:
    """Return the fraction of a render's pixels that show a point outside the images of all photographs, sampled on a grid.

    Unlike `coverage_map`, this function renders nothing, and counts occluded points as seen.

    Args:
        depth: z-depth of the render [u], 0 where there is no surface, shape [H, W].
        camera: Camera of the render, a pinhole; arrays of numpy.
        photographs: Cameras of the photographs; a lens is replaced by the pinhole of the same K.
        empty: Whether pixels without a surface are included, at the median depth of the other pixels.

    Raises:
        UsageError: A photograph has no pinhole of the same K, such as an orthographic one.
    """
    small = _resized(camera, min(1.0, GRID / max(camera.width, camera.height)))
    rows, columns = (
        ((torch.arange(few, device=depth.device) + 0.5) * (many / few)).long()
        for few, many in ((small.height, camera.height), (small.width, camera.width))
    )
    points = depth[rows][:, columns].cpu()
    shown = points > 0
    if not shown.any():
        return 0.0
    outside = torch.ones_like(shown) if empty else shown
    points = torch.where(shown, points, points[shown].median())
    for other in sorted(photographs, key=lambda c: float(np.linalg.norm(c.center - camera.center))):
        u, v, z = _seen_from(points, small, pinhole_of(other))
        outside = outside & ~((z > NEAR) & (u >= 0) & (u < other.width) & (v >= 0) & (v < other.height))
        if not outside.any():  # mostly after the nearest few
            break
    return float(outside.float().mean())
