"""Settings and sizes of images that are chosen for the user."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest

from warpgs.pipeline.runs.request import SceneRequest
from warpgs.pipeline.train.by_views import settings_by_views
from warpgs.pipeline.train.presets import PRESETS


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize(("views", "width", "height"), [(3, 126, 94), (3, 504, 378), (10, 900, 1600), (54, 504, 378)])
def test_quick_is_never_slower_than_default(device, views, width, height):
    """At most 600 steps, and on a CPU at most as many as its time has for the default; a number that is given holds."""
    train = [SimpleNamespace(camera=SimpleNamespace(width=width, height=height), alpha=None)] * views
    quick, default = (settings_by_views(PRESETS[name], train, device)[0].steps for name in ("quick", "default"))
    assert 0 < quick == min(600, default)
    given = dataclasses.replace(PRESETS["quick"], steps=700)
    assert settings_by_views(given, train, device)[0].steps == 700


def test_a_fit_on_a_cpu_has_smaller_images_unless_told():
    """A side or a factor that is given holds on both devices, and a run that remembers its size keeps it."""
    for device, side in (("cpu", 800), ("cuda", 1600)):
        chosen = SceneRequest("scene").with_scale(device)
        assert (chosen.downscale, chosen.max_side) == (1, side)
        assert SceneRequest("scene", max_side=1200).with_scale(device).max_side == 1200
        assert SceneRequest("scene", downscale=2).with_scale(device).max_side == 0
        assert chosen.with_scale("cpu") == chosen == chosen.with_scale("cuda")
