"""Geometry: rotations, logit, projection and back-projection, for arrays and tensors."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.gaussians import camera
from warpgs import geometry
from warpgs.errors import UsageError
from warpgs.scene import Camera


def unit_quats(count: int = 200) -> np.ndarray:
    """Return random unit quaternions, with half turns and the identity among them."""
    q = np.random.default_rng(0).standard_normal((count, 4))
    q[:4] = np.eye(4)
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def test_rotations_turn_vectors_as_quaternions_do():
    """R v equals q v q*, R is orthonormal with determinant 1, and arrays and tensors give the same bits."""
    q = unit_quats()
    R = geometry.rotation_matrices(q)
    v = np.random.default_rng(1).standard_normal((len(q), 3))
    cross = np.cross(q[:, 1:], v) + q[:, :1] * v  # q v q* = v + 2 u x (u x v + w v)
    assert np.allclose(np.einsum("nij,nj->ni", R, v), v + 2 * np.cross(q[:, 1:], cross), atol=1e-14)
    assert np.allclose(R @ R.transpose(0, 2, 1), np.eye(3), atol=1e-14) and np.allclose(np.linalg.det(R), 1)
    assert np.array_equal(geometry.rotation_matrices(torch.from_numpy(q)).numpy(), R)
    assert np.array_equal(geometry.rotation_matrices(q[7]), R[7])


def test_quaternions_of_rotations_come_back():
    """Up to the sign, for half turns too."""
    q = torch.from_numpy(unit_quats())
    found = geometry.quaternions(geometry.rotation_matrices(q))
    assert torch.allclose((found * q).sum(1).abs(), torch.ones(len(q), dtype=torch.float64), atol=1e-14)


@pytest.mark.parametrize("probability", [1e-12, 0.1, 0.5, 0.99])
def test_logit_is_the_inverse_of_the_sigmoid(probability):
    """Near both ends, too."""
    assert 1 / (1 + math.exp(-geometry.logit(probability))) == pytest.approx(probability, rel=1e-12)


def test_logits_of_both_ends_are_infinite():
    """No opacity is below 0, and none is above 1; beyond them there is no logit."""
    assert (geometry.logit(0), geometry.logit(1.0)) == (-math.inf, math.inf)
    for probability in (-0.1, 1.1):
        with pytest.raises(ValueError):
            geometry.logit(probability)


def test_points_come_back_from_pixels_and_depths():
    """Projection and both back-projections are inverse to each other."""
    cam = camera(40, 30, cameras=4)
    for viewmat, K in zip(cam.viewmat, cam.K):
        arrays, tensors = Camera(viewmat.numpy(), K.numpy(), 40, 30), Camera(viewmat, K, 40, 30)
        points = np.random.default_rng(2).uniform(-1, 1, (50, 3)) + np.array([0, 0, 4])
        pixels, depths = geometry.project_points(arrays, points)
        assert np.allclose(geometry.back_project(arrays, pixels, depths), points, atol=1e-12)
        found = geometry.back_project_tensors(tensors, torch.from_numpy(pixels), torch.from_numpy(depths))
        assert np.allclose(found.numpy(), points, atol=1e-12)


def test_other_camera_models_are_refused():
    """Their projection is known to the kernels alone: an error, not wrong points."""
    cam = camera()
    arrays = Camera(cam.viewmat.numpy(), cam.K.numpy(), 18, 17, "orthographic")
    with pytest.raises(UsageError, match="'orthographic'; undistort"):
        geometry.project_points(arrays, np.zeros((1, 3)))
    with pytest.raises(UsageError, match="undistort"):
        geometry.back_project(arrays, np.zeros((1, 2)), np.ones(1))
    with pytest.raises(UsageError, match="undistort"):
        geometry.back_project_tensors(dataclasses.replace(cam, model="orthographic"), torch.zeros(1, 2), torch.ones(1))
