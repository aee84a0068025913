"""Readers of scene folders: one file per format; `load_scene` turns each into a `warpgs.scene.Scene`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warpgs.faces import lazy

__all__ = [
    "Lens",
    "LoadedImage",
    "MapOptions",
    "NamedMaps",
    "Probe",
    "ReadOptions",
    "Reader",
    "SceneFolder",
    "ViewList",
    "register_reader",
    "view_name",
]

if TYPE_CHECKING:
    from warpgs.io.folders import SceneFolder, ViewList, view_name
    from warpgs.io.given_maps import NamedMaps
    from warpgs.io.images import Lens, LoadedImage
    from warpgs.io.map_files import MapOptions
    from warpgs.io.readers import Probe, Reader, ReadOptions
    from warpgs.io.readers import register as register_reader
else:
    __getattr__, __dir__ = lazy(
        __name__,
        ("warpgs.io.folders", "SceneFolder", "ViewList", "view_name"),
        ("warpgs.io.given_maps", "NamedMaps"),
        ("warpgs.io.images", "Lens", "LoadedImage"),
        ("warpgs.io.map_files", "MapOptions"),
        ("warpgs.io.readers", "Probe", "Reader", "ReadOptions", "register as register_reader"),
    )
