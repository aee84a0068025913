"""From photographs to a scene with poses; whatever does not work ends in a sentence and leaves nothing behind."""

import cv2
import numpy as np
import pytest

from tests.poses.conftest import film, with_exif, write_png
from warpgs.app.cli import main
from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.io.load import load_scene
from warpgs.poses import find, mapping
from warpgs.poses import photographs as module_of_photographs
from warpgs.poses.find import find_poses, needs_poses
from warpgs.poses.photographs import prepare


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


def test_images_are_upright_and_at_full_size(found, still_life_views):
    """A photograph that lies on its side is turned, one of another size has a camera of its own; PNG keeps its pixels."""
    out, record = found
    images = {p.name: cv2.imread(str(p), cv2.IMREAD_UNCHANGED)[..., ::-1] for p in (out / "images").iterdir()}
    assert np.array_equal(images["0.png"], still_life_views[1][0]) and images["3.png"].shape == (150, 200, 3)
    assert np.abs(images["2.jpg"].astype(int) - still_life_views[1][2]).mean() < 4
    assert sorted((c["width"], c["height"]) for c in record["cameras"]) == [(200, 150), (240, 180), (240, 180)]
    assert "1 photograph turned upright by EXIF" in record["notes"]


def test_nothing_personal_is_written(found, photographs):
    """No position, owner or maker of the camera, no path of this machine."""
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


def noise(path, seed, smooth=0):
    image = np.random.default_rng(seed).integers(0, 255, (120, 160, 3), np.uint8)
    write_png(path, cv2.GaussianBlur(image, (0, 0), smooth) if smooth else image)


@pytest.mark.parametrize(
    ("kind", "count", "message"),
    [("two", 2, "has 2 photographs; poses need at least 3"), ("apart", 3, "no two of 3 photographs could be matched"),
     ("blank", 3, "blank wall"), ("broken", 3, r"1\.png: the image cannot be decoded"), ("none", 0, "no supported image")],
)  # fmt: skip
def test_photographs_that_cannot_work(sfm, tmp_path, capsys, kind, count, message):
    """One sentence, the exit code of bad data, and nothing half-written."""
    source = tmp_path / "in"
    source.mkdir()
    for i in range(count):
        if kind == "blank":
            write_png(source / f"{i}.png", np.full((120, 160, 3), 200, np.uint8))
        else:
            noise(source / f"{i}.png", i, 2)
    if kind == "broken":
        (source / "1.png").write_bytes((source / "1.png").read_bytes()[:500])
    assert main(["poses", str(source), "--out", str(tmp_path / "out")]) == DataError.exit_code
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    with pytest.raises(DataError, match=message):
        raise DataError(said)
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
        noise(source / f"{i}.png", i, 2)
    assert main(words) == DataError.exit_code
    said = capsys.readouterr().err.splitlines()[-1]
    assert "has 2 photographs" in said and "left out: a.nef is a RAW" in said
    assert [p.name for p in tmp_path.iterdir()] == ["in"]


def test_a_broken_video_is_told_of_once(sfm, tmp_path, capfd):
    """OpenCV's own warnings, written past Python, are not shown."""
    (tmp_path / "a.mp4").write_bytes(b"")
    assert main(["poses", str(tmp_path / "a.mp4"), "--out", str(tmp_path / "out")]) == DataError.exit_code
    said = capfd.readouterr().err
    assert said.startswith("warpgs: ") and len(said.splitlines()) == 1


def test_a_video_of_one_frame(sfm, tmp_path):
    film(tmp_path / "a.avi", 1)
    with pytest.raises(DataError, match=r"a\.avi: has 1 frame; poses need"):
        find_poses(tmp_path / "a.avi", tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["a.avi"]


def test_pairs_are_chosen_and_copies_are_small(sfm, tmp_path, photographs, found, monkeypatch):
    """As for many and large photographs: copies of less than their size are matched; cameras are of full size."""
    monkeypatch.setattr(mapping, "EXHAUSTIVE", 5)
    for module in (mapping, module_of_photographs):
        monkeypatch.setattr(module, "MATCHING_SIDE", 216)
    record = find_poses(photographs, tmp_path / "out")
    assert all(p["registered"] for p in record["photographs"]) and record["pairs_tried"] == 15
    assert [c["width"] for c in record["cameras"]] == [c["width"] for c in found[1]["cameras"]]


def test_what_is_there_is_not_overwritten(sfm, tmp_path, photographs):
    (tmp_path / "mine").touch()
    with pytest.raises(UsageError, match="exists already"):
        find_poses(photographs, tmp_path)
    with pytest.raises(DataError, match="does not exist"):
        find_poses(tmp_path / "none", tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_without_pycolmap_a_sentence_says_what_to_install(tmp_path, photographs, monkeypatch):
    monkeypatch.setattr(mapping.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"pip install '\.\[poses\]'"):
        find_poses(photographs, tmp_path / "out")


def test_a_worker_that_fails_is_reported_and_leaves_nothing(sfm, tmp_path, photographs, monkeypatch):
    """Its last words are in the message."""
    monkeypatch.setattr(find, "prepare", lambda path, root, small, most: prepare(path, root, small.with_name("lost"), most))
    with pytest.raises(ResourceError, match=r"pycolmap ended with code \d+.*last message: "):
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
