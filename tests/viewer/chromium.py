"""A headless Chromium that tests drive by its debugging protocol, over two pipes: it opens no port."""

import base64
import contextlib
import io
import json
import os
import queue
import shutil
import signal
import subprocess
import threading
import time

import numpy as np
import pytest
from PIL import Image

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
WEBGL = ("--disable-gpu-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
TIME = 120
"""Seconds that anything may take."""
CHANGED = ("navigated", "context was destroyed", "context with specified id", "Promise was collected", "active page")
"""Words of errors of a page that another one took the place of."""


class PageChanged(Exception):
    """Another page took the place of the one that was asked."""


class Chromium:
    def __init__(self, folder, *graphics: str):
        browser = next(filter(None, map(shutil.which, BROWSERS)), None)
        if browser is None or not hasattr(os, "set_inheritable"):
            pytest.skip(f"none of {', '.join(BROWSERS)} is there")
        to_read, self._write = os.pipe()
        self._read, to_write = os.pipe()
        words = [
            browser, "--headless=new", "--no-sandbox", *(graphics or WEBGL), "--disable-quic", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--disable-sync", "--remote-debugging-pipe",
            f"--user-data-dir={folder / 'profile'}", "--window-size=900,700", "about:blank",
        ]  # fmt: skip
        # the browser reads commands at 3 and writes at 4
        shell = 'exec 3<&"$0" 4>&"$1"; shift; exec "$@"'
        self.process = subprocess.Popen(
            ["bash", "-c", shell, str(to_read), str(to_write), *words], pass_fds=(to_read, to_write), start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(to_read)
        os.close(to_write)
        self.events: list[dict] = []
        self._answers: queue.Queue = queue.Queue()
        self._number, self._session = 0, None
        threading.Thread(target=self._listen, daemon=True).start()
        target = next(t for t in self.ask("Target.getTargets")["targetInfos"] if t["type"] == "page")
        self._session = self.ask("Target.attachToTarget", targetId=target["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.ask(f"{domain}.enable")

    def _listen(self):
        left = b""
        with open(self._read, "rb", buffering=0) as stream:
            while part := stream.read(2**16):
                *whole, left = (left + part).split(b"\0")
                for text in whole:
                    message = json.loads(text)
                    (self._answers.put if "id" in message else self.events.append)(message)
        self._answers.put({"id": None, "error": "the browser has ended"})

    def ask(self, method: str, **params) -> dict:
        self._number += 1
        session = {"sessionId": self._session} if self._session else {}
        text = json.dumps({"id": self._number, "method": method, "params": params, **session})
        os.write(self._write, text.encode() + b"\0")
        answer = self._answers.get(timeout=2 * TIME)
        if "error" in answer and any(w in str(answer["error"]) for w in CHANGED):
            raise PageChanged(answer)
        assert answer.get("id") == self._number and "error" not in answer, answer
        return answer["result"]

    def open(self, address: str) -> None:
        self.ask("Page.navigate", url=address)

    def value(self, expression: str):
        found = self.ask("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait(self, expression: str):
        """Wait until JavaScript has a true value, looked at in each frame of the page, and return it."""
        promise = (
            f"new Promise(done => {{const end = performance.now() + {1000 * TIME}; const look = () => {{"
            f"const found = {expression}; found || performance.now() > end ? done(found) : requestAnimationFrame(look)}}"
            "; look()})"
        )
        until = time.monotonic() + TIME
        while True:
            try:
                found = self.value(promise)
                assert found, f"{expression}: {self.console()}"
                return found
            except PageChanged:  # as it is loaded: look at the next one
                assert time.monotonic() < until, f"{expression}: {self.console()}"

    def resize(self, width: int, height: int) -> None:
        """Give the page a size [px], which pictures have then."""
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def picture_of(self, shows):
        """First picture, [H, W, 3] in [0, 1], for which a function is true; the last one where none is, in time."""
        until = time.monotonic() + TIME
        while True:
            with contextlib.suppress(PageChanged):
                image = np.asarray(Image.open(io.BytesIO(self.picture())).convert("RGB"), np.float32) / 255
                if shows(image) or time.monotonic() > until:
                    return image

    def console(self) -> list[str]:
        lines = []
        for event in self.events:
            found = event.get("params", {})
            if event["method"] == "Log.entryAdded":
                lines.append(f"{found['entry']['level']}: {found['entry']['text']}")
            elif event["method"] == "Runtime.consoleAPICalled":
                lines.append(f"{found['type']}: {' '.join(str(a.get('value', a.get('description'))) for a in found['args'])}")
            elif event["method"] == "Runtime.exceptionThrown":
                lines.append(f"exception: {found['exceptionDetails']}")
        return lines

    def picture(self) -> bytes:
        return base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])

    def close(self) -> None:
        os.close(self._write)
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
