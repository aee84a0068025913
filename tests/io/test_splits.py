"""Published splits, id by id, and splits of one's own."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tests.io import scenes
from warpgs.errors import DataError, UsageError
from warpgs.io.load import Split, coincident_views, held_out_split, split_views
from warpgs.scene import Camera


def scene_of(names):
    """Return a stand-in for a scene: a split only looks at names."""
    return SimpleNamespace(views=[SimpleNamespace(name=n) for n in names])


def numbered(count):
    return scene_of([f"{i:03d}.png" for i in range(count)])


def ids(names):
    return [int(n[:3]) for n in names]


LLFF = {
    "fern": (20, 3, [1, 10, 19]), "flower": (34, 5, [1, 17, 33]), "fortress": (42, 6, [1, 21, 41]),
    "horns": (62, 8, [1, 30, 61]), "leaves": (26, 4, [1, 12, 25]), "orchids": (25, 4, [1, 12, 23]),
    "room": (41, 6, [1, 20, 39]), "trex": (55, 7, [1, 28, 54]),
}  # fmt: skip
"""Photographs, held-out views and 3-view training ids of the eight scenes; rounding half up would give others for horns and
leaves, whose middle falls on 26.5 and 10.5 of the pool."""
EVEN = [
    *((f"{kind}:3", views, train) for views, _, train in LLFF.values() for kind in ("llff", "mip360")),
    ("llff:1", 20, [1]), ("llff:2", 20, [1, 19]), ("llff:7", 9, [1, 2, 3, 4, 5, 6, 7]),
    ("llff:3", 7, [1, 3, 6]),  # a pool of 6: its middle, 2.5, goes to 2, the third
    ("llff:6", 20, [1, 4, 7, 12, 15, 19]),  # places 0, 3.2, 6.4, 9.6, 12.8, 16 of 1-7, 9-15, 17-19
    ("llff:9", 20, [1, 3, 5, 7, 10, 12, 14, 17, 19]),
    ("mip360:24", 185, [
        1, 9, 17, 25, 33, 41, 49, 57, 65, 73, 81, 89, 95, 103, 111, 119, 127, 135, 143, 151, 159, 167, 175, 183,
    ]),  # garden
    ("mip360:12", 185, [1, 18, 34, 51, 67, 84, 100, 117, 133, 150, 166, 183]),
]  # fmt: skip


@pytest.mark.parametrize("spec,views,train", EVEN)
def test_every_8th_is_held_out_and_the_others_are_evenly_spaced(spec, views, train):
    scene = numbered(views)
    split = split_views(scene, spec)
    assert ids(split.train) == train and ids(split.test) == list(range(0, views, 8))
    assert (views, len(split.test)) in [(20, 3), (9, 2), (7, 1), (185, 24), *(v[:2] for v in LLFF.values())]
    scene.views.reverse()
    assert split_views(scene, spec) == split


@pytest.mark.parametrize("views", [49, 64])
def test_dtu_protocol(views):
    train = [25, 22, 28, 40, 44, 48, 0, 8, 13]
    test = [1, 2, 9, 10, 11, 12, 14, 15, 23, 24, 26, 27, 29, 30, 31, 32, 33, 34, 35, 41, 42, 43, 45, 46, 47]
    for k in (3, 6, 9):
        split = split_views(numbered(views), f"dtu:{k}")
        assert ids(split.train) == train[:k] and ids(split.test) == test


def test_ids_of_names_and_splits_by_number():
    """Files that count from one or from zero give the same views; a gap would shift every id after it."""
    for form in ("rect_{:03d}_3_r5000.png", "images/{:03d}.png"):
        split = split_views(scene_of([form.format(i + 1) for i in range(49)]), "dtu:3")
        assert split.train == tuple(form.format(i + 1) for i in (25, 22, 28)) and split.test[0] == form.format(2)
    names = [a + b for a in "abcdefg" for b in "abcdefg"]
    assert split_views(scene_of(names), "dtu:3").train == (names[25], names[22], names[28])
    names = [f"rect_{i + 1:03d}_3_r5000.png" for i in range(64)]
    with pytest.raises(DataError, match=r"with the ids 10, counted from 0, are missing"):
        split_views(scene_of(names[:10] + names[11:]), "dtu:3")
    with pytest.raises(DataError, match=r"with the ids 0, counted from 0, are missing"):
        split_views(scene_of(names[1:]), "dtu:3")
    # Blender's frames are counted, not their names
    names = [f"{part}/r_{i}.png" for part, n in (("train", 100), ("val", 100), ("test", 200)) for i in range(n)]
    split = split_views(scene_of(names), "blender:8")
    assert split.train == tuple(f"train/r_{i}.png" for i in (2, 16, 26, 55, 73, 76, 86, 93))
    assert split.test == tuple(f"test/r_{i}.png" for i in range(0, 200, 8))
    split = split_views(numbered(7), "every:3")
    assert ids(split.test) == [0, 3, 6] and ids(split.train) == [1, 2, 4, 5]
    assert split_views(numbered(3), "all") == Split(("000.png", "001.png", "002.png"), ())
    assert split_views(scene_of(scenes.NAMES), "llff:3") == Split(("photo1.png", "photo3.png", "photo4.png"), ("photo0.png",))


NAMES = ["a/x.png", "b/x.png", "b/y.png", "z.jpg"]


@pytest.mark.parametrize(
    "spec,train,test",
    [
        ("train=a/x.png,z.jpg;test=b/y.png", ("a/x.png", "z.jpg"), ("b/y.png",)),
        ("train=z,y", ("z.jpg", "b/y.png"), ("a/x.png", "b/x.png")),
        ("test=a/x", ("b/x.png", "b/y.png", "z.jpg"), ("a/x.png",)),
        (" test = z ; train = y.png, a/x ;", ("b/y.png", "a/x.png"), ("z.jpg",)),
    ],
)
def test_explicit_names(spec, train, test):
    assert split_views(scene_of(NAMES), spec) == Split(train, test)


@pytest.mark.parametrize(
    "spec,message",
    [
        ("train=x", r"'x' could be any of a/x.png, b/x.png; give the whole name"),
        ("train=q/yy.png", r"no view 'q/yy.png'; did you mean b/y.png"),
        ("train=zz", r"no view 'zz'; the views are a/x.png"),
        ("train=z,z.jpg", r"train names z.jpg twice"),
        ("train=z;test=z", r"views z.jpg are in training and in test"),
        ("train=;test=z", r"leaves no training view"),
        ("llff:4", r"needs 4 views, 3 of 4 remain without every 8th"),
        ("dtu:3", r"needs 49 views, not 4"),
        ("blender:8", r"not 0 and 0"),
    ],
)
def test_splits_that_the_scene_cannot_give(spec, message):
    with pytest.raises(DataError, match=message):
        split_views(scene_of(NAMES), spec)


@pytest.mark.parametrize(
    "spec",
    [
        "", "llff", "llff:", "llff:0", "llff:-1", "llff:1.5", "llff:²", "llff:" + "9" * 5000, "LLFF:3", "dtu:4", "blender:7",
        "every:0", "every:1", "all:3", "train:a", "valid=a", "train=z;train=y", "train=z;nonsense", "../x",
        ("z", "y"),
    ],
)  # fmt: skip
def test_splits_that_make_no_sense(spec):
    with pytest.raises(UsageError, match="split"):
        split_views(scene_of(NAMES), spec)


@pytest.mark.parametrize(
    "views,held_out,words", [(9, [0, 8], "every 8th"), (8, [4], "004.png"), (3, [1], "001.png"), (2, [], "none is held out")]
)
def test_a_study_without_a_split_holds_views_out(views, held_out, words):
    spec, note = held_out_split(numbered(views))
    split = split_views(numbered(views), spec)
    assert ids(split.test) == held_out and len(split.train) == views - len(held_out) and words in note


def test_coincident_views_are_views_from_one_place():
    """Equal poses across the split count, in any unit; equal poses within training and turned cameras do not."""

    def view(name, x, turned=False):
        viewmat = np.eye(4)
        if turned:
            viewmat[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
        viewmat[0, 3] = -x
        return SimpleNamespace(name=name, camera=Camera(viewmat, np.eye(3), 4, 4))

    for unit in (1e-3, 1e3):
        views = [view("a", 0), view("b", 5e-4 * unit), view("c", unit), view("d", unit), view("e", unit, turned=True)]
        scene = SimpleNamespace(views=tuple(views))
        assert coincident_views(scene, Split(("b", "c", "e"), ("a", "d"))) == [("a", "b"), ("d", "c")]
        assert coincident_views(scene, Split(("c", "d", "e"), ("a", "b"))) == []


@given(spec=st.text(max_size=30) | st.from_regex(r"(llff|dtu|blender|every|train=|test=):?[0-9a-z./;=,]*", fullmatch=True))
@settings(max_examples=2 * settings.default.max_examples, deadline=None, derandomize=True)
def test_any_text_is_a_split_or_refused(spec):
    scene = scene_of(scenes.NAMES)
    try:
        split = split_views(scene, spec)
    except (DataError, UsageError):
        return
    assert set(split.train).isdisjoint(split.test) and set(split.train) | set(split.test) <= set(scenes.NAMES)
