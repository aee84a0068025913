"""All mutants, with keys that do not depend on edits elsewhere in a file, and samples of mutants."""

import hashlib
import random
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from tools.mutation import rules
from tools.mutation.edit import Edit
from tools.mutation.native import native_edits
from tools.mutation.python import python_edits

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Candidate:
    """One mutant."""

    file: str
    """Path below the root of the repository."""
    edit: Edit
    number: int
    """Line, from 1."""
    line: str
    """Text of the line, stripped."""
    change: str
    """The change, with ``#n`` where one statement offers the same change n times."""

    @property
    def key(self) -> tuple[str, str, str, str, str]:
        """File, function, path, shape and change: a name that does not depend on the rest of the file."""
        place = self.edit.place
        return self.file, place.function, place.path, place.shape, self.change

    @property
    def id(self) -> str:
        """Eight hexadecimal digits of the key."""
        return hashlib.sha256("\0".join(self.key).encode()).hexdigest()[:8]

    @property
    def cuda(self) -> bool:
        """True where only a CUDA device runs it."""
        return self.edit.place.cuda


def candidates_of(file: str, source: bytes) -> list[Candidate]:
    """Return the mutants of one source text."""
    edits = python_edits(source, file) if file.endswith(".py") else native_edits(source)
    lines = source.decode().splitlines()
    seen: Counter = Counter()
    found = []
    for edit in edits:
        number = source.count(b"\n", 0, edit.start) + 1
        seen[key := (edit.place.function, edit.place.path, edit.change)] += 1
        change = edit.change if seen[key] == 1 else f"{edit.change} #{seen[key]}"
        found.append(Candidate(file, edit, number, lines[number - 1].strip(), change))
    return found


def all_candidates() -> list[Candidate]:
    """Return the mutants of all files that `rules.MUTATED` names."""
    paths = [p for pattern in rules.MUTATED for p in sorted(ROOT.glob(pattern))]
    return [c for p in paths for c in candidates_of(p.relative_to(ROOT).as_posix(), p.read_bytes())]


def sample(candidates: list[Candidate], count: int, seed: int) -> list[Candidate]:
    """Return a random sample, stratified by file and by device, in proportion to the number of mutants, rounded up.

    A larger sample with the same seed contains the smaller one.
    """
    strata: dict[tuple[str, bool], list[Candidate]] = {}
    for c in candidates:
        strata.setdefault((c.file, c.cuda), []).append(c)
    found = []
    for stratum, own in strata.items():
        order = random.Random(f"{seed} {stratum}").sample(own, len(own))
        found.extend(order[: -(-count * len(own) // len(candidates))])
    return sorted(found, key=lambda c: (c.file, c.edit.start, c.change))
