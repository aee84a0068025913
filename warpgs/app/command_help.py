"""`warpgs COMMAND --help` on one screen, from the dataclass of the command's flags."""

import dataclasses
import textwrap
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from warpgs.field_docs import field_docs

WIDTH = 80
"""Columns of a terminal."""
NAMES = 22
"""Largest width of the column with flags and values [letters]."""
FEW = 4
"""Largest number of flags in a group whose flags are explained; a larger group is only a list of names."""
VALUES = {int: "N", float: "X", Path: "PATH", str: "VALUE"}
"""Placeholders for the value of a flag, by its type."""


def help_text(kind: type, program: str, description: str) -> str:
    """Return the help of a command.

    Args:
        kind: Dataclass of the flags, as for `parse_flags`.
        program: Name of the program and the command.
        description: Description of the command; lines of a list begin with two spaces.
    """
    docs, usage, positionals, flags, more = field_docs(kind), [program], [], [], []
    for field in dataclasses.fields(kind):
        hint, markers = _parts(typing.get_type_hints(kind, include_extras=True)[field.name])
        if dataclasses.is_dataclass(hint):
            group = _prefix(field.name, markers)
            more += _group(hint, group, sole=len(dataclasses.fields(kind)) <= 2)
            usage += [_row(f, h, group, "")[0] for f, h, _ in _fields(hint) if _required(f)]
        elif "Positional" in str(markers):
            several = typing.get_origin(hint) is tuple
            usage.append(field.name.upper() + " ..." * several)
            positionals.append((field.name.upper(), docs.get(field.name, "").removesuffix(".")))
        else:
            row = _row(field, hint, "", docs.get(field.name, ""))
            flags.append(row)
            if _required(field):
                usage.append(row[0])
    about = [line for text in f"{program}: {description}".splitlines() for line in _wrapped(text) or [""]]
    lines = [*about, "", f"usage: {' '.join(usage)} [flags]", ""]
    lines += [*_columns(positionals), *[""] * bool(positionals), "flags, and their [defaults]:", *_columns(flags)]
    return "\n".join([*lines, *(line for title, rows in more for line in (title, *rows))])


def flag_names(kind: type, prefix: str = "") -> Iterator[str]:
    """Yield the names of all flags of a dataclass, with dashes: also flags of nested settings and ``no-`` flags."""
    hints = typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint, markers = _parts(hints[field.name])
        if dataclasses.is_dataclass(hint):
            yield from flag_names(typing.cast(type, hint), prefix + _prefix(field.name, markers))
        elif "Positional" not in str(markers):
            name = f"{prefix}{field.name}".replace("_", "-")
            parent, _, last = name.rpartition(".")
            yield f"--{name}"
            if hint is bool:
                yield f"--{parent}{'.' * bool(parent)}no-{last}"


def positional_names(kind: type) -> list[str]:
    """Return the names of a command's positional arguments for its help."""
    hints, names = typing.get_type_hints(kind, include_extras=True), []
    for field in dataclasses.fields(kind):
        hint, markers = _parts(hints[field.name])
        if dataclasses.is_dataclass(hint):
            names += positional_names(typing.cast(type, hint))
        elif "Positional" in str(markers) and _required(field):
            names.append(field.name.upper())
    return names


def _parts(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return the type and the markers of an annotation; for a union, its first type that is not None."""
    markers: tuple[Any, ...] = ()
    while hasattr(hint, "__metadata__"):
        hint, markers = hint.__origin__, (*markers, *hint.__metadata__)
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        hint = next(a for a in typing.get_args(hint) if a is not type(None))
    return hint, markers


def _prefix(name: str, markers: tuple[Any, ...]) -> str:
    """Return the prefix of the names of a group's flags."""
    named = [m.name for m in markers if getattr(m, "name", None) is not None]
    if "OmitArgPrefixes" in str(markers) or "" in named:
        return ""
    return f"{named[0] if named else name}."


def _required(field: Any) -> bool:
    """Return whether a field has no default."""
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _row(field: Any, hint: Any, prefix: str, text: str) -> tuple[str, str]:
    """Return a flag with its value, and its description with the default."""
    default = field.default
    if isinstance(default, bool):
        word, flag, stated = "", "[no-]" * default, " [on]" * default
    else:
        word = " " + " ".join(VALUES.get(a, "VALUE") for a in typing.get_args(hint) or (hint,))
        values = default if isinstance(default, tuple) else (default,)
        flag, stated = "", "" if _required(field) or default in (None, "") else f" [{' '.join(map(str, values))}]"
    return f"--{flag}{prefix}{field.name}{word}".replace("_", "-"), text.removesuffix(".") + stated


def _fields(kind: type) -> Iterator[tuple[Any, Any, str]]:
    """Yield the fields of a group that a user may give: field, type, description."""
    docs, hints = field_docs(kind), typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint, markers = _parts(hints[field.name])
        if "Suppress" not in str(markers):
            yield field, hint, docs.get(field.name, "")


def _group(kind: type, prefix: str, *, sole: bool) -> Iterator[tuple[str, list[str]]]:
    """Yield title and lines of a group of flags; flags of a large group have no descriptions."""
    rows = [_row(field, hint, prefix, text) for field, hint, text in _fields(kind)]
    if sole or len(rows) <= FEW:
        yield "", _columns(rows)
    else:
        names = ", ".join(flag.partition(" ")[0] for flag, _ in rows)
        lines = textwrap.wrap(names, WIDTH - 2, break_on_hyphens=False)
        yield "\nmore flags, explained by --help-all:", [f"  {line}" for line in lines]


def _wrapped(text: str) -> list[str]:
    """Break a line of a description into lines of a screen; a line that begins with spaces has a hanging indent."""
    hang = "    " if text.startswith("  ") else ""
    return textwrap.wrap(text, WIDTH, subsequent_indent=hang, break_on_hyphens=False)


def _columns(rows: list[tuple[str, str]]) -> list[str]:
    """Return names and descriptions as two columns; a long name has a line of its own."""
    width = min(max((len(name) for name, _ in rows), default=0), NAMES)
    lines = []
    for name, text in rows:
        words = textwrap.wrap(text.replace("``", ""), WIDTH - width - 4, break_on_hyphens=False) or [""]
        if len(name) > width:
            lines.append(f"  {name}")
            name = ""
        lines += [f"  {name if i == 0 else '':<{width}}  {line}".rstrip() for i, line in enumerate(words)]
    return lines
