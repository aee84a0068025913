"""Fusion of depth into a grid of signed distances, and its zero surface as triangles."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import torch

from warpgs.device import available_bytes, format_bytes
from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.geometry import evenly_spaced, in_image, inside, pinhole_of, project_points
from warpgs.kernels.launch import MAX_SIZE
from warpgs.kernels.tsdf import gather_colors, integrate
from warpgs.mesh.views import DEPTHS, SAMPLES, SurfaceView, SurfaceViews, agreed, depth_map, neighbours, sample_surface
from warpgs.process import Say, silent
from warpgs.render.options import RasterizeOptions
from warpgs.report.images import resized
from warpgs.scene import Box, Camera, Gaussians, Mesh
from warpgs.schema import Checked, Within

RESOLUTION = 256
"""Voxels along the longest side of the box around the surfaces, if neither ``voxel`` nor ``resolution`` is given."""
MIN_RESOLUTION, MAX_RESOLUTION = 8, 4096
TRUNCATION = 4.0
"""Largest distance from a surface that the grid stores, in voxels."""
FENCE = 3.0
"""Distance outside the quartiles, in interquartile ranges, beyond which a coordinate is an outlier (Tukey, 1977: Exploratory
Data Analysis)."""
QUANTILES = (0.005, 0.995)
"""Quantiles of the surface points' coordinates; they bound the grid along each axis, unless `FENCE` bounds it more tightly."""
GRID_BYTES = 8
"""Bytes of a grid point on the device: distance and weight."""
CPU = torch.device("cpu")
HOST_BYTES = 14
"""Bytes of a grid point in main memory while triangles are made: two copies of the distances, the weights, and two masks."""


@dataclass(frozen=True)
class GridPlan:
    """A regular grid of points, parallel to the axes of the world."""

    origin: tuple[float, float, float]
    """Position of the first point [u]."""
    voxel: float
    """Distance from one point to the next [u]."""
    shape: tuple[int, int, int]
    """Number of points along each axis."""
    inside: float
    """Fraction of the surface points inside the grid."""

    @property
    def points(self) -> int:
        """Number of points."""
        return math.prod(self.shape)

    @property
    def truncation(self) -> float:
        """Largest distance from a surface that is stored [u]."""
        return TRUNCATION * self.voxel


def find_box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corner [3] of the box around points [N, 3] [u], except outliers along each axis."""
    first, third = np.quantile(points, [0.25, 0.75], axis=0)
    low, high = np.quantile(points, QUANTILES, axis=0)
    return np.maximum(low, first - FENCE * (third - first)), np.minimum(high, third + FENCE * (third - first))


SUBJECT = 1 / 3
"""Fraction of the cameras that look at the subject: its surroundings are in fewer photographs."""


def subject(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Mask [N] of the points [N, 3] [u] that are in the images of at least `SUBJECT` of the cameras, if any are."""
    counts = np.zeros(len(points), int)
    for camera in map(pinhole_of, cameras):
        counts += in_image(camera, points)
    return counts >= min(SUBJECT * len(cameras), counts.max(initial=0))


def plan_grid(
    points: np.ndarray, footprints: np.ndarray, voxel: float | None = None, resolution: int | None = None
) -> GridPlan:
    """Choose the grid for points [N, 3] [u] with pixels ``footprints`` [N] [u] wide, by ``voxel`` [u] or ``resolution``."""
    if not len(points):
        raise DataError("no training view shows a surface: alpha is below 0.5 or depth uncertain everywhere; take more steps")
    low, high = find_box(points)
    longest = float((high - low).max())
    if voxel is None:
        voxel = longest / (resolution or RESOLUTION)
        if resolution is None:
            voxel = max(voxel, float(np.median(footprints)) / 2)
    if not (voxel > 0 and longest / voxel <= 2**20):
        raise UsageError("--voxel must be at least a millionth of the longest side of the scene")
    margin = 2 * TRUNCATION * voxel
    shape: Any = tuple(int(n) for n in np.ceil((high - low + 2 * margin) / voxel) + 1)
    origin: Any = tuple((low - margin).tolist())
    return GridPlan(origin, voxel, shape, float(((points >= low - margin) & (points <= high + margin)).all(1).mean()))


def check_memory(plan: GridPlan, device: torch.device) -> str:
    """Return how much memory a grid takes, as text, before it is allocated."""
    needs = {device: plan.points * GRID_BYTES}
    needs[CPU] = needs.get(CPU, 0) + plan.points * HOST_BYTES
    sizes, remedy = " x ".join(map(str, plan.shape)), "give a larger --voxel or a smaller --resolution"
    if plan.points > MAX_SIZE:
        raise ResourceError(f"a grid of {sizes} points is beyond the {MAX_SIZE:,} that kernels can index; {remedy}")
    for where, needed in needs.items():
        if needed > 0.8 * (free := available_bytes(where)):
            raise ResourceError(f"a grid of {sizes} points takes {format_bytes(needed)} of {format_bytes(free)} free; {remedy}")
    return format_bytes(sum(needs.values()))


HOLE = 8.0
"""Half the diagonal of the box around the largest hole that is closed with flat triangles, in voxels."""
MAX_JUMP = 1.1
"""Largest difference, in units of the truncation, of the distances at two neighbouring grid points with a surface between them.
A smaller limit leaves out surfaces at grazing angles; with a larger one, false triangles extend behind depth edges. The limit
and the truncation were chosen on a demo scene with another seed than the scene of the results
(docs/decisions/019-thresholds.md)."""
NO_SURFACE = "no surface inside the grid; give a larger --voxel (smaller if they are as large as the scene), or more steps"
"""Message for a grid without a surface."""
MIN_PART = 0.002
"""Smallest fraction of all triangles that a connected part needs to be kept; smaller parts float in front of surfaces."""


def _grey(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Return a mesh of vertices [V, 3] and triangles [F, 3], without colours."""
    return Mesh(vertices, faces.astype(np.int32), np.full(vertices.shape, 0.5, np.float32))


def extract(plan: GridPlan, distance_grid: torch.Tensor, weight_grid: torch.Tensor) -> Mesh:
    """Return the surface where distances [X, Y, Z] are 0, open where no view looked and at jumps of the distance."""
    # The surface is left open where no view looked: a triangle is kept only if both grid points beside each of its vertices
    # were seen. No triangle is made where the distance jumps from in front of one surface to behind another, as at depth edges.
    from skimage.measure import marching_cubes

    distances, weights = distance_grid.cpu().numpy(), weight_grid.cpu().numpy()
    seen = weights > 0
    values = np.where(seen, distances, np.float32(1))
    if not (values < 0).any() or min(values.shape) < 2:
        raise DataError(NO_SURFACE)
    corners, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent", allow_degenerate=False)
    # A vertex lies on an edge of the grid: between the points below and above.
    below, above = (tuple(f(corners).astype(np.int64).T) for f in (np.floor, np.ceil))
    kept = seen[below] & seen[above] & (np.abs(values[below] - values[above]) <= MAX_JUMP)
    faces = faces[kept[faces].all(1)]
    if not len(faces):
        raise DataError(NO_SURFACE)
    return _compact(_grey(np.array(plan.origin) + plan.voxel * corners.astype(np.float64), faces))


def _compact(mesh: Mesh) -> Mesh:
    """Remove vertices that no triangle uses."""
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces] = True
    return Mesh(mesh.vertices[used], (np.cumsum(used) - 1)[mesh.faces].astype(np.int32), mesh.colors[used])


def parts(mesh: Mesh) -> tuple[int, np.ndarray]:
    """Return the number of connected parts, and the part of each triangle, shape [F]."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends, count = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2), len(mesh.vertices)
    graph = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), (count, count))
    number, labels = connected_components(graph, directed=False)
    return number, labels[mesh.faces[:, 0]]


def remove_small_parts(mesh: Mesh, fraction: float = MIN_PART) -> tuple[Mesh, int]:
    """Return a mesh without connected parts of less than ``fraction`` of all triangles, and the number of removed parts."""
    number, part = parts(mesh)
    keep = np.bincount(part, minlength=number) >= max(1.0, fraction * len(mesh.faces))
    return _compact(replace(mesh, faces=mesh.faces[keep[part]])), int((~keep).sum())


def _scaled(mesh: Mesh) -> tuple[Any, np.ndarray, float]:
    """Return VTK's form of a mesh, centred and scaled to size 1, since VTK computes in float32; its centre [3] and size [u]."""
    import pyvista

    middle = mesh.vertices.mean(0)
    size = float(np.abs(mesh.vertices - middle).max()) or 1.0
    return pyvista.PolyData.from_regular_faces(((mesh.vertices - middle) / size).astype(np.float32), mesh.faces), middle, size


def decimate(mesh: Mesh, max_faces: int) -> Mesh:
    """Return a mesh of at most about ``max_faces`` triangles, without colours, by quadric error (Garland and Heckbert 1997)."""
    # This part of VTK needs no graphics library.
    if len(mesh.faces) <= max_faces:
        return mesh
    data, middle, size = _scaled(mesh)
    fewer = data.decimate(1 - max_faces / len(mesh.faces))
    return _compact(_grey(np.asarray(fewer.points, np.float64) * size + middle, fewer.regular_faces))


def fill_holes(mesh: Mesh, radius: float) -> Mesh:
    """Return a mesh without colours; holes are closed if half the diagonal of the box around them is below ``radius`` [u]."""
    data, middle, size = _scaled(mesh)
    # the triangles that VTK adds may face inwards; those it was given come first, and set the side
    closed = data.fill_holes(radius / size).compute_normals(
        cell_normals=False, consistent_normals=True, split_vertices=False, non_manifold_traversal=False
    )
    return _grey(np.asarray(closed.points, np.float64) * size + middle, closed.regular_faces)


COLOR_TOLERANCE = 1.0
"""Largest distance between a vertex and the surface of a view that colours it, as a multiple of the grid's truncation."""

MIN_FACES = 4
"""Smallest number of triangles that enclose a volume."""


@dataclass(frozen=True)
class MeshOptions(Checked, group="--"):
    """Options of `fuse`."""

    voxel: Annotated[float | None, Within(0, math.inf, "()")] = None
    """Distance between neighbouring grid points [u]; None to derive it from ``resolution``."""
    resolution: Annotated[int | None, Within(MIN_RESOLUTION, MAX_RESOLUTION)] = None
    """Voxels along the longest side of the box around the surfaces; None for 256, or fewer if the images resolve less."""
    max_faces: Annotated[int, Within(MIN_FACES)] = 200_000
    """Largest number of triangles; larger meshes are simplified."""
    depth: Annotated[str, DEPTHS] = "median"
    """Rendered depth that is fused: median, or mean (expected depth), which mixes surfaces at edges."""
    crop: str | Box | None = None
    """Part of the scene: auto for the surfaces that at least a third of the cameras look at; or a box in the units of the
    cameras: centre [3], sides [3], and rotation [3, 3] with the directions of the sides as columns; None for everything."""
    fill_holes: bool = False
    """Fill holes: with depths that are uncertain or that only one view sees, and small ones with flat triangles."""

    def __post_init__(self) -> None:
        """Check the options, before any view is rendered."""
        super().__post_init__()
        if isinstance(self.crop, str) and self.crop != "auto":
            raise UsageError(f"--crop must be auto or a box, not {self.crop[:60]!r}")
        if None not in (self.voxel, self.resolution):
            raise UsageError("--voxel and --resolution exclude each other; give one of them")


@dataclass(frozen=True)
class FusedMesh:
    """A mesh with its statistics."""

    mesh: Mesh
    """The mesh, in the units of the cameras."""
    plan: GridPlan
    """Grid that the mesh was made with."""
    unseen: float
    """Fraction of the grid points that no view saw."""
    extracted: int
    """Number of triangles before small parts were removed and the rest was simplified."""
    removed: int
    """Number of small parts that were removed."""
    uncolored: int
    """Number of vertices that no view saw; each has the colour of the nearest vertex that was seen."""


def fuse(
    gaussians: Gaussians, cameras: Sequence[Camera], render: RasterizeOptions, options: MeshOptions = MeshOptions(), *,
    stage: Say = silent, planned: Callable[[GridPlan, str], object] = lambda plan, memory: None,
) -> FusedMesh:  # fmt: skip
    """Make a mesh of the surfaces that cameras see; ``planned`` gets the grid and its memory before it is allocated."""
    # Areas that no camera sees, or on which cameras disagree, stay open. Views are used three times: for the extent of the
    # scene, for distances and for colours. If the views have up to 16 million pixels in all, they are rendered once and kept.
    # Otherwise each use renders them again, one at a time, and only depths are kept.
    if not cameras:
        raise UsageError("fuse needs at least one camera that sees the surfaces")
    samples, maps, like = [], [], gaussians.means
    fill, box = options.fill_holes, None if isinstance(options.crop, str) else options.crop
    views = SurfaceViews(gaussians, cameras, render, options.depth, stage, fill)
    for view in views("finding surfaces"):
        samples.append(sample_surface(view, max(1, SAMPLES // len(cameras))))
        maps.append(depth_map(view, len(cameras)))
    points, footprints = map(np.concatenate, zip(*samples))
    if options.crop is not None and len(points):
        kept = subject(points, cameras) if box is None else inside(points, box)
        if not kept.any():
            raise DataError("--crop: no surface is inside the box; give a larger box, in the units of the run's files")
        points, footprints = points[kept], footprints[kept]
    plan = plan_grid(points, footprints, options.voxel, options.resolution)
    planned(plan, check_memory(plan, like.device))
    distances, weights, confirmed = like.new_zeros(plan.shape), like.new_zeros(plan.shape), False
    for view, others in zip(views("fusing depth"), neighbours(maps)):
        view = agreed(view, [maps[i] for i in others], fill)
        confirmed = confirmed or bool(((view.depth > 0) & torch.isfinite(view.depth)).any())
        integrate(distances, weights, plan.origin, plan.voxel, plan.truncation, view.camera, view.depth, view.weights)
    del maps
    if not confirmed:
        raise DataError("no depth of a training view is confirmed by another view; fit with more steps, or more photographs")
    unseen = 1 - np.count_nonzero(weights.cpu().numpy()) / plan.points
    stage("finding triangles: marching cubes")
    whole = extract(plan, distances, weights)
    del distances, weights
    if box is not None:
        whole = _compact(replace(whole, faces=whole.faces[inside(whole.vertices, box)[whole.faces].all(1)]))
    cleaned, removed = remove_small_parts(whole)
    if fill:
        cleaned = fill_holes(cleaned, HOLE * plan.voxel)
    if len(cleaned.faces) > options.max_faces:
        stage(f"simplifying: {len(cleaned.faces):,} triangles")
    mesh = decimate(cleaned, options.max_faces)
    colors, uncolored = vertex_colors(mesh, views, plan.truncation)
    mesh = textured(replace(mesh, colors=colors), views, plan.truncation, float(np.median(footprints)))
    return FusedMesh(mesh, plan, unseen, len(whole.faces), removed, uncolored)


def seen_colors(vertices: np.ndarray, views: Iterable[SurfaceView], truncation: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted mean colour that views see at points [N, 3] [u], [N, 3], and whether any sees them, [N]."""
    for i, view in enumerate(views):
        if i == 0:
            points = torch.as_tensor(vertices, dtype=view.depth.dtype, device=view.depth.device)
            sums, weights = torch.zeros_like(points), torch.zeros_like(points[:, 0])
        gather_colors(points, COLOR_TOLERANCE * truncation, view.camera, view.depth, view.weights, view.image, sums, weights)
    known = (weights > 0).cpu().numpy()
    return sums.cpu().numpy() / np.maximum(weights.cpu().numpy(), np.finfo(np.float32).tiny)[:, None], known


def vertex_colors(mesh: Mesh, views: SurfaceViews, truncation: float) -> tuple[np.ndarray, int]:
    """Return the weighted mean colour [V, 3] that views see at each vertex, and the number of vertices that none sees."""
    colors, known = seen_colors(mesh.vertices, views("colouring"), truncation)
    if known.any() and not known.all():
        from scipy.spatial import cKDTree

        colors[~known] = colors[known][cKDTree(mesh.vertices[known]).query(mesh.vertices[~known])[1]]
    return np.clip(colors, 0, 1).astype(np.float32), int((~known).sum())


# Texture: the renders of some views side by side. Each triangle shows the view in which it and its surroundings are largest, so
# neighbours mostly stay neighbours: few seams, and mipmaps and anti-aliasing mix no strangers. Triangles that no view shows
# whole have the colours of their vertices.

MAX_TEXTURE = 4096
"""Largest side of a texture [px]: all devices with WebGL 2 show it."""
TEXTURE_VIEWS = 16
"""Largest number of views in a texture, evenly spaced: of 16, each still has about a thousand pixels a side."""
COARSE = 1.5
"""Median length of an edge [pixels of the photographs] below which the colours at vertices hold all detail."""
SPREAD = 20
"""Number of times that the areas of triangles are averaged with those of their neighbours, over about 5 edges."""
STRIP = 4
"""Height of the white strip below the views [px], for triangles with the colours of their vertices."""


def textured(mesh: Mesh, views: SurfaceViews, truncation: float, footprint: float) -> Mesh:
    """Return a mesh with a texture, if its edges are longer than `COARSE` pixels, each ``footprint`` [u] wide."""
    ends = mesh.vertices[mesh.faces]
    if np.median(np.linalg.norm(ends - np.roll(ends, 1, 1), axis=2)) < COARSE * footprint:
        return mesh
    chosen = evenly_spaced(range(len(views.cameras)), TEXTURE_VIEWS)
    size = np.max([(views.cameras[i].width, views.cameras[i].height) for i in chosen], axis=0)
    columns = max(1, round(math.sqrt(len(chosen) * size[1] / size[0])))
    grid = np.array([columns, -(-len(chosen) // columns)])
    cell = np.minimum(size, (MAX_TEXTURE - STRIP) // grid)
    cell = np.maximum(1, size * (cell / size).min()).astype(int)
    texture = np.full((grid[1] * cell[1] + STRIP, grid[0] * cell[0], 3), 255, np.uint8)
    largest, uv = np.zeros(len(ends)), np.full((*ends.shape[:2], 2), [STRIP / 2, len(texture) - STRIP / 2])
    degree = np.bincount(mesh.faces.ravel(), minlength=len(mesh.vertices)).clip(1)
    for k, view in enumerate(views("making the texture", chosen)):
        colors, seen = seen_colors(mesh.vertices, [view], truncation)
        gain = mesh.colors[seen].sum(0) / colors[seen].sum(0).clip(1e-6)  # of exposure and white balance
        places = project_points(view.camera, mesh.vertices)[0][mesh.faces]
        a, b = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
        shown = seen[mesh.faces].all(1)
        area = np.where(shown, np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), 0)
        for _ in range(SPREAD):
            area = (np.bincount(mesh.faces.ravel(), area.repeat(3), len(seen)) / degree)[mesh.faces].mean(1)
        area = np.where(shown, area, 0)
        better, start = area > largest, cell * [k % columns, k // columns]
        width, height = (cell * [view.camera.width, view.camera.height] / size).astype(int).clip(1)
        largest[better] = area[better]
        uv[better] = start + places[better] * [width / view.camera.width, height / view.camera.height]
        image = resized(gain * view.image.cpu().numpy(), width, height)
        texture[start[1] : start[1] + height, start[0] : start[0] + width] = image
    return replace(mesh, texture=texture, uv=(uv / texture.shape[1::-1]).astype(np.float32))


fuse_mesh = fuse
