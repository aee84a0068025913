"""Gaussians as a PLY file in the layout of the INRIA 3DGS code, which splat viewers and editors read.

One vertex per Gaussian, binary little endian: position, an unused normal, spherical-harmonics coefficients (degree 0
first, the rest channel-major), opacity as a logit, log scales, rotation wxyz as stored (not normalised).
"""

from __future__ import annotations

import functools
import math
import os
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from warpgs.coordinates import checked_normalization, convert_gaussians
from warpgs.errors import DataError
from warpgs.export.arrays import arrays_of, check_finite, parts
from warpgs.export.base import Format, register, warn_of_antialiasing
from warpgs.export.compressed_ply import CompressedPLY, is_compressed, start_of
from warpgs.export.ply_header import MAX_HEADER_BYTES, Element, is_antialiased, mode_comments, parse_header, ply_error
from warpgs.files import writing
from warpgs.input_files import open_input, unread_reason
from warpgs.scene import Gaussians, Normalization

CHUNK_ROWS = 65536
"""Number of Gaussians written at a time, so that the interleaved copy of a large model never exists as a whole."""
OPAQUE = 30.0
"""Logit that replaces infinity: the opacity is 1 in float32. -30 replaces minus infinity."""
FLAT = math.log(1e-37)
"""Log scale that replaces minus infinity, an axis of length 0: float32 still holds its exponential."""

_POSITION = ("x", "y", "z")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_REST_COUNTS = (0, 9, 24, 45, 72)


def write_ply(
    path: str | os.PathLike[str], gaussians: Gaussians, normalization: Normalization | None = None, *, units: str = "scene",
    antialiased: bool = False,
) -> None:  # fmt: skip
    """Write Gaussians to a PLY file in the units of the scene's files.

    Means become ``mean / scale + offset`` [file units] and log scales ``log_scale - log(scale)``, computed in float64 and
    stored as float32; rotations, logit opacities and spherical harmonics are stored unchanged. The write is atomic: the file is
    written under a temporary name beside ``path`` and then renamed.

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
    path = Path(path)
    normalization = checked_normalization(normalization, units, f"{path}: not written")
    in_file = convert_gaussians(gaussians, normalization, units, "file")
    for g in (gaussians, in_file):  # finite numbers may overflow float32 in the conversion
        arrays = arrays_of(g)
        check_finite(path, arrays)

    n, k = arrays["sh"].shape[:2]
    header = _header(n, 3 * (k - 1), antialiased)
    with writing(path, len(header) + 4 * n * (14 + 3 * k)) as file:
        file.write(header)
        for start in range(0, n, CHUNK_ROWS):
            file.write(_rows({name: a[start : start + CHUNK_ROWS] for name, a in arrays.items()}).tobytes())


def read_ply(path: str | os.PathLike[str], normalization: Normalization | None = None, *, units: str = "file") -> Gaussians:
    """Read Gaussians from a PLY file in the INRIA 3DGS layout, binary little endian.

    Properties and elements outside the layout are ignored. Other programs write opacities of 0 and 1 as infinite logits, and
    axes of length 0 as log scales of -inf. These become finite numbers that look the same (`OPAQUE`, `FLAT`). The number of
    rows is checked against the file size before memory is allocated. A file that declares antialiasing causes a warning: render
    it with `RasterizeOptions.antialiased`.

    Args:
        path: The file, written by `write_ply` or by another program with the same layout.
        normalization: Similarity from file to scene units; needed where ``units`` is scene.
        units: Units of the result: file as stored, or scene to go with a scene's cameras.

    Returns:
        N Gaussians, torch float32 tensors on the CPU: means [N, 3], quats wxyz as stored [N, 4], log scales [N, 3], logit
        opacities [N], spherical harmonics [N, K, 3] with K in {1, 4, 9, 16, 25}.

    Raises:
        warpgs.DataError: The file is missing, malformed, truncated, or contains a NaN, another infinity or a rotation of
            zero length; the message names the place.
        warpgs.UsageError: The units are unknown, or scene units are requested without a normalization.
    """
    path = Path(path)
    gaussians = _read(path, normalization, units)
    if is_antialiased(start_of(path)):
        warn_of_antialiasing(path)
    return gaussians


def _read(path: Path, normalization: Normalization | None, units: str) -> Gaussians:
    """Return what `read_ply` does, without a warning."""
    normalization = checked_normalization(normalization, units, str(path))
    try:
        with open_input(path) as file:
            size = os.fstat(file.fileno()).st_size
            elements, start = parse_header(path, file.read(MAX_HEADER_BYTES))
            vertex, start = _locate_vertices(path, elements, start)
            rest = _check_properties(path, vertex)
            dtype = np.dtype(vertex.properties)
            end = start + vertex.count * dtype.itemsize
            if end > size:
                needed = f"{vertex.count} Gaussians of {dtype.itemsize} bytes end at byte {end}"
                raise ply_error(path, f"truncated: {needed}, but the file has {size} bytes")
            file.seek(start)

            def rows(part: slice) -> np.ndarray:
                found = np.fromfile(file, dtype=dtype, count=part.stop - part.start)
                if len(found) != part.stop - part.start:
                    raise ply_error(path, f"truncated: {vertex.count} Gaussians announced, {part.start + len(found)} read")
                return found

            gaussians = _assemble(path, rows, vertex.count, rest)
    except OSError as e:
        raise DataError(f"{path}: cannot be read ({unread_reason(e)}). Check the path and its permissions.") from e
    return convert_gaussians(gaussians, normalization, "file", units)


def _names(rest: int) -> list[str]:
    """Return the property names of the layout with ``rest`` coefficients above degree 0, in file order."""
    return [*_POSITION, "nx", "ny", "nz", *_DC, *(f"f_rest_{i}" for i in range(rest)), "opacity", *_SCALE, *_ROTATION]


def _header(n: int, rest: int, antialiased: bool) -> bytes:
    """Return the header of a file with ``n`` Gaussians and ``rest`` coefficients above degree 0."""
    lines = ["ply", "format binary_little_endian 1.0", *mode_comments(antialiased), f"element vertex {n}"]
    lines += [f"property float {name}" for name in _names(rest)]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


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
    if [e.name for e in elements].count("vertex") != 1:
        raise ply_error(path, "the header must have one 'element vertex'")
    for element in elements:
        if element.has_list and (element.count or element.name == "vertex"):
            raise ply_error(path, f"element {element.name[:40]!r} has list properties, so the Gaussians cannot be located")
        if element.name == "vertex":
            break
        start += element.count * sum(np.dtype(kind).itemsize for _, kind in element.properties)
    return element, start


def _check_properties(path: Path, vertex: Element) -> int:
    """Return the number of coefficients above degree 0; DataError where the layout is incomplete."""
    names = [name for name, _ in vertex.properties]
    if len(set(names)) < len(names):
        twice = Counter(names).most_common(1)[0][0]
        raise ply_error(path, f"property {twice[:40]!r} appears twice")
    rest = sum(bool(re.fullmatch(r"f_rest_[0-9]+", name)) for name in names)
    if rest not in _REST_COUNTS:
        raise ply_error(path, f"it has {rest} f_rest properties, but degrees 0 to 4 have 0, 9, 24, 45 or 72")
    # Normals are unused, and some tools leave them out.
    missing = sorted(set(_names(rest)) - set(names) - {"nx", "ny", "nz"})
    if missing == ["scale_2"]:
        raise ply_error(path, "its Gaussians are flat (2DGS, no scale_2), which is not supported")
    if missing:
        raise ply_error(path, f"properties missing: {', '.join(missing[:8])}{' ...' if len(missing) > 8 else ''}")
    return rest


def _assemble(path: Path, read: Callable[[slice], np.ndarray], n: int, rest: int) -> Gaussians:
    """Return N Gaussians from structured rows, which are read in their order; DataError where a value cannot be used."""
    import torch

    k = rest // 3
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh": (1 + k, 3)}
    arrays = {name: np.empty((n, *shape), np.float32) for name, shape in shapes.items()}
    for part in parts(n):
        rows = read(part)

        columns = functools.partial(_columns, path, rows, part.start)
        arrays["sh"][part, 0] = columns(_DC)
        if rest:
            above = columns([f"f_rest_{i}" for i in range(rest)])
            arrays["sh"][part, 1:] = above.reshape(len(rows), 3, k).transpose(0, 2, 1)
        quats = arrays["quats"][part] = columns(_ROTATION)
        zero = ~quats.any(axis=1)
        if zero.any():
            raise ply_error(path, f"the rotation of Gaussian {part.start + int(np.argmax(zero))} has zero length")
        arrays["means"][part] = columns(_POSITION)
        arrays["log_scales"][part] = columns(_SCALE, least=FLAT)
        arrays["logit_opacities"][part] = columns(["opacity"], -OPAQUE, OPAQUE)[:, 0]
    return Gaussians(**{name: torch.from_numpy(array) for name, array in arrays.items()})


def _columns(
    path: Path, rows: np.ndarray, first: int, names: list[str] | tuple[str, ...], least: float = -np.inf, most: float = np.inf
) -> np.ndarray:
    """Return columns of structured rows, float32 [N, C]; infinities become ``least`` and ``most``.

    ``first`` is the number of the first row, for messages.
    """
    out = np.empty((len(rows), len(names)), np.float32)
    # A double beyond float32 becomes an infinity, and the check below names it.
    with np.errstate(over="ignore", invalid="ignore"):
        for i, name in enumerate(names):
            out[:, i] = rows[name]
    out[out == -np.inf], out[out == np.inf] = least, most
    bad = ~np.isfinite(out)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise ply_error(path, f"{names[column]} of Gaussian {first + row} is not finite in float32")
    return out


@register("ply")
class PLY(Format):
    """The PLY format; such a file may be compressed."""

    suffix = ".ply"
    description = "layout of Kerbl et al. 2023, float32; every tool"
    cleaned = False
    declares = True
    max_degree = 4

    def write(self, path: Path, gaussians: Gaussians, normalization: Normalization | None, units: str) -> None:
        """Write Gaussians with `write_ply`."""
        write_ply(path, gaussians, normalization, units=units, antialiased=self.antialiased)

    def read(self, path: Path, normalization: Normalization | None, units: str) -> Gaussians:
        """Read Gaussians with `read_ply`, or with `CompressedPLY` if the header announces that format.

        Raises:
            DataError: The file is missing or malformed.
        """
        if is_compressed(path, start_of(path)):
            return CompressedPLY().read(path, normalization, units)
        return _read(path, normalization, units)

    def is_antialiased(self, path: Path) -> bool:
        """Return whether the header declares antialiasing.

        Raises:
            DataError: The file is missing or not a PLY file.
        """
        return is_antialiased(start_of(path))
