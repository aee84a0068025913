"""The benches run and their arithmetic holds; how long things take is nobody's test."""

import json

import pytest
import torch

from bench import inputs, peers, predict
from bench.__main__ import OPS, run
from bench.points import Point, growth, points
from warpgs import rasterize
from warpgs.kernels.ssim import ssim

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def result():
    """A run over tiny sizes, as JSON. One thread: torch's spin where cores are shared, and that takes longer than the work."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    made = run(CPU, tiny=True, echo=lambda line: None)
    torch.set_num_threads(before)
    return json.loads(json.dumps(made))


def test_every_op_gives_rows(result):
    """A positive time for each op and direction, sizes, and a share of the roof for our own."""
    rows = result["rows"]
    assert {r["op"] for r in rows} == set(OPS)
    assert all(r["median_ms"] > 0 and r["quartiles_ms"][0] <= r["median_ms"] <= r["quartiles_ms"][1] for r in rows)
    backward = {r["op"] for r in rows if r["direction"] in ("backward", "both")}
    assert backward == {"project", "sh", "blend", "ssim", "render"}
    ours = [r for r in rows if r["program"] == "warpgs" and not r.get("threads")]
    assert all(r["share"] > 0 and r["bytes"] > 0 and r["roof_ms"] > 0 for r in ours)
    assert result["roofline"]["bytes_per_s"] > 0 and result["roofline"]["operations_per_s"] > 0
    assert {r["program"] for r in rows} >= {"warpgs", peers.TORCH_SSIM, peers.DENSE}


def test_a_budget_of_nothing_skips_everything():
    """All tasks are listed with the reason, none is measured."""
    result = run(CPU, tiny=True, ops=("adam", "render"), budget=0, echo=lambda line: None)
    assert not result["rows"]
    assert {s["op"] for s in result["skipped"]} == {"adam", "render"}
    assert all("left of the time given" in s["reason"] for s in result["skipped"])


def row(count: int, milliseconds: float, **more) -> dict:
    """A measured row of one op."""
    return {"op": "adam", "program": "warpgs", "direction": "forward", "N": count, "median_ms": milliseconds, **more}


def test_predictions_grow_linearly_at_least():
    """Flat growth counts as linear, steeper growth goes on, and nothing is foretold for smaller sizes."""
    task = ("adam", "warpgs", "forward")
    flat, steep = [row(100, 1.0), row(1000, 1.1)], [row(100, 1.0), row(1000, 30.0)]
    assert predict.time_ms(flat, *task, {"N": 10_000}) == pytest.approx(11.0)
    assert predict.time_ms(steep, *task, {"N": 10_000}) == pytest.approx(900.0)
    assert predict.time_ms(flat, *task, {"N": 50}) is None
    assert predict.time_ms(flat, "knn", "warpgs", "forward", {"N": 10_000}) is None


def test_hopeless_tasks_are_skipped():
    """Too long, or too large for the free memory; anything else runs."""
    task, point = ("adam", "warpgs", "forward"), Point(1_000_000)
    sizes = point.sizes(("count",))
    rows = [row(100_000, 150.0, peak_bytes=10_000_000)]
    assert predict.reason_to_skip(rows, *task, point, sizes, free=1e12) is None
    assert "a repeat" in predict.reason_to_skip([row(100_000, 250.0)], *task, point, sizes, free=1e12)
    assert "GiB" in predict.reason_to_skip(rows, *task, point, sizes, free=5e7)
    assert "GiB" in predict.reason_to_skip([], *task, point, sizes, free=5e7)


def test_points_vary_one_axis_at_a_time_and_along_the_diagonal():
    """No full cross product; the base point once; sizes as agreed for each device."""
    axes = ("count", "image", "degree", "cameras")
    for device, largest, widest in (("cpu", 10**6, 1920), ("cuda", 10**7, 7680)):
        found = points(axes, torch.device(device), tiny=False)
        assert len(found) == len(set(found)) < 25
        assert max(p.count for p in found) == largest and max(p.width for p in found) == widest
        assert {p.degree for p in found} == {0, 1, 2, 3} and {p.cameras for p in found} == {1, 4}
        assert sum(p.count != 100_000 and p.width != 504 for p in found) in (3, 4)


def test_growth_is_that_of_the_axis_that_grows_most():
    """Linear in Gaussians and pixels; more threads make less work; nothing is said about smaller sizes."""
    small, large = Point(1000, 10, 10).sizes(("count", "image")), Point(4000, 30, 30).sizes(("count", "image"))
    assert growth(small, large) == 9
    assert growth(large, small) is None
    assert growth({"N": 5, "threads": 2}, {"N": 5, "threads": 1}) == 2


def test_peers_draw_and_score_the_same():
    """What is compared for speed must agree in its result."""
    gaussians, camera = inputs.gaussians(60, CPU), inputs.camera(40, 30, CPU, 2)
    ours, dense = rasterize(gaussians, camera).rgb, peers.dense_rasterize(gaussians, camera)
    assert (ours - dense).abs().max() < 1e-3
    a, b = inputs.image(40, 30, CPU), inputs.image(40, 30, CPU, seed=1)
    assert (ssim(a, b) - peers.torch_ssim(a, b)).abs().max() < 1e-4
