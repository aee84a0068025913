"""The paper's strategy: scores and gate on images with known scores, the gain against renders, and fits with every switch."""

import ast
import dataclasses
import importlib
import itertools
from pathlib import Path

import numpy as np
import pytest
import torch

import warpgs
from tests.pipeline.train.fits import advanced
from tests.scenes import photos, priors, ring, seeds, three_gaussians
from tests.tolerances import GAIN
from warpgs.constants import LOW_PASS, Rule
from warpgs.pipeline import paper
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.paper import scores
from warpgs.pipeline.paper.scores import (
    EVERY,
    SUPPORT,
    blur,
    gain_map,
    gains,
    geometry_gate,
    geometry_score,
    importance,
    normalized,
    render_score,
    residual_of,
    semantic_score,
    weights,
)
from warpgs.pipeline.paper.strategy import UNIFORM, PaperConfig
from warpgs.pipeline.train.schedule import PhaseConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies import sampling
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.sampling import MethodConfig, SamplerConfig, fine_gaussians
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import C0, Camera, Gaussians, View

CPU = torch.device("cpu")


def grid(height: int = 40, width: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    y, x = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    return x, y


def test_blurred_and_normalized_scores():
    """A constant stays, an impulse becomes the Gaussian itself."""
    assert torch.allclose(blur(torch.full((9, 8), 0.3)), torch.tensor(0.3))
    impulse = torch.zeros(21, 21)
    impulse[10, 10] = 1
    x, y = grid(21, 21)
    expected = torch.exp(-0.5 * ((x - 10) ** 2 + (y - 10) ** 2))
    assert torch.allclose(blur(impulse), expected / expected[7:14, 7:14].sum(), atol=1e-4)
    # one wild pixel, a factor and an offset change nothing; a constant has score 0
    score = torch.rand(50, 60, generator=torch.Generator().manual_seed(0))
    spoiled = score.clone()
    spoiled[0, 0] = 1e6
    assert torch.allclose(normalized(score)[1:], normalized(spoiled)[1:], atol=2e-3)
    assert torch.allclose(normalized(7 * score - 3), normalized(score), atol=1e-5)
    assert normalized(score).min() == 0 and normalized(score).max() == 1
    assert not bool(normalized(torch.full((4, 4), 0.7)).any())
    assert not bool(normalized(score, torch.zeros(50, 60, dtype=torch.bool)).any())


def test_geometry_score_finds_the_step_and_the_curved_patch(monkeypatch):
    """A plane has one score, since all its gradients are the same; a step and a bowl on it stand out."""
    x, y = grid()
    plane = 0.01 * x + 0.02 * y
    inner = geometry_score(plane)[6:-6, 6:-6]
    assert float(inner.max() - inner.min()) < 1e-3
    step = plane + (x > 25)
    score = geometry_score(step)
    assert bool((score[5:-5, 25:27] > 0.9).all()) and float(score[5:-5, 32:45].max()) < 0.1
    bowl = plane + torch.where((x - 12) ** 2 + (y - 20) ** 2 < 64, 0.02 * ((x - 12) ** 2 + (y - 20) ** 2 - 64), 0)
    middle = (20, 12)  # no gradient there but that of the plane
    found = {}
    for curvature in (2.0, 0.0):
        monkeypatch.setattr(scores, "CURVATURE", curvature)
        found[curvature] = geometry_score(bowl)[middle]
    assert found[2.0] > found[0.0] + 0.1


def test_scores_weights_and_gate_are_those_of_the_paper():
    """F_seg (omega_boundary + omega_foreground), up to the scale of the view."""
    generator = torch.Generator().manual_seed(1)
    confidence, boundary, foreground = torch.rand(3, 30, 40, generator=generator)
    product = confidence * (boundary + foreground)
    score = semantic_score(confidence, boundary, foreground)
    inner = (score > 0) & (score < 1)
    assert np.corrcoef(score[inner], product[inner])[0, 1] > 0.999999
    # by the norm over channels
    image, rendered = torch.zeros(30, 30, 3), torch.zeros(30, 30, 3)
    rendered[4:14, 4:14] = torch.tensor([0.3, 0.0, 0.4])  # length 0.5
    rendered[18:28, 18:28, 0] = 0.45
    score = render_score(rendered, image)
    assert score[9, 9] == 1 and abs(float(score[23, 23]) - 0.9) < 5e-3 and score[0, 29] == 0
    # the rows of the ablation table; without any score every pixel counts the same
    for switches, expected in (
        ((True, True, True), (0.4, 0.2, 0.4)), ((False, True, True), (0, 1 / 3, 2 / 3)), ((True, False, True), (0.5, 0, 0.5)),
        ((True, True, False), (2 / 3, 1 / 3, 0)), ((False, False, False), (0, 0, 0)),
    ):  # fmt: skip
        assert np.allclose(weights(*switches), expected)
    values = tuple(torch.full((2, 3), v) for v in (0.5, 0.25, 1.0))
    assert torch.allclose(importance(values, (0.4, 0.2, 0.4)), torch.tensor(0.65))
    assert torch.equal(importance(values, (0, 0, 0)), torch.ones(2, 3))
    # where too few would pass, the quantile falls; a constant score lets all valid pixels pass
    score = torch.rand(50, 40, generator=torch.Generator().manual_seed(0))
    valid = torch.ones(50, 40, dtype=torch.bool)
    gate, used = geometry_gate(score, valid, 0.6, 10)
    assert used == 0.6 and abs(float(gate.float().mean()) - 0.4) < 0.01
    assert score[gate].min() > score[~gate].max()
    gate, used = geometry_gate(score, valid, 0.6, 400)  # needs 1600 of 2000
    assert used < 0.25 and int(gate.sum()) >= SUPPORT * 400
    gate, used = geometry_gate(torch.zeros(50, 40), valid, 0.6, 10)
    assert used == 0 and torch.equal(gate, valid)
    gate, used = geometry_gate(score, ~valid, 0.6, 10)
    assert used == 0 and not bool(gate.any())


SIZE = (64, 48)
FOOTPRINT = 3.0
OPTIONS = RasterizeOptions(rule=Rule("uncut", alpha_cut=1e-6), background=torch.zeros(3))


def wall() -> Gaussians:
    y, x = torch.meshgrid(torch.linspace(-1.5, 1.5, 41), torch.linspace(-2, 2, 55), indexing="ij")
    means = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    count = len(means)
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    scales = torch.tensor([0.08, 0.08, 1e-3]).log().repeat(count, 1)
    return Gaussians(means, quats, scales, torch.full((count,), 4.0), torch.full((count, 1, 3), (0.5 - 0.5) / C0))


def cameras() -> list[Camera]:
    K = np.array([[80.0, 0, 32.7], [0, 80, 23.6], [0, 0, 1]])
    found = []
    for x in (-0.15, 0.15):
        viewmat = np.eye(4)
        viewmat[:3, 3] = x, 0, 2.2
        found.append(Camera(viewmat, K, *SIZE))
    return found


def views(paint=lambda image, number: image) -> list[TrainingView]:
    found = []
    for number, camera in enumerate(cameras()):
        rgb = rasterize(wall(), camera, OPTIONS).rgb.clamp(0, 1).numpy()
        found.append(TrainingView.of(View(f"{number}.png", camera, paint(rgb, number)), CPU))
    return found


def blob(image: np.ndarray, number: int) -> np.ndarray:
    """Add waves of colour, other ones in each view."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    waves = np.stack([np.sin(0.21 * x + number), np.sin(0.17 * y), np.cos(0.13 * x + 0.19 * y)], -1)
    return (image + 0.2 * waves).clip(0, 1).astype(np.float32)


def residuals(shown: list[TrainingView]):
    renders = [rasterize(wall(), v.camera, OPTIONS) for v in shown]
    return [residual_of(v, r.rgb, r.depth, FOOTPRINT) for v, r in zip(shown, renders)]


def squared_error(gaussians: Gaussians, shown: list[TrainingView]) -> float:
    return sum(float((rasterize(gaussians, v.camera, OPTIONS).rgb.double() - v.image).square().sum()) for v in shown)


def test_gain_is_the_fall_of_the_error_of_all_views(monkeypatch):
    shown = views(blob)
    view, before = shown[0], squared_error(wall(), shown)
    at = torch.tensor([[24, 30], [18, 22], [30, 40], [22, 44], [28, 18]])
    depth = 0.999 * rasterize(wall(), view.camera, OPTIONS).depth
    opacity = 1e-2
    monkeypatch.setattr(sampling, "OPACITY", opacity)
    rows = fine_gaussians(view.camera, view.image, depth, at, FOOTPRINT, 1)
    area = 2 * np.pi * (FOOTPRINT**2 + LOW_PASS)  # of the footprint as it is rendered
    expected = gains(rows["means"], view.image[at[:, 0], at[:, 1]], residuals(shown))
    measured = []
    for i in range(len(at)):
        both = Gaussians(**{n: torch.cat([t, rows[n][i : i + 1]]) for n, t in wall().tensors().items()})
        measured.append((before - squared_error(both, shown)) / (2 * opacity * area))
    scale = float(np.abs(measured).max())
    np.testing.assert_allclose(expected.numpy() / scale, np.array(measured) / scale, atol=GAIN)


def test_gain_counts_where_points_are_seen_and_views_agree():
    """None behind the wall, outside of the image, or where masks leave out every pixel."""
    shown = views(blob)
    center = shown[0].camera.viewmat[:3, :3].T @ -shown[0].camera.viewmat[:3, 3]
    behind, aside = -0.4 * center[None], center[None] + 50 * shown[0].camera.viewmat[:3, :3].T[:, :1].T
    white = torch.ones(1, 3)
    assert float(gains(torch.zeros(1, 3), white, residuals(shown)).abs()) > 0
    assert gains(behind, white, residuals(shown)[:1]).item() == gains(aside, white, residuals(shown)[:1]).item() == 0
    masked = [dataclasses.replace(v, mask=torch.zeros_like(v.image[..., 0])) for v in shown]
    assert gains(torch.zeros(1, 3), white, residuals(masked)).item() == 0

    # a bright patch has none beside a view in which the wall is darker than its render
    def patch(image, number):
        changed = image.copy()
        rows, columns = (slice(18, 30), slice(26, 38)) if number == 0 else (slice(0, 48), slice(0, 64))
        changed[rows, columns] += 0.3 if number == 0 else -0.3
        return changed.clip(0, 1)

    shown, sized = views(patch), (SIZE[1], SIZE[0])
    found, depth = residuals(shown), rasterize(wall(), shown[0].camera, OPTIONS).depth
    valid = depth > 0
    alone, both = gain_map(shown[0], depth, valid, found[:1]), gain_map(shown[0], depth, valid, found)
    assert alone.shape == both.shape == sized and float(alone[24, 32]) > 0.01 and float(both[24, 32]) == 0
    assert float(alone[4, 4]) < 1e-3 * float(alone[24, 32])
    assert torch.equal(alone[::EVERY, ::EVERY], alone[1::EVERY, 1::EVERY])
    assert not bool(gain_map(shown[0], depth, ~valid, found).any())


@pytest.mark.parametrize("size", [(3, 5), (1, 1), (2, 9)])
def test_tiny_images_have_a_gain_map(size):
    width, height = size
    camera = dataclasses.replace(ring(1)[0], width=width, height=height)
    view = TrainingView.of(View("a.png", camera, np.full((height, width, 3), 0.7, np.float32)), CPU)
    depth = torch.full((height, width), 2.2)
    residual = residual_of(view, torch.full_like(view.image, 0.5), depth, FOOTPRINT)
    found = gain_map(view, depth, depth > 0, [residual])
    assert found.shape == (height, width) and bool(torch.isfinite(found).all()) and bool((found > 0).all())


METHOD = MethodConfig(hier=True, sampler=SamplerConfig(fraction=0.01))
CONFIG = FitConfig(
    steps=6, sh_every=10, dropout=0.2, init=InitConfig(source="points"), sh_degree=1,
    density=DensityConfig(start=2, every=8, gradient=1e-5), phases=PhaseConfig(100, 50), strategy="paper", method=METHOD,
)  # fmt: skip
SWITCHES = ("s_render", "s_semantic", "s_geometry", "ra", "agp", "pm")
SOME = [(True,) * 7, (False,) * 7, *(tuple(i != j for i in range(7)) for j in range(7))]
"""All parts, none, and each part switched off alone."""


@pytest.fixture
def tiny(monkeypatch):
    """Three Gaussians are hardly opaque."""
    monkeypatch.setattr(sampling, "MIN_ALPHA", 0.05)


def trainer(config: FitConfig = CONFIG, given=None, size: tuple[int, int] = (32, 32)) -> Trainer:
    views = photos(3, *size)
    return Trainer(views, seeds(), config, CPU, priors=priors(views) if given is None else given)


def with_own(**settings) -> FitConfig:
    return dataclasses.replace(CONFIG, strategy_config=PaperConfig(**settings))


@pytest.mark.parametrize(
    "combinations",
    [SOME, pytest.param([*itertools.product((False, True), repeat=7)], marks=pytest.mark.slow)],
    ids=["some", "all"],
)
def test_switch_combinations_run(tiny, combinations):
    """Fits of a 32 x 32 scene, 2^7 of them in all: every one samples, protects or not as asked, and stays finite."""
    for hier, *values in combinations:
        own = dict(zip(SWITCHES, values))
        fit = trainer(dataclasses.replace(with_own(**own), method=dataclasses.replace(METHOD, hier=hier)))
        advanced(fit)
        assert all(bool(torch.isfinite(t).all()) for t in fit.gaussians.tensors().values()), own
        # the first event fills the layer; the second finds no room among the protected
        first, second = fit.strategy.events
        assert first["added"] > 0 and first["evicted"] == 0, own
        assert (second["added"] > 0) == (second["evicted"] > 0) == (not own["pm"]), own


def test_without_its_parts_it_is_the_strategy_sampling(tiny):
    """The same bits, with `UNIFORM`; other settings differ."""
    configs = dataclasses.replace(CONFIG, strategy="sampling"), with_own(**dataclasses.asdict(UNIFORM)), CONFIG
    plain, uniform, full = (advanced(trainer(c)).gaussians.means for c in configs)
    assert torch.equal(plain, uniform) and not (plain.shape == full.shape and torch.equal(plain, full))
    blank = [dataclasses.replace(p, boundary=p.boundary * 0, foreground=p.foreground * 0) for p in priors(photos(3, 32, 32))]
    fit = trainer(given=blank)
    render, semantic, geometry, total = fit.strategy.sample(1, {0: fit.views[0]}, 0.01, 0.5)[2][0].scores.values()
    assert not bool(semantic.any()) and torch.allclose(total, 0.5 * render + 0.5 * geometry)


def test_gain_draws_where_all_views_ask_for_colour(tiny):
    """One of the three Gaussians is missing: most pixels sampled by the gain lie on it, and uniform ones do not."""
    whole = three_gaussians()
    fraction = []
    for own in (PaperConfig(s_semantic=False, s_geometry=False, residual="gain", depth="consistent", gate_quantile=0), UNIFORM):
        fit = trainer(dataclasses.replace(CONFIG, strategy_config=own), size=(40, 32))
        views = {i: dataclasses.replace(v, consistent=rasterize(whole, v.camera).depth) for i, v in enumerate(fit.views)}
        kept = {n: t[:2].clone() for n, t in whole.tensors().items()}
        fit.table.params.update(kept)
        fit.table.columns.update({n: c[:2] for n, c in fit.table.columns.items()})
        fit.context.capacity = 10_000
        change, *_ = fit.strategy.sample(9, views, 0.01, 50.0)
        away = (change.added["means"] - whole.means[2]).norm(dim=1)
        fraction.append(float((away < 0.45).float().mean()))
    assert fraction[0] > 0.9 > 0.6 > fraction[1]


def test_the_room_of_the_paper_uses_public_names_alone():
    """What its modules import from others is on the faces, so that it stands beside a strategy of one's own."""
    folder = Path(paper.__file__).parent
    used = set()
    for file in folder.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module.startswith("warpgs") and "paper" not in node.module:
                module = importlib.import_module(node.module)
                used |= {(a.name, id(getattr(module, a.name))) for a in node.names}
    public = {id(getattr(face, name)) for face in (warpgs, warpgs.train) for name in face.__all__}
    assert len(used) > 10 and {name for name, own in used if own not in public} == set()
