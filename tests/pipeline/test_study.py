"""Studies: paired and resumable, their statistics, tables and plots."""

import csv
import dataclasses
import hashlib
import io
import json
import math
import re
import shutil
import sys
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import stats

from tests.pipeline.farms import HereEngine
from warpgs.app.cli import main
from warpgs.errors import DataError, UsageError
from warpgs.files import LOCK
from warpgs.pipeline.farm.job import job_of
from warpgs.pipeline.farm.work import ensure_run
from warpgs.pipeline.metrics.lpips import NETS, convert_lpips
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.paper.strategy import UNIFORM, PaperConfig
from warpgs.pipeline.run.fit import fit_request
from warpgs.pipeline.run.folder import TENSORS
from warpgs.pipeline.run.request import CPU_MAX_SIDE, FitRequest, SceneRequest, read_scene
from warpgs.pipeline.study import study
from warpgs.pipeline.study.study import (
    ABLATION_ROWS,
    BOXES,
    FILES,
    SWITCHES,
    StudyRequest,
    ablation_variants,
    preset_variants,
    run_folder,
    run_study,
)
from warpgs.pipeline.study.tables import (
    BETTER,
    UNDECIDED,
    WORSE,
    Table,
    csv_rows,
    family_confidence,
    forest,
    interval,
    latex,
    markdown,
    paired_difference,
    sample,
)
from warpgs.pipeline.train.presets import PRESETS, preset_settings
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.pipeline.train.strategies.sampling import MethodConfig
from warpgs.report.images import crops
from warpgs.synthetic.demo import split_spec

BASE, OTHER = [20.0, 20.2, 20.1], [20.6, 20.7, 20.8]
GAP = paired_difference(OTHER, BASE)


def table_of(**changes) -> Table:
    """A table of two variants; the second is better and has a name that breaks tables."""
    differences = {"psnr": GAP, "ssim": paired_difference([0.7, 0.8, 0.6], [0.8] * 3), "lpips": paired_difference([], [])}
    figures = {"psnr": sample(BASE), "ssim": sample([0.8] * 3), "gaussians": sample([12000, 12001, 12005])}
    samples = {"full": figures, "no a_b|c": {"psnr": sample(OTHER), "ssim": sample([0.7, 0.8, 0.6])}}
    table = Table("A study of 100 %", ("psnr", "ssim", "lpips"), samples, {"no a_b|c": differences})
    return dataclasses.replace(table, **changes)


def cells(text: str) -> list[list[list[str]]]:
    """The Markdown tables of a text, as rows of cells."""
    found, current = [], []
    for line in [*text.splitlines(), ""]:
        if line.startswith("|"):
            current.append([c.strip().replace("\\|", "|") for c in re.split(r"(?<!\\)\|", line)[1:-1]])
        elif current:
            found.append(current)
            current = []
    return found


def test_markdown_holds_means_deviations_differences_and_check_marks():
    """The best of a column is bold; an interval without 0 is marked; a figure without a spread stands alone."""
    text = markdown(table_of())
    assert text.startswith("Scores of held-out views: mean ± standard deviation over seeds, the best mean in bold:")
    figures, gaps = cells(text)
    assert figures[0] == ["method", "PSNR ↑", "SSIM ↑", "LPIPS ↓", "Gaussians", "seeds"]
    assert figures[2] == ["full", "20.10 ± 0.10", "**0.800 ± 0.000**", "-", "12,002", "3"]
    assert figures[3] == ["no a_b|c", "**20.70 ± 0.10**", "0.700 ± 0.100", "-", "-", "3"]
    assert gaps[2][:2] == ["no a_b|c", f"+0.60 [{GAP.low:+.2f}, {GAP.high:+.2f}] \\*"]
    assert not gaps[2][2].endswith("*") and gaps[2][3:] == ["-", "3"] and len(gaps) == 3
    assert len({len(r) for r in figures}) == len({len(r) for r in gaps}) == 1
    one = {"a": {"psnr": sample([20.0])}, "b": {"psnr": sample([21.0])}}
    gaps = {"b": {"psnr": paired_difference([21.0], [20.0])}}
    figures, gaps = cells(markdown(table_of(samples=one, differences=gaps, metrics=("psnr",))))
    assert figures[2][1] == "20.00" and gaps[2][1] == "+1.00"
    # an ablation has check marks in every notation
    t = table_of(switches=("Hier", "S_{rend}"), marks={"full": (True, True), "no a_b|c": (False, True)})
    figures, _ = cells(markdown(t))
    assert figures[0][:3] == ["row", "Hier", "S_rend"] and [r[1:3] for r in figures[2:]] == [["✓", "✓"], ["✗", "✓"]]
    tex = latex(t)
    assert "$Hier$ & $S_{rend}$ & PSNR$\\uparrow$" in tex and "$\\times$ & $\\checkmark$ & $\\mathbf{20.70 \\pm 0.10}$" in tex
    head, *rows = csv_rows(t)
    assert head[1:3] == ["Hier", "S_rend"] and [r[1:3] for r in rows if r[3] == "psnr"] == [[1, 1], [0, 1]]


def test_csv_keeps_every_digit_and_latex_is_balanced_and_escaped():
    """What was not measured is empty, not zero; names cannot break a table: TeX reads ^^5c as a backslash."""
    head, *rows = csv_rows(table_of())
    rows = {(r[0], r[1]): dict(zip(head, r, strict=True)) for r in rows}
    r = rows["no a_b|c", "psnr"]
    found = [float(r[k]) for k in ("mean", "sd", "difference", "low95", "high95")]
    assert found == [sample(OTHER).mean, sample(OTHER).sd, GAP.mean, GAP.low, GAP.high] and r["pairs"] == 3
    assert rows["full", "psnr"]["difference"] == rows["full", "psnr"]["pairs"] == rows["full", "lpips"]["mean"] == ""
    assert len(rows) == 6
    tex = latex(table_of())
    assert tex.count("{") == tex.count("}") and tex.count("$") % 2 == 0 and "\\begin{tabular}{lcccr}" in tex
    assert "no a\\_b|c" in tex and "100 \\%" in tex and "paired by seed, with a 95 \\% t int" in tex
    lines = [line for line in tex.splitlines() if line.endswith("\\\\")]
    assert len(lines) == 3 and {len(re.split(r"(?<!\\)&", line)) for line in lines} == {5}
    words = "\\caption{\\textbackslash{}a\\textasciicircum{}\\textasciicircum{}5cinput\\{b\\}\\textasciitilde{}c  d. "
    assert words in latex(table_of(caption="\\a^^5cinput{b}~c\n\nd"))


def test_small_differences_keep_their_digits_and_few_measurements_have_no_spread():
    """No minus zero, and an interval without 0 does not end at 0."""
    assert interval(paired_difference([20.0, 20.0, 20.001], [20.0, 20.001, 20.0]), 2) == "+0.00 [+0.00, +0.00]"
    assert interval(paired_difference([19.9986, 19.9988], [20.0, 20.0]), 2) == "-0.00130 [-0.00257, -0.00003]"
    # equal when printed is equally best; nothing measured has no best
    table = table_of(samples={str(v): {m: sample([v]) for m in ("psnr", "lpips")} for v in (20.0001, 20.0004, 21.0)})
    assert [table.best("psnr"), table.best("lpips")] == [21.0, 20.0] and math.isnan(table.best("ssim"))
    d = paired_difference([2.0], [1.0])
    assert d.mean == 1 and math.isnan(d.sd) and math.isnan(d.low) and not d.excludes_zero
    assert family_confidence(1) == 0.95 and family_confidence(10) == pytest.approx(0.995)
    assert math.isnan(sample([]).mean) and paired_difference([1.0, 2.0], [0.0, 1.0]).low == 1.0
    with pytest.raises(ValueError):
        paired_difference([1.0, 2.0], [1.0])


# Studies: paired, resumable, honest about what is missing.

A = FitConfig(steps=8, init=InitConfig(source="random", random_count=200))
B = dataclasses.replace(A, preset="b", steps=16)


@pytest.fixture(scope="module")
def scene(demo):
    return SceneRequest(str(demo), split_spec(8))


@pytest.fixture(scope="module")
def finished(scene, tmp_path_factory):
    request = StudyRequest((scene,), {"a": A, "b b": B}, 2, tmp_path_factory.mktemp("study") / "out", "cpu")
    return request, run_study(request)


def metrics_of(request, variant, seed):
    return json.loads((run_folder(request, "still", variant, seed) / "metrics.json").read_text())


def test_every_run_is_an_ordinary_run_folder_and_tables_are_of_these_runs(finished):
    request, lines = finished
    for variant, steps in (("a", 8), ("b b", 16)):
        for seed in (0, 1):
            folder = request.out / "still" / variant.replace(" ", "-") / str(seed)
            files = "config.json", "metrics.json", "report.html", TENSORS, "point_cloud.ply"
            assert all((folder / n).is_file() for n in files)
            m = metrics_of(request, variant, seed)
            assert (m["seed"], m["steps"]) == (seed, steps)
    assert all((request.out / f).is_file() for f in FILES)
    image = Image.open(request.out / "figure.png")
    assert 3 * 180 < image.width < 2600 and image.height > 200
    colors = {tuple(c) for c in np.unique(np.asarray(image).reshape(-1, 3), axis=0).tolist()}
    assert {tuple(round(255 * v) for v in color) for color in BOXES} <= colors
    record = json.loads((request.out / "study.json").read_text())
    assert record["seeds"] == 2 and set(record["variants"]) == {"a", "b b"}
    assert len(record["scenes"]["still"]["fingerprint"]) == 64
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


def copy_of(finished, tmp_path, **changes):
    """The request of the finished study with changes, in a copy of its folder, which is made once."""
    request, out = finished[0], tmp_path / "out"
    if not out.exists():
        shutil.copytree(request.out, out)
    return dataclasses.replace(request, out=out, **changes)


def states(request):
    return [r["state"] for r in csv.DictReader(io.StringIO((request.out / "runs.csv").read_text()))]


def test_finished_runs_are_kept_and_half_finished_ones_continued(finished, tmp_path, capsys):
    """Nothing is fitted twice; a run without its scores goes on from its checkpoint; more seeds are added to what is there."""
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
    grown = dataclasses.replace(request, seeds=3)
    run_study(grown)
    assert states(grown) == ["kept"] * 4 + ["fitted"] * 2
    assert cells((grown.out / "table.md").read_text())[0][2][-1] == "3"


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
    monkeypatch.setattr(STRATEGIES, "_classes", dict(STRATEGIES._classes))
    path = tmp_path / "mine.py"
    code = "from warpgs import Strategy\nclass Mine(Strategy):\n    rate = {}\nmine = {{'base': 'quick', 'strategy': Mine}}\n"

    def study_of(rate):
        path.write_text(code.format(rate))
        for name in [n for n, m in sys.modules.items() if getattr(m, "__file__", None) == str(path)]:
            del sys.modules[name]  # as in a new process
        mine, origin = preset_settings(f"{path}:mine")
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        assert f"(SHA-256 {digest[:12]})" in origin
        variants = {"a": A, "mine": dataclasses.replace(A, strategy=mine.strategy)}
        request = copy_of(finished, tmp_path, seeds=1, variants=variants)
        run_study(request)
        record = json.loads((run_folder(request, "still", "mine", 0) / "config.json").read_text())
        assert record["own_code"] == {mine.strategy: digest}
        return states(request), (request.out / "table.md").read_text()

    assert study_of(1)[0] == ["kept", "fitted"] and study_of(1)[0] == ["kept", "kept"]
    again, text = study_of(2)
    assert again == ["kept", "redone"] and "differs in user code; moved to 0.old1" in text


@pytest.mark.parametrize(
    "key,value,word",
    [
        ("fingerprint", "0" * 64, "data"), ("train", ["000.png"], "training views"), ("device", "cuda", "device"),
        ("versions", {"warpgs": "0.0.0"}, "version of warpgs"), ("config_hash", "0" * 12, "configuration"),
    ],
)  # fmt: skip
def test_what_makes_a_run_another_run(finished, tmp_path, monkeypatch, key, value, word):
    fitted = lambda request: SimpleNamespace(metrics={"fitted": request.resume})  # noqa: E731
    monkeypatch.setattr("warpgs.pipeline.farm.work.fit_request", fitted)
    request = copy_of(finished, tmp_path)
    folder = run_folder(request, "still", "a", 0)
    record = json.loads((folder / "config.json").read_text()) | {key: value}
    (folder / "config.json").write_text(json.dumps(record))
    _, split, _ = read_scene(request.scenes[0])
    fit = FitRequest(request.scenes[0], folder, A, "cpu")
    state, metrics, note = ensure_run(fit, metrics_of(request, "a", 1)["fingerprint"], split, "cpu", {})
    assert state == "redone" and word in note and metrics == {"fitted": False}


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
    shutil.copytree(scene.path, tmp_path / "other")
    request = copy_of(finished, tmp_path, scenes=(scene, SceneRequest(str(tmp_path / "other"), scene.split)))
    shutil.copytree(request.out / "still", request.out / "other")
    for i, path in enumerate(sorted((request.out / "other").glob("*/*/metrics.json"))):
        metrics = json.loads(path.read_text())
        metrics["test"]["psnr"] += i**2  # the same data, so that nothing is fitted, with other scores
        metrics["start"] = "start: 9 random points, instead of --init.source sweep: only 3 survived"
        path.write_text(json.dumps(metrics))
    run_study(request)
    assert set(states(request)) == {"kept"}
    tables = cells((request.out / "table.md").read_text())
    assert len(tables) == 6
    rows = list(csv.DictReader(io.StringIO((request.out / "runs.csv").read_text())))
    psnr = {"a": [], "b b": []}
    for variant, seed in (("a", "0"), ("a", "1"), ("b b", "0"), ("b b", "1")):
        psnr[variant].append(np.mean([float(r["psnr"]) for r in rows if (r["variant"], r["seed"]) == (variant, seed)]))
    assert tables[0][3][1].strip("*") == f"{np.mean(psnr['b b']):.2f} ± {np.std(psnr['b b'], ddof=1):.2f}"
    d = paired_difference(psnr["b b"], psnr["a"])
    assert tables[1][2][1].removesuffix(" \\*") == f"{d.mean:+.2f} [{d.low:+.2f}, {d.high:+.2f}]"
    notes = (request.out / "table.md").read_text()
    assert "on these scenes, not other scenes" in notes
    assert notes.count("other, a, seed 1: start: 9 random points, instead of") == 1 and "still, a, seed 1: start" not in notes


def test_a_study_on_a_farm_is_the_same_study(finished, tmp_path, monkeypatch):
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
    return job_of(text).name, "crashed", "its process ended"


def test_requests_that_make_no_sense(scene, tmp_path, capsys):
    both = {"a": A, "b": B}
    for words, scenes, variants, seeds in (
        (r"--seeds must be in \[1, 1000\]", (scene,), both, 0), ("at least two settings", (scene,), {"a": A}, 2),
        ("are named", (scene, scene), both, 2), ("name at least one scene", (), both, 2),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=words):
            StudyRequest(scenes, variants, seeds, tmp_path)
    for words, names in (("preset 'x' is not one of", ["x"]), ("appears twice", ["quick", "quick"])):
        with pytest.raises(UsageError, match=words):
            preset_variants(names, None)
    with pytest.raises(DataError, match="no view is held out"):
        run_study(StudyRequest((dataclasses.replace(scene, split="all"),), {"a": A, "b": B}, 1, tmp_path / "x", "cpu"))
    assert not (tmp_path / "x").exists()
    # without a split a view is held out, in its fits too: a fit of its own would train on every view
    wanted = dataclasses.replace(scene, split=None)
    asked, _, split = study._place(wanted, "cpu")
    assert split.test == ("004.png",) and "no --split given: 004.png is held out" in capsys.readouterr().out
    assert read_scene(asked)[1] == split and asked.max_side == CPU_MAX_SIDE


def test_command_compares_presets(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(PRESETS._made, "a", A)
    monkeypatch.setitem(PRESETS._made, "b", B)
    flags = ["--presets", "a,b", "--seeds", "1", "--steps", "2", "--device", "cpu", "--out", str(tmp_path / "out")]
    assert main(["compare", scene.path, "--split", scene.split, *flags]) == 0
    out = capsys.readouterr().out
    lines = out.splitlines()
    heads = "[1/2] still, a, seed 0", "[2/2] still, b, seed 0"
    first, second = (next(i for i, line in enumerate(lines) if line.startswith(head)) for head in heads)
    assert sum("2 of 2 steps" in line for line in lines[first:second]) == 1 and lines[second - 1].startswith("  PSNR ")
    assert "next:" not in out and "one seed" in out and "table.tex" in out and "1 seed:" in out
    assert main(["compare", scene.path, "--out", str(tmp_path / "y"), "--presets", "a,zzz"]) == 2
    assert "preset 'zzz'" in capsys.readouterr().err


# `warpgs ablate`: a row for each part that is switched off or on, and a table with check marks.

FULL = dataclasses.replace(A, preset="whole", strategy="paper", method=MethodConfig(hier=True))


def test_ablation_rows_switch_one_part_each():
    """Full, uniform sampling, one score more at a time, each other part off, no sampling, and the paper's settings; marks."""
    variants, marks = ablation_variants(FULL)
    scores = ["uniform", "residual only", "residual + semantics"]  # which is full without geometry
    parts = [name for name in SWITCHES if name != "s_geometry"]
    assert list(variants) == ["full", *scores, *(f"no {name}" for name in parts), "paper-literal"]
    assert variants["full"] == FULL
    paper = variants.pop("paper-literal")
    assert paper == dataclasses.replace(PRESETS["paper-literal"], steps=FULL.steps) and FULL.steps != 30_000
    weights = [variants[row].strategy_config.weights() for row in scores]
    assert weights == [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), pytest.approx((2 / 3, 1 / 3, 0.0))]
    for (row, variant), name in zip(list(variants.items())[4:], parts, strict=True):
        if name == "events":
            assert dataclasses.replace(FULL, strategy="clone_split", strategy_config=None) == variant
        else:
            switches = {"hier": variant.method.hier, **dataclasses.asdict(variant.strategy_config)}
            assert [s for s, value in switches.items() if value is False] == [name] and row == f"no {name}"
            assert dataclasses.replace(variant, method=FULL.method, strategy_config=FULL.strategy_config) == FULL
        assert [s for s, mark in zip(SWITCHES, marks[row]) if not mark] == [name]
    assert all(marks["full"]) and list(SWITCHES)[:7] == ["hier", "s_render", "s_semantic", "s_geometry", "ra", "agp", "pm"]
    with pytest.raises(UsageError, match="preset '3dgs' has no sampling events"):
        ablation_variants(FitConfig())
    # a preset without scores gets a row with each and one with all, and no row twice: uniform is the preset itself
    base = dataclasses.replace(FULL, strategy="sampling", strategy_config=None)
    variants, _ = ablation_variants(base)
    rows = "full", "residual only", "residual + semantics + geometry", "with s_semantic", "with s_geometry"
    assert {*rows, "no hier"} <= set(variants)
    assert not {"uniform", "no s_render", "with s_render", "with hier"} & set(variants)
    assert variants["full"] == base and dataclasses.replace(base, strategy="paper", strategy_config=UNIFORM) not in variants
    weights = [variants[row].strategy_config.weights() for row in rows[1:]]
    assert weights == [(1, 0, 0), pytest.approx((0.4, 0.2, 0.4)), (0, 1, 0), (0, 0, 1)]
    assert "paper-literal" not in ablation_variants(PRESETS["paper-literal"])[0]


def test_command_ablates(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(PRESETS._made, "whole", FULL)
    monkeypatch.setattr("warpgs.pipeline.study.study.ABLATION_ROWS", {n: ABLATION_ROWS[n] for n in ("full", "no pm")})
    monkeypatch.setenv("WARPGS_CACHE", str(tmp_path / "cache"))
    asked = []

    def noted(request, **others):
        asked.append((request.config.seed, request.config.strategy_config))
        return fit_request(request)

    monkeypatch.setattr("warpgs.pipeline.farm.work.fit_request", noted)
    flags = ["--preset", "whole", "--seeds", "1", "--steps", "2", "--device", "cpu", "--out", str(tmp_path / "out")]
    assert main(["ablate", scene.path, "--split", scene.split, *flags]) == 0
    assert "[2/2] still, no pm, seed 0" in capsys.readouterr().out
    figures, gaps = cells((tmp_path / "out" / "table.md").read_text())
    assert figures[0][1:9] == ["Hier", "S_rend", "S_sem", "S_geo", "RA", "AGP", "PM", "Events"]
    assert [r[1:9] for r in figures[2:]] == [["✓"] * 8, ["✓"] * 6 + ["✗", "✓"]]
    assert gaps[2] == ["no pm", "not exercised", "not exercised", "not exercised", "-"]  # two steps end before any event
    assert asked == [(0, PaperConfig()), (0, PaperConfig(pm=False))]
    assert main(["ablate", scene.path, "--out", str(tmp_path / "y"), "--preset", "3dgs"]) == 2
    assert "ablate a preset with them" in capsys.readouterr().err


# Means, deviations and paired intervals against scipy and by simulation.


@pytest.mark.parametrize("n", [2, 5, 40])
@pytest.mark.parametrize("confidence", [0.8, 0.95])
def test_interval_equals_scipys_paired_t(n, confidence):
    rng = np.random.default_rng(n)
    base = 20 + rng.standard_normal(n)
    ours = base + 0.1 + 0.1 * rng.standard_normal(n)
    expected = stats.ttest_rel(ours, base).confidence_interval(confidence)
    d = paired_difference(list(ours), list(base), confidence)
    assert (d.mean, d.sd, len(d.values)) == pytest.approx((np.mean(ours - base), np.std(ours - base, ddof=1), n))
    assert (d.low, d.high) == pytest.approx((expected.low, expected.high), rel=1e-9)
    assert d.excludes_zero == (stats.ttest_rel(ours, base).pvalue < 1 - confidence)


# The plot of a study and its figure: every number is shown, nothing leaves its frame, crops lie where pictures differ.

SVG = "{http://www.w3.org/2000/svg}"


def forest_of(metric="psnr", title="t"):
    """The plot of a base and three variants, of which two differ from it."""
    values = {"b": (0.9, 1.0, 1.1), "c": (-0.9, -1.0, -1.1), "d": (-1.0, 1.0)}
    gaps = {n: {metric: paired_difference(v, [0.0] * len(v))} for n, v in values.items()}
    return ElementTree.fromstring(forest(Table(title, (metric,), {n: {} for n in "abcd"}, gaps)))


def test_forest_draws_every_seed_and_prints_every_interval():
    """Small dots for seeds, a large one for each mean, words for the ends, all in the frame; nothing unmeasured."""
    root = forest_of(title="t <&>")
    width, height = (float(root.get(k)) for k in ("width", "height"))
    circles = root.findall(f"{SVG}circle")
    small, large = ([c for c in circles if c.get("r") == r] for r in ("2.8", "5.5"))
    assert len(small) == 8 and len(large) == 3
    assert all(0 < float(c.get("cx")) < width and 0 < float(c.get("cy")) < height for c in circles)
    words = [t.text for t in root.findall(f"{SVG}text")]
    d = paired_difference([0.9, 1.0, 1.1], [0, 0, 0])
    assert f"+1.00 [{d.low:+.2f}, {d.high:+.2f}]" in words and {"a", "b", "c", "d", "the base", "t <&>"} <= set(words)
    xs = [float(c.get("cx")) for c in large]
    assert xs[1] < xs[2] < xs[0] and xs[0] - xs[2] == pytest.approx(xs[2] - xs[1], abs=0.2)
    # more PSNR is better, more LPIPS is worse, and what the interval does not decide is neither
    assert [c.get("fill") for c in large] == [BETTER, WORSE, UNDECIDED]
    means = [c for c in forest_of("lpips").findall(f"{SVG}circle") if c.get("r") == "5.5"]
    assert [c.get("fill") for c in means] == [WORSE, BETTER, UNDECIDED]
    one = {"b": {"psnr": paired_difference([0.5], [0.0]), "lpips": paired_difference([], [])}}
    root = ElementTree.fromstring(forest(Table("t", ("psnr", "lpips"), {"a": {}, "b": {}}, one)))
    words = [t.text for t in root.findall(f"{SVG}text")]
    assert "+0.50" in words and not any("LPIPS" in w for w in words)
    assert "no pair of runs to compare" in forest(Table("t", ("lpips",), {"a": {}, "b": {}}, one))


def test_crops_find_where_pictures_differ():
    values = np.zeros((40, 60), np.float32)
    values[30:36, 44:54] = 0.9
    values[4:10, 4:14] = 0.5
    (x0, y0), (x1, y1) = crops(values, 12, 8, 2)
    assert x0 <= 44 and x0 + 12 >= 54 and y0 <= 30 and y0 + 8 >= 36
    assert x1 <= 4 and x1 + 12 >= 14 and y1 <= 4 and y1 + 8 >= 10
    # nothing differs: the middle; windows larger than the picture: one, the whole
    assert crops(np.zeros((20, 30)), 10, 8, 1) == [(10, 6)] and crops(np.ones((6, 5)), 9, 9, 3) == [(0, 0)]
    many = crops(np.random.default_rng(0).random((20, 20)), 10, 10, 9)
    assert 1 <= len(many) <= 4
    assert all(abs(a - c) >= 10 or abs(b - d) >= 10 for i, (a, b) in enumerate(many) for c, d in many[:i])
