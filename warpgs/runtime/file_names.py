"""File names that are not UTF-8: Linux allows any bytes in a name, and Python stores undecodable bytes as surrogates.

Python opens such files. Libraries that expect UTF-8 fail on such names, and some end the process.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from warpgs.errors import UsageError
from warpgs.files import DESCRIPTORS, readable
from warpgs.runtime.terminal import say


def is_utf8(text: str) -> bool:
    """Return whether text can be written as UTF-8."""
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True


def use_utf8_names() -> None:
    """Start this program again in Python's UTF-8 mode, with a note, if Python reads file names in another encoding.

    File names in scene files are UTF-8. Under LC_ALL=C with PYTHONUTF8=0, or in a locale of another encoding, Python cannot
    open them.
    """
    encoding = sys.getfilesystemencoding()
    if sys.platform == "win32" or sys.flags.utf8_mode or encoding.lower().replace("-", "") == "utf8":
        return
    say(f"warpgs: this locale reads file names as {encoding}; started again in Python's UTF-8 mode (PYTHONUTF8=1)", error=True)
    os.environ["PYTHONUTF8"] = "1"  # for processes that this one starts
    if sys.stdout is not None:  # letters that the terminal lacks are still printed as codes
        os.environ.setdefault("PYTHONIOENCODING", f"{sys.stdout.encoding}:backslashreplace")
    # the options of the interpreter, -P and -I among them, are part of orig_argv
    os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])


@contextlib.contextmanager
def utf8_name(path: Path) -> Iterator[str]:
    """Give a UTF-8 path to a file: its own path if possible, else one through a descriptor of its open folder or of the file.

    Args:
        path: The file. A file to be written must have a UTF-8 name; its folder need not.

    Raises:
        UsageError: The name is not UTF-8, and this system has no other path to the file.
    """
    if is_utf8(str(path)):
        yield str(path)
        return
    by_folder = is_utf8(path.name)
    if not DESCRIPTORS.is_dir():
        raise UsageError(f"{readable(str(path))}: the name is not UTF-8, which is needed here; rename the file or its folder")
    descriptor = os.open(path.parent if by_folder else path, os.O_RDONLY)
    try:
        yield f"{DESCRIPTORS}/{descriptor}/{path.name}" if by_folder else f"{DESCRIPTORS}/{descriptor}"
    finally:
        os.close(descriptor)
