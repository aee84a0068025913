"""Smoothness of rendered depth: values, gradients, when it is chosen, memory, and fits."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from tests.pipeline.test_memory_plan import STEADY, instances, measured
from tests.pipeline.test_normals_example import same_bits
from tests.scenes import photos, seeds, view_stub
from warpgs.errors import UsageError
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.folder import load_checkpoint, save_checkpoint
from warpgs.pipeline.train.loss import BOUND, CONFIRMED, EDGE, LossConfig, SmoothDepth, built_in_terms, depth_roughness
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.settings import FEW, SMOOTH_STEPS, FitConfig, settings_by_views, steps_by_views
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.rasterize import rasterize

CPU = torch.device("cpu")


def flat(depth: torch.Tensor, **changed) -> float:
    """Return the roughness of depth before an even image, all of it opaque."""
    given = {"alpha": torch.ones_like(depth), "image": torch.zeros(*depth.shape, 3), "weight": torch.ones_like(depth)}
    given = {n: t.to(depth.dtype) for n, t in (given | changed).items() if n != "mask"}
    return float(depth_roughness(depth, *given.values(), changed.get("mask")))


def test_a_plane_is_smooth_and_a_bend_is_not():
    """By hand: a bend of one pixel, its bound, edges of colour, weights, transparent and masked pixels, and no unit."""
    y, x = torch.meshgrid(torch.arange(6.0).double(), torch.arange(7.0).double(), indexing="ij")
    plane = 1 / (0.5 + 0.02 * x + 0.03 * y)
    assert flat(plane) < 1e-12
    bent = torch.ones(3, 3, dtype=torch.float64)
    bent[1, 1] = 1.02  # both rows of its own, and four of its neighbours' see no bend: they lie at the border
    rough = 2 * (2 * 1.02 - 2) / 9
    assert abs(flat(bent) - rough) < 1e-12 and abs(flat(1e6 * bent) - rough) < 1e-9
    far = bent.clone()
    far[1, 1] = 3
    assert abs(flat(far) - 2 * BOUND / 9) < 1e-12
    image = torch.zeros(3, 3, 3)
    image[:, 2] = EDGE  # an edge along rows alone
    assert abs(flat(bent, image=image) - rough * (1 + torch.e**-1) / 2) < 1e-8
    assert abs(flat(bent, weight=torch.full((3, 3), 0.2)) - 0.2 * rough) < 1e-8
    alpha, mask = torch.ones(3, 3), torch.ones(3, 3)
    alpha[1, 0] = mask[0, 1] = 0
    assert abs(flat(bent, alpha=alpha) - rough / 2) < 1e-12 and abs(flat(bent, mask=mask) - rough / 2) < 1e-12
    assert flat(torch.ones(2, 2)) == 0 and torch.isnan(torch.tensor(flat(bent * torch.nan)))


def test_gradients_in_float64():
    """Below the bound, and 0 beyond it."""
    g = torch.Generator().manual_seed(0)
    depth = (1 + 0.02 * torch.rand(5, 6, generator=g, dtype=torch.float64)).requires_grad_()
    image, weight = torch.rand(5, 6, 3, generator=g, dtype=torch.float64), torch.rand(5, 6, generator=g, dtype=torch.float64)
    alpha = torch.ones(5, 6, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda d: depth_roughness(d, alpha, image, weight, None), depth)


def test_confirmed_pixels_count_less():
    """All count alike where no depth is consistent."""
    view = TrainingView.of(photos(1, 4, 4)[0], CPU)
    assert torch.equal(SmoothDepth().needs(view, None)["smooth_depth"], torch.ones(4, 4))
    consistent = torch.zeros(4, 4)
    consistent[1] = 2.0
    found = SmoothDepth().needs(TrainingView(view.camera, view.image, consistent=consistent), None)["smooth_depth"]
    assert torch.equal(found, torch.where(consistent > 0, CONFIRMED, 1.0))


@pytest.mark.parametrize(
    ("views", "alpha", "weight"),
    [(3, None, 1.0), (4, None, 1.0), (5, None, 0.0), (3, 1.0, 0.5), (8, 1.0, 0.5), (9, 1.0, 0.0)],
)
def test_few_views_have_the_term(views, alpha, weight):
    """In fits of at least 3000 steps, so not where a CPU limits them; what is given holds, and other presets have none."""
    train = [view_stub(alpha=alpha)] * views
    default = PRESETS["default"]
    config, _ = settings_by_views(default, train, "cuda")
    assert config.loss.smooth_weight == weight
    few = 3000 if alpha else 4500
    assert config.steps == (few if views <= FEW else steps_by_views(views))
    assert [t.name for t in built_in_terms(config.loss)] == ["photometric", "smooth_depth"][: 1 + (weight > 0)]
    short = dataclasses.replace(default, steps=SMOOTH_STEPS - 1), PRESETS["quick"], PRESETS["3dgs"]
    assert all(settings_by_views(c, train, "cuda")[0].loss.smooth_weight == 0 for c in short)
    limited, _ = settings_by_views(default, train, "cpu")
    assert limited.steps < SMOOTH_STEPS and limited.loss.smooth_weight == 0
    unlimited = dataclasses.replace(default, cpu_limit=False)
    assert settings_by_views(unlimited, train, "cpu")[0].loss.smooth_weight == weight
    given = dataclasses.replace(default, loss=LossConfig(smooth_weight=0.2))
    assert settings_by_views(given, train, "cpu")[0].loss.smooth_weight == 0.2


def test_wrong_weights_are_refused():
    """In the settings and in the term."""
    for wrong in (-1, math.nan, 1001):
        for kind, name in ((LossConfig, "smooth_weight"), (SmoothDepth, "weight")):
            with pytest.raises(UsageError, match=r"(loss\.smooth-|smooth-depth\.)weight must be in \[0, 1000\]"):
                kind(**{name: wrong})


def test_a_fit_with_the_term_is_smoother_and_continues(tmp_path):
    """Rendered depth is less rough than without; a continued fit has the same bits as an uninterrupted one."""

    def fit(weight: float, until: int = 40) -> Trainer:
        config = FitConfig(
            steps=40, init=InitConfig(source="points", opacity=0.9), sh_degree=0, half_resolution=0.5,
            loss=LossConfig(smooth_weight=weight),
        )  # fmt: skip
        trainer = Trainer(photos(3, 40, 32), seeds(), config, CPU)
        while trainer.step < until:
            trainer.advance(until - trainer.step)
        return trainer

    def rough(trainer: Trainer) -> float:
        found = []
        for v in photos(3, 40, 32):
            r = rasterize(trainer.gaussians, v.camera)
            image = torch.as_tensor(v.image, dtype=torch.float32)
            found.append(float(depth_roughness(r.depth, r.alpha, image, torch.ones_like(r.depth), None)))
        return sum(found)

    whole, half = fit(30.0), fit(30.0, 20)
    assert rough(whole) < 0.9 * rough(fit(0.0))
    save_checkpoint(tmp_path, *half.state())
    again = fit(30.0, 0)
    again.load(*load_checkpoint(tmp_path))
    while again.step < 40:
        again.advance(40 - again.step)
    assert same_bits(whole, again)


def test_plan_covers_the_term():
    """The weights that stay, and what the term and its gradient take."""
    config = dataclasses.replace(STEADY, loss=LossConfig(smooth_weight=1.0))
    fit = Trainer(photos(2, 400, 300), seeds(60), config, CPU)
    fit.advance()
    found, planned = measured(fit, 2), fit.layout.step(60, instances(fit))
    assert found <= planned <= 1.25 * found + 20_000, (found, planned)
