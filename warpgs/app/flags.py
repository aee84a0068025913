"""Flags of a command: tyro parses them, and flags that are gone name what replaces them."""

import contextlib
import dataclasses
import functools
import io
import itertools
import re
import types
import typing
from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeVar

import tyro  # noqa: TID253 - only a command imports this file

from warpgs.errors import UsageError, field_docs
from warpgs.process import say_lines
from warpgs.schema import Within, rules_of

REMOVED = {"--repeat": "the error of the fit itself names step, view, loss term and tensors"}
"""What replaces flags that are gone, by their names with dashes."""
Threads = Annotated[int, Within(0, 4096)]
"""Number of threads."""
Port = Annotated[int, Within(0, 65535)]
"""Port of this machine."""

Settings = TypeVar("Settings")


def call(command: Callable[..., Any], arguments: list[str], program: str, description: str) -> Any:
    """Call a function with the arguments of a command line as its own, in the ranges of its hints; return its result."""

    @functools.wraps(command)
    def later(**named: Any) -> Callable[[], Any]:
        for name, rule in rules_of(command):
            if named[name] is not None and not rule.allows(named[name]):
                raise UsageError(f"--{name.replace('_', '-')} must be {rule}, not {named[name]}")
        return functools.partial(command, **named)

    return parse_flags(later, arguments, program, description)()


def read_by(metavar: str, read: Callable[[str], Any], kind: Any, text: Callable[[Any], str]) -> Any:
    """Return tyro's rule for a flag of one word, whose value is of ``kind`` or None, and is shown as ``text``."""
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1, metavar=metavar, instance_from_str=lambda words: read(words[0]),
        is_instance=lambda value: value is None or isinstance(value, kind), str_from_instance=lambda value: [text(value)],
    )  # fmt: skip


def _open_value(info: Any) -> Any:
    """Return tyro's rule for a number or switch that may be None, which takes none, true and false in any case."""
    kinds = typing.get_args(info.type)
    kind = next((k for k in (int, float, bool) if set(kinds) == {k, types.NoneType}), None)
    if kind is None:
        return None
    words = {"none": None} | ({"true": True, "false": False} if kind is bool else {})

    def read(word: str) -> Any:
        if word.lower() not in words and kind is bool:
            raise ValueError(f"expected true, false or none, got {word!r}")
        return words[word.lower()] if word.lower() in words else kind(word)

    metavar = "|".join([*words, *([] if kind is bool else [kind.__name__.upper()])])
    return read_by(metavar, read, (int, kind), lambda value: str(value).lower())


def parse_flags(kind: Callable[..., Any], arguments: list[str], program: str, description: str) -> Any:
    """Return the instance of a dataclass of flags for the arguments of a command line."""
    words = ["--help" if word == "--help-all" else word for word in arguments]
    words = [part for flag, word in zip(["", *words], words) for part in (word.split("x") if flag == "--size" else [word])]
    complaint, help_text, registry = io.StringIO(), io.StringIO(), tyro.constructors.ConstructorRegistry()
    registry.primitive_rule(_open_value)
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, args=words, prog=program, description=description, registry=registry)
    except SystemExit as e:
        if not e.code:  # after the help
            raise
    said = re.sub(r"\[/?bold\]", "", complaint.getvalue())
    with contextlib.redirect_stdout(help_text), contextlib.suppress(SystemExit):
        tyro.cli(kind, args=["--help"], prog=program, registry=registry)
    known = {*re.findall(r"--[\w.-]+", help_text.getvalue())}
    for flag in (word.partition("=")[0].replace("_", "-") for word in arguments if word.startswith("--")):
        from warpgs.pipeline.train.settings import removed_note

        if note := f"{flag} was removed: {REMOVED[flag]}" if flag in REMOVED else removed_note(flag[2:]):
            raise UsageError(note)
        if flag not in known and flag not in said.replace("_", "-"):  # tyro took the word after it for its value
            raise UsageError(f"unknown flag {flag}; `{program} --help-all` lists the flags")
        if flag == "--size" and re.search("(parsing|argument) '?--size", said):
            raise UsageError(f"--size takes two numbers: --size 1080 1920; `{program} --help-all` shows what it takes")
    say_lines(said.splitlines(), error=True)
    raise UsageError(f"wrong arguments, as shown above; `{program} --help-all` lists them")


def flags_of(kind: type, default: Any, special: Mapping[str, tuple[Any, ...]] | None = None) -> tuple[type, Any]:
    """Return a subclass of a settings dataclass whose fields are flags with their docstrings as help, and its defaults."""
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


def listed(title: str, lines: Mapping[str, str]) -> str:
    """Return a title and a list of names with descriptions, for the beginning of a help text."""
    return "\n".join([f"{title}:", *(f"  {name}: {about}" if about else f"  {name}" for name, about in lines.items())])


def word_after(arguments: list[str], flag: str) -> str | None:
    """Return the value of a flag that determines the other flags; None if it is not given."""
    found = None
    for word, after in itertools.zip_longest(arguments, arguments[1:]):
        name, given, value = word.partition("=")
        if name.replace("_", "-") == flag:  # tyro accepts _ and -
            found = value if given else found if after is None else after
    return found
