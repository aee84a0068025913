"""Unsupported formats of photographs, and remedies.

HEIC is supported only for finding poses (`warpgs.poses.heic`). RAW is left to a converter, in which the user chooses the same
colour and exposure for all photographs.
"""

from __future__ import annotations

from pathlib import Path

from warpgs.io.image_formats.avif import kind

RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw")
"""Suffixes of RAW files of cameras; many begin like a TIFF, and their first image is a small preview."""
HEIC = "a HEIC photograph, which is supported only for finding poses (warpgs poses); convert all HEIC files to JPEG"
RAW = (
    "a RAW file, which is not supported; convert all RAW files to JPEG or 16-bit PNG, with the same settings and white balance"
)


def unread_format(path: Path, head: bytes) -> str | None:
    """Return a remedy for a photograph of an unsupported format, as the end of a sentence; None for any other file.

    Args:
        path: Name of the file; only RAW is detected by suffix.
        head: First bytes of the file; they identify damaged files, too.
    """
    if path.suffix.lower() in RAW_SUFFIXES or kind(head) == "RAW":
        return RAW
    return HEIC if kind(head) == "HEIC" else None


def unread_note(folder: Path) -> str:
    """Return a sentence on the RAW files of a folder, known by their suffix; empty for none."""
    files = (
        sorted(p for p in folder.glob("*") if p.suffix.lower() in RAW_SUFFIXES and p.name[0] != ".") if folder.is_dir() else []
    )
    if not files:
        return ""
    return f"{files[0].name} is {RAW}" if len(files) == 1 else f"{files[0].name} is {RAW} ({len(files)} such files)"
