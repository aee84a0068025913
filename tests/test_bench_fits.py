"""Benches of whole fits: presets, rivals, objects, meshes, and gsplat's trainer."""

import functools
import math
import sys
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from bench.lib import arm_fits, gsplat_trainer, one_fit, pool, result_file, score_times, surfaces
from bench.lib.arms import ABLATION, ARMS, LADDER, NETWORK, PAPERS, RIVALS, Arm, chosen_steps, steps_in
from bench.lib.backgrounds import ply_scores
from bench.lib.gsplat_trainer import default_settings, strategy_of
from bench.lib.one_fit import Fit, config_of, is_peer, peer_settings
from bench.lib.points import exponent
from bench.lib.pool import finished
from bench.lib.preset_table import rival, sizes_table, tables
from bench.lib.scenes import PHOTOGRAPHS, ROWS, Row, folds, left_out, photographs, row_of, scene_at
from tests import gaussians as sets
from tests.scenes import photos
from warpgs import RasterizeOptions, rasterize
from warpgs.errors import UsageError
from warpgs.io.load import split_views
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import mean_color
from warpgs.pipeline.train.settings import settings_by_views
from warpgs.scene import Camera, Gaussians, Mesh, Normalization, View
from warpgs.synthetic import raycast
from warpgs.synthetic.demo import camera_path, split_spec, still_life


@pytest.fixture
def fake_gsplat(monkeypatch):
    """A module in place of gsplat; it notes strategies, degrees, and the learning rate of the means at each step."""
    told = SimpleNamespace(strategies=[], degrees=[], lrs=[])

    class MCMCStrategy:
        def __init__(self, **settings):
            told.strategies.append(settings)
            told.lrs.clear()

        def check_sanity(self, params, optimizers):
            assert set(params) == set(optimizers) == {"means", "scales", "quats", "opacities", "sh0", "shN"}

        def initialize_state(self):
            return {}

        def step_pre_backward(self, params, optimizers, state, step, info):
            assert info == {"seen": step}

        def step_post_backward(self, params, optimizers, state, step, info, lr):
            assert all(p.grad is None for p in params.values()) and step == len(told.lrs)
            told.lrs.append(lr)

    def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree, packed):
        told.degrees.append(sh_degree)
        g = Gaussians(means, quats, scales.log(), opacities.logit(), colors)
        rgb = rasterize(g, Camera(viewmats, Ks, width, height), RasterizeOptions(rule="gsplat-1.5", sh_degree=sh_degree)).rgb
        return rgb, None, {"seen": len(told.lrs)}

    module = SimpleNamespace(MCMCStrategy=MCMCStrategy, rasterization=rasterization)
    monkeypatch.setitem(sys.modules, "gsplat", module)
    return told


def first(count: int) -> Gaussians:
    """Gaussians in front of the cameras of `photos`, of which only means and colours matter."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator) - 0.5
    return Gaussians(means, torch.zeros(count, 4), torch.zeros(count, 3), torch.zeros(count), torch.zeros(count, 1, 3))


def test_gsplat_is_trained_as_its_example_trainer_does(fake_gsplat):
    views = photos(3)
    s = gsplat_trainer.Settings(steps=12, cap=123, sh_every=4)
    params = gsplat_trainer.train(views, first(200), s, seed=1, scale=2.0, size=3.0)
    assert fake_gsplat.strategies == [
        {"cap_max": 123, "noise_lr": 5e5, "refine_start_iter": 500, "refine_stop_iter": 10, "refine_every": 100}
    ]
    assert fake_gsplat.degrees == [0] * 4 + [1] * 4 + [2] * 4
    wanted = [3.0 * 1.6e-4 * 0.01 ** ((k + 1) / 12) for k in range(12)]
    assert fake_gsplat.lrs == pytest.approx(wanted)
    again = gsplat_trainer.start(2 * first(200).means, torch.full((200, 3), 0.5), s)
    before, after = (
        np.mean([np.square(gsplat_trainer.image_of(p, v, 2.0) - v.image).mean() for v in views]) for p in (again, params)
    )
    assert after < before


def test_units_and_the_default_strategy_of_gsplat(fake_gsplat, monkeypatch):
    """Twice the unit with twice the world gives the same image; refinement ends half-way, without regularizers."""
    view, s = photos(1)[0], gsplat_trainer.Settings(steps=1, cap=1)
    torch.manual_seed(0)
    params = gsplat_trainer.start(first(100).means, torch.rand(100, 3), s)
    image = gsplat_trainer.image_of(params, view, 1.0)
    params["means"].data *= 2
    params["scales"].data += np.log(2)
    assert image.max() > 0.05 and np.abs(gsplat_trainer.image_of(params, view, 2.0) - image).max() < 1e-3
    # cameras on a circle of radius 4 in the files that look at the origin: there 4 is 1, whatever our unit
    cameras, n = [], Normalization(np.array([1.0, 2.0, 3.0]), 0.5)
    for angle in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        axis = -np.array([np.cos(angle), np.sin(angle), 0])
        right = np.array([-axis[1], axis[0], 0])
        rotation = np.stack([right, np.cross(axis, right), axis])
        center = 0.5 * (-4 * axis - n.offset)
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ center
        cameras.append(Camera(viewmat, np.eye(3), 4, 4))
    assert gsplat_trainer.own_scale(cameras, n) == pytest.approx(1 / (4 * 0.5))
    assert gsplat_trainer.scene_scale(cameras, 0.5) == pytest.approx(1.1 * 0.5 * 2)
    default = lambda **k: SimpleNamespace(told=k, initialize_state=lambda scene_scale: scene_scale)  # noqa: E731
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(DefaultStrategy=default))
    s = default_settings(7000)
    strategy, state = strategy_of(s, 2.5)
    told = {"refine_start_iter": 500, "refine_stop_iter": 3500, "refine_every": 100, "reset_every": 3000}
    assert strategy.told == told
    assert state == 2.5
    assert (s.init_opacity, s.init_scale, s.opacity_reg, s.scale_reg) == (0.1, 1.0, 0.0, 0.0)


# Presets side by side: rows and their left-out views, the worker processes, one fit, and the tables.


def test_rows_are_named_or_given(tmp_path):
    assert row_of("fern:3") is ROWS["fern:3"] and row_of("a/b@llff:3") == Row("a/b", "llff:3")
    assert row_of("a/b@every:8@2") == Row("a/b", "every:8", 2)
    for name in ("fern:4", "a@", "@llff:3", "a@all@0"):
        with pytest.raises(UsageError, match="fern:17"):
            row_of(name)
    # without cameras: photographs evenly spaced, the first and the last among them, in a new folder at each call
    folder, count, flags = PHOTOGRAPHS["fern:3:film"]
    source = tmp_path / folder
    source.mkdir(parents=True)
    for n in range(20):
        (source / f"{n:02d}.png").write_bytes(b"")
    one, other = (photographs(source, count, tmp_path) for _ in range(2))
    assert sorted(p.name for p in one.iterdir()) == ["00.png", "09.png", "19.png"] and one != other and flags == ""
    assert (one.name, one.parent.parent) == ("fern", tmp_path)


def test_training_views_are_left_out_and_held_out_ones_are_not_read(demo):
    """Up to four views one by one, of more some between the ends; scored views are not held-out views."""
    assert left_out(("a", "b", "c"), 2) == [("a",), ("b",), ("c",)]
    assert left_out(tuple("abcdefghi"), 1) == [("e",)] and left_out(tuple("abcdefghi"), 3) == [("c", "e", "g")]
    with pytest.raises(UsageError, match="at least two"):
        left_out(("a", "b"), 1)
    scene, spec = scene_at(str(demo), 1), split_spec(8)
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
    # without compiled kernels, every worker would compile them again
    with pytest.raises(ZeroDivisionError):
        list(finished(eval, ["{}"], 1, math.inf, functools.partial(divmod, 1, 0)))


def test_a_fit_gives_a_row_and_the_peer_starts_from_the_same_points(demo, fake_gsplat, monkeypatch):
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
        row = one_fit.measure(Fit("r", f"{preset}:steps=3", 1, str(demo), split_spec(8), "", 1, "cpu"))
        assert 3 < row["psnr"] < 40 and row["steps"] == 3 and row["bytes"] > 0 and row["setup"] > 0
        counts[preset] = row.get("points")
    seen = scene_at(str(demo), 1).points.seen_by(set(split_views(scene_at(str(demo), 1), split_spec(8)).train), least=2)
    assert counts[one_fit.PEER_POINTS] == len(seen) != counts[one_fit.PEER] > 0


def results(row: str, preset: str, scores: list[float], **more) -> list[dict]:
    rest = {"ssim": 0.5, "gaussians": 10, "bytes": 2000, "steps": 7, "setup": 1.0, "training": 2.0, "left_out": ""} | more
    return [{"row": row, "preset": preset, "seed": s, "psnr": p} | rest for s, p in enumerate(scores)]


def test_rivals_and_tables_of_presets():
    """Tables have the worst seed below the median, times beside other fits in brackets, failures by name, sizes in pairs."""
    scores = {"default": [20.0, 20.0, 20.0], "even": [20.1, 20.1, 20.1], "lucky": [19.0, 25.0, 19.0]}
    d, names = rival({k: dict(enumerate(v)) for k, v in scores.items()}, "default")
    assert sorted(names) == ["even", "lucky"]
    assert d.mean == pytest.approx(((20 - 19) + (20 - 20.1) + (20 - 19)) / 3) and len(d.values) == 3
    weak = {"default": dict.fromkeys(range(3), 20.0), "weak": dict.fromkeys(range(3), 1.0), "best": {0: 21.0, 1: 21.0}}
    shorter, _ = rival(weak, "default")
    assert len(shorter.values) == 2 and shorter.mean == pytest.approx(-1), "seeds that the best lacks are not compared"
    rows = results("a", "default", [20.0, 20.2, 19.5], jobs=1) + results("a", "x", [20.1, 20.1, 20.1], jobs=6)
    rows += results("b", "x", [1.0], left_out="u") + results("b", "x", [3.0], left_out="v")
    rows += [{"row": "b", "preset": "default", "seed": 0, "error": "E: no"}]
    text = tables(rows, "default")
    assert "| a | `default` | 3 | 19.90 ± 0.36 | 0.5000 ± 0.0000 | 0.50 | 10 | 2 | 1.0 + 2.0 | 7 |" in text
    assert "| (1.0 + 2.0) | 7 |" in text and "| b | `x` | 1 | 2.00 |" in text
    assert "Worst row: a, -0.20 dB, beyond" in text and "- failed: b, `default`, seed 0: E: no" in text
    rows = []
    for row in ("a", "b"):
        rows += results(row, "paper", [20.0, 21.0]) + results(row, "small", [19.96, 20.96], bytes=1000)
        rows += results(row, "pruned/paper", [19.9, 20.9], ssim=None)
    text = sizes_table(rows, "paper")
    assert "- small: 0.50 of the bytes, -0.0400 dB [-0.0400, -0.0400], +0.0000 SSIM" in text
    assert "- pruned/paper: 1.00 of the bytes, -0.1000 dB [-0.1000, -0.1000] over 2 scenes; beyond limits" in text


@dataclass(frozen=True)
class Task:
    """A task as `measure_all` takes it."""

    seed: int

    @property
    def key(self) -> dict:
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
    made = one_fit.config_of("quick:optimizer.scales-decay=0.5,init.source=flow,steps=7", 3).to_json()
    base = PRESETS["quick"].to_json() | {"seed": 3}
    base["optimizer"]["scales_decay"], base["init"]["source"], base["steps"] = 0.5, "flow", 7
    assert made == base and one_fit.config_of("pruned/quick") == PRESETS["quick"]
    for bad in ("slow", "quick:steps", "quick:optimizer.speed=1", "quick:steps.x=1", "quick:steps=0"):
        with pytest.raises(UsageError):
            one_fit.config_of(bad)


# Rivals under one rule: their steps are chosen on training views left out, and all share start, background and degree.


@pytest.mark.usefixtures("registries_as_they_were")
@pytest.mark.parametrize("views", [3, 6])
def test_all_arms_share_start_background_and_degree(views):
    """Those of `default`, for any number of views; the ladder's first arm starts at random, NexusGS from flow."""
    train = photos(views)
    default = settings_by_views(config_of("default"), train, "cpu")[0]
    for arm in (*RIVALS, *(a for a in PAPERS if "paper-literal" not in a.preset), *LADDER, *ABLATION):
        if is_peer(arm.preset):
            peer = peer_settings(arm.preset, train)
            assert (peer.sh_degree, peer.background) == (default.sh_degree, mean_color(train)), arm.words
            continue
        own = settings_by_views(config_of(arm.preset), train, "cpu")[0]
        assert (own.sh_degree, own.background) == (default.sh_degree, "auto"), arm.words
        start = (own.init.merge_px, own.init.fill_px, own.init.opacity, own.init.scale_factor)
        same = start == (8, 32, default.init.opacity, default.init.scale_factor) and own.init.source in ("auto", "sweep")
        assert same != (arm is LADDER[0] or arm.words == "NexusGS"), arm.words


def test_first_seeds_come_before_further_ones_and_long_fits_last(monkeypatch, tmp_path):
    monkeypatch.delenv(NETWORK, raising=False)
    monkeypatch.setattr(arm_fits, "find_spec", lambda name: None)
    monkeypatch.setattr(arm_fits, "plan", lambda row, preset, seed, folder, place, count, device: [
        Fit(row, preset, seed, folder, "s", "a.png" if count else "", 1, device)
    ])  # fmt: skip
    a, rows = SimpleNamespace(set="papers", arms=99, seeds=3, folds=1), {"fern:3": ROWS["fern:3"]}
    study = arm_fits.ArmFits(a, rows, {"fern:3": "f"}, torch.device("cpu"))
    words = [arm.words for arm in study.arms]
    assert "`paper-literal`" in words and not any("network" in w or "gsplat" in w for w in words)
    assert [(f.preset, f.seed) for f in study.scored([], False)] == [(arm.preset, 0) for arm in (*PAPERS[:2], PAPERS[-2])]
    tuning = study.tuning()
    assert len(tuning) == sum(len(arm.steps) for arm in study.arms) and all(f.seed == 0 and f.left_out for f in tuning)
    done = [t.key | {"psnr": 20.0 + i} for i, t in enumerate(tuning)]
    fits = study.scored(done, True)
    others = len(words) - 1
    assert [f.seed for f in fits] == [0] * (others + 1) + [1] * others + [2] * others + [1, 2]
    assert [f.preset for f in fits[-2:]] == ["paper-literal"] * 2
    monkeypatch.setenv(NETWORK, str(tmp_path / "n.onnx"))
    arm = PAPERS[-1]
    assert not arm_fits.missing(arm) and "$" in arm.preset and str(tmp_path) not in arm.preset
    assert config_of(arm.preset).priors.segmentation_model == str(tmp_path / "n.onnx") and steps_in(arm.preset) == 30_000


@pytest.mark.usefixtures("registries_as_they_were")
def test_arms_name_their_steps_and_settings_and_steps_are_chosen_on_views_left_out():
    for arm in (a for arms in ARMS.values() for a in arms if a.steps):
        assert len(arm.steps) > 1 and arm.steps == tuple(sorted(arm.steps))
        for steps in arm.steps:
            preset = arm.with_steps(steps)
            found = peer_settings(preset, photos(3)) if is_peer(preset) else config_of(preset)
            assert found.steps == steps
    own = "3dgs:strategy=examples/05_own_strategy.py:Sprout,sprout.growth="
    assert config_of(f"{own}0.5").strategy_config.growth == 0.5
    assert config_of(f"{own}0.5,steps=7,sprout.every=3").strategy_config.every == 3
    for bad in (f"{own}0.5,sprout.speed=1", "3dgs:sprout.growth=0.5"):
        with pytest.raises(UsageError, match="sets nothing"):
            config_of(bad)
    arm = Arm("a", "3dgs:sh_degree=0", (10, 20, 30))

    def row(steps: int, out: str, psnr: float) -> dict:
        return {"row": "r", "preset": f"3dgs:sh_degree=0,steps={steps}", "seed": 0, "left_out": out, "psnr": psnr}

    rows = [row(10, "x", 20.0), row(10, "y", 22.0), row(20, "x", 21.5), row(20, "y", 21.0), row(30, "x", 99.0)]
    rows += [row(10, "", 99.0), row(10, "z", 99.0) | {"error": "died"}, row(10, "x", 99.0) | {"row": "other"}]
    assert chosen_steps(rows, "r", arm) == 20
    with pytest.raises(UsageError, match="a: no number of steps was tried"):
        chosen_steps(rows, "r", Arm("a", "mcmc", (10, 20)))


# Objects with true alpha in the bench are scored right before other backgrounds.


def test_a_ply_is_right_before_every_background_where_the_truth_is_rendered_by_itself():
    """What the Gaussians themselves look like over a colour is no error before any background; another opacity is one."""
    ours, camera, gray = sets.cloud(40), sets.camera(dtype=torch.float32), (0.5, 0.25, 0.75)
    r = rasterize(ours, camera, RasterizeOptions(background=torch.tensor(gray)))
    view = View("a", camera, r.rgb.clamp(0, 1).numpy(), alpha=r.alpha.numpy())
    assert 0.02 < view.alpha.mean() < 0.98
    right = ply_scores(ours, [view], gray)
    assert set(right) == {"ply_black", "ply_white", "ply_pattern"} and min(right.values()) > 45
    denser = View("a", camera, view.image, alpha=np.sqrt(view.alpha))
    wrong = ply_scores(ours, [denser], gray)
    assert max(wrong.values()) < 35


# The errors of meshes are measured right: distances to shapes, to triangles, and what is made of them.

SQUARE = Mesh(
    np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]]),
    np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    np.zeros((4, 3), np.float32),
)


def test_distances_to_the_shapes_that_rays_hit():
    """Points that rays hit lie on a surface; moved along its normal they lie that far from their shape, also inside of it."""
    shapes, camera = still_life(), camera_path(8, 64, 48)[3]
    points = surfaces.true_points(shapes, [camera])
    assert len(points) == 64 * 48 and np.min([surfaces.distance_to(s, points) for s in shapes], axis=0).max() < 1e-4
    rays = raycast.pixel_rays(camera.K, camera.viewmat, np.random.default_rng(0).uniform(0, 48, (500, 2)))
    t, index = raycast.cast(shapes, camera.center, rays)
    for i, shape in enumerate(shapes):
        x = camera.center + (t[:, None] * rays)[index == i]
        normals = shape.normal(shape.local(x)) @ shape.rotation.T
        for step in (0.02, -0.02):
            found = surfaces.distance_to(shape, x + step * normals)
            assert (found <= 0.02 + 1e-6).all() and (not len(x) or np.median(found) == pytest.approx(0.02, abs=1e-6))


def test_samples_and_distances_of_triangles():
    """Samples lie on the triangles, evenly; distances are to the nearest point of them, not to a vertex."""
    found = surfaces.sample(SQUARE, 4000)
    assert (found[:, 2] == 0).all() and np.allclose(found.mean(0), [1, 0.5, 0], atol=0.05)
    assert np.allclose(surfaces.distance_to_mesh(SQUARE, np.array([[1.0, 0.5, 3], [4, 0.5, 0], [1, 0.2, 0]])), [3, 2, 0])
    row = surfaces.summary("x", np.array([0.0, 0.01, 0.02, 0.97]), 1.0)
    assert row["x_mean"] == row["x_mean_of_radius"] == 0.25
    assert (row["x_median"], row["x_within_0.01_of_radius"]) == (0.015, 0.5)
    wall = raycast.Plane((0, 0, 3.0), still_life()[0].texture)
    camera = Camera(np.eye(4), np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), 32, 24)
    assert np.allclose(surfaces.true_depth([wall], camera), 3) and surfaces.true_depth([wall], camera).shape == (24, 32)


# PSNR against time: rivals in proportion to their whole schedules, stopped clocks, and the times at which scores are reached.


def test_a_short_schedule_is_the_whole_one_in_proportion():
    """As gsplat's trainer scales it; never below a step."""
    names = ("sh_every", "refine_start", "refine_every", "reset_every", "last_refinement")
    for strategy, steps, wanted in (
        ("default", 7500, (250, 125, 25, 750, 3750)), ("mcmc", 7500, (250, 125, 25, 750, 6250)), ("mcmc", 60, (2, 1, 1, 6, 50)),
    ):  # fmt: skip
        s = gsplat_trainer.scaled_settings(strategy, steps, 9)
        assert tuple(getattr(s, n) for n in names) == wanted and s.steps == steps
        assert s.strategy == strategy and s.cap == (9 if strategy == "mcmc" else 0)


def test_a_rival_is_scored_on_the_way_and_its_clock_stands_still(demo, fake_gsplat, monkeypatch, tmp_path):
    fit, points = Fit("r", "gsplat", 1, demo, split_spec(8), "", 1, "cpu"), tmp_path / "p.npz"
    made = score_times.write_points(fit, points)
    honest, clock = score_times.scores, SimpleNamespace(now=100.0)

    def slow(*of) -> dict:
        clock.now += 1000.0
        return honest(*of)

    def monotonic() -> float:
        clock.now += 1.0
        return clock.now

    monkeypatch.setattr(score_times, "scores", slow)
    monkeypatch.setattr(score_times.time, "monotonic", monotonic)
    row = score_times.rival(fit, "gsplat MCMC", 8, 50, points, 100.0, (0.25, 0.5))
    assert row["gaussians"] == made["points"] > 0 and [at["step"] for at in row["curve"]] == [2, 4]
    times = [row["setup"], *(at["seconds"] for at in row["curve"]), row["seconds"]]
    assert times == sorted(times) and times[-1] < 20, "scores took 2000 s"
    assert 3 < row["curve"][0]["psnr"] < row["psnr"] < 40


def test_growth_is_the_slope_of_logarithms():
    """Of a power it is the power; of two powers it lies between."""
    assert exponent([(n, 3 * n**1.5) for n in (10, 100, 1000)]) == pytest.approx(1.5)
    assert 1 < exponent([(n, n + n**2 / 100) for n in (1, 10, 100, 1000)]) < 2
