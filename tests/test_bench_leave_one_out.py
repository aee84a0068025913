"""Leaving out training views: what a trial's name means, which views are scored, what the table says."""

import pytest
import torch

from bench.experiments.leave_one_out import folds, table, trial_config
from bench.experiments.tradeoff_outcome import fit_once
from warpgs.errors import UsageError
from warpgs.pipeline.runs.folder import SceneRequest, read_scene
from warpgs.pipeline.train.config import PRESETS
from warpgs.synthetic.demo import write_demo


def test_a_trial_changes_what_it_names_and_nothing_else():
    assert trial_config("quick") == PRESETS["quick"]
    made = trial_config("quick:optimizer.scales_decay=0.5,init.source=flow,steps=7").to_json()
    base = PRESETS["quick"].to_json()
    assert (made["optimizer"]["scales_decay"], made["init"]["source"], made["steps"]) == (0.5, "flow", 7)
    base["optimizer"]["scales_decay"], base["init"]["source"], base["steps"] = 0.5, "flow", 7
    assert made == base


@pytest.mark.parametrize("bad", ["slow", "quick:steps", "quick:optimizer.speed=1", "quick:steps.x=1", "quick:steps=0"])
def test_a_trial_that_sets_nothing_is_refused(bad):
    with pytest.raises(UsageError):
        trial_config(bad)


def test_every_training_view_is_left_out_once_and_held_out_views_are_not_touched(tmp_path):
    spec = write_demo(tmp_path / "scene", views=8, width=48, height=36)
    train, test = (part.split("=")[1].split(",") for part in spec.split(";"))
    cut = folds(SceneRequest(str(tmp_path / "scene"), spec, 1))
    assert len(cut) == len(train) >= 3
    for name, split in cut:
        assert split.endswith(f"test={name}") and split.count(name) == 1
        assert not any(t in split for t in test)


def test_a_trial_is_fitted_as_its_settings_say(tmp_path):
    """An adaptive trial is judged and trimmed, and its bytes are counted by degree."""
    spec = write_demo(tmp_path / "scene", views=8, width=64, height=48)
    scene, _, _ = read_scene(SceneRequest(str(tmp_path / "scene"), spec, 1))
    plain, adaptive = (
        fit_once(scene, spec, trial_config(f"quick:steps=60,sh_every=10,adaptive={on}"), torch.device("cpu"))
        for on in ("false", "true")
    )
    assert (
        adaptive["gaussians"] < plain["gaussians"]
        and adaptive["bytes"] / adaptive["gaussians"] < plain["bytes"] / plain["gaussians"]
    )


def test_the_table_counts_whole_seeds_alone():
    row = {"scene": "s", "trial": "quick", "ssim": 0.5, "bytes": 4_000_000}
    rows = [row | {"left_out": v, "seed": 0, "psnr": p} for v, p in (("a", 20.0), ("b", 22.0))]
    rows += [row | {"left_out": v, "seed": 1, "psnr": p} for v, p in (("a", 21.0), ("b", 25.0))]
    rows += [row | {"left_out": "a", "seed": 2, "psnr": 90.0}]
    assert table(rows, ["quick", "paper"], 2)[2:] == [
        "| `quick` | 22.00 ± 1.41 (2) | 0.5000 | 21.00 | 4,000 |",
        "| `paper` |  |  |  |  |",
    ]
