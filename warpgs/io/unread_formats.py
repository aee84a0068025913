"""Formats of photographs that are known and not read, and what to do with them.

HEIC: the binary wheels of pillow-heif contain x265 (GPL), which this project does not depend on. RAW is left to a converter,
where colour and exposure are chosen for all photographs alike. AVIF is not read yet.
"""

from __future__ import annotations

from pathlib import Path

RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw")
"""Suffixes of RAW files of cameras; many of them begin like a TIFF, whose first image is a small preview."""
BRANDS = {
    b"heic": "HEIC", b"heix": "HEIC", b"heim": "HEIC", b"heis": "HEIC", b"hevc": "HEIC", b"hevx": "HEIC", b"mif1": "HEIC",
    b"msf1": "HEIC", b"avif": "AVIF", b"avis": "AVIF", b"crx ": "RAW",
}  # fmt: skip
"""Major brands of ISO base media files (ISO/IEC 14496-12; 23008-12 for HEIC), and the formats that they stand for."""
REMEDIES = {
    "HEIC": "a HEIC photograph, which is not read: convert all of them to JPEG, for instance with `heif-convert -q 95` or the "
    "phone's own export",
    "AVIF": "an AVIF photograph, which is not read: convert all of them to PNG, for instance with `avifdec`",
    "RAW": "a camera's RAW file, which is not read: develop all of them alike to JPEG or 16-bit PNG, with one white balance",
}
"""Words for each format and its remedy, as the end of a sentence."""
SUFFIXES = {".heic": "HEIC", ".heif": "HEIC", ".hif": "HEIC", ".avif": "AVIF", **dict.fromkeys(RAW_SUFFIXES, "RAW")}
"""Formats by the suffix of a file, lower case."""
HEAD = 12
"""Bytes that decide: length, ``ftyp`` and the major brand."""


def unread_format(path: Path, head: bytes) -> str | None:
    """Return the words on a photograph that is known and not read, as the end of a sentence; None for any other file.

    Args:
        path: Name of the file; the suffix decides for RAW alone.
        head: Its first bytes; a damaged file is known by them as well.
    """
    kind = BRANDS.get(head[8:HEAD]) if head[4:8] == b"ftyp" else None
    if kind == "HEIC" and b"avif" in head[HEAD:32]:  # mif1 is any still image; the compatible brands name the codec
        kind = "AVIF"
    if kind is None and path.suffix.lower() in RAW_SUFFIXES:
        kind = "RAW"
    return None if kind is None else REMEDIES[kind]


def unread_note(folder: Path) -> str:
    """Return a sentence on the photographs of a folder that are known by their suffix and not read; empty for none."""
    files = sorted(p for p in folder.glob("*") if p.suffix.lower() in SUFFIXES and p.name[0] != ".") if folder.is_dir() else []
    if not files:
        return ""
    first = f"{files[0].name} is {REMEDIES[SUFFIXES[files[0].suffix.lower()]]}"
    return first if len(files) == 1 else f"{first} ({len(files)} such files)"
