"""Rows of the comparisons: scenes with a split and a size, and the same rows with training views left out."""

from __future__ import annotations

import functools
import re
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from warpgs import load_scene
from warpgs.errors import UsageError
from warpgs.io.load import split_views
from warpgs.scene import Scene
from warpgs.synthetic.demo import split_spec, write_demo

DEMO = "demo"
DEMO_VIEWS = 24
FEW = 4
"""Largest number of training views for which each is left out in turn; of more views, some are left out at once."""


@dataclass(frozen=True)
class Row:
    """A scene with its split and size."""

    scene: str
    """Folder, relative to the data folder; ``demo`` is generated."""
    split: str
    """Split, as in `warpgs fit --split`."""
    downscale: int = 1
    """Factor by which both image sides shrink."""
    views: int = 8
    """Number of training views, by which the time of a fit is predicted."""


ROWS = {
    **{f"fern:{n}": Row("llff/fern", f"llff:{n}", 1, n) for n in (3, 6, 9)},
    "fern:17": Row("colmap/fern", "every:8", 1, 17),
    **{f"horns:{n}": Row("llff/horns", f"llff:{n}", 1, n) for n in (3, 6, 9)},
    "horns:54": Row("llff/horns", "every:8", 1, 54),
    "fox:8": Row("fox", "llff:8", 4, 8),
    "fox:all": Row("fox", "every:8", 4, 43),
    # photographs 1 and 11 are one: llff:4 trains on 2, 6, 12 and 16, every:5 holds both out
    "temple:4": Row("templeSparseRing", "llff:4", 1, 4),
    "temple:12": Row("templeSparseRing", "every:5", 1, 12),
    "demo": Row(DEMO, split_spec(DEMO_VIEWS), 1, 6),
}
"""Named rows. fern and horns are 504 x 378 px, fox is 270 x 480, temple 640 x 480, the demo 320 x 240."""


PHOTOGRAPHS = {"fern:3:film": ("llff/fern/images_8", 3, ""), "fox:30": ("fox/images", 30, "--max-side 1333")}
"""Rows without cameras: folder of photographs, number of them, evenly spaced, and flags. The name says if a film is made."""


def row_of(name: str) -> Row:
    """Return a named row, or that of ``FOLDER@SPLIT`` or ``FOLDER@SPLIT@DOWNSCALE``."""
    if name in ROWS:
        return ROWS[name]
    match = re.fullmatch(r"([^@]+)@([^@]+)(?:@([1-9][0-9]?))?", name)
    if match is None:
        raise UsageError(f"row {name!r} is not one of {', '.join(ROWS)}, nor FOLDER@SPLIT or FOLDER@SPLIT@DOWNSCALE")
    return Row(match[1], match[2], int(match[3] or 1))


def made(data: Path, row: Row, work: Path) -> str:
    """Return the folder of a row's scene; the demo is written below ``work`` if it is missing."""
    if row.scene != DEMO:
        return str(data / row.scene)
    folder = work / DEMO
    if not folder.is_dir():
        write_demo(folder, views=DEMO_VIEWS)
    return str(folder)


def photographs(folder: Path, count: int, work: Path) -> Path:
    """Return a new folder with some of the photographs of a folder and nothing else."""
    files, made = sorted(p for p in folder.iterdir() if p.is_file()), Path(tempfile.mkdtemp(dir=work)) / folder.parent.name
    made.mkdir()
    for k in range(count):
        shutil.copy(files[k * (len(files) - 1) // max(1, count - 1)], made)
    return made


@functools.lru_cache(maxsize=32)
def scene_at(folder: str, downscale: int) -> Scene:
    """Return a scene; a process reads each once."""
    return load_scene(folder, downscale=downscale)


def left_out(names: tuple[str, ...], count: int) -> list[tuple[str, ...]]:
    """Return the sets of training views to leave out: of up to four each in turn, else ``count`` evenly between the ends."""
    n = len(names)
    if n < 3 or (n > FEW and not 1 <= count <= n - 2):
        raise UsageError(f"{count} of {n} training views cannot be left out: at least two must stay; use fewer")
    if n <= FEW:
        return [(name,) for name in names]
    return [tuple(names[round(i * (n - 1) / (count + 1))] for i in range(1, count + 1))]


def folds(scene: Scene, split: str, count: int) -> list[tuple[str, str]]:
    """Return splits that score left-out training views, each with the names of these; held-out views are never read.

    With ``count`` 0, return the split itself, without names.
    """
    if not count:
        return [(split, "")]
    train = split_views(scene, split).train
    made = []
    for out in left_out(train, count):
        rest = ",".join(name for name in train if name not in out)
        made.append((f"train={rest};test={','.join(out)}", ",".join(out)))
    return made


def shrunk(row: Row, factor: int) -> Row:
    """Return the row at a further fraction of its size."""
    return replace(row, downscale=row.downscale * factor)
