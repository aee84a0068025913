"""Which views train and which are held out: the published protocols, and splits of one's own."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from warpgs.errors import DataError, UsageError
from warpgs.scene import Scene

DTU_TRAIN = (25, 22, 28, 40, 44, 48, 0, 8, 13)
"""Training ids of pixelNeRF's DTU protocol; the first 3, 6 or 9 are used."""
DTU_TEST = (1, 2, 9, 10, 11, 12, 14, 15, 23, 24, 26, 27, 29, 30, 31, 32, 33, 34, 35, 41, 42, 43, 45, 46, 47)
BLENDER_TRAIN = (2, 16, 26, 55, 73, 76, 86, 93)
"""Training ids of DietNeRF's 8-view Blender protocol; tests are every 8th of the test frames."""

SPECS = "llff:K, mip360:K, dtu:3|6|9, blender:8, every:N, all, or train=NAMES;test=NAMES"


@dataclass(frozen=True)
class Split:
    """Names of the views that train and of those held out; disjoint."""

    train: tuple[str, ...]
    test: tuple[str, ...]

    def __post_init__(self):
        both = set(self.train) & set(self.test)
        if both:
            raise DataError(
                f"views {', '.join(sorted(both)[:5])} are in training and in test; a score on them would mean nothing"
            )
        if not self.train:
            raise DataError("the split leaves no training view")


def _every_8th(names: list[str], count: int, spec: str) -> Split:
    test = tuple(n for i, n in enumerate(names) if i % 8 == 0)
    pool = [n for i, n in enumerate(names) if i % 8]
    if not 1 <= count <= len(pool):
        raise DataError(f"split {spec}: wants {count} training views, but {len(pool)} remain of {len(names)} after every 8th")
    # np.round goes half to even, as the published id tables do
    ids = np.round(np.linspace(0, len(pool) - 1, count)).astype(int)
    return Split(tuple(pool[i] for i in ids), test)


def _numbered(names: list[str], count: int, spec: str) -> Split:
    if spec.startswith("dtu"):
        if count not in (3, 6, 9) or len(names) != 49:
            raise DataError(f"split {spec}: the protocol has 3, 6 or 9 training views of 49; this scene has {len(names)} views")
        return Split(tuple(names[i] for i in DTU_TRAIN[:count]), tuple(names[i] for i in DTU_TEST))
    train = [n for n in names if n.split("/")[0] == "train"]
    test = [n for n in names if n.split("/")[0] == "test"]
    if count != 8 or len(train) != 100 or len(test) != 200:
        raise DataError(f"split {spec}: the protocol needs 100 train and 200 test frames; found {len(train)} and {len(test)}")

    def number(name: str) -> int:
        return int("".join(filter(str.isdigit, PurePosixPath(name).stem)) or 0)

    train, test = sorted(train, key=number), sorted(test, key=number)
    return Split(tuple(train[i] for i in BLENDER_TRAIN), tuple(test[::8]))


def _find(names: list[str], wanted: str, spec: str) -> str:
    matches = [n for n in names if n == wanted]
    matches = matches or [
        n for n in names if wanted in (PurePosixPath(n).name, PurePosixPath(n).stem, str(PurePosixPath(n).with_suffix("")))
    ]
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise DataError(f"split {spec}: {wanted!r} could be any of {', '.join(matches[:5])}; give the whole name")
    near = difflib.get_close_matches(wanted, names, 3, 0.3)
    raise DataError(f"split {spec}: there is no view {wanted!r}; the nearest names are {', '.join(near or names[:3])}")


def _explicit(names: list[str], spec: str) -> Split:
    parts: dict[str, tuple[str, ...]] = {}
    for part in spec.split(";"):
        key, sep, values = part.partition("=")
        if key.strip() not in ("train", "test") or not sep:
            raise UsageError(f"split {spec!r} is not understood; use {SPECS}")
        parts[key.strip()] = tuple(_find(names, v.strip(), spec) for v in values.split(",") if v.strip())
    train = parts.get("train", tuple(n for n in names if n not in parts.get("test", ())))
    test = parts.get("test", tuple(n for n in names if n not in train))
    return Split(train, test)


def split_views(scene: Scene, spec: str) -> Split:
    """Apply a split to a scene.

    ``llff:K`` and ``mip360:K``: of the sorted views every 8th is held out, K of the rest are chosen evenly. ``dtu:K`` and
    ``blender:8``: the published ids. ``every:N``: every Nth is held out, the rest trains. ``all``: none is held out.
    ``train=a,b;test=c``: names, with or without suffix; where one half is missing it is the rest.

    Raises:
        DataError: The scene does not have what the split names, or training and test overlap.
        UsageError: The split is not understood.
    """
    names = sorted(v.name for v in scene.views)
    if spec == "all":
        return Split(tuple(names), ())
    if "=" in spec:
        return _explicit(names, spec)
    kind, _, number = spec.partition(":")
    if kind not in ("llff", "mip360", "dtu", "blender", "every") or not number.isdigit() or int(number) < 1:
        raise UsageError(f"split {spec!r} is not understood; use {SPECS}")
    count = int(number)
    if kind in ("llff", "mip360"):
        return _every_8th(names, count, spec)
    if kind in ("dtu", "blender"):
        return _numbered(names, count, spec)
    test = tuple(n for i, n in enumerate(names) if i % count == 0)
    return Split(tuple(n for n in names if n not in test), test)


def default_split(scene: Scene) -> tuple[Split, str]:
    """The split where the user names none, and a sentence that says so.

    Every 8th view is held out where there are at least 9, else the middle one; of two views none.
    """
    names = sorted(v.name for v in scene.views)
    if len(names) >= 9:
        return split_views(scene, "every:8"), "no --split given: every 8th view is held out"
    if len(names) == 2:
        return Split(tuple(names), ()), "no --split given: both views train, none is held out"
    middle = names[len(names) // 2]
    return Split(tuple(n for n in names if n != middle), (middle,)), f"no --split given: {middle} is held out"
