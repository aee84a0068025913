"""Every output of the rasterizer has a gradient, or refuses to take one; none drops it."""

import dataclasses

import pytest
import torch

from tests.gaussians import camera, cloud, leaves
from warpgs.errors import UsageError
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Render

OUTPUTS = [f.name for f in dataclasses.fields(Render) if f.name not in ("absgrad", "overflow")]
DIFFERENTIABLE = ("rgb", "alpha", "depth", "features", "projected")
WHOLE_NUMBERS = ("tile_counts", "heaviest_ids", "blend_counts")


@pytest.mark.parametrize("most", [None, 60], ids=["whole", "chunks"])
@pytest.mark.parametrize("name", [*OUTPUTS, "means2d"])
def test_a_gradient_reaches_the_gaussians_or_is_refused(device, name, most):
    """Alone, and beside an image that has one; what has none can be detached, and is plain where autograd is off."""
    gaussians, cam = leaves(cloud(60, device=device)), camera(40, 24, dtype=torch.float32, device=device)
    options = RasterizeOptions(
        features=torch.ones(60, 2, device=device), contributions=True, median_depth=True, heaviest=2, error_bound=True,
        max_instances=most,
    )  # fmt: skip
    render = rasterize(gaussians, cam, options)
    values = getattr(render, name)
    if name in WHOLE_NUMBERS:
        assert values.dtype == torch.int32
        return
    assert values.requires_grad and bool(values.any())
    if name in DIFFERENTIABLE:
        values.sum().backward()
        assert bool(gaussians.means.grad.any())
        return
    with pytest.raises(RuntimeError if name == "means2d" else UsageError, match=rf"{name} (has|passes) no gradient"):
        (render.rgb.sum() + values.sum()).backward()
    (render.rgb.sum() * values.detach().sum()).backward()
    assert bool(gaussians.means.grad.any())
    with torch.no_grad():
        plain = getattr(rasterize(gaussians, cam, options), name)
    assert not plain.requires_grad and torch.equal(plain, values)


def test_outputs_of_the_pixels_refuse_too(device):
    """A list of pixels in place of an image."""
    gaussians, cam = leaves(cloud(60, device=device)), camera(40, 24, dtype=torch.float32, device=device)
    pixels = torch.tensor([[3, 5], [30, 20]], device=device)
    render = rasterize(gaussians, cam, RasterizeOptions(pixels=pixels, median_depth=True))
    with pytest.raises(UsageError, match="median_depth has no gradient"):
        render.median_depth.sum().backward()
