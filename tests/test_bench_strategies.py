"""gsplat's strategies on two rasterizers: the loop drives ours behind the adapter of the example, and the table pairs seeds."""

import sys
from types import SimpleNamespace

import pytest

from bench.lib import strategy_runs
from tests.test_examples import StandIn
from warpgs.synthetic.demo import split_spec, write_demo


@pytest.fixture
def scene(tmp_path):
    """A small scene of nine views."""
    write_demo(tmp_path / "scene", views=9, width=48, height=36)
    return str(tmp_path / "scene")


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_the_loop_trains_on_our_rasterizer(scene, strategy, monkeypatch):
    """More steps give a better score, and the strategy adds Gaussians by the gradients that the adapter hands it."""
    classes = dict.fromkeys(("DefaultStrategy", "MCMCStrategy"), StandIn)
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(**classes))
    found = []
    for steps in (2, 30):
        task = strategy_runs.Task(scene, 1, split_spec(9), strategy, "gsplat-1.6", 0, steps, "cpu")
        found.append(strategy_runs.measure(task))
    assert found[1]["psnr"] > found[0]["psnr"] + 0.5 and found[1]["gaussians"] > found[1]["points"]


def test_the_table_pairs_seeds():
    """Differences are taken seed by seed; gsplat's row comes first and has none."""
    rows = [
        {"split": "a", "strategy": "default", "rasterizer": r, "seed": s, "psnr": p, "ssim": 0.5, "gaussians": 9, "seconds": 1}
        for r, s, p in [("exact", 0, 20.5), ("gsplat", 0, 20.0), ("exact", 1, 22.0), ("gsplat", 1, 22.0)]
    ]
    lines = strategy_runs.table(rows).splitlines()[2:]
    assert "| gsplat | 2 | 21.00 ± 1.41 |  |" in lines[0] and "| exact | 2 | 21.25 ± 1.06 | +0.25 ± 0.35 |" in lines[1]
