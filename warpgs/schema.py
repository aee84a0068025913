"""Schemas of untrusted JSON: its size and depth are bounded, and every value has the expected type.

A schema is a function of a value and of its place in the file. It returns nothing, and raises `SchemaError` for an invalid
value.
"""

import functools
import json
import math
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from warpgs.errors import MalformedError, UsageError, expect
from warpgs.files import read_input

MAX_BYTES = 2**25
"""Size of the largest text that is read [bytes]; config.json of a thousand views takes one MiB."""
MAX_DEPTH = 50
"""Largest number of nested lists and objects, so that code that walks through a value needs no limit of its own."""
MAX_PARTS = 2**19
"""Largest number of lists and objects; each takes some thirty times as much memory as its text."""
MAX_WHOLE = 2**63 - 1
"""Largest signed integer of 64 bits."""
MAX_NUMBER = 1e300
"""Largest magnitude of a finite number, and of an integer in the place of a number: a larger one could overflow a float."""

Schema = Callable[[Any, str], None]


SchemaError = MalformedError
"""Error of text that is not JSON, or of a value that its schema does not allow; the message names the place."""


def parse(text: str | bytes) -> Any:
    """Return the value of a JSON text."""
    expect(len(text) <= MAX_BYTES, f"is larger than {MAX_BYTES / 2**20:.0f} MiB")
    check_parts(text)
    try:
        value = json.loads(text)
    except RecursionError as e:
        raise SchemaError(f"is nested deeper than {MAX_DEPTH} lists and objects") from e
    except ValueError as e:
        raise SchemaError(f"not valid JSON: {e}") from e
    check_depth(value, MAX_DEPTH)
    return value


def check_parts(text: str | bytes) -> None:
    """Check the number of lists and objects of a JSON text before it is parsed."""
    count = text.count("[") + text.count("{") if isinstance(text, str) else text.count(b"[") + text.count(b"{")
    expect(count <= MAX_PARTS, f"has more than {MAX_PARTS:,} lists and objects")


def check_depth(value: Any, most: int) -> None:
    """Check that at most ``most`` lists and objects are nested, without recursion."""
    level, depth = [value], 0
    while level := [p for v in level for p in (v.values() if isinstance(v, dict) else v if isinstance(v, list) else ())]:
        depth += 1
        expect(depth <= most, f"is nested deeper than {most} lists and objects")


def anything(value: Any, place: str) -> None:
    """Allow every value."""


def read(path: Path, below: Path | None = None, rule: Schema = anything) -> Any:
    """Return the value of a JSON file that keeps a rule."""
    value = parse(read_input(path, MAX_BYTES, below))
    rule(value, "")
    return value


def flag(value: Any, place: str) -> None:
    """Allow true and false."""
    _must(isinstance(value, bool), value, place, "true or false")


def text(value: Any, place: str) -> None:
    """Allow text that can be a path: no zero byte, and no surrogates except those of undecodable bytes in names."""
    _must(isinstance(value, str), value, place, "text")
    try:
        _must(b"\0" not in value.encode("utf-8", "surrogateescape"), value, place, "text without a zero byte")
    except UnicodeEncodeError:
        _must(False, value, place, "text of whole characters")


def one_of(*values: Any) -> Schema:
    """Return the schema of a value that is one of some JSON values; 1 and true are different values."""
    wanted = f"one of {', '.join(map(str, values))}"

    def check(value: Any, place: str) -> None:
        _must(any(value == v and type(value) is type(v) for v in values), value, place, wanted)

    return check


def whole(low: int = -MAX_WHOLE, high: int = MAX_WHOLE) -> Schema:
    """Return the schema of integers from ``low`` to ``high``."""
    wanted = "a whole number of 64 bits" if (low, high) == (-MAX_WHOLE, MAX_WHOLE) else f"a whole number from {low} to {high}"

    def check(value: Any, place: str) -> None:
        _must(isinstance(value, int) and not isinstance(value, bool) and low <= value <= high, value, place, wanted)

    return check


def real(value: Any, place: str) -> None:
    """Allow every number, NaN and infinity too."""
    plain = isinstance(value, float) or (isinstance(value, int) and not isinstance(value, bool) and abs(value) <= MAX_NUMBER)
    _must(plain, value, place, "a number")


def number(low: float = -math.inf, above: float = -math.inf, high: float = math.inf) -> Schema:
    """Return the schema of finite numbers that are at least ``low``, larger than ``above``, and at most ``high``."""
    bounds = f" of at least {low:g}" * (low > -math.inf) + f" above {above:g}" * (above > -math.inf)
    bounds += f" of at most {high:g}" * (high < math.inf)

    def check(value: Any, place: str) -> None:
        sound = not isinstance(value, bool) and isinstance(value, (int, float)) and abs(value) <= MAX_NUMBER
        _must(sound and low <= value <= high and value > above, value, place, f"a finite number{bounds}")

    return check


def or_null(schema: Schema) -> Schema:
    """Return the schema of null and of all values that ``schema`` allows."""

    def check(value: Any, place: str) -> None:
        if value is not None:
            schema(value, place)

    return check


def items(schema: Schema, count: int | None = None) -> Schema:
    """Return the schema of lists of items that ``schema`` allows, ``count`` of them if given."""

    def check(value: Any, place: str) -> None:
        fits = isinstance(value, list) and count in (None, len(value))
        _must(fits, value, place, "a list" if count is None else f"a list of {count}")
        for i, item in enumerate(value):
            schema(item, f"{place}[{i}]")

    return check


def mapping(schema: Schema, names: Schema = text) -> Schema:
    """Return the schema of objects: ``names`` must allow each name, ``schema`` each value."""

    def check(value: Any, place: str) -> None:
        _must(isinstance(value, dict), value, place, "an object")
        for name, item in value.items():
            names(name, f"a name in {place}")
            schema(item, f"{place}.{name}")

    return check


def fields(needed: Mapping[str, Schema], more: Mapping[str, Schema] | None = None, *, others: bool = True) -> Schema:
    """Return the schema of objects with certain names."""
    known = {**needed, **(more or {})}

    def check(value: Any, place: str) -> None:
        _must(isinstance(value, dict), value, place, "an object")
        for name in needed:
            expect(name in value, f"{place}.{name}".lstrip(".") + " is missing")
        for name, item in value.items():
            if name in known:
                known[name](item, f"{place}.{name}".lstrip("."))
            else:
                expect(others, f"{place}.{name[:40]}".lstrip(".") + " is unknown")

    return check


state_schema = fields


def of_type(hint: Any) -> Schema:
    """Return the schema of a field's values by its type hint: bool, int, float, str or a tuple, each also as ``... | None``.

    Every value is allowed for other types.
    """
    parts = typing.get_args(hint)
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        kinds = [of_type(p) for p in parts if p is not type(None)]
        return or_null(kinds[0]) if len(kinds) == 1 and type(None) in parts else anything
    if typing.get_origin(hint) is tuple:
        return items(of_type(parts[0]), None if len(parts) == 2 and parts[1] is Ellipsis else len(parts))
    return {bool: flag, int: whole(), float: number(), str: text}.get(hint, anything)


def _must(sound: bool, value: Any, place: str, wanted: str) -> None:
    """Refuse a value unless it is ``sound``."""
    if not sound:
        found = repr(value)[:60] if isinstance(value, (str, float, bool, type(None))) else type(value).__name__
        raise SchemaError(f"{place[:100] or 'it'} must be {wanted}, not {found}")


class Within(NamedTuple):
    """Numbers that a setting allows, for `typing.Annotated`: from ``low`` to ``high``, without NaN."""

    low: float = -math.inf
    high: float = math.inf
    open: str = ""
    """Ends that are left out: "(" for ``low``, ")" for ``high``."""
    zero: bool = False
    """Whether 0 is allowed, too; it switches a limit off."""

    def allows(self, value: float) -> bool:
        """Return whether a number is in the range."""
        ends = ("(" in self.open and value == self.low) or (")" in self.open and value == self.high)
        return (self.low <= value <= self.high and not ends) or (self.zero and value == 0)

    def __str__(self) -> str:
        """Return the range in words."""
        off = "0 (no limit), or " * self.zero
        if self.high == math.inf:
            return f"{off}{'above' if '(' in self.open else 'at least'} {self.low:g}{' and finite' * (')' in self.open)}"
        ends = "(" if "(" in self.open else "[", ")" if ")" in self.open else "]"
        return f"{off}in {ends[0]}{self.low:g}, {self.high:g}{ends[1]}"


class Checked:
    """Base of a dataclass of settings that checks its fields against their `Within`, or a tuple of allowed values."""

    group: ClassVar[str] = ""
    """Beginning of the names of the settings in messages, such as ``init.``."""

    def __init_subclass__(cls, group: str | None = None, **others: Any) -> None:
        """Take the name of the group of settings."""
        super().__init_subclass__(**others)
        if group is not None:
            cls.group = group

    def __post_init__(self) -> None:
        """Check every field; None stands for an automatic choice.

        Raises:
            UsageError: A value is not allowed.
        """
        kind: Any = type(self)
        for name, rule in rules_of(kind):
            value = getattr(self, name)
            if value is None or (rule.allows(value) if isinstance(rule, Within) else value in rule):
                continue
            wanted = str(rule) if isinstance(rule, Within) else f"one of {', '.join(rule)}"
            shown = value if isinstance(rule, Within) else repr(value)[:60]
            raise UsageError(f"{self.group}{name.replace('_', '-')} must be {wanted}, not {shown}")


@functools.cache
def rules_of(kind: type) -> tuple[tuple[str, Any], ...]:
    """Return name and rule of each field with a range or a list of values."""
    hints = typing.get_type_hints(kind, include_extras=True)
    parts = ((name, part) for name, hint in hints.items() for part in (hint, *typing.get_args(hint)))  # of ``... | None``, too
    return tuple((n, rule) for n, part in parts for rule in getattr(part, "__metadata__", ()) if isinstance(rule, tuple))
