"""Triangles of grids whose surface is known: where they are, which way they face, where the mesh stays open."""

import numpy as np
import pytest
import torch

from warpgs.errors import DataError
from warpgs.kernels.tsdf import DistanceGrid
from warpgs.mesh.fuse import decimate, extract, parts, remove_small_parts
from warpgs.scene import Mesh

ORIGIN, VOXEL = (-1.5, -1.4, -1.6), 0.1


def grid_of(distance, seen=None, shape=(31, 29, 33)):
    """Return a grid of a distance function of points [..., 3], in units of four voxels, seen where ``seen`` says."""
    x = np.array(ORIGIN) + VOXEL * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    weights = np.ones(shape) if seen is None else seen(x).astype(float)
    values = np.clip(distance(x) / (4 * VOXEL), -1, 1)
    return DistanceGrid(ORIGIN, VOXEL, 4 * VOXEL, torch.tensor(values).float(), torch.tensor(weights).float())


def sphere(x):
    return np.linalg.norm(x, axis=-1) - 1


def areas_and_normals(mesh: Mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a) / 2
    return np.linalg.norm(normals, axis=1), normals, (a + b + c) / 3


def test_a_sphere_is_closed_and_faces_outwards():
    """Vertices a hundredth of a voxel from the surface, its area and volume, one part, every edge of two triangles."""
    mesh = extract(grid_of(sphere))
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 0.02 * VOXEL
    area, normals, middles = areas_and_normals(mesh)
    assert area.sum() == pytest.approx(4 * np.pi, rel=0.01)
    assert (normals * middles).sum() / 3 == pytest.approx(4 / 3 * np.pi, rel=0.01)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all() and parts(mesh)[0] == 1
    assert mesh.faces.dtype == np.int32 and mesh.colors.shape == mesh.vertices.shape


def test_what_was_not_seen_stays_open():
    """No triangle reaches into the unseen half, and none closes it."""
    mesh = extract(grid_of(sphere, lambda x: x[..., 0] < 0.33))
    assert 0.2 < mesh.vertices[:, 0].max() < 0.33
    _, normals, middles = areas_and_normals(mesh)
    assert ((normals * middles).sum(1) > 0).all()  # a lid would face another way than outwards
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)


def test_no_skirt_between_two_surfaces():
    """Where distance jumps from before a surface to behind another, no triangles connect the two."""
    mesh = extract(grid_of(lambda x: np.where(x[..., 0] < 0.05, x[..., 2] + 0.53, x[..., 2] - 0.53)))
    assert (np.abs(np.abs(mesh.vertices[:, 2]) - 0.53) < 1.2 * VOXEL).all() and parts(mesh)[0] == 2


def test_small_parts_go():
    """A speck beside a sphere; the sphere stays as it is."""
    alone = extract(grid_of(sphere))
    both = extract(grid_of(lambda x: np.minimum(sphere(x), np.linalg.norm(x - [1.2, 1.1, 1.3], axis=-1) - 0.12)))
    assert parts(both)[0] == 2
    mesh, removed = remove_small_parts(both, 0.05)
    assert removed == 1 and len(mesh.faces) == len(alone.faces) and np.allclose(mesh.vertices, alone.vertices)
    kept, none = remove_small_parts(both, 0.0)
    assert none == 0 and len(kept.faces) == len(both.faces)


def test_fewer_triangles_of_the_same_surface():
    """A fifth of them, at most a tenth of a voxel off, with the same open edge; the same bits twice; few stay as they are."""
    mesh = extract(grid_of(sphere, lambda x: x[..., 0] < 0.33))
    fewer = decimate(mesh, len(mesh.faces) // 5)
    assert 0.15 * len(mesh.faces) < len(fewer.faces) <= 0.2 * len(mesh.faces) + 1
    assert np.abs(np.linalg.norm(fewer.vertices, axis=1) - 1).max() < 0.1 * VOXEL
    assert fewer.vertices[:, 0].max() == pytest.approx(mesh.vertices[:, 0].max(), abs=VOXEL / 2)
    _, normals, middles = areas_and_normals(fewer)
    assert (normals * middles).sum() > 0
    assert decimate(mesh, len(mesh.faces)) is mesh
    assert np.array_equal(fewer.vertices, decimate(mesh, len(mesh.faces) // 5).vertices)


@pytest.mark.parametrize("seen", [lambda x: x[..., 0] > 9, lambda x: x[..., 0] > 1.2])
def test_no_surface_is_said(seen):
    """Nothing seen at all, and nothing but emptiness."""
    with pytest.raises(DataError, match="no surface inside the grid"):
        extract(grid_of(sphere, seen))
