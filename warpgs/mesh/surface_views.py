"""Surface of a model that each camera sees: depth, weight of the depth, and colour."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from warpgs.errors import UsageError
from warpgs.geometry import back_project, pinhole_of
from warpgs.kernels.tsdf import face_cosines
from warpgs.mesh.ray_depth import CONTRIBUTORS, MIN_SHARE, surface_depth
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

DEPTHS = ("median", "mean")
"""Kinds of rendered depth that can be fused."""
MIN_ALPHA = 0.5
"""Least opacity of a pixel that shows a surface."""
EMPTY = 0.02
"""Opacity below which a pixel is empty: five of 255 levels."""
SAMPLES = 200_000
"""Number of pixels of all views that are sampled to find the extent of the surfaces."""
KEPT_PIXELS = 2**24
"""Largest number of pixels of all views together for which renders are kept, 320 MiB; otherwise every use renders again."""


@dataclass(frozen=True)
class SurfaceView:
    """Surface that one camera sees."""

    camera: Camera
    """Pinhole camera, arrays of numpy."""
    depth: torch.Tensor
    """z-depth [u], shape [H, W]; infinite for an empty pixel, 0 where the depth is uncertain."""
    weights: torch.Tensor
    """Weight of each pixel, in [0, 1], shape [H, W]: the cosine between ray and normal, times alpha if there is a surface."""
    image: torch.Tensor
    """Colours, shape [H, W, 3]."""


@torch.no_grad()
def surface_view(gaussians: Gaussians, camera: Camera, options: RasterizeOptions, depth: str = "median") -> SurfaceView:
    """Render what a camera sees of the surface.

    Args:
        gaussians: N Gaussians in the units of the camera.
        camera: Camera, arrays of numpy; a lens is replaced by the pinhole of the same K.
        options: Settings of the rasterizer.
        depth: Depth to use, one of `DEPTHS`.

    Raises:
        UsageError: The camera has no pinhole of the same K, or the depth is unknown.
    """
    if depth not in DEPTHS:
        raise UsageError(f"depth {depth!r} is not one of {', '.join(DEPTHS)}")
    camera = pinhole_of(camera)
    r = rasterize(gaussians, camera, replace(options, heaviest=CONTRIBUTORS if depth == "median" else 0))
    z = r.depth
    if r.heaviest_ids is not None and r.heaviest_weights is not None:
        z, share = surface_depth(gaussians, camera, r.heaviest_ids, r.heaviest_weights)
        z = torch.where(share >= MIN_SHARE, z, 0)
    z = torch.where(r.alpha >= MIN_ALPHA, z, torch.where(r.alpha <= EMPTY, torch.inf, 0.0)).contiguous()
    weights = face_cosines(z, camera) * torch.where(torch.isfinite(z), r.alpha, 1.0)
    return SurfaceView(camera, z, weights, r.rgb.contiguous())


class SurfaceViews:
    """Surfaces that the cameras see, in the order of the cameras; they can be iterated several times.

    If all views together have at most `KEPT_PIXELS` pixels, each view is rendered once and kept. Otherwise every iteration
    renders the views again, one at a time.
    """

    def __init__(
        self, gaussians: Gaussians, cameras: Sequence[Camera], options: RasterizeOptions, depth: str,
        stage: Callable[[str], object] = lambda line: None,
    ) -> None:  # fmt: skip
        """Prepare to render a model from all cameras.

        Args:
            gaussians: N Gaussians in the units of the cameras.
            cameras: Cameras, arrays of numpy.
            options: Settings of the rasterizer.
            depth: Depth to use, one of `DEPTHS`.
            stage: Function that shows a line of progress, before each view.
        """
        self._render = lambda camera: surface_view(gaussians, camera, options, depth)
        self._cameras, self._stage = cameras, stage
        self._keeps = sum(c.width * c.height for c in cameras) <= KEPT_PIXELS
        self._kept: dict[int, SurfaceView] = {}

    def __call__(self, purpose: str) -> Iterator[SurfaceView]:
        """Yield what each camera sees of the surface.

        Args:
            purpose: Text for the line of progress.

        Raises:
            UsageError: A camera has no pinhole of the same K, or the depth is unknown.
        """
        for i, camera in enumerate(self._cameras):
            self._stage(f"{purpose}: view {i + 1} of {len(self._cameras)}")
            view = self._kept.get(i) or self._render(camera)
            if self._keeps:
                self._kept[i] = view
            yield view


def sample_surface(view: SurfaceView, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points of the surface that a view sees, on an even grid of its pixels.

    Args:
        view: The view.
        count: Approximate number of pixels to sample.

    Returns:
        Positions [u], shape [N, 3], and the width of a pixel there [u], shape [N].
    """
    depth, camera = view.depth.cpu().numpy().astype(np.float64), view.camera
    step = max(1, round((depth.size / count) ** 0.5))
    row, column = np.mgrid[step // 2 : depth.shape[0] : step, step // 2 : depth.shape[1] : step].reshape(2, -1)
    z = depth[row, column]
    seen = (z > 0) & np.isfinite(z)
    pixels = np.stack([column, row], 1)[seen] + 0.5
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    return back_project(camera, pixels, z[seen]), z[seen] / focal
