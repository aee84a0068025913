"""Photographs without cameras for the fuzzer: images with EXIF, AVIF, HEIC in and out of a process of its own, and videos."""

from __future__ import annotations

import importlib.util
import shutil
import struct
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from tests.faults import image_targets
from tests.faults.image_targets import encoded, jpeg_segments, photo, png_checksums, tiff_tag
from tests.faults.mutations import damage, number, png_bomb, rarely
from tests.faults.targets import Target, register
from warpgs.errors import DataError
from warpgs.io import image_files
from warpgs.io.image_files import decode
from warpgs.poses import photographs

MAX_PIXELS = 20_000
CONTAINERS = {
    b"meta": 4, b"iprp": 0, b"ipco": 0, b"moov": 0, b"trak": 0, b"mdia": 0, b"minf": 0, b"stbl": 0, b"stsd": 8, b"iinf": 6,
}  # fmt: skip
"""Boxes of ISO base media files that hold boxes, and the number of bytes before those."""


def boxes(data: bytes, begin: int, end: int) -> list[tuple[int, int]]:
    """Return begin and end of what each box holds, those in boxes included."""
    found: list[tuple[int, int]] = []
    while begin + 8 <= end:
        size, kind = struct.unpack_from(">I4s", data, begin)
        if not 8 <= size <= end - begin:
            break
        found.append((begin + 8, begin + size))
        if kind in CONTAINERS:
            found += boxes(data, begin + 8 + CONTAINERS[kind], begin + size)
        begin += size
    return found


def box(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a number in a box of an ISO base media file; all lengths stay right."""
    found = boxes(data, 0, len(data))
    if not found:
        return number(data, rng)
    begin, end = found[int(rng.integers(len(found)))]
    part = data[begin : begin + 4096 if end - begin > 4096 else end]
    return data[:begin] + number(part, rng) + data[begin + len(part) :]


# ---- photographs -------------------------------------------------------------------------------------------------------

OWNER = "Jane Owner"


def exif(orientation: int) -> Image.Exif:
    found = Image.Exif()
    found[0x010F], found[0x0110], found[0x0112], found[0x013B] = "ACME", "Phone 7", orientation, OWNER
    found.get_ifd(0x8825).update({1: "N", 2: (48.0, 8.0, 30.0)})
    found.get_ifd(0x8769)[0xA405] = 28
    return found


KINDS = {"jpg": "JPEG", "png": "PNG", "webp": "WEBP", "tif": "TIFF", "avif": "AVIF"}


def photo_files(root: Path) -> list[Path]:
    paths = []
    (root / "in").mkdir()
    for i, (suffix, kind) in enumerate(KINDS.items()):
        for orientation in (1, 6) if suffix in ("jpg", "png") else (1 + i,):
            paths.append(root / "in" / f"{orientation}.{suffix}")
            paths[-1].write_bytes(encoded(kind, "RGB", exif=exif(orientation)))
    paths.append(root / "in" / "long.png")  # is matched at a smaller size
    photo("L", size=(photographs.MATCHING_SIDE + 50, 9)).save(paths[-1])
    return paths


def exif_tag(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a tag of EXIF, or a number in it; checksums of PNG are put right."""
    found = [at for head in (b"MM\0*", b"II*\0") if (at := data.find(head)) >= 0]
    if not found:
        return number(data, rng)
    at = found[0]
    block = (tiff_tag if rng.random() < 0.6 else number)(data[at : at + 400], rng)
    data = data[:at] + block + data[at + len(block) :]
    return png_checksums(data) if data.startswith(b"\x89PNG") else data


def read_photograph(root: Path, path: Path) -> tuple[photographs.Photograph, np.ndarray]:
    """Read a photograph as `warpgs poses` does, and its copy in the scene."""
    found = photographs.prepare(path, root / "in", root / "small.png", MAX_PIXELS)
    shutil.rmtree(root / "out", ignore_errors=True)
    (root / "out").mkdir()
    photographs.write_copy(found, root / "out", MAX_PIXELS)
    copy = root / "out" / found.name
    assert OWNER.encode() not in copy.read_bytes(), "the copy names the owner"
    return found, decode(copy, MAX_PIXELS)[0]


def photo_nonsense(found: tuple[photographs.Photograph, np.ndarray]) -> str:
    photograph, pixels = found
    if pixels.shape[:2] != (photograph.height, photograph.width):
        return "the copy has another size"
    return "" if photograph.focal is None or 0 < photograph.focal < 1000 else "a focal length is none"


PHOTOGRAPHS = (
    photographs.prepare, photographs.write_copy, photographs.scene_name, photographs._format,
    photographs.without_jpeg_metadata, photographs.without_png_metadata,
)  # fmt: skip
register(
    Target(
        "photograph", photo_files, read_photograph, PHOTOGRAPHS, (exif_tag, rarely(png_bomb, exif_tag), jpeg_segments),
        png_checksums, photo_nonsense, share=0.7,
    )
)  # fmt: skip

# ---- AVIF and HEIC -----------------------------------------------------------------------------------------------------

AVIFS = {m: encoded("AVIF", m, quality=70) for m in ("RGB", "RGBA")} | {"lossless": encoded("AVIF", "L", quality=100)}
image_targets.add("avif", AVIFS, (image_files._opened, image_files._loaded), (box, box, box), share=0.7)


def heic_files(root: Path) -> list[Path]:
    from tests.poses.test_photographs import HEIC

    (root / "in").mkdir()
    (root / "in" / "a.heic").write_bytes(HEIC)
    return [root / "in" / "a.heic"]


def heic_copy(root: Path, path: Path) -> np.ndarray:
    try:
        copy = photographs._coded_again(path, MAX_PIXELS)
    except Exception as e:  # as its process does, for which the caller names the file
        raise DataError(f"{path}: the image cannot be decoded: {e}") from e
    (root / "a.jpg").write_bytes(copy)
    return decode(root / "a.jpg", MAX_PIXELS)[0]


def heic_in_process(root: Path, path: Path) -> np.ndarray:
    shutil.rmtree(root / "out", ignore_errors=True)
    photographs.is_heic(path)
    return decode(photographs.to_jpeg([path], root / "in", root / "out", MAX_PIXELS)[path], MAX_PIXELS)[0]


if importlib.util.find_spec("pi_heif"):
    register(Target("heic", heic_files, heic_copy, (photographs._coded_again,), (box, box, box), own_process=True))
    register(
        Target(
            "heic by its process", heic_files, heic_in_process, (photographs.to_jpeg,), (box, box, box), lines=0.7, share=0.01
        )
    )

# ---- videos ------------------------------------------------------------------------------------------------------------

CODECS = {"mp4v": "mp4", "MJPG": "avi", "FFV1": "avi", "VP80": "webm", "XVID": "mkv"}


def video_files(root: Path) -> list[Path]:
    (root / "frames").mkdir()
    for codec, suffix in CODECS.items():
        writer = cv2.VideoWriter(str(root / f"{codec}.{suffix}"), cv2.VideoWriter_fourcc(*codec), 5, (48, 36))
        for i in range(4):
            writer.write(np.asarray(photo("RGB", i, (48, 36))))
        writer.release()
    return sorted(p for p in root.iterdir() if p.is_file())


def video_header(data: bytes, rng: np.random.Generator) -> bytes:
    return number(data[:600], rng) + data[600:]


def video_body(data: bytes, rng: np.random.Generator) -> bytes:
    return data[:600] + damage(data[600:], rng)


def frames_of(root: Path, path: Path) -> list[np.ndarray]:
    folder = root / "frames"
    shutil.rmtree(folder)
    folder.mkdir()
    photographs.write_frames(path, folder, 2, lambda line: None)
    return [decode(p)[0] for p in sorted(folder.iterdir())]


VIDEO = (photographs._frames, photographs.write_frames, photographs.sharpest)
register(Target("video", video_files, frames_of, VIDEO, (video_header, box, video_body), share=0.3))
