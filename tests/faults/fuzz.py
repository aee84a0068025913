"""Fuzzer of all readers: changed files are read in processes of their own, with bounded memory and time.

`FUZZ=200000 FUZZ_SEED=5 make test-fault` reads as many inputs; a seed gives the same inputs everywhere. To see one input again,
`python -m tests.faults.fuzz png 5 1234 FOLDER` writes that of reader, seed and number into a new folder.
"""

from __future__ import annotations

import functools
import multiprocessing
import os
import queue
import shutil
import sys
import tempfile
import time
import traceback
import zlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.faults import bounds
from tests.faults.mutations import damage
from tests.faults.targets import MODULES, Target, all_targets, parser_lines

FAILURES_KEPT = 20
PAST = 0.1
"""Smallest share of inputs that must get past the first check of a reader."""
JUDGED = 30
"""Number of inputs from which on that share is judged; slow readers get fewer in a short run."""
ATTEMPTS = 8
"""Number of changes that are tried until one changes the file."""


@dataclass
class Tally:
    """Outcomes of the inputs of one reader."""

    name: str
    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    past: int = 0
    """Inputs that were accepted, or reached a line that no file of random bytes reaches."""
    slowest: float = 0.0
    """Processor time [s]."""
    memory: int = 0
    """Peak beyond the result [bytes]."""
    lines: set[bounds.Line] = field(default_factory=set)
    failures: list[str] = field(default_factory=list)
    kinds: Counter[str] = field(default_factory=Counter)

    def fail(self, kind: str, index: int, text: str) -> None:
        self.kinds[kind] += 1
        if len(self.failures) < FAILURES_KEPT:
            self.failures.append(f"{self.name}, input {index}: {kind}: {text}")

    def add(self, other: Tally) -> None:
        self.inputs, self.accepted = self.inputs + other.inputs, self.accepted + other.accepted
        self.refused, self.past = self.refused + other.refused, self.past + other.past
        self.slowest, self.memory = max(self.slowest, other.slowest), max(self.memory, other.memory)
        self.lines |= other.lines
        self.failures = (self.failures + other.failures)[:FAILURES_KEPT]
        self.kinds += other.kinds


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


class Worker:
    """One reader with its valid files."""

    def __init__(self, target: Target, seed: int, folder: Path, measured: bool = False):
        self.target, self.seed, self.folder, self.measured = target, seed, folder, measured
        self.tally = Tally(target.name)
        self.reached = bounds.Reached(parser_lines(target) if measured else {})
        self.paths = target.prepare(folder)
        self.bytes = {p: p.read_bytes() for p in self.paths}
        self.good = {p: self._try(p) for p in self.paths}
        assert any(g is not None for g in self.good.values()), f"{target.name}: every valid file is refused"
        self.first = {p: self._first_checks(p) for p in self.paths} if measured else {}

    def _try(self, path: Path) -> object:
        """Return what is read of a file; None where it is refused."""
        from warpgs.errors import WarpgsError

        try:
            return self._read(path)
        except WarpgsError:
            return None

    def _read(self, path: Path) -> object:
        if not self.measured:
            return self.target.read(self.folder, path)
        try:
            with self.reached:
                return self.target.read(self.folder, path)
        finally:
            self.tally.lines |= self.reached.lines()

    def _first_checks(self, path: Path) -> set[bounds.Line]:
        """Return the lines that run where files without a meaning, in place of a valid one, are refused."""
        lines = set()
        for data in [*bounds.garbage(), None]:
            path.unlink()
            if data is not None:
                path.write_bytes(data)
            if self._try(path) is None:  # an empty file means something in some formats
                lines |= self.reached.lines()
            self.restore(path)
        return lines

    def put(self, index: int) -> tuple[Path, bytes, bool]:
        """Write an input in place of a valid file."""
        rng = np.random.default_rng([self.seed, zlib.crc32(self.target.name.encode()), index])
        path = self.paths[int(rng.integers(len(self.paths)))]
        for _ in range(ATTEMPTS):
            data, plain = changed(self.target, self.bytes[path], rng)
            if data != self.bytes[path]:
                break
        if rng.random() < 0.01:  # no file at all
            path.unlink()
            if rng.random() < 0.5:
                path.mkdir()
        else:
            path.write_bytes(data)
        return path, data, plain

    def restore(self, path: Path) -> None:
        """Write the valid file back, where the input or its reader changed or removed it."""
        if path.is_dir():
            shutil.rmtree(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(self.bytes[path])

    def run(self, index: int) -> None:
        tally = self.tally
        try:
            path, data, plain = self.put(index)
        except Exception as e:  # of the fuzzer itself: nothing was read
            tally.fail("no input", index, repr(e))
            return
        peak, began = bounds.PeakMemory(), bounds.spent()
        tally.inputs += 1
        try:
            found = self._outcome(index, path, data, plain)
            grown, seconds = peak.grown(), bounds.spent() - began
            grown -= bounds.size_of(found) if grown > bounds.MEMORY else 0
        finally:
            self.restore(path)
        tally.slowest, tally.memory = max(tally.slowest, seconds), max(tally.memory, grown)
        if seconds > bounds.LIMIT:  # where a library swallows the exception, or the system has no timer
            tally.fail("hang", index, f"takes {seconds:.1f} s of processor time")
        if grown > bounds.MEMORY:
            tally.fail("memory", index, f"takes {grown / 2**20:.0f} MiB beyond its result, for a file of {len(data):,} bytes")

    def _outcome(self, index: int, path: Path, data: bytes, plain: bool) -> object:
        """Read an input and count what becomes of it; return what was read."""
        from warpgs.errors import ResourceError, WarpgsError

        tally, found = self.tally, None
        try:
            with bounds.time_limit(self.measured):
                found = self._read(path)
            if found is None:  # the file is passed over, as one that is not there
                tally.refused += 1
            else:
                tally.accepted += 1
                self._judge(index, path, data, plain, found)
        except ResourceError as e:
            tally.fail("memory", index, str(e))
        except WarpgsError as e:
            tally.refused += 1
            if str(self.folder) not in str(e) or len(str(e)) < len(str(self.folder)) + 20:
                tally.fail("message", index, str(e))
        except bounds.Hang:
            tally.fail(
                "hang", index, f"takes more than {bounds.LIMIT:.0f} s of processor time, or {bounds.WALL:.0f} s of wall time"
            )
        except Exception as e:
            last = traceback.extract_tb(e.__traceback__)[-1]
            tally.fail("raw", index, f"{type(e).__name__}: {str(e)[:200]} ({last.filename}, line {last.lineno})")
        if self.measured:
            tally.past += found is not None or bool(self.reached.lines() - self.first[path])
        return found

    def _judge(self, index: int, path: Path, data: bytes, plain: bool, found: object) -> None:
        if bad := self.target.nonsense(found):
            self.tally.fail("nonsense", index, bad)
        good = self.good[path]
        if plain and good is not None and path.is_file():
            if bad := self.target.unexplained(self.bytes[path], data, good, found):
                self.tally.fail("nonsense", index, bad)


def work(name: str, seed: int, first: int, last: int, current, results) -> None:
    """Read the inputs ``first`` to ``last`` of a reader and send a `Tally` at the end; ``current`` tells which one runs."""
    target, broken = all_targets()[name], Tally(name)
    bounds.bound_process()
    with tempfile.TemporaryDirectory() as folder:
        try:
            worker = Worker(target, seed, Path(os.path.realpath(folder)), measured=True)
        except Exception:  # a mistake in the target itself
            broken.fail("no target", first, traceback.format_exc())
            results.put(broken)
            return
        for index in range(first, last):
            current.value = index
            worker.run(index)
    results.put(worker.tally)


@functools.cache
def _context() -> multiprocessing.context.BaseContext:
    """Return how processes start: on Linux from one that has imported all readers, in the environment of `ALLOCATOR`."""
    os.environ.update(bounds.ALLOCATOR)
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([f"tests.faults.{name}" for name in MODULES])
    return context


def _outcome_of(process, current, results) -> Tally | None:
    """Wait for the tally of a process; None where it ends without one, or stands still."""
    seen, since = current.value, time.monotonic()
    while process.is_alive() and time.monotonic() - since < 3 * bounds.WALL:
        try:
            return results.get(timeout=0.5)
        except queue.Empty:
            if current.value != seen:
                seen, since = current.value, time.monotonic()
    try:
        return results.get(timeout=1)
    except queue.Empty:
        return None


def fuzz(name: str, inputs: int, seed: int, first: int = 0) -> Tally:
    """Read inputs of one reader in a process, and in another one after each that ends it."""
    context, tally, last = _context(), Tally(name), first + inputs
    while first < last:
        current, results = context.Value("q", first), context.Queue()
        process = context.Process(target=work, args=(name, seed, first, last, current, results))
        process.start()
        part = _outcome_of(process, current, results)
        if part is not None:
            process.join()
            tally.add(part)
            break
        process.kill()
        process.join()
        # what that process read before is read again, up to the input that ended it
        broken = current.value
        if all_targets()[name].own_process and process.exitcode is not None and current.value > first:
            tally.inputs, tally.refused = tally.inputs + 1, tally.refused + 1
        else:
            tally.fail("crash", broken, f"the process ended with {process.exitcode}")
        if broken > first:
            tally.add(fuzz(name, broken - first, seed, first))
        first = broken + 1
        if tally.kinds["crash"] > FAILURES_KEPT:
            break
    return tally


def shares(names: list[str], inputs: int) -> dict[str, int]:
    """Return the number of inputs of each reader: slow ones get less."""
    weights = {n: all_targets()[n].share for n in names}
    return {n: -int(-inputs * w // sum(weights.values())) for n, w in weights.items()}


def table(tallies: list[Tally]) -> str:
    rows = [f"{'reader':<26}{'inputs':>8}{'accepted':>10}{'refused':>9}{'past':>8}{'slowest':>10}{'memory':>10}{'lines':>8}"]
    for t in tallies:
        wanted, of = sum(map(len, parser_lines(all_targets()[t.name]).values())), max(t.inputs, 1)
        rows.append(
            f"{t.name:<26}{t.inputs:>8}{t.accepted / of:>10.1%}{t.refused / of:>9.1%}{t.past / of:>8.1%}"
            f"{t.slowest:>8.2f} s{max(t.memory, 0) / 2**20:>6.0f} MiB{len(t.lines) / wanted:>8.1%}"
        )
    return "\n".join(rows)


def shallow(tally: Tally) -> str:
    """Say where too few inputs get past the first check of a reader; empty where enough do, or where few inputs say little."""
    if tally.inputs < JUDGED or tally.past >= PAST * tally.inputs:
        return ""
    return f"{tally.name}: {tally.past} of {tally.inputs} inputs get past the first check"


def missed(tally: Tally) -> dict[str, list[int]]:
    lines = parser_lines(all_targets()[tally.name])
    found = {Path(f).name: sorted(n for n in numbers if (f, n) not in tally.lines) for f, numbers in lines.items()}
    return {f: numbers for f, numbers in found.items() if numbers}


if __name__ == "__main__":
    name, seed, index, place = sys.argv[1:]
    Path(place).mkdir(parents=True)
    print(Worker(all_targets()[name], int(seed), Path(place)).put(int(index))[0])
