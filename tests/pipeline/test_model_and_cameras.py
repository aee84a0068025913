"""Gaussians trained elsewhere render through cameras from a file."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.gaussians import cloud
from tests.io import scenes
from warpgs.app.cli import main
from warpgs.errors import DataError, UsageError
from warpgs.export.base import write_gaussians
from warpgs.export.meshes_and_cameras import NAMES, write_cameras
from warpgs.files import make_folder
from warpgs.geometry import look_at
from warpgs.io.transforms import read_cameras
from warpgs.pipeline.films.film import FilmSettings
from warpgs.pipeline.run.commands import open_file, render
from warpgs.pipeline.run.export import Filters, convert
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera


def make_cameras(count=3):
    K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    up, target = np.array([0.0, -1, 0]), np.array([0.0, 0, 4])
    return [Camera(look_at(np.array([0.5 * i - 0.5, 0.2 * i, 0.0]), target, up), K, 64, 48) for i in range(count)]


def torch_camera(camera):
    return Camera(*(torch.from_numpy(np.asarray(m)).float() for m in (camera.viewmat, camera.K)), camera.width, camera.height)


@pytest.mark.parametrize("name", NAMES)
def test_cameras_read_back(name, tmp_path):
    made = make_cameras()
    assert write_cameras(tmp_path / name, made) == []
    found, notes = read_cameras(tmp_path / name if name != "sparse" else tmp_path)
    text = "".join(p.read_text() for p in tmp_path.rglob("*") if p.is_file())
    assert len(found) == 3 and not notes and str(tmp_path) not in text
    for a, b in zip(made, found.values()):
        assert np.allclose(a.viewmat, b.viewmat) and np.allclose(a.K, b.K) and (a.width, a.height) == (b.width, b.height)
    with pytest.raises(UsageError, match=r"cameras\.json or transforms\.json"):
        write_cameras(tmp_path / "poses.json", made)
    made[0].K[0, 2] += 2
    make_folder(tmp_path / "b")
    notes = write_cameras(tmp_path / "b" / name, made)
    assert ("up to 2.0 px" in notes[0]) if name == "cameras.json" else not notes


def test_a_reconstruction_is_not_replaced(tmp_path):
    scenes.write_colmap(tmp_path)
    with pytest.raises(UsageError, match="exists already"):
        write_cameras(tmp_path / "sparse", make_cameras())


def test_colmap_reads_our_cameras(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    write_cameras(tmp_path / "sparse", made := make_cameras())
    found = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert len(found.images) == 3 and len(found.cameras) == 1
    for image in found.images.values():
        pose = np.asarray(image.cam_from_world().matrix())
        assert np.allclose(pose, made[int(image.name[:4])].viewmat[:3])


def test_cameras_turn_with_their_gaussians(tmp_path):
    """A model and its cameras, both converted with the same rotation, give the same image."""
    made, cameras = cloud(50, degree=2), make_cameras()
    write_gaussians(tmp_path / "a.ply", made, units="file")
    write_cameras(tmp_path / "cameras.json", cameras)
    turn = Filters(rotate="1,2,3,70")
    convert(tmp_path / "a.ply", tmp_path / "b.ply", turn)
    lines = convert(tmp_path / "cameras.json", tmp_path / "b" / "transforms.json", turn)
    assert "rotated by 70.0 degrees" in lines[0] and "3 cameras for images of 64 x 48 px in" in lines[-1]
    models = [open_file(tmp_path / f"{x}.ply", tmp_path / y, "inria", "cpu")[0] for x, y in (
        ("a", "cameras.json"), ("b", "b/transforms.json"))]  # fmt: skip
    images = [rasterize(m.gaussians(), torch_camera(list(m.cameras().values())[1])).rgb for m in models]
    assert float((images[0] - images[1]).abs().max()) < 1e-3 and float(images[0].max()) > 0.1
    with pytest.raises(UsageError, match="do not apply to cameras"):
        convert(tmp_path / "cameras.json", tmp_path / "c" / "cameras.json", Filters(clean=True))
    convert(tmp_path / "cameras.json", tmp_path / "l" / "cameras.json", Filters(rotate="level"))
    with pytest.raises(UsageError, match="not supported"):
        convert(tmp_path / "cameras.json", tmp_path / "c.txt")


def test_cameras_of_colmap(tmp_path):
    scenes.write_colmap(tmp_path)
    found, _ = read_cameras(tmp_path)
    assert len(found) == 5 and list(found) == sorted(found)
    lines = convert(tmp_path, tmp_path / "transforms.json")  # names of files may say who and where
    assert all("photo" in name for name in found) and "5 cameras" in lines[-1]
    assert "photo" not in (tmp_path / "transforms.json").read_text()
    for below in ("sparse", "sparse/0"):
        assert list(read_cameras(tmp_path / below)[0]) == list(found)


ROW = '"position": [0, 0, %s], "width": 9, "height": 9, "fx": 9, "fy": 9}]'


@pytest.mark.parametrize(
    "text,match",
    [
        ("[]", "holds no camera"), ("{}", "no list 'frames'"), ("[1]", "camera 0: needs"),
        ("[" * 10000, "cannot be read as JSON"),
        ('[{"rotation": [[1,0,0],[0,1,0],[0,0,1]], ' + ROW % "1e999", "camera 0"),
        ('[{"rotation": [[2,0,0],[0,1,0],[0,0,1]], ' + ROW % "0", "camera 0"),
        ('{"frames": [{"transform_matrix": [[1]], "w": 9, "h": 9, "fl_x": 9}]}', "frame 0"),
        ('{"frames": [{"transform_matrix": [[1]], "fl_x": 9}]}', "gives no w and h"),
    ],
)  # fmt: skip
def test_files_that_hold_no_cameras(text, match, tmp_path):
    (tmp_path / "cameras.json").write_text(text)
    with pytest.raises(DataError, match=match):
        read_cameras(tmp_path / "cameras.json")


@pytest.mark.parametrize("rule", ["inria", "gsplat-1.5"])
def test_a_file_shows_what_it_held(rule, tmp_path):
    made, cameras = cloud(50), make_cameras()
    write_gaussians(tmp_path / "a.ply", made, units="file")
    write_cameras(tmp_path / "cameras.json", cameras)
    model, notes = open_file(tmp_path / "a.ply", tmp_path / "cameras.json", rule, "cpu")
    assert "50 Gaussians, 3 cameras" in notes[-1] and model.rule == rule
    for there, c in zip(model.cameras().values(), cameras):
        image = rasterize(model.gaussians(), torch_camera(there)).rgb
        want = rasterize(made, torch_camera(c)).rgb
        assert float((image - want).abs().max()) < 1e-3 and float(want.max()) > 0.1


def test_a_file_renders_antialiased(tmp_path):
    """Its options have the setting, and so have the frames of a film; runs, which have their own, refuse it."""
    made = cloud(50)
    made.log_scales.sub_(2)  # below a pixel
    write_gaussians(tmp_path / "a.ply", made, units="file")
    write_cameras(tmp_path / "cameras.json", make_cameras())
    model, _ = open_file(tmp_path / "a.ply", tmp_path / "cameras.json", "exact", "cpu", antialiased=True)
    camera = torch_camera(next(iter(model.cameras().values())))
    image, plain = (rasterize(model.gaussians(), camera, options).rgb for options in (model.options(), RasterizeOptions()))
    assert torch.equal(image, rasterize(model.gaussians(), camera, RasterizeOptions(antialiased=True)).rgb)
    assert float(image.sum()) < 0.7 * float(plain.sum())
    file = [
        "render",
        str(tmp_path / "a.ply"),
        "--cameras",
        str(tmp_path / "cameras.json"),
        "--path",
        "views",
        "--device",
        "cpu",
    ]
    frames = []
    for flags in (["--antialiased"], []):
        assert main([*file, "--out", str(tmp_path / f"out{len(flags)}"), *flags]) == 0
        frames.append(sorted((tmp_path / f"out{len(flags)}").glob("*.png"))[0].read_bytes())
    assert frames[0] != frames[1]
    assert main(["render", str(tmp_path), "--antialiased"]) == UsageError.exit_code


def test_render_of_a_file(tmp_path):
    write_gaussians(tmp_path / "a.spz", cloud(50), units="file")
    write_cameras(tmp_path / "cameras.json", make_cameras())
    out, settings = tmp_path / "out", FilmSettings()
    lines = render(tmp_path / "a.spz", "views", out, settings, "cpu", file_of=(tmp_path / "cameras.json", None))
    assert any("cut-offs of inria" in line for line in lines) and any("the background is black" in line for line in lines)
    assert len(list(out.glob("*.png"))) == 3
    write_cameras(tmp_path / "transforms.json", [replace(c, K=1000 * c.K, width=20000, height=20000) for c in make_cameras()])
    with pytest.raises(DataError, match="20000 x 20000 px has over 100,000,000 pixels"):
        render(tmp_path / "a.spz", "views", out, settings, "cpu", file_of=(tmp_path / "transforms.json", None))
    assert main(["render", str(tmp_path / "none.ply"), "--cameras", str(tmp_path / "cameras.json")]) == DataError.exit_code
    assert main(["render", str(tmp_path), "--cameras", str(tmp_path / "cameras.json")]) == UsageError.exit_code
    with pytest.raises(UsageError, match="cameras are named"):
        convert(tmp_path / "cameras.json", tmp_path / "poses.json")
    with pytest.raises(UsageError, match="has no cameras"):
        render(tmp_path / "a.spz", "views", out, settings, "cpu", file_of=(None, None))
    with pytest.raises(UsageError, match="unknown rule 'other'"):
        render(tmp_path / "a.spz", "views", out, settings, "cpu", file_of=(tmp_path / "cameras.json", "other"))
    assert json.loads((tmp_path / "cameras.json").read_text())[0]["img_name"] == "0000"
