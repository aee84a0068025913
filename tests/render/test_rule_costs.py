"""Settings that are chosen for the user: by error, by time, and one clear message where neither can be kept."""

import dataclasses
import json
import math
import re

import pytest
import torch

from tests.scenes import photos
from warpgs import select_rule
from warpgs.app.cli import main
from warpgs.constants import RULES
from warpgs.errors import UsageError
from warpgs.pipeline.train import time_budget
from warpgs.pipeline.train.by_views import steps_by_views
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.time_budget import MIN_STEPS, within_budget
from warpgs.render.rule_costs import RULE_COSTS
from warpgs.synthetic.demo import split_spec, write_demo

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "scene"
    write_demo(folder, views=9, width=64, height=48)
    return folder


def test_the_fastest_rule_within_the_error():
    """At each cost's own error its rule is chosen, just below it the next one; every rule named exists."""
    assert [p.rule for p in RULE_COSTS][-1] == "exact"
    errors, times = [p.mean_error for p in RULE_COSTS], [p.time for p in RULE_COSTS]
    assert errors == sorted(errors, reverse=True) and times == sorted(times)
    for cost, slower in zip(RULE_COSTS, [*RULE_COSTS[1:], None]):
        assert cost.rule in RULES
        rule, why = select_rule(max_error=cost.mean_error)
        assert rule == cost.rule and cost.rule in why and "exact" in why
        if slower:
            assert select_rule(max_error=0.99 * cost.mean_error)[0] == slower.rule


@pytest.mark.parametrize("error", [0.0, -1.0, float("nan"), float("inf")])
def test_an_error_that_is_none(error):
    with pytest.raises(UsageError, match="positive number"):
        select_rule(max_error=error)


def test_an_error_below_float32():
    with pytest.raises(UsageError, match="float32 itself"):
        select_rule(max_error=1e-9)


def test_more_time_more_steps(monkeypatch):
    """By the costs of a probe of 10 ms, the predicted time keeps the budget, and one step more would not."""
    monkeypatch.setattr(time_budget, "probe_seconds", lambda *_: 0.01)
    views, config = photos(3), FitConfig(seed=7, rule="fast")
    setup, step = 0.01 * time_budget.SETUP * 3, 0.01 * time_budget.STEP
    for seconds in (setup + 150 * step, setup + 777.5 * step):
        chosen, why = within_budget(config, seconds, views, CPU)
        assert setup + chosen.steps * step <= seconds < setup + (chosen.steps + 1) * step + 1e-9
        assert f"--steps {chosen.steps}" in why and dataclasses.replace(chosen, steps=config.steps) == config
    for count in (3, 20):
        most, why = within_budget(config, 1e9, photos(count), CPU)
        assert most.steps == steps_by_views(count) and why.count(f"{count} views need no more") == 1
    with pytest.raises(UsageError, match=f"too short: {MIN_STEPS} steps"):
        within_budget(config, setup + (MIN_STEPS - 1) * step, views, CPU)


def test_the_probe_measures(device):
    """A positive time; how long is the machine's affair."""
    assert 0 < time_budget.probe_seconds(32, 24, device) < math.inf


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--time-budget", "-3"], "positive number of seconds"),
        (["--time-budget", "0.001"], "too short"), (["--max-error", "0"], "positive number"),
        (["--max-error", "1e-3", "--time-budget", "9"], "give one of them"),
        (["--max-error", "1e-3", "--rule", "exact"], "leave out --rule"),
        (["--time-budget", "9", "--steps", "9"], "leave out --steps"),
    ],
)  # fmt: skip
def test_flags_that_exclude_each_other(scene, tmp_path, capsys, flags, words):
    """Exit code 2, one line, no folder left."""
    out = tmp_path / "run"
    assert main(["fit", str(scene), "--split", split_spec(9), "--out", str(out), "--device", "cpu", *flags]) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1 and not out.exists()


def test_what_was_chosen_is_said_and_stored(scene, tmp_path, capsys):
    """A rule by error: in the run's configuration, among its notes, and priced on its own views."""
    out = tmp_path / "run"
    flags = ["--steps", "12", "--max-error", "0.5", "--out", str(out), "--device", "cpu", "--init.source", "random"]
    assert main(["fit", str(scene), "--split", split_spec(9), *flags]) == 0
    printed = capsys.readouterr().out
    config, metrics = json.loads((out / "config.json").read_text()), json.loads((out / "metrics.json").read_text())
    assert config["config"]["rule"] == metrics["rule"]["rule"] == RULE_COSTS[0].rule
    assert f"chose rule {RULE_COSTS[0].rule}" in printed
    assert metrics["rule"]["summary"] in (out / "report.html").read_text("utf-8")
    assert re.search(r"a view took [\d.]+ ms instead of", metrics["rule"]["summary"])
