"""Fuzzer of all readers: changed files are read in processes of their own, with bounded memory and time.

Run it with `python -m tests.faults.fuzz --inputs 100000`; the same seed gives the same inputs on every machine.
One input again: `python -m tests.faults.fuzz --reader png --first 1234 --inputs 1 --keep folder`.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
import zlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.faults.mutations import damage
from tests.faults.targets import MEMORY, MEMORY_PER_BYTE, Target, all_targets, parser_lines

LIMIT = 20
"""Time that one input may take [s]; the slowest real one takes a hundredth of it."""
ADDRESS_SPACE = 4 * 2**30
"""Address space that a process may take beyond what it has when it begins [bytes]."""
FAILURES_KEPT = 20


@dataclass
class Tally:
    """What became of the inputs of one reader."""

    name: str
    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    unseen: int = 0
    """Accepted with another result than the undamaged file, after plain damage."""
    slowest: float = 0.0
    memory: int = 0
    lines: set[tuple[str, int]] = field(default_factory=set)
    failures: list[str] = field(default_factory=list)
    kinds: Counter[str] = field(default_factory=Counter)

    def fail(self, kind: str, index: int, text: str) -> None:
        self.kinds[kind] += 1
        if len(self.failures) < FAILURES_KEPT:
            self.failures.append(f"{self.name}, input {index}: {kind}: {text}")

    def add(self, other: Tally) -> None:
        self.inputs, self.accepted = self.inputs + other.inputs, self.accepted + other.accepted
        self.refused, self.unseen = self.refused + other.refused, self.unseen + other.unseen
        self.slowest, self.memory = max(self.slowest, other.slowest), max(self.memory, other.memory)
        self.lines |= other.lines
        self.failures = (self.failures + other.failures)[:FAILURES_KEPT]
        self.kinds += other.kinds


class Hang(BaseException):
    """An input takes longer than `LIMIT`."""


def _memory(key: str) -> int:
    """Return a size of this process by its name in Linux [bytes]; 0 on other systems."""
    if sys.platform != "linux":
        return 0
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(key))
    return 1024 * int(line.split()[1])


def _reset_peak() -> None:
    if sys.platform == "linux":
        with contextlib.suppress(OSError):  # then growth beyond the largest before is seen, and no other
            Path("/proc/self/clear_refs").write_text("5")


def _bound_process() -> None:
    """Bound memory and silence decoders, where the system can."""
    with open(os.devnull, "w") as nothing:
        os.dup2(nothing.fileno(), 2)
    if sys.platform == "linux":
        import resource

        import psutil

        limit = psutil.Process().memory_info().vms + ADDRESS_SPACE
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    if hasattr(signal, "setitimer"):

        def late(*_):
            raise Hang

        signal.signal(signal.SIGALRM, late)


def changed(target: Target, data: bytes, rng: np.random.Generator) -> tuple[bytes, bool]:
    """Return the input of a valid file, and whether nothing but plain damage was done to it."""
    if not target.changes or rng.random() < 0.35:
        damaged = damage(data, rng)
        repaired = target.repair is not None and rng.random() < 0.5
        return (target.repair(damaged), False) if repaired else (damaged, True)
    for _ in range(1 + int(rng.integers(3)) // 2):
        data = target.changes[int(rng.integers(len(target.changes)))](data, rng)
    if rng.random() < 0.1:
        data = damage(data, rng)
    return data, False


def _alarm(seconds: float) -> None:
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, seconds)


def _differ(a: object, b: object) -> bool:
    pairs = zip(a, b) if isinstance(a, tuple) else ()
    return any(isinstance(x, np.ndarray) and not np.array_equal(x, y) for x, y in pairs)


class Worker:
    """One reader with its valid files, in a process of its own."""

    def __init__(self, target: Target, seed: int, folder: Path, limit: float = 0):
        """Write the valid files; ``limit`` bounds the time of an input [s] after `_bound_process`, 0 does not."""
        self.target, self.seed, self.folder, self.limit = target, seed, folder, limit
        self.paths = target.prepare(folder)
        self.bytes = {p: p.read_bytes() for p in self.paths}
        self.good = {p: self._read_valid(p) for p in self.paths}
        self.tally = Tally(target.name)
        assert any(g is not None for g in self.good.values()), f"{target.name}: every valid file is refused"

    @classmethod
    def check(cls, target: Target, seed: int) -> None:
        """Prepare once in this process, so that a mistake in a target itself is seen as one."""
        with tempfile.TemporaryDirectory() as folder:
            cls(target, seed, Path(folder))

    def _read_valid(self, path: Path) -> object:
        from warpgs.errors import WarpgsError

        try:
            return self.target.read(self.folder, path)
        except WarpgsError:  # a sample of what is refused
            return None

    def put(self, index: int) -> tuple[Path, bytes, bool]:
        """Write an input in place of a valid file."""
        rng = np.random.default_rng([self.seed, zlib.crc32(self.target.name.encode()), index])
        path = self.paths[int(rng.integers(len(self.paths)))]
        data, plain = changed(self.target, self.bytes[path], rng)
        if rng.random() < 0.01:  # no file at all
            path.unlink()
            if rng.random() < 0.5:
                path.mkdir()
        else:
            path.write_bytes(data)
        return path, data, plain

    def restore(self, path: Path) -> None:
        if path.is_dir():
            shutil.rmtree(path)
        path.write_bytes(self.bytes[path])

    def run(self, index: int) -> None:
        from warpgs.errors import ResourceError, WarpgsError

        tally = self.tally
        try:
            path, data, plain = self.put(index)
        except Exception as e:  # of the fuzzer itself: nothing was read
            tally.fail("no input", index, repr(e))
            return
        _reset_peak()
        before, began = _memory("VmHWM"), time.perf_counter()
        tally.inputs += 1
        try:
            _alarm(self.limit)
            found = self.target.read(self.folder, path)
            _alarm(0)
            tally.accepted += 1
            self._judge(index, path, data, plain, found)
        except ResourceError as e:
            tally.fail("memory", index, str(e))
        except WarpgsError as e:
            tally.refused += 1
            if str(self.folder) not in str(e) or len(str(e)) < len(str(self.folder)) + 20:
                tally.fail("message", index, str(e))
        except Hang:
            tally.fail("hang", index, f"takes more than {LIMIT} s")
        except Exception as e:
            last = traceback.extract_tb(e.__traceback__)[-1]
            tally.fail("raw", index, f"{type(e).__name__}: {str(e)[:200]} ({last.filename}, line {last.lineno})")
        finally:
            _alarm(0)
            tally.slowest = max(tally.slowest, time.perf_counter() - began)
            self.restore(path)
        grown = _memory("VmHWM") - before
        tally.memory = max(tally.memory, grown)
        if grown > MEMORY + MEMORY_PER_BYTE * len(data):
            tally.fail("memory", index, f"takes {grown / 2**20:.0f} MiB for a file of {len(data):,} bytes")

    def _judge(self, index: int, path: Path, data: bytes, plain: bool, found: object) -> None:
        if bad := self.target.nonsense(found):
            self.tally.fail("nonsense", index, bad)
        good = self.good[path]
        if not plain or good is None or not path.is_file():
            return
        self.tally.unseen += _differ(good, found)
        if bad := self.target.unexplained(self.bytes[path], data, good, found):
            self.tally.fail("nonsense", index, bad)


def work(name: str, seed: int, first: int, last: int, current, results) -> None:
    """Read the inputs ``first`` to ``last`` of a reader and send a `Tally` at the end; ``current`` tells which one runs."""
    import coverage

    target = all_targets()[name]
    _bound_process()
    lines = parser_lines(target)
    cover = coverage.Coverage(data_file=None, include=list(lines), config_file=False)
    with tempfile.TemporaryDirectory() as folder:
        cover.start()
        worker = Worker(target, seed, Path(os.path.realpath(folder)), LIMIT)
        for index in range(first, last):
            current.value = index
            worker.run(index)
        cover.stop()
    for file, numbers in lines.items():
        worker.tally.lines |= {(file, n) for n in set(cover.get_data().lines(file) or ()) & numbers}
    results.put(worker.tally)


def fuzz(name: str, inputs: int, seed: int, first: int = 0) -> Tally:
    """Read inputs of one reader in a process, and in another one after each that ends it."""
    context = multiprocessing.get_context("spawn")
    tally, last = Tally(name), first + inputs
    Worker.check(all_targets()[name], seed)
    while first < last:
        current, results = context.Value("q", first), context.Queue()
        process = context.Process(target=work, args=(name, seed, first, last, current, results))
        process.start()
        part, seen, since = None, first, time.monotonic()
        while part is None and process.is_alive() and time.monotonic() - since < 5 * LIMIT:
            try:
                part = results.get(timeout=0.5)
            except Exception:  # nothing yet
                if current.value != seen:
                    seen, since = current.value, time.monotonic()
        if part is None and not process.is_alive():
            try:
                part = results.get(timeout=1)
            except Exception:
                part = None
        if part is not None:
            process.join()
            tally.add(part)
            break
        process.kill()
        process.join()
        # what that process read before is read again, up to the input that ended it
        broken = current.value
        tally.fail("crash", broken, f"the process ended with {process.exitcode}")
        if broken > first:
            tally.add(fuzz(name, broken - first, seed, first))
        first = broken + 1
        if tally.kinds["crash"] > FAILURES_KEPT:
            break
    return tally


def table(tallies: list[Tally]) -> str:
    """Return one row per reader."""
    rows = [f"{'reader':<26}{'inputs':>8}{'accepted':>10}{'refused':>9}{'changed':>9}{'slowest':>10}{'memory':>10}{'lines':>8}"]
    for t in tallies:
        wanted = sum(map(len, parser_lines(all_targets()[t.name]).values()))
        rows.append(
            f"{t.name:<26}{t.inputs:>8}{t.accepted / max(t.inputs, 1):>10.1%}{t.refused / max(t.inputs, 1):>9.1%}"
            f"{t.unseen:>9}{1e3 * t.slowest:>7.0f} ms{t.memory / 2**20:>6.0f} MiB{len(t.lines) / wanted:>8.1%}"
        )
    return "\n".join(rows)


def missed(tally: Tally) -> dict[str, list[int]]:
    """Return the lines of a reader's parser that no input reached, by file name."""
    lines = parser_lines(all_targets()[tally.name])
    found = {Path(f).name: sorted(n for n in numbers if (f, n) not in tally.lines) for f, numbers in lines.items()}
    return {f: numbers for f, numbers in found.items() if numbers}


def main() -> int:
    """Fuzz the named readers, all without a name; print a table and every failure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=10_000, help="over all readers")
    parser.add_argument("--reader", action="append")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="write the first input of the first reader to this folder, and stop")
    a = parser.parse_args()
    names = a.reader or list(all_targets())
    if a.keep:
        a.keep.mkdir(parents=True)
        print(Worker(all_targets()[names[0]], a.seed, a.keep).put(a.first)[0])
        return 0
    tallies = []
    for name in names:
        tallies.append(fuzz(name, -(-a.inputs // len(names)), a.seed, a.first))
        print(
            table(tallies[-1:]).splitlines()[len(tallies) > 1 :][-1],
            *tallies[-1].failures,
            missed(tallies[-1]),
            sep="\n",
            flush=True,
        )
    print(table(tallies))
    return 1 if any(t.failures for t in tallies) else 0


if __name__ == "__main__":
    sys.exit(main())
