"""Films of a model: paths of cameras, keyframes, choices that are said, and the files that are asked for."""

import dataclasses
import itertools
import json
import math

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

import warpgs
from tests.scenes import ring, three_gaussians
from warpgs.errors import DataError, UsageError
from warpgs.geometry import look_at, project_points
from warpgs.pipeline.films import film, paths
from warpgs.pipeline.films.film import FilmPlan, FilmSettings, fault_notes, fault_of, plan_film, render_film
from warpgs.pipeline.model.table import FittedModel
from warpgs.scene import Camera, Normalization

UNITS = Normalization(np.array([1.0, 2.0, 3.0]), 0.5)


@pytest.fixture
def model() -> FittedModel:
    """Three Gaussians as if they had been fitted, in scene units of their own."""
    cameras = {f"{i}.png": c for i, c in enumerate(ring(5))}
    return FittedModel(three_gaussians(), UNITS, cameras, tuple(cameras), (), "exact", (0.0, 0.0, 0.0), 1)


def keyframe(model: FittedModel, i: int, seconds: float, **changes) -> dict:
    """Keyframe i of a model as a viewer saves it: camera-to-world in file units."""
    camera = model.cameras("file")[f"{i}.png"]
    fov_y = 2 * math.atan(0.5 * camera.height / camera.K[1, 1])
    return {"c2w": np.linalg.inv(camera.viewmat).tolist(), "fov_y": fov_y, "seconds": seconds, **changes}


def test_keyframes_of_a_viewer_give_back_its_cameras(model, tmp_path):
    """The first and the last frame are the cameras that were saved in file units; the middle one lies at its time."""
    path = tmp_path / "keys.json"
    path.write_text(json.dumps([keyframe(model, 0, 2.0), keyframe(model, 1, 2.5), keyframe(model, 4, 3.0, fov_y=0.3)]))
    plan = plan_film(model, str(path), FilmSettings(fps=20))
    assert len(plan.cameras) == 21 and plan.notes == ["path: 3 keyframes over 1 s"]
    cameras = [c for _, c in plan.cameras]
    for got, wanted in ((cameras[0], 0), (cameras[10], 1), (cameras[-1], 4)):
        assert np.allclose(got.viewmat, model.cameras()[f"{wanted}.png"].viewmat, atol=1e-9)
    assert cameras[0].K[0, 2] == 20 and cameras[0].K[1, 2] == 16  # a viewer's axis is the middle of its image
    assert 2 * math.atan(0.5 * cameras[-1].height / cameras[-1].K[1, 1]) == pytest.approx(0.3)
    center = paths.rig_of(list(model.cameras().values()), 2.2).center
    for camera in cameras:  # all three look at one point, and so does every frame between them
        seen = camera.viewmat[:3, :3] @ center + camera.viewmat[:3, 3]
        assert np.abs(seen[:2]).max() < 0.15 and 2 < seen[2] < 2.5
    with pytest.raises(UsageError, match="their own fields of view"):
        plan_film(model, str(path), FilmSettings(fov_y=1.0))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda k: {}, "a list"),
        (lambda k: [], "holds 0 keyframes"),
        (lambda k: [{**k, "c2w": np.diag([1.0, 1, 2, 1]).tolist()}], "keyframe 0 must be a rigid"),
        (lambda k: [{**k, "c2w": np.diag([1.0, 1, -1, 1]).tolist()}], "keyframe 0 must be a rigid"),
        (lambda k: [{**k, "c2w": (1e200 * np.ones((4, 4))).tolist()}], "keyframe 0 must be a rigid"),
        (lambda k: [{**k, "c2w": [[1, 0], [0, 1]]}], "c2w"),
        (lambda k: [{**k, "c2w": [[math.nan] * 4] * 4}], "c2w"),
        (lambda k: [{**k, "fov_y": 50}], "fov_y"),
        (lambda k: [{**k, "fov_y": 0}], "fov_y"),
        (lambda k: [k, {**k, "seconds": 5e-324}], "keyframe 1 must be 0.001 to 86400 s after the last"),
        (lambda k: [k, {**k, "seconds": 1e300}], "keyframe 1 must be 0.001 to 86400"),
        (lambda k: [k] * 10_001, "1 to 10,000"),
        (lambda k: [{"c2w": k["c2w"], "fov_y": 1.0}], "seconds is missing"),
        (None, "no keyframes .No such file"),
        (lambda k: "{", "no keyframes"),
        (lambda k: "[" * 100_000, "no keyframes"),
    ],
)
def test_keyframes_that_are_none_are_refused(model, tmp_path, change, words):
    path = tmp_path / "keys.json"
    if change is not None:
        found = change(keyframe(model, 0, 0.0))
        path.write_text(found if isinstance(found, str) else json.dumps(found))
    with pytest.raises(DataError, match=words):
        paths.read_keyframes(path, model.cameras()["0.png"], UNITS)


def test_what_was_chosen_is_said(model, monkeypatch):
    plan = plan_film(model, "auto", FilmSettings(frames=4))
    assert len(plan.cameras) == 4 and plan.notes[1:] == ["path: spiral"]
    assert plan.notes[0] == "5 cameras on one side of the scene"
    low, high = (
        dataclasses.replace(c, viewmat=look_at(eye, np.zeros(3), np.array([0, -1.0, 0])))
        for c, eye in zip(model.cameras().values(), np.array([[0, 0, -4.0], [0, -4 * math.sin(0.8), -4 * math.cos(0.8)]]))
    )
    above = dataclasses.replace(model, scene_cameras={"0.png": low, "1.png": high}, train=("0.png", "1.png"))
    assert plan_film(above, "auto", FilmSettings()).notes[0] == "2 cameras on one side of the scene"
    plan = plan_film(model, "turntable", FilmSettings(seconds=0.5, fps=12, size=(64, 20), fov_y=0.5))
    assert [(c.width, c.height) for _, c in plan.cameras] == [(64, 20)] * 6 and "there and back" in plan.notes[-1]
    assert 2 * math.atan(10 / plan.cameras[0][1].K[1, 1]) == pytest.approx(0.5)
    for size, lost, fov in (((160, 64), "height", "34"), ((80, 128), "width", "63"), ((80, 64), "", "")):
        notes = [n for n in plan_film(model, "spiral", FilmSettings(frames=2, size=size)).notes if "shape" in n]
        said = f"frames have another shape than the photographs, and show 50% of their {lost}; --fov {fov} shows all"
        assert notes == [said] * bool(lost)
    plan = plan_film(model, "interpolate", FilmSettings(frames=13))
    assert plan.notes[-1].startswith("path: interpolate, through 3 of 5 cameras in the given order")
    assert [n for n, _ in plan_film(model, "views", FilmSettings()).cameras] == [f"{i}" for i in range(5)]
    monkeypatch.setattr("warpgs.pipeline.films.paths.path_of", lambda rig: "interpolate")
    named = [plan_film(model, path, FilmSettings()).notes[-1].endswith("is calmer") for path in ("auto", "interpolate")]
    assert named == [True, False]
    with pytest.raises(UsageError, match="path 'orbit'; choose one of auto, views, turntable, spiral, interpolate, or give"):
        plan_film(model, "orbit", FilmSettings())
    with pytest.raises(UsageError, match=r"unknown path 'turntabel'; did you mean turntable\?"):
        plan_film(model, "turntabel", FilmSettings())
    wrong = [{"size": (8, 100)}, {"fov_y": 0.001}, {"frames": 0}, *({"seconds": s} for s in (0.0, math.nan, 1e9))]
    for settings in wrong:
        with pytest.raises(UsageError):
            FilmSettings(**settings)


def test_empty_and_black_frames_are_noticed(model, tmp_path):
    good, black = list(model.cameras().values())[:3], three_gaussians()
    away = dataclasses.replace(good[0], viewmat=look_at(good[0].center, 2 * good[0].center, np.array([0, -1.0, 0])))
    plan = dataclasses.replace(
        plan_film(model, "auto", FilmSettings(frames=2)),
        cameras=[(str(i), c) for i, c in enumerate([*good, away, away, good[0]])],
    )
    assert 0.02 < plan.coverage < 0.9
    files, notes = render_film(model, plan, tmp_path / "a.webp", FilmSettings())
    assert notes[-1].startswith("2 of 6 frames show nearly nothing (frames 3, 4): the path leaves the captured area")
    assert "--path interpolate" in notes[-1] and files == [tmp_path / "a.webp"]
    dark = dataclasses.replace(model, scene_gaussians=dataclasses.replace(black, sh=torch.full_like(black.sh, -2.0)))
    _, notes = render_film(dark, plan, tmp_path / "b.webp", FilmSettings())
    assert "4 of 6 frames are black (frames 0, 1, 2, 5)" in notes[-1]
    white = np.ones((4, 4, 3))  # a tenth of what a training view shows is nearly nothing, however much that is
    assert [bool(fault_of(white, np.full((4, 4), alpha), 0.5)) for alpha in (0.04, 0.06)] == [True, False]
    assert "(frames 0, 3, 6, 9, 12, 15, 18, 21 and 6 more)" in fault_notes(["are black", "", ""] * 14, "")[0]


@pytest.mark.parametrize(
    ("path", "settings", "advice"),
    [
        ("auto", {}, None),
        ("interpolate", {}, None),
        ("auto", {"size": (160, 32)}, None),
        ("spiral", {"fov_y": 1.0}, "--path interpolate stays at the training views"),
        ("own", {}, "turn back"),
    ],
)
def test_what_no_photograph_saw_gets_a_note(model, tmp_path, path, settings, advice):
    """A film that is wider than the photographs, or leaves them, says so and what to do; others have no such note."""
    if path == "own":
        first = model.cameras()["0.png"]
        aside = [dataclasses.replace(first, viewmat=first.viewmat @ (np.eye(4) + x * np.eye(4, k=3))) for x in (0.0, -0.6)]
        plan = FilmPlan([(str(i), c) for i, c in enumerate(aside)], 0.0, "turn back", [])
    else:
        plan = plan_film(model, path, FilmSettings(frames=2, **settings))
    notes = [n for n in render_film(model, plan, tmp_path / "a.webp", FilmSettings())[1] if "outside all photographs" in n]
    assert len(notes) == (advice is not None)
    if advice:
        frames = "1 of 2 frames have over 10% of their pixels outside all photographs (frames 1)"
        assert notes[0].startswith(frames if path == "own" else "2 of 2 frames")
        assert notes[0].endswith(f"expect artefacts there; {advice}")


def test_a_film_alone_and_six_frames_on_a_sheet(model, tmp_path, capsys):
    """The suffix decides; a folder has an image for each frame as well, and a sheet is three frames wide."""
    assert warpgs.render_path(model, "turntable", out=tmp_path / "a.gif", frames=8) == [tmp_path / "a.gif"]
    assert "path: turntable, there and back" in capsys.readouterr().err
    plan = plan_film(model, "turntable", FilmSettings(frames=8))
    files, _ = render_film(model, plan, tmp_path / "a.webp", FilmSettings(), sheet=True)
    lines = []
    render_film(model, plan, tmp_path / "a.webp", FilmSettings(), tell=lines.append)
    assert lines[1] == "rendering: 1 of 8 frames" and lines[-1] == "writing a.webp"
    shape = 2 * 32 + 4, 3 * 40 + 8, 3
    assert files == [tmp_path / "a.webp"] and cv2.imread(str(tmp_path / "a-sheet.png")).shape == shape
    render_film(model, plan, tmp_path / "images", FilmSettings())
    less = render_film(model, plan_film(model, "turntable", FilmSettings(frames=5)), tmp_path / "images", FilmSettings())
    assert less[1][-1].startswith("3 older images are also in ")
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 8 and image.size == (40, 32)
    with pytest.raises(UsageError, match="coverage images are PNG files"):
        render_film(model, plan, tmp_path / "a.webp", FilmSettings(), coverage=True)
    (_, first), (_, second), *_ = plan.cameras
    mixed = dataclasses.replace(plan, cameras=[("0", first), ("1", dataclasses.replace(second, width=50))])
    with pytest.raises(UsageError, match="views differ in size"):
        render_film(model, mixed, tmp_path / "a.mp4", FilmSettings())
    with pytest.raises(UsageError, match="no camera"):
        warpgs.render_path(model, [], out=tmp_path / "x")
    with pytest.raises(TypeError, match=r"not Gaussians; `warpgs\.rasterize` renders"):
        warpgs.render_path(model.gaussians(), out=tmp_path / "x")


# Paths of films: what the cameras are is found from their poses, and every frame sees what matters.

K = np.array([[50.0, 0, 20], [0, 55, 15], [0, 0, 1]])
TARGET = np.array([3.0, -1.0, 7.0])
UP = np.array([0.3, -0.9, 0.1]) / math.sqrt(0.91)


def rolled(camera: Camera, degrees: float) -> Camera:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn = np.eye(4)
    turn[:2, :2] = [[c, -s], [s, c]]
    return Camera(turn @ camera.viewmat, camera.K, camera.width, camera.height)


def around(azimuths, elevation: float = 20.0, distance: float = 4.0) -> list[Camera]:
    """Cameras that look at the target from azimuths and an elevation about a slanted upward direction [deg]."""
    a, e = np.cross(UP, [0, 0, 1.0]), math.radians(elevation)
    a /= np.linalg.norm(a)
    b = np.cross(UP, a)
    eyes = [
        TARGET + distance * (math.cos(e) * (math.cos(t) * a + math.sin(t) * b) + math.sin(e) * UP) for t in np.radians(azimuths)
    ]
    return [Camera(look_at(eye, TARGET, UP), K, 40, 30) for eye in eyes]


def one_way(count: int = 6) -> list[Camera]:
    return [
        Camera(look_at(np.array([x, y, 0.0]), np.array([x, y, 1.0]), np.array([0, -1.0, 0])), K, 40, 30)
        for x, y in [(0.3 * (i % 3), 0.2 * (i // 3)) for i in range(count)]
    ]


def room(count: int = 10) -> list[Camera]:
    inner = around(360 * np.arange(count) / count, 0.0, 0.3)
    return [Camera(look_at(c.center, 2 * c.center - TARGET, UP), K, 40, 30) for c in inner]


def walk(count: int = 12) -> list[Camera]:
    corners = np.array([[0, 0, 0], [0, 0, 9.0], [9, 0, 9], [9, 0, 0]])
    at = np.linspace(0, 2.999, count)
    eyes = [corners[int(t)] + (t % 1) * (corners[int(t) + 1] - corners[int(t)]) for t in at]
    ways = [corners[int(t) + 1] - corners[int(t)] for t in at]
    return [Camera(look_at(e, e + w, np.array([0, -1.0, 0])), K, 40, 30) for e, w in zip(eyes, ways)]


@pytest.mark.parametrize(
    ("cameras", "kind", "all_round"),
    [
        (around(np.arange(0, 360, 30)), "ring", True),
        (around([0, 110, 235]), "ring", True),
        (around(np.arange(0, 360, 45), elevation=65), "ring", True),
        (around(np.arange(0, 190, 20)), "ring", False),
        (around(np.arange(0, 70, 12)), "forward", False),
        (ring(5), "forward", False),
        (one_way(), "forward", False),
        (one_way(1), "forward", False),
        (room(), "room", True),
        (walk(), "free", False),
    ],
)
def test_the_rig_is_found(cameras, kind, all_round):
    rig = paths.rig_of(cameras, 2.0)
    assert rig.kind == kind and rig.kind in paths.BY_KIND
    if kind != "free":
        assert (rig.span is None) == all_round
    if kind in ("ring", "forward"):
        assert all(rig.reach(c) > 0 for c in cameras)


def test_a_film_of_one_side_stays_near_the_photographs():
    """Over a wide arc it goes from one to the next; a spiral is as far from the scene as the photographs, and among them."""
    wide, narrow = around(np.arange(0, 70, 12)), around(np.arange(0, 31, 6))
    assert [paths.path_of(paths.rig_of(c, 2.0)) for c in (wide, narrow)] == ["interpolate", "spiral"]
    rig = paths.rig_of(narrow, 2.0)
    centers = np.array([c.center for c in narrow])
    ahead = rig.center - centers.mean(0)
    ahead /= np.linalg.norm(ahead)
    path = paths.camera_path("spiral", rig, narrow, 40)
    for c in path:
        assert abs(project_points(c, rig.center[None])[0][0] - c.K[:2, 2]).max() < 1e-6
        assert np.allclose(c.viewmat[:3, :3] @ c.viewmat[:3, :3].T, np.eye(3), atol=1e-12)
    eyes = np.array([c.center for c in path])
    assert np.linalg.norm(eyes - np.roll(eyes, 1, 0), axis=1).max() < 0.5  # the last is near the first
    np.testing.assert_allclose((rig.center - eyes) @ ahead, np.linalg.norm(rig.center - centers[0]), rtol=0.002)
    assert np.linalg.norm(eyes - centers.mean(0), axis=1).max() < np.linalg.norm(centers - centers.mean(0), axis=1).max()


@pytest.mark.parametrize("azimuths", [np.arange(0, 360, 30), np.arange(0, 30, 3), np.arange(0, 96, 10)])
def test_close_ups_do_not_cut_the_subject_off(model, monkeypatch, azimuths):
    """Beside six of ten photographs from 1.5 units, a film shows a ball that those from 4 units show whole."""
    cameras = [around([a], distance=1.5 if i % 5 < 3 else 4.0)[0] for i, a in enumerate(azimuths)]
    named = {str(i): c for i, c in enumerate(cameras)}
    model = dataclasses.replace(model, scene_cameras=named, train=tuple(named))
    shape = TARGET + 0.9 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])

    def whole(c: Camera) -> bool:
        pixels, depths = project_points(c, shape)
        return bool((depths > 0).all() and (pixels > 0).all() and (pixels < (c.width, c.height)).all())

    assert [whole(c) for c in cameras] == [i % 5 >= 3 for i in range(len(cameras))]
    monkeypatch.setattr(film, "depth_and_coverage", lambda *_: (2.5, 1.0))
    plan = plan_film(model, "auto", FilmSettings(frames=12))
    assert all(whole(c) for _, c in plan.cameras), plan.notes
    assert ("close-ups are left out" in plan.notes[-1]) == ("interpolate" in plan.notes[-1])


def test_a_film_has_the_shape_of_most_photographs():
    cameras = around(np.arange(0, 60, 12))
    tall = [dataclasses.replace(c, width=30, height=40, K=c.K[[1, 0, 2]][:, [1, 0, 2]]) for c in cameras[1:]]
    mixed = [cameras[0], *tall]
    rig = paths.rig_of(mixed, 4.0)
    keys = paths.tour_of(mixed, [rig.reach(c) for c in mixed], 2.0, 100)[0]
    for path in (
        paths.camera_path("spiral", rig, mixed, 3),
        paths.camera_path("turntable", rig, mixed, 3),
        paths.through(keys, 5),
    ):
        assert {(c.width, c.height) for c in path} == {(30, 40)}
    # a new size shows no more than the photograph in either direction; the axis stays in place, and square pixels stay square
    camera = ring(1)[0]
    for size in ((160, 64), (80, 128)):
        other = paths.framed(camera, size, None)
        assert other.K[0, 0] == other.K[1, 1] == pytest.approx(4 * camera.K[1, 1]) and (other.width, other.height) == size
    assert paths.framed(camera, (80, 64)).K == pytest.approx(camera.K * [[2], [2], [1]])
    near = paths.framed(camera, None, math.radians(40))
    assert 2 * math.degrees(math.atan(0.5 * near.height / near.K[1, 1])) == pytest.approx(40)
    assert paths.framed(camera) == camera
    turned = paths.framed(Camera(camera.viewmat, K, 40, 30), turned=True)
    assert turned.K.tolist() == [[55, 0, 15], [0, 50, 20], [0, 0, 1]] and (turned.width, turned.height) == (30, 40)


@pytest.mark.parametrize("roll", [(0, 0), (90, 90), (3, -4)])
@pytest.mark.parametrize("kind", ["turntable", "spiral"])
def test_a_ring_is_circled_level_whatever_way_the_photographs_lie(kind, roll):
    """Every frame has the object at its centre, upright, from the distance and height of the cameras; sides are swapped."""
    cameras = [rolled(c, roll[i % 2]) for i, c in enumerate(around(np.arange(0, 360, 24)))]
    rig = paths.rig_of(cameras, 1.0)
    assert rig.turned == (abs(roll[0]) == 90) and np.abs(rig.up - UP).max() < 1e-6
    for up in (paths.rig_among(cameras, TARGET + 0.1 * np.eye(3)).up, paths.common_up(cameras)):
        assert np.abs(up - UP).max() < 1e-6
    path = paths.camera_path(kind, rig, cameras, 9)
    for c in path:
        seen = c.viewmat[:3, :3] @ TARGET + c.viewmat[:3, 3]
        # focus_point is pulled to the mean centre by a millionth of the distance between them
        assert np.abs(seen[:2]).max() < 1e-4 and seen[2] == pytest.approx(4, rel=1e-5)
        assert -c.viewmat[1, :3] @ UP > 0.9 and abs(c.viewmat[0, :3] @ UP) < 1e-6
        assert (c.center - TARGET) @ UP == pytest.approx(4 * math.sin(math.radians(20)), rel=1e-4)
        assert (c.width, c.height) == ((30, 40) if rig.turned else (40, 30))
    azimuths = np.unwrap([math.atan2(*((c.center - TARGET) @ np.stack([rig.first, np.cross(UP, rig.first)]).T)) for c in path])
    turned = abs(azimuths[-1] - azimuths[0]) * 9 / 8
    assert turned == pytest.approx((2 if kind == "spiral" else 1) * 2 * math.pi, rel=1e-6)


@pytest.mark.parametrize("rolls", [(90, -90), (92, 92), (180, 0)])
def test_up_is_the_side_that_people_stand_on(rolls):
    """If photographs disagree on the upward direction, cameras are above their subject, also in a world upside down."""
    cameras = [rolled(c, rolls[i % 2]) for i, c in enumerate(around(np.arange(0, 360, 24)))]
    flip = np.diag([1.0, -1, -1, 1])
    flipped = [Camera(c.viewmat @ flip, c.K, c.width, c.height) for c in cameras]
    assert paths.rig_of(cameras, 1.0).up @ UP > 0.999 and paths.rig_of(flipped, 1.0).up @ (flip[:3, :3] @ UP) > 0.999


@pytest.mark.parametrize("cameras", [around(np.arange(0, 190, 20)), around(np.arange(0, 50, 12))])
def test_a_turntable_never_goes_where_no_camera_was(cameras):
    """It swings through the cameras' azimuths and back, with the object in every frame."""
    rig = paths.rig_of(cameras, 4.0)
    path = paths.camera_path("turntable", rig, cameras, 40)
    nearest = [min(np.linalg.norm(c.center - v.center) for v in cameras) for c in path]
    assert max(nearest) < 1.0 and max(np.linalg.norm(a.center - b.center) for a, b in zip(path, path[1:] + path[:1])) < 0.9
    for c in path:
        pixels, z = project_points(c, TARGET[None])
        assert z[0] > 0 and (0 < pixels[0]).all() and (pixels[0] < (c.width, c.height)).all()


@pytest.mark.parametrize(("roll", "azimuths"), [(0, [0, 110, 235]), (90, [0, 110, 235]), (-90, [10, 80, 150, 290])])
def test_three_photographs_are_enough_to_know_what_is_up(roll, azimuths):
    """Any three centres lie in a plane, which says nothing where the photographs were taken from different heights."""
    rig = paths.rig_of([rolled(c, roll) for c in around(azimuths)], 1.0)
    assert rig.turned == (roll != 0) and rig.up @ UP > 0.999
    heights = [around([a], e)[0] for a, e in zip(azimuths, (0, 50, 10, 40))]
    assert not paths.rig_of(heights, 1.0).turned and paths.rig_of(heights, 1.0).up @ UP > 0.9


def test_rooms_close_photographs_rings_and_closed_splines():
    cameras = room()
    path = paths.camera_path("turntable", paths.rig_of(cameras, 2.0), cameras, 8)
    assert all(np.allclose(c.center, TARGET, atol=1e-9) and abs(c.viewmat[2, :3] @ UP) < 1e-6 for c in path)
    assert np.linalg.norm(np.mean([c.viewmat[2, :3] for c in path], axis=0)) < 1e-6
    # of eight cameras on an arc and two below, nearer: a plane through them leans, but the cameras are level
    cameras = [*around(np.linspace(-55, 50, 8), 5.0), *around([-10, 15], -20.0, 1.6)]
    cameras = [rolled(c, 4 * (-1) ** i) for i, c in enumerate(cameras)]
    assert paths.rig_of(cameras, 4.0).up @ UP > math.cos(math.radians(5))
    # between two far views of a ring the path goes around, not through
    cameras = around([0, 70, 140, 220, 290])
    rig = paths.rig_of(cameras, 2.0)
    keys, closed, _ = paths.tour_of(cameras, [rig.reach(c) for c in cameras], 2.0, 100)
    for c in paths.through(keys, 60, closed=closed):
        seen = c.viewmat[:3, :3] @ TARGET + c.viewmat[:3, 3]
        assert np.abs(seen[:2]).max() < 1e-4 and abs(seen[2] - 4) < 0.05
    # neither position nor rotation, whose quaternion comes back as its opposite, has a corner where the spline closes
    keys = around([0, 90, 180, 270, 0])
    frames = 400
    path = paths.through([paths.Keyframe(c, float(i)) for i, c in enumerate(keys)], frames, closed=True)
    eyes, axes = np.array([c.center for c in path]), np.array([c.viewmat[:3, :3] for c in path])
    for values in (eyes, axes.reshape(frames, 9)):
        speed = np.diff(np.concatenate([values, values[:2]]), axis=0)
        assert np.abs(np.diff(speed, axis=0)).max() < 0.1 * np.abs(speed).max()
    # a tour of views whose names say nothing goes from neighbour to neighbour, and of too many views through some
    azimuths = np.arange(0, 300, 20)
    shuffled = around(azimuths[np.random.default_rng(0).permutation(15)])
    keys, _, by_name = paths.tour_of(shuffled, [0.0] * 15, 4.0, 100)
    legs = [np.linalg.norm(a.camera.center - b.camera.center) for a, b in itertools.pairwise(keys)]
    assert not by_name and len(legs) == 14 and max(legs) < 1.5
    assert paths.tour_of(around(azimuths), [0.0] * 15, 4.0, 100)[2]
    keys, closed, _ = paths.tour_of(around(azimuths), [0.0] * 15, 4.0, 6)
    assert len(keys) - closed == 6


@pytest.mark.parametrize(
    ("cameras", "closed"),
    [(around(np.arange(0, 360, 40)), True), (ring(6), False), (walk(), False)],
    ids=["ring", "arc", "walk"],
)
def test_a_tour_passes_through_the_cameras(cameras, closed):
    rig = paths.rig_of(cameras, 2.0)
    keys, is_closed, by_name = paths.tour_of(cameras, [rig.reach(c) for c in cameras], 4.0, 100)
    assert {id(k.camera) for k in keys} == {id(c) for c in cameras} and is_closed is closed
    end = keys[-1].seconds
    assert end == pytest.approx(4.0)
    path = paths.through(keys, 2001)
    for key in keys:
        at = path[round(key.seconds / end * 2000)]
        assert np.linalg.norm(at.center - key.camera.center) < 0.03 and at.viewmat[2] @ key.camera.viewmat[2] > 0.999
    eyes = np.array([c.center for c in path])
    steps = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    assert steps.max() < 20 * np.median(steps)
    assert np.linalg.norm(np.diff(eyes, 2, axis=0), axis=1).max() < 0.15 * np.median(steps)
    assert np.allclose(path[0].viewmat, cameras[0].viewmat, atol=1e-9) or not by_name
