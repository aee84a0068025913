"""The viewer and the page of a model in a real browser: what they show, and that foreign pages get nothing."""

import dataclasses
import http.server
import json
import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.scenes import ring, three_gaussians
from tests.viewer import wait_shown
from warpgs.geometry import look_at, project_points
from warpgs.render.rasterize import rasterize
from warpgs.scene import Normalization
from warpgs.synthetic.demo import split_spec, write_demo
from warpgs.viewer import html, server as connections
from warpgs.viewer.server import address, open_server, stop_server
from warpgs.viewer.watch import live_view
from warpgs.viewer.window import CROP, PATH, Window, content_of_run

pytest.importorskip("viser")
WIDTH, HEIGHT = 700, 600
SHOWN = np.s_[200:, :]
"""Rows without the page's own button."""
CORNER = np.s_[40:160, :320]
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


UP, TARGET = np.array([0.0, -1, 0]), np.zeros(3)


def looking(azimuth, height=0.0):
    """A camera 4 u from the origin, at an azimuth to its right and a tangent of the elevation, that looks at it."""
    eye = 4 * np.array([np.sin(azimuth), -height, -np.cos(azimuth)])
    return dataclasses.replace(ring(1)[0], viewmat=look_at(eye, TARGET, UP))


def degrees(cameras, target=TARGET):
    """Captured arc to the left, right, top and bottom, and the margin beyond it, in degrees."""
    arc, margin = html.turning_limits(cameras, target, UP)
    return *np.degrees(arc), np.degrees(margin)


def test_a_page_turns_as_far_as_the_photographs_and_shows_what_they_saw():
    """To each side with a margin, about the scene's upward direction; a portrait photograph sees its own width."""
    narrow = [looking(np.radians(a)) for a in (0, -6, -3, 10)]
    np.testing.assert_allclose(degrees(narrow), [6, 10, 0, 0, 4], atol=1e-9)
    arc = [looking(np.radians(a), h) for a, h in ((0, 0), (-30, 0), (40, 0), (0, np.tan(np.radians(20))))]
    np.testing.assert_allclose(degrees(arc), [30, 40, 20, 0, 15], atol=1e-9)
    wide = [looking(np.radians(a)) for a in (0, 30, 80, 130, 180, 220)]  # further to one side than half a turn
    np.testing.assert_allclose(degrees(wide), [0, 220, 0, 0, 15], atol=1e-9)
    row = [moved(0.0), moved(2.0), moved(-1.0)]
    left, right = np.degrees(np.arctan2([1, 2], 4))
    np.testing.assert_allclose(degrees(row, row[0].center + np.array([0, 0, 4.0])), [left, right, 0, 0, (left + right) / 4])
    np.testing.assert_allclose(degrees([moved(0.0), moved(1e-3)])[4], 2)  # never stuck
    # a photograph far off the rest is left out: no other one shows what is between
    few = [looking(np.radians(a)) for a in (3, -6, 0, 6, 10)]
    np.testing.assert_allclose(degrees(html.middle_first([*few, looking(np.radians(80))], crowd())), [9, 7, 0, 0, 4], atol=1e-9)
    near = html.middle_first([looking(np.radians(20 * a)) for a in range(7)], crowd())
    np.testing.assert_allclose(degrees(near), [60, 60, 0, 0, 15], atol=1e-9)
    around = degrees([looking(np.radians(a), 0.5) for a in range(0, 360, 45)])
    np.testing.assert_allclose(around, [np.inf, np.inf, 0, 0, 15], atol=1e-9)
    np.testing.assert_array_equal(degrees(arc[:1])[:4], np.inf)
    # not about that of a camera that looks down: half a turn about it would end below the ground
    server = SimpleNamespace(scene=SimpleNamespace(set_up_direction=lambda up: None), initial_camera=SimpleNamespace())
    cameras = [looking(np.radians(a), 0.7) for a in range(0, 360, 45)]
    up = html.place_first_camera(server, cameras[0], three_gaussians(), cameras)[1]
    np.testing.assert_allclose(server.initial_camera.up, up)
    np.testing.assert_allclose(up, UP, atol=1e-6)
    down = dataclasses.replace(cameras[0], viewmat=look_at(np.array([0.0, -4, 0]), TARGET, np.array([0.0, 0, 1])))
    up = html.place_first_camera(server, down, three_gaussians(), cameras)[1]  # the scene's is in the middle of its image
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-6)
    # cameras beside the first add what they see of the plane through the target
    first = moved(0.0)
    K = np.array([[100.0, 0, 30], [0, 100, 60], [0, 0, 1]])
    portrait = dataclasses.replace(first, K=K, width=60, height=120)
    target = np.array([0, 0, 4.0])
    np.testing.assert_allclose(html.seen_at([portrait], target), [0.3, 0.6])
    row = [dataclasses.replace(portrait, viewmat=moved(x).viewmat) for x in (0.0, -1.0, 2.0)]
    np.testing.assert_allclose(html.seen_at(row, target), [0.3 + 1 / 4, 0.6])
    # but not what one of five sees, which stays vague
    np.testing.assert_allclose(html.seen_at([portrait] * 3 + row[1:], target), [0.3, 0.6])
    cameras = [moved(x) for x in (4.0, 0.0, 1.5, 1.0)]
    wall = dataclasses.replace(crowd(), means=crowd().means * 0.1 + crowd().means.new_tensor([0, 0, 40.0]))
    assert [c.center[0] for c in html.middle_first(cameras, wall)] == [1.5, 4.0, 0.0, 1.0] and html.middle_first([], wall) == []
    # a close-up in the middle shows less than the others
    cameras[2] = dataclasses.replace(cameras[2], K=cameras[2].K * [[40, 1, 1], [1, 40, 1], [1, 1, 1]])
    assert html.middle_first(cameras, wall)[0].center[0] == 1.0
    # photographs on their side: the page starts upright, as films and the report do
    roll = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    lying = [dataclasses.replace(c, viewmat=roll @ c.viewmat) for c in (looking(a, 0.3) for a in np.arange(8) * np.pi / 4)]
    lying = html.middle_first(lying, crowd())
    assert (lying[0].width, lying[0].height) == (lying[1].height, lying[1].width)
    np.testing.assert_allclose(html.place_first_camera(server, lying[0], three_gaussians(), lying)[1], UP, atol=1e-6)
    assert -lying[0].viewmat[1] @ [*UP, 0] > 0.9


def test_limits_end_where_fewer_than_two_photographs_saw_the_surface():
    """Two photographs of the front and one of the back do not support the sides; photographs between them do."""
    i = torch.arange(900, dtype=torch.float64) + 0.5  # a ball
    polar, azimuth = torch.arccos(1 - 2 * i / 900), np.pi * (1 + 5**0.5) * i
    ball = torch.stack([polar.sin() * azimuth.cos(), polar.cos(), polar.sin() * azimuth.sin()], 1).float()
    one, turn = torch.ones(900), torch.tensor([[1.0, 0, 0, 0]])
    g = type(three_gaussians())(ball, turn.repeat(900, 1), ball * 0 - 2.5, 4 * one, ball[:, None] * 0)

    def ends(*azimuths):
        cameras = [looking(np.radians(a)) for a in azimuths]
        arc, margin = html.supported(g, cameras, TARGET, UP, *html.turning_limits(cameras, TARGET, UP))
        return np.degrees(arc[:2] + margin)

    few, many = ends(0, 10, 170), ends(*range(0, 180, 10))
    assert 10 < few[1] < 30 and few[0] == pytest.approx(15, abs=3) and 170 < many[1] < 185
    # cameras without a centre have no such views, and the limits are those of the arc
    parallel = [dataclasses.replace(looking(a), model="orthographic") for a in (0.0, 0.2, 2.0)]
    limits = html.turning_limits(parallel, TARGET, UP)
    assert html.supported(g, parallel, TARGET, UP, *limits) == limits
    # the first camera at an end of the arc, a rounding error beyond it, is no whole turn
    for i in range(8):
        up = np.array([0.1 * i, -1, 0.05]) / np.hypot(0.1 * i, np.hypot(1, 0.05))
        row = [dataclasses.replace(c, viewmat=look_at(c.center, TARGET, up)) for c in (looking(1.0), looking(1.1))]
        assert html.turning_limits(row, TARGET, up)[0][:2].max() < 0.2


TURNED = "(()=>{const t=__viserMutable.cameraControl;t.update(9);return t.azimuthAngle})()"
"""Azimuth of the page's camera at the end of its motion, in JavaScript [rad]."""


@pytest.mark.browser
def test_a_page_stops_where_the_photographs_end(browser, tmp_path):
    """Softly; one window width of drag is the whole range, and a button switches the limits and the frame off."""
    path, cameras = tmp_path / "scene.html", [looking(np.radians(a)) for a in (0, -6, 10)]
    g = three_gaussians()
    html.write_html(path, dataclasses.replace(g, means=g.means - g.means.mean(0)), cameras, background=(1.0, 0.2, 0.0))
    browser.resize(WIDTH, HEIGHT)
    browser.open(path.as_uri())
    turned = "window.__viserMutable?.cameraControl?.rotate(0, 0, false)"
    browser.wait(f"({turned}, (window.__viserMutable?.cameraControl?.azimuthRotateSpeed ?? 1) < 0.2)")
    first = browser.value(TURNED)

    def rotated(angle):
        browser.value(f"void __viserMutable.cameraControl.rotate({np.radians(angle)}, 0, false)")
        return np.degrees(browser.value(TURNED) - first)

    speed = browser.value("__viserMutable.cameraControl.azimuthRotateSpeed")
    assert speed * 360 * WIDTH / HEIGHT == pytest.approx(6 + 10 + 2 * 4, rel=1e-3)
    assert rotated(8) == pytest.approx(8, abs=0.01) and rotated(-4) == pytest.approx(4, abs=0.01)  # free in the captured arc
    assert 12 < rotated(10) < 13 and 13.5 < rotated(90) < 14  # resistance, then the end
    assert rotated(-60) == pytest.approx(-6 - 4 * 0.95, abs=0.05)
    browser.value("dispatchEvent(new KeyboardEvent('keydown', {key: 'r', bubbles: true}))")
    browser.wait(f"Math.abs({TURNED} - {first}) < 1e-3")
    assert browser.value("document.querySelector('#warpgs-frame').checkVisibility()")
    color = browser.value("getComputedStyle(document.querySelector('#warpgs-frame')).boxShadow")
    assert color.startswith("rgba(255, 51, 0, 0.9)")
    browser.value("document.querySelector('#warpgs-limits').click()")
    assert not browser.value("document.querySelector('#warpgs-frame').checkVisibility()")
    assert rotated(60) == pytest.approx(60, abs=0.05)
    browser.value("document.querySelector('#warpgs-limits').click()")
    browser.wait(f"Math.abs({TURNED} - {first + np.radians(10 + 4 * 0.95)}) < 1e-3")


def moved(x):
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    return dataclasses.replace(ring(1)[0], viewmat=viewmat)


@pytest.mark.browser
def test_a_page_tells_how_to_move_and_returns(browser, tmp_path):
    """A line of help, no scene tree; the key R and a button lead back to the first view; loading is said."""
    path = tmp_path / "scene.html"
    html.write_html(path, crowd(), [ring(3)[1]], title="my <scene>")
    body = path.read_text("utf-8").partition("<body>")[2]
    assert body.startswith('<div id="warpgs-loading"') and "Loading the scene" in body[:300]
    browser.open(path.as_uri())
    browser.wait("window.__viserMutable?.resetCameraPose && document.querySelector('canvas') !== null")
    browser.wait("document.querySelector('[aria-label$=\"scene tree\"]') !== null")
    browser.wait("document.querySelector('#warpgs-loading') === null")
    assert browser.value("document.title") == "my <scene>" and "Drag to turn" in browser.value("document.body.innerText")
    browser.resize(390, 844)  # on a phone, the buttons are in one row; words are legible before a white wall, too
    assert browser.value("new Set([...document.querySelectorAll('#warpgs-help button')].map(b=>b.offsetTop)).size") == 1
    color = browser.value("getComputedStyle(document.querySelector('#warpgs-help span')).backgroundColor")
    assert color == "rgba(0, 0, 0, 0.45)"
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


@pytest.mark.browser
def test_a_page_has_a_ruler(browser, tmp_path):
    """Two clicks on Gaussians give the distance of their means in the unit of the files; a click beside them says so."""
    g, camera, path = three_gaussians(), ring(3)[1], tmp_path / "scene.html"
    means = g.means.new_tensor([[-0.8, 0.1, 0.5], [0.1, 0.2, 0.1], [0.5, -0.3, -0.2]])
    g = dataclasses.replace(g, means=means, log_scales=0 * g.log_scales - 2.5, logit_opacities=0 * g.logit_opacities + 4)
    K = np.diag([20, 20, 1.0]) @ camera.K
    K[:2, 2] = 400, 320
    html.write_html(path, g, [camera], normalization=Normalization(scale=0.25, unit="m"))
    browser.resize(800, 640)
    browser.open(path.as_uri())
    ruler = "document.querySelector('#warpgs-ruler')"
    browser.wait(f"{ruler} && document.querySelector('#warpgs-loading') === null")
    browser.value(f"{ruler}.click()")
    ends = means.double().numpy()[[0, 2]]
    length = np.linalg.norm(ends[0] - ends[1]) / 0.25
    pixels = project_points(dataclasses.replace(camera, K=K), ends)[0].tolist()
    for (x, y), said in zip([*pixels, (5, 600)], ("click the other point", f": {length:.2g}", "no surface there")):
        for kind in ("mousePressed", "mouseReleased"):
            browser.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        browser.wait(f"{ruler}.textContent.includes({said!r})")
    assert not refused(browser), browser.console()


@pytest.mark.browser
def test_a_page_from_disk_shows_the_render(browser, tmp_path):
    """At least 22 dB at a training camera; without the script for pages from disk the Gaussians come in the wrong order."""
    g, camera = crowd(), ring(3)[1]
    factor = HEIGHT / camera.height
    K = np.diag([factor, factor, 1.0]) @ camera.K
    K[:2, 2] = WIDTH / 2, HEIGHT / 2
    wanted = rasterize(g, dataclasses.replace(camera, K=K, width=WIDTH, height=HEIGHT)).rgb.clamp(0, 1).numpy()
    path = tmp_path / "scene.html"
    assert html.write_html(path, g, [camera]) == [] and wanted[SHOWN].std() > 0.1
    browser.resize(WIDTH, HEIGHT)
    browser.open(path.as_uri())
    image = browser.picture_of(lambda found: psnr(found, wanted) > 22)  # they are sorted by a worker, and fade in
    assert psnr(image, wanted) > 22, psnr(image, wanted)
    assert image[CORNER].min(-1).max() < 0.4  # no white letters
    assert not refused(browser), browser.console()
    path.write_text(path.read_text("utf-8").replace(html.SORT_FROM_DISK, ""), "utf-8")
    browser.open(path.as_uri())
    before: list[np.ndarray] = []
    unsorted = browser.picture_of(lambda found: refused(browser) and settled(found, before))
    assert refused(browser) and psnr(unsorted, wanted) < psnr(image, wanted) - 3


@pytest.mark.browser
def test_a_page_on_a_phone_shows_the_whole_width_of_the_first_image(browser, tmp_path):
    """A narrow window has a wider field of view, also after it was turned; a wide one has the camera's."""
    camera, path = ring(1)[0], tmp_path / "scene.html"
    html.write_html(path, crowd(), [camera])
    tall, wide = (camera.height / camera.K[1, 1], camera.width / camera.K[0, 0])
    browser.resize(390, 844)
    browser.open(path.as_uri())
    for width, height in ((390, 844), (844, 390), (390, 844)):
        browser.resize(width, height)
        degrees = 2 * np.degrees(np.arctan(max(tall, wide * height / width) / 2))
        browser.wait(f"Math.abs((window.__viserMutable?.camera?.fov ?? 0) - {degrees}) < 1e-3")


def refused(browser) -> list[str]:
    """Lines of the console on what the content policy, or the browser, refused."""
    return [line for line in browser.console() if "Content Security Policy" in line or "Refused" in line]


def settled(image: np.ndarray, before: list[np.ndarray]) -> bool:
    """Whether Gaussians are shown, and the picture is the one before; keeps it for the next."""
    before.append(image)
    return image[SHOWN].std() > 0.05 and len(before) > 1 and np.array_equal(image, before[-2])


# The viewer in a real browser: it works under its content policy, and pages of other sites get nothing from it.

viser = pytest.importorskip("viser")

TEXT = "(document.body?.innerText || '')"
"""Text of a page, in JavaScript."""
FOREIGN = """<!doctype html><title>foreign</title><iframe name=below></iframe><form method=post target=below></form><script>
const at=AT,other=location.host+'/evil',evil='?websocket=ws://'+other,played='?playbackPath=http://'+other,found={};
const wait=(what,turn)=>new Promise(done=>{
 const end=x=>done([what,String(x)]);setTimeout(()=>end('nothing'),20000);turn(end)});
const body=frame=>{try{return frame.contentDocument?'read':'closed'}catch(e){return 'closed'}};
const framed=(what,url)=>wait(what,end=>{const frame=document.createElement('iframe');frame.src=url;
 frame.onload=()=>setTimeout(()=>end(body(frame)),500);document.body.append(frame)});
const socket=(what,url)=>wait(what,end=>{try{const s=new WebSocket(url,'viser-vVERSION');
 s.onopen=()=>end('open');s.onerror=()=>end('refused')}catch(e){end('refused')}});
const fetched=(what,url,how)=>wait(what,end=>
 fetch(url,how).then(r=>r.text()).then(t=>end('read '+t.length),()=>end('refused')));
(async()=>{const tried=[];
for(const base of at){const ws=base.replace('http','ws');tried.push(
 framed('frame',base),framed('frame with websocket',base+evil),framed('frame with playback',base+played),
 socket('socket',ws),socket('socket at the top',ws.replace(/\\/$/,'')),
 fetched('fetch',base),fetched('fetch simple',base,{mode:'no-cors'}),
 fetched('post',base,{method:'POST',mode:'no-cors',body:'x=1'}))}
for(const base of at){document.forms[0].action=base;document.forms[0].submit()}
for(const [what,how] of await Promise.all(tried))(found[what]=found[what]||[]).push(how);
window.found=found})()</script>"""


@contextmanager
def site(page=""):
    """Another site on this machine, that counts what comes to it; yields its address and the paths that were asked for."""
    seen = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            seen.append(self.path)
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(page.encode())

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://localhost:{server.server_address[1]}", seen
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    import warpgs

    folder = tmp_path_factory.mktemp("browser")
    write_demo(folder / "scene", views=8, width=48, height=36)
    config = warpgs.FitConfig(steps=12)
    warpgs.fit(str(folder / "scene"), config, split=split_spec(8), out=folder / "run", device="cpu", verbose=False)
    return folder


@contextmanager
def viewing(folder, kind):
    """A listener of a command, with the scene in it: of `warpgs view`, or of `warpgs fit --view`."""
    content = content_of_run(folder / "run")
    if kind == "fit --view":
        with live_view(folder / "run", port=0) as live:
            live.look(content.model)
            wait_shown(live)
            yield live.server
        return
    server = open_server(0)
    window = Window(server, content)
    try:
        yield server
    finally:
        window.close()
        stop_server(server)


class Admitted(set):
    """Websockets, and how many there have ever been."""

    ever = 0

    def add(self, item):
        self.ever += 1
        super().add(item)


def trouble(browser) -> list[str]:
    """Lines of the console of the content policy, of scripts that failed, and of connections that were refused."""
    words = ("Content Security Policy", "Refused", "exception", "EvalError", "WebSocket connection")
    return [line for line in browser.console() if any(w in line for w in words)]


@pytest.mark.browser
def test_the_viewer_works_under_its_policy(folder, browser, capfd):
    """The scene is seen, the panel answers, a reload connects anew, and messages cannot bring JavaScript."""
    with viewing(folder, "view") as server:
        browser.open(address(server))
        browser.wait(f"{TEXT}.includes('Gaussians') && {TEXT}.includes('cameras')")
        assert len(server.rules.browsers) == 1
        image = browser.picture_of(lambda found: found[150:, :500].std() > 0.05)
        assert image[150:, :500].std() > 0.05, trouble(browser)
        assert browser.value("location.href") == address(server)
        browser.value("[...document.querySelectorAll('label')].find(l=>l.innerText.includes('cameras')).click()")
        assert trouble(browser) == []
        browser.open(address(server))
        browser.wait(f"{TEXT}.includes('Gaussians')")
        server._websock_server.queue_message(viser._messages.RunJavascriptMessage(source="window.ran=1"))
        server.gui.add_markdown("what comes after it")
        browser.wait(f"{TEXT}.includes('what comes after it')")
        assert browser.value("typeof window.ran") == "undefined"
        for code in ("Function('return 1')()", "new Function('return 1')()", "(0,eval)('1')"):
            assert browser.value(f"typeof {code}") == "undefined"
        assert trouble(browser) == []
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.browser
def test_the_viewer_has_the_limits_of_the_page(folder, browser):
    """Also in a browser that is there before the model; the panel switches them off."""
    content = content_of_run(folder / "run")
    server = open_server(0)
    browser.open(address(server))
    browser.wait("window.__viserMutable?.cameraControl != null")
    window = Window(server, content)
    try:
        tilt = "window.__viserMutable?.nodeRefFromName?.['/limits/tilt']?.position"
        browser.wait(f"{tilt}?.z === 1")
        ahead = html.distance_ahead(window.first, content.model.gaussians())
        browser.wait(f"({TURNED}, Math.abs(__viserMutable.cameraControl.distance - {ahead}) < 1e-3)")
        first = browser.value(TURNED)
        until = time.monotonic() + 60
        while window._limits is window._widest and time.monotonic() < until:
            time.sleep(0.02)
        sides = tilt.replace("tilt", "sides")
        browser.wait(f"Math.abs({sides}.z - {window._limits[1]}) < 1e-5 && Math.abs({sides}.y - {window._limits[0][1]}) < 1e-5")
        browser.value("void __viserMutable.cameraControl.rotate(2, 0, false)")
        arc, margin = window._limits
        assert np.degrees(browser.value(TURNED) - first) == pytest.approx(np.degrees(arc[1] + 0.95 * margin), abs=0.1)
        window.panel.limits.value = False
        browser.wait(f"{tilt}?.z === 0")
        browser.value("void __viserMutable.cameraControl.rotate(1, 0, false)")
        assert browser.value(TURNED) - first == pytest.approx(arc[1] + 0.95 * margin + 1, abs=0.002)
        window.step_into(content.model.train[-1], None)  # within the captured arc, perhaps not within the supported one
        assert window._limits is window._widest
        window.move(window.first, None)
        assert window._limits is window._narrow is not window._widest
        assert trouble(browser) == []
    finally:
        window.close()
        stop_server(server)


@pytest.mark.browser
def test_the_panel_of_a_phone_starts_folded(folder, browser):
    """A tap on its bar opens it; in a wide window it is open."""
    bar = 'document.querySelector(\'[style*="bottom: 0"] [style*="cursor: pointer"]\')'
    with viewing(folder, "view") as server:
        browser.resize(390, 844)
        browser.open(address(server))
        browser.wait(f"{bar} && !{TEXT}.includes('step into') && {bar}.getBoundingClientRect().top > 750")
        browser.value(f"{bar}.click()")
        browser.wait(f"{TEXT}.includes('step into') && {bar}.getBoundingClientRect().top < 600")
        browser.resize(WIDTH, HEIGHT)
        browser.open(address(server))
        browser.wait(f"{TEXT}.includes('step into')")
        assert trouble(browser) == []


@pytest.mark.browser
@pytest.mark.parametrize("kind", ["view", "fit --view"])
def test_a_foreign_page_gets_nothing(folder, browser, kind):
    """Frames, sockets, requests and forms, with and without the address, from another site: nothing opens or is written."""
    with viewing(folder, kind) as server:
        port = server.get_port()
        known = [f"http://{host}:{port}/" for host in ("127.0.0.1", "localhost")]
        # with the secret, too: a page that somehow learns it still gets no socket and no frame
        at = json.dumps([*known, address(server), address(server).replace("127.0.0.1", "localhost")])
        page = FOREIGN.replace("AT", at, 1).replace("VERSION", viser.__version__)
        with site(page) as (foreign, seen):
            server.rules.browsers = Admitted()
            browser.open(f"{foreign}/page")
            found = json.loads(browser.wait("window.found && JSON.stringify(window.found)"))
            assert browser.value("document.title") == "foreign"
            framings = [line for line in browser.console() if "Framing" in line and "frame-ancestors 'none'" in line]
            assert len(framings) >= 3 * 4, browser.console()
            assert set(found) == {
                "frame", "frame with websocket", "frame with playback", "socket", "socket at the top", "fetch", "fetch simple",
                "post",
            }  # fmt: skip
            for what, hows in found.items():
                assert len(hows) == 4 and set(hows) <= {"refused", "closed", "nothing", "read 0"}, (what, hows)
            for base in (*known, address(server)):  # and as the page that is looked at
                browser.open(f"{base}?websocket=ws://{foreign.removeprefix('http://')}/evil")
                browser.wait(f"{TEXT}.includes({connections.REFUSED.strip()!r})")
            assert not [path for path in seen if "evil" in path], seen
        assert server.rules.browsers.ever == 0
    assert not (folder / "run" / PATH).exists() and not (folder / "run" / CROP).exists()


@pytest.mark.browser
def test_a_page_from_disk_obeys_no_parameters(folder, browser, tmp_path):
    """It shows its own model, and asks nobody, whatever stands behind its address."""
    html.write_html(tmp_path / "scene.html", content_of_run(folder / "run").model.gaussians())
    with site() as (foreign, seen):
        host = foreign.removeprefix("http://")
        for query in (
            f"websocket=ws://{host}/evil",
            f"playbackPath={foreign}/evil",
            "dummyWindowDimensions=fill&dummyWindowTitle=evil",
        ):
            browser.open(f"{(tmp_path / 'scene.html').as_uri()}?{query}")
            browser.wait("document.querySelector('canvas') !== null")
            assert browser.value("new URLSearchParams(location.search).size") == 0
            assert "evil" not in browser.value("document.body.innerText")
        assert seen == []
