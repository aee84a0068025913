"""Rivals under one rule: their steps are chosen on training views left out, and all share start, background and degree."""

import math

import pytest

from bench.lib.arms import ABLATION, ARMS, LADDER, RIVALS, Arm, chosen_steps
from bench.lib.one_fit import config_of, is_peer, peer_settings
from bench.lib.rivals_page import arms_table, other_steps_table
from tests.scenes import photos
from tests.test_bench_presets import results
from warpgs.errors import UsageError
from warpgs.pipeline.train.schedule import mean_color
from warpgs.pipeline.train.settings import settings_by_views
from warpgs.pipeline.train.strategies.base import STRATEGIES


@pytest.fixture(autouse=True)
def registry_as_it_was(monkeypatch):
    """What a test registers is gone after it."""
    STRATEGIES.names()
    monkeypatch.setattr(STRATEGIES, "_classes", dict(STRATEGIES._classes))


@pytest.mark.parametrize("views", [3, 6])
def test_all_arms_share_start_background_and_degree(views):
    """Those of `default`, for any number of views; only the ladder's first arm starts at random."""
    train = photos(views)
    default = settings_by_views(config_of("default"), train, "cpu")[0]
    for arm in (*RIVALS, *LADDER, *ABLATION):
        if is_peer(arm.preset):
            peer = peer_settings(arm.preset, train)
            assert (peer.sh_degree, peer.background) == (default.sh_degree, mean_color(train)), arm.words
            continue
        own = settings_by_views(config_of(arm.preset), train, "cpu")[0]
        assert (own.sh_degree, own.background) == (default.sh_degree, "auto"), arm.words
        start = (own.init.merge_px, own.init.fill_px, own.init.opacity, own.init.scale_factor)
        same = start == (8, 32, default.init.opacity, default.init.scale_factor) and own.init.source in ("auto", "sweep")
        assert same != (arm is LADDER[0]), arm.words


def test_the_page_pairs_each_method_with_its_base():
    """Differences are paired by seed, to the first arm or to the one above; few seeds have no interval; cells may lack."""
    arms = (Arm("a", "default"), Arm("b", "3dgs", (10, 20)), Arm("c", "mcmc:steps=7"))
    rows = results("fern:3", "default", [20.0, 20.2, 20.1]) + results("fern:3", "3dgs:steps=20", [21.0, 21.4, 21.2])
    rows += results("fern:3", "mcmc:steps=7", [19.0, 19.2])
    rows += [{"row": "fern:3", "preset": f"3dgs:steps={n}", "seed": 0, "left_out": "x", "psnr": float(n)} for n in (10, 20)]
    table = arms_table(arms, rows, ["fern:3"], above=False).splitlines()
    assert table[0].startswith("| method | fern: steps | PSNR / SSIM | difference |")
    assert "| a | 4,500 | 20.10 / 0.500 |  |" in table
    low, high = (1.1 + sign * 0.1 / math.sqrt(3) * 6.2053 for sign in (-1, 1))  # Student's t, 97.5 % of two rows, two degrees
    assert f"| b | 20 | 21.20 / 0.500 | +1.10 [{low:+.2f}, {high:+.2f}] |" in table
    assert "| c | 7 | 19.10 / 0.500 (2 seeds) | -1.00 |" in table
    again = arms_table((*arms, Arm("d", "quick")), rows, ["fern:3"], above=True).splitlines()
    assert again[-2:] == ["| c | 7 | 19.10 / 0.500 (2 seeds) | -2.10 |", "| d |  |  |  |"]


def test_the_page_lists_scores_with_steps_that_were_not_chosen():
    """Those on held-out views alone, beside the first arm: the chosen number stands in the other table."""
    arms = (Arm("a", "default"), Arm("b", "3dgs", (10, 20)))
    rows = results("fern:3", "3dgs:steps=10", [21.0, 21.4]) + results("fern:3", "3dgs:steps=20", [20.0])
    rows += results("fern:3", "default", [22.0, 22.0, 25.0])
    rows += [{"row": "fern:3", "preset": f"3dgs:steps={n}", "seed": 0, "left_out": "x", "psnr": float(n)} for n in (10, 20)]
    assert other_steps_table(arms, rows, ["fern:3"]).splitlines()[2:] == ["| fern | b | 10 | 21.20 ± 0.28 (2 seeds) | -0.80 |"]


def test_every_arm_names_its_steps_once():
    """Numbers of steps are read from the preset itself."""
    for arm in (a for arms in ARMS.values() for a in arms if a.steps):
        assert len(arm.steps) > 1 and arm.steps == tuple(sorted(arm.steps))
        for steps in arm.steps:
            preset = arm.with_steps(steps)
            found = peer_settings(preset, photos(3)) if is_peer(preset) else config_of(preset)
            assert found.steps == steps


def test_an_arm_sets_what_a_strategy_of_ones_own_has():
    """By the names of its flags, after the strategy; a name that it lacks is refused."""
    own = "3dgs:strategy=examples/05_own_strategy.py:Sprout,sprout.growth="
    assert config_of(f"{own}0.5").strategy_config.growth == 0.5
    assert config_of(f"{own}0.5,steps=7,sprout.every=3").strategy_config.every == 3
    for bad in (f"{own}0.5,sprout.speed=1", "3dgs:sprout.growth=0.5"):
        with pytest.raises(UsageError, match="sets nothing"):
            config_of(bad)


def test_steps_are_chosen_on_views_left_out():
    """The best mean; a number that lacks a view, a test score and a failure count for nothing."""
    arm = Arm("a", "3dgs:sh_degree=0", (10, 20, 30))

    def row(steps: int, out: str, psnr: float) -> dict:
        return {"row": "r", "preset": f"3dgs:sh_degree=0,steps={steps}", "seed": 0, "left_out": out, "psnr": psnr}

    rows = [row(10, "x", 20.0), row(10, "y", 22.0), row(20, "x", 21.5), row(20, "y", 21.0), row(30, "x", 99.0)]
    rows += [row(10, "", 99.0), row(10, "z", 99.0) | {"error": "died"}, row(10, "x", 99.0) | {"row": "other"}]
    assert chosen_steps(rows, "r", arm) == 20
    with pytest.raises(UsageError, match="a: no number of steps was tried"):
        chosen_steps(rows, "r", Arm("a", "mcmc", (10, 20)))
