"""Photographs without cameras: their files, their EXIF values, and copies without personal metadata."""

from __future__ import annotations

import functools
import hashlib
import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from warpgs.errors import DataError
from warpgs.files import UNDECODABLE, make_folder, write_bytes
from warpgs.io.decoding import MAX_PIXELS, decode, read_image_file
from warpgs.io.exif import read_exif
from warpgs.io.image_formats.kinds import format_of
from warpgs.io.images import list_images, turn_upright
from warpgs.io.inside import inside
from warpgs.poses.metadata import without_jpeg_metadata, without_png_metadata

MASK_FOLDERS = ("mask", "masks", "idrmasks")
"""Folders beside or below photographs that hold masks."""
RUN_FILES = ("metrics.jsonl", "checkpoint.safetensors")
"""Files that identify, with a config.json, the folder of a run."""
SHOWN_FOLDERS = 10
"""Largest number of folders of photographs that a note names."""
MATCHING_SIDE = 2000
"""Longer side of the copies that are matched [px]; larger copies cost time and give the same points."""
DIAGONAL_35MM = math.hypot(36, 24)
"""Diagonal of 35 mm film [mm], by which the equivalent focal length in EXIF is defined (CIPA DCG-001)."""
JPEG_QUALITY = 98
"""Quality of a photograph that must be coded again since it is turned upright."""


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


def _is_run(folder: Path) -> bool:
    """Return whether the files of a folder are those of a run."""
    if (folder / "scene" / "poses.json").is_file():  # a fit that has found poses only
        return True
    return (folder / "config.json").is_file() and any((folder / name).is_file() for name in RUN_FILES)


def _sorted_out(folder: Path) -> tuple[list[Path], list[str]]:
    """Return the image files of a folder of photographs, and the names of the runs below it, whose images are left out."""
    root = image_root(folder)
    is_run = functools.cache(_is_run)
    files, runs = [], set()
    for path in list_images(root):
        parents = [root / p for p in path.relative_to(root).parents[-2::-1]]  # the outermost first, without the root
        run = next(filter(is_run, parents), None)
        if run is not None:
            runs.add(run.relative_to(root).as_posix())
        elif not {p.name for p in parents} & set(MASK_FOLDERS):
            files.append(path)
    return files, sorted(runs)


def find_photographs(folder: Path) -> list[Path]:
    """Return the image files of a folder of photographs, sorted by name; no file is opened.

    Masks are left out, and so are the images of earlier runs below the folder.
    """
    return _sorted_out(folder)[0]


def folder_notes(folder: Path) -> list[str]:
    """Return notes on skipped runs, and on the folders of the photographs if there are several."""
    root = image_root(folder)
    files, runs = _sorted_out(folder)
    count = Counter(p.parent.relative_to(root).as_posix() for p in files)
    places = [f"{n} in {'the folder itself' if name == '.' else name}" for name, n in sorted(count.items())]
    more = [f"{len(places) - SHOWN_FOLDERS} more folders"] if len(places) > SHOWN_FOLDERS else []
    notes = [f"skipped as earlier runs: {', '.join(runs)}"] if runs else []
    return [*notes, *([f"photographs by folder: {', '.join([*places[:SHOWN_FOLDERS], *more])}"] if len(places) > 1 else [])]


def photographs_inside(folder: Path, allow_outside: bool) -> list[Path]:
    """Return the image files as `find_photographs` does, to be opened.

    Raises:
        DataError: A link points outside the folder, and that is not allowed.
    """
    found = find_photographs(folder)
    return found if allow_outside else [inside(p, folder, "the folder of photographs") for p in found]


def scene_name(name: str, data: bytes) -> str:
    """Return the name of a photograph in the scene: its own, with .png added where the file becomes a PNG.

    Bytes that are not UTF-8, which COLMAP needs, are written as in addresses: ``b%E4r.jpg``.
    """
    name = UNDECODABLE.sub(lambda byte: f"%{ord(byte[0]) - 0xDC00:02X}", name)
    return name if _format(data) in ("JPEG", "PNG") else f"{name}.png"


def _format(data: bytes) -> str:
    try:
        return format_of(data)[0]
    except ValueError:
        return ""


def prepare(path: Path, root: Path, small: Path, max_pixels: int = MAX_PIXELS) -> Photograph:
    """Read a photograph and write the upright copy that is matched, at most `MATCHING_SIDE` pixels wide and high.

    Args:
        path: The image file.
        root: The folder of photographs.
        small: File to write, a PNG.
        max_pixels: Largest number of pixels that the file may have.

    Raises:
        DataError: The file cannot be decoded.
        ResourceError: There is not enough memory, or the copy cannot be written.
    """
    import cv2

    data = read_image_file(path, max_pixels)
    name, colors = path.relative_to(root).as_posix(), decode(path, max_pixels, data)[0]
    exif = read_exif(data)  # decode has checked that the file is an image within the limits
    image = turn_upright(colors, exif.orientation)
    del colors
    height, width = image.shape[:2]
    scale = min(1.0, MATCHING_SIDE / max(width, height))
    if scale < 1:
        size = max(1, round(scale * width)), max(1, round(scale * height))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, png = cv2.imencode(".png", np.round(255 * image[..., ::-1]).astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    write_bytes(small, png.tobytes())
    film = exif.focal
    focal = None if film is None else film / DIAGONAL_35MM * math.hypot(width, height) / max(width, height)
    device = exif.device if film is None else f"{exif.device} {film:g} mm"
    digest = hashlib.sha256(data).hexdigest()
    return Photograph(scene_name(name, data), path, width, height, exif.orientation, device, focal, digest)


def write_copy(photograph: Photograph, folder: Path, max_pixels: int = MAX_PIXELS) -> None:
    """Write a photograph into the image folder of a scene: upright, at full size, and without its metadata.

    JPEG and PNG files that are upright keep their coded pixels. Other files are coded again: JPEG files as JPEG of quality
    `JPEG_QUALITY`, all others as PNG of 8 bits.

    Raises:
        DataError: The file has changed since it was matched.
        ResourceError: The disk is full.
    """
    import cv2

    data = read_image_file(photograph.path, max_pixels)
    if hashlib.sha256(data).hexdigest() != photograph.digest:
        raise DataError(f"{photograph.path}: the file has changed since it was read; start again")
    kind, target = _format(data), folder / PurePosixPath(photograph.name)
    make_folder(target.parent)
    if photograph.orientation == 1 and kind in ("JPEG", "PNG"):
        write_bytes(target, without_jpeg_metadata(data) if kind == "JPEG" else without_png_metadata(data))
        return
    colors, alpha = (
        None if a is None else turn_upright(a, photograph.orientation) for a in decode(photograph.path, max_pixels, data)
    )
    assert colors is not None
    pixels = colors[..., ::-1] if alpha is None else np.concatenate([colors[..., ::-1], alpha[..., None]], -1)
    suffix, options = (".jpg", [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]) if kind == "JPEG" else (".png", [])
    _, coded = cv2.imencode(suffix, np.round(255 * pixels).astype(np.uint8), options)
    write_bytes(target, coded.tobytes())
