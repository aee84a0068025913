"""The page of a model in a real browser, opened as a file: it shows what our rasterizer does, and asks nobody for anything."""

import dataclasses

import numpy as np
import pytest

from tests.scenes import ring, three_gaussians
from tests.viewer.chromium import Chromium
from warpgs.geometry import look_at
from warpgs.render.rasterize import rasterize
from warpgs.viewer.html import MARGIN, SORT_FROM_DISK, middle_first, turning_limits, write_html

pytest.importorskip("viser")
WIDTH, HEIGHT = 700, 600
SHOWN = np.s_[200:, :]
"""Rows without the page's own button."""
CORNER = np.s_[:160, :320]
"""Place of viser's remark on software rendering, in white letters, which the page hides."""


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a[SHOWN] - b[SHOWN]) ** 2)))


def crowd():
    """The three Gaussians, large and opaque, the far ones last in the file: only sorting shows them rightly."""
    g = three_gaussians()
    order = g.means[:, 2].argsort()
    means = g.means * g.means.new_tensor([0.3, 0.3, 1.0])
    g = dataclasses.replace(g, means=means, log_scales=g.log_scales + 0.4)
    return type(g)(**{n: t[order] for n, t in g.tensors().items()})


def test_the_middle_of_the_cameras_comes_first():
    """The one nearest to the mean of all centres, then the others in their order."""
    cameras = [moved(x) for x in (4.0, 0.0, 1.5, 1.0)]
    assert [c.center[0] for c in middle_first(cameras)] == [1.5, 4.0, 0.0, 1.0] and middle_first([]) == []


def test_a_page_turns_as_far_as_the_photographs():
    """Around an arc, along a row of parallel cameras and in one place; all round there is no limit, nor with one camera."""
    up, target = np.array([0.0, -1, 0]), np.zeros(3)

    def looking(azimuth, height=0.0):
        eye = 4 * np.array([np.sin(azimuth), -height, -np.cos(azimuth)])
        return dataclasses.replace(ring(1)[0], viewmat=look_at(eye, target, up))

    arc = [looking(np.radians(a), h) for a, h in ((0, 0), (-30, 0), (40, 0), (0, np.tan(np.radians(20))))]
    np.testing.assert_allclose(turning_limits(arc, target, up), np.radians([40, 20]) + MARGIN, atol=1e-9)
    row = [moved(0.0), moved(2.0), moved(-1.0)]
    side, tilt = turning_limits(row, row[0].center + np.array([0, 0, 4.0]), up)
    assert side == pytest.approx(np.arctan2(2, 4) + MARGIN) and tilt == pytest.approx(MARGIN)
    ways = [looking(np.radians(a)) for a in range(0, 360, 45)]
    assert turning_limits(ways, target, up)[0] == np.pi and turning_limits(arc[:1], target, up) == (np.pi, np.pi)


@pytest.mark.browser
def test_a_page_stops_where_the_photographs_end(tmp_path):
    """To both sides; the key R leads back to the first view."""
    path, cameras = tmp_path / "scene.html", middle_first(ring(3))
    write_html(path, crowd(), cameras)
    browser = Chromium(tmp_path)
    try:
        browser.open(path.as_uri())
        angle = "window.__viserMutable?.cameraControl?.azimuthAngle"
        browser.wait("Number.isFinite(window.__viserMutable?.cameraControl?.maxAzimuthAngle)")
        first = browser.value(angle)
        for way in (1, -1):
            browser.value(f"void __viserMutable.cameraControl.rotate({way} * 2.5, 0, false)")
            browser.wait(f"Math.abs({angle} - {first}) > 0.1")
            assert abs(browser.value(angle) - first) < np.radians(60)
            browser.value("dispatchEvent(new KeyboardEvent('keydown', {key: 'r', bubbles: true}))")
            browser.wait(f"Math.abs({angle} - {first}) < 1e-3")
    finally:
        browser.close()


def moved(x):
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    return dataclasses.replace(ring(1)[0], viewmat=viewmat)


@pytest.mark.browser
def test_a_page_tells_how_to_move_and_returns(tmp_path):
    """The line of help stands there, no scene tree does, and the key R and the button lead back to the first view.

    The page says that it loads, until the scene is there.
    """
    path = tmp_path / "scene.html"
    write_html(path, crowd(), [ring(3)[1]], title="my <scene>")
    body = path.read_text("utf-8").partition("<body>")[2]
    assert body.startswith('<div id="warpgs-loading"') and "Loading the scene" in body[:300]
    browser = Chromium(tmp_path)
    try:
        browser.open(path.as_uri())
        browser.wait("window.__viserMutable?.resetCameraPose && document.querySelector('canvas') !== null")
        browser.wait("document.querySelector('[aria-label$=\"scene tree\"]') !== null")
        browser.wait("document.querySelector('#warpgs-loading') === null")
        assert browser.value("document.title") == "my <scene>" and "Drag to turn" in browser.value("document.body.innerText")
        assert browser.value("document.querySelector('[aria-label$=\"scene tree\"]').checkVisibility()") is False
        place = "JSON.stringify(__viserMutable.camera.position.toArray().map(x => Math.round(1e3 * x)))"
        browser.wait("document.querySelector('#warpgs-help button').checkVisibility()")
        before = browser.value(place)
        for back in (
            "dispatchEvent(new KeyboardEvent('keydown', {key: 'r', bubbles: true}))",
            "document.querySelector('#warpgs-help button').click()",
        ):
            browser.value("void __viserMutable.cameraControl.rotate(0.7, 0.2, false)")
            browser.wait(f"{place} !== {before!r}")
            browser.value(f"void {back}")
            browser.wait(f"{place} === {before!r}")
        assert not [line for line in browser.console() if "Content Security Policy" in line]
    finally:
        browser.close()


@pytest.mark.browser
def test_a_page_from_disk_shows_the_render(tmp_path):
    """At least 22 dB at a training camera; without the script for pages from disk the Gaussians come in the wrong order."""
    g, camera = crowd(), ring(3)[1]
    factor = HEIGHT / camera.height
    K = np.diag([factor, factor, 1.0]) @ camera.K
    K[:2, 2] = WIDTH / 2, HEIGHT / 2
    wanted = rasterize(g, dataclasses.replace(camera, K=K, width=WIDTH, height=HEIGHT)).rgb.clamp(0, 1).numpy()
    path = tmp_path / "scene.html"
    assert write_html(path, g, [camera]) == [] and wanted[SHOWN].std() > 0.1
    browser = Chromium(tmp_path)
    try:
        browser.resize(WIDTH, HEIGHT)
        browser.open(path.as_uri())
        image = browser.picture_of(lambda found: psnr(found, wanted) > 22)  # they are sorted by a worker, and fade in
        assert psnr(image, wanted) > 22, psnr(image, wanted)
        assert image[CORNER].min(-1).max() < 0.4  # no white letters
        assert not refused(browser), browser.console()
        path.write_text(path.read_text("utf-8").replace(SORT_FROM_DISK, ""), "utf-8")
        browser.open(path.as_uri())
        before: list[np.ndarray] = []
        unsorted = browser.picture_of(lambda found: refused(browser) and settled(found, before))
        assert refused(browser) and psnr(unsorted, wanted) < psnr(image, wanted) - 3
    finally:
        browser.close()


@pytest.mark.browser
def test_a_page_on_a_phone_shows_the_whole_width_of_the_first_image(tmp_path):
    """A narrow window has a wider field of view, also after it was turned; a wide one has the camera's."""
    camera, path = ring(1)[0], tmp_path / "scene.html"
    write_html(path, crowd(), [camera])
    tall, wide = (camera.height / camera.K[1, 1], camera.width / camera.K[0, 0])
    browser = Chromium(tmp_path)
    try:
        browser.resize(390, 844)
        browser.open(path.as_uri())
        for width, height in ((390, 844), (844, 390), (390, 844)):
            browser.resize(width, height)
            degrees = 2 * np.degrees(np.arctan(max(tall, wide * height / width) / 2))
            browser.wait(f"Math.abs((window.__viserMutable?.camera?.fov ?? 0) - {degrees}) < 1e-3")
    finally:
        browser.close()


def refused(browser) -> list[str]:
    """Lines of the console on what the content policy, or the browser, refused."""
    return [line for line in browser.console() if "Content Security Policy" in line or "Refused" in line]


def settled(image: np.ndarray, before: list[np.ndarray]) -> bool:
    """Whether Gaussians are shown, and the picture is the one before; keeps it for the next."""
    before.append(image)
    return image[SHOWN].std() > 0.05 and len(before) > 1 and np.array_equal(image, before[-2])
