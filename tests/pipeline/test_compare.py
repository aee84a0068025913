"""Studies: paired, resumable, honest about what is missing."""

import csv
import dataclasses
import hashlib
import io
import json
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from tests.pipeline.farms import HereEngine
from tests.pipeline.test_table_files import cells
from warpgs.app.cli import main
from warpgs.errors import DataError, UsageError
from warpgs.files import LOCK
from warpgs.pipeline.farm.job import Event, job_of
from warpgs.pipeline.farm.work import ensure_run
from warpgs.pipeline.metrics.lpips import NETS, convert_lpips
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.folder import TENSORS
from warpgs.pipeline.run.request import CPU_MAX_SIDE, FitRequest, SceneRequest, read_scene
from warpgs.pipeline.study.study import FILES, StudyRequest, _places, preset_variants, run_folder, run_study
from warpgs.pipeline.study.tables import paired_difference
from warpgs.pipeline.train.presets import PRESETS, preset_settings
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.synthetic.demo import split_spec, write_demo

A = FitConfig(steps=8, init=InitConfig(source="random", random_count=200))
B = dataclasses.replace(A, preset="b", steps=16)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A demo scene with photographs of 48 x 36 px."""
    folder = tmp_path_factory.mktemp("data") / "still"
    write_demo(folder, views=8, width=48, height=36)
    return SceneRequest(str(folder), split_spec(8))


@pytest.fixture(scope="module")
def finished(scene, tmp_path_factory):
    """Two settings, two seeds, one scene."""
    request = StudyRequest((scene,), {"a": A, "b b": B}, 2, tmp_path_factory.mktemp("study") / "out", "cpu")
    return request, run_study(request)


def test_a_study_without_a_split_holds_a_view_out_and_its_fits_do_the_same(scene, tmp_path, capsys):
    """A fit of its own would train on every view."""
    wanted = dataclasses.replace(scene, split=None)
    request = StudyRequest((wanted,), {"a": A, "b": B}, 1, tmp_path / "out", "cpu")
    (place,) = _places(request, "cpu")
    assert place.split.test == ("004.png",) and "no --split given: 004.png is held out" in capsys.readouterr().out
    assert read_scene(place.request)[1] == place.split and place.request.max_side == CPU_MAX_SIDE


def metrics_of(request, variant, seed):
    return json.loads((run_folder(request, "still", variant, seed) / "metrics.json").read_text())


def test_every_run_is_an_ordinary_run_folder_with_its_own_seed(finished):
    """SCENE/VARIANT/SEED, and what `warpgs fit` leaves in it."""
    request, _ = finished
    for variant, steps in (("a", 8), ("b b", 16)):
        for seed in (0, 1):
            folder = request.out / "still" / variant.replace(" ", "-") / str(seed)
            assert all(
                (folder / n).is_file() for n in ("config.json", "metrics.json", "report.html", TENSORS, "point_cloud.ply")
            )
            m = metrics_of(request, variant, seed)
            assert (m["seed"], m["steps"]) == (seed, steps)


def test_table_is_of_these_runs(finished):
    """Means, deviations and paired intervals, computed here once more from the run folders."""
    request, lines = finished
    text = (request.out / "table.md").read_text()
    figures, gaps = cells(text)
    psnr = {v: [metrics_of(request, v, s)["test"]["psnr"] for s in (0, 1)] for v in ("a", "b b")}
    assert "with a 95 % t interval;" in text  # one difference needs no correction
    assert [r[0] for r in figures[2:]] == ["a", "b b"]
    for row in figures[2:]:
        values = psnr[row[0]]
        count = f"{np.mean([metrics_of(request, row[0], s)['gaussians'] for s in (0, 1)]):,.0f}"
        assert row[1].strip("*") == f"{np.mean(values):.2f} ± {np.std(values, ddof=1):.2f}" and row[3:] == ["-", count, "2"]
    d = paired_difference(psnr["b b"], psnr["a"])
    assert gaps[2][1].removesuffix(" \\*") == f"{d.mean:+.2f} [{d.low:+.2f}, {d.high:+.2f}]"
    assert "LPIPS was not measured" in text and "images as stored" in text and "48 x 36 px" in text
    assert any("still" in line for line in lines)
    rows = list(csv.DictReader(io.StringIO((request.out / "runs.csv").read_text())))
    assert [(r["variant"], r["seed"]) for r in rows] == [("a", "0"), ("b b", "0"), ("a", "1"), ("b b", "1")]
    assert [float(r["psnr"]) for r in rows if r["variant"] == "a"] == psnr["a"]


def test_all_files_are_there_and_the_figure_has_a_column_per_setting(finished):
    """Two settings and the photograph, of the views that were held out."""
    request, _ = finished
    assert all((request.out / f).is_file() for f in FILES)
    image = Image.open(request.out / "figure.png")
    assert image.width > 3 * 180 and image.height > 200
    study = json.loads((request.out / "study.json").read_text())
    assert study["seeds"] == 2 and set(study["variants"]) == {"a", "b b"} and len(study["scenes"]["still"]["fingerprint"]) == 64


def copied(finished, out, **changes):
    """The request of the finished study with changes, in a copy of its folder, which is made once."""
    request, _ = finished
    if not out.exists():
        shutil.copytree(request.out, out)
    return dataclasses.replace(request, out=out, **changes)


def copy_of(finished, tmp_path, **changes):
    return copied(finished, tmp_path / "out", **changes)


def states(request):
    return [r["state"] for r in csv.DictReader(io.StringIO((request.out / "runs.csv").read_text()))]


def test_finished_runs_are_kept_and_half_finished_ones_continued(finished, tmp_path, capsys):
    """Nothing is fitted twice; one run without its scores goes on from its checkpoint and gives the same scores."""
    request = copy_of(finished, tmp_path)
    times = {p: p.stat().st_mtime_ns for p in request.out.glob("still/*/*/point_cloud.ply")}
    before = metrics_of(request, "a", 1)["test"]
    half = run_folder(request, "still", "a", 1)
    (half / "metrics.json").unlink()
    (run_folder(request, "still", "a", 0) / LOCK).touch()  # of a fit that was killed after its last file
    run_study(request)
    assert states(request) == ["kept", "kept", "continued", "kept"] and not list(request.out.rglob(LOCK))
    (half / "report.html").unlink()  # a fit was killed between its scores and its report
    run_study(request)
    assert states(request) == ["kept", "kept", "continued", "kept"] and (half / "report.html").is_file()
    assert metrics_of(request, "a", 1)["test"] == before
    assert [p.parent for p, t in times.items() if p.stat().st_mtime_ns != t] == [half]
    assert "continued from the last checkpoint" in capsys.readouterr().out
    assert "still, a, seed 1: was interrupted" in (request.out / "table.md").read_text()


def test_more_seeds_fit_only_what_is_new(finished, tmp_path):
    """A study grows: the pairs that are there stay."""
    request = copy_of(finished, tmp_path, seeds=3)
    run_study(request)
    assert states(request) == ["kept"] * 4 + ["fitted"] * 2
    assert cells((request.out / "table.md").read_text())[0][2][-1] == "3"


def test_runs_of_another_kind_are_moved_aside_and_said(finished, tmp_path):
    """Another configuration under the same name, and a broken checkpoint: done anew, the old one still there."""
    request = copy_of(finished, tmp_path)
    changed = dataclasses.replace(request, variants={"a": A, "b b": dataclasses.replace(B, steps=12)})
    broken = run_folder(request, "still", "a", 0)
    (broken / "metrics.json").unlink()
    (broken / TENSORS).write_bytes(b"nothing")
    run_study(changed)
    assert states(changed) == ["redone", "redone", "kept", "redone"]
    text = (changed.out / "table.md").read_text()
    assert "the old run differs in configuration; moved to 0.old1" in text and "could not be continued" in text
    assert (broken.parent / "0.old1" / TENSORS).read_bytes() == b"nothing"
    assert metrics_of(changed, "b b", 0)["steps"] == 12


def test_a_strategy_whose_code_was_edited_is_fitted_again(finished, tmp_path, monkeypatch):
    """Same settings and same name, but other code: the old run says nothing of it."""
    monkeypatch.setattr(STRATEGIES, "_classes", dict(STRATEGIES._classes))
    path = tmp_path / "mine.py"
    code = "from warpgs import Strategy\nclass Mine(Strategy):\n    rate = {}\nmine = {{'base': 'quick', 'strategy': Mine}}\n"

    def study(rate):
        path.write_text(code.format(rate))
        for name in [n for n, m in sys.modules.items() if getattr(m, "__file__", None) == str(path)]:
            del sys.modules[name]  # as in a new process
        mine, origin = preset_settings(f"{path}:mine")
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        assert f"(SHA-256 {digest[:12]})" in origin
        request = copied(
            finished, tmp_path / "out", seeds=1, variants={"a": A, "mine": dataclasses.replace(A, strategy=mine.strategy)}
        )
        run_study(request)
        record = json.loads((run_folder(request, "still", "mine", 0) / "config.json").read_text())
        assert record["own_code"] == {mine.strategy: digest}
        return states(request), (request.out / "table.md").read_text()

    assert study(1)[0] == ["kept", "fitted"] and study(1)[0] == ["kept", "kept"]
    again, text = study(2)
    assert again == ["kept", "redone"] and "differs in user code; moved to 0.old1" in text


@pytest.mark.parametrize(
    "key,value,word",
    [
        ("fingerprint", "0" * 64, "data"), ("train", ["000.png"], "training views"), ("device", "cuda", "device"),
        ("versions", {"warpgs": "0.0.0"}, "version of warpgs"), ("config_hash", "0" * 12, "configuration"),
    ],
)  # fmt: skip
def test_what_makes_a_run_another_run(finished, tmp_path, monkeypatch, key, value, word):
    """Each of these alone forbids to keep it."""
    monkeypatch.setattr(
        "warpgs.pipeline.farm.work.fit_request", lambda request: SimpleNamespace(metrics={"fitted": request.resume})
    )
    request = copy_of(finished, tmp_path)
    folder = run_folder(request, "still", "a", 0)
    record = json.loads((folder / "config.json").read_text()) | {key: value}
    (folder / "config.json").write_text(json.dumps(record))
    _, split, _ = read_scene(request.scenes[0])
    fit = FitRequest(request.scenes[0], folder, A, "cpu")
    outcome = ensure_run(fit, metrics_of(request, "a", 1)["fingerprint"], split, "cpu", {})
    assert outcome.state == "redone" and word in outcome.note and outcome.metrics == {"fitted": False}


def test_a_failed_run_is_left_out_of_its_pairs_and_named(finished, tmp_path, monkeypatch):
    """One pair is left: a difference without an interval, and a note which seed is missing."""
    request = copy_of(finished, tmp_path)
    shutil.rmtree(run_folder(request, "still", "b b", 1))

    def fail(*_, **__):
        raise DataError("no luck")

    monkeypatch.setattr("warpgs.pipeline.farm.work.fit_request", fail)
    run_study(request)
    text = (request.out / "table.md").read_text()
    assert states(request) == ["kept", "kept", "kept", "failed"]
    assert "b b: no result for still seed 1" in text and "no luck" in text
    figures, gaps = cells(text)
    assert figures[3][-1] == "1" and gaps[2][-1] == "1" and "[" not in gaps[2][1]
    shutil.rmtree(run_folder(request, "still", "b b", 0))
    with pytest.raises(DataError, match="every run of b b failed"):
        run_study(request)


def test_lpips_is_measured_on_kept_runs(finished, tmp_path):
    """Weights given later score the runs that are there, once; another file scores them again."""
    request = copy_of(finished, tmp_path, seeds=1)
    files = []
    for i in range(2):
        torch.manual_seed(i)
        state = {name: torch.randn(shape).abs() / 10 for name, shape in NETS["alex"].shapes().items()}
        for part, start in (("b", "features"), ("h", "lin")):
            torch.save({k: v for k, v in state.items() if k.startswith(start)}, tmp_path / f"{part}.pth")
        files.append(tmp_path / f"{i}.safetensors")
        convert_lpips(tmp_path / "b.pth", tmp_path / "h.pth", files[-1])
    figures = []
    for i in (0, 0, 1):
        study = dataclasses.replace(request, lpips_weights=files[i])
        run_study(study)
        stamp = (run_folder(study, "still", "a", 0) / "eval.json").stat().st_mtime_ns
        table = cells((study.out / "table.md").read_text())[0]
        assert table[0][3] == "LPIPS-Alex ↓" and set(states(study)) == {"kept"}
        (row, *_) = csv.DictReader(io.StringIO((study.out / "runs.csv").read_text()))
        figures.append((float(row["lpips_alex_legacy"]), stamp))
    assert figures[0] == figures[1] and figures[2][0] != figures[0][0] and figures[2][1] != figures[0][1]


def test_several_scenes_are_averaged_by_seed(finished, scene, tmp_path):
    """The table is of the mean over scenes, with a table per scene after it."""
    shutil.copytree(scene.path, tmp_path / "other")
    request = copy_of(finished, tmp_path, scenes=(scene, SceneRequest(str(tmp_path / "other"), scene.split)))
    shutil.copytree(request.out / "still", request.out / "other")
    for i, path in enumerate(sorted((request.out / "other").glob("*/*/metrics.json"))):
        metrics = json.loads(path.read_text())
        metrics["test"]["psnr"] += i**2  # the same data, so that nothing is fitted, with other scores
        path.write_text(json.dumps(metrics))
    run_study(request)
    assert set(states(request)) == {"kept"}
    tables = cells((request.out / "table.md").read_text())
    assert len(tables) == 6
    rows = list(csv.DictReader(io.StringIO((request.out / "runs.csv").read_text())))
    psnr = {
        v: [np.mean([float(r["psnr"]) for r in rows if (r["variant"], r["seed"]) == (v, s)]) for s in "01"]
        for v in ("a", "b b")
    }
    assert tables[0][3][1].strip("*") == f"{np.mean(psnr['b b']):.2f} ± {np.std(psnr['b b'], ddof=1):.2f}"
    d = paired_difference(psnr["b b"], psnr["a"])
    assert tables[1][2][1].removesuffix(" \\*") == f"{d.mean:+.2f} [{d.low:+.2f}, {d.high:+.2f}]"
    assert "on these scenes, not other scenes" in (request.out / "table.md").read_text()


def test_a_study_on_a_farm_is_the_same_study(finished, tmp_path, monkeypatch):
    """Its runs are jobs; what failed there is a failed run, and is not fitted again in this process."""
    monkeypatch.setattr("warpgs.pipeline.farm.farm.LocalEngine", lambda slots: HereEngine(slots=len(slots)))
    request = dataclasses.replace(finished[0], out=tmp_path / "out", seeds=1, engine={"slots": 2})
    run_study(request)
    assert states(request) == ["fitted", "fitted"] and (request.out / "index.html").is_file()
    for variant in request.variants:
        there, here = (run_folder(r, "still", variant, 0) / "point_cloud.ply" for r in (finished[0], request))
        assert there.read_bytes() == here.read_bytes()
    shutil.rmtree(run_folder(request, "still", "a", 0))
    monkeypatch.setattr("warpgs.pipeline.farm.farm.LocalEngine", lambda slots: HereEngine(fail))
    with pytest.raises(DataError, match=r"every run of a failed.*its process ended \(2 attempts\)"):
        run_study(request)


def fail(text):
    return Event(job_of(text).name, "crashed", "its process ended")


def test_requests_that_make_no_sense(scene, tmp_path):
    """Found out before anything is fitted."""
    with pytest.raises(UsageError, match="--seeds must be a number from 1 to 1000"):
        StudyRequest((scene,), {"a": A, "b": B}, 0, tmp_path)
    with pytest.raises(UsageError, match="at least two settings"):
        StudyRequest((scene,), {"a": A}, 2, tmp_path)
    with pytest.raises(UsageError, match="have the same name"):
        StudyRequest((scene, scene), {"a": A, "b": B}, 2, tmp_path)
    with pytest.raises(UsageError, match="name at least one scene"):
        StudyRequest((), {"a": A, "b": B}, 2, tmp_path)
    with pytest.raises(UsageError, match="preset 'x' is not one of"):
        preset_variants(["x"], None)
    with pytest.raises(UsageError, match="appears twice"):
        preset_variants([next(iter(PRESETS))] * 2, None)
    with pytest.raises(DataError, match="no view is held out"):
        run_study(StudyRequest((dataclasses.replace(scene, split="all"),), {"a": A, "b": B}, 1, tmp_path / "x", "cpu"))
    assert not (tmp_path / "x").exists()


def test_command_compares_presets(scene, tmp_path, capsys, monkeypatch):
    """`warpgs compare` from flags to files; one seed is said to prove nothing."""
    monkeypatch.setitem(PRESETS._made, "a", A)
    monkeypatch.setitem(PRESETS._made, "b", B)
    flags = ["--presets", "a,b", "--seeds", "1", "--steps", "2", "--device", "cpu", "--out", str(tmp_path / "out")]
    assert main(["compare", scene.path, "--split", scene.split, *flags]) == 0
    out = capsys.readouterr().out
    lines = out.splitlines()
    first, second = (
        next(i for i, line in enumerate(lines) if line.startswith(f"[{k}/2] still, {n}, seed 0"))
        for k, n in ((1, "a"), (2, "b"))
    )
    assert sum("2 steps" in line for line in lines[first:second]) == 1 and lines[second - 1].startswith("  PSNR ")
    assert "next:" not in out and "one seed" in out and "table.tex" in out and "1 seed:" in out
    assert main(["compare", scene.path, "--out", str(tmp_path / "y"), "--presets", "a,zzz"]) == 2
    assert "preset 'zzz'" in capsys.readouterr().err
