"""All mutants of warpgs/kernels, each under a key that edits elsewhere leave alone, and samples of them."""

import hashlib
import random
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from tests.mutate.edit import Edit
from tests.mutate.native import native_edits
from tests.mutate.python import python_edits

ROOT = Path(__file__).parents[2]
KERNELS = "warpgs/kernels"


@dataclass(frozen=True)
class Candidate:
    """One mutant."""

    file: str
    """Path below warpgs/kernels."""
    edit: Edit
    number: int
    """Line, from 1."""
    line: str
    """Its text, stripped."""
    change: str
    """What is done; with ``#n`` where one line text of one function offers the same change n times."""

    @property
    def key(self) -> tuple[str, str, str, str]:
        """File, function, line text and change: what names it whatever stands elsewhere in the file."""
        return self.file, self.edit.function, self.line, self.change

    @property
    def id(self) -> str:
        """Eight hexadecimal digits of the key."""
        return hashlib.sha256("\0".join(self.key).encode()).hexdigest()[:8]

    @property
    def cuda(self) -> bool:
        """Whether only a CUDA device runs it."""
        return self.edit.cuda

    def mutated_line(self) -> str:
        """The line as it becomes (of a statement over several lines, the first)."""
        source = (ROOT / KERNELS / self.file).read_bytes()
        return self.edit.apply(source).decode().splitlines()[self.number - 1].strip()


def candidates_of(file: str, source: bytes) -> list[Candidate]:
    """The mutants of one source text."""
    edits = python_edits(source, file) if file.endswith(".py") else [
        Edit(e.start, e.end, e.new, e.change, cuda=True) for e in native_edits(source)
    ]  # fmt: skip
    lines = source.decode().splitlines()
    seen: Counter = Counter()
    found = []
    for edit in edits:
        number = source.count(b"\n", 0, edit.start) + 1
        line = lines[number - 1].strip()
        seen[key := (edit.function, line, edit.change)] += 1
        change = edit.change if seen[key] == 1 else f"{edit.change} #{seen[key]}"
        found.append(Candidate(file, edit, number, line, change))
    return found


def all_candidates() -> list[Candidate]:
    """The mutants of every kernel file."""
    folder = ROOT / KERNELS
    paths = sorted([*folder.glob("*.py"), *(folder / "cuda").glob("*.cu")])
    return [c for p in paths for c in candidates_of(p.relative_to(folder).as_posix(), p.read_bytes())]


def draw(candidates: list[Candidate], count: int, seed: int) -> list[Candidate]:
    """A random sample: of each file, and apart for each device, a share in proportion to its candidates, rounded up.

    A larger sample of the same seed holds the smaller one.
    """
    strata: dict[tuple[str, bool], list[Candidate]] = {}
    for c in candidates:
        strata.setdefault((c.file, c.cuda), []).append(c)
    drawn = []
    for stratum, own in strata.items():
        order = random.Random(f"{seed} {stratum}").sample(own, len(own))
        drawn.extend(order[: -(-count * len(own) // len(candidates))])
    return sorted(drawn, key=lambda c: (c.file, c.edit.start, c.change))
