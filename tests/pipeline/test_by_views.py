"""Settings and sizes of images that are chosen for the user."""

from __future__ import annotations

import dataclasses

import pytest

from tests.scenes import view_stub
from warpgs.pipeline.run.request import SceneRequest
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import plan_phases
from warpgs.pipeline.train.settings import ONE_LAYER, settings_by_views
from warpgs.pipeline.train.stopping import StoppingConfig


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize(("views", "width", "height"), [(3, 126, 94), (3, 504, 378), (10, 900, 1600), (54, 504, 378)])
def test_quick_is_never_slower_than_default(device, views, width, height):
    """At most 600 steps, and on a CPU at most as many as its time has for the default; a number that is given holds."""
    train = [view_stub(width, height)] * views
    quick, default = (settings_by_views(PRESETS[name], train, device)[0].steps for name in ("quick", "default"))
    assert 0 < quick == min(600, default)
    given = dataclasses.replace(PRESETS["quick"], steps=700)
    assert settings_by_views(given, train, device)[0].steps == 700


def test_rates_rise_where_the_time_of_a_cpu_limits_many_views():
    """With more than nine views, and only where steps are left out; rates that are given hold, and the loss is said."""

    def chosen(views, device, **optimizer):
        train = [view_stub()] * views
        config = PRESETS["default"]
        config = dataclasses.replace(config, optimizer=dataclasses.replace(config.optimizer, **optimizer))
        found, notes = settings_by_views(config, train, device)
        return (found.optimizer.means_lr, found.optimizer.sh_lr), notes

    usual = (1.6e-4, 2.5e-3)
    assert chosen(9, "cpu")[0] == chosen(10, "cuda")[0] == usual
    rates, notes = chosen(10, "cpu")
    assert rates == (4e-4, 6.25e-3)
    assert chosen(10, "cpu", means_lr=1e-3, sh_lr=2e-3)[0] == (1e-3, 2e-3)
    assert "--no-cpu-limit takes all, about 11 min, and raises PSNR by at least 0.5 dB" in notes[-1]


def test_one_layer_has_fewer_steps_in_the_time_of_a_cpu():
    """Its steps take longer, so that both take the same time."""
    train = [view_stub()] * 3
    config = PRESETS["default"]
    one, two = (
        settings_by_views(dataclasses.replace(config, method=dataclasses.replace(config.method, hier=hier)), train, "cpu")[0]
        for hier in (False, True)
    )
    assert abs(ONE_LAYER * one.steps - two.steps) < 2 and one.steps < two.steps


def test_nothing_is_held_out_where_the_time_of_a_cpu_limits_the_steps():
    """All degrees of the harmonics are in use when growth begins, as with held-out blocks; a gain that is given holds."""

    def chosen(views, device, config=PRESETS["default"]):
        train = [view_stub()] * views
        return settings_by_views(config, train, device)[0]

    for views in (3, 12):
        limited, whole = chosen(views, "cpu"), chosen(views, "cuda")
        assert limited.stopping.min_gain_db == 0 and whole.stopping.min_gain_db == 0.1
        assert limited.steps < whole.steps and whole.sh_every == 500
        assert limited.sh_degree * limited.sh_every <= plan_phases(limited.phases, limited.steps).refine
    assert chosen(12, "cpu", dataclasses.replace(PRESETS["default"], steps=100)).stopping.min_gain_db == 0.1
    given = dataclasses.replace(PRESETS["default"], stopping=StoppingConfig(min_gain_db=0.2))
    assert chosen(12, "cpu", given).stopping.min_gain_db == 0.2 and chosen(12, "cpu", given).sh_every == 500


def test_a_fit_on_a_cpu_has_smaller_images_unless_told():
    """A side or a factor that is given holds on both devices, and a run that remembers its size keeps it."""
    for device, side in (("cpu", 800), ("cuda", 1600)):
        chosen = SceneRequest("scene").with_scale(device)
        assert (chosen.downscale, chosen.max_side) == (1, side)
        assert SceneRequest("scene", max_side=1200).with_scale(device).max_side == 1200
        assert SceneRequest("scene", downscale=2).with_scale(device).max_side == 0
        assert chosen.with_scale("cpu") == chosen == chosen.with_scale("cuda")
