"""Degrees and least widths: held after every step, followed row by row, stored without what is not used."""

import pytest
import torch

from tests.gaussians import cloud
from warpgs.pipeline.model.edit import drop_unused_sh, stored_degrees
from warpgs.pipeline.model.table import model_bytes, pack, truncated, unpack
from warpgs.scene import Gaussians


def test_coefficients_above_the_degree_vanish():
    """Band by band for every degree; what is left has that degree."""
    sh = 1 + torch.rand(5, 25, 3)
    cut = truncated(sh, torch.tensor([0, 1, 2, 3, 4]))
    for d, count in enumerate((1, 4, 9, 16, 25)):
        assert torch.equal(cut[d, :count], sh[d, :count]) and not bool(cut[d, count:].any())
    assert stored_degrees(cut).tolist() == [0, 1, 2, 3, 4]
    assert torch.equal(unpack(pack(cut, stored_degrees(cut)), stored_degrees(cut)), cut)
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
