"""The compressed PLY of PlayCanvas and SuperSplat: 16 bytes a Gaussian, and one more byte per harmonic and channel.

Positions (11, 10, 11 bits), log scales (11, 10, 11) and colours (8 each) are fractions between bounds, which a chunk of 256
Gaussians shares. A rotation has 2 bits for the index of its largest component, and 10 bits for each other component. The loss
is smallest if neighbours in the file are neighbours in space, so an export sorts the Gaussians (``sorted``).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from warpgs.colors import base_coefficients, base_colors
from warpgs.errors import DataError
from warpgs.export.arrays import (
    SH_SIZES,
    SQRT2,
    Arrays,
    by_rows,
    from_smallest_three,
    logits,
    malformed,
    rounded,
    sigmoid,
    smallest_three,
)
from warpgs.export.base import Format, register
from warpgs.export.ply_header import MAX_HEADER_BYTES, Element, is_antialiased, mode_comments, parse_header
from warpgs.input_files import read_start, unread_reason

CHUNK = 256
"""Number of Gaussians that share bounds."""
SH_RANGE = 8
"""Width of the range about 0 that harmonics above degree 0 are stored in."""
_GROUPS = (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
_CHUNK_NAMES = [f"{end}_{name}" for group in _GROUPS for end in ("min", "max") for name in group]
_VERTEX_NAMES = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_BITS = (11, 10, 11)


def encode(arrays: Arrays, antialiased: bool = False) -> list[bytes]:
    """Return the bytes of a file, with antialiasing declared in its header; harmonics above degree 0 are clamped to +-4."""
    n, k = arrays["sh"].shape[:2]
    chunks = np.arange(n) // CHUNK
    colors = base_colors(arrays["sh"][:, :1].astype(np.float64))
    bounds, fractions = [], []
    for values in (arrays["means"], arrays["log_scales"], colors):
        starts = np.arange(0, n, CHUNK)
        low = np.minimum.reduceat(values, starts).astype("<f4")
        high = np.maximum.reduceat(values, starts).astype("<f4")
        bounds += [low, high]
        span = high.astype(np.float64) - low
        fractions.append((values - low[chunks].astype(np.float64)) / np.where(span > 0, span, 1)[chunks])
    largest, others = smallest_three(arrays["quats"])
    position, scale = (_pack(fractions[i], _BITS) for i in (0, 1))
    rgba = np.concatenate([fractions[2], sigmoid(arrays["logit_opacities"])[:, None]], 1)
    rotation = (largest << 30) | _pack(others / SQRT2 + 0.5, (10, 10, 10))
    rows = np.stack([position, rotation, scale, _pack(rgba, (8, 8, 8, 8))], 1).astype("<u4")
    rest = arrays["sh"][:, 1:].astype(np.float64).transpose(0, 2, 1).reshape(n, -1)
    harmonics = np.clip(np.floor((rest / SH_RANGE + 0.5) * 256), 0, 255).astype("u1")
    lines = ["ply", "format binary_little_endian 1.0", *mode_comments(antialiased), f"element chunk {len(bounds[0])}"]
    lines += [f"property float {name}" for name in _CHUNK_NAMES]
    lines += [f"element vertex {n}", *(f"property uint {name}" for name in _VERTEX_NAMES)]
    if k > 1:
        lines += [f"element sh {n}", *(f"property uchar f_rest_{i}" for i in range(3 * (k - 1)))]
    header = ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")
    return [header, np.concatenate(bounds, 1).tobytes(), rows.tobytes(), harmonics.tobytes()]


def start_of(path: Path) -> bytes:
    """Return the first `MAX_HEADER_BYTES` bytes of a PLY file, or the whole file if it is shorter, and check its header.

    Raises:
        DataError: The file cannot be read, or is not a PLY file.
    """
    try:
        head = read_start(path, MAX_HEADER_BYTES)
    except OSError as e:
        raise DataError(f"{path}: cannot be read ({unread_reason(e)}). Check the path and its permissions.") from e
    parse_header(path, head)
    return head


def is_compressed(path: Path, data: bytes) -> bool:
    """Return whether the header of a .ply file announces this format; DataError if the file has no header."""
    elements, _ = parse_header(path, data[:MAX_HEADER_BYTES])
    return any(e.name == "vertex" and "packed_position" in dict(e.properties) for e in elements)


def decode(path: Path, data: bytes) -> Arrays:
    """Return the Gaussians of a file's bytes.

    Raises:
        DataError: The file is malformed or truncated, or needs an unsupported render mode.
    """
    elements, start = parse_header(path, data[:MAX_HEADER_BYTES])
    tables = {}
    for element in elements:
        if element.name in tables or element.has_list or not element.properties:
            raise malformed(path, f"its element {element.name[:40]!r} is invalid")
        tables[element.name], start = _table(path, data, element, start)
    chunk, vertex, sh = tables.get("chunk"), tables.get("vertex"), tables.get("sh")
    if chunk is None or vertex is None:
        raise malformed(path, "the element chunk or vertex is missing")
    n = len(vertex)
    if len(chunk) != -(-n // CHUNK):
        raise malformed(path, f"it has {len(chunk)} chunks, but {n} Gaussians need {-(-n // CHUNK)}")
    position, rotation, scale, color = (_column(path, vertex, name, "<u4") for name in _VERTEX_NAMES)
    bounds = [_bounds(path, chunk, group) for group in _GROUPS]

    def values(i: int, packed: np.ndarray, bits: tuple[int, ...], part: slice) -> np.ndarray:
        """Return the unpacked values of the i-th group [P, 3], scaled to the bounds of their chunks if there are bounds."""
        fractions = _unpack(packed[part].astype(np.int64), bits)[:, :3]
        if (ends := bounds[i]) is None:
            return fractions
        rows = np.arange(part.start, part.stop) // CHUNK
        return ends[0][rows] * (1 - fractions) + ends[1][rows] * fractions

    def quats(part: slice) -> np.ndarray:
        packed = rotation[part].astype(np.int64)
        return from_smallest_three(packed >> 30, (_unpack(packed & (2**30 - 1), (10, 10, 10)) - 0.5) * SQRT2)

    def harmonics(part: slice) -> np.ndarray:
        first = base_coefficients(values(2, color, (8, 8, 8, 8), part))[:, None]
        return first if rest is None else np.concatenate([first, rest(part)], 1)

    rest, k = (None, 1) if sh is None else _harmonics(path, sh, n)
    return {
        "sh": by_rows(n, (k, 3), harmonics),
        "means": by_rows(n, (3,), lambda p: values(0, position, _BITS, p)),
        "quats": by_rows(n, (4,), quats),
        "log_scales": by_rows(n, (3,), lambda p: values(1, scale, _BITS, p)),
        "logit_opacities": by_rows(n, (), lambda p: logits(_unpack(color[p].astype(np.int64), (8, 8, 8, 8))[:, 3], 1 / 255)),
    }


def _bounds(path: Path, chunk: np.ndarray, group: tuple[str, ...]) -> list[np.ndarray] | None:
    """Return the bounds of each chunk, two arrays float64 [C, 3]; None for the colours of older files, which span 0 to 1."""
    if group == _GROUPS[2] and "min_r" not in (chunk.dtype.names or ()):
        return None
    return [
        np.stack([_column(path, chunk, f"{end}_{name}", "<f4") for name in group], 1).astype(np.float64)
        for end in ("min", "max")
    ]


def _harmonics(path: Path, sh: np.ndarray, n: int) -> tuple[Callable[[slice], np.ndarray], int]:
    """Return a function for the coefficients above degree 0 [P, K - 1, 3] of some rows, and K."""
    count = len(sh.dtype.names or ())
    if len(sh) != n or count // 3 + 1 not in SH_SIZES or count % 3:
        raise malformed(path, f"{len(sh)} rows of {count} harmonics do not fit {n} Gaussians")
    columns = [_column(path, sh, f"f_rest_{i}", "u1") for i in range(count)]

    def rows(part: slice) -> np.ndarray:
        levels = np.empty((part.stop - part.start, count))
        for i, column in enumerate(columns):
            levels[:, i] = column[part]
        fraction = np.where(levels == 0, 0, np.where(levels == 255, 1, (levels + 0.5) / 256))
        return ((fraction - 0.5) * SH_RANGE).reshape(len(levels), 3, count // 3).transpose(0, 2, 1)

    return rows, count // 3 + 1


def _table(path: Path, data: bytes, element: Element, start: int) -> tuple[np.ndarray, int]:
    """Return the rows of an element that begins at byte ``start`` of the file, and the byte at which the next one begins."""
    names = [name for name, _ in element.properties]
    if len(set(names)) < len(names):
        raise malformed(path, f"a property of {element.name[:40]!r} appears twice")
    dtype = np.dtype(element.properties)
    end = start + element.count * dtype.itemsize
    if end > len(data):
        rows = f"{element.count} rows of {element.name[:40]!r}"
        raise malformed(path, f"truncated: {rows} end at byte {end}, but the file has {len(data)} bytes")
    return np.frombuffer(data, dtype, element.count, start), end


def _column(path: Path, table: np.ndarray, name: str, kind: str) -> np.ndarray:
    """Return a column of a table; DataError where it is missing or of another type."""
    if name not in (table.dtype.names or ()) or table.dtype[name] != np.dtype(kind):
        raise malformed(path, f"the property {name} is missing, or has the wrong type")
    return table[name]


def _pack(fractions: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return fractions [N, B] in [0, 1] as one integer per row, the first fraction in the upper bits, int64 [N]."""
    packed = np.zeros(len(fractions), np.int64)
    for column, width in zip(fractions.T, bits):
        most = 2**width - 1
        packed = (packed << width) | rounded(column * most, most)
    return packed


def _unpack(packed: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return the fractions [N, B] that `_pack` packed, float64."""
    columns = []
    for width in reversed(bits):
        most = 2**width - 1
        columns.append((packed & most) / most)
        packed = packed >> width
    return np.stack(columns[::-1], 1)


@register("compressed_ply")
class CompressedPLY(Format):
    """The compressed PLY format."""

    suffix = ".compressed.ply"
    description = "PlayCanvas, 8 to 11 bits within chunks of 256; SuperSplat"
    sorted = True
    declares = True
    decode = staticmethod(decode)

    def encode(self, arrays: Arrays) -> list[bytes]:
        """Return the bytes of a file."""
        return encode(arrays, self.antialiased)

    def is_antialiased(self, path: Path) -> bool:
        """Return whether the header declares antialiasing.

        Raises:
            DataError: The file is missing or not a PLY file.
        """
        return is_antialiased(start_of(path))
