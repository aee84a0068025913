"""Presets side by side: rows and what is left out of them, the worker processes, one fit, and the tables."""

import functools
import math
import sys
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch

from bench.lib import one_fit, pool, result_file
from bench.lib.gsplat_trainer import default_settings, strategy_of
from bench.lib.one_fit import Fit
from bench.lib.pool import finished
from bench.lib.preset_table import rival, sizes_table, tables
from bench.lib.scenes import ROWS, Row, folds, left_out, row_of, scene_at
from tests.test_bench_gsplat import gsplat  # noqa: F401
from warpgs.errors import UsageError
from warpgs.io.load import split_views
from warpgs.pipeline.train.presets import PRESETS
from warpgs.synthetic.demo import split_spec, write_demo


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> str:
    """Folder of a tiny scene."""
    folder = tmp_path_factory.mktemp("data") / "scene"
    write_demo(folder, views=8, width=40, height=32)
    return str(folder)


def test_rows_are_named_or_given():
    """A name, or a folder with its split and downscale; anything else is an error that lists them."""
    assert row_of("fern:3") is ROWS["fern:3"] and row_of("a/b@llff:3") == Row("a/b", "llff:3")
    assert row_of("a/b@every:8@2") == Row("a/b", "every:8", 2)
    for name in ("fern:4", "a@", "@llff:3", "a@all@0"):
        with pytest.raises(UsageError, match="fern:17"):
            row_of(name)


def test_training_views_are_left_out_and_held_out_ones_are_not_read(demo):
    """Up to four views one by one, of more some between the ends; what is scored is no held-out view."""
    assert left_out(("a", "b", "c"), 2) == [("a",), ("b",), ("c",)]
    assert left_out(tuple("abcdefghi"), 1) == [("e",)] and left_out(tuple("abcdefghi"), 3) == [("c", "e", "g")]
    with pytest.raises(UsageError, match="at least two"):
        left_out(("a", "b"), 1)
    scene, spec = scene_at(demo, 1), split_spec(8)
    whole = split_views(scene, spec)
    assert folds(scene, spec, 0) == [(spec, "")]
    ((part, names),) = folds(scene, spec, 2)
    cut = split_views(scene, part)
    assert set(cut.train) | set(cut.test) == set(whole.train) and ",".join(cut.test) == names and len(cut.test) == 2


def test_failures_are_results_and_no_task_begins_after_the_limit():
    """An exception and a dead worker each become the result of their task; the others go on."""
    assert list(finished(eval, ["{}"], 1, 0.0)) == []
    died, good = "__import__('os')._exit(1)", "{'square': 4}"
    found = dict(finished(eval, ["1 / 0", died, good], 1, math.inf))  # built in: workers import nothing
    assert found["1 / 0"]["error"].startswith("ZeroDivisionError") and found[good] == {"square": 4}
    assert "Broken" in found[died]["error"]


def test_an_error_before_the_first_task_is_not_lost():
    """Without compiled kernels, every worker would compile them again."""
    with pytest.raises(ZeroDivisionError):
        list(finished(eval, ["{}"], 1, math.inf, functools.partial(divmod, 1, 0)))


def test_a_fit_gives_a_row_and_the_peer_starts_from_the_same_points(demo, gsplat, monkeypatch):  # noqa: F811
    """Ours through the public fit; gsplat from our start, and from the points of the reconstruction; all scored alike."""

    class DefaultStrategy(sys.modules["gsplat"].MCMCStrategy):
        def initialize_state(self, scene_scale):
            assert scene_scale > 0
            return {}

        def step_post_backward(self, **values):
            super().step_post_backward(**values, lr=0.0)

    monkeypatch.setattr(sys.modules["gsplat"], "DefaultStrategy", DefaultStrategy, raising=False)
    counts = {}
    for preset in ("quick", *one_fit.PEERS):
        row = one_fit.measure(Fit("r", f"{preset}:steps=3", 1, demo, split_spec(8), "", 1, "cpu"))
        assert 3 < row["psnr"] < 40 and row["steps"] == 3 and row["bytes"] > 0 and row["setup"] > 0
        counts[preset] = row.get("points")
    seen = scene_at(demo, 1).points.seen_by(set(split_views(scene_at(demo, 1), split_spec(8)).train), least=2)
    assert counts[one_fit.PEER_POINTS] == len(seen) != counts[one_fit.PEER] > 0


def test_the_default_strategy_has_its_own_settings(gsplat, monkeypatch):  # noqa: F811
    """Refinement up to half of the steps, no regularizers, opacity 0.1; its state knows the size of the scene."""
    made = SimpleNamespace(
        DefaultStrategy=lambda **k: SimpleNamespace(told=k, initialize_state=lambda scene_scale: scene_scale)
    )
    monkeypatch.setitem(sys.modules, "gsplat", made)
    s = default_settings(7000)
    strategy, state = strategy_of(s, 2.5)
    assert strategy.told == {"refine_start_iter": 500, "refine_stop_iter": 3500, "refine_every": 100} and state == 2.5
    assert (s.init_opacity, s.init_scale, s.opacity_reg, s.scale_reg) == (0.1, 1.0, 0.0, 0.0)


def results(row: str, preset: str, scores: list[float], **more) -> list[dict]:
    """Rows of a preset, one for each seed."""
    rest = {"ssim": 0.5, "gaussians": 10, "bytes": 2000, "steps": 7, "setup": 1.0, "training": 2.0, "left_out": ""} | more
    return [{"row": row, "preset": preset, "seed": s, "psnr": p} | rest for s, p in enumerate(scores)]


def test_the_rival_is_picked_on_the_other_seeds():
    """One lucky seed makes a rival everywhere but on that seed."""
    scores = {"default": [20.0, 20.0, 20.0], "even": [20.1, 20.1, 20.1], "lucky": [19.0, 25.0, 19.0]}
    d, names = rival({k: dict(enumerate(v)) for k, v in scores.items()}, "default")
    assert sorted(names) == ["even", "lucky"]
    assert d.mean == pytest.approx(((20 - 19) + (20 - 20.1) + (20 - 19)) / 3) and d.count == 3
    shorter, _ = rival(
        {"default": {0: 20.0, 1: 20.0, 2: 20.0}, "weak": {0: 1.0, 1: 1.0, 2: 1.0}, "best": {0: 21.0, 1: 21.0}}, "default"
    )
    assert shorter.count == 2 and shorter.mean == pytest.approx(-1), "seeds that the best lacks are not compared"


def test_tables_say_worst_seed_times_and_failures():
    """The worst seed below the median, times beside other fits in brackets, views left out averaged, errors named."""
    rows = results("a", "default", [20.0, 20.2, 19.5], jobs=1) + results("a", "x", [20.1, 20.1, 20.1], jobs=6)
    rows += results("b", "x", [1.0], left_out="u") + results("b", "x", [3.0], left_out="v")
    rows += [{"row": "b", "preset": "default", "seed": 0, "error": "E: no"}]
    text = tables(rows, "default")
    assert "| a | `default` | 3 | 19.90 ± 0.36 | 0.5000 ± 0.0000 | 0.50 | 10 | 2 | 1.0 + 2.0 | 7 |" in text
    assert "| (1.0 + 2.0) | 7 |" in text and "| b | `x` | 1 | 2.00 |" in text
    assert "Worst row: a, -0.20 dB, beyond" in text and "- failed: b, `default`, seed 0: E: no" in text


@dataclass(frozen=True)
class Task:
    """A task as `measure_all` takes it."""

    seed: int

    @property
    def key(self) -> dict:
        """What tells its row from others."""
        return {"seed": self.seed}


def test_a_stopped_comparison_goes_on(tmp_path, monkeypatch, capsys):
    """Finished rows are kept, failed ones are tried again, and another commit is refused."""
    calls = []

    def ran(work, tasks, *_):
        calls.append([t.seed for t in tasks])
        return [(t, {"error": "E: no"} if len(calls) == 1 and t.seed else {"psnr": 20.0}) for t in tasks]

    monkeypatch.setattr(pool, "finished", ran)
    out = tmp_path / "p.json"
    a = SimpleNamespace(out=out, jobs=1, seconds=math.inf)
    for _ in range(2):
        rows = pool.measure_all(None, [Task(0), Task(1)], None, a, "w", torch.device("cpu"), lambda r: f"{r['psnr']:.1f}")
    assert calls == [[0, 1], [1]] and [r["psnr"] for r in rows] == [20.0, 20.0]
    assert "failed: E: no" in capsys.readouterr().out and pool.stored_rows(out) == rows
    result_file.write(out, result_file.read(out) | {"commit": "other"})
    with pytest.raises(UsageError, match="choose another --out"):
        pool.stored_rows(out)


def test_a_preset_changes_what_it_names_and_nothing_else():
    """Values by name in the preset's settings; what sets nothing is refused."""
    made = one_fit.config_of("quick:optimizer.scales_decay=0.5,init.source=flow,steps=7", 3).to_json()
    base = PRESETS["quick"].to_json() | {"seed": 3}
    base["optimizer"]["scales_decay"], base["init"]["source"], base["steps"] = 0.5, "flow", 7
    assert made == base and one_fit.config_of("pruned/quick") == PRESETS["quick"]
    for bad in ("slow", "quick:steps", "quick:optimizer.speed=1", "quick:steps.x=1", "quick:steps=0"):
        with pytest.raises(UsageError):
            one_fit.config_of(bad)


def test_sizes_are_paired_with_the_fixed_fit():
    """Half the bytes at 0.04 dB less is within the limits; SSIM that is not measured is left out."""
    rows = []
    for row in ("a", "b"):
        rows += results(row, "paper", [20.0, 21.0]) + results(row, "small", [19.96, 20.96], bytes=1000)
        rows += results(row, "pruned/paper", [19.9, 20.9], ssim=None)
    text = sizes_table(rows, "paper")
    assert "- small: 0.50 of the bytes, -0.0400 dB [-0.0400, -0.0400], +0.0000 SSIM" in text
    assert "- pruned/paper: 1.00 of the bytes, -0.1000 dB [-0.1000, -0.1000] over 2 scenes; beyond limits" in text
