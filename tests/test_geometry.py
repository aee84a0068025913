"""Geometry: rotations, logit, projection and back-projection, for arrays and tensors."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, hand_placed
from tests.lens_cameras import LENSES, lens_camera
from warpgs import geometry
from warpgs.errors import UsageError
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
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


def test_normals_of_gaussians_are_their_shortest_axes():
    """The eigenvector of the smallest eigenvalue of each covariance, towards the camera; of a batch, towards each."""
    g, cams = hand_placed(), camera(cameras=3)
    found = geometry.gaussian_normals(g, cams)
    turns = geometry.rotation_matrices(g.quats / g.quats.norm(dim=1, keepdim=True))
    axis = torch.linalg.eigh(turns @ torch.diag_embed((2 * g.log_scales).exp()) @ turns.mT).eigenvectors[..., 0]
    for viewmat, normals in zip(cams.viewmat, found):
        assert torch.allclose((normals * axis).sum(1).abs(), torch.ones(len(g), dtype=torch.float64), atol=1e-12)
        in_camera = g.means @ viewmat[:3, :3].T + viewmat[:3, 3]
        assert bool(((normals @ viewmat[:3, :3].T * in_camera).sum(1) < 0).all())
        one = Camera(viewmat.numpy(), cams.K[0].numpy(), cams.width, cams.height)
        assert torch.allclose(geometry.gaussian_normals(g, one), normals, atol=1e-15)
        parallel = geometry.gaussian_normals(g, dataclasses.replace(one, model="orthographic"))
        assert bool((parallel @ viewmat[2, :3] < 0).all()) and torch.equal(parallel.abs(), normals.abs())


def test_gradient_of_the_normals_of_gaussians():
    """By quaternions of any length, also through an image of normals."""
    g, cam = hand_placed(degree=0), camera()
    quats = g.quats.clone().requires_grad_()

    def rendered(quats: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        turned = dataclasses.replace(g, quats=quats)
        normals = geometry.gaussian_normals(turned, cam)
        return normals, rasterize(turned, cam, RasterizeOptions(rule=SMOOTH, features=normals)).features

    assert torch.autograd.gradcheck(rendered, quats, fast_mode=True)


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
        again = geometry.project_tensors(tensors, found)
        assert np.allclose(again[0].numpy(), pixels, atol=1e-9) and np.allclose(again[1].numpy(), depths, atol=1e-12)


def plane_depth(cam: Camera, normal: torch.Tensor, distance: float) -> torch.Tensor:
    """Depth [H, W] of the plane of the world points x with normal . x = distance."""
    y, x = torch.meshgrid(torch.arange(cam.height) + 0.5, torch.arange(cam.width) + 0.5, indexing="ij")
    R, t = cam.viewmat[:3, :3], cam.viewmat[:3, 3]
    rays = torch.stack([(x - cam.K[0, 2]) / cam.K[0, 0], (y - cam.K[1, 2]) / cam.K[1, 1], torch.ones_like(x)], -1).double()
    return (distance + normal @ R.T @ t) / (rays @ R @ normal)


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
def test_normals_of_a_plane(dtype, unit):
    """The plane's own, towards the camera, in any unit of length; zero at the border and around pixels without depth."""
    cam = camera(40, 30, cameras=4)
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 1.2], dtype=torch.float64), dim=0)
    for viewmat, K in zip(cam.viewmat, cam.K):
        viewmat = torch.cat([viewmat[:, :3], viewmat[:, 3:] * torch.tensor([[unit]] * 3 + [[1.0]])], 1)
        one = Camera(viewmat, K, 40, 30)
        depth = plane_depth(one, normal, 4 * unit)
        assert bool((depth > 0).all())
        depth[10, 20] = 0
        normals = geometry.depth_normals(dataclasses.replace(one, viewmat=viewmat.to(dtype), K=K.to(dtype)), depth.to(dtype))
        none = torch.zeros(30, 40, dtype=torch.bool)
        none[[0, -1]], none[:, [0, -1]] = True, True
        none[9:12, 20], none[10, 19:22] = True, True
        assert bool((normals[none] == 0).all())
        assert torch.allclose(normals[~none], -normal.to(dtype), atol=1e-12 if dtype == torch.float64 else 1e-3)


def test_gradient_of_normals():
    """By depth and camera, in float64 against central differences; none, not NaN, where there is no depth."""
    cam = camera(7, 6)
    depth = 3 + torch.rand(6, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    depth[2, 3] = 0

    def normals(depth, viewmat, K):
        return geometry.depth_normals(dataclasses.replace(cam, viewmat=viewmat, K=K), depth)

    inputs = [t.clone().requires_grad_() for t in (depth, cam.viewmat, cam.K)]
    assert torch.autograd.gradcheck(lambda v, K: normals(depth, v, K), inputs[1:], eps=1e-6, atol=1e-8)
    held = depth == 0  # a step there would give it depth
    assert torch.autograd.gradcheck(lambda d: normals(torch.where(held, 0, d), *inputs[1:]), inputs[0], eps=1e-6, atol=1e-8)
    (gradient,) = torch.autograd.grad(normals(*inputs)[..., 0].sum(), inputs[0])
    assert float(gradient[2, 3]) == 0 and bool(gradient.isfinite().all()) and bool(gradient.any())
    depth[4, 4] = torch.nan
    assert bool(normals(depth, cam.viewmat, cam.K).isnan().any())
    assert not bool(geometry.depth_normals(cam, depth[:2]).any())


@pytest.mark.parametrize("model", LENSES)
def test_points_come_back_from_lenses(model):
    """Pixels and depths of the rasterizer, and back; behind a pinhole there is nothing to see."""
    cam = lens_camera(model, width=40, height=30)
    arrays = Camera(*(a if isinstance(a, int | str | None) else a.numpy() for a in vars(cam).values()))
    points = np.random.default_rng(2).uniform(-1, 1, (50, 3)) + np.array([0, 0, 4])
    pixels, depths = geometry.project_points(arrays, points)
    gaussians = cloud(50, torch.float64)
    drawn = rasterize(dataclasses.replace(gaussians, means=torch.from_numpy(points)), cam).projected[0]
    shown = drawn[:, 5] > 0
    assert shown.any() and np.allclose(drawn[shown][:, [0, 1, 9]], np.column_stack([pixels, depths])[shown], atol=1e-9)
    assert np.allclose(geometry.back_project(arrays, pixels, depths), points, atol=1e-9)
    found = geometry.back_project_tensors(cam, torch.from_numpy(pixels), torch.from_numpy(depths))
    assert np.allclose(found.numpy(), points, atol=1e-9)
    again = geometry.project_tensors(cam, found)
    assert np.allclose(again[0].numpy(), pixels, atol=1e-6) and np.allclose(again[1].numpy(), depths, atol=1e-9)
    if model == "opencv":
        assert bool((geometry.project_tensors(cam, -found)[1] <= 0).all())
    if model == "opencv":
        assert geometry.project_points(arrays, -points)[1].tolist() == [0] * 50


def test_other_camera_models_are_refused():
    """Their projection is known to the kernels alone: an error, not wrong points."""
    cam = camera()
    arrays = Camera(cam.viewmat.numpy(), cam.K.numpy(), 18, 17, "own")
    with pytest.raises(UsageError, match="'own'; undistort"):
        geometry.project_points(arrays, np.zeros((1, 3)))
    with pytest.raises(UsageError, match="undistort"):
        geometry.back_project(arrays, np.zeros((1, 2)), np.ones(1))
    with pytest.raises(UsageError, match="undistort"):
        geometry.back_project_tensors(dataclasses.replace(cam, model="own"), torch.zeros(1, 2), torch.ones(1))
