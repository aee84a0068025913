"""The benches run and their arithmetic holds; how long things take is nobody's test."""

import json
import math
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest
import torch

from bench.lib import accuracy_page, inputs, measured_page, ops, peers, performance_page, result_file, timing
from bench.lib.ops import OPS, Bench, run
from bench.lib.points import Point, exponent, growth, points
from warpgs import rasterize
from warpgs.kernels.ssim import ssim

CPU = torch.device("cpu")


def tiny(names: tuple[str, ...]) -> dict:
    """A run over tiny sizes, as JSON, on a machine that is never too slow or busy: neither is what these tests are about.

    One thread: torch's spin where cores are shared, and that takes longer than the work.
    """
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
    """Two light ops."""
    return tiny(("adam", "knn"))


@pytest.mark.slow
def test_every_op_gives_rows():
    """A positive time for each op and direction, sizes, and a fraction of the roof for our own."""
    result = tiny(OPS)
    rows = result["rows"]
    assert not result["skipped"]
    assert {r["op"] for r in rows} == set(OPS)
    assert all(r["median_ms"] > 0 and r["quartiles_ms"][0] <= r["median_ms"] <= r["quartiles_ms"][1] for r in rows)
    backward = {r["op"] for r in rows if r["direction"] in ("backward", "both")}
    assert backward == {"project", "blend", "ssim", "render"}
    ours = [r for r in rows if r["program"] == "warpgs" and not r.get("threads")]
    assert all(r["fraction"] > 0 and r["bytes"] > 0 and r["roof_ms"] > 0 for r in ours)
    assert {r["program"] for r in rows} >= {"warpgs", peers.TORCH_SSIM, peers.DENSE}


def test_a_budget_of_nothing_skips_everything():
    """All tasks are listed with the reason, none is measured."""
    result = run(CPU, tiny=True, ops=("adam", "knn"), budget=0, echo=lambda line: None)
    assert not result["rows"] and {s["op"] for s in result["skipped"]} == {"adam", "knn"}
    assert all("no time is left" in s["reason"] for s in result["skipped"])


def test_a_second_run_measures_only_what_the_first_lacks_or_what_was_disturbed(result):
    """All rows stay as they are but the one that was taken out, and the one during which other programs kept cores busy."""
    busy = [r | {"others_cores": 2.0} if r["op"] == "knn" else r for r in result["rows"]]
    knn = sum(r["op"] == "knn" for r in busy)
    lacking = result | {"rows": [r for r in busy if (r["op"], r.get("N")) != ("adam", 100)]}
    lines = []
    again = run(CPU, tiny=True, ops=("adam", "knn"), earlier=lacking, echo=lines.append)
    kept = [r for r in again["rows"] if r in result["rows"]]
    assert len(again["rows"]) == len(result["rows"]) and len(kept) == len(busy) - knn - 1
    assert again["roofline"] == result["roofline"] and len(lines) == 1 + 1 + knn


def row(count: int, milliseconds: float, **more) -> dict:
    """A measured row of one op."""
    return {"op": "adam", "program": "warpgs", "direction": "forward", "N": count, "median_ms": milliseconds, **more}


def test_points_vary_one_axis_at_a_time_and_along_the_diagonal():
    """No full cross product; the base point once; sizes as agreed for each device."""
    axes = ("count", "image", "degree", "cameras")
    for device, largest, widest in (("cpu", 10**6, 1920), ("cuda", 10**7, 7680)):
        found = points(axes, torch.device(device), tiny=False)
        assert len(found) == len(set(found)) < 25
        assert max(p.count for p in found) == largest and max(p.width for p in found) == widest
        assert {p.degree for p in found} == {0, 1, 2, 3} and {p.cameras for p in found} == {1, 4}
        assert sum(p.count != 100_000 and p.width != 504 for p in found) in (4, 5)


def test_disturbed_rows_are_known_and_give_way_to_faster_ones():
    """Per op and sizes; all rows of a second try take the place of slower ones, and of nothing else."""
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


def test_what_took_too_long_is_not_tried_at_larger_sizes():
    """Nor is anything where two sizes cannot be compared left out."""
    bench, module = Bench(CPU, 3, None, lambda line: None), SimpleNamespace(PROGRAMS={"warpgs": ("forward",)})
    bench._stop("adam", "warpgs", "forward", {"N": 1000}, "took 3 s a repeat")
    found = [bench._chosen("adam", module, Point(n), {"N": n}) for n in (100, 1000, 10_000)]
    assert found == [{("warpgs", "forward")}, set(), set()] and len(bench.skipped) == 3


def test_work_beyond_the_limit_is_left_after_the_warm_up(monkeypatch):
    """Two calls and no more."""
    calls = []
    monkeypatch.setattr(timing, "_timed", lambda work, device: (calls.append(1) or 3000.0, None))
    (row,) = timing.measure_in_turn([lambda: None], CPU, limit_ms=2000.0)
    assert row["warm_up_ms"] == 3000.0 and "median_ms" not in row and len(calls) == 2


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


def test_the_exponent_of_a_power_law_is_found():
    """Exactly, from the last decade alone; None where there is nothing to fit."""
    points = [(10.0**k, 3 * 10.0 ** (1.4 * k)) for k in range(3, 8)]
    assert exponent(points) == pytest.approx(1.4)
    assert exponent([(1e3, 5.0), (1e4, 5.0), (1e5, 5.0), (1e6, 50.0)]) == pytest.approx(1.0)
    assert exponent([(504 * 378, 1.0), (1920 * 1080, 10.0)]) is not None
    assert exponent([(1e3, 1.0)]) is None and exponent([(1e3, 1.0), (1e6, 2.0)]) is None


def hand_made(device: str) -> dict:
    """A result as `run` makes it, small enough to read."""
    size = {"width": 504, "height": 378}
    cuda = {"gpu_ms": 0.5, "peak_bytes": 2**20} if device == "cuda" else {}
    common = {"quartiles_ms": [0.5, 2.0], "repeats": 30, **cuda}
    roof = {"bytes": 1e6, "operations": 1e6, "roof_ms": 0.25, "bound": "bytes", "fraction": 0.25}
    rows = [
        {"op": "render", "program": program, "direction": "both", "N": n, **size, "median_ms": n / scale, **common}
        | (roof if program == "warpgs" else {})
        for n in (1000, 10_000, 100_000)
        for program, scale in (("warpgs", 1000), ("gsplat", 500))
    ]
    rows += [{"op": "ssim", "program": "warpgs", "direction": d, "width": 16 * k, "height": 9 * k, "median_ms": k * k / 1e3}
             | common | roof for d in ("forward", "backward") for k in (40, 80, 120)]  # fmt: skip
    skipped = [{"op": "render", "program": "gsplat", "direction": "both", "N": 10**6, **size, "reason": "predicted 9 s"}]
    return {
        "what": "w", "command": "c", "commit": "abc", "date": "2026-01-02", "versions": {"torch": "2"}, "repeats": 30,
        "machine": {
            "device": device, "name": "Device <A & B>", "processor": "P", "cores": 2, "threads": 2, "memory_gib": 8.0,
            "device_memory_gib": 9.0,
        },
        "note": "Words about it.", "absent": {"naive": "not there"}, "rows": rows, "skipped": skipped,
        "roofline": {"bytes_per_s": 1e10, "operations_per_s": 1e11, "how": "measured"},
    }  # fmt: skip


def test_the_document_says_what_the_results_say():
    """Tables, ratios, exponents, reasons; charts are well-formed; the same results give the same bytes."""
    results = {"b": hand_made("cuda"), "a": hand_made("cpu")}
    files = performance_page.files(results)
    assert files == performance_page.files(json.loads(json.dumps(dict(reversed(results.items())))))
    text = files["performance.md"]
    assert text.index("(a)\n") < text.index("(b)\n")
    assert all(f"| render | warpgs | both | {cell} |  | 1.00 |  |" in text for cell in ("100", "100 / 1"))
    assert "| ssim | warpgs | forward |  | 14.4 |  | 1.00 |" in text
    assert "| 100,000 | 504 x 378 | gsplat | 200 | 100 | 2 |" in text
    assert "predicted 9 s: 1 of render both (gsplat)" in text and "naive: not there" in text
    svgs = {path: svg for path, svg in files.items() if path.endswith(".svg")}
    assert {"plots/a_pixels.svg", "plots/a_whole.svg", "plots/b_whole.svg"} <= set(svgs)
    for path, svg in svgs.items():
        assert ElementTree.fromstring(svg).tag.endswith("svg") and path.removeprefix("plots/") in text


def test_the_document_is_that_of_the_committed_results():
    """docs/performance.md and its charts are what `python -m bench.document` writes, and nothing else lies there."""
    files = performance_page.files(result_file.stored("ops"))
    docs = result_file.ROOT / "docs"
    for path, text in files.items():
        assert (docs / path).read_text("utf-8") == text, f"{path} is stale: run python -m bench.document"
    assert {f"plots/{p.name}" for p in (docs / "plots").glob("*.svg")} == set(files) - {"performance.md"}


def test_the_other_pages_are_those_of_the_committed_results():
    """docs/measured.md and the tables of docs/accuracy.md are what `python -m bench.document` writes."""
    docs = result_file.ROOT / "docs"
    assert (docs / "measured.md").read_text("utf-8") == measured_page.page(), "stale: run python -m bench.document"
    page = (docs / "accuracy.md").read_text("utf-8")
    assert accuracy_page.filled(page) == page, "stale: run python -m bench.document"
