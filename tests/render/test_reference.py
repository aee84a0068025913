"""The float64 image against the tests' reference, the float64 kernels, and with a Gaussian in the way."""

import dataclasses

import pytest
import torch

from tests.gaussians import camera, cloud, hand_placed
from tests.reference.blend import blend_reference
from tests.reference.project import project_reference
from warpgs.constants import RULES
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.render.reference import reference_image

BACKGROUND = torch.tensor([0.2, 0.5, 0.7], dtype=torch.float64)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_equals_the_reference(degree):
    """The image is that of the loop over Gaussians, in another structure; two of the Gaussians are clamped at the frustum."""
    g, cam, rule = hand_placed(), camera(), RULES["exact"]
    projected = project_reference(
        *g.tensors().values(), cam.viewmat[None], cam.K[None], width=18, height=17, degree=degree, low_pass=rule.low_pass
    )
    means, covs, colors, depths, opacities = (t[0] if t.ndim > 1 else t for t in projected)
    wanted = blend_reference(means, covs, opacities, colors, depths, BACKGROUND, 18, 17, rule)[0]
    found = reference_image(g, cam, (0, 0, 18, 17), BACKGROUND, degree)
    assert float((found - wanted).abs().max()) < 1e-13 and float((wanted - BACKGROUND).abs().max()) > 0.1
    crop = reference_image(g, cam, (5, 3, 9, 8), BACKGROUND, degree)
    assert float((crop - wanted[3:11, 5:14]).abs().max()) < 1e-13


def test_equals_the_kernels(device):
    """A cloud dense enough that pixels stop early; the kernels in float64."""
    g, cam = cloud(600, torch.float64, device), camera(75, 53, device=device)
    g = dataclasses.replace(g, logit_opacities=g.logit_opacities + 4)
    wanted = rasterize(g, cam, RasterizeOptions(background=BACKGROUND))
    found = reference_image(g, cam, (16, 0, 59, 53), BACKGROUND.to(device), 1)
    assert float((found - wanted.rgb[:, 16:]).abs().max()) < 1e-12
    assert float((1 - wanted.alpha).min()) < 1e-4  # some pixels stopped


def test_what_is_not_drawn_does_not_show(device):
    """Behind the camera, and fainter than the cut: the background to the bit."""
    g, cam = cloud(20, torch.float64, device), camera(device=device)
    for hidden in (
        dataclasses.replace(g, means=-g.means),
        dataclasses.replace(g, logit_opacities=torch.full_like(g.logit_opacities, -6)),
    ):
        found = reference_image(hidden, cam, (0, 0, 18, 17), BACKGROUND.to(device), 1)
        assert torch.equal(found, BACKGROUND.to(device).expand_as(found))
