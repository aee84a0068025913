"""Scene folders: the interface of a reader, and what all readers do alike."""

import abc
import math
import posixpath
import re
import threading
import unicodedata
import warnings
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, ClassVar

import numpy as np

from warpgs.constants import POSE_TOLERANCE
from warpgs.device import machine_memory, usable_cores
from warpgs.errors import DataError, UsageError, expect, explained, listed, shortened
from warpgs.files import inside, is_within
from warpgs.geometry import matmul, nearest_rotation, pose_at, pose_of, rotation_matrices
from warpgs.io.image_files import READ, decode, unread_note
from warpgs.io.images import BLACK, REDUCED, SUFFIXES, Lens, LoadedImage, ReadOptions, list_images, load_image
from warpgs.io.maps import NOTHING_NAMED, GivenMaps, NamedMaps
from warpgs.plugins import Registry
from warpgs.scene import Camera, Scene, View

# Readers of scene formats: the base class, the registry, and the choice of a reader by name, class or object.
#
# One module of `warpgs.io` holds one format and registers its reader. Adding a format means adding one such module; a
# user's own reader is passed to `warpgs.load_scene`, or named as ``module:Class`` or ``file.py:Class``
# (examples/06_own_format.py).


@dataclass(frozen=True)
class Probe:
    """Files of a format in a folder."""

    found: str
    """Files of the format that were found, such as ``poses_bounds.npy``, as the subject of a sentence."""
    missing: str = ""
    """Missing files; empty if the folder is complete."""
    fallback: bool = False
    """True if other complete formats of the folder come first, whatever the priorities."""


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
            automatic choices. `warpgs.load_scene` sorts the views, normalises the coordinates, and adds score masks and
            the fingerprint.

        Raises:
            warpgs.DataError: A file is missing or malformed; the message names file, reason and fix.
        """

    def scene(self, folder: Path, views: list[View], notes: list[str], **fields: Any) -> Scene:
        """Return a `Scene` of this format; ``fields`` are further fields (points, background, pixels)."""
        return Scene(str(folder), self.name, tuple(views), notes=tuple(map(shortened, notes)), **fields)


READERS: Registry[Reader] = Registry("reader", Reader, __package__)  # type: ignore[type-abstract]

register = register_reader = READERS.register
"""Class decorator ``@register("name")`` that adds a reader to the built-in ones."""


def all_readers() -> list[Reader]:
    """Return a reader of every registered format, by ascending ``priority``, then by name."""
    return sorted((READERS.find(name)() for name in READERS.names()), key=lambda r: (r.priority, r.name))


def find_reader(choice: str | type[Reader] | Reader) -> Reader:
    """Return the reader for a name, ``module:Class``, ``path/to/file.py:Class``, a class or a reader object.

    A string with a colon imports the module or file, which runs its code: never pass a string from an untrusted file.
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


def named_by_dtu(names: list[str]) -> bool:
    """Return True where all names are DTU's own, `rect_001_3_r5000.png`, which count from 1."""
    return all(re.search(r"rect_[0-9]+_", n) for n in names)


def image_ids(names: list[str]) -> list[int] | None:
    """Return the ids of image files from the numbers in their names; None if no number distinguishes the names.

    DTU's own names, `rect_001_3_r5000.png`, count from 1, so number 1 is id 0; other numbers are used unchanged.
    """
    groups = [re.findall(r"[0-9]{1,12}", PurePosixPath(n).stem) for n in names]
    for place in zip(*groups):  # the first group of digits that differs between all names
        if len(values := [int(digits) for digits in place]) == len(set(values)):
            return [v - 1 for v in values] if named_by_dtu(names) else values
    return None


def protocol_ids(names: list[str], wanted: tuple[int, ...], least: int, where: str) -> dict[int, str]:
    """Return the names of the images with the wanted ids."""
    if len(names) < least:
        raise DataError(f"{where}: the protocol needs {least} views, not {len(names)}; restore them, or use llff:K, every:N")
    if (ids := image_ids(names)) is None:
        return {i: names[i] for i in wanted}
    first = 1 if min(ids) == 1 and not named_by_dtu(names) else 0  # files renamed 001, 002, ... count from one
    by_id = {i - first: name for i, name in zip(ids, names)}
    if missing := [i for i in range(max(least, len(names))) if i not in by_id]:
        raise DataError(f"{where}: images with the ids {listed(missing, 8)}, counted from 0, are missing; restore them")
    return {i: by_id[i] for i in wanted}


def rigid(viewmat: np.ndarray, where: str) -> np.ndarray:
    """Return a pose [4, 4] with its rotation made exactly orthonormal."""
    R = viewmat[:3, :3]
    with explained(f"{where}: cannot be used", "estimate the pose again, or remove the image", ValueError):
        expect(viewmat.shape == (4, 4) and np.isfinite(viewmat).all(), "the pose is not finite")
        # entries of a rotation are at most 1; the bound keeps the squares of wild ones from overflowing
        error = float(np.abs(R @ R.T - np.eye(3)).max()) if np.abs(R).max() < 1e3 else np.inf
        expect(error <= POSE_TOLERANCE, f"the pose is not rigid (R R^T is off by {error:.2g}): it scales or shears")
        expect(np.linalg.det(R) > 0, "the pose mirrors the scene (determinant -1): two axes are probably swapped")
    return pose_of(nearest_rotation(R), viewmat[:3, 3])


def quat_rotation(quat: tuple[float, ...], where: str) -> np.ndarray:
    """Return the rotation [3, 3] of a quaternion wxyz of any length."""
    q = np.array(quat, np.float64)
    norm = float(np.linalg.norm(q)) if (np.abs(q) < 1e100).all() else np.inf
    if not 1e-12 < norm < np.inf:
        raise DataError(f"{where}: the rotation quaternion {tuple(quat)} is zero or not finite; estimate the pose again")
    return rotation_matrices(q / norm)


def from_camera_to_world(matrix: np.ndarray, where: str, *, opengl: bool) -> np.ndarray:
    """Return camera_from_world [4, 4] with OpenCV axes from a camera-to-world matrix."""
    pose = np.eye(4)
    pose[: matrix.shape[0]] = matrix
    p, q, r, s = pose[3].tolist()  # numpy's allclose would take a quarter of the time of a pose
    if np.isfinite(pose).all() and not (max(abs(p), abs(q), abs(r)) <= 1e-6 and abs(s - 1) <= 1e-5):
        raise DataError(f"{where}: the last row of the pose is {pose[3].tolist()}, not 0 0 0 1; is the matrix transposed?")
    if opengl:
        pose[:3, 1:3] *= -1
    pose = rigid(pose, where)
    return pose_at(pose[:3, :3].T, pose[:3, 3])


def about(viewmat: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return camera_from_world [4, 4] in file units from one in file units about an ``origin`` [3]."""
    if not origin.any():
        return viewmat
    moved = viewmat.copy()
    moved[:3, 3] -= matmul(viewmat[:3, :3], origin)
    return moved


MAX_NAME_LENGTH = 4096


def has_folder(root: Path, *patterns: str) -> bool:
    """Return whether ``root`` contains a folder of one of the names or glob patterns."""
    return any(p.is_dir() for pattern in patterns for p in root.glob(pattern))


def view_name(name: str) -> str:
    """Return the normalised name of a view from a file name: "./a//b.png" gives "a/b.png".

    Renders are stored under these names, so no name is absolute or contains "..": "../a.png" gives "outside/a.png".
    """
    plain = posixpath.normpath(name)
    kept = [part for part in plain.split("/") if part not in ("", "..")]
    return "/".join(["outside", *kept] if plain.startswith(("/", "../")) else kept)


def view_name_of(path: Path, root: Path) -> str:
    """Return the view name of a file: its path below ``root`` without following links, else a path below `outside`."""
    plain, base = (posixpath.normpath(p.absolute().as_posix()) for p in (path, root))
    return view_name(plain[len(base) + 1 :] if Path(plain).is_relative_to(base) else plain)


def _folded(name: str) -> str:
    """Return a name without case, in one spelling of its letters."""
    return unicodedata.normalize("NFC", name).casefold()


def _plain(name: str) -> str:
    """Return the name of an image without suffix, as `_folded` does."""
    stem, dot, suffix = _folded(name).rpartition(".")
    return stem if f".{suffix}" in SUFFIXES else stem + dot + suffix


def _images_of(mask: str, images: set[str]) -> set[str]:
    """Return the images to which a mask file may belong: photo.jpg.mask.png to photo.jpg, photo_mask.png to photo.

    If the mask names one of the ``images`` with its suffix, that one alone; else plain names.
    """
    stems = {_plain(mask), re.sub(r"[._-]mask$", "", _plain(mask))}
    return stems & images or stems | {_plain(stem) for stem in stems}


class SceneFolder:
    """A scene folder with the options for reading it. Readers open all images and masks through it."""

    def __init__(self, root: Path, options: ReadOptions):
        self.root, self.options = root, options
        self._reduced, self._thread = False, threading.local()
        self._base = "images"
        # by folder of masks: the folder of its images, the masks by plain name of an image, and the images without one
        self._masks: dict[Path, tuple[Path, dict[str, list[Path]], dict[str, Path]]] = {}
        self._maps = GivenMaps(options)

    def inside(self, path: Path) -> Path:
        """Return a path after a check that no link in it points outside the scene folder, unless this is allowed.

        Raises:
            DataError: A link points outside.
        """
        return path if self.options.allow_outside else inside(path, self.root, "the scene folder")

    def child(self, folder: Path, name: object, where: str, *, root: Path | None = None) -> Path:
        """Return the path of a file that the scene names, in ``root`` (by default ``folder``) unless others are allowed.

        Raises:
            DataError: The name cannot be one of a file, or points outside.
        """
        usable = isinstance(name, str) and name.strip("/\\. ") and "\0" not in name and len(name) < MAX_NAME_LENGTH
        with explained(f"{where}: {str(name)[:80]!r} is not a file name", "name an image file", ValueError):
            expect(usable, "it is empty, too long or no text")
            str(name).encode("utf-8", "surrogateescape")
        path = folder / str(name)
        if "\\" in str(name) and not path.is_file():
            path = folder / str(name).replace("\\", "/")  # written on Windows
        if not self.options.allow_outside and not is_within(path, root or folder):
            raise DataError(f"{where}: {name!r} points outside the scene folder; move the file inside, or pass --allow-outside")
        return path

    def image(
        self,
        path: Path,
        lens: Lens | Callable[[int, int], Lens],
        *,
        downscale: int | None = None,
        mask: np.ndarray | Callable[[], np.ndarray] | None = None,
        background: tuple[float, float, float] = BLACK,
        named: NamedMaps = NOTHING_NAMED,
    ) -> LoadedImage:
        """Load an image of the scene as `load_image` does, and its maps of depth and normals.

        Args:
            path: The image file.
            lens: Its intrinsics, or a function that returns them for width and height [px].
            downscale: Factor by which both sides shrink: 1 for images of a folder such as `images_4`, which have been resized
                already. None for the factor that the user gave.
            mask: Weight of each pixel, in [0, 1], shape [H, W], from the method `mask`; or a function that returns it.
            background: Colour in [0, 1] behind transparent pixels.
            named: Maps that the scene names for the image.

        Returns:
            The image, float32, shape [H, W, 3], with intrinsics for its size.

        Raises:
            DataError: The file is outside the folder, or `load_image` rejects it; or a map is invalid.
            ResourceError: There is not enough memory to decode the image.
            UsageError: A side becomes too small, or the camera model does not support a map.
        """
        options = self.options if downscale is None else replace(self.options, downscale=downscale)
        weights = mask() if callable(mask) else mask
        loaded = load_image(self.inside(path), lens, options, weights, background)
        if weights is not None and getattr(self._thread, "binary", False):
            loaded = replace(loaded, done=(*loaded.done, "with a mask of the values 0 and 1, read as 0 and 255"))
        self._thread.binary = False
        if loaded.mask is not None and not loaded.mask.any():  # left out by `ViewList.add`
            return loaded
        if any(words.startswith(REDUCED) for words in loaded.done):
            self._reduced = True
        return self._maps.attached(loaded, path, named)

    def mask(self, path: Path) -> np.ndarray:
        """Return the weights of a mask file of the scene: float32 [H, W], 1 to keep a pixel, 0 to mask it out."""
        gray = np.ascontiguousarray(decode(self.inside(path), self.options.max_pixels)[0][..., 0])
        binary = self._thread.binary = 0 < float(gray.max()) < 1.5 / 255
        gray = (gray > 0).astype(np.float32) if binary else gray
        return gray if self.options.mask_keeps == "white" else 1 - gray

    def find_mask(self, image: Path, images_root: Path, folder: Path | None = None) -> np.ndarray | None:
        """Return the mask [H, W] of an image, or None without one.

        The mask is in ``folder``, by default `masks` beside the image folder. For photo.jpg it is photo.jpg.png, photo.png or
        photo.jpg, else the only file of the names of `_images_of`.
        """
        mask = self.mask_of(image, images_root, folder)
        return None if mask is None else mask()

    def mask_of(self, image: Path, images_root: Path, folder: Path | None = None) -> Callable[[], np.ndarray] | None:
        """Return a function that reads the mask of an image, for the method `image`; None without one. See `find_mask`."""
        folder = folder or images_root.parent / "masks"
        if not image.is_relative_to(images_root):
            return None
        _, masks, unmasked = self._masks.setdefault(folder, (images_root, {}, {}))
        relative = image.relative_to(images_root)
        names = _folded(relative.as_posix()), _plain(relative.as_posix())
        if folder.is_dir():
            for candidate in (folder / f"{relative.as_posix()}.png", folder / relative.with_suffix(".png"), folder / relative):
                if candidate.is_file():
                    return partial(self.mask, candidate)
            files = [] if masks else list_images(folder)
            images = {_folded(p.relative_to(images_root).as_posix()) for p in list_images(images_root) if files}
            for file in files:
                for name in _images_of(file.relative_to(folder).as_posix(), images):
                    masks.setdefault(name, []).append(file)
            files = masks.get(names[0]) or masks.get(names[1], [])
            if len(files) == 1:
                return partial(self.mask, *files)
        unmasked |= dict.fromkeys(names, relative)
        return None

    def mask_notes(self) -> list[str]:
        """Return notes on mask files without an image, and on folders named mask or masks that are not read."""
        notes = []
        for folder, (images, masks, unmasked) in self._masks.items():
            places = [p for p in (images, images.parent, self.root) if p.is_relative_to(self.root)]
            near = {p for place in places for p in place.iterdir() if p.name.casefold() in ("mask", "masks") and p.is_dir()}
            for other in sorted(near):  # two spellings may be one folder
                if not any(read.is_dir() and other.samefile(read) for read in self._masks) and list_images(other):
                    inner = (p.relative_to(self.root) if p.is_relative_to(self.root) else p for p in (other, folder))
                    where, there = (p.as_posix() for p in inner)
                    notes.append(f"the folder {where} is not read; masks are read from {there}")
            files = list_images(folder) if folder.is_dir() and unmasked else []
            known = {form(p.relative_to(images).as_posix()) for p in list_images(images) if files for form in (_folded, _plain)}
            of_unmasked, of_known = ({f for n in names for f in masks.get(n, [])} for names in (unmasked, known))
            if lone := [f for f in files if f in of_unmasked or f not in of_known]:
                image = min(unmasked.values())
                lost = f"{len(lone)} of {len(files)} files in {folder.name}, such as {lone[0].relative_to(folder)},"
                notes.append(f"{lost} match no image or several; name a mask like its image: {image.with_suffix('.png')}")
        return notes

    def images(self, base: str = "images") -> tuple[Path, int, str]:
        """Choose the image folder: `images_N` for a factor N, else the full-size folder, whose images are then resampled.

        Returns:
            The folder, the remaining factor for resampling, and a note for the user (empty if there was no choice).

        Raises:
            DataError: There is no image folder, or it is a link that points outside the scene folder.
        """
        downscale, folder = self.options.downscale, self.root / base
        self._base, ready = base, folder.parent / f"{folder.name}_{downscale}"
        if downscale > 1 and folder != self.root and ready.is_dir() and list_images(ready):
            return self.inside(ready), 1, f"images taken from {ready.name}"
        how = f"area-resampled by {downscale}" if downscale > 1 else ""
        if folder.is_dir() and list_images(folder):
            return self.inside(folder), downscale, how and f"images {how}"
        sizes = ((p.name[len(folder.name) + 1 :], p) for p in folder.parent.glob(f"{folder.name}_*"))
        others = {int(n): p for n, p in sizes if n.isdecimal() and list_images(p)}
        if not others:
            note = unread_note(folder) or f"missing, or without images ({READ}); put the images into it"
            raise DataError(f"{folder}: {note}")
        largest = others[min(others)]
        return self.inside(largest), downscale, f"no folder '{base}': images taken from {largest.name}{how and ', '}{how}"

    def pixel_source(self, by_folder: bool) -> str:
        """Return the source of a scene's pixels, for result files: the folder, and "as stored" or the kind of resampling.

        Call it after all images are read, because ``max_side`` may have reduced any of them.

        Args:
            by_folder: True if the format supports folders `images_N` (`images`); False if its reader reads the files that the
                scene names.
        """
        name, factor = "images", self.options.downscale
        if by_folder:
            folder, factor, _ = self.images(self._base)
            name = folder.name
        how = f"area-resampled by {factor}" if factor > 1 else "as stored"
        return f"{name} {how}, {REDUCED}at most {self.options.max_side} px a side" if self._reduced else f"{name} {how}"


def resampling_note(downscale: int) -> list[str]:
    """Return the note of a format that always resamples its images; an empty list for a factor of 1."""
    return [f"images area-resampled by {downscale}"] if downscale > 1 else []


def name_key(name: str) -> str:
    """Return a name without suffix, with / between folders, in one spelling of its letters."""
    return unicodedata.normalize("NFC", re.sub(r"(?<=[^/])\.[^./]*$", "", name.replace("\\", "/"))).casefold()


def by_key(files: dict[Path, str]) -> dict[str, Path]:
    """Return the files by the key of their names, without those that share one."""
    keys = {path: name_key(name) for path, name in files.items()}
    counts = Counter(keys.values())
    return {key: path for path, key in keys.items() if counts[key] == 1}


def is_absolute(name: str) -> bool:
    """Return whether a name is an absolute path, of this machine or of another one."""
    return PurePosixPath(name).is_absolute() or PureWindowsPath(name).is_absolute()


def missing_name(name: str) -> str:
    """Return a name below a folder for the file of an absolute path that is not there."""
    return posixpath.normpath(name.replace("\\", "/")).replace(":", "").lstrip("/")


def matched_note(found: dict[str, Path], place: str, root: Path, noun: str = "image") -> list[str]:
    """Return the note on names that another file than that of their spelling was ``found`` for; [] for none."""
    if not found:
        return []
    first, count = min(found), f"{len(found)} {noun}{'s' if len(found) != 1 else ''} of {place}"
    return [f"{count} matched by their names without suffix, case or folder ({first} is {found[first].relative_to(root)})"]


def missing_note(missing: list[str], total: int, noun: str, file: Path, strict: bool) -> list[str]:
    """Return the note on frames without an image file, which are skipped; a DataError if ``strict``; [] if all have one."""
    if not missing:
        return []
    text = f"{len(missing)} of {total} {noun} have no image file: {listed(missing)}"
    if count := sum(any("\ud800" <= letter <= "\udfff" for letter in name) for name in missing):
        text += f" ({count} of the names are not UTF-8; rename the photographs to letters of ASCII, and find poses again)"
    if strict:
        raise DataError(f"{file}: {text}. Restore them, or leave out --strict to go on without them")
    return [f"skipped: {text}"]


MIN_SEEN = 0.5
"""Smallest fraction of the pixels of an image that a usual lens leaves."""
MIN_CUT, MIN_CUT_VIEWS = 0.02, 0.5
"""Smallest transparent fraction of all pixels, and of images with some, where images show a cut-out object."""


LOADERS, MOST_LOADERS, LOADER_BYTES = 4, 16, 2**32
"""Largest number of threads that load images, each with 15 bytes a pixel of one at full size, 30 with lens distortion; then the
number where each has this much free memory [bytes], which is enough for 100 megapixels."""


def loaders() -> int:
    """Return the number of threads that load images on this machine."""
    return min(usable_cores(), max(LOADERS, min(MOST_LOADERS, machine_memory()[1] // LOADER_BYTES)))


def _masked_by_alpha(view: View, alpha: np.ndarray) -> View:
    """Return a view whose pixels are masked where its opacity is below 1 - `MIN_CUT`."""
    mask = alpha > 1 - MIN_CUT  # lossy encoders leave 253 of 255
    return replace(view, mask=mask if view.mask is None else mask & view.mask, alpha=None)


class ViewList:
    """Views of a scene in the order of reading, and counts of changes to their pixels.

    Args:
        options: Options for reading the scene; their ``on_image`` is called for each view. None for no call.
    """

    def __init__(self, options: ReadOptions | None = None) -> None:
        self._on_image = options and options.on_image
        self._views: list[View] = []
        self._waiting: list[tuple[str, np.ndarray, Callable[[], LoadedImage]]] = []
        self._done: Counter[str] = Counter()
        self._kept: dict[str, float] = {}
        self._narrow: dict[str, float] = {}
        self._names: set[str] = set()

    def claim(self, name: str, where: str) -> str:
        """Return and reserve the name of a view before its image is decoded.

        Raises:
            DataError: Another view has this name.
        """
        if name in self._names:
            raise DataError(f"{where}: the image {name!r} is listed twice; remove one of its cameras")
        self._names.add(name)
        return name

    @property
    def views(self) -> list[View]:
        """The views, with their images."""
        self._load()
        return self._views

    def add(self, name: str, viewmat: np.ndarray, loaded: LoadedImage | Callable[[], LoadedImage]) -> None:
        """Append a view of an image at its final size; ``viewmat`` is camera_from_world [4, 4] in file units, rigid.

        Functions that load images are called later, several at a time.
        """
        self._waiting.append((name, viewmat, loaded if callable(loaded) else lambda: loaded))

    def _load(self) -> None:
        """Load the images that wait; an error is that of the first image that has one."""
        waiting, self._waiting = self._waiting, []
        with warnings.catch_warnings(action="ignore"), ThreadPoolExecutor(loaders()) as pool:
            for (name, viewmat, _), loaded in zip(waiting, pool.map(lambda row: row[2](), waiting)):
                if self._on_image is not None:
                    self._on_image(name)
                self._append(name, viewmat, loaded)
        clear = [0.0 if v.alpha is None else float(1 - v.alpha.mean()) for v in self._views]
        share, many = math.fsum(clear) / max(1, len(clear)), sum(c > 0 for c in clear)
        if many and "cut out by a mask file" not in self._done and (share < MIN_CUT or many < MIN_CUT_VIEWS * len(clear)):
            what = f"without a cut-out object: transparent pixels, {share:.2%} of all, do not count, like masked ones"
            self._done[what] = many
            masked = (v if v.alpha is None else _masked_by_alpha(v, v.alpha) for v in self._views)
            self._views = [v for v in masked if v.mask is None or v.mask.any()]

    def _append(self, name: str, viewmat: np.ndarray, loaded: LoadedImage) -> None:
        if loaded.kept is not None:
            self._kept[name] = loaded.kept
        if loaded.mask is not None:
            if not loaded.mask.any():
                return
            left = float(loaded.mask.mean()) / (loaded.kept or 1 if "masked by a mask file" in loaded.done else 1)
            if left < MIN_SEEN and any("distort" in words for words in loaded.done):
                self._narrow[name] = left
        height, width = loaded.image.shape[:2]
        camera = Camera(viewmat, loaded.K, width, height, loaded.camera_model, loaded.distortion)
        maps = {"depth": loaded.depth, "normals": loaded.normals}
        self._views.append(View(name, camera, loaded.image, loaded.mask, alpha=loaded.alpha, **maps))
        self._done.update(loaded.done)

    def notes(self, options: ReadOptions | None = None) -> list[str]:
        """Return notes on changes to the pixels; with ``options`` also assumptions about masks."""
        self._load()
        notes = [f"{n} image{'s' if n != 1 else ''} {what}" for what, n in sorted(self._done.items())]
        if 0 < (opaque := sum(v.alpha is None for v in self._views)) < len(self._views):
            notes.append(f"{opaque} of {len(self._views)} images have no transparent pixel, and count as opaque everywhere")
        if self._narrow:
            name, left = min(self._narrow.items(), key=lambda item: item[1])
            many = f"the lens distortion leaves few pixels of {len(self._narrow)} images, {left:.0%} of {name}"
            notes.append(f"{many}; check it, or use --lenses native")
        cutout = options is not None and options.masks == "cutout"
        if options is None or not self._kept:
            return [*notes, "--masks cutout changes nothing: no image has a mask file"] if cutout else notes
        others = f"the others {'are transparent' if cutout else 'are ignored'} (--masks {options.masks})"
        kept = f"the {options.mask_keeps} ones (--mask-keeps {options.mask_keeps})"
        notes.append(f"masks keep {math.fsum(self._kept.values()) / len(self._kept):.1%} of the pixels, {kept}; {others}")
        out = "" if cutout else ", so that their views are left out (see --mask-keeps)"
        for fraction, what in ((0.0, f"keep no pixel{out}"), (1.0, "keep every pixel")):
            if names := [n for n, kept in self._kept.items() if kept == fraction]:
                notes.append(f"masks that {what}: {listed(names, 5)} ({len(names)})")
        return notes
