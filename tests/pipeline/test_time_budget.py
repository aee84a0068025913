"""The number of steps that fits into a time, and one clear message where none does."""

import dataclasses
import math

import pytest
import torch

from tests.scenes import photos
from warpgs.app.cli import main
from warpgs.errors import UsageError
from warpgs.pipeline.train import settings
from warpgs.pipeline.train.settings import MIN_TIMED_STEPS, FitConfig, steps_by_views, within_budget
from warpgs.synthetic.demo import split_spec, write_demo

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "scene"
    write_demo(folder, views=9, width=64, height=48)
    return folder


def test_more_time_more_steps(monkeypatch):
    """By the costs of a probe of 10 ms, the predicted time keeps the budget, and one step more would not."""
    monkeypatch.setattr(settings, "probe_seconds", lambda *_: 0.01)
    views, config = photos(3), FitConfig(seed=7, rule="fast")
    setup, step = 0.01 * settings.SETUP * 3, 0.01 * settings.STEP
    for seconds in (setup + 150 * step, setup + 777.5 * step):
        chosen, why = within_budget(config, seconds, views, CPU)
        assert setup + chosen.steps * step <= seconds < setup + (chosen.steps + 1) * step + 1e-9
        assert f"--steps {chosen.steps}" in why and dataclasses.replace(chosen, steps=config.steps) == config
    for count in (3, 20):
        most, why = within_budget(config, 1e9, photos(count), CPU)
        assert most.steps == steps_by_views(count) and why.count(f"{count} views need no more") == 1
    with pytest.raises(UsageError, match=f"too short: {MIN_TIMED_STEPS} steps"):
        within_budget(config, setup + (MIN_TIMED_STEPS - 1) * step, views, CPU)


def test_the_probe_measures(device):
    """A positive time; how long is the machine's affair."""
    assert 0 < settings.probe_seconds(32, 24, device) < math.inf


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--time-budget", "-3"], "positive number of seconds"),
        (["--time-budget", "0.001"], "too short"),
        (["--time-budget", "9", "--steps", "9"], "leave out --steps"),
    ],
)  # fmt: skip
def test_flags_that_exclude_each_other(scene, tmp_path, capsys, flags, words):
    """Exit code 2, one line, no folder left."""
    out = tmp_path / "run"
    assert main(["fit", str(scene), "--split", split_spec(9), "--out", str(out), "--device", "cpu", *flags]) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1 and not out.exists()
