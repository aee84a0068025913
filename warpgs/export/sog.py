"""PlayCanvas's SOG format, version 2: lossless WebP images whose pixels are Gaussians, and meta.json, in a zip or in a folder.

Positions have 16 bits between bounds, on a logarithmic scale; rotations 8 bits a component; log scales, colours and harmonics
are entries of codebooks of 256 values. Harmonics above degree 0 have a palette of at most 65,536 rows, an eighth of the number
of Gaussians. Axes are those of PLY. Source: developer.playcanvas.com, "The SOG Format".
"""

import contextlib
import io
import json
import math
import os
import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from warpgs.errors import expect
from warpgs.export import base
from warpgs.files import is_within, make_folder, read_file, remove_file, replacing
from warpgs.scene import ORIGIN

META = "meta.json"
"""Name of the file that describes the images; as the path of a model, it stands for a folder without an archive."""

LEVELS = 256
"""Number of entries of a codebook."""
PALETTE = 65536
"""Largest number of rows of harmonics."""
SHARED, SMALLEST = 8, 1024
"""Number of Gaussians for a row of harmonics, and number of rows that no model has to share. On fits of two scenes, an eighth
of the rows loses less than 0.05 dB, and takes an eighth of the bytes."""
CELL, PALETTE_ROUNDS = 4096, 6
"""Largest number of Gaussians among which rows are chosen, which bounds the time, and rounds of Lloyd's algorithm in each."""
COLUMNS = 64
"""Rows of the palette side by side in its image."""
ROUNDS = 12
"""Rounds of Lloyd's algorithm for a codebook."""
MAX_META_BYTES = 2**20
MAX_CONTENTS_BYTES = 2**16
"""Size of the largest table of contents: a real one has 500 bytes, and zipfile takes ten times its size as memory."""
MAX_PER_BYTE, MAX_PIXELS, SMALL = 1, 4, 4096
"""Largest numbers of Gaussians per byte of a file and of pixels per Gaussian, and a number added to both limits. Real files
have one Gaussian per ten bytes, and one pixel per Gaussian. Files beyond these limits count as decompression bombs."""
MAX_PIXEL_BYTES = 8
"""Largest number of bytes per pixel of a lossless WebP image; incompressible pixels take little more than 4."""
MAX_PALETTE_PIXELS = 2**20
"""Largest number of pixels of the palette's image: 65,536 rows of 15 coefficients."""
_DATE = (1980, 1, 1, 0, 0, 0)


def encode(arrays: base.Arrays, antialiased: bool = False, origin: np.ndarray | None = None) -> list[bytes]:
    """Return the bytes of a file, with antialiasing declared in meta.json."""
    n, k = arrays["sh"].shape[:2]
    width = 4 * math.ceil(math.sqrt(n) / 4)
    height = 4 * math.ceil(n / width / 4)
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "warpgs"}, "count": n}
    meta |= {"model": "antialiased"} if antialiased else {}
    meta |= {} if origin is None or not origin.any() else {ORIGIN: origin.tolist()}
    files: dict[str, bytes] = {}

    def image(name: str, *columns: np.ndarray) -> None:
        pixels = np.full((width * height, 4), 255, "u1")
        pixels[:n, : len(columns)] = np.stack(columns, 1)
        pixels[:n, len(columns) : 3] = 0
        files[name] = _webp(pixels.reshape(height, width, 4))

    means = arrays["means"].astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    levels = base.rounded(65535 * (logs - low) / np.where(high > low, high - low, 1), 65535)
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}
    image("means_l.webp", *(levels & 255).T)
    image("means_u.webp", *(levels >> 8).T)
    largest, others = base.smallest_three(arrays["quats"])
    meta["quats"] = {"files": ["quats.webp"]}
    image("quats.webp", *base.rounded(255 * (others / base.SQRT2 + 0.5), 255).T, largest + 252)
    book, labels = codebook(base.with_least_scale(arrays["log_scales"]))
    meta["scales"] = {"codebook": book.tolist(), "files": ["scales.webp"]}
    image("scales.webp", *labels.T)
    book, labels = codebook(arrays["sh"][:, 0])
    meta["sh0"] = {"codebook": book.tolist(), "files": ["sh0.webp"]}
    image("sh0.webp", *labels.T, base.rounded(255 * base.sigmoid(arrays["logit_opacities"]), 255))
    if k > 1:
        opacities = base.sigmoid(arrays["logit_opacities"]) + 1e-3
        rows, labels = _palette(arrays["sh"][:, 1:].reshape(n, -1).astype(np.float64), opacities)
        book, pixels = codebook(rows)
        padded = np.full((COLUMNS * -(-len(rows) // COLUMNS), k - 1, 4), 255, "u1")
        padded[: len(rows), :, :3] = pixels.reshape(len(rows), k - 1, 3)
        names = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = {"count": len(rows), "bands": math.isqrt(k) - 1, "codebook": book.tolist(), "files": names}
        files[names[0]] = _webp(padded.reshape(-1, COLUMNS * (k - 1), 4))
        image(names[1], labels & 255, labels >> 8)
    files = {META: json.dumps(meta, separators=(",", ":")).encode()} | files
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), content)
    return [out.getvalue()]


def codebook(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a codebook of 256 ascending entries, and the index of the entry nearest to each of ``values``, uint8, same shape.

    Lloyd's algorithm from evenly spaced values and quantiles, on sorted numbers, so that results repeat.
    """
    ordered = np.sort(values.reshape(-1).astype(np.float64))
    even = np.linspace(ordered[0], ordered[-1], LEVELS)
    entries = 0.5 * (even + ordered[np.linspace(0, len(ordered) - 1, LEVELS).astype(np.int64)])
    sums = np.concatenate([[0], np.cumsum(ordered)])
    for _ in range(ROUNDS):
        cuts = np.concatenate([[0], np.searchsorted(ordered, 0.5 * (entries[1:] + entries[:-1])), [len(ordered)]])
        counts = np.diff(cuts)
        entries = np.where(counts > 0, np.diff(sums[cuts]) / np.maximum(counts, 1), entries)
    entries = np.array([float(str(v)) for v in np.sort(entries).astype(np.float32)])  # readers hold them in float32
    return entries, np.searchsorted(0.5 * (entries[1:] + entries[:-1]), values.astype(np.float64)).astype("u1")


def _palette(rows: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows that represent all ``rows`` [N, D], and for each row the index of its representative, int64 [N].

    Cells of rows are halved at the median of their widest column. In each, weighted k-means chooses the representatives. They
    are in the order of their first use, so that neighbours in the file have similar indices.
    """
    n = len(rows)
    count = min(PALETTE, max(SMALLEST, n // SHARED))
    if n <= count:
        return rows, np.arange(n)
    cells = [np.arange(n)]
    while len(cells[-1]) > CELL:  # halves differ by one row at most
        orders = [cell[np.argsort(rows[cell][:, np.ptp(rows[cell], 0).argmax()], kind="stable")] for cell in cells]
        cells = [half for order in orders for half in (order[: len(order) // 2], order[len(order) // 2 :])]
    chosen, labels = [], np.empty(n, np.int64)
    for cell in cells:
        means, near = _means_of(rows[cell], weights[cell], max(1, count * len(cell) // n))
        labels[cell] = near + sum(map(len, chosen))
        chosen.append(means)
    used, first, labels = np.unique(labels, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return np.concatenate(chosen)[used[order]], np.argsort(order)[labels.reshape(-1)]


def _means_of(rows: np.ndarray, weights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at most ``count`` weighted means of clusters of rows [N, D], and the index of the nearest for each row [N]."""
    means = rows[np.linspace(0, len(rows) - 1, count).astype(np.int64)]
    for last in range(PALETTE_ROUNDS, -1, -1):
        near = ((means * means).sum(1) - 2 * rows @ means.T).argmin(1)
        if last:
            order = np.argsort(near, kind="stable")
            starts = np.unique(near[order], return_index=True)[1]
            means = np.add.reduceat((weights[:, None] * rows)[order], starts) / np.add.reduceat(weights[order], starts)[:, None]
    return means, near


def _webp(pixels: np.ndarray) -> bytes:
    """Return RGBA pixels [H, W, 4] as lossless WebP, colours behind an alpha of 0 included."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "WEBP", lossless=True, exact=True, method=3)
    return out.getvalue()


def decode(path: Path, file: BinaryIO) -> base.Arrays:
    """Return the Gaussians of an open file; images much larger than the Gaussians need are rejected before decoding."""
    with _members(path, file) as (member, size):
        meta = _meta(path, member)
        n, model = meta.get("count"), meta.get("model", "default")
        expect(model in ("default", "antialiased"), f"its model {str(model)[:40]!r} is not supported")
        few = type(n) is int and 0 < n <= MAX_PER_BYTE * size + SMALL
        expect(few, f"it announces {str(n)[:20]} Gaussians in only {size} bytes")

        def pixels(part: str, i: int) -> np.ndarray:
            name = meta[part]["files"][i]
            return _pixels(str(name), member(name, MAX_PIXEL_BYTES * (MAX_PIXELS * n + SMALL)), n)

        # one attribute after another, the largest first, to limit the peak memory
        sh = _harmonics(meta, n, pixels, lambda name: member(name, MAX_PIXEL_BYTES * MAX_PALETTE_PIXELS))
        opacities = _colors(_book(meta["sh0"]), pixels("sh0", 0), sh)
        quats = _quats(pixels("quats", 0), n)
        means = _means(meta["means"], pixels("means", 0), pixels("means", 1), n)
        scales, book = pixels("scales", 0), _book(meta["scales"])
        log_scales = base.by_rows(n, (3,), lambda p: book[scales[p, :3]])
    return {"means": means, "quats": quats, "log_scales": log_scales, "logit_opacities": opacities, "sh": sh}


@contextlib.contextmanager
def _members(path: Path, file: BinaryIO) -> Iterator[tuple[Callable[[object, int], bytes], int]]:
    """Yield a function that returns a file of a model, by its name and largest size [bytes], and the size of all [bytes]."""
    if is_unpacked(path):
        yield partial(_beside, path), _size(path)
    else:
        _check_contents(file, size := file.seek(0, os.SEEK_END))
        with zipfile.ZipFile(file) as archive:
            yield partial(_member, archive), size


def is_unpacked(path: str | os.PathLike[str]) -> bool:
    """Return whether the path of a model names a folder without an archive, by its meta.json."""
    return Path(path).name.lower() == META


def _size(path: Path) -> int:
    """Return the bytes of a model: of the archive, or of meta.json and the images beside it."""
    return sum(p.stat().st_size for p in [path, *(path.parent.glob("*.webp") if is_unpacked(path) else ())])


def _beside(path: Path, name: object, most: int) -> bytes:
    """Return a file of at most ``most`` bytes beside meta.json: one that a plain name names, and no link to another folder."""
    plain = isinstance(name, str) and name == Path(name).name != "" and not {*name} & {*"\\:\0"}
    beside = plain and is_within(path.parent / str(name), path.parent)
    expect(beside, f"{str(name)[:40]!r} is not a file beside it, or is a link to another folder")
    return read_file(path.parent / str(name), None, most, "copy the whole folder again")


def _meta(path: Path, member: Callable[[object, int], bytes]) -> dict[str, Any]:
    """Return meta.json; DataError where it is of another version."""
    meta = json.loads(member(path.name if is_unpacked(path) else META, MAX_META_BYTES))
    expect(isinstance(meta, dict) and meta.get("version") == 2, "its meta.json is not of version 2")
    return meta


def _harmonics(
    meta: dict[str, Any], n: int, pixels: Callable[[str, int], np.ndarray], member: Callable[[object], bytes]
) -> np.ndarray:
    """Return the coefficients [N, K, 3] from the palette; the first of each Gaussian is not set yet."""
    if meta.get("shN") is None:
        return np.empty((n, 1, 3), np.float32)
    rows = _palette_rows(meta["shN"], member(meta["shN"]["files"][0]))
    labels = pixels("shN", 1)
    sh = np.empty((n, 1 + rows.shape[1], 3), np.float32)
    for part in base.parts(n):
        label = labels[part, 0].astype(np.int64) | labels[part, 1].astype(np.int64) << 8
        beyond = label >= len(rows)
        row = part.start + int(beyond.argmax())
        expect(not beyond.any(), f"Gaussian {row} refers to harmonics beyond the {len(rows)} rows")
        sh[part, 1:] = rows[label]
    return sh


def _colors(book: np.ndarray, pixels: np.ndarray, sh: np.ndarray) -> np.ndarray:
    """Set the first coefficient in ``sh`` [N, K, 3] from colour pixels [P, 4]; returns the logits of the opacities [N]."""
    for part in base.parts(len(sh)):
        sh[part, 0] = book[pixels[part, :3]]
    return base.by_rows(len(sh), (), lambda p: base.logits(pixels[p, 3] / 255, 1 / 255))


def _means(part: dict[str, Any], lower: np.ndarray, upper: np.ndarray, n: int) -> np.ndarray:
    """Return the means [N, 3] from the lower and the upper bytes of their levels, [P, 4] each."""
    low, high = (np.array(part[key], np.float64).reshape(3) for key in ("mins", "maxs"))

    def rows(p: slice) -> np.ndarray:
        levels = lower[p, :3].astype(np.int64) | upper[p, :3].astype(np.int64) << 8
        logs = low + np.where(high != low, high - low, 1) * levels / 65535
        with np.errstate(over="ignore"):  # an infinity is named with its Gaussian afterwards
            return np.sign(logs) * np.expm1(np.abs(logs))

    return base.by_rows(n, (3,), rows)


def _quats(pixels: np.ndarray, n: int) -> np.ndarray:
    """Return the rotations [N, 4] that ``pixels`` [P, 4] store."""
    largest = pixels[:n, 3]
    none = largest < 252
    expect(not none.any(), f"the rotation of Gaussian {int(none.argmax())} names no largest component")

    def rows(p: slice) -> np.ndarray:
        return base.from_smallest_three(largest[p].astype(np.int64) - 252, (pixels[p, :3] / 255 - 0.5) * base.SQRT2)

    return base.by_rows(n, (4,), rows)


def _check_contents(file: BinaryIO, size: int) -> None:
    """Raise a `MalformedError` if the end record of an archive announces a large table of contents, or is not plain.

    A plain record has no comment after it, and no zip64 locator before it. Archives beyond 4 GiB need the locator.
    """
    file.seek(max(0, size - 42))
    locator, end = (last := file.read())[:-22], last[-22:]
    plain = end[:4] == b"PK\5\6" and end[-2:] == b"\0\0" and locator[:4] != b"PK\6\7"
    small = plain and int.from_bytes(end[12:16], "little") <= MAX_CONTENTS_BYTES
    expect(small, f"its table of contents is not at the end of the file, or over {MAX_CONTENTS_BYTES:,} bytes")


def _member(archive: zipfile.ZipFile, name: object, most: int) -> bytes:
    """Return a file of the archive of at most ``most`` bytes, read into memory only: its name is never used as a path."""
    expect(isinstance(name, str) and name in archive.namelist(), f"{str(name)[:40]!r} is not in the archive")
    announced = archive.getinfo(name).file_size
    expect(announced <= most, f"{name[:40]!r} would take {announced} bytes")
    with archive.open(name) as file:
        content = file.read(most + 1)
    expect(len(content) <= most, f"{name[:40]!r} takes more than {most} bytes")
    return content


def _pixels(name: str, content: bytes, n: int) -> np.ndarray:
    """Return the RGBA pixels [P, 4] of an image of at least ``n``; its size is checked before it is decoded."""
    import cv2

    width, height = _webp_size(content)
    expect(width * height, f"{name[:40]!r} is not a lossless WebP image")
    expect(n <= width * height <= MAX_PIXELS * n + SMALL, f"{name[:40]!r} has {width} x {height} pixels for {n} values")
    image = None
    with contextlib.suppress(cv2.error):
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    read = image is not None and image.shape[:2] == (height, width) and image.dtype == np.uint8 and image.ndim == 3
    expect(read, f"{name[:40]!r} is not a readable WebP image")
    if image.shape[2] == 4:
        return cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA, image).reshape(-1, 4)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGBA).reshape(-1, 4)


def _webp_size(data: bytes) -> tuple[int, int]:
    """Return width and height [px] of a lossless, still WebP image; zeros for any other file."""
    at = 12 if data[:4] == b"RIFF" and data[8:12] == b"WEBP" else len(data)
    while at + 13 <= len(data):
        kind, length = struct.unpack_from("<4sI", data, at)
        if kind == b"VP8L":
            bits = int.from_bytes(data[at + 9 : at + 13], "little")
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
        if kind in (b"VP8 ", b"ANIM", b"ANMF") or (kind == b"VP8X" and data[at + 8] & 2):
            break
        at += 8 + length + length % 2
    return 0, 0


def _book(part: dict[str, Any]) -> np.ndarray:
    """Return the 256 numbers of a codebook."""
    book = np.array(part["codebook"], np.float64)
    expect(book.shape == (LEVELS,), f"a codebook has the shape {book.shape}, not {LEVELS} numbers")
    return book


def _palette_rows(part: dict[str, Any], content: bytes) -> np.ndarray:
    """Return the rows of the palette of harmonics [P, K - 1, 3]."""
    bands, count = part["bands"], part["count"]
    sound = bands in (1, 2, 3) and type(count) is int and 0 < count <= PALETTE
    expect(sound, f"its table of harmonics is invalid: {str(count)[:20]} rows, {str(bands)[:20]} degrees")
    k = base.SH_SIZES[bands] - 1
    pixels = _pixels("harmonics", content, count * k)
    expect(len(pixels) % (COLUMNS * k) == 0, "its image of harmonics has an invalid width")
    return _book(part).astype(np.float32)[pixels[: count * k, :3].reshape(count, k, 3)]


@base.register("sog")
class SOG(base.Format):
    """The SOG format."""

    suffix = ".sog"
    description = "PlayCanvas, images of 8-bit indices in a zip archive, or in a folder for FOLDER/meta.json; SuperSplat"
    sorted = True
    archive = True
    declares = True
    decode = staticmethod(decode)
    size = staticmethod(_size)

    def fits(self, path: str | os.PathLike[str]) -> bool:
        """Return whether a name has the suffix, or is meta.json."""
        return super().fits(path) or is_unpacked(path)

    def encode(self, arrays: base.Arrays) -> list[bytes]:
        """Return the bytes of a file."""
        return encode(arrays, self.antialiased, self.origin)

    def store(self, path: Path, pieces: Iterable[bytes]) -> None:
        """Write the archive, or its files beside meta.json, which is removed once all are on the disk, and comes last."""
        if not is_unpacked(path):
            return super().store(path, pieces)
        make_folder(path.parent)
        with zipfile.ZipFile(io.BytesIO(b"".join(pieces))) as archive, contextlib.ExitStack() as stack:
            for name in archive.namelist():  # meta.json is the first, and so the last to be replaced
                data, target = archive.read(name), path if name == META else path.with_name(name)
                file, _ = stack.enter_context(replacing(target, size=len(data)))
                file.write(data)
                file.flush()
            remove_file(path)

    def origin_in(self, path: Path) -> object:
        """Return the origin in meta.json."""
        return self._meta_of(path).get(ORIGIN)

    def is_antialiased(self, path: Path) -> bool:
        """Return whether meta.json declares antialiasing."""
        return self._meta_of(path).get("model") == "antialiased"

    def is_own(self, path: Path) -> bool:
        """Return whether meta.json names warpgs."""
        return bool(self._meta_of(path).get("asset") == {"generator": "warpgs"})

    def _meta_of(self, path: Path) -> dict[str, Any]:
        """Return meta.json of a file."""
        with base.reading(path) as file, _members(path, file) as (member, _):
            return _meta(path, member)
