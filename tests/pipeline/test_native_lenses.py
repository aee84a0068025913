"""A fit through a lens from a folder to its scores, and what each command makes of such a run."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch

import warpgs
from tests.io.scenes import save
from tests.scenes import ring, seeds, three_gaussians
from warpgs import geometry
from warpgs.app.cli import main
from warpgs.errors import UsageError
from warpgs.geometry import pinhole_of, seen_pixels
from warpgs.io.images import list_images
from warpgs.pipeline.films.paths import framed
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train.settings import FitConfig, settings_by_views
from warpgs.pipeline.train.setup import prepare
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Scene, View
from warpgs.synthetic.demo import split_spec, write_demo

LENS = ("OPENCV_FISHEYE", "fisheye", (2.0, 0, 0, 0))
"""A lens that shows less of the scene than the pinhole of the same K."""
CPU = ["--device", "cpu"]


def write_lens_demo(folder) -> None:
    """Write the demo scene as a fisheye takes it: its images through the lens, and cameras that say so."""
    write_demo(folder, views=8, width=64, height=48)
    cameras = folder / "sparse" / "0" / "cameras.txt"
    number, _, width, height, *K = cameras.read_text().splitlines()[-1].split()
    fx, fy, cx, cy = map(float, K)
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    rays = geometry.from_plane(LENS[1], np.array(LENS[2]), np.stack([(x - cx) / fx, (y - cy) / fy], -1))
    at = rays[..., :2] / rays[..., 2:] * [fx, fy] + [cx - 0.5, cy - 0.5]
    for path in list_images(folder / "images"):
        image = cv2.imread(str(path))[..., ::-1]
        save(path, cv2.remap(image, *np.moveaxis(at.astype(np.float32), -1, 0), cv2.INTER_LINEAR))
    cameras.write_text(f"{number} {LENS[0]} {width} {height} {' '.join(K)} {' '.join(map(str, LENS[2]))}\n")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of the default preset through the lens."""
    folder = tmp_path_factory.mktemp("lens")
    write_lens_demo(folder / "scene")
    flags = ["--lenses", "native", "--steps", "8", "--split", split_spec(8), *CPU]
    assert main(["fit", str(folder / "scene"), "--out", str(folder / "run"), *flags]) == 0
    return folder / "run"


@pytest.mark.slow
def test_the_default_fit_goes_through_the_lens(run):
    """Images are those of the float64 reference through the lens, and coverage is known."""
    record, metrics = (json.loads((run / f"{n}.json").read_text()) for n in ("config", "metrics"))
    assert record["scene"]["lenses"] == "native"
    assert {c["model"] for c in record["cameras"].values()} == {"fisheye"}
    assert metrics["rule"]["mean"] < 1e-5 and metrics["coverage"]["classes"]


@pytest.mark.slow
def test_depth_found_in_other_views_is_that_of_the_lens(run):
    """Where the sweep finds depth, exact points of the scene lie there in half of the pixels."""
    scene = warpgs.load_scene(run.parent / "scene", lenses="native")
    config, _ = settings_by_views(FitConfig(steps=2, init=InitConfig(source="sweep")), list(scene.views), "cpu")
    cpu, generator = torch.device("cpu"), np.random.default_rng(0)
    depths = prepare(list(scene.views), None, config, generator, cpu, [], lambda: None).start.depths
    errors = []
    for view, found in zip(scene.views, depths, strict=True):
        own = np.array([view.name in t for t in scene.points.tracks])
        _, rows, columns, exact = seen_pixels(view.camera, scene.points.points[own])
        valid = found.valid[rows, columns]
        errors.append(np.abs(found.depth[rows, columns][valid] / exact[valid] - 1))
    # 0.009; where the lens is read as a pinhole 0.045
    assert sum(map(len, errors)) > 500 and np.median(np.concatenate(errors)) < 0.018


@pytest.mark.slow
def test_commands_know_the_lens_or_take_its_pinhole(run, tmp_path, capsys):
    """Scores go through the lens; films, meshes and files of cameras take the pinhole of the same K, which a note says."""
    stored = warpgs.open_run(run, "cpu")
    camera = next(iter(stored.cameras().values()))
    assert camera.model == "fisheye" and camera.distortion.tolist() == list(LENS[2])
    before = json.loads((run / "metrics.json").read_text())["test"]
    assert main(["eval", str(run), *CPU]) == 0
    assert json.loads((run / "metrics.json").read_text())["test"]["psnr"] == pytest.approx(before["psnr"], abs=1e-6)
    assert main(["render", str(run), "--path", "interpolate", "--frames", "2", "--out", str(tmp_path / "film"), *CPU]) == 0
    assert main(["mesh", str(run), "--out", str(tmp_path / "m.ply"), "--resolution", "16", *CPU]) == 0
    capsys.readouterr()
    assert main(["export", str(run), "--to", str(tmp_path / "transforms.json")]) == 0
    assert "written without their lens distortion, as pinholes" in capsys.readouterr().out
    frame = json.loads((tmp_path / "transforms.json").read_text())["frames"][0]
    assert frame["fl_x"] == pytest.approx(camera.K[0, 0])


@pytest.mark.slow
def test_orthographic_views_are_fitted_from_points(tmp_path):
    """With scores and a report; where a pinhole would be needed, the error says what to do."""
    views = []
    for i, c in enumerate(ring(8)):
        K = np.concatenate([c.K[:, :2] / 2.2, c.K[:, 2:]], 1)
        c = dataclasses.replace(c, K=K, model="orthographic")
        views.append(View(f"{i}.png", c, rasterize(three_gaussians(), c).rgb.clamp(0, 1).numpy()))
    scene = Scene("", "own", tuple(views), points=seeds())
    options = {"device": "cpu", "verbose": False, "split": "every:4"}
    result = warpgs.fit(scene, "3dgs", steps=60, init={"source": "points"}, out=tmp_path / "run", **options)
    # 16.7 dB; 16.8 by pinholes
    assert result.metrics["test"]["psnr"] > 16 and "coverage" not in result.metrics
    assert result.metrics["rule"]["mean"] < 1e-5 and (tmp_path / "run" / "report.html").is_file()
    with pytest.raises(UsageError, match=r"camera model orthographic: .* --init.source points"):
        warpgs.fit(scene, steps=2, **options)
    with pytest.raises(UsageError, match="'orthographic'"):
        warpgs.render_path(result, "turntable", out=tmp_path / "film", frames=2)


def test_a_pinhole_in_place_of_a_lens():
    """Pose, K and size stay; parallel rays have no pinhole."""
    camera = dataclasses.replace(ring(1)[0], model="opencv", distortion=np.ones(8))
    found = pinhole_of(camera)
    assert (found.model, found.distortion) == ("pinhole", None) and found.K is camera.K and found.viewmat is camera.viewmat
    assert framed(camera, (20, 16)).model == "pinhole" and pinhole_of(found) is found
    parallel = Camera(camera.viewmat, camera.K, 40, 32, "orthographic")
    with pytest.raises(UsageError, match="only pinhole cameras are supported here, not 'orthographic'"):
        pinhole_of(parallel)
