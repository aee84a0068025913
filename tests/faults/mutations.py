"""Changes of files that fuzzers try, and small files that unpack to much."""

import functools
import gzip
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable

import numpy as np
from PIL import Image

# Damage and changes of files: bytes at random, numbers in text and in bytes, JSON values; repeatable by their
# generator.

Change = Callable[[bytes, np.random.Generator], bytes]

NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
WORDS = (
    b"0", b"-1", b"1", b"2", b"nan", b"inf", b"-inf", b"1e308", b"1e-320", b"1e400", b"-0.0", b"4294967296", b"1e12", b"1e20",
    b"9223372036854775808", b"99999999999999999999999999", b"0x10", b"1_0", b"", b"x", b"\xff", b"\0", b"7", b"1e5",
)  # fmt: skip
WHOLE = (0, 1, -1, 2, 7, 127, 255, 256, 32767, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63, 2**64 - 1)
REAL = (0.0, -0.0, 1.0, np.nan, np.inf, -np.inf, 1.7e308, 1e-320, 5e-324, 1e20, -1e12, 1e38, 3.5e38)
VALUES = (
    None, True, False, 0, -1, 1, 7, 2**63, 10**400, 1e308, 1e-320, -0.0, float("nan"), float("inf"), "", "x", "\ud800", "../x",
    "a\0b", "/", [], {}, [[]], [1, 2], {"a": 1}, "x" * 5000, [[1.0, 2.0, 3.0]],
)  # fmt: skip


def _pick(rng: np.random.Generator, values):
    return values[int(rng.integers(len(values)))]


def _cut(data: bytes, rng: np.random.Generator) -> tuple[int, int]:
    """Return begin and end of a part, mostly a short one."""
    begin = int(rng.integers(len(data) + 1))
    longest = len(data) - begin
    return begin, begin + min(longest, int(rng.integers(1, 9) if rng.random() < 0.7 else rng.integers(longest + 1)))


def flip(data: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        if out:
            out[int(rng.integers(len(out)))] ^= 1 << int(rng.integers(8))
    return bytes(out)


def fill(data: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _cut(data, rng)
    return data[:begin] + _pick(rng, (b"\0", b"\xff", b"A")) * (end - begin) + data[end:]


def truncate(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def remove(data: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _cut(data, rng)
    return data[:begin] + data[end:]


def splice(data: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _cut(data, rng)
    at = int(rng.integers(len(data) + 1))
    return data[:at] + data[begin:end] + data[at + (end - begin) * int(rng.integers(2)) :]


def append(data: bytes, rng: np.random.Generator) -> bytes:
    return data + rng.bytes(int(rng.integers(1, 40)))


def number(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace a number in bytes, or move a real one by a ten thousandth."""
    layout = _pick(rng, ("<d", ">d", "<f", ">f", "<i", ">i", "<I", ">I", "<H", ">H", "<Q", "<q", "B"))
    size = struct.calcsize(layout)
    if len(data) < size:
        return data
    at = int(rng.integers(len(data) - size + 1))
    if rng.random() < 0.5:
        at = at // size * size
    (value,) = struct.unpack_from(layout, data, at)
    if layout[-1] in "df":
        new = value * (1 + 1e-4 * rng.standard_normal()) if rng.random() < 0.5 else _pick(rng, REAL)
        with np.errstate(over="ignore"):
            packed = np.array(new, layout[0] + ("f8" if layout[-1] == "d" else "f4")).tobytes()
    else:
        new = value + int(rng.integers(-2, 3)) if rng.random() < 0.5 else _pick(rng, WHOLE)
        packed = (new % 256**size).to_bytes(size, "big" if layout[0] == ">" else "little")
    return data[:at] + packed + data[at + size :]


PLAIN: tuple[Change, ...] = (flip, fill, truncate, remove, splice, append, number)


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    for _ in range(1 + int(rng.integers(3)) // 2 * int(rng.integers(1, 3))):
        data = _pick(rng, PLAIN)(data, rng)
    return data


def text_number(data: bytes, rng: np.random.Generator) -> bytes:
    found = list(NUMBER.finditer(data))
    if not found:
        return data
    match = _pick(rng, found)
    word = _pick(rng, WORDS)
    if rng.random() < 0.5 and b"." in match[0]:
        word = repr(float(match[0]) * (1 + 1e-5 * float(rng.standard_normal()))).encode()
    return data[: match.start()] + word + data[match.end() :]


def text_line(data: bytes, rng: np.random.Generator) -> bytes:
    glue = _pick(rng, (b"\n", b"\n", b" "))
    parts = data.split(glue)
    a, b = int(rng.integers(len(parts))), int(rng.integers(len(parts)))
    kind = int(rng.integers(4))
    if kind == 0:
        del parts[a]
    elif kind == 1:
        parts.insert(b, parts[a])
    elif kind == 2:
        parts[a], parts[b] = parts[b], parts[a]
    else:
        parts[a] = _pick(rng, (b"", b"#", b"# a comment", parts[a] + b" 1", b"\r"))
    return glue.join(parts)


def _places(value, found: list) -> list:
    """Return pairs (container, key) of everything in a JSON value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        found.append((value, key))
        _places(inner, found)
    return found


def changed_value(whole, rng: np.random.Generator):
    """Replace, remove, repeat, move a little or wrap one value of nested lists and objects, in place; return the whole."""
    places = _places(whole, [])
    if not places:
        return whole
    container, key = _pick(rng, places)
    kind = int(rng.integers(6))
    value = container[key]
    if kind == 0:
        del container[key]
    elif kind == 1 and isinstance(container, list):
        container.append(value)
    elif kind == 2:
        for _ in range(_pick(rng, (1, 3, 40, 400))):
            value = [value]
        container[key] = value
    elif kind <= 4 and isinstance(value, float):
        container[key] = value * (1 + 1e-5 * float(rng.standard_normal()))
    else:
        other, name = _pick(rng, places)
        container[key] = _pick(rng, (*VALUES, other[name]))
    return whole


def json_value(data: bytes, rng: np.random.Generator) -> bytes:
    try:
        return json.dumps(changed_value(json.loads(data), rng)).encode()
    except (ValueError, RecursionError):  # no JSON; or the value was put into itself
        return data


# Small files that unpack to large ones, for the fuzzer: a reader must know a size before it takes the memory.

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
