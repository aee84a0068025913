"""The fit that finds its own size, on scenes of which the size is known; and that it is repeatable, resumable and honest."""

import dataclasses
import json
import math

import pytest
import torch

from tests import textured_planes
from tests.scenes import photos, priors, seeds
from warpgs.app.cli import main
from warpgs.pipeline.model.init import InitConfig
from warpgs.pipeline.model.scale_limits import LimitConfig
from warpgs.pipeline.runs.checkpoint import load_checkpoint, save_checkpoint
from warpgs.pipeline.train.complexity import complexity_figures, complexity_summary
from warpgs.pipeline.train.config import PRESETS, FitConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.holdout import NEAR
from warpgs.pipeline.train.strategies.holdout_blocks import HoldoutConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.scene import PointCloud, View
from warpgs.synthetic.demo import split_spec, write_demo

CPU = torch.device("cpu")
GROWING = FitConfig(
    steps=60, sh_every=15, strategy="holdout", init=InitConfig(source="points", max_sh_degree=1),
    holdout=HoldoutConfig(levels=2, fraction=0.3, trim_db=0), density=DensityConfig(start=10, every=5, gradient=1e-5),
)  # fmt: skip


def advanced(config: FitConfig, steps: int) -> Trainer:
    fit = Trainer(photos(4), seeds(), config, CPU)
    while fit.step < steps:
        fit.advance()
    return fit


def finished(views: list[View], points: PointCloud | None = None, steps: int = 600, **holdout) -> Trainer:
    """A fit as its sizes below were measured, whose settings do not follow from the number of views."""
    quick = PRESETS["quick"]
    lrs = dataclasses.replace(quick.optimizer, scales_lr=0.1, opacities_lr=0.05)
    quick = dataclasses.replace(
        quick, holdout=HoldoutConfig(**holdout), half_resolution=0.0, optimizer=lrs, limits=LimitConfig(max_reach=0),
        init=dataclasses.replace(quick.init, max_sh_degree=1),
    )  # fmt: skip
    start = quick.init if points is None else dataclasses.replace(quick.init, source="points")
    fit = Trainer(
        views, points, dataclasses.replace(quick, steps=steps, strategy="holdout", init=start), CPU, priors=priors(views)
    )
    while fit.step < steps:
        fit.advance()
    return fit


def complexity(fit: Trainer) -> dict:
    return complexity_figures(fit)["complexity"]


def test_growth_is_judged_and_then_all_pixels_count():
    """Blocks are hidden up to the end of growth and from then on not; rows neither come nor go any more; the figures add up."""
    fit = advanced(GROWING, 14)
    hidden = sum(int((v.mask == 0).sum()) for v in fit.views)
    assert hidden == sum(len(b) * b.side**2 for b in fit.strategy.blocks) > 0 and fit.strategy.closed is None
    while fit.strategy.closed is None and fit.step < 60:
        fit.advance()
    assert 15 < fit.strategy.closed <= 30 == fit.strategy.marks[-1]
    assert all(v.mask is None for v in fit.views)
    count = len(fit.gaussians)
    told = list(fit.messages)
    while fit.step < 60:
        assert fit.advance()[0].count == count
    c = complexity(fit)
    assert c["count"] == count and c["trims"] == []
    assert c["marginal_db"] == c["levels"][-1]["gain"] == min(c["levels"][-1][k] for k in ("fall", "own"))
    assert c["why"] and c["why"] in told[-1] and c["why"] in complexity_summary({"complexity": c})
    json.dumps(c)


def with_trims(**holdout) -> FitConfig:
    return dataclasses.replace(GROWING, holdout=dataclasses.replace(GROWING.holdout, **({"trim_db": 0.1} | holdout)))


BY_ROW = ("params", "exp_avg", "exp_avg_sq", "columns")


def test_trimmed_within_the_loss_and_everything_by_row_stays_aligned():
    """Smaller after each trim, training in between, at the end no worse than allowed, and one row of everything for each."""
    fit = advanced(with_trims(enough_db=20.0, trims=2), 60)
    c, closed = complexity(fit), fit.strategy.closed
    first, last = c["trims"]
    assert [first["step"], last["step"]] == [closed + round((60 - closed) / 2), 60]
    assert first["before"] > first["after"] == last["before"] >= last["after"] == c["count"] == len(fit.gaussians)
    assert first["after"] < 0.9 * first["before"] and first["psnr"][0] > 20 > first["psnr"][1] >= 19.9
    assert last["psnr"][1] == pytest.approx(fit.strategy.view_psnr(fit.gaussians), abs=1e-9)
    assert last["psnr"][0] > first["psnr"][1] and last["psnr"][1] >= 19.9
    assert "trimmed at step 60" in fit.messages[-1]

    tensors, _ = fit.state()
    by_row = [n for n in tensors if n.split(".")[0] in BY_ROW]
    assert len(by_row) == 15 + 2 + 2 + 3 and all(len(tensors[n]) == c["count"] for n in by_row)
    degrees = fit.table.columns["max_degree"]
    assert tensors["params.sh"].shape[1] == 4 and bool((degrees.diff() >= 0).all())
    flat = degrees == 0
    assert bool(flat.any()) and not bool(fit.gaussians.sh[flat, 1:].any())
    assert bool((fit.gaussians.log_scales >= fit.table.columns["min_log_scale"][:, None] - 1e-6).all())
    assert all(bool(t.isfinite().all()) for n, t in tensors.items() if n.startswith(("params", "exp_avg")))


@pytest.mark.slow
def test_what_a_fit_is_better_than_enough_goes_for_size():
    """Far below enough there is one trim, within its loss; above it the loss counts from enough, and there are more."""
    (own,) = advanced(with_trims(), 60).strategy.trims
    assert own["step"] == 60 and own["psnr"][0] - 0.1 <= own["psnr"][1] < own["psnr"][0] < HoldoutConfig().enough_db
    enough = own["psnr"][0] - 0.5
    (less,) = advanced(with_trims(enough_db=enough, trims=1), 60).strategy.trims
    assert less["psnr"][0] == own["psnr"][0] and less["after"] < own["after"]
    assert enough - 0.1 <= less["psnr"][1] < own["psnr"][1]
    several = advanced(with_trims(enough_db=enough), 60).strategy.trims
    assert len(several) > 1 and all(t["psnr"][0] > enough - NEAR for t in several[:-1])
    assert several[-1]["step"] == 60 and several[-1]["psnr"][0] - several[-1]["psnr"][1] <= 0.1 + max(
        0, several[-1]["psnr"][0] - enough
    )


def test_a_trim_counts_on_half_of_what_training_recovered_of_the_one_before():
    """Except the last, after which nothing is. Before it less goes the farther a fit is below enough, and far below nothing."""
    fit = Trainer(photos(3), seeds(), with_trims(enough_db=30.0), CPU)
    strategy = fit.strategy
    budget = strategy.psnr_budget
    assert budget(30.0, 50) == pytest.approx(0.1) and budget(31.5, 50) == pytest.approx(0.1 + 1.5)
    assert budget(30.0 - NEAR / 2, 50) == pytest.approx(0.05) and budget(30.0 - NEAR, 50) == 0 == budget(math.nan, 50)
    strategy.trims = [{"psnr": [33.0, 31.0]}]
    assert budget(31.5, 50) == pytest.approx(0.1 + 1.5 + 0.25) and budget(30.5, 50) == pytest.approx(0.1 + 0.5)
    strategy.trims = [{"psnr": [29.0, 27.6]}]
    assert budget(28.0, 50) == pytest.approx(0.05 + 0.2)
    assert budget(31.5, 60) == pytest.approx(0.1 + 1.5) and budget(29.0, 60) == pytest.approx(0.1)


def test_of_a_trimmed_model_no_more_is_hidden_than_of_the_whole():
    """The number shown is that of the whole model with dropout, and all where fewer are left."""
    fit = Trainer(photos(3), seeds(), dataclasses.replace(GROWING, dropout=0.5), CPU)
    assert fit.strategy.dropout(60) == 0.5
    fit.strategy.trims = [{"before": 100, "after": 80}]
    assert fit.strategy.dropout(60) == pytest.approx(1 - 0.5 / 0.8)
    fit.strategy.trims.append({"before": 80, "after": 40})
    assert fit.strategy.dropout(60) == 0


SAVED = (17, 24, 50)
STOPPED = dataclasses.replace(GROWING, dropout=0.3, holdout=dataclasses.replace(GROWING.holdout, trim_db=0.2, enough_db=20.0))


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """A fit that was not interrupted, its checkpoints by step, and the number of trims at each."""
    fit, saved = Trainer(photos(4), seeds(), STOPPED, CPU), {}
    while fit.step < 60:
        fit.advance()
        if fit.step in SAVED:
            folder = tmp_path_factory.mktemp("saved")
            save_checkpoint(folder, *fit.state())
            saved[fit.step] = folder, len(fit.strategy.trims)
    return fit, saved


@pytest.mark.parametrize("at", [pytest.param(17, marks=pytest.mark.slow), 24, 50])
def test_continued_fit_equals_uninterrupted_one(straight, at):
    """Saved before blocks are measured, between two measurements, or between trims: the same bits and story at the end."""
    straight, saved = straight
    folder, trims = saved[at]
    assert 0 < trims < len(straight.strategy.trims) or at < 50
    resumed = Trainer(photos(4), seeds(), STOPPED, CPU)
    resumed.load(*load_checkpoint(folder))
    while resumed.step < 60:
        resumed.advance()
    (a, plain), (b, again) = straight.state(), resumed.state()
    assert a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)
    assert plain["strategy"] == again["strategy"] and plain["strategy"]["closed"] and plain["notes"] == again["notes"]


def test_without_evidence_it_is_the_plain_fit():
    """Too few blocks to tell anything: said so, and the same bits as without the strategy."""
    config = dataclasses.replace(GROWING, steps=20, holdout=HoldoutConfig(fraction=0.001))
    fit = Trainer(photos(1), seeds(), config, CPU)
    plain = Trainer(photos(1), seeds(), dataclasses.replace(config, strategy="clone_split"), CPU)
    for _ in range(20):
        fit.advance()
        plain.advance()
    assert any("nothing is held out" in n for n in fit.notes) and not complexity(fit)["holdout"]
    assert all(torch.equal(t, plain.gaussians.tensors()[n]) for n, t in fit.gaussians.tensors().items())


def test_what_one_view_alone_sees_stays_coarse():
    """With one view that sees anything, nothing is cloned or split, and no Gaussian has a degree above 0."""
    views = photos(3)
    away = [
        dataclasses.replace(v, camera=dataclasses.replace(v.camera, viewmat=v.camera.viewmat @ _turned())) for v in views[1:]
    ]
    fit = Trainer([views[0], *away], seeds(), GROWING, CPU)
    for _ in range(31):
        fit.advance()
    assert fit.strategy.closed and len(fit.gaussians) <= len(seeds())
    assert not bool(fit.gaussians.sh[:, 1:].any()) and not bool(fit.table.columns["max_degree"].any())


def _turned():
    import numpy as np

    turn = np.diag([-1.0, 1, -1, 1])  # half a turn about the vertical through the origin, and far away
    turn[2, 3] = -90.0
    return turn


@pytest.mark.parametrize(("width", "steps", "psnr"), [(32, 200, 30), (64, 600, 39)])
@pytest.mark.slow
def test_a_wall_of_one_colour_needs_next_to_nothing(width, steps, psnr):
    """With default flags a handful of Gaussians of degree 0 for a card of one colour that fills the views, seen as it is."""
    fit = finished(textured_planes.photos(textured_planes.plain, half=(9, 9), width=width, height=3 * width // 4), steps=steps)
    c = complexity(fit)
    assert c["count"] < 10 and c["mean_degree"] == 0 and fit.strategy.view_psnr(fit.gaussians) >= psnr


@pytest.mark.slow
def test_a_card_that_ends_before_black_needs_little():
    """Under 50 Gaussians of degree 0 at 26 dB: its border is sharp, Gaussians are not, and each decibel more takes more."""
    fit = finished(textured_planes.photos(textured_planes.plain, width=64, height=48), textured_planes.points(), enough_db=26.0)
    c = complexity(fit)
    assert c["count"] < 50 and c["mean_degree"] == 0 and fit.strategy.view_psnr(fit.gaussians) > 25.5


@pytest.mark.slow
def test_size_follows_content_and_neither_pixels_nor_views():
    """A smooth wall with default flags: a view a second time adds nothing, four times the pixels less than as much."""
    start = textured_planes.points(400, (2.0, 1.4))
    walls = [textured_planes.photos(textured_planes.smooth, half=(9, 9), width=w, height=3 * w // 4) for w in (64, 128)]
    again = [*walls[0], dataclasses.replace(walls[0][1], name="again.png")]
    fits = [finished(v, start) for v in (*walls, again)]
    once, fine, twice = (complexity(f)["count"] for f in fits)
    assert all(abs(f.strategy.view_psnr(f.gaussians) - HoldoutConfig().enough_db) < 0.6 for f in fits)
    # fine was 1.0 to 1.8 times once in six such fits, whose starts, or sums, differed by no more than rounding
    assert once < 80 and twice <= 1.1 * once and fine <= 2 * once


@pytest.mark.slow
def test_a_worse_picture_needs_less():
    """The same wall where 30 dB are enough: measured 11, 14 and 12."""
    start = textured_planes.points(400, (2.0, 1.4))
    walls = [textured_planes.photos(textured_planes.smooth, half=(9, 9), width=w, height=3 * w // 4) for w in (64, 128)]
    again = [*walls[0], dataclasses.replace(walls[0][1], name="again.png")]
    assert all(complexity(finished(v, start, enough_db=30.0))["count"] < 20 for v in (*walls, again))


@pytest.mark.slow
@pytest.mark.parametrize(("colour", "most"), [(textured_planes.waves, 200), (textured_planes.rings, 130)])
def test_walls_that_hardly_reach_enough_are_small_too(colour, most):
    """Two that chose no setting. Measured with default flags: 155, 175 and 141, or 123, 181 and 115 with other rounding; 91, 58
    and 62. Four times the pixels may need twice as many, as above.
    """
    walls = [textured_planes.photos(colour, half=(9, 9), width=w, height=3 * w // 4) for w in (64, 128)]
    again = [*walls[0], dataclasses.replace(walls[0][1], name="again.png")]
    fits = [finished(v, textured_planes.points(400, (2.0, 1.4))) for v in (*walls, again)]
    once, fine, twice = (complexity(f)["count"] for f in fits)
    assert once < most and twice <= 1.1 * once and fine <= 2 * once
    assert all(f.strategy.view_psnr(f.gaussians) > 35.5 for f in fits)


def test_command_line_says_what_the_model_takes(tmp_path, capsys):
    """A whole run with this strategy and --max-gaussians: terminal, metrics.json, report, and the file without unused bands."""
    write_demo(tmp_path / "scene", views=8, width=64, height=48)
    flags = ["--split", split_spec(8), "--steps", "60", "--device", "cpu", "--preset", "quick", "--strategy", "holdout"]
    assert main(["fit", str(tmp_path / "scene"), "--out", str(tmp_path / "run"), *flags, "--max-gaussians", "900"]) == 0
    words = capsys.readouterr().out
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    c = metrics["complexity"]
    assert c["holdout"] and c["cap"] == 900 and c["count"] == metrics["gaussians"] <= 900
    assert f"{c['count']:,} Gaussians, " in words
    page = (tmp_path / "run" / "report.html").read_text()
    assert "mean SH degree" in page and "growth ended at step" in page and "growth stopped because" in page
