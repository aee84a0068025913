"""Sizes of a pixel at Gaussians, against angles and depths in float64."""

import math

import numpy as np
import pytest
import torch

from tests.reference.pixel_size import log_pixel
from tests.scenes import ring
from warpgs.kernels.neighbours import SMALLEST_PIXEL, pixel_size
from warpgs.pipeline.model.limits import TrainingCameras
from warpgs.scene import Camera

CPU = torch.device("cpu")


def rows(count: int, fisheye: float = 0.3) -> torch.Tensor:
    """Cameras about the origin that look anywhere; some are fisheyes, of which a few see more than half the space."""
    generator = np.random.default_rng(count)
    axes = generator.standard_normal((count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    wide = generator.random(count) < fisheye
    cosines = np.where(wide, generator.uniform(-1, 0.5, count), generator.uniform(0.5, 0.95, count))
    focal = generator.uniform(50, 500, count)
    columns = [generator.standard_normal((count, 3)), axes, focal[:, None], cosines[:, None], wide[:, None]]
    return torch.from_numpy(np.concatenate(columns, 1)).float()


@pytest.mark.parametrize("cameras", [1, 3, 40])
def test_it_is_the_smallest_pixel_of_those_that_see_it(device, cameras):
    """Near and far ones, within a rounding of float32; a mean on the rim of a cone may be seen or not."""
    generator = torch.Generator().manual_seed(cameras)
    means = torch.randn(2000, 3, generator=generator) * torch.logspace(-2, 4, 2000)[:, None]
    given = rows(cameras)
    exact = torch.from_numpy(log_pixel(means.numpy(), given.numpy(), 0.4, SMALLEST_PIXEL))
    found = pixel_size(means.to(device), given.to(device), 0.4).cpu().double()
    same = torch.isclose(found, exact, rtol=1e-5, atol=1e-5)
    assert found.dtype == torch.float64 and float(same.double().mean()) > 0.998
    seen = exact > math.log(2 * SMALLEST_PIXEL)
    assert bool(seen.any()) and (cameras == 40 or not bool(seen.all()))


def test_a_row_says_what_a_camera_sees(device):
    """Depth over focal length for a pinhole, for points in its image alone; distance for a fisheye; nothing without centre."""
    K = np.array([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]])
    pinhole = Camera(np.eye(4), K, 80, 60)
    means = torch.tensor([[0.0, 0, 5], [1.9, 1.4, 5], [4.0, 0, 5], [0, 0, -5]])
    rim = Camera(np.eye(4), K, 80, 60, "fisheye", np.zeros(4))
    for camera, wanted in (
        (pinhole, [0.05, 0.05, None, None]),
        (rim, [0.05, math.sqrt(1.9**2 + 1.4**2 + 25) / 100, None, None]),
        (Camera(np.eye(4), K, 80, 60, "orthographic"), [None] * 4),
    ):
        found = pixel_size(means.to(device), TrainingCameras.of([camera], device).rows, 1.0).cpu()
        for size, expected in zip(found.exp().tolist(), wanted, strict=True):
            assert size == pytest.approx(SMALLEST_PIXEL if expected is None else expected, rel=1e-5)
    both = TrainingCameras.of([pinhole, *ring(3)], device)
    assert both.rows.shape == (4, 9) and both.centers.shape == (4, 3)


def test_at_a_camera_and_without_gaussians(device):
    """The smallest size; nothing from nothing; a NaN is seen by none; a wrong shape is refused."""
    given = rows(1).to(device)
    assert float(pixel_size(given[:, :3].contiguous(), given, 0.5)) == pytest.approx(math.log(SMALLEST_PIXEL))
    assert pixel_size(given[:0, :3], given, 0.5).shape == (0,)
    broken = torch.full((1, 3), math.nan, device=device)
    assert float(pixel_size(broken, given, 0.5)) == pytest.approx(math.log(SMALLEST_PIXEL))
    with pytest.raises(ValueError, match="cameras"):
        pixel_size(given[:, :3].contiguous(), given[:, :4], 0.5)
