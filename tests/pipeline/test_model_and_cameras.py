"""Gaussians trained elsewhere render through cameras from a file."""

import json

import numpy as np
import pytest

from tests.gaussians import cloud
from tests.io import scenes
from warpgs.errors import DataError, UsageError
from warpgs.export.cameras import write_cameras
from warpgs.export.formats import write_gaussians
from warpgs.geometry import look_at
from warpgs.io.camera_files import read_cameras
from warpgs.pipeline.runs.commands import render
from warpgs.pipeline.runs.film_plan import FilmSettings
from warpgs.pipeline.runs.model_and_cameras import open_file
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera


def make_cameras(count=3):
    K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    up, target = np.array([0.0, -1, 0]), np.array([0.0, 0, 4])
    return [Camera(look_at(np.array([0.5 * i - 0.5, 0.2 * i, 0.0]), target, up), K, 64, 48) for i in range(count)]


@pytest.mark.parametrize("name", ["cameras.json", "transforms.json"])
def test_cameras_read_back(name, tmp_path):
    made = make_cameras()
    write_cameras(tmp_path / name, made)
    found, notes = read_cameras(tmp_path / name)
    assert len(found) == 3 and not notes and str(tmp_path) not in (tmp_path / name).read_text()
    for a, b in zip(made, found.values()):
        assert np.allclose(a.viewmat, b.viewmat) and np.allclose(a.K, b.K) and (a.width, a.height) == (b.width, b.height)
    with pytest.raises(UsageError, match=r"cameras\.json or transforms\.json"):
        write_cameras(tmp_path / "poses.json", made)


def test_cameras_of_colmap(tmp_path):
    scenes.write_colmap(tmp_path)
    found, _ = read_cameras(tmp_path)
    assert len(found) == 5 and list(found) == sorted(found)


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


@pytest.mark.parametrize("rule", ["inria", "gsplat"])
def test_a_file_shows_what_it_held(rule, tmp_path):
    made, cameras = cloud(50), make_cameras()
    write_gaussians(tmp_path / "a.ply", made, units="file")
    write_cameras(tmp_path / "cameras.json", cameras)
    model, notes = open_file(tmp_path / "a.ply", tmp_path / "cameras.json", rule, "cpu")
    assert "50 Gaussians, 3 cameras" in notes[-1] and model.rule == rule
    like = made.means.new_tensor
    for there, c in zip(model.cameras().values(), cameras):
        image = rasterize(model.gaussians(), Camera(like(there.viewmat), like(there.K), 64, 48)).rgb
        want = rasterize(made, Camera(like(c.viewmat), like(c.K), 64, 48)).rgb
        assert float((image - want).abs().max()) < 1e-3 and float(want.max()) > 0.1


def test_render_of_a_file(tmp_path):
    write_gaussians(tmp_path / "a.spz", cloud(50), units="file")
    write_cameras(tmp_path / "cameras.json", make_cameras())
    out, settings = tmp_path / "out", FilmSettings(frames=1)
    lines = render(tmp_path / "a.spz", "views", out, settings, "cpu", file_of=(tmp_path / "cameras.json", None))
    assert any("cut-offs of inria" in line for line in lines) and len(list(out.glob("*.png"))) == 3
    with pytest.raises(UsageError, match="has no cameras"):
        render(tmp_path / "a.spz", "views", out, settings, "cpu", file_of=(None, None))
    with pytest.raises(UsageError, match="--rule other"):
        render(tmp_path / "a.spz", "views", out, settings, "cpu", file_of=(tmp_path / "cameras.json", "other"))
    assert json.loads((tmp_path / "cameras.json").read_text())[0]["img_name"] == "0000"
