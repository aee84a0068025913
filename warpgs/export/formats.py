"""Reading and writing of Gaussians in the format of a file's suffix, or in a given one."""

from __future__ import annotations

import copy
import os
import re
from pathlib import Path

from warpgs.errors import UsageError
from warpgs.export.base import FORMATS, Format, warn_of_antialiasing
from warpgs.scene import Gaussians, Normalization


def all_formats() -> list[Format]:
    """Return every registered format with its default options: longer suffixes first, so .compressed.ply before .ply."""
    found = [FORMATS.find(name)() for name in FORMATS.names()]
    return sorted(found, key=lambda f: (-len(f.suffix), not type(f).__module__.startswith("warpgs."), f.suffix))


def suffixes() -> list[str]:
    """Return the suffix of every registered format, the longer ones first."""
    return [f.suffix for f in all_formats()]


def find_format(choice: str | type[Format] | Format) -> Format:
    """Return a format that is given as a name, ``module:Class``, ``path/to/file.py:Class``, a class or an object.

    A string with a colon imports the module or file, which runs its code: never pass a string from an untrusted file.

    Raises:
        UsageError: There is no such format, it does not derive from `Format`, or it has no suffix.
    """
    if not isinstance(choice, (str, type, Format)):
        raise UsageError(
            f"{choice!r} is not a format; give a name, module:Class, or a class or object derived from warpgs.Format"
        )
    found = (
        choice if isinstance(choice, Format) else FORMATS.load(choice)() if isinstance(choice, str) else FORMATS.find(choice)()
    )
    if not re.fullmatch(r"(\.[a-z0-9_-]+)+", found.suffix):
        raise UsageError(
            f"the format {type(found).__name__} has the suffix {found.suffix!r}; set it to a dot and lower-case letters or "
            "digits, such as '.mine'"
        )
    return found


def format_of(path: str | os.PathLike[str], choice: str | type[Format] | Format | None = None) -> Format:
    """Return the given format, or else the format of the file's suffix.

    Raises:
        UsageError: No format has the suffix, or the given format has another suffix.
    """
    if choice is not None:
        chosen = find_format(choice)
        if not chosen.fits(path):
            raise UsageError(f"{path}: expected a name that ends in {chosen.suffix}, for the format {chosen.name}")
        return chosen
    known = all_formats()
    for kind in known:
        if kind.fits(path):
            return kind
    name = Path(path).name.lower()
    if name.endswith(".htm"):
        raise UsageError(f"{path}: format .htm is not supported; did you mean {path}l?")
    cameras = "; cameras are named cameras.json, transforms.json or sparse" if name.endswith(".json") else ""
    raise UsageError(
        f"{path}: format {Path(path).suffix or '(none)'} is not supported; use one of {', '.join(k.suffix for k in known)}, or "
        f"give a format of your own{cameras}. `warpgs export` makes a page, too (.html), and `warpgs mesh` a mesh (.ply, .glb)"
    )


def write_gaussians(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    normalization: Normalization | None = None,
    *,
    units: str = "scene",
    format: str | type[Format] | Format | None = None,
    antialiased: bool = False,
) -> None:
    """Write Gaussians to a file, in the format of its suffix and in the units of the scene's files.

    The order of the Gaussians is kept. The write is atomic.

    Args:
        path: The file; an existing one is replaced.
        gaussians: N Gaussians, on any device; at least one, except in a .ply file.
        normalization: Similarity from file to scene units; needed where ``units`` is scene.
        units: Units of ``gaussians``: scene, or file to write them unchanged.
        format: Name of a format, or a `Format` of your own: an object, a class, ``module:Class`` or
            ``path/to/file.py:Class``. None for the format of the suffix.
        antialiased: True for Gaussians to be rendered with `RasterizeOptions.antialiased`. PLY, SPZ and SOG declare it.

    Raises:
        warpgs.DataError: A tensor contains a non-finite number, or one that the format cannot store; there are no
            Gaussians; or their spherical-harmonics degree is too high for the format.
        warpgs.ResourceError: The file cannot be written.
        TypeError: The Gaussians have other parameters; ``stored()`` of `ActivatedGaussians` converts them.
        warpgs.UsageError: The suffix, the format or the units are unknown, or scene units are given without a
            normalization.
        ValueError: A tensor has the wrong shape.
    """
    chosen = copy.copy(format_of(path, format))
    chosen.antialiased = antialiased
    chosen.write(Path(path), gaussians, normalization, units)


def read_gaussians(
    path: str | os.PathLike[str],
    normalization: Normalization | None = None,
    *,
    units: str = "file",
    format: str | type[Format] | Format | None = None,
) -> Gaussians:
    """Read Gaussians from a file, in the format of its suffix; a .ply file may be compressed.

    A file that declares antialiasing causes a warning: render it with `RasterizeOptions.antialiased`.

    Args:
        path: The file.
        normalization: Similarity from file to scene units; needed where ``units`` is scene.
        units: Units of the result: file as stored, or scene to go with a scene's cameras.
        format: As in `write_gaussians`.

    Returns:
        N Gaussians, torch float32 tensors on the CPU.

    Raises:
        warpgs.DataError: The file is missing, malformed, truncated, declares more data than its size allows, or contains
            a NaN, an infinity that `read_ply` does not replace, or a rotation of zero length.
        warpgs.UsageError: The suffix, the format or the units are unknown, or scene units are given without a
            normalization.
    """
    gaussians, antialiased = read_with_antialiasing(Path(path), normalization, units, format)
    if antialiased:
        warn_of_antialiasing(Path(path))
    return gaussians


def read_with_antialiasing(
    path: Path, normalization: Normalization | None, units: str, format: str | type[Format] | Format | None = None
) -> tuple[Gaussians, bool]:
    """Return the result of `read_gaussians`, and whether the file declares antialiasing."""
    chosen = format_of(path, format)
    return chosen.read(path, normalization, units), chosen.is_antialiased(path)
