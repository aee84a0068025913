"""Geometry and units: rotations, projection and lenses; the similarity between scene and file coordinates."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import warpgs
from tests.gaussians import LENSES, SMOOTH, camera, cloud, hand_placed, lens_camera
from warpgs import Normalization, export, geometry, load, rasterize, read_ply, save, write_ply
from warpgs.errors import DataError, UsageError
from warpgs.export.base import write_gaussians
from warpgs.geometry import convert_camera, convert_gaussians, near_cameras
from warpgs.io.load import normalize_view
from warpgs.render.options import RasterizeOptions
from warpgs.scene import ActivatedGaussians, Camera, PointCloud, Scene, View

N = Normalization(np.array([3.0, -2.0, 0.5]), 0.25)


def as_double(g):
    return type(g)(**{n: t.double() for n, t in g.tensors().items()})


def test_gaussians_and_cameras_together_look_the_same_in_both_units():
    """Converted alike, they give the same image; depth is longer by the scale, and only means and scales change."""
    g, c = as_double(cloud(40, degree=2)), camera()
    g_file, c_file = convert_gaussians(g, N, "scene", "file"), convert_camera(c, N, "scene", "file")
    before, after = rasterize(g, c), rasterize(g_file, c_file)
    assert float(before.alpha.max()) > 0.1
    torch.testing.assert_close(after.rgb, before.rgb, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(after.depth, before.depth / N.scale, rtol=1e-9, atol=1e-9)
    assert g_file.sh is g.sh and g_file.quats is g.quats and g_file.logit_opacities is g.logit_opacities
    np.testing.assert_allclose(g_file.means, g.means.numpy() / 0.25 + N.offset, rtol=1e-12)
    np.testing.assert_allclose(g_file.log_scales.exp(), g.log_scales.exp() / 0.25, rtol=1e-12)
    # conversions are inverse, and those of the reader
    g = as_double(cloud(5))
    back = convert_gaussians(convert_gaussians(g, N, "scene", "file"), N, "file", "scene")
    torch.testing.assert_close(back.means, g.means, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(back.log_scales, g.log_scales, rtol=1e-12, atol=1e-12)
    numpy_camera = Camera(np.asarray(c.viewmat, np.float64), np.asarray(c.K, np.float64), c.width, c.height)
    in_file = convert_camera(numpy_camera, N, "scene", "file")
    read = normalize_view(View("a", in_file, np.zeros((c.height, c.width, 3), np.float32)), N).camera
    np.testing.assert_allclose(read.viewmat, numpy_camera.viewmat, atol=1e-12)
    again = convert_camera(in_file, N, "file", "scene")
    np.testing.assert_array_equal(again.viewmat, read.viewmat)
    batch = dataclasses.replace(in_file, viewmat=torch.as_tensor(in_file.viewmat)[None].repeat(2, 1, 1))
    np.testing.assert_allclose(convert_camera(batch, N, "file", "scene").viewmat[1], read.viewmat, atol=1e-12)
    assert convert_camera(c, N, "file", "file") is c and convert_gaussians(g, N, "scene", "scene") is g


@pytest.mark.parametrize("units", ["scene", "file"])
def test_model_and_ply_files_know_their_units(tmp_path, units):
    g = cloud(30, degree=1)
    given = convert_gaussians(g, N, "scene", units)
    for name in ("again.safetensors", "m.safetensors"):
        save(tmp_path / name, given, N, units=units)
    assert (tmp_path / name).read_bytes() == (tmp_path / "again.safetensors").read_bytes()
    write_ply(tmp_path / "m.ply", given, N, units=units)
    model = load(tmp_path / "m.safetensors")
    for wanted in ("scene", "file"):
        reference = convert_gaussians(g, N, "scene", wanted)
        for found in (model.gaussians(wanted), read_ply(tmp_path / "m.ply", N, units=wanted)):
            for name, t in reference.tensors().items():
                torch.testing.assert_close(getattr(found, name), t, rtol=1e-5, atol=1e-5, msg=name)
    for read in (read_ply, export.read_gaussians):  # without units, a normalization is used
        assert torch.equal(read(tmp_path / "m.ply", N).means, read_ply(tmp_path / "m.ply", N, units="scene").means)
        assert torch.equal(read(tmp_path / "m.ply").means, read_ply(tmp_path / "m.ply", units="file").means)
    assert model.normalization.scale == N.scale and np.array_equal(model.normalization.offset, N.offset)
    torch.testing.assert_close(load(tmp_path / "m.safetensors").gaussians(units).means, given.means)


def test_texts_of_records_have_shapes():
    """No values, and no field that has its default."""
    g, c = cloud(3, degree=2), Camera(np.eye(4), np.eye(3), 16, 12)
    assert repr(g) == "Gaussians(means=[3, 3], quats=[3, 4], log_scales=[3, 3], logit_opacities=[3], sh=[3, 9, 3])"
    tensors = [g.means, g.quats, g.log_scales.exp(), g.logit_opacities.sigmoid()]
    assert repr(ActivatedGaussians(*tensors)) == "ActivatedGaussians(means=[3, 3], quats=[3, 4], scales=[3, 3], opacities=[3])"
    assert repr(c) == "Camera(viewmat=[4, 4], K=[3, 3], width=16, height=12)"
    view = View("a.png", c, np.zeros((12, 16, 3), np.float32))
    assert repr(view) == f"View(name='a.png', camera={c!r}, image=[12, 16, 3])"
    points = PointCloud(np.zeros((2, 3)), np.zeros((2, 3), np.float32))
    assert repr(points) == "PointCloud(points=[2, 3], colors=[2, 3])"
    assert (
        repr(Scene("there", "colmap", (view,) * 4, points))
        == f"Scene(path='there', format='colmap', views=[4], points={points!r})"
    )
    assert repr(replace(g, means=None)) and repr(replace(c, viewmat=[1], model="fisheye")).endswith(
        "height=12, model='fisheye')"
    )


def test_mistakes_are_named(tmp_path):
    g = cloud(3)
    with pytest.raises(UsageError, match="units 'metres' is not one of scene, file"):
        convert_gaussians(g, N, "scene", "metres")
    for call in (save, write_ply):
        with pytest.raises(UsageError, match="units='scene' requires normalization="):
            call(tmp_path / "a", g)
        for scale, offset in ((0.0, [0, 0, 0]), (np.nan, [0, 0, 0]), (1.0, [0, 0]), (1.0, [0, 0, np.inf])):
            with pytest.raises(DataError, match="is not a similarity"):
                call(tmp_path / "a", g, Normalization(np.array(offset), scale))
    with pytest.raises(UsageError, match="units='scene' requires"):
        read_ply(tmp_path / "a", units="scene")
    broken = type(g)(**{**g.tensors(), "means": g.means * float("nan")})
    with pytest.raises(DataError, match="means holds non-finite values"):
        save(tmp_path / "a", broken, units="file")
    assert not (tmp_path / "a").exists()
    with pytest.raises(DataError, match="cannot be read"):
        load(tmp_path / "a")
    write_ply(tmp_path / "a", g, units="file")
    with pytest.raises(DataError, match="damaged or not a safetensors file"):
        load(tmp_path / "a")
    save_file({"means": g.means}, tmp_path / "b")
    with pytest.raises(DataError, match="not a model of format"):
        load(tmp_path / "b")


@pytest.mark.parametrize("write", [warpgs.write_ply, warpgs.save, write_gaussians], ids=lambda f: f.__name__)
def test_only_stored_gaussians_are_written(tmp_path, write):
    means, quats, scales = torch.rand(2, 3), torch.rand(2, 4), torch.rand(2, 3)
    activated = warpgs.ActivatedGaussians(means, quats, scales, torch.full((2,), 0.5))
    path = tmp_path / f"scene{'.safetensors' if write is warpgs.save else '.ply'}"
    with pytest.raises(TypeError, match=r"not ActivatedGaussians; give gaussians\.stored\(\)"):
        write(path, activated, units="file")
    covariances = warpgs.CovarianceGaussians(means, torch.eye(3).repeat(2, 1, 1), torch.full((2,), 0.5))
    with pytest.raises(TypeError, match="not CovarianceGaussians; files hold quats, log scales and logits"):
        write(path, covariances, units="file")
    assert not path.exists()
    write(path, activated.stored(), units="file")
    assert path.exists()


@pytest.mark.parametrize("write", [save, write_ply, write_gaussians])
@pytest.mark.parametrize(
    ("name", "part", "said"),
    [
        ("means", (0, 0), r"means must have shape \[N, 3\] \(N=0\), not \[\]"),
        ("quats", (slice(None), slice(3)), r"quats must have shape \[N, 4\] \(N=6\), not \[6, 3\]"),
        ("log_scales", (slice(5),), r"log_scales must have shape \[N, 3\] \(N=6\), not \[5, 3\]"),
        ("sh", (slice(None), slice(3)), r"sh must have shape \[N, K, 3\] \(N=6\), where K is 1, 4, .*, not \[6, 3, 3\]"),
        ("sh", (slice(5),), r"sh must have shape .* not \[5, 4, 3\]"),
    ],
)  # fmt: skip
def test_tensors_that_do_not_go_together_are_not_written(tmp_path, write, name, part, said):
    g = cloud(6, degree=1)
    with pytest.raises(ValueError, match=said):
        write(tmp_path / "m.ply", dataclasses.replace(g, **{name: g.tensors()[name][part]}), units="file")
    with pytest.raises(TypeError, match="quats must be a torch tensor, not list"):
        write(tmp_path / "m.ply", dataclasses.replace(g, quats=g.quats.tolist()), units="file")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "types", [{"sh": torch.float64}, {"means": torch.float64}, dict.fromkeys(cloud(1).tensors(), torch.half)]
)
def test_what_load_refuses_is_not_saved(tmp_path, types):
    g = cloud(6)
    g = dataclasses.replace(g, **{name: g.tensors()[name].to(kind) for name, kind in types.items()})
    with pytest.raises(TypeError, match=r"is torch\.float.*; give all tensors as float32 or all as float64"):
        save(tmp_path / "m", g, units="file")
    assert not list(tmp_path.iterdir())


def unit_quats(count: int = 200) -> np.ndarray:
    q = np.random.default_rng(0).standard_normal((count, 4))
    q[:4] = np.eye(4)
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def test_rotations_turn_vectors_as_quaternions_do():
    q = unit_quats()
    R = geometry.rotation_matrices(q)
    v = np.random.default_rng(1).standard_normal((len(q), 3))
    cross = np.cross(q[:, 1:], v) + q[:, :1] * v  # q v q* = v + 2 u x (u x v + w v)
    assert np.allclose(np.einsum("nij,nj->ni", R, v), v + 2 * np.cross(q[:, 1:], cross), atol=1e-14)
    assert np.allclose(R @ R.transpose(0, 2, 1), np.eye(3), atol=1e-14) and np.allclose(np.linalg.det(R), 1)
    assert np.array_equal(geometry.rotation_matrices(torch.from_numpy(q)).numpy(), R)
    assert np.array_equal(geometry.rotation_matrices(q[7]), R[7])
    back = geometry.quaternions(torch.from_numpy(R)).numpy()  # up to the sign, for half turns too
    assert np.allclose(np.abs((back * q).sum(1)), 1, atol=1e-14)
    # logit is the inverse of the sigmoid
    for probability in (1e-12, 0.1, 0.5, 0.99):
        assert 1 / (1 + math.exp(-geometry.logit(probability))) == pytest.approx(probability, rel=1e-12)
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
    # their gradient
    g, cam = hand_placed(degree=0), camera()
    quats = g.quats.clone().requires_grad_()

    def rendered(quats: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        turned = dataclasses.replace(g, quats=quats)
        normals = geometry.gaussian_normals(turned, cam)
        return normals, rasterize(turned, cam, RasterizeOptions(rule=SMOOTH, features=normals)).features

    assert torch.autograd.gradcheck(rendered, quats, fast_mode=True)


def test_points_come_back_from_pixels_and_depths():
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
    cam = camera()  # of another model
    arrays = Camera(cam.viewmat.numpy(), cam.K.numpy(), 18, 17, "own")
    with pytest.raises(UsageError, match="'own'; undistort"):
        geometry.project_points(arrays, np.zeros((1, 3)))
    with pytest.raises(UsageError, match="undistort"):
        geometry.back_project(arrays, np.zeros((1, 2)), np.ones(1))
    with pytest.raises(UsageError, match="undistort"):
        geometry.back_project_tensors(dataclasses.replace(cam, model="own"), torch.zeros(1, 2), torch.ones(1))


def plane_depth(cam: Camera, normal: torch.Tensor, distance: float) -> torch.Tensor:
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
    assert not bool(geometry.depth_normals(dataclasses.replace(cam, height=2), depth[:2]).any())
    for other in (depth[:5], depth.T, depth[None]):
        with pytest.raises(UsageError, match=r"depth is .*, not \[6, 7\]; scale"):
            geometry.depth_normals(cam, other)


@pytest.mark.parametrize("model", LENSES)
def test_points_come_back_from_lenses(model):
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
        assert geometry.project_points(arrays, -points)[1].tolist() == [0] * 50


@pytest.mark.parametrize(
    "xs,points,far",
    [
        ([0, 1, 2, 3, 4], None, []), ([0, 1, 2, 3, 300], None, [4]), ([0, 0, 0, 0, 1], None, []),
        ([0, 0.05, 0.1, 2], [4.0], []), ([0, 0.05, 0.1, 2], None, []), ([0, 0.05, 0.1, 20], [4.0], [3]), ([0, 1e6], None, []),
        ([0, 1e-3, 2e-3, 3e-3, 1, 2], None, []),
    ],
)  # fmt: skip
def test_cameras_far_off_the_rest(xs, points, far):
    """Cameras that are close to each other compared with the scene, or in one place, are no reason to leave another one out."""
    centers = np.stack([np.array(xs, float), np.zeros(len(xs)), np.zeros(len(xs))], 1)
    cloud = None if points is None else np.array([[0, 0, z] for z in points])
    assert np.flatnonzero(~near_cameras(centers, cloud)).tolist() == far


def test_a_camera_that_cannot_look_there():
    """Lists are points, too; up along the view, or a target at the center, would give NaN."""
    assert np.allclose(
        geometry.look_at([0, 0, -3], [0, 0, 0], [0, -1, 0]), [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    )
    for target in ([0, -4, -3], [0, 0, -3]):
        with pytest.raises(UsageError, match="must not be parallel"):
            geometry.look_at([0, 0, -3], target, [0, -1, 0])
