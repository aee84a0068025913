"""Degrees and least widths: held after every step, followed row by row, stored without what is not used."""

import math

import pytest
import torch

from tests.gaussians import cloud
from tests.pipeline.tables import adam_step
from warpgs.pipeline.model.compress import drop_unused_sh, stored_degrees
from warpgs.pipeline.model.parameter_bounds import (
    FINEST,
    NO_BOUND,
    bound_columns,
    enforce_bounds,
    min_log_scale,
    model_bytes,
    pack,
    truncated,
    unpack,
)
from warpgs.pipeline.model.table import DensityUpdate, Table
from warpgs.scene import Gaussians


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


def bounded(count: int = 9, degree: int = 1) -> Table:
    return Table.of_gaussians(cloud(count, degree=degree), bound_columns(degree))


def test_bounds_hold_after_every_step():
    """Whatever the gradient, coefficients above the degree stay 0 and no axis falls below its least; twice is as once."""
    table = bounded()
    table.columns["max_degree"][:4] = 0
    table.columns["min_log_scale"] = min_log_scale(torch.full((9,), 0.1))
    assert float(table.columns["min_log_scale"][0]) == pytest.approx(math.log(0.1 * FINEST))
    for step in (1, 2, 3):
        gradients = {n: torch.randn_like(t) for n, t in table.params.items()}
        gradients["log_scales"] = torch.full_like(gradients["log_scales"], 50.0)
        adam_step(table, gradients, step)
        enforce_bounds(table)
    assert not bool(table.params["sh"][:4, 1:].any()) and bool(table.params["sh"][4:, 1:].all())
    assert float(table.params["log_scales"].detach().min()) >= math.log(0.1 * FINEST) - 1e-6
    before = {n: t.detach().clone() for n, t in table.params.items()}
    enforce_bounds(table)
    assert all(torch.equal(before[n], t) for n, t in table.params.items())


def test_bounds_follow_the_rows():
    """What grew from another has its bounds; what grew from none has the highest degree and no least width."""
    table = bounded()
    table.columns["max_degree"] = torch.tensor([0, 1, 0, 1, 0, 1, 0, 1, 0], dtype=torch.int32)
    table.columns["min_log_scale"] = -torch.arange(9.0)
    added = {n: t.detach()[[2, 5, 5]] for n, t in table.params.items()}
    table.apply(DensityUpdate(torch.tensor([1, 2, 5, 8]), added, torch.tensor([2, 5, -1])))
    assert table.columns["max_degree"].tolist() == [1, 0, 1, 0, 0, 1, 1]
    assert table.columns["min_log_scale"].tolist() == [-1, -2, -5, -8, -2, -5, NO_BOUND]
    assert bool((min_log_scale(torch.zeros(2)) == NO_BOUND).all())
