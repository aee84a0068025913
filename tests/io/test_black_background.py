"""Objects on black: what around them is empty, and scenes that are left alone."""

import numpy as np
import pytest

from tests.io import scenes
from warpgs.io.load import load_scene
from warpgs.pipeline.metrics.scores import counted_region


def ring(i):
    """Return an image [36, 48, 3] of a bright ring on black, with noise in the black and a dark pixel in the bright."""
    image = np.full((36, 48, 3), 5, np.uint8)
    image[6:30, 12:36] = 200 - 10 * i
    image[12:24, 18:30] = 0
    image[9, 15] = 3
    image[:2, :2] = [[[4] * 3, [90] * 3], [[90] * 3] * 2]  # what lies in the corner is joined to the border alone
    return image


def write(root, images):
    scenes.write_middlebury(root)
    for name, image in zip(scenes.NAMES, images, strict=True):
        scenes.save(root / name, image)


def test_dark_pixels_around_objects_and_in_holes_are_transparent(tmp_path):
    """A speck stays opaque; the region of the score is that of the same images without opacity."""
    write(tmp_path, [ring(i) for i in range(5)])
    scene, plain = load_scene(tmp_path), load_scene(tmp_path, black_is_empty=False)
    alpha = np.zeros((36, 48), np.float32)
    alpha[6:30, 12:36] = 1
    alpha[12:24, 18:30] = 0
    alpha[:2, :2] = [[0, 1], [1, 1]]
    for v, before in zip(scene.views, plain.views):
        assert (v.alpha == alpha).all() and v.alpha.dtype == np.float32 and not v.image[alpha == 0].any()
        assert v.alpha_estimated and not before.alpha_estimated
        assert (v.image[alpha == 1] == before.image[alpha == 1]).all() and before.alpha is None
        assert (counted_region(v)[0] == counted_region(before)[0]).all()
    note = "every image shows an object on black: the dark pixels around the object and in its holes (74.8% of all pixels)"
    assert any(n.startswith(note) and "--no-black-is-empty" in n for n in scene.notes)
    assert not any("object on black" in n for n in plain.notes) and scene.fingerprint != plain.fingerprint


@pytest.mark.parametrize("what", ["a bright image", "a mask", "an alpha channel"])
def test_one_view_that_differs_leaves_all_as_they_are(what, tmp_path):
    write(tmp_path, [ring(i) for i in range(5)])
    if what == "a bright image":
        scenes.save(tmp_path / scenes.NAMES[4], np.full((36, 48, 3), 90, np.uint8))
    elif what == "a mask":
        scenes.save(tmp_path / "masks" / "photo4.png", np.full((36, 48), 255, np.uint8))
    else:
        alpha = np.full((36, 48, 1), 255, np.uint8)
        alpha[0] = 9
        scenes.save(tmp_path / scenes.NAMES[4], np.concatenate([ring(4), alpha], axis=2))
    scene = load_scene(tmp_path)
    assert all(v.alpha is None for v in scene.views[:4]) and not any("object on black" in n for n in scene.notes)
