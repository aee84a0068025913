"""Splits of a scene into training views and held-out views: published protocols, and the user's own."""

from __future__ import annotations

import difflib
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from warpgs.errors import DataError, UsageError
from warpgs.geometry import camera_extent
from warpgs.io.image_ids import protocol_ids
from warpgs.scene import Scene

DTU_TRAIN = (25, 22, 28, 40, 44, 48, 0, 8, 13)
"""Training ids of pixelNeRF's DTU protocol; the first 3, 6 or 9 are used."""
DTU_TEST = (1, 2, 9, 10, 11, 12, 14, 15, 23, 24, 26, 27, 29, 30, 31, 32, 33, 34, 35, 41, 42, 43, 45, 46, 47)
DTU_VIEWS = 49
"""Number of views to which the ids refer: the first 49 of a scan; some scans have 64."""
BLENDER_TRAIN = (2, 16, 26, 55, 73, 76, 86, 93)
"""Training ids of DietNeRF's 8-view Blender protocol; tests are every 8th of the test frames."""

MAX_COMPARED = 200
"""Longest name for which similar names are suggested."""
SPECS = "llff:K, mip360:K, dtu:3|6|9, blender:8, every:N, all, or train=NAMES;test=NAMES"


@dataclass(frozen=True)
class Split:
    """Names of the training views and of the held-out views; disjoint."""

    train: tuple[str, ...]
    test: tuple[str, ...]

    def __post_init__(self):
        both = set(self.train) & set(self.test)
        if both:
            some = ", ".join(sorted(both)[:5])
            raise DataError(f"views {some} are in training and in test, so their scores would be meaningless; name each once")
        if not self.train:
            raise DataError("the split leaves no training view; name at least one")


def _every_8th(names: list[str], count: int, spec: str) -> Split:
    test = tuple(n for i, n in enumerate(names) if i % 8 == 0)
    pool = [n for i, n in enumerate(names) if i % 8]
    if not 1 <= count <= len(pool):
        raise DataError(
            f"split {spec}: needs {count} training views, but {len(pool)} remain of {len(names)} after every 8th is held out; "
            "ask for fewer"
        )
    # np.round goes half to even, as the published id tables do
    ids = np.round(np.linspace(0, len(pool) - 1, count)).astype(int)
    return Split(tuple(pool[i] for i in ids), test)


def _dtu(names: list[str], count: int, spec: str) -> Split:
    if count not in (3, 6, 9):
        raise UsageError(f"split {spec!r}: the DTU protocol has 3, 6 or 9 training views; use dtu:3, dtu:6 or dtu:9")
    found = protocol_ids(names, DTU_TRAIN[:count] + DTU_TEST, DTU_VIEWS, f"split {spec}")
    return Split(tuple(found[i] for i in DTU_TRAIN[:count]), tuple(found[i] for i in DTU_TEST))


def _frame_number(name: str) -> tuple[int, str]:
    digits = re.findall(r"[0-9]{1,12}", PurePosixPath(name).stem)
    return int(digits[-1]) if digits else -1, name


def _blender(names: list[str], count: int, spec: str) -> Split:
    if count != len(BLENDER_TRAIN):
        raise UsageError(f"split {spec!r}: the Blender protocol has {len(BLENDER_TRAIN)} training views; use blender:8")
    # r_10 sorts before r_2 by name; the ids count frames
    train, test = (sorted((n for n in names if n.split("/")[0] == s), key=_frame_number) for s in ("train", "test"))
    if len(train) <= max(BLENDER_TRAIN) or not test:
        raise DataError(
            f"split {spec}: the Blender protocol picks from 100 frames in train and 200 in test; found {len(train)} and "
            f"{len(test)}. Restore the scene, or use llff:K or every:N"
        )
    return Split(tuple(train[i] for i in BLENDER_TRAIN), tuple(test[::8]))


class _Names:
    """Names of views, to be found by their ends."""

    def __init__(self, names: list[str], spec: str):
        self.names, self.spec = names, spec
        self.bare = {n: str(PurePosixPath(n).with_suffix("")) for n in names}
        self._ends: dict[tuple[bool, int], dict[str, list[str]]] = {}

    def find(self, wanted: str) -> str:
        """Return the view with the wanted name or name end, with suffix or without; the strictest kind of match decides."""
        parts = wanted.count("/") + 1
        for count in (0, parts):
            for bare in (False, True):
                matches = self._by_end(bare, count).get(wanted, [])
                if len(matches) == 1:
                    return matches[0]
                if matches:
                    some = ", ".join(matches[:5])
                    raise DataError(f"split {self.spec}: {wanted!r} could be any of {some}; give the whole name")
        forms = {f: n for n in self.names for f in (PurePosixPath(n).stem, PurePosixPath(n).name, self.bare[n], n)}
        short = [f for f in forms if len(f) <= MAX_COMPARED]  # the comparison takes the product of both lengths
        near = list(dict.fromkeys(forms[f] for f in difflib.get_close_matches(wanted[:MAX_COMPARED], short, 4, 0.3)))[:3]
        some = ", ".join(near or self.names[:3])
        raise DataError(f"split {self.spec}: no view {wanted!r}; the nearest names are {some}")

    def _by_end(self, bare: bool, count: int) -> dict[str, list[str]]:
        """Return names of more than ``count`` parts by their last ``count`` parts; if it is 0, all names by the whole name."""
        if (bare, count) not in self._ends:
            table: dict[str, list[str]] = {}
            for name in self.names:
                form = self.bare[name] if bare else name
                head, *tail = form.rsplit("/", count) if count else (form,)
                if len(tail) == count:
                    table.setdefault("/".join(tail) if count else head, []).append(name)
            self._ends[bare, count] = table
        return self._ends[bare, count]


def check_spec(spec: str) -> None:
    """Check that the specification of a split can be understood, before a scene is read.

    Raises:
        UsageError: The specification is unknown or malformed, or leaves nothing to train.
    """
    if "=" in spec:
        _named(spec)
    elif spec == "every:1":
        raise UsageError("split 'every:1' holds out every view and leaves none to train; use every:2 or more, or all")
    elif spec != "all" and not re.fullmatch(r"(llff|mip360|dtu|blender|every):([1-9][0-9]{0,5})", spec):
        raise UsageError(f"split {spec[:80]!r} is not understood; use {SPECS}")


def _named(spec: str) -> dict[str, str]:
    """Return the names that a specification lists for train and for test."""
    parts: dict[str, str] = {}
    for part in filter(str.strip, spec.split(";")):
        key, sep, values = (x.strip() for x in part.partition("="))
        if key not in ("train", "test") or not sep or key in parts:
            raise UsageError(f"split {spec[:80]!r} is not understood; use {SPECS}")
        parts[key] = values
    return parts


def _explicit(names: list[str], spec: str) -> Split:
    parts: dict[str, tuple[str, ...]] = {}
    known = _Names(names, spec)
    for key, values in _named(spec).items():
        found = [known.find(v.strip()) for v in values.split(",") if v.strip()]
        twice = sorted(n for n, count in Counter(found).items() if count > 1)
        if twice:
            raise DataError(f"split {spec}: {key} names {twice[0]} twice; name every view once")
        parts[key] = tuple(found)
    held = set(parts.get("test", ()))
    train = parts.get("train", tuple(n for n in names if n not in held))
    trained = set(train)
    test = parts.get("test", tuple(n for n in names if n not in trained))
    return Split(train, test)


def split_views(scene: Scene, spec: str) -> Split:
    """Return the split of a scene that a specification names.

    ``llff:K`` and ``mip360:K``: every 8th of the sorted views is held out, and K of the others, evenly spaced, train. ``dtu:K``
    and ``blender:8``: the published ids. ``every:N``: every Nth is held out, the others train. ``all``: none is held out.
    ``train=a,b;test=c``: names, with or without suffix; if one part is missing, it consists of all other views.

    Raises:
        DataError: The scene lacks views of the split, or training and test views overlap.
        UsageError: The split is not understood.
    """
    check_spec(spec)
    names = sorted(v.name for v in scene.views)
    if spec == "all":
        return Split(tuple(names), ())
    if "=" in spec:
        return _explicit(names, spec)
    kind, number = spec.split(":")
    count = int(number)
    if kind == "every":
        test = tuple(n for i, n in enumerate(names) if i % count == 0)
        return Split(tuple(n for i, n in enumerate(names) if i % count), test)
    return {"llff": _every_8th, "mip360": _every_8th, "dtu": _dtu, "blender": _blender}[kind](names, count, spec)


def held_out_split(scene: Scene) -> tuple[str, str]:
    """Return the default split of a study, which needs held-out views, and a note.

    Every 8th view is held out if there are at least 9, else the middle view. No view is held out if there are only two, or if
    the name of the middle view cannot be written in a specification.
    """
    names = sorted(v.name for v in scene.views)
    if len(names) >= 9:
        return "every:8", "no --split given: every 8th view is held out (--split every:8)"
    middle = names[len(names) // 2]
    if len(names) == 2 or set(middle) & set(",;=") or middle != middle.strip():
        return "all", "no --split given: every view trains, none is held out (--split all)"
    return f"test={middle}", f"no --split given: {middle} is held out"


def coincident_views(scene: Scene, split: Split) -> list[tuple[str, str]]:
    """Return pairs (held-out view, training view) with the same camera: a copy of the training image would score well.

    Two cameras count as the same if all entries of their poses differ by less than a thousandth; lengths are in camera extents.
    """
    extent = max(camera_extent([v.camera for v in scene.views]), 1e-9)
    unit = np.array([[1, 1, 1, 1 / extent]] * 3 + [[1] * 4])
    poses = {v.name: v.camera.viewmat * unit for v in scene.views}
    trained = np.stack([poses[b] for b in split.train])
    same = ((a, np.abs(trained - poses[a]).max((1, 2)) < 1e-3) for a in split.test)
    return [(a, split.train[i]) for a, found in same for i in np.flatnonzero(found)]
