"""Limits of the size and the shape of every Gaussian, applied in each step of a fit; and statistics of sizes and shapes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch

from warpgs import geometry
from warpgs.kernels.neighbours import camera_reach, pixel_size
from warpgs.scene import Camera, Gaussians, PointCloud, Tensors
from warpgs.schema import Checked, Within

WITHIN = 0.9
"""Fraction of the initial points within the radius of a scene; the farthest points are often wrong."""
NEEDLE = 30.0
"""Ratio of the longest to the middle axis above which a Gaussian is counted as a needle."""
MAX_CENTERS = 32
"""Largest number of cameras to which the distance of every Gaussian is measured in a step."""
ROUNDING = 1e-5
"""Tolerance of the logarithm of an axis at its limit: ten times the rounding error of float32."""


@dataclass(frozen=True)
class Limits:
    """Limits that one step holds every Gaussian to."""

    largest: float = math.inf
    """Largest standard deviation of an axis [u]."""
    ratio: float = math.inf
    """Largest ratio of the longest axis to the middle one."""
    reach: float = 0.0
    """Largest standard deviation of an axis, as a fraction of the distance to the nearest camera; 0 for no such limit."""
    pixels: float = 0.0
    """Smallest standard deviation of an axis [px], in the camera that samples the Gaussian most finely; 0 for no such limit."""

    @torch.no_grad()
    def hold(self, params: Tensors, cameras: tuple[torch.Tensor, torch.Tensor], going: torch.Tensor | None = None) -> None:
        """Bring ``log_scales`` [N, 3] of Gaussians at ``means`` [N, 3] within the limits, in place; twice is as once.

        Axes are raised to the smallest size, then cut to the largest, which has priority. If the longest axis is then too long
        for the middle one, the middle one grows. A flat disk stays flat. Moments of Adam do not change. The call may be part of
        a captured step. ``cameras`` are `camera_centers` and `camera_rows`. If ``going`` [1] is False, nothing changes.
        """
        if self == NO_LIMITS:
            return
        new = old = params["log_scales"].detach()
        if self.pixels > 0:
            new = torch.maximum(new, pixel_size(params["means"].detach(), cameras[1], self.pixels)[:, None])
        new = new.clamp(max=math.log(self.largest))
        if self.reach > 0:
            new = torch.minimum(new, camera_reach(params["means"].detach(), cameras[0], self.reach)[:, None])
        new = torch.where(old.isinf(), old, new)  # non-finite values stay visible
        if self.ratio < math.inf:
            longest, middle = (x[:, None] for x in long_axes(new))
            new = torch.where(new == middle, torch.maximum(new, longest - math.log(self.ratio)), new)
        old.copy_(new if going is None else torch.where(going, new, old))


NO_LIMITS = Limits()
"""Limits that change nothing."""
MIN_PIXELS = 0.2**0.5
"""Smallest standard deviation of an axis in an antialiased fit, in pixels of the training camera that samples the Gaussian most
finely: the 3D filter of Mip-Splatting (Yu et al. 2024), which it replaces, has a variance of 0.2 pixels squared."""
RATIO_FROM = 0.7
"""Fraction of the steps after which `LimitConfig.max_ratio` applies: long Gaussians help the first steps."""


@dataclass(frozen=True)
class LimitConfig(Checked, group="limits."):
    """Limits of every Gaussian of a fit."""

    max_size: Annotated[float, Within(0, 1e6)] = 1.0
    """Largest standard deviation of an axis, as a fraction of the scene's radius; 0 for no limit."""
    max_ratio: Annotated[float, Within(1, 1e6, zero=True)] = NEEDLE
    """Largest ratio of the longest axis to the middle one, at least 1; 0 for no limit."""
    max_reach: Annotated[float, Within(0, 1e6)] = 1 / 3
    """Largest standard deviation of an axis, as a fraction of the distance to the nearest training camera; 0 for no limit. With
    a third, three standard deviations reach no camera; larger Gaussians beside or behind training cameras would be fog in other
    views."""

    def at(self, progress: float, radius: float, antialiased: bool = False) -> Limits:
        """Return the limits of a step in a scene of a ``radius`` [u] (`scene_radius`).

        ``progress`` is the fraction of the fit that is done before the step; 1 for the last step, which has all limits.
        """
        held = self.max_ratio > 0 and (progress > RATIO_FROM or progress == 1)
        largest = self.max_size * radius if self.max_size > 0 else math.inf
        return Limits(largest, self.max_ratio if held else math.inf, self.max_reach, MIN_PIXELS if antialiased else 0.0)


def camera_rows(cameras: Sequence[Camera], device: torch.device) -> torch.Tensor:
    """Return the cameras as `pixel_size` takes them, float32 [C, 9]; the cone of each holds eight points of its image's border.

    If the lens does not reach one of these points, the cone is the whole field of view of the lens. For a camera model without
    a centre, pixels have size 0 and limit nothing.
    """
    rows, ends = [], np.array([(x, y) for x in (0, 0.5, 1) for y in (0, 0.5, 1) if (x, y) != (0.5, 0.5)])
    for camera in cameras:
        f, by_distance, central = camera.K[[0, 1], [0, 1]], camera.model == "fisheye", camera.model in geometry.CENTRAL
        cosine = -1.0 if by_distance else 0.0
        if central:
            points = (ends * (camera.width, camera.height) - camera.K[:2, 2]) / f
            rays = geometry.from_plane(camera.model, camera.distortion, points)
            cosines = rays[:, 2] / np.linalg.norm(rays, axis=1)
            cosine = float(cosines.min()) if np.isfinite(cosines).all() else cosine
        rows.append([*camera.center, *camera.viewmat[2, :3], f.max() if central else math.inf, cosine, by_distance])
    return torch.as_tensor(np.array(rows), dtype=torch.float32, device=device)


def camera_centers(cameras: Sequence[Camera], device: torch.device) -> torch.Tensor:
    """Return the positions of at most `MAX_CENTERS` of the cameras, evenly chosen [u], float32, shape [C, 3]."""
    chosen = cameras[:: -(-len(cameras) // MAX_CENTERS)]
    return torch.as_tensor(np.stack([c.center for c in chosen]), dtype=torch.float32, device=device)


def long_axes(log_scales: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the logarithms of the longest and of the middle axis, shape [N] each; ``log_scales`` has shape [N, 3]."""
    a, b, c = log_scales.unbind(1)
    low, high = torch.minimum(a, b), torch.maximum(a, b)
    return torch.maximum(high, c), torch.maximum(low, torch.minimum(high, c))


def scene_radius(cameras: list[Camera], cloud: PointCloud) -> float:
    """Return the radius around the mean of the cameras that contains all cameras and 90 % of the initial points [u].

    `scene_extent` differs: it is the size of the camera set, unless all cameras coincide. The photographed scene may be much
    larger or smaller.
    """
    centers = np.array([c.center for c in cameras])
    center = centers[geometry.near_cameras(centers, cloud.points)].mean(0)
    reach = float(np.quantile(np.linalg.norm(cloud.points - center, axis=1), WITHIN)) if len(cloud) else 0.0
    return max(reach, geometry.camera_extent(cameras, cloud.points), 1e-6)


def shape_figures(
    gaussians: Gaussians, config: LimitConfig, radius: float, extent: float, cameras: Sequence[Camera]
) -> dict[str, Any]:
    """Return the figures of size and shape of a model for metrics.json; at least one camera, a limit of 0 is never exceeded.

    ``radius`` and ``extent`` [u] (`scene_radius`, `scene_extent`); the ``largest`` standard deviation [u], and its ratios to
    both; the largest ratio of a standard deviation to the distance of the nearest of `camera_centers`; ``needles``, the
    fraction of Gaussians whose longest axis is more than `NEEDLE` times the middle one; ``needles_by_opacity``, this fraction
    weighted by opacity; ``thin``, the fraction whose longest axis is more than `NEEDLE` times the shortest; and the number of
    Gaussians ``beyond`` the limits.
    """
    scales = gaussians.log_scales.detach().cpu().double()
    longest, middle = long_axes(scales)
    opacities = gaussians.logit_opacities.detach().cpu().double().sigmoid()
    needle = longest - middle > math.log(NEEDLE) + ROUNDING
    thin = longest - scales.amin(1) > math.log(NEEDLE) + ROUNDING
    at = config.at(1.0, radius)
    means, centers = gaussians.means.detach().cpu().float(), camera_centers(cameras, torch.device("cpu"))
    over = longest - camera_reach(means, centers, 1.0).double()
    beyond = (longest > math.log(at.largest) + ROUNDING) | (longest - middle > math.log(at.ratio) + ROUNDING)
    if at.reach > 0:
        beyond |= over > math.log(at.reach) + ROUNDING
    count, sigma = max(1, len(gaussians)), float(longest.max().exp()) if len(gaussians) else 0.0
    # exactly rounded sums, the same for any number of threads
    weight = math.fsum(opacities[needle].tolist()) / max(math.fsum(opacities.tolist()), 1e-30)
    return {
        "radius": radius, "extent": extent, "largest": sigma, "largest_over_radius": sigma / radius,
        "largest_over_extent": sigma / extent, "largest_over_distance": float(over.max().exp()) if len(over) else 0.0,
        "needles": int(needle.sum()) / count, "needles_by_opacity": weight,
        "thin": int(thin.sum()) / count, "beyond": int(beyond.sum()),
    }  # fmt: skip


def shape_summary(f: dict[str, Any]) -> str:
    """Return the values of `shape_figures` as one line for the user."""
    return (
        f"shape: the largest axis is {f['largest_over_radius']:.2g} of the scene's radius; {f['needles']:.1%} of the Gaussians "
        f"are needles, more than {NEEDLE:g} times as long as wide; {f['beyond']:,} exceed the limits"
    )
