"""The roughness of depth against whole maps, its gradient, what hides a pixel, and shapes."""

import pytest
import torch

from tests.reference.roughness import roughness_reference
from tests.tolerances import close
from warpgs.kernels.roughness import MIN_ALPHA, roughness

SIZES = [(1, 1), (1, 5), (5, 1), (2, 2), (2, 3), (3, 3), (7, 9), (33, 20)]


def maps(height: int, width: int, dtype=torch.float64, device="cpu") -> list[torch.Tensor]:
    """Depth with some bends beyond the bound, opacity, edges, weight and mask, with some hidden pixels, whose depth is 0."""
    g = torch.Generator().manual_seed(100 * height + width)
    sides = (width, height), (width, height), (width - 2, height), (width, height - 2), (width, height), (width, height)
    depth, alpha, rows, columns, weight, mask = (
        torch.rand(max(0, y), max(0, x), generator=g, dtype=torch.float64) for x, y in sides
    )
    alpha, mask = MIN_ALPHA * (0.9 + 0.2 * (alpha > 0.1)), (mask > 0.1).double()
    depth = torch.where(alpha > MIN_ALPHA, 2 + 0.15 * depth, 0)
    return [t.to(device, dtype) for t in (depth, alpha, rows, columns, weight, mask)]


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_the_map_equals_the_reference_and_the_gradient_has_its_bits(device, dtype, height, width):
    """With and without a mask, for any gradient of the map: fits are the same as with torch's kernels."""
    depth, *others = maps(height, width, dtype, device)
    depth, v = depth.requires_grad_(), others[3]
    for mask in (others[-1], None):
        found, wanted = (f(depth, *others[:-1], mask) for f in (roughness, roughness_reference))
        close("image", found, wanted.double())
        assert torch.equal(*(torch.autograd.grad(values, depth, v)[0] for values in (found, wanted)))


def test_gradcheck_and_an_opacity_that_is_nan(device):
    depth, *others = maps(7, 6, device=device)
    depth = depth + (depth == 0)
    assert torch.autograd.gradcheck(lambda d: roughness(d, *others), [depth.requires_grad_()])
    depth, alpha, *others, _ = maps(3, 3)
    alpha, depth = torch.full_like(alpha, torch.nan), torch.full_like(depth, torch.nan)
    assert roughness(depth, alpha, *others, None).isnan().sum() == 5  # all but the corners
    with pytest.raises(ValueError, match="alpha must have shape"):
        roughness(depth, alpha[:2], *others, None)
