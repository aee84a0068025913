"""The bookkeeping of captured steps, against torch."""

import math

import pytest
import torch

from tests.kernels.test_guard_bytes import Guarded
from tests.reference import step_buffers as reference
from warpgs.kernels.update import NOT_FINITE, SHIFT, Setting, begin_step, end_step, squared_error


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


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (37, 111), (64, 64)])
def test_squared_errors_are_those_of_the_clamped_image(device, size):
    """Colours below 0 and above 1, images of part of a task and of several; a NaN stays one."""
    g = torch.Generator().manual_seed(0)
    rgb, target = 3 * torch.rand(*size, 3, generator=g) - 1, torch.rand(*size, 3, generator=g)
    wanted = reference.squared_error(rgb, target)
    found = squared_error(rgb.to(device), target.to(device))
    assert found.shape == () and abs(float(found) / float(wanted) - 1) < 1e-6
    rgb[0, 0, 1] = math.nan
    assert math.isnan(squared_error(rgb.to(device), target.to(device)))


def test_squared_errors_have_the_same_bits_on_any_number_of_threads():
    """Tasks do not depend on the number of threads."""
    rgb, target = torch.rand(2, 64, 128, 3, generator=torch.Generator().manual_seed(0))
    threads, found = torch.get_num_threads(), set()
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            found.add(float(squared_error(rgb, target)))
    finally:
        torch.set_num_threads(threads)
    assert len(found) == 1
