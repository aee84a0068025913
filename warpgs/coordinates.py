"""The two systems of units that Gaussians and cameras come in, and the similarity between them.

``scene`` units [u] are those of a `Scene` that `load_scene` returned: recentred and rescaled, as the fit sees it. ``file``
units are those of the scene's own files and of a run's PLY files. `Normalization` holds the similarity from file to
scene units: ``x_scene = scale * (x_file - offset)``.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from warpgs.errors import DataError, UsageError
from warpgs.scene import Camera, Gaussians, Mesh, Normalization

UNITS = ("scene", "file")
SH_COUNTS = (1, 4, 9, 16, 25)
"""Numbers of spherical-harmonics coefficients that Gaussians may have."""


def check_units(units: str) -> None:
    """Check that ``units`` names one of the two systems.

    Raises:
        UsageError: ``units`` is not one of `UNITS`.
    """
    if units not in UNITS:
        raise UsageError(f"units {units!r} is not one of {', '.join(UNITS)}")


def checked_normalization(normalization: Normalization | None, units: str, where: str) -> Normalization:
    """Check and return ``normalization``; with file units, None becomes the identity.

    Args:
        normalization: Similarity from file to scene units, or None.
        units: Units of the Gaussians: scene or file.
        where: Beginning of messages, such as the path of a file.

    Raises:
        DataError: The normalization is not finite, or its scale is not above 0.
        UsageError: The units are unknown, or scene units are given without a normalization.
    """
    check_units(units)
    if normalization is None:
        if units == "scene":
            raise UsageError(
                f"{where}: units='scene' requires normalization=scene.normalization; give it, or units='file' "
                "for Gaussians without a scene"
            )
        return Normalization()
    scale, offset = normalization.scale, np.asarray(normalization.offset)
    if not (math.isfinite(scale) and scale > 0 and offset.shape == (3,) and np.isfinite(offset).all()):
        raise DataError(f"{where}: the scene's normalization is not a similarity: {normalization}. Read the scene again")
    return normalization


def check_stored(gaussians: object) -> None:
    """Check that Gaussians have log scales and logits, as in files, and tensors of matching shapes.

    Raises:
        TypeError: The Gaussians have other parameters, or a parameter is not a tensor.
        ValueError: A shape disagrees.
    """
    if not isinstance(gaussians, Gaussians):
        how = "give gaussians.stored()" if hasattr(gaussians, "stored") else "files hold quats, log scales and logits"
        raise TypeError(f"gaussians must be an instance of Gaussians, not {type(gaussians).__name__}; {how}")
    for name, tensor in gaussians.tensors().items():
        if not hasattr(tensor, "detach"):
            raise TypeError(f"{name} must be a torch tensor, not {type(tensor).__name__}")
    count = gaussians.means.shape[0] if gaussians.means.ndim else 0
    for name, rest in {"means": [3], "quats": [4], "log_scales": [3], "logit_opacities": []}.items():
        if (found := list(getattr(gaussians, name).shape)) != [count, *rest]:
            raise ValueError(f"{name} must have shape [{', '.join(map(str, ['N', *rest]))}] (N={count}), not {found}")
    found = list(gaussians.sh.shape)
    if len(found) != 3 or found[1] not in SH_COUNTS or found != [count, found[1], 3]:
        raise ValueError(f"sh must have shape [N, K, 3] (N={count}), where K is 1, 4, 9, 16 or 25, not {found}")


def convert_gaussians(gaussians: Gaussians, normalization: Normalization, source: str, target: str) -> Gaussians:
    """Return Gaussians in other units; tensors that do not change are shared.

    Means and log scales change; quaternions, opacities and spherical harmonics do not, because the similarity has no rotation.
    Sums are taken in float64: with georeferenced offsets of 10^6 m, float32 would lose millimetres.

    Args:
        gaussians: N Gaussians in the units ``source``, on any device.
        normalization: Similarity from file to scene units.
        source: Units of the input: scene or file.
        target: Units of the result: scene or file.

    Raises:
        TypeError: The Gaussians are given by other parameters.
        UsageError: A name of units is unknown.
        ValueError: A shape disagrees.
    """
    check_stored(gaussians)
    check_units(source)
    check_units(target)
    if source == target:
        return gaussians
    means, log_scales = gaussians.means.double(), gaussians.log_scales.double()
    offset = means.new_tensor(np.asarray(normalization.offset, np.float64))
    if target == "file":
        means, log_scales = means / normalization.scale + offset, log_scales - math.log(normalization.scale)
    else:
        means, log_scales = normalization.scale * (means - offset), log_scales + math.log(normalization.scale)
    kind = gaussians.means.dtype
    return dataclasses.replace(gaussians, means=means.to(kind), log_scales=log_scales.to(kind))


def convert_mesh(mesh: Mesh, normalization: Normalization, source: str, target: str) -> Mesh:
    """Return a mesh in other units: its vertices change, triangles and colours are shared.

    Args:
        mesh: The mesh in the units ``source``.
        normalization: Similarity from file to scene units.
        source: Units of the input: scene or file.
        target: Units of the result: scene or file.

    Raises:
        UsageError: A name of units is unknown.
    """
    check_units(source)
    check_units(target)
    if source == target:
        return mesh
    scale, offset = normalization.scale, np.asarray(normalization.offset, np.float64)
    vertices = mesh.vertices / scale + offset if target == "file" else scale * (mesh.vertices - offset)
    return dataclasses.replace(mesh, vertices=vertices)


def convert_camera(camera: Camera, normalization: Normalization, source: str, target: str) -> Camera:
    """Return a camera, or a batch of them, in other units: its translation changes, rotation and intrinsics do not.

    Args:
        camera: One camera or a batch, with numpy arrays or torch tensors.
        normalization: Similarity from file to scene units.
        source: Units of the input: scene or file.
        target: Units of the result: scene or file.

    Raises:
        UsageError: A name of units is unknown.
    """
    check_units(source)
    check_units(target)
    if source == target:
        return camera
    viewmat: Any = camera.viewmat.copy() if isinstance(camera.viewmat, np.ndarray) else camera.viewmat.clone()
    offset: Any = np.asarray(normalization.offset, np.float64)
    if not isinstance(viewmat, np.ndarray):
        offset = viewmat.new_tensor(offset)
    rotation, translation = viewmat[..., :3, :3], viewmat[..., :3, 3]
    if target == "file":
        viewmat[..., :3, 3] = translation / normalization.scale - rotation @ offset
    else:
        viewmat[..., :3, 3] = normalization.scale * (rotation @ offset + translation)
    return dataclasses.replace(camera, viewmat=viewmat)
