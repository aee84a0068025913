"""The errors of meshes are measured right: distances to shapes, to triangles, and what is made of them."""

import numpy as np
import pytest

from bench.lib import surfaces
from warpgs.scene import Camera, Mesh
from warpgs.synthetic import raycast
from warpgs.synthetic.demo import camera_path, still_life

SQUARE = Mesh(
    np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]]),
    np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    np.zeros((4, 3), np.float32),
)


def test_distances_to_the_shapes_that_rays_hit():
    """Points that rays hit lie on a surface; moved along its normal they lie that far from their shape, also inside of it."""
    shapes, camera = still_life(), camera_path(8, 64, 48)[3]
    points = surfaces.true_points(shapes, [camera])
    assert len(points) == 64 * 48 and np.min([surfaces.distance_to(s, points) for s in shapes], axis=0).max() < 1e-4
    rays = raycast.pixel_rays(camera.K, camera.viewmat, np.random.default_rng(0).uniform(0, 48, (500, 2)))
    t, index = raycast.cast(shapes, camera.center, rays)
    for i, shape in enumerate(shapes):
        x = camera.center + (t[:, None] * rays)[index == i]
        normals = shape.normal(shape.local(x)) @ shape.rotation.T
        for step in (0.02, -0.02):
            found = surfaces.distance_to(shape, x + step * normals)
            assert (found <= 0.02 + 1e-6).all() and (not len(x) or np.median(found) == pytest.approx(0.02, abs=1e-6))


def test_depth_is_along_the_axis():
    """A wall across the axis has one depth."""
    wall = raycast.Plane((0, 0, 3.0), still_life()[0].texture)
    camera = Camera(np.eye(4), np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), 32, 24)
    assert np.allclose(surfaces.true_depth([wall], camera), 3) and surfaces.true_depth([wall], camera).shape == (24, 32)


def test_samples_and_distances_of_triangles():
    """Samples lie on the triangles, evenly; distances are to the nearest point of them, not to a vertex."""
    found = surfaces.sample(SQUARE, 4000)
    assert (found[:, 2] == 0).all() and np.allclose(found.mean(0), [1, 0.5, 0], atol=0.05)
    assert np.allclose(surfaces.distance_to_mesh(SQUARE, np.array([[1.0, 0.5, 3], [4, 0.5, 0], [1, 0.2, 0]])), [3, 2, 0])
    row = surfaces.summary("x", np.array([0.0, 0.01, 0.02, 0.97]), 1.0)
    assert (
        row["x_mean"] == row["x_mean_of_radius"] == 0.25 and row["x_median"] == 0.015 and row["x_within_0.01_of_radius"] == 0.5
    )
