"""The server of the viewer: one port, a token, and messages of bounded size."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import importlib.util
import io
import logging
import math
import secrets
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

from warpgs import schema
from warpgs.errors import DataError, ResourceError, WarpgsError, expect, explained, install_extras
from warpgs.process import Say, say
from warpgs.ranks import HOST, WebGuard, loopback_socket
from warpgs.schema import Schema

if TYPE_CHECKING:
    import viser


def said(error: BaseException) -> str:
    """Return an error as one line, shortened; with its type unless it is a `WarpgsError`."""
    line = (str(error).strip().splitlines() or [""])[0][:200]
    return line if isinstance(error, WarpgsError) else f"{type(error).__name__}: {line}"


def guarded(callback: Callable[..., Any], tell: Say | None = None) -> Callable[..., None]:
    """Wrap a callback: if it raises an error for the user, ``tell`` it; else, or without ``tell``, print one line on stderr."""

    @functools.wraps(callback)
    def call(*args: Any) -> None:
        try:
            callback(*args)
        except Exception as e:  # any error of a browser's request; the viewer continues
            if tell is not None and isinstance(e, WarpgsError):
                tell(str(e))
            else:
                say(f"the viewer could not serve a request of a browser ({said(e)})", error=True)

    return call


NO_PARAMETERS = "URLSearchParams=class extends URLSearchParams{constructor(){super()}set(){}};"
"""JavaScript that runs before viser's own, so that address parameters have no effect and none is added. Some of them, such as
``websocket`` and ``playbackPath``, name servers and files to load."""
NO_TEXT_AS_CODE = (
    "{const made=Function,nothing=()=>{},make=args=>args.length>1?made(...args):nothing;"
    "eval=nothing;Function=new Proxy(made,{apply:(f,self,args)=>make(args),construct:(f,args)=>make(args)})}"
)
"""JavaScript that runs before viser's own, so that JavaScript in messages does nothing. The content policy cannot do this,
since the code that sorts Gaussians makes functions from text, too; functions with parameters are still allowed."""
_MARK_LOADED = (
    "document.createElement=function(name,...rest){"
    "const made=Document.prototype.createElement.call(this,name,...rest);"
    "if(name==='script'){made.nonce='NONCE';delete document.createElement}return made};"
)
"""JavaScript that gives the nonce to the one script that viser's page unpacks."""

_NO_FALSE_ALARM = "{const tell=console.error;console.error=(...a)=>/Computed radius is NaN/.test(a[0])||tell(...a)};"
"""JavaScript that hides an error of three.js on viser's mesh of Gaussians: its positions have two coordinates, so no radius."""
FIRST = NO_PARAMETERS + NO_TEXT_AS_CODE + _NO_FALSE_ALARM
"""JavaScript that runs before viser's own."""

LIMITS = "/limits"
"""Scene node with the limits of `TURNING`, as positions: of itself the way from the target to the first camera [u], of
``sides`` the captured arc to the left and right, and the margin, of ``tilt`` that above and below [rad], and 1 for on."""
TURNING = (
    "{const turn=2*Math.PI,begin=()=>{const m=window.__viserMutable,t=m?.cameraControl,root=m?.nodeRefFromName?.[''];"
    "if(!t||!root||!m.camera)return requestAnimationFrame(begin);const free=t.rotateTo,"
    "limits=()=>{const [away,a,b]=['','/sides','/tilt'].map(n=>m.nodeRefFromName['LIMITS'+n]?.position);"
    "return !b?.z||document.body.classList.contains('warpgs-free')?null:"
    "{away,left:a.x,right:a.y,margin:a.z,above:b.x,below:b.y}},"
    "pace=()=>{const l=limits(),range=l?Math.min(l.left+l.right+2*l.margin,turn):turn;"
    "t.azimuthRotateSpeed=t.polarRotateSpeed=range/turn*m.canvas.clientHeight/m.canvas.clientWidth},"
    "soft=(x,low,high,m)=>x>high?high+m*(1-Math.exp((high-x)/m)):x<low?-soft(-x,-high,-low,m):x,"
    "pulled=(x,low,high,m)=>x>high?high-m*Math.log(Math.max(1-(x-high)/m,.05)):x<low?-pulled(-x,-high,-low,m):x,"
    "moved=(x,by,low,high,m)=>soft(Math.min(Math.max(pulled(x,low,high,m)+by,low-3*m),high+3*m),low,high,m)-x;"
    "t.rotateTo=(a,p,smooth)=>{const l=limits();pace();if(!l)return free(a,p,smooth);"
    "const end=t.getSpherical({copy:s=>s}),c=m.camera,up=c.up.clone(),middle=(l.right-l.left)/2,"
    "q=c.quaternion.clone().setFromUnitVectors(up,up.clone().set(0,1,0)),"
    "v=l.away.clone().applyQuaternion(root.quaternion).applyQuaternion(q).normalize(),"
    "off=end.theta-Math.atan2(v.x,v.z)-middle,x=middle+off-turn*Math.round(off/turn),y=Math.acos(v.y)-end.phi;"
    "return free(end.theta+moved(x,a-end.theta,-l.left,l.right,l.margin),"
    "end.phi-moved(y,end.phi-p,-l.below,l.above,l.margin),smooth)};"
    "t.addEventListener('controlstart',pace);pace()};begin()}"
).replace("LIMITS", LIMITS)
"""JavaScript that keeps the camera where photographs show the scene: it turns freely within the captured arc, and ever less
in the margin beyond. A drag over the width of the window turns through the whole range."""
FOLD = (
    "if(matchMedia('(max-width:36em)').matches){const fold=()=>{"
    'const bar=document.querySelector(\'[style*="bottom: 0"] [style*="cursor: pointer"]\');'
    "bar?bar.click():requestAnimationFrame(fold)};fold()}"
)
"""JavaScript that folds the panel on a phone, where viser opens it over the lower half of the scene."""


def live_page(text: str, nonce: str) -> str:
    """Return viser's page for a content policy that only runs scripts with a nonce."""
    own = f"<script>{FIRST}{_MARK_LOADED.replace('NONCE', nonce)}{TURNING}{FOLD}</script>"
    return text.replace("<head>", f"<head>{own}", 1).replace("<script", f'<script nonce="{nonce}"')


MAX_FRAME = 2**16
"""Largest frame [bytes]; a camera takes 300."""
MAX_COORDINATE = 1e9
"""Largest coordinate [u]."""
MAX_TEXT = 4096
"""Longest text: names of images are among the values of controls."""


def _short(value: Any, place: str) -> None:
    schema.text(value, place)
    expect(len(value) <= MAX_TEXT, f"{place} must be at most {MAX_TEXT} letters long")


def _rotation(value: Any, place: str) -> None:
    """Allow unit quaternions."""
    schema.items(schema.number(-1.01, high=1.01), 4)(value, place)
    expect(abs(math.hypot(*value) - 1) <= 0.01, f"{place} must be a unit quaternion")


def _value(value: Any, place: str) -> None:
    """Allow what a control can hold."""
    if isinstance(value, list):
        schema.items(_coordinate, 3)(value, place)
    elif isinstance(value, str):
        _short(value, place)
    elif not isinstance(value, bool):
        _coordinate(value, place)


_coordinate = schema.number(-MAX_COORDINATE, high=MAX_COORDINATE)
_distance = schema.number(0, high=MAX_COORDINATE)
_point = schema.items(_coordinate, 3)
_size = schema.whole(0, 2**15)
_node = {"name": _short, "owner": _short}
_click = {"ray_origin": _point, "ray_direction": _point, "modifier": schema.or_null(_short)}
_only = functools.partial(schema.fields, others=False)
MESSAGES: Mapping[str, Schema] = {
    "ViewerCameraMessage": _only(
        {
            "wxyz": _rotation, "position": _point, "look_at": _point, "up_direction": _point,
            "fov": schema.number(1e-3, high=3.1), "near": _distance, "far": _distance, "image_height": _size,
            "image_width": _size,
        }
    ),
    "GuiUpdateMessage": _only({"uuid": _short, "updates": _only({"value": _value})}),
    "SceneNodeClickMessage": _only(
        {**_node, **_click, "instance_index": schema.or_null(schema.whole(0)), "screen_pos": schema.items(_coordinate, 2)}
    ),
    "ScenePointerMessage": _only(
        {**_click, "event_type": schema.one_of("click"), "screen_pos": schema.items(schema.items(_coordinate, 2), 1)}
    ),
    "TransformControlsUpdateMessage": _only({**_node, "wxyz": _rotation, "position": _point}),
    "TransformControlsDragStartMessage": _only(_node),
    "TransformControlsDragEndMessage": _only(_node),
}  # fmt: skip
"""Messages that the viewer needs, by type, with the schema of the other fields; viser has more, such as uploads and tunnels."""


def read_frame(frame: bytes | str) -> dict[str, Any]:
    """Return the message of a websocket frame, with ``type`` and checked fields."""
    import msgspec

    if not isinstance(frame, bytes) or len(frame) > MAX_FRAME:
        raise DataError(f"a message must be binary and at most {MAX_FRAME} bytes long")
    with explained("a message is malformed", "reload the page", (ValueError, TypeError, RecursionError)):
        message = msgspec.msgpack.decode(frame)
        expect(isinstance(message, dict) and all(isinstance(name, str) for name in message), "it is not an object with names")
        kind = message.pop("type", None)
        expect(isinstance(kind, str) and kind in MESSAGES, f"its type {str(kind)[:60]!r} is unknown")
        MESSAGES[kind](message, kind)
    return {"type": kind, **message}


def write_frame(message: Mapping[str, Any]) -> bytes:
    """Return a message as a frame: viser reads checked messages only."""
    import msgspec

    return bytes(msgspec.msgpack.encode(message))


def control_value(value: Any, control: Any) -> Any:
    """Return a message's value as a value for a control, clamped to the control's limits."""
    present = True if control is None else control.value
    low, high = getattr(control, "min", None), getattr(control, "max", None)
    if isinstance(present, bool):
        if isinstance(value, bool):
            return value
    elif isinstance(present, str):
        if value in (getattr(control, "options", None) or ()):
            return value
    elif isinstance(present, (int, float)):
        if _is_number(value):
            return type(present)(_limited(value, low, high))
    elif isinstance(present, tuple) and isinstance(value, list) and len(value) == len(present) and all(map(_is_number, value)):
        lows, highs = (limits if limits is not None else (None,) * len(present) for limits in (low, high))
        return [float(_limited(v, a, b)) for v, a, b in zip(value, lows, highs)]
    raise DataError(f"a control cannot have the value {str(value)[:60]!r}")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= MAX_COORDINATE


def _limited(value: float, low: float | None, high: float | None) -> float:
    return min(max(value, -math.inf if low is None else low), math.inf if high is None else high)


MAX_CONNECTIONS = 64
"""Largest number of connections at a time, including connections that have sent no request yet."""
REFUSED = "Open the address that the viewer printed.\n"
_HOOK = threading.Lock()


class Rules:
    """Rules for connections and messages, and the open connections."""

    def __init__(self) -> None:
        """Begin without controls."""
        self.guard = WebGuard()
        self.control_of: Callable[[str], Any] = lambda uuid: None
        """Function that returns a control by its identifier in messages."""
        self.connected: dict[Any, None] = {}
        """Connections of all kinds, in the order in which they came."""
        self.browsers: set[Any] = set()
        """Websockets."""

    def checked(self, frame: bytes | str) -> bytes | None:
        """Return a frame as viser may read it, or None for a value that its control cannot have."""
        message = read_frame(frame)
        if message["type"] == "GuiUpdateMessage":
            try:
                value = control_value(message["updates"]["value"], self.control_of(message["uuid"]))
            except DataError:  # empty for a moment while the user types
                return None
            message["updates"] = {"value": value}
        return write_frame(message)

    def answer(self, inner: Callable[..., Any] | None, protocol: str, connection: Any, request: Any) -> Any:
        """Return the answer to a request; None if its websocket may be opened."""
        from websockets.datastructures import Headers

        headers = request.headers
        upgrade = "Upgrade" in headers
        path = self.guard.admitted_path(request.path, headers.get_all("Host"), headers.get_all("Origin"), upgrade)
        if path is None or (upgrade and headers.get_all("Sec-WebSocket-Protocol") != [protocol]):
            return connection.respond(HTTPStatus.FORBIDDEN, REFUSED)
        if upgrade:
            self.browsers.add(connection)
            return None
        if inner is None:
            return connection.respond(HTTPStatus.NOT_FOUND, REFUSED)
        response = inner(connection, dataclasses.replace(request, path=path, headers=Headers()))  # no compression
        if response.headers.get("Content-Type", "").startswith("text/html"):
            response.body = live_page(response.body.decode("utf-8"), connection.nonce).encode()
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(response.body))
        return response

    def add_headers(self, connection: Any, request: Any, response: Any) -> None:
        """Add the headers of every answer."""
        for name, value in self.guard.headers(next(iter(request.headers.get_all("Host")), ""), connection.nonce).items():
            response.headers[name] = value


def connection_class(rules: Rules) -> type:
    """Return the class of connections that follow rules."""
    from websockets.asyncio.server import ServerConnection

    class Connection(ServerConnection):
        """A connection that checks messages before viser reads them."""

        def __init__(self, *args: Any, **named: Any):
            super().__init__(*args, **named)
            self.nonce = secrets.token_urlsafe(16)
            self.refused = False

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            rules.connected[self] = None
            if len(rules.connected) > MAX_CONNECTIONS:  # those that ask for nothing must not lock out a browser
                next((c for c in rules.connected if c not in rules.browsers), self).transport.abort()

        def connection_lost(self, exc: Exception | None) -> None:
            rules.connected.pop(self, None)
            rules.browsers.discard(self)
            super().connection_lost(exc)

        async def recv(self, *args: Any, **named: Any) -> bytes:
            """Return the next message that viser may read; a malformed one closes the connection."""
            while True:
                frame = await super().recv(*args, **named)
                if self.refused:  # messages from before the connection ended, too
                    continue
                try:
                    checked = rules.checked(frame)
                except DataError as e:
                    self.refused = True
                    say(f"the viewer closed the connection of a browser: {e}", error=True)
                    self.transport.abort()  # a client that sends such a message may ignore a normal close
                    continue
                if checked is not None:
                    return checked

    return Connection


def _failed(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Print an error of viser's own in one line."""
    error = context.get("exception")
    say(f"the viewer ignored a message ({said(error) if error else context.get('message')})", error=True)


@contextlib.contextmanager
def guarded_server(rules: Rules, bound: socket.socket, protocol: str) -> Iterator[None]:
    """Make the server that viser starts in the block follow rules, and listen at the socket ``bound``."""
    # viser has no option for such checks, so the function that starts its server is replaced in the block.
    import websockets.asyncio.server as module

    with _HOOK:
        serve = module.serve

        def guarded(handler: Any, *_: Any, process_request: Any = None, **named: Any) -> Any:
            async def handle(connection: Any) -> None:
                try:
                    await handler(connection)
                except Exception as e:
                    say(f"the viewer closed the connection of a browser ({said(e)})", error=True)

            asyncio.get_running_loop().set_exception_handler(_failed)
            # websockets would print tracebacks of invalid requests
            limits = {"max_size": MAX_FRAME, "server_header": None, "logger": logging.Logger("silent", logging.CRITICAL + 1)}
            return serve(
                handle, sock=bound, create_connection=connection_class(rules), process_response=rules.add_headers,
                process_request=lambda connection, request: rules.answer(process_request, protocol, connection, request),
                **{**named, **limits},
            )  # fmt: skip

        module.serve = guarded  # type: ignore[misc, assignment]
        try:
            yield
        finally:
            module.serve = serve  # type: ignore[misc]


PORT = 8080
"""Default port."""
REMEDY = install_extras("view")
OTHER_PORT = "choose another port with --port (fit: --view-port), or 0 for any free one"


def require_viser() -> None:
    """Check that viser is installed."""
    if importlib.util.find_spec("viser") is None:
        raise ResourceError(f"the viewer and scene.html need viser, which is not installed; {REMEDY}")


def _refuses_others(port: int) -> bool:
    """Return whether the server answers 403 to a request without the token."""
    with socket.create_connection((HOST, port), timeout=10) as stream:
        stream.sendall(f"GET / HTTP/1.1\r\nHost: {HOST}:{port}\r\n\r\n".encode())
        return stream.recv(64).startswith(b"HTTP/1.1 403 ")


def open_server(port: int = PORT, label: str = "warpgs") -> viser.ViserServer:
    """Start a server that only this machine reaches, at an address with a secret (`address`); ``server.stop()`` ends it."""
    require_viser()
    import viser

    class LocalServer(viser.ViserServer):
        rules: Rules

        def request_share_url(self, verbose: bool = True) -> None:
            """Refuse to open a tunnel to the internet."""

    rules, bound = Rules(), loopback_socket(port, OTHER_PORT)
    port = bound.getsockname()[1]
    # viser would print its address; the command prints it instead
    with guarded_server(rules, bound, f"viser-v{viser.__version__}"), contextlib.redirect_stdout(io.StringIO()):
        server = LocalServer(host=HOST, port=port, label=label, verbose=False)
    server.rules = rules
    if server.get_port() != port or not _refuses_others(port) or not hasattr(server.gui, "_gui_input_handle_from_uuid"):
        stop_server(server)
        why = "because requests to its server cannot be checked"
        raise ResourceError(f"viser {viser.__version__} is not supported, {why}; {REMEDY}")
    # viser has no public way to the shared control with an identifier; buttons of a single browser are not there
    rules.control_of = server.gui._gui_input_handle_from_uuid.get
    server.gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=True, control_width="medium")
    return server


def address(server: viser.ViserServer) -> str:
    """Return the address to open in a browser, with the secret that grants access."""
    return str(server.rules.guard.address(server.get_port()))


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server without the line that viser prints."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
