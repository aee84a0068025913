"""SSIM against a convolution, its gradient, constant images, and images smaller than the window."""

import pytest
import torch

from tests.reference.ssim import ssim_reference
from tests.tolerances import close
from warpgs.kernels.ssim import differences, ssim

SIZES = [(1, 1), (1, 17), (17, 1), (5, 7), (9, 5), (9, 6), (10, 11), (16, 16), (15, 32), (32, 17), (17, 33), (33, 47)]


def images(height, width, dtype=torch.float64, device="cpu"):
    generator = torch.Generator().manual_seed(height * 100 + width)
    pair = torch.rand(2, height, width, 3, generator=generator, dtype=torch.float64)
    return pair[0].to(device, dtype), pair[1].to(device, dtype)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_maps_sums_and_gradients_equal_the_convolution(device, dtype, height, width):
    """Every pixel, border included, equals the dense computation; some pixels are equal, where |a - b| has no slope."""
    image, target = images(height, width, dtype, device)
    image[:2] = target[:2]
    weights, target64 = images(height, width)[1], target.cpu().double()
    for summed in (False, True):
        leaf, image64 = image.clone().requires_grad_(), image.detach().cpu().double().requires_grad_()
        wanted = ssim_reference(image64, target64)
        if summed:
            wanted, weights = torch.stack([(1 - wanted).sum(), (image64 - target64).abs().sum()]), torch.tensor([0.2, 0.8])
        found = (differences if summed else ssim)(leaf, target)
        (found * weights.to(found)).sum().backward()
        (wanted * weights).sum().backward()
        if bool(wanted.detach().any()):
            close("ssim", found, wanted)
        if bool((image64.grad.abs() > 1e-12).any()):
            close("gradient", leaf.grad, image64.grad)


def test_gradcheck_and_batches(device):
    image, target = images(7, 9, device=device)
    assert torch.autograd.gradcheck(lambda a: ssim(a, target), [image.requires_grad_()], eps=1e-6, atol=1e-8, rtol=1e-5)
    image, target = (torch.stack([t, t.flip(0)]) for t in images(10, 9, device=device))
    assert torch.autograd.gradcheck(lambda a: differences(a, target), [image.requires_grad_()], eps=1e-6, atol=1e-7, rtol=1e-5)
    a, b = images(20, 21, torch.float32, device)
    batch = ssim(torch.stack([a, b]), torch.stack([b, a]))
    assert torch.equal(batch[0], ssim(a, b)) and torch.equal(batch[1], ssim(b, a))


def test_bad_input_names_the_argument():
    a, b = images(8, 9)
    with pytest.raises(TypeError, match=r"image must be float32 or float64, .* image\.float\(\) / 255 converts it"):
        ssim((255 * a).byte(), (255 * b).byte())
    with pytest.raises(ValueError, match="target"):
        ssim(a, b[:5])
    with pytest.raises(ValueError, match="image"):
        ssim(a[..., :2], b[..., :2])
    with pytest.raises(TypeError, match="target"):
        ssim(a, b.float())
