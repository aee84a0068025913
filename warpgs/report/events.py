"""Event log of a fit: one JSON object per line of metrics.jsonl, appended during the fit."""

from __future__ import annotations

import io
import json
import math
import os
from pathlib import Path
from typing import BinaryIO

from warpgs import schema
from warpgs.errors import DataError, ResourceError
from warpgs.files import appending, write_bytes
from warpgs.input_files import read_input, unread_reason
from warpgs.output_folders import RefusedError

MAX_BYTES = 2**30
"""Largest log that is read [bytes]: a million steps take a third of it."""

_SERIES = schema.mapping(schema.or_null(schema.real))
_STEP = schema.fields({"step": schema.whole(0)})


class EventLog:
    """A log to which events are appended; a resumed fit first drops the events after its checkpoint.

    The log is the only file of a run that is not replaced as a whole: lines are appended. After a kill only the last line can
    be incomplete; readers skip this line, and a resumed fit drops it.
    """

    _file: BinaryIO | None = None

    def __init__(self, path: Path, step: int = 0):
        """Open the log of a fit that has done ``step`` steps, and drop the events of later steps; 0 empties the log.

        Raises:
            ResourceError: The file cannot be written.
        """
        self.path = Path(path)
        self.rewind(step)

    def rewind(self, step: int) -> None:
        """Drop the events of all steps after ``step``; 0 empties the log.

        Raises:
            ResourceError: The file cannot be written.
        """
        if self._file is not None:
            self.close()
        try:
            kept = [e for e in read_events(self.path) if e["step"] <= step] if step and self.path.is_file() else []
            # The old log stays until the shortened one is on the disk.
            write_bytes(self.path, *(_line(e) for e in kept))
            self._file = appending(self.path)
        except OSError as e:
            raise self._failure(e) from e

    def write(self, *, step: int, **values: object) -> None:
        """Append the event of one step; NaN and infinity become null.

        Raises:
            ResourceError: The file cannot be written.
        """
        try:
            self._file.write(_line({"step": step, **values}))
        except OSError as e:
            raise self._failure(e) from e

    def flush(self) -> None:
        """Flush the log and sync it to the disk, so that it never lags behind a checkpoint.

        Raises:
            ResourceError: The file cannot be written.
        """
        try:
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as e:
            raise self._failure(e) from e

    def close(self) -> None:
        """Flush and close the log, which takes no further events."""
        try:
            self._file.close()
        except OSError as e:
            raise self._failure(e) from e

    def _failure(self, error: OSError) -> ResourceError:
        if isinstance(error, RefusedError):
            return ResourceError(f"{self.path}: cannot be written, as {error}")
        return ResourceError(f"{self.path}: cannot be written ({error.strerror or error}). Free some disk space")


def read_events(path: Path) -> list[dict]:
    """Return all events of a log in file order.

    A line that is not an object of numbers with an integer ``step`` is skipped, because a killed run may leave an incomplete
    last line. Null is read as NaN, so that a series has a number at every step.

    Raises:
        DataError: The log cannot be read, or is larger than `MAX_BYTES`.
    """
    events = []
    try:
        data = read_input(path, MAX_BYTES, path.parent)
    except OSError as e:
        raise DataError(f"{path}: cannot be read ({unread_reason(e)}); restore it, or fit again") from e
    for line in io.BytesIO(data):
        try:
            event = schema.parse(line)
            _SERIES(event, "")
            _STEP(event, "")
        except schema.SchemaError:
            continue
        events.append({k: math.nan if v is None else v for k, v in event.items()})
    return events


def _line(event: dict) -> bytes:
    """Return an event as a line; numbers that are not finite become null, because JSON cannot hold them."""
    plain = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in event.items()}
    return (json.dumps(plain, allow_nan=False) + "\n").encode()
