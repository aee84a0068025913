"""Sizes at which Gaussians reach no camera, against distances in float64."""

import math

import pytest
import torch

from tests.reference.camera_reach import log_reach
from warpgs.kernels.neighbours import SMALLEST_REACH, camera_reach


@pytest.mark.parametrize("cameras", [1, 3, 32])
def test_it_is_the_fraction_of_the_distance_to_the_nearest(device, cameras):
    """Near and far ones, within a rounding of float32."""
    generator = torch.Generator().manual_seed(cameras)
    means = torch.randn(1000, 3, generator=generator) * torch.logspace(-3, 6, 1000)[:, None]
    centers = torch.randn(cameras, 3, generator=generator)
    exact = torch.from_numpy(log_reach(means.numpy(), centers.numpy(), 1 / 3, SMALLEST_REACH))
    found = camera_reach(means.to(device), centers.to(device), 1 / 3)
    assert found.dtype == torch.float32 and torch.allclose(found.cpu().double(), exact, rtol=1e-6, atol=1e-5)


def test_at_a_camera_and_without_gaussians(device):
    """The smallest size; nothing from nothing; a wrong shape is refused."""
    center = torch.tensor([[1.0, 2.0, 3.0]], device=device)
    assert float(camera_reach(center, center, 0.5)) == pytest.approx(math.log(SMALLEST_REACH))
    assert camera_reach(center[:0], center, 0.5).shape == (0,)
    with pytest.raises(ValueError, match="centers"):
        camera_reach(center, center[:, :2], 0.5)
