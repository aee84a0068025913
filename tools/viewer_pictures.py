"""Pictures of the tools of viewer and page, in Chromium: clean-up, ruler and level.

`python -m tools.viewer_pictures RUN --out docs/images` takes a run of the demo scene with its scene, and changes neither. It
writes viewer-clean.webp (the viewer before and after a clean-up), page-ruler.webp (scene.html with the ruler, on a desktop and
on a phone) and level.webp (points of `warpgs level --ground`, and a grid on the ground that they give).
"""

import argparse
import dataclasses
import io
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import warpgs
from tests.viewer.chromium import Chromium
from warpgs.app.cli import main as command
from warpgs.geometry import project_points
from warpgs.pipeline.run.commands import scene_of
from warpgs.viewer.html import NO_REMARKS
from warpgs.viewer.server import address, open_server, stop_server
from warpgs.viewer.window import Window, content_of_run, views_of

DESKTOP, PHONE = (1000, 640), (390, 640)
"""Width and height of the browser's window [px]."""
GROUND = (14, 172), (100, 236), (252, 196)
"""Points of the floor in photograph 014 of the demo scene [px]."""
SHOWN = 3.0
"""Time in which the browser draws what was sent to it [s]."""


def row(images: list[Image.Image], gap: int = 8) -> Image.Image:
    """Return images side by side, at the height of the first."""
    images = [i.convert("RGB").resize((round(i.width * images[0].height / i.height), images[0].height)) for i in images]
    sheet = Image.new("RGB", (sum(i.width + gap for i in images) - gap, images[0].height), "white")
    for k, image in enumerate(images):
        sheet.paste(image, (sum(i.width + gap for i in images[:k]), 0))
    return sheet


def taken(browser: Chromium) -> Image.Image:
    """Return what the browser shows."""
    time.sleep(SHOWN)
    return Image.open(io.BytesIO(browser.picture()))


def press(browser: Chromium, text: str) -> None:
    """Click the innermost element with a text."""
    found = f"[...document.querySelectorAll('*')].filter(e=>(e.innerText||'').trim()===`{text}`).at(-1)"
    browser.wait(f"{found} != null")
    browser.value(f"void ({found}.scrollIntoView(), {found}.click())")


def clean(browser: Chromium, run: Path) -> Image.Image:
    """Return the viewer with what would go in colour, and after it was removed."""
    content = content_of_run(run)
    server = open_server(0)
    window = Window(server, dataclasses.replace(content, views=views_of(content)[0]))
    window.panel.cameras.value = False
    try:
        browser.resize(*DESKTOP)
        browser.open(address(server))
        window.panel.in_colors.value = True
        press(browser, "Clean up")
        browser.picture_of(lambda image: image[150:, :500].std() > 0.05)
        browser.value(f"void document.head.insertAdjacentHTML('beforeend', {NO_REMARKS!r})")
        images = [taken(browser)]
        press(browser, "remove")
        return row([*images, taken(browser)])
    finally:
        window.close()
        stop_server(server)


def ruler(browser: Chromium, run: Path, folder: Path) -> Image.Image:
    """Return the page with two points picked, on a desktop and on a phone."""
    page, images = folder / "scene.html", []
    command(["export", str(run), "--to", str(page)])
    for width, height in (DESKTOP, PHONE):
        browser.resize(width, height)
        browser.open(page.as_uri())
        browser.wait("document.querySelector('#warpgs-ruler') && document.querySelector('#warpgs-loading') === null")
        browser.value("document.querySelector('#warpgs-ruler').click()")
        for x, y in ((0.42, 0.55), (0.6, 0.5)):
            for kind in ("mousePressed", "mouseReleased"):
                at = {"x": x * width, "y": y * height}
                browser.ask("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, **at)
        images.append(taken(browser))
    return row(images)


def level(run: Path) -> Image.Image:
    """Return a photograph with the points of `warpgs level --ground`, and with a grid on the ground that they give."""
    name = next(name for name in warpgs.open_run(run).train if name.endswith("014.png"))
    command(["level", str(run), "--ground", *(f"{name}:{x},{y}" for x, y in GROUND)])
    stored = warpgs.open_run(run)
    camera = stored.cameras("file")[name]
    image = next(v.image for v in scene_of(stored)[1] if v.name == name)
    images = [Image.fromarray(np.uint8(255 * image)).resize((2 * camera.width, 2 * camera.height)) for _ in range(2)]
    dots, lines = map(ImageDraw.Draw, images)
    for x, y in GROUND:
        dots.ellipse((2 * x - 7, 2 * y - 7, 2 * x + 7, 2 * y + 7), (255, 221, 51), (0, 0, 0))
    middle, steps = np.round(camera.center), np.linspace(-8, 8, 17)
    for along in steps:
        for way in (0, 1):
            ends = np.stack([np.full(321, along), np.linspace(-8, 8, 321)][:: 1 - 2 * way], 1)
            points = np.stack([middle[0] + ends[:, 0], np.zeros(321), middle[2] + ends[:, 1]], 1)
            pixels, z = project_points(camera, points)
            for a, b, ahead in zip(2 * pixels[:-1], 2 * pixels[1:], np.minimum(z[:-1], z[1:])):
                if ahead > 0.1:
                    lines.line((*a, *b), (255, 221, 51), 2)
    return row(images)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder of a demo scene")
    parser.add_argument("--out", type=Path, required=True, help="folder of the pictures")
    a = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        run = shutil.copytree(a.run, folder / "run")
        browser = Chromium(folder)
        try:
            made: dict[str, Callable[[], Image.Image]] = {
                "viewer-clean": lambda: clean(browser, run), "page-ruler": lambda: ruler(browser, run, folder),
                "level": lambda: level(run),
            }  # fmt: skip
            for name, draw in made.items():
                draw().save(a.out / f"{name}.webp", quality=82, method=6)
                print(f"{a.out / name}.webp: {(a.out / name).with_suffix('.webp').stat().st_size / 1000:.0f} kB")
        finally:
            browser.close()


if __name__ == "__main__":
    main()
