"""The benches: programs run on tiny sizes, studies compute what they say, results are of one format."""

import json
import math
import sys

import pytest
import torch

import warpgs
from bench import __main__ as bench_main
from bench.lib import ops, pages, peers, result_file, timing, training
from bench.lib.inputs import camera as bench_camera, gaussians, image
from bench.lib.naive import rasterize as bench_programs_rasterize
from bench.lib.op_tasks import DEFAULT, OPS
from bench.lib.ops import Bench, run
from bench.lib.points import Point, growth, points
from bench.lib.tables import mean_sd
from tests.gaussians import camera, cloud
from warpgs.scene import Gaussians

CPU = torch.device("cpu")


def tiny(names: tuple[str, ...]) -> dict:
    """A run over tiny sizes, as JSON, as if the machine were never slow or busy; on one thread, as torch's spin otherwise."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ops, "LIMIT_MS", math.inf)
        made = run(CPU, tiny=True, ops=names, echo=lambda line: None)
    torch.set_num_threads(before)
    made["rows"] = [r | {"others_cores": 0.0} for r in made["rows"]]
    return json.loads(json.dumps(made))


@pytest.fixture(scope="module")
def result():
    return tiny(("adam", "knn"))


@pytest.mark.slow
def test_every_op_gives_rows():
    """A positive time for each op and direction, sizes, and a fraction of the roof for our own."""
    result = tiny(tuple(OPS))
    rows = result["rows"]
    assert not result["skipped"]
    assert {r["op"] for r in rows} == set(OPS)
    assert all(r["median_ms"] > 0 and r["quartiles_ms"][0] <= r["median_ms"] <= r["quartiles_ms"][1] for r in rows)
    backward = {r["op"] for r in rows if r["direction"] in ("backward", "both")}
    assert backward == {"project", "blend", "blend_channels", "ssim", "render"}
    ours = [r for r in rows if r["program"] == "warpgs" and r["op"] in DEFAULT and not r.get("threads")]
    assert all(r["fraction"] > 0 and r["bytes"] > 0 and r["roof_ms"] > 0 for r in ours)
    assert {r["program"] for r in rows} >= {"warpgs", peers.TORCH_SSIM, peers.DENSE}


def test_the_ops_of_the_page_are_those_of_its_results():
    """Names, sizes, programs and directions are those of the kept rows, so that old and new results compare."""
    rows = [r for r in result_file.stored("ops")["cpu2"]["rows"] if r["op"] in OPS]  # sh became a part of others
    assert set(DEFAULT) == {r["op"] for r in rows}
    for r in rows:
        op, image = OPS[r["op"]], {"width", "height"} <= r.keys()
        assert r["direction"] in op.programs[r["program"]] and image == ("image" in op.axes)
        assert ("N" in r, "degree" in r, "cameras" in r) == tuple(a in op.axes for a in ("count", "degree", "cameras"))


def test_a_second_run_measures_only_what_the_first_lacks_or_what_was_disturbed(result):
    """All other rows stay as they are; a budget of nothing skips everything, with a reason."""
    busy = [r | {"others_cores": 2.0} if r["op"] == "knn" else r for r in result["rows"]]
    knn = sum(r["op"] == "knn" for r in busy)
    lacking = result | {"rows": [r for r in busy if (r["op"], r.get("N")) != ("adam", 100)]}
    lines = []
    again = run(CPU, tiny=True, ops=("adam", "knn"), earlier=lacking, echo=lines.append)
    kept = [r for r in again["rows"] if r in result["rows"]]
    assert len(again["rows"]) == len(result["rows"]) and len(kept) == len(busy) - knn - 1
    assert again["roofline"] == result["roofline"] and len(lines) == 1 + 1 + knn
    nothing = run(CPU, tiny=True, ops=("adam", "knn"), budget=0, echo=lambda line: None)
    assert not nothing["rows"] and {s["op"] for s in nothing["skipped"]} == {"adam", "knn"}
    assert all("no time is left" in s["reason"] for s in nothing["skipped"])


def row(count: int, milliseconds: float, **more) -> dict:
    return {"op": "adam", "program": "warpgs", "direction": "forward", "N": count, "median_ms": milliseconds, **more}


def test_points_vary_one_axis_at_a_time_and_along_the_diagonal(monkeypatch):
    """No full cross product; growth is that of the axis that grows most; what took too long is not tried at larger sizes."""
    axes = ("count", "image", "degree", "cameras")
    for device, largest, widest in (("cpu", 10**6, 1920), ("cuda", 10**7, 7680)):
        found = points(axes, torch.device(device), tiny=False)
        assert len(found) == len(set(found)) < 25
        assert max(p.count for p in found) == largest and max(p.width for p in found) == widest
        assert {p.degree for p in found} == {0, 1, 2, 3} and {p.cameras for p in found} == {1, 4}
        assert sum(p.count != 100_000 and p.width != 504 for p in found) in (4, 5)
    # linear in Gaussians and pixels; more threads make less work; nothing is said about smaller sizes
    small, large = Point(1000, 10, 10).sizes(("count", "image")), Point(4000, 30, 30).sizes(("count", "image"))
    assert growth(small, large) == 9
    assert growth(large, small) is None
    assert growth({"N": 5, "threads": 2}, {"N": 5, "threads": 1}) == 2
    bench = Bench(CPU, 3, None, lambda line: None)
    bench._stop("adam", "warpgs", "forward", {"N": 1000}, "took 3 s a repeat")
    found = [bench._chosen("adam", Point(n), {"N": n}) for n in (100, 1000, 10_000)]
    assert found == [{("warpgs", "forward")}, set(), set()] and len(bench.skipped) == 3
    # work beyond the limit is left after the warm-up: two calls and no more
    calls = []
    monkeypatch.setattr(timing, "_timed", lambda work, device: (calls.append(1) or 3000.0, None))
    (late,) = timing.measure_in_turn([lambda: None], CPU, limit_ms=2000.0)
    assert late["warm_up_ms"] == 3000.0 and "median_ms" not in late and len(calls) == 2
    # disturbed rows are known per op and sizes, and give way to faster ones of a second try, with nothing else
    bench = Bench(CPU, 3, None, print)
    peer = {"program": "peer"}
    bench._keep([row(100, 2.0, others_cores=0.9), row(100, 6.0, **peer, others_cores=0.9)])
    bench._keep([row(1000, 3.0, others_cores=0.1)])
    bench._keep([row(100, 4.0, threads=1, others_cores=0.0)])
    assert bench.open("adam", {"N": 100}) and not bench.open("adam", {"N": 1000}) and bench.open("adam", {"N": 7})
    assert not bench.open("adam", {"N": 100, "threads": 1})
    bench._keep([row(100, 2.1, others_cores=0.0), row(100, 4.0, **peer, others_cores=0.0)])
    bench._keep([row(1000, 9.0, others_cores=0.0)])
    assert [r["median_ms"] for r in bench.rows] == [2.1, 4.0, 3.0, 4.0] and not bench.open("adam", {"N": 100})


def test_tables_without_a_figure_and_marks_without_a_part():
    # a table with a figure that one fit lacks is still written
    assert mean_sd([1.0, 2.0]) == "1.50 ± 0.71" and mean_sd([1.0]) == "1.00"
    assert mean_sd([1.0, math.nan]) == mean_sd([math.nan, math.nan]) == mean_sd([math.nan]) == "nan"
    # text outside the marks stays; a missing part, and marks without one, are errors
    page = "a\n<!-- x y: written by bench.document -->\nold\n<!-- end of x y -->\nb\n"
    assert pages.filled(page, {"x y": "new\n"}) == page.replace("old\n", "\nnew\n\n")
    for parts in ({}, {"x y": "", "z": ""}):
        with pytest.raises(ValueError, match="x y"):
            pages.filled(page, parts)


def test_pages_and_charts_are_those_of_the_kept_results():
    """The generated parts of docs/ are what `python -m bench.document` writes, and docs/plots holds nothing else."""
    files = pages.files()
    stale = [path for path, text in files.items() if (pages.DOCS / path).read_text("utf-8") != text]
    assert not stale, f"{', '.join(stale)} differ from bench/results: run python -m bench.document"
    assert {f"plots/{p.name}" for p in (pages.DOCS / "plots").glob("*.svg")} == {p for p in files if p.startswith("plots/")}


def test_everything_that_can_be_run_is_listed(capsys, monkeypatch, tmp_path):
    """A line for each program; a result has the keys of the format, facts and rows, and no folder of the machine."""
    monkeypatch.setattr(sys, "argv", ["bench", "--help"])
    assert bench_main.main() == 0
    text = capsys.readouterr().out
    for name in ("document", "kernels.ops", "peers.against_others", "fits.presets"):
        assert f"\n  {name} " in text
    assert all(line.endswith((".", ":")) or line[:2] != "  " for line in text.splitlines()), text
    monkeypatch.setattr(sys, "argv", ["bench", "nothing"])
    assert bench_main.main() == 2 and "--help" in capsys.readouterr().err
    monkeypatch.setattr(sys, "argv", ["x", "/data/fern", "--out", "a.json"])
    made = result_file.result("w", CPU, [{"a": 1}], size=3)
    assert made["command"].endswith("fern --out a.json") and "/data" not in made["command"]
    assert list(made) == ["what", "command", "commit", "date", "machine", "versions", "size", "rows"]
    result_file.write(tmp_path / "a.json", made)
    assert result_file.read(tmp_path / "a.json") == made
    with pytest.raises(ValueError, match="versions"):
        result_file.write(tmp_path / "b.json", {k: v for k, v in made.items() if k != "versions"})


@pytest.mark.parametrize("path", sorted(result_file.FOLDER.glob("*")), ids=lambda p: p.name)
def test_kept_results_are_of_one_format(path):
    """JSON with what, command, commit, machine, versions and rows; else a table or chart drawn from one."""
    if path.suffix != ".json":
        assert path.suffix in (".md", ".svg") and list(path.parent.glob(f"{path.stem}*.json"))
        return
    values = result_file.read(path)
    assert values["rows"] and all(isinstance(row, dict) for row in values["rows"])
    assert {"device", "name"} <= set(values["machine"]) and {"torch", "warp"} <= set(values["versions"])


def test_naive_kernels_equal_the_real_ones(device):
    """Image and gradients of the peer with a thread a pixel; the same step over and over lowers the loss."""
    cam = camera(45, 37, cameras=2, dtype=torch.float32, device=device)
    tensors = cloud(300, torch.float32, device).tensors()
    tensors["logit_opacities"] += 3  # some alphas are clamped, some pixels stop
    leaves = [t.requires_grad_() for t in tensors.values()]
    ours, theirs = warpgs.rasterize(Gaussians(*leaves), cam).rgb, bench_programs_rasterize(Gaussians(*leaves), cam)
    v_rgb = torch.randn(ours.shape, generator=torch.Generator().manual_seed(2)).to(device)
    pairs = zip(torch.autograd.grad(theirs, leaves, v_rgb), torch.autograd.grad(ours, leaves, v_rgb))
    # an alpha within a rounding of the cut may be drawn by one and not by the other
    for found, wanted in [(theirs.detach(), ours.detach()), *pairs]:
        assert float((found - wanted).norm()) <= 1e-4 * float(wanted.norm())
    g, view, target = gaussians(200, device, 1), bench_camera(48, 32, device), image(48, 32, device)
    losses = []
    for lr in (1e-2, 1e-12):
        steps = training.Steps(g, view, target, "exact", lr)
        for take in (steps.eager, steps.replay) * 10:
            take()
        losses.append(float(steps.buffers.history[0, 0]))
    assert losses[0] < 0.95 * losses[1]
    assert all(torch.equal(t, g.tensors()[n]) for n, t in steps.table.params.items() if n == "quats")
