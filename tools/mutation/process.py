"""Tests run against mutated copies of the tree, in a forked child for each mutant, which inherits torch and Warp imported."""

import contextlib
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tools.mutation.rules import SKIPPED

COPIED = ("warpgs", "tests", "bench")
PASSED, NO_TESTS, NOT_RUN = 0, 5, (3, 4, 70)
"""Exit status of passed tests, of no tests, and of failures to run: an error in pytest, a missing file, and our own error."""


@dataclass(frozen=True)
class Job:
    """Tests to run on a tree in which one file is another."""

    name: str
    tests: tuple[str, ...]
    cuda: bool
    """True to run the tests marked cuda, False to run the others."""
    file: str | None = None
    """Path of the file that is replaced; None for the tree as it is."""
    source: bytes = b""
    patience: float = 1.0
    """Factor of the time limits."""


@dataclass(frozen=True)
class Outcome:
    """Result of a job."""

    name: str
    status: str
    """``killed``, ``survived``, ``timeout`` (counts as killed), ``untested``: no test is meant for that device, or ``broken``:
    the tests could not be run at all."""
    seconds: float
    output: str
    """The end of pytest's output."""


def copy_tree(root: Path, to: Path) -> None:
    """Make hard links to all files that tests read; to change a file, unlink it first."""
    ignored = shutil.ignore_patterns("__pycache__", "*.pyc")
    for name in COPIED:
        if (root / name).is_dir():
            shutil.copytree(root / name, to / name, ignore=ignored, copy_function=_link)
    for path in root.glob("*.toml"):
        _link(path, to / path.name)


def _link(source, target) -> None:
    try:
        os.link(source, target)
    except OSError:  # another file system
        shutil.copyfile(source, target)


def preload() -> None:
    """Import, once for all children, modules that are slow to import and hold no state of ours or of a device."""
    for name in ("numpy", "torch", "torch.autograd.gradcheck", "warp", "pytest", "scipy.stats", "hypothesis"):
        with contextlib.suppress(ImportError):
            __import__(name)


class _Clock:
    """A pytest plugin that counts tests, and ends the process if a single test takes too long, even in an endless loop."""

    def __init__(self, seconds: float):
        self.seconds, self.run = seconds, 0

    def pytest_runtest_logreport(self, report):
        self.run += report.when == "call" and not report.skipped

    def pytest_runtest_logstart(self, nodeid, location):
        signal.setitimer(signal.ITIMER_REAL, self.seconds)


def _child(job: Job, tree: Path, root: Path, cache: Path, test_timeout: float) -> int:
    """Do the work of a forked child, and return pytest's exit status."""
    import pytest
    import torch

    copy_tree(root, tree)
    if job.file is not None:
        path = tree / job.file
        path.unlink()
        path.write_bytes(job.source)
    for name in [n for n in sys.modules if n.split(".")[0] in ("tests", "warpgs", "bench")]:
        del sys.modules[name]
    os.chdir(tree)
    sys.path[:] = [str(tree), *(p for p in sys.path if Path(p or ".").resolve() != root)]
    sys.dont_write_bytecode = True
    search = os.pathsep.join(filter(None, sys.path))  # processes that tests start find what this one finds
    os.environ |= {"WARP_CACHE_PATH": str(cache), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTHONPATH": search}
    torch.set_num_threads(1)  # some tests set their own number
    clock = _Clock(test_timeout)
    mark = f"not slow and {'cuda' if job.cuda else 'not cuda'}"
    # the project's own options ask for plugins and warnings that a mutant need not load
    options = [*(f"--deselect={test}" for test in SKIPPED), "-x", "-q", "--tb=line", "-p", "no:cacheprovider", "-m", mark]
    status = int(pytest.main([*job.tests, *options], plugins=[clock])) if job.tests else NO_TESTS
    return NO_TESTS if status == PASSED and not clock.run else status  # all of them were skipped


def _start(job: Job, folder: Path, root: Path, cache: Path, test_timeout: float) -> int:
    tree = folder / "tree"
    tree.mkdir(parents=True)
    if pid := os.fork():
        return pid
    status = 70
    try:
        os.setsid()  # so that a timeout ends what the tests started, too
        out = os.open(folder / "output", os.O_WRONLY | os.O_CREAT)
        os.dup2(out, 1)
        os.dup2(out, 2)
        status = _child(job, tree, root, cache, test_timeout)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _outcome(job: Job, status: int, timed_out: bool, seconds: float, output: str) -> Outcome:
    """Classify the end of a job: a failed test, a crash or a timeout means that the mutant was noticed."""
    code = os.waitstatus_to_exitcode(status)
    if timed_out or code == -signal.SIGALRM:
        word = "timeout"
    elif code == PASSED:
        word = "survived"
    elif code == NO_TESTS:
        word = "untested"
    elif code in NOT_RUN:
        word = "broken"
    else:
        word = "killed"  # 1: a test failed; 2: a module does not import; below 0: a signal
    return Outcome(job.name, word, round(seconds, 1), output)


def run_jobs(
    jobs: Iterable[Job], root: Path, cache: Path, *, workers: int, timeout: float, test_timeout: float = 600
) -> Iterator[Outcome]:
    """Run jobs, ``workers`` at a time, and yield each outcome as it comes.

    Args:
        jobs: Jobs to run.
        root: The tree to copy.
        cache: Warp's folder of compiled kernels. Processes can share it: its keys depend on the code, and writes are atomic.
        workers: Processes at a time.
        timeout: Time limit of a job [s].
        test_timeout: Time limit of a single test of a job [s].
    """
    waiting, running = iter(jobs), {}
    with tempfile.TemporaryDirectory(prefix="mutants-") as scratch:
        try:
            count = 0
            while True:
                while len(running) < workers and (job := next(waiting, None)) is not None:
                    folder = Path(scratch) / str(count)
                    count += 1
                    pid = _start(job, folder, root, cache, test_timeout * job.patience)
                    running[pid] = (job, folder, time.monotonic(), set())
                if not running:
                    return
                time.sleep(0.02)
                for pid, (job, folder, since, killed) in list(running.items()):
                    ended, status = os.waitpid(pid, os.WNOHANG)
                    seconds = time.monotonic() - since
                    if ended:
                        del running[pid]
                        lines = (folder / "output").read_text(errors="replace").strip().splitlines()
                        yield _outcome(job, status, bool(killed), seconds, "\n".join(lines[-6:]))
                        shutil.rmtree(folder, ignore_errors=True)
                    elif seconds > timeout * job.patience and not killed:
                        with contextlib.suppress(ProcessLookupError):  # it has no group of its own yet, and is asked again
                            os.killpg(pid, signal.SIGKILL)
                            killed.add(pid)
        finally:
            for pid in running:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
