"""Films of a model: choices are said, empty frames noticed, keyframes read or refused, and the files are those asked for."""

import dataclasses
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
from warpgs.geometry import look_at
from warpgs.pipeline.films.film import FilmPlan, FilmSettings, FrameCheck, plan_film, render_film
from warpgs.pipeline.films.paths import read_keyframes, rig_of
from warpgs.pipeline.model.table import FittedModel
from warpgs.scene import Normalization

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
    center = rig_of(list(model.cameras().values()), 2.2).center
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
        (lambda k: [{**k, "c2w": np.zeros((4, 4)).tolist()}], "keyframe 0 must be a rigid"),
        (lambda k: [{**k, "c2w": (1e200 * np.ones((4, 4))).tolist()}], "keyframe 0 must be a rigid"),
        (lambda k: [{**k, "c2w": [[1, 0], [0, 1]]}], "c2w"),
        (lambda k: [{**k, "c2w": [[math.nan] * 4] * 4}], "c2w"),
        (lambda k: [{**k, "fov_y": 50}], "give radians"),
        (lambda k: [{**k, "fov_y": 0}], "fov_y"),
        (lambda k: [{**k, "seconds": "1"}], "seconds"),
        (lambda k: [k, {**k, "seconds": 5e-324}], "keyframe 1 must be 0.001 to 86400 above those of keyframe 0"),
        (lambda k: [k, {**k, "seconds": 1e300}], "keyframe 1 must be 0.001 to 86400 above those of keyframe 0"),
        (lambda k: [k, k], "keyframe 1 must be 0.001 to 86400 above those of keyframe 0"),
        (lambda k: [k] * 10_001, "1 to 10,000"),
        (lambda k: [{"c2w": k["c2w"], "fov_y": 1.0}], "seconds is missing"),
    ],
)
def test_keyframes_that_are_none_are_refused(model, tmp_path, change, words):
    path = tmp_path / "keys.json"
    path.write_text(json.dumps(change(keyframe(model, 0, 0.0))))
    with pytest.raises(DataError, match=words):
        read_keyframes(path, model.cameras()["0.png"], UNITS)


def test_no_file_of_keyframes(model, tmp_path):
    for name, text in (("none.json", None), ("a.json", "{"), ("b.json", "[" * 100_000)):
        if text is not None:
            (tmp_path / name).write_text(text)
        words = "no such file; give a .json file of keyframes" if text is None else "cannot be read as keyframes"
        with pytest.raises(DataError, match=words):
            read_keyframes(tmp_path / name, model.cameras()["0.png"], UNITS)


def test_a_film_through_photographs_of_one_side_names_the_calmer_path(model, monkeypatch):
    """Where warpgs chose the path, and only there."""
    monkeypatch.setattr("warpgs.pipeline.films.film.path_of", lambda rig: "interpolate")
    calmer = "; --path turntable is calmer"
    named = [plan_film(model, path, FilmSettings()).notes[-1].endswith(calmer) for path in ("auto", "interpolate")]
    assert named == [True, False]


def test_what_was_chosen_is_said(model):
    """Auto takes what suits the cameras; durations and frames are those asked for."""
    plan = plan_film(model, "auto", FilmSettings(frames=4))
    assert len(plan.cameras) == 4 and plan.notes[1:] == ["path: spiral"]
    assert plan.notes[0].startswith("5 cameras on one side of the scene, over 6")
    plan = plan_film(model, "turntable", FilmSettings(seconds=0.5, fps=12, size=(64, 20), fov_y=0.5))
    assert [(c.width, c.height) for _, c in plan.cameras] == [(64, 20)] * 6 and "there and back" in plan.notes[-1]
    assert 2 * math.atan(10 / plan.cameras[0][1].K[1, 1]) == pytest.approx(0.5)
    plan = plan_film(model, "interpolate", FilmSettings(frames=13))
    assert plan.notes[-1].startswith("path: interpolate, through 3 of 5 cameras in the given order")
    assert [n for n, _ in plan_film(model, "views", FilmSettings()).cameras] == [f"{i}" for i in range(5)]
    with pytest.raises(UsageError, match="path 'orbit'; choose one of auto, views, turntable, spiral, interpolate, or give"):
        plan_film(model, "orbit", FilmSettings())
    with pytest.raises(UsageError, match=r"unknown path 'turntabel'; did you mean turntable\?"):
        plan_film(model, "turntabel", FilmSettings())


@pytest.mark.parametrize(
    "wrong", [{"size": (8, 100)}, {"fov_y": 0.001}, {"seconds": 0.0}, {"seconds": math.nan}, {"seconds": 1e9}, {"frames": 0}]
)
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(UsageError):
        FilmSettings(**wrong)


def test_empty_and_black_frames_are_noticed(model, tmp_path):
    """A camera that looks away, one in front of something black, and good ones between them."""
    good, black = list(model.cameras().values())[:3], three_gaussians()
    away = dataclasses.replace(good[0], viewmat=look_at(good[0].center, 2 * good[0].center, np.array([0, -1.0, 0])))
    plan = dataclasses.replace(
        plan_film(model, "auto", FilmSettings(frames=2)),
        cameras=[(str(i), c) for i, c in enumerate([*good, away, away, good[0]])],
    )
    assert 0.02 < plan.coverage < 0.9
    files, notes = render_film(model, plan, tmp_path / "a.webp", FilmSettings())
    assert notes[-1].startswith("2 of 6 frames show nearly nothing (frames 3 to 4): the path leaves the captured area")
    assert "--path interpolate" in notes[-1] and files == [tmp_path / "a.webp"]
    dark = dataclasses.replace(model, scene_gaussians=dataclasses.replace(black, sh=torch.full_like(black.sh, -2.0)))
    _, notes = render_film(dark, plan, tmp_path / "b.webp", FilmSettings())
    assert "4 of 6 frames are black (frames 0 to 2 and 5)" in notes[-1]
    check = FrameCheck(0.5)
    for alpha in (0.04, 0.06):  # a tenth of what a training view shows is nearly nothing, however much that is
        check.look(np.ones((4, 4, 3)), np.full((4, 4), alpha))
    assert check.empty == [0]
    check = FrameCheck(0.0)
    for i in range(40):
        check.look(np.ones((4, 4, 3)), np.full((4, 4), i % 3))
    assert "(frames 0, 3, 6, 9, 12 and 9 more)" in check.notes("", "")[0]


@pytest.mark.parametrize(
    ("path", "settings", "advice"),
    [
        ("auto", {}, None),
        ("interpolate", {}, None),
        ("auto", {"size": (160, 32)}, "keep the shape and the field of view of the photographs"),
        ("spiral", {"fov_y": 1.0}, "keep the shape and the field of view of the photographs"),
        ("own", {}, "move the cameras nearer to the photographs' cameras"),
    ],
)
def test_what_no_photograph_saw_gets_a_note(model, tmp_path, path, settings, advice):
    """A film that is wider than the photographs, or leaves them, says so and what to do; others have no such note."""
    if path == "own":
        first = model.cameras()["0.png"]
        aside = [dataclasses.replace(first, viewmat=first.viewmat @ _moved(x)) for x in (0.0, -0.6)]
        plan = FilmPlan([(str(i), c) for i, c in enumerate(aside)], 0.0, "", [])
    else:
        plan = plan_film(model, path, FilmSettings(frames=2, **settings))
    notes = [n for n in render_film(model, plan, tmp_path / "a.webp", FilmSettings())[1] if "outside all photographs" in n]
    assert len(notes) == (advice is not None)
    if advice:
        frames = (
            "1 of 2 frames have over 10% of their pixels outside all photographs (frames 1)"
            if path == "own"
            else "2 of 2 frames"
        )
        assert notes[0].startswith(frames) and notes[0].endswith(f"expect artefacts there; {advice}")


def _moved(x: float) -> np.ndarray:
    """A rigid motion to one side [u]."""
    motion = np.eye(4)
    motion[0, 3] = x
    return motion


def test_a_film_alone_and_six_frames_on_a_sheet(model, tmp_path, capsys):
    """The suffix decides; a folder has an image for each frame as well, and a sheet is three frames wide."""
    assert warpgs.render_path(model, "turntable", out=tmp_path / "a.gif", frames=8) == [tmp_path / "a.gif"]
    assert "path: turntable, there and back" in capsys.readouterr().err
    plan = plan_film(model, "turntable", FilmSettings(frames=8))
    files, _ = render_film(model, plan, tmp_path / "a.webp", FilmSettings(), sheet=True)
    assert files == [tmp_path / "a.webp"] and cv2.imread(str(tmp_path / "a-sheet.png")).shape == (
        2 * 32 + 4,
        3 * 40 + 8,
        3,
    )
    render_film(model, plan, tmp_path / "images", FilmSettings())
    less = render_film(model, plan_film(model, "turntable", FilmSettings(frames=5)), tmp_path / "images", FilmSettings())
    assert less[1][-1].startswith("3 older images are also in ")
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 8 and image.size == (40, 32)
    with pytest.raises(UsageError, match="coverage images are PNG files"):
        render_film(model, plan, tmp_path / "a.webp", FilmSettings(), coverage=True)
    mixed = dataclasses.replace(
        plan, cameras=[("0", plan.cameras[0][1]), ("1", dataclasses.replace(plan.cameras[1][1], width=50))]
    )
    with pytest.raises(UsageError, match="the views differ in size"):
        render_film(model, mixed, tmp_path / "a.mp4", FilmSettings())
    with pytest.raises(UsageError, match="no camera"):
        warpgs.render_path(model, [], out=tmp_path / "x")
