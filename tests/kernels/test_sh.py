"""Spherical harmonics against scipy, their gradients, and bad input."""

import pytest
import torch

from tests.reference.sh import basis_reference
from tests.reference.sh_polynomials import colors_reference
from tests.tolerances import close
from warpgs.kernels.sh import evaluate_sh


def inputs(dtype, device, count=50):
    generator = torch.Generator().manual_seed(1)
    sh = torch.randn(count, 16, 3, generator=generator, dtype=torch.float64)
    dirs = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=1)
    return sh.to(device, dtype), dirs.to(device, dtype)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_equal_scipy(device, dtype, degree):
    """Every basis function has scipy's value, up to the sign convention."""
    sh, dirs = inputs(dtype, device)
    count = (degree + 1) ** 2
    wanted = torch.einsum("nk,nkc->nc", basis_reference(dirs)[:, :count], sh.cpu().double()[:, :count])
    close("sh", evaluate_sh(sh, dirs, degree), wanted)


def test_the_polynomial_reference_equals_scipy():
    """The twin that other references use is itself right."""
    sh, dirs = inputs(torch.float64, "cpu")
    wanted = torch.einsum("nk,nkc->nc", basis_reference(dirs), sh)
    assert torch.allclose(colors_reference(sh, dirs, 3), wanted, atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradcheck(device, degree):
    """Finite differences agree with the backward kernel for coefficients and free directions."""
    sh, dirs = (t[:4].requires_grad_() for t in inputs(torch.float64, device))
    assert torch.autograd.gradcheck(lambda s, d: evaluate_sh(s, d, degree), (sh, dirs), eps=1e-6, atol=1e-8, rtol=1e-6)


def test_unused_coefficients_get_no_gradient(device):
    """Coefficients above the degree in use have a gradient of exactly zero."""
    sh, dirs = inputs(torch.float64, device)
    sh.requires_grad_()
    evaluate_sh(sh, dirs, 1).sum().backward()
    assert bool((sh.grad[:, 4:] == 0).all()) and bool((sh.grad[:, :4] != 0).any(-1).all())


def test_no_gaussians(device, dtype):
    """Nothing in, nothing out."""
    assert evaluate_sh(
        torch.zeros(0, 4, 3, dtype=dtype, device=device), torch.zeros(0, 3, dtype=dtype, device=device), 1
    ).shape == (0, 3)


def test_bad_input_names_the_argument():
    """A wrong shape, type or degree is refused with the argument's name."""
    sh, dirs = inputs(torch.float32, "cpu")
    with pytest.raises(ValueError, match="dirs"):
        evaluate_sh(sh, dirs[:, :2], 1)
    with pytest.raises(TypeError, match=r"dirs is torch\.float64"):
        evaluate_sh(sh, dirs.double(), 1)
    with pytest.raises(ValueError, match="sh holds 4 coefficients"):
        evaluate_sh(sh[:, :4], dirs, 2)
    with pytest.raises(ValueError, match="degree must be 0 to 3"):
        evaluate_sh(sh, dirs, 4)
    with pytest.raises(TypeError, match="float16"):
        evaluate_sh(sh.half(), dirs.half(), 1)
