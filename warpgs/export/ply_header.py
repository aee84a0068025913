"""Headers of binary PLY files: elements, their properties, and comments that declare antialiasing."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

from warpgs.errors import DataError

MAX_HEADER_BYTES = 65536
"""Largest accepted header [bytes]; real headers have some two thousand."""
REMEDY = "Export the model again with warpgs, or with any tool that writes the binary layout of the INRIA 3DGS code."

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "<i2",
    "int16": "<i2",
    "ushort": "<u2",
    "uint16": "<u2",
    "int": "<i4",
    "int32": "<i4",
    "uint": "<u4",
    "uint32": "<u4",
    "float": "<f4",
    "float32": "<f4",
    "double": "<f8",
    "float64": "<f8",
}


@dataclass
class Element:
    """One element of a PLY header."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    """Pairs (name, numpy type) in file order."""
    has_list: bool = False
    """True where a property is a list, so that rows differ in length."""


def mode_comments(antialiased: bool) -> tuple[str, str]:
    """Return the comments of Brush and Postshot that declare antialiasing."""
    return f"comment SplatRenderMode: {'mip' if antialiased else 'default'}", f"comment antialiased {int(antialiased)}"


def is_antialiased(head: bytes) -> bool:
    """Return whether a parsed header declares antialiasing; the last such comment decides."""
    found = False
    for line in head.partition(b"end_header")[0].decode("ascii").lower().replace(":", " ").splitlines():
        match line.split():
            case ["comment", "splatrendermode", mode]:
                found = mode == "mip"
            case ["comment", "antialiased", value]:
                found = value in ("1", "true")
    return found


def ply_error(path: Path, what: str) -> DataError:
    """Return a DataError about a malformed file, with the remedy."""
    return DataError(f"{path}: not a usable Gaussian PLY file: {what}. {REMEDY}")


def parse_header(path: Path, head: bytes) -> tuple[list[Element], int]:
    """Return the elements of the header in the first bytes of a file, and the offset [bytes] of the data behind it."""
    if not re.match(rb"ply\r?\n", head):
        raise ply_error(path, "it does not start with 'ply'")
    end = re.search(rb"^end_header\r?\n", head, re.MULTILINE)
    if end is None:
        raise ply_error(path, f"no 'end_header' line within the first {MAX_HEADER_BYTES} bytes")
    try:
        lines = head[: end.start()].decode("ascii").splitlines()[1:]
    except UnicodeDecodeError as e:
        raise ply_error(path, f"byte {e.start} of the header is not ASCII") from e

    elements: list[Element] = []
    formats = []
    for line in lines:
        match line.split():
            case ["comment", *words]:
                _check_comment(path, words)
            case [] | ["obj_info", *_]:
                pass
            case ["format", *words]:
                formats.append(" ".join(words))
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,18}", count):
                elements.append(Element(name, int(count)))
            case ["property", "list", count, item, _] if elements and count in _TYPES and item in _TYPES:
                elements[-1].has_list = True
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append((name, _TYPES[kind]))
            case _:
                raise ply_error(path, f"header line {line[:80]!r} is invalid")
    if formats != ["binary_little_endian 1.0"]:
        raise ply_error(path, f"its format is {' and '.join(formats)[:80] or 'not given'}, not binary_little_endian 1.0")
    return elements, end.end()


def _check_comment(path: Path, words: list[str]) -> None:
    """Raise a DataError where a comment names an unsupported render mode."""
    text = " ".join(words).lower().replace(":", " ").split()
    match text:
        case ["splatrendermode", mode] if mode not in ("default", "mip"):
            raise DataError(
                f"{path}: its Gaussians need the render mode {mode[:40]!r}, which is not supported. Train or export them in "
                "the mode 'default' or 'mip'."
            )
