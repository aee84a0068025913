"""Photographs and videos that poses are found for: which they are, and their copies as images."""

import contextlib
import functools
import hashlib
import importlib.util
import itertools
import json
import math
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from warpgs.errors import DataError, UsageError, explained, install_extras, listed
from warpgs.files import UNDECODABLE, inside, make_folder, read_start, write_bytes, write_json
from warpgs.io import image_files
from warpgs.io.images import list_images, turn_upright
from warpgs.process import ProcessFailed, Say, answer, end_with_parent, hidden_stderr, python_lines, silent, utf8_name

DROPPED = {0xFE, *range(0xE0, 0xF0)} - {0xE0, 0xEE}
"""JPEG segments without effect on pixels: comments and those of applications, except JFIF and Adobe, which name the colours."""
KEPT_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
"""Chunks of a PNG file with its pixels; all others are metadata."""


def without_jpeg_metadata(data: bytes) -> bytes:
    """Return a decodable JPEG file without comments, application segments (JFIF and Adobe stay) and trailing data."""
    # phones store films and depth maps after the end of the image
    kept = [segment for marker, _, segment in image_files.jpeg_segments(data) if marker not in DROPPED]
    return b"".join([data[:2], *kept, b"\xff\xd9"])


def without_png_metadata(data: bytes) -> bytes:
    """Return a decodable PNG file with only those chunks that hold pixels."""
    chunks = (chunk for kind, chunk in image_files.png_chunks(data) if kind in KEPT_CHUNKS)
    return b"".join([image_files.PNG_START, *chunks])


SHARPNESS_SIDE = 640
"""Longer side at which frames are compared for sharpness [px]: small enough to average out noise and compression artefacts."""
MAX_FRAMES = 100_000
"""Longest video that is read [frames]: an hour at 25 a second."""
MAX_FRAME_PIXELS = 2**26
"""Largest frame that is read [px]: 8K has half of that."""
MAX_TOTAL_PIXELS = 2**40
"""Largest number of pixels of all frames that are read: an hour and a half of 4K at 25 frames a second."""
START = 12
"""First bytes of a file, which identify its container."""
BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot")
"""First boxes of MP4 and MOV files (ISO/IEC 14496-12, QuickTime)."""


def is_video(path: Path) -> bool:
    """Return whether a path is a file with the suffix of a video."""
    return path.suffix.lower() in image_files.VIDEO_SUFFIXES and path.is_file()


def _frames(path: Path) -> Iterator[np.ndarray]:
    """Yield the frames of a video, uint8 BGR [H, W, 3], upright."""
    import cv2

    _check_container(path)
    with hidden_stderr():  # for a broken file, both would print the error, too
        capture = cv2.VideoCapture(utf8_name(path), cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            raise DataError(f"{path}: OpenCV cannot read it as a video; convert it to mp4 with H.264, or give its frames")
        size = capture.get(cv2.CAP_PROP_FRAME_WIDTH) * capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if not 0 < size <= MAX_FRAME_PIXELS:
            raise DataError(f"{path}: its frames have {size:,.0f} pixels, not 1 to {MAX_FRAME_PIXELS:,}; convert the video")
        total = 0
        for _ in range(MAX_FRAMES):
            there, frame = capture.read()
            if not there:
                return
            total += frame.shape[0] * frame.shape[1]
            if total > MAX_TOTAL_PIXELS:
                raise DataError(f"{path}: has more than {MAX_TOTAL_PIXELS:,} pixels in all frames; cut it shorter or shrink it")
            yield frame
    finally:
        capture.release()
    raise DataError(f"{path}: has more than {MAX_FRAMES:,} frames; cut it shorter")


def _check_container(path: Path) -> None:
    """Raise a DataError if a file is not a video container: FFmpeg would follow a playlist to other files."""
    with explained(f"{path}: the video cannot be read", "fix its permissions or copy it again"):
        start = read_start(path, START)
    avi, matroska = start[:4] == b"RIFF" and start[8:] == b"AVI ", start[:4] == b"\x1a\x45\xdf\xa3"
    if not (avi or matroska or start[4:8] in BOXES):
        raise DataError(f"{path}: OpenCV cannot read it as a video; convert it to an mp4 file with H.264, or give its frames")


def sharpness(frame: np.ndarray) -> float:
    """Return the variance of the Laplacian of a frame, uint8 BGR [H, W, 3], at a size at which noise averages out."""
    import cv2

    gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    if (scale := SHARPNESS_SIDE / max(gray.shape)) < 1:
        gray = cv2.resize(gray, (0, 0), fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray.astype(np.float64), cv2.CV_64F).var())


def sharpest(values: list[float], count: int) -> list[int]:
    """Return indices of at most ``count`` frames: the sharpest of each of ``count`` equal parts, the first if several are."""
    bounds = np.linspace(0, len(values), min(count, len(values)) + 1).round().astype(int)
    return [a + int(np.argmax(values[a:b])) for a, b in itertools.pairwise(bounds)]


def write_frames(path: Path, folder: Path, count: int, progress: Say) -> int:
    """Write the sharpest frame of each of ``count`` equal parts of a video as PNG; return the video's number of frames."""
    import cv2

    values = []
    for i, frame in enumerate(_frames(path)):
        progress(f"looking for sharp frames: {i + 1} read")
        values.append(sharpness(frame))
    if not values:
        raise DataError(f"{path}: holds no frame that OpenCV can read; record it again, or give its frames as images")
    wanted = set(sharpest(values, count))
    for i, frame in enumerate(_frames(path)):
        if i in wanted:
            progress(f"writing frames: frame {i}")
            _, png = cv2.imencode(".png", frame, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            write_bytes(folder / f"frame_{i:06d}.png", png.tobytes())
    return len(values)


# HEIC photographs, as phones take them: coded again as JPEG by a separate process.
#
# pi-heif (libheif and libde265, LGPL) reads them. A malicious file can crash the process that reads it, so one separate
# process reads all photographs.


def is_heic(path: Path) -> bool:
    """Return whether a file begins as a HEIC file does."""
    return image_files.brand(image_files.read_image_file(path, start=image_files.BRANDS_END)) == "HEIC"


def to_jpeg(paths: Sequence[Path], root: Path, folder: Path, max_pixels: int, progress: Say = silent) -> dict[Path, Path]:
    """Write upright JPEG copies of HEIC files below ``root``, without private EXIF, into ``folder``; return each one's copy."""
    if not paths:
        return {}
    if importlib.util.find_spec("pi_heif") is None:
        raise UsageError(f"{paths[0]}: HEIC, but pi-heif is not installed; {install_extras('poses')}, or convert all to JPEG")
    copies = {p: folder / f"{p.relative_to(root).as_posix()}.jpg" for p in paths}
    for copy in copies.values():
        make_folder(copy.parent)
    job = folder / "heic.json"
    write_json(job, {"max_pixels": max_pixels, "files": [[str(p.resolve()), str(c)] for p, c in copies.items()]})
    at, why = 0, "the decoder ended early"
    try:
        for line in python_lines("warpgs.poses.photographs", str(job), folder=folder):
            said = json.loads(line)
            if "error" in said:
                why = said["error"]
                break
            at = said["file"]
            progress(f"reading HEIC: photograph {at + 1} of {len(paths)}")
        else:
            return copies
    except ProcessFailed as e:
        why = f"the decoder ended with code {e.code}"
    raise DataError(f"{paths[at]}: the image cannot be decoded: {why}. Restore it from its source, or convert it to JPEG")


def _coded_again(source: Path, max_pixels: int) -> bytes:
    """Return the copy of one file."""
    import io

    import pi_heif
    from PIL import Image

    with pi_heif.HeifImageFile(io.BytesIO(image_files.read_image_file(source, max_pixels))) as image:
        width, height = image.size
        if width * height > max_pixels:
            raise ValueError(f"{width} x {height} px are more than the limit of {max_pixels:,} pixels (--max-pixels)")
        (_, *names, film), kept = image_files.parse_exif(image.info.get("exif") or b""), Image.Exif()
        kept.update({tag: text for tag, text in zip((image_files.MAKE, image_files.MODEL), names) if text})
        if film is not None:
            kept.get_ifd(image_files.EXPOSURE)[image_files.FOCAL_35MM] = int(film)
        pixels = io.BytesIO()
        image.convert("RGB").save(pixels, "JPEG", quality=JPEG_QUALITY, subsampling=0, exif=kept)
    return pixels.getvalue()


def main(path: str) -> None:
    """Copy the files of a job; print a line of JSON before each file, and one with the first error."""
    job: dict[str, Any] = json.loads(Path(path).read_text("utf-8"))
    for i, (source, target) in enumerate(job["files"]):
        answer(json.dumps({"file": i}))
        try:
            copy = _coded_again(Path(source), job["max_pixels"])
        except Exception as e:  # decoders raise a dozen types on malformed files; the caller names the file
            answer(json.dumps({"error": str(e).strip().rstrip(".") or type(e).__name__}))
            return
        write_bytes(Path(target), copy)


MASK_FOLDERS = ("mask", "masks", "idrmasks")
"""Folders beside or below photographs that hold masks."""
RUN_FILES = ("metrics.jsonl", "checkpoint.safetensors")
"""Files that identify, with a config.json, the folder of a run."""
SOFTWARE_FILES = ("pyvenv.cfg", "pyproject.toml")
"""Files, one of which marks a virtual environment or the source of a program."""
SHOWN_FOLDERS = 10
"""Largest number of folders of photographs that a note names."""
MATCHING_SIDE = 2000
"""Longer side of the copies that are matched [px]; larger copies cost time and give the same points."""
DIAGONAL_35MM = math.hypot(36, 24)
"""Diagonal of 35 mm film [mm], by which the equivalent focal length in EXIF is defined (CIPA DCG-001)."""
JPEG_QUALITY = 98
"""JPEG quality of photographs that must be coded again, since they are HEIC or turned upright."""


@dataclass(frozen=True)
class Photograph:
    """A photograph without a camera."""

    name: str
    """Path below the folder of photographs, POSIX style."""
    path: Path
    """The image file."""
    width: int
    """Width once upright [px]."""
    height: int
    """Height once upright [px]."""
    orientation: int
    """EXIF orientation, 1 to 8."""
    device: str
    """Maker, model and equivalent focal length of the device; empty without EXIF."""
    focal: float | None
    """Focal length by EXIF, as a multiple of the longer side of the image; None if unknown."""
    digest: str
    """SHA-256 of the file."""


def image_root(folder: Path) -> Path:
    """Return the folder with the photographs: its subfolder ``images`` if that holds photographs, else the folder itself."""
    inner = folder / "images"
    return inner if inner.is_dir() and list_images(inner) else folder


def _why_skipped(folder: Path) -> str:
    """Return what a folder holds by its files, if that is an earlier run or software; else an empty string."""
    if any((folder / name).exists() for name in SOFTWARE_FILES):
        return "software"
    # a fit that has found poses only has no config.json
    run = (folder / "config.json").is_file() and any((folder / name).is_file() for name in RUN_FILES)
    return "earlier runs" if run or (folder / "scene" / "poses.json").is_file() else ""


def models_below(folder: Path) -> Iterator[Path]:
    """Yield the folders below ``folder`` with a COLMAP reconstruction, relative to it, without those of earlier runs."""
    why_skipped = functools.cache(_why_skipped)
    for file in sorted(folder.rglob("images.*")):
        pair = file.suffix in (".bin", ".txt") and file.with_name(f"cameras{file.suffix}").is_file()
        if pair and file.parent != folder and not any(why_skipped(p) for p in file.parents if folder in p.parents):
            yield file.parent.relative_to(folder)


def find_photographs(folder: Path) -> tuple[list[Path], list[str]]:
    """Return the image files of a folder by name, without masks, earlier runs and software, and notes on skipped folders."""
    root, why_skipped = image_root(folder), functools.cache(_why_skipped)
    files, skipped = [], defaultdict[str, set[str]](set)
    for path in list_images(root):
        parents = [root / p for p in path.relative_to(root).parents[-2::-1]]  # the outermost first, without the root
        other = next(filter(why_skipped, parents), None)
        if other is not None:
            skipped[why_skipped(other)].add(other.relative_to(root).as_posix())
        elif not {p.name for p in parents} & set(MASK_FOLDERS):
            files.append(path)
    count = Counter(p.parent.relative_to(root).as_posix() for p in files)
    places = [f"{n} in {'the folder itself' if name == '.' else name}" for name, n in sorted(count.items())]
    notes = [f"skipped as {why}: {', '.join(sorted(others))}" for why, others in sorted(skipped.items())]
    if len(places) > 1:
        notes.append(f"photographs by folder: {listed(places, SHOWN_FOLDERS)}")
    return files, notes


def photographs_inside(folder: Path, allow_outside: bool) -> list[Path]:
    """Return the image files as `find_photographs` does; a DataError for a link out of the folder, if not allowed."""
    found, _ = find_photographs(folder)
    return found if allow_outside else [inside(p, folder, "the folder of photographs") for p in found]


def scene_name(name: str, data: bytes) -> str:
    """Return the name of a photograph in the scene: its own, with .png added where the file becomes a PNG."""
    # COLMAP needs UTF-8: other bytes are written as in addresses, b%E4r.jpg
    name = UNDECODABLE.sub(lambda byte: f"%{ord(byte[0]) - 0xDC00:02X}", name)
    return name if _format(data) in ("JPEG", "PNG") else f"{name}.png"


def _format(data: bytes) -> str:
    with contextlib.suppress(ValueError):
        return image_files.format_of(data)
    return ""


def prepare(path: Path, root: Path, small: Path, max_pixels: int = image_files.MAX_PIXELS) -> Photograph:
    """Read a photograph and write the upright copy that is matched, at most `MATCHING_SIDE` pixels wide and high."""
    import cv2

    data = image_files.read_image_file(path, max_pixels)
    name, colors = path.relative_to(root).as_posix(), image_files.decode(path, max_pixels, data)[0]
    orientation, *names, film = image_files.read_exif(data)  # decode has checked that the file is an image within the limits
    image = turn_upright(colors, orientation)
    del colors
    height, width = image.shape[:2]
    if (scale := min(1.0, MATCHING_SIDE / max(width, height))) < 1:
        size = max(1, round(scale * width)), max(1, round(scale * height))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, png = cv2.imencode(".png", np.round(255 * image[..., ::-1]).astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    write_bytes(small, png.tobytes())
    focal = None if film is None else film / DIAGONAL_35MM * math.hypot(width, height) / max(width, height)
    device = " ".join(filter(None, names))[: image_files.MAX_TEXT] + ("" if film is None else f" {film:g} mm")
    return Photograph(scene_name(name, data), path, width, height, orientation, device, focal, hashlib.sha256(data).hexdigest())


def write_copy(photograph: Photograph, folder: Path, max_pixels: int = image_files.MAX_PIXELS) -> None:
    """Write a photograph into the image folder of a scene: upright, at full size, and without its metadata."""
    import cv2

    data = image_files.read_image_file(photograph.path, max_pixels)
    if hashlib.sha256(data).hexdigest() != photograph.digest:
        raise DataError(f"{photograph.path}: the file has changed since it was read; start again")
    kind, target = _format(data), folder / PurePosixPath(photograph.name)
    make_folder(target.parent)
    if photograph.orientation == 1 and kind in ("JPEG", "PNG"):
        write_bytes(target, without_jpeg_metadata(data) if kind == "JPEG" else without_png_metadata(data))
        return
    stored = image_files.decode(photograph.path, max_pixels, data)
    colors, alpha = (None if a is None else turn_upright(a, photograph.orientation) for a in stored)
    assert colors is not None
    pixels = colors[..., ::-1] if alpha is None else np.concatenate([colors[..., ::-1], alpha[..., None]], -1)
    suffix, options = (".jpg", [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]) if kind == "JPEG" else (".png", [])
    _, coded = cv2.imencode(suffix, np.round(255 * pixels).astype(np.uint8), options)
    write_bytes(target, coded.tobytes())


if __name__ == "__main__":
    end_with_parent()
    main(sys.argv[1])
