import subprocess

import cv2
import numpy as np
import pytest

from warpgs.report import overview as module
from warpgs.report.overview import probe_rendering, render_overview
from warpgs.scene import Camera

UP = np.array([0.0, -1, 0])
K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])


def camera(angle):
    """Return a camera 4 u from the origin that looks at it."""
    center = np.array([4 * np.sin(angle), 0, -4 * np.cos(angle)])
    forward, down = -center / 4, np.array([0.0, 1, 0])
    R = np.stack([np.cross(down, forward), down, forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = R, -R @ center
    return Camera(viewmat, K, 320, 240)


def cloud():
    points = np.random.default_rng(0).normal(size=(500, 3)) * 0.5
    return points, np.full((500, 3), 0.2)


def test_overview_is_an_image_or_a_reason_with_a_remedy():
    """Either result is right; the graphics libraries of the machine decide."""
    data, why = render_overview([camera(a) for a in (-0.4, 0.0, 0.4)], [camera(0.2)], *cloud(), UP)
    if data is None:
        assert "libegl1" in why
        return
    assert why == ""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    for color in (module.TRAIN_COLOR, module.TEST_COLOR):
        rgb = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
        assert (np.abs(image - rgb).sum(-1) < 30).sum() > 50, color


def test_frusta_start_at_the_camera_and_pass_through_the_image_corners():
    c = camera(0.3)
    lines = module.frusta([c], 0.5)
    assert lines.shape == (8, 2, 3)
    np.testing.assert_allclose(lines[:4, 0], np.repeat(c.center[None], 4, 0))
    in_camera = lines[:4, 1] @ c.viewmat[:3, :3].T + c.viewmat[:3, 3]
    np.testing.assert_allclose(in_camera[:, 2], 0.5)
    pixels = in_camera @ K.T
    np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], [[0, 0], [320, 0], [320, 240], [0, 240]], atol=1e-9)


@pytest.mark.parametrize("code, text", [(-11, "code -11"), (1, "code 1 (no display)")])
def test_a_crash_of_vtk_is_a_note_and_not_ours(monkeypatch, code, text):
    seen = {}

    def crash(command, env, **_):
        seen.update(env)
        return subprocess.CompletedProcess(command, code, "", "no display\n" if code > 0 else "")

    monkeypatch.setattr(module.subprocess, "run", crash)
    data, why = render_overview([camera(0)], [], *cloud(), UP)
    assert data is None and text in why and "apt-get install libegl1 libgl1 libgl1-mesa-dri" in why
    ok, why = probe_rendering()
    assert not ok and text in why and "libegl1" in why
    assert seen["VTK_DEFAULT_OPENGL_WINDOW"] == "vtkEGLRenderWindow"


def test_a_hanging_driver_is_given_up(monkeypatch):
    def hang(command, timeout, **_):
        raise subprocess.TimeoutExpired(command, timeout)

    monkeypatch.setattr(module.subprocess, "run", hang)
    assert "did not finish" in render_overview([camera(0)], [], *cloud(), UP)[1]


def test_nothing_to_draw_is_a_note():
    for train, points in (([camera(0)], np.zeros((0, 3))), ([], np.zeros((5, 3)))):
        data, why = render_overview(train, [], points, np.zeros_like(points), UP)
        assert data is None and "no points or no training cameras" in why


def test_a_whole_wall_is_in_the_image_and_no_far_background():
    """The points from which the camera's place follows: all of a grid, none of the two in a hundred far away."""
    wall = np.stack(np.meshgrid(np.linspace(-3, 3, 20), np.linspace(0, 2, 20), [1.0, 1.5]), -1).reshape(-1, 3)
    far = np.random.default_rng(0).normal(size=(16, 3)) * 50 + 200
    shown = module.within(np.concatenate([wall, far]), module.EDGE)
    assert shown[: len(wall)].all() and not shown[len(wall) :].any()


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
