"""Flags from settings: a command line with the names, defaults and help texts of a dataclass of settings."""

import contextlib
import dataclasses
import io
import re
import types
import typing
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from warpgs.app.command_help import help_text
from warpgs.app.wrong_words import refuse
from warpgs.errors import UsageError
from warpgs.field_docs import field_docs
from warpgs.runtime.terminal import say

Settings = TypeVar("Settings")


def flags_of(kind: type, default: Any, special: Mapping[str, tuple[Any, ...]] | None = None) -> tuple[type, Any]:
    """Derive the flags of a settings dataclass, nested settings included.

    Every field becomes a flag with the field's docstring as its help. Flags of nested settings begin with the field's name.

    Args:
        kind: The dataclass.
        default: Instance of ``kind`` with the defaults of the flags.
        special: Markers and constructors of tyro for some fields of ``kind`` itself, by name.

    Returns:
        A subclass of ``kind`` that tyro can parse, and an instance of it with the defaults.
    """
    import tyro

    hints, docs, fields, values = typing.get_type_hints(kind), field_docs(kind), [], {}
    for f in dataclasses.fields(kind):
        hint, value = hints[f.name], getattr(default, f.name)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            hint, value = flags_of(hint, value)
            markers: tuple[Any, ...] = ()
        else:
            markers = (tyro.conf.arg(help=docs.get(f.name, "")),)
        for marker in (*markers, *(special or {}).get(f.name, ())):
            hint = Annotated[hint, marker]
        values[f.name] = value
        fields.append((f.name, hint, dataclasses.field(default=value)))
    flags = dataclasses.make_dataclass(kind.__name__, fields, bases=(kind,), frozen=True, namespace={"__doc__": kind.__doc__})
    return flags, flags(**values)


def settings_of(kind: type[Settings], flags: Any) -> Settings:
    """Return the settings of parsed flags: the inverse of `flags_of`."""
    hints = typing.get_type_hints(kind)
    values = {f.name: getattr(flags, f.name) for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    return kind(**{n: settings_of(hints[n], v) if dataclasses.is_dataclass(hints[n]) else v for n, v in values.items()})


def either(flags: Any, name: str) -> bool | None:
    """Return True for a flag, False for its no- form, None if neither is given.

    Args:
        flags: Parsed flags with booleans ``name`` and ``no_name``.
        name: Name of the flag.

    Raises:
        UsageError: Both are given.
    """
    yes, no = getattr(flags, name), getattr(flags, f"no_{name}")
    if yes and no:
        raise UsageError(f"--{name} and --no-{name} exclude each other; give one of them")
    return True if yes else False if no else None


MAX_WHOLE = 2**63 - 1
"""Largest whole number that a flag takes: the largest signed integer of 64 bits."""
MAX_THREADS = 4096
"""Most threads that a flag takes."""
MAX_NUMBER = 3e38
"""Largest number that a flag takes: just below the largest float32."""


def _whole(words: list[str]) -> int:
    """Return the integer of an argument; ValueError if it is not an integer of 64 bits."""
    if not re.fullmatch(r"[+-]?[0-9][0-9_]*", words[0]):
        raise ValueError(f"expected an integer, got {words[0][:40]!r}")
    if len(words[0]) > 40 or abs(number := int(words[0])) > MAX_WHOLE:
        raise ValueError(f"expected an integer of at most 2^63 - 1, got {words[0][:40]!r}")
    return number


def _number(words: list[str]) -> float:
    """Return the number of an argument; ValueError if it is not a number, not finite, or beyond float32."""
    plain = re.fullmatch(r"[+-]?([0-9][0-9_]*\.?[0-9_]*|\.[0-9][0-9_]*)([eE][+-]?[0-9]+)?", words[0])
    if not plain:
        raise ValueError(f"expected a finite number, got {words[0][:40]!r}")
    if not abs(number := float(words[0])) <= MAX_NUMBER:
        raise ValueError(f"expected a finite number of at most {MAX_NUMBER:g}, got {words[0][:40]!r}")
    return number


def _switch(words: list[str]) -> bool:
    """Return True for true and False for false, in any case; ValueError for another argument."""
    found = {"true": True, "false": False}.get(words[0].lower())
    if found is None:
        raise ValueError(f"expected true, false or none, got {words[0][:40]!r}")
    return found


PARSERS: dict[Any, Any] = {int: _whole, float: _number, bool: _switch}
"""Functions that return the value of an argument, by its type."""


def _number_rule(info: Any) -> Any:
    """Return the parser of a number, or of a number or switch that may be None; None for other types."""
    import tyro

    union = typing.get_origin(info.type) in (typing.Union, types.UnionType)
    kinds = [k for k in (typing.get_args(info.type) if union else (info.type,)) if k is not types.NoneType]
    if len(kinds) != 1 or kinds[0] not in PARSERS or (kinds[0] is bool and not union):  # a switch alone is --name or --no-name
        return None
    kind = kinds[0]
    name = "{None,True,False}" if kind is bool else "{None}|" * union + kind.__name__.upper()
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1, metavar=name,
        instance_from_str=lambda words: None if union and words[0].lower() == "none" else PARSERS[kind](words),
        is_instance=lambda value: (
            (union and value is None) or (isinstance(value, (int, kind)) and isinstance(value, bool) == (kind is bool))
        ),
        str_from_instance=lambda value: [str(value)],
    )  # fmt: skip


def parse_flags(kind: type, arguments: list[str], program: str, description: str) -> Any:
    """Parse the arguments of a command line into a dataclass of flags; ``--help`` prints one screen.

    Numbers are finite and written in the digits 0 to 9.

    Args:
        kind: The dataclass.
        arguments: Arguments after the name of the command.
        program: Name of the program and the command, for the help.
        description: Description of the command, for the help.

    Raises:
        SystemExit: Help was asked for.
        UsageError: An argument is wrong or missing.
    """
    import tyro

    if {"-h", "--help"} & {*arguments}:
        for line in help_text(kind, program, description).splitlines():
            say(line)
        raise SystemExit(0)
    arguments = ["--help" if word == "--help-all" else word for word in arguments]  # tyro's help, with every flag
    registry = tyro.constructors.ConstructorRegistry()
    registry.primitive_rule(_number_rule)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, args=arguments, prog=program, description=description, registry=registry)
    except SystemExit:
        if complaint.getvalue():
            refuse(kind, arguments, program, complaint.getvalue())
        raise  # after tyro's help


def check_range(flag: str, value: float, low: float, high: float) -> None:
    """Check the number of a flag.

    Raises:
        UsageError: The value is below ``low`` or above ``high``.
    """
    if not low <= value <= high:
        raise UsageError(f"{flag} must be a number from {low:,} to {high:,}, not {value}")


def listed(title: str, lines: Mapping[str, str]) -> str:
    """Return a title and a list of names with descriptions, for the beginning of a help text."""
    return "\n".join([f"{title}:", *(f"  {name}: {about}" if about else f"  {name}" for name, about in lines.items())])


def word_after(arguments: list[str], flag: str) -> str | None:
    """Return the value of a flag that determines the other flags; None if it is not given."""
    found = None
    for i, word in enumerate(arguments):
        name, given, value = word.partition("=")
        if name.replace("_", "-") != flag:  # tyro accepts _ and -
            continue
        if given:
            found = value
        elif i + 1 < len(arguments):
            found = arguments[i + 1]
    return found
