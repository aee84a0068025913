"""One change of a source text, its place in the syntax, and the changes that both languages share."""

import hashlib
import re
from collections import Counter
from dataclasses import dataclass, replace

ARITHMETIC = {
    "+": "-", "-": "+", "*": "/", "/": "*", "//": "*", "%": "*", "**": "*", "<<": ">>", ">>": "<<", "|": "&", "&": "|",
}  # fmt: skip
BOUNDARY = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "=="}
DIRECTION = {"<": ">", "<=": ">=", ">": "<", ">=": "<="}
UPDATES = {"+=": "-=", "-=": "+=", "*=": "/=", "/=": "*=", "&=": "|="}
LOGIC = {"and": "or", "or": "and", "&&": "||", "||": "&&"}
NAMES = {
    "min": "max", "max": "min", "fminf": "fmaxf", "fmaxf": "fminf", "floor": "ceil", "ceil": "floor",
    "__fsub_rn": "__fadd_rn", "__fmul_rn": "__fdiv_rn", "amin": "amax", "amax": "amin",
}  # fmt: skip
"""Functions that stand for an operator, each with its neighbour."""


@dataclass(frozen=True)
class Place:
    """A statement, identified by syntax: independent of names, comments, line breaks and edits of other functions."""

    function: str = ""
    """Dotted name of the function around it; empty at module level."""
    path: str = ""
    """Statements from the function down to this one, each with its number among those of its kind there: ``For2.If1``."""
    shape: str = ""
    """Fingerprint of the statement; statements with different shapes are different, at any place."""
    cuda: bool = False
    """True if only a CUDA device runs the statement."""

    def below(self, kind: str, counts: Counter, shape: str = "") -> "Place":
        """Return the place of the next part of a kind below this one; ``counts`` is of one file."""
        counts[self.function, self.path, kind] += 1
        path = f"{self.path}.{kind}{counts[self.function, self.path, kind]}".lstrip(".")
        return replace(self, path=path, shape=shape)

    def inside(self, name: str) -> "Place":
        """Return the place that a function or class of that name begins with."""
        return Place(f"{self.function}.{name}".strip("."), cuda=self.cuda)


@dataclass(frozen=True)
class Edit:
    """A change of the bytes ``start`` to ``end`` of a source into ``new``."""

    start: int
    end: int
    new: str
    change: str
    """The change as text, independent of its place: ``+ to -``."""
    place: Place = Place()

    def apply(self, source: bytes) -> bytes:
        """Return the mutated source."""
        return source[: self.start] + self.new.encode() + source[self.end :]


def fingerprint(shape: str) -> str:
    """Return four hexadecimal digits of the text of a syntax."""
    return hashlib.sha256(shape.encode()).hexdigest()[:4]


def swaps(operator: str) -> list[str]:
    """Return the replacements of an operator."""
    tables = (ARITHMETIC, BOUNDARY, DIRECTION, UPDATES, LOGIC)
    return [table[operator] for table in tables if operator in table]


def other_number(text: str, index: bool = False) -> str:
    """Return a neighbour of a number, as text: 0.0 becomes 1.0, whole numbers one more, others one hundredth more.

    ``index``: as the last of three entries, 2 becomes 1, so that the index stays in range.
    """
    if text.startswith("0x"):
        return hex(int(text, 16) + 1)
    digits, suffix = re.fullmatch(r"(.*?)((?:ll|[uU]|[fF])?)", text).groups()
    if re.fullmatch(r"\d+", digits):
        value = int(digits)
        return f"{1 if index and value == 2 else value + 1}{suffix}"
    value = float(digits)
    return f"{1.0 if value == 0.0 else float(f'{value * 1.01:.12g}')!r}{suffix}"
