"""Names of the image files of views, unique on every system."""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable
from pathlib import PurePosixPath

MOST_BYTES = 100
"""Longest name that is kept unchanged, without suffix: any file system allows it."""
NOT_EVERYWHERE = re.compile(
    r'^\.|[<>:"\\|?*\x00-\x1f\x7f]|^(con|prn|aux|nul|com\d|lpt\d)(\.|$)|^$|[\ud800-\udfff]', re.IGNORECASE
)
"""Names that hide a file, that are not UTF-8, or that Windows does not take."""


def image_names(views: Iterable[str]) -> dict[str, str]:
    """Return the file name, without suffix, of the images of each view of a scene.

    A file has the view's name without suffix, with _ for /, if this name is unique, ignoring capitals. A name that is
    ambiguous, longer than 100 bytes or not allowed on some system is shortened; digits of a hash of the whole name follow.

    Args:
        views: Names of all views of the scene, so that a view has one name in every folder.
    """
    own = {view: _own_name(view) for view in views}
    count = Counter(map(_folded, own.values()))
    kept = {v: n for v, n in own.items() if count[_folded(n)] == 1 and not NOT_EVERYWHERE.search(n) and _size(n) <= MOST_BYTES}
    taken = set(map(_folded, kept.values()))
    for view, name in own.items():
        if view in kept:
            continue
        part = re.sub(r"[^\w.-]", "_", name).lstrip(".").encode("utf-8", "replace")[: MOST_BYTES // 2].decode("utf-8", "ignore")
        digits, length = hashlib.sha256(view.encode("utf-8", "surrogatepass")).hexdigest(), 8
        while _folded(f"{part}-{digits[:length]}") in taken:
            length += 1
        kept[view] = f"{part}-{digits[:length]}"
        taken.add(_folded(kept[view]))
    return {view: kept[view] for view in own}


def renaming_notes(names: dict[str, str]) -> list[str]:
    """Return notes on views with other names for their images."""
    changed = [f"{view} is {name}.png" for view, name in names.items() if name != _own_name(view)]
    if not changed:
        return []
    words = ", ".join(changed[:3]) + (f", and {len(changed) - 3} more" if len(changed) > 3 else "")
    return [
        f"images of some views have other names, because view names are alike, long, or not allowed on every system: {words}"
    ]


def _own_name(view: str) -> str:
    path = PurePosixPath(view)
    return str(path).removesuffix(path.suffix).replace("/", "_")


def _folded(name: str) -> str:
    """Return a key that is equal for names that a file system may confuse: macOS and Windows ignore capitals."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _size(name: str) -> int:
    return len(name.encode("utf-8", "surrogatepass"))
