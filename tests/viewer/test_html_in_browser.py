"""The page of a model in a real browser, opened as a file: it shows what our rasterizer does, and asks nobody for anything."""

import dataclasses
import shutil
import subprocess

import numpy as np
import pytest
from PIL import Image

from tests.report.test_page_in_browser import BROWSERS
from tests.scenes import ring, three_gaussians
from tests.viewer.chromium import Chromium
from warpgs.render.rasterize import rasterize
from warpgs.viewer.html import SORT_FROM_DISK, middle_first, write_html

pytest.importorskip("viser")
WIDTH, HEIGHT = 700, 600
SHOWN = np.s_[200:, :]
"""Rows without the page's own button."""
CORNER = np.s_[:160, :320]
"""Place of viser's remark on software rendering, in white letters, which the page hides."""
MILLISECONDS = 30_000
"""The browser's own time until the picture is taken: Gaussians fade in."""


ATTEMPTS = 8
"""Pictures of a page until one shows it whole: the browser's own time does not wait for the worker that sorts Gaussians, and
until then a grey cover lies over the page."""


def shot(page, folder) -> tuple[np.ndarray, str]:
    """A picture of a page in [0, 1], [H, W, 3], and what the browser wrote; the last of several where it stays covered."""
    for _ in range(ATTEMPTS):
        image, console = taken(page, folder)
        if image[-1, -1].max() == 0 and image[SHOWN].std() > 0.05:
            break
    return image, console


def taken(page, folder) -> tuple[np.ndarray, str]:
    """A picture of a page as it is once the browser's own time is over, and what the browser wrote."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is there")
    done = subprocess.run(
        [
            browser, "--headless=new", "--no-sandbox", "--disable-gpu-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader", "--no-first-run", "--disable-background-networking", "--disable-component-update",
            "--disable-sync", f"--user-data-dir={folder / 'profile'}", f"--window-size={WIDTH},{HEIGHT}", "--hide-scrollbars",
            "--enable-logging=stderr", f"--virtual-time-budget={MILLISECONDS}", f"--screenshot={folder / 'shot.png'}",
            page.as_uri(),
        ],
        capture_output=True, text=True, encoding="utf-8", check=True, timeout=240,
    )  # fmt: skip
    return np.asarray(Image.open(folder / "shot.png").convert("RGB"), np.float32) / 255, done.stderr


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


def moved(x):
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    return dataclasses.replace(ring(1)[0], viewmat=viewmat)


@pytest.mark.browser
def test_a_page_tells_how_to_move_and_returns(tmp_path):
    """The line of help stands there, no scene tree does, and the key R and the button lead back to the first view."""
    path = tmp_path / "scene.html"
    write_html(path, crowd(), [ring(3)[1]], title="my <scene>")
    browser = Chromium(tmp_path)
    try:
        browser.open(path.as_uri())
        browser.wait("window.__viserMutable?.resetCameraPose && document.querySelector('canvas') !== null")
        browser.wait("document.querySelector('[aria-label$=\"scene tree\"]') !== null")
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
    assert write_html(path, g, [camera]) == []
    image, console = shot(path, tmp_path)
    assert image.shape == wanted.shape and wanted[SHOWN].std() > 0.1
    assert psnr(image, wanted) > 22, psnr(image, wanted)
    assert image[CORNER].min(-1).max() < 0.4  # no white letters
    assert "Content Security Policy" not in console and "Refused" not in console, console
    path.write_text(path.read_text("utf-8").replace(SORT_FROM_DISK, ""), "utf-8")
    unsorted, console = shot(path, tmp_path)
    assert "Refused" in console and psnr(unsorted, wanted) < psnr(image, wanted) - 3
