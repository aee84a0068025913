"""The initial Gaussians: from depths that views confirm, from the reconstruction's points, from a visual hull, or at random."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from warpgs import geometry
from warpgs.colors import base_coefficients
from warpgs.errors import DataError, UsageError
from warpgs.kernels.knn import mean_square_distances
from warpgs.kernels.sh import coefficient_count
from warpgs.pipeline.model.depth_points import NOTHING, coarse_points, depth_bounds, joined
from warpgs.pipeline.model.extrapolation import EXTRAPOLATED_OPACITY, all_count, extrapolated_points
from warpgs.pipeline.model.hull import hull_points, in_empty_region, silhouettes
from warpgs.pipeline.model.random_points import camera_depths, random_points
from warpgs.priors.epipolar import EpipolarConfig, flow_depth
from warpgs.priors.flow import RANGES, flow_between
from warpgs.priors.given_depth import any_given, with_given_depth
from warpgs.priors.matches import triangulate_matches
from warpgs.priors.sweep import CPU, SweepConfig, sweep_depths
from warpgs.scene import Camera, Gaussians, PointCloud, View, ViewDepth

SOURCES = ("auto", "sweep", "flow", "points", "hull", "random")
MIN_POINTS = 100
"""Fewest sparse points to start from: with fewer, most of the image is empty, and a random start is better."""


@dataclass(frozen=True)
class InitConfig:
    """Source and initial values of the Gaussians."""

    source: str = "auto"
    """Source of the first points: sweep or flow (one for each pixel with depth that other views confirm), points (those of the
    reconstruction), random, hull (surface of the visual hull of views with an alpha channel), or auto. auto is sweep if depth
    is given, or for at most --init.sweep-up-to views; else points if the training views saw at least 100 points; else random.
    If views have an alpha channel, points in an empty area of a view are left out."""
    sweep_up_to: int = 0
    """auto: largest number of training views for a start by sweep, which takes about a second per view on two cores."""
    random_count: int = 20_000
    """Number of random points."""
    opacity: float = 0.1
    """Initial opacity, in (0, 1)."""
    scale_factor: float = 1.0
    """Initial standard deviation of a Gaussian, as a multiple of the distance to its neighbours, in [0.001, 10]."""
    near_views: int = 4
    """sweep, flow: number of other views with which each view is matched."""
    merge_px: float = 4.0
    """sweep, flow: width of the cells in which points of confirmed depth are merged [px]; 0 keeps a point for every pixel."""
    fill_px: float = 16.0
    """sweep, flow: cell width [px] for filling in points where other views do not confirm depth; 0 fills in none."""
    extrapolate: bool | None = False
    """sweep, flow: add extrapolated points where no view looks, beyond the images and behind depth edges
    (docs/decisions/026-extrapolated-points.md). In a fit with such points, opacity decay spares Gaussians that a step does not
    use. No points are added if a view has a mask, an alpha channel or a black background. None: chosen by the number of
    views."""
    flow: str = "dis"
    """flow: source of optical flow: dis, deepflow, sparse, a folder of .flo files or an ONNX file (images in, flow out)."""
    flow_range: str = "255"
    """flow: range of input colours of an ONNX file: 255 (0 to 255), unit (0 to 1) or signed (-1 to 1)."""
    max_residual: float = 1.0
    """flow: largest distance of a match from its epipolar line [px]."""
    blend: str = "least_sensitive"
    """flow: rule to combine depths from several views: least_sensitive, nearest_first, mean_valid or inverse_sensitivity."""

    def __post_init__(self):
        if self.source not in SOURCES:
            raise UsageError(f"init: `source` {self.source!r} is not one of {', '.join(SOURCES)}")
        for name in ("merge_px", "fill_px", "sweep_up_to"):
            if not 0 <= getattr(self, name) < np.inf:
                raise UsageError(f"init: `{name.replace('_', '-')}` must be 0 or more, not {getattr(self, name)}")
        if self.flow_range not in RANGES:
            raise UsageError(f"init: `flow-range` {self.flow_range!r} is not one of {', '.join(RANGES)}")
        self.epipolar()  # its own checks
        if not 1e-3 <= self.scale_factor <= 10:
            raise UsageError(f"init: `scale-factor` must be between 0.001 and 10, not {self.scale_factor}")
        if not 0 < self.opacity < 1:
            raise UsageError(f"init: `opacity` must be in (0, 1), not {self.opacity}")
        if self.random_count < 1:
            raise UsageError(f"init: `random-count` must be at least 1, not {self.random_count}")

    def epipolar(self) -> EpipolarConfig:
        """Return the settings of depth from flow.

        Raises:
            UsageError: A setting is out of range.
        """
        return EpipolarConfig(max_residual=self.max_residual, near_count=self.near_views, blend=self.blend)


class Start(NamedTuple):
    """The points that a fit starts from."""

    cloud: PointCloud
    """Positions and colours."""
    how: str
    """Description of the points and their source, for the user."""
    depths: list[ViewDepth] | None = None
    """Geometrically consistent depth of each view; None if not computed."""
    extrapolated: int = 0
    """Number of extrapolated points, where no view looks; they are the last points of the cloud."""


def consistent_depths(
    views: list[View], known: PointCloud, config: InitConfig, device: Callable[[], torch.device] = lambda: CPU,
    progress: Callable[[str], object] = lambda line: None,
) -> list[ViewDepth]:  # fmt: skip
    """Return the geometrically consistent depth of each of at least two views, by flow or by sweeping planes.

    Args:
        views: Training views.
        known: Points that bound the planes.
        config: Source and its settings.
        device: Function that waits until the device to sweep on may be used, and returns it.
        progress: Called with a line for the user about the current work.
    """
    if config.source == "flow":
        between = flow_between(views, config.flow, config.flow_range)
        return [flow_depth(views, i, between, config.epipolar()) for i in range(len(views))]
    points = np.concatenate([known.points, triangulate_matches(views).points])
    bounds = [depth_bounds(v, points, camera_depths(views)) for v in views]
    return sweep_depths(
        views, bounds, SweepConfig(near_count=config.near_views), device(),
        lambda done, total: progress(f"finding depth: {done} of {total} views"),
    )  # fmt: skip


def consistent_points(
    views: list[View], points: PointCloud, config: InitConfig, generator: np.random.Generator,
    device: Callable[[], torch.device], progress: Callable[[str], object],
) -> Start:  # fmt: skip
    """Return points behind pixels whose depth other views confirm, and a line on each view.

    If fewer than `MIN_POINTS` points are found, the start is random, with a note.
    """
    reason, depths, given, source = "depth needs at least two views", None, [], config.source
    if len(views) > 1:
        depths = consistent_depths(views, points, config, device, progress)
    if any_given(views):
        source, (depths, given) = f"given depth and {source}", with_given_depth(views, depths, points)
    if depths is not None:
        cloud, notes = coarse_points(
            views, depths, merge_px=config.merge_px, fill_px=config.fill_px, source=source, known=points
        )
        if len(cloud) >= MIN_POINTS:
            extrapolated = extrapolated_points(views, depths) if config.extrapolate else NOTHING
            if config.extrapolate:
                notes[-1] += f", {_number_extrapolated(views, len(extrapolated))}"
            how = "\n".join((notes[-1], *given, *(f"    {n}" for n in notes[:-1])))
            return Start(joined((cloud, extrapolated)), how, depths, len(extrapolated))
        reason = f"only {len(cloud)} points survived the checks ({' | '.join(notes[:-1])}); do the views overlap?"
    cloud, how = random_points(views, config.random_count, generator)
    return Start(cloud, f"{how}, instead of --init.source {config.source}: {reason}", depths)


def _number_extrapolated(views: list[View], count: int) -> str:
    """Describe, for the user, how many points are extrapolated, or why there are none."""
    if count:
        return f"{count:,} extrapolated where no view looks"
    hidden = "" if all_count(views) else ", because masks, an alpha channel or a black background hide parts of the views"
    return f"none extrapolated{hidden}"


def seen_points(views: list[View], points: PointCloud | None) -> PointCloud:
    """Return the reconstruction's points that at least two views saw, or that the only view saw; none without a reconstruction.

    A point that only one of several views saw was triangulated with held-out views.
    """
    return NOTHING if points is None else points.seen_by({v.name for v in views}, min(2, len(views)))


def sweeps(config: InitConfig, views: int) -> bool:
    """Return whether a fit of that many views starts from a sweep."""
    return config.source == "sweep" or (config.source == "auto" and 2 <= views <= config.sweep_up_to)


def extrapolates(config: InitConfig, views: list[View]) -> bool:
    """Return whether the start of a fit of these views has extrapolated points, if it finds depth."""
    if not config.extrapolate or len(views) < 2:
        return False
    searches = config.source == "flow" or sweeps(config, len(views)) or (config.source == "auto" and any_given(views))
    return searches and all_count(views)


def check_points(views: list[View], points: PointCloud | None, config: InitConfig) -> None:
    """Check that a start from points has points that the training views saw.

    Raises:
        DataError: The training views saw no points, and ``config`` needs them.
    """
    if config.source == "points" and len(seen_points(views, points)) == 0:
        raise DataError(
            "--init.source points needs 3D points that the training views saw, but the scene has none; use --init.source "
            "random, or give a reconstruction with points"
        )


def on_object(start: Start, views: list[View]) -> Start:
    """Return the start without points in empty areas of views with an alpha channel.

    If fewer than `MIN_POINTS` points would be left, the start is unchanged.
    """
    shapes = silhouettes(views)
    if not shapes:
        return start
    cloud = start.cloud
    keep = ~in_empty_region(shapes, cloud.points)
    if keep.all():
        return start
    count = int(keep.sum())
    if count < MIN_POINTS:
        few = f"only {count} of these points are outside the empty areas of all views; check the poses"
        return start._replace(how=f"{start.how}\n{few}")
    how = f"{start.how}\n{len(keep) - count:,} of these points left out: they are in an empty area of a view"
    return start._replace(cloud=PointCloud(cloud.points[keep], cloud.colors[keep]), how=how)


def initial_points(
    views: list[View], points: PointCloud | None, config: InitConfig, generator: np.random.Generator,
    device: Callable[[], torch.device] = lambda: CPU, progress: Callable[[str], object] = lambda line: None,
) -> Start:  # fmt: skip
    """Return the points to start from.

    ``device`` waits until the device to sweep on may be used, and returns it; ``progress`` is called with lines about the
    current work.

    Raises:
        DataError: The training views saw no points, and ``config`` needs them; or masks leave no pixel for a random start.
    """
    check_points(views, points, config)
    if config.source == "hull":
        cloud, how = hull_points(views, config.merge_px)
        if len(cloud) >= MIN_POINTS:
            return Start(cloud, how)
        cloud, made = random_points(views, config.random_count, generator)
        return Start(cloud, f"{made}, instead of --init.source hull: {how}")
    found = on_object(_found_points(views, points, config, generator, device, progress), views)
    if config.extrapolate and found.depths is None:
        return found._replace(how=f"{found.how}\nno extrapolated points: they need --init.source sweep or flow")
    return found


def _found_points(
    views: list[View], points: PointCloud | None, config: InitConfig, generator: np.random.Generator,
    device: Callable[[], torch.device], progress: Callable[[str], object],
) -> Start:  # fmt: skip
    """Return the points of a source other than the hull."""
    usable = seen_points(views, points)
    if config.source == "auto" and (sweeps(config, len(views)) or any_given(views)):
        return consistent_points(views, usable, dataclasses.replace(config, source="sweep"), generator, device, progress)
    if config.source in ("sweep", "flow"):
        return consistent_points(views, usable, config, generator, device, progress)
    if config.source == "points" or (config.source == "auto" and len(usable) >= MIN_POINTS):
        return Start(usable, f"{len(usable):,} points of the reconstruction that the training views saw")
    cloud, how = random_points(views, config.random_count, generator)
    if config.source == "auto" and points is not None:
        how += f" (the reconstruction has only {len(usable)} points that the training views saw)"
    return Start(cloud, how)


def subsample(start: Start, most: int, generator: np.random.Generator) -> Start:
    """Return the start with at most ``most`` points, sampled at random; sparser points get wider Gaussians."""
    count = len(start.cloud)
    if count <= most:
        return start
    keep = np.sort(generator.permutation(count)[:most])
    how = f"{start.how}\nused {most:,} of these {count:,} points, sampled at random, because --max-gaussians is {most:,}"
    cloud = PointCloud(start.cloud.points[keep], start.cloud.colors[keep])
    return start._replace(cloud=cloud, how=how, extrapolated=int((keep >= count - start.extrapolated).sum()))


def scene_extent(cameras: list[Camera], cloud: PointCloud) -> float:
    """Return the size of the scene [u]: the extent of the cameras, or a tenth of the cloud's spread if all cameras coincide."""
    extent = geometry.camera_extent(cameras)
    spread = float(np.linalg.norm(np.std(cloud.points, axis=0)))
    return max(extent, 0.1 * spread if extent < 1e-3 * spread else 0.0, 1e-6)


def initial_gaussians(
    cloud: PointCloud, config: InitConfig, sh_degree: int, extent: float, device: torch.device, extrapolated: int = 0
) -> Gaussians:
    """Return one isotropic Gaussian per point; widths follow the root mean square distance to the three nearest points.

    Args:
        cloud: At least one point.
        config: Opacity, and the factor from distances to widths.
        sh_degree: Degree of the spherical harmonics, 0 to 4.
        extent: Size of the scene [u]; the distances are limited to 1e-6 to 0.1 of the size, also for coincident or lone points.
        device: Device of the tensors, float32.
        extrapolated: Number of extrapolated points, which are the last of the cloud and start with `EXTRAPOLATED_OPACITY`.

    Returns:
        The Gaussians.
    """
    points = torch.as_tensor(cloud.points, dtype=torch.float32, device=device)
    colors = torch.as_tensor(cloud.colors, dtype=torch.float32, device=device)
    count = len(points)
    # in float64, since the rounding of float32's roots and logarithms depends on the processor (MKL)
    distances = mean_square_distances(points).double().sqrt()
    scales = config.scale_factor * distances.clamp(1e-6 * extent, 0.1 * extent)
    sh = points.new_zeros(count, coefficient_count(sh_degree), 3)
    sh[:, 0] = base_coefficients(colors)
    quats = points.new_zeros(count, 4)
    quats[:, 0] = 1
    logits = points.new_full((count,), geometry.logit(config.opacity))
    logits[count - extrapolated :] = geometry.logit(EXTRAPOLATED_OPACITY)
    return Gaussians(
        means=points,
        quats=quats,
        log_scales=scales.log().to(points.dtype)[:, None].repeat(1, 3),
        logit_opacities=logits,
        sh=sh,
    )
