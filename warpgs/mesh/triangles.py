"""Triangles from a grid of signed distances: marching cubes where it was seen, removal of small parts, simplification."""

from __future__ import annotations

import numpy as np

from warpgs.errors import DataError
from warpgs.kernels.tsdf import DistanceGrid
from warpgs.scene import Mesh

MAX_JUMP = 1.1
"""Largest difference, in units of the truncation, of the distances at two neighbouring grid points with a surface between them.
A smaller limit leaves out surfaces at grazing angles; with a larger one, false triangles extend behind depth edges. The limit
and the truncation were chosen on a demo scene with another seed than the scene of the results
(docs/decisions/019-thresholds.md)."""
NO_SURFACE = (
    "no surface inside the grid; give a larger --voxel (a smaller one if voxels are as large as the scene), or fit "
    "with more steps"
)
"""Message for a grid without a surface."""
MIN_PART = 0.002
"""Smallest fraction of all triangles that a connected part needs to be kept; smaller parts float in front of surfaces."""


def _grey(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Return a mesh of vertices [V, 3] and triangles [F, 3], without colours."""
    return Mesh(vertices, faces.astype(np.int32), np.full(vertices.shape, 0.5, np.float32))


def extract(grid: DistanceGrid) -> Mesh:
    """Return the surface where distances are 0, without colours.

    The surface is left open where no view looked: a triangle is kept only if both grid points beside each of its vertices were
    seen. No triangle is made where the distance jumps from in front of one surface to behind another, as at depth edges.

    Args:
        grid: The grid.

    Raises:
        DataError: There is no surface inside the grid.
    """
    from skimage.measure import marching_cubes

    distances, weights = grid.distances.cpu().numpy(), grid.weights.cpu().numpy()
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
    return _compact(_grey(np.array(grid.origin) + grid.voxel * corners.astype(np.float64), faces))


def _compact(mesh: Mesh) -> Mesh:
    """Remove vertices that no triangle uses."""
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces] = True
    numbers = np.cumsum(used) - 1
    return Mesh(mesh.vertices[used], numbers[mesh.faces].astype(np.int32), mesh.colors[used])


def parts(mesh: Mesh) -> tuple[int, np.ndarray]:
    """Return the number of connected parts, and the part of each triangle, shape [F]."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    count = len(mesh.vertices)
    graph = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), (count, count))
    number, labels = connected_components(graph, directed=False)
    return number, labels[mesh.faces[:, 0]]


def remove_small_parts(mesh: Mesh, fraction: float = MIN_PART) -> tuple[Mesh, int]:
    """Return a mesh without connected parts of less than ``fraction`` of all triangles, and the number of removed parts."""
    number, part = parts(mesh)
    sizes = np.bincount(part, minlength=number)
    keep = sizes >= max(1.0, fraction * len(mesh.faces))
    left = Mesh(mesh.vertices, mesh.faces[keep[part]], mesh.colors)
    return _compact(left), int((~keep).sum())


def decimate(mesh: Mesh, max_faces: int) -> Mesh:
    """Return a mesh of at most about ``max_faces`` triangles, without colours; open edges stay where they are.

    VTK collapses edges in the order of their quadric error (Garland and Heckbert 1997). This part of VTK needs no graphics
    library.

    Args:
        mesh: The mesh; it is returned unchanged if it is small enough.
        max_faces: Number of triangles, at least 4.
    """
    if len(mesh.faces) <= max_faces:
        return mesh
    import pyvista

    # centred and scaled to size 1, since VTK computes in float32
    middle = mesh.vertices.mean(0)
    size = float(np.abs(mesh.vertices - middle).max()) or 1.0
    data = pyvista.PolyData.from_regular_faces(((mesh.vertices - middle) / size).astype(np.float32), mesh.faces)
    fewer = data.decimate(1 - max_faces / len(mesh.faces))
    return _compact(_grey(np.asarray(fewer.points, np.float64) * size + middle, fewer.regular_faces))
