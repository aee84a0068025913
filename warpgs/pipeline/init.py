"""The first Gaussians: from the reconstruction's points, or at random where the training cameras look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from warpgs import geometry
from warpgs.errors import DataError, UsageError
from warpgs.kernels.knn import mean_square_distances
from warpgs.kernels.sh import C0, coefficient_count
from warpgs.priors.matches import triangulate_matches
from warpgs.scene import Gaussians, PointCloud, View

MIN_POINTS = 100
"""With fewer sparse points a random start is better: they leave most of the picture empty."""


@dataclass(frozen=True)
class InitConfig:
    """Where the first Gaussians come from."""

    source: str = "auto"
    """points (the reconstruction's), random, or auto: points where the scene has at least 100 that training views saw."""
    random_count: int = 20_000
    """Number of random points."""
    opacity: float = 0.1
    """First opacity, in (0, 1)."""
    max_sh_degree: int = 3
    """Spherical-harmonics degree stored, 0 to 3."""

    def __post_init__(self):
        if self.source not in ("auto", "points", "random"):
            raise UsageError(f"init source {self.source!r} is not one of auto, points, random")
        if not 0 < self.opacity < 1:
            raise UsageError(f"init opacity {self.opacity} must lie between 0 and 1")
        if self.random_count < 1:
            raise UsageError(f"init random count {self.random_count} must be at least 1")


def depth_bounds(views: list[View]) -> tuple[float, float, str]:
    """Near and far depth [u] of what the views see, and how it was found.

    From triangulated SIFT matches between the views where there are enough (their 2nd and 98th percentile, widened by a
    quarter); else from a tenth of the distance to the cameras' focus point to ten times it.
    """
    cloud = triangulate_matches(views)
    if len(cloud) >= 30:
        depths = np.concatenate([geometry.project_points(v.camera, cloud.points)[1] for v in views])
        near, far = np.percentile(depths[depths > 0], [2, 98])
        return 0.8 * near, 1.25 * far, f"depths {0.8 * near:.2f} to {1.25 * far:.2f} from {len(cloud)} matched points"
    focus = geometry.focus_point([v.camera for v in views])
    distance = float(np.median([np.linalg.norm(v.camera.center - focus) for v in views]))
    distance = max(distance, 1e-3)
    return 0.1 * distance, 10 * distance, f"depths {0.1 * distance:.2f} to {10 * distance:.2f} guessed from the cameras"


def random_points(views: list[View], count: int, generator: np.random.Generator) -> tuple[PointCloud, str]:
    """Points on random pixels of random training views, uniform in inverse depth, kept where two views see them.

    Colours are those of the pixels. Returns the cloud and a sentence on how it was made.
    """
    near, far, how = depth_bounds(views)
    need = min(2, len(views))
    kept_points, kept_colors, kept = [], [], 0
    for attempt in range(50):
        size = 4 * count
        points, colors = np.empty((size, 3)), np.empty((size, 3), np.float32)
        which = generator.integers(len(views), size=size)
        for i, view in enumerate(views):
            rows = np.flatnonzero(which == i)
            x = generator.integers(view.camera.width, size=len(rows))
            y = generator.integers(view.camera.height, size=len(rows))
            depths = 1 / generator.uniform(1 / far, 1 / near, size=len(rows))
            points[rows] = geometry.back_project(view.camera, np.stack([x, y], 1) + 0.5, depths)
            colors[rows] = view.image[y, x]
            if view.mask is not None:
                which[rows[~view.mask[y, x]]] = -1
        seen = sum(geometry.in_image(v.camera, points).astype(int) for v in views)
        keep = (seen >= need) & (which >= 0)
        kept_points.append(points[keep])
        kept_colors.append(colors[keep])
        kept += int(keep.sum())
        if kept >= count:
            break
        if attempt == 9 and kept < count // 10:
            need = 1  # the views hardly overlap: rather points that one view sees than none
    points, colors = np.concatenate(kept_points)[:count], np.concatenate(kept_colors)[:count]
    if len(points) == 0:
        raise DataError("no random start: every pixel of the training views is masked out; check the masks' polarity")
    seen_by = "at least two training views" if need == 2 else "one training view"
    return PointCloud(points, colors), f"{len(points):,} random points that {seen_by} see, {how}"


def initial_points(
    views: list[View], points: PointCloud | None, config: InitConfig, generator: np.random.Generator
) -> tuple[PointCloud, str]:
    """The points to start from and a sentence on where they come from.

    Raises:
        DataError: Points were asked for and the scene has none that the training views saw.
    """
    names = {v.name for v in views}
    usable = points.seen_by(names) if points is not None else PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    if config.source == "points" and len(usable) == 0:
        raise DataError(
            "the scene holds no 3D points that the training views saw, and --init.source points asks for them; "
            "use --init.source random, or give a reconstruction with points"
        )
    if config.source == "points" or (config.source == "auto" and len(usable) >= MIN_POINTS):
        return usable, f"{len(usable):,} points of the reconstruction that the training views saw"
    cloud, how = random_points(views, config.random_count, generator)
    if config.source == "auto" and points is not None:
        how += f" (the reconstruction has only {len(usable)} points that the training views saw)"
    return cloud, how


def initial_gaussians(cloud: PointCloud, config: InitConfig, extent: float, device: torch.device) -> Gaussians:
    """One isotropic Gaussian per point, as wide as the root mean square distance to its three neighbours.

    Args:
        cloud: At least one point.
        config: Opacity and degree.
        extent: Size of the scene [u]; widths are kept between 1e-6 and 0.1 of it, so coincident or lone points get one too.
        device: Where the tensors go, float32.

    Returns:
        The Gaussians.
    """
    points = torch.as_tensor(cloud.points, dtype=torch.float32, device=device)
    colors = torch.as_tensor(cloud.colors, dtype=torch.float32, device=device)
    count = len(points)
    scales = mean_square_distances(points).sqrt().clamp(1e-6 * extent, 0.1 * extent)
    sh = points.new_zeros(count, coefficient_count(config.max_sh_degree), 3)
    sh[:, 0] = (colors - 0.5) / C0
    quats = points.new_zeros(count, 4)
    quats[:, 0] = 1
    logit = float(np.log(config.opacity / (1 - config.opacity)))
    return Gaussians(
        means=points,
        quats=quats,
        log_scales=scales.log()[:, None].repeat(1, 3),
        logit_opacities=points.new_full((count,), logit),
        sh=sh,
    )
