"""The interface of a file format of Gaussians, and the formats by name.

One module of `warpgs.export` holds one format and registers it. A format of your own is one class in one file, named as
``module:Class`` or ``path/to/file.py:Class``.
"""

from __future__ import annotations

import io
import os
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from warpgs.coordinates import checked_normalization, convert_gaussians
from warpgs.errors import DataError, UsageError
from warpgs.export.arrays import Arrays, arrays_of, check_finite, gaussians_of, malformed
from warpgs.files import write_bytes
from warpgs.input_files import open_input, read_input, unread_reason
from warpgs.plugins import Registry
from warpgs.scene import Gaussians, Normalization

BROKEN = (
    struct.error, zlib.error, zipfile.BadZipFile, EOFError, ValueError, KeyError, TypeError, IndexError, OverflowError,
    NotImplementedError, RecursionError, RuntimeError, OSError,
)  # fmt: skip
"""Errors of decoders (standard library, zstandard, our own) about invalid content: zipfile reports encryption as RuntimeError,
unknown methods as NotImplementedError, and seeks before the start as OSError."""


class Format:
    """A file format of Gaussians. To add a format, derive a class that defines `encode`, `decode` or both."""

    name: ClassVar[str] = ""
    """Name in the registry."""
    suffix: ClassVar[str] = ""
    """Suffix of file names in lower case, with the dot, such as ``.spz``."""
    description: ClassVar[str] = ""
    """One line about the format, for the help."""
    Config: ClassVar[type | None] = None
    """Frozen dataclass of the options for writing, which become flags, grouped under the format's name; None for no options."""
    cleaned: ClassVar[bool] = True
    """True to remove floaters and needles by default."""
    sorted: ClassVar[bool] = False
    """True to sort the Gaussians along a space-filling curve, so that neighbours in space are near each other in the file."""
    archive: ClassVar[bool] = False
    """True for an archive of several files: `decode` then receives the open file instead of its bytes."""
    max_degree: ClassVar[int] = 3
    """Highest degree of spherical harmonics that the format supports."""
    note: ClassVar[str] = ""
    """Note for users on the format's axes, if programs disagree on the axes."""
    declares: ClassVar[bool] = False
    """True if a file can declare that its Gaussians are antialiased (`RasterizeOptions.antialiased`)."""

    def __init__(self, config: Any = None):
        """Take the options, an instance of ``Config``; None for their defaults."""
        self.config: Any = self.Config() if config is None and self.Config is not None else config
        """The options."""
        self.antialiased = False
        """True while an antialiased model is written."""

    def encode(self, arrays: Arrays) -> Iterable[bytes]:
        """Return the bytes of a file, in pieces.

        Args:
            arrays: The tensors of `Gaussians` by name, as finite numpy arrays: means [N, 3] and log scales [N, 3] in file
                units, quats wxyz of any length [N, 4], logit opacities [N], spherical harmonics [N, K, 3].

        Raises:
            UsageError: The format does not define `encode`.
        """
        raise UsageError(f"{self.suffix} files can be read but not written: {type(self).__name__} defines no encode")

    def decode(self, path: Path, data: Any) -> Arrays:
        """Return the arrays that `encode` takes.

        Args:
            path: The file, for messages.
            data: Bytes of the file; for an ``archive`` the open file.

        Raises:
            UsageError: The format does not define `decode`.
        """
        raise UsageError(f"{path}: {self.suffix} files can be written but not read: {type(self).__name__} defines no decode")

    def is_antialiased(self, path: Path) -> bool:
        """Return whether a file declares that its Gaussians are antialiased; False if the format cannot declare it.

        Raises:
            DataError: The file is missing or malformed.
        """
        return False

    def fits(self, path: str | os.PathLike[str]) -> bool:
        """Return whether a file name has the suffix of the format."""
        return Path(path).name.lower().endswith(self.suffix)

    def write(self, path: Path, gaussians: Gaussians, normalization: Normalization | None, units: str) -> None:
        """Write Gaussians, with the arguments of `warpgs.export.write_gaussians`.

        Raises:
            DataError: There are no Gaussians, a number is not finite or cannot be stored, or the degree is too high.
        """
        if not len(gaussians):
            raise DataError(f"{path}: not written, the model holds no Gaussian. Use .ply for an empty model")
        normalization = checked_normalization(normalization, units, f"{path}: not written")
        for g in (gaussians, convert_gaussians(gaussians, normalization, units, "file")):
            arrays = arrays_of(g)
            check_finite(path, arrays)
        if self.max_degree == 0:
            arrays["sh"] = arrays["sh"][:, :1]
        elif gaussians.sh_degree > self.max_degree:
            raise DataError(
                f"{path}: not written, {self.suffix} files hold harmonics up to degree {self.max_degree}, not "
                f"{gaussians.sh_degree}. Drop higher degrees with --sh-degree {self.max_degree}, in Python with "
                f"sh[:, :{(self.max_degree + 1) ** 2}], or write .ply"
            )
        write_bytes(path, *self.encode(arrays))

    def read(self, path: Path, normalization: Normalization | None, units: str) -> Gaussians:
        """Read Gaussians, with the arguments of `warpgs.export.read_gaussians`.

        Raises:
            DataError: The file is missing or malformed.
        """
        normalization = checked_normalization(normalization, units, str(path))
        try:
            data: BinaryIO = open_input(path) if self.archive else io.BytesIO(read_input(path))
        except OSError as e:
            raise DataError(f"{path}: cannot be read ({unread_reason(e)}). Check the path and its permissions.") from e
        try:
            with data, np.errstate(all="ignore"):  # infinities and NaN of a broken file are named below, with their Gaussian
                arrays = self.decode(path, data if self.archive else data.read())
        except BROKEN as e:
            raise malformed(path, f"its content is invalid ({type(e).__name__}: {str(e)[:80]})") from e
        return convert_gaussians(gaussians_of(path, arrays), normalization, "file", units)


def warn_of_antialiasing(path: Path) -> None:
    """Warn that the Gaussians of a file are antialiased; the warning points to the caller of the reading function."""
    warnings.warn(f"{path}: its Gaussians are antialiased; render them with RasterizeOptions(antialiased=True)", stacklevel=3)


FORMATS: Registry[Format] = Registry("format", Format, __package__)
"""File formats of Gaussians by name; those in the modules of `warpgs.export` are built in."""
register = FORMATS.register
