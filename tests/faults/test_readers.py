"""Readers of foreign files under the fuzzer: all are there, all understand or refuse, within bounds of time and memory."""

import ast
import contextlib
import functools
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import warpgs
from tests.faults import bounds
from tests.faults.bounds import size_of
from tests.faults.fuzz import JUDGED, Tally, Worker, fuzz, missed, shallow, shares, table
from tests.faults.targets import Target, all_targets, codes_of, parser_lines
from warpgs.errors import DataError
from warpgs.pipeline.metrics import lpips

INPUTS = int(os.environ.get("FUZZ", "2000"))
FEW, ENOUGH = 10_000, 50_000
"""Numbers of inputs from which on the share past the first check is judged, and the lines reached."""
SEED = int(os.environ.get("FUZZ_SEED", "29100"))
NAMES = sorted(all_targets())


@pytest.mark.fault
@pytest.mark.parametrize("name", NAMES)
def test_many_damaged_files(name, capfd):
    tally = fuzz(name, shares(NAMES, INPUTS)[name], seed=SEED)
    with capfd.disabled():
        print(f"\n{table([tally])}")
    assert not tally.failures
    assert INPUTS < FEW or not shallow(tally)
    if INPUTS >= ENOUGH:
        wanted = all_targets()[name].lines * sum(map(len, parser_lines(all_targets()[name]).values()))
        assert len(tally.lines) >= wanted, missed(tally)


@pytest.mark.parametrize("name", ["png", "model file", "run record"])
def test_the_same_seed_gives_the_same_inputs(name, tmp_path):
    written = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        worker = Worker(all_targets()[name], seed=3, folder=folder)
        written.append([worker.put(i)[1] for i in range(9)])
    assert written[0] == written[1] and len(set(written[0])) > 5


# Every function of warpgs that opens input is read by the fuzzer, or a reason stands here why it is not.

PACKAGE = Path(warpgs.__file__).parent
OPENING = {
    "open", "open_input", "read_bytes", "read_file", "read_input", "read_start", "read_text", "read_tensors", "input_digest",
    "fromfile", "imdecode", "imread", "safe_open", "HeifImageFile", "InferenceSession", "VideoCapture",
    "ZipFile", "fdopen", "memmap", "loadtxt", "genfromtxt", "load_file", "open_memmap",
}  # fmt: skip
"""Names of functions and classes that open a file or decode what one holds."""
PARSING = {
    "ElementTree.fromstring",
    "json.load",
    "json.loads",
    "np.load",
    "schema.parse",
    "schema.read",
    "torch.load",
    "msgspec.msgpack.decode",
}
"""The same with their modules."""

UNLISTED = (
    ("export/base.py", "reading", "splat"), ("export/sog.py", "_members", "SOG"), ("export/sog.py", "_meta", "SOG"),
    ("io/image_files.py", "read_image_file", "any image"), ("poses/photographs.py", "_check_container", "video"),
    ("pipeline/metrics/lpips.py", "_check_unpacked", "LPIPS state dict"),
)  # fmt: skip
"""Functions that a reader of the fuzzer calls, but does not name as its parser: file, function, reader."""

OWN = "reads what this process wrote just before"
PIPE = "reads lines of a process that warpgs started, by a pipe that nobody else writes to"
PRIVATE = "reads a file of the farm's private folder, which nobody else may enter"
DIGEST = "reads bytes that it does not look into"
SYSTEM = "reads what the system says"
LAYER = "opens for others, which are named here"
REASONS = {
    "export/sog.py": {"encode": "writes", "SOG.store": OWN},
    "files.py": {"appending": "writes", "read_file": LAYER, "read_tensors": LAYER, "tensors_of": LAYER,
        "open_input": LAYER, "read_input": LAYER, "read_start": LAYER, "input_digest": LAYER},
    "folders.py": {"Folder.__init__": LAYER, "Folder.open": LAYER, "Folder.open_regular": LAYER,
        "_locked": "writes", "temporary_file": "writes"},
    "locks.py": {"_held": "writes"},
    "pipeline/farm/work.py": {"_with_lpips": OWN, "fit_job": DIGEST},
    "pipeline/farm/slurm.py": {"main": PRIVATE,
        "SlurmEngine._ended": PRIVATE},
    "pipeline/farm/job.py": {"job_of": PIPE,
        "is_whole": DIGEST},
    "pipeline/farm/farm.py": {"LocalEngine._serve": PIPE},
    "pipeline/farm/worker.py": {"main": PIPE},
    "pipeline/metrics/coverage.py": {"coverage_section": OWN},
    "pipeline/run/level.py": {"store": "reads config.json again, which `read_record` has checked"},
    "pipeline/run/results.py": {"sampling_report_of": "reads images for `webp`, which is named here"},
    "pipeline/study/study.py": {"_same_files": DIGEST},
    "plugins.py": {"module_digest": DIGEST},
    "poses/find.py": {"find_poses": OWN, "source_digest": DIGEST, "_distinct": DIGEST},
    "poses/photographs.py": {"main": PIPE},
    "poses/mapping.py": {"_lines": PIPE,
        "main": PIPE, "match": OWN, "extract": OWN, "import_photographs": OWN, "matched": OWN, "verify_learned": OWN},
    "priors/export.py": {"_own_weights": "reads weights of 45 MB with safetensors, as the readers named here do",
        "package_files": "reads files whose SHA-256 must be known", "_backbone": "loads weights whose SHA-256 is known",
        "onnx_bytes": OWN},
    "report/film.py": {"_encode_vp9": OWN, "_decoded_sizes": OWN},
    "report/images.py": {"webp": OWN},
    "kernels/native.py": {"source": "reads a file of the package",
        "exclusive": "opens a lock"},
    "clock.py": {"_age": SYSTEM},
    "device.py": {"_text": SYSTEM},
    "process.py": {"hidden_stderr": "opens /dev/null for writing",
        "_send_to_null": "opens /dev/null for writing"},
    "ranks.py": {"machine": SYSTEM},
    "viewer/html.py": {"write_html": "reads a file of the package"},
    "viewer/window.py": {"Panel._add_sampling": "reads an image for `decode`, whose reader is named here"},
}  # fmt: skip
"""Why a function that opens something is not read by the fuzzer, by file and function."""


def opening(node: ast.AST, where: str = "", inside: bool = False) -> Iterator[str]:
    """Yield the name of each function below a node that opens or parses input; of functions in each other the outermost."""
    for child in ast.iter_child_nodes(node):
        function = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef))
        if (function or isinstance(child, ast.ClassDef)) and not inside:
            yield from opening(child, f"{where}.{child.name}".lstrip("."), function)
            continue
        if isinstance(child, ast.Call):
            called = ast.unparse(child.func)
            if called in PARSING or called.rpartition(".")[2] in OPENING:
                yield where
        yield from opening(child, where, inside)


@functools.cache
def openings() -> set[tuple[str, str]]:
    """Return the file and name of each function of the package that opens or parses input."""
    files = {p.relative_to(PACKAGE).as_posix(): ast.parse(p.read_text("utf-8")) for p in PACKAGE.rglob("*.py")}
    return {(f, function) for f, tree in files.items() for function in opening(tree)}


def parsing(name: str) -> set[tuple[str, str]]:
    """Return the functions among `openings` that a reader of the fuzzer stands for."""
    codes = (code for part in all_targets()[name].parser for code in codes_of(part))
    found = {(code.co_filename.removeprefix(f"{PACKAGE.as_posix()}/"), code.co_qualname) for code in codes}
    return openings() & found | {(file, function) for file, function, reader in UNLISTED if reader == name}


def test_every_reader_is_fuzzed_or_has_a_reason():
    """Else add a reader to a module of tests/faults, or its reason here; a name left over would hide the next such function."""
    assert openings() - set().union(*map(parsing, NAMES)) == {(f, n) for f, names in REASONS.items() for n in names}
    assert {(f, n) for f, n, _ in UNLISTED} <= openings()


@contextlib.contextmanager
def noted_calls() -> Iterator[set[tuple[str, str]]]:
    """Note the file and name of each function that is called; images load in threads."""
    called = set()

    def note(frame, event, argument):
        if event == "call":
            called.add((frame.f_code.co_filename, frame.f_code.co_qualname))

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        yield called
    finally:
        sys.setprofile(None)
        threading.setprofile(None)


@pytest.mark.parametrize("name", NAMES)
def test_a_few_damaged_files(name, tmp_path, monkeypatch):
    """And the valid files of a reader go through the functions that it stands for."""
    monkeypatch.setattr(lpips, "NETS", dict(lpips.NETS))  # the reader of weights is given a small network
    with noted_calls() as called:
        worker = Worker(all_targets()[name], seed=1, folder=tmp_path)
    assert {(str(PACKAGE / f), n) for f, n in parsing(name)} <= called
    count = max(1, round(12 * all_targets()[name].share))
    for index in range(count):
        worker.run(index)
    assert not worker.tally.failures
    assert worker.tally.accepted + worker.tally.refused == worker.tally.inputs == count


# What the fuzzer calls a defect is one, what it bounds is bounded, and it knows what gets past a check.

LARGE = 100 * 2**20


def read(folder, path):
    """Read a file whose words say what to do."""
    data = path.read_bytes() if path.is_file() else b""
    if not data.startswith(b"ok"):
        raise DataError(f"{path}: does not begin as these files do; write it again")
    if data == b"ok raw":
        raise KeyError("raw")
    if data == b"ok allocate":
        np.ones(LARGE, np.uint8)
    if data == b"ok return":
        return np.ones(LARGE, np.uint8)
    while data == b"ok loop":
        pass
    return data


def ran(folder, data: bytes, plain: bool = False, measured: bool = True) -> Tally:
    """Return the outcome of one input, without the limits that only a process of its own can have."""

    def prepare(root):
        (root / "a").write_bytes(b"ok")
        return [root / "a"]

    def ends_with(word):
        return lambda *found: word if isinstance(found[-1], bytes) and found[-1].endswith(word.encode()) else ""

    judges = {word: ends_with(word) for word in ("nonsense", "unexplained")}
    target = Target("planted", prepare, read, (read,), **judges)
    made = Worker(target, 0, folder, measured=measured)
    made.put = lambda index: ((folder / "a").write_bytes(data), (folder / "a", data, plain))[1]
    made.run(0)
    return made.tally


@pytest.mark.parametrize("kind", ["raw", "nonsense", "unexplained", None])
def test_defects_are_noticed(kind, tmp_path):
    wanted = [{"unexplained": "nonsense"}.get(kind, kind)] if kind else []
    assert list(ran(tmp_path, f"ok {kind}".encode(), plain=True, measured=False).kinds) == wanted


@pytest.mark.skipif(sys.platform != "linux", reason="memory is measured on Linux alone")
@pytest.mark.parametrize("data, kinds", [(b"ok allocate", ["memory"]), (b"ok return", []), (b"ok", [])])
def test_memory_beyond_the_result_is_noticed(data, kinds, tmp_path):
    assert list(ran(tmp_path, data).kinds) == kinds
    array = np.zeros(1000, np.float32)
    assert 4000 <= size_of({"a": array, "b": (array, b"x" * 100)}) < 5000  # the same array counts once


@pytest.mark.skipif(not hasattr(bounds.signal, "setitimer"), reason="Windows has no timers")
def test_an_endless_loop_is_a_hang(tmp_path, monkeypatch):
    """By the processor's time, so that the load of the machine is nothing to it."""
    monkeypatch.setattr(bounds, "LIMIT", 0.05)
    before = [bounds.signal.getsignal(s) for s in (bounds.signal.SIGPROF, bounds.signal.SIGALRM)]
    bounds.catch_timers()
    try:
        assert list(ran(tmp_path, b"ok loop").kinds) == ["hang"]
    finally:
        for s, handler in zip((bounds.signal.SIGPROF, bounds.signal.SIGALRM), before):
            bounds.signal.signal(s, handler)
    times = iter((0.0, 1.0))  # of slow code that swallows the exception
    monkeypatch.setattr(bounds, "spent", lambda: next(times))
    assert list(ran(tmp_path, b"ok").kinds) == ["hang"]


def test_the_first_check_is_told_from_later_ones_and_every_reader_gets_inputs(tmp_path):
    for data, past in ((b"", 0), (b"xx", 0), (b"ok", 1), (b"ok more", 1)):
        tally = ran(tmp_path, data)
        assert tally.past == past and not tally.failures
    assert shallow(Tally("a", inputs=100, past=9)) and not shallow(Tally("a", inputs=100, past=10))
    assert not shallow(Tally("a", inputs=JUDGED - 1)) and shallow(Tally("a", inputs=JUDGED))
    counts = shares(list(all_targets()), 200_000)
    assert sum(counts.values()) >= 200_000 and min(counts.values()) >= JUDGED
