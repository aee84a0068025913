"""Longest silence of each command in a terminal: how long a user looks at a screen on which nothing moves.

usage: python -m bench.silence [--photos FOLDER] [--scene FOLDER] [--only NAME ...] [--out FILE.json]
Each command runs in a terminal of its own (a pty of 100 x 30 characters). A silence ends when text is written that is not
what was last written there, so that a frame drawn again without a change is none. The demo scene is fitted with 12 training
views by the preset quick and an empty kernel cache. `--photos` finds the poses of the photographs in a folder, `--scene`
adds a fit of a scene of one's own.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import sys
import tempfile
import termios
import time
from dataclasses import dataclass, field
from pathlib import Path

import torch

from bench import result_file
from bench.machine import describe

ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\x1b[()][0-9A-Za-z]|[\r\b]")
COLUMNS, ROWS = 100, 30


@dataclass
class Watch:
    """What was written to a terminal, and when."""

    last: float = 0.0
    """Time of the last change [s]."""
    text: str = ""
    """Text of the last change."""
    first: float | None = None
    """Time of the first text [s]."""
    silences: list[tuple[float, float, str]] = field(default_factory=list)
    """Length and beginning of each silence [s], and the text before it."""

    def write(self, now: float, data: str) -> None:
        """Take what was written at a time [s]."""
        text = ESCAPES.sub("", data).strip()
        if not text or text == self.text:
            return
        self.end(now)
        self.first = now if self.first is None else self.first
        self.last, self.text = now, text

    def end(self, now: float) -> None:
        """End a silence at a time [s]."""
        self.silences.append((now - self.last, self.last, self.text[-80:]))


def watch(command: list[str], folder: Path, environment: dict[str, str]) -> dict:
    """Run a command in a terminal; returns seconds in all, to the first text, and of the longest silence, and its exit code."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
    began, seen = time.perf_counter(), Watch()
    variables = {**os.environ, "TERM": "xterm-256color", "COLUMNS": str(COLUMNS), **environment}
    process = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave, cwd=folder, env=variables)
    os.close(slave)
    while True:
        ready, _, _ = select.select([master], [], [], 0.1)
        if ready:
            try:
                data = os.read(master, 65536)
            except OSError:  # Linux says so where the other side is closed
                break
            if not data:
                break
            seen.write(time.perf_counter() - began, data.decode("utf-8", "replace"))
        elif process.poll() is not None:
            break
    code, now = process.wait(), time.perf_counter() - began
    os.close(master)
    seen.end(now)
    length, at, text = max(seen.silences)
    return {
        "seconds": round(now, 2), "first_text_s": None if seen.first is None else round(seen.first, 2),
        "longest_silence_s": round(length, 2), "after_s": round(at, 2), "after_text": text, "exit_code": code,
    }  # fmt: skip


def commands(photos: Path | None, scene: Path | None) -> dict[str, list[str]]:
    """Return the commands by name, in the order in which they need each other's results."""
    fit = ["fit", "demo", "--split", "every:2", "--preset", "quick", "--out", "run"]
    found = {
        "help": ["--help"],
        "fit help": ["fit", "--help"],
        "doctor": ["doctor"],
        "demo": ["demo", "demo"],
        "fit, empty kernel cache": fit,
        "eval": ["eval", "run"],
        "render": ["render", "run"],
        "export": ["export", "run", "--to", "scene.html"],
        "mesh": ["mesh", "run", "--out", "mesh.ply"],
        "plot": ["plot", "run"],
        "prune": ["prune", "run"],
    }
    if photos is not None:
        found["poses"] = ["poses", str(photos.resolve()), "--out", "posed"]
    if scene is not None:
        found[f"fit {scene.name}"] = ["fit", str(scene.resolve()), "--preset", "quick", "--out", "run-scene"]
    return found


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--only", nargs="+", help="names of commands; rows of the others stay in --out as they are")
    parser.add_argument("--folder", type=Path, help="work here, and keep what is written; a temporary folder where not given")
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    again = commands(a.photos, a.scene).keys() & (a.only or commands(a.photos, a.scene))
    kept = result_file.read(a.out)["rows"] if a.only and a.out is not None and a.out.is_file() else []
    rows = [r for r in kept if r["name"] not in again]
    with tempfile.TemporaryDirectory() as temporary:
        folder = a.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for name, words in commands(a.photos, a.scene).items():
            if name not in again:
                continue
            own = {"WARP_CACHE_PATH": f"{temporary}/kernels"} if "empty" in name else {}
            load = os.getloadavg()[0]
            found = watch([sys.executable, "-P", "-m", "warpgs", *words], folder, own)
            line = [Path(w).name if Path(w).is_absolute() else w for w in words]
            commit = describe(torch.device("cpu"))["commit"]  # of this row: others may stay from an earlier run
            rows.append({"name": name, "arguments": line, "load": round(load, 1), **found, "commit": commit})
            print(
                f"{name}: first text after {found['first_text_s']} s, longest silence {found['longest_silence_s']} s of "
                f"{found['seconds']} s, exit code {found['exit_code']}, after: {found['after_text']}", flush=True
            )  # fmt: skip
            what = "longest silence of a command in a terminal, and the time to its first text; load is that of the machine"
            result_file.write(a.out, result_file.result(what, torch.device("cpu"), rows))


if __name__ == "__main__":
    main()
