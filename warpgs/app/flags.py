"""Flags of a command: parsed by tyro, with help on one screen and hints at wrong words."""

import contextlib
import dataclasses
import io
import re
import textwrap
import traceback
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

from warpgs.errors import UsageError, WarpgsError, did_you_mean, field_docs
from warpgs.process import say

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


TARGETS = ("--to", "--out")
"""Flags that name the file to write."""
MAX_SHOWN = 40
"""Largest number of letters of a wrong argument that a message repeats."""


def refuse(kind: type, arguments: list[str], program: str, complaint: str) -> NoReturn:
    """Raise an error in one line for a command line that tyro has rejected.

    Args:
        kind: The dataclass of flags.
        arguments: Arguments after the name of the command.
        program: Name of the program and the command.
        complaint: Text that tyro printed: a box with a title, the reason and, below a line, a hint on the help.

    Raises:
        UsageError: Always; the message names the wrong, missing or extra argument, and the fix.
    """
    _refuse_unknown_flag(kind, arguments, program)
    _refuse_lone_side(kind, arguments)
    text = re.sub(r"\x1b\[[0-9;]*m", "", complaint)
    _, *rows = [row for row in re.sub(r"(?m)^│|│$", "", text).splitlines() if row.strip()]  # without the title
    _refuse_stray_word(kind, arguments, program, rows)
    drawn = re.compile(r"[ ─╰╯-]+").fullmatch  # a line, with the hint on the help below
    rows = [*takewhile(lambda row: not drawn(row), dropwhile(drawn, rows))]
    reason = _missing(kind, rows) or _wrong_value(" ".join(" ".join(rows).split()))
    raise UsageError(f"{reason}; `{program} --help` lists its arguments")


def _refuse_unknown_flag(kind: type, arguments: list[str], program: str) -> None:
    """Raise UsageError for the first word that looks like a flag but is not one of a dataclass of flags."""
    known = {*flag_names(kind), "--help"}
    for word in arguments:
        flag = word.partition("=")[0].replace("_", "-")
        if re.match(r"--|-[A-Za-z]", flag) and flag not in known:
            from warpgs.pipeline.train.settings import removed_note

            hint = removed_note(flag[2:]) or did_you_mean(flag, known) or f"`{program} --help-all` lists the flags"
            raise UsageError(f"unknown flag {flag}; {hint}")


def _refuse_lone_side(kind: type, arguments: list[str]) -> None:
    """Raise UsageError for a size that is not two whole numbers."""
    for flag in {"--size"} & {*flag_names(kind)}:
        at = next((i for i, word in enumerate(arguments) if word.partition("=")[0] == flag), None)
        if at is not None and not ("=" not in arguments[at] and _are_whole(arguments[at + 1 : at + 3])):
            raise UsageError(f"{flag} needs two numbers: width height, such as {flag} 1280 720")


def _are_whole(words: list[str]) -> bool:
    """Return whether words are two whole numbers."""
    return len(words) == 2 and all(re.fullmatch(r"[+-]?[0-9]+", word) for word in words)


def _refuse_stray_word(kind: type, arguments: list[str], program: str, rows: list[str]) -> None:
    """Raise UsageError for the first word that tyro calls unrecognized; its flag, such as --out, may be missing."""
    words = " ".join(rows).partition("Unrecognized options:")[2].split()
    if not words or words[0] not in arguments:
        return
    known, given = {*flag_names(kind)}, {word.partition("=")[0] for word in arguments}
    target = next((flag for flag in TARGETS if flag in known - given), None)
    missing = target and any(row.strip().startswith(f"{target} ") for row in rows)
    hint = (
        f"did you mean {target} {words[0]}?"
        if target and (missing or Path(words[0]).suffix)
        else f"`{program} --help` lists its arguments"
    )
    raise UsageError(f"{words[0]} is an extra argument; {hint}")


def _missing(kind: type, rows: list[str]) -> str:
    """Return the message on missing arguments, which tyro lists after four spaces; empty for another error."""
    if not rows or not rows[0].strip().startswith("Missing from "):
        return ""
    found = [row.strip() for row in textwrap.dedent("\n".join(rows)).splitlines()[1:] if re.match(r" {4}\S", row)]
    flags, others = ([name for name in found if name.startswith("--") == is_flag] for is_flag in (True, False))
    if len(known := positional_names(kind)) >= len(others):  # tyro names some by their type; the last ones are missing
        others = known[len(known) - len(others) :]
    names = [*others, *flags]
    return f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} missing"


def _wrong_value(reason: str) -> str:
    """Return tyro's reason as one line, in the wording of our errors."""
    if found := re.match(r"Missing value for argument '(.+?)'\. Expected (\d+)", reason):
        flag, count = found.groups()
        return f"{flag} needs {'a value' if count == '1' else f'{count} values'}"
    if found := re.match(r"invalid choice '(.*)' for argument '(.+?)'\. Expected one of \((.*)\)", reason):
        value, flag, choices = found.groups()
        listed = re.findall(r"'([^']*)'", choices)
        return f"{flag}: {value[:MAX_SHOWN]!r} is not one of {', '.join(listed)}"
    if found := re.match(r"Error parsing (.+?): .*input length (\d+) did not match expected argument count (\d+)", reason):
        flag, given, count = found.groups()
        return f"{flag} needs {count} values, got {given}"
    if found := re.match(r"Error parsing (.+?): (.*)", reason):
        flag, why = found.groups()
        one = re.search(r"expected .*?, got .*?(?= - <class|$)", why)  # tyro gives a reason for each type that the flag accepts
        return f"{flag}: {one[0] if one else why}"
    return reason


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
    values = {f.name: getattr(flags, f.name) for f in dataclasses.fields(kind)}
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


Loaded = TypeVar("Loaded")


def load_own(kind: str, spec: str, load: Callable[[], Loaded]) -> Loaded:
    """Return what ``load`` returns; an error in the imported code is reported in one sentence.

    Args:
        kind: Kind of the loaded object, for messages.
        spec: Name of the object: ``module:NAME`` or ``path/to/file.py:NAME``.
        load: Function that loads it.

    Raises:
        UsageError: The object is missing, or its code does not run; the message names the line.
    """
    try:
        return load()
    except WarpgsError:
        raise
    except Exception as e:  # whatever a user's module raises
        last = traceback.extract_tb(e.__traceback__)[-1]
        syntax = isinstance(e, SyntaxError)
        what, where = (e.msg, f"{e.filename}, line {e.lineno}") if syntax else (e, f"{last.filename}, line {last.lineno}")
        raise UsageError(
            f"the {kind} {spec!r} cannot be loaded: {type(e).__name__}: {what} ({where}); correct that code, or omit the {kind}"
        ) from e
