"""Ten times the input costs about ten times the work, equal names included: lines that run are counted, not seconds."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import warpgs
from tests.io import scenes
from warpgs.errors import DataError
from warpgs.io import capture, colmap, others, transforms as camera_files
from warpgs.io.load import coincident_views, load_scene, split_views
from warpgs.pipeline.farm.job import list_jobs
from warpgs.poses.find import _notes, advice, neighbours
from warpgs.poses.mapping import Mapping, camera_groups, cameras_of
from warpgs.poses.photographs import Photograph
from warpgs.report.page import image_names
from warpgs.report.progress import read_events
from warpgs.scene import Camera, Scene, View

PACKAGE = str(Path(warpgs.__file__).parent)
SMALL, LARGE = 30, 300


def work(run):
    """Return how many lines of warpgs a call runs, rounds of loops included, and how many functions it enters."""
    steps = 0

    def local(frame, event, argument):
        nonlocal steps
        steps += 1
        return local

    def entered(frame, event, argument):
        return local(frame, event, argument) if frame.f_code.co_filename.startswith(PACKAGE) else None

    before = sys.gettrace()
    sys.settrace(entered)
    try:
        run()
    finally:
        sys.settrace(before)
    return steps


def grows(make, most=13.0):
    make(2)()
    small, large = (work(make(n)) for n in (SMALL, LARGE))
    assert large < most * small, f"{small} steps for {SMALL}, {large} for {LARGE}"


POSE = np.eye(3).tolist()


def inria(path, names):
    rows = [
        {"img_name": n, "width": 64, "height": 48, "fx": 50, "fy": 50, "rotation": POSE, "position": [i, 0, 0]}
        for i, n in enumerate(names)
    ]
    path.write_text(json.dumps(rows))


def transforms(path, names):
    frames = [{"file_path": n, "transform_matrix": np.eye(4).tolist()} for n in names]
    path.write_text(json.dumps({"w": 64, "h": 48, "fl_x": 50, "frames": frames}))


def colmap_text(path, names):
    path.mkdir(exist_ok=True)
    (path / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    (path / "images.txt").write_text("".join(f"{i} 1 0 0 0 {i} 0 0 1 {n}\n\n" for i, n in enumerate(names, 1)))


WRITERS = {"cameras.json": inria, "transforms.json": transforms, "sparse": colmap_text}
NAMES = {
    "equal": lambda n: ["a.png"] * n,
    "numbered": lambda n: ["a", *(f"a-{i}" for i in range(2, n // 2)), *["a"] * (n // 2)],
    "different": lambda n: [f"{i}.png" for i in range(n)],
}


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("file", WRITERS)
def test_cameras(file, names, tmp_path):
    def make(n):
        path = tmp_path / str(n) / file
        path.parent.mkdir()
        WRITERS[file](path, NAMES[names](n))
        return lambda: camera_files.read_cameras(path)

    grows(make)


def test_points_parameters_jobs_events_photographs_and_views(tmp_path):
    def points(n):
        path = tmp_path / f"{n}.txt"
        path.write_text("".join(f"{i} 0 0 1 9 9 9 0.1 1 0 2 0\n" for i in range(n)))
        return lambda: colmap.read_points(path, {1: "a", 2: "b"})

    def parameters(n):
        path = tmp_path / f"{n}_par.txt"
        path.write_text(f"{n}\n" + "".join(f"{i}.png {'1 ' * 21}\n" for i in range(n)))
        return lambda: others.read_camera_rows(path)

    def xml(n):
        (tmp_path / f"{n}.xml").write_text(scenes.metashape_xml(camera=scenes.METASHAPE_CAMERA * n))
        return lambda: capture.MetashapeReader().rows(tmp_path / f"{n}.xml")

    def table(n):
        text = scenes.realityscan_csv(names=scenes.NAMES[:1])
        (tmp_path / f"{n}.csv").write_text(text + f"{text.splitlines()[-1]}\n" * n)
        return lambda: capture.RealityScanReader().rows(tmp_path / f"{n}.csv")

    def jobs(n):
        path = tmp_path / f"{n}.jsonl"
        path.write_text("".join(json.dumps({"scene": f"s{i}", "steps": 5}) + "\n" for i in range(n)))
        return lambda: list_jobs(str(path))

    def events(n):
        path = tmp_path / f"{n}.events"
        path.write_text("".join(json.dumps({"step": i, "loss": 0.5}) + "\n" for i in range(n)))
        return lambda: read_events(path)

    photographs = [Photograph(f"{i}.png", None, 40, 30, 1, f"phone {i}", None, "0") for i in range(LARGE)]
    assert cameras_of(photographs, camera_groups(photographs)) == photographs
    grows(lambda n: lambda: _notes(photographs[:n]))

    def lookups(n):
        views = scene(n)
        split = split_views(views, "every:2")
        return lambda: (coincident_views(views, split), [views.view(v.name) for v in views.views], image_names(split.train))

    for make in (points, parameters, xml, table, jobs, events, lookups):
        grows(make)
    with pytest.raises(KeyError):
        scene(3).view("none")
    inria(tmp_path / "cameras.json", ["a", "a-2", "a", "a", "a-2", "b"])
    found, _ = camera_files.read_cameras(tmp_path / "cameras.json")
    assert list(found) == ["a", "a-2", "a-3", "a-4", "a-2-2", "b"]


def scene(n):
    images = np.zeros((4, 4, 3), np.float32)
    poses = [np.eye(4) for _ in range(n)]
    for i, pose in enumerate(poses):
        pose[0, 3] = i
    views = (View(f"a/{i:04d}/b.png", Camera(p, np.eye(3), 4, 4), images) for i, p in enumerate(poses))
    return Scene("x", "colmap", tuple(views))


@pytest.mark.parametrize("form", ["a/{:04d}/b.png", "a/{:04d}/b", "{:04d}/b.png", "{:04d}/b"])
def test_splits_by_names(form):
    def make(n):
        views = scene(n)
        spec = f"test={','.join(form.format(i) for i in range(0, n, 2))}"
        return lambda: split_views(views, spec)

    grows(make)


@pytest.mark.parametrize("wanted, found", [
    ("b/c.png", "b/c.png"), ("b/c", "b/c.png"), ("d/e.png", "x/d/e.png"), ("d/e", "x/d/e.png"), ("e.png", "x/d/e.png"),
    ("c.png", "could be any of a/b/c.png, b/c.png"), ("/c.png", "no view"), ("", "no view"), ("f" * 9999, "no view"),
])  # fmt: skip
def test_names_are_found_by_their_ends(wanted, found):
    from warpgs.io.load import _finder

    find = _finder(["a/b/c.png", "b/c.png", "x/d/e.png", "f" * 5000], "s")
    if " " in found:
        with pytest.raises(DataError, match=found):
            find(wanted)
    else:
        assert find(wanted) == found


def test_what_to_photograph_next():
    """The tree of nearest views takes one angle for each pair, where it took one for each pair of each step."""

    def found(n):
        angles = np.linspace(0, 3, n)
        turns = [np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]]) for a in angles]
        views = {i: (r, 100) for i, r in enumerate(turns)}
        matches = {(i, i + 1): 200 for i in range(n - 1)}
        return Mapping((900,) * n, matches, n, views, (), (), 50, 0.4, "incremental", "4")

    by_count = {n: found(n) for n in (2, SMALL, LARGE)}
    grows(lambda n: lambda: neighbours(by_count[n]), most=130)
    tree = neighbours(found(9))
    assert [(i, j) for i, j, _ in tree] == [(i, i + 1) for i in range(8)]
    lost = {n: replace(m, views={}) for n, m in by_count.items()}
    names = [f"{i}.png" for i in range(LARGE)]
    grows(lambda n: lambda: advice(lost[n], names[:n]))


@pytest.mark.parametrize("kind", ["transforms", "middlebury"])
def test_no_image_is_read_before_all_are_known_to_be_listed_once(kind, tmp_path, monkeypatch):
    """One file of ten thousand rows would decode its image ten thousand times, and hold all of them."""
    from warpgs.io import folder as folders

    folder = scenes.WRITERS[kind](tmp_path / "scene")
    if kind == "transforms":
        path = folder / "transforms.json"
        values = json.loads(path.read_text())
        values["frames"] = [values["frames"][0]] * 50
        path.write_text(json.dumps(values))
    else:
        path = next(folder.glob("*_par.txt"))
        _, first, *_ = path.read_text().splitlines()
        path.write_text("50\n" + f"{first}\n" * 50)
    read, load = [], folders.load_image
    monkeypatch.setattr(folders, "load_image", lambda p, *a, **k: (read.append(p), load(p, *a, **k))[1])
    with pytest.raises(DataError, match="is listed twice; remove one of its cameras"):
        load_scene(folder)
    assert not read
