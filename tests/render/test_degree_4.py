"""Spherical harmonics of degree 4: whole renders against references, turned scenes, coefficients that are not used."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, hand_placed, leaves
from tests.reference.blend import blend_reference
from tests.reference.project import project_reference
from tests.tolerances import close
from warpgs.pipeline.model.edit import rotate, rotation_about
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize


def test_images_and_gradients_equal_reference(device, dtype):
    """Through projection and blending, two cameras at once, so that coefficients get sums."""
    gaussians, cam = leaves(hand_placed(dtype, device, degree=4)), camera(cameras=2, dtype=dtype, device=device)
    r = rasterize(gaussians, cam, RasterizeOptions(rule=SMOOTH))
    other = [t.detach().cpu().double().requires_grad_() for t in (*gaussians.tensors().values(), cam.viewmat, cam.K)]
    parts = project_reference(*other, width=cam.width, height=cam.height, degree=4, low_pass=SMOOTH.low_pass)
    means, covs, colors, depths, opacities = parts
    size, black = (cam.width, cam.height), torch.zeros(3, dtype=torch.float64)
    images = [
        blend_reference(*p, opacities, *q, black, *size, SMOOTH)[0] for p, q in zip(zip(means, covs), zip(colors, depths))
    ]
    wanted = torch.stack(images)
    close("image", r.rgb, wanted)
    upstream = torch.randn(wanted.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (r.rgb * upstream.to(r.rgb)).sum().backward()
    (wanted * upstream).sum().backward()
    assert bool(gaussians.sh.grad[:, 16:].any())
    for a, b in zip(gaussians.tensors().values(), other):
        close("gradient", a.grad, b.grad)


@pytest.mark.parametrize("degree", [3, 4])
def test_a_turned_scene_with_its_camera_gives_the_same_image(device, dtype, degree):
    """Means, shapes and harmonics turn; colours and gradients of opacities stay."""
    turn = rotation_about(np.array([0.3, -0.8, 0.5]), 1.1)
    gaussians, cam = cloud(60, dtype, device, degree=degree), camera(40, 30, dtype=dtype, device=device)
    pose = torch.eye(4, dtype=dtype, device=device)
    pose[:3, :3] = torch.from_numpy(turn.T).to(pose)
    turned = dataclasses.replace(cam, viewmat=cam.viewmat @ pose)
    found = []
    for g, c in ((gaussians, cam), (rotate(gaussians, turn), turned)):
        g = leaves(g)
        r = rasterize(g, c)
        r.rgb.square().sum().backward()
        found.append((r.rgb, g.logit_opacities.grad))
    limit = 2e-5 if dtype == torch.float32 else 1e-12  # measured: 2.0e-6, 4.1e-15
    assert float((found[0][0] - found[1][0]).detach().abs().max()) <= limit
    assert float((found[0][1] - found[1][1]).norm()) <= 10 * limit * float(found[0][1].norm())
    unturned = rasterize(gaussians, turned).rgb
    assert float((unturned - found[0][0]).detach().abs().max()) > 0.01


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_lower_degrees_of_25_coefficients(device, degree):
    """The bits of those coefficients alone; those above may be NaN, and get gradients of 0."""
    gaussians, cam = cloud(60, device=device, degree=4), camera(40, 30, cameras=2, dtype=torch.float32, device=device)
    count = (degree + 1) ** 2
    gaussians.sh[:, count:] = math.nan
    found = []
    for sh in (gaussians.sh, gaussians.sh[:, :count].contiguous()):
        g = leaves(dataclasses.replace(gaussians, sh=sh))
        r = rasterize(g, cam, RasterizeOptions(sh_degree=degree))
        r.rgb.square().sum().backward()
        found.append((r.rgb, g.sh.grad, g.means.grad))
    (a, v, m), (b, w, n) = found
    assert torch.equal(a, b) and torch.equal(v[:, :count], w) and torch.equal(m, n) and not bool(v[:, count:].any())
