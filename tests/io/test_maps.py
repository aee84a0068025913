"""Maps beside images: depth, normals and masks for scoring, matched by image; bad ones are refused with a reason."""

import json
import os
import shutil

import numpy as np
import pytest

from tests.io import scenes
from tests.io.scenes import link, refused
from warpgs.errors import DataError, UsageError
from warpgs.io import maps
from warpgs.io.folder import image_ids
from warpgs.io.images import LoadedImage, turn_upright
from warpgs.io.load import load_scene
from warpgs.io.maps import in_pixels_of, resized
from warpgs.pipeline.metrics.scores import score

SHAPE = (scenes.HEIGHT, scenes.WIDTH)
RAMP = (np.arange(np.prod(SHAPE), dtype=np.uint16).reshape(SHAPE) * 10 + 1000).astype(np.uint16)
"""Depths from 1 m to 2.91 m in millimetres."""


def facing() -> np.ndarray:
    """Return normals that face the camera, slanted by the column, float32 [H, W, 3]."""
    x = np.broadcast_to(np.linspace(-0.5, 0.5, scenes.WIDTH), SHAPE)
    return np.stack([x, np.zeros(SHAPE), -np.sqrt(1 - x**2)], -1).astype(np.float32)


def write_maps(folder, values=RAMP, names=scenes.NAMES, suffix=".png"):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        path = folder / (name.rpartition(".")[0] + suffix)
        path.parent.mkdir(parents=True, exist_ok=True)
        if suffix.endswith(".png"):
            scenes.save(path, values)
        else:
            np.save(path, values)
    return folder


@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_depths_of_every_format_are_in_scene_units(kind, tmp_path):
    """Millimetres become units of the cameras, and follow the scene's own scale; a note says so."""
    scene = scenes.WRITERS[kind](tmp_path / "scene")
    names = [v.name for v in load_scene(scene).views]
    loaded = load_scene(scene, depths=write_maps(tmp_path / "maps", names=[n.rpartition("/")[2] for n in names]))
    for view in loaded.views:
        assert view.depth.kind == "metric" and view.depth.values.dtype == np.float32
        assert np.allclose(view.depth.values, RAMP * 0.001 * loaded.normalization.scale, rtol=1e-6)
    assert any("depth maps: 5 of 5 views" in n and "0.001 for integers" in n for n in loaded.notes)
    assert loaded.fingerprint != load_scene(scene).fingerprint


def test_missing_views_units_and_kinds(tmp_path):
    scene = scenes.write_colmap(tmp_path / "scene")
    write_maps(tmp_path / "maps", RAMP.astype(np.float32), scenes.NAMES[:2], ".npy")
    maps = tmp_path / "maps"
    loaded = load_scene(scene, depths=maps)
    assert [v.depth is not None for v in loaded.views] == [True, True, False, False, False]
    scale = loaded.normalization.scale
    assert np.allclose(loaded.views[0].depth.values, RAMP * scale)
    assert np.allclose(load_scene(scene, depths=maps, depth_unit=0.5).views[1].depth.values, 0.5 * RAMP * scale)
    relative = load_scene(scene, depths=maps, depth_kind="disparity").views[0].depth
    assert relative.kind == "disparity" and (relative.values == RAMP).all()
    values = RAMP.astype(np.float32)
    values[0], values[1], values[2] = np.nan, np.inf, 0
    found = load_scene(scene, depths=write_maps(tmp_path / "gaps", values, suffix=".npy")).views[0].depth.values
    assert (found[:3] == 0).all() and (found[3:] > 0).all()
    for wrong in ({"depth_kind": "deep"}, {"normal_axes": "blender"}, {"depth_unit": 0}, {"depth_unit": float("nan")}):
        with pytest.raises(UsageError):
            load_scene(scene, **wrong)


@pytest.mark.parametrize(("raw", "wanted"), [(np.float32(0.25), 0.25), (np.uint8(51), 0.2), (np.uint8(1), 0.5)])
def test_confidence_lies_beside_the_map(tmp_path, raw, wanted):
    """Gray levels are fractions of the largest; three levels 0, 1, 2 are halves. Depth without confidence does not count."""
    scene, maps = scenes.write_colmap(tmp_path / "scene"), write_maps(tmp_path / "maps")
    confidence = np.full(SHAPE, raw)
    confidence[0] = 0
    np.save(maps / "photo1.confidence.npy", confidence)
    found = load_scene(scene, depths=maps)
    assert found.views[0].depth.confidence is None
    assert np.allclose(found.views[1].depth.confidence[1:], wanted) and (found.views[1].depth.values[0] == 0).all()
    for values, reason in (
        (np.full(SHAPE, 2.5, np.float32), "must be in"),
        (np.ones((2, 2), np.float32), "its depth map 16 x 12"),
    ):
        np.save(maps / "photo1.confidence.npy", values)
        refused(scene, f"photo1.confidence.npy.*{reason}", depths=maps)


@pytest.mark.parametrize(("order", "kind"), [("C", "<f4"), ("F", ">f8"), ("F", ">u2"), ("C", "u1")])
def test_numbers_of_every_layout(order, kind, tmp_path):
    wanted = np.arange(7 * 9 * 3).reshape(1, 7, 9, 3).astype(kind)
    np.save(tmp_path / "a.npy", np.asarray(wanted, order=order))
    found = maps.read_numbers(tmp_path / "a.npy")
    assert (found == wanted[0]).all()
    assert found.dtype == {"f": np.float32, "u": np.dtype(kind).newbyteorder("=")}[wanted.dtype.kind]


@pytest.mark.parametrize("suffix", [".png", ".npy"])
def test_normals_in_both_axes(tmp_path, suffix):
    """RGB (n + 1) / 2 or vectors, in OpenCV axes or OpenGL's."""
    scene = scenes.write_colmap(tmp_path / "scene")
    for axes, sign in (("opencv", 1), ("opengl", -1)):
        n = facing() * np.array([1, sign, sign], np.float32)
        stored = np.round((n + 1) / 2 * 255).astype(np.uint8) if suffix == ".png" else n
        maps = write_maps(tmp_path / axes, stored, suffix=suffix)
        found = load_scene(scene, normals=maps, normal_axes=axes).views[2].normals
        assert np.allclose(found, facing(), atol=0.01) and np.allclose(np.linalg.norm(found, axis=-1), 1, atol=1e-6)
        other = {"opencv": "opengl", "opengl": "opencv"}[axes]
        refused(scene, r"photo0.*face away from the camera; give the other --normal-axes", normals=maps, normal_axes=other)


BAD = {
    "size": (RAMP[:, :-3], r"13 x 12 px, its image 16 x 12; give a map of the whole image"),
    "empty": (np.zeros(SHAPE, np.uint16), "all values are 0"),
    "negative": (-RAMP.astype(np.float32), r"192 depths are negative, down to -2910"),
    "nan": (np.full(SHAPE, np.nan, np.float32), "all values are 0 or not finite"),
    "infinite": (np.full(SHAPE, np.inf, np.float32), "all values are 0 or not finite"),
    "huge": (np.full(SHAPE, 1e20, np.float32), "beyond 1e"),
    "picture": (np.stack([RAMP, RAMP, RAMP + 1], -1), "colour image of 3 channels"),
    "bits": (RAMP.astype(np.uint8) | 1, "has 8 bits"),
    "numbers": (RAMP.astype(np.int32), "its numbers are int32"),
    "words": (np.full(SHAPE, "a"), "its numbers are"),
    "axes": (np.zeros((2, 3, 4, 5), np.float32), "must be an array"),
    "vectors": (2 * facing(), "100% of its vectors are not unit normals"),
    "none": (0 * facing(), "every pixel is black"),
    "one channel": (facing()[..., 0], "not of three channels"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_map_is_refused_with_view_and_reason(case, tmp_path):
    values, reason = BAD[case]
    scene, maps = scenes.write_colmap(tmp_path / "scene"), tmp_path / "maps"
    normals = case in ("vectors", "none", "one channel")
    write_maps(maps, facing() if normals else RAMP.astype(np.float32), suffix=".npy")
    np.save(maps / "photo3.npy", values)
    refused(scene, f"photo3.npy: .*{reason}", **{"normals" if normals else "depths": maps})


def test_folders_without_maps(tmp_path):
    scene, maps = scenes.write_colmap(tmp_path / "scene"), tmp_path / "maps"
    refused(scene, "no such folder", depths=maps)
    maps.mkdir()
    refused(scene, "holds no maps; add NPY", depths=maps)
    (maps / "photo0.exr").write_bytes(b"v/1\1")
    refused(scene, r"holds no maps; add NPY", depths=maps)
    write_maps(maps, names=("else.png",))
    refused(scene, "none of its 1 maps.* has the name of an image", depths=maps)
    write_maps(maps)
    np.save(maps / "photo0.npy", RAMP)
    refused(scene, "is for the same image", depths=maps)
    (maps / "photo0.png").unlink()
    np.save(maps / "photo0.npy", np.array([{}], object))
    refused(scene, "cannot be read as a numpy array", depths=maps)
    (maps / "photo0.npy").rename(maps / "photo0.png")
    refused(scene, "is not a PNG", depths=maps)


def test_sizes_beyond_the_limit_and_links_are_refused(tmp_path):
    scene, maps = scenes.write_colmap(tmp_path / "scene"), tmp_path / "maps"
    write_maps(maps, np.ones((60, 80), np.float32), suffix=".npy")
    refused(scene, "has more than 200 pixels", depths=maps, max_pixels=200)
    (maps / "photo0.npy").rename(tmp_path / "outside.npy")
    link(maps / "photo0.npy", tmp_path / "outside.npy")
    refused(scene, r"photo0\.npy: a link points outside the folder of maps", depths=maps)
    assert load_scene(scene, depths=maps, allow_outside=True).views[0].depth is not None
    if hasattr(os, "mkfifo"):
        (maps / "photo0.npy").unlink()
        os.mkfifo(maps / "photo0.npy")
        assert load_scene(scene, depths=maps).views[0].depth is None  # no file, so no map


def write_named(root, unit=None):
    content = scenes.transforms_json()
    if unit is not None:
        content["depth_unit_scale_factor"] = unit
    for i, frame in enumerate(content["frames"]):
        frame["depth_file_path"], frame["normal_file_path"] = f"depths/photo{i}.png", f"normals/photo{i}.npy"
    write_maps(root / "depths"), write_maps(root / "normals", facing(), suffix=".npy")
    return scenes.write_transforms(root, content)


def test_maps_that_transforms_json_names(tmp_path):
    """By nerfstudio's keys, also by the end of a path that is no photograph; flags come before them, and `none` skips them."""
    root = write_named(tmp_path / "a")
    found = load_scene(root)
    assert np.allclose(found.views[1].depth.values, RAMP * 0.001 * found.normalization.scale)
    assert np.allclose(found.views[1].normals, facing(), atol=1e-6)
    assert any("listed in the scene's file" in n for n in found.notes)
    tenth = load_scene(write_named(tmp_path / "b", 0.0001))
    assert np.allclose(tenth.views[1].depth.values, RAMP * 0.0001 * tenth.normalization.scale)
    assert np.allclose(load_scene(tmp_path / "b", depth_unit=0.002).views[1].depth.values, 20 * tenth.views[1].depth.values)
    bare = load_scene(root, depths="none", normals="none")
    assert bare.views[0].depth is None and bare.views[0].normals is None
    file = root / "transforms.json"
    content = json.loads(file.read_text())
    moved = json.loads(file.read_text())
    for i, frame in enumerate(moved["frames"]):
        frame["mask_path"] = f"masks/{i}.png"
        frame |= {k: f"/home/me/a/{v}" if i else f"C:\\a\\{v}" for k, v in frame.items() if k.endswith("_path")}
        scenes.save(root / "masks" / f"{i}.png", np.full((12, 16), 255, np.uint8))
    file.write_text(json.dumps(moved))
    elsewhere = load_scene(root)
    assert np.array_equal(elsewhere.views[1].depth.values, found.views[1].depth.values)
    assert np.array_equal(elsewhere.views[1].normals, found.views[1].normals)
    assert sum(n.startswith(("5 images of", "15 files of")) and "matched by their" in n for n in elsewhere.notes) == 2
    moved["frames"][1]["mask_path"] = "/gone/images/photo1.png"
    file.write_text(json.dumps(moved))
    refused(root, "points outside")
    for name, reason in {
        "../x.png": "points outside",
        "x.exr": "maps must be .png or .npy",
        "gone.npy": "cannot be read",
    }.items():
        content["frames"][2]["depth_file_path"] = name
        file.write_text(json.dumps(content))
        refused(root, reason)


def test_maps_follow_size_and_mask(tmp_path):
    """A map of another size, images made smaller, pixels that a mask leaves out, and a lens that is undone."""
    scene = scenes.write_colmap(tmp_path / "scene")
    small = write_maps(tmp_path / "small", np.full((6, 8), 1500, np.uint16))
    for downscale in (1, 3):
        loaded = load_scene(scene, depths=small, downscale=downscale)
        assert np.allclose(loaded.views[0].depth.values, 1.5 * loaded.normalization.scale)
    half = np.tile(np.array([0, 255], np.uint8).repeat(8), (12, 1))
    for i in range(scenes.VIEWS):
        scenes.save(scene / "masks" / f"photo{i}.png", half)
    values = load_scene(scene, depths=small).views[0].depth.values
    assert (values[:, :8] == 0).all() and (values[:, 8:] > 0).all()
    scene = scenes.write_colmap(tmp_path / "lens", model="OPENCV", parameters=(20, 20, 8, 6, 1.0, 0, 0, 0))
    columns = np.broadcast_to(np.arange(scenes.WIDTH) + 1.0, SHAPE).astype(np.float32)
    view = load_scene(scene, depths=write_maps(tmp_path / "maps", columns, suffix=".npy"), depth_kind="relative").views[2]
    shown = view.image[..., 0] * scenes.WIDTH + 0.5  # red grows to the right
    known = view.depth.values > 0
    assert known.mean() > 0.7 and np.abs(view.depth.values - shown)[known].max() < 0.6
    assert np.abs(view.depth.values - columns).max() > 0.9  # it moved


def test_sizes_and_orientations_of_maps_and_ids_of_names():
    sparse = np.zeros((12, 16), np.float32)
    sparse[3, 5], sparse[9, 14] = 2.0, 3.0
    found = resized(sparse, 4, 3)
    assert sorted(found[found > 0].tolist()) == [2.0, 3.0] and found[0, 1] == 2 and found[2, 3] == 3
    step = np.where(np.arange(8) < 4, 1.0, 4.0).astype(np.float32)[None].repeat(6, 0)
    assert set(np.unique(resized(step, 16, 12))) == {1.0, 4.0}
    slope = (10 + 0.1 * np.arange(8)).astype(np.float32)[None].repeat(6, 0)
    assert np.abs(np.diff(resized(slope, 16, 12)[5])).max() < 0.06
    # a map lies as its image was stored, or upright
    image = LoadedImage(np.zeros((16, 12, 3), np.float32), None, np.eye(3), orientation=6, full_size=(16, 12))
    stored = RAMP.astype(np.float32)
    upright = turn_upright(stored, 6)
    assert (in_pixels_of(image, stored, "a.npy") == upright).all() and (in_pixels_of(image, upright, "a.npy") == upright).all()
    with pytest.raises(DataError, match="EXIF rotates its image"):
        in_pixels_of(image, facing(), "n.npy")
    # the id of a name is the number that differs from name to name
    for names, ids in (
        (["rect_001_3_r5000.png", "rect_026_3_r5000.png"], [0, 25]),
        (["a/000003.png", "a/000010.png"], [3, 10]),
        (["cam2_07.png", "cam2_09.png"], [7, 9]),
        (["x.png", "y.png"], None),
        (["1_2.png", "1_2.jpg"], None),
    ):
        assert image_ids(names) == ids, names


# Object masks for scoring: matched by image id, never by sorted order.

RECT = tuple(f"rect_{i + 1:03d}_3_r5000.png" for i in range(scenes.VIEWS))


def mask_of(i: int) -> np.ndarray:
    mask = np.full((scenes.HEIGHT, scenes.WIDTH), 255, np.uint8)
    mask[i] = 0
    return mask


def write_masks(folder, ids=range(scenes.VIEWS), form="{:03d}.png"):
    for i in ids:
        scenes.save(folder / form.format(i), mask_of(i))


def black_rows(scene):
    return [np.flatnonzero(~v.score_mask.any(1)).tolist() for v in scene.views]


@pytest.mark.parametrize("names", [scenes.NAMES, RECT])
def test_masks_of_a_scene_folder_are_found_and_matched_by_id(tmp_path, names):
    """`idrmasks`, with or without DTU's inner `mask`, or a folder elsewhere with more masks; the fit keeps every pixel."""
    scenes.write_colmap(tmp_path / "scene", names=names)
    plain = load_scene(tmp_path / "scene")
    write_masks(tmp_path / "scan8" / "mask", range(8), "{:05d}.png")
    elsewhere = load_scene(tmp_path / "scene", score_masks=tmp_path / "scan8")
    assert plain.views[0].score_mask is None
    for inner in ("mask", ""):
        write_masks(tmp_path / "scene" / "idrmasks" / inner)
        scene = load_scene(tmp_path / "scene")
        shutil.rmtree(tmp_path / "scene" / "idrmasks")
        assert black_rows(scene) == black_rows(elsewhere) == [[i] for i in range(scenes.VIEWS)]
        assert all(v.mask is None for v in scene.views) and any("matched by image id" in n for n in scene.notes)
        assert scene.fingerprint == elsewhere.fingerprint != plain.fingerprint  # scores over other pixels do not compare


def test_ids_are_not_guessed_and_masks_that_cannot_be_used_are_named(tmp_path):
    """Matching by sorted order would give later views their neighbour's mask; images 1 to 5 and masks 0 to 5 match twice."""
    scenes.write_colmap(tmp_path / "dtu", names=RECT)
    write_masks(tmp_path / "dtu" / "idrmasks", [0, 1, 3, 4])
    refused(tmp_path / "dtu", r"no mask for image id 2\).* rect_001_... is id 0")
    scene = scenes.write_colmap(tmp_path / "own", names=tuple(f"{i + 1:03d}.png" for i in range(scenes.VIEWS)))
    write_masks(scene / "idrmasks", range(6))
    refused(scene, "count from 0, or remove mask 0")
    shutil.rmtree(scene / "idrmasks")
    write_masks(scene / "idrmasks", range(5))
    refused(scene, "no mask for image id 5")
    scene, folder = scenes.write_colmap(tmp_path / "scene"), tmp_path / "m"  # none, without numbers, of another shape, black
    refused(scene, "contains none", score_masks=folder)
    for name in "abcde":
        scenes.save(folder / f"{name}.png", mask_of(0))
    refused(scene, "no distinct numbers", score_masks=folder)
    shutil.rmtree(folder)
    write_masks(folder)
    scenes.save(folder / "002.png", np.full((20, 20), 255, np.uint8))
    refused(scene, "002.png: its aspect is not that of photo2.png, 16 x 12 px", score_masks=folder)
    scenes.save(folder / "002.png", np.zeros((12, 16), np.uint8))
    refused(scene, "leaves no pixel of photo2.png", score_masks=folder)
    write_masks(scene / "idrmasks")
    scenes.save(scene / "idrmasks" / "001.png", np.repeat(np.repeat(mask_of(1), 4, 0), 4, 1))  # of the original size
    assert black_rows(load_scene(scene))[1] == [1]
    assert load_scene(scene, downscale=2).views[0].score_mask.shape == (6, 8)


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
