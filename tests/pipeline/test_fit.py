"""`warpgs.fit` from Python: the same fit as the command, with or without a run folder, in either units."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from PIL import Image

import warpgs
from warpgs.app.cli import main
from warpgs.errors import DataError, UsageError
from warpgs.export.base import read_gaussians
from warpgs.geometry import convert_camera
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.request import NO_SCORES
from warpgs.process import Detail
from warpgs.synthetic.demo import split_spec, write_demo

STEPS, SPLIT = 12, split_spec(8)
CONFIG = warpgs.FitConfig(steps=STEPS, init=InitConfig(source="random", random_count=80))
FLAGS = ["--preset", "3dgs", "--steps", str(STEPS), "--init.source", "random", "--init.random-count", "80", "--split", SPLIT]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene, and a run of the command on it."""
    folder = tmp_path_factory.mktemp("fit")
    write_demo(folder / "scene", views=8, width=40, height=32)
    assert main(["fit", str(folder / "scene"), "--out", str(folder / "run"), "--device", "cpu", *FLAGS]) == 0
    return folder


@pytest.fixture(scope="module")
def fitted(folder):
    """The same fit from Python on a scene in memory; the result and the reports of its steps."""
    steps = []
    scene = warpgs.load_scene(folder / "scene")
    result = warpgs.fit(scene, CONFIG, split=SPLIT, device="cpu", on_step=steps.append, verbose=False)
    return result, steps


def test_command_and_function_are_one_fit(folder, fitted):
    """Same Gaussians to the bit, same scores; the step reports are those of the log."""
    result, steps = fitted
    run = warpgs.open_run(folder / "run", "cpu")
    for name, t in run.gaussians().tensors().items():
        assert torch.equal(getattr(result.gaussians(), name), t), name
    stored = json.loads((folder / "run" / "metrics.json").read_text())
    assert {k: result.metrics[k] for k in ("test", "train", "views")} == {k: stored[k] for k in ("test", "train", "views")}
    assert [p["name"] for p in stored["photographs"]] == [*run.train, *run.test]
    assert [p["moved"] is None for p in stored["photographs"]] == [False] * len(run.train) + [True] * len(run.test)
    log = [json.loads(line) for line in (folder / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [(r.step, r.loss, r.count) for r in steps] == [(r["step"], r["loss"], r["count"]) for r in log]
    assert (result.config, result.step, result.folder) == (CONFIG, STEPS, None)
    assert (result.train, result.test) == (run.train, run.test) and len(result.test) > 0
    views = [warpgs.load_scene(folder / "scene").view(n) for n in result.test]
    assert warpgs.evaluate(result.gaussians(), views, result.options())[0].psnr == stored["views"][0]["psnr"]


def test_every_photograph_trains_by_default_and_a_run_remembers_its_scale(folder, tmp_path, capsys, monkeypatch):
    """No score is made up, which the report says; a later default leaves the run as it is."""
    few, out = dataclasses.replace(CONFIG, steps=2), tmp_path / "run"
    monkeypatch.setattr("warpgs.pipeline.run.request.CPU_MAX_SIDE", 20)
    result = warpgs.fit(folder / "scene", few, out=out, device="cpu")
    assert len(result.train) == 8 and result.test == () and not result.metrics["test"]
    printed = capsys.readouterr().out
    assert printed.count(NO_SCORES) == 1 and "no score of new views: no view is held out" in printed
    assert NO_SCORES in result.notes and NO_SCORES in (out / "report.html").read_text()
    protocol = result.metrics["protocol"]
    assert (protocol["split"], protocol["resolution"]) == ("all (no --split given)", ["20 x 16"])
    monkeypatch.setattr("warpgs.pipeline.run.request.CPU_MAX_SIDE", 30)
    record = json.loads((out / "config.json").read_text())["scene"]
    assert (record["downscale"], record["max_side"]) == (1, 20)
    assert main(["eval", str(out), "--device", "cpu"]) == 0 and "no view is held out" in capsys.readouterr().out
    with pytest.raises(UsageError, match="a flag that changes them, like --downscale"):
        warpgs.fit(folder / "scene", few, out=out, device="cpu", resume=True, verbose=False)


def test_nothing_is_written_or_printed_unless_asked_for(folder, tmp_path, monkeypatch, capsys):
    """Without a folder the current one stays empty; verbose prints what the command prints, else there is silence."""
    monkeypatch.chdir(tmp_path)
    few = dataclasses.replace(CONFIG, steps=2)
    loud = warpgs.fit(folder / "scene", few, device="cpu")
    printed = capsys.readouterr().out
    assert printed.splitlines()[0] == f"reading {folder / 'scene'}"
    assert "views to fit" in printed and "no run folder (out) was given" in printed
    (first,) = (line for line in printed.splitlines() if line.startswith("step 1 of 2"))
    assert first.endswith("per step -  left -")  # it may have compiled
    details = [n for n in loud.notes if isinstance(n, Detail)]
    assert any(n.startswith("shape: ") for n in details) and len(details) < len(loud.notes)
    assert all((n in printed) != isinstance(n, Detail) for n in loud.notes)
    assert warpgs.fit(folder / "scene", few, device="cpu", verbose=False).notes == loud.notes
    assert capsys.readouterr().out == "" and not list(tmp_path.iterdir())
    with pytest.raises(UsageError, match="preset 'best' is not one of"):
        warpgs.fit(folder / "scene", "best", device="cpu", out=tmp_path / "x")
    with pytest.raises(UsageError, match="resume requires out"):
        warpgs.fit(folder / "scene", CONFIG, resume=True)
    assert not list(tmp_path.iterdir())


def test_units_lead_from_the_fit_to_its_files_and_back(folder, fitted):
    """In file units the Gaussians are those of the PLY, the cameras those of the reconstruction."""
    result, _ = fitted
    ply = warpgs.read_ply(folder / "run" / "point_cloud.ply")
    torch.testing.assert_close(result.gaussians("file").means, ply.means, rtol=0, atol=0)
    again = warpgs.read_ply(folder / "run" / "point_cloud.ply", result.normalization, units="scene")
    torch.testing.assert_close(again.means, result.gaussians().means, rtol=1e-5, atol=1e-5)
    name, camera = next(iter(result.cameras("file").items()))
    scene = warpgs.load_scene(folder / "scene")
    wanted = (scene.view(name).camera.center / scene.normalization.scale) + scene.normalization.offset
    np.testing.assert_allclose(camera.center, wanted, atol=1e-9)


def test_render_path_takes_own_cameras_in_either_units(folder, fitted, tmp_path):
    """The same camera in scene and in file units gives the same PNG, which is the view's render; a film comes with them."""
    result, _ = fitted
    camera = result.cameras()[result.test[0]]
    in_file = convert_camera(camera, result.normalization, "scene", "file")
    *scene_files, film = warpgs.render_path(result, [camera, camera], out=tmp_path / "a")
    file_files = warpgs.render_path(result, [in_file], out=tmp_path / "b", units="file")
    assert film.name == "film.mp4" and len(scene_files) == 2 and len(file_files) == 2
    image, other = (np.asarray(Image.open(f), float) for f in (scene_files[0], file_files[0]))
    assert np.abs(image - other).max() <= 1
    with torch.no_grad():
        rgb = warpgs.rasterize(result.gaussians(), camera, result.options()).rgb.numpy()
    assert np.abs(image / 255 - rgb.clip(0, 1)).max() < 0.51 / 255
    with pytest.raises(UsageError, match="no camera to render"):
        warpgs.render_path(result, [], out=tmp_path / "c")


def test_a_run_of_a_scene_from_python_is_complete_but_for_the_scene(folder, tmp_path, capsys):
    """Its folder exports and renders; scoring it again needs the scene, which is said; it is continued with the scene."""
    scene = warpgs.load_scene(folder / "scene")
    few = dataclasses.replace(CONFIG, steps=3)
    result = warpgs.fit(scene, few, out=tmp_path / "run", device="cpu", verbose=False)
    assert result.folder == tmp_path / "run" and (tmp_path / "run" / "report.html").is_file()
    assert main(["export", str(tmp_path / "run"), "--to", str(tmp_path / "a.ply")]) == 0
    assert main(["eval", str(tmp_path / "run"), "--device", "cpu"]) == 3
    assert "passed from Python" in capsys.readouterr().err
    with pytest.raises(DataError, match="not a record of a fit"):
        (tmp_path / "x").mkdir()
        (tmp_path / "x" / "config.json").write_text("{}")
        warpgs.fit(scene, few, out=tmp_path / "x", resume=True)
    again = warpgs.fit(scene, few, out=tmp_path / "run", device="cpu", resume=True, verbose=False)
    assert torch.equal(again.gaussians().means, result.gaussians().means)


def test_degree_4_is_fitted_and_stored(folder, tmp_path, capsys):
    """All five degrees learn; the run, the model file and PLY hold them, SPZ holds degree 3, and the output says so."""
    config, scene, out = (
        dataclasses.replace(CONFIG, sh_degree=4, sh_every=2),
        warpgs.load_scene(folder / "scene"),
        tmp_path / "run",
    )
    result = warpgs.fit(scene, config, split=SPLIT, device="cpu", out=out, verbose=False)
    made = result.gaussians()
    assert made.sh.shape[1] == 25 and bool(made.sh[:, 16:].any())
    warpgs.save(tmp_path / "model.safetensors", made, scene.normalization)
    stored = warpgs.open_run(out, "cpu").gaussians(), warpgs.load(tmp_path / "model.safetensors").gaussians()
    assert all(torch.equal(g.sh, made.sh) for g in stored)
    for suffix, count in ((".ply", 25), (".spz", 16)):
        capsys.readouterr()
        assert main(["export", str(out), "--to", str(tmp_path / f"a{suffix}"), "--no-clean", "--rotate", "0,0,1,30"]) == 0
        assert ("harmonics above degree 3 are dropped" in capsys.readouterr().out) == (count == 16)
        assert read_gaussians(tmp_path / f"a{suffix}").sh.shape[1] == count
