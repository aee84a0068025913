"""Docstrings of dataclass fields, which Python itself does not keep."""

import ast
import dataclasses
import inspect
import itertools
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
        try:
            source = inspect.getsource(cls)
        except OSError:  # a class typed into an interpreter has no source
            continue
        (tree,) = ast.parse(textwrap.dedent(source)).body
        for statement, after in itertools.pairwise(tree.body if isinstance(tree, ast.ClassDef) else []):
            match statement, after:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str() as text)):
                    docs[name] = " ".join(text.split())
    return docs


def document_fields(kind: Kind) -> Kind:
    """Add the docstrings of a dataclass's fields to the docstring of the class, for ``help``; return the class."""
    wrap = textwrap.TextWrapper(HELP_WIDTH, initial_indent="    ", subsequent_indent=" " * 8, break_on_hyphens=False)
    lines = [wrap.fill(f"{name}: {text}") for name, text in field_docs(kind).items()]
    kind.__doc__ = "\n".join([f"{inspect.cleandoc(kind.__doc__ or '')}\n", "Attributes:", *lines])
    return kind
