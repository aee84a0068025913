"""Docstrings of dataclass fields, which Python itself does not keep."""

import ast
import dataclasses
import functools
import inspect
import itertools
import sys
import textwrap
from typing import TypeVar

Kind = TypeVar("Kind", bound=type)

HELP_WIDTH = 76
"""Width of a line, to which ``help`` adds a margin of four characters."""


def field_docs(kind: type) -> dict[str, str]:
    """Return the docstrings of a dataclass's fields by name, each on one line, including the fields of its bases."""
    docs: dict[str, str] = {}
    for cls in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(cls):
            continue
        for statement, after in itertools.pairwise(_statements_of(cls)):
            match statement, after:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str() as text)):
                    docs[name] = " ".join(text.split())
    return docs


def _statements_of(cls: type) -> list[ast.stmt]:
    """Return the statements of a class; none without source, as for a class typed into an interpreter."""
    try:
        named = [c for c in _classes_in(inspect.getsource(sys.modules[cls.__module__])) if c.name == cls.__qualname__]
        if len(named) == 1:  # the file is parsed once; inspect.getsource(cls) would parse it for every class
            return named[0].body
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    except (OSError, TypeError, KeyError):
        return []
    return tree.body if isinstance(tree, ast.ClassDef) else []


@functools.lru_cache(maxsize=1)
def _classes_in(source: str) -> list[ast.ClassDef]:
    """Return the classes at the top level of a file's source."""
    return [statement for statement in ast.parse(source).body if isinstance(statement, ast.ClassDef)]


def document_fields(kind: Kind) -> Kind:
    """Add the docstrings of a dataclass's fields to the docstring of the class, for ``help``; return the class."""
    wrap = textwrap.TextWrapper(HELP_WIDTH, initial_indent="    ", subsequent_indent=" " * 8, break_on_hyphens=False)
    lines = [wrap.fill(f"{name}: {text}") for name, text in field_docs(kind).items()]
    kind.__doc__ = "\n".join([f"{inspect.cleandoc(kind.__doc__ or '')}\n", "Attributes:", *lines])
    return kind
