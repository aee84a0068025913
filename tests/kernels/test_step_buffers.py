"""The bookkeeping of captured steps, against torch."""

import math

import pytest
import torch

from tests.kernels.test_guard_bytes import Guarded
from tests.reference import step_buffers as reference
from warpgs.kernels.step_buffers import NOT_FINITE, SHIFT, Setting, begin_step, end_step


def rows(device, height=5, width=7, views=3, steps=4) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    shapes = ((steps, 15), (steps, 2), (views, 4, 4), (views, 3, 3), (views, height, width, 3))
    return [torch.rand(s, generator=g).to(device) for s in shapes]


@pytest.mark.parametrize("size", [(5, 7), (1, 1), (1, 2), (33, 65)])
def test_a_step_finds_its_own(device, size):
    """Learning rates, settings, camera and image follow the number of the step, for images smaller than a matrix, too."""
    given, views = rows(device, *size), torch.tensor([2, 0, 1, 0], device=device)
    for step in range(4):
        counter = torch.tensor([step], device=device)
        found, wanted = (f(counter, views, *given) for f in (begin_step, reference.begin_step))
        assert all(a.shape == b.shape and torch.equal(a, b) for a, b in zip(found, wanted, strict=True))


def test_nothing_is_written_beside_what_a_step_finds(device):
    """Image sizes larger and smaller than a matrix."""
    for size in ((5, 7), (1, 1)):
        given, views = rows(device, *size), torch.tensor([2, 0, 1, 0], device=device)
        counter = torch.tensor([1], device=device)
        with Guarded(2**30) as guards:
            begin_step(counter, views, *given)
            stop, history = torch.zeros(1, dtype=torch.int32, device=device), torch.zeros(4, 2, device=device)
            end_step(given[0][0, 0], given[0][0, 1], counter, stop, history)
        assert len(guards.kept) >= 5 and guards.intact()


@pytest.mark.parametrize("stopped", [0, 1, NOT_FINITE])
@pytest.mark.parametrize("value", [0.25, 0.0, math.nan, math.inf, -math.inf])
def test_a_step_is_written_down_and_counted_if_it_counts(device, value, stopped):
    """A loss that is not finite stops the batch, a stopped batch stays so, and neither step is counted."""
    ends = []
    for f in (end_step, reference.end_step):
        counter, stop = torch.tensor([2], device=device), torch.tensor([stopped], dtype=torch.int32, device=device)
        history = torch.zeros(4, 2, device=device)
        going = f(torch.tensor(value, device=device), torch.tensor(0.5, device=device), counter, stop, history)
        assert going.dtype == torch.bool and going.shape == (1,)
        ends.append([going.tolist(), counter.tolist(), stop.tolist(), str(history.tolist())])
    assert ends[0] == ends[1]
    assert ends[0][0] == [stopped == 0 and math.isfinite(value)]


def test_settings_stand_in_their_columns():
    """A row holds each setting where its column says."""
    row = Setting.row(dropout=0.2, number=7, step=4, means_lr=1e-4, shift=(0.1, 0.5, 0.9))
    assert (row[Setting.DROPOUT], row[Setting.NUMBER], row[Setting.MEANS_LR], row[SHIFT]) == (0.2, 7, 1e-4, (0.1, 0.5, 0.9))
    assert row[Setting.STEP] == 4
    assert (row[Setting.RED], row[Setting.GREEN], row[Setting.BLUE]) == row[SHIFT] and len(row) == len(Setting)
