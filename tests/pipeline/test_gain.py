"""Gain of a fine Gaussian against the fall of the squared error that a render with it shows."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.scenes import ring
from tests.tolerances import GAIN
from warpgs.constants import LOW_PASS, Rule
from warpgs.pipeline.train.sampling import EVERY, SamplerConfig, fine_gaussians, gain_map, gains, residual_of
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import C0, Camera, Gaussians, View

CPU = torch.device("cpu")
SIZE = (64, 48)
FOOTPRINT = 3.0
OPTIONS = RasterizeOptions(rule=Rule("uncut", alpha_cut=1e-6), background=torch.zeros(3))


def wall() -> Gaussians:
    """A gray wall through the origin, across the view axes, of many flat Gaussians."""
    y, x = torch.meshgrid(torch.linspace(-1.5, 1.5, 41), torch.linspace(-2, 2, 55), indexing="ij")
    means = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    count = len(means)
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    scales = torch.tensor([0.08, 0.08, 1e-3]).log().repeat(count, 1)
    return Gaussians(means, quats, scales, torch.full((count,), 4.0), torch.full((count, 1, 3), (0.5 - 0.5) / C0))


def cameras() -> list[Camera]:
    """Two cameras side by side that face the wall."""
    K = np.array([[80.0, 0, 32.7], [0, 80, 23.6], [0, 0, 1]])
    found = []
    for x in (-0.15, 0.15):
        viewmat = np.eye(4)
        viewmat[:3, 3] = x, 0, 2.2
        found.append(Camera(viewmat, K, *SIZE))
    return found


def views(paint=lambda image, number: image) -> list[TrainingView]:
    """Two views of the wall, with something else on their images."""
    found = []
    for number, camera in enumerate(cameras()):
        rgb = rasterize(wall(), camera, OPTIONS).rgb.clamp(0, 1).numpy()
        found.append(TrainingView.of(View(f"{number}.png", camera, paint(rgb, number)), CPU))
    return found


def blob(image: np.ndarray, number: int) -> np.ndarray:
    """Add waves of colour, other ones in each view."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    waves = np.stack([np.sin(0.21 * x + number), np.sin(0.17 * y), np.cos(0.13 * x + 0.19 * y)], -1)
    return (image + 0.2 * waves).clip(0, 1).astype(np.float32)


def residuals(shown: list[TrainingView]):
    renders = [rasterize(wall(), v.camera, OPTIONS) for v in shown]
    return [residual_of(v, r.rgb, r.depth, FOOTPRINT) for v, r in zip(shown, renders)]


def squared_error(gaussians: Gaussians, shown: list[TrainingView]) -> float:
    return sum(float((rasterize(gaussians, v.camera, OPTIONS).rgb.double() - v.image).square().sum()) for v in shown)


def test_gain_is_the_fall_of_the_error_of_all_views():
    """A faint Gaussian just before the wall: what it changes in both renders, up to the area of its footprint."""
    shown = views(blob)
    view, before = shown[0], squared_error(wall(), shown)
    at = torch.tensor([[24, 30], [18, 22], [30, 40], [22, 44], [28, 18]])
    depth = 0.999 * rasterize(wall(), view.camera, OPTIONS).depth
    opacity = 1e-2
    rows = fine_gaussians(view.camera, view.image, depth, at, SamplerConfig(footprint=FOOTPRINT, opacity=opacity), 1)
    area = 2 * np.pi * (FOOTPRINT**2 + LOW_PASS)  # of the footprint as it is rendered
    expected = gains(rows["means"], view.image[at[:, 0], at[:, 1]], residuals(shown))
    measured = []
    for i in range(len(at)):
        both = Gaussians(**{n: torch.cat([t, rows[n][i : i + 1]]) for n, t in wall().tensors().items()})
        measured.append((before - squared_error(both, shown)) / (2 * opacity * area))
    scale = float(np.abs(measured).max())
    np.testing.assert_allclose(expected.numpy() / scale, np.array(measured) / scale, atol=GAIN)


def test_gain_counts_where_a_point_is_seen_and_pixels_count():
    """None behind the wall, outside of the image, or where masks leave out every pixel."""
    shown = views(blob)
    center = shown[0].camera.viewmat[:3, :3].T @ -shown[0].camera.viewmat[:3, 3]
    behind, aside = -0.4 * center[None], center[None] + 50 * shown[0].camera.viewmat[:3, :3].T[:, :1].T
    white = torch.ones(1, 3)
    assert float(gains(torch.zeros(1, 3), white, residuals(shown)).abs()) > 0
    assert gains(behind, white, residuals(shown)[:1]).item() == gains(aside, white, residuals(shown)[:1]).item() == 0
    masked = [dataclasses.replace(v, mask=torch.zeros_like(v.image[..., 0])) for v in shown]
    assert gains(torch.zeros(1, 3), white, residuals(masked)).item() == 0


def test_a_residual_that_other_views_contradict_has_no_gain():
    """A bright patch in one view: a gain alone, none beside a view in which the same wall is darker than its render."""

    def patch(image, number):
        changed = image.copy()
        rows, columns = (slice(18, 30), slice(26, 38)) if number == 0 else (slice(0, 48), slice(0, 64))
        changed[rows, columns] += 0.3 if number == 0 else -0.3
        return changed.clip(0, 1)

    shown, sized = views(patch), (SIZE[1], SIZE[0])
    found, depth = residuals(shown), rasterize(wall(), shown[0].camera, OPTIONS).depth
    valid = depth > 0
    alone, both = gain_map(shown[0], depth, valid, found[:1]), gain_map(shown[0], depth, valid, found)
    assert alone.shape == both.shape == sized and float(alone[24, 32]) > 0.01 and float(both[24, 32]) == 0
    assert float(alone[4, 4]) < 1e-3 * float(alone[24, 32])
    assert torch.equal(alone[::EVERY, ::EVERY], alone[1::EVERY, 1::EVERY])
    assert not bool(gain_map(shown[0], depth, ~valid, found).any())


@pytest.mark.parametrize("size", [(3, 5), (1, 1), (2, 9)])
def test_tiny_images_have_a_gain_map(size):
    """Images smaller than the footprint, of odd sides."""
    width, height = size
    camera = dataclasses.replace(ring(1)[0], width=width, height=height)
    view = TrainingView.of(View("a.png", camera, np.full((height, width, 3), 0.7, np.float32)), CPU)
    depth = torch.full((height, width), 2.2)
    residual = residual_of(view, torch.full_like(view.image, 0.5), depth, FOOTPRINT)
    found = gain_map(view, depth, depth > 0, [residual])
    assert found.shape == (height, width) and bool(torch.isfinite(found).all()) and bool((found > 0).all())
