"""Films in a real browser: they play to their end, at the right length, and their colours are those of the frames."""

import http.server
import json
import queue
import shutil
import subprocess
import threading

import numpy as np
import pytest

from tests.report.test_page_in_browser import BROWSERS
from warpgs.report.film import write_film

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
