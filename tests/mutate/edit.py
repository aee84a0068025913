"""One change of a source text, and the changes that both languages share."""

import re
from dataclasses import dataclass

ARITHMETIC = {
    "+": "-",
    "-": "+",
    "*": "/",
    "/": "*",
    "//": "*",
    "%": "*",
    "**": "*",
    "<<": ">>",
    ">>": "<<",
    "|": "&",
    "&": "|",
}
BOUNDARY = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "=="}
DIRECTION = {"<": ">", "<=": ">=", ">": "<", ">=": "<="}
UPDATES = {"+=": "-=", "-=": "+=", "*=": "/=", "/=": "*=", "&=": "|="}
LOGIC = {"and": "or", "or": "and", "&&": "||", "||": "&&"}
NAMES = {
    "min": "max", "max": "min", "fminf": "fmaxf", "fmaxf": "fminf", "floor": "ceil", "ceil": "floor",
    "__fsub_rn": "__fadd_rn", "__fmul_rn": "__fdiv_rn", "amin": "amax", "amax": "amin",
}  # fmt: skip
"""Functions that stand for an operator, and the one that is its neighbour."""


@dataclass(frozen=True)
class Edit:
    """Bytes ``start`` to ``end`` of a source become ``new``."""

    start: int
    end: int
    new: str
    change: str
    """What is done, in words that do not depend on the place: ``+ to -``."""
    function: str = ""
    """Dotted name of the function around it; empty at module level."""
    cuda: bool = False
    """Whether only a CUDA device runs it."""

    def apply(self, source: bytes) -> bytes:
        """The mutated source."""
        return source[: self.start] + self.new.encode() + source[self.end :]


def swaps(operator: str) -> list[str]:
    """What an operator is replaced by."""
    tables = (ARITHMETIC, BOUNDARY, DIRECTION, UPDATES, LOGIC)
    return [table[operator] for table in tables if operator in table]


def other_number(text: str, index: bool = False) -> str:
    """A neighbour of a number, as text: 0 and 1 one more, other whole numbers too, others one hundredth more.

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
