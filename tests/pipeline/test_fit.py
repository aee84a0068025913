"""Fits from Python and by commands: run folders, given maps, backgrounds, objects cut out, previews."""

import ast
import dataclasses
import html
import json
import re
import shutil
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

import warpgs
from tests.io import scenes
from tests.io.scenes import save
from tests.priors import networks as nw
from tests.priors.rigs import exact_depth
from tests.scenes import photos, seeds
from warpgs.app.cli import main
from warpgs.errors import DataError, UsageError
from warpgs.export.base import read_gaussians
from warpgs.io.load import load_scene
from warpgs.pipeline.films.film import render_path
from warpgs.pipeline.metrics import scores
from warpgs.pipeline.metrics.scores import score, summarize
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run import fit as runs
from warpgs.pipeline.run.commands import scene_of, view_psnrs
from warpgs.pipeline.run.folder import METRICS, open_run
from warpgs.pipeline.run.request import NO_SCORES, SceneRequest
from warpgs.pipeline.run.results import score_line
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import choose_background, color_of, over_background
from warpgs.pipeline.train.settings import FitConfig, probe_seconds
from warpgs.process import Detail
from warpgs.report.images import png, straight_alpha
from warpgs.scene import Camera, Scene, View
from warpgs.synthetic import demo
from warpgs.synthetic.demo import split_spec, write_demo

# `warpgs.fit` from Python: the same fit as the command, with or without a run folder, in either units.

STEPS, SPLIT = 12, split_spec(8)
CONFIG = warpgs.FitConfig(steps=STEPS, init=InitConfig(source="random", random_count=80))
FLAGS = ["--preset", "3dgs", "--steps", str(STEPS), "--init.source", "random", "--init.random-count", "80", "--split", SPLIT]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
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


@pytest.mark.parametrize("long", [False, True])
def test_a_short_fit_reports_no_moving_objects(folder, monkeypatch, long):
    """Its edges are blurred, which looks like motion; a tenth of the default's steps is enough."""
    monkeypatch.setattr(runs, "moved_fractions", lambda views, renders: [0.01] * len(views))
    monkeypatch.setattr(runs, "steps_by_views", lambda views, opaque, cutout: STEPS * 10 + (not long))
    result = warpgs.fit(str(folder / "scene"), CONFIG, split=SPLIT, device="cpu", verbose=False)
    assert any("something may have moved" in note for note in result.notes) == long
    assert (0.01 in [p["moved"] for p in result.metrics["photographs"]]) == long


def test_command_and_function_are_one_fit(folder, fitted):
    result, steps = fitted
    run = warpgs.open_run(folder / "run", "cpu")
    for name, t in run.gaussians().tensors().items():
        assert torch.equal(getattr(result.gaussians(), name), t), name
    stored = json.loads((folder / "run" / "metrics.json").read_text())
    assert {k: result.metrics[k] for k in ("test", "train", "views")} == {k: stored[k] for k in ("test", "train", "views")}
    assert [p["name"] for p in stored["photographs"]] == [*run.train, *run.test]
    assert all(p["moved"] is None for p in stored["photographs"])  # too short a fit
    log = [json.loads(line) for line in (folder / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [(r.step, r.loss, r.count) for r in steps] == [(r["step"], r["loss"], r["count"]) for r in log]
    assert (result.config, result.step, result.folder) == (CONFIG, STEPS, None)
    assert (result.train, result.test) == (run.train, run.test) and len(result.test) > 0
    views = [warpgs.load_scene(folder / "scene").view(n) for n in result.test]
    assert warpgs.evaluate(result.gaussians(), views, result.options())[0].psnr == stored["views"][0]["psnr"]
    # the parts sum to the total; only a command has imports before its fit
    stored = json.loads((folder / "run" / "metrics.json").read_text())
    for metrics in (stored, fitted[0].metrics):
        times = dict(metrics["wall_seconds"])
        total = times.pop("total")
        assert total == pytest.approx(sum(times.values())) and total >= metrics["seconds"]["total"]
        assert {"kernels", "photo checks", "first points", "steps (phase 2)", "scoring", "checks", "other"} <= times.keys()
    assert {"import", "reading", "report", "writing"} <= stored["wall_seconds"].keys()
    assert re.match("start: [0-9,]+ (random )?points", stored["start"])
    assert not {"import", "reading", "report"} & fitted[0].metrics["wall_seconds"].keys()
    assert "<li>wall time until this page was written: " in (folder / "run" / "report.html").read_text()


def test_a_result_is_scored_over_the_background_of_its_fit(folder, recwarn):
    """As the page on Python shows; Gaussians alone know no background, which is said where it shows."""
    scene = warpgs.load_scene(folder / "scene")
    result = warpgs.fit(scene, CONFIG, split=SPLIT, background="white", device="cpu", verbose=False)
    views = [scene.view(n) for n in result.test]
    scored = warpgs.evaluate(result, views)
    assert summarize(scored)["psnr"] == result.metrics["test"]["psnr"] and not recwarn.list
    assert warpgs.evaluate(result, views, warpgs.RasterizeOptions()) != scored
    with pytest.warns(UserWarning, match="of view .* shows the background, taken as black; give the result of the fit") as told:
        assert warpgs.evaluate(result.gaussians(), views) != scored
    assert told[0].filename == __file__
    assert len(told) == 1
    with pytest.raises(TypeError, match="gaussians must be an instance of Gaussians"):
        warpgs.evaluate(3, views)
    # as after a scene was loaded without some photographs, which moves its origin
    viewmat = views[0].camera.viewmat.copy()
    viewmat[0, 3] += 0.01
    moved = dataclasses.replace(views[0].camera, viewmat=viewmat)
    with pytest.warns(UserWarning, match="the pose of view .* is not that of the fit; load the scene with"):
        warpgs.evaluate(result, [dataclasses.replace(views[0], camera=moved)])
    alpha = np.pad(np.ones((20, 20), np.float32), ((6, 6), (10, 10)))
    for color, count in (1.0, 0), (0.0, 1):
        cut_out = [dataclasses.replace(v, alpha=alpha, image=np.where(alpha[..., None] > 0, v.image, color)) for v in views]
        with warnings.catch_warnings(record=True) as said:
            warpgs.evaluate(result, cut_out)
        assert ["is over another background than the render" in str(w.message) for w in said] == [True] * count


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_a_fit_trains_within_a_mode_of_its_caller(folder, fitted, mode, device):
    """Where gradients are off: the same bits, and tensors that can be used afterwards."""
    with mode():
        result = warpgs.fit(folder / "scene", CONFIG, split=SPLIT, device=device, verbose=False)
        assert not torch.is_grad_enabled()
    assert not result.gaussians().means.is_inference()
    if device.type == "cpu":
        assert all(torch.equal(t, fitted[0].gaussians().tensors()[n]) for n, t in result.gaussians().tensors().items())


def hidden(scene, fill, given):
    """A scene with masks in all views; what they hide is ``fill``, in all of the ``given`` arrays."""
    views = []
    for k, v in enumerate(scene.views):
        mask, size = np.ones(v.image.shape[:2], bool), v.image.shape[:2]
        mask[5:17, 4 + 2 * k : 16 + 2 * k] = False
        mask[-3:] = False
        junk = fill(k, (*size, 3)).astype(np.float32)
        arrays = {"image": np.where(mask[..., None], v.image, junk)}
        if "alpha" in given:
            arrays["alpha"] = np.where(mask, np.float32(1), junk[..., 0])
        if "maps" in given:
            arrays["depth"] = warpgs.GivenDepth(np.where(mask, np.float32(2.9), 1 + junk[..., 1]))
            arrays["normals"] = np.float32([0, 0, -1]) * (mask | (junk[..., 2] > 0.5))[..., None]
        views.append(dataclasses.replace(v, mask=mask, **arrays))
    return dataclasses.replace(scene, views=tuple(views))


@pytest.mark.parametrize(
    "preset, given, settings",
    [
        ("default", "", {"steps": 30}),
        ("default", "", {"steps": 30, "init": {"source": "flow"}}),
        ("3dgs", "", {"steps": 12, "init": {"source": "random"}, "background": "mean"}),
        ("default", "alpha", {"steps": 12, "init": {"source": "hull"}}),
        ("default", "maps", {"steps": 12}),
    ],
    ids=["sweep", "flow", "random", "alpha", "maps"],
)
def test_what_a_mask_hides_has_no_influence(folder, preset, given, settings, device):
    """Two scenes that differ only under their masks: the same Gaussians to the bit, scores and notes (not of free memory)."""
    scene, results = warpgs.load_scene(folder / "scene"), []
    for fill in (lambda k, shape: np.zeros(shape), lambda k, shape: np.random.default_rng(k).random(shape)):
        made = hidden(scene, fill, given)
        results.append(warpgs.fit(made, preset, split=SPLIT, device=device, verbose=False, **settings))
    a, b = results
    told = [[n for n in r.notes if not n.startswith("memory: ")] for r in results]
    assert told[0] == told[1] and len(told[0]) == len(a.notes) - 1
    assert all(torch.equal(t, b.gaussians().tensors()[n]) for n, t in a.gaussians().tensors().items())
    assert {k: a.metrics[k] for k in ("test", "baselines", "photographs")} == {
        k: b.metrics[k] for k in ("test", "baselines", "photographs")
    }


def test_every_photograph_trains_by_default_and_a_run_remembers_its_scale(folder, tmp_path, capsys, monkeypatch):
    """No score is made up, which the report says; a later default leaves the run as it is."""
    few, out = dataclasses.replace(CONFIG, steps=2), tmp_path / "run"
    monkeypatch.setattr("warpgs.pipeline.run.request.CPU_MAX_SIDE", 20)
    result = warpgs.fit(folder / "scene", few, out=out, device="cpu")
    assert len(result.train) == 8 and result.test == () and not result.metrics["test"]
    printed = capsys.readouterr().out
    lines = printed.splitlines()
    assert lines.index(f"model: {out / 'point_cloud.ply'}; scores and report follow") < lines.index("scoring: 0 of 8 views")
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
    (first,) = (line for line in printed.splitlines() if line.startswith("fitting: 1 of 2 steps, left -,"))
    assert first.endswith(" - per step")  # it may have compiled
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


def test_units_lead_from_the_fit_to_its_files_and_back(folder, fitted, tmp_path):
    result, _ = fitted
    ply = folder / "run" / "point_cloud.ply"
    torch.testing.assert_close(result.gaussians("file").means, warpgs.read_ply(ply).means, rtol=0, atol=0)
    again = warpgs.read_ply(ply, result.normalization, units="scene")
    torch.testing.assert_close(again.means, result.gaussians().means, rtol=1e-5, atol=1e-5)
    name, scene = result.test[0], warpgs.load_scene(folder / "scene")
    camera, in_file = result.cameras()[name], result.cameras("file")[name]
    wanted = (scene.view(name).camera.center / scene.normalization.scale) + scene.normalization.offset
    np.testing.assert_allclose(in_file.center, wanted, atol=1e-9)
    *scene_files, film = warpgs.render_path(result, [camera, camera], out=tmp_path / "a")
    file_files = warpgs.render_path(result, [in_file], out=tmp_path / "b", units="file")
    assert film.name == "film.mp4" and len(scene_files) == 2 and len(file_files) == 2
    image, other = (np.asarray(Image.open(f), float) for f in (scene_files[0], file_files[0]))
    assert np.abs(image - other).max() <= 1
    with torch.no_grad():
        rgb = warpgs.rasterize(result.gaussians(), camera, result.options()).rgb.numpy()
    assert np.abs(image / 255 - rgb.clip(0, 1)).max() < 0.51 / 255
    with pytest.raises(UsageError, match="no camera is given"):
        warpgs.render_path(result, [], out=tmp_path / "c")


def test_a_run_of_a_scene_from_python_is_complete_but_for_the_scene(folder, tmp_path, capsys):
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
    config, out = dataclasses.replace(CONFIG, sh_degree=4, sh_every=2), tmp_path / "run"
    scene = warpgs.load_scene(folder / "scene")
    result = warpgs.fit(scene, config, split=SPLIT, device="cpu", out=out, verbose=False)
    made = result.gaussians()
    assert made.sh.shape[1] == 25 and bool(made.sh[:, 16:].any())
    warpgs.save(tmp_path / "model.safetensors", made, scene.normalization)
    with pytest.raises(warpgs.UsageError, match=r"writes safetensors, not \.ply"):
        warpgs.save(tmp_path / "model.PLY", made, scene.normalization)
    stored = warpgs.open_run(out, "cpu").gaussians(), warpgs.load(tmp_path / "model.safetensors").gaussians()
    assert all(torch.equal(g.sh, made.sh) for g in stored)
    for suffix, count in ((".ply", 25), (".spz", 25), (".glb", 16)):
        capsys.readouterr()
        assert main(["export", str(out), "--to", str(tmp_path / f"a{suffix}"), "--no-clean", "--rotate", "0,0,1,30"]) == 0
        assert ("harmonics above degree 3 are dropped" in capsys.readouterr().out) == (count == 16)
        assert read_gaussians(tmp_path / f"a{suffix}").sh.shape[1] == count


# `warpgs fit --depths --normals`: what it says, what a run keeps of it, and what continues it or scores it.

VIEWS, SIZE, GIVEN_STEPS = 8, (48, 36), 8
GIVEN_SPLIT = demo.split_spec(VIEWS)


def write_depths(folder, factor=1.0):
    """Write the true depth of the demo's views, but of the first, in millimetres as 16-bit PNG."""
    for i, camera in enumerate(demo.camera_path(VIEWS, *SIZE)):
        if i:
            save(folder / f"{i:03d}.png", np.round(1000 * factor * exact_depth(demo.still_life(0), camera)).astype(np.uint16))
    return folder


@pytest.fixture(scope="module")
def given_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("given")
    demo.write_demo(folder / "scene", views=VIEWS, width=SIZE[0], height=SIZE[1])
    write_depths(folder / "depths")
    assert main(command(folder, folder / "run", "--depths", str(folder / "depths"))) == 0
    return folder


def command(folder, out, *more, steps=GIVEN_STEPS):
    flags = ["--device", "cpu", "--split", GIVEN_SPLIT, "--preset", "3dgs", "--steps", str(steps), "--sh-degree", "0"]
    return ["fit", str(folder / "scene"), "--out", str(out), *flags, *more]


def test_a_run_finds_a_scene_that_was_moved(given_folder, tmp_path, capsys):
    shutil.copytree(given_folder / "scene", tmp_path / "scene")
    shutil.copytree(given_folder / "depths", tmp_path / "scene" / "maps")
    run, new, score = tmp_path / "run", tmp_path / "new place", ["eval", str(tmp_path / "run"), "--device", "cpu"]
    assert main(command(tmp_path, run, "--depths", str(tmp_path / "scene" / "maps"))) == 0
    (tmp_path / "scene").rename(new)
    capsys.readouterr()
    for words in (score, ["fit", "--out", str(run), "--resume"]):
        assert main(words) == 3
        said = capsys.readouterr().err
        assert f"scene: the scene of {run} is gone; if it was moved, `warpgs fit NEW_PLACE --out {run} --resume`" in said
    assert main(["fit", str(given_folder / "scene"), "--out", str(run), "--resume"]) == 3  # without the maps
    assert main(["fit", str(new), "--out", str(run), "--resume", "--device", "cpu"]) == 0
    stored = json.loads((run / "config.json").read_text())["scene"]
    assert stored["path"] == str(new) and stored["depths"] == str(new / "maps") and main(score) == 0


def test_maps_decide_whether_a_run_continues_and_a_wrong_unit_is_named(given_folder, tmp_path, capsys):
    """The same maps give the same bits as an uninterrupted run; other maps are another scene."""
    run = tmp_path / "run"
    maps = ["--depths", str(given_folder / "depths")]

    def stop(report):
        if report.step == 5:
            raise KeyboardInterrupt

    request = SceneRequest(str(given_folder / "scene"), GIVEN_SPLIT, depths=str(given_folder / "depths"))
    config = {"preset": "3dgs", "steps": GIVEN_STEPS, "sh_degree": 0, "device": "cpu", "verbose": False}
    with pytest.raises(KeyboardInterrupt):
        warpgs.fit(request, out=run, on_step=stop, **config)
    assert main(["fit", "--out", str(run), "--resume"]) == 0
    whole, again = (warpgs.open_run(f, "cpu").gaussians().tensors() for f in (given_folder / "run", run))
    assert all((whole[n] == again[n]).all() for n in whole)
    other = write_depths(tmp_path / "other", 1.01)
    assert main(command(given_folder, run, "--depths", str(other), "--resume")) == 2
    assert "the scene" in capsys.readouterr().err
    assert main(command(given_folder, run, *maps, "--resume")) == 0
    assert f"all {GIVEN_STEPS} steps are taken; only the images, scores and report are made again" in capsys.readouterr().out
    # with the ratio, view by view, and the flag that mends it
    out = tmp_path / "wrong"
    assert main(command(given_folder, out, "--depths", str(given_folder / "depths"), "--depth-unit", "1")) == 3
    said = capsys.readouterr().err
    assert "no depth map can be used" in said and "times those that the views confirm" in said and "--depth-unit" in said
    assert not (out / "metrics.jsonl").exists()
    assert main(command(given_folder, out, "--depths", "nowhere")) == 3 and "no such folder" in capsys.readouterr().err


def test_a_run_says_and_keeps_what_was_given(given_folder, capsys):
    record, metrics = (json.loads((given_folder / "run" / f).read_text()) for f in ("config.json", "metrics.json"))
    notes = html.unescape((given_folder / "run" / "report.html").read_text())
    assert "depth maps: 7 of 8 views, 100.0% of their pixels, metric (a unit is 0.001 for integers" in notes
    assert "given depth: used in 5 of 6 views" in notes
    assert "median difference of rendered depth" in notes and "start: " in notes and "by given depth and sweep" in notes
    assert record["scene"]["depths"] == str(given_folder / "depths") and record["scene"]["depth_kind"] == "metric"
    rows = metrics["given"]["depth"]["views"]
    assert len(rows) == 5 and all(r["coverage"] > 0.9 and 0 < r["difference"] < 0.5 for r in rows)
    assert main(["eval", str(given_folder / "run"), "--device", "cpu"]) == 0
    scene = warpgs.load_scene(given_folder / "scene", depths=given_folder / "depths")
    fitted = warpgs.fit(scene, "3dgs", split=GIVEN_SPLIT, steps=2, device="cpu", verbose=False, loss_depth_weight=0.0)
    assert fitted.metrics["given"] == {} and any("given depth: used in 5" in n for n in fitted.notes)


# `warpgs priors show` as a user types it.


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPGS_CACHE", str(tmp_path / "cache"))


def show(scene, *flags):
    return ["priors", "show", str(scene), "--split", split_spec(9), *map(str, flags)]


@pytest.mark.usefixtures("own_cache")
def test_a_sheet_per_training_view(scene, tmp_path, capsys):
    """With networks: sheets, notes, and maps that are there the second time."""
    depth = nw.depth_network(tmp_path / "d.onnx")
    labels = nw.segmentation_network(tmp_path / "s.onnx")
    (tmp_path / "d.onnx.json").write_text('{"size": 64}')
    (tmp_path / "s.onnx.json").write_text('{"size": 64, "mean": [0, 0, 0], "std": [1, 1, 1]}')
    flags = ["--depth-model", depth, "--segmentation-model", labels, "--threads", 1]
    assert main(show(scene, "--out", tmp_path / "a", *flags)) == 0
    text = capsys.readouterr().out
    sheets = sorted((tmp_path / "a").glob("*.png"))
    assert f"{len(sheets)} sheets in {tmp_path / 'a'}" in text and len(sheets) >= 3
    assert "d.onnx (SHA-256 " in text and "assumed multiple 32, mean 0.5 0.5 0.5" in text
    sheet = cv2.imread(str(sheets[0]))
    assert sheet.shape[1] > 1500 and sheet.std() > 20
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").iterdir()}
    assert main(show(scene, "--out", tmp_path / "b", *flags)) == 0
    assert len(written) == 2 * len(sheets) and written == {
        path: path.stat().st_mtime_ns for path in (tmp_path / "cache").iterdir()
    }
    for path in sheets:
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "b" / path.name)), cv2.imread(str(path)))


@pytest.mark.usefixtures("own_cache")
@pytest.mark.parametrize("source", ["sweep", "flow"])
def test_without_networks_the_notes_say_what_stands_in(scene, tmp_path, capsys, source):
    """Depth comes from the other views, and some of it is confirmed in every one."""
    assert main(show(scene, "--out", tmp_path / "a", "--source", source)) == 0
    text = capsys.readouterr().out
    assert "semantics: saliency as foreground" in text and "held out" not in text
    assert "depth: from the other views, " in text and "no consistent depth" not in text
    assert not (tmp_path / "cache").exists()


@pytest.mark.usefixtures("own_cache")
def test_mistakes_get_one_line(scene, tmp_path, capsys):
    out, file = tmp_path / "out", tmp_path / "x.onnx"
    file.write_text("no network")
    shown = show(scene, "--out", out)
    for code, word, words in (
        (2, "give show or export", ["priors"]), (2, "give show or export", ["priors", "draw"]),
        (2, "--threads must be in [0, 4096]", [*shown, "--threads", "-1"]),
        (2, "depth-size was removed: give it in FILE.onnx.json", [*shown, "--depth-size", "64"]),
        (3, "not an ONNX model", [*shown, "--depth-model", str(file)]),
        (3, "cannot be read", [*shown, "--segmentation-model", str(tmp_path / "none.onnx")]),
        (4, "choose another folder", show(scene, "--out", scene / "images" / "000.png" / "sheets")),
    ):  # fmt: skip
        assert main(words) == code, words
        text = capsys.readouterr().err.strip()
        assert word in text and text.startswith("warpgs: ") and "internal error" not in text and len(text.splitlines()) == 1
    assert not out.exists() or not list(out.iterdir())
    assert main(["priors", "--help"]) == 0 and "priors export" in capsys.readouterr().out


# The colour behind a scene: named, chosen, shown by renders, and kept by the run folder.


def test_colours_by_name_and_by_number():
    named = {"black": (0, 0, 0), "white": (1, 1, 1), "#ff8000": (1, 128 / 255, 0), "0.25,1,.5": (0.25, 1, 0.5), "auto": None}
    for text, color in named.items():
        assert color_of(text) == color and FitConfig(background=text).background == text
    for text in ("", "grey", "#fff", "#gggggg", "1,1", "nan,0,0", "1.5,0,0", "-0.1,0,0"):
        with pytest.raises(UsageError, match=r"is not a colour: give auto, mean, scene, black, white, #rrggbb, or r,g,b"):
            FitConfig(background=text)


def test_the_mean_colour_is_of_training_pixels_that_count(tmp_path):
    scene = load_scene(scenes.write_colmap(tmp_path))
    first, second, *_ = scene.views
    mask = np.zeros((12, 16), bool)
    mask[:, :4] = True
    train = [dataclasses.replace(first, mask=mask), second]
    expected = np.concatenate([first.image[mask], second.image.reshape(-1, 3)]).astype(np.float64).mean(0)
    for wish in ("auto", "mean"):
        color, note = choose_background(wish, scene, train)
        np.testing.assert_allclose(color, expected, atol=1e-6)
        assert "the mean colour of the training views, #" in note
    assert choose_background("scene", scene, train) == ((0, 0, 0), "")
    assert choose_background("#ff0000", scene, train) == (
        (1, 0, 0),
        "background: #ff0000, #ff0000; change it with --background",
    )
    assert [n for n, c in PRESETS.items() if c.background == "auto"] == ["default", "quick"]


def test_cut_out_objects_keep_the_background_of_the_scene(tmp_path):
    """Whether they know their opacity or stand on black; transparent pixels change with another one, and come back."""
    scene = load_scene(scenes.write_blender(tmp_path))
    color, note = choose_background("auto", scene, list(scene.views))
    assert color == (1, 1, 1) and "since views show a cut-out object, #ffffff" in note
    assert choose_background("scene", scene, list(scene.views))[1] == note
    black = [dataclasses.replace(v, image=v.image * (v.alpha[..., None] > 0), alpha=None) for v in scene.views]
    assert choose_background("auto", dataclasses.replace(scene, background=(0, 0, 0)), black)[0] == (0, 0, 0)
    half = [dataclasses.replace(v, alpha=v.alpha * np.float32(0.5), image=(v.image + 1) / 2) for v in scene.views]
    scene = dataclasses.replace(scene, views=tuple(half))
    other = over_background(scene, (0.0, 0.5, 1.0))
    assert other.background == (0, 0.5, 1) and other.views[0].image.dtype == np.float32
    np.testing.assert_allclose(other.views[0].image[0, 0], [0, 0.5, 1], atol=1e-6)
    np.testing.assert_allclose(other.views[0].image[0, 9], scene.views[0].image[0, 9] - [0.5, 0.25, 0], atol=1e-6)
    back = over_background(other, scene.background)
    assert all(np.allclose(a.image, b.image, atol=1e-6) for a, b in zip(back.views, scene.views))
    assert over_background(scene, scene.background) is scene


def test_a_run_keeps_its_background(tmp_path, capsys):
    """config.json holds the colour; scoring and continuing put the scene over it, and no colour makes another scene of it."""
    scenes.write_blender(tmp_path / "scene")
    flags = ["--init.source", "random", "--init.random-count", "20", "--preset", "3dgs", "--steps", "2", "--device", "cpu"]
    fit = ["fit", str(tmp_path / "scene"), "--out", str(tmp_path / "run"), "--split", "every:8", *flags]
    fit += ["--background", "0.5,0.25,0"]
    assert main(fit) == 0
    assert "background: 0.5,0.25,0, #804000" in capsys.readouterr().out
    record = json.loads((tmp_path / "run" / "config.json").read_text())
    assert record["background"] == [0.5, 0.25, 0] and record["config"]["background"] == "0.5,0.25,0"
    assert record["fingerprint"] == load_scene(tmp_path / "scene").fingerprint
    stored = open_run(tmp_path / "run", "cpu")
    scene, _, test = scene_of(stored)
    assert stored.options().background.tolist() == [0.5, 0.25, 0] and scene.background == (0.5, 0.25, 0)
    np.testing.assert_allclose(test[0].image[0, 0], [0.5, 0.25, 0], atol=1e-6)
    assert main(["eval", str(tmp_path / "run"), "--device", "cpu"]) == 0
    first, second = (json.loads((tmp_path / "run" / n).read_text())["test"]["psnr"] for n in ("metrics.json", "eval.json"))
    assert first == second
    assert main([*fit, "--resume"]) == 0


# Runs on objects cut out: scores of opacity, transparent renders, films over a colour, and what the run folder holds.


def view(alpha=None, mask=None):
    camera = Camera(np.eye(4), np.eye(3), 16, 12)
    return View("a.png", camera, np.full((12, 16, 3), 0.4, np.float32), mask, alpha=alpha)


def test_scores_of_opacity_and_straight_alpha():
    """Empty, object and edge have an error of their own; masked pixels do not count."""
    alpha = np.zeros((12, 16), np.float32)
    alpha[:, 4:12], alpha[:, 12:] = 1, 0.6
    mask = np.ones((12, 16), bool)
    mask[0] = False
    rendered = np.where(alpha == 1, np.float32(0.9), np.float32(0.25))
    rendered[0] = 0.5
    image = np.full((12, 16, 3), 102 / 255, np.float32)
    image[:, :4] += 51 / 255
    image[0] = 0
    m = score(view(alpha, mask), image, alpha=rendered)
    assert m.opacity["alpha_empty"] == pytest.approx(0.25) and m.opacity["alpha_object"] == pytest.approx(0.9)
    assert m.opacity["psnr_whole"] == pytest.approx(10 * np.log10(4 * 25)) and m.opacity["psnr_foreground"] == np.inf
    assert score(view(), image, alpha=rendered).opacity == {} == score(view(alpha), image).opacity
    assert set(m.opacity) == set(scores.ALPHA_VARIANTS)
    whole, half = np.ones((12, 16), np.float32), np.ones((12, 16), np.float32)
    half[:, :8] = 0
    image = np.full((12, 16, 3), 0.5, np.float32)
    rows = [score(view(a), image, alpha=np.full((12, 16), r, np.float32)) for a, r in ((whole, 1.0), (half, 0.5), (None, 0.1))]
    means = summarize(rows)
    assert means["alpha_empty"] == 0.5 and means["alpha_object"] == 0.75
    line = score_line(means)
    assert ", PSNR of the foreground 19.83 dB" in line and ", alpha where empty 0.500, alpha in the object 0.750" in line
    assert "alpha" not in score_line(summarize(rows[2:]))
    # the image again, over any background
    rng = np.random.default_rng(0)
    colors, alpha = rng.uniform(0, 1, (6, 7, 3)).astype(np.float32), rng.uniform(0, 1, (6, 7)).astype(np.float32)
    alpha[0] = 0
    on_black = colors * alpha[..., None]
    for background in ((0, 0, 0), (1, 0.5, 0.2)):
        made = straight_alpha(on_black + (1 - alpha[..., None]) * np.float32(background), alpha, background)
        assert (made[0] == 0).all()
        np.testing.assert_allclose(made[1:, :, :3] * alpha[1:, :, None], on_black[1:], atol=1e-5)
    decoded = cv2.imdecode(np.frombuffer(png(made), np.uint8), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]]
    np.testing.assert_array_equal(decoded, np.round(made * 255))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cut_out")
    scenes.write_blender(folder / "scene")
    flags = ["--init.source", "random", "--init.random-count", "60", "--preset", "3dgs", "--steps", "3", "--device", "cpu"]
    flags += ["--split", "every:8"]
    assert main(["fit", str(folder / "scene"), "--out", str(folder / "run"), *flags]) == 0
    return folder / "run"


def test_metrics_report_and_renders_know_the_opacity(run, tmp_path, capsys):
    metrics, record = (json.loads((run / n).read_text()) for n in ("metrics.json", "config.json"))
    assert set(scores.ALPHA_VARIANTS) <= set(metrics["test"]) & set(metrics["views"][0]) & set(metrics["variants"])
    assert metrics["test"]["psnr"] == metrics["test"]["psnr_whole"] and record["transparent"] is True
    METRICS(metrics, "")
    assert "alpha where empty" in (run / "report.html").read_text()
    assert open_run(run, "cpu").transparent
    stored = open_run(run, "cpu")
    images = {}
    for name in ("auto", "white", "#0000ff"):
        out = tmp_path / name.strip("#")
        assert main(["render", str(run), "--out", str(out), "--path", "views", "--device", "cpu", "--background", name]) == 0
        file = sorted(out.rglob("*.png"))[0]
        images[name] = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[..., ::-1] / 255.0
    assert [i.shape[2] for i in images.values()] == [4, 3, 3]
    alpha, colors = images["auto"][..., :1], images["auto"][..., 1:]  # reversed: ARGB
    for name, background in (("white", [1, 1, 1]), ("#0000ff", [0, 0, 1])):
        np.testing.assert_allclose(alpha * colors + (1 - alpha) * background, images[name], atol=2.5 / 255)
    assert main(["render", str(run), "--out", str(tmp_path / "x"), "--background", "mean"]) == 2
    assert "expected auto, black, white" in capsys.readouterr().err
    opaque = dataclasses.replace(stored, transparent=False)
    file, film = render_path(opaque, [stored.scene_cameras[stored.train[0]]], out=tmp_path / "opaque")
    assert cv2.imread(str(file), cv2.IMREAD_UNCHANGED).shape[2] == 3 and film.name == "film.mp4"


def move_camera(scene, name, distance):
    """Move the camera of an image along x, in COLMAP's text."""
    file = scene / "sparse" / "0" / "images.txt"
    lines = file.read_text().split("\n")
    i = next(i for i, line in enumerate(lines) if line.endswith(f" {name}"))
    words = lines[i].split()
    w, x, y, z = map(float, words[1:5])
    column = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
    words[5:8] = map(repr, (np.array(words[5:8], float) - distance * column).tolist())
    file.write_text("\n".join([*lines[:i], " ".join(words), *lines[i + 1 :]]))


@pytest.mark.parametrize("distance", [30.0, 1000.0, 1e6])
def test_a_camera_far_off_does_not_set_the_scale(tmp_path, distance):
    write_demo(tmp_path / "a", views=8, width=64, height=48)
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    move_camera(tmp_path / "b", "007.png", distance)
    scene, moved = load_scene(tmp_path / "a"), load_scene(tmp_path / "b")
    others = np.stack([v.camera.center / scene.normalization.scale + scene.normalization.offset for v in scene.views[:-1]])
    extent = 1.1 * np.linalg.norm(others - others.mean(0), axis=1).max()
    assert moved.normalization.scale == pytest.approx(1 / extent, rel=1e-12)
    assert any("1 of 8 cameras are far off" in n and "007.png" in n for n in moved.notes)
    assert not any("far off" in n for n in scene.notes)
    split = "train=" + ",".join(v.name for v in scene.views)
    flags = ["--steps", "60", "--device", "cpu", "--preset", "3dgs", "--split"]
    psnr = []
    for name, views in (("a", split.removesuffix(",007.png")), ("b", split)):
        run = tmp_path / f"run-{name}"
        test = ";test=007.png" if name == "a" else ""
        assert main(["fit", str(tmp_path / name), "--out", str(run), *flags, views + test]) == 0
        stored = open_run(run, "cpu")
        train = [v for v in scene_of(stored)[1] if v.name != "007.png"]
        psnr.append(view_psnrs(stored.gaussians(), train, stored.options()).mean())
    assert psnr[1] > psnr[0] - 0.5, psnr


# A fit under another default type or device of torch: the same bits.

ROOT = Path(warpgs.__file__).parent
REAL = {"zeros", "ones", "full", "empty", "rand", "randn", "eye", "linspace", "tensor"}
"""Functions of torch that make numbers of the default type on the default device."""
WHOLE = {"arange", "randint", "randperm"}
"""Functions of torch that make integers on the default device."""


@pytest.fixture(params=["float64", "meta"])
def other_default(request):
    """Set another default, as a user's program may, and set the usual one again."""

    def switch():
        if request.param == "meta":
            torch.set_default_device("meta")
        else:
            torch.set_default_dtype(torch.float64)

    yield switch
    torch.set_default_device(None)
    torch.set_default_dtype(torch.float32)


def gaussians_of(preset: str, scene: Scene, device: torch.device, **changes) -> list[torch.Tensor]:
    result = warpgs.fit(scene, preset, steps=12, split="every:4", device=device, verbose=False, **changes)
    return list(result.gaussians().tensors().values())


@pytest.mark.parametrize(
    ("preset", "changes"),
    [
        ("default", {"exposure": True, "refine_poses": True}), ("mcmc", {}), ("3dgs", {}),
        *(pytest.param(p, {}, marks=pytest.mark.slow) for p in ("quick", "paper-literal")),
    ],
)  # fmt: skip
def test_a_fit_makes_its_own_types_and_devices(other_default, device, preset, changes):
    """The second of two fits in one process, whose launches were recorded by the first."""
    scene = Scene("three Gaussians", "test", tuple(photos(6)), seeds())
    first = gaussians_of(preset, scene, device, **changes)
    other_default()
    second = gaussians_of(preset, scene, device, **changes)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_the_step_of_a_time_budget_too(other_default, device):
    other_default()
    assert probe_seconds(20, 16, device) > 0


def test_new_tensors_name_their_type_and_device():
    """In the whole package, since a fit meets only part of it."""
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).removeprefix("torch.") in REAL | WHOLE:
                name = ast.unparse(node.func)
                named = {k.arg for k in node.keywords}
                wanted = {"device"} | ({"dtype"} if name.removeprefix("torch.") in REAL else set())
                assert not name.startswith("torch.") or wanted <= named or None in named, f"{path}:{node.lineno}"
