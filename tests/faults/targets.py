"""Registry of readers under test: what a reader reads, what may be changed in it, and what it must never return."""

from __future__ import annotations

import importlib
import inspect
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.faults.mutations import Change


@dataclass(frozen=True)
class Target:
    """A reader of foreign files."""

    name: str
    prepare: Callable[[Path], list[Path]]
    """Write valid files to a folder and return those to change, one at a time."""
    read: Callable[[Path, Path], object]
    """Read, from the folder and the changed file, and return what was read; None where a reader passes a file over."""
    parser: tuple[object, ...]
    """Modules, functions and classes whose lines count as the parser's."""
    changes: tuple[Change, ...] = ()
    """Changes that know the format; plain damage comes by itself."""
    repair: Callable[[bytes], bytes] | None = None
    """Makes checksums right, so that changes get past them."""
    nonsense: Callable[[object], str] = lambda result: ""
    """Says what of a result is nonsense; empty where nothing is."""
    unexplained: Callable[[bytes, bytes, object, object], str] = lambda before, after, good, found: ""
    """Says what of a result plain damage does not explain: bytes before and after, results of both; empty where nothing."""
    lines: float = 0.9
    """Share of the parser's lines that many inputs must reach: less where lines wait for what no file can bring about."""
    own_process: bool = False
    """Whether a process of its own does the reading in warpgs: then an input that ends the process is refused, not a defect."""
    share: float = 1.0
    """Number of inputs relative to other readers: less than 1 for slow ones."""


MODULES = (
    "format_targets", "image_targets", "model_targets", "photo_targets", "record_targets", "scene_targets", "viewer_targets",
)  # fmt: skip
"""Modules of this folder that register readers."""
TARGETS: dict[str, Target] = {}


def register(target: Target) -> Target:
    assert target.name not in TARGETS
    TARGETS[target.name] = target
    return target


def all_targets() -> dict[str, Target]:
    for name in MODULES:
        importlib.import_module(f"tests.faults.{name}")
    return TARGETS


def codes_of(thing: object) -> Iterator[types.CodeType]:
    """Yield the code of a module's, class's or function's own functions."""
    if isinstance(thing, types.ModuleType):
        own = (v for v in vars(thing).values() if getattr(v, "__module__", None) == thing.__name__)
        for value in own:
            yield from codes_of(value)
    elif isinstance(thing, type):
        for value in vars(thing).values():
            yield from codes_of(getattr(value, "__func__", getattr(value, "fget", value)))
    elif callable(thing) and hasattr(inner := getattr(thing, "__wrapped__", thing), "__code__"):
        yield inner.__code__
    elif isinstance(thing, types.CodeType):
        yield thing


def parser_lines(target: Target) -> dict[str, set[int]]:
    """Return the numbers of the lines that can run in a reader's parser, by file."""
    lines: dict[str, set[int]] = {}
    names = {inspect.getfile(inspect.unwrap(p)) for p in target.parser}
    stack = [code for part in target.parser for code in codes_of(part)]
    while stack:
        code = stack.pop()
        stack += [c for c in code.co_consts if isinstance(c, types.CodeType)]
        if code.co_filename not in names:  # generated, as of dataclasses
            continue
        found = {line for _, _, line in code.co_lines() if line is not None}
        lines.setdefault(code.co_filename, set()).update(found - {code.co_firstlineno} if len(found) > 1 else found)
    return lines


def writing(files: dict[str, bytes]) -> Callable[[Path], list[Path]]:
    """Return a function that writes files of these names to a folder, and returns their paths."""

    def prepare(root: Path) -> list[Path]:
        for name, data in files.items():
            (root / name).write_bytes(data)
        return [root / name for name in files]

    return prepare


def not_finite(**arrays: np.ndarray | None) -> str:
    return ", ".join(f"{n} not finite" for n, a in arrays.items() if a is not None and not np.isfinite(a).all())
