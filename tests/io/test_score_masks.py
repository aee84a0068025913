"""Object masks for scoring: matched by image id, never by sorted order."""

import shutil

import numpy as np
import pytest

from tests.io import scenes
from warpgs.errors import DataError
from warpgs.io.folder import image_ids
from warpgs.io.load import load_scene
from warpgs.pipeline.metrics.scores import score

RECT = tuple(f"rect_{i + 1:03d}_3_r5000.png" for i in range(scenes.VIEWS))


def mask_of(i: int) -> np.ndarray:
    """Return a mask that names its id: row i is black."""
    mask = np.full((scenes.HEIGHT, scenes.WIDTH), 255, np.uint8)
    mask[i] = 0
    return mask


def write_masks(folder, ids=range(scenes.VIEWS), form="{:03d}.png"):
    for i in ids:
        scenes.save(folder / form.format(i), mask_of(i))


def black_rows(scene):
    """Return the row that each view's score mask leaves out."""
    return [np.flatnonzero(~v.score_mask.any(1)).tolist() for v in scene.views]


@pytest.mark.parametrize("inner", ["", "mask"])
@pytest.mark.parametrize("names", [scenes.NAMES, RECT])
def test_masks_of_a_scene_folder_are_found_and_matched_by_id(tmp_path, names, inner):
    """`idrmasks` in the scene folder, with or without DTU's inner `mask`; the fit keeps every pixel."""
    scenes.write_colmap(tmp_path, names=names)
    write_masks(tmp_path / "idrmasks" / inner)
    scene = load_scene(tmp_path)
    assert black_rows(scene) == [[i] for i in range(scenes.VIEWS)]
    assert all(v.mask is None for v in scene.views)
    assert any("matched by image id" in n for n in scene.notes)


def test_masks_elsewhere_of_more_views_than_there_are(tmp_path):
    """Masks of 64 images serve a scan of five, also from a folder elsewhere."""
    scenes.write_colmap(tmp_path / "scene", names=RECT)
    write_masks(tmp_path / "scan8" / "mask", range(8), "{:05d}.png")
    scene = load_scene(tmp_path / "scene", score_masks=tmp_path / "scan8")
    assert black_rows(scene) == [[i] for i in range(scenes.VIEWS)]
    assert load_scene(tmp_path / "scene").views[0].score_mask is None


def test_a_missing_mask_is_named_by_its_id(tmp_path):
    """Matching by sorted order would give every later view its neighbour's mask."""
    scenes.write_colmap(tmp_path, names=RECT)
    write_masks(tmp_path / "idrmasks", [0, 1, 3, 4])
    with pytest.raises(DataError, match=r"no mask for image id 2 .* rect_001_... is id 0"):
        load_scene(tmp_path)


def test_counting_from_one_is_not_guessed(tmp_path):
    """Images 1 to 5 and masks 0 to 5 can be matched in two ways, so the scene is refused."""
    scenes.write_colmap(tmp_path, names=tuple(f"{i + 1:03d}.png" for i in range(scenes.VIEWS)))
    write_masks(tmp_path / "idrmasks", range(6))
    with pytest.raises(DataError, match="off by one"):
        load_scene(tmp_path)
    shutil.rmtree(tmp_path / "idrmasks")
    write_masks(tmp_path / "idrmasks", range(5))
    with pytest.raises(DataError, match="no mask for image id 5"):
        load_scene(tmp_path)


def test_masks_that_cannot_be_used_are_named(tmp_path):
    """No masks, masks without numbers, of another shape, or all black."""
    scenes.write_colmap(tmp_path / "scene")
    folder = tmp_path / "m"

    def refused(message):
        with pytest.raises(DataError, match=message):
            load_scene(tmp_path / "scene", score_masks=folder)

    refused("contains no masks")
    for name in "abcde":
        scenes.save(folder / f"{name}.png", mask_of(0))
    refused("no distinct numbers")
    shutil.rmtree(folder)
    write_masks(folder)
    scenes.save(folder / "002.png", np.full((20, 20), 255, np.uint8))
    refused("002.png: the mask is 20 x 20 px, its image photo2.png 16 x 12")
    scenes.save(folder / "002.png", np.zeros((12, 16), np.uint8))
    refused("leaves no pixel of photo2.png")


def test_larger_masks_shrink_with_the_images(tmp_path):
    """Masks of the original size serve at any downscale."""
    scenes.write_colmap(tmp_path)
    write_masks(tmp_path / "idrmasks")
    scenes.save(tmp_path / "idrmasks" / "001.png", np.repeat(np.repeat(mask_of(1), 4, 0), 4, 1))
    assert black_rows(load_scene(tmp_path))[1] == [1]
    assert load_scene(tmp_path, downscale=2).views[0].score_mask.shape == (6, 8)


def test_masks_belong_to_the_fingerprint(tmp_path):
    """Scores over other pixels do not compare, so the fingerprint differs."""
    scenes.write_colmap(tmp_path)
    plain = load_scene(tmp_path).fingerprint
    write_masks(tmp_path / "idrmasks")
    assert load_scene(tmp_path).fingerprint != plain


@pytest.mark.parametrize(
    "names,ids",
    [
        (["rect_001_3_r5000.png", "rect_026_3_r5000.png"], [0, 25]),
        (["a/000003.png", "a/000010.png"], [3, 10]),
        (["cam2_07.png", "cam2_09.png"], [7, 9]),
        (["x.png", "y.png"], None),
        (["1_2.png", "1_2.jpg"], None),
    ],
)
def test_ids_of_names(names, ids):
    """The id is the number that differs from name to name."""
    assert image_ids(names) == ids


def test_where_pixels_come_from(tmp_path):
    """A ready-made folder and resampling give different descriptions."""
    scenes.write_colmap(tmp_path)
    assert load_scene(tmp_path).pixels == "images as stored"
    assert load_scene(tmp_path, downscale=2).pixels == "images area-resampled by 2"
    scenes.save_images(tmp_path / "images_2", width=8, height=6)
    assert load_scene(tmp_path, downscale=2).pixels == "images_2 as stored"


def test_undistorted_images_are_scored_inside_their_mask_only(tmp_path):
    """Pixels that the lens did not see change no score, with a score mask and without one."""
    for folder, masks in ((tmp_path / "plain", False), (tmp_path / "masked", True)):
        scenes.write_transforms(folder, scenes.transforms_json(k1=0.8, k2=0.0, p1=0.0, p2=0.0))
        if masks:
            for i in range(scenes.VIEWS):
                scenes.save(folder / "idrmasks" / f"{i:03d}.png", np.full((scenes.HEIGHT, scenes.WIDTH), 255, np.uint8))
        view = load_scene(folder).views[0]
        assert view.mask is not None and not view.mask[0, 0] and (view.score_mask is not None) == masks
        image = view.image.copy()
        image[~view.mask] = 1 - image[~view.mask]
        m = score(view, image)
        assert m.psnr == np.inf and m.ssim == 1
        image[view.mask] = 0
        assert score(view, image).psnr < 30
