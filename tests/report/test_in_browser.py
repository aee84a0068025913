"""Reports and films in a real browser: images are whole, nothing sticks out, films play to their end."""

import base64

import numpy as np
import pytest

from tests.report.test_page import write
from warpgs.report.film import write_film
from warpgs.report.images import png

GRAPHICS = ("--disable-gpu",)
"""The rasterizer of `Chromium` has other colours of films."""
PROBE = """(() => {
const slider=document.querySelector('.slider'),input=slider.querySelector('input'),drawn=[...document.images];
document.querySelectorAll('details').forEach(d=>{d.open=true});
const before=getComputedStyle(slider.querySelector('.top')).clipPath;
input.value=10;input.dispatchEvent(new Event('input'));
return {images:drawn.length,broken:drawn.filter(i=>!i.naturalWidth).length,
flat:drawn.filter(i=>!i.getBoundingClientRect().height).length,
moved:before!==getComputedStyle(slider.querySelector('.top')).clipPath,
view:slider.getBoundingClientRect().height,wide:document.documentElement.scrollWidth-innerWidth}})()"""


def probed(browser, page, width: int) -> dict:
    browser.resize(width, 900)
    browser.open(page.as_uri())
    browser.wait("document.readyState === 'complete' && document.querySelector('.slider') !== null")
    return browser.value(PROBE)


@pytest.mark.browser
@pytest.mark.parametrize("width", [1280, 500])
def test_page_opens_whole(browser, tmp_path, width):
    path = tmp_path / "report.html"
    write(path, views=[("a.png", "a portrait", *[png(np.full((32, 18, 3), 0.5, np.float32))] * 4)] * 2)
    found = probed(browser, path, width)
    assert found["images"] >= 10 and found["moved"] and found["wide"] <= 0
    assert (found["broken"], found["flat"]) == (0, 0) and browser.console() == []
    assert found["view"] <= 0.85 * 900


PAGE = """<!doctype html><video id="v" muted src="data:{kind};base64,{data}"></video><script>
const v=document.getElementById('v');
v.onerror=()=>{{window.found={{error:v.error.message||String(v.error.code)}}}};
v.onended=()=>{{const c=document.createElement('canvas');c.width=v.videoWidth;c.height=v.videoHeight;
const d=c.getContext('2d');d.drawImage(v,0,0);
const at=[1,3,5].map(i=>[...d.getImageData(c.width*i/6,c.height/2,1,1).data].slice(0,3));
window.found={{size:[c.width,c.height],seconds:v.duration,ended:v.ended,colors:at}}}};
v.play().catch(e=>{{window.found={{error:String(e)}}}})</script>"""
COLORS = np.array([[0.8, 0.3, 0.2], [0.2, 0.7, 0.3], [0.25, 0.35, 0.9]], np.float32)


def played(browser, film) -> dict:
    page = film.with_suffix(".html")
    page.write_text(PAGE.format(kind=f"video/{film.suffix[1:]}", data=base64.b64encode(film.read_bytes()).decode()))
    browser.open(page.as_uri())
    return browser.wait("window.found")


def stripes(shape, count):
    height, width = shape
    image = COLORS[np.arange(width) * 3 // width][None].repeat(height, 0)
    for i in range(count):
        frame = image.copy()
        frame[: height // 4, : width * (i + 1) // count] = 1
        yield frame


@pytest.mark.browser
@pytest.mark.parametrize(("name", "shape"), [("a.mp4", (378, 504)), ("a.webm", (120, 160)), ("hd.mp4", (720, 1280))])
def test_a_film_plays_to_its_end(browser, tmp_path, name, shape):
    """Colours are checked at a small and at a high resolution: players take another matrix for each where a film names none."""
    film = tmp_path / name
    write_film(film, stripes(shape, 15), fps=15)
    result = played(browser, film)
    assert result.get("ended") and result["size"] == [shape[1], shape[0]] and abs(result["seconds"] - 1) < 0.1, result
    np.testing.assert_allclose(np.array(result["colors"]) / 255, COLORS, atol=0.03)
