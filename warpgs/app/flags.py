"""Flags from settings: a dataclass of settings as a command line that takes its names, defaults and help texts from it."""

import ast
import dataclasses
import inspect
import itertools
import textwrap
import typing
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

Settings = TypeVar("Settings")


def field_docs(kind: type) -> dict[str, str]:
    """Return the docstrings of the fields of a dataclass by name, each on one line; those of its bases included."""
    docs: dict[str, str] = {}
    for cls in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(cls):
            continue
        try:
            source = inspect.getsource(cls)
        except OSError:  # a class typed into an interpreter has no source: its flags go without help
            continue
        (tree,) = ast.parse(textwrap.dedent(source)).body
        for statement, after in itertools.pairwise(tree.body if isinstance(tree, ast.ClassDef) else []):
            match statement, after:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str() as text)):
                    docs[name] = " ".join(text.split())
    return docs


def flags_of(kind: type, default: Any, special: Mapping[str, tuple[Any, ...]] | None = None) -> tuple[type, Any]:
    """Derive the flags of a settings dataclass, nested settings included.

    Every field becomes a flag with the field's docstring as its help, those of nested settings under the field's name.

    Args:
        kind: The dataclass.
        default: An instance of it, with the defaults of the flags.
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
    """Return the settings that parsed flags stand for: the inverse of `flags_of`."""
    hints = typing.get_type_hints(kind)
    values = {f.name: getattr(flags, f.name) for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    return kind(**{n: settings_of(hints[n], v) if dataclasses.is_dataclass(hints[n]) else v for n, v in values.items()})


def word_after(arguments: list[str], flag: str) -> str | None:
    """Return the word after a flag that must be known before the others can be described; None where it is not given."""
    found = None
    for i, word in enumerate(arguments):
        name, given, value = word.partition("=")
        if name.replace("_", "-") != flag:  # tyro takes either
            continue
        if given:
            found = value
        elif i + 1 < len(arguments):
            found = arguments[i + 1]
    return found
