"""Viewing a run, a file, or a fit that is still going, until Ctrl-C."""

from __future__ import annotations

import contextlib
import math
import shlex
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from warpgs.errors import DataError, WarpgsError, similar_folder
from warpgs.export.base import all_formats, suffixes
from warpgs.pipeline.model.table import FittedModel
from warpgs.pipeline.run.folder import CONFIG, read_record
from warpgs.pipeline.run.request import choose_device
from warpgs.process import say
from warpgs.report.progress import waiting
from warpgs.scene import Gaussians
from warpgs.viewer.server import PORT, address, open_server, require_viser, stop_server
from warpgs.viewer.window import Content, Window, content_of_file, content_of_run, modified, views_of

if TYPE_CHECKING:
    import viser

POLL = 1.0
"""Time between checks of a run folder, and between states of a fit in this process [s]."""


def view(path: Path, port: int = PORT, device: str = "auto", reader: str | None = None) -> None:
    """Show a run folder or a file of Gaussians until Ctrl-C; new checkpoints of a running fit are shown, too."""
    choose_device(device)
    if path.is_dir():
        read_record(path)
    elif path.suffix.lower() in (".html", ".htm") and path.is_file():
        raise DataError(f"{path}: is a web page; open this file in a browser")
    elif not path.is_file() or not any(kind.fits(path) for kind in all_formats()):
        what = "of no known format" if path.exists() else "no such file or folder"
        fix = f"give a run folder ({CONFIG} in it) or a file of Gaussians ({', '.join(suffixes())})"
        raise DataError(f"{path}: {what}; {similar_folder(path) or fix}")
    require_viser()
    with contextlib.suppress(KeyboardInterrupt):
        server = open_server(port)
        try:
            say(f"open {address(server)} in a browser on this machine; Ctrl-C ends")
            _follow(server, path, device, reader)
        finally:
            stop_server(server)


def _follow(server: viser.ViserServer, path: Path, device: str, reader: str | None) -> None:
    """Show the present state, and every later checkpoint."""
    window, seen, stages, is_run = None, None, waiting(), path.is_dir()
    if is_run and modified(path) is None:
        stages("waiting")
        say("waiting for the first checkpoint of the fit")
    while True:
        found = modified(path) if is_run else 0.0
        if found is not None and found != seen:
            seen = found
            if window is None:
                stages(f"reading {path}")
                content = content_of_run(path, device) if is_run else content_of_file(path, choose_device(device)[0].type)
                views, notes = views_of(content, reader)
                for note in notes:
                    say(f"  {note}")
                window = Window(server, replace(content, views=views))
                stages.clear()
                say(f"  {content.title}: {len(content.model.gaussians()):,} Gaussians")
            else:
                try:
                    window.show(content_of_run(path, device, window.content.views))
                    say(f"  step {window.content.model.step}: {len(window.content.model.gaussians()):,} Gaussians")
                except WarpgsError as e:  # the previous checkpoint stays
                    say(f"  {e}", error=True)
        _pause()


def _pause() -> None:
    """Wait until the next check."""
    time.sleep(POLL)


class LiveView:
    """A viewer of a fit in this process: a thread of its own shows the latest state, and the fit never waits for it."""

    def __init__(self, server: viser.ViserServer, title: str, folder: Path):
        """Begin without a state."""
        self.server, self.title, self.folder = server, title, folder
        self._latest: FittedModel | None = None
        self._next = -math.inf
        self._wake, self._open = threading.Event(), True
        self._window: Window | None = None
        self._thread = threading.Thread(target=self._draw, name="live view", daemon=True)
        self._thread.start()

    def look(self, model: FittedModel) -> None:
        """Copy a state before the fit's next step overwrites it, at most once per `POLL`; an older unshown one is dropped."""
        if time.monotonic() < self._next:
            return
        copy = {n: t.detach().to("cpu", copy=True) for n, t in model.gaussians().tensors().items()}
        self._latest = replace(model, scene_gaussians=Gaussians(**copy))
        self._next = time.monotonic() + POLL
        self._wake.set()

    def close(self) -> None:
        """Stop showing states."""
        self._open = False
        self._wake.set()
        self._thread.join(timeout=10)
        if self._window is not None:
            self._window.close()

    def _draw(self) -> None:
        """Show each state that comes, until `close`."""
        try:
            while self._wake.wait() and self._open:
                self._wake.clear()
                model, self._latest = self._latest, None
                if model is None or not len(model.gaussians()):
                    continue
                content = Content(self.title, model, self.folder)
                if self._window is None:
                    self._window = Window(self.server, content, maps=False)
                else:
                    self._window.show(content)
        except Exception as e:  # errors of viser, too, so that the fit continues
            say(f"the viewer stopped ({type(e).__name__}: {e}); the fit continues", error=True)


@contextlib.contextmanager
def live_view(folder: Path, port: int = PORT) -> Iterator[LiveView]:
    """Give a viewer of a fit that runs in the block; it closes when the fit ends."""
    server = open_server(port)
    try:
        say(f"watch the fit at {address(server)} (afterwards with `warpgs view {shlex.quote(str(folder))}`)")
        with contextlib.closing(LiveView(server, folder.resolve().name, folder)) as live:
            yield live
    finally:
        stop_server(server)
