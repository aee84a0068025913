"""The study on coverage finds the unseen parts with the largest error, and draws them beside the photograph."""

import io

import numpy as np
import pytest
from PIL import Image

from bench.lib.coverage_fits import measure, picture, renders_of, unseen_in_both, worst_parts
from bench.lib.one_fit import plan
from warpgs.synthetic.demo import split_spec, write_demo


def views(bright: tuple[int, int, int], unseen: tuple[int, int, int]) -> dict:
    """Return two gray views [30, 48], with a bright square in the render and an unseen one: view, top and left of each."""
    photo = np.full((2, 30, 48, 3), 90, np.uint8)
    render, mask = photo.copy(), np.zeros(photo.shape[:3], bool)
    for array, (i, top, left), value in ((render, bright, 250), (mask, unseen, True)):
        array[i, top : top + 10, left : left + 16] = value
    return {"name": np.array(["a.png", "b.png"]), "photo": photo, "render": render, "unseen": mask}


def test_the_worst_part_is_unseen_in_both_and_wrong_in_one():
    """An error that a training view saw does not count, nor one that is unseen in one fit alone."""
    before, after = views((1, 12, 20), (1, 12, 20)), views((0, 0, 0), (1, 12, 20))
    assert worst_parts(before, after, 1) == [[1, 20, 12, 16, 10]]
    after["unseen"][:] = False
    after["unseen"][0, :5, :5] = before["unseen"][0, :5, :5] = True
    assert worst_parts(before, after, 2)[0] == [0, 0, 0, 16, 10]


def test_two_fits_are_compared_where_both_are_unseen(tmp_path):
    """A square of 160 levels of error before, none after; what one fit alone does not see is left out."""
    files, both = (tmp_path / "a.npz", tmp_path / "b.npz"), [views((1, 12, 20), (1, 12, 20)), views((0, 0, 0), (1, 12, 20))]
    both[1]["render"], both[0]["unseen"][0] = both[1]["photo"] + np.uint8(16), True
    for file, values in zip(files, both):
        np.savez(file, **values)
    found = unseen_in_both(*files)
    assert found["share_of_pixels"] == 160 / (2 * 30 * 48)
    assert [found[k] for k in ("before", "after")] == pytest.approx([20 * np.log10(255 / e) for e in (160, 16)])
    both[1]["unseen"][:] = False
    np.savez(files[1], **both[1])
    assert unseen_in_both(*files) == {"share_of_pixels": 0, "before": None, "after": None}


def test_a_fit_leaves_its_views_and_the_picture_shows_them(tmp_path):
    """One row of four cells for each crop; shares of all classes sum to 1."""
    spec, folder = split_spec(8), str(tmp_path / "scene")
    write_demo(tmp_path / "scene", views=8, width=64, height=48)
    files = []
    for preset in ("default:steps=4,method.hier=true", "default:steps=4"):
        (fit,) = plan("demo@x", preset, 0, folder, (spec, 1), 0, "cpu")
        row = measure(tmp_path, fit)
        files.append(renders_of(tmp_path, fit))
        assert abs(sum(c["share_of_pixels"] for c in row["classes"].values()) - 1) < 1e-9 and row["steps"] == 4
    kept = np.load(files[1])
    assert kept["photo"].shape == kept["render"].shape == (*kept["unseen"].shape, 3) and len(set(files)) == 2
    with Image.open(io.BytesIO(picture({"demo": (files[0], files[1])}, 1))) as made:
        assert made.format == "JPEG" and made.width > 4 * made.height / 2
