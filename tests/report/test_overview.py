"""The 3D overview of a report, and plots of scenes."""

import io
import subprocess

import numpy as np
import pytest
import torch
from PIL import Image, ImageColor

from tests.scenes import ring
from warpgs.errors import ResourceError
from warpgs.render.options import RasterizeOptions
from warpgs.report import overview as module
from warpgs.report.overview import TRAIN_COLOR, probe_rendering, render_overview, render_plot
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


def test_the_overview_shows_gaussians_and_both_kinds_of_cameras(monkeypatch):
    """On white, in the colour without directions, without another process."""
    monkeypatch.setattr(module, "run_python", None)
    train, test = [camera(a) for a in (-0.4, 0.0, 0.4)], [camera(0.2)]
    image = render_overview(wall(), RasterizeOptions(rule="fast"), train, test, UP)
    assert image.shape == (module.HEIGHT, module.WIDTH, 3) and (image == 1).all(-1).mean() > 0.5
    assert (np.abs(image - 0.2).max(-1) < 0.02).sum() > 2000
    seen = {color: colored(image, color) for color in (module.TRAIN_COLOR, module.TEST_COLOR)}
    assert min(seen.values()) > 100
    assert colored(render_overview(wall(), RasterizeOptions(), train, [], UP), module.TEST_COLOR) == 0
    empty = Gaussians(**{n: t[:0] for n, t in wall().tensors().items()})
    assert render_overview(empty, RasterizeOptions(), [camera(0)], [], UP) is None


def test_frusta_pass_through_the_image_corners_and_hidden_lines_and_far_points_are_left_out():
    c = camera(0.3)
    lines = module.frusta([c], 0.5)
    assert lines.shape == (8, 2, 3)
    np.testing.assert_allclose(lines[:4, 0], np.repeat(c.center[None], 4, 0))
    in_camera = lines[:4, 1] @ c.viewmat[:3, :3].T + c.viewmat[:3, 3]
    np.testing.assert_allclose(in_camera[:, 2], 0.5)
    pixels = in_camera @ K.T
    np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], [[0, 0], [320, 0], [320, 240], [0, 240]], atol=1e-9)
    # lines behind a surface are hidden
    shown = Camera(np.eye(4), np.array([[10.0, 0, 20], [0, 10, 10], [0, 0, 1]]), 40, 20)
    image, depth = np.full((20, 40, 3), 255, np.uint8), np.full((20, 40), np.inf)
    depth[:, :20] = 1
    module._draw(image, depth, shown, np.array([[[-3.0, 0, 2], [3, 0, 2]]]), "#000000")
    dark = (image < 128).all(-1)
    assert not dark[:, :18].any() and dark[:, 22:34].any(0).all()
    # of a grid all points count for the camera's place, of the two in a hundred far away none
    grid = np.stack(np.meshgrid(np.linspace(-3, 3, 20), np.linspace(0, 2, 20), [1.0, 1.5]), -1).reshape(-1, 3)
    far = np.random.default_rng(0).normal(size=(16, 3)) * 50 + 200
    near = module.within(np.concatenate([grid, far]), module.EDGE)
    assert near[: len(grid)].all() and not near[len(grid) :].any()


@pytest.mark.parametrize("code, text", [(-11, "code -11"), (1, "code 1 (no display)")])
def test_a_crash_of_vtk_is_a_note_and_not_ours(monkeypatch, code, text):
    seen = {}

    def crash(command, env, **_):
        seen.update(env)
        return subprocess.CompletedProcess(command, code, "", "no display\n" if code > 0 else "")

    monkeypatch.setattr(module.subprocess, "run", crash)
    ok, why = probe_rendering()
    assert not ok and text in why and "apt-get install libegl1 libgl1 libgl1-mesa-dri" in why
    assert seen["VTK_DEFAULT_OPENGL_WINDOW"] == "vtkEGLRenderWindow"


def test_a_hanging_driver_is_given_up_and_a_machine_that_cannot_render_is_told_what_to_install(monkeypatch):
    def hang(command, timeout, **_):
        raise subprocess.TimeoutExpired(command, timeout)

    monkeypatch.setattr(module.subprocess, "run", hang)
    assert "did not finish" in probe_rendering()[1]
    monkeypatch.setattr(module, "run_pyvista", lambda *_: (False, "pyvista ended with code -11"))
    with pytest.raises(ResourceError, match=r"no plot: pyvista ended with code -11.*libegl1"):
        plot((200, 100), "white")


@pytest.mark.parametrize("aspect", [2.0, 0.5])
@pytest.mark.parametrize("direction", [[0.3, -1, 2], [0, 5, 0], [0, 0, -1e-15], [1, 1, 1]])
def test_everything_shown_is_in_the_image_and_fills_it(direction, aspect):
    shown = np.random.default_rng(1).normal(size=(300, 3)) * [5, 1, 2] + [10, -20, 3]
    eye, focus, up = module.framing(shown, np.array(direction, float), np.array([0.0, 1, 0]), aspect)
    forward = (focus - eye) / np.linalg.norm(focus - eye)
    assert abs(forward @ up) < 1e-9 and np.linalg.norm(up) == pytest.approx(1)
    x, y, z = ((shown - eye) @ np.stack([np.cross(forward, up), up, forward]).T).T
    slope = np.tan(np.radians(module.VIEW_ANGLE / 2))
    reach = np.maximum(np.abs(y / z) / slope, np.abs(x / z) / (slope * aspect))
    assert (z > 0).all() and 0.85 < reach.max() < 1


# Plots: the script gets what is to be shown, the legend stands below, and a machine that cannot render is told why.


def plot(size, background, count: int = 400, **changes) -> bytes:
    points = np.random.default_rng(0).normal(size=(count, 3)) * 0.3
    points[0] = 1000
    axes = np.broadcast_to(0.05 * np.eye(3), (count, 3, 3)).copy()
    axes[1] *= 1e6
    up, direction = np.array([0, -1.0, 0]), np.array([1.0, -0.5, -1])
    contents = {"axes": axes, "train": ring(4), "test": ring(2), "legend": [("seen by 1", "#ff0000")]} | changes
    colors = np.full((count, 3), 0.5)
    return render_plot(points, colors, up=up, direction=direction, size=size, background=background, **contents)


@pytest.fixture
def sent(monkeypatch) -> dict:
    found: dict = {}

    def instead(code, source, words, target):
        with np.load(source) as data:
            found.update(data)
        found["words"] = words
        size = module.json.loads(words)["size"]
        Image.new("RGB", size, "gray").save(target, "PNG")
        return True, ""

    monkeypatch.setattr(module, "run_pyvista", instead)
    return found


def test_what_lies_far_outside_is_left_out_and_what_is_huge_is_shrunk(sent):
    data = plot((400, 300), "black")
    assert len(sent["points"]) == 399 and np.abs(sent["points"]).max() < 2
    lengths = np.linalg.norm(sent["axes"], axis=1)
    assert lengths[0].max() < 0.2 and lengths[1:].min() > 0.03
    with Image.open(io.BytesIO(data)) as image:
        assert image.size == (400, 300)
        strip = np.asarray(image)[-18:].reshape(-1, 3)
    for color in (TRAIN_COLOR, "#ff0000"):
        assert (strip == [int(color[i : i + 2], 16) for i in (1, 3, 5)]).all(1).any()
    del sent["axes"]
    data = plot((200, 100), "white", train=[], test=[], legend=[], axes=None)
    with Image.open(io.BytesIO(data)) as image:
        assert image.size == (200, 100) and (np.asarray(image) == 128).all()
    assert "axes" not in sent
