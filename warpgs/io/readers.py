"""Readers of scene formats: the base class, the registry, and the choice of a reader by name, class or object.

One module of `warpgs.io` holds one format and registers its reader. Adding a format means adding one such module; a user's
own reader is passed to `warpgs.load_scene`, or named as ``module:Class`` or ``file.py:Class`` (examples/06_own_format.py).
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from warpgs.errors import UsageError
from warpgs.io.decoding import MAX_PIXELS
from warpgs.io.map_files import NO_MAPS, MapOptions
from warpgs.plugins import Registry
from warpgs.scene import Scene, View

DEFAULT_MAX_SIDE = 1600
"""Default of the longest side of an image [px]: 12 MP of a phone would take hours on a CPU."""


def image_scale(downscale: int | None, max_side: int | None) -> tuple[int, int]:
    """Return the factor and the longest side [px] (0 for no limit) that follow from two settings, each None if not given."""
    if max_side is None:
        max_side = DEFAULT_MAX_SIDE if downscale is None else 0
    return 1 if downscale is None else downscale, max_side


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading a scene folder."""

    downscale: int = 1
    """Factor, at least 1, by which both image sides shrink."""
    strict: bool = False
    """True to treat a frame without an image file as an error instead of a note."""
    allow_outside: bool = False
    """True to allow names and links that point to files outside the scene folder."""
    masks: str = "ignore"
    """Treatment of masked-out pixels: ignore (left out of fit and scores) or cutout (transparent)."""
    mask_keeps: str = "white"
    """Colour of a mask file that keeps a pixel: white or black."""
    black_is_empty: bool = True
    """True to make dark pixels around an object transparent, if every image shows an object on black."""
    max_pixels: int = MAX_PIXELS
    """Largest number of pixels that an image or a mask may have."""
    max_side: int = 0
    """Largest image side [px], after ``downscale``; 0 for no limit."""
    lenses: str = "undistort"
    """Treatment of lens distortion: undistort (images are resampled to a pinhole) or native (`Camera.model` names the lens)."""
    maps: MapOptions = NO_MAPS
    """Given maps of depth and normals."""
    on_image: Callable[[Path], object] | None = None
    """Called with the file of each image before it is decoded; None for no call."""

    def __post_init__(self) -> None:
        if isinstance(self.downscale, bool) or not isinstance(self.downscale, int) or self.downscale < 1:
            raise UsageError(f"--downscale must be a whole number of at least 1, not {self.downscale!r}")
        if isinstance(self.max_side, bool) or not isinstance(self.max_side, int) or not 0 <= self.max_side:
            raise UsageError(f"--max-side must be a whole number of pixels, 0 for no limit, not {self.max_side!r}")
        if isinstance(self.max_pixels, bool) or not isinstance(self.max_pixels, int) or self.max_pixels < 1:
            raise UsageError(f"--max-pixels must be a whole number of at least 1, not {self.max_pixels!r}")
        if self.masks not in ("ignore", "cutout"):
            raise UsageError(f"--masks must be ignore or cutout, not {self.masks!r}")
        if self.lenses not in ("undistort", "native"):
            raise UsageError(f"--lenses must be undistort or native, not {self.lenses!r}")
        if self.mask_keeps not in ("white", "black"):
            raise UsageError(f"--mask-keeps must be white or black, not {self.mask_keeps!r}")


@dataclass(frozen=True)
class Probe:
    """Files of a format in a folder."""

    found: str
    """Files of the format that were found, such as ``poses_bounds.npy``, as the subject of a sentence."""
    missing: str = ""
    """Missing files; empty if the folder is complete."""


class Reader(abc.ABC):
    """Base class of the readers of scene formats."""

    name: ClassVar[str] = ""
    """Name of the format: the name given to `register`, else the class attribute, else the name of the class."""
    description: ClassVar[str] = ""
    """Files of the format, then its name in brackets, on one line, for the error message on an unknown folder."""
    priority: ClassVar[int] = 100
    """Priority if a folder has several complete formats, lowest first; the built-in readers have 10 to 50."""

    _declared_name: ClassVar[str] = ""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.name = cls._declared_name = cls.__dict__.get("name", cls.__name__)

    @abc.abstractmethod
    def probe(self, folder: Path) -> Probe | None:
        """Look for the format in a folder, by file names only.

        Returns:
            The found and missing files; None if no file belongs to the format.
        """

    @abc.abstractmethod
    def read(self, folder: Path, options: ReadOptions) -> Scene:
        """Read a scene folder in which `probe` found everything.

        Returns:
            The scene in file coordinates: cameras as camera_from_world with OpenCV axes, images at their final size, notes on
            automatic choices. `warpgs.io.load.load_scene` sorts the views, normalises the coordinates, and adds score masks and
            the fingerprint.

        Raises:
            warpgs.DataError: A file is missing or malformed; the message names file, reason and fix.
        """

    def scene(self, folder: Path, views: list[View], notes: list[str], **fields: Any) -> Scene:
        """Return a `Scene` of this format; ``fields`` are further fields (points, background, pixels)."""
        return Scene(str(folder), self.name, tuple(views), notes=tuple(notes), **fields)


READERS: Registry[Reader] = Registry("reader", Reader, __package__)  # type: ignore[type-abstract]

register = READERS.register
"""Class decorator ``@register("name")`` that adds a reader to the built-in ones."""


def all_readers() -> list[Reader]:
    """Return a reader of every registered format, by ascending ``priority``, then by name."""
    return sorted((READERS.find(name)() for name in READERS.names()), key=lambda r: (r.priority, r.name))


def find_reader(choice: str | type[Reader] | Reader) -> Reader:
    """Return the reader for a name, ``module:Class``, ``path/to/file.py:Class``, a class or a reader object.

    A string with a colon imports the module or file, which runs its code: never pass a string from an untrusted file.

    Raises:
        UsageError: There is no such reader, or it does not derive from `Reader`.
    """
    if isinstance(choice, Reader):
        return choice
    if not isinstance(choice, (str, type)):
        raise UsageError(f"{choice!r} is not a reader; give a name, module:Class, or a class or object derived from Reader")
    if isinstance(choice, type) or ":" not in choice:
        return READERS.find(choice)()
    cls = READERS.load(choice)
    cls.name = cls._declared_name  # a scene's format is named by its reader, not by the place of the code
    return cls()
