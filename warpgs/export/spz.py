"""Niantic's SPZ format, versions 2 to 4, in fixed point: about 20 bytes a Gaussian, and one more per harmonic and channel.

Versions 2 and 3 are one gzip stream; version 4 has a plain header and one zstd stream per attribute (package zstandard). Axes
are RUB (x right, y up, z back), a half turn about x from those of PLY.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from itertools import pairwise
from pathlib import Path

import numpy as np

from warpgs.errors import DataError, UsageError
from warpgs.export.arrays import (
    SH_SIZES,
    SQRT2,
    Arrays,
    from_smallest_three,
    half_turn,
    logits,
    malformed,
    rounded,
    sigmoid,
    smallest_three,
    unit_quats,
)

VERSION = 3
"""Version that is written where none is asked for: programs of any age read gzip."""
VERSIONS = (2, 3, 4)
"""Versions that are read and written."""
MAGIC = 0x5053474E
HEADER, HEADER_4 = struct.Struct("<IIIBBBB"), struct.Struct("<IIIBBBBI12x")
COLOR = 0.15 * 255
MAX_FRACTIONAL_BITS = 24
MAX_WINDOW = 2**27
"""Most memory that a zstd stream may ask for [bytes]."""
MAX_RATIO, SMALL = 32, 65536
"""Most bytes that a byte of a file may unpack to, and bytes that any file may: real ones have 2 or 3, a bomb has 1000."""


def fractional_bits(means: np.ndarray) -> int:
    """Return the finest resolution, 2^-bits, at which all coordinates [N, 3] fit into 24 signed bits; at most 2^-24.

    Raises:
        DataError: A coordinate is beyond 2^23, which the format cannot hold.
    """
    largest = float(np.abs(means).max(initial=0))
    bits = MAX_FRACTIONAL_BITS
    while bits >= 0 and largest * 2.0**bits > 2**23 - 1:
        bits -= 1
    if bits < 0:
        raise DataError(
            f"SPZ holds coordinates up to 8388607, and one is {largest:.0f}: move the scene to its origin, or use .ply"
        )
    return bits


def _sections(a: Arrays, bits: int, version: int) -> list[bytes]:
    """Return the attributes of RUB Gaussians in file order."""
    fixed = np.floor(a["means"].astype(np.float64) * 2.0**bits + 0.5).astype("<i4")
    colors = rounded(COLOR * a["sh"][:, 0].astype(np.float64) + 127.5, 255)
    scales = rounded(16 * (a["log_scales"].astype(np.float64) + 10), 255)
    xyzw = unit_quats(a["quats"])[:, [1, 2, 3, 0]]
    if version == 2:
        positive = xyzw * np.where(xyzw[:, 3:] < 0, -1, 1)
        rotations = rounded(127.5 * positive[:, :3] + 127.5, 255).astype("u1").tobytes()
    else:
        largest, others = smallest_three(xyzw)
        packed = largest << 30
        for i in range(3):
            size = rounded(511 * SQRT2 * np.abs(others[:, i]), 511)
            packed |= (size | ((others[:, i] < 0).astype(np.int64) << 9)) << (10 * (2 - i))
        rotations = packed.astype("<u4").tobytes()
    return [
        fixed.view("u1").reshape(-1, 4)[:, :3].tobytes(),
        rounded(255 * sigmoid(a["logit_opacities"]), 255).astype("u1").tobytes(),
        colors.astype("u1").tobytes(),
        scales.astype("u1").tobytes(),
        rotations,
        rounded(128 * a["sh"][:, 1:].astype(np.float64) + 128, 255).astype("u1").tobytes(),
    ]


def encode(arrays: Arrays, version: int = VERSION) -> list[bytes]:
    """Return the bytes of a file.

    Args:
        arrays: The Gaussians, in the axes of PLY.
        version: 2, 3 or 4.

    Raises:
        DataError: A coordinate is too large for the format.
        UsageError: The version is unknown, or needs zstandard, which is not installed.
    """
    if version not in VERSIONS:
        raise UsageError(f"SPZ version {version}: choose one of {', '.join(map(str, VERSIONS))}")
    a = half_turn({k: np.asarray(v) for k, v in arrays.items()}, "x")
    bits, n = fractional_bits(a["means"]), len(a["means"])
    sections, degree = _sections(a, bits, version), math.isqrt(a["sh"].shape[1]) - 1
    if version < 4:
        body = HEADER.pack(MAGIC, version, n, degree, bits, 0, 0) + b"".join(sections)
        return [gzip.compress(body, compresslevel=6, mtime=0)]
    compressor = _zstandard().ZstdCompressor(level=12)
    sections = [s for s in sections if s]
    streams = [compressor.compress(s) for s in sections]
    toc = b"".join(struct.pack("<QQ", len(c), len(s)) for c, s in zip(streams, sections))
    return [HEADER_4.pack(MAGIC, 4, n, degree, bits, 0, len(streams), HEADER_4.size), toc, *streams]


def decode(path: Path, data: bytes) -> Arrays:
    """Return the Gaussians of a file's bytes, in the axes of PLY.

    Raises:
        DataError: The file is malformed, cut short, or announces more than its size can hold.
        UsageError: It is of version 4, and zstandard is not installed.
    """
    if data[:2] == b"\x1f\x8b":
        stream = zlib.decompressobj(31)
        head = stream.decompress(data, HEADER.size)
        if len(head) < HEADER.size:
            raise malformed(path, "its header is cut short")
        magic, version, n, degree, bits, flags, _ = HEADER.unpack(head)
        sizes = _checked(path, len(data), (magic, version, n, degree, bits, flags), (2, 3))
        body = stream.decompress(stream.unconsumed_tail, sum(sizes) + 1)
        if len(body) != sum(sizes) or not stream.eof:  # at its end zlib has compared the checksum
            what = "more" if len(body) > sum(sizes) else "fewer, or its end is cut off"
            raise malformed(path, f"{n} Gaussians need {sum(sizes)} bytes, it has {what}")
        ends = np.cumsum([0, *sizes]).tolist()
        sections = [body[i:j] for i, j in pairwise(ends)]
    else:
        if len(data) < HEADER_4.size:
            raise malformed(path, "its header is cut short")
        magic, version, n, degree, bits, flags, count, place = HEADER_4.unpack_from(data)
        sizes = _checked(path, len(data), (magic, version, n, degree, bits, flags), (4,))
        sections = _streams(path, data, sizes, count, place)
    return half_turn(_unpack(sections, n, degree, bits, version), "x")


def _checked(path: Path, size: int, header: tuple[int, ...], versions: tuple[int, ...]) -> list[int]:
    """Return the sizes of the sections [bytes]; DataError where the header cannot be true of a file of ``size`` bytes."""
    magic, version, n, degree, bits, flags = header
    if magic != MAGIC:
        raise malformed(path, "it does not start as SPZ does")
    if version not in versions:
        raise malformed(path, f"it is of version {version} here, and this reads {', '.join(map(str, versions))}")
    if degree > 3:
        raise malformed(path, f"its harmonics are of degree {degree}, and this reads degrees 0 to 3")
    if bits > MAX_FRACTIONAL_BITS:
        raise malformed(path, f"its coordinates have {bits} fractional bits of 24")
    sizes = [9 * n, n, 3 * n, 3 * n, (3 if version == 2 else 4) * n, 3 * (SH_SIZES[degree] - 1) * n]
    if sum(sizes) > MAX_RATIO * size + SMALL:
        raise malformed(path, f"{n} Gaussians in {size} bytes")
    if flags & 1:
        raise malformed(path, "it was trained with antialiasing (mip-splatting), which this program does not render")
    return sizes


def _streams(path: Path, data: bytes, sizes: list[int], count: int, place: int) -> list[bytes]:
    """Return the sections of a version-4 file; an empty section has no stream."""
    wanted = [s for s in sizes if s]
    if count != len(wanted) or place < HEADER_4.size or place + 16 * count > len(data):
        raise malformed(path, f"its table of {count} streams at byte {place} makes no sense")
    zstandard = _zstandard()
    decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
    out, start = [], place + 16 * count
    for i, size in enumerate(wanted):
        packed, plain = struct.unpack_from("<QQ", data, place + 16 * i)
        if plain != size or start + packed > len(data):
            raise malformed(path, f"stream {i} announces {packed} bytes that become {plain}, not {size}")
        try:
            with decompressor.stream_reader(data[start : start + packed]) as reader:
                section = reader.read(size + 1)  # never more than was announced, whatever the frame says
        except zstandard.ZstdError as e:
            raise malformed(path, f"stream {i} is no zstd stream") from e
        if len(section) != size:
            raise malformed(path, f"stream {i} does not hold its {size} bytes")
        out.append(section)
        start += packed
    rest = iter(out)
    return [next(rest) if s else b"" for s in sizes]


def _unpack(sections: list[bytes], n: int, degree: int, bits: int, version: int) -> Arrays:
    """Return the Gaussians of the sections, in RUB axes."""
    positions, alphas, colors, scales, rotations, rest = (np.frombuffer(s, "u1") for s in sections)
    fixed = np.zeros((n, 3, 4), "u1")
    fixed[:, :, 1:] = positions.reshape(n, 3, 3)  # in the upper bytes, whose shift down keeps the sign
    if version == 2:
        xyz = rotations.reshape(n, 3) / 127.5 - 1
        xyzw = np.concatenate([xyz, np.sqrt(np.clip(1 - (xyz * xyz).sum(1, keepdims=True), 0, None))], 1)
    else:
        packed = rotations.view("<u4").astype(np.int64)
        parts = np.stack([(packed >> s) & 1023 for s in (20, 10, 0)], 1)
        xyzw = from_smallest_three(packed >> 30, np.where(parts & 512, -1, 1) * (parts & 511) / (511 * SQRT2))
    sh = np.empty((n, SH_SIZES[degree], 3))
    sh[:, 0] = (colors.reshape(n, 3) - 127.5) / COLOR
    sh[:, 1:] = (rest.reshape(n, -1, 3).astype(np.float64) - 128) / 128
    return {
        "means": (fixed.reshape(n, 12).view("<i4") >> 8) / 2.0**bits,
        "quats": xyzw[:, [3, 0, 1, 2]],
        "log_scales": scales.reshape(n, 3) / 16 - 10,
        "logit_opacities": logits(alphas / 255, 1 / 255),
        "sh": sh,
    }


def _zstandard():
    """Return the module zstandard; UsageError where it is missing."""
    try:
        import zstandard
    except ImportError as e:
        raise UsageError("SPZ version 4 needs zstandard: pip install 'warpgs[formats]', or use version 3") from e
    return zstandard
