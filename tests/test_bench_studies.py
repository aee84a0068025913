"""What studies compute is right: orders of depths, fronts, references and errors of settings."""

import numpy as np
import pytest
import torch

from bench.lib import pareto, selected_rules, tradeoff_kernel
from bench.lib.depth_order import depth_order
from bench.lib.frozen import scenes
from bench.lib.settings import UNCUT, Setting, settings
from tests.gaussians import camera, cloud
from tests.reference.blend import blend_reference
from tests.reference.project import project_reference
from warpgs.io.load import load_scene
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.synthetic.demo import write_demo

CPU = torch.device("cpu")


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
    order = depth_order(depth, full, view.camera, seen)
    assert order["correlation"] > 0.9 and order["drawn"] == order["points"] > 10
    assert depth_order(1 / depth, full, view.camera, seen)["correlation"] == pytest.approx(-order["correlation"], abs=1e-3)
    assert np.isnan(depth_order(full, full, view.camera, seen)["correlation"])
    nothing = depth_order(depth, 0 * full, view.camera, seen)
    assert nothing["drawn"] == 0 and np.isnan(nothing["correlation"])


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
    """Without a cut float32 alone errs; with one more; all settings have a row with its time."""
    monkeypatch.setattr(tradeoff_kernel, "LIMIT_MS", 1e9)
    scene = scenes(device, 48, 36, 300, None, 0)[0]()
    chosen = [s for s in settings(3, False) if s.name in ("exact", "cut 0/255", "cut 4/255")]
    rows = {r["setting"]: r for r in tradeoff_kernel.measure_scene(scene, 2, chosen)}
    assert len(rows) == len(chosen) == 3
    assert rows["cut 0/255"]["mean"] < 1e-5 < rows["exact"]["mean"] < rows["cut 4/255"]["mean"]
    assert rows["exact"]["max_to_exact"] == 0 < rows["cut 4/255"]["max_to_exact"]
    assert rows["cut 0/255"]["grad_rel_l2"] < 1e-2 and rows["cut 0/255"]["grad_cosine"] > 0.999
    assert rows["exact"]["both_ms"] > 0


def test_fog_is_lost_under_the_cut():
    """The layers are 98 % opaque without a cut and nothing under `exact`."""
    fog = next(f for f in (m() for m in scenes(CPU, 16, 12, 300, None, 0)) if f.name == "fog")
    assert float(Setting("t", "t", UNCUT).render(fog.gaussians, fog.camera).mean()) > 0.4
    assert float(Setting("e", "e").render(fog.gaussians, fog.camera).max()) == 0


def test_selected_rules_keep_their_limits():
    """In every small scene the true error is within the limit; haze that a rule drops is left to a slower one."""
    rows = []
    for scene in selected_rules.measured_scenes(24, 60, 1, None):
        rows += selected_rules.measure(scene, 2)
    assert {r["kind"] for r in rows} == {"haze", "needles", "far"} and len(rows) == 6 * (5 + 2)
    kept = [r for r in rows if r["rule"] != "none"]
    assert all(r["error"] <= r["bound"] <= r["limit"] for r in kept) and len(kept) > 30
    assert {r["rule"] for r in rows if r["kind"] == "haze"} == {"fast", "balanced", "exact"}
    (row,) = selected_rules.summary([r for r in rows if (r["kind"], r["measure"], r["limit"]) == ("haze", "mean", 1e-2)])
    assert sum(row["rules"].values()) == 5 and row["rules"]["exact"] == 2 and row["typical"] <= row["worst"] <= 1e-2


def test_a_limit_that_no_rule_keeps_counts_as_none():
    """The summary leaves times and errors out where all scenes are refused."""
    row = {"kind": "far", "measure": "max", "limit": 1e-4, "rule": "none", "time": None, "error": 1e-3, "pixel_max": 1e-3}
    assert selected_rules.summary([row, row]) == [{"kind": "far", "measure": "max", "limit": 1e-4, "rules": {"none": 2}}]
