"""Keypoints and matches of a network instead of SIFT's: what is refused, what agrees, and poses from them."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.priors import networks
from warpgs.app.cli import main
from warpgs.errors import DataError
from warpgs.poses import find
from warpgs.poses.find import find_poses
from warpgs.poses.mapping import find_model
from warpgs.poses.matching import MAX_KEYPOINTS, WHOLE, Matcher, mutual_matches, quarter_turns

AT = np.array([[3.0, 4.0], [60.0, 20.0], [5.0, 6.0]])
SCORES = np.array([0.2, 0.9, 0.0])
UNIT = np.array([[0.6, 0.8], [0.0, 1.0], [0.0, 0.0]])


def opened(tmp_path, *arrays, **options) -> Matcher:
    return Matcher(networks.write(tmp_path / "m.onnx", networks.matcher(*arrays, **options)), threads=1)


def whole(rows) -> np.ndarray:
    """Return descriptors as a matcher does, of length `WHOLE`."""
    return np.round(np.array(rows) / np.linalg.norm(rows, axis=1, keepdims=True) * WHOLE).astype(np.int16)


def test_keypoints_are_in_pixels_of_the_photograph(tmp_path):
    """The best first; what has no score is none. A photograph of 512 x 256 px is seen at twice its size."""
    matcher = opened(tmp_path, AT, SCORES, UNIT)
    pixels, descriptors = matcher.features(np.zeros((256, 512, 3), np.uint8))
    np.testing.assert_array_equal(pixels, AT[[1, 0]] / 2)
    np.testing.assert_array_equal(descriptors, np.round(UNIT[[1, 0]] * WHOLE))
    assert matcher.title.startswith("m.onnx (SHA-256 ") and matcher.size is None
    fixed = opened(tmp_path, AT, SCORES, UNIT, size=(64, 64))
    np.testing.assert_allclose(fixed.features(np.zeros((32, 128, 3), np.uint8))[0], AT[[1, 0]] * [2, 0.5])
    many = np.tile(AT[:1], (MAX_KEYPOINTS + 5, 1)), np.ones(MAX_KEYPOINTS + 5), np.tile(UNIT[:1], (MAX_KEYPOINTS + 5, 1))
    assert len(opened(tmp_path, *many).features(np.zeros((32, 32, 3), np.uint8))[0]) == MAX_KEYPOINTS
    image = np.zeros((40, 60, 3), np.uint8)
    for turns in range(4):  # the first keypoint is at (60, 20) of what the network sees, 1024 px at the longer side
        (width, height), (w, h) = ((60, 40), (1024, 672)) if turns % 2 == 0 else ((40, 60), (672, 1024))
        x, y = 60 * width / w, 20 * height / h
        wanted = [(x, y), (60 - y, x), (60 - x, 40 - y), (y, 40 - x)][turns]
        np.testing.assert_allclose(matcher.features(image, turns)[0][0], wanted, rtol=1e-5)


@pytest.mark.parametrize(
    ("arrays", "options", "message"),
    [
        ((AT, SCORES, UNIT), {"named": "x"}, "lacks the output scores; give a file of `warpgs priors export --model xfeat`"),
        ((AT, SCORES, UNIT), {"size": (64, "w")}, "fixes only one side"),
        ((AT[:2], SCORES, UNIT), {}, r"returned keypoints \[2, 2\], scores \[3\]"),
        ((AT, SCORES, UNIT[:, :0]), {}, "have 0 numbers"),
        ((AT, SCORES, np.ones((3, 300))), {}, "have 300 numbers"),
        ((AT * np.nan, SCORES, UNIT), {}, "contain NaN"),
        ((AT * 100, SCORES, UNIT), {}, "keypoints must be in the image"),
        ((AT, SCORES, UNIT * 2), {}, "descriptors of length 1"),
    ],
)
def test_networks_that_are_no_matchers_are_refused(tmp_path, arrays, options, message):
    with pytest.raises(DataError, match=message):
        opened(tmp_path, *arrays, **options).features(np.zeros((64, 64, 3), np.uint8))


def test_a_network_of_another_kind_is_refused_before_any_work(sfm, tmp_path, photographs, capsys):
    network = networks.depth_network(tmp_path / "depth.onnx")
    words = ["poses", str(photographs), "--out", str(tmp_path / "out"), "--matcher"]
    assert main([*words, network]) == main([*words, str(tmp_path / "none.onnx")]) == DataError.exit_code
    said = capsys.readouterr().err
    assert "depth.onnx: is not a matcher, because it lacks the output keypoints and scores and descriptors" in said
    assert "none.onnx: the model cannot be read" in said and not (tmp_path / "out").exists()


class Sift:
    title = "sift.onnx (SHA-256 0)"

    def features(self, image, turns=0, side=0, most=0):
        image = np.ascontiguousarray(np.rot90(image, turns))
        points, found = cv2.SIFT_create(contrastThreshold=0.01).detectAndCompute(image, None)
        found /= np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1)
        return np.array([p.pt for p in points], np.float32) + 0.5, np.round(found * WHOLE).astype(np.int16)


def test_the_network_is_asked_where_sift_leaves_photographs_out(sfm, tmp_path, photographs, found, monkeypatch):
    """Its model counts if it has more photographs; the same bits on any number of threads; the report says what was taken."""
    made, kept, some = [], tmp_path / "sift", slice(None)

    def by_sift_once(*arguments, learned=False):
        if learned:
            return find_model(*arguments, learned=True)
        if not made:
            made.append(find_model(*arguments))
            shutil.copytree(arguments[3] / "model", kept)
        else:
            shutil.copytree(kept, arguments[3] / "model")
        return replace(made[0], views=dict(list(made[0].views.items())[some]))

    monkeypatch.setattr(find, "find_model", by_sift_once)
    monkeypatch.setattr(find, "Matcher", lambda path, threads: Sift())
    record = find_poses(photographs, tmp_path / "all", matcher="x.onnx")
    assert record["cameras"] == found[1]["cameras"] and any("SIFT finds the poses of all" in n for n in record["notes"])
    some = slice(3)
    record = find_poses(photographs, tmp_path / "a", matcher="x.onnx", threads=2)
    assert all(p["registered"] for p in record["photographs"]) and record["pairs_tried"] == 15
    assert "keypoints and matches by sift.onnx (SHA-256 0): 6 poses; SIFT, which is more accurate, finds 3" in record["notes"]
    assert record["mean_reprojection_error_px"] < 0.5 and record["points"] > 200
    assert find_poses(photographs, tmp_path / "b", matcher="x.onnx", threads=1) == record
    assert len(list((tmp_path / "a" / "images").iterdir())) == 6 and not (tmp_path / "a" / "work").exists()
    monkeypatch.setattr(find, "EXHAUSTIVE", 5)
    assert all(p["registered"] for p in find_poses(photographs, tmp_path / "c", matcher="x.onnx")["photographs"])
    monkeypatch.setattr(Sift, "features", lambda self, image, *_: (np.zeros((0, 2)), np.zeros((0, 128))))
    record = find_poses(photographs, tmp_path / "d", matcher="x.onnx")
    assert "sift.onnx (SHA-256 0) is not used: it finds 0 poses, and SIFT 3" in record["notes"]


class Upright:
    """A matcher that knows no turns: a keypoint at each pixel, described by its place and colour together."""

    def features(self, image, turns=0, side=0, most=0):
        colors = np.rot90(image, turns).reshape(-1, 3)
        rows = np.stack([np.random.default_rng([i, *c]).normal(size=32) for i, c in enumerate(colors)])
        return np.zeros((len(rows), 2), np.float32), whole(rows)


def test_matches_are_mutual_and_turns_are_found():
    """Two of four are turned, one of them matches the others by way of the other alone."""
    a, b = whole([[1, 0, 0], [0, 1, 0], [1, 0.1, 0], [0, 0, 1]]), whole([[0, 1, 0.1], [1, 0.01, 0], [0, -1, 0.5]])
    assert mutual_matches(a, b).tolist() == [[0, 1], [1, 0]]
    assert mutual_matches(a, np.zeros((0, 3), np.int16)).shape == (0, 2)
    image = np.random.default_rng(1).integers(0, 255, (8, 8, 3))
    images = [image, np.rot90(image), image, np.rot90(image, 2)]
    assert quarter_turns(Upright(), images, [(0, 1), (0, 2), (1, 2), (1, 3)]) == [0, 3, 0, 2]
    assert quarter_turns(Upright(), [], []) == []
