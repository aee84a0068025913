"""Parts that plug in: classes found by name, built-in or a user's own."""

import contextlib
import functools
import hashlib
import importlib
import importlib.util
import os
import pkgutil
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from warpgs.errors import DataError, UsageError, WarpgsError
from warpgs.files import input_digest


class Named(Protocol):
    """A class that carries the name by which it is found."""

    name: ClassVar[str]


T = TypeVar("T", bound=Named)


class Registry(Generic[T]):
    """Classes of one kind by name.

    Built-in classes are in the modules of a package; looking up a name imports them all. So a new class needs only a new
    file. A user's own class is passed in Python, or as ``module:Class`` or ``path/to/file.py:Class`` on the command line. A
    name in a stored file never causes an import.
    """

    def __init__(self, kind: str, base: type[T], *packages: str):
        """Start without classes; ``packages`` are dotted names of packages or modules of the built-in ones."""
        self.kind, self.base, self.packages = kind, base, packages
        self._classes: dict[str, type[T]] = {}
        self._searched = False

    def register(self, name: str) -> Callable[[type[T]], type[T]]:
        """Return a decorator that registers a class by a name and sets its ``name``."""

        def decorate(cls: type[T]) -> type[T]:
            if (before := self._classes.get(name)) is not None and is_ours(before) and not is_ours(cls):
                raise UsageError(f"{cls.__name__}: {name!r} is a {self.kind} of warpgs; register yours under another name")
            cls.name = name
            self._classes[name] = cls
            return cls

        return decorate

    def names(self) -> list[str]:
        """Return the names of the registered classes, sorted; names of the form ``module:Class`` are left out."""
        if not self._searched:
            for name in self.packages:
                for module in pkgutil.iter_modules(getattr(importlib.import_module(name), "__path__", [])):
                    importlib.import_module(f"{name}.{module.name}")
            self._searched = True
        return sorted(n for n in self._classes if ":" not in n)

    def name_of(self, cls: type[T]) -> str:
        """Return the name of a class; a class without a name is registered as ``module:Class``."""
        self._checked(cls, cls.__name__)
        return cls.name if self.has(cls) else self.register(f"{cls.__module__}:{cls.__qualname__}")(cls).name

    def described(self) -> dict[str, str]:
        """Return a line about each class of `names`: its ``description``, or the first sentence of its docstring."""
        return {name: _line_about(self._classes[name]) for name in self.names()}

    def knows(self, name: str) -> bool:
        """Return whether `find` accepts a name: one without a colon, or the name of a user's class that was loaded."""
        return ":" not in name or name in self._classes

    def has(self, cls: type) -> bool:
        """Return whether a class itself, not only a base of it, is registered by its ``name``."""
        return self._classes.get(getattr(cls, "name", "")) is cls

    def unnamed(self, cls: type) -> str:
        """Return the message on a class that is not registered by its ``name``; its file may have been loaded twice."""
        how = f'@warpgs.{_FACES.get(self.kind, "train")}.register_{self.kind.replace(" ", "_")}("name")'
        return f"the {self.kind} {cls.__qualname__} has no registered name; write {how} above it, or name it as module:Class"

    def find(self, name: str | type[T]) -> type[T]:
        """Return the class of a name, or the class itself."""
        if isinstance(name, type):
            return self._checked(name, name.__name__)
        if name in self._classes or name in self.names():
            return self._classes[name]
        if isinstance(name, str) and ":" in name:
            raise UsageError(f"{self.kind} {name!r}: a file does not load your code; name it by flag, .py preset or in Python")
        more = "import the file that registers it first, in Python" if self.kind == "camera model" else "give module:Class"
        raise UsageError(f"unknown {self.kind} {name!r}; choose one of {', '.join(self.names())}, or {more}")

    def load(self, spec: str) -> type[T]:
        """Return the class of a name; ``module:Class`` or ``path/to/file.py:Class`` is imported, which runs its code."""
        if ":" not in spec or spec in self._classes:
            return self.find(spec)
        cls = self._checked(load_object(self.kind, spec), spec)
        self._classes[spec] = cls
        cls.name = spec
        return cls

    def _checked(self, cls: object, name: str) -> type[T]:
        if not (isinstance(cls, type) and issubclass(cls, self.base)):
            raise UsageError(f"{name} is not a {self.kind}: it must be a class that derives from warpgs.{self.base.__name__}")
        return cls


_FACES = {"camera model": "kernels", "reader": "io", "format": "export"}
"""Face of the decorator of each kind; for all others `warpgs.train`."""
_PREFIX = "_warpgs_"
"""Start of the names of modules that were loaded by their path."""
LOADED: set[str] = set()
"""Names of the modules that users' own classes were loaded from."""


def load_object(kind: str, spec: str) -> object:
    """Import ``module:NAME`` or ``path/to/file.py:NAME``, which runs its code; return the object.

    An error in that code becomes one that names the ``kind`` and ``spec`` of the object, and the line.
    """
    where, _, name = spec.rpartition(":")
    try:
        module = module_of(where)
    except WarpgsError:
        raise
    except (ImportError, OSError) as e:
        advice = f"give path/to/file.py:{name or 'NAME'}"
        if where.endswith(".py") and isinstance(e, ModuleNotFoundError) and e.name:
            path = Path(where).absolute()
            if path.with_name(f"{e.name}.py").is_file():
                advice = f"set PYTHONPATH={path.parent} and give {path.stem}:{name or 'NAME'}, or use one file"
        raise UsageError(f"the {kind} {spec!r} cannot be imported ({e}); {advice}") from e
    except Exception as e:  # whatever a user's module raises
        what, at = (e.msg, e) if isinstance(e, SyntaxError) else (e, traceback.extract_tb(e.__traceback__)[-1])
        why = f"{type(e).__name__}: {what} ({at.filename}, line {at.lineno})"
        raise UsageError(f"the {kind} {spec!r} cannot be loaded: {why}; correct that code, or omit the {kind}") from e
    if not hasattr(module, name):
        raise UsageError(f"the {kind} {spec!r} does not exist: {where} does not define {name}; give a name that it defines")
    LOADED.add(module.__name__)
    return getattr(module, name)


def own_code(classes: Iterable[type]) -> dict[str, str]:
    """Return the SHA-256 of the source file of each class from outside warpgs, by its registered name."""
    digests = {
        str(getattr(c, "name", c.__qualname__)): module_digest(sys.modules.get(c.__module__)) for c in classes if not is_ours(c)
    }
    return {name: digest for name, digest in sorted(digests.items()) if digest}


def own_places(classes: Iterable[type]) -> list[str]:
    """Return where `module_of` finds the modules of classes from outside warpgs; the running script is left out."""
    modules = {c.__module__ for c in classes if not is_ours(c)} - {"__main__"}
    files = {m: getattr(sys.modules.get(m), "__file__", None) if m.startswith(_PREFIX) else m for m in modules}
    return sorted(str(place) for place in files.values() if place)


@functools.cache
def module_digest(module: ModuleType | None) -> str:
    """Return the SHA-256 of the file of a module, read at the first call because it may be edited later; empty without one."""
    path = getattr(module, "__file__", None)
    with contextlib.suppress(DataError):  # a module of an archive, or one that is gone since
        return input_digest(path) if path else ""
    return ""


def is_ours(cls: type) -> bool:
    """Return whether a class belongs to warpgs, not to the user."""
    return cls.__module__.startswith("warpgs.")


def returned(
    plugin: object, method: str, value: Any, kind: Any, what: str, *, each: Any = object, shape: Iterable[int] | None = None,
    names: Iterable[str] | None = None,
) -> Any:  # fmt: skip
    """Return what a method of a plug-in returned; UsageError that names class and method if it is wrong.

    ``what`` is the type in words. ``shape`` is that of a tensor, or the first axes of the tensors of a mapping, whose values
    are of type ``each``; ``names`` are the names that a mapping may have.
    """
    wrong, wanted = "", None if shape is None else tuple(shape)
    size = tuple(getattr(value, "shape", wanted or ()))
    if not isinstance(value, kind):
        wrong = type(value).__name__
    elif isinstance(value, Mapping):
        for n, v in value.items():
            if not isinstance(n, str) or (names is not None and n not in names):
                wrong = f"the name {n!r}"
            elif not isinstance(v, each):
                wrong = f"{type(v).__name__} for {n!r}"
            elif wanted is not None and tuple(v.shape[: len(wanted)]) != wanted:
                wrong = f"shape {list(v.shape)} for {n!r}"
    elif wanted is not None and size != wanted:
        wrong = f"shape {list(size)}"
    if wrong:
        raise UsageError(f"{type(plugin).__name__}.{method} must return {what}; it returned {wrong}. Correct the class")
    return value


def _line_about(cls: type) -> str:
    if text := getattr(cls, "description", ""):
        return str(text)
    text = cls.__dict__.get("__doc__") or ""
    if text.startswith(f"{cls.__name__}("):  # the docstring that a dataclass gets by default
        return ""
    return re.split(r"(?<!\bal)\.(?: |$)", " ".join(text.split("\n\n")[0].split()))[0]


def flag_group(name: str) -> str:
    """Return the group name of the flags of a plug-in's settings: ``my_strategy`` for ``my.module:MyStrategy``."""
    return re.sub(r"\W", "_", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.rpartition(":")[2])).lower()


def own_frame(error: BaseException) -> str:
    """Return file and line of the last frame of a user's own code in an error's traceback; empty if it has no such frame."""
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        if frame.f_globals.get("__name__") in LOADED:
            place = f"{frame.f_code.co_filename}, line {line}"
    return place


def module_of(where: str) -> ModuleType:
    """Import the module of a dotted name, or the .py file of a path, which runs its code; return the module."""
    if where.endswith(".py"):
        return _load_file(Path(where))
    if not where or where.startswith("."):
        raise ImportError(f"{where!r} is not a full module name")
    return importlib.import_module(where)


def _load_file(path: Path) -> ModuleType:
    """Import a file by its path, once, under a name of its own."""
    path = Path(os.path.realpath(path))  # Path.resolve raises a RuntimeError on circular links
    name = f"{_PREFIX}{path.stem}_{hashlib.sha256(os.fsencode(path)).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None or not path.is_file():
        raise OSError(f"there is no file {path}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
