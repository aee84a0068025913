"""Given maps of depth and normals of a scene: which file belongs to which image, and the checks that need the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warpgs.errors import DataError, UsageError
from warpgs.io.images import LoadedImage
from warpgs.io.map_files import NONE, MapFolder, MapOptions, read_confidence, read_depth, read_normals
from warpgs.io.map_pixels import in_pixels_of
from warpgs.lenses import CENTRAL
from warpgs.scene import GivenDepth, View

DEPTHS, NORMALS = "--depths", "--normals"


@dataclass(frozen=True)
class NamedMaps:
    """Maps that the files of a scene name for an image."""

    depth: Path | None = None
    """Depth map."""
    normals: Path | None = None
    """Normal map."""
    unit: float | None = None
    """Length of one unit of the depth map in units of the cameras, if the scene specifies it."""


NOTHING_NAMED = NamedMaps()
"""No maps."""


class GivenMaps:
    """Depth and normal maps of a scene, from the folders that the user names or the files that the scene names."""

    def __init__(self, options: MapOptions, max_pixels: int, allow_outside: bool):
        """List the files of the folders in ``options``.

        Raises:
            DataError: A folder is missing, or holds no map.
        """
        self.options, self.max_pixels = options, max_pixels

        def folder(path: Path | None, flag: str) -> MapFolder | None:
            return MapFolder(path, flag, allow_outside) if path is not None and str(path) != NONE else None

        self.depths, self.normals = folder(options.depths, DEPTHS), folder(options.normals, NORMALS)

    def attached(self, loaded: LoadedImage, image: Path, named: NamedMaps = NOTHING_NAMED) -> LoadedImage:
        """Return an image with its maps, at the image's size; the user's folder has priority over maps named in the scene.

        Raises:
            DataError: A map cannot be read, does not fit its image, or its values cannot be depths or normals.
            UsageError: The camera model of the image does not support the map.
        """
        depth, confidence, options = named.depth, None, self.options
        if options.depths is not None:
            depth, confidence = self.depths.find(image) if self.depths is not None else (None, None)
        elif depth is not None and options.depth_unit is None:
            options = replace(options, depth_unit=named.unit)
        normals = named.normals
        if options.normals is not None:
            normals = self.normals.find(image)[0] if self.normals is not None else None
        if depth is not None:
            loaded = replace(loaded, depth=self._depth(loaded, depth, confidence, options))
        return loaded if normals is None else replace(loaded, normals=self._normals(loaded, normals))

    def _depth(self, loaded: LoadedImage, path: Path, confidence: Path | None, options: MapOptions) -> GivenDepth:
        if loaded.camera_model not in CENTRAL or loaded.camera_model == "fisheye":
            raise UsageError(
                f"{path}: depth is not supported for the camera model {loaded.camera_model}; leave out --lenses "
                f"native, or the map ({DEPTHS} none)"
            )
        stored = read_depth(path, options, self.max_pixels)
        values, sure = in_pixels_of(loaded, stored, path), None
        if confidence is not None:
            known = read_confidence(confidence, stored.shape, self.max_pixels)
            sure = in_pixels_of(loaded, np.where(stored > 0, known, 0), confidence)
            values = np.where(sure > 0, values, 0)
        if not values.any():
            raise DataError(
                f"{path}: no pixel has a depth after mask, confidence and --downscale; remove the file: depth maps are optional"
            )
        return GivenDepth(values, options.depth_kind, sure)

    def _normals(self, loaded: LoadedImage, path: Path) -> np.ndarray:
        if loaded.camera_model != "pinhole":
            raise UsageError(
                f"{path}: normals need pinholes, not the camera model {loaded.camera_model}; leave out --lenses native, or the "
                f"map ({NORMALS} none)"
            )
        normals = in_pixels_of(loaded, read_normals(path, self.options, self.max_pixels), path)
        size = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = np.divide(normals, size, out=np.zeros_like(normals), where=size > 0.5)
        height, width = normals.shape[:2]
        K = loaded.K
        x, y = np.meshgrid((np.arange(width) + 0.5 - K[0, 2]) / K[0, 0], (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1])
        along = normals[..., 0] * x + normals[..., 1] * y + normals[..., 2]
        known = normals.any(-1)
        away = float((along[known] > 0).mean()) if known.any() else 1.0
        if not known.any():
            raise DataError(f"{path}: no pixel inside the mask has a normal; remove the file: normals are optional")
        if away > 0.5:
            other = "opencv" if self.options.normal_axes == "opengl" else "opengl"
            raise DataError(
                f"{path}: {away:.0%} of its normals face away from the camera in {self.options.normal_axes} axes; give "
                f"--normal-axes {other}, or turn them towards the camera"
            )
        return np.where((along <= 0)[..., None], normals, 0).astype(np.float32)


def check_found(views: Sequence[View], options: MapOptions, allow_outside: bool) -> list[str]:
    """Return notes on the maps of a scene's views.

    Raises:
        DataError: A folder is given, but no view has a map in it.
    """
    notes = []
    flags = {"depth": (options.depths, DEPTHS), "normals": (options.normals, NORMALS)}
    for name, (path, flag) in flags.items():
        having = [v for v in views if getattr(v, name) is not None]
        if path is not None and str(path) != NONE and not having:
            raise MapFolder(path, flag, allow_outside).unmatched()
        if not having:
            continue
        where = f"from {path}" if path is not None else f"listed in the scene's file; to ignore them, use {flag} none"
        what = "normals" if name == "normals" else "depth maps"
        notes.append(f"{what}: {len(having)} of {len(views)} views, {_about(name, having, options)}, {where}")
    return notes


def _about(name: str, views: Sequence[View], options: MapOptions) -> str:
    """Return a description of the values of the maps, for a note."""
    if name == "normals":
        return f"{'OpenCV' if options.normal_axes == 'opencv' else 'OpenGL'} axes"
    share = float(np.mean([(v.depth.values > 0).mean() for v in views if v.depth is not None]))
    unit = "a unit is 0.001 for integers, else 1" if options.depth_unit is None else f"a unit is {options.depth_unit:g}"
    words = {
        "metric": f"metric ({unit}; change it with --depth-unit)", "relative": "depth of unknown scale and shift",
        "disparity": "inverse depth of unknown scale and shift",
    }  # fmt: skip
    return f"{share:.1%} of their pixels, {words[options.depth_kind]}"
