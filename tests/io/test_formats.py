"""The same cameras and images give the same scene, whatever the format."""

import numpy as np
import pytest

from tests.io import scenes
from warpgs.errors import DataError, UsageError
from warpgs.io.load import load_scene, split_views


def landing(scene, i, point):
    """Return the position in the i-th view [px] of a point in file coordinates, by all that the scene holds."""
    camera, n = scene.views[i].camera, scene.normalization
    x = camera.viewmat[:3, :3] @ (n.scale * (point - n.offset)) + camera.viewmat[:3, 3]
    return (camera.K @ (x / x[2]))[:2]


def by_index(scene):
    """Return the positions of the views in the order of their cameras; only Blender's folders change it."""
    return sorted(range(len(scene.views)), key=lambda j: scene.views[j].name.rpartition("/")[2])


@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_a_point_lands_on_the_same_pixel_in_every_format(kind, tmp_path):
    scene = load_scene(scenes.WRITERS[kind](tmp_path))
    assert len(scene.views) == scenes.VIEWS
    point = scenes.POINT
    if kind == "dtu":
        point = (np.linalg.inv(scenes.SCALE_MAT) @ [*point, 1])[:3]
    for i, j in enumerate(by_index(scene)):
        np.testing.assert_allclose(landing(scene, j, point), scenes.pixel(i), atol=1e-8)


@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_pixels_arrive_as_rgb(kind, tmp_path):
    scene = load_scene(scenes.WRITERS[kind](tmp_path))
    for i, j in enumerate(by_index(scene)):
        view = scene.views[j]
        assert view.image.dtype == np.float32 and view.image.shape == (scenes.HEIGHT, scenes.WIDTH, 3)
        right = (slice(None), slice(scenes.WIDTH // 2, None))  # Blender's left halves are transparent
        np.testing.assert_allclose(view.image[right], scenes.image(i)[right] / 255, atol=1e-6)


@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_images_over_the_longest_side_are_reduced_and_that_is_said(kind, tmp_path, monkeypatch):
    """Without a factor the default bound holds, with one or with 0 none does."""
    monkeypatch.setattr("warpgs.io.images.DEFAULT_MAX_SIDE", 8)
    scenes.WRITERS[kind](tmp_path)
    reduced, whole = load_scene(tmp_path), load_scene(tmp_path, max_side=0)
    assert {(v.camera.width, v.camera.height) for v in reduced.views} == {(8, 6)} and "at most 8 px a side" in reduced.pixels
    assert any("reduced to 8 px on the longer side" in n for n in reduced.notes)
    for a, b in zip(reduced.views, whole.views, strict=True):
        np.testing.assert_allclose(a.camera.K[:2] * (b.camera.width / 8), b.camera.K[:2])
    assert whole.views[0].camera.width == load_scene(tmp_path, downscale=1).views[0].camera.width == 16
    assert not any("reduced" in n for n in whole.notes)


@pytest.mark.parametrize("kind", scenes.WRITERS)
@pytest.mark.parametrize("downscale", [2, 3])
def test_downscaling_keeps_the_point_at_the_same_part_of_the_image(kind, downscale, tmp_path):
    scene = load_scene(scenes.WRITERS[kind](tmp_path), downscale=downscale)
    point = scenes.POINT if kind != "dtu" else (np.linalg.inv(scenes.SCALE_MAT) @ [*scenes.POINT, 1])[:3]
    for i, j in enumerate(by_index(scene)):
        camera = scene.views[j].camera
        assert (camera.width, camera.height) == (round(16 / downscale), round(12 / downscale))
        expected = scenes.pixel(i) * [camera.width / 16, camera.height / 12]
        np.testing.assert_allclose(landing(scene, j, point), expected, atol=1e-8)
    assert any(f"by {downscale}" in n for n in scene.notes)


@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_scene_is_centred_and_of_unit_size(kind, tmp_path):
    scene = load_scene(scenes.WRITERS[kind](tmp_path))
    centers = np.array([v.camera.center for v in scene.views])
    np.testing.assert_allclose(centers.mean(0), 0, atol=1e-12)
    assert np.linalg.norm(centers, axis=1).max() == pytest.approx(1 / 1.1)
    assert scene.views[0].camera.viewmat.dtype == np.float64


@pytest.mark.parametrize("kind", ["colmap", "colmap text"])
def test_colmap_points_colors_and_tracks(kind, tmp_path):
    scene = load_scene(scenes.WRITERS[kind](tmp_path))
    n = scene.normalization
    np.testing.assert_allclose(scene.points.points / n.scale + n.offset, scenes.POINTS, atol=1e-12)
    np.testing.assert_allclose(scene.points.colors, np.tile([1, 0, 0.2], (3, 1)), atol=1e-6)
    assert scene.points.tracks == tuple(frozenset(scenes.NAMES[i] for i in t) for t in scenes.TRACKS)
    assert len(scene.points.seen_by({"photo3.png"})) == 1


def test_blender_is_put_over_white_and_split_by_folder(tmp_path):
    scene = load_scene(scenes.write_blender(tmp_path))
    assert scene.background == (1.0, 1.0, 1.0)
    assert [v.name for v in scene.views] == ["test/r_4.png", *(f"train/r_{i}.png" for i in range(3)), "val/r_3.png"]
    assert all(v.mask is None and (v.image[:, :8] == 1).all() for v in scene.views)
    assert all((v.alpha[:, :8] == 0).all() and (v.alpha[:, 8:] == 1).all() for v in scene.views)
    assert "5 images transparent in part, by the alpha channel" in scene.notes


def test_dtu_masks_match_by_number_and_can_be_inverted(tmp_path):
    scenes.write_dtu(tmp_path)
    mask = np.zeros((12, 16), np.uint8)
    mask[:, 4:] = 255
    for i in range(5):
        scenes.save(tmp_path / "mask" / f"{i:03d}.png", mask)
    assert all((v.mask == (mask > 0)).all() for v in load_scene(tmp_path).views)
    assert all((v.mask == (mask == 0)).all() for v in load_scene(tmp_path, mask_keeps="black").views)


def test_transforms_per_frame_intrinsics_and_mask_path(tmp_path):
    content = scenes.transforms_json()
    content["frames"][2] |= {"fl_x": 25.0, "cx": 7.0, "mask_path": "m/two.png"}
    scenes.save(tmp_path / "m" / "two.png", np.tile(np.array([0, 255], np.uint8).repeat(8), (12, 1)))
    scene = load_scene(scenes.write_transforms(tmp_path, content))
    assert scene.views[2].camera.K[0, 0] == 25 and scene.views[2].camera.K[0, 2] == 7
    assert scene.views[1].camera.K[0, 0] == 20 and scene.views[1].mask is None
    assert not scene.views[2].mask[:, :8].any() and scene.views[2].mask[:, 8:].all()


def test_transforms_skip_frames_without_a_file(tmp_path):
    scenes.write_transforms(tmp_path)
    (tmp_path / "images" / "photo3.png").unlink()
    scene = load_scene(tmp_path)
    assert len(scene.views) == 4 and any("1 of 5 frames" in n and "photo3.png" in n for n in scene.notes)
    with pytest.raises(DataError, match=r"1 of 5 frames.*photo3.png.*--strict"):
        load_scene(tmp_path, strict=True)


def test_ply_points_of_nerfstudio_are_left_with_a_note(tmp_path):
    scene = load_scene(scenes.write_transforms(tmp_path, scenes.transforms_json(ply_file_path="sparse_pc.ply")))
    assert scene.points is None and any("sparse_pc.ply" in n for n in scene.notes)


def test_fingerprint_follows_the_data(tmp_path):
    first = load_scene(scenes.write_colmap(tmp_path / "a")).fingerprint
    assert len(first) == 64 and first == load_scene(scenes.write_colmap(tmp_path / "b")).fingerprint
    image = scenes.image(1)
    image[0, 0, 0] ^= 1
    scenes.save(tmp_path / "b" / "images" / "photo1.png", image)
    assert load_scene(tmp_path / "b").fingerprint != first
    assert load_scene(tmp_path / "a", downscale=2).fingerprint != first


def test_ready_made_small_images_are_taken(tmp_path):
    scenes.write_colmap(tmp_path)
    scenes.save_images(tmp_path / "images_2", width=8, height=6)
    scenes.save(tmp_path / "images_2" / "photo0.png", np.full((6, 8, 3), 7, np.uint8))
    scene = load_scene(tmp_path, downscale=2)
    assert (scene.views[0].image == np.float32(7 / 255)).all() and "images taken from images_2" in scene.notes
    assert scene.views[0].camera.K[0, 0] == 10


@pytest.mark.parametrize("other", ["{stem}.jpg", "image{i:03d}.png"])
def test_small_images_of_other_names_are_matched(other, tmp_path):
    scenes.write_colmap(tmp_path)
    names = [other.format(stem=n[:-4], i=i) for i, n in enumerate(scenes.NAMES)]
    scenes.save_images(tmp_path / "images_2", names, 8, 6)
    scene = load_scene(tmp_path, downscale=2)
    assert [v.name for v in scene.views] == list(scenes.NAMES) and any("matched" in n for n in scene.notes)
    blues = [float(v.image[..., 2].mean()) for v in scene.views]
    np.testing.assert_allclose(np.diff(blues), 0.2, atol=0.08)  # JPEG is not exact


@pytest.mark.parametrize("downscale,size,note", [(1, (8, 6), "images_2"), (2, (8, 6), "images_2"), (4, None, "--downscale")])
def test_llff_with_only_small_images(downscale, size, note, tmp_path):
    scenes.write_llff(tmp_path)
    (tmp_path / "images").rename(tmp_path / "gone")
    scenes.save_images(tmp_path / "images_2", width=8, height=6)
    if size is None:  # 2 x 2 px would be left
        with pytest.raises(UsageError, match=note):
            load_scene(tmp_path, downscale=downscale)
        return
    scene = load_scene(tmp_path, downscale=downscale)
    assert (scene.views[0].camera.width, scene.views[0].camera.height) == size
    assert scene.views[0].camera.K[0, 0] == 10 and any(note in n for n in scene.notes)


def test_llff_small_images_are_resampled_further(tmp_path):
    rows = scenes.llff_rows()
    rows[:, [4, 9, 14]] *= 4  # made for 64 x 48
    np.save(tmp_path / "poses_bounds.npy", rows)
    scenes.save_images(tmp_path / "images_4")
    scene = load_scene(tmp_path, downscale=2)
    assert scene.views[0].camera.width == 8 and scene.views[0].camera.K[0, 0] == 10
    assert any("images_4, area-resampled by 2" in n for n in scene.notes)


@pytest.mark.parametrize("names", [[f"größe {i} 写真.png" for i in range(5)], [f"{i}/same.png" for i in range(5)]])
@pytest.mark.parametrize("write", [scenes.write_colmap, scenes.write_colmap_txt, scenes.write_transforms])
def test_unicode_spaces_and_subfolders_in_names(names, write, tmp_path):
    scene = load_scene(write(tmp_path, names=names))
    prefix = "images/" if write is scenes.write_transforms else ""
    assert [v.name for v in scene.views] == [prefix + n for n in names]
    assert split_views(scene, f"train={names[0]},{names[1]};test={names[2]}").test == (prefix + names[2],)


@pytest.mark.parametrize("kind", ["colmap text", "middlebury", "transforms"])
def test_windows_line_ends_and_byte_order_mark(kind, tmp_path):
    plain = load_scene(scenes.WRITERS[kind](tmp_path)).fingerprint
    for path in [*tmp_path.rglob("*.txt"), *tmp_path.rglob("*.json")]:
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert load_scene(tmp_path).fingerprint == plain


def test_rigs_and_frames_are_ignored(tmp_path):
    scenes.write_colmap(tmp_path)
    for name in ("rigs.bin", "frames.bin"):
        (tmp_path / "sparse" / "0" / name).write_bytes(b"\xff" * 9)
    assert len(load_scene(tmp_path).views) == 5


def test_images_without_a_pose_are_counted(tmp_path):
    scenes.write_colmap(tmp_path)
    scenes.save(tmp_path / "images" / "extra.png", scenes.image(0))
    scenes.save(tmp_path / "images" / "._photo0.png", scenes.image(0))
    assert any(n.startswith("1 files in images have no pose") for n in load_scene(tmp_path).notes)


def test_outside_images_need_permission_and_get_harmless_names(tmp_path):
    content = scenes.transforms_json()
    content["frames"][0]["file_path"] = "../elsewhere.png"
    root = scenes.write_transforms(tmp_path / "scene", content)
    scenes.save(tmp_path / "elsewhere.png", scenes.image(0))
    with pytest.raises(DataError, match=r"frame 0: '../elsewhere.png' points outside the scene folder.*--allow-outside"):
        load_scene(root)
    scene = load_scene(root, allow_outside=True)
    assert any(v.name.startswith("outside/") and v.name.endswith("elsewhere.png") for v in scene.views)
    assert any("1 images are outside" in n for n in scene.notes)
