"""SSIM against a convolution, its gradient, constant images, and images smaller than the window."""

import pytest
import torch

from tests.reference.ssim import ssim_reference
from tests.tolerances import close
from warpgs.kernels.ssim import differences, ssim

SIZES = [
    (1, 1),
    (1, 17),
    (17, 1),
    (5, 7),
    (9, 5),
    (9, 6),
    (10, 11),
    (16, 16),
    (15, 32),
    (32, 17),
    (17, 33),
    (33, 47),
]


def images(height, width, dtype=torch.float64, device="cpu"):
    generator = torch.Generator().manual_seed(height * 100 + width)
    pair = torch.rand(2, height, width, 3, generator=generator, dtype=torch.float64)
    return pair[0].to(device, dtype), pair[1].to(device, dtype)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_map_and_gradient_equal_the_convolution(device, dtype, height, width):
    """Every pixel, border included, equals the dense computation; so does the gradient."""
    image, target = images(height, width, dtype, device)
    leaf, image64 = image.requires_grad_(), image.detach().cpu().double().requires_grad_()
    weights = images(height, width)[1]
    found, wanted = ssim(leaf, target), ssim_reference(image64, target.cpu().double())
    close("ssim", found, wanted)
    (found * weights.to(found)).sum().backward()
    (wanted * weights).sum().backward()
    close("gradient", leaf.grad, image64.grad)


def test_gradcheck(device):
    """Finite differences agree with the backward kernels."""
    image, target = images(7, 9, device=device)
    assert torch.autograd.gradcheck(lambda a: ssim(a, target), [image.requires_grad_()], eps=1e-6, atol=1e-8, rtol=1e-5)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_summed_differences_equal_the_maps(device, dtype, height, width):
    """The two sums and their gradient are those of the dense maps; some pixels are equal, where |a - b| has no slope."""
    image, target = images(height, width, dtype, device)
    image[:2] = target[:2]
    leaf, image64 = image.requires_grad_(), image.detach().cpu().double().requires_grad_()
    target64 = target.cpu().double()
    found = differences(leaf, target)
    wanted = torch.stack([(1 - ssim_reference(image64, target64)).sum(), (image64 - target64).abs().sum()])
    if bool(wanted.detach().any()):
        close("ssim", found, wanted)
    (0.2 * found[0] + 0.8 * found[1]).backward()
    (0.2 * wanted[0] + 0.8 * wanted[1]).backward()
    if bool((image64.grad.abs() > 1e-12).any()):
        close("gradient", leaf.grad, image64.grad)


def test_gradcheck_of_the_sums(device):
    """Finite differences agree with the gradient of both sums, over a batch."""
    image, target = (torch.stack([t, t.flip(0)]) for t in images(10, 9, device=device))
    assert torch.autograd.gradcheck(lambda a: differences(a, target), [image.requires_grad_()], eps=1e-6, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("value", [0.0, 0.5, 0.6, 1.0])
def test_identical_constant_images_are_alike(device, dtype, value):
    """Rounding must not push a similarity above 1, nor make its gradient anything but finite."""
    image = torch.full((24, 20, 3), value, dtype=dtype, device=device, requires_grad=True)
    result = ssim(image, image.detach())
    result.sum().backward()
    assert bool((result.detach() == 1).all())
    assert bool(torch.isfinite(image.grad).all())


def test_batch_equals_single_images(device):
    """A batch gives the same bits as its images one by one."""
    a, b = images(20, 21, torch.float32, device)
    batch = ssim(torch.stack([a, b]), torch.stack([b, a]))
    assert torch.equal(batch[0], ssim(a, b)) and torch.equal(batch[1], ssim(b, a))


def test_threads_do_not_change_the_bits():
    """One thread and two give the same map."""
    a, b = images(200, 150, torch.float32)
    torch.set_num_threads(1)
    one, sums = ssim(a, b), differences(a, b)
    torch.set_num_threads(2)
    assert torch.equal(one, ssim(a, b)) and torch.equal(sums, differences(a, b))


def test_bad_input_names_the_argument():
    """Shapes that disagree are refused."""
    a, b = images(8, 9)
    with pytest.raises(ValueError, match="target"):
        ssim(a, b[:5])
    with pytest.raises(ValueError, match="image"):
        ssim(a[..., :2], b[..., :2])
    with pytest.raises(TypeError, match="target"):
        ssim(a, b.float())
