"""Given depth means what its references say, is refused where it contradicts them, and comes before searched depth."""

import dataclasses
import functools

import numpy as np
import pytest

from tests.priors.rigs import exact_depth, still_life
from warpgs.errors import DataError
from warpgs.geometry import back_project
from warpgs.pipeline.model.start import InitConfig, initial_points
from warpgs.priors import given_depth
from warpgs.priors.given_depth import align, fit_line, lens_depth, pinhole_view, votes, with_given_depth
from warpgs.priors.sweep import sweep_depths
from warpgs.scene import GivenDepth, PointCloud, View, ViewDepth
from warpgs.synthetic import demo

NO_POINTS = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32))


@functools.cache
def swept():
    views, depths = still_life()
    return sweep_depths(views, [(0.5 * d.min(), 2 * d.max()) for d in depths])


def combined(views):
    return with_given_depth(views, swept(), NO_POINTS)


def given(view, values, kind="metric", confidence=None):
    return dataclasses.replace(view, depth=GivenDepth(np.asarray(values, np.float32), kind, confidence))


def error(found: ViewDepth, true: np.ndarray) -> np.ndarray:
    return np.abs(found.depth / true - 1)[found.valid]


@pytest.mark.parametrize("kind", ["relative", "disparity"])
def test_a_map_of_unknown_scale_and_shift_is_fitted(kind):
    """To searched depth, whose errors are larger than those of the fitted map; 0 stays no depth."""
    views, depths = still_life()
    true = depths[1]
    values = (true if kind == "relative" else 1 / true) * 7 + 3
    values[:5] = 0
    view = given(views[1], values, kind)
    made = align(view, swept()[1], NO_POINTS)
    found = made.depth(view.depth)
    assert not made.why_not and (found[:5] == 0).all()
    assert np.median(np.abs(found / true - 1)[5:]) < 0.5 * np.median(error(swept()[1], true))


def test_a_line_is_found_beside_outliers_and_points_fit_where_nothing_was_searched():
    """Scale and shift to 0.1 % with noise of 1 % and a fifth of the values wrong; constant values have no scale."""
    rng = np.random.default_rng(0)
    x = rng.uniform(0, 1, 2000)
    y = (3 * x + 0.7) * (1 + 0.01 * rng.standard_normal(2000))
    y[:400] = rng.uniform(0.5, 4, 400)
    scale, shift = fit_line(x, y)
    assert scale == pytest.approx(3, rel=2e-3) and shift == pytest.approx(0.7, abs=2e-3)
    assert fit_line(np.ones(60), y[:60])[0] == 0
    views, depths = still_life()
    at = np.random.default_rng(0).integers(0, (160, 120), (80, 2))
    points = back_project(views[0].camera, at + 0.5, depths[0][at[:, 1], at[:, 0]])
    cloud = PointCloud(points, np.zeros((80, 3), np.float32), (frozenset({views[0].name, views[1].name}),) * 80)
    view = given(views[0], 5 / depths[0] + 1, "disparity")
    made = align(view, None, cloud)
    assert np.abs(made.depth(view.depth) / depths[0] - 1).max() < 1e-3
    elsewhere = dataclasses.replace(cloud, tracks=(frozenset({"other"}),) * 80)
    assert "0 depths are known" in align(view, None, elsewhere).why_not
    assert "0 depths are known" in align(view, None, NO_POINTS).why_not


def test_maps_that_contradict_are_refused_with_figures():
    """Another unit, disparity called depth, and noise."""
    views, depths = still_life()
    cases = {
        "its depths are 99": given(views[0], 1000 * depths[0]),
        "its values change with depth in the wrong direction; are they disparity": given(views[0], 1 / depths[0], "relative"),
        "of its depths are within 10%": given(views[0], np.random.default_rng(0).uniform(1, 9, depths[0].shape), "relative"),
    }
    for reason, view in cases.items():
        assert reason in align(view, swept()[0], NO_POINTS).why_not
        with pytest.raises(DataError, match=rf"no depth map can be used: {view.name}: .*{reason}"):
            combined([view, *views[1:]])
    found, notes = combined([cases["its depths are 99"], given(views[1], depths[1]), views[2]])
    assert "used in 1 of 3 views" in notes[0] and f"1 maps are not used: {views[0].name}: its depths are 99" in notes[1]
    assert found[0] is swept()[0] and found[0].given is None and found[1].given is not None


def test_depth_that_other_views_look_through_is_left_out(monkeypatch):
    """A block before everything in one view; the other views see what lies behind it."""
    views, depths = still_life()
    wrong = depths[1].copy()
    wrong[40:60, 60:90] *= 0.5
    maps = [depths[0], wrong, depths[2]]
    found, notes = combined([given(v, d) for v, d in zip(views, maps)])
    assert (found[1].given[42:58, 62:88] > 0).mean() < 0.1 and "left out, because other views see through them" in notes[0]
    assert (found[1].given > 0).mean() > 0.9
    confirm, through = votes(views, [d.astype(np.float32) for d in maps], 1)
    assert through[50, 75] == 2 and confirm[50, 75] == 0 and confirm.max() == 2
    monkeypatch.setattr(given_depth, "MAX_POINTS", 3000)
    on_grid = votes(views, [d.astype(np.float32) for d in maps], 1)
    assert on_grid[0].shape == (120, 160) and (on_grid[0] == confirm).mean() > 0.9 and (on_grid[1] == through).mean() > 0.95


def test_a_fitted_map_that_is_not_exact_fills_gaps_and_replaces_outliers():
    """A bent one counts where a view confirms it and the search found nothing or something else, an exact one everywhere."""
    views, depths = still_life()
    bend = 1 + 0.04 * np.sin(np.linspace(0, 18, 160))
    bent = [given(v, 3 / (d * bend) + 1, "disparity") for v, d in zip(views, depths)]
    for d, before in zip(combined(bent)[0], swept()):
        changed = before.valid & (d.depth != before.depth)
        assert d.valid.mean() > before.valid.mean() + 0.05 and changed.mean() < 0.12
        assert np.abs(d.depth[changed] / before.depth[changed] - 1).min() > 0.04
    close = [given(v, 3 / d + 1, "disparity") for v, d in zip(views, depths)]
    for d, true in zip(combined(close)[0], depths):
        assert d.valid.mean() > 0.98 and np.median(error(d, true)) < 0.005


def test_metric_depth_comes_before_searched_depth_and_sparse_or_uncertain_depth_joins_it():
    views, depths = still_life()
    rng = np.random.default_rng(0)
    noisy = [d * (1 + 0.01 * rng.standard_normal(d.shape)) for d in depths]
    found, notes = combined([given(v, d) for v, d in zip(views, noisy)])
    for d, true, before in zip(found, depths, swept()):
        assert d.valid.mean() > 0.98 > before.valid.mean() and np.median(error(d, true)) < 0.008
        assert np.isfinite(d.sensitivity[d.valid]).all()
    assert "used in 3 of 3 views; median difference" in notes[0]
    sparse = [np.where(rng.random(d.shape) < 0.02, d, 0) for d in depths]
    found, _ = combined([given(v, d) for v, d in zip(views, sparse)])
    for d, s, before in zip(found, sparse, swept()):
        assert (d.valid >= before.valid).all() and np.allclose(d.depth[d.given > 0], s[d.given > 0], rtol=1e-6)
        assert (d.given > 0).sum() > 0.95 * (s > 0).sum()
    views, depths = still_life()
    confidence = np.where(np.arange(160) < 80, 0.4, 0.6).astype(np.float32)[None].repeat(120, 0)
    found, _ = with_given_depth([given(v, d, confidence=confidence) for v, d in zip(views, depths)], None, NO_POINTS)
    valid = found[1].valid
    assert not valid[:, :80].any() and valid[:, 80:].mean() > 0.9 and (found[1].given[:, :80] > 0).mean() > 0.9


def test_the_start_is_at_the_given_depth():
    """Also of a single view, which has no other to compare with; the same every time."""
    views, depths = still_life()
    mapped = [given(v, d) for v, d in zip(views, depths)]
    config = InitConfig(fill_px=0)
    start = initial_points(mapped, None, config, np.random.default_rng(0))
    assert "by given depth and sweep" in start.how and "given depth: used in 3 of 3 views" in start.how
    camera = views[1].camera
    true = exact_depth(demo.still_life(0), camera)
    x = start.cloud.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    at = np.floor(x[:, :2] / x[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]).astype(int)
    inside = ((at >= 0) & (at < [160, 120])).all(1) & (x[:, 2] > 0)
    ratio = x[inside, 2] / true[at[inside, 1], at[inside, 0]]
    assert (np.abs(ratio - 1) < 0.03).mean() > 0.85
    again = initial_points(mapped, None, config, np.random.default_rng(0))
    assert np.array_equal(start.cloud.points, again.cloud.points)
    alone = initial_points(mapped[:1], None, config, np.random.default_rng(0))
    assert "1 of these views without a comparison" in alone.how and len(alone.cloud) > 500


def test_depth_in_the_pixels_of_a_lens():
    """A map goes to the pinhole in which views are compared and comes back, a ramp to a pixel's step."""
    camera = dataclasses.replace(
        still_life()[0][0].camera, model="opencv", distortion=np.array([-0.1, 0.02, 0, 0, 0, 0, 0, 0.0])
    )
    ramp = np.broadcast_to(np.linspace(3, 5, 160), (120, 160)).astype(np.float32)
    view = given(View("a.png", camera, np.zeros((120, 160, 3), np.float32)), ramp, confidence=ramp / 5)
    flat = pinhole_view(view)
    assert flat.camera.model == "pinhole" and np.abs(flat.depth.values - ramp).max() > 0.03
    assert np.allclose(flat.depth.confidence, flat.depth.values / 5, atol=1e-6)
    found = ViewDepth(flat.depth.values, flat.depth.values > 0, np.zeros((120, 160), np.float32), given=flat.depth.values)
    back = lens_depth(camera, found).given
    known = back > 0
    assert known.mean() > 0.9 and np.abs(back - ramp)[known].max() < 2 * 2 / 160
