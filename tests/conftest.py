"""Fixtures that every op's tests share: the devices there are, and both scalar types."""

import gc
import os
import re
import sys
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_NUM_THREADS"] = "1"  # workers share the cores; tests that are about threads set their number
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as warpgs does where it is imported before torch

import pytest
import torch
from hypothesis import settings

# Examples of a property: few where every change waits for them, more with `--hypothesis-profile many` (make test-slow).
settings.register_profile("few", max_examples=4)
settings.register_profile("many", max_examples=40)
settings.load_profile("few")

MISSING = re.compile(r"could not import '|not installed: ")
"""Reasons of skipped tests that miss a package; those of the extra `export`, which is in no lock, may be skipped."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport():
    """Let a test fail that is skipped because an extra is missing, where the Makefile says that all are installed."""
    return without_missing_extras((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report():
    """Do the same for a file of tests."""
    return without_missing_extras((yield))


def without_missing_extras(report):
    """Return a report, failed where its test was skipped for a missing extra."""
    reason = str(report.longrepr)
    if report.skipped and os.environ.get("WARPGS_EXTRAS_INSTALLED") and MISSING.search(reason) and "[export]" not in reason:
        report.outcome, report.longrepr = "failed", f"an extra is missing: {reason}"
    return report


DEVICES = [pytest.param("cpu")]
if torch.cuda.is_available():
    DEVICES.append(pytest.param("cuda:0", marks=pytest.mark.cuda))


def pytest_collection_modifyitems(items):
    """A test marked cuda is shown as skipped, not lost, where there is no such device."""
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("cuda"):
                item.add_marker(pytest.mark.skip(reason="no CUDA device"))


def pytest_collection_finish():
    """Leave modules and collected tests out of garbage collections, most of whose time they would take."""
    gc.collect()
    gc.freeze()


@pytest.fixture(params=DEVICES)
def device(request) -> torch.device:
    return torch.device(request.param)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request) -> torch.dtype:
    return request.param


@pytest.fixture
def browser(tmp_path, request):
    """Return a headless Chromium, with the ``GRAPHICS`` of the test's module if it has some; skips where none is installed."""
    from tests.viewer.chromium import Chromium

    opened = Chromium(tmp_path, *getattr(request.module, "GRAPHICS", ()))
    yield opened
    opened.close()


@pytest.fixture(scope="session")
def demo(tmp_path_factory):
    """Folder of a scene of eight photographs of 48 x 36 px, which no test changes."""
    from warpgs.synthetic.demo import write_demo

    folder = tmp_path_factory.mktemp("demo") / "still"
    write_demo(folder, views=8, width=48, height=36)
    return folder


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """Folder of a scene of nine photographs of 64 x 48 px, which no test changes."""
    from warpgs.synthetic.demo import write_demo

    folder = tmp_path_factory.mktemp("nine") / "scene"
    write_demo(folder, views=9, width=64, height=48)
    return folder


@pytest.fixture
def heeding() -> list[str]:
    """Beginning of a command that heeds Ctrl-C, also in tests in the background, where a shell has it ignored."""
    code = "import signal, sys; signal.signal(2, signal.default_int_handler); from warpgs.app.cli import main; sys.exit(main())"
    return [sys.executable, "-c", code]


@pytest.fixture
def own_file(tmp_path):
    """Write a user's Python file below the test's folder; its modules are forgotten afterwards."""
    yield lambda name, text: (tmp_path / name).write_text(text) and tmp_path / name
    for name in [n for n, m in sys.modules.items() if Path(getattr(m, "__file__", None) or "/").parent == tmp_path]:
        del sys.modules[name]


@pytest.fixture(autouse=True, scope="session")
def compiling_is_announced():
    """Once in a process, after two seconds, a line tells of it: now, or what a test reads would depend on the machine."""
    from warpgs.kernels import native

    native._say_compiling()


@pytest.fixture(autouse=True, scope="session")
def no_overview_in_reports():
    """Leave the 3D overview out of reports, for speed; tests/report/test_overview.py looks at it."""
    patch = pytest.MonkeyPatch()
    patch.setattr("warpgs.pipeline.run.results.render_overview", lambda *_: None)
    yield
    patch.undo()


@pytest.fixture
def registries_as_they_were(monkeypatch):
    """Forget what a test registers, and the files that it loads, which would not register again."""
    from warpgs.pipeline.train.loss import LOSS_TERMS
    from warpgs.pipeline.train.strategies.base import STRATEGIES
    from warpgs.pipeline.train.view_modules import VIEW_MODULES

    for registry in (STRATEGIES, LOSS_TERMS, VIEW_MODULES):
        registry.names()
        monkeypatch.setattr(registry, "_classes", dict(registry._classes))
    before = set(sys.modules)
    yield
    for name in {n for n in sys.modules if n.startswith("_warpgs_")} - before:
        del sys.modules[name]


@pytest.fixture(autouse=True)
def keep_thread_count():
    """Put torch's number of threads back after a test that changes it."""
    count = torch.get_num_threads()
    yield
    torch.set_num_threads(count)
