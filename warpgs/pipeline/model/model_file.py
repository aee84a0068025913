"""Models, in memory and as one safetensors file: Gaussians, and the similarity from the coordinates of their scene's files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from warpgs import schema
from warpgs.coordinates import check_stored, checked_normalization, convert_camera, convert_gaussians
from warpgs.errors import DataError, UsageError
from warpgs.files import write_bytes
from warpgs.input_files import read_input, unread_reason
from warpgs.pipeline.metrics.evaluate import options_for
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Camera, Gaussians, Normalization
from warpgs.version import __version__

FORMAT = "warpgs-model-1"


@dataclass(frozen=True)
class Model:
    """A set of Gaussians in scene units, with the conversion to file units."""

    scene_gaussians: Gaussians
    """The Gaussians in scene units [u]."""
    normalization: Normalization
    """Similarity from file to scene units."""

    def gaussians(self, units: str = "scene") -> Gaussians:
        """Return the Gaussians in ``scene`` units, those of a `Scene`, or in ``file`` units, those of the scene's files."""
        return convert_gaussians(self.scene_gaussians, self.normalization, "scene", units)


@dataclass(frozen=True, repr=False)
class FittedModel(Model):
    """A model with the cameras it was fitted to and the settings it is rendered with."""

    scene_cameras: dict[str, Camera]
    """Cameras of all views of the scene by name, in scene units [u]."""
    train: tuple[str, ...]
    """Names of the views that were fitted."""
    test: tuple[str, ...]
    """Names of the views held out."""
    rule: str
    """Name of the rasterizer's cut-offs in the fit, such as exact."""
    background: tuple[float, float, float]
    """Colour behind the scene."""
    step: int
    """Steps done."""
    transparent: bool = field(default=False, kw_only=True)
    """True if the scene's images have an alpha channel, so that renders are transparent."""
    antialiased: bool = field(default=False, kw_only=True)
    """True if renders are antialiased (`RasterizeOptions.antialiased`)."""

    def __repr__(self) -> str:
        """Describe the model in one line."""
        sizes = f"{len(self.scene_gaussians):,} Gaussians, {len(self.scene_cameras)} cameras"
        return f"<{type(self).__name__}: {sizes}, step {self.step}>"

    def cameras(self, units: str = "scene") -> dict[str, Camera]:
        """Return the cameras of all views by name, in ``scene`` or ``file`` units."""
        return {n: convert_camera(c, self.normalization, "scene", units) for n, c in self.scene_cameras.items()}

    def options(self) -> RasterizeOptions:
        """Return the rasterizer's options of the fit: rule, background and antialiasing."""
        return options_for(self.rule, self.background, self.scene_gaussians, self.antialiased)


def save(path: str | Path, gaussians: Gaussians, normalization: Normalization | None = None, units: str = "scene") -> None:
    """Write a model to a safetensors file, atomically.

    Tensors are stored unchanged; the header contains their units and the normalization.

    Args:
        path: File to write; an existing file is replaced.
        gaussians: N Gaussians, on any device.
        normalization: Similarity from file to scene units; None for Gaussians in file units without a scene.
        units: Units of ``gaussians``: scene or file.

    Raises:
        DataError: A number is not finite, or the normalization is not a similarity.
        ResourceError: The file cannot be written.
        TypeError: The Gaussians have other parameters (``stored()`` of `ActivatedGaussians` converts them), or tensors differ
            in type.
        UsageError: The units are unknown, or scene units are given without a normalization.
        ValueError: The shapes of the tensors do not match.
    """
    from safetensors.torch import save as to_bytes

    check_stored(gaussians)
    _check_type(gaussians)
    normalization = checked_normalization(normalization, units, f"{path}: not written")
    tensors = {n: t.detach().cpu().contiguous() for n, t in gaussians.tensors().items()}
    for name, t in tensors.items():
        if not bool(torch.isfinite(t).all()):
            raise DataError(f"{path}: not written, {name} holds non-finite values; save an earlier state of the model")
    header = {
        "format": FORMAT, "version": __version__, "units": units, "scale": repr(float(normalization.scale)),
        "offset": json.dumps([float(v) for v in normalization.offset]),
    }  # fmt: skip
    write_bytes(Path(path), to_bytes(tensors, header))


def load(path: str | Path, device: str | torch.device = "cpu") -> Model:
    """Read a model that `save` wrote; `Model.gaussians` returns its Gaussians in scene or file units.

    Args:
        path: The file.
        device: Device of the tensors.

    Raises:
        DataError: The file is missing, damaged, or not a model.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load as from_bytes

    path = Path(path)
    try:
        data = read_input(path)
        tensors = from_bytes(data)
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")]).get("__metadata__") or {}
    except OSError as e:
        raise DataError(f"{path}: cannot be read ({unread_reason(e)}); check the path and its permissions") from e
    except (SafetensorError, ValueError) as e:
        raise DataError(f"{path}: damaged or not a safetensors file ({e}); write it again with warpgs.save") from e
    if header.get("format") != FORMAT or tensors.keys() != Gaussians.__dataclass_fields__.keys():
        raise DataError(f"{path}: not a model of format {FORMAT}; write it with warpgs.save, or read PLY with warpgs.read_ply")
    try:
        offset = schema.parse(header["offset"])
        schema.items(schema.number(), 3)(offset, "offset")
        found = Normalization(np.array(offset, np.float64), float(header["scale"]))
        normalization = checked_normalization(found, units := header["units"], str(path))
    except (KeyError, ValueError, UsageError) as e:
        raise DataError(f"{path}: its header is damaged ({e}); write it again with warpgs.save") from e
    gaussians = checked_gaussians(tensors, str(path))
    gaussians = gaussians.to(device)
    return Model(convert_gaussians(gaussians, normalization, units, "scene"), normalization)


def checked_gaussians(tensors: Mapping[str, torch.Tensor], where: str) -> Gaussians:
    """Return stored tensors as Gaussians.

    Args:
        tensors: Fields of `Gaussians` by name, of any shape [...].
        where: Path of their file, for messages.

    Raises:
        DataError: A tensor is missing or not finite, or shapes or types do not match.
    """
    names = Gaussians.__dataclass_fields__
    missing = [n for n in names if n not in tensors]
    if missing:
        raise DataError(f"{where}: {', '.join(missing)} missing; restore the file, or write it again")
    gaussians = Gaussians(**{n: tensors[n] for n in names})
    try:
        check_stored(gaussians)
        _check_type(gaussians)
    except (TypeError, ValueError) as e:
        raise DataError(f"{where}: {e}; restore the file, or write it again") from e
    for name, t in gaussians.tensors().items():
        if not bool(torch.isfinite(t).all()):
            raise DataError(f"{where}: {name} holds non-finite values; restore the file, or write it again")
    return gaussians


def _check_type(gaussians: Gaussians) -> None:
    """Raise TypeError if tensors are not all float32 or all float64."""
    for name, t in gaussians.tensors().items():
        if t.dtype not in (torch.float32, torch.float64) or t.dtype != gaussians.means.dtype:
            raise TypeError(f"{name} is {t.dtype}; give all tensors as float32 or all as float64")
