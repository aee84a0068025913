"""The file formats of Gaussians by suffix: how each is written and read."""

from __future__ import annotations

import io
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.coordinates import checked_normalization, convert_gaussians
from warpgs.errors import DataError, UsageError
from warpgs.export import compressed_ply, gltf, sog, splat, spz
from warpgs.export.arrays import Arrays, arrays_of, check_finite, gaussians_of, malformed
from warpgs.export.ply import read_ply, write_ply
from warpgs.files import write_bytes
from warpgs.input_files import open_input, read_input, read_start, unread_reason
from warpgs.scene import Gaussians, Normalization


@dataclass(frozen=True)
class Format:
    """A file format of Gaussians."""

    name: str
    """Name for messages."""
    encode: Callable[[Arrays], list[bytes]] | None
    """Function from arrays in file units to the bytes of a file; None for plain PLY, which is written in pieces."""
    decode: Callable[[Path, Any], Arrays] | None
    """Function from the bytes of a file, or from the open file of an archive, to arrays in file units."""
    cleaned: bool = True
    """True where exports are cleaned unless asked otherwise: the formats that strangers open."""
    sorted: bool = False
    """True where Gaussians that are near each other in space should be so in the file."""
    archive: bool = False
    """True where the file holds others, which are read one by one."""
    max_degree: int = 3
    """Highest degree of harmonics that it holds."""
    note: str = ""
    """Sentence for users on its axes, where programs disagree on them."""


_SPZ_NOTE = (
    "SPZ has y up, as Niantic defines it; SuperSplat, splat-transform 3, gsply and gaussforge take its axes for those of PLY: "
    "--rotate 1,0,0,180 turns a file from them or for them"
)
FORMATS = {
    ".compressed.ply": Format("compressed PLY", compressed_ply.encode, compressed_ply.decode, sorted=True),
    ".ply": Format("PLY", None, None, cleaned=False),
    ".splat": Format("splat", splat.encode, splat.decode, max_degree=0),
    ".spz": Format("SPZ", spz.encode, spz.decode, sorted=True, note=_SPZ_NOTE),
    ".sog": Format("SOG", sog.encode, sog.decode, sorted=True, archive=True),
    ".glb": Format("glTF (binary)", gltf.encode_glb, gltf.decode),
    ".gltf": Format("glTF (text)", gltf.encode_gltf, gltf.decode),
}
"""Formats by the end of a file's name; the longer end comes first."""

_BROKEN = (
    struct.error, zlib.error, zipfile.BadZipFile, EOFError, ValueError, KeyError, TypeError, IndexError, OverflowError,
    NotImplementedError, RecursionError, RuntimeError, OSError,
)  # fmt: skip
"""What the decoders of the standard library, zstandard and our own raise about content that makes no sense: zipfile reports
encryption as RuntimeError, methods it does not know as NotImplementedError, and seeks before the start as OSError."""


def format_of(path: str | os.PathLike[str]) -> Format:
    """Return the format that a file's name says.

    Raises:
        UsageError: The suffix is none of a format.
    """
    name = Path(path).name.lower()
    for end, kind in FORMATS.items():
        if name.endswith(end):
            return kind
    cameras = "; cameras are named cameras.json, transforms.json or sparse" if name.endswith(".json") else ""
    raise UsageError(
        f"{path}: format {Path(path).suffix or '(none)'} is not supported; use one of {', '.join(FORMATS)}{cameras}. "
        "`warpgs export` makes a page, too (.html), and `warpgs mesh` a mesh (.ply, .glb)"
    )


def write_gaussians(
    path: str | os.PathLike[str], gaussians: Gaussians, normalization: Normalization | None = None, *, units: str = "scene"
) -> None:
    """Write Gaussians to a file, in the format of its suffix and in the units of the scene's files.

    The order is kept, and the file appears whole or not at all.

    Args:
        path: The file; an existing one is replaced.
        gaussians: N >= 1 Gaussians, on any device.
        normalization: Similarity from file to scene units; needed where ``units`` is scene.
        units: Units of ``gaussians``: scene, or file for those that are to be written as they are.

    Raises:
        warpgs.errors.DataError: A tensor holds a NaN or an infinity, or a number that the format cannot hold.
        warpgs.errors.ResourceError: The folder or the disk does not take the file.
        warpgs.errors.UsageError: The suffix or the units are unknown, or scene units come without a normalization.
    """
    path, kind = Path(path), format_of(path)
    if kind.encode is None:
        write_ply(path, gaussians, normalization, units=units)
        return
    if not len(gaussians):
        raise DataError(f"{path}: not written, the model holds no Gaussian. Use .ply for an empty model")
    normalization = checked_normalization(normalization, units, f"{path}: not written")
    for g in (gaussians, convert_gaussians(gaussians, normalization, units, "file")):
        arrays = arrays_of(g)
        check_finite(path, arrays)
    if kind.max_degree == 0:
        arrays["sh"] = arrays["sh"][:, :1]
    write_bytes(path, *kind.encode(arrays))


def read_gaussians(
    path: str | os.PathLike[str], normalization: Normalization | None = None, *, units: str = "file"
) -> Gaussians:
    """Read Gaussians from a file, in the format of its suffix; a .ply file may be compressed.

    Args:
        path: The file.
        normalization: Similarity from file to scene units; needed where ``units`` is scene.
        units: Units of the result: file as stored, or scene to go with a scene's cameras.

    Returns:
        N Gaussians, torch float32 tensors on the CPU.

    Raises:
        warpgs.errors.DataError: The file is missing, malformed, cut short, announces more than its size can hold, or holds a
            NaN, an infinity or a rotation of zero length.
        warpgs.errors.UsageError: The suffix or the units are unknown, or scene units come without a normalization.
    """
    path, kind = Path(path), format_of(path)
    normalization = checked_normalization(normalization, units, str(path))
    decode = kind.decode
    try:
        if decode is None:
            if not compressed_ply.is_compressed(path, read_start(path, compressed_ply.MAX_HEADER_BYTES)):
                return read_ply(path, normalization, units=units)
            decode = compressed_ply.decode
        data = open_input(path) if kind.archive else io.BytesIO(read_input(path))
    except OSError as e:
        raise DataError(f"{path}: cannot be read ({unread_reason(e)}). Check the path and its permissions.") from e
    try:
        with data, np.errstate(all="ignore"):  # infinities and NaN of a broken file are named below, with their Gaussian
            arrays = decode(path, data if kind.archive else data.getvalue())
    except _BROKEN as e:
        raise malformed(path, f"its content makes no sense ({type(e).__name__}: {str(e)[:80]})") from e
    return convert_gaussians(gaussians_of(path, arrays), normalization, "file", units)
