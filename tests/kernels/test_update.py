"""Updates of a step: Adam, dropout, the decay of opacities, and the bookkeeping of captured steps."""

import math

import numpy as np
import pytest
import torch

from bench.lib.kernel_calls import adam_step
from tests.kernels.test_guard_bytes import Guarded
from tests.reference import update as reference
from tests.reference.update import adam_reference, decayed, expected_factors
from warpgs.kernels.update import (
    NOT_FINITE,
    Setting,
    adam_scheduled,
    begin_step,
    end_step,
    opacity_decay,
    opacity_dropout,
    scheduled_lrs,
    squared_error,
)


def run(param, grads, **options):
    param, mean, square = param.clone(), torch.zeros_like(param), torch.zeros_like(param)
    for i, grad in enumerate(grads, 1):
        adam_step(param, grad, mean, square, step=i, **options)
    return param, mean, square


def problem(dtype, device, shape=(1500, 4, 3)):
    generator = torch.Generator().manual_seed(0)
    param = torch.randn(shape, generator=generator, dtype=torch.float64)
    grads = [torch.randn(shape, generator=generator, dtype=torch.float64) * 10.0**-i for i in range(4)]
    return param.to(device, dtype), [g.to(device, dtype) for g in grads]


@pytest.mark.parametrize(("shape", "head"), [((1500, 4, 3), 0), ((50, 4, 3), 3), ((701, 16, 3), 3), ((999, 1, 3), 3)])
def test_steps_equal_torch(device, dtype, shape, head):
    """Four steps, also with a rate of their own for the first columns; rows cross lanes, segments and groups of four."""
    param, grads = problem(dtype, device, shape)
    lrs = torch.full((shape[0], shape[1] * 3), 0.01, dtype=torch.float64)
    lrs[:, :head] = 0.2
    found, _, _ = run(param, grads, lr=0.01, head_lr=0.2, head=head)
    start = param.cpu().double()
    wanted = adam_reference(start, [g.cpu().double() for g in grads], lrs.view(shape))
    moved = float((wanted - start).abs().max())
    assert float((found.cpu().double() - wanted).abs().max()) <= (1e-5 if dtype == torch.float32 else 1e-13) * moved


def test_zero_gradient_moves_nothing(device, dtype):
    """No gradient, no step and no NaN, although both moments are zero; no rows are fine."""
    param, _ = problem(dtype, device)
    found, mean, square = run(param, [torch.zeros_like(param)], lr=0.1)
    assert torch.equal(found, param) and not bool(mean.any()) and not bool(square.any())
    empty = torch.zeros(0, 3)
    skip = torch.zeros(1, dtype=torch.int32)
    adam_scheduled(empty, empty, empty.clone(), empty.clone(), torch.tensor(scheduled_lrs(0.1, 1)), skip, head=0)


COUNT = 20_000


def factors(device, p: float, step: int = 1, seed: int = 0) -> torch.Tensor:
    settings = Setting.row(dropout=p, number=step, step=step, means_lr=0.1, shift=(0.2, 0.3, 0.4))
    return opacity_dropout(COUNT, torch.tensor(settings, dtype=torch.float32, device=device), seed)


def test_factors_are_as_frequent_as_they_should_and_follow_from_seed_and_step(device):
    """Within 3.9 standard deviations; another step or seed hides others, neighbours are independent, and p = 0 hides none."""
    for p, step, seed in ((0.2, 1, 0), (0.05, 9_999, 0), (0.5, 3, 7)):
        values, chances = expected_factors(p)
        drawn = factors(device, p, step, seed).double().cpu()
        dropped = int((drawn == 0).sum())
        assert torch.allclose(drawn[drawn > 0], torch.tensor(values[1]), rtol=1e-6)
        assert abs(dropped - COUNT * chances[0]) < 3.9 * (COUNT * chances.prod()) ** 0.5
    first = factors(device, 0.5, 4, 2)
    assert torch.equal(first, factors(device, 0.5, 4, 2)) and bool((factors(device, 0.0) == 1).all())
    for other in (factors(device, 0.5, 5, 2), factors(device, 0.5, 4, 3)):
        assert 0.45 < float((first == other).float().mean()) < 0.55
    hidden = (first == 0).double()
    assert abs(float(torch.corrcoef(torch.stack([hidden[1:], hidden[:-1]]))[0, 1])) < 0.03
    with pytest.raises(ValueError, match="settings"):
        opacity_dropout(3, torch.zeros(3), 0)


@pytest.mark.cuda
def test_every_device_draws_the_same():
    assert torch.equal(factors("cpu", 0.3, 17), factors("cuda", 0.3, 17).cpu())


@pytest.mark.parametrize("factor", [0.5, 0.995, 0.999, 1 - 1e-6])
def test_opacities_are_multiplied(device, factor):
    logits = torch.linspace(-20, 20, 1001)
    found = opacity_decay(logits.to(device), factor).cpu().numpy()
    assert np.abs(found - decayed(logits.numpy(), factor)).max() <= 1e-6
    assert (found < logits.numpy()).all() or factor > 0.999


def test_ends_and_what_is_no_number(device):
    """An opacity of 1 becomes the factor, one of 0 stays; a NaN is not hidden; nothing from nothing."""
    found = opacity_decay(torch.tensor([np.inf, -np.inf, np.nan, -100.0], device=device), 0.75).cpu()
    assert float(found[0].sigmoid()) == pytest.approx(0.75) and float(found[1]) == -np.inf and bool(found[2].isnan())
    assert float(found[3]) == pytest.approx(-100 + np.log(0.75), abs=1e-5)
    assert opacity_decay(found[:0].to(device), 0.5).shape == (0,)
    for wrong in (0.0, 1.0, np.nan):
        with pytest.raises(ValueError, match="factor"):
            opacity_decay(found.to(device), wrong)


def rows(device, height=5, width=7, views=3, steps=4) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    shapes = ((steps, 15), (steps, 2), (views, 4, 4), (views, 3, 3), (views, height, width, 3))
    return [torch.rand(s, generator=g).to(device) for s in shapes]


@pytest.mark.parametrize("size", [(5, 7), (1, 1), (1, 2), (33, 65)])
def test_a_step_finds_its_own(device, size):
    given, views = rows(device, *size), torch.tensor([2, 0, 1, 0], device=device)
    for step in range(4):
        counter = torch.tensor([step], device=device)
        found, wanted = (f(counter, views, *given) for f in (begin_step, reference.begin_step))
        assert all(a.shape == b.shape and torch.equal(a, b) for a, b in zip(found, wanted, strict=True))


def test_nothing_is_written_beside_what_a_step_finds(device):
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


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (37, 111)])
def test_squared_errors_are_those_of_the_clamped_image(device, size):
    """Colours below 0 and above 1, images of part of a task and of several; a NaN stays one."""
    g = torch.Generator().manual_seed(0)
    rgb, target = 3 * torch.rand(*size, 3, generator=g) - 1, torch.rand(*size, 3, generator=g)
    wanted = reference.squared_error(rgb, target)
    found = squared_error(rgb.to(device), target.to(device))
    assert found.shape == () and abs(float(found) / float(wanted) - 1) < 1e-6
    rgb[0, 0, 1] = math.nan
    assert math.isnan(squared_error(rgb.to(device), target.to(device)))
