"""Things that moved: found where one view alone shows them, and nowhere on a scene that stands still."""

import dataclasses

import numpy as np
import pytest

from tests.scenes import photos
from warpgs.pipeline.metrics.scores import Rendered, moved_fractions, moved_notes
from warpgs.scene import View

WALL = 2.2
"""Depth of a wall that all of it is painted on [u]."""


def _scene(count: int = 6) -> tuple[list[View], list[Rendered]]:
    """Views side by side of a wall that their renders show exactly."""
    first = photos(1, 64, 48)[0]
    views = []
    for i in range(count):
        viewmat = np.eye(4)
        viewmat[0, 3] = 0.1 * i
        views.append(
            View(f"{i}.png", dataclasses.replace(first.camera, viewmat=viewmat), np.full((48, 64, 3), 0.4, np.float32))
        )
    return views, [Rendered(v.image.copy(), np.full((48, 64), WALL), np.ones((48, 64))) for v in views]


def _with_patch(view: View) -> View:
    """The view with something bright on the wall, 4 % of its pixels."""
    image = view.image.copy()
    left = round(26 + view.camera.K[0, 0] * (view.camera.viewmat[0, 3] - 0.2) / WALL)
    image[20:30, left : left + 12] = 0.9
    return dataclasses.replace(view, image=image)


@pytest.mark.parametrize("alone", [True, False])
def test_what_one_view_alone_shows_is_named(alone):
    """What all views show, and the model lacks, did not move."""
    views, renders = _scene()
    changed = [_with_patch(v) if i == 2 or not alone else v for i, v in enumerate(views)]
    fractions = moved_fractions(changed, renders)
    assert [f > 0 for f in fractions] == [alone and i == 2 for i in range(len(views))]
    assert fractions[2] == pytest.approx(0.04 * alone, abs=0.02)
    notes = moved_notes({v.name: f for v, f in zip(views, fractions)})
    assert len(notes) == alone and all("2.png" in n and "of its pixels" in n for n in notes)


def test_it_takes_two_others_that_show_the_place():
    """Nothing is said where the renders of others show another depth, there are few views, or a mask hides it."""
    views, renders = _scene()
    views[2] = _with_patch(views[2])
    elsewhere = [r if i == 2 else r._replace(depth=2 * r.depth) for i, r in enumerate(renders)]
    assert not any(moved_fractions(views, elsewhere))
    assert not any(moved_fractions(views[:5], renders[:5]))
    mask = np.ones((48, 64), bool)
    mask[16:34, 22:42] = False
    masked = [dataclasses.replace(v, mask=mask) if i == 2 else v for i, v in enumerate(views)]
    assert moved_fractions(views, renders)[2] > 0 and not any(moved_fractions(masked, renders))


def test_a_view_that_fits_badly_as_a_whole_has_no_region_that_stands_out():
    """Its exposure or pose is off, and that is something else."""
    views, renders = _scene()
    views[2] = _with_patch(dataclasses.replace(views[2], image=views[2].image + np.float32(0.1)))
    assert not any(moved_fractions(views, renders))


def test_a_fit_that_has_hardly_begun_accuses_no_view():
    """All views are far from their renders."""
    views, renders = _scene()
    views[2] = _with_patch(views[2])
    assert not any(moved_fractions(views, [r._replace(rgb=r.rgb + np.float32(0.01)) for r in renders]))
