"""Clone, split and prune, and how fast scales may change meanwhile."""

import math

import pytest
import torch

from tests.gaussians import cloud
from warpgs.errors import UsageError
from warpgs.pipeline.train.schedule import OptimizerConfig
from warpgs.pipeline.train.strategies import clone_split
from warpgs.pipeline.train.strategies.clone_split import DensityConfig, refine
from warpgs.scene import Gaussians


def run(gaussians, pull, config=DensityConfig(), after_reset=False, seed=0, capacity=1000):  # noqa: B008
    generator, pull = torch.Generator().manual_seed(seed), torch.tensor(pull, dtype=torch.float32)
    return refine(
        gaussians, pull, config, extent=1.0, capacity=capacity, after_reset=after_reset, generator=generator
    )  # fmt: skip


def gaussians_of(scales: list[float], opacities: list[float]) -> Gaussians:
    g = cloud(len(scales))
    g.log_scales[:] = torch.log(torch.tensor(scales))[:, None]
    g.logit_opacities[:] = torch.logit(torch.tensor(opacities))
    return g


def test_small_ones_are_cloned_large_ones_split_faint_ones_removed():
    """Rows: 0 small and pulled, 1 large and pulled, 2 faint, 3 left alone."""
    g = gaussians_of([0.005, 0.5, 0.005, 0.005], [0.5, 0.5, 0.001, 0.5])
    change = run(g, [1.0, 1.0, 1.0, 0.0])
    assert change.keep.tolist() == [0, 3]
    assert len(change.added["means"]) == 3  # one clone, two children
    assert torch.equal(change.added["means"][0], g.means[0])
    assert torch.allclose(change.added["log_scales"][1:], g.log_scales[1] - math.log(1.6))
    assert not torch.equal(change.added["means"][1], change.added["means"][2])


def test_children_lie_where_their_parent_does():
    """The children of many equal parents have the parent's mean and covariance (a needle turned by 60 degrees)."""
    count = 4000
    g = cloud(count)
    g.means[:] = torch.tensor([1.0, 2.0, 3.0])
    g.quats[:] = 3 * torch.tensor([math.cos(math.pi / 6), 0, 0, math.sin(math.pi / 6)])
    g.log_scales[:] = torch.log(torch.tensor([0.5, 0.1, 0.2]))
    g.logit_opacities[:] = 2.0
    children = run(g, [1.0] * count, capacity=2 * count).added["means"].double()
    offsets = children - torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    c, s = 0.5, math.sqrt(0.75)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    wanted = turn @ torch.diag(torch.tensor([0.25, 0.01, 0.04], dtype=torch.float64)) @ turn.T
    assert float(offsets.mean(0).abs().max()) < 0.03
    assert float((offsets.T @ offsets / len(offsets) - wanted).abs().max()) < 0.02


def test_the_cap_lets_only_the_strongest_grow():
    """With room for one, the most pulled Gaussian is cloned; with none, nothing is."""
    g = gaussians_of([0.005] * 4, [0.5] * 4)
    change = run(g, [1.0, 3.0, 2.0, 0.0], capacity=5)
    assert torch.equal(change.added["means"], g.means[1:2])
    assert len(run(g, [1.0] * 4, capacity=4).added["means"]) == 0


def test_huge_ones_go_only_after_a_reset():
    """Size pruning waits for the first opacity reset, as in the reference."""
    g = gaussians_of([0.5, 0.005], [0.5, 0.5])
    assert run(g, [0, 0]).keep.tolist() == [0, 1]
    assert run(g, [0, 0], after_reset=True).keep.tolist() == [1]


def test_one_gaussian_always_survives():
    """Where all are faint, or not a number, the most opaque stays."""
    assert run(gaussians_of([0.1] * 3, [0.001, 0.003, 0.002]), [0, 0, 0]).keep.tolist() == [1]


def test_same_seed_same_children():
    """Splitting is repeatable, and another seed gives other children."""
    g = gaussians_of([0.5] * 3, [0.5] * 3)
    a, b, c = (run(g, [1.0] * 3, seed=s).added["means"] for s in (1, 1, 2))
    assert torch.equal(a, b) and not torch.equal(a, c)


@pytest.mark.parametrize("bad", [{"every": 0}, {"start": -1}, {"stop_fraction": 1.5}, {"reset_opacity": 0}])
def test_bad_settings_are_refused(bad):
    """A setting that cannot work is an error at once."""
    with pytest.raises(UsageError):
        DensityConfig(**bad)


def test_protected_are_not_pruned_and_only_the_growing_grow(monkeypatch):
    """Two faint ones, one of them protected; two that are pulled at, one of which may grow."""
    monkeypatch.setattr(clone_split, "CLONE_SIZE", 1.0)
    gaussians = gaussians_of([0.1] * 4, [0.001, 0.001, 0.5, 0.5])
    pull = torch.tensor([0.0, 0, 1, 1])
    change = refine(
        gaussians, pull, DensityConfig(), extent=1.0, capacity=100, after_reset=False,
        generator=torch.Generator(),
        growing=torch.tensor([True, True, True, False]), protected=torch.tensor([True, False, False, False]),
    )  # fmt: skip
    assert change.keep.tolist() == [0, 2, 3] and change.parents.tolist() == [2]


def test_rates_of_scales_may_fall():
    """Log-linear to the share that is left at the last step, from where the set settles; level where nothing is asked for."""
    falling = OptimizerConfig(scales_lr=0.1, scales_decay=0.01)

    def lrs(stable_start: float, *progress: float) -> list[float]:
        return [falling.lrs(p, 1.0, stable_start)["log_scales"] for p in progress]

    assert lrs(0.0, 0.0, 0.5, 1.0) == pytest.approx([0.1, 0.01, 0.001])
    assert lrs(0.5, 0.0, 0.5, 0.75, 1.0) == pytest.approx([0.1, 0.1, 0.01, 0.001])
    assert OptimizerConfig(scales_lr=0.1).lrs(1.0, 1.0)["log_scales"] == pytest.approx(0.1)
