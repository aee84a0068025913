"""Loss terms on given depth and normals: values, gradients, half size, memory, and fits that continue with the same bits."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.pipeline.test_memory_plan import STEADY, instances, measured
from tests.pipeline.test_normals_example import same_bits
from tests.priors.rigs import still_life
from tests.scenes import photos, seeds, three_gaussians
from warpgs.errors import UsageError
from warpgs.geometry import depth_normals
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.folder import load_checkpoint, save_checkpoint
from warpgs.pipeline.train.loss import (
    LOSS_TERMS,
    GivenDepthDifference,
    GivenNormalsDifference,
    LossConfig,
    built_in_terms,
    inverse_depth_difference,
    normal_difference,
)
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import TrainingView, half_size
from warpgs.priors.views import PriorConfig
from warpgs.render.rasterize import rasterize
from warpgs.scene import GivenDepth, Prior, View

CPU = torch.device("cpu")
CONFIG = FitConfig(
    steps=60, init=InitConfig(source="points", opacity=0.9), sh_degree=0, density=DensityConfig(start=6, every=6),
    half_resolution=0.5, loss=LossConfig(depth_weight=1, normal_weight=0.01),
)  # fmt: skip


def mapped(count: int = 4, width: int = 40, height: int = 32, normals: bool = True) -> list[View]:
    """Return views of the three Gaussians with their own depth and normals; the last has none."""
    views, found = photos(count, width, height), []
    for v in views[:-1]:
        r = rasterize(three_gaussians(), v.camera)
        depth = torch.where(r.alpha > 0.5, r.depth, 0)
        camera = dataclasses.replace(v.camera, viewmat=torch.eye(4), K=torch.as_tensor(v.camera.K, dtype=torch.float32))
        vectors = depth_normals(camera, depth).numpy() if normals else None
        found.append(dataclasses.replace(v, depth=GivenDepth(depth.numpy()), normals=vectors))
    return [*found, views[-1]]


def fitted(config: FitConfig = CONFIG, until: int = 60) -> Trainer:
    fit = Trainer(mapped(), seeds(), config, CPU)
    while fit.step < until:
        fit.advance(until - fit.step)
    return fit


def target_of(term, **fields) -> torch.Tensor:
    camera = photos(1)[0].camera
    view = TrainingView(camera, torch.zeros(*next(iter(fields.values())).shape[:2], 3), **fields)
    (found,) = term.needs(view, None).values()
    return found


def test_depth_term_is_a_mean_of_inverse_depths_over_their_median():
    """By hand: weights, pixels without depth, transparent and masked ones; no unit of length matters."""
    given = torch.tensor([[2.0, 4.0, 0.0, 4.0, 8.0]])
    weight = torch.tensor([[1.0, 0.5, 1.0, 1.0, 1.0]])
    depth, alpha = torch.tensor([[4.0, 2.0, 1.0, 1.0, 1.0]]), torch.tensor([[1.0, 1, 1, 0.3, 1]])
    mask = torch.tensor([[1.0, 1, 1, 1, 0]])
    target = target_of(GivenDepthDifference(), depth=given, depth_weight=weight)
    q = 4.0
    wanted = (abs(q / 4 - q / 2) + 0.5 * abs(q / 2 - q / 4)) / 1.5
    assert float(inverse_depth_difference(depth, alpha, target, mask)) == pytest.approx(wanted)
    far = target_of(GivenDepthDifference(), depth=1e6 * given, depth_weight=weight)
    assert float(inverse_depth_difference(1e6 * depth, alpha, far, mask)) == pytest.approx(wanted)
    nothing = target_of(GivenDepthDifference(), depth=0 * given)
    assert float(inverse_depth_difference(depth, alpha, nothing, None)) == 0
    assert torch.isnan(inverse_depth_difference(depth * torch.nan, alpha, target, mask))


def test_gradients_in_float64():
    g = torch.Generator().manual_seed(0)
    depth = (torch.rand(5, 6, generator=g, dtype=torch.float64) + 1).requires_grad_()
    given = torch.rand(5, 6, generator=g, dtype=torch.float64) + 1
    given[1], alpha = 0, torch.rand(5, 6, generator=g, dtype=torch.float64)
    target = torch.stack([1.5 * (given > 0) / given.clamp_min(0.1), (given > 0).double(), 1.5 * (given > 0)], -1)
    assert torch.autograd.gradcheck(lambda d: inverse_depth_difference(d, alpha, target, None), depth)
    normals = torch.nn.functional.normalize(torch.rand(5, 6, 3, generator=g, dtype=torch.float64) - 0.5, dim=-1)
    other = torch.nn.functional.normalize(torch.rand(5, 6, 3, generator=g, dtype=torch.float64) - 0.5, dim=-1)
    other[2] = 0
    assert torch.autograd.gradcheck(lambda n: normal_difference(n, other, None), normals.requires_grad_())


def test_normal_term_is_a_mean_of_angles():
    normals = torch.tensor([[[0.0, 0, -1], [0, 0, -1], [0, 0, 0], [1, 0, 0]]])
    given = torch.tensor([[[0.0, 0, -1], [0.6, 0, -0.8], [0, 0, -1], [0, 0, 0]]])
    assert float(normal_difference(normals, given, None)) == pytest.approx(0.5 * 0.2)
    assert float(normal_difference(normals, given, torch.tensor([[1.0, 0, 1, 1]]))) == 0
    assert float(normal_difference(normals, 0 * given, None)) == 0


def test_half_size_keeps_weighted_means():
    """Pixels without depth take no part in the means of half the size, and few points keep their values."""
    given = torch.zeros(4, 4)
    given[0, 0], given[2, 2], given[2, 3] = 2.0, 4.0, 8.0
    view = TrainingView.of(photos(1, 4, 4)[0], CPU)
    view = dataclasses.replace(view, maps=GivenDepthDifference().needs(dataclasses.replace(view, depth=given), None))
    small = half_size(view).maps["given_depth"]
    exact = torch.tensor([[2.0, 1.0], [1.0, 16 / 3]])  # harmonic means
    alpha = torch.ones(2, 2)
    assert float(inverse_depth_difference(exact, alpha, small, None)) == pytest.approx(0, abs=1e-6)
    assert float(inverse_depth_difference(2 * exact, alpha, small, None)) > 0.3


def test_terms_follow_from_the_views_and_the_weights():
    assert [t.name for t in Trainer(mapped(2), seeds(), CONFIG, CPU).terms] == ["photometric", "given_depth", "given_normals"]
    assert [t.name for t in Trainer(photos(2), seeds(), CONFIG, CPU).terms] == ["photometric"]
    assert len(built_in_terms(LossConfig(depth_weight=0, normal_weight=0), False, True, True)) == 1
    for bad in ({"depth_weight": -1}, {"normal_weight": float("nan")}):
        with pytest.raises(UsageError, match=r"loss\.(depth|normal)-weight must be in \[0, 1000\]"):
            LossConfig(**bad)


def test_a_fit_with_maps_is_nearer_to_them_and_continues(tmp_path):
    """Rendered depth comes nearer to the given one than without; a continued fit has the same bits as an uninterrupted one."""
    whole, plain = fitted(), fitted(dataclasses.replace(CONFIG, loss=LossConfig(depth_weight=0, normal_weight=0)))

    def off(fit: Trainer) -> float:
        found = []
        for v in mapped()[:-1]:
            r, given = rasterize(fit.gaussians, v.camera), torch.as_tensor(v.depth.values)
            at = (given > 0) & (r.alpha > 0.5)
            found.append(float((r.depth[at] / given[at] - 1).abs().mean()))
        return float(np.mean(found))

    assert off(whole) < 0.85 * off(plain)
    part = fitted(until=25)
    save_checkpoint(tmp_path, *part.state())
    again = Trainer(mapped(), seeds(), CONFIG, CPU)
    again.load(*load_checkpoint(tmp_path))
    while again.step < 60:
        again.advance(60 - again.step)
    assert same_bits(whole, again)


@pytest.mark.parametrize("normals", [False, True])
def test_plan_covers_the_terms(normals):
    """The maps that stay, and what the terms and their gradients take."""
    views = mapped(2, 400, 300, normals)
    fit = Trainer(views, seeds(60), STEADY, CPU)
    fit.advance()
    found = measured(fit, 2)
    planned = fit.layout.step(60, instances(fit))
    assert found <= planned <= 1.25 * found + 20_000, (found, planned)


def test_depth_by_a_network_takes_the_same_way():
    """`--depth-guides`: the network's disparity is fitted to what views confirm, and in the loss; it needs a network."""
    views, depths = still_life()
    maps = [np.ones_like(d, np.float32) for d in depths]
    priors = [Prior((3 / d).astype(np.float32), *[m] * 3, "a network", "none") for d, m in zip(depths, maps)]
    network = PriorConfig(depth_model="depth.onnx", depth_guides=True)  # not opened: its maps are there
    fit = Trainer(views, None, FitConfig(steps=2, init=InitConfig(source="sweep"), priors=network), CPU, priors=priors)
    assert [t.name for t in fit.terms] == ["photometric", "given_depth"]
    assert any("given depth: used in 3 of 3 views" in n for n in fit.notes)
    for view, true in zip(fit.views, depths):
        scaled, weight, q = (m.numpy() for m in view.maps["given_depth"].unbind(-1))
        at = weight > 0
        assert at.mean() > 0.9 and np.median(np.abs(q[at] / scaled[at] / true[at] - 1)) < 0.005
    with pytest.raises(UsageError, match="--depth-guides requires --depth-model"):
        PriorConfig(depth_guides=True)


@pytest.mark.cuda
@pytest.mark.parametrize("batch", [1, 2])
def test_recorded_steps_equal_single_steps(batch):
    """On CUDA: maps are taken from the stacks by number, and the bits are those of steps one by one."""
    config, device = dataclasses.replace(CONFIG, batch=batch), torch.device("cuda", 0)
    fits = [Trainer(mapped(), seeds(), dataclasses.replace(config, cuda_graph=g), device) for g in (True, False)]
    for fit in fits:
        while fit.step < 24:
            fit.advance(24 - fit.step)
    assert same_bits(*fits)


def test_names_of_the_terms_are_registered():
    assert LOSS_TERMS.find("given_depth") is GivenDepthDifference and LOSS_TERMS.find("given_normals") is GivenNormalsDifference
