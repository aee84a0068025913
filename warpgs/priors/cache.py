"""Disk cache of the maps that networks compute from images; the key is a hash of all inputs and settings of a map."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from warpgs.errors import ResourceError
from warpgs.files import write_bytes
from warpgs.input_files import read_input
from warpgs.runtime.folders import cache_home, private_folder
from warpgs.runtime.terminal import say

CODE = 1
"""Version of the code between image and maps; increased whenever the same inputs would produce other maps."""


def cache_folder() -> Path:
    """Return the cache folder: WARPGS_CACHE if set, else warpgs in the system's folder for caches.

    Without WARPGS_CACHE and a home folder, the maps go to a private folder of this process, and a line on stderr reports that.

    Raises:
        ResourceError: There is no home folder, and no folder for temporary files either; or WARPGS_CACHE names an unknown home
            folder.
    """
    if own := os.environ.get("WARPGS_CACHE"):
        asked = Path(os.path.expanduser(own))  # as a shell does, but not within quotes
        if own.startswith("~") and not asked.is_absolute():
            raise ResourceError(f"WARPGS_CACHE: the home folder of {own} is unknown; give an absolute path")
        return asked
    home = cache_home()
    if home is None:
        say("warpgs: no home folder: maps are kept for this run only; set WARPGS_CACHE to a folder", error=True)
        return private_folder() / "maps"
    return home / "warpgs" / "Cache" if sys.platform == "win32" else home / "warpgs"


@dataclass
class MapCache:
    """A folder of maps. Damaged entries are computed again; notes report them, and report if the folder cannot be written."""

    folder: Path
    """Folder of the entries."""
    notes: list[str] = field(default_factory=list)
    """Messages for the user: entries that were damaged, a folder that cannot be written."""
    found: int = 0
    """Number of entries read from disk."""
    made: int = 0
    """Number of entries computed."""

    def maps(
        self, image: np.ndarray, names: tuple[str, ...], decided_by: dict, make: Callable[[], tuple[np.ndarray, ...]]
    ) -> tuple[np.ndarray, ...]:
        """Return the maps of an image, read from disk or computed.

        Args:
            image: Colours, float32, shape [H, W, 3].
            names: Names of the maps.
            decided_by: All other values that affect the maps, as JSON data.
            make: Function that computes the maps, float32 [H, W] in [0, 1] each.

        Returns:
            One map per name, float32, shape [H, W].
        """
        path = self._path(image, names, decided_by)
        stored = self._read(path, names, image.shape[:2])
        if stored is not None:
            self.found += 1
            return stored
        maps = make()
        self.made += 1
        self._write(path, names, maps)
        return maps

    def _path(self, image: np.ndarray, names: tuple[str, ...], decided_by: dict) -> Path:
        words = {"code": CODE, "names": names, "shape": image.shape, "type": str(image.dtype), **decided_by}
        key = hashlib.sha256(json.dumps(words, sort_keys=True).encode())
        key.update(np.ascontiguousarray(image).data)
        return self.folder / f"{key.hexdigest()}.safetensors"

    def _read(self, path: Path, names: tuple[str, ...], shape: tuple[int, int]) -> tuple[np.ndarray, ...] | None:
        import safetensors
        from safetensors.numpy import load

        try:
            stored = load(read_input(path))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError, KeyError, safetensors.SafetensorError) as e:
            self.notes.append(f"{path}: a stored map could not be read ({e}) and was computed again")
            return None
        maps = tuple(stored.get(n) for n in names)
        if all(m is not None and m.dtype == np.float32 and m.shape == shape and ((m >= 0) & (m <= 1)).all() for m in maps):
            return maps
        self.notes.append(f"{path}: a stored map was damaged and was computed again")
        return None

    def _write(self, path: Path, names: tuple[str, ...], maps: tuple[np.ndarray, ...]) -> None:
        from safetensors.numpy import save

        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, save({n: np.ascontiguousarray(m) for n, m in zip(names, maps)}))
        except (OSError, ResourceError) as e:
            note = f"maps are not cached ({e}); set WARPGS_CACHE to another folder"
            if not any(n.startswith("maps are not cached") for n in self.notes):
                self.notes.append(note)
