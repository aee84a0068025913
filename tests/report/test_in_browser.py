"""Reports and films in a real browser: images are whole, nothing sticks out, films play to their end."""

import html
import http.server
import json
import queue
import re
import shutil
import subprocess
import threading

import numpy as np
import pytest

from tests.report.test_page import write
from warpgs.report.film import write_film

# The report page in a real browser: images are whole, nothing sticks out, and the slider moves.

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PROBE = """<script>addEventListener('load',()=>{
const slider=document.querySelector('.slider'),input=slider.querySelector('input'),drawn=[...document.images];
document.querySelectorAll('details').forEach(d=>{d.open=true});
const before=getComputedStyle(slider.querySelector('.top')).clipPath;
input.value=10;input.dispatchEvent(new Event('input'));
const found={images:drawn.length,broken:drawn.filter(i=>!i.naturalWidth).length,
flat:drawn.filter(i=>!i.getBoundingClientRect().height).length,
moved:before!==getComputedStyle(slider.querySelector('.top')).clipPath,
wide:document.documentElement.scrollWidth-innerWidth};
const out=document.createElement('output');out.textContent=JSON.stringify(found);document.body.append(out)})</script>"""


def opened(page, folder, width: int) -> tuple[dict, str]:
    """Return what the probe found on a page in a window so many pixels wide, and what the browser wrote to its console."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is there")
    probed = folder / "probed.html"
    probed.write_text(page.read_text("utf-8").replace("</body>", f"{PROBE}</body>"), "utf-8")
    done = subprocess.run(
        [
            browser, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
            "--disable-component-update", "--disable-sync", f"--user-data-dir={folder / 'profile'}",
            f"--window-size={width},900", "--enable-logging=stderr", "--dump-dom", probed.as_uri(),
        ],
        capture_output=True, text=True, encoding="utf-8", check=True, timeout=120,
    )  # fmt: skip
    (found,) = re.findall(r"<output>(.*?)</output>", done.stdout)
    return json.loads(html.unescape(found)), done.stderr


@pytest.mark.browser
@pytest.mark.parametrize("width", [1280, 500])
def test_page_opens_whole(tmp_path, width):
    """All images are decoded and have a height, the slider uncovers, and the page is no wider than the window."""
    path = tmp_path / "report.html"
    write(path)
    found, console = opened(path, tmp_path, width)
    assert found["images"] >= 10 and found["moved"]
    assert (found["broken"], found["flat"]) == (0, 0)
    assert found["wide"] <= 0
    assert "CONSOLE" not in console, console


@pytest.mark.browser
def test_a_broken_page_is_noticed(tmp_path):
    """An image that cannot be decoded, a script that fails, and a wide box, so that the test above can fail."""
    path = tmp_path / "report.html"
    write(path)
    text = path.read_text("utf-8").replace("data:image/png;base64,iVBOR", "data:image/png;base64,AAAA", 1)
    wrong = '<script>missing()</script><div style="width:3000px">wide</div></main>'
    path.write_text(text.replace("</main>", wrong), "utf-8")
    found, console = opened(path, tmp_path, 1280)
    assert found["broken"] == 1 and found["wide"] > 0
    assert "CONSOLE" in console


# Films in a real browser: they play to their end, at the right length, and their colours are those of the frames.

PAGE = """<!doctype html><video id="v" muted src="/film"></video><script>
const v=document.getElementById('v'),tell=o=>fetch('/found',{method:'POST',body:JSON.stringify(o)});
v.onerror=()=>tell({error:v.error.message||String(v.error.code)});
v.onended=()=>{const c=document.createElement('canvas');c.width=v.videoWidth;c.height=v.videoHeight;
const d=c.getContext('2d');d.drawImage(v,0,0);
const at=[1,3,5].map(i=>[...d.getImageData(c.width*i/6,c.height/2,1,1).data].slice(0,3));
tell({size:[c.width,c.height],seconds:v.duration,ended:v.ended,colors:at})};
v.play().catch(e=>tell({error:String(e)}))</script>"""
COLORS = np.array([[0.8, 0.3, 0.2], [0.2, 0.7, 0.3], [0.25, 0.35, 0.9]], np.float32)
TYPES = {".mp4": "video/mp4", ".webm": "video/webm"}


def played(film, folder) -> dict:
    """Return what the page found: the browser loads it from a server of this test, which takes the answer as well."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is there")
    found: queue.Queue = queue.Queue()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            data, kind = (film.read_bytes(), TYPES[film.suffix]) if self.path == "/film" else (PAGE.encode(), "text/html")
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def do_POST(self):
            found.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *arguments):
            """Say nothing."""

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        words = [
            browser, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
            "--disable-component-update", "--disable-sync", f"--user-data-dir={folder / 'profile'}",
            "--autoplay-policy=no-user-gesture-required", f"http://127.0.0.1:{server.server_port}/",
        ]  # fmt: skip
        with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            try:
                return found.get(timeout=90)
            finally:
                process.terminate()
                server.shutdown()


def stripes(shape, count):
    """Three upright stripes, with a bar that moves so that frames differ."""
    height, width = shape
    image = COLORS[np.arange(width) * 3 // width][None].repeat(height, 0)
    for i in range(count):
        frame = image.copy()
        frame[: height // 4, : width * (i + 1) // count] = 1
        yield frame


@pytest.mark.browser
@pytest.mark.parametrize(("name", "shape"), [("a.mp4", (378, 504)), ("a.webm", (120, 160)), ("hd.mp4", (720, 1280))])
def test_a_film_plays_to_its_end(tmp_path, name, shape):
    """Colours are checked at a small and at a high resolution: players take another matrix for each where a film names none."""
    film = tmp_path / name
    write_film(film, stripes(shape, 15), fps=15)
    result = played(film, tmp_path)
    assert result.get("ended") and result["size"] == [shape[1], shape[0]], result
    assert abs(result["seconds"] - 1) < 0.1, result
    np.testing.assert_allclose(np.array(result["colors"]) / 255, COLORS, atol=0.03)


@pytest.mark.browser
def test_a_film_that_is_no_film_is_noticed(tmp_path):
    """So that the test above can fail."""
    film = tmp_path / "a.mp4"
    film.write_bytes(b"no film" * 1000)
    assert "error" in played(film, tmp_path)
