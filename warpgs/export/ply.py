"""PLY files of Gaussians, plain and compressed."""

import functools
import itertools
import math
import os
import re
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from warpgs.errors import DataError, expect
from warpgs.export import base
from warpgs.files import PLY_TYPES, replacing
from warpgs.geometry import checked_normalization
from warpgs.scene import ORIGIN, Gaussians, Normalization, base_coefficients, base_colors, checked_origin

MAX_HEADER_BYTES = 65536
"""Largest accepted header [bytes]; real headers have some two thousand."""
REMEDY = "Export the model again with warpgs, or with any tool that writes the binary layout of the INRIA 3DGS code."

_TYPES = {name: kind if kind.endswith("1") else f"<{kind}" for name, kind in PLY_TYPES.items()}
_FORMATS = {"binary_little_endian 1.0": "<", "binary_big_endian 1.0": ">", "ascii 1.0": "<"}
"""Formats that are read, with their byte order in numpy; the numbers of an ASCII file do not need one."""
ASCII = re.compile(rb"^format[ \t]+ascii", re.MULTILINE)


Element = tuple[str, int, list[tuple[str, str]]]
"""Name and number of rows of an element, and pairs (name, numpy type) of its properties in file order."""
LIST = "list"
"""Type of a property that is a list, so that rows differ in length."""


def mode_comments(antialiased: bool) -> tuple[str, str]:
    """Return the comments of Brush and Postshot that declare antialiasing."""
    return f"comment SplatRenderMode: {'mip' if antialiased else 'default'}", f"comment antialiased {int(antialiased)}"


def origin_stated(head: bytes) -> list[str] | None:
    """Return the words of the comment that `base.origin_comment` made; None without one."""
    line = re.search(rf"^comment {ORIGIN} (.*)$".encode(), head.partition(b"end_header")[0], re.MULTILINE)
    return None if line is None else line[1].decode("utf-8", "replace").split()


def is_own(head: bytes) -> bool:
    """Return whether a header has both comments of `mode_comments`, of which other programs write one or none."""
    return any("\n".join(mode_comments(antialiased)).encode() in head for antialiased in (True, False))


def ply_error(path: Path, what: str) -> DataError:
    """Return a DataError about a malformed file, with the remedy."""
    return DataError(f"{path}: not a usable Gaussian PLY file: {what}. {REMEDY}")


def parse_header(path: Path, head: bytes) -> tuple[list[Element], int, bool]:
    """Return the elements of the header in the first bytes of a file, and the offset [bytes] of the data behind it.

    Also returns whether it declares antialiasing; the last such comment decides.
    """
    if not re.match(rb"ply[ \t]*\r?\n", head):
        raise ply_error(path, "it does not start with 'ply'")
    if (end := re.search(rb"^end_header[ \t]*\r?\n", head, re.MULTILINE)) is None:
        raise ply_error(path, f"no 'end_header' line within the first {MAX_HEADER_BYTES} bytes")
    elements: list[Element] = []
    formats, antialiased = [], False
    # comments may have any encoding
    for line in head[: end.start()].decode("utf-8", "replace").split("\n")[1:]:
        match line.split():
            case ["comment", *words]:
                match " ".join(words).lower().replace(":", " ").split():
                    case ["splatrendermode", "default" | "mip" as mode]:
                        antialiased = mode == "mip"
                    case ["splatrendermode", mode]:
                        fix = "train or export with mode 'default' or 'mip'"
                        raise DataError(f"{path}: render mode {mode[:40]!r} is not supported; {fix}")
                    case ["antialiased", value]:
                        antialiased = value in ("1", "true")
            case [] | ["obj_info", *_]:
                pass
            case ["format", *words]:
                formats.append(" ".join(words))
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,18}", count):
                elements.append((name, int(count), []))
            case ["property", "list", count, item, name] if elements and count in _TYPES and item in _TYPES:
                elements[-1][2].append((name, LIST))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1][2].append((name, _TYPES[kind]))
            case _:
                raise ply_error(path, f"header line {line[:80]!r} is invalid")
    if len(formats) != 1 or formats[0] not in _FORMATS:
        given = " and ".join(formats)[:80] or "not given"
        raise ply_error(path, f"its format is {given}, not one of {', '.join(_FORMATS)}")
    order = _FORMATS[formats[0]]
    elements = [(name, n, [(key, kind.replace("<", order)) for key, kind in given]) for name, n, given in elements]
    return elements, end.end(), antialiased


# The compressed PLY of PlayCanvas and SuperSplat: 16 bytes a Gaussian, and one more byte per harmonic and channel.
#
# Positions (11, 10, 11 bits), log scales (11, 10, 11) and colours (8 each) are fractions between bounds, which a chunk
# of 256 Gaussians shares. A rotation has 2 bits for the index of its largest component, and 10 bits for each other
# component. The loss is smallest if neighbours in the file are neighbours in space, so an export sorts the Gaussians
# (``sorted``).

CHUNK = 256
"""Number of Gaussians that share bounds."""
SH_RANGE = 8
"""Width of the range about 0 that harmonics above degree 0 are stored in."""
_GROUPS = (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
_CHUNK_NAMES = [f"{end}_{name}" for group in _GROUPS for end in ("min", "max") for name in group]
_VERTEX_NAMES = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_BITS = (11, 10, 11)


def encode(arrays: base.Arrays, antialiased: bool, origin: np.ndarray | None = None) -> list[bytes]:
    """Return the bytes of a file, with antialiasing declared in its header; harmonics above degree 0 are clamped to +-4."""
    n, k = arrays["sh"].shape[:2]
    chunks = np.arange(n) // CHUNK
    colors = base_colors(arrays["sh"][:, :1].astype(np.float64))
    bounds, fractions = [], []
    for values in (arrays["means"], base.with_least_scale(arrays["log_scales"]), colors):
        starts = np.arange(0, n, CHUNK)
        low = np.minimum.reduceat(values, starts).astype("<f4")
        high = np.maximum.reduceat(values, starts).astype("<f4")
        bounds += [low, high]
        span = high.astype(np.float64) - low
        fractions.append((values - low[chunks].astype(np.float64)) / np.where(span > 0, span, 1)[chunks])
    largest, others = base.smallest_three(arrays["quats"])
    position, scale = (_pack(fractions[i], _BITS) for i in (0, 1))
    rgba = np.concatenate([fractions[2], base.sigmoid(arrays["logit_opacities"])[:, None]], 1)
    rotation = (largest << 30) | _pack(others / base.SQRT2 + 0.5, (10, 10, 10))
    rows = np.stack([position, rotation, scale, _pack(rgba, (8, 8, 8, 8))], 1).astype("<u4")
    rest = arrays["sh"][:, 1:].astype(np.float64).transpose(0, 2, 1).reshape(n, -1)
    harmonics = np.clip(np.floor((rest / SH_RANGE + 0.5) * 256), 0, 255).astype("u1")
    lines = [f"element chunk {len(bounds[0])}", *(f"property float {name}" for name in _CHUNK_NAMES)]
    lines += [f"element vertex {n}", *(f"property uint {name}" for name in _VERTEX_NAMES)]
    if k > 1:
        lines += [f"element sh {n}", *(f"property uchar f_rest_{i}" for i in range(3 * (k - 1)))]
    return [_header(lines, antialiased, origin), np.concatenate(bounds, 1).tobytes(), rows.tobytes(), harmonics.tobytes()]


def start_of(path: Path) -> bytes:
    """Return the first `MAX_HEADER_BYTES` bytes of a PLY file, or the whole file if it is shorter, and check its header."""
    with base.reading(path) as file:
        head = file.read(MAX_HEADER_BYTES)
    parse_header(path, head)
    return head


def is_compressed(path: Path, data: bytes) -> bool:
    """Return whether the header of a .ply file announces this format; DataError if the file has no header."""
    elements, *_ = parse_header(path, data[:MAX_HEADER_BYTES])
    return any(name == "vertex" and "packed_position" in dict(properties) for name, _, properties in elements)


def decode(path: Path, data: bytes) -> base.Arrays:
    """Return the Gaussians of a file's bytes."""
    elements, start, _ = parse_header(path, data[:MAX_HEADER_BYTES])
    expect(not ASCII.search(data[:start]), "it is compressed, but in ASCII")
    tables = {}
    for element in elements:
        name, _, properties = element
        sound = name not in tables and properties and LIST not in dict(properties).values()
        expect(sound, f"its element {name[:40]!r} is invalid")
        tables[name], start = _table(data, element, start)
    expect({"chunk", "vertex"} <= tables.keys(), "the element chunk or vertex is missing")
    chunk, vertex, sh = tables["chunk"], tables["vertex"], tables.get("sh")
    n = len(vertex)
    expect(len(chunk) == -(-n // CHUNK), f"it has {len(chunk)} chunks, but {n} Gaussians need {-(-n // CHUNK)}")
    position, rotation, scale, color = (_column(vertex, name, "<u4") for name in _VERTEX_NAMES)
    bounds = [_bounds(chunk, group) for group in _GROUPS]

    def values(i: int, packed: np.ndarray, bits: tuple[int, ...], part: slice) -> np.ndarray:
        """Return the unpacked values of the i-th group [P, 3], scaled to the bounds of their chunks if there are bounds."""
        fractions = _unpack(packed[part].astype(np.int64), bits)[:, :3]
        if (ends := bounds[i]) is None:
            return fractions
        rows = np.arange(part.start, part.stop) // CHUNK
        return ends[0][rows] * (1 - fractions) + ends[1][rows] * fractions

    def quats(part: slice) -> np.ndarray:
        packed = rotation[part].astype(np.int64)
        return base.from_smallest_three(packed >> 30, (_unpack(packed & (2**30 - 1), (10, 10, 10)) - 0.5) * base.SQRT2)

    def opacities(part: slice) -> np.ndarray:
        return base.logits(_unpack(color[part].astype(np.int64), (8, 8, 8, 8))[:, 3], 1 / 255)

    def harmonics(part: slice) -> np.ndarray:
        first = base_coefficients(values(2, color, (8, 8, 8, 8), part))[:, None]
        return first if rest is None else np.concatenate([first, rest(part)], 1)

    rest, k = (None, 1) if sh is None else _harmonics(sh, n)
    return {
        "sh": base.by_rows(n, (k, 3), harmonics),
        "means": base.by_rows(n, (3,), lambda p: values(0, position, _BITS, p)),
        "quats": base.by_rows(n, (4,), quats),
        "log_scales": base.by_rows(n, (3,), lambda p: values(1, scale, _BITS, p)),
        "logit_opacities": base.by_rows(n, (), opacities),
    }


def _bounds(chunk: np.ndarray, group: tuple[str, ...]) -> list[np.ndarray] | None:
    """Return the bounds of each chunk, two arrays float64 [C, 3]; None for the colours of older files, which span 0 to 1."""
    if group == _GROUPS[2] and "min_r" not in (chunk.dtype.names or ()):
        return None
    columns = ([_column(chunk, f"{end}_{name}", "<f4") for name in group] for end in ("min", "max"))
    return [np.stack(column, 1).astype(np.float64) for column in columns]


def _harmonics(sh: np.ndarray, n: int) -> tuple[Callable[[slice], np.ndarray], int]:
    """Return a function for the coefficients above degree 0 [P, K - 1, 3] of some rows, and K."""
    count = len(sh.dtype.names or ())
    fits = len(sh) == n and count // 3 + 1 in base.SH_SIZES and count % 3 == 0
    expect(fits, f"{len(sh)} rows of {count} harmonics do not fit {n} Gaussians")
    columns = [_column(sh, f"f_rest_{i}", "u1") for i in range(count)]

    def rows(part: slice) -> np.ndarray:
        levels = np.empty((part.stop - part.start, count))
        for i, column in enumerate(columns):
            levels[:, i] = column[part]
        fraction = np.where(levels == 0, 0, np.where(levels == 255, 1, (levels + 0.5) / 256))
        return ((fraction - 0.5) * SH_RANGE).reshape(len(levels), 3, count // 3).transpose(0, 2, 1)

    return rows, count // 3 + 1


def _table(data: bytes, element: Element, start: int) -> tuple[np.ndarray, int]:
    """Return the rows of an element that begins at byte ``start`` of the file, and the byte at which the next one begins."""
    name, count, properties = element
    expect(len(dict(properties)) == len(properties), f"a property of {name[:40]!r} appears twice")
    dtype = np.dtype(properties)
    end, rows = start + count * dtype.itemsize, f"{count} rows of {name[:40]!r}"
    expect(end <= len(data), f"truncated: {rows} end at byte {end}, but the file has {len(data)} bytes")
    return np.frombuffer(data, dtype, count, start), end


def _column(table: np.ndarray, name: str, kind: str) -> np.ndarray:
    """Return a column of a table; `MalformedError` where it is missing or of another type."""
    there = name in (table.dtype.names or ()) and table.dtype[name] == np.dtype(kind)
    expect(there, f"the property {name} is missing, or has the wrong type")
    return table[name]


def _pack(fractions: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return fractions [N, B] in [0, 1] as one integer per row, the first fraction in the upper bits, int64 [N]."""
    packed = np.zeros(len(fractions), np.int64)
    for column, width in zip(fractions.T, bits):
        most = 2**width - 1
        packed = (packed << width) | base.rounded(column * most, most)
    return packed


def _unpack(packed: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return the fractions [N, B] that `_pack` packed, float64."""
    columns = []
    for width in reversed(bits):
        most = 2**width - 1
        columns.append((packed & most) / most)
        packed = packed >> width
    return np.stack(columns[::-1], 1)


class _HeadedFormat(base.Format):
    """A format with declarations of a file as comments in its header."""

    declares = True

    def origin_in(self, path: Path) -> object:
        """Return the origin in the header's comments."""
        return origin_stated(start_of(path))

    def is_antialiased(self, path: Path) -> bool:
        """Return whether the header declares antialiasing."""
        return parse_header(path, start_of(path))[2]

    def is_own(self, path: Path) -> bool:
        """Return whether the header has the comments of warpgs."""
        return is_own(start_of(path))


@base.register("compressed_ply")
class CompressedPLY(_HeadedFormat):
    """The compressed PLY format."""

    suffix = ".compressed.ply"
    description = "PlayCanvas, 8 to 11 bits within chunks of 256; SuperSplat"
    sorted = True
    decode = staticmethod(decode)

    def encode(self, arrays: base.Arrays) -> list[bytes]:
        """Return the bytes of a file."""
        return encode(arrays, self.antialiased, self.origin)


# Gaussians as a PLY file in the layout of the INRIA 3DGS code, which splat viewers and editors read.
#
# One vertex per Gaussian, binary little endian: position, an unused normal, spherical-harmonics coefficients (degree 0
# first, the rest channel-major), opacity as a logit, log scales, rotation wxyz as stored (not normalised).

CHUNK_ROWS = 65536
"""Number of Gaussians written at a time, so that the interleaved copy of a large model never exists as a whole."""
OPAQUE = 30.0
"""Logit that replaces infinity: the opacity is 1 in float32. -30 replaces minus infinity."""
FLAT = math.log(1e-37)
"""Log scale that replaces minus infinity, an axis of length 0: float32 still holds its exponential."""

LEAST_JUDGED = 100
"""Files with fewer Gaussians get no note on the range of their values."""

_POSITION = ("x", "y", "z")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_RGB = ("red", "green", "blue")
_SCALE = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_REST_COUNTS = (0, 9, 24, 45, 72)


def write_ply(
    path: str | os.PathLike[str], gaussians: Gaussians, normalization: Normalization | None = None, *, units: str = "scene",
    antialiased: bool = False,
) -> None:  # fmt: skip
    """Write Gaussians to a PLY file in the units of the scene's files.

    Means become ``mean / scale + offset`` [file units] and log scales ``log_scale - log(scale)``, computed in float64 and
    stored as float32; map coordinates are stored about an origin that the header states (docs/formats.md). Rotations, logit
    opacities and spherical harmonics are stored unchanged. The write is atomic: the file is written under a temporary name
    beside ``path`` and then renamed.

    Args:
        path: The file; an existing one is replaced.
        gaussians: N Gaussians, on any device: means [N, 3], quats wxyz of any length [N, 4], log scales [N, 3], logit opacities
            [N], spherical harmonics [N, K, 3] with K in {1, 4, 9, 16, 25}.
        normalization: Similarity from file to scene units of the fitted scene, ``x_scene = scale * (x_file - offset)``;
            required if ``units`` is scene.
        units: Units of ``gaussians``: scene, or file to write them unchanged.
        antialiased: True for Gaussians to be rendered with `RasterizeOptions.antialiased`; the header declares it.

    Raises:
        warpgs.DataError: A tensor is not finite, before or after the change of coordinates; or the normalization is not
            a similarity. Nothing is written.
        warpgs.ResourceError: The file cannot be written.
        TypeError: The Gaussians have other parameters; ``stored()`` of `ActivatedGaussians` converts them.
        warpgs.UsageError: The units are unknown, or scene units are given without a normalization.
        ValueError: A tensor has the wrong shape.
    """
    _write(Path(path), gaussians, normalization, units, antialiased, None)


def _write(
    path: Path, gaussians: Gaussians, normalization: Normalization | None, units: str, antialiased: bool,
    origin: np.ndarray | None,
) -> None:  # fmt: skip
    """Write Gaussians as `write_ply` does, about an ``origin`` [3] if one is given."""
    arrays, origin = base.arrays_to_write(path, gaussians, normalization, units, origin)
    n, k = arrays["sh"].shape[:2]
    header = _header([f"element vertex {n}", *(f"property float {v}" for v in _names(3 * (k - 1)))], antialiased, origin)
    with replacing(path, size=len(header) + 4 * n * (14 + 3 * k)) as (file, _):
        file.write(header)
        for start in range(0, n, CHUNK_ROWS):
            file.write(_rows({name: a[start : start + CHUNK_ROWS] for name, a in arrays.items()}).tobytes())


def read_ply(path: str | os.PathLike[str], normalization: Normalization | None = None, *, units: str = "file") -> Gaussians:
    """Read Gaussians from a PLY file in the INRIA 3DGS layout, binary or ASCII; `read_gaussians` also reads compressed ones.

    Other properties and elements are ignored, but ``filter_3D`` of Mip-Splatting is applied, with a warning. Programs write
    opacities of 0 and 1 as infinite logits, and axes of length 0 as log scales of -inf. These become finite numbers that look
    the same (`OPAQUE`, `FLAT`). Gaussians of other programs with a NaN, another infinity or a rotation of zero length are left
    out with a warning; `read_gaussians` can refuse them (``strict``). The number of rows is checked against the file size
    before memory is allocated. A file that declares antialiasing causes a warning: render it with
    `RasterizeOptions.antialiased`.

    Args:
        path: The file, written by `write_ply` or by another program with the same layout.
        normalization: Similarity from file to scene units; needed where ``units`` is scene.
        units: Units of the result: file as stored, or scene to go with a scene's cameras.

    Returns:
        N Gaussians, torch tensors on the CPU, float32, or float64 for map coordinates in file units: means [N, 3], quats wxyz
        as stored [N, 4], log scales [N, 3], logit opacities [N], spherical harmonics [N, K, 3] with K in {1, 4, 9, 16, 25}.

    Raises:
        warpgs.DataError: The file is missing, malformed, truncated or compressed, has no usable Gaussian, or is of warpgs and
            has one that is not usable; the message names the place.
        warpgs.UsageError: The units are unknown, or scene units are requested without a normalization.
    """
    path = Path(path)
    notes: list[str] = []
    normalization = checked_normalization(normalization, units, str(path))
    gaussians = base.from_origin(*_read(path, False, notes), normalization, units)
    if parse_header(path, start_of(path))[2]:
        base.warn_of_antialiasing(path)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return gaussians


def _read(path: Path, strict: bool, notes: list[str]) -> tuple[Gaussians, np.ndarray]:
    """Return the Gaussians in file units about an origin, and the origin [3]; fills ``notes``."""
    with base.reading(path) as file:
        size = os.fstat(file.fileno()).st_size
        head = file.read(MAX_HEADER_BYTES)
        elements, start, _ = parse_header(path, head)
        file.seek(start)
        text, own = ASCII.search(head[:start]), is_own(head[:start])
        vertex, start = _locate_vertices(path, elements, start)
        _, n, properties = vertex
        rest = _check_properties(path, properties)
        dtype = np.dtype(properties)
        width = 2 * len(properties) if text else dtype.itemsize  # a number of one digit and a space
        end = file.tell() + n * width - 1 if text else start + n * width
        if end > size:
            raise ply_error(path, f"truncated: {n} Gaussians of {width} bytes end at byte {end}, but the file has {size} bytes")
        lines = (line.decode("ascii", "replace") for line in file if line.strip())
        if text:
            before = sum(count for _, count, _ in elements[: elements.index(vertex)])
            next(itertools.islice(lines, before, before), None)
        else:
            file.seek(start)

        def numbers(part: slice) -> np.ndarray:
            found = list(itertools.islice(lines, part.stop - part.start))
            values = np.loadtxt(found, ndmin=2, comments=None) if found else np.empty((0, len(properties)))
            if values.shape != (part.stop - part.start, len(properties)):
                raise ply_error(path, f"Gaussians {part.start} to {part.stop - 1} are not rows of {len(properties)} numbers")
            return values.view([(name, "f8") for name, _ in properties])[:, 0]

        def rows(part: slice) -> np.ndarray:
            found = np.fromfile(file, dtype=dtype, count=part.stop - part.start)
            if len(found) != part.stop - part.start:
                raise ply_error(path, f"truncated: {n} Gaussians announced, {part.start + len(found)} read")
            return found

        stated = origin_stated(head[:start])
        origin = np.zeros(3) if stated is None else checked_origin(stated, str(path))
        return _assemble(path, numbers if text else rows, n, rest, strict or own, notes, origin)


def _names(rest: int) -> list[str]:
    """Return the property names of the layout with ``rest`` coefficients above degree 0, in file order."""
    return [*_POSITION, "nx", "ny", "nz", *_DC, *(f"f_rest_{i}" for i in range(rest)), "opacity", *_SCALE, *_ROTATION]


def _header(elements: list[str], antialiased: bool, origin: np.ndarray | None) -> bytes:
    """Return the header of a file with the lines of its elements."""
    lines = ["ply", "format binary_little_endian 1.0", *mode_comments(antialiased), *base.origin_comment(origin).splitlines()]
    return ("\n".join([*lines, *elements, "end_header"]) + "\n").encode("ascii")


def _rows(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Interleave the tensors of n Gaussians: little-endian float32, shape [n, 17 + 3 (K - 1)]."""
    sh = arrays["sh"]
    n = len(sh)
    # Channel-major: all coefficients of red, then green, then blue.
    rest = sh[:, 1:, :].transpose(0, 2, 1).reshape(n, -1)
    opacity = arrays["logit_opacities"][:, None]
    columns = [arrays["means"], np.zeros((n, 3)), sh[:, 0, :], rest, opacity, arrays["log_scales"], arrays["quats"]]
    return np.concatenate(columns, axis=1, dtype="<f4", casting="same_kind")


def _locate_vertices(path: Path, elements: list[Element], start: int) -> tuple[Element, int]:
    """Return the vertex element and the offset [bytes] of its rows, behind the rows of any elements before it."""
    if [name for name, *_ in elements].count("vertex") != 1:
        raise ply_error(path, "the header must have one 'element vertex'")
    for element in elements:
        name, count, properties = element
        if LIST in (kinds := [kind for _, kind in properties]) and (count or name == "vertex"):
            raise ply_error(path, f"element {name[:40]!r} has list properties, so the Gaussians cannot be located")
        if name == "vertex":
            break
        start += count * sum(np.dtype(kind).itemsize for kind in kinds if count)
    return element, start


def _check_properties(path: Path, properties: list[tuple[str, str]]) -> int:
    """Return the number of coefficients above degree 0; DataError where the layout is incomplete."""
    names = [name for name, _ in properties]
    if len(set(names)) < len(names):
        raise ply_error(path, f"property {Counter(names).most_common(1)[0][0][:40]!r} appears twice")
    rest = sum(bool(re.fullmatch(r"f_rest_[0-9]+", name)) for name in names)
    if rest not in _REST_COUNTS:
        raise ply_error(path, f"it has {rest} f_rest properties, but degrees 0 to 4 have 0, 9, 24, 45 or 72")
    # Normals are unused, and some tools leave them out.
    missing = sorted(set(_names(rest)) - set(names) - {"nx", "ny", "nz"})
    if missing[:3] == [*_DC] and all((name, "u1") in properties for name in _RGB):
        missing = missing[3:]  # nerfstudio's export with colours, not coefficients
    if "packed_position" in names:
        raise DataError(f"{path}: is a compressed PLY file, which read_ply does not read; use warpgs.export.read_gaussians")
    if missing == ["scale_2"]:
        raise ply_error(path, "its Gaussians are flat (2DGS, no scale_2), which is not supported")
    if missing:
        raise ply_error(path, f"properties missing: {', '.join(missing[:8])}{' ...' if len(missing) > 8 else ''}")
    return rest


def _assemble(
    path: Path, read: Callable[[slice], np.ndarray], n: int, rest: int, strict: bool, notes: list[str], origin: np.ndarray
) -> tuple[Gaussians, np.ndarray]:
    """Return the Gaussians of N structured rows, which are read in their order, and their ``origin`` [3]; see `usable`.

    Doubles far from 0 become float32 about a point near the first rows, which is added to the origin.
    """
    middle = np.zeros(3)
    k = rest // 3
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh": (1 + k, 3)}
    arrays = {name: np.empty((n, *shape), np.float32) for name, shape in shapes.items()}
    bad = np.zeros(n, bool)
    reasons: list[str] = []
    for part in base.parts(n):
        rows = read(part)
        if part.start == 0 and all(rows.dtype[name].itemsize == 8 for name in _POSITION):
            middle = base.origin_of(np.stack([rows[name] for name in _POSITION], 1).astype(np.float64))
        columns = functools.partial(_columns, rows, part.start, bad[part], reasons)
        arrays["sh"][part, 0] = columns(_DC) if _DC[0] in (rows.dtype.names or ()) else base_coefficients(columns(_RGB) / 255)
        if rest:
            arrays["sh"][part, 1:] = columns([f"f_rest_{i}" for i in range(rest)]).reshape(len(rows), 3, k).transpose(0, 2, 1)
        quats = arrays["quats"][part] = columns(_ROTATION)
        zero = ~quats.any(axis=1)
        if zero.any():
            reasons.append(f"the rotation of Gaussian {part.start + int(np.argmax(zero))} has zero length")
            bad[part] |= zero
        arrays["means"][part] = columns(_POSITION, shift=middle)
        arrays["log_scales"][part] = columns(_SCALE, least=FLAT)
        arrays["logit_opacities"][part] = columns(["opacity"], -OPAQUE, OPAQUE)[:, 0]
        # Mip-Splatting (Yu et al. 2024, section 4.1) convolves each Gaussian with a ball of this standard deviation
        if filtered := "filter_3D" in (rows.dtype.names or ()):
            narrow = arrays["log_scales"][part].astype(np.float64)
            wide = 0.5 * np.logaddexp(2 * narrow, 2 * np.log(np.maximum(columns(["filter_3D"]), math.exp(FLAT))))
            with np.errstate(invalid="ignore"):  # of rows that are left out
                opacities = base.sigmoid(arrays["logit_opacities"][part]) * np.exp((narrow - wide).sum(1))
            arrays["log_scales"][part], arrays["logit_opacities"][part] = wide, base.logits(opacities, 4 * math.exp(-OPAQUE))
    if n and filtered:
        notes.append(f"{path}: filter_3D of Mip-Splatting is applied to sizes and opacities")
    stored, scales = arrays["logit_opacities"], arrays["log_scales"]
    if n >= LEAST_JUDGED and stored.min() >= 0 and stored.max() <= 1 and scales.min() > 0:
        values = f"all opacities are from {stored.min():.2g} to {stored.max():.2g} and all log scales above 0"
        why = "as if stored after the sigmoid and the exponential; they are read as logits and logarithms"
        notes.append(f"{path}: {values}, {why}. If images are foggy, export the model again without activations")
    return base.usable(path, arrays, bad, next(iter(reasons), ""), lambda: strict, notes, ply_error), origin + middle


def _columns(
    rows: np.ndarray, first: int, bad: np.ndarray, reasons: list[str], names: Sequence[str], least: float = -np.inf,
    most: float = np.inf, shift: Sequence[float] | np.ndarray = (),
) -> np.ndarray:  # fmt: skip
    """Return columns of structured rows less a ``shift``, float32 [N, C]; infinities become ``least`` and ``most``.

    Rows with other numbers are marked as ``bad`` [N], with a reason, in which ``first`` is the number of the first row.
    """
    out = np.empty((len(rows), len(names)), np.float32)
    # A double beyond float32 becomes an infinity, and the check below finds it.
    with np.errstate(over="ignore", invalid="ignore"):
        for i, name in enumerate(names):
            out[:, i] = rows[name] - shift[i] if np.any(shift) else rows[name]
    out[out == -np.inf], out[out == np.inf] = least, most
    finite = np.isfinite(out)
    if not finite.all():
        row, column = np.argwhere(~finite)[0]
        reasons.append(f"{names[column]} of Gaussian {first + row} is not finite in float32")
        bad |= ~finite.all(axis=1)
    return out


@base.register("ply")
class PLY(_HeadedFormat):
    """The PLY format; such a file may be compressed."""

    suffix = ".ply"
    description = "layout of Kerbl et al. 2023, float32; every tool"
    cleaned = False
    max_degree = 4
    decode = staticmethod(decode)

    def write(self, path: Path, gaussians: Gaussians, normalization: Normalization | None, units: str) -> None:
        """Write Gaussians with `write_ply`."""
        _write(path, gaussians, normalization, units, self.antialiased, self.origin)

    def read_stored(self, path: Path) -> Gaussians:
        """Read Gaussians as `read_ply` does, or as `CompressedPLY` if the header announces that format."""
        if is_compressed(path, start_of(path)):
            return super().read_stored(path)
        self.notes = []
        gaussians, self.origin = _read(path, self.strict, self.notes)
        return gaussians
