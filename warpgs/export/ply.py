"""PLY files of Gaussians, plain and compressed."""

import itertools
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from warpgs import geometry
from warpgs.errors import DataError, expect, listed
from warpgs.export import base
from warpgs.files import MAX_HEADER_BYTES, PLY_LIST, PlyElement, ply_header, replacing
from warpgs.scene import ORIGIN, Gaussians, Normalization, base_coefficients, base_colors

MODES = re.compile(rb"^comment[ \t]+(?:splatrendermode[ \t:]+(\S+)|antialiased[ \t:]+(\S+))[ \t]*\r?$", re.M | re.I)
"""Comments of Brush and Postshot that declare antialiasing."""


def mode_comments(antialiased: bool) -> tuple[str, str]:
    """Return the comments of Brush and Postshot that declare antialiasing."""
    return f"comment SplatRenderMode: {'mip' if antialiased else 'default'}", f"comment antialiased {int(antialiased)}"


def declared(head: bytes) -> bool:
    """Return whether a header, which is checked, declares antialiasing; the last such comment decides."""
    found = False
    for mode, value in MODES.findall(head[: ply_header(head)[1]]):
        text = mode.decode("utf-8", "replace").lower()
        expect(text in ("", "default", "mip"), f"render mode {text[:40]!r} is not supported; train in mode 'default' or 'mip'")
        found = text == "mip" or value.lower() in (b"1", b"true")
    return found


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
        declared(head)
    return head


def is_compressed(head: bytes) -> bool:
    """Return whether the header of a .ply file announces this format."""
    return any(name == "vertex" and "packed_position" in dict(properties) for name, _, properties in ply_header(head)[0])


def decode(path: Path, data: bytes) -> base.Arrays:
    """Return the Gaussians of a file's bytes."""
    elements, start, text = ply_header(data[:MAX_HEADER_BYTES])
    expect(not text, "it is compressed, but in ASCII")
    tables = {}
    for element in elements:
        name, _, properties = element
        sound = name not in tables and properties and PLY_LIST not in dict(properties).values()
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


def _table(data: bytes, element: PlyElement, start: int) -> tuple[np.ndarray, int]:
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
        """Return the words of the comment that `base.origin_comment` made; None without one."""
        head = start_of(path).partition(b"end_header")[0]
        line = re.search(rf"^comment {ORIGIN} (.*)$".encode(), head, re.MULTILINE)
        return None if line is None else line[1].decode("utf-8", "replace").split()

    def is_antialiased(self, path: Path) -> bool:
        """Return whether the header declares antialiasing."""
        return declared(start_of(path))

    def is_own(self, path: Path) -> bool:
        """Return whether the header has both comments of `mode_comments`, of which other programs write one or none."""
        head = start_of(path)
        return any("\n".join(mode_comments(antialiased)).encode() in head for antialiased in (True, False))


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


def read_ply(
    path: str | os.PathLike[str], normalization: Normalization | None = None, *, units: str | None = None
) -> Gaussians:
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
        units: Units of the result: file as stored, or scene to go with a scene's cameras; None for scene if a normalization is
            given, else file.

    Returns:
        N Gaussians, torch tensors on the CPU, float32, or float64 for map coordinates in file units: means [N, 3], quats wxyz
        as stored [N, 4], log scales [N, 3], logit opacities [N], spherical harmonics [N, K, 3] with K in {1, 4, 9, 16, 25}.

    Raises:
        warpgs.DataError: The file is missing, malformed, truncated or compressed, has no usable Gaussian, or is of warpgs and
            has one that is not usable; the message names the place.
        warpgs.UsageError: The units are unknown, or scene units are requested without a normalization.
    """
    units = units or ("file" if normalization is None else "scene")
    normalization = geometry.checked_normalization(normalization, units, str(path))
    if is_compressed(start_of(Path(path))):
        raise DataError(f"{path}: is a compressed PLY file, which read_ply does not read; use warpgs.export.read_gaussians")
    return base.read_with_warnings(Path(path), normalization, units, PLY)


def _plain(path: Path, file: BinaryIO, notes: list[str]) -> base.Arrays:
    """Return the Gaussians of an open file that is not compressed; fills ``notes``."""
    elements, end_of_header, text = ply_header(file.read(MAX_HEADER_BYTES))
    vertex, start = _locate_vertices(elements, end_of_header)
    _, n, properties = vertex
    rest, dtype = _check_properties(properties), np.dtype(properties)
    width = 2 * len(properties) if text else dtype.itemsize  # a number of one digit and a space
    end, size = end_of_header + n * width - 1 if text else start + n * width, os.fstat(file.fileno()).st_size
    expect(end <= size, f"truncated: {n} Gaussians of {width} bytes end at byte {end}, but the file has {size} bytes")
    file.seek(end_of_header if text else start)
    lines = (line.decode("ascii", "replace") for line in file if line.strip())
    if text:
        before = sum(count for _, count, _ in elements[: elements.index(vertex)])
        next(itertools.islice(lines, before, before), None)
        dtype = np.dtype([(name, "f8") for name, _ in properties])

    def rows(part: slice) -> np.ndarray:
        """Return the next rows, structured."""
        count = part.stop - part.start
        if not text:
            table = np.fromfile(file, dtype, count)
            expect(len(table) == count, f"truncated: {n} Gaussians announced, {part.start + len(table)} read")
            return table
        some = list(itertools.islice(lines, count))
        values = np.loadtxt(some, ndmin=2, comments=None) if some else np.empty((0, len(properties)))
        fits = values.shape == (count, len(properties))
        expect(fits, f"Gaussians {part.start} to {part.stop - 1} are not rows of {len(properties)} numbers")
        return values.view(dtype)[:, 0]

    k, names = rest // 3, dtype.names or ()
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh": (1 + k, 3)}
    arrays: dict[str, np.ndarray] = {name: np.empty((n, *shape), np.float32) for name, shape in shapes.items()}
    if all(dtype[name].itemsize == 8 for name in _POSITION):  # maybe map coordinates
        arrays["means"] = np.empty((n, 3))
    for part in base.parts(n):
        table = rows(part)
        means, quats, scales, logits, sh = (array[part] for array in arrays.values())
        means[:] = np.stack([table[name] for name in _POSITION], 1)
        quats[:], scales[:], logits[:] = _columns(table, _ROTATION), _columns(table, _SCALE), table["opacity"]
        sh[:, 0] = _columns(table, _DC) if _DC[0] in names else base_coefficients(_columns(table, _RGB) / 255)
        sh[:, 1:] = _columns(table, _names(rest)[9 : 9 + rest]).reshape(len(table), 3, k).transpose(0, 2, 1) if rest else 0
        scales[scales == -np.inf] = FLAT
        np.copyto(logits, np.copysign(np.float32(OPAQUE), logits), where=np.isinf(logits))
        # Mip-Splatting (Yu et al. 2024, section 4.1) convolves each Gaussian with a ball of this standard deviation
        if "filter_3D" in names:
            narrow = scales.astype(np.float64)
            filters = np.maximum(_columns(table, ["filter_3D"]), math.exp(FLAT))
            scales[:] = wide = 0.5 * np.logaddexp(2 * narrow, 2 * np.log(filters))
            logits[:] = base.logits(base.sigmoid(logits) * np.exp((narrow - wide).sum(1)), 4 * math.exp(-OPAQUE))
    if n and "filter_3D" in names:
        notes.append(f"{path}: filter_3D of Mip-Splatting is applied to sizes and opacities")
    logits, scales = arrays["logit_opacities"], arrays["log_scales"]
    if n >= LEAST_JUDGED and logits.min() >= 0 and logits.max() <= 1 and scales.min() > 0:
        notes.append(f"{path}: opacities look activated. If images are foggy, export the model again without activations")
    return arrays


def _columns(table: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Return columns of structured rows, float32 [N, C]; numbers beyond float32 become infinities."""
    return np.stack([table[name].astype(np.float32) for name in names], 1)


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


def _locate_vertices(elements: list[PlyElement], start: int) -> tuple[PlyElement, int]:
    """Return the vertex element and the offset [bytes] of its rows, behind the rows of any elements before it."""
    expect([name for name, *_ in elements].count("vertex") == 1, "the header must have one 'element vertex'")
    for element in elements:
        name, count, properties = element
        listed = PLY_LIST in (kinds := [kind for _, kind in properties]) and (count or name == "vertex")
        expect(not listed, f"element {name[:40]!r} has list properties, so the Gaussians cannot be located")
        if name == "vertex":
            break
        start += count * sum(np.dtype(kind).itemsize for kind in kinds if count)
    return element, start


def _check_properties(properties: list[tuple[str, str]]) -> int:
    """Return the number of coefficients above degree 0; `MalformedError` where the layout is incomplete."""
    names = [name for name, _ in properties]
    expect(len(set(names)) == len(names), f"property {Counter(names).most_common(1)[0][0][:40]!r} appears twice")
    rest = sum(bool(re.fullmatch(r"f_rest_[0-9]+", name)) for name in names)
    expect(rest in _REST_COUNTS, f"it has {rest} f_rest properties, but degrees 0 to 4 have 0, 9, 24, 45 or 72")
    # Normals are unused, and some tools leave them out.
    missing = sorted(set(_names(rest)) - set(names) - {"nx", "ny", "nz"})
    if missing[:3] == [*_DC] and all((name, "u1") in properties for name in _RGB):
        missing = missing[3:]  # nerfstudio's export with colours, not coefficients
    expect(missing != ["scale_2"], "its Gaussians are flat (2DGS, no scale_2), which is not supported")
    expect(not missing, f"properties missing: {listed(missing, 8)}")
    return rest


@base.register("ply")
class PLY(_HeadedFormat):
    """The PLY format; such a file may be compressed."""

    suffix = ".ply"
    description = "layout of Kerbl et al. 2023, float32; every tool"
    cleaned = False
    max_degree = 4
    archive = True

    def decode(self, path: Path, file: BinaryIO) -> base.Arrays:
        """Return the Gaussians of an open file, which may be compressed."""
        compressed = is_compressed(file.read(MAX_HEADER_BYTES))
        file.seek(0)
        return decode(path, file.read()) if compressed else _plain(path, file, self.notes)

    def write(self, path: Path, gaussians: Gaussians, normalization: Normalization | None, units: str) -> None:
        """Write Gaussians with `write_ply`."""
        _write(path, gaussians, normalization, units, self.antialiased, self.origin)
