"""Classes that plug in by name: built-in ones found in a package, a user's own given in Python or as ``module:Class``."""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Callable
from typing import Generic, TypeVar

from warpgs.errors import UsageError

T = TypeVar("T")


class Registry(Generic[T]):
    """Named subclasses of one base class, found by importing every module of a package.

    A registered class gets its name as the attribute ``name``.
    """

    def __init__(self, base: type[T], package: str, kind: str):
        """Make an empty registry.

        Args:
            base: Class that every member derives from.
            package: Dotted name of the package whose modules register the built-in members.
            kind: Noun for the members in messages, such as ``reader``.
        """
        self.base, self.package, self.kind = base, package, kind
        self._classes: dict[str, type[T]] = {}
        self._discovered = False

    def register(self, name: str) -> Callable[[type[T]], type[T]]:
        """Return a class decorator that adds a class under ``name``.

        Raises:
            ValueError: Another class has that name, the name holds a colon, or the class does not derive from the base.
        """

        def add(cls: type[T]) -> type[T]:
            if ":" in name or not issubclass(cls, self.base):
                raise ValueError(f"{self.kind} {name!r}: needs a name without a colon and a subclass of {self.base.__name__}")
            known = self._classes.get(name, cls)
            if (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
                raise ValueError(
                    f"{self.kind} {name!r} is already {known.__module__}:{known.__qualname__}; choose another name"
                )
            cls.name = name
            self._classes[name] = cls
            return cls

        return add

    def classes(self) -> dict[str, type[T]]:
        """Return all registered classes by name; the first call imports the modules of the package."""
        if not self._discovered:
            for module in pkgutil.iter_modules(importlib.import_module(self.package).__path__):
                importlib.import_module(f"{self.package}.{module.name}")
            self._discovered = True
        return dict(self._classes)

    def find(self, choice: str | type[T]) -> type[T]:
        """Return the class that a registered name, ``module:Class`` or a class itself stands for.

        A module is imported by its name alone: its folder must be on the import path (PYTHONPATH). Never pass a string that
        comes from a file of others, because importing a module runs it.

        Raises:
            UsageError: There is no such name, module or class, or the class does not derive from the base.
        """
        if not isinstance(choice, str):
            return self._derived(choice, repr(choice))
        if ":" not in choice:
            classes = self.classes()
            if choice not in classes:
                names = ", ".join(sorted(classes))
                raise UsageError(f"{self.kind} {choice!r} is unknown; use one of {names}, or name your own as module:Class")
            return classes[choice]
        match = re.fullmatch(r"(\w+(?:\.\w+)*):(\w+)", choice)
        if match is None:
            raise UsageError(f"{self.kind} {choice!r} is not of the form module:Class; write for example my_module:MyClass")
        try:
            module = importlib.import_module(match[1])
        except ImportError as e:
            raise UsageError(
                f"{self.kind} {choice!r}: the module cannot be imported ({e}); put its folder on the import path, for example "
                "PYTHONPATH=FOLDER"
            ) from e
        if not hasattr(module, match[2]):
            raise UsageError(f"{self.kind} {choice!r}: {module.__file__} has no {match[2]}; check the spelling")
        return self._derived(getattr(module, match[2]), repr(choice))

    def _derived(self, cls: object, shown: str) -> type[T]:
        if isinstance(cls, type) and issubclass(cls, self.base):
            return cls
        raise UsageError(
            f"{self.kind} {shown} is not a class derived from {self.base.__module__}.{self.base.__qualname__}; derive it from "
            "that class"
        )
