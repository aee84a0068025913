"""Fusion of the depth of all cameras into a mesh: distances, then triangles, then their colours."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from warpgs.errors import DataError, UsageError
from warpgs.kernels.tsdf import DistanceGrid, empty_grid, gather_colors, integrate
from warpgs.mesh.agreement import DepthMap, agreed, depth_map, neighbours
from warpgs.mesh.grid import MAX_RESOLUTION, MIN_RESOLUTION, GridPlan, check_memory, plan_grid
from warpgs.mesh.surface_views import DEPTHS, SAMPLES, SurfaceViews, sample_surface
from warpgs.mesh.triangles import decimate, extract, remove_small_parts
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Camera, Gaussians, Mesh

COLOR_TOLERANCE = 1.0
"""Largest distance between a vertex and the surface of a view that colours it, as a multiple of the grid's truncation."""

MIN_FACES = 4
"""Smallest number of triangles that enclose a volume."""


@dataclass(frozen=True)
class MeshOptions:
    """Options of `fuse`."""

    voxel: float | None = None
    """Distance between neighbouring grid points [u]; None to derive it from ``resolution``."""
    resolution: int | None = None
    """Voxels along the longest side of the box around the surfaces; None for 256, or fewer if the images resolve less."""
    max_faces: int = 200_000
    """Largest number of triangles; larger meshes are simplified."""
    depth: str = "median"
    """Rendered depth that is fused: median, or mean (expected depth), which mixes surfaces at edges."""

    def __post_init__(self) -> None:
        """Check the options, before any view is rendered.

        Raises:
            UsageError: An option is out of its range, or two options exclude each other.
        """
        if self.depth not in DEPTHS:
            raise UsageError(f"--depth {self.depth!r} is not one of {', '.join(DEPTHS)}")
        if self.voxel is not None and not 0 < self.voxel < math.inf:
            raise UsageError(f"--voxel must be a number above 0, not {self.voxel:g}")
        if self.voxel is not None and self.resolution is not None:
            raise UsageError("--voxel and --resolution exclude each other; give one of them")
        if self.resolution is not None and not MIN_RESOLUTION <= self.resolution <= MAX_RESOLUTION:
            raise UsageError(f"--resolution must be {MIN_RESOLUTION} to {MAX_RESOLUTION} voxels, not {self.resolution}")
        if self.max_faces < MIN_FACES:
            raise UsageError(f"--max-faces must be at least {MIN_FACES}, not {self.max_faces}")


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


def integrate_views(views: SurfaceViews, plan: GridPlan, maps: Sequence[DepthMap], like: torch.Tensor) -> DistanceGrid:
    """Return the grid into which the depth of all views was fused, in the order of the cameras.

    Args:
        views: Surface that each camera sees.
        plan: The grid.
        maps: Depth map of each view, to compare other views with.
        like: Any tensor with the scalar type and device that the grid gets, shape [...].

    Raises:
        DataError: Other views contradict all depths.
    """
    grid, confirmed = empty_grid(plan.origin, plan.voxel, plan.shape, plan.truncation, like), False
    for view, others in zip(views("fusing depth"), neighbours(maps)):
        view = agreed(view, [maps[i] for i in others])
        confirmed = confirmed or bool(((view.depth > 0) & torch.isfinite(view.depth)).any())
        integrate(grid, view.camera, view.depth, view.weights)
    if not confirmed:
        raise DataError(
            "no depth of a training view is confirmed by another view, so there is no surface to mesh; fit again with more "
            "steps, or with more photographs that show the same surfaces"
        )
    return grid


def fuse(
    gaussians: Gaussians, cameras: Sequence[Camera], render: RasterizeOptions, options: MeshOptions = MeshOptions(), *,
    stage: Callable[[str], object] = lambda line: None, planned: Callable[[GridPlan, str], object] = lambda plan, memory: None,
) -> FusedMesh:  # fmt: skip
    """Make a mesh of the model's surfaces that cameras see.

    Areas that no camera sees, or on which cameras disagree, stay open. Views are used three times: for the extent of the scene,
    for distances and for colours. If the views have up to 16 million pixels in all, they are rendered once and kept. Otherwise
    each use renders them again, one at a time, and only depths are kept.

    Args:
        gaussians: N Gaussians in the units of the cameras.
        cameras: Cameras, arrays of numpy, at least one; lenses are replaced by pinholes of the same K.
        render: Settings of the rasterizer, as the fit used them.
        options: Options.
        stage: Function that shows a line of progress.
        planned: Called with the grid, and its memory as text, before the grid is allocated.

    Raises:
        DataError: No camera sees a surface, or other cameras contradict all depths.
        ResourceError: The grid does not fit into memory.
        UsageError: There is no camera, a camera has no pinhole of the same K, or an option is out of range.
    """
    if not cameras:
        raise UsageError("fuse needs at least one camera that sees the surfaces")
    samples, maps = [], []
    views = SurfaceViews(gaussians, cameras, render, options.depth, stage)
    for view in views("finding surfaces"):
        samples.append(sample_surface(view, max(1, SAMPLES // len(cameras))))
        maps.append(depth_map(view, len(cameras)))
    plan = plan_grid(*map(np.concatenate, zip(*samples)), options.voxel, options.resolution)
    planned(plan, check_memory(plan, gaussians.means.device))
    grid = integrate_views(views, plan, maps, gaussians.means)
    del maps
    unseen = 1 - np.count_nonzero(grid.weights.cpu().numpy()) / plan.points
    stage("finding triangles: marching cubes")
    whole = extract(grid)
    del grid
    cleaned, removed = remove_small_parts(whole)
    if len(cleaned.faces) > options.max_faces:
        stage(f"simplifying: {len(cleaned.faces):,} triangles")
    mesh = decimate(cleaned, options.max_faces)
    colors, uncolored = vertex_colors(mesh, views, plan.truncation)
    return FusedMesh(replace(mesh, colors=colors), plan, unseen, len(whole.faces), removed, uncolored)


def vertex_colors(mesh: Mesh, views: SurfaceViews, truncation: float) -> tuple[np.ndarray, int]:
    """Return the weighted mean of the rendered colours that the views see at each vertex.

    Args:
        mesh: The mesh, V vertices.
        views: Surface that each camera sees, at least one.
        truncation: Truncation of the grid's distances [u].

    Returns:
        Colours in [0, 1], float32, shape [V, 3], and the number of vertices that no view sees.
    """
    tolerance = COLOR_TOLERANCE * truncation
    for i, view in enumerate(views("colouring")):
        if i == 0:
            points = torch.as_tensor(mesh.vertices, dtype=view.depth.dtype, device=view.depth.device)
            sums, weights = torch.zeros_like(points), torch.zeros_like(points[:, 0])
        gather_colors(points, tolerance, view.camera, view.depth, view.weights, view.image, sums, weights)
    known = (weights > 0).cpu().numpy()
    colors = sums.cpu().numpy() / np.maximum(weights.cpu().numpy(), np.finfo(np.float32).tiny)[:, None]
    if known.any() and not known.all():
        from scipy.spatial import cKDTree

        colors[~known] = colors[known][cKDTree(mesh.vertices[known]).query(mesh.vertices[~known])[1]]
    return np.clip(colors, 0, 1).astype(np.float32), int((~known).sum())
