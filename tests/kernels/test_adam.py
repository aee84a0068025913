"""The fused Adam step against torch's."""

import pytest
import torch

from tests.reference.adam import adam_reference
from warpgs.kernels.update import adam_step


def run(param, grads, **options):
    """The parameter after one fused step per gradient, with its moments."""
    param, mean, square = param.clone(), torch.zeros_like(param), torch.zeros_like(param)
    for i, grad in enumerate(grads, 1):
        adam_step(param, grad, mean, square, step=i, **options)
    return param, mean, square


def problem(dtype, device, shape=(1500, 4, 3)):
    generator = torch.Generator().manual_seed(0)
    param = torch.randn(shape, generator=generator, dtype=torch.float64)
    grads = [torch.randn(shape, generator=generator, dtype=torch.float64) * 10.0**-i for i in range(4)]
    return param.to(device, dtype), [g.to(device, dtype) for g in grads]


def test_steps_equal_torch(device, dtype):
    """Four steps move every element as torch.optim.Adam does."""
    param, grads = problem(dtype, device)
    found, _, _ = run(param, grads, lr=0.01)
    wanted = adam_reference(param.cpu().double(), [g.cpu().double() for g in grads], 0.01)
    moved = (wanted - param.cpu().double()).abs().max()
    assert float((found.cpu().double() - wanted).abs().max()) <= (1e-5 if dtype == torch.float32 else 1e-13) * float(moved)


@pytest.mark.parametrize("shape", [(50, 4, 3), (701, 9, 3), (701, 16, 3), (999, 1, 3)])
def test_head_of_a_row_takes_its_own_rate(device, dtype, shape):
    """The first columns move with head_lr, all others with lr; rows cross lanes, segments and groups of four."""
    param, grads = problem(dtype, device, shape)
    lrs = torch.full((shape[0], shape[1] * 3), 0.01, dtype=torch.float64)
    lrs[:, :3] = 0.2
    found, _, _ = run(param, grads, lr=0.01, head_lr=0.2, head=3)
    wanted = adam_reference(param.cpu().double(), [g.cpu().double() for g in grads], lrs.view(shape))
    assert torch.allclose(found.cpu().double(), wanted, atol=1e-5 if dtype == torch.float32 else 1e-12)


def test_zero_gradient_moves_nothing(device, dtype):
    """No gradient, no step and no NaN, although both moments are zero."""
    param, _ = problem(dtype, device)
    found, mean, square = run(param, [torch.zeros_like(param)], lr=0.1)
    assert torch.equal(found, param) and not bool(mean.any()) and not bool(square.any())


def test_threads_do_not_change_the_bits():
    """One thread and two give the same parameter."""
    param, grads = problem(torch.float32, "cpu", (40_000, 4, 3))
    torch.set_num_threads(1)
    one = run(param, grads, lr=0.01)
    torch.set_num_threads(2)
    assert all(torch.equal(a, b) for a, b in zip(one, run(param, grads, lr=0.01)))


def test_empty_and_bad_input():
    """No rows are fine; a wrong shape, an odd layout or step 0 is refused."""
    empty = torch.zeros(0, 3)
    adam_step(empty, empty, empty.clone(), empty.clone(), lr=0.1, step=1)
    a = torch.zeros(4, 3)
    with pytest.raises(ValueError, match="grad"):
        adam_step(a, torch.zeros(3, 3), a.clone(), a.clone(), lr=0.1, step=1)
    with pytest.raises(ValueError, match="contiguous"):
        adam_step(torch.zeros(3, 4).T, a, a.clone(), a.clone(), lr=0.1, step=1)
    with pytest.raises(ValueError, match="step must be at least 1"):
        adam_step(a, a.clone(), a.clone(), a.clone(), lr=0.1, step=0)
