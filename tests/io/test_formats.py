"""Formats of scenes: the same cameras, lenses and images whatever the format; objects on black."""

import json
import threading
from pathlib import PurePosixPath

import numpy as np
import pytest

from tests.gaussians import opencv_pixels
from tests.io import scenes
from tests.io.scenes import refused
from warpgs import geometry
from warpgs.errors import DataError, UsageError
from warpgs.geometry import project_points
from warpgs.io.capture import COLUMNS, RealityScanReader
from warpgs.io.load import load_scene, split_views
from warpgs.io.transforms import read_cameras
from warpgs.pipeline.metrics.scores import counted_region
from warpgs.poses.find import needs_poses
from warpgs.scene import base_coefficients

# The same cameras and images give the same scene, whatever the format.


def landing(scene, i, point=scenes.POINT):
    """Return the position in the i-th view [px] of a point in file coordinates, by all that the scene holds."""
    n = scene.normalization
    return project_points(scene.views[i].camera, n.scale * (point - n.offset)[None])[0][0]


@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_every_format_gives_the_same_scene(kind, tmp_path, monkeypatch):
    """A point lands on the same pixel at every scale; pixels are RGB; the scene is of unit size; a longest side holds."""
    scenes.WRITERS[kind](tmp_path)
    point = scenes.POINT if kind != "dtu" else (np.linalg.inv(scenes.SCALE_MAT) @ [*scenes.POINT, 1])[:3]
    for downscale in (1, 2, 3):
        scene = load_scene(tmp_path, downscale=downscale)
        centers = np.array([v.camera.center for v in scene.views])
        assert len(scene.views) == scenes.VIEWS and scene.views[0].camera.viewmat.dtype == np.float64
        np.testing.assert_allclose(centers.mean(0), 0, atol=1e-12)
        assert np.linalg.norm(centers, axis=1).max() == pytest.approx(1 / 1.1)
        assert downscale == 1 or any(f"by {downscale}" in n for n in scene.notes)
        order = sorted(
            range(len(scene.views)), key=lambda j: scene.views[j].name.rpartition("/")[2]
        )  # Blender's folders change it
        for i, j in enumerate(order):
            view, camera = scene.views[j], scene.views[j].camera
            assert (camera.width, camera.height) == (round(16 / downscale), round(12 / downscale))
            expected = scenes.pixel(i) * [camera.width / 16, camera.height / 12]
            np.testing.assert_allclose(landing(scene, j, point), expected, atol=1e-8)
            assert view.image.dtype == np.float32 and view.image.shape == (camera.height, camera.width, 3)
            if downscale == 1:
                right = (slice(None), slice(scenes.WIDTH // 2, None))  # Blender's left halves are transparent
                np.testing.assert_allclose(view.image[right], scenes.image(i)[right] / 255, atol=1e-6)
    monkeypatch.setattr("warpgs.io.images.DEFAULT_MAX_SIDE", 8)  # without a factor; with one, or with 0, none holds
    reduced, whole = load_scene(tmp_path), load_scene(tmp_path, max_side=0)
    assert {(v.camera.width, v.camera.height) for v in reduced.views} == {(8, 6)} and "at most 8 px a side" in reduced.pixels
    assert any("reduced to 8 px on the longer side" in n for n in reduced.notes)
    for a, b in zip(reduced.views, whole.views, strict=True):
        np.testing.assert_allclose(a.camera.K[:2] * (b.camera.width / 8), b.camera.K[:2])
    assert whole.views[0].camera.width == load_scene(tmp_path, downscale=1).views[0].camera.width == 16
    assert not any("reduced" in n for n in whole.notes)


@pytest.mark.parametrize("kind", ["colmap", "colmap text"])
def test_colmap_points_colors_and_tracks(kind, tmp_path):
    scene = load_scene(scenes.WRITERS[kind](tmp_path))
    n = scene.normalization
    np.testing.assert_allclose(scene.points.points / n.scale + n.offset, scenes.POINTS, atol=1e-12)
    np.testing.assert_allclose(scene.points.colors, np.tile([1, 0, 0.2], (3, 1)), atol=1e-6)
    assert scene.points.tracks == tuple(frozenset(scenes.NAMES[i] for i in t) for t in scenes.TRACKS)
    assert len(scene.points.seen_by({"photo3.png"})) == 1


def test_blender_is_put_over_white_and_dtu_masks_match_by_number(tmp_path):
    scene = load_scene(scenes.write_blender(tmp_path))
    assert scene.background == (1.0, 1.0, 1.0)
    assert [v.name for v in scene.views] == ["test/r_4.png", *(f"train/r_{i}.png" for i in range(3)), "val/r_3.png"]
    assert all(v.mask is None and (v.image[:, :8] == 1).all() for v in scene.views)
    assert all((v.alpha[:, :8] == 0).all() and (v.alpha[:, 8:] == 1).all() for v in scene.views)
    assert "5 images transparent in part, by the alpha channel" in scene.notes
    dtu = scenes.write_dtu(tmp_path / "dtu")
    mask = np.zeros((12, 16), np.uint8)
    mask[:, 4:] = 255
    for i in range(5):
        scenes.save(dtu / "mask" / f"{i:03d}.png", mask)
    assert all((v.mask == (mask > 0)).all() for v in load_scene(dtu).views)
    assert all((v.mask == (mask == 0)).all() for v in load_scene(dtu, mask_keeps="black").views)


def test_transforms_per_frame_intrinsics_and_mask_path(tmp_path):
    content = scenes.transforms_json()
    content["frames"][2] |= {"fl_x": 25.0, "cx": 7.0, "mask_path": "m/two.png"}
    content |= {"train_filenames": ["images/photo0.png"], "test_filenames": ["images/photo1.png"], "val_filenames": []}
    scenes.save(tmp_path / "m" / "two.png", np.tile(np.array([0, 255], np.uint8).repeat(8), (12, 1)))
    scene = load_scene(scenes.write_transforms(tmp_path, content | {"ply_file_path": "sparse_pc.ply"}))
    assert scene.points is None and any("sparse_pc.ply" in n for n in scene.notes)
    unused = "train_filenames and test_filenames of transforms.json choose no views; --split 'train=NAMES;test=NAMES' does"
    assert unused in scene.notes
    assert scene.views[2].camera.K[0, 0] == 25 and scene.views[2].camera.K[0, 2] == 7
    assert scene.views[1].camera.K[0, 0] == 20 and scene.views[1].mask is None
    assert not scene.views[2].mask[:, :8].any() and scene.views[2].mask[:, 8:].all()


@pytest.mark.parametrize("other", ["{stem}.png", "{stem}.jpg", "image{i:03d}.png"])
def test_ready_made_small_images_are_taken(other, tmp_path):
    scenes.write_colmap(tmp_path)
    names = [other.format(stem=n[:-4], i=i) for i, n in enumerate(scenes.NAMES)]
    scenes.save_images(tmp_path / "images_2", names, 8, 6)
    scene = load_scene(tmp_path, downscale=2)
    assert [v.name for v in scene.views] == list(scenes.NAMES)
    assert any("matched" in n for n in scene.notes) == (other != "{stem}.png")
    assert "images taken from images_2" in scene.notes
    assert scene.views[0].camera.K[0, 0] == 10
    assert scene.pixels == "images_2 as stored" and load_scene(tmp_path).pixels == "images as stored"
    assert load_scene(tmp_path, downscale=3).pixels == "images area-resampled by 3"
    blues = [float(v.image[..., 2].mean()) for v in scene.views]
    np.testing.assert_allclose(np.diff(blues), 0.2, atol=0.08)  # JPEG is not exact
    scenes.save(tmp_path / "images_2" / names[0], np.full((6, 8, 3), 7, np.uint8))
    assert (load_scene(tmp_path, downscale=2).views[0].image == np.float32(7 / 255)).all()


def test_llff_with_only_small_images(tmp_path):
    scenes.write_llff(tmp_path)
    (tmp_path / "images").rename(tmp_path / "gone")
    scenes.save_images(tmp_path / "images_2", width=8, height=6)
    for downscale in (1, 2):
        scene = load_scene(tmp_path, downscale=downscale)
        assert (scene.views[0].camera.width, scene.views[0].camera.height) == (8, 6)
        assert scene.views[0].camera.K[0, 0] == 10 and any("images_2" in n for n in scene.notes)
    with pytest.raises(UsageError, match="--downscale"):  # 2 x 2 px would be left
        load_scene(tmp_path, downscale=4)
    rows = scenes.llff_rows()
    rows[:, [4, 9, 14]] *= 4  # made for 64 x 48
    np.save(tmp_path / "poses_bounds.npy", rows)
    (tmp_path / "gone").rename(tmp_path / "images_4")
    (tmp_path / "images_2").rename(tmp_path / "elsewhere")
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


def test_other_files_of_a_reconstruction(tmp_path):
    scenes.write_colmap(tmp_path)
    for name in ("rigs.bin", "frames.bin"):
        (tmp_path / "sparse" / "0" / name).write_bytes(b"\xff" * 9)
    for name in ("extra.png", "._photo0.png"):
        scenes.save(tmp_path / "images" / name, scenes.image(0))
    scene = load_scene(tmp_path)
    assert len(scene.views) == 5 and any(n.startswith("1 files in images have no pose") for n in scene.notes)
    # the fingerprint follows the data
    first = load_scene(scenes.write_colmap(tmp_path / "a")).fingerprint
    assert len(first) == 64 and first == load_scene(scenes.write_colmap(tmp_path / "b")).fingerprint
    image = scenes.image(1)
    image[0, 0, 0] ^= 1
    scenes.save(tmp_path / "b" / "images" / "photo1.png", image)
    assert load_scene(tmp_path / "b").fingerprint != first
    assert load_scene(tmp_path / "a", downscale=2).fingerprint != first
    # images outside need permission, and get harmless names
    content = scenes.transforms_json()
    content["frames"][0]["file_path"] = "../elsewhere.png"
    root = scenes.write_transforms(tmp_path / "scene", content)
    scenes.save(tmp_path / "elsewhere.png", scenes.image(0))
    refused(root, r"frame 0: '../elsewhere.png' points outside the scene folder.*--allow-outside")
    scene = load_scene(root, allow_outside=True)
    assert any(v.name.startswith("outside/") and v.name.endswith("elsewhere.png") for v in scene.views)
    assert any("1 images are outside" in n for n in scene.notes)


# COLMAP folders of other tools: the same scene as in sparse/0 and images, with a note on the choice.

PLACES = {
    "sparse/1": ("sparse/1", "images"), "undistorted": ("dense/0/sparse", "dense/0/images"),
    "dense": ("dense/sparse", "dense/images"), "nerfstudio": ("colmap/sparse/0", "images"), "flat": (".", "."),
    "flat model": ("colmap", "colmap"), "input": ("sparse/0", "input"), "reduced": ("dense/0/sparse", "dense/0/images_2"),
    "root": (".", "images"),
}  # fmt: skip


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("files", [scenes.colmap_bin, scenes.colmap_txt])
def test_reconstructions_at_other_places_are_read(place, files, tmp_path):
    model, images = PLACES[place]
    plain = load_scene(scenes.write_colmap(tmp_path / "plain"))
    root = tmp_path / "scene"
    scenes.write_files(root / model, files())
    scenes.save_images(root / images)
    scene = load_scene(root)
    assert not needs_poses(root) and scene.format == "colmap" and scene.fingerprint == plain.fingerprint
    np.testing.assert_allclose(scene.points.points, plain.points.points)
    assert scene.points.tracks == plain.points.tracks
    base = images.removesuffix("_2")
    assert (f"cameras taken from {model}, images from {base}" in scene.notes) == (place != "root")
    assert "left out" not in str(scene.notes)
    if place in ("flat", "root", "input"):
        return
    scenes.write_transforms(root)  # a scene of nerfstudio holds COLMAP's files, too
    assert load_scene(root).format == "transforms" and load_scene(root, reader="colmap").format == "colmap"


def test_the_largest_sub_model_is_taken(tmp_path):
    """Or the one that the user names, anywhere in the scene; another format has none."""
    scenes.write_colmap(tmp_path)
    two = scenes.NAMES[:2]
    for folder, names in (("sparse/0", two), ("sparse/1", scenes.NAMES), ("sparse/10", scenes.NAMES[:3]), ("own/model", two)):
        scenes.write_files(tmp_path / folder, scenes.colmap_bin(names=names))
    scene = load_scene(tmp_path)
    note = "sparse/1 is the largest reconstruction (images in sparse/0: 2, sparse/1: 5, sparse/10: 3); --reconstruction"
    assert len(scene.views) == 5 and scene.notes[0].startswith(note)
    for folder, count in (("sparse/0", 2), ("sparse/10", 3), ("own/model", 2)):
        scene = load_scene(tmp_path, reconstruction=folder)
        assert len(scene.views) == count and scene.notes[0] == f"cameras taken from {folder} (--reconstruction)"
    (tmp_path / "sparse" / "1" / "images.bin").write_bytes(b"broken")
    assert len(load_scene(tmp_path).views) == 3
    refused(tmp_path, "sparse/7: holds no COLMAP reconstruction; give its folder in the scene", reconstruction="sparse/7")
    scenes.write_colmap(tmp_path.parent / "other")
    refused(tmp_path, "a link points outside|outside the scene", reconstruction="../other/sparse/0")
    with pytest.raises(UsageError, match="--reconstruction requires a COLMAP scene"):
        load_scene(tmp_path, reader="llff", reconstruction="sparse/0")


NAMED = {
    "project root": ("images/{}.png", "{}.png", "images/{}.png"), "windows": (r"a\{}.png", "a/{}.png", r"a\{}.png"),
    "windows absolute": (r"C:\me\{}.png", "a/{}.png", "a/{}.png"), "absolute": ("/home/me/{}.JPG", "{}.png", "{}.png"),
    "suffix": ("{}.JPG", "{}.png", "{}.JPG"), "case": ("A/{}.png", "a/{}.PNG", "A/{}.png"),
    "unicode": ("fo\u0308n{}.png", "f\u00f6n{}.png", "fo\u0308n{}.png"), "dots": ("./{}.jpg", "{}.png", "{}.jpg"),
}  # fmt: skip


@pytest.mark.parametrize("kind", NAMED)
def test_names_are_matched_to_the_only_file_that_fits(kind, tmp_path):
    written, stored, shown = NAMED[kind]
    scenes.write_files(tmp_path / "sparse" / "0", scenes.colmap_bin(names=[written.format(i) for i in range(5)]))
    scenes.save_images(tmp_path / "images", [stored.format(i) for i in range(5)])
    scene = load_scene(tmp_path)
    assert [v.name for v in scene.views] == [shown.format(i) for i in range(5)]
    for i, view in enumerate(scene.views):
        np.testing.assert_array_equal(view.image, (scenes.image(i) / 255).astype(np.float32))
    assert any("matched by their names" in n for n in scene.notes) == (kind != "windows")
    if kind.endswith("absolute"):
        (tmp_path / "images" / stored.format(1)).unlink()
        scene = load_scene(tmp_path)
        assert len(scene.views) == 4 and any(n.startswith("skipped: 1 of 5 images have no image file") for n in scene.notes)
    if kind == "project root":  # of reduced images, those are read
        scenes.save_images(tmp_path / "images_2", [f"{i}.png" for i in range(4)], 8, 6)
        scenes.save(tmp_path / "images_2" / "0.png", np.full((6, 8, 3), 7, np.uint8))
        assert (load_scene(tmp_path, downscale=2).views[0].image == np.float32(7 / 255)).all()
    if kind in ("suffix", "case"):
        scenes.save(tmp_path / "images" / stored.format(1).replace("png", "bmp").replace("PNG", "bmp"), scenes.image(4))
        assert [v.name for v in load_scene(tmp_path).views] == [shown.format(i) for i in (0, 2, 3, 4)]
        names = [f"{i}.{end}" for i, end in ((0, "jpg"), (0, "tif"), (1, "jpg"), (2, "bmp"), (3, "bmp"))]
        scenes.write_files(tmp_path / "sparse" / "0", scenes.colmap_bin(names=names))
        for i in range(4):
            scenes.save(tmp_path / "images" / f"{i}.png", scenes.image(i))
        assert "0.jpg, 0.tif" in str([n for n in load_scene(tmp_path).notes if n.startswith("skipped")])


FRAMES = {
    "suffix": "images/{}.jpg", "case": "Images/{}.PNG", "absolute": "/home/me/images/{}.png", "other folder": "/home/me/{}.PNG",
    "windows": r"C:\me\scan\images\{}.png", "outside": r"./..\data\scan\images/{}.png", "no suffix": "/home/me/images/{}",
}  # fmt: skip


@pytest.mark.parametrize("kind", FRAMES)
def test_names_of_frames_are_matched_to_the_only_file_that_fits(kind, tmp_path):
    plain = load_scene(scenes.write_transforms(tmp_path))
    stems = [PurePosixPath(name).stem for name in scenes.NAMES]
    content = scenes.transforms_json()

    def named(*names: str) -> list[str]:
        for frame, name in zip(content["frames"], names):
            frame["file_path"] = name
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        return [v.name for v in load_scene(tmp_path).views]

    names = [FRAMES[kind].format(stem) for stem in stems]
    scenes.save_images(tmp_path / "images_2", scenes.NAMES, 8, 6)
    assert named(*names) == [v.name for v in plain.views]
    scene = load_scene(tmp_path)
    assert scene.fingerprint == plain.fingerprint
    assert scene.notes[0].startswith("5 images of transforms.json matched by their names")
    assert scene.notes[0].endswith(f"({names[0]} is images/photo0.png)")
    scenes.save(tmp_path / "images" / "photo1.bmp", scenes.image(4))
    left = [v.name for v in plain.views if kind not in ("suffix", "case", "other folder") or "photo1" not in v.name]
    assert named(*names) == left
    (tmp_path / "images" / "photo1.bmp").unlink()
    if kind == "absolute":
        (tmp_path / "images" / "photo1.png").unlink()
        assert named(*names) == [v.name for v in plain.views if "photo1" not in v.name]
        assert f"skipped: 1 of 5 frames have no image file: {names[1]}" in load_scene(tmp_path).notes
    if kind == "other folder":  # of two photographs of one name, one is there: the other must not take a third
        scenes.save(tmp_path / "a" / "photo3.png", scenes.image(3))
        left = ["a/photo3.png", *(v.name for v in plain.views if v.name[-5] in "024")]
        assert named(names[0], "/home/me/a/photo3.png", names[2], "/home/me/b/photo3.png", names[4]) == left
    if kind == "suffix":
        assert named("images/photo0.tif", *names[:1], *names[2:]) == [v.name for v in plain.views][2:]


@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_photographs_are_left_out_by_name_before_they_are_decoded(kind, tmp_path):
    root, lines = scenes.WRITERS[kind](tmp_path), []
    scene = load_scene(root, progress=lambda line: lines.append((threading.get_ident(), line)))
    assert lines == [(threading.get_ident(), f"reading {root}: image {i + 1}") for i in range(5)]
    name = scene.views[1].name
    bad = next(p for p in root.rglob("*.png") if p.as_posix().endswith(name))
    bad.write_bytes(bad.read_bytes()[:60])
    refused(root, rf"{bad.name}: the image cannot be decoded: .*Restore it")
    for pattern in (name, PurePosixPath(name).stem, f"*{PurePosixPath(name).stem[-1]}.png", f"{name} , {scene.views[2].name}"):
        left = load_scene(root, exclude=pattern, strict=True)
        gone = {name, scene.views[2].name} if "," in pattern else {name}
        assert [v.name for v in left.views] == [v.name for v in scene.views if v.name not in gone]
        assert any(n.startswith(f"left out by --exclude: {len(gone)} image") and name in n for n in left.notes)
    first = scene.views[0].name
    refused(root, f"--exclude x{first}: no view has this name; did you mean {first}", exclude=f"x{first},{name}")


@pytest.mark.parametrize("kind", ["colmap", "colmap text", "transforms"])
def test_missing_photographs_are_skipped_and_all_named(kind, tmp_path):
    root = scenes.WRITERS[kind](tmp_path)
    for i in (1, 3):
        (root / "images" / scenes.NAMES[i]).unlink()
    scene = load_scene(root)
    assert [v.name.removeprefix("images/") for v in scene.views] == [scenes.NAMES[i] for i in (0, 2, 4)]
    prefix = "images/" if kind == "transforms" else ""
    assert any(n.startswith("skipped: 2 of 5") and n.endswith(f": {prefix}photo1.png, {prefix}photo3.png") for n in scene.notes)
    if kind != "transforms":
        assert set().union(*scene.points.tracks) == {v.name for v in scene.views}
    refused(root, "2 of 5 .* have no image file: .*photo1.png.*photo3.png. Restore.*--strict", strict=True)
    assert len(load_scene(root, strict=True, exclude="photo1, photo3.png").views) == 3


@pytest.mark.parametrize(
    "more", [*({"camera_model": m} for m in ("opencv", "PERSPECTIVE", "FULL_OPENCV")), {"sharpness": np.nan}]
)
def test_frames_of_other_programs_that_mean_the_same(more, tmp_path):
    """Names of lenses that say nothing more, and a NaN that no scene needs."""
    plain = load_scene(scenes.write_transforms(tmp_path / "a")).fingerprint
    assert load_scene(scenes.write_transforms(tmp_path / "b", scenes.transforms_json(**more))).fingerprint == plain


# Points of PLY files.

CLOUD = np.random.default_rng(0).uniform(-0.8, 0.8, (60, 3))


def cloud_colors() -> np.ndarray:
    seen = [np.floor([scenes.pixel(i, p) for p in CLOUD]).astype(int).clip(0, (15, 11)) for i in range(5)]
    return np.round(np.mean([scenes.image(i)[at[:, 1], at[:, 0]] for i, at in enumerate(seen)], axis=0))


def ply(points: np.ndarray, colors: np.ndarray | None = None, form: str = "ascii", kind: str = "uchar") -> bytes:
    """Return a PLY file of points with colours of a type, a comment, a further property and a further element."""
    types = {"uchar": "u1", "float": "f4", "double": "f8"}
    names = {"x": "double", "y": "double", "z": "double", "quality": "float"}
    names |= {} if colors is None else dict.fromkeys(("red", "green", "blue"), kind)
    columns = [*points.T, np.zeros(len(points)), *([] if colors is None else colors.T)]
    head = ["ply", f"format {form} 1.0", "comment made up", f"element vertex {len(points)}"]
    head += [f"property {t} {n}" for n, t in names.items()] + ["element face 0", "property list uchar int vertex_indices"]
    if form == "ascii":
        rows = zip(*[np.asarray(c).astype(types[t]).tolist() for c, t in zip(columns, names.values())])
        body = "".join(" ".join(map(repr, row)) + "\n" for row in rows).encode()
    else:
        order = "<" if "little" in form else ">"
        table = np.zeros(len(points), [(n, order + types[t]) for n, t in names.items()])
        for n, c in zip(names, columns):
            table[n] = c
        body = table.tobytes()
    return "\n".join([*head, "end_header\n"]).encode() + body


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["uchar", "float", "double", None])
def test_points_of_a_ply_file_are_read(form, kind, tmp_path):
    scenes.write_colmap(tmp_path)
    colors = cloud_colors()
    if kind == "double":  # fractions, too, if all are 0 or 1
        colors = 255.0 * (colors > 128)
    given = {"uchar": colors, "float": colors / 255, "double": colors / 255, None: None}[kind]
    (tmp_path / "sparse" / "0" / "points3D.bin").unlink()
    (tmp_path / "sparse" / "0" / "points3D.ply").write_bytes(ply(CLOUD, given, form, kind or "uchar"))
    scene = load_scene(tmp_path)
    points, n = scene.points, scene.normalization
    np.testing.assert_allclose(points.points / n.scale + n.offset, CLOUD, atol=1e-9)
    np.testing.assert_allclose(points.colors, 127 / 255 if kind is None else colors / 255, atol=1e-6)
    assert points.tracks is None and "points taken from points3D.ply, because points3D.bin is missing" in scene.notes
    assert ("they have no colours and start gray" in scene.notes) == (kind is None)


@pytest.mark.parametrize(
    "data,message",
    [
        (b"solid", "it does not start with 'ply'"),
        (ply(CLOUD)[:-9], "points3D.ply: the points cannot be understood"),
        (ply(CLOUD, form="binary_little_endian")[:-9], "points3D.ply: the points cannot be understood"),
        (ply(CLOUD).replace(b" z\n", b" w\n"), "vertices lack x, y or z"),
        (ply(CLOUD).replace(b"vertex 60", b"vertex 6000000000000"), "points cannot be understood"),
        (ply(CLOUD).replace(b"vertex 60", b"vertex -1"), "points cannot be understood"),
        (ply(CLOUD * np.nan), "60 of 60 points are not finite"),
        (ply(CLOUD).replace(b"element vertex", b"element other"), "first element is not vertex"),
        (b"ply\nformat ascii 1.0\nend_header\n", "first element is not vertex"),
        (ply(CLOUD).replace(b"format ascii", b"format other"), "points cannot be understood"),
        (ply(CLOUD).replace(b"double x", b"list uchar int x"), "points cannot be understood"),
        (ply(CLOUD).replace(b"quality", b"z"), "have one twice"),
    ],
)
def test_malformed_ply_files(data, message, tmp_path):
    scenes.write_colmap(tmp_path)
    (tmp_path / "sparse" / "0" / "points3D.bin").unlink()
    (tmp_path / "sparse" / "0" / "points3D.ply").write_bytes(data)
    refused(tmp_path, message)


@pytest.mark.parametrize("names", ["diffuse_red diffuse_green diffuse_blue", "f_dc_0 f_dc_1 f_dc_2", "label part segment"])
def test_colours_of_points_have_other_names(names, tmp_path):
    """Of MeshLab and of Gaussians, whose positions and colours may be where a fit starts; without colours there is a note."""
    colors = cloud_colors()
    data = ply(CLOUD, base_coefficients(colors / 255), kind="double") if "f_dc" in names else ply(CLOUD, colors)
    for old, new in zip(("red", "green", "blue"), names.split()):
        data = data.replace(f" {old}\n".encode(), f" {new}\n".encode())
    scenes.write_transforms(tmp_path, scenes.transforms_json(ply_file_path="pc.ply"))
    (tmp_path / "pc.ply").write_bytes(data)
    scene = load_scene(tmp_path)
    gray = "label" in names
    np.testing.assert_allclose(scene.points.colors, 127 / 255 if gray else colors / 255, atol=1e-6)
    assert f"points taken from pc.ply{'; they have no colours and start gray' if gray else ''}" in scene.notes


@pytest.mark.parametrize("stored", ["with the transform", "without it", "no transform"])
@pytest.mark.parametrize("scale", [None, 0.5])
def test_points_of_transforms_stand_where_the_images_show_them(stored, scale, tmp_path):
    """The poses contain applied_transform; the points do in files of today's nerfstudio, not in those of its first versions."""
    applied = np.array([[1.0, 0, 0, 0.2], [0, 0, 1, 0.1], [0, -1, 0, -0.3]])
    back = (CLOUD / (scale or 1.0) - applied[:, 3]) @ applied[:, :3]
    content = scenes.transforms_json(ply_file_path="pc.ply", applied_transform=applied.tolist(), applied_scale=scale)
    if stored == "no transform":
        content.pop("applied_transform")
    scenes.write_transforms(tmp_path, content)
    (tmp_path / "pc.ply").write_bytes(ply(back if stored == "without it" else CLOUD, cloud_colors()))
    scene = load_scene(tmp_path)
    n = scene.normalization
    np.testing.assert_allclose(scene.points.points / n.scale + n.offset, CLOUD, atol=1e-9)
    assert any(note.startswith("points taken from pc.ply") for note in scene.notes)
    for name, words in (("gone.ply", "gone.ply is missing"), ("../x.ply", "points outside the scene folder")):
        (tmp_path / "transforms.json").write_text(json.dumps(content | {"ply_file_path": name}))
        scene = load_scene(tmp_path)
        assert scene.points is None and any(words in note for note in scene.notes)


# Lenses without terms, and numbers as other tools write them.


@pytest.mark.parametrize("write", [scenes.write_colmap, scenes.write_colmap_txt])
def test_rational_lenses_without_rational_terms_are_undistorted(write, tmp_path):
    """A fisheye without terms is no pinhole: its image radius is f times the angle."""
    plain = load_scene(write(tmp_path / "a"))
    assert (
        load_scene(write(tmp_path / "b", model="FULL_OPENCV", parameters=(*scenes.PINHOLE, *[0] * 8))).fingerprint
        == plain.fingerprint
    )
    four = (0.1, -0.02, 0.01, 0.02)
    opencv = load_scene(write(tmp_path / "c", model="OPENCV", parameters=(*scenes.PINHOLE, *four)))
    full = load_scene(write(tmp_path / "d", model="FULL_OPENCV", parameters=(*scenes.PINHOLE, *four, *[0] * 4)))
    assert full.fingerprint == opencv.fingerprint
    third = load_scene(write(tmp_path / "e", model="FULL_OPENCV", parameters=(*scenes.PINHOLE, *four, 0.3, *[0] * 3)))
    assert third.fingerprint != opencv.fingerprint and "5 images undistorted (FULL_OPENCV)" in third.notes
    refused(
        write(tmp_path / "f", model="FULL_OPENCV", parameters=(*scenes.PINHOLE, *[0] * 7, 0.1)),
        "FULL_OPENCV is not supported.*or fit with --lenses native",
    )
    for model, count in (("OPENCV_FISHEYE", 8), ("FOV", 5), ("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16)):
        refused(
            write(tmp_path / "g", model=model, parameters=(*scenes.PINHOLE, *[0] * (count - 4))), f"camera model {model} is not"
        )


def test_numbers_of_text_files_may_be_written_as_fractions(tmp_path):
    plain = load_scene(scenes.write_colmap_txt(tmp_path))
    for file, old, new in (("cameras", "16 12", "16.0 12.0"), ("points3D", "255 0 51", "255.0 0.0 51.0"),
                           ("points3D", "255.0 0.0 51.0", "1.0 0.0 0.2")):  # fmt: skip
        path = tmp_path / "sparse" / f"{file}.txt"
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))
        scene = load_scene(tmp_path)
        assert scene.fingerprint == plain.fingerprint
        np.testing.assert_allclose(scene.points.colors, plain.points.colors, atol=1e-7)
    path = tmp_path / "sparse" / "cameras.txt"
    path.write_text(path.read_text().replace("16.0 12.0", "16.5 12.0"))
    refused(tmp_path, r"cameras.txt, line 2: .*16.5 x 12 px is not whole")


# Lenses that are kept: the same point lands on the same pixel through the camera as through the lens of the file.

F, CX, CY = scenes.FOCAL, scenes.WIDTH / 2, scenes.HEIGHT / 2
EIGHT = (0.1, -0.02, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06)
COLMAP = {
    "SIMPLE_PINHOLE": ((F, CX, CY), "pinhole", ()),
    "PINHOLE": ((F, F, CX, CY), "pinhole", ()),
    "SIMPLE_RADIAL": ((F, CX, CY, 0.1), "opencv", (0.1,)),
    "RADIAL": ((F, CX, CY, 0.1, -0.02), "opencv", (0.1, -0.02)),
    "OPENCV": ((F, F, CX, CY, 0.1, -0.02, 0.01, 0.02), "opencv", (0.1, -0.02, 0.01, 0.02)),
    "FULL_OPENCV": ((F, F, CX, CY, *EIGHT), "opencv", EIGHT),
    "OPENCV_FISHEYE": ((F, F, CX, CY, 0.1, -0.02, 0.01, 0.02), "fisheye", (0.1, -0.02, 0.01, 0.02)),
    "SIMPLE_RADIAL_FISHEYE": ((F, CX, CY, 0.1), "fisheye", (0.1,)),
    "RADIAL_FISHEYE": ((F, CX, CY, 0.1, -0.02), "fisheye", (0.1, -0.02)),
}  # fmt: skip
TRANSFORMS = {
    "pinhole": ({}, "pinhole", ()),
    "opencv": ({"k1": 0.1, "k2": -0.02, "p1": 0.01, "p2": 0.02, "k3": 0.03}, "opencv", (0.1, -0.02, 0.01, 0.02, 0.03)),
    "fisheye by its model": ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.02}, "fisheye", (0.1, 0, 0, 0.02)),
    "fisheye by its flag": ({"is_fisheye": True, "k1": 0.1, "k2": -0.02}, "fisheye", (0.1, -0.02)),
    "fisheye without coefficients": ({"camera_model": "OPENCV_FISHEYE"}, "fisheye", ()),
}


def lands(scene, model: str, terms: tuple[float, ...]) -> None:
    """Check camera, pixels and where a point lands."""
    for i, view in enumerate(scene.views):
        camera = view.camera
        assert camera.model == model and np.array_equal(view.image, (scenes.image(i) / 255).astype(np.float32))
        wanted = scenes.pixel(i)
        if model != "pinhole":
            padded = np.zeros(4 if model == "fisheye" else 8)
            padded[: len(terms)] = terms
            assert np.array_equal(camera.distortion, padded)
            in_camera = scenes.VIEWMATS[i, :3, :3] @ scenes.POINT + scenes.VIEWMATS[i, :3, 3]
            wanted = opencv_pixels(model, padded, scenes.K, in_camera[None])[0]
        np.testing.assert_allclose(landing(scene, i), wanted, atol=1e-8)


@pytest.mark.parametrize("name", COLMAP)
@pytest.mark.parametrize("write", [scenes.write_colmap, scenes.write_colmap_txt], ids=["bin", "txt"])
def test_colmap_lenses_are_kept(name, write, tmp_path):
    parameters, model, terms = COLMAP[name]
    scene = load_scene(write(tmp_path, model=name, parameters=parameters), lenses="native")
    lands(scene, model, terms)
    if len(parameters) > 3 and parameters[:2] == (F, F):  # both focal lengths are read
        write(tmp_path, model=name, parameters=(F, F + 1, *parameters[2:]))
        assert np.diag(load_scene(tmp_path, lenses="native").views[0].camera.K).tolist() == [F, F + 1, 1]
    notes = [n for n in scene.notes if "lens" in n]
    assert notes == ([] if model == "pinhole" else [f"5 images kept with the distortion of their lens ({name})"])


@pytest.mark.parametrize("name", TRANSFORMS)
def test_lenses_of_transforms_are_kept(name, tmp_path):
    values, model, terms = TRANSFORMS[name]
    content = scenes.transforms_json(fl_x=F, fl_y=F, cx=CX, cy=CY, **values)
    lands(load_scene(scenes.write_transforms(tmp_path, content), lenses="native"), model, terms)


def test_what_a_lens_does_not_reach_leaves_the_mask(tmp_path):
    """A fisheye of a short focal length folds at 85 degrees: its corners are dark, and do not count; half the size agrees."""
    parameters, rim = (5.0, 5.0, CX, CY, -0.15, 0, 0, 0), np.sqrt(1 / 0.45)
    scene = load_scene(scenes.write_colmap(tmp_path, model="OPENCV_FISHEYE", parameters=parameters), lenses="native")
    x, y = np.meshgrid(np.arange(scenes.WIDTH) + 0.5 - CX, np.arange(scenes.HEIGHT) + 0.5 - CY)
    wanted = np.hypot(x, y) / 5 < rim - 0.15 * rim**3
    assert 0.2 < wanted.mean() < 0.9 and all(np.array_equal(v.mask, wanted) for v in scene.views)
    half = load_scene(tmp_path, lenses="native", downscale=2).views[0]
    assert half.camera.K[0, 0] == 2.5 and np.array_equal(half.camera.distortion, scene.views[0].camera.distortion)
    assert np.array_equal(half.mask, lenses_reach(half.camera))


def lenses_reach(camera) -> np.ndarray:
    """Return where the way back from the pixels of a camera ends."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    plane = (np.stack([x, y], -1) - camera.K[:2, 2]) / camera.K[0, 0]
    return np.isfinite(geometry.from_plane(camera.model, camera.distortion, plane)).all(-1)


@pytest.mark.parametrize(
    "lenses, values, message",
    [
        ("undistort", {"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE is not supported.*or fit them with --lenses native"),
        ("undistort", {"is_fisheye": True}, "is_fisheye is not supported here.*or fit them with --lenses native"),
        ("native", {"k4": 0.1}, "k4 is not supported here"),
        ("native", {"is_fisheye": True, "p1": 0.1}, "p1 is not supported here"),
        ("native", {"is_fisheye": True, "fisheye_crop_radius": 9}, "fisheye_crop_radius is not supported here"),
    ],
)
def test_errors_name_the_way_to_keep_a_lens(lenses, values, message, tmp_path):
    """Undistorting stays the default; terms that no model here has are refused either way."""
    scenes.write_transforms(tmp_path, scenes.transforms_json(fl_x=F, **values))
    refused(tmp_path, message, **({} if lenses == "undistort" else {"lenses": lenses}))
    with pytest.raises(UsageError, match="--lenses must be one of undistort, native, not 'both'"):
        load_scene(tmp_path, lenses="both")


# Objects on black: what around them is empty, and scenes that are left alone.


def ring(i):
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
    """A speck stays opaque; scores count the same region; one bright image, alpha channel or mask leaves all as they are."""
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
    note = "images show an object on black: 74.8% become transparent"
    assert any(n.startswith(note) and "--no-black-is-empty" in n for n in scene.notes)
    assert not any("object on black" in n for n in plain.notes) and scene.fingerprint != plain.fingerprint
    channel = np.full((36, 48, 1), 255, np.uint8)
    channel[0] = 9
    for name, image in (
        (scenes.NAMES[4], np.full((36, 48, 3), 90, np.uint8)),
        (scenes.NAMES[4], np.concatenate([ring(4), channel], axis=2)),
        ("masks/photo4.png", np.full((36, 48), 255, np.uint8)),
    ):
        write(tmp_path, [ring(i) for i in range(5)])
        scenes.save(tmp_path / name, image)
        scene = load_scene(tmp_path)
        assert all(v.alpha is None for v in scene.views[:4]) and not any("object on black" in n for n in scene.notes)


# Camera files of other programs.


def viewer_path(**changes) -> dict:
    """Return the cameras of the scenes as nerfstudio's viewer writes a path."""
    fov = 2 * np.degrees(np.arctan(scenes.HEIGHT / 2 / scenes.FOCAL))
    frames = [
        {"camera_to_world": np.ravel(scenes.opengl(i)).tolist(), "fov": fov, "aspect": 4 / 3} for i in range(scenes.VIEWS)
    ]
    sizes = {"render_width": scenes.WIDTH, "render_height": float(scenes.HEIGHT)}
    return sizes | {"keyframes": [], "camera_path": frames} | changes


def test_cameras_of_a_path_of_nerfstudio(tmp_path):
    """Their field of view is vertical, and in degrees."""
    path = tmp_path / "camera_path.json"
    path.write_text(json.dumps(viewer_path(camera_type="perspective", fps=24)))
    cameras, notes = read_cameras(path)
    assert list(cameras) == [f"{i:05d}" for i in range(scenes.VIEWS)] and not notes
    for camera, viewmat in zip(cameras.values(), scenes.VIEWMATS):
        np.testing.assert_allclose(camera.viewmat, viewmat, atol=1e-12)
        np.testing.assert_allclose(camera.K, scenes.K, atol=1e-12)
        assert (camera.width, camera.height) == (scenes.WIDTH, scenes.HEIGHT)


@pytest.mark.parametrize(
    "changes,message",
    [
        ({"camera_type": "equirectangular"}, "camera_type is equirectangular, but renders are pinholes"),
        ({"render_width": None}, "camera_path 0: needs camera_to_world, fov, render_width"),
        ({"camera_path": [{"camera_to_world": [1, 0], "fov": 50}]}, "camera_path 0: needs camera_to_world"),
        ({"camera_path": [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 0}]}, "camera_path 0: needs .* fov"),
        ({"camera_path": [{"camera_to_world": [2.0] * 16, "fov": 50}]}, "camera_path 0: the last row of the pose"),
        ({"camera_path": ["images"]}, "camera_path 0: needs camera_to_world"),
        ({"camera_path": []}, "holds no camera"),
    ],
)
def test_paths_of_nerfstudio_that_cannot_be_used(changes, message, tmp_path):
    path = tmp_path / "camera_path.json"
    path.write_text(json.dumps(viewer_path(**changes)))
    with pytest.raises(DataError, match=message):
        read_cameras(path)


# Programs for photogrammetry: Metashape and RealityScan.


def radial(x, y, k1, k2, k3=0.0, k4=0.0):
    r2 = x * x + y * y
    return 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4


def camera_points(i, points):
    return (scenes.VIEWMATS[i, :3, :3] @ points.T).T + scenes.VIEWMATS[i, :3, 3]


def metashape_pixels(points, f, cx, cy, b1=0.0, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0, k4=0.0, fisheye=False):
    """Project points of the camera [N, 3] to pixels [N, 2], as the user manual of Metashape defines it."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    if fisheye:
        r = np.hypot(x, y)
        x, y = x * np.arctan(r) / r, y * np.arctan(r) / r
    r2, d = x * x + y * y, radial(x, y, k1, k2, k3, k4)
    u = x * d + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    v = y * d + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    return np.stack([scenes.WIDTH / 2 + cx + (f + b1) * u, scenes.HEIGHT / 2 + cy + f * v], 1)


def realityscan_pixels(points, px, py, k1, k2, k3, t1, t2):
    """Project points of the camera [N, 3] to pixels [N, 2], as RealityScan does."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2, d = x * x + y * y, radial(x, y, k1, k2, k3)
    u, v = x * d + t1 * (r2 + 2 * x * x) + 2 * t2 * x * y, y * d + t2 * (r2 + 2 * y * y) + 2 * t1 * x * y
    side = scenes.WIDTH  # the longer one
    return np.stack([scenes.WIDTH / 2 + px * side + 20 * u, scenes.HEIGHT / 2 + py * side + 20 * v], 1)


def projected(root):
    scene = load_scene(root, lenses="native")
    n = scene.normalization
    return project_points(scene.views[0].camera, n.scale * (scenes.POINTS - n.offset))[0], scene


METASHAPE = {"cx": 0.3, "cy": -0.2, "k1": 0.08, "k2": -0.03}


@pytest.mark.parametrize(
    "kind,terms",
    [
        ("frame", METASHAPE | {"b1": 0.7, "k3": 0.01, "p1": 0.02, "p2": -0.01}),
        ("fisheye", METASHAPE | {"k3": 0.01, "k4": -0.02}),
    ],
)
def test_lenses_of_metashape(kind, terms, tmp_path):
    """Points land where the manual of the program puts them; names have no suffix, the last camera is not aligned."""
    xml = "".join(f"<{name}>{value}</{name}>" for name, value in terms.items()) + "<b2>0.001</b2><k5/>"
    off = '<camera id="9" sensor_id="0" label="photo9" enabled="false"><transform>1</transform></camera>'
    scenes.write_metashape(tmp_path, terms=xml, kind=kind, camera=f'<camera id="8" sensor_id="7" label="photo8"/>{off}')
    scenes.save_images(tmp_path / "images", ["photo8.png"])
    pixels, scene = projected(tmp_path)
    expected = metashape_pixels(camera_points(0, scenes.POINTS), 20, fisheye=kind == "fisheye", **terms)
    np.testing.assert_allclose(pixels, expected, atol=1e-7)
    assert np.abs(expected - metashape_pixels(camera_points(0, scenes.POINTS), 20, 0.3, -0.2)).max() > 1e-3
    assert scene.format == "metashape" and [v.name for v in scene.views] == list(scenes.NAMES)
    assert {"1 files in images have no pose in the reconstruction and are left out", "points taken from points.ply"} <= {
        *scene.notes
    }
    np.testing.assert_allclose(
        scene.points.points / scene.normalization.scale + scene.normalization.offset, scenes.POINTS, atol=1e-12
    )
    if kind == "fisheye":
        refused(tmp_path, "images of fisheye lenses cannot be undistorted; keep the lens with --lenses native")
    else:
        assert any("undistorted (frame)" in note for note in load_scene(tmp_path).notes)


@pytest.mark.parametrize("tall", [False, True])
def test_lenses_of_realityscan(tall, tmp_path):
    """Lengths are relative to the longer side; the angles give the rotation of the XMP file of the same export."""
    lens = (0.01, -0.02, 0.08, -0.03, 0.01, 0.02, -0.01)
    scenes.write_realityscan(tmp_path, lens="0.01,-0.02,0.08,-0.03,0.01,0,0.02,-0.01")
    pixels, scene = projected(tmp_path)
    np.testing.assert_allclose(pixels, realityscan_pixels(camera_points(0, scenes.POINTS), *lens), atol=1e-7)
    assert scene.format == "realityscan" and "points taken from calib.ply" in scene.notes
    if tall:
        scenes.save_images(tmp_path, width=scenes.HEIGHT, height=scenes.WIDTH)
    scenes.write_files(tmp_path, {"calib.csv": scenes.realityscan_csv("", scenes.RC_HEADER.partition(",px")[0]).encode()})
    K = load_scene(tmp_path).views[0].camera.K
    assert K[0, 0] == pytest.approx(20) and K[:2, 2].tolist() == ([6, 8] if tall else [8, 6])
    # forums.unrealengine.com/t/different-rotation-of-cameras-in-xmp-and-csv/710449
    row = "photo0.png,0,0,0,163.736597399311,83.4154313461628,174.386496244756,30"
    (tmp_path / "calib.csv").write_text(f"#name,{','.join(COLUMNS)}\n{row}\n")
    xmp = [[0.98259, 0.18543, -0.01122], [-0.03211, 0.11008, -0.99340], [-0.18297, 0.97647, 0.114]]
    np.testing.assert_allclose(RealityScanReader().rows(tmp_path / "calib.csv")[0][2][:3, :3], xmp, atol=2e-4)


def test_points_in_other_coordinates_and_missing_photographs_of_capture_programs(tmp_path):
    scenes.write_metashape(tmp_path)
    (tmp_path / "z.xml").write_text(scenes.metashape_xml())
    (tmp_path / "a.xml").write_text("<other/>")
    (tmp_path / "images" / "photo1.png").unlink()
    (tmp_path / "points.ply").write_bytes(scenes.points_ply(scenes.POINTS + 90))
    scene = load_scene(tmp_path)
    assert len(scene.views) == 4 and scene.points is None
    assert scene.notes[0] == "cameras taken from cameras.xml; z.xml ignored"
    assert "skipped: 1 of 5 images have no image file: photo1" in scene.notes
    assert any("the points of points.ply are left out, as few are in a view; export" in n for n in scene.notes)
    refused(tmp_path, "1 of 5 images have no image file: photo1. Restore them", strict=True)
    (tmp_path / "points.ply").unlink()
    assert any("no PLY file is beside cameras.xml" in n for n in load_scene(tmp_path).notes)


@pytest.mark.parametrize("folder", ["", "left"])
def test_labels_of_metashape_have_neither_suffix_nor_folder(folder, tmp_path):
    """What follows a dot in a label is no suffix; a photograph in a folder is found if no other one has its name."""
    scenes.write_metashape(tmp_path, labels=[f"a.{i:04}" for i in range(5)])
    (tmp_path / "images" / folder).mkdir(exist_ok=True)
    for i, name in enumerate(scenes.NAMES):
        (tmp_path / "images" / name).rename(tmp_path / "images" / folder / f"a.{i:04}.png")
    assert [v.name for v in load_scene(tmp_path).views] == [f"{folder}/a.{i:04}.png".lstrip("/") for i in range(5)]
    if folder:
        scenes.save_images(tmp_path / "images" / "right", ["a.0001.png"])
        assert len(load_scene(tmp_path).views) == 4


def test_columns_of_realityscan_may_be_named_without_a_mark(tmp_path):
    scenes.write_realityscan(tmp_path)
    (tmp_path / "calib.csv").write_text(scenes.realityscan_csv().replace("#name", "name").partition("\r\n")[2])
    assert len(load_scene(tmp_path).views) == 5
