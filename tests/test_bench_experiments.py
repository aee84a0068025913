"""The studies of `bench.experiments` measure what they say, on tiny sizes."""

import json
import math
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import torch

from bench import result_file
from bench.experiments import (
    bucket,
    complexity,
    left_out_view,
    pareto,
    scale_limits,
    tradeoff,
    tradeoff_kernel,
    tradeoff_outcome,
)
from bench.experiments.bucket_kernel import SIZES, make_backward
from bench.experiments.depth_order import depth_order, main
from bench.experiments.frozen import scenes
from bench.experiments.leave_one_out import folds, table, trial_config
from bench.experiments.settings import UNCUT, Setting, settings
from tests.gaussians import camera, cloud
from tests.reference.blend import blend_reference
from tests.reference.project import project_reference
from tests.scenes import photos, seeds
from warpgs.app.cli import main as warpgs
from warpgs.errors import UsageError
from warpgs.geometry import focus_point, project_points
from warpgs.io.load import load_scene
from warpgs.pipeline.model.init import InitConfig
from warpgs.pipeline.runs.request import SceneRequest
from warpgs.pipeline.train.config import PRESETS, FitConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.holdout_blocks import HoldoutConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.render.rule_costs import RULE_COSTS
from warpgs.synthetic.demo import split_spec, write_demo

CPU = torch.device("cpu")


@pytest.mark.cuda
@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("rule", ["gsplat", "exact", "inria"])
def test_buckets_give_the_gradients_of_chunks(rule, with_depth):
    """All slots are written, by every kernel, with what the product writes; lists of several buckets, two cameras."""
    cameras = camera(150, 90, 2, dtype=torch.float32, device="cuda:0")
    case = bucket.case_of(cloud(6000, device="cuda:0"), cameras, bucket.RULES[rule], with_depth)
    assert int((case.tiles.ranges[:, 1] - case.tiles.ranges[:, 0]).max()) > 2 * max(SIZES)
    assert len(case.variants) == 2 * len(SIZES)
    row = bucket.measure(case, 2)
    assert bucket.agrees(row), row["disagreement"]


def test_a_gradient_that_nobody_wrote_is_a_disagreement():
    """NaN is no agreement; buckets are whole warps."""
    row = {"disagreement": {"bucket 32": {"instances": math.nan, "records": 0.0}}}
    assert not bucket.agrees(row)
    row["disagreement"]["bucket 32"]["instances"] = 1e-6
    assert bucket.agrees(row)
    with pytest.raises(ValueError, match="multiple of 32"):
        make_backward(16, False, 48, True)


@pytest.mark.slow
def test_complexity_has_tables_and_a_curve(tmp_path, monkeypatch, capsys):
    """Both fits of a tiny scene, a row each, paired; each point is a pruned model no larger than the one before."""
    write_demo(tmp_path / "scene", views=8, width=64, height=48)
    monkeypatch.setattr(complexity, "KEEP", (0.1, 1.0))
    words = [str(tmp_path / "scene"), "--out", str(tmp_path / "out"), "--split", split_spec(8), "--preset", "quick"]
    assert complexity.main([*words, "--steps", "30", "--seeds", "1", "--device", "cpu"]) == 0
    fixed, adaptive = result_file.read(tmp_path / "out" / "complexity.json")["rows"]
    assert (fixed["variant"], adaptive["variant"]) == ("fixed", "adaptive") and adaptive["bytes"] < fixed["bytes"]
    gain = f"| {fixed['bytes'] / adaptive['bytes']:.2f} | {adaptive['psnr'] - fixed['psnr']:.2f} |"
    assert gain in (tmp_path / "out" / "complexity.md").read_text() and gain in capsys.readouterr().out
    rows = result_file.read(tmp_path / "out" / "curve.json")["rows"]
    assert [r["keep_db"] for r in rows] == [0, 0.1, 1.0] * 2
    for own, run in ((rows[:3], fixed), (rows[3:], adaptive)):
        sizes = [r["bytes"] for r in own]
        assert sizes == sorted(sizes, reverse=True) and sizes[2] < sizes[0]
        assert own[2]["train_psnr"] >= own[0]["train_psnr"] - 1.0 and own[0]["psnr"] == pytest.approx(run["psnr"])
    circles = [e for e in ET.parse(tmp_path / "out" / "curve.svg").getroot().iter() if e.tag.endswith("circle")]
    assert len(circles) == 6 and all(0 < float(c.get("cx")) < 520 and 0 < float(c.get("cy")) < 300 for c in circles)


def test_depths_in_order_correlate_and_points_on_nothing_do_not_count(tmp_path):
    """1 for depths that grow with the points', -1 for their inverse, NaN for a flat depth or for nothing drawn."""
    write_demo(tmp_path / "scene", views=9, width=48, height=36)
    loaded = load_scene(str(tmp_path / "scene"))
    view = loaded.views[4]
    seen = loaded.points.seen_by({view.name})
    size, full = (view.camera.height, view.camera.width), np.ones((view.camera.height, view.camera.width))
    at = seen.points @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
    pixels = (at @ view.camera.K.T)[:, :2] / at[:, 2:]
    depth = np.full(size, float(np.median(at[:, 2])))
    for (x, y), z in zip(np.floor(pixels).astype(int), at[:, 2], strict=True):
        if 0 <= x < size[1] and 0 <= y < size[0]:
            depth[y, x] = z
    order = depth_order("v", depth, full, view.camera, seen)
    assert order.correlation > 0.9 and order.drawn == order.points > 10
    assert depth_order("v", 1 / depth, full, view.camera, seen).correlation == pytest.approx(-order.correlation, abs=1e-3)
    assert np.isnan(depth_order("v", full, full, view.camera, seen).correlation)
    nothing = depth_order("v", depth, 0 * full, view.camera, seen)
    assert nothing.drawn == 0 and np.isnan(nothing.correlation)


@pytest.mark.slow
def test_depth_order_of_a_run(tmp_path, capsys):
    """A short fit from the exact points has its held-out depths nearly in order, a line per view; mistakes are told."""
    scene, run = tmp_path / "scene", tmp_path / "run"
    write_demo(scene, views=9, width=96, height=72)
    flags = ["--preset", "3dgs", "--steps", "30", "--init.source", "points", "--device", "cpu", "--out", str(run)]
    assert warpgs(["fit", str(scene), "--split", split_spec(9), *flags]) == 0
    capsys.readouterr()
    assert main([str(run), str(scene)]) == 0
    *lines, mean = capsys.readouterr().out.splitlines()
    values = [float(re.search(r"correlation (\S+) over", line)[1]) for line in lines]
    assert min(values) > 0.8 and float(mean.split()[-1]) == pytest.approx(np.mean(values), abs=1e-4)
    record = json.loads((run / "config.json").read_text())
    assert [line.split(":")[0] for line in lines] == record["test"]
    (run / "config.json").write_text(json.dumps(record | {"test": []}))
    assert main([str(run), str(scene)]) == 3 and "holds no view out" in capsys.readouterr().err


def test_a_trial_changes_what_it_names_and_nothing_else():
    """Values by name in the preset's settings; what sets nothing is refused."""
    made = trial_config("quick:optimizer.scales_decay=0.5,init.source=flow,steps=7").to_json()
    base = PRESETS["quick"].to_json()
    base["optimizer"]["scales_decay"], base["init"]["source"], base["steps"] = 0.5, "flow", 7
    assert made == base and trial_config("quick") == PRESETS["quick"]
    for bad in ("slow", "quick:steps", "quick:optimizer.speed=1", "quick:steps.x=1", "quick:steps=0"):
        with pytest.raises(UsageError):
            trial_config(bad)


def test_every_training_view_is_left_out_once(tmp_path):
    """Held-out views of the split are not touched; the table counts whole seeds alone."""
    spec = write_demo(tmp_path / "scene", views=8, width=48, height=36)
    train, test = (part.split("=")[1].split(",") for part in spec.split(";"))
    cut = folds(SceneRequest(str(tmp_path / "scene"), spec, 1))
    assert len(cut) == len(train) >= 3
    assert all(split.endswith(f"test={name}") and split.count(name) == 1 for name, split in cut)
    assert not any(t in split for _, split in cut for t in test)
    row = {"scene": "s", "trial": "quick", "ssim": 0.5, "bytes": 4_000_000}
    seeds = ((0, "a", 20.0), (0, "b", 22.0), (1, "a", 21.0), (1, "b", 25.0), (2, "a", 90.0))
    rows = [row | {"left_out": view, "seed": seed, "psnr": psnr} for seed, view, psnr in seeds]
    lines = table(rows, ["quick", "paper"], 2)[2:]
    assert lines == ["| `quick` | 22.00 ± 1.41 (2) | 0.5000 | 21.00 | 4,000 |", "| `paper` |  |  |  |  |"]


def point(name: str, cost: float, value: float) -> pareto.Point:
    return pareto.Point(name, "knob", cost, value)


def test_front_and_chart():
    """What another point beats is hollow; squares are presets; what lies far behind is named instead of shown."""
    points = (point("a", 1, 5), point("b", 2, 3), point("c", 3, 4), pareto.Point("mine", "preset", 5, 2, 0.5, preset=True))
    assert [p.name for p in pareto.front(points)] == ["a", "b", "mine"]
    assert [p.name for p in pareto.front(points, upwards=True)] == ["a"]
    svg = pareto.chart("title", [pareto.Panel("panel", "what", "time", "error", points)] * 2)
    assert svg.count("<circle") == 2 + 2 * 3 and svg.count("<rect") == 1 + 2 and svg.count('r="4" fill="#ffffff"') == 2
    assert "mine" in svg and "nan" not in svg and "inf" not in svg and "outside" not in svg
    far = pareto.chart("title", [pareto.Panel("panel", "what", "time", "error", (*points, point("away", 50, 1)))])
    assert "outside: away: 50, 1" in far and far.count("<circle") == 2 + 3
    behind = (point("a", 1, 10), point("b", 2, 11), point("c", 1.5, 7.9), point("d", 1.5, 8.1))
    svg = pareto.chart("t", [pareto.Panel("p", "", "x", "y", behind, upwards=True, log_y=False)])
    assert "outside: c: 1.5, 7.9" in svg and svg.count("<circle") == 3 + 1


def test_the_reference_is_the_model(device):
    """Float64 kernels without cut-offs against the plain loop over Gaussians."""
    g, cam = cloud(60, torch.float64, device), camera(40, 33, device=device)
    found = rasterize(g, cam, RasterizeOptions(rule=UNCUT)).rgb.cpu()
    plain = {n: t.cpu() for n, t in g.tensors().items()}
    views = (cam.viewmat[None].cpu(), cam.K[None].cpu())
    projected = project_reference(*plain.values(), *views, width=40, height=33, degree=1, low_pass=UNCUT.low_pass)
    means, covs, colors, depths, opacities = (t[0] if t.ndim > 1 else t for t in projected)
    wanted = blend_reference(means, covs, opacities, colors, depths, torch.zeros(3).double(), 40, 33, UNCUT)[0]
    assert float((found - wanted).abs().max()) < 1e-12


@pytest.mark.slow
def test_errors_of_a_scene_are_what_the_settings_leave_out(device, monkeypatch):
    """Without a cut float32 alone errs; with one more; all settings have a row, simulated ones no time."""
    monkeypatch.setattr(tradeoff_kernel, "LIMIT_MS", 1e9)
    scene = scenes(device, 48, 36, 300, None, 0)[0]()
    chosen = [s for s in settings(3, False) if s.name in ("exact", "cut 0/255", "cut 4/255", "half SH", "order off 0.0016")]
    rows = {r["setting"]: r for r in tradeoff_kernel.measure_scene(scene, 2, chosen)}
    assert len(rows) == len(chosen) == 5
    assert rows["cut 0/255"]["mean"] < 1e-5 < rows["exact"]["mean"] < rows["cut 4/255"]["mean"]
    assert rows["exact"]["max_to_exact"] == 0 < rows["cut 4/255"]["max_to_exact"]
    assert rows["cut 0/255"]["grad_rel_l2"] < 1e-2 and rows["cut 0/255"]["grad_cosine"] > 0.999
    assert rows["exact"]["both_ms"] > 0 and "both_ms" not in rows["half SH"] and rows["half SH"]["simulated"]


def test_fog_is_lost_under_the_cut():
    """The layers are 98 % opaque without a cut and nothing under `exact`."""
    fog = next(f for f in (m() for m in scenes(CPU, 16, 12, 300, None, 0)) if f.name == "fog")
    assert float(Setting("t", "t", UNCUT).render(fog.gaussians, fog.camera).mean()) > 0.4
    assert float(Setting("e", "e").render(fog.gaussians, fog.camera).max()) == 0


def test_an_interrupted_kernel_run_goes_on(tmp_path, monkeypatch, capsys):
    """Scenes that the file holds are not measured again; another size is refused; a chart stands beside it."""
    calls = []

    def row(scene, repeats, chosen=None):
        calls.append(scene.name)
        base = {"scene": scene.name, "setting": "exact", "knob": "preset", "preset": True, "simulated": False}
        return [base | {"max": 0.1, "mean": 0.01, "grad_rel_l2": 0.1, "forward_ms": 1.0, "backward_ms": 1.0, "both_ms": 2.0}]

    monkeypatch.setattr(tradeoff_kernel, "measure_scene", row)
    monkeypatch.setattr(tradeoff_kernel, "sorting_share", lambda *_: {})
    flags = ["kernel", "--device", "cpu", "--out", str(tmp_path / "k.json"), "--width", "16", "--count", "10"]
    tradeoff.main(flags)
    assert len(calls) == 6 and "about" in capsys.readouterr().out
    done = result_file.read(tmp_path / "k.json")
    del done["scenes"]["fog"]
    done["rows"] = [r for r in done["rows"] if r["scene"] != "fog"]
    (tmp_path / "k.json").write_text(json.dumps(done))
    tradeoff.main(flags)
    assert calls[6:] == ["fog"] and len(result_file.read(tmp_path / "k.json")["rows"]) == 6
    assert (tmp_path / "k.svg").read_text().startswith("<svg")
    with pytest.raises(SystemExit, match="another measurement"):
        tradeoff.main([*flags[:-1], "11"])


def test_outcomes_are_paired_by_seed():
    """Mean difference to `quick` over the same seeds, and an interval that a constant shift leaves at nothing."""
    rows = []
    for seed, psnr in enumerate((20.0, 21.0, 22.5)):
        head = {"seed": seed, "preset": False, "knob": "k", "gaussians": 10, "seconds": 2.0}
        rows += [head | {"trial": "quick", "psnr": psnr, "ssim": 0.5}, head | {"trial": "x", "psnr": psnr + 0.5, "ssim": 0.6}]
    quick, x = tradeoff_outcome.summary(rows, "seconds")
    assert quick["psnr_gain"] == 0 and x["psnr_gain"] == pytest.approx(0.5) and x["psnr_bar"] == pytest.approx(0, abs=1e-9)
    assert x["psnr"] == pytest.approx(63.5 / 3 + 0.5) and x["seeds"] == 3


def test_rule_costs_quote_the_stored_results():
    """What `--max-error` goes by is what was measured, to two digits."""
    rows = result_file.read(result_file.FOLDER / "tradeoff_kernel_cpu2.json")["rows"]
    by_name = {r["setting"]: r for r in rows if r["scene"] == "trained"}
    for cost in RULE_COSTS[:-1]:
        row = by_name[cost.rule]
        assert cost.mean_error == pytest.approx(row["mean_to_exact"], rel=0.06)
        assert cost.max_error == pytest.approx(row["max_to_exact"], rel=0.06)
        assert cost.time == pytest.approx(row["both_ms"] / by_name["exact"]["both_ms"], abs=0.03)
    assert all(math.isfinite(r["mean"]) for r in rows)


def test_scale_limits_are_compared_from_beside_the_cameras(tmp_path):
    """The camera stands aside and looks at the same point; splits and limits are read; the table has a row for each way."""
    write_demo(tmp_path / "scene", views=8, width=64, height=48)
    scene = load_scene(tmp_path / "scene")
    cameras = [v.camera for v in scene.views]
    here, aside = scale_limits.beside(cameras, 0.0), scale_limits.beside(cameras, 0.5)
    target = focus_point(cameras)
    assert np.allclose(np.linalg.norm(aside.center - here.center), 0.5 * np.linalg.norm(target - here.center))
    assert np.allclose(project_points(aside, target[None])[0], aside.K[:2, 2])
    assert scale_limits.split_of(scene, "even:4").startswith("train=000.png,002.png,004.png,006.png;test=001.png")
    assert scale_limits.split_of(scene, "every:8") == "every:8"
    assert scale_limits.limits_of("max_size=2,ratio_from=0").max_size == 2
    for wrong in (lambda: scale_limits.split_of(scene, "even:9"), lambda: scale_limits.limits_of("size=1")):
        with pytest.raises(UsageError):
            wrong()
    row = {"scene": "a", "psnr": 20.0, "ssim": 0.5, "gaussians": 9} | dict.fromkeys(scale_limits.FIGURES, 0.25)
    rows = [row | {"limits": kind, "seed": seed} for kind in ("off", "on") for seed in (0, 1)]
    assert scale_limits.table(rows).count("\n| a | ") == 2 and "| on | 2 | 20.00 |" in scale_limits.table(rows)


def test_the_central_view_is_left_out_until_growth_ends():
    init = InitConfig(source="points", max_sh_degree=1)
    density = DensityConfig(start=10, every=5, gradient=1e-5)
    held = HoldoutConfig(levels=2, trim_db=0)
    config = FitConfig(steps=60, sh_every=15, strategy="left_out_view", init=init, holdout=held, density=density)
    fit = Trainer(photos(5), seeds(), config, torch.device("cpu"))
    centers = torch.stack([left_out_view.center(v.camera.viewmat) for v in fit.strategy.whole])
    chosen = int((centers[:, None] - centers).norm(dim=2).sum(1).argmin())
    assert [len(b) > 0 for b in fit.strategy.blocks] == [i == chosen for i in range(5)]
    assert len(fit.views) == 4
    while fit.step < config.steps:
        fit.advance()
    assert fit.strategy.closed is not None and fit.strategy.levels
    assert len(fit.views) == 5
