"""Errors with their exit codes, and the words that help: the nearest name, the documentation of a field."""

import ast
import contextlib
import dataclasses
import difflib
import functools
import inspect
import itertools
import os
import sys
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

MOST_LETTERS = 4000
"""Longest error or note: a text of an untrusted file that it quotes may be as long as the file."""
Text = TypeVar("Text", bound=str)


def shortened(text: Text) -> Text:
    """Return an error or a note with the middle left out if it is too long; the fix, at its end, stays."""
    if len(text) <= MOST_LETTERS:
        return text
    half = MOST_LETTERS // 2
    return type(text)(f"{text[:half]} [{len(text) - 2 * half:,} letters left out] {text[-half:]}")


class WarpgsError(Exception):
    """Base of every error shown to a user without a traceback.

    A message names the problem, the place, the reason and the fix.
    """

    exit_code = 5
    """Exit code of `warpgs` after this error."""

    def __init__(self, message: object = "", *more: object):
        """Take a message; a long one is `shortened`."""
        super().__init__(shortened(message) if isinstance(message, str) else message, *more)


class UsageError(WarpgsError):
    """A flag or an argument that cannot be used as given."""

    exit_code = 2


class DataError(WarpgsError):
    """An invalid scene, image, model file or run folder."""

    exit_code = 3


class NotFiniteError(WarpgsError):
    """A non-finite loss or parameter of a fit."""

    view: int | None = None
    """Number of the training view with a non-finite loss; None if another value is not finite."""
    slot: int = 0
    """Index of the view ``view`` among the views of the step."""


class ResourceError(WarpgsError):
    """Too little memory or disk space, a missing device or package, or a folder that cannot be written."""

    exit_code = 4


class FolderHeldError(ResourceError):
    """A folder that another process is writing into."""


class OutOfMemoryError(ResourceError):
    """A step of a fit that needed more memory than the device had."""

    def __init__(self, message: str, intact: bool):
        """Take a message, and whether the fit's state is ``intact``: unchanged by the step."""
        super().__init__(message)
        self.intact = intact


class MalformedError(ValueError):
    """Invalid content of a file, in words that the function that opened the file completes with its path and the fix."""


def expect(condition: object, what: str) -> None:
    """Raise a `MalformedError` unless a condition holds; ``what`` is wrong with the content otherwise."""
    if not condition:
        raise MalformedError(what)


Kinds = type[Exception] | tuple[type[Exception], ...]


@contextlib.contextmanager
def explained(what: str, fix: str, errors: Kinds = OSError, kind: type[WarpgsError] = DataError) -> Iterator[None]:
    """Turn errors of the block into one that says what is wrong, why in brackets, and the fix."""
    try:
        yield
    except errors as e:
        why = getattr(e, "strerror", None) or next(iter(str(e).splitlines()), type(e).__name__)
        at = f"{e.filename}: " if isinstance(e, OSError) and e.filename and str(e.filename) not in what else ""
        raise kind(f"{what} ({at}{why}); {fix}") from e


def listed(names: Sequence[object], most: int = 100) -> str:
    """Return names for a message: all of them, or the first of very many."""
    return ", ".join(map(str, names[:most])) + (f" and {len(names) - most} more" if len(names) > most else "")


MAX_COMPARED = 60
"""Letters of a mistyped name that are compared."""


def did_you_mean(word: str, known: Iterable[str], least: float = 0.6) -> str:
    """Return "did you mean ...?" for the nearest of the ``known`` names; empty if none has the ``least`` likeness, 0 to 1."""
    plain = {name.lstrip("-"): name for name in known}  # dashes would make all short flags alike
    near = difflib.get_close_matches(word.lstrip("-")[:MAX_COMPARED], plain, 1, least)
    return f"did you mean {plain[near[0]]}?" if near else ""


def similar_folder(path: Path) -> str:
    """Return `did_you_mean` for the name of a missing folder among the folders beside it."""
    with contextlib.suppress(OSError):  # without the folder around it there is nothing to suggest
        with os.scandir(path.parent) as entries:
            return did_you_mean(path.name, [e.name for e in entries if e.is_dir()])
    return ""


def install_extras(*names: str) -> str:
    """Return the words on how to install extras by name; warpgs is on no package index."""
    extras = f"[{','.join(names)}]"
    return f"`pip install '.{extras}'` in your copy of the repository, or add {extras} to the path of the wheel"


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
