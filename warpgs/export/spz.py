"""Niantic's SPZ format, versions 2 to 4, in fixed point: about 20 bytes a Gaussian, and one byte per harmonic and channel.

Versions 2 and 3 are one gzip stream; version 4 has a plain header and one zstd stream per attribute (package zstandard). Axes
are RUB (x right, y up, z back), a half turn about x from those of PLY.
"""

import functools
import gzip
import io
import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from warpgs.errors import DataError, MalformedError, UsageError, expect, explained, install_extras
from warpgs.export import base

Section = Callable[[int], bytes]
"""Function that returns the next bytes of a section, exactly as many as are requested."""
VERSION = 3
"""Version that is written by default: gzip, which old programs read, too."""
VERSIONS = (2, 3, 4)
"""Versions that are read and written."""
MAGIC = 0x5053474E
HEADER, HEADER_4 = struct.Struct("<IIIBBBB"), struct.Struct("<IIIBBBBI12x")
COLOR = 0.15 * 255
MAX_FRACTIONAL_BITS = 24
ANTIALIASED, EXTENDED = 1, 2
"""Flags of the header."""
COORDINATE_SYSTEM, RUB = 0xADBE0003, 4
"""Type of the extension that names the axes, and the number of its default."""
MAX_EXTENSIONS = 65536
"""Largest size of the extensions [bytes]; real ones have some ten."""
MAX_WINDOW = 2**26
"""Largest window of a zstd stream [bytes]."""
MAX_RATIO, SMALL = 32, 65536
"""Largest ratio of unpacked to packed bytes, and unpacked bytes that are always allowed: real files have a ratio of 2 or 3, a
bomb 1000."""


def fractional_bits(means: np.ndarray) -> int:
    """Return the number of fractional bits, at most 24, at which all coordinates [N, 3] just fit into 24 signed bits."""
    largest = float(np.abs(means).max(initial=0))
    bits = MAX_FRACTIONAL_BITS
    while bits >= 0 and largest * 2.0**bits > 2**23 - 1:
        bits -= 1
    if bits < 0:
        raise DataError(f"SPZ coordinates reach 8388607, and one is {largest:.0f}; move the scene to the origin, or write .ply")
    return bits


def _sections(a: base.Arrays, bits: int, version: int) -> list[bytes]:
    """Return the attributes of RUB Gaussians in file order."""
    fixed = np.floor(a["means"].astype(np.float64) * 2.0**bits + 0.5).astype("<i4")
    colors = base.rounded(COLOR * a["sh"][:, 0].astype(np.float64) + 127.5, 255)
    xyzw = base.unit_quats(a["quats"])[:, [1, 2, 3, 0]]
    if version == 2:
        rotations = base.rounded(127.5 * (xyzw * np.where(xyzw[:, 3:] < 0, -1, 1))[:, :3] + 127.5, 255).astype("u1").tobytes()
    else:
        largest, others = base.smallest_three(xyzw)
        packed = largest << 30
        for i in range(3):
            size = base.rounded(511 * base.SQRT2 * np.abs(others[:, i]), 511)
            packed |= (size | ((others[:, i] < 0).astype(np.int64) << 9)) << (10 * (2 - i))
        rotations = packed.astype("<u4").tobytes()
    return [
        fixed.view("u1").reshape(-1, 4)[:, :3].tobytes(),
        base.rounded(255 * base.sigmoid(a["logit_opacities"]), 255).astype("u1").tobytes(),
        colors.astype("u1").tobytes(),
        base.rounded(16 * (a["log_scales"].astype(np.float64) + 10), 255).astype("u1").tobytes(),
        rotations,
        base.rounded(128 * a["sh"][:, 1:].astype(np.float64) + 128, 255).astype("u1").tobytes(),
    ]


def encode(arrays: base.Arrays, version: int = VERSION, antialiased: bool = False) -> list[bytes]:
    """Return the bytes of a file."""
    if version not in VERSIONS:
        raise UsageError(f"SPZ version {version}: choose one of {', '.join(map(str, VERSIONS))}")
    a = base.half_turn({k: np.asarray(v) for k, v in arrays.items()}, "x")
    bits, n = fractional_bits(a["means"]), len(a["means"])
    sections, degree = _sections(a, bits, version), math.isqrt(a["sh"].shape[1]) - 1
    if version < 4:
        body = HEADER.pack(MAGIC, version, n, degree, bits, int(antialiased), 0) + b"".join(sections)
        return [gzip.compress(body, compresslevel=6, mtime=0)]
    compressor = _zstandard().ZstdCompressor(level=12)
    sections = [s for s in sections if s]
    streams = [compressor.compress(s) for s in sections]
    toc = b"".join(struct.pack("<QQ", len(c), len(s)) for c, s in zip(streams, sections))
    return [HEADER_4.pack(MAGIC, 4, n, degree, bits, int(antialiased), len(streams), HEADER_4.size), toc, *streams]


def decode(path: Path, data: bytes) -> base.Arrays:
    """Return the Gaussians of a file's bytes, in the axes of PLY."""
    packed = data[:2] == b"\x1f\x8b"
    stream: BinaryIO = gzip.GzipFile(fileobj=io.BytesIO(data)) if packed else io.BytesIO(data)
    layout, versions = (HEADER, (2, 3)) if packed else (HEADER_4, (4,))
    head = stream.read(layout.size)
    expect(len(head) == layout.size, "its header is truncated")
    magic, version, n, degree, bits, flags, *places = layout.unpack(head)
    sizes = _checked(len(data), (magic, version, n, degree, bits), versions)
    extensions = bytearray(data[layout.size : places[1]] if flags & EXTENDED and not packed else b"")
    more = extensions if flags & EXTENDED else None
    sections = _parts_of_gzip(stream, n, sizes, more) if packed else _streams(data, sizes, *places)
    arrays = _unpack(sections, n, degree, bits, version)
    next(sections, None)  # checks the end of the last section
    if (system := _coordinate_system(extensions)) == RUB:
        base.half_turn_in_place(arrays, "x")
    else:
        base.transform_in_place(arrays, to_ply(system), np.zeros(3))
    return arrays


def to_ply(system: int) -> np.ndarray:
    """Return the matrix [3, 3] from one of the 16 coordinate systems to the axes of PLY, as Niantic's library has it.

    The bits of the number less 1 are right, up and front. From 9 on, the library then adds a quarter turn about x. As a
    result, its names of 9 and 10 (front, down), and of 15 and 16 (back, up), are swapped; files follow the library.
    """
    bits = system - 1
    signs = np.diag([1.0 if bits & 1 else -1.0, -1.0 if bits & 2 else 1.0, 1.0 if bits & 4 else -1.0])
    return signs[[0, 2, 1]] * [[1], [1], [-1]] if bits & 8 else signs


def _coordinate_system(extensions: bytes | bytearray) -> int:
    """Return the number of the coordinate system that the extensions name; others are skipped, as is a truncated end."""
    at = 0
    while at + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, at)
        at += 8 + size
        if kind == COORDINATE_SYSTEM and size >= 4 and at <= len(extensions):
            system = int.from_bytes(extensions[at - size : at - size + 4], "little")
            expect(system <= 16, f"its coordinate system {system} is unknown (known: 1 to 16)")
            return system or RUB
    return RUB


def _parts_of_gzip(stream: BinaryIO, n: int, sizes: list[int], extensions: bytearray | None) -> Iterator[Section]:
    """Yield the sections of a file of version 2 or 3, each to be read to its end before the next; then fill ``extensions``."""

    def read(size: int) -> bytes:
        data = stream.read(size)
        expect(len(data) == size, f"{n} Gaussians need {sum(sizes)} bytes, but the file has fewer")
        return data

    for _ in sizes:
        yield read
    if extensions is not None:
        extensions += stream.read(MAX_EXTENSIONS)
    # at its end the checksum has been compared
    expect(not stream.read(1), f"{n} Gaussians need {sum(sizes)} bytes, but the file has more")


def _checked(size: int, header: tuple[int, ...], versions: tuple[int, ...]) -> list[int]:
    """Return the sizes of the sections [bytes]; `MalformedError` where the header does not fit a file of ``size`` bytes."""
    magic, version, n, degree, bits = header
    expect(magic == MAGIC, "it does not start with the SPZ signature")
    expect(version in versions, f"version {version} is not supported here (supported: {', '.join(map(str, versions))})")
    expect(degree <= 4, f"harmonics of degree {degree} are not supported (supported: 0 to 4)")
    expect(bits <= MAX_FRACTIONAL_BITS, f"its coordinates have {bits} fractional bits, more than {MAX_FRACTIONAL_BITS}")
    sizes = [9 * n, n, 3 * n, 3 * n, (3 if version == 2 else 4) * n, 3 * degree * (degree + 2) * n]
    expect(sum(sizes) <= MAX_RATIO * size + SMALL, f"it announces {n} Gaussians in only {size} bytes")
    return sizes


def _streams(data: bytes, sizes: list[int], count: int, place: int) -> Iterator[Section]:
    """Yield the sections of a version-4 file, each to be read to its end before the next; an empty section has no stream."""
    sound = count == len([s for s in sizes if s]) and place >= HEADER_4.size and place + 16 * count <= len(data)
    expect(sound, f"its table of {count} streams at byte {place} is invalid")
    decompressor = _zstandard().ZstdDecompressor(max_window_size=MAX_WINDOW)
    view, i, start = memoryview(data), 0, place + 16 * count
    for size in sizes:
        if not size:
            yield bytes
            continue
        packed, plain = struct.unpack_from("<QQ", data, place + 16 * i)
        fits = plain == size and start + packed <= len(data)
        expect(fits, f"stream {i} announces {packed} packed and {plain} unpacked bytes, not {size} unpacked")
        with decompressor.stream_reader(view[start : start + packed]) as reader:
            yield functools.partial(_decompressed, reader, i, size)
            expect(not _decompressed(reader, i, size, 1, end=True), f"stream {i} does not hold its {size} bytes")
        i, start = i + 1, start + packed


def _decompressed(reader: BinaryIO, i: int, whole: int, size: int, *, end: bool = False) -> bytes:
    """Return the next ``size`` of ``whole`` bytes of the i-th stream; fewer at its end."""
    try:
        data = reader.read(size)
    except _zstandard().ZstdError as e:
        raise MalformedError(f"stream {i} is not a zstd stream, or asks for more than {MAX_WINDOW >> 20} MiB") from e
    expect(len(data) == size or end, f"stream {i} does not hold its {whole} bytes")
    return data


def _unpack(sections: Iterator[Section], n: int, degree: int, bits: int, version: int) -> base.Arrays:
    """Return the Gaussians of the sections, in RUB axes."""

    def take(width: int, shape: tuple[int, ...], make: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        read = next(sections)
        return base.by_rows(n, shape, lambda p: make(np.frombuffer(read((p.stop - p.start) * width), "u1").reshape(-1, width)))

    means = take(9, (3,), lambda data: _fixed(data) / 2.0**bits)
    opacities = take(1, (), lambda data: base.logits(data[:, 0] / 255, 1 / 255))
    k = degree * (degree + 2)
    read, sh = next(sections), np.empty((n, k + 1, 3), np.float32)
    for p in base.parts(n):
        sh[p, 0] = (np.frombuffer(read((p.stop - p.start) * 3), "u1").reshape(-1, 3) - 127.5) / COLOR
    scales = take(3, (3,), lambda data: data / 16 - 10)
    quats = take(3, (4,), _quats_2) if version == 2 else take(4, (4,), _quats)
    read = next(sections)
    for p in base.parts(n):
        rest = np.frombuffer(read((p.stop - p.start) * 3 * k), "u1").reshape(p.stop - p.start, k, 3)
        sh[p, 1:] = (rest.astype(np.float64) - 128) / 128
    return {"means": means, "quats": quats, "log_scales": scales, "logit_opacities": opacities, "sh": sh}


def _fixed(data: np.ndarray) -> np.ndarray:
    """Return signed 24-bit coordinates, bytes [P, 9], as integers [P, 3]."""
    fixed = np.zeros((len(data), 3, 4), "u1")
    fixed[:, :, 1:] = data.reshape(-1, 3, 3)  # in the upper bytes, since an arithmetic shift down keeps the sign
    return fixed.reshape(-1, 12).view("<i4") >> 8


def _quats_2(data: np.ndarray) -> np.ndarray:
    """Return rotations wxyz [P, 4] from the bytes [P, 3] of version 2."""
    xyz = data / 127.5 - 1
    return np.concatenate([np.sqrt(np.clip(1 - (xyz * xyz).sum(1, keepdims=True), 0, None)), xyz], 1)


def _quats(data: np.ndarray) -> np.ndarray:
    """Return rotations wxyz [P, 4] from the bytes [P, 4] of versions 3 and 4."""
    packed = np.ascontiguousarray(data).view("<u4")[:, 0].astype(np.int64)
    components = np.stack([(packed >> s) & 1023 for s in (20, 10, 0)], 1)
    fractions = np.where(components & 512, -1, 1) * (components & 511) / (511 * base.SQRT2)
    return base.from_smallest_three(packed >> 30, fractions)[:, [3, 0, 1, 2]]


def _zstandard():
    """Return the module zstandard; UsageError where it is missing."""
    fix = f"{install_extras('formats')}, or use version 3"
    with explained("SPZ version 4 needs zstandard", fix, ImportError, UsageError):
        import zstandard
    return zstandard


@dataclass(frozen=True)
class SPZConfig:
    """Options of the SPZ format."""

    version: int = VERSION
    """Version of the format to write: 2, 3, or 4, which needs zstandard (the extra ``formats``)."""


@base.register("spz")
class SPZ(base.Format):
    """The SPZ format."""

    suffix = ".spz"
    description = "Niantic, fixed point and 8 bits, gzip; Scaniverse, Babylon.js, SuperSplat"
    Config = SPZConfig
    sorted = True
    declares = True
    max_degree = 4
    note = "SPZ has y up, as Niantic defines it; SuperSplat, gsply and others take y as down: for them pass --rotate 1,0,0,180"
    decode = staticmethod(decode)

    def encode(self, arrays: base.Arrays) -> list[bytes]:
        """Return the bytes of a file of the version that the options name."""
        return encode(arrays, self.config.version, self.antialiased)

    def is_antialiased(self, path: Path) -> bool:
        """Return whether the header declares antialiasing."""
        with base.reading(path) as file:
            packed = file.read(2) == b"\x1f\x8b"
            file.seek(0)
            head = (gzip.GzipFile(fileobj=file) if packed else file).read(HEADER.size)
            return bool(HEADER.unpack(head)[5] & ANTIALIASED)
