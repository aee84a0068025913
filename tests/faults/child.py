"""A process that runs commands of ours and kills itself before a call of a given number.

Arguments: the folder whose calls are numbered; the number of the call, 0 for none; the file for the calls; then the words of
the commands, those of one command after those of another with a ``+`` between. Each command numbers its calls anew, and
only the last one is killed. ``keep A B`` copies a folder, ``worker`` is a farm whose jobs run in the process of the farm.

With ``serve`` alone it reads such arguments as lines of JSON, ``{"words": [...], "tmp": FOLDER, "said": FILE}``, and forks for
each: what takes long to import is there already. It answers with the exit code once all that it started has ended.
"""

import contextlib
import ctypes
import hashlib
import importlib
import itertools
import json
import os
import shutil
import sys
import tempfile
from pathlib import Path
from unittest import mock

import numpy as np
import warp

from tests.faults.calls import Call, numbered
from warpgs.app.cli import OWN_FILES, main
from warpgs.pipeline.farm.job import Event
from warpgs.pipeline.farm.work import run_job
from warpgs.pipeline.run import commands as plot, results
from warpgs.pipeline.study import study
from warpgs.poses import mapping

SUBREAPER = 36
"""Number of Linux's prctl that gives a process the orphans of its children."""


class OneProcess:
    """Engine of a farm that runs its jobs in the farm's own process."""

    name, slots = "one process", 1

    def __init__(self, *_: object):
        self.jobs: list = []

    def start(self, job) -> None:
        self.jobs.append(job)

    def wait(self, seconds: float) -> list[Event]:
        job = self.jobs.pop(0)
        return [(job.name, run_job(job.text()), "")]

    def close(self) -> None:
        """Do nothing."""


def plain_overview(*_, size: tuple[int, int], **others) -> np.ndarray:
    """Stand in for the picture of a plot, which takes seconds."""
    return np.zeros((*size[::-1], 3), np.float32)


@contextlib.contextmanager
def saving_viewer():
    """Have `warpgs view` save a crop box and a path once it shows something, and end."""
    from warpgs.viewer import watch
    from warpgs.viewer.window import CROP, PATH, box_json, keyframe

    windows: list = []

    def window(*given):
        windows.append(watch_window(*given))
        return windows[-1]

    def pause() -> None:
        (shown,) = windows
        panel, model = shown.panel, shown.content.model
        panel._crop.value = True
        panel._save(CROP, box_json(panel.crop_box(), model.normalization))
        panel._save(PATH, [keyframe(model.scene_cameras[n], float(i), model.normalization) for i, n in enumerate(model.train)])
        raise KeyboardInterrupt

    watch_window = watch.Window
    with mock.patch.object(watch, "Window", window), mock.patch.object(watch, "_pause", pause):
        yield


def run_one(words: list[str]) -> int:
    if words[0] == "worker":
        with mock.patch("warpgs.pipeline.farm.farm.LocalEngine", OneProcess):
            return main(["farm", *words[1:]])
    with saving_viewer() if words[0] == "view" else contextlib.nullcontext():
        return main(words)


def run(root: Path, at: int, trace: Path, commands: list[list[str]]) -> int:
    results.render_overview, plot.render_overview = lambda *_: None, plain_overview
    study.ABLATION_ROWS = {name: study.ABLATION_ROWS[name] for name in ("full", "no events")}
    with trace.open("wb", buffering=0) as log:
        for words in commands:
            if words[0] == "keep":
                shutil.copytree(*words[1:])
                continue
            log.write(f"command {words[0]}\n".encode())
            last = words is commands[-1]

            def before(call: Call, last: bool = last) -> None:
                digest = ""
                if call.source is not None and call.source.is_file():
                    digest = hashlib.sha256(call.source.read_bytes()).hexdigest()
                log.write(f"{call.kind}\t{os.path.relpath(call.path, root)}\t{digest}\n".encode())
                if last and call.number == at:
                    if call.half is not None:
                        call.half()
                    os.kill(os.getpid(), 9)  # SIGKILL; on Windows the end of the process

            with numbered(root, before, mapping):
                code = run_one(words)
            if code:
                return code
    return 0


def run_words(words: list[str]) -> int:
    groups = [list(g) for plus, g in itertools.groupby(words[3:], lambda w: w == "+") if not plus]
    return run(Path(os.path.realpath(words[0])), int(words[1]), Path(words[2]), groups)


def serve() -> None:
    """Fork for each line of stdin, and answer with exit codes."""
    import warpgs.viewer.watch  # noqa: F401  (and all that commands import late)
    from warpgs.pipeline.run import commands, export  # noqa: F401

    for name in ("commands", *OWN_FILES):
        importlib.import_module(f"warpgs.app.{name}")
    warp.config.use_precompiled_headers = False  # kernels that are not in the cache would leave them in the folder
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(SUBREAPER, 1, 0, 0, 0)
    for line in sys.stdin:
        job = json.loads(line)
        child = os.fork()
        if not child:
            said = os.open(job["said"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for number in (1, 2):
                os.dup2(said, number)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            os.environ["TMPDIR"], tempfile.tempdir = job["tmp"], None
            code = 70
            try:
                code = run_words(job["words"])
            except BaseException as e:
                print(repr(e), file=sys.stderr)
            finally:
                for stream in (sys.stdout, sys.stderr):
                    stream.flush()
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        with contextlib.suppress(ChildProcessError):  # and orphans, such as workers of a farm
            while True:
                os.waitpid(-1, 0)
        print(code, flush=True)


if __name__ == "__main__":
    if sys.argv[1:] == ["serve"]:
        serve()
    else:
        sys.exit(run_words(sys.argv[1:]))
