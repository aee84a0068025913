"""The term on normals of `examples/`: its value, and fits with it that are recorded and continued."""

import dataclasses
import sys

import pytest
import torch

from tests.example_terms import NormalSmoothness
from tests.scenes import photos, seeds
from warpgs.errors import UsageError
from warpgs.geometry import depth_normals
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.folder import load_checkpoint, save_checkpoint
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.render.rasterize import rasterize

CPU = torch.device("cpu")
unevenness = sys.modules[NormalSmoothness.__module__].unevenness
SMOOTH = FitConfig(
    steps=24, init=InitConfig(source="points", opacity=0.9), sh_degree=0, density=DensityConfig(start=6, every=6),
    half_resolution=0.5, loss_terms=(NormalSmoothness(2.0, growth=10),),
)  # fmt: skip


def fitted(config: FitConfig, device: torch.device = CPU, until: int = 24) -> Trainer:
    fit = Trainer(photos(4), seeds(), config, device)
    while fit.step < until:
        fit.advance(until - fit.step)
    return fit


def same_bits(a: Trainer, b: Trainer) -> bool:
    (tensors, _), (others, _) = a.state(), b.state()
    return tensors.keys() == others.keys() and all(torch.equal(t, others[n]) for n, t in tensors.items())


def test_unevenness_is_a_weighted_mean_of_angles():
    """Two halves that face apart by 60 degrees; an edge of the image between them hides that; gradcheck in float64."""
    normals = torch.zeros(4, 6, 3, dtype=torch.float64)
    normals[:, :3, 2], normals[:, 3:] = -1, torch.tensor([0.75**0.5, 0, -0.5], dtype=torch.float64)
    image = torch.zeros(4, 6, 3, dtype=torch.float64)
    assert float(unevenness(normals, image)) == pytest.approx(0.5 * 4 / (4 * 5 + 3 * 6))
    image[:, 3:] = 1
    assert float(unevenness(normals, image)) < 1e-5
    assert float(unevenness(torch.zeros_like(normals), image)) == 0
    random = torch.nn.functional.normalize(torch.rand(4, 6, 3, dtype=torch.float64) - 0.5, dim=-1).requires_grad_()
    assert torch.autograd.gradcheck(lambda n: unevenness(n, image), random)


def test_a_fit_with_the_term_is_smoother_and_continues(tmp_path):
    """On a CPU: smoother than without, and the same bits where it is continued from a checkpoint."""
    whole, plain = fitted(SMOOTH), fitted(dataclasses.replace(SMOOTH, loss_terms=()))

    def found(fit: Trainer) -> float:
        renders = [(v, rasterize(fit.gaussians, v.camera)) for v in fit.views]
        depths = [(v, torch.where(r.alpha > 0.5, r.depth, 0)) for v, r in renders]
        return sum(float(unevenness(depth_normals(v.camera, d), v.image)) for v, d in depths)

    assert found(whole) < 0.8 * found(plain)
    save_checkpoint(tmp_path, *fitted(SMOOTH, until=13).state())
    stored, values = load_checkpoint(tmp_path)
    resumed = Trainer(photos(4), seeds(), FitConfig.from_json(values["config"]), CPU)
    resumed.load(stored, values)
    while resumed.step < 24:
        resumed.advance()
    assert same_bits(resumed, whole)


def test_the_weight_grows_over_the_first_steps():
    """By the number of the step: a tenth of it in the first of ten."""
    fit = Trainer(photos(4), seeds(), dataclasses.replace(SMOOTH, half_resolution=0.0), CPU)
    term, steps = fit.terms[-1], []

    class Noted(NormalSmoothness):
        def __call__(self, inputs):
            with torch.no_grad():
                whole = NormalSmoothness(2.0, growth=1)(inputs)
                steps.append(float(NormalSmoothness.__call__(self, inputs) / whole))
            return super().__call__(inputs)

    fit.terms = (*fit.terms[:-1], Noted(term.weight, term.growth))
    while fit.step < 12:
        fit.advance()
    assert steps == pytest.approx([min(1, k / 10) for k in range(1, 13)])


@pytest.mark.parametrize("bad", [{"weight": -1.0}, {"weight": float("nan")}, {"growth": 0}])
def test_settings_out_of_range_are_refused(bad):
    """By name, with the range."""
    with pytest.raises(UsageError, match=f"{next(iter(bad))} .* must"):
        NormalSmoothness(**bad)


@pytest.mark.cuda
@pytest.mark.parametrize("batch", [1, 2])
def test_recorded_steps_with_the_term_equal_single_steps(batch):
    """On CUDA: the step's number is read on the device, so that a replayed step has its own weight."""
    config = dataclasses.replace(SMOOTH, batch=batch)
    device = torch.device("cuda", 0)
    recorded, single = (fitted(dataclasses.replace(config, cuda_graph=g), device) for g in (True, False))
    without = fitted(dataclasses.replace(config, loss_terms=()), device)
    assert same_bits(recorded, single) and not torch.equal(recorded.gaussians.means[:10], without.gaussians.means[:10])
