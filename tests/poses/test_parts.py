"""Parts of the search for poses that need no pycolmap: pairs, metadata, frames of a video, advice."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.poses.conftest import film, with_exif
from warpgs.errors import DataError
from warpgs.poses.find import _check_found, advice, reason, record_of, report_lines
from warpgs.poses.mapping import Mapping
from warpgs.poses.matching import choose_pairs, similarity
from warpgs.poses.photographs import (
    Photograph,
    find_photographs,
    folder_notes,
    prepare,
    sharpest,
    without_jpeg_metadata,
    without_png_metadata,
    write_frames,
)


def descriptors(places: int, each: int, seed: int = 0) -> list[np.ndarray]:
    """Descriptors of photographs of some places in turn: those of one place share most of theirs."""
    generator = np.random.default_rng(seed)
    kinds = generator.integers(0, 256, (places, 60, 128), np.uint8)
    noisy = [
        np.clip(kinds[i % places] + generator.normal(0, 5, (60, 128)), 0, 255).astype(np.uint8) for i in range(places * each)
    ]
    return [*noisy, np.zeros((0, 128), np.uint8)]


def test_photographs_of_one_place_look_alike():
    alike = similarity(descriptors(4, 3))
    assert alike[0, 4] > 0.7 > 0.4 > alike[0, 1] and not alike[-1].any()


def test_pairs_are_neighbours_and_lookalikes():
    """Of 26 photographs of 25 places not all pairs, but those of one place, and neighbours in order; the same each time."""
    found = descriptors(25, 2)
    pairs = choose_pairs(found, "video")
    assert {(i, i + 25) for i in range(25)} <= set(pairs) and {(i, i + 1) for i in range(50)} <= set(pairs)
    assert len(pairs) < 51 * 50 / 2 * 0.7 and pairs == sorted(pairs) == choose_pairs(found, "video")
    assert choose_pairs([np.zeros((0, 128), np.uint8)] * 3, "photographs") == [(0, 1), (0, 2), (1, 2)]


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_without_its_metadata_has_the_same_pixels(progressive):
    image = np.random.default_rng(0).integers(0, 255, (40, 56, 3), np.uint8)
    coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1].tobytes()
    exif = with_exif(image, 1)
    at = exif.index(b"\xff\xe1")
    block = exif[at : at + 2 + int.from_bytes(exif[at + 2 : at + 4], "big")]
    bare = without_jpeg_metadata(coded[:2] + block + coded[2:] + b"a film follows \xff\xd9")
    assert b"Jane" in block and bare == coded


def test_a_png_without_its_metadata_has_the_same_pixels():
    coded = cv2.imencode(".png", np.arange(300, dtype=np.uint16).reshape(10, 30))[1].tobytes()
    text = b"\0\0\0\4tEXtJane\0\0\0\0"
    assert without_png_metadata(coded[:33] + text + coded[33:] + b"more") == coded


def test_what_exif_says_of_the_lens(tmp_path):
    """The equivalent focal length is by the diagonal: 34 mm of 43.3 on 4:3 is 0.98 longer sides; the size is that upright."""
    (tmp_path / "a.jpg").write_bytes(with_exif(np.zeros((80, 60, 3), np.uint8), 8))
    p = prepare(tmp_path / "a.jpg", tmp_path, tmp_path / "small.png")
    assert (p.width, p.height, p.orientation, p.device) == (80, 60, 8, "ACME Phone 7 34 mm")
    assert p.focal == pytest.approx(34 / np.hypot(36, 24) * 100 / 80)
    assert cv2.imread(str(tmp_path / "small.png")).shape == (60, 80, 3)


def test_masks_are_no_photographs(tmp_path):
    for name in ("images/a.png", "images/masks/a.png", "b.png", "masks/a.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert [p.name for p in find_photographs(tmp_path)] == ["a.png"]


def test_images_of_earlier_runs_are_no_photographs(tmp_path):
    """A run below the photographs is left out with all below it, also one that holds found poses alone; both are named."""
    names = ("a.png", "b/c.png", "b/run/renders/d.png", "b/run/path-auto/0000.png", "b/run/e.png", "posed/scene/images/f.png")
    others = ("g/h.png", "b/run/config.json", "b/run/metrics.jsonl", "posed/scene/poses.json", "g/config.json")
    for name in (*names, *others):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert [p.relative_to(tmp_path).as_posix() for p in find_photographs(tmp_path)] == ["a.png", "b/c.png", "g/h.png"]
    assert folder_notes(tmp_path) == [
        "skipped as earlier runs: b/run, posed", "photographs by folder: 1 in the folder itself, 1 in b, 1 in g"
    ]  # fmt: skip


def test_one_folder_of_photographs_needs_no_notes(tmp_path):
    for name in ("images/a.png", "images/b.png", "c.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert folder_notes(tmp_path) == []


def test_frames_of_a_video_are_sharp_and_evenly_spaced(tmp_path):
    film(tmp_path / "a.avi", 12)
    (tmp_path / "frames").mkdir()
    assert write_frames(tmp_path / "a.avi", tmp_path / "frames", 4, lambda line: None) == 12
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == [f"frame_{i:06d}.png" for i in (1, 4, 7, 10)]
    assert sharpest([3.0, 1.0], 5) == [0, 1] and sharpest([1.0, 1.0, 2.0, 2.0], 2) == [0, 2]


def test_videos_that_cannot_work(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"no video" * 100)
    with pytest.raises(DataError, match="cannot read it as a video"):
        write_frames(tmp_path / "a.mp4", tmp_path, 3, lambda line: None)


def mapping(**values) -> Mapping:
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


def test_too_few_that_fit_together_are_told_with_their_links():
    """The pairs that do match, once each, and who matches nobody."""
    photographs = [Photograph(f"{n}.png", Path(n), 320, 240, 1, "", None, "0") for n in "abcde"]
    found = mapping(views={}, keypoints=(900,) * 5, matches={(0, 1): 525, (2, 3): 292})
    with pytest.raises(
        DataError, match=r"e\.png matches no other; c\.png and d\.png share 292 matches; a\.png and b\.png share 525"
    ):
        _check_found(Path("in"), found, photographs)


@pytest.mark.parametrize(("focal", "count", "said"), [(None, 5, True), (None, 6, False), (0.8, 5, False)])
def test_a_record_says_that_few_photographs_do_not_tell_the_focal_length(focal, count, said):
    """Where EXIF does not tell it, up to five of them."""
    view = mapping().views[0]
    photographs = [Photograph(f"{n}.png", Path(str(n)), 320, 240, 1, "", focal, "0") for n in range(count)]
    found = mapping(views=dict.fromkeys(range(count), view), keypoints=(900,) * count, matches={(0, 1): 200})
    notes = record_of(found, photographs, "0", [])["notes"]
    assert any(f"An estimate from {count} photographs is often 5 % off" in n for n in notes) is said


def test_a_record_says_what_does_not_repeat_and_who_has_no_pose():
    """Its lines name the photographs without a pose, why, and what to do."""
    photographs = [Photograph(f"{n}.png", Path(n), 320, 240, 1, "", None, "0") for n in "abcde"]
    assert not any("run to run" in n for n in record_of(mapping(), photographs, "0", [])["notes"])
    record = record_of(mapping(method="global"), photographs, "0", ["a note"])
    assert record["notes"][0] == "a note" and record["notes"][-1].endswith("from run to run")
    lines = report_lines(record)
    assert "poses found for 3 of 5 photographs" in lines[1] and "What to photograph next:" in lines
    assert lines[8].startswith("d.png  NO POSE: it has 600 keypoints and 9 matches with c.png")


def test_reasons_and_advice():
    """Blank and lost photographs first, then wide gaps, then weak links; nothing where all is well."""
    names = ["a", "b", "c", "d", "e"]
    assert reason(mapping(), 3, names) == "has 600 keypoints and 9 matches with c, too few of them at places of known depth"
    assert reason(mapping(), 4, names).startswith("has 12 keypoints, too few to match")
    said = advice(mapping(), names)
    assert [
        "between d and c" in said[0],
        "take e again" in said[1],
        "between b and c, whose axes differ by 50 degrees" in said[2],
    ] == [True] * 3
    assert said[3] == "take a photograph between c and b, which share only 40 matches" and len(said) == 4
    well = mapping(keypoints=(900, 800), matches={(0, 1): 200}, views=dict(list(mapping().views.items())[:2]))
    assert advice(well, ["a", "b"]) == []
    assert "matches no other" in reason(mapping(matches={}), 3, names)


def test_a_record_without_photographs_has_lines():
    """Records are files that anybody may have changed."""
    record = {"notes": ["a note"], "photographs": [], "advice": []}
    assert report_lines(record)[0] == "a note"
