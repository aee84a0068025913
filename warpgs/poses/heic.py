"""HEIC photographs, as phones take them: coded again as JPEG by a separate process.

pi-heif (libheif and libde265, LGPL) reads them. A malicious file can crash the process that reads it, so one separate process
reads all photographs.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from warpgs.errors import DataError, UsageError
from warpgs.files import make_folder, write_bytes, write_json
from warpgs.io.decoding import read_image_file, read_image_start
from warpgs.io.exif import EXPOSURE, FOCAL_35MM, MAKE, MODEL, parse_exif
from warpgs.io.image_formats.avif import BRANDS_END, kind
from warpgs.runtime.subprocesses import ProcessFailed, end_with_parent, python_lines
from warpgs.runtime.terminal import answer
from warpgs.suggestion import install_extras

QUALITY = 98
"""JPEG quality of the copies, without subsampling of colours."""


def is_heic(path: Path) -> bool:
    """Return whether a file begins as a HEIC file does.

    Raises:
        DataError: The file cannot be read.
    """
    return kind(read_image_start(path, BRANDS_END)) == "HEIC"


def to_jpeg(
    paths: Sequence[Path], root: Path, folder: Path, max_pixels: int, progress: Callable[[str], object] = lambda line: None
) -> dict[Path, Path]:
    """Write upright JPEG copies of HEIC files, with only maker, model and focal length as EXIF; return the copy of each.

    Args:
        paths: HEIC files below ``root``.
        root: The folder of photographs.
        folder: Folder of the copies, which have the relative names with .jpg added.
        max_pixels: Largest number of pixels that a header may announce.
        progress: Called with lines for the user.

    Raises:
        DataError: A file cannot be decoded, or has too many pixels.
        UsageError: pi-heif is not installed.
    """
    if not paths:
        return {}
    if importlib.util.find_spec("pi_heif") is None:
        raise UsageError(
            f"{paths[0]}: is a HEIC photograph, and the package pi-heif is not installed; "
            f"{install_extras('poses')}, or convert all HEIC files to JPEG"
        )
    copies = {p: folder / f"{p.relative_to(root).as_posix()}.jpg" for p in paths}
    for copy in copies.values():
        make_folder(copy.parent)
    job = folder / "heic.json"
    write_json(job, {"max_pixels": max_pixels, "files": [[str(p.resolve()), str(c)] for p, c in copies.items()]})
    at, why = 0, "the decoder ended early"
    try:
        for line in python_lines("warpgs.poses.heic", str(job), folder=folder):
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

    with pi_heif.HeifImageFile(io.BytesIO(read_image_file(source, max_pixels))) as image:
        width, height = image.size
        if width * height > max_pixels:
            raise ValueError(f"{width} x {height} px are more than the limit of {max_pixels:,} pixels (--max-pixels)")
        found, kept = parse_exif(image.info.get("exif") or b""), Image.Exif()
        kept.update({tag: text for tag, text in ((MAKE, found.maker), (MODEL, found.model)) if text})
        if found.focal is not None:
            kept.get_ifd(EXPOSURE)[FOCAL_35MM] = int(found.focal)
        pixels = io.BytesIO()
        image.convert("RGB").save(pixels, "JPEG", quality=QUALITY, subsampling=0, exif=kept)
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


if __name__ == "__main__":
    end_with_parent()
    main(sys.argv[1])
