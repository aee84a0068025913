"""Small files that unpack to large ones, for the fuzzer: a reader must know a size before it takes the memory."""

from __future__ import annotations

import functools
import gzip
import io
import json
import struct
import zipfile
import zlib

import numpy as np
from PIL import Image

from tests.faults.mutations import Change

UNPACKED = 192 * 2**20
"""Bytes of zeros that a bomb unpacks to: more than a reader may take, in less than half a second."""
SIDE = 5000
"""Width and height of an image of one colour [px]."""
MANY = 1_000_000
"""Number of Gaussians in a small file."""
ROWS = 10_000
"""Number of equal rows, from which on quadratic time is seen."""
SHARE = 0.005


def rarely(bomb: Change, change: Change) -> Change:
    """Return a change that is a bomb now and then: each takes as long as a hundred other inputs."""
    return lambda data, rng: (bomb if rng.random() < SHARE else change)(data, rng)


def gzip_bomb(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a gzip stream with zeros behind what it holds."""
    try:
        plain = zlib.decompressobj(31).decompress(data, 2**20)
    except zlib.error:
        plain = b""
    return gzip.compress(plain + bytes(UNPACKED), 1, mtime=0)


def spz_bomb(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a packed SPZ file with a million equal Gaussians, or with zeros behind the last one."""
    try:
        plain = zlib.decompressobj(31).decompress(data, 2**20)
        (count,) = struct.unpack_from("<I", plain, 8)
        if rng.random() < 0.5 or not count:
            return gzip_bomb(data, rng)
        body = bytes((len(plain) - 16) // count * MANY)
        return gzip.compress(plain[:8] + struct.pack("<I", MANY) + plain[12:16] + body, 1, mtime=0)
    except (zlib.error, struct.error):
        return gzip_bomb(data, rng)


def zip_bomb(data: bytes, rng: np.random.Generator) -> bytes:
    """Return an archive with a file that is followed by spaces, packed."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {n: archive.read(n) for n in archive.namelist()}
    except (zipfile.BadZipFile, OSError, RuntimeError, NotImplementedError, ValueError, EOFError, zlib.error):
        return data
    out, name = io.BytesIO(), sorted(members)[int(rng.integers(len(members)))]
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for n, content in members.items():
            archive.writestr(zipfile.ZipInfo(n), content + b" " * UNPACKED * (n == name), zipfile.ZIP_DEFLATED, 1)
    return out.getvalue()


@functools.cache
def large_webp() -> bytes:
    """Return a lossless WebP of one colour, of some kilobytes."""
    out = io.BytesIO()
    Image.new("RGBA", (SIDE, SIDE), (9, 9, 9, 255)).save(out, "WEBP", lossless=True, quality=0, method=0)
    return out.getvalue()


def png_bomb(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a PNG whose rows, or whose text or profile, unpack to zeros; its header stays, or announces as much."""
    packed, parts = zlib.compress(bytes(UNPACKED), 1), [data[:8]]
    kind = (b"IDAT", b"zTXt", b"iCCP")[int(rng.integers(3))]
    body = packed if kind == b"IDAT" else b"a\0\0" + packed
    header = data[16:29] if rng.random() < 0.5 else struct.pack(">IIBBBBB", SIDE, SIDE, 8, 2, 0, 0, 0)
    for name, content in ((b"IHDR", header), (kind, body), (b"IEND", b"")):
        parts.append(struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content)))
    return b"".join(parts)


def many_rows(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a JSON text with one item of a list, or of a list in it, very often."""
    try:
        whole = json.loads(data)
    except ValueError:
        return data
    values = [whole, *(whole.values() if isinstance(whole, dict) else ())]
    lists = [v for v in values if isinstance(v, list) and v]
    if not lists:
        return data
    rows = lists[int(rng.integers(len(lists)))]
    rows[:] = [rows[int(rng.integers(len(rows)))]] * ROWS
    return json.dumps(whole).encode()
