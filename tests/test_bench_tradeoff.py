"""The bench of speed against accuracy: fronts, errors, an interrupted run that goes on, stored results that prices quote."""

import json
import math
from pathlib import Path

import pytest
import torch

from bench.experiments import pareto, tradeoff, tradeoff_kernel, tradeoff_outcome
from bench.experiments.frozen import scenes
from bench.experiments.settings import UNCUT, Setting, settings
from tests.gaussians import camera, cloud
from tests.reference.blend import blend_reference
from tests.reference.project import project_reference
from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.render.rule_costs import RULE_COSTS

CPU = torch.device("cpu")
RESULTS = Path(__file__).parent.parent / "bench/results"


def point(name: str, cost: float, value: float) -> pareto.Point:
    return pareto.Point(name, "knob", cost, value)


def test_front():
    """What another point beats is left out, either way up; of equals one stays."""
    points = [point("a", 1, 5), point("b", 2, 3), point("c", 2, 4), point("d", 3, 3), point("e", 4, 1), point("e2", 4, 1)]
    assert [p.name for p in pareto.front(points)] == ["a", "b", "e"]
    assert [p.name for p in pareto.front(points, upwards=True)] == ["a"]


def test_chart_shows_what_is_beaten_hollow():
    """Filled marks on the front, hollow ones elsewhere, squares for presets, every knob in the legend."""
    points = (point("a", 1, 5), point("b", 2, 3), point("c", 3, 4), pareto.Point("mine", "preset", 5, 2, 0.5, preset=True))
    svg = pareto.chart("title", [pareto.Panel("panel", "what", "time", "error", points)] * 2)
    assert svg.count("<circle") == 2 + 2 * 3 and svg.count("<rect") == 1 + 2 and svg.count('r="4" fill="#ffffff"') == 2
    assert "mine" in svg and "nan" not in svg and "inf" not in svg and "outside" not in svg
    far = pareto.chart("title", [pareto.Panel("panel", "what", "time", "error", (*points, point("away", 50, 1)))])
    assert "outside: away: 50, 1" in far and far.count("<circle") == 2 + 3


def test_values_far_behind_are_named_instead_of_shown():
    """On a linear axis, beyond twice what front and presets span; on a logarithmic one all are shown."""
    points = (point("a", 1, 10), point("b", 2, 11), point("c", 1.5, 7.9), point("d", 1.5, 8.1))
    svg = pareto.chart("t", [pareto.Panel("p", "", "x", "y", points, upwards=True, log_y=False)])
    assert "outside: c: 1.5, 7.9" in svg and svg.count("<circle") == 3 + 1
    assert "outside" not in pareto.chart("t", [pareto.Panel("p", "", "x", "y", points, upwards=True)])
    alone = (pareto.Point("a", "k", 1, 10, preset=True), point("b", 2, 9.99), point("c", 3, 9.98))
    assert "outside" not in pareto.chart("t", [pareto.Panel("p", "", "x", "y", alone, upwards=True, log_y=False)])


def test_the_truth_is_the_model(device):
    """Float64 kernels without cut-offs against the plain loop over Gaussians: R64 of the bench is the picture of the model."""
    g, cam = cloud(60, torch.float64, device), camera(40, 33, device=device)
    found = rasterize(g, cam, RasterizeOptions(rule=UNCUT)).rgb.cpu()
    plain = {n: t.cpu() for n, t in g.tensors().items()}
    projected = project_reference(
        *plain.values(), cam.viewmat[None].cpu(), cam.K[None].cpu(), width=40, height=33, degree=1, low_pass=UNCUT.low_pass
    )
    means, covs, colors, depths, opacities = (t[0] if t.ndim > 1 else t for t in projected)
    wanted = blend_reference(means, covs, opacities, colors, depths, torch.zeros(3).double(), 40, 33, UNCUT)[0]
    assert float((found - wanted).abs().max()) < 1e-12


def test_errors_of_a_scene_are_what_the_settings_leave_out(device, monkeypatch):
    """Without a cut float32 alone errs; with one more; sorting by depths that are off most; all settings have a row."""
    monkeypatch.setattr(tradeoff_kernel, "LIMIT_MS", 1e9)
    make = scenes(device, 48, 36, 300, None, 0)[0]
    scene = make()
    chosen = [s for s in settings(3, False) if s.name in ("exact", "cut 0/255", "cut 4/255", "half SH", "order off 0.0016")]
    rows = {r["setting"]: r for r in tradeoff_kernel.measure_scene(scene, 2, chosen)}
    assert len(rows) == len(chosen) == 5
    assert rows["cut 0/255"]["mean"] < 1e-5 < rows["exact"]["mean"] < rows["cut 4/255"]["mean"]
    assert rows["exact"]["max_to_exact"] == 0 < rows["cut 4/255"]["max_to_exact"]
    assert rows["cut 0/255"]["grad_rel_l2"] < 1e-2 and rows["cut 0/255"]["grad_cosine"] > 0.999
    assert rows["exact"]["both_ms"] > 0 and "both_ms" not in rows["half SH"] and rows["half SH"]["simulated"]


def test_fog_is_lost_under_the_cut():
    """The layers are 98 % opaque in truth and nothing under `exact`."""
    fog = next(f for f in (m() for m in scenes(CPU, 16, 12, 300, None, 0)) if f.name == "fog")
    assert float(Setting("t", "t", UNCUT).draw(fog.gaussians, fog.camera).mean()) > 0.4
    assert float(Setting("e", "e").draw(fog.gaussians, fog.camera).max()) == 0


def test_an_interrupted_kernel_run_goes_on(tmp_path, monkeypatch, capsys):
    """Scenes that the file holds are not measured again; another size is refused; CSV and SVG stand beside it."""
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
    done = json.loads((tmp_path / "k.json").read_text())
    del done["scenes"]["fog"]
    (tmp_path / "k.json").write_text(json.dumps(done))
    tradeoff.main(flags)
    assert calls[6:] == ["fog"]
    assert (tmp_path / "k.csv").read_text().count("\n") == 7 and (tmp_path / "k.svg").read_text().startswith("<svg")
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


def test_prices_quote_the_stored_results():
    """What `--max-error` goes by is what was measured, to two digits."""
    rows = json.loads((RESULTS / "tradeoff_kernel_cpu2.json").read_text())["scenes"]["trained"]["rows"]
    by_name = {r["setting"]: r for r in rows}
    for cost in RULE_COSTS[:-1]:
        row = by_name[cost.rule]
        assert cost.mean_error == pytest.approx(row["mean_to_exact"], rel=0.06)
        assert cost.max_error == pytest.approx(row["max_to_exact"], rel=0.06)
        assert cost.time == pytest.approx(row["both_ms"] / by_name["exact"]["both_ms"], abs=0.03)
    assert all(math.isfinite(r["mean"]) for r in rows)
