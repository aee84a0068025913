"""Links lead out of a scene only where the user allows it, in every format, for images, masks and score masks."""

import os

import numpy as np
import pytest

from tests.io import scenes
from warpgs.errors import DataError
from warpgs.io.load import load_scene


def link(path, target):
    """Make a link, or skip where the system or the user may not."""
    try:
        path.symlink_to(target, target_is_directory=target.is_dir())
    except OSError:
        pytest.skip("this system does not let the user make links")


def moved_out(scene, path):
    """Move a file or folder of a scene out of it and leave a link there."""
    outside = scene.parent / "elsewhere"
    outside.mkdir(exist_ok=True)
    path.rename(outside / path.name)
    link(path, outside / path.name)


def asks(scene):
    with pytest.raises(DataError, match=r"points outside the scene folder.*--allow-outside"):
        load_scene(scene)
    assert len(load_scene(scene, allow_outside=True).views) == scenes.VIEWS


@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_an_image_that_is_a_link(kind, tmp_path):
    scene = scenes.WRITERS[kind](tmp_path / "scene")
    first = sorted(scene.rglob("*.png"))[0]
    inside = scene / "originals" / first.name
    inside.parent.mkdir()
    if not kind.startswith("colmap"):  # its names stay in the image folder
        first.rename(inside)
        link(first, inside)
        assert len(load_scene(scene).views) == scenes.VIEWS
        first = inside
    moved_out(scene, first)
    asks(scene)


@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_files_of_cameras_and_points_that_are_links(kind, tmp_path):
    scene = scenes.WRITERS[kind](tmp_path / "scene")
    files = [p for p in scene.rglob("*") if p.is_file() and p.suffix != ".png"]
    assert files
    for path in files:
        moved_out(scene, path)
        asks(scene)
        path.unlink()
        (tmp_path / "elsewhere" / path.name).rename(path)


@pytest.mark.parametrize("kind", ["colmap", "colmap text", "transforms", "llff", "dtu"])
def test_an_image_folder_that_is_a_link(kind, tmp_path):
    scene = scenes.WRITERS[kind](tmp_path / "scene")
    moved_out(scene, scene / ("image" if kind == "dtu" else "images"))
    asks(scene)


@pytest.mark.parametrize("kind", ["colmap", "transforms", "llff", "dtu", "middlebury"])
@pytest.mark.parametrize("whole", [False, True])
def test_masks_that_are_links(kind, whole, tmp_path):
    scene = scenes.WRITERS[kind](tmp_path / "scene")
    mask = scene / "masks" / ("000000.png" if kind == "dtu" else "photo0.png")
    scenes.save(mask, np.full((12, 16), 255, np.uint8))
    assert any("masked by a mask file" in n for n in load_scene(scene).notes)
    moved_out(scene, mask.parent if whole else mask)
    asks(scene)


def test_score_masks_that_are_links(tmp_path):
    scene = scenes.write_colmap(tmp_path / "scene")
    for i in range(scenes.VIEWS):
        scenes.save(scene / "idrmasks" / f"{i:03d}.png", np.full((12, 16), 255, np.uint8))
    moved_out(scene, scene / "idrmasks")
    asks(scene)
    # a folder that the user names is his own choice, but its files stay in it
    named = tmp_path / "elsewhere" / "idrmasks"
    assert load_scene(scene, score_masks=named).views[0].score_mask is not None
    (named / "000.png").rename(tmp_path / "000.png")
    link(named / "000.png", tmp_path / "000.png")
    with pytest.raises(DataError, match=r"000.png: a link points outside"):
        load_scene(scene, score_masks=named)


@pytest.mark.skipif(os.name == "nt", reason="Windows makes no such links")
@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_links_that_lead_round_in_circles(kind, tmp_path):
    scene = scenes.WRITERS[kind](tmp_path / "scene")
    first = sorted(scene.rglob("*.png"))[0]
    first.unlink()
    link(first, first)
    if kind in ("transforms", "instant-ngp", "blender"):  # frames without a file are skipped and named
        assert len(load_scene(scene).views) == scenes.VIEWS - 1
        return
    message = r"images.*Copy the scene again|counts must agree|is a broken link; restore it"
    with pytest.raises(DataError, match=message):
        load_scene(scene)
