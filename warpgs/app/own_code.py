"""Loading of the user's own code that a command line names."""

import traceback
from collections.abc import Callable
from typing import TypeVar

from warpgs.errors import UsageError, WarpgsError

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
