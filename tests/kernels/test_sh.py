"""Spherical harmonics against scipy, by way of the projection that uses them: values, gradients, unused coefficients."""

import numpy as np
import pytest
import torch

from bench.lib.kernel_calls import project
from tests.reference.sh import basis_reference, colors_reference
from tests.tolerances import close
from warpgs.constants import RULES
from warpgs.geometry import look_at
from warpgs.kernels import sh

COUNT = 24


def inputs(dtype, device, count=COUNT):
    generator = torch.Generator().manual_seed(1)
    coefficients = torch.randn(count, 25, 3, generator=generator, dtype=torch.float64)
    coefficients[:, 0] += 8 / sh.C0  # no colour is clamped at zero
    dirs = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=1)
    up = np.array([0.3, 0.5, 0.8])
    viewmats = torch.stack([torch.from_numpy(look_at(np.zeros(3), d.numpy(), up)) for d in dirs])
    return coefficients.to(device, dtype), dirs.to(device, dtype), viewmats.to(device, dtype)


def colors(coefficients, means, viewmats, degree):
    count, K = len(means), torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]).to(means)
    quats, log_scales = means.new_zeros(count, 4), means.new_full((count, 3), -3.0)
    quats[:, 0] = 1
    projected, _ = project(
        means, quats, log_scales, means.new_zeros(count), coefficients, viewmats, K.expand(count, 3, 3).contiguous(),
        width=16, height=16, degree=degree, rule=RULES["exact"],
    )  # fmt: skip
    rows = torch.arange(count, device=means.device)
    return projected[rows, rows, 6:9]


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_values_equal_scipy(device, dtype, degree):
    coefficients, dirs, viewmats = inputs(dtype, device)
    count = (degree + 1) ** 2
    basis = basis_reference(dirs)[:, :count]
    wanted = 0.5 + torch.einsum("nk,nkc->nc", basis, coefficients.cpu().double()[:, :count])
    close("sh", colors(coefficients, 2 * dirs, viewmats, degree), wanted)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_gradcheck(device, degree):
    coefficients, dirs, viewmats = inputs(torch.float64, device, 4)
    leaves = [(0.3 * coefficients).requires_grad_(), (1.5 * dirs).requires_grad_()]
    assert torch.autograd.gradcheck(
        lambda c, m: colors(c, m, viewmats, degree), leaves, eps=1e-6, atol=1e-8, rtol=1e-6, nondet_tol=0.0
    )


def test_the_torch_references_equal_scipy_and_a_degree_out_of_range_is_refused():
    coefficients, dirs, _ = inputs(torch.float64, "cpu")
    wanted = torch.einsum("nk,nkc->nc", basis_reference(dirs), coefficients)
    assert torch.allclose(colors_reference(coefficients, dirs, 4), wanted, atol=1e-12)
    assert torch.allclose(sh.basis(dirs), basis_reference(dirs), atol=1e-14)
    for degree in (-1, 5):
        with pytest.raises(ValueError, match="degree must be 0 to 4"):
            sh.coefficient_count(degree)
