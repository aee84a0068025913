"""The 3D overview of a report, and plots of scenes."""

import numpy as np
import pytest
import torch
from PIL import ImageColor

from warpgs.render.options import RasterizeOptions
from warpgs.report import overview as module
from warpgs.report.overview import TRAIN_COLOR, render_overview, with_legend
from warpgs.scene import C0, Camera, Gaussians

UP = np.array([0.0, -1, 0])
K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])


def camera(angle):
    center = np.array([4 * np.sin(angle), 0, -4 * np.cos(angle)])
    forward, down = -center / 4, np.array([0.0, 1, 0])
    R = np.stack([np.cross(down, forward), down, forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = R, -R @ center
    return Camera(viewmat, K, 320, 240)


def wall(color: float = 0.2, depth: float = 0.0) -> Gaussians:
    """Return opaque Gaussians of one colour in a square of 2 u across z, at a depth of the file's origin."""
    x, y = np.meshgrid(np.linspace(-1, 1, 24), np.linspace(-1, 1, 24))
    means = torch.tensor(np.stack([x, y, np.full_like(x, depth)], -1).reshape(-1, 3), dtype=torch.float32)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    sh = torch.full((len(means), 4, 3), (color - 0.5) / C0)
    sh[:, 1:] = 9.0
    return Gaussians(means, quats.clone(), torch.full((len(means), 3), -2.5), torch.full((len(means),), 6.0), sh)


def colored(image: np.ndarray, color: str) -> int:
    rgb = np.array(ImageColor.getrgb(color)) / 255
    return int((np.abs(image - rgb).sum(-1) < 0.05).sum())


def test_the_overview_shows_gaussians_and_both_kinds_of_cameras():
    """On white, in the colour without directions."""
    train, test = [camera(a) for a in (-0.4, 0.0, 0.4)], [camera(0.2)]
    image = render_overview(wall(), RasterizeOptions(rule="fast"), train, test, UP)
    assert image.shape == (*module.SIZE[::-1], 3) and (image == 1).all(-1).mean() > 0.5
    assert (np.abs(image - 0.2).max(-1) < 0.02).sum() > 2000
    seen = {color: colored(image, color) for color in (module.TRAIN_COLOR, module.TEST_COLOR)}
    assert min(seen.values()) > 100
    assert colored(render_overview(wall(), RasterizeOptions(), train, [], UP), module.TEST_COLOR) == 0


def test_without_a_background_it_is_that_of_the_fit():
    own = RasterizeOptions(background=torch.tensor([0.2, 0.4, 0.6]))
    image = render_overview(wall(), own, [camera(0)], [], UP, size=(64, 32), background=None, cameras=False)
    np.testing.assert_allclose(image[0, 0], [0.2, 0.4, 0.6], atol=0.01)


def test_lines_behind_a_surface_are_hidden():
    shown = Camera(np.eye(4), np.array([[10.0, 0, 20], [0, 10, 10], [0, 0, 1]]), 40, 20)
    image, depth = np.full((20, 40, 3), 255, np.uint8), np.full((20, 40), np.inf)
    depth[:, :20] = 1
    module._draw(image, depth, shown, np.array([[[-3.0, 0, 2], [3, 0, 2]]]), "#000000")
    dark = (image < 128).all(-1)
    assert not dark[:, :18].any() and dark[:, 22:34].any(0).all()


def test_no_gaussians_have_no_overview():
    empty = Gaussians(**{n: t[:0] for n, t in wall().tensors().items()})
    assert render_overview(empty, RasterizeOptions(), [camera(0)], [], UP) is None


def test_frusta_start_at_the_camera_and_pass_through_the_image_corners():
    c = camera(0.3)
    lines = module.frusta([c], 0.5)
    assert lines.shape == (8, 2, 3)
    np.testing.assert_allclose(lines[:4, 0], np.repeat(c.center[None], 4, 0))
    in_camera = lines[:4, 1] @ c.viewmat[:3, :3].T + c.viewmat[:3, 3]
    np.testing.assert_allclose(in_camera[:, 2], 0.5)
    pixels = in_camera @ K.T
    np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], [[0, 0], [320, 0], [320, 240], [0, 240]], atol=1e-9)


@pytest.mark.parametrize("aspect", [2.0, 0.5])
@pytest.mark.parametrize("direction", [[0.3, -1, 2], [0, 5, 0], [0, 0, -1e-15], [1, 1, 1]])
def test_everything_shown_is_in_the_image_and_fills_it(direction, aspect):
    shown = np.random.default_rng(1).normal(size=(300, 3)) * [5, 1, 2] + [10, -20, 3]
    axes, eye = module.framing(shown, np.array(direction, float), np.array([0.0, 1, 0]), aspect)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) > 0 and (abs(direction[0]) + abs(direction[2]) < 1e-9 or axes[1, 1] < 0)
    x, y, z = ((shown - eye) @ axes.T).T
    slope = np.tan(np.radians(module.VIEW_ANGLE / 2))
    reach = np.maximum(np.abs(y / z) / slope, np.abs(x / z) / (slope * aspect))
    assert (z > 0).all() and 0.94 < reach.max() < 0.95


# Plots: another size, on black, without cameras, and the legend below.


def test_a_plot_has_the_size_and_background_that_are_asked_for():
    shown = render_overview(wall(), RasterizeOptions(), [camera(0)], [], UP, size=(200, 100), background="black", cameras=False)
    assert shown.shape == (100, 200, 3) and (shown == 0).all(-1).mean() > 0.3 and colored(shown, TRAIN_COLOR) == 0


def test_what_lies_far_outside_is_left_out():
    far = wall(0.9)
    far.means[:4] += 1000
    near, options = wall(0.9), RasterizeOptions()
    near = Gaussians(**{n: t[4:] for n, t in near.tensors().items()})
    images = [render_overview(g, options, [camera(0)], [], UP, size=(64, 32)) for g in (far, near)]
    assert np.abs(images[0] - images[1]).mean() < 0.01 and (images[0] < 1).any()


def test_the_legend_is_a_strip_below_the_image():
    image = np.full((282, 400, 3), 0.5, np.float32)
    found = with_legend(image, [("training cameras", TRAIN_COLOR), ("seen by 1", "#ff0000")], 300, "black")
    assert found.shape == (300, 400, 3) and (found[:282] == image).all()
    assert min(colored(found[282:], color) for color in (TRAIN_COLOR, "#ff0000")) > 10
    assert with_legend(image, [], 282, "white") is not None
