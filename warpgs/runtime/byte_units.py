"""Sizes in bytes, as people write and read them."""

from __future__ import annotations

import re

from warpgs.errors import UsageError

UNITS = {"B": 1} | {f"{p}{u}": b**i for i, p in enumerate("KMGT", 1) for u, b in (("B", 1000), ("iB", 1024))}
"""Bytes of each unit by name."""


def parse_bytes(text: str) -> int:
    """Return a size such as 2GiB, 512 MB or 1.5GiB in bytes.

    Raises:
        UsageError: The text is not a size, or the size is below one byte or not below 2^63.
    """
    found = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?|\.[0-9]+)\s*([A-Za-z]+)\s*", text)
    units = {u.lower(): b for u, b in UNITS.items()}
    if not found or found[2].lower() not in units:
        raise UsageError(
            f"memory limit {text[:40]!r} is not a size: give a number and a unit of {', '.join(UNITS)}, such as 2GiB"
        )
    size = float(found[1]) * units[found[2].lower()]
    if not 1 <= size < 2**63:
        raise UsageError(f"memory limit {text[:40]!r} must be at least one byte and less than 2^63")
    return int(size)


def format_bytes(size: float) -> str:
    """Return a size [bytes] as text for people to read."""
    for unit in ("B", "KiB", "MiB", "GiB"):
        if size < 1024:
            return f"{size:.0f} {unit}" if unit in ("B", "KiB") else f"{size:.1f} {unit}"
        size /= 1024
    return f"{size:.1f} TiB"
