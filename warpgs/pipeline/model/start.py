"""The first Gaussians of a fit: from points, depth or random places."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import numpy as np
import torch

from warpgs import geometry
from warpgs.clock import section
from warpgs.errors import DataError
from warpgs.kernels.neighbours import mean_square_distances
from warpgs.kernels.sh import coefficient_count
from warpgs.pipeline.metrics.scores import fitted_region
from warpgs.pipeline.model import depth_points
from warpgs.priors.flow import flow_between, flow_depth, triangulate_matches
from warpgs.priors.given_depth import any_given, with_given_depth
from warpgs.priors.sweep import CPU, sweep_depths
from warpgs.process import Say, silent
from warpgs.scene import Camera, Gaussians, PointCloud, View, ViewDepth, base_coefficients
from warpgs.schema import Checked, Within

OBJECTS = ("foreground", "object")
"""Names of the regions of an object (`fitted_region`): object on black, and object that an alpha channel cuts out."""
MIN_MATCHES = 10
"""Fewest matched points of a view that give depths to its random points."""
NEIGHBORS = 5
"""Number of nearest matched points from which a random pixel takes its depth."""
PAIRS = 2**20
"""Largest number of distances in memory at a time while neighbours are searched."""
DEPTH_SPREAD = 0.1
"""Standard deviation of the logarithm of depth around a matched point."""


Device = Callable[[], torch.device]
"""A function that waits until the device to sweep on may be used, and returns it."""


def camera_depths(views: list[View]) -> tuple[float, float]:
    """Return the default near and far depth [u]: 0.1 and 10 times the distance to the cameras' focus point.

    Cameras in one place with one direction have no focus point; then the distance is 1 u.
    """
    focus = geometry.focus_point([v.camera for v in views])
    distance = float(np.median([np.linalg.norm(v.camera.center - focus) for v in views]))
    distance = distance if distance > 1e-3 else 1.0
    return 0.1 * distance, 10 * distance


def nearest(points: np.ndarray, queries: np.ndarray, count: int) -> np.ndarray:
    """Return the rows of the ``count`` points [P, 2] nearest to each query [Q, 2], the nearest first, int64 [Q, count]."""
    known = torch.from_numpy(points)
    rows = []
    # every pair, some rows at a time: a few hundred points take less time than importing a library of search trees
    for asked in torch.from_numpy(queries).split(max(1, PAIRS // max(1, len(known)))):
        rows.append(sum((asked[:, i, None] - known[None, :, i]) ** 2 for i in range(2)).topk(count, largest=False).indices)
    return torch.cat(rows).numpy()


class _Depths:
    """Random depths for pixels of one view: near the depths of nearby matched points, else between the default bounds."""

    def __init__(self, view: View, matched: PointCloud, bounds: tuple[float, float]):
        seen = geometry.in_image(view.camera, matched.points)
        pixels, self.known = geometry.project_points(view.camera, matched.points)
        self.pixels, self.known, self.bounds = pixels[seen], self.known[seen], bounds
        self.has_matches = len(self.known) >= MIN_MATCHES

    def sample(self, pixels: np.ndarray, wanted: int, generator: np.random.Generator) -> np.ndarray:
        """Return depths [u] of the first ``wanted`` pixels, shape [wanted].

        Random numbers are sampled for all pixels [N, 2], so that a depth does not depend on how many are wanted.
        """
        count = len(pixels)
        if not self.has_matches:
            near, far = self.bounds
            return 1 / generator.uniform(1 / far, 1 / near, size=count)[:wanted]
        which, spread = generator.integers(NEIGHBORS, size=count), generator.normal(0, DEPTH_SPREAD, count)
        ids = nearest(self.pixels, pixels[:wanted], NEIGHBORS)
        return self.known[ids[np.arange(wanted), which[:wanted]]] * np.exp(spread[:wanted])


def empty_votes(views: list[View], regions: list[tuple[np.ndarray | None, str]], points: np.ndarray) -> np.ndarray:
    """Count the views in which each point [N, 3] falls on the empty background, int [N]: 0 within the visual hull."""
    votes = np.zeros(len(points), int)
    for view, (region, name) in zip(views, regions):
        if name not in OBJECTS:
            continue
        seen, rows, columns, _ = geometry.seen_pixels(view.camera, points)
        votes[seen] += ~region[rows, columns]
    return votes


def random_points(views: list[View], count: int, generator: np.random.Generator) -> tuple[PointCloud, str]:
    """Return points behind random pixels of the training views with the pixels' colours, and a sentence on how they were made.

    A view with at least 10 triangulated SIFT matches takes each depth from one of the 5 matches nearest to the pixel, spread by
    a tenth (docs/decisions/003-random-start.md). Any other view samples inverse depths uniformly, and prefers points that a
    second view sees. If views show an object on black, or have an alpha channel, points start on the object. Several candidates
    are made, and those that fall on empty pixels in the fewest views are taken, to avoid empty space.

    Raises:
        DataError: Masks leave no pixel of any training view.
    """
    regions = [fitted_region(v) for v in views]
    matched, bounds = triangulate_matches(views), camera_depths(views)
    sources = [_Depths(v, matched, bounds) for v in views]
    objects, cut_out = (sum(name == of for _, name in regions) for of in OBJECTS)
    points, colors = [], []
    for i, (view, source, (region, _)) in enumerate(zip(views, sources, regions)):
        wanted = (i + 1) * count // len(views) - i * count // len(views)
        rows, columns = np.nonzero(np.ones(view.image.shape[:2], bool) if region is None else region)
        if len(rows) == 0:
            continue
        chosen = generator.integers(len(rows), size=8 * wanted)
        rows, columns = rows[chosen], columns[chosen]
        pixels = np.stack([columns, rows], 1) + 0.5
        elsewhere = not source.has_matches and len(views) > 1
        # where all are equally good, the first are taken, and the others need no depth
        useful = len(pixels) if elsewhere or objects or cut_out else wanted
        candidates = geometry.back_project(view.camera, pixels[:useful], source.sample(pixels, useful, generator))
        worse = empty_votes(views, regions, candidates)
        if elsewhere:
            worse += sum(geometry.in_image(v.camera, candidates).astype(int) for v in views) < 2
        best = np.argsort(worse, kind="stable")[:wanted]
        points.append(candidates[best])
        colors.append(view.image[rows[best], columns[best]])
    if not points:
        raise DataError("no random start: masks or alpha hide all pixels of the views; check --mask-keeps and the images")
    with_matches = sum(s.has_matches for s in sources)
    how = f"{count:,} random points, {with_matches} of {len(views)} views with depths from {len(matched):,} matched points"
    how += f", on the object ({objects} views show it on black)" if objects else ""
    how += f", in the opaque areas of {cut_out} views" if cut_out else ""
    return PointCloud(np.concatenate(points), np.concatenate(colors)), how


SOURCES = ("auto", "sweep", "flow", "points", "hull", "random")
MIN_POINTS = 100
"""Fewest sparse points to start from: with fewer, most of the image is empty, and a random start is better."""


@dataclass(frozen=True)
class InitConfig(Checked, group="init."):
    """Source and initial values of the Gaussians."""

    source: Annotated[str, SOURCES] = "auto"
    """Source of the first points: sweep or flow (one for each pixel with depth that other views confirm), points (those of the
    reconstruction), random, hull (surface of the visual hull of views with an alpha channel), or auto. auto is sweep if depth
    is given, or for at most --init.sweep-up-to views; else points if the training views saw at least 100 points; else random.
    If views have an alpha channel, points in an empty area of a view are left out."""
    sweep_up_to: Annotated[int, Within(0)] = 0
    """auto: largest number of training views for a start by sweep, which takes about a second per view on two cores."""
    random_count: Annotated[int, Within(1, 10_000_000)] = 20_000
    """Number of random points, at most ten million."""
    opacity: Annotated[float, Within(0, 1, "()")] = 0.1
    """Initial opacity, in (0, 1)."""
    scale_factor: Annotated[float, Within(1e-3, 10)] = 1.0
    """Initial standard deviation of a Gaussian, as a multiple of the distance to its neighbours, in [0.001, 10]."""
    merge_px: Annotated[float, Within(0, np.inf, ")")] = 4.0
    """sweep, flow: width of the cells in which points of confirmed depth are merged [px]; 0 keeps a point for every pixel."""
    fill_px: Annotated[float, Within(0, np.inf, ")")] = 16.0
    """sweep, flow: cell width [px] for filling in points where other views do not confirm depth; 0 fills in none."""
    extrapolate: bool | None = False
    """sweep, flow: add extrapolated points where no view looks, beyond the images and behind depth edges
    (docs/decisions/026-extrapolated-points.md). In a fit with such points, opacity decay spares Gaussians that a step does not
    use. No points are added if a view has a mask, an alpha channel or a black background. None: chosen by the number of
    views."""
    flow: str = "dis"
    """flow: source of optical flow: dis, deepflow, sparse, a folder of .flo files or an ONNX file (images of 0 to 255 in, flow
    out)."""


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
    views: list[View], known: PointCloud, config: InitConfig, device: Device = lambda: CPU, progress: Say = silent
) -> list[ViewDepth]:
    """Return the geometrically consistent depth of each of at least two views, by flow or by sweeping planes.

    ``known`` points bound the planes.
    """
    if config.source == "flow":
        with section("depth"):
            between = flow_between(views, config.flow)
            return [flow_depth(views, i, between) for i in range(len(views))]
    with section("matches"):
        points = np.concatenate([known.points, triangulate_matches(views, device).points])
    bounds = [depth_points.depth_bounds(v, points, camera_depths(views)) for v in views]
    with section("depth"):
        return sweep_depths(views, bounds, device(), lambda n, of: progress(f"finding depth: {n} of {of} views"))


def consistent_points(
    views: list[View], points: PointCloud, config: InitConfig, generator: np.random.Generator, device: Device, progress: Say
) -> Start:
    """Return points behind pixels whose depth other views confirm, and a line on each view.

    If fewer than `MIN_POINTS` points are found, the start is random, with a note.
    """
    depths = consistent_depths(views, points, config, device, progress) if len(views) > 1 else None
    reason, given, source = "depth needs at least two views", [], config.source
    if any_given(views):
        source, (depths, given) = f"given depth and {source}", with_given_depth(views, depths, points)
    if depths is not None:
        cloud, notes = depth_points.coarse_points(
            views, depths, merge_px=config.merge_px, fill_px=config.fill_px, source=source, known=points
        )
        if len(cloud) >= MIN_POINTS:
            extrapolated = depth_points.extrapolated_points(views, depths) if config.extrapolate else depth_points.NOTHING
            if len(extrapolated):
                notes[-1] += f", {len(extrapolated):,} extrapolated where no view looks"
            elif config.extrapolate:
                notes[-1] += ", none extrapolated (masks, alpha and black backgrounds hide parts)"
            how = "\n".join((notes[-1], *given, *(f"    {n}" for n in notes[:-1])))
            return Start(depth_points.joined((cloud, extrapolated)), how, depths, len(extrapolated))
        reason = f"only {len(cloud)} points survived the checks ({' | '.join(notes[:-1])}); do the views overlap?"
    cloud, how = random_points(views, config.random_count, generator)
    return Start(cloud, f"{how}, instead of --init.source {config.source}: {reason}", depths)


def seen_points(views: list[View], points: PointCloud | None) -> PointCloud:
    """Return the reconstruction's points that at least two views saw, or that the only view saw; none without a reconstruction.

    A point that only one of several views saw was triangulated with held-out views.
    """
    return depth_points.NOTHING if points is None else points.seen_by({v.name for v in views}, min(2, len(views)))


def sweeps(config: InitConfig, views: int) -> bool:
    """Return whether a fit of that many views starts from a sweep."""
    return config.source == "sweep" or (config.source == "auto" and 2 <= views <= config.sweep_up_to)


def extrapolates(config: InitConfig, views: list[View]) -> bool:
    """Return whether the start of a fit of these views has extrapolated points, if it finds depth."""
    if not config.extrapolate or len(views) < 2:
        return False
    searches = config.source == "flow" or sweeps(config, len(views)) or (config.source == "auto" and any_given(views))
    return searches and depth_points.all_count(views)


def check_points(views: list[View], points: PointCloud | None, config: InitConfig) -> None:
    """Check that a start from points has points that the training views saw; DataError if it has none."""
    if config.source == "points" and len(seen_points(views, points)) == 0:
        raise DataError("--init.source points needs 3D points that training views saw; give them, or use --init.source random")


def on_object(start: Start, views: list[View]) -> Start:
    """Return the start without points in empty areas of views with an alpha channel.

    If fewer than `MIN_POINTS` points would be left, the start is unchanged.
    """
    cloud, shapes = start.cloud, depth_points.silhouettes(views)
    keep = ~depth_points.in_empty_region(shapes, cloud.points)
    if not shapes or keep.all():
        return start
    if (count := int(keep.sum())) < MIN_POINTS:
        return start._replace(how=f"{start.how}\nonly {count} points are outside the empty areas of all views; check the poses")
    how = f"{start.how}\n{len(keep) - count:,} of these points left out: they are in an empty area of a view"
    return start._replace(cloud=PointCloud(cloud.points[keep], cloud.colors[keep]), how=how)


def initial_points(
    views: list[View], points: PointCloud | None, config: InitConfig, generator: np.random.Generator,
    device: Device = lambda: CPU, progress: Say = silent,
) -> Start:  # fmt: skip
    """Return the points to start from; DataError if there are none. Arguments are those of `consistent_depths`."""
    check_points(views, points, config)
    if config.source == "hull":
        cloud, how = depth_points.hull_points(views, config.merge_px)
        if len(cloud) >= MIN_POINTS:
            return Start(cloud, how)
        cloud, made = random_points(views, config.random_count, generator)
        return Start(cloud, f"{made}, instead of --init.source hull: {how}")
    usable = seen_points(views, points)
    if config.source == "auto" and (sweeps(config, len(views)) or any_given(views)):
        config = replace(config, source="sweep")
    if config.source in ("sweep", "flow"):
        start = consistent_points(views, usable, config, generator, device, progress)
    elif config.source == "points" or (config.source == "auto" and len(usable) >= MIN_POINTS):
        start = Start(usable, f"{len(usable):,} points of the reconstruction that the training views saw")
    else:
        start = Start(*random_points(views, config.random_count, generator))
        if config.source == "auto" and points is not None:
            few = f"the reconstruction has only {len(usable)} points that the training views saw"
            start = start._replace(how=f"{start.how} ({few})")
    start = on_object(start, views)
    if config.extrapolate and start.depths is None:
        return start._replace(how=f"{start.how}\nno extrapolated points: they need --init.source sweep or flow")
    return start


def subsample(start: Start, most: int, generator: np.random.Generator) -> Start:
    """Return the start with at most ``most`` points, sampled at random; sparser points get wider Gaussians."""
    if (count := len(start.cloud)) <= most:
        return start
    keep = np.sort(generator.permutation(count)[:most])
    how = f"{start.how}\nused {most:,} of these {count:,} points, sampled at random, because --max-gaussians is {most:,}"
    cloud = PointCloud(start.cloud.points[keep], start.cloud.colors[keep])
    return start._replace(cloud=cloud, how=how, extrapolated=int((keep >= count - start.extrapolated).sum()))


def scene_extent(cameras: list[Camera], cloud: PointCloud) -> float:
    """Return the size of the scene [u]: the extent of the cameras, or a tenth of the cloud's spread if all cameras coincide."""
    extent = geometry.camera_extent(cameras, cloud.points)
    spread = float(np.linalg.norm(np.std(cloud.points, axis=0)))
    return max(extent, 0.1 * spread if extent < 1e-3 * spread else 0.0, 1e-6)


def initial_gaussians(
    cloud: PointCloud, config: InitConfig, sh_degree: int, extent: float, device: torch.device, extrapolated: int = 0
) -> Gaussians:
    """Return one isotropic Gaussian per point; widths follow the root mean square distance to the three nearest points.

    There is at least one point. The distances are limited to 1e-6 to 0.1 of the ``extent`` of the scene [u], also for
    coincident or lone points. The last ``extrapolated`` points start with `EXTRAPOLATED_OPACITY`. Tensors are float32.
    """
    points = torch.as_tensor(cloud.points, dtype=torch.float32, device=device)
    colors = torch.as_tensor(cloud.colors, dtype=torch.float32, device=device)
    # in float64, since the rounding of float32's roots and logarithms depends on the processor (MKL)
    scales = config.scale_factor * mean_square_distances(points).double().sqrt().clamp(1e-6 * extent, 0.1 * extent)
    logits = points.new_full((len(points),), geometry.logit(config.opacity))
    logits[len(points) - extrapolated :] = geometry.logit(depth_points.EXTRAPOLATED_OPACITY)
    return isotropic(points, colors, scales.log().to(points.dtype), logits, coefficient_count(sh_degree))


def isotropic(
    means: torch.Tensor, colors: torch.Tensor, log_sizes: torch.Tensor, logits: torch.Tensor, coefficients: int
) -> Gaussians:
    """Return Gaussians of means and colours [N, 3], logarithms of sizes and logits of opacities [N]; K ``coefficients``."""
    sh = means.new_zeros(len(means), coefficients, 3)
    sh[:, 0] = base_coefficients(colors)
    quats = means.new_tensor([1, 0, 0, 0]).repeat(len(means), 1)
    return Gaussians(means, quats, log_sizes[:, None].repeat(1, 3), logits, sh)
