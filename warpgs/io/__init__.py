"""Readers of scene folders: one file per format; `load_scene` turns each into a `warpgs.scene.Scene`."""

from typing import TYPE_CHECKING

from warpgs.faces import lazy

if TYPE_CHECKING:
    from warpgs.io.folder import (
        Probe as Probe,
        Reader as Reader,
        SceneFolder as SceneFolder,
        ViewList as ViewList,
        register_reader as register_reader,
        view_name as view_name,
    )
    from warpgs.io.images import Lens as Lens, LoadedImage as LoadedImage, ReadOptions as ReadOptions
    from warpgs.io.maps import NamedMaps as NamedMaps
else:
    __getattr__, __dir__ = lazy(__name__)
