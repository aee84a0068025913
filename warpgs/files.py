"""Writing of files so that nothing is lost: a new file appears whole or not at all."""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path

from warpgs.errors import ResourceError


def write_bytes(path: Path, *chunks: bytes | memoryview) -> None:
    """Replace a file by chunks of bytes, once all of them are on disk.

    Raises:
        ResourceError: The disk is full or the folder not writable; what was there before is untouched.
    """
    temporary = path.with_name(f"{path.name}.tmp.{os.getpid()}.{threading.get_ident()}")
    try:
        with temporary.open("wb") as f:
            for chunk in chunks:
                f.write(chunk)
            f.flush()
            os.fsync(f.fileno())
        temporary.replace(path)
    except OSError as e:
        temporary.unlink(missing_ok=True)
        raise ResourceError(
            f"{path}: {sum(map(len, chunks)) / 2**20:.1f} MiB could not be written ({e.strerror}); what was there before is "
            "untouched. Free some disk space, or write elsewhere"
        ) from e


def write_text(path: Path, text: str) -> None:
    """Replace a text file (UTF-8) as `write_bytes` does."""
    write_bytes(path, text.encode())


def write_json(path: Path, values: object) -> None:
    """Replace a JSON file as `write_bytes` does; NaN and infinity become null, which JSON can hold."""
    write_text(path, json.dumps(plain(values), indent=1) + "\n")


def plain(value: object) -> object:
    """Return a value that JSON can hold: tuples become lists, NaN and infinity null."""
    if isinstance(value, float) and not (value - value == 0):
        return None
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return value
