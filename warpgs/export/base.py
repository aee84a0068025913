"""Formats of files of Gaussians: the interface, the arrays, the formats by suffix, and .splat."""

import copy
import io
import json
import math
import os
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from warpgs.errors import DataError, MalformedError, UsageError, expect, explained
from warpgs.files import open_input, read_input, write_bytes, write_json
from warpgs.geometry import checked_normalization, convert_gaussians, rotate
from warpgs.plugins import Registry, returned
from warpgs.scene import ORIGIN, Gaussians, Normalization, base_coefficients, base_colors, checked_origin

BYTES = (bytes, bytearray, memoryview)
"""Types of the pieces of a file."""
ROWS = 16384
"""Number of Gaussians decoded at a time, so that float64 copies of a whole model never exist."""
Arrays = dict[str, np.ndarray]
"""The five tensors of `Gaussians` by field name, as numpy arrays of any float type, means and log scales in file units."""

SH_SIZES = (1, 4, 9, 16)
"""Numbers of spherical-harmonics coefficients of degrees 0 to 3."""
SQRT2 = 1.4142135623730951
_AXES = (
    "", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x",
    "xy", "yz", "xy", "yz", "", "xz", "", "xz", "",
)  # fmt: skip
"""Axes that flip the sign of each harmonic, in the order of docs/sh.md."""


def malformed(path: Path, what: str) -> DataError:
    """Return a DataError about a file that does not match its suffix, with the fix."""
    return DataError(f"{path}: not a usable {path.suffix or 'model'} file: {what}. Export it again, or use another format")


def by_rows(n: int, shape: tuple[int, ...], rows: Callable[[slice], np.ndarray]) -> np.ndarray:
    """Return an array, float32 [n, *shape], made of pieces of at most `ROWS` rows that are requested in order.

    Values beyond float32 become infinities, which `gaussians_of` reports.
    """
    out = np.empty((n, *shape), np.float32)
    for part in parts(n):
        out[part] = rows(part)
    return out


def parts(n: int) -> Iterator[slice]:
    """Yield slices of at most `ROWS` rows that make up ``n``."""
    return (slice(start, min(start + ROWS, n)) for start in range(0, n, ROWS))


def arrays_of(gaussians: Gaussians) -> Arrays:
    """Return the tensors of Gaussians as arrays on the CPU."""
    return {name: t.detach().cpu().numpy() for name, t in gaussians.tensors().items()}


def origin_of(points: np.ndarray) -> np.ndarray:
    """Return the `Normalization.origin` [3] of points [N, 3] in file units, float64; 0 unless float32 is too coarse."""
    points = points[np.isfinite(points).all(1)]
    if not len(points):
        return np.zeros(3)
    low, high = np.percentile(points, [5, 95], axis=0)
    return Normalization((low + high) / 2, 1 / (float(np.linalg.norm(high - low)) or 1.0)).origin


def origin_comment(origin: np.ndarray | None, start: str = "comment") -> str:
    """Return the line of a text file that states an origin [3]; empty for 0."""
    return f"{start} {ORIGIN} {' '.join(map(repr, origin.tolist()))}\n" if origin is not None and origin.any() else ""


def side_file(path: Path) -> Path:
    """Return the file that holds the origin of a file in a format without a place for it."""
    return path.with_name(f"{path.name}.origin.json")


def from_origin(gaussians: Gaussians, origin: np.ndarray, normalization: Normalization, units: str) -> Gaussians:
    """Return Gaussians in file units about an ``origin`` [3] in scene units, or in file units: float64 unless it is 0."""
    if units == "file" and origin.any():
        tensors = {name: t.double() for name, t in gaussians.tensors().items()}
        return Gaussians(**tensors | {"means": tensors["means"] + tensors["means"].new_tensor(origin)})
    offset = np.asarray(normalization.offset, np.float64) - origin
    return convert_gaussians(gaussians, replace(normalization, offset=offset), "file", units)


def arrays_to_write(
    path: Path, gaussians: Gaussians, normalization: Normalization | None, units: str, origin: np.ndarray | None = None
) -> tuple[Arrays, np.ndarray]:
    """Return the tensors of Gaussians in file units about an origin, and the origin [3], for Gaussians not about it already.

    The tensors are checked before and after the conversion: it may overflow float32.
    """
    normalization = checked_normalization(normalization, units, f"{path}: not written")
    local = convert_gaussians(gaussians, normalization.local, units, "file")
    if origin is None:
        origin = normalization.origin
        if units == "file":
            # float32 has lost the digits that an origin would keep
            origin = origin_of(arrays_of(gaussians)["means"]) if gaussians.means.element_size() > 4 else np.zeros(3)
            moved = gaussians.means - gaussians.means.new_tensor(origin) if origin.any() else gaussians.means
            local = replace(gaussians, means=moved)
    for g in (gaussians, local):
        arrays = arrays_of(g)
        for name, array in arrays.items():
            if bad := array.size - int(np.isfinite(array).sum()):
                raise DataError(f"{path}: {bad} of {array.size} values of {name} are not finite; export an earlier checkpoint")
    logits = arrays["logit_opacities"]
    if logits.size and 0 <= logits.min() < logits.max() <= 1:
        words = "all logit_opacities are in [0, 1], as opacities are; ActivatedGaussians(...).stored() makes logits"
        warnings.warn(f"{path}: {words}", stacklevel=2)
    if origin.any():
        arrays = {name: array.astype(np.float32) for name, array in arrays.items()}
    return arrays, origin


def gaussians_of(
    path: Path, arrays: Arrays, strict: Callable[[], bool] = lambda: True, notes: list[str] | None = None
) -> Gaussians:
    """Return Gaussians of decoded arrays, as float32 tensors, without bad rows, which get a note.

    The reason of the first bad row is an error if `strict` asks for it, or if no Gaussian is left.
    """
    import torch

    with np.errstate(over="ignore", invalid="ignore"):  # values beyond float32 become infinities, which the error below names
        single = {name: np.ascontiguousarray(array, dtype=np.float32) for name, array in arrays.items()}
    bad, reason = np.zeros(len(single["means"]), bool), ""
    for name, array in single.items():
        for part in parts(len(array)):
            rows = ~np.isfinite(array[part]).reshape(len(array[part]), -1).all(axis=1)
            if rows.any():
                reason = reason or f"{name} of Gaussian {part.start + int(rows.argmax())} is not finite in float32"
                bad[part] |= rows
    zero = ~single["quats"].any(axis=1)
    if zero.any():
        reason = reason or f"the rotation of Gaussian {int(zero.argmax())} has zero length"
        bad |= zero
    if count := int(bad.sum()):
        if count == len(bad) or strict():
            raise malformed(path, reason)
        if notes is not None:
            notes.append(f"{path}: {count:,} of {len(bad):,} Gaussians left out, not finite or with a zero rotation ({reason})")
        single = {name: array[~bad] for name, array in single.items()}
    return Gaussians(**{name: torch.from_numpy(array) for name, array in single.items()})


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """Return 1 / (1 + exp(-x)) in float64 without overflow, in the shape [N] of ``logits``."""
    small = np.exp(-np.abs(logits.astype(np.float64)))
    return np.asarray(np.where(logits >= 0, 1, small) / (1 + small))


def logits(opacities: np.ndarray, quantum: float) -> np.ndarray:
    """Return finite log(p / (1 - p)) [N] in float64; 0 and 1 are moved inwards by a quarter of a quantum."""
    p = np.clip(opacities.astype(np.float64), 0.25 * quantum, 1 - 0.25 * quantum)
    return np.log(p) - np.log1p(-p)


def unit_quats(quats: np.ndarray) -> np.ndarray:
    """Return rotations [N, 4] of length 1 in float64; lengths from 1e-15 to 1e15 are fine, zero becomes the identity."""
    q = quats.astype(np.float64)
    length = np.sqrt((q * q).sum(axis=1, keepdims=True))
    return np.where(length > 0, q / np.where(length > 0, length, 1), [1.0, 0.0, 0.0, 0.0])


def smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split unit quaternions into the index of their largest component and the other three."""
    q = unit_quats(quats)
    largest = np.abs(q).argmax(axis=1)
    q = q * np.where(q[np.arange(len(q)), largest] < 0, -1.0, 1.0)[:, None]
    return largest, q[np.arange(4)[None] != largest[:, None]].reshape(len(q), 3)


def from_smallest_three(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the quaternions [N, 4] that `smallest_three` split."""
    q = np.empty((len(others), 4))
    keep = np.arange(4)[None] != largest[:, None]
    q[keep] = others.reshape(-1)
    q[~keep] = np.sqrt(np.clip(1 - (others * others).sum(axis=1), 0, None))
    return q


def half_turn(arrays: Arrays, axis: str) -> Arrays:
    """Turn Gaussians by 180 degrees about a coordinate axis: exact, and its own inverse."""
    copies = arrays | {name: np.array(arrays[name]) for name in ("means", "quats", "sh")}
    half_turn_in_place(copies, axis)
    return copies


def half_turn_in_place(arrays: Arrays, axis: str) -> None:
    """Turn arrays of a float type as `half_turn` does, without a copy."""
    turned = {a: 1.0 if a == axis else -1.0 for a in "xyz"}
    signs = np.array([turned[a] for a in "xyz"], np.float32)
    harmonics = np.array([np.prod([turned[a] for a in axes]) for axes in _AXES], np.float32)[: arrays["sh"].shape[1]]
    arrays["means"] *= signs
    arrays["quats"] *= np.concatenate([[1], signs]).astype(np.float32)
    arrays["sh"] *= harmonics[:, None]


def transform_in_place(arrays: Arrays, matrix: np.ndarray, offset: np.ndarray) -> None:
    """Map arrays of a float type by a similarity or a mirrored one: ``matrix`` [3, 3] and ``offset`` [3]."""
    import torch

    size = abs(np.linalg.det(matrix)) ** (1 / 3)
    for part in parts(len(arrays["means"])):
        rows = {name: np.asarray(array[part], np.float32) for name, array in arrays.items()}
        turned = rotate(Gaussians(**{name: torch.from_numpy(array) for name, array in rows.items()}), matrix / size)
        arrays["means"][part] = np.einsum("ij,nj->ni", matrix, rows["means"].astype(np.float64)) + offset
        arrays["quats"][part] = turned.quats.numpy() * rows["quats"].any(axis=1, keepdims=True)  # 0 stays 0
        arrays["log_scales"][part] += math.log(size)
        arrays["sh"][part] = turned.sh.numpy()


FLATTEST = -20.0
"""Least log scale that a format with steps stores, or as far below the largest: 2e-9 of a length is nothing to see, as in
splat-transform. Lower ones, of axes without length, would take the steps of the others."""


def with_least_scale(log_scales: np.ndarray) -> np.ndarray:
    """Return log scales [N, 3], at least `FLATTEST`."""
    return np.asarray(np.maximum(log_scales, min(FLATTEST, float(log_scales.max()) + FLATTEST), dtype=log_scales.dtype))


def rounded(values: np.ndarray, most: int) -> np.ndarray:
    """Return values [N, ...] rounded to integers and clamped to 0 .. ``most``, int64."""
    return np.clip(np.floor(values + 0.5), 0, most).astype(np.int64)


# The interface of a file format of Gaussians, and the formats by name.
#
# One module of `warpgs.export` holds one format and registers it. A format of your own is one class in one file, named
# as ``module:Class`` or ``path/to/file.py:Class``.

BROKEN = (
    struct.error, zlib.error, zipfile.BadZipFile, EOFError, ValueError, AttributeError, KeyError, TypeError, IndexError,
    OverflowError, NotImplementedError, RecursionError, RuntimeError, OSError,
)  # fmt: skip
"""Errors of decoders (standard library, zstandard, our own) about invalid content: zipfile reports encryption as RuntimeError,
unknown methods as NotImplementedError, and seeks before the start as OSError."""


@contextmanager
def reading(path: Path, whole: bool = False) -> Iterator[BinaryIO]:
    """Open a file, or read the ``whole`` file; errors of opening and of decoding become a DataError."""
    with explained(f"{path}: cannot be read", "check the path and its permissions"):
        file: BinaryIO = io.BytesIO(read_input(path)) if whole else open_input(path)
    try:
        with file, np.errstate(all="ignore"):  # infinities and NaN are named afterwards, with their Gaussian
            yield file
    except BROKEN as e:
        own = isinstance(e, MalformedError)
        raise malformed(path, str(e) if own else f"its content is invalid ({type(e).__name__}: {str(e)[:80]})") from e


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
    """True to have `decode` receive the open file instead of its bytes, as for an archive of several files."""
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
        self.strict = False
        """True to refuse a file with a Gaussian that cannot be rendered, instead of leaving the Gaussian out."""
        self.notes: list[str] = []
        """Notes for the user on the last file that was read."""
        self.origin: np.ndarray | None = None
        """Point [3] in file units about which the Gaussians are that are written or were last read; None to choose one."""

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

    def origin_in(self, path: Path) -> object:
        """Return the origin that a file states; None without one. By default it is in a side file."""
        if not (side := side_file(path)).is_file():
            return None
        with reading(side, whole=True) as file:
            values = json.loads(file.read())
        return values.get(ORIGIN, values) if isinstance(values, dict) else values

    def is_own(self, path: Path) -> bool:
        """Return whether warpgs wrote a file, so that bad numbers mean damage; False if the format cannot tell."""
        return False

    def fits(self, path: str | os.PathLike[str]) -> bool:
        """Return whether a file name has the suffix of the format."""
        return Path(path).name.lower().endswith(self.suffix)

    def size(self, path: Path) -> int:
        """Return the bytes of a model on disk."""
        return path.stat().st_size

    def store(self, path: Path, pieces: Iterable[bytes]) -> None:
        """Write the pieces of a file, replacing an existing one."""
        write_bytes(path, *pieces)

    def write(self, path: Path, gaussians: Gaussians, normalization: Normalization | None, units: str) -> None:
        """Write Gaussians, with the arguments of `warpgs.export.write_gaussians`.

        Raises:
            DataError: There are no Gaussians, a number is not finite or cannot be stored, or the degree is too high.
        """
        if not len(gaussians):
            raise DataError(f"{path}: not written, the model holds no Gaussian. Use .ply for an empty model")
        arrays, self.origin = arrays_to_write(path, gaussians, normalization, units, self.origin)
        if self.max_degree == 0:
            arrays["sh"] = arrays["sh"][:, :1]
        elif gaussians.sh_degree > self.max_degree:
            raise DataError(f"{path}: degree {gaussians.sh_degree} is too high; give --sh-degree {self.max_degree}, or .ply")
        pieces = returned(self, "encode", self.encode(arrays), Iterable, "an iterable of bytes")
        self.store(path, [returned(self, "encode", p, BYTES, "an iterable of bytes") for p in pieces])
        if type(self).origin_in is Format.origin_in:
            if self.origin.any():
                write_json(side_file(path), {ORIGIN: self.origin.tolist()})
            else:
                side_file(path).unlink(missing_ok=True)

    def read(self, path: Path, normalization: Normalization | None, units: str) -> Gaussians:
        """Read Gaussians, with the arguments of `warpgs.export.read_gaussians`.

        Raises:
            DataError: The file is missing or malformed.
        """
        normalization = checked_normalization(normalization, units, str(path))
        return from_origin(self.read_stored(path), np.zeros(3) if self.origin is None else self.origin, normalization, units)

    def read_stored(self, path: Path) -> Gaussians:
        """Read Gaussians in file units about `origin`, which this sets, as float32."""
        self.notes = []
        with reading(path, whole=not self.archive) as file:
            arrays = self.decode(path, file if self.archive else file.read())
            what, names = "an array for each tensor of Gaussians, by name", Gaussians.__dataclass_fields__
            returned(self, "decode", arrays, Mapping, what, each=np.ndarray, names=names)
            returned(self, "decode", {n: arrays.get(n) for n in names}, Mapping, what, each=np.ndarray)
        with reading(path):
            stated = self.origin_in(path)
        self.origin = np.zeros(3) if stated is None else checked_origin(stated, str(path))
        if (means := arrays["means"]).dtype == np.float64 and (middle := origin_of(means[:ROWS])).any():
            with np.errstate(over="ignore", invalid="ignore"):
                moved = np.subtract(means, middle, out=np.empty(means.shape, np.float32), casting="same_kind")
            arrays, self.origin = arrays | {"means": moved}, self.origin + middle
        return gaussians_of(path, arrays, lambda: self.strict or self.is_own(path), self.notes)


FORMATS: Registry[Format] = Registry("format", Format, __package__)
"""File formats of Gaussians by name; those in the modules of `warpgs.export` are built in."""
register = register_format = FORMATS.register


# The .splat format of antimatter15's viewer: 32 bytes a Gaussian, without spherical harmonics above degree 0.
#
# Position and axis lengths as float32, colour and opacity as bytes, rotation wxyz as bytes (128 is 0). Axes are those
# of PLY.

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
_TINY = 1e-37
"""Least axis length that is written and read: the logarithm of 0 is not finite."""


@register("splat")
class Splat(Format):
    """The .splat format."""

    suffix = ".splat"
    description = "antimatter15, 8 bits, no view-dependent colours; small viewers"
    max_degree = 0

    def encode(self, arrays: Arrays) -> list[bytes]:
        """Return the bytes of a file; harmonics above degree 0 are lost, and colours outside of [0, 1] clamped."""
        rows = np.empty(len(arrays["means"]), _ROW)
        rows["mean"] = arrays["means"]
        rows["scale"] = np.clip(np.exp(arrays["log_scales"].astype(np.float64)), _TINY, 3e38)
        rows["rgba"][:, :3] = rounded(255 * base_colors(arrays["sh"][:, :1].astype(np.float64)), 255)
        rows["rgba"][:, 3] = rounded(255 * sigmoid(arrays["logit_opacities"]), 255)
        rows["quat"] = rounded(128 * unit_quats(arrays["quats"]) + 128, 255)
        return [rows.tobytes()]

    def decode(self, path: Path, data: bytes) -> Arrays:
        """Return the Gaussians of a file's bytes."""
        expect(data, "it is empty")
        expect(len(data) % _ROW.itemsize == 0, f"its {len(data)} bytes are not a multiple of {_ROW.itemsize}")
        rows = np.frombuffer(data, _ROW)
        n = len(rows)
        for part in parts(n):
            negative = (rows["scale"][part] < 0).any(1)
            expect(not negative.any(), f"an axis of Gaussian {part.start + int(negative.argmax())} has a negative length")
        return {
            "means": by_rows(n, (3,), lambda p: rows["mean"][p]),
            "quats": by_rows(n, (4,), lambda p: (rows["quat"][p].astype(np.float64) - 128) / 128),
            "log_scales": by_rows(n, (3,), lambda p: np.log(np.maximum(rows["scale"][p].astype(np.float64), _TINY))),
            "logit_opacities": by_rows(n, (), lambda p: logits(rows["rgba"][p, 3] / 255, 1 / 255)),
            "sh": by_rows(n, (1, 3), lambda p: base_coefficients(rows["rgba"][p, None, :3].astype(np.float64) / 255)),
        }


def all_formats() -> list[Format]:
    """Return every registered format with its default options: longer suffixes first, so .compressed.ply before .ply."""
    found = [FORMATS.find(name)() for name in FORMATS.names()]
    return sorted(found, key=lambda f: (-len(f.suffix), not type(f).__module__.startswith("warpgs."), f.suffix))


def suffixes() -> list[str]:
    """Return the suffix of every registered format, the longer ones first."""
    return [f.suffix for f in all_formats()]


def find_format(choice: str | type[Format] | Format) -> Format:
    """Return a format that is given as a name, ``module:Class``, ``path/to/file.py:Class``, a class or an object.

    A string with a colon imports the module or file, which runs its code: never pass a string from an untrusted file.
    """
    if not isinstance(choice, (str, type, Format)):
        raise UsageError(f"{choice!r} is not a format; give a name, module:Class, or a class or object of warpgs.Format")
    kind = FORMATS.load(choice) if isinstance(choice, str) else choice if isinstance(choice, Format) else FORMATS.find(choice)
    found = kind if isinstance(kind, Format) else kind()
    if not re.fullmatch(r"(\.[a-z0-9_-]+)+", found.suffix):
        raise UsageError(f"the suffix {found.suffix!r} of {type(found).__name__} must be a dot and lower-case letters, digits")
    return found


def format_of(path: str | os.PathLike[str], choice: str | type[Format] | Format | None = None) -> Format:
    """Return the given format, or else the format of the file's suffix."""
    if choice is not None:
        chosen = find_format(choice)
        if not chosen.fits(path):
            raise UsageError(f"{path}: expected a name that ends in {chosen.suffix}, for the format {chosen.name}")
        return chosen
    known = all_formats()
    if (kind := next((k for k in known if k.fits(path)), None)) is not None:
        return kind
    name = Path(path).name.lower()
    if (Path(path) / "meta.json").is_file():
        raise UsageError(f"{path}: is the folder of a SOG model; give {Path(path) / 'meta.json'}")
    cameras = "; cameras are named cameras.json, transforms.json or sparse" if name.endswith(".json") else ""
    one = f"use one of {', '.join(k.suffix for k in known)}, or give a format of your own{cameras}"
    raise UsageError(f"{path}: format {Path(path).suffix or '(none)'} is not supported; {one}")


def write_gaussians(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    normalization: Normalization | None = None,
    *,
    units: str = "scene",
    format: str | type[Format] | Format | None = None,
    antialiased: bool = False,
) -> None:
    """Write Gaussians to a file, in the format of its suffix and in the units of the scene's files.

    The order of the Gaussians is kept. The write is atomic.

    Args:
        path: The file; an existing one is replaced.
        gaussians: N Gaussians, on any device; at least one, except in a .ply file.
        normalization: Similarity from file to scene units; needed where ``units`` is scene.
        units: Units of ``gaussians``: scene, or file to write them unchanged.
        format: Name of a format, or a `Format` of your own: an object, a class, ``module:Class`` or
            ``path/to/file.py:Class``. None for the format of the suffix.
        antialiased: True for Gaussians to be rendered with `RasterizeOptions.antialiased`. PLY, SPZ and SOG declare it.

    Raises:
        warpgs.DataError: A tensor contains a non-finite number, or one that the format cannot store; there are no
            Gaussians; or their spherical-harmonics degree is too high for the format.
        warpgs.ResourceError: The file cannot be written.
        TypeError: The Gaussians have other parameters; ``stored()`` of `ActivatedGaussians` converts them.
        warpgs.UsageError: The suffix, the format or the units are unknown, or scene units are given without a
            normalization.
        ValueError: A tensor has the wrong shape.
    """
    chosen = copy.copy(format_of(path, format))
    chosen.antialiased = antialiased
    chosen.write(Path(path), gaussians, normalization, units)


def read_gaussians(
    path: str | os.PathLike[str],
    normalization: Normalization | None = None,
    *,
    units: str | None = None,
    format: str | type[Format] | Format | None = None,
    strict: bool = False,
) -> Gaussians:
    """Read Gaussians from a file, in the format of its suffix; a .ply file may be compressed.

    A file that declares antialiasing causes a warning: render it with `RasterizeOptions.antialiased`. A Gaussian is not
    usable if it has a NaN, an infinity that `read_ply` does not replace, or a rotation of zero length. In files of other
    programs, such Gaussians are left out, and a warning counts them. In files of warpgs, they are an error.

    Args:
        path: The file.
        normalization: Similarity from file to scene units; needed where ``units`` is scene.
        units: Units of the result: file as stored, or scene to go with a scene's cameras; None for scene if a normalization is
            given, else file.
        format: As in `write_gaussians`.
        strict: True to refuse every file with a Gaussian that is not usable.

    Returns:
        N Gaussians, torch tensors on the CPU: float32, or float64 for map coordinates in file units.

    Raises:
        warpgs.DataError: The file is missing, malformed or truncated; it declares more data than its size allows; or it has
            no usable Gaussian. For files of warpgs, and with ``strict``, also: a Gaussian is not usable.
        warpgs.UsageError: The suffix, the format or the units are unknown, or scene units are given without a
            normalization.
    """
    units = units or ("file" if normalization is None else "scene")
    return read_with_warnings(Path(path), normalization, units, format, strict)


def read_with_warnings(path: Path, *how: Any) -> Gaussians:
    """Read Gaussians with the arguments of `read_with_antialiasing`; warnings point to the caller of the calling function."""
    gaussians, antialiased, notes = read_with_antialiasing(path, *how)
    words = f"{path}: its Gaussians are antialiased; render them with RasterizeOptions(antialiased=True)"
    for note in [words] * antialiased + notes:
        warnings.warn(note, stacklevel=3)
    return gaussians


def read_with_antialiasing(
    path: Path, normalization: Normalization | None, units: str, format: str | type[Format] | Format | None = None,
    strict: bool = False,
) -> tuple[Gaussians, bool, list[str]]:  # fmt: skip
    """Return the result of `read_gaussians`, whether the file declares antialiasing, and notes for the user."""
    chosen = copy.copy(format_of(path, format))
    chosen.strict, chosen.notes, chosen.origin = strict, [], None
    return chosen.read(path, normalization, units), chosen.is_antialiased(path), chosen.notes
