"""Degrees and least widths: held after every step, followed row by row, stored without what is not used."""

import math

import pytest
import torch

from tests.gaussians import cloud
from warpgs.pipeline.model.compress import drop_unused_sh, stored_degrees
from warpgs.pipeline.model.parameter_bounds import FINEST, NONE, ParameterBounds, model_bytes, pack, truncated, unpack
from warpgs.pipeline.train.schedule import OptimizerConfig
from warpgs.pipeline.train.strategies.clone_split import DensityUpdate
from warpgs.scene import Gaussians

CPU = torch.device("cpu")


def test_coefficients_above_the_degree_vanish():
    """Band by band for every degree; what is left has that degree."""
    sh = 1 + torch.rand(4, 16, 3)
    cut = truncated(sh, torch.tensor([0, 1, 2, 3]))
    for d, count in enumerate((1, 4, 9, 16)):
        assert torch.equal(cut[d, :count], sh[d, :count]) and not bool(cut[d, count:].any())
    assert stored_degrees(cut).tolist() == [0, 1, 2, 3]
    assert stored_degrees(torch.zeros(2, 1, 3)).tolist() == [0, 0]


def test_stored_without_what_is_not_used():
    """Packed by degree and back: the same numbers in fewer bytes; unsorted degrees are refused."""
    degrees = torch.tensor([0, 0, 1, 1, 1, 2])
    sh = truncated(torch.randn(6, 16, 3), degrees)
    packed = pack(sh, degrees)
    assert packed.numel() == 3 * (2 * 1 + 3 * 4 + 9) and torch.equal(unpack(packed, degrees), sh[:, :9])
    assert model_bytes(degrees) == 4 * (6 * 11 + packed.numel())
    with pytest.raises(ValueError, match="ascend"):
        pack(sh, degrees.flip(0))
    assert unpack(pack(sh[:2], degrees[:2]), degrees[:2]).shape == (2, 1, 3)
    flat = drop_unused_sh(Gaussians(**(cloud(5).tensors() | {"sh": truncated(cloud(5).sh, torch.zeros(5))})))
    assert flat.sh.shape == (5, 1, 3)


def optimizer(count: int = 9, degree: int = 1) -> Optimizer:
    made = Optimizer(cloud(count, degree=degree), OptimizerConfig(), 1.0)
    made.bounds = ParameterBounds(count, degree, CPU)
    return made


def test_limits_hold_after_every_step():
    """Whatever the gradient, coefficients above the degree stay 0 and no axis falls below its floor; twice is as once."""
    o = optimizer()
    o.bounds.degree[:4] = 0
    o.bounds.set_footprint(torch.full((9,), 0.1))
    assert float(o.bounds.floor[0]) == pytest.approx(math.log(0.1 * FINEST))
    for _ in range(3):
        for t in o.params.values():
            t.grad = torch.randn_like(t)
        o.params["log_scales"].grad = torch.full_like(o.params["log_scales"], 50.0)
        o.step(0.0)
    assert not bool(o.params["sh"][:4, 1:].any()) and bool(o.params["sh"][4:, 1:].all())
    assert float(o.params["log_scales"].detach().min()) >= math.log(0.1 * FINEST) - 1e-6
    before = {n: t.detach().clone() for n, t in o.params.items()}
    o.bounds.enforce(o.params)
    assert all(torch.equal(before[n], t) for n, t in o.params.items())


def test_limits_follow_the_rows():
    """After a change and a sort every Gaussian still has its own limits, and its own moments; a checkpoint gives them back."""
    o = optimizer()
    o.bounds.degree = torch.tensor([0, 1, 0, 1, 0, 1, 0, 1, 0], dtype=torch.int32)
    o.bounds.floor = -torch.arange(9.0)
    o.bounds.growing = 3
    for m in (*o.means.values(), *o.squares.values()):
        m += torch.arange(9.0).reshape(-1, *[1] * (m.ndim - 1))
    added = {n: t.detach()[[2, 5, 5]] for n, t in o.params.items()}
    o.apply(DensityUpdate(torch.tensor([1, 2, 5, 8]), added, torch.tensor([2, 5, -1])))
    assert o.bounds.degree.tolist() == [1, 0, 1, 0, 0, 1, 1]
    assert o.bounds.floor.tolist() == [-1, -2, -5, -8, -2, -5, NONE]
    assert o.bounds.level.tolist() == [0, 0, 0, 0, 3, 3, 3]
    order = torch.tensor([6, 3, 0, 1, 2, 4, 5])
    o.reorder(order)
    assert o.bounds.degree.tolist() == [1, 0, 1, 0, 1, 0, 1] and o.bounds.level.tolist() == [3, 0, 0, 0, 0, 3, 3]
    assert o.means["sh"][:, 0, 0].tolist() == [0, 8, 1, 2, 5, 0, 0]
    again = optimizer(7)
    again.load(o.state(), 4)
    assert all(torch.equal(again.state()[n], t) for n, t in o.state().items()) and "limits.degree" in o.state()
    assert torch.equal(again.bounds.floor, o.bounds.floor)
