"""The search for poses: its parts, whole scenes from photographs, interruptions, and fits that find poses once."""

import dataclasses
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tests.io import scenes
from tests.poses.conftest import film, with_exif, write_png
from warpgs.app.cli import main
from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.files import write_json
from warpgs.io.load import load_scene
from warpgs.pipeline.run import fit as module
from warpgs.pipeline.run.fit import fit, pose_tasks, title_of, with_poses
from warpgs.pipeline.run.folder import StoredRun, run_folder
from warpgs.pipeline.run.request import SceneRequest
from warpgs.poses import find, mapping, photographs as module_of_photographs
from warpgs.poses.find import JSON, _check_found, advice, find_poses, needs_poses, reason, record_of, report_lines
from warpgs.poses.mapping import Mapping
from warpgs.poses.matching import choose_pairs, similarity
from warpgs.poses.photographs import (
    Photograph,
    find_photographs,
    models_below,
    prepare,
    sharpest,
    without_jpeg_metadata,
    without_png_metadata,
    write_frames,
)
from warpgs.process import Task


def test_all_photographs_get_the_poses_that_they_were_taken_from(found, still_life_views):
    """Up to a similarity: rotations, and the shape of the cameras' path."""
    out, record = found
    scene, cameras = load_scene(out), still_life_views[0]
    assert [v.name for v in scene.views] == ["0.png", "1.png", "2.jpg", "3.png", "4.png", "5.jpg"]
    assert all(p["registered"] for p in record["photographs"]) and record["mean_reprojection_error_px"] < 0.6
    mine = np.stack([v.camera.viewmat[:3, :3] for v in scene.views])
    true = np.stack([c.viewmat[:3, :3] for c in cameras])
    u, _, vt = np.linalg.svd(np.einsum("nki,nkj->ij", true, mine))
    turned = np.einsum("nij,jk,nlk->nil", true, u @ vt, mine)
    angles = np.degrees(np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert angles.max() < 1.5
    steps = [
        np.linalg.norm(np.diff([c.center for c in cs], axis=0), axis=1) for cs in (cameras, [v.camera for v in scene.views])
    ]
    assert np.allclose(steps[0] / steps[0].sum(), steps[1] / steps[1].sum(), atol=0.03)
    assert scene.points is not None and len(scene.points) > 150


@pytest.mark.parametrize(("factor", "kept"), [(1.0, True), (1.8, False)])
def test_few_photographs_keep_the_focal_length_of_exif(sfm, still_life_views, tmp_path, factor, kept):
    """Unless they contradict it: four tell it less well than EXIF, which a cropped photograph makes wrong."""
    cameras, images = still_life_views
    true = cameras[0].K[0, 0]
    film = round(factor * true * np.hypot(36, 24) / np.hypot(cameras[0].width, cameras[0].height))
    (tmp_path / "in").mkdir()
    for i in range(1, 5):
        (tmp_path / "in" / f"{i}.jpg").write_bytes(with_exif(images[i], 1, film))
    record = find_poses(tmp_path / "in", tmp_path / "out", threads=2)
    assert sum(p["registered"] for p in record["photographs"]) == 4
    said = [n.startswith("the focal length is taken from EXIF") for n in record["notes"] if "4 photographs" in n]
    (camera,) = record["cameras"]
    exif = film / np.hypot(36, 24) * np.hypot(cameras[0].width, cameras[0].height)
    assert said[-1] is kept is bool(abs(camera["focal"] - exif) < 1e-6)
    assert any(n.startswith("the EXIF focal length does not fit the 4 photographs") for n in record["notes"]) is not kept


def test_images_are_upright_at_full_size_and_without_anything_personal(found, photographs, still_life_views):
    """One that lies on its side is turned, one of another size has its own camera; no owner, position or path is written."""
    out, record = found
    images = {p.name: cv2.imread(str(p), cv2.IMREAD_UNCHANGED)[..., ::-1] for p in (out / "images").iterdir()}
    assert np.array_equal(images["0.png"], still_life_views[1][0]) and images["3.png"].shape == (150, 200, 3)
    assert np.abs(images["2.jpg"].astype(int) - still_life_views[1][2]).mean() < 4
    assert sorted((c["width"], c["height"]) for c in record["cameras"]) == [(200, 150), (240, 180), (240, 180)]
    assert "1 photograph turned upright by EXIF" in record["notes"]
    personal = [b"Exif", b"GPS", b"Jane", b"ACME", str(photographs).encode(), str(found[0].parent).encode()]
    for path in (p for p in found[0].rglob("*") if p.is_file()):
        assert not [word for word in personal if word in path.read_bytes()], path


def test_the_command_gives_the_same_bits_on_another_number_of_threads(found, photographs, tmp_path, capsys):
    """It prints the report that poses.txt holds."""
    assert main(["poses", str(photographs), "--out", str(tmp_path / "a 2nd"), "--threads", "1"]) == 0
    printed = capsys.readouterr().out
    assert (tmp_path / "a 2nd" / "poses.txt").read_text("utf-8") in printed
    assert f"next: warpgs fit '{tmp_path / 'a 2nd'}' --out run" in printed
    for path in (p for p in found[0].rglob("*") if p.is_file()):
        assert path.read_bytes() == (tmp_path / "a 2nd" / path.relative_to(found[0])).read_bytes(), path


def noise(path, seed):
    image = np.random.default_rng(seed).integers(0, 255, (120, 160, 3), np.uint8)
    write_png(path, cv2.GaussianBlur(image, (0, 0), 2))


@pytest.mark.parametrize(
    ("kind", "count", "message"),
    [("two", 2, "has 2 photographs; poses need at least 3"), ("apart", 3, "no two of 3 photographs could be matched"),
     ("blank", 3, "blank wall"), ("broken", 3, r"1\.png: the image cannot be decoded"), ("none", 0, "no supported image")],
)  # fmt: skip
def test_photographs_that_cannot_work(sfm, tmp_path, capsys, kind, count, message):
    source = tmp_path / "in"
    source.mkdir()
    for i in range(count):
        noise(source / f"{i}.png", i)
        if kind == "blank":
            write_png(source / f"{i}.png", np.full((120, 160, 3), 200 + i, np.uint8))
    if kind == "broken":
        (source / "1.png").write_bytes((source / "1.png").read_bytes()[:500])
    assert main(["poses", str(source), "--out", str(tmp_path / "out")]) == DataError.exit_code
    assert re.fullmatch(f".*{message}.*\n", capsys.readouterr().err)
    assert [p.name for p in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize("command", ["poses", "fit"])
def test_photographs_of_an_unread_format_are_named(sfm, tmp_path, capsys, command):
    """Alone they are an error that says what to do, a damaged one as well; among others they are told of, not passed over."""
    source = tmp_path / "in"
    source.mkdir()
    for name in ("a.nef", "b.NEF"):
        (source / name).write_bytes(b"II*\0")
    words = [command, str(source), "--out", str(tmp_path / "out")]
    assert main(words) == DataError.exit_code
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and "a.nef is a RAW file, which is not supported; convert" in said
    assert "(2 such files)" in said
    for i in range(2):
        noise(source / f"{i}.png", i)
    assert main(words) == DataError.exit_code
    said = capsys.readouterr().err.splitlines()[-1]
    assert "has 2 photographs" in said and "left out: a.nef is a RAW" in said
    assert [p.name for p in tmp_path.iterdir()] == ["in"]


def test_a_copy_is_no_photograph_more(sfm, tmp_path, capsys):
    """It would raise the count, and a held-out copy would be scored as if it were a new view."""
    source = tmp_path / "in"
    source.mkdir()
    for i in range(2):
        noise(source / f"{i}.png", i)
    (source / "again").mkdir()
    for copy in ("0 (1).png", "again/1.png"):
        (source / copy).write_bytes((source / f"{copy.removeprefix('again/')[0]}.png").read_bytes())
    assert main(["poses", str(source), "--out", str(tmp_path / "out")]) == DataError.exit_code
    said = capsys.readouterr().err
    assert "has 2 photographs; left out: 0 (1).png is a copy of 0.png, again/1.png is a copy of 1.png; poses need" in said


def test_videos_that_cannot_work(sfm, tmp_path, capfd):
    """A broken one is told of once, without OpenCV's own warnings, which are written past Python; one frame is too few."""
    film(tmp_path / "a.avi", 1)
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "text.mp4").write_bytes(b"no video" * 100)
    for name, words in (
        ("empty.mp4", "cannot read it as a video"),
        ("text.mp4", "cannot read"),
        ("a.avi", "has 1 frame; poses"),
    ):
        assert main(["poses", str(tmp_path / name), "--out", str(tmp_path / "out")]) == DataError.exit_code
        assert re.fullmatch(rf"warpgs: .*{name}.*{words}.*\n", capfd.readouterr().err)
    assert not (tmp_path / "out").exists()


def test_pairs_are_chosen_and_copies_are_small(sfm, tmp_path, photographs, found, monkeypatch):
    """As for many and large photographs: copies of less than their size are matched; cameras are of full size.

    Progress on matching comes between its pairs, too.
    """
    monkeypatch.setattr(mapping, "EXHAUSTIVE", 5)
    monkeypatch.setattr(mapping, "PROGRESS_INTERVAL", 0.001)
    for room in (mapping, module_of_photographs):
        monkeypatch.setattr(room, "MATCHING_SIDE", 216)
    said: list[str] = []
    record = find_poses(photographs, tmp_path / "out", progress=said.append)
    assert all(p["registered"] for p in record["photographs"]) and record["pairs_tried"] == 15
    done = [int(counted[1]) for line in said if (counted := re.fullmatch(r"matching: (\d+) of 15 pairs", line))]
    assert done[0] == 0 and done == sorted(done) and len(set(done)) > 3
    assert [c["width"] for c in record["cameras"]] == [c["width"] for c in found[1]["cameras"]]


def test_what_is_there_is_not_overwritten(sfm, tmp_path, photographs):
    (tmp_path / "mine").touch()
    with pytest.raises(UsageError, match="exists already"):
        find_poses(photographs, tmp_path)
    with pytest.raises(DataError, match="does not exist"):
        find_poses(tmp_path / "none", tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_a_worker_that_fails_or_is_not_there(sfm, tmp_path, photographs, monkeypatch):
    """Its last words are in the message, or what to install; nothing is left."""
    monkeypatch.setattr(
        find.photos, "prepare", lambda path, root, small, most: prepare(path, root, small.with_name("lost"), most)
    )
    with pytest.raises(ResourceError, match=r"pycolmap ended with code \d+.*last message: "):
        find_poses(photographs, tmp_path / "out")
    monkeypatch.setattr(mapping.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"pip install '.*(pycolmap|poses)"):
        find_poses(photographs, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_folders_that_need_poses(tmp_path, photographs, found):
    with pytest.raises(DataError, match="images without cameras; `warpgs poses` finds the cameras"):
        load_scene(photographs)
    assert needs_poses(photographs) and not needs_poses(found[0]) and not needs_poses(tmp_path)
    (tmp_path / "film.MP4").touch()
    assert needs_poses(tmp_path / "film.MP4")
    assert needs_poses(found[0] / "images") and not needs_poses(tmp_path / "none")
    assert not needs_poses(tmp_path / ("x" * 5000))


def test_a_reconstruction_deep_in_the_photographs_is_named(tmp_path, photographs):
    """Instead of other poses in other units; a fit reads it by --reconstruction, and those of earlier runs do not count."""
    folder = tmp_path / "photographs"
    shutil.copytree(photographs, folder)
    scenes.write_files(folder / "run" / "scene" / "sparse" / "0", scenes.colmap_bin())
    (folder / "run" / "scene" / "poses.json").touch()
    assert not list(models_below(folder))
    scenes.write_files(folder / "out" / "my model", scenes.colmap_txt())
    with pytest.raises(UsageError, match=r"holds poses: use `warpgs fit .* --reconstruction out/my"):
        find_poses(folder, tmp_path / "out")
    request = SceneRequest(path=str(folder), reconstruction="out/my model")
    assert with_poses(request, None, print) == (request, [])


# Ctrl-C while the process that calls pycolmap runs.


@pytest.mark.skipif(sys.platform == "win32", reason="there are no process groups")
@pytest.mark.parametrize("everyone", [False, True], ids=["warpgs alone", "its group, as a terminal does"])
def test_ctrl_c_ends_both_processes_and_leaves_nothing(sfm, tmp_path, photographs, everyone, heeding):
    command = [*heeding, "poses", str(photographs), "--out", str(tmp_path / "deep" / "scene")]
    process = subprocess.Popen(
        [*command, "--threads", "1"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    lines = []
    for line in process.stdout:
        lines.append(line)
        if "finding features" in line:
            break
    (os.killpg if everyone else os.kill)(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, "warpgs: interrupted\n"), lines
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
    assert not list(tmp_path.rglob("*.tmp")) and not list(tmp_path.rglob("scene"))


# A fit of photographs without cameras: poses are found once, kept in the run folder, and found there again.


def test_poses_are_kept_in_the_run_folder(tmp_path, photographs, found, monkeypatch):
    """Found at first; a continued run takes them from there, and refuses other photographs."""
    calls, said, run = [], [], tmp_path / "run"
    run.mkdir()

    def copied(source, out, **options):
        calls.append(source)
        assert options["matcher"] == "x.onnx"
        shutil.copytree(found[0], out)
        return found[1]

    monkeypatch.setattr(module, "find_poses", copied)
    shutil.copytree(photographs, tmp_path / "in")
    request = SceneRequest(str(tmp_path / "in"), matcher="x.onnx")
    for _ in range(2):
        posed, notes = with_poses(request, run, said.append)
        assert (posed.path, posed.matcher) == (str(run / "scene"), None)
        assert any(n.startswith("poses found for 6 of 6") for n in notes)
    assert calls == [tmp_path / "in"] and "has no cameras: finding the poses" in said[0]
    (tmp_path / "in" / "0.png").write_bytes((tmp_path / "in" / "1.png").read_bytes())
    with pytest.raises(UsageError, match="holds poses of other photographs than"):
        with_poses(request, run, said.append)
    for resume in (False, True):  # a fit that ended before its first step begins again either way
        with run_folder(run, resume):
            pass


def test_a_run_of_photographs_has_their_name_and_ends_with_what_to_do(tmp_path, found, photographs):
    """The photographs without a pose, and the first three pieces of advice; nothing where all are well linked."""
    scene = tmp_path / "scene"
    scene.mkdir()
    rows, missing = found[1]["photographs"], "2 of 6 photographs have no pose and were not used: scene/poses.txt in the run"
    for lost, said in ((0, []), (2, [missing, *("to photograph next: " + a for a in "abc")])):
        unposed = [p | {"registered": False, "reason": "has none"} for p in rows[:lost]]
        write_json(scene / JSON, found[1] | {"photographs": [*unposed, *rows[lost:]], "advice": [*"abcd"][: 2 * lost]})
        tasks = pose_tasks(tmp_path)
        assert [line.partition(" folder")[0] for line in tasks] == said and all(isinstance(t, Task) for t in tasks)
    assert pose_tasks(None) == pose_tasks(scene) == []
    assert title_of(scene, tmp_path) == photographs.name != tmp_path.name
    assert title_of(scene, tmp_path / "other") == "scene" and title_of(tmp_path / "garden", tmp_path) == "garden"
    write_json(scene / JSON, {k: v for k, v in found[1].items() if k != "source"})  # as version 0.1 wrote it
    assert title_of(scene, tmp_path) == tmp_path.name


def test_other_requests_stay_as_they_are_and_splits_are_checked_first(tmp_path, photographs, found, monkeypatch):
    for request in (SceneRequest(str(found[0])), SceneRequest(str(photographs), reader="llff"), SceneRequest("")):
        assert with_poses(request, tmp_path, print) == (request, [])
    with pytest.raises(UsageError, match=r"--matcher requires a folder of photographs without cameras; leave it out for"):
        with_poses(SceneRequest(str(found[0]), matcher="x.onnx"), tmp_path, print)
    with pytest.raises(UsageError, match="needs a run folder; give out="):
        with_poses(SceneRequest(str(photographs)), None, print)
    monkeypatch.setattr(module, "find_poses", lambda *_, **__: pytest.fail("poses are found"))
    for spec in ("every8", "every:1", "tset=0.png", "llff:9", "dtu:3"):
        with pytest.raises((UsageError, DataError), match="split"):
            fit(SceneRequest(str(photographs), spec), out=tmp_path / "run", device="cpu", verbose=False)
    assert not (tmp_path / "run").exists()


def test_a_run_that_was_moved_finds_its_scene(tmp_path, found):
    """The record holds where the scene lay; where nothing is there any more, the run's own scene is read."""
    options = {"path": str(tmp_path / "gone" / "scene"), "downscale": 2}
    run = SimpleNamespace(folder=tmp_path, record={"scene": options})
    with pytest.raises(DataError, match=r"scene: the scene of .* is gone; .*`warpgs fit NEW_PLACE --out .* --resume`"):
        StoredRun.scene_request(run)
    (tmp_path / "scene").mkdir()
    shutil.copy(found[0] / "poses.json", tmp_path / "scene")
    assert StoredRun.scene_request(run) == SceneRequest(str(tmp_path / "scene"), downscale=2)


# Parts of the search for poses that need no pycolmap: pairs, metadata, frames of a video, advice.


def test_pairs_are_neighbours_and_lookalikes():
    """Of two photographs of each of 25 places not all pairs, but those of one place, and neighbours; the same each time."""
    generator = np.random.default_rng(0)
    kinds = np.tile(generator.integers(0, 256, (25, 60, 128), np.uint8), (2, 1, 1))
    noisy = [*np.clip(kinds + generator.normal(0, 5, kinds.shape), 0, 255).astype(np.uint8), np.zeros((0, 128), np.uint8)]
    alike = similarity(noisy)
    assert alike[0, 25] > 0.7 > 0.4 > alike[0, 1] and not alike[-1].any()
    pairs = choose_pairs(noisy, "video")
    assert {(i, i + 25) for i in range(25)} <= set(pairs) and {(i, i + 1) for i in range(50)} <= set(pairs)
    assert len(pairs) < 51 * 50 / 2 * 0.7 and pairs == sorted(pairs) == choose_pairs(noisy, "video")
    assert choose_pairs([np.zeros((0, 128), np.uint8)] * 3, "photographs") == [(0, 1), (0, 2), (1, 2)]


@pytest.mark.parametrize("progressive", [0, 1])
def test_files_without_their_metadata_have_the_same_pixels(progressive):
    image = np.random.default_rng(0).integers(0, 255, (40, 56, 3), np.uint8)
    coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1].tobytes()
    exif = with_exif(image, 1)
    at = exif.index(b"\xff\xe1")
    block = exif[at : at + 2 + int.from_bytes(exif[at + 2 : at + 4], "big")]
    bare = without_jpeg_metadata(coded[:2] + block + coded[2:] + b"a film follows \xff\xd9")
    assert b"Jane" in block and bare == coded
    coded = cv2.imencode(".png", np.arange(300, dtype=np.uint16).reshape(10, 30))[1].tobytes()
    text = b"\0\0\0\4tEXtJane\0\0\0\0"
    assert without_png_metadata(coded[:33] + text + coded[33:] + b"more") == coded


@pytest.mark.parametrize(
    ("files", "photographs", "notes"),
    [
        ("images/a.png images/masks/a.png b.png masks/a.png images/b.png", "images/a.png images/b.png", []),
        (
            "a.png b/c.png b/run/renders/d.png b/run/path-auto/0.png b/run/e.png posed/scene/images/f.png g/h.png "
            "b/run/config.json b/run/metrics.jsonl posed/scene/poses.json g/config.json",
            "a.png b/c.png g/h.png",
            ["skipped as earlier runs: b/run, posed", "photographs by folder: 1 in the folder itself, 1 in b, 1 in g"],
        ),
        (
            "photos/a.png photos/.cache/b.png .trash/c.png env/pyvenv.cfg env/lib/d.png code/pyproject.toml code/docs/e.png "
            "run/renders/f.png run/config.json run/metrics.jsonl",
            "photos/a.png",
            ["skipped as earlier runs: run", "skipped as software: code, env"],
        ),
    ],
)
def test_masks_and_images_of_runs_and_software_are_no_photographs(tmp_path, files, photographs, notes):
    """A run below the photographs is left out with all below it, also one that holds found poses alone; so is software."""
    for name in files.split():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    found, said = find_photographs(tmp_path)
    assert [p.relative_to(tmp_path).as_posix() for p in found] == photographs.split() and said == notes


def test_exif_of_the_lens_and_frames_of_a_video(tmp_path):
    """The equivalent focal length is by the diagonal: 34 mm of 43.3 on 4:3 is 0.98 longer sides; the size is that upright."""
    (tmp_path / "a.jpg").write_bytes(with_exif(np.zeros((80, 60, 3), np.uint8), 8))
    p = prepare(tmp_path / "a.jpg", tmp_path, tmp_path / "small.png")
    assert (p.width, p.height, p.orientation, p.device) == (80, 60, 8, "ACME Phone 7 34 mm")
    assert p.focal == pytest.approx(34 / np.hypot(36, 24) * 100 / 80)
    assert cv2.imread(str(tmp_path / "small.png")).shape == (60, 80, 3)
    film(tmp_path / "a.avi", 12)
    (tmp_path / "frames").mkdir()
    assert write_frames(tmp_path / "a.avi", tmp_path / "frames", 4, lambda line: None) == 12
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == [f"frame_{i:06d}.png" for i in (1, 4, 7, 10)]
    assert sharpest([3.0, 1.0], 5) == [0, 1] and sharpest([1.0, 1.0, 2.0, 2.0], 2) == [0, 2]


def found_mapping(**values) -> Mapping:
    """Three photographs in one model, 50 degrees apart at the end, and two that are lost."""
    angles = np.radians([0, 10, 60])
    turns = [np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]]) for a in angles]
    views = {i: (r, 100) for i, r in enumerate(turns)}
    given = {
        "keypoints": (900, 800, 700, 600, 12), "matches": {(0, 1): 200, (1, 2): 40, (2, 3): 9}, "tried": 10, "views": views,
        "cameras": ({"focal": 300, "distortion": 0, "width": 320, "height": 240},), "groups": ((0, 1, 2),), "points": 50,
        "error": 0.4,
        "method": "incremental", "version": "4",
    }  # fmt: skip
    return Mapping(**(given | values))


def unposed(names, focal=None) -> list[Photograph]:
    return [Photograph(f"{n}.png", Path(f"{n}.png"), 320, 240, 1, "", focal, "0") for n in names]


@pytest.mark.parametrize(("focal", "count", "said"), [(None, 5, True), (None, 6, False), (0.8, 5, False)])
def test_a_record_says_that_few_photographs_do_not_tell_the_focal_length(focal, count, said):
    view = found_mapping().views[0]
    found = found_mapping(views=dict.fromkeys(range(count), view), keypoints=(900,) * count, matches={(0, 1): 200})
    notes = record_of(found, unposed(range(count), focal), "0", [])["notes"]
    assert any(f"an estimate from {count} photographs is often 5 % off" in n for n in notes) is said
    assert not any("times their longer side" in n for n in notes)
    stretched = {"focal": 900, "distortion": 0, "width": 320, "height": 240}
    notes = record_of(found_mapping(cameras=(stretched,)), unposed(range(5), focal), "0", [])["notes"]
    assert any("photographs of 320 x 240 px have a focal length of 2.8 times their longer side" in n for n in notes)


def test_records_reasons_and_advice():
    """Lost and blank photographs first, then wide gaps, then weak links; nothing where all is well."""
    names, found = ["a", "b", "c", "d", "e"], found_mapping()
    assert reason(found, 3, names) == "has 600 keypoints and 9 matches with c, too few of them at places of known depth"
    assert reason(found, 4, names).startswith("has 12 keypoints, too few to match")
    assert "matches no other" in reason(found_mapping(matches={}), 3, names)
    said = advice(found, names)
    for line, words in zip(
        said, ("between d and c", "take e again", "b and c, 50 degrees apart", "only 40 matches"), strict=True
    ):
        assert words in line
    joined = found_mapping(matches={(0, 1): 200, (1, 2): 90, (2, 3): 9, (3, 4): 300}, keypoints=(900, 800, 700, 600, 500))
    assert "between d and c" in advice(joined, names)[0] and "photographs from e to the others" in advice(joined, names)[1]
    assert len(advice(joined, names)) == 2, "b and c match well, though their axes differ"
    apart = found_mapping(
        keypoints=(900,) * 7, groups=((0, 1, 2), (3, 4, 5)),
        matches={(0, 1): 200, (1, 2): 90, (3, 4): 40, (4, 5): 50, (2, 4): 8, (1, 5): 5, (5, 6): 20},
    )  # fmt: skip
    bridge, other = advice(apart, [*names, "f", "g"])
    assert "between e and c" in bridge and bridge.endswith("3 form a separate group, d to f")
    assert "photographs from g to the others" in other, "a photograph without a pose is no place to start from"
    assert (
        "from d to the photographs outside its group" in advice(dataclasses.replace(apart, matches={}), [*names, "f", "g"])[0]
    )
    well = found_mapping(keypoints=(900, 800), matches={(0, 1): 200}, views=dict(list(found.views.items())[:2]))
    assert advice(well, ["a", "b"]) == []
    # its lines name the photographs without a pose, why, and what to do
    photographs = unposed("abcde")
    assert not any("between runs" in n for n in record_of(found_mapping(), photographs, "0", [])["notes"])
    record = record_of(found_mapping(method="global"), photographs, "0", ["a note"])
    assert record["notes"][0] == "a note" and record["notes"][-1].endswith("between runs")
    lines = report_lines(record)
    assert "poses found for 3 of 5 photographs" in lines[1] and "What to photograph next:" in lines
    assert lines[8].startswith("d.png  NO POSE: it has 600 keypoints and 9 matches with c.png")
    nobody = {"notes": ["a note"], "photographs": [], "advice": []}  # records are files that anybody may have changed
    assert report_lines(nobody)[0] == "a note"
    # what to photograph first
    found = found_mapping(views={}, keypoints=(900,) * 5, matches={(0, 1): 525, (2, 3): 292})
    words = "at most 0 of 5 photographs fit together.* First, take photographs from a.png to the others"
    with pytest.raises(DataError, match=words):
        _check_found(Path("in"), found, unposed("abcde"))
