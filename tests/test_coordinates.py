"""Units: the similarity between scene and file coordinates, forth and back."""

import dataclasses

import numpy as np
import pytest
import torch

import warpgs
from tests.gaussians import camera, cloud
from warpgs import Normalization, load, rasterize, read_ply, save, write_ply
from warpgs.errors import DataError, UsageError
from warpgs.export.base import write_gaussians
from warpgs.geometry import convert_camera, convert_gaussians
from warpgs.io.load import normalize_view
from warpgs.scene import Camera, View

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


def test_conversions_are_inverse_and_those_of_the_reader():
    """Scene to file to scene is the identity; file to scene is what `load_scene` does with cameras."""
    g, c = as_double(cloud(5)), camera()
    back = convert_gaussians(convert_gaussians(g, N, "scene", "file"), N, "file", "scene")
    torch.testing.assert_close(back.means, g.means, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(back.log_scales, g.log_scales, rtol=1e-12, atol=1e-12)
    numpy_camera = Camera(np.asarray(c.viewmat, np.float64), np.asarray(c.K, np.float64), c.width, c.height)
    in_file = convert_camera(numpy_camera, N, "scene", "file")
    read = normalize_view(View("a", in_file, np.zeros((c.height, c.width, 3), np.float32)), N).camera
    np.testing.assert_allclose(read.viewmat, numpy_camera.viewmat, atol=1e-12)
    again = convert_camera(in_file, N, "file", "scene")
    np.testing.assert_array_equal(again.viewmat, read.viewmat)
    batch = Camera(torch.as_tensor(in_file.viewmat)[None].repeat(2, 1, 1), torch.as_tensor(in_file.K)[None], c.width, c.height)
    np.testing.assert_allclose(convert_camera(batch, N, "file", "scene").viewmat[1], read.viewmat, atol=1e-12)
    assert convert_camera(c, N, "file", "file") is c and convert_gaussians(g, N, "scene", "scene") is g


@pytest.mark.parametrize("units", ["scene", "file"])
def test_model_and_ply_files_know_their_units(tmp_path, units):
    """Whatever units they were written from, they come back the same in either."""
    g = cloud(30, degree=1)
    given = convert_gaussians(g, N, "scene", units)
    save(tmp_path / "m.safetensors", given, N, units=units)
    write_ply(tmp_path / "m.ply", given, N, units=units)
    model = load(tmp_path / "m.safetensors")
    for wanted in ("scene", "file"):
        reference = convert_gaussians(g, N, "scene", wanted)
        for found in (model.gaussians(wanted), read_ply(tmp_path / "m.ply", N, units=wanted)):
            for name, t in reference.tensors().items():
                torch.testing.assert_close(getattr(found, name), t, rtol=1e-5, atol=1e-5, msg=name)
    assert model.normalization.scale == N.scale and np.array_equal(model.normalization.offset, N.offset)
    torch.testing.assert_close(load(tmp_path / "m.safetensors").gaussians(units).means, given.means)


def test_mistakes_are_named(tmp_path):
    """Unknown units, scene units without a scene, no similarity, numbers that are not finite, and files of others."""
    g = cloud(3)
    with pytest.raises(UsageError, match="units 'metres' is not one of scene, file"):
        convert_gaussians(g, N, "scene", "metres")
    for call in (save, write_ply):
        with pytest.raises(UsageError, match="units='scene' requires normalization="):
            call(tmp_path / "a", g)
        with pytest.raises(DataError, match="is not a similarity"):
            call(tmp_path / "a", g, Normalization(np.zeros(3), 0.0))
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
    from safetensors.torch import save_file

    save_file({"means": g.means}, tmp_path / "b")
    with pytest.raises(DataError, match="not a model of format"):
        load(tmp_path / "b")


@pytest.mark.parametrize("write", [warpgs.write_ply, warpgs.save, write_gaussians], ids=lambda f: f.__name__)
def test_only_stored_gaussians_are_written(tmp_path, write):
    """Those by scales and opacities name their conversion, which can be written."""
    means, quats, scales = torch.rand(2, 3), torch.rand(2, 4), torch.rand(2, 3)
    activated = warpgs.ActivatedGaussians(means, quats, scales, torch.full((2,), 0.5))
    path = tmp_path / "scene.ply"
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
        ("means", (slice(None), slice(2)), r"means must have shape \[N, 3\] \(N=6\), not \[6, 2\]"),
        ("means", (0, 0), r"means must have shape \[N, 3\] \(N=0\), not \[\]"),
        ("quats", (slice(None), slice(3)), r"quats must have shape \[N, 4\] \(N=6\), not \[6, 3\]"),
        ("log_scales", (slice(5),), r"log_scales must have shape \[N, 3\] \(N=6\), not \[5, 3\]"),
        ("logit_opacities", (slice(None), None), r"logit_opacities must have shape \[N\] \(N=6\), not \[6, 1\]"),
        ("sh", (slice(None), slice(3)), r"sh must have shape \[N, K, 3\] \(N=6\), where K is 1, 4, .*, not \[6, 3, 3\]"),
        ("sh", (slice(5),), r"sh must have shape .* not \[5, 4, 3\]"),
    ],
)  # fmt: skip
def test_tensors_that_do_not_go_together_are_not_written(tmp_path, write, name, part, said):
    """No file is there afterwards that no reader takes."""
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
    """A model has one type, float32 or float64."""
    g = cloud(6)
    g = dataclasses.replace(g, **{name: g.tensors()[name].to(kind) for name, kind in types.items()})
    with pytest.raises(TypeError, match=r"is torch\.float.*; give all tensors as float32 or all as float64"):
        save(tmp_path / "m", g, units="file")
    assert not list(tmp_path.iterdir())
