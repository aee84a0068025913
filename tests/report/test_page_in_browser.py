"""The report page in a real browser: images are whole, nothing sticks out, and the slider moves."""

import html
import json
import re
import shutil
import subprocess

import pytest

from tests.report.test_page import write

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
