"""PlayCanvas's SOG format, version 2: a zip archive of lossless WebP images whose pixels are Gaussians, and meta.json.

Positions have 16 bits between bounds, on a logarithmic scale; rotations 8 bits a component; log scales, colours and harmonics
are entries of codebooks of 256 values. Harmonics above degree 0 have a palette of at most 65,536 rows: up to as many Gaussians
keep their own. Axes are those of PLY.
"""

from __future__ import annotations

import io
import json
import math
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.export.arrays import (
    SH_SIZES,
    SQRT2,
    Arrays,
    from_smallest_three,
    logits,
    malformed,
    rounded,
    sigmoid,
    smallest_three,
)

LEVELS = 256
"""Entries of a codebook."""
PALETTE = 65536
"""Most rows of harmonics."""
COLUMNS = 64
"""Rows of the palette side by side in its image."""
ROUNDS = 12
"""Rounds of Lloyd's algorithm for a codebook."""
MAX_META_BYTES = 2**20
MAX_PER_BYTE, MAX_PIXELS, SMALL = 1, 4, 4096
"""Most Gaussians per byte of a file, most pixels per Gaussian, and what any file may have of both: real ones have one in ten
bytes, and one pixel each. Beyond, images are bombs."""
_DATE = (1980, 1, 1, 0, 0, 0)


def encode(arrays: Arrays) -> list[bytes]:
    """Return the bytes of a file."""
    n, k = arrays["sh"].shape[:2]
    width = 4 * math.ceil(math.sqrt(n) / 4)
    height = 4 * math.ceil(n / width / 4)
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "warpgs"}, "count": n}
    files: dict[str, bytes] = {}

    def image(name: str, *columns: np.ndarray) -> None:
        pixels = np.full((width * height, 4), 255, "u1")
        pixels[:n, : len(columns)] = np.stack(columns, 1)
        pixels[:n, len(columns) : 3] = 0
        files[name] = _webp(pixels.reshape(height, width, 4))

    means = arrays["means"].astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    levels = rounded(65535 * (logs - low) / np.where(high > low, high - low, 1), 65535)
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}
    image("means_l.webp", *(levels & 255).T)
    image("means_u.webp", *(levels >> 8).T)
    largest, others = smallest_three(arrays["quats"])
    meta["quats"] = {"files": ["quats.webp"]}
    image("quats.webp", *rounded(255 * (others / SQRT2 + 0.5), 255).T, largest + 252)
    book, labels = codebook(arrays["log_scales"])
    meta["scales"] = {"codebook": book.tolist(), "files": ["scales.webp"]}
    image("scales.webp", *labels.T)
    book, labels = codebook(arrays["sh"][:, 0])
    meta["sh0"] = {"codebook": book.tolist(), "files": ["sh0.webp"]}
    image("sh0.webp", *labels.T, rounded(255 * sigmoid(arrays["logit_opacities"]), 255))
    if k > 1:
        rows, labels = _palette(arrays["sh"][:, 1:].reshape(n, -1).astype(np.float64))
        book, pixels = codebook(rows)
        padded = np.full((COLUMNS * -(-len(rows) // COLUMNS), k - 1, 4), 255, "u1")
        padded[: len(rows), :, :3] = pixels.reshape(len(rows), k - 1, 3)
        names = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = {"count": len(rows), "bands": math.isqrt(k) - 1, "codebook": book.tolist(), "files": names}
        files[names[0]] = _webp(padded.reshape(-1, COLUMNS * (k - 1), 4))
        image(names[1], labels & 255, labels >> 8)
    files = {"meta.json": json.dumps(meta, separators=(",", ":")).encode()} | files
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), content)
    return [out.getvalue()]


def codebook(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return 256 values that stand for all, ascending, and the entry nearest to each, as uint8 in the shape of ``values``.

    Lloyd's algorithm from evenly spaced values and quantiles, on sorted numbers, so that it repeats.
    """
    ordered = np.sort(values.reshape(-1).astype(np.float64))
    even = np.linspace(ordered[0], ordered[-1], LEVELS)
    quantiles = ordered[np.linspace(0, len(ordered) - 1, LEVELS).astype(np.int64)]
    entries = 0.5 * (even + quantiles)
    sums = np.concatenate([[0], np.cumsum(ordered)])
    for _ in range(ROUNDS):
        ends = np.searchsorted(ordered, 0.5 * (entries[1:] + entries[:-1]))
        cuts = np.concatenate([[0], ends, [len(ordered)]])
        counts = np.diff(cuts)
        entries = np.where(counts > 0, np.diff(sums[cuts]) / np.maximum(counts, 1), entries)
    entries = np.sort(entries).astype(np.float32).astype(np.float64)  # readers hold them in float32
    labels = np.searchsorted(0.5 * (entries[1:] + entries[:-1]), values.astype(np.float64))
    return entries, labels.astype("u1")


def _palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return at most 65,536 rows that stand for all, and the one for each, int64 [N].

    More rows than that are halved at the median of their widest column, again and again; each cell is one row, its mean.
    """
    n = len(rows)
    if n <= PALETTE:
        return rows, np.arange(n)
    cells = [np.arange(n)]
    while 2 * len(cells) <= PALETTE:
        halves = []
        for cell in cells:
            part = rows[cell]
            order = cell[np.argsort(part[:, (part.max(0) - part.min(0)).argmax()], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        cells = halves
    labels = np.empty(n, np.int64)
    for i, cell in enumerate(cells):
        labels[cell] = i
    return np.stack([rows[cell].mean(0) for cell in cells]), labels


def _webp(pixels: np.ndarray) -> bytes:
    """Return RGBA pixels [H, W, 4] as lossless WebP, colours behind an alpha of 0 included."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "WEBP", lossless=True, exact=True, method=3)
    return out.getvalue()


def decode(path: Path, data: bytes) -> Arrays:
    """Return the Gaussians of a file's bytes.

    Raises:
        DataError: The file is malformed, cut short, or announces more than its size can hold.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        meta = json.loads(_member(path, archive, "meta.json", MAX_META_BYTES))
        n = meta.get("count") if isinstance(meta, dict) else None
        if not isinstance(meta, dict) or meta.get("version") != 2:
            raise malformed(path, "its meta.json is not of version 2")
        if meta.get("model", "default") != "default":
            raise malformed(path, f"it is for the model {str(meta['model'])[:40]!r}, which this program does not render")
        if type(n) is not int or not 0 < n <= MAX_PER_BYTE * len(data) + SMALL:
            raise malformed(path, f"{str(n)[:20]} Gaussians in {len(data)} bytes")

        def pixels(part: str, i: int) -> np.ndarray:
            name = meta[part]["files"][i]
            return _pixels(path, str(name), _member(path, archive, name, len(data)), n)

        levels = pixels("means", 0)[:n, :3].astype(np.int64) | pixels("means", 1)[:n, :3].astype(np.int64) << 8
        quats, scales, colors = (pixels(part, 0)[:n] for part in ("quats", "scales", "sh0"))
        harmonics = [_book(path, meta["sh0"])[colors[:, :3]][:, None]]
        if meta.get("shN") is not None:
            labels = pixels("shN", 1)[:n].astype(np.int64)
            name = meta["shN"]["files"][0]
            rows = _palette_rows(path, meta["shN"], _member(path, archive, name, len(data)))
            harmonics.append(rows[_within(path, labels[:, 0] | labels[:, 1] << 8, len(rows))])
    low, high = (np.array(meta["means"][key], np.float64).reshape(3) for key in ("mins", "maxs"))
    logs = low + np.where(high != low, high - low, 1) * levels / 65535
    if (quats[:, 3] < 252).any():
        raise malformed(path, f"the rotation of Gaussian {int(np.argmax(quats[:, 3] < 252))} has no largest component")
    with np.errstate(over="ignore"):  # an infinity is named with its Gaussian afterwards
        means = np.sign(logs) * np.expm1(np.abs(logs))
    return {
        "means": means,
        "quats": from_smallest_three(quats[:, 3].astype(np.int64) - 252, (quats[:, :3] / 255 - 0.5) * SQRT2),
        "log_scales": _book(path, meta["scales"])[scales[:, :3]],
        "logit_opacities": logits(colors[:, 3] / 255, 1 / 255),
        "sh": np.concatenate(harmonics, 1),
    }


def _member(path: Path, archive: zipfile.ZipFile, name: object, most: int) -> bytes:
    """Return a file of the archive of at most ``most`` bytes, read into memory only, so that its name leads nowhere."""
    if not isinstance(name, str) or name not in archive.namelist():
        raise malformed(path, f"{str(name)[:40]!r} is not in the archive")
    if archive.getinfo(name).file_size > most:
        raise malformed(path, f"{name[:40]!r} would take {archive.getinfo(name).file_size} bytes")
    with archive.open(name) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise malformed(path, f"{name[:40]!r} takes more than {most} bytes")
    return content


def _pixels(path: Path, name: str, content: bytes, n: int) -> np.ndarray:
    """Return the RGBA pixels [P, 4] of an image of at least ``n``, whose size is checked before it is decoded."""
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the bound below is tighter
        try:
            image = Image.open(io.BytesIO(content), formats=["WEBP"])
            if not n <= image.width * image.height <= MAX_PIXELS * n + SMALL:
                raise malformed(path, f"{name[:40]!r} has {image.width} x {image.height} pixels for {n} values")
            return np.asarray(image.convert("RGBA")).reshape(-1, 4)
        except (OSError, Image.DecompressionBombError, SyntaxError) as e:
            raise malformed(path, f"{name[:40]!r} is no WebP image that can be read") from e


def _book(path: Path, part: dict[str, Any]) -> np.ndarray:
    """Return the 256 numbers of a codebook."""
    book = np.array(part["codebook"], np.float64)
    if book.shape != (LEVELS,):
        raise malformed(path, f"a codebook has the shape {book.shape} instead of {LEVELS} numbers")
    return book


def _palette_rows(path: Path, part: dict[str, Any], content: bytes) -> np.ndarray:
    """Return the rows of the palette of harmonics [P, K - 1, 3]."""
    bands, count = part["bands"], part["count"]
    if bands not in (1, 2, 3) or type(count) is not int or not 0 < count <= PALETTE:
        raise malformed(path, f"{str(count)[:20]} rows of harmonics of {str(bands)[:20]} degrees")
    k = SH_SIZES[bands] - 1
    pixels = _pixels(path, "harmonics", content, count * k)
    if len(pixels) % (COLUMNS * k):
        raise malformed(path, "its image of harmonics has another width")
    return _book(path, part)[pixels[: count * k, :3].reshape(count, k, 3)]


def _within(path: Path, labels: np.ndarray, count: int) -> np.ndarray:
    """Return labels that all lie below ``count``; DataError where one does not."""
    if (labels >= count).any():
        raise malformed(path, f"Gaussian {int(np.argmax(labels >= count))} points beyond its {count} rows of harmonics")
    return labels
