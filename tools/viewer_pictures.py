"""Pictures of viewer and page in Chromium, and of `warpgs level`, as the documents show them.

`python -m tools.viewer_pictures RUN --out docs/images` takes a run of `warpgs demo scene --width 640 --height 480` with its
scene, and changes neither. For one picture it fits the scene in 160 steps.
"""

import argparse
import contextlib
import io
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import warpgs
from tests.viewer.chromium import Chromium
from warpgs.app.cli import main as command
from warpgs.geometry import project_points
from warpgs.pipeline.run.commands import scene_of
from warpgs.scene import View
from warpgs.viewer import window as windows
from warpgs.viewer.html import NO_REMARKS, distance_ahead
from warpgs.viewer.server import address, open_server, stop_server
from warpgs.viewer.watch import live_view

DESKTOP, LOW, SMALL, MAP, PHONE = (1100, 640), (1100, 420), (760, 540), (640, 480), (360, 540)
"""Width and height of the browser's window [px]."""
GROUND = np.array([(0.05, 0.8), (0.17, 0.9), (0.33, 0.95), (0.64, 0.95), (0.79, 0.82)])
"""Points of the floor in photograph 014 of the demo scene, in widths and heights."""


def joined(images: list[Image.Image], axis: int = 1) -> Image.Image:
    """Return images side by side, or one below the other with ``axis`` 0."""
    parts = [np.asarray(image.convert("RGB")) for image in images]
    gap = np.full_like(parts[0].swapaxes(0, axis)[:8].swapaxes(0, axis), 255)
    return Image.fromarray(np.concatenate([p for part in parts for p in (gap, part)][1:], axis))


def taken(browser: Chromium) -> Image.Image:
    """Return what the browser shows, once it drew what was sent to it."""
    time.sleep(5)
    return Image.open(io.BytesIO(browser.picture()))


def press(browser: Chromium, text: str) -> None:
    """Click the innermost element with a text."""
    found = f"[...document.querySelectorAll('*')].filter(e=>(e.innerText||'').trim()===`{text}`).at(-1)"
    browser.wait(f"(e => e && (e.scrollIntoView(), e.click(), true))({found})")


def click(browser: Chromium, x: float, y: float) -> None:
    """Click a place of the window [px]."""
    for kind in ("mousePressed", "mouseReleased"):
        browser.ask("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, x=x, y=y)


def entered(browser: Chromium, size: tuple[int, int], server: object) -> Image.Image:
    """Return the viewer in a window of a size."""
    browser.resize(*size)
    browser.open(address(server))
    browser.picture_of(lambda image: image[150:, :300].std() > 0.05)
    style = NO_REMARKS + "<style>*{outline:none!important}</style>"
    browser.value(f"void document.head.insertAdjacentHTML('beforeend', {style!r})")
    return taken(browser)


def start(browser: Chromium, window: windows.Window) -> Image.Image:
    """Return the viewer as it starts, and with its panel folded and the cameras seen from behind and above."""
    image, first = entered(browser, DESKTOP, window.server), window.first
    click(browser, DESKTOP[0] - 150, 33)  # the title folds the panel
    browser.resize(*LOW)
    ahead = distance_ahead(first, window.content.model.gaussians()) * first.viewmat[2, :3]
    for client in window.server.get_clients().values():
        client.camera.position = first.center - 0.5 * ahead - 0.35 * np.linalg.norm(ahead) * first.viewmat[1, :3]
        client.camera.look_at = first.center + 0.6 * ahead
    return joined([image, taken(browser)], axis=0)


def maps(browser: Chromium, window: windows.Window) -> Image.Image:
    """Return render, depth, coverage and error at a training camera, at the size that they have on a GPU."""
    windows.MAP_SIDE["cpu"], images = windows.MAP_SIDE["cuda"], [entered(browser, MAP, window.server)]
    click(browser, MAP[0] - 150, 33)
    window.step_into(window.content.model.train[0], None)
    for window.panel.kind.value in (*windows.MAPS, windows.GAUSSIANS):
        time.sleep(5)
        images.append(taken(browser))
    return joined([joined(images[1:3]), joined(images[3:5])], axis=0)


def clean(browser: Chromium, window: windows.Window) -> Image.Image:
    """Return the viewer with what would go in colour, and after it was removed."""
    window.panel.in_colors.value = True
    entered(browser, SMALL, window.server)
    press(browser, "Clean up")
    image = taken(browser).crop((0, 0, 420, 540))
    press(browser, "remove")
    return joined([image, taken(browser)])


def fit(browser: Chromium, run: Path, folder: Path) -> Image.Image:
    """Return the viewer of a fit after its first step, and after 150 steps."""
    images: list[Image.Image] = []
    with live_view(folder / "fit", 0) as live:

        def look(model):
            if model.step in (1, 150):
                live.look(model)
                images.append(entered(browser, SMALL, live.server))

        warpgs.fit(warpgs.open_run(run).scene_request(), out=folder / "fit", on_model=look, steps=160)
    return joined([images[0].crop((0, 0, 420, 540)), images[1]])


def pages(browser: Chromium, run: Path, folder: Path) -> list[Image.Image]:
    """Return the page on a desktop and on a phone, as it starts and with two points picked."""
    images: list[Image.Image] = []
    command(["export", str(run), "--to", str(folder / "scene.html")])
    for width, height in (SMALL, PHONE):
        browser.resize(width, height)
        browser.open((folder / "scene.html").as_uri())
        browser.wait("document.querySelector('#warpgs-ruler') && document.querySelector('#warpgs-loading') === null")
        images.append(taken(browser))
        press(browser, "Ruler")
        for x in (0.54, 0.73):
            click(browser, x * width, 0.5 * height)
        images.append(taken(browser))
    return [joined(images[::2]), joined(images[1::2])]


def level(run: Path, views: dict[str, View]) -> Image.Image:
    """Return a photograph with the points of `warpgs level --ground`, and with a grid on the ground that they give."""
    name, view = next(item for item in views.items() if item[0].endswith("014.png"))
    size = np.array([view.camera.width, view.camera.height])
    points = (GROUND * size).astype(int)
    command(["level", str(run), "--ground", *(f"{name}:{x},{y}" for x, y in points)])
    stored = warpgs.open_run(run)
    camera = stored.cameras("file")[name]
    grid = np.stack(np.meshgrid(np.linspace(-8, 8, 33), 0.0, np.linspace(-8, 8, 4801)), -1).reshape(-1, 3)
    pixels, z = project_points(camera, np.round(camera.center) * [1, 0, 1] + np.concatenate([grid, grid[:, ::-1]]))
    pixels, z = (values[(z > 0.1) & (pixels > 0).all(1) & (pixels < size).all(1)] for values in (pixels, z))
    depth = warpgs.rasterize(stored.gaussians("file"), camera, stored.options()).depth.numpy(force=True)
    images = [Image.fromarray(np.uint8(255 * view.image)).resize(tuple(2 * size)) for _ in range(2)]
    seen = pixels[z < 1.03 * depth[tuple(pixels.T.astype(int)[::-1])]]  # objects on the ground hide the grid
    for image, dots, radius in zip(images, (points, seen), (16, 2)):
        for dot in 2 * dots:
            ImageDraw.Draw(image).ellipse((*(dot - radius), *(dot + radius)), (255, 221, 51), (0, 0, 0), radius // 5)
    return joined([image.reduce(2) for image in images])


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder of a demo scene")
    parser.add_argument("--out", type=Path, required=True, help="folder of the pictures")
    a = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary, contextlib.ExitStack() as ends:
        folder, server = Path(temporary), open_server(0)
        ends.callback(stop_server, server)
        browser = ends.enter_context(contextlib.closing(Chromium(folder)))
        run = shutil.copytree(a.run, folder / "run")
        views = {v.name: v for some in scene_of(warpgs.open_run(run))[1:] for v in some}
        window = ends.enter_context(contextlib.closing(windows.Window(server, windows.content_of_run(run, views=views))))
        made = {f"viewer{name}": draw(browser, window) for name, draw in {"": start, "-maps": maps, "-clean": clean}.items()}
        made |= dict(zip(("viewer-page", "page-ruler"), pages(browser, run, folder)))
        made |= {"viewer-fit": fit(browser, run, folder), "level": level(run, views)}
        for name, image in made.items():
            image.save(a.out / f"{name}.webp", quality=82, method=6)


if __name__ == "__main__":
    main()
