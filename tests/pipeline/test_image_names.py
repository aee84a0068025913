"""Each view has image files of its own, whatever the views are called and whichever system they lie on."""

import unicodedata

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.scenes import photos, seeds
from warpgs.pipeline.model.start import InitConfig, initial_gaussians
from warpgs.pipeline.run.results import evaluate_run
from warpgs.render.options import RasterizeOptions
from warpgs.report.page import image_names, renaming_notes


def test_plain_names_stay_as_they_are():
    """A suffix goes, a folder becomes a part of the name, and there is nothing to note."""
    names = image_names(["000.png", "left/IMG_1.JPG", "a.b.png", "Größe 1.png"])
    assert list(names.values()) == ["000", "left_IMG_1", "a.b", "Größe 1"] and renaming_notes(names) == []


@pytest.mark.parametrize(
    "views",
    [["a/b.png", "a_b.png"], ["c.png", "C.png"], ["c.png", "c.jpg"], ["é.png", "e\u0301.png"], ["Straße.png", "STRASSE.png"],
     ["x" * 251 + ".png", "x" * 250 + "y.png"], ["con.png", "NUL"], ["a?b.png", "a*b.png"], [".warpgs.lock", "..", "/", ".png"],
     ["a/b.png", "a_b.png", image_names(["a/b.png", "a_b.png"])["a_b.png"] + ".png"]],
    ids=["folder", "capitals", "suffix", "accent", "ss", "long", "reserved", "signs", "hidden", "taken"],
)  # fmt: skip
def test_names_that_meet_are_told_apart(views):
    """In no case two files that some system takes for one; the order of the views does not matter; the note names them."""
    names = image_names(views)
    folded = {unicodedata.normalize("NFC", n.casefold()) for n in names.values()}
    assert len(folded) == len(views) and all(len(n.encode()) <= 100 and not n.startswith(".") for n in names.values())
    assert not any(set(n) & set('<>:"\\|?*/') for n in names.values())
    assert image_names(views[:2][::-1] + views[2:]) == names
    (note,) = renaming_notes(names)
    assert f"{views[0]} is {names[views[0]]}.png" in note


@given(st.lists(st.text(st.sampled_from("aAäÄ/._-é:\udc80"), min_size=1), unique=True))
def test_no_two_views_share_a_name(views):
    names = image_names(views)
    assert len({n.casefold() for n in names.values()}) == len(views) and "" not in names.values()


def test_images_of_views_with_like_names_are_all_written(tmp_path):
    """Of four held-out views whose names meet, each has its render and its depth map."""
    views, wanted = photos(5), ["a/b.png", "a_b.png", "A_B.jpg", "x" * 250 + ".png", "train.png"]
    for view, name in zip(views, wanted):
        object.__setattr__(view, "name", name)
    gaussians = initial_gaussians(seeds(), InitConfig(), 3, 1.0, torch.device("cpu"))
    evaluate_run(tmp_path, gaussians, views[4:], views[:4], RasterizeOptions())
    for folder in ("renders", "depth"):
        assert len(list((tmp_path / folder).iterdir())) == 4
