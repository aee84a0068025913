"""Objects that are cut out: views that know their opacity, the loss over other backgrounds, the hull, and where fits start."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.scenes import ring, seeds, three_gaussians
from warpgs.errors import UsageError
from warpgs.geometry import look_at
from warpgs.kernels.update import SHIFT
from warpgs.pipeline.metrics.scores import fitted_region
from warpgs.pipeline.model import start as init
from warpgs.pipeline.model.depth_points import carve, hull_points, in_empty_region, silhouettes
from warpgs.pipeline.model.start import InitConfig, initial_points, random_points
from warpgs.pipeline.train import trainer
from warpgs.pipeline.train.loss import AlphaDifference, LossConfig, LossInputs, Target
from warpgs.pipeline.train.schedule import over, random_shift
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import TrainingView, half_size, stack_views, with_alpha
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, PointCloud, View

CPU = torch.device("cpu")
WHITE = (1.0, 1.0, 1.0)
CUTOUT = FitConfig(
    steps=80, init=InitConfig(source="points"), density=DensityConfig(start=10, every=10), dropout=0.2, half_resolution=0.2
)


def cutouts(count: int = 4) -> list[View]:
    """Views of the three Gaussians before white, with their opacity."""
    views = []
    for i, camera in enumerate(ring(count)):
        render = rasterize(three_gaussians(), camera, RasterizeOptions(background=torch.ones(3)))
        views.append(View(f"{i}", camera, render.rgb.clamp(0, 1).numpy(), alpha=render.alpha.numpy()))
    return views


def balls(count: int = 8, side: int = 40) -> list[View]:
    """Views of a ball of radius 0.4 around the origin from 4 u away, all around it."""
    views = []
    for angle in 2 * np.pi * np.arange(count) / count:
        center = 4 * np.array([np.sin(angle), 0.3 * np.cos(3 * angle), -np.cos(angle)])
        K = np.array([[2.0 * side, 0, side / 2], [0, 2.0 * side, side / 2], [0, 0, 1]])
        camera = Camera(look_at(center, np.zeros(3), np.array([0, -1.0, 0])), K, side, side)
        y, x = np.mgrid[:side, :side] + 0.5 - side / 2
        distance = np.linalg.norm(center)
        ball = np.hypot(x, y) < 2 * side * 0.4 / np.sqrt(distance**2 - 0.4**2)
        image = np.where(ball[..., None], np.float32([0.2, 0.4, 0.6]), np.float32(1))
        views.append(View(f"{angle:.2f}", camera, image, alpha=ball.astype(np.float32)))
    return views


def fitted(views: list[View], loss: LossConfig, steps: int = CUTOUT.steps, points: PointCloud | None = None) -> Trainer:
    fit = Trainer(views, points or seeds(), dataclasses.replace(CUTOUT, loss=loss), CPU, WHITE)
    for _ in range(steps):
        fit.advance()
    return fit


def alpha_errors(fit: Trainer, views: list[View]) -> tuple[float, float]:
    """Mean rendered opacity where the truth is empty, and what is missing of it where the truth is nearly opaque."""
    alphas = [rasterize(fit.gaussians, v.camera).alpha.numpy() for v in views]
    true = np.stack([v.alpha for v in views])
    return float(np.stack(alphas)[true < 0.02].mean()), float(1 - np.stack(alphas)[true > 0.9].mean())


def test_an_image_over_another_background():
    """What is opaque stays, what is empty shows the other colour, and both sides of the loss mean the same."""
    view = cutouts(1)[0]
    shift = torch.tensor([-0.9, -0.3, 0.0])
    black = rasterize(three_gaussians(), view.camera, RasterizeOptions(background=1 + shift)).rgb
    shown = over(torch.from_numpy(view.image), torch.from_numpy(view.alpha), shift)
    assert torch.allclose(shown, black, atol=1e-6)
    shifts = np.array([random_shift(3, step, WHITE) for step in range(200)])
    assert (shifts <= 0).all() and (shifts >= -1).all() and np.allclose(shifts.mean(0), -0.5, atol=0.1)
    assert random_shift(3, 7, WHITE) == random_shift(3, 7, WHITE) != random_shift(4, 7, WHITE)


def test_views_carry_their_opacity():
    """An opaque view among others gets one; at half the size it is a mean, and stacks share its memory."""
    first, second = cutouts(2)
    both = with_alpha([dataclasses.replace(first, alpha=None), second])
    assert (both[0].alpha == 1).all() and both[1] is second
    assert with_alpha([both[0]]) == [both[0]]
    views = [TrainingView.of(v, CPU) for v in both]
    half = half_size(views[1])
    assert torch.allclose(half.alpha, torch.from_numpy(second.alpha.reshape(16, 2, 20, 2).mean((1, 3))), atol=1e-6)
    _, stacks, _ = stack_views([*views, half], 2)
    assert [len(s.alphas) for s in stacks.values()] == [2, 1]
    assert torch.equal(views[1].countable, (views[1].alpha > 0.5).float())


@pytest.mark.parametrize("masked", [False, True])
def test_alpha_term_is_a_mean_absolute_difference(masked):
    """Over the pixels that count; views without an opacity have none, and weights beyond reason are refused."""
    rendered, true, kept = torch.rand(3, 9, 11, generator=torch.Generator().manual_seed(0))
    mask = (kept > 0.3).float() if masked else None
    image = torch.zeros(9, 11, 3)

    def term(alpha: torch.Tensor | None) -> float:
        target = Target(image, mask, {}, alpha)
        return float(AlphaDifference(0.5)(LossInputs({"alpha": rendered}, target, None, None, torch.ones(()))))

    expected = (rendered - true).abs()[mask > 0].mean() if masked else (rendered - true).abs().mean()
    assert term(true) == pytest.approx(0.5 * float(expected), rel=1e-5) and term(None) == 0
    with pytest.raises(UsageError, match=r"alpha\.weight"):
        AlphaDifference(-1.0)
    with pytest.raises(UsageError, match=r"loss\.alpha-weight"):
        LossConfig(alpha_weight=float("nan"))


@pytest.mark.parametrize("loss", [LossConfig(alpha_weight=0), LossConfig()], ids=["background", "alpha"])
def test_either_way_empties_what_is_empty(loss, monkeypatch):
    """Without opacities Gaussians in the colour of the background are left where nothing is."""
    if loss.alpha_weight:
        monkeypatch.setattr(trainer, "random_shift", lambda *_: (0.0, 0.0, 0.0))
    monkeypatch.setattr(init, "on_object", lambda start, views: start)
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (200, 3))
    white = PointCloud(np.concatenate([seeds().points, points]), np.ones((len(seeds()) + 200, 3), np.float32))
    views = cutouts()
    plain = alpha_errors(fitted([dataclasses.replace(v, alpha=None) for v in views], LossConfig(), points=white), views)[0]
    empty, missing = alpha_errors(fitted(views, loss, points=white), views)
    assert empty < 0.3 * plain and missing < (0.1 if loss.alpha_weight else 1)  # by colour alone it takes more steps


def test_a_continued_fit_equals_an_uninterrupted_one():
    """The colour behind a step depends on seed and step alone; opaque views have none."""
    whole, half = fitted(cutouts(), LossConfig()), fitted(cutouts(), LossConfig(), 30)
    other = fitted(cutouts(), LossConfig(), 0)
    other.load(*half.state())
    while other.step < CUTOUT.steps:
        other.advance()
    assert all(torch.equal(a, b) for a, b in zip(whole.gaussians.tensors().values(), other.gaussians.tensors().values()))
    opaque = fitted([dataclasses.replace(v, alpha=None) for v in cutouts()], LossConfig(), 1)
    assert opaque.settings(5)[SHIFT] == (0, 0, 0) != whole.settings(5)[SHIFT]
    assert [t.name for t in opaque.terms] == ["photometric"]


def test_an_estimated_opacity_is_no_target():
    """It says where Gaussians start and are sampled; the loss is that of opaque views."""
    views = [dataclasses.replace(v, alpha_estimated=True) for v in cutouts()]
    fit = fitted(views, LossConfig(), 1)
    assert [t.name for t in fit.terms] == ["photometric"] and fit.settings(5)[SHIFT] == (0, 0, 0)
    assert fit.views[0].countable is not None and fit.layout.sizes.cutout


def test_hull_of_a_ball():
    """All points lie near its surface, in its colour, and none in the empty region of a view."""
    views = balls()
    cloud, how = hull_points(views, 2)
    distance = np.linalg.norm(cloud.points, axis=1)
    assert len(cloud) > 100 and f"{len(cloud):,} points on the hull of 8 silhouettes" in how
    assert (distance > 0.3).all() and (distance < 0.6).all()
    assert np.allclose(cloud.colors, [0.2, 0.4, 0.6], atol=1e-6)
    shapes = silhouettes(views)
    assert not in_empty_region(shapes, cloud.points).any()
    assert in_empty_region(shapes, np.array([[0, 0, 0], [0, 0.6, 0], [0.6, 0, 0]])).tolist() == [False, True, True]
    assert hull_points([views[0], dataclasses.replace(views[1], alpha=None)], 2)[0].points.shape == (0, 3)


def test_one_view_in_many_may_err():
    """A hole in one silhouette of twelve carves nothing; the same hole in a second one does."""
    views = balls(12)
    torn = dataclasses.replace(views[0], alpha=np.zeros_like(views[0].alpha))
    assert len(carve(silhouettes([torn, *views[1:]]))[0]) > 100
    also = dataclasses.replace(views[1], alpha=np.zeros_like(views[1].alpha))
    assert len(carve(silhouettes([torn, also, *views[2:]]))[0]) == 0


def test_starts_stand_on_the_object():
    """Whatever the source, no point lies in a place that is empty in a view."""
    views = balls()
    assert fitted_region(views[0])[1] == "object"
    shapes = silhouettes(views)
    everywhere = PointCloud(np.random.default_rng(0).uniform(-0.8, 0.8, (3000, 3)), np.ones((3000, 3), np.float32))
    starts = [initial_points(views, everywhere, InitConfig(source=s), np.random.default_rng(0)) for s in ("hull", "points")]
    assert "left out: they are in an empty area of a view" in starts[1].how
    for cloud in (*(s.cloud for s in starts), random_points(views, 200, np.random.default_rng(0))[0]):
        assert len(cloud) >= 100 and not in_empty_region(shapes, cloud.points).any()
