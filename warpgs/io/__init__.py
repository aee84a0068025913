"""Readers of scene folders: one file per format; `load_scene` turns each into a `warpgs.scene.Scene`."""

from typing import TYPE_CHECKING

from warpgs.faces import lazy

__all__ = [
    "Lens",
    "LoadedImage",
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
    from warpgs.io.folder import Probe, Reader, SceneFolder, ViewList, register as register_reader, view_name
    from warpgs.io.images import Lens, LoadedImage, ReadOptions
    from warpgs.io.maps import NamedMaps
else:
    __getattr__, __dir__ = lazy(__name__)
