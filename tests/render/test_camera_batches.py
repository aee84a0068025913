"""Cameras and Gaussians brought together: shared intrinsics and lenses, errors of those that do not fit, and devices."""

import dataclasses

import pytest
import torch

from tests.gaussians import camera, cloud, leaves
from warpgs.render.rasterize import rasterize

COEFFICIENTS = {"fisheye": 4, "opencv": 8}


@pytest.mark.parametrize("model", COEFFICIENTS)
def test_one_row_of_coefficients_is_for_all_cameras(device, model):
    """As the same row for each camera; numpy coefficients work too."""
    gaussians, cam = cloud(50, device=device), camera(20, 12, cameras=2, dtype=torch.float32, device=device)
    row = 0.01 * torch.arange(1, COEFFICIENTS[model] + 1, device=device)
    cam = dataclasses.replace(cam, model=model)
    each = rasterize(gaussians, dataclasses.replace(cam, distortion=row.expand(2, -1).contiguous())).rgb
    assert bool(each.any())
    for shared in (row, row.cpu().numpy()):
        assert torch.equal(rasterize(gaussians, dataclasses.replace(cam, distortion=shared)).rgb, each)


def test_one_K_is_for_all_cameras(device):
    """Its gradient is the sum of those of the cameras."""
    gaussians, cam = cloud(50, device=device), camera(20, 12, cameras=2, dtype=torch.float32, device=device)
    shared, each = cam.K[0].clone().requires_grad_(), cam.K[:1].repeat(2, 1, 1).requires_grad_()
    images = [rasterize(gaussians, dataclasses.replace(cam, K=K)).rgb for K in (shared, each)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    assert torch.allclose(shared.grad, each.grad.sum(0)) and bool(shared.grad.any())


@pytest.mark.parametrize(
    "change, message",
    [
        ({"K": torch.eye(3).repeat(3, 1, 1)}, r"camera\.K must have shape \[3, 3\] or \[2, 3, 3\].*, not \[3, 3, 3\]"),
        ({"viewmat": torch.eye(4)}, r"camera\.K must have shape \[3, 3\] or \[1, 3, 3\].*camera\.viewmat.*, not \[2, 3, 3\]"),
        ({"distortion": torch.zeros(3, 4)}, r"camera\.distortion must have shape \[4\] or \[2, 4\].*, not \[3, 4\]"),
    ],
    ids=["K", "viewmat", "distortion"],
)
def test_cameras_that_do_not_fit_together(change, message):
    """The error names the camera's own field, and the shape that was given."""
    cam = dataclasses.replace(camera(20, 12, cameras=2, dtype=torch.float32), model="fisheye", distortion=torch.zeros(4))
    with pytest.raises(ValueError, match=message):
        rasterize(cloud(5), dataclasses.replace(cam, **change))


def test_gaussians_move_to_a_device(device):
    """All five tensors, with gradients back to those that moved."""
    gaussians = leaves(cloud(5))
    moved = gaussians.to(device)
    assert all(t.device.type == device.type for t in moved.tensors().values())
    rasterize(moved, camera(20, 12, dtype=torch.float32)).rgb.sum().backward()
    assert gaussians.means.grad.device.type == "cpu" and bool(gaussians.means.grad.any())
