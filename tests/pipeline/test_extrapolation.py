"""Extrapolated points where no view looks: where they lie, what they look like, when there are some, and that they stay."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from tests.pipeline.test_depth_points import known
from tests.scenes import photos, seeds, view_stub
from warpgs.geometry import in_image, project_points
from warpgs.pipeline.model.depth_points import BEYOND, BEYOND_PX, EXTRAPOLATED_OPACITY, REACH, STEP, extrapolated_points
from warpgs.pipeline.model.start import InitConfig, Start, initial_gaussians, initial_points, subsample
from warpgs.pipeline.train import setup
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import OptimizerConfig
from warpgs.pipeline.train.settings import EXTRAPOLATED_VIEWS, FitConfig, settings_by_views
from warpgs.pipeline.train.step import decay_opacities
from warpgs.pipeline.train.trainer import Trainer
from warpgs.scene import Camera, PointCloud, View, ViewDepth

SIZE, NEAR, FAR = 96, 2.0, 4.0
RED, BLUE = (0.75, 0.25, 0.25), (0.25, 0.25, 0.75)


def depth_of(values: np.ndarray) -> ViewDepth:
    """Return consistent depth, known where it is above 0."""
    valid = values > 0
    return ViewDepth(values.astype(np.float32), valid, np.where(valid, 1, np.inf).astype(np.float32))


def card(shift: float = 0.0) -> tuple[View, ViewDepth]:
    """Return a red card of 48 x 48 px at depth 2 in front of a blue wall at depth 4, and their depth."""
    viewmat = np.eye(4)
    viewmat[0, 3] = -shift
    camera = Camera(viewmat, np.array([[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1]], float), SIZE, SIZE)
    near = np.zeros((SIZE, SIZE), bool)
    near[24:72, 24:72] = True
    image = np.where(near[..., None], RED, BLUE).astype(np.float32)
    return View(f"{shift}", camera, image), depth_of(np.where(near, NEAR, FAR))


def test_an_image_goes_on_beyond_its_border():
    """Around it and in no image, about as far away as the border and in its colours."""
    view, depth = card()
    cloud = extrapolated_points([view], [depth])
    pixels, z = project_points(view.camera, cloud.points)
    outside = ~in_image(view.camera, cloud.points)
    pad = BEYOND * SIZE
    assert outside.sum() == ((SIZE + 2 * pad) / BEYOND_PX) ** 2 - (SIZE / BEYOND_PX) ** 2
    assert np.allclose(z[outside], FAR, rtol=0.2) and np.allclose(cloud.colors[outside], BLUE, atol=1e-5)
    assert pixels[outside].min() >= -pad and pixels[outside].max() <= SIZE + pad
    beside = card(0.5)
    both = extrapolated_points([view, beside[0]], [depth, beside[1]])
    shown = [in_image(v.camera, both.points) for v in (view, beside[0])]
    beyond = ~(shown[0] | shown[1])
    assert 0 < beyond.sum() < 2 * outside.sum()


def test_a_wall_goes_on_behind_the_edge_of_a_card():
    """At its own depth and in its colour, within reach of the edge; an even slope has no edge."""
    view, depth = card()
    cloud = extrapolated_points([view], [depth])
    inside = in_image(view.camera, cloud.points)
    pixels, z = project_points(view.camera, cloud.points[inside])
    red, _, blue = cloud.colors[inside].T
    assert len(z) > 20 and np.allclose(z, FAR) and (blue > red).all()
    edge = np.minimum(pixels - 24, 72 - pixels).min(1)  # distance from the card's edge, inwards [px]
    assert (edge > 0).all() and (edge <= REACH).all()
    slope = np.broadcast_to(2 * (1 + 0.8 * (STEP - 1)) ** np.arange(SIZE), (SIZE, SIZE))  # more than EDGE within reach
    assert not in_image(view.camera, extrapolated_points([view], [depth_of(slope)]).points).any()


def test_nothing_is_extrapolated_before_what_another_view_sees():
    """None where a second view looks at a wall further away; depth that is not confirmed has no say."""
    (view, depth), (other, _) = card(), card(0.5)
    past = np.full((SIZE, SIZE), 8 * FAR)
    none = extrapolated_points([view, other], [depth, depth_of(past)])
    assert not (in_image(view.camera, none.points) & in_image(other.camera, none.points)).any()
    some = extrapolated_points([view, other], [depth, depth_of(0 * past)])
    assert (in_image(view.camera, some.points) & in_image(other.camera, some.points)).any()


def test_nothing_is_extrapolated_of_parts_of_images():
    """Nor where no depth is known, or none was searched for; beyond a lens with distortion nothing is."""
    view, depth = card()
    mask = np.ones((SIZE, SIZE), bool)
    mask[:8] = False
    assert len(extrapolated_points([dataclasses.replace(view, mask=mask)], [depth])) == 0
    assert len(extrapolated_points([dataclasses.replace(view, alpha=mask.astype(np.float32))], [depth])) == 0
    assert len(extrapolated_points([view], [depth_of(0 * depth.depth)])) == 0
    assert len(extrapolated_points([view], [dataclasses.replace(depth, searched=False)])) == 0
    lens = dataclasses.replace(view.camera, model="opencv", distortion=np.zeros(8))
    bent = extrapolated_points([dataclasses.replace(view, camera=lens)], [depth])
    assert len(bent) > 20 and in_image(view.camera, bent.points).all()


def test_extrapolated_points_come_last():
    """The others are those of a start without; the same every time; fewer points keep the count of them."""
    views, _ = known()
    config = InitConfig(source="sweep", merge_px=4, fill_px=8)
    plain, more = (
        initial_points(views, None, dataclasses.replace(config, extrapolate=unseen), np.random.default_rng(0))
        for unseen in (False, True)
    )
    count = len(plain.cloud)
    assert plain.extrapolated == 0 and more.extrapolated == len(more.cloud) - count > 20
    assert np.array_equal(more.cloud.points[:count], plain.cloud.points)
    assert f"{more.extrapolated} extrapolated where no view looks" in more.how and "extrapolated" not in plain.how
    fewer = subsample(more, len(more.cloud) // 2, np.random.default_rng(0))
    extrapolated = {tuple(p) for p in more.cloud.points[count:]}
    are = [tuple(p) in extrapolated for p in fewer.cloud.points]
    assert sum(are) == fewer.extrapolated > 0 and all(are[-fewer.extrapolated :])


def test_a_start_without_extrapolated_points_says_why():
    """Where they were asked for: with masks, and where the start is not from depth."""
    views, _ = known()
    corner = np.ones(views[0].image.shape[:2], bool)
    corner[:4, :4] = False
    masked = [dataclasses.replace(v, mask=corner) for v in views]
    config = InitConfig(source="sweep", merge_px=4, fill_px=8, extrapolate=True)
    random = dataclasses.replace(config, source="random", random_count=200)
    for given, settings, reason in ((masked, config, "none extrapolated, because masks"), (views, random, "sweep or flow")):
        start = initial_points(given, None, settings, np.random.default_rng(0))
        assert reason in start.how and start.extrapolated == 0
        plain = dataclasses.replace(settings, extrapolate=False)
        assert "extrapolated" not in initial_points(given, None, plain, np.random.default_rng(0)).how


def test_extrapolated_gaussians_start_more_opaque():
    """All others with the opacity of the settings."""
    view, depth = card()
    cloud = extrapolated_points([view], [depth])
    opacities = initial_gaussians(cloud, InitConfig(), 0, 1.0, torch.device("cpu"), 5).logit_opacities.sigmoid()
    assert torch.allclose(opacities[-5:], torch.tensor(EXTRAPOLATED_OPACITY))
    assert torch.allclose(opacities[:-5], torch.tensor(InitConfig().opacity))


def test_decay_spares_what_is_not_used():
    """Those that are used lose as much as without."""
    logits, used = torch.linspace(-3, 3, 6), torch.tensor([True, False] * 3)
    all_of_them, some = logits.clone(), logits.clone()
    decay_opacities(all_of_them, 0.1, torch.tensor([True]))
    decay_opacities(some, 0.1, torch.tensor([True]), used)
    assert torch.equal(some[used], all_of_them[used]) and torch.equal(some[~used], logits[~used])


@pytest.mark.parametrize("extrapolated", [1, 0])
def test_a_fit_spares_what_no_view_shows(device, extrapolated, monkeypatch):
    """A Gaussian far outside all images keeps its opacity to the bit, but decays if no point is extrapolated."""
    cloud = seeds()
    lone = PointCloud(np.concatenate([cloud.points, [[500.0, 500, 500]]]), np.concatenate([cloud.colors, cloud.colors[:1]]))
    monkeypatch.setattr(setup, "initial_points", lambda *given: Start(lone, "", None, extrapolated))
    config = FitConfig(
        steps=4, sh_degree=0, init=InitConfig(source="points", extrapolate=True),
        optimizer=OptimizerConfig(opacities_decay=0.01, opacities_lr=1e-6),
    )  # fmt: skip
    trainer = Trainer(photos(3), lone, config, torch.device(device))
    before = trainer.gaussians.logit_opacities.clone()
    for _ in range(4):
        trainer.advance()
    lower = trainer.gaussians.logit_opacities < before
    far = trainer.gaussians.means.norm(dim=1) > 100
    assert int(far.sum()) == 1 and bool(lower[far]) != bool(extrapolated) and lower[~far].float().mean() > 0.5


@pytest.mark.parametrize(
    ("views", "alpha", "device_kind", "unseen"),
    [(1, None, "cuda", False), (2, None, "cuda", True), (EXTRAPOLATED_VIEWS, None, "cuda", True),
     (EXTRAPOLATED_VIEWS + 1, None, "cuda", False), (3, 1.0, "cuda", False), (3, None, "cpu", False)],
)  # fmt: skip
def test_few_opaque_views_have_extrapolated_points(views, alpha, device_kind, unseen):
    """In a whole fit that starts from a sweep; opacities then decay faster. What is given holds."""
    train = [view_stub(alpha=alpha)] * views
    default = PRESETS["default"]
    config, notes = settings_by_views(default, train, device_kind)
    decay = 0.0015 if unseen else 0.001
    assert (config.init.extrapolate, config.optimizer.opacities_decay) == (unseen, decay)
    assert ("no extrapolated points" in " ".join(notes)) != unseen
    for change in ({"extrapolate": False}, {"source": "random"}):
        given = dataclasses.replace(default, init=dataclasses.replace(default.init, **change))
        found = settings_by_views(given, train, device_kind)[0]
        assert not found.init.extrapolate and found.optimizer.opacities_decay == min(decay, 0.001)


MASKED, FULL, DARK = np.eye(6, 8) > 0, np.ones((6, 8), bool), np.zeros((6, 8, 3))
DARK[3, 3] = 1


@pytest.mark.parametrize("extrapolate", [None, True])
@pytest.mark.parametrize(
    ("changed", "source", "views", "decay"),
    [({}, "auto", 3, 0.0015), ({"mask": FULL}, "auto", 3, 0.0015), ({"mask": MASKED}, "auto", 3, 0.001),
     ({"image": DARK}, "auto", 3, 0.001), ({}, "points", 3, 0.001), ({}, "hull", 3, 0.001), ({}, "random", 3, 0.001),
     ({}, "sweep", 1, 0.001)],
)  # fmt: skip
def test_decay_changes_only_with_extrapolated_points(extrapolate, changed, source, views, decay):
    """Not if a part of a view does not count, nor if the start searches for no depth; even where points are asked for."""
    default = PRESETS["default"]
    init = dataclasses.replace(default.init, source=source, extrapolate=extrapolate)
    config, _ = settings_by_views(dataclasses.replace(default, init=init), [view_stub(**changed)] * views, "cuda")
    assert config.optimizer.opacities_decay == decay
    assert config.init.extrapolate == (decay == 0.0015 if extrapolate is None else extrapolate)
