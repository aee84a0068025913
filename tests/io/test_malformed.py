"""Broken scenes of every format end in a message that names the file, the reason and the remedy, never in a traceback."""

import json
import os
import shutil
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.io import scenes
from tests.io.scenes import refused
from warpgs.errors import DataError
from warpgs.io import colmap
from warpgs.io.load import detect, load_scene
from warpgs.io.transforms import TransformsReader, read_cameras
from warpgs.process import Detail

# ---- detection -------------------------------------------------------------------------------------------------------


def test_folders_that_hold_no_scene(tmp_path):
    """Of several complete formats the first is taken, with a note; alone, what a broken one lacks is named."""
    refused(tmp_path / "gone", "gone: no such folder; give a folder of photographs")
    (tmp_path / "photographs").mkdir()
    refused(tmp_path / "photogaphs", r"photogaphs: no such folder; did you mean photographs\?")
    refused(tmp_path, r"no scene format found. Looked for: sparse/0.*transforms.json.*poses_bounds.npy.*cameras.npz.*_par.txt")
    (tmp_path / "a.txt").write_text("")
    refused(tmp_path / "a.txt", "a.txt: is a file; give a folder")
    scenes.write_colmap(tmp_path)
    (tmp_path / "sparse" / "0" / "images.bin").unlink()
    refused(tmp_path, "the COLMAP reconstruction in sparse/0 lacks images.bin, and no other format was found. Copy")
    scenes.write_llff(tmp_path)
    scene = load_scene(tmp_path)
    assert scene.format == "llff"
    assert scene.notes[0] == "the COLMAP reconstruction in sparse/0 lacks images.bin; llff is complete and is used instead"
    scenes.write_colmap_txt(tmp_path)
    assert colmap.reconstruction(tmp_path)[0][0] == tmp_path / "sparse"
    reader, notes = detect(tmp_path)
    assert (reader.name, notes) == ("colmap", ["the folder also holds llff: colmap is used"])


@pytest.mark.parametrize("kind,lack", [("colmap", "images"), ("llff", "images"), ("dtu", "image")])
def test_scenes_without_images(kind, lack, tmp_path):
    scenes.WRITERS[kind](tmp_path)
    (tmp_path / lack).rename(tmp_path / "elsewhere")
    refused(tmp_path, rf"lacks its image folder, {lack}")
    (tmp_path / lack).mkdir()
    (tmp_path / lack / "photo0.exr").write_bytes(b"v/1\1")
    refused(tmp_path, r"missing, or without images \(JPEG, PNG, .*\); put|but .* holds 0 images")


# ---- COLMAP, binary --------------------------------------------------------------------------------------------------


def read_all(folder, kind):
    colmap.read_cameras(folder / f"cameras.{kind}")
    poses = colmap.read_poses(folder / f"images.{kind}")
    return colmap.read_points(folder / f"points3D.{kind}", {n: p[0] for n, p in poses.items()})


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_truncations_and_wrong_counts_are_noticed(name, tmp_path):
    """Counts that are too large are refused before a record is read; too small ones leave bytes over."""
    files = scenes.colmap_bin()
    scenes.write_files(tmp_path, files)
    for length in reversed(range(len(files[name]))):
        os.truncate(tmp_path / name, length)
        with pytest.raises(DataError, match=rf"{name}: .*(truncated|ends in the middle)"):
            read_all(tmp_path, "bin")
    (right,) = struct.unpack_from("<Q", files[name])
    for count, words in (
        *((c, rf"truncated: {c:,} records announced, at most") for c in (100, 2**40, 2**64 - 1)),
        (right - 1, r"\d+ bytes follow the last of its records. Copy"),
    ):
        scenes.write_files(tmp_path, files | {name: struct.pack("<Q", count) + files[name][8:]})
        with pytest.raises(DataError, match=f"{name}: {words}"):
            read_all(tmp_path, "bin")
    points = bytearray(files["points3D.bin"])
    points[8 + 43 : 8 + 51] = struct.pack("<Q", 2**62)  # the length of a track
    scenes.write_files(tmp_path, files | {"points3D.bin": bytes(points)})
    with pytest.raises(DataError, match=r"points3D.bin: the file ends in the middle of a record"):
        read_all(tmp_path, "bin")


def test_lens_models_distortion_and_points_of_binary_files(tmp_path):
    scenes.write_colmap(tmp_path)
    cameras, path = (tmp_path / "sparse" / "0" / f"{name}.bin" for name in ("cameras", "points3D"))
    for model, name in ((5, "OPENCV_FISHEYE"), (77, "77"), (-1, "-1")):
        cameras.write_bytes(cameras.read_bytes()[:12] + struct.pack("<i", model) + cameras.read_bytes()[16:])
        refused(tmp_path, rf"cameras.bin: camera model {name} is not supported. Run `colmap image_undistorter")
    scenes.write_colmap(tmp_path, model="SIMPLE_RADIAL", parameters=(20, 8, 6, 1e300))
    refused(tmp_path, r"camera 1: .*distortion .*1e\+300")
    for k1 in (1e-320, 5e-324, -1e-320, 1e-100):
        scene = load_scene(scenes.write_colmap(tmp_path, model="SIMPLE_RADIAL", parameters=(20, 8, 6, k1)))
        assert scene.views[0].mask is None
        np.testing.assert_allclose(scene.views[0].image, scenes.image(0) / 255, atol=1e-6)
    for far in (1.7e308, -1.7e308, 1e30):
        path.write_bytes(path.read_bytes()[:16] + struct.pack("<d", far) + path.read_bytes()[24:])
        refused(tmp_path, r"1 of 3 points are not finite, or too far from the cameras; remove them")
    path.write_bytes(struct.pack("<Q", 0))
    scene = load_scene(tmp_path)
    assert len(scene.points) == 0 and "points3D.bin holds no points" in scene.notes
    path.unlink()
    scene = load_scene(tmp_path)
    assert scene.points is None and any("points3D.bin is missing" in n for n in scene.notes)


@pytest.mark.parametrize(
    "parameters,size,message",
    [
        ((0, 20, 8, 6), (16, 12), "focal lengths"),
        ((np.nan, 20, 8, 6), (16, 12), "focal lengths"),
        ((20, -20, 8, 6), (16, 12), "focal lengths .* calibrate again"),
        ((1e-320, 20, 8, 6), (16, 12), "focal lengths"),
        ((1e-3, 20, 8, 6), (16, 12), "focal lengths"),
        ((1e300, 20, 8, 6), (16, 12), "focal lengths"),
        ((20, 20, np.inf, 6), (16, 12), "principal point"),
        ((20, 20, 8, 6), (0, 12), "image size 0 x 12"),
        ((20, 20, 8, 6), (2**63, 12), "image size 9223372036854775808 x 12"),
        ((20, 20, 8, 6), (12, 16), "the aspects differ"),
    ],
)
@pytest.mark.parametrize("write", [scenes.write_colmap, scenes.write_colmap_txt])
def test_impossible_cameras(write, parameters, size, message, tmp_path):
    refused(write(tmp_path, parameters=parameters, size=size), rf"(cameras\.(bin|txt).*camera 1: .*|photo0.png: .*){message}")


def patched_pose(tmp_path, **changes):
    """Write a scene in which some of the words of the second pose are replaced, by index."""
    scenes.write_colmap_txt(tmp_path)
    path = tmp_path / "sparse" / "images.txt"
    lines = path.read_text().split("\n")
    words = lines[3].split()
    for index, value in changes.items():
        words[int(index[1:])] = value
    lines[3] = " ".join(words)
    path.write_text("\n".join(lines))
    return tmp_path


@pytest.mark.parametrize(
    "changes,message",
    [
        ({"_5": "nan"}, r"images.txt, image 'photo1.png': .*the pose is not finite"),
        ({"_5": "1e400"}, r"images.txt, image 'photo1.png': .*the pose is not finite"),
        ({"_1": "0", "_2": "0", "_3": "0", "_4": "0"}, r"'photo1.png': the rotation quaternion .* is zero or not finite"),
        ({"_1": "1e308"}, r"'photo1.png': the rotation quaternion .* is zero or not finite"),
        ({"_2": "x"}, r"images.txt, line 4: cannot be understood \(could not convert"),
        ({"_8": "9"}, r"'photo1.png': camera 9 is missing from cameras.txt"),
        ({"_0": "1"}, r"images.txt, line 4: id 1 is given twice"),
        ({"_5": "1e100"}, r"image 'photo1.png': its centre is beyond 1e\+12 units"),
        ({"_9": "photo0.png"}, r"the image 'photo0.png' is listed twice"),
        ({"_9": "../images.png"}, r"'../images.png' points outside the scene folder"),
        ({"_9": "/etc/passwd"}, r"'/etc/passwd' points outside the scene folder"),
        ({"_9": ".."}, r"images.txt: '..' is not a file name"),
    ],
)
def test_broken_poses_in_text(changes, message, tmp_path):
    refused(patched_pose(tmp_path, **changes), message, strict=True)


@pytest.mark.parametrize("kind", ["txt", "bin"])
@pytest.mark.parametrize("what", ["pose", "camera"])
@pytest.mark.parametrize("number", ["nan", "-nan(ind)", "inf", "1.#QNAN", "-1.#IND00"])
def test_images_without_a_finite_pose_or_camera_are_left_out(number, what, kind, tmp_path):
    """Some programs write unaligned photographs so, on Windows in the spelling of its library."""
    write, value = (scenes.write_colmap, scenes.write_colmap_txt)[kind == "txt"], np.inf if number == "inf" else np.nan
    folder = write(tmp_path) / ("sparse/0" if kind == "bin" else "sparse")
    images, cameras = folder / f"images.{kind}", folder / f"cameras.{kind}"
    data = images.read_bytes()
    if kind == "txt":
        rows = data.decode().split("\n")
        words = rows[5].split()
        words[8], words[5:8] = ("2", words[5:8]) if what == "camera" else (words[8], [number] * 3)
        rows[5] = " ".join(words)
        images.write_text("\n".join(rows))
        bad = " ".join([number] * 4) if what == "camera" else "20 20 8 6"
        cameras.write_text(cameras.read_text() + f"2 PINHOLE 16 12 {bad}\n")
    else:
        end = data.index(b"photo2.png")
        pose, camera = (b"", struct.pack("<i", 2)) if what == "camera" else (struct.pack("<3d", *[value] * 3), b"")
        images.write_bytes(data[: end - (len(pose) + 4 if pose else 4)] + pose + (camera or data[end - 4 : end]) + data[end:])
        lens = [value] * 4 if what == "camera" else [20, 20, 8, 6]
        cameras.write_bytes(struct.pack("<Q", 2) + cameras.read_bytes()[8:] + struct.pack("<iiQQ4d", 2, 1, 16, 12, *lens))
    scene = load_scene(tmp_path)
    assert [v.name for v in scene.views] == [n for n in scenes.NAMES if n != "photo2.png"]
    note = "left out: 1 of 5 images, as pose or camera is not finite: photo2.png"
    assert note in scene.notes and len(scene.points) == 3 and not any("have no pose" in n for n in scene.notes)
    assert (len((read := read_cameras(folder))[0]), read[1]) == (4, [note])
    refused(tmp_path, "the pose is not finite" if what == "pose" else r"camera 2: .*focal lengths \[(nan|inf)", strict=True)


@pytest.mark.parametrize("kind", ["txt", "bin", "ply"])
def test_points_that_are_not_finite_are_left_out(kind, tmp_path):
    folder = (scenes.write_colmap_txt if kind == "txt" else scenes.write_colmap)(tmp_path)
    path = folder / ("sparse" if kind == "txt" else "sparse/0") / f"points3D.{kind}"
    if kind == "txt":
        rows = path.read_text().split("\n")
        rows[2] = " ".join(["2", "-nan(ind)", *rows[2].split()[2:]])
        path.write_text("\n".join(rows))
    elif kind == "bin":
        data = bytearray(path.read_bytes())
        data[16:24] = struct.pack("<d", np.nan)
        path.write_bytes(data)
    else:
        path.with_suffix(".bin").unlink()
        head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {n}\n" for n in ("x", "y", "z", "nx"))
        path.write_text(head + "end_header\n0 0 0 -nan(ind)\nnan 0 0 0\n0 1 0 0\n")
    scene = load_scene(tmp_path)
    assert len(scene.points) == 2 and np.isfinite(scene.points.points).all()
    assert scene.points.tracks is None or len(scene.points.tracks) == 2
    assert f"1 of 3 points of points3D.{kind} are not finite and are left out" in scene.notes
    refused(tmp_path, rf"points3D.{kind}: 1 of 3 points are not finite", strict=True)


@pytest.mark.parametrize(
    "name,content,message",
    [
        ("points3D.txt", "1 0 0\n", r"points3D.txt, line 1: cannot be understood \(a point needs 8 numbers"),
        ("points3D.txt", "1 0 0 nan 1 1 1 0\n", r"points3D.txt: 1 of 1 points are not finite"),
        ("points3D.txt", "1 0 0 0 1 1 1 0 1\n", r"points3D.txt, line 1"),
        ("cameras.txt", "1 PINHOLE 16 12 20 20 8\n", r"cameras.txt, line 1: .*PINHOLE has 4 parameters, not 3"),
        ("cameras.txt", "1 THIN 16 12 20\n", r"cameras.txt: camera model THIN is not supported"),
        ("cameras.txt", "1\n", r"cameras.txt, line 1: cannot be understood"),
        ("cameras.txt", b"\xff\xfe", r"cameras.txt, line 1: cannot be understood"),
        ("images.txt", "1 1 0 0 0 0 0 3 1 photo0.png\n2 1 0 0 0 0 0 3 1 photo1.png\n", r"images.txt, line 2: expected"),
        ("images.txt", "", r"has 0 usable views.*at least 2"),
        ("images.txt", "1 1 0 0 0 0 0 3 1 photo0.png\n\n", r"has 1 usable views.*at least 2 .*. Add images"),
    ],
)
def test_broken_text_files(name, content, message, tmp_path):
    scenes.write_colmap_txt(tmp_path)
    (tmp_path / "sparse" / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    refused(tmp_path, message)


def test_a_long_text_of_a_file_is_shortened(tmp_path):
    """In errors and notes, which go into the files of a run or a farm; the file is still named."""
    long = "x" * 1_000_000
    patched_pose(tmp_path, _2=long)
    with pytest.raises(DataError) as raised:
        load_scene(tmp_path)
    text = str(raised.value)
    assert text.startswith(str(tmp_path)) and "x [" in text and "letters left out] x" in text and len(text) < 4100
    notes = TransformsReader().scene(Path("a"), [], ["x" * 9000 + " end", Detail("y" * 9000)]).notes
    assert len(notes[0]) < 4200 and notes[0].endswith("x end") and isinstance(notes[1], Detail) and len(notes[1]) < 4200


def test_names_that_are_not_utf8(tmp_path):
    scenes.write_colmap(tmp_path)
    path = tmp_path / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes().replace(b"photo3", b"phot\xff3"))
    refused(tmp_path, r"1 of 5 images have no image file: phot\udcff3.png \(1 of the names are not UTF-8; rename", strict=True)
    image = tmp_path / "images" / "photo3.png"
    if sys.platform == "linux":  # where any bytes are a name
        image.rename(image.with_name("phot\udcff3.png"))
        assert "phot\udcff3.png" in [v.name for v in load_scene(tmp_path).views]


# ---- transforms ------------------------------------------------------------------------------------------------------


def broken_frame(tmp_path, **changes):
    content = scenes.transforms_json()
    content["frames"][1] |= changes
    return scenes.write_transforms(tmp_path, content)


MIRROR = (np.array(scenes.opengl(1)) @ np.diag([-1.0, 1, 1, 1])).tolist()
SCALED = (np.array(scenes.opengl(1)) @ np.diag([2.0, 2, 2, 1])).tolist()


@pytest.mark.parametrize(
    "changes,message",
    [
        ({"transform_matrix": MIRROR}, r"transforms.json, frame 1 \(images/photo1.png\): .*the pose mirrors .*determinant -1"),
        ({"transform_matrix": SCALED}, r"frame 1 \(images/photo1.png\): .*the pose is not rigid"),
        ({"transform_matrix": np.array(scenes.opengl(1)).T.tolist()}, r"frame 1 .*the last row of the pose is .*transposed"),
        ({"transform_matrix": [[1, 2], [3]]}, r"frame 1 .*: transform_matrix is missing or not made of rows"),
        ({"transform_matrix": [[10**400] * 4] * 4}, r"frame 1 .*: transform_matrix is missing or not made of rows"),
        ({"transform_matrix": [["1"] * 4] * 4}, r"frame 1 .*not finite"),
        ({"transform_matrix": [[1e200] * 4] * 3}, r"frame 1 .*not rigid"),
        ({"transform_matrix": None}, r"frame 1 .*: transform_matrix is missing"),
        ({"transform_matrix": [[1.0]]}, r"frame 1 .*: transform_matrix must be \[4, 4\], not \[1, 1\]"),
        ({"file_path": None}, r"frame 1: 'None' is not a file name"),
        ({"file_path": ""}, r"frame 1: '' is not a file name"),
        ({"file_path": "a\0b"}, r"frame 1: .* is not a file name"),
        ({"file_path": "\ud800.png"}, r"frame 1: .* is not a file name"),
        ({"file_path": "/"}, r"frame 1: '/' is not a file name"),
        ({"file_path": "images/../../x.png"}, r"frame 1: .* points outside the scene folder; .*--allow-outside"),
        ({"mask_path": "../m.png"}, r"frame 1 .*, mask: '../m.png' points outside the scene folder"),
        ({"mask_path": "m.png"}, r"frame 1 .*: its mask .*m.png is missing; restore it, or remove mask_path"),
        ({"file_path": "images/photo0.png"}, r"the image 'images/photo0.png' is listed twice"),
        ({"fl_x": -1}, r"frame 1 .*: .*focal lengths \[-1.0, 20.0\] px"),
        ({"fl_x": True}, r"frame 1 .*: not a number .fl_x must be a finite number, not True"),
        ({"fl_x": 10**400}, r"frame 1 .*: not a number .fl_x must be a finite number"),
        ({"cx": "8"}, r"frame 1 .*: not a number .cx must be a finite number, not '8'.; write it without quotes"),
        *(
            ({"fl_x": n}, rf"frame 1 .*: not a number .fl_x must be a finite number, not {n}")
            for n in (np.nan, np.inf, -np.inf)
        ),
        ({"transform_matrix": [[np.nan] * 4] * 4}, r"frame 1 .*: .*the pose is not finite"),
        ({"w": 0}, r"frame 1 .*: impossible camera .the camera's image size 0 x 12 px"),
        ({"w": 30}, r"photo1.png: the image is 16 x 12 px, its camera 30 x 12"),
        ({"k4": 0.1}, r"frame 1 .*: k4 is not supported"),
        ({"k4": 0.1, "camera_model": "FULL_OPENCV"}, r"frame 1 .*: k4 is not supported"),
        ({"camera_model": "OPENCV_FISHEYE"}, r"frame 1 .*: camera model OPENCV_FISHEYE is not supported"),
    ],
)
def test_broken_frames(changes, message, tmp_path):
    refused(broken_frame(tmp_path, **changes), message)


@pytest.mark.parametrize(
    "text",
    [
        "", "{", "[]", "{}", '{"frames": 3}', "[" * 100000, '{"frames": [1]}', "\xff", '{"frames": []}',
        *(f'{{"fl_x": 1, "frames": {n}}}' for n in ("NaN", "Infinity", "[NaN]", "1e999")),
    ],
)  # fmt: skip
def test_json_that_is_no_scene(text, tmp_path):
    (tmp_path / "transforms.json").write_bytes(text.encode("latin-1"))
    refused(tmp_path, r"transforms.json|0 usable views")


def test_json_that_is_nested_deep_or_huge(tmp_path, monkeypatch):
    scenes.write_transforms(tmp_path)
    path = tmp_path / "transforms.json"
    text, nested = path.read_text(), '{"a":' * 900 + "1" + "}" * 900
    for key in ("file_path", "mask_path", "transform_matrix", "fl_x", "camera_model", "ply_file_path", "x"):
        path.write_text(text.replace('"frames": [{', f'"{key}": {nested}, "frames": [{{"{key}": {nested}, ', 1))
        refused(tmp_path, r"transforms.json: is nested deeper than 16 levels|transforms.json: cannot be read as JSON")
    path.write_text(text)
    monkeypatch.setattr("warpgs.io.transforms.MAX_BYTES", 100)
    refused(tmp_path, r"transforms.json: cannot be read .is larger than 100 bytes")


def test_no_focal_length_and_names_that_no_file_has(tmp_path):
    scenes.write_transforms(tmp_path, scenes.transforms_json(fl_x=None, fl_y=None))
    refused(tmp_path, r"frame 0 .*has neither fl_x nor camera_angle_x")
    scenes.write_transforms(tmp_path, scenes.transforms_json(fl_x=None, fl_y=None, camera_angle_x=4.0))
    refused(tmp_path, r"frame 0 .*camera_angle_x is 4.0 rad, not between 0 and pi")
    # too long for the file system, and of half a character; the message is text all the same
    refused(broken_frame(tmp_path, file_path="x" * 300 + ".png"), r"cannot be read|usable views|no image file")
    with pytest.raises(DataError) as caught:
        load_scene(broken_frame(tmp_path, file_path="\ud800.png"))
    json.dumps(str(caught.value)).encode()
    str(caught.value).encode("utf-8")


# Broken LLFF, DTU and Middlebury scenes, and broken images in any format, end in a message.


@pytest.mark.parametrize(
    "column,value,message",
    [
        (3, np.nan, r"poses_bounds.npy, image 'photo2.png': .*the pose is not finite"),
        (0, 5.0, r"poses_bounds.npy, image 'photo2.png': .*the pose is not rigid"),
        (14, 0.0, r"'photo2.png': .*focal lengths"),
        (4, -12.0, r"'photo2.png': .*the camera's image size"),
        (9, 99.0, r"photo2.png: the image is 16 x 12 px, its camera 99 x 12"),
        ([0, 5, 10], "mirrored", r"'photo2.png': .*the pose mirrors the scene \(determinant -1\)"),
    ],
)
def test_llff_rows(column, value, message, tmp_path):
    scenes.write_llff(tmp_path)
    rows = scenes.llff_rows()
    rows[2, column] = -rows[2, column] if value == "mirrored" else value
    np.save(tmp_path / "poses_bounds.npy", rows)
    refused(tmp_path, message)


def test_llff_arrays_of_another_kind_or_length(tmp_path):
    scenes.write_llff(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", scenes.llff_rows()[:4])
    refused(tmp_path, r"poses_bounds.npy: has 4 poses, but .*images holds 5 images.*Copy the scene again")
    for array in (np.zeros((5, 16)), np.zeros(17), np.array([["a"] * 17] * 5), np.zeros((5, 17), complex)):
        np.save(tmp_path / "poses_bounds.npy", array)
        refused(tmp_path, r"poses_bounds.npy: must be an array \[n, 17\] of numbers")


@pytest.mark.parametrize("name,write", [("poses_bounds.npy", scenes.write_llff), ("cameras.npz", scenes.write_dtu)])
def test_numpy_files_that_are_none(name, write, tmp_path):
    write(tmp_path)
    data = (tmp_path / name).read_bytes()
    pickled = np.array([{"a": 1}] * 5, dtype=object)
    for broken in (b"", b"x", data[:40], data[:-30], data[:10] + b"{" * 118, b"PK\x03\x04" + b"\0" * 50):
        (tmp_path / name).write_bytes(broken)
        refused(tmp_path, rf"{name}: cannot be read as")
    with (tmp_path / name).open("wb") as f:
        np.save(f, pickled)  # would run code if it were unpickled
    refused(tmp_path, rf"{name}: cannot be read as")
    with (tmp_path / name).open("wb") as f:
        if name.endswith("npy"):
            np.lib.format.write_array_header_1_0(f, {"descr": "<f8", "fortran_order": False, "shape": (10**13, 17)})
            f.write(b"\0" * 64)
        else:
            f.truncate(2**24 + 1)  # of which zipfile would make ten times its size of a table of contents
    refused(tmp_path, rf"{name}: cannot be read as (a numpy array|an archive of arrays \(is larger than 16 MiB)")
    if name.endswith("npy"):
        with (tmp_path / name).open("wb") as f:
            np.savez(f, a=np.zeros(3))
        refused(tmp_path, "is an archive of arrays, not one array")


SKEW = np.block([[np.array([[20, 5, 8], [0, 20, 6], [0, 0, 1.0]]), np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])


@pytest.mark.parametrize(
    "changes,message",
    [
        ({"world_mat_4": None}, r"cameras.npz: has 4 cameras, but .*image holds 5 images"),
        ({"world_mat_4": None, "world_mat_7": np.eye(4)}, r"image '000004.png': world_mat_4 is missing"),
        ({"world_mat_1": np.zeros((4, 4))}, r"image '000001.png': the projection matrix is not finite or not invertible"),
        ({"world_mat_1": np.full((4, 4), np.nan)}, r"cameras.npz: world_mat_1 must be finite and \[4, 4\]"),
        ({"scale_mat_1": np.eye(3)}, r"cameras.npz: scale_mat_1 must be finite and \[4, 4\], not \[3, 3\]"),
        ({"world_mat_1": SKEW}, r"image '000001.png': the camera is skewed by 5 px"),
    ],
)
def test_dtu_archives(changes, message, tmp_path):
    scenes.write_dtu(tmp_path)
    matrices = {k: v for k, v in (scenes.dtu_matrices() | changes).items() if v is not None}
    np.savez(tmp_path / "cameras.npz", **matrices)
    refused(tmp_path, message)


@pytest.mark.parametrize(
    "old,new,message",
    [
        ("5\n", "6\n", r"tiny_par.txt: announces 6 images and lists 5; it is truncated"),
        ("5\n", "x\n", r"tiny_par.txt: cannot be understood"),
        ("photo1.png 20.0", "photo1.png nan", r"tiny_par.txt, line 3, image 'photo1.png': needs 21 finite numbers"),
        ("photo1.png 20.0", "photo1.png", r"line 3, image 'photo1.png': needs 21 finite numbers"),
        ("photo1.png 20.0 0.0", "photo1.png 20.0 3.0", r"line 3, image 'photo1.png': the camera is skewed by 3 px"),
        ("photo1.png 20.0", "photo1.png -20.0", r"line 3, image 'photo1.png': .*focal lengths"),
        ("photo1.png 20.0", "photo9.png 20.0", r"photo9.png: the image cannot be read .No such"),
        ("photo1.png 20.0", "../photo1.png 20.0", r"line 3, image '../photo1.png': '../photo1.png' points outside"),
        ("5.5 0.0 0.0 1.0", "5.5 0.0 0.1 1.0", r"image 'photo0.png': K is not a matrix of intrinsics"),
    ],
)
def test_middlebury_files(old, new, message, tmp_path):
    scenes.write_middlebury(tmp_path)
    path = tmp_path / "tiny_par.txt"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    refused(tmp_path, message)


# ---- Metashape and RealityScan ---------------------------------------------------------------------------------------

ENTITIES = "".join(f'<!ENTITY e{i + 1} "{f"&e{i};" * 10}">' for i in range(9))
BOMB = f'<?xml version="1.0"?><!DOCTYPE document [<!ENTITY e0 "ha">{ENTITIES}]><document><chunk>&e9;</chunk></document>'


@pytest.mark.parametrize(
    "change,message",
    [
        (lambda s: BOMB, "cameras.xml: cannot be understood .it has a DOCTYPE, which Metashape does not write.; write the"),
        (lambda s: s[:-20], r"cameras.xml: cannot be understood .unclosed token.*; write the file again"),
        (lambda s: s.replace("<cameras>", "<cameras>" + "<a/>" * 2**19), "it has more than 524,288 parts"),
        (lambda s: s.replace("chunk", "part").replace("<part", "<!--<chunk--><part"), "has 0 chunks with aligned cameras"),
        (lambda s: s.replace("</document>", s[s.index("<chunk") :]), "has 2 chunks with aligned cameras"),
        (lambda s: s.replace("<f>20.0</f>", "<f>20.0</f><k4>0.1</k4>"), "sensor 0: k4 of a frame camera is not supported"),
        (lambda s: s.replace("<f>20.0</f>", "<f>20.0</f><b2>3</b2>"), "sensor 0: b2 of a frame camera is not supported"),
        (lambda s: s.replace("<f>20.0</f>", "<f>nan</f>"), "sensor 0: cannot be understood .<f> needs 1 finite numbers"),
        (lambda s: s.replace("<f>20.0</f>", ""), "sensor 0: .*focal lengths .0.0, 0.0. px"),
        (lambda s: s.replace("<f>20.0</f>", "<f>-20</f>"), "focal lengths .* calibrate again"),
        (lambda s: s.replace('sensor id="0"', 'sensor id="1"'), "sensor 0: cannot be understood .it has no calibration; align"),
        (lambda s: s.replace('type="frame"', 'type="spherical"'), "sensor 0: spherical cameras are not supported"),
        (lambda s: s.replace('width="16"', 'width="x"'), "sensor 0: cannot be understood .invalid literal"),
        (lambda s: s.replace("<scale>2.0", "<scale>0"), "camera 'photo0': cannot be understood .its scale is 0"),
        (lambda s: s.replace("<rotation>0.0 -1.0", "<rotation>0.0 -3.0"), "camera 'photo0': .*the pose is not rigid"),
        (lambda s: s.replace("</transform></camera>", " 1</transform></camera>"), "photo0': .*<transform> needs 16 finite"),
        (lambda s: s.replace("UTF-8", "UTF-9"), "unknown encoding: UTF-9"),
        (lambda s: s.replace("</group>", "</group><camera sensor_id='0'><transform/></camera>"), "<transform> needs 16 finite"),
        (lambda s: s.replace('label="photo1"', 'label="photo0"'), "'photo0.png' is listed twice"),
        (lambda s: s.replace('label="photo1"', 'label="../../a"'), "points outside the scene folder"),
        (lambda s: s.replace('label="photo1"', ""), "'' is not a file name"),
    ],
)  # fmt: skip
def test_metashape_files(change, message, tmp_path):
    scenes.write_metashape(tmp_path / "scene")
    path = tmp_path / "scene" / "cameras.xml"
    path.write_text(change(path.read_text()))
    refused(tmp_path / "scene", message)


@pytest.mark.parametrize(
    "old,new,message",
    [
        (",0,0,0,0,0,0,0,0", ",0,0,0,0,0,0.1,0,0", "line 3: k4 is not supported; align with the model Brown3"),
        (
            "0,0,0,0,0,0,0,0",
            "0,0,0",
            r"calib.csv, line 3: cannot be understood \(zip\(\) argument .*; write the file again",
        ),
        (",0,0,0,0,0,0,0,0", ",0,0,nan,0,0,0,0,0", "distortion .* of the Brown lens"),
        (",0,0,0,0,0,0,0,0", ",1e300,0,0,0,0,0,0,0", "line 3, image 'photo0.png': .*the principal point"),
        (",45.0,", ",-45.0,", "image 'photo0.png': .*focal lengths"),
        ("photo0.png,", "photo0.png,x,", "line 3: cannot be understood"),
        ("photo1.png", "photo0.png", "'photo0.png' is listed twice"),
        ("photo1.png", "../a.png", "points outside the scene folder"),
        ("photo1.png", '"photo1.png', "line .*: cannot be understood"),
    ],
)
def test_realityscan_files(old, new, message, tmp_path):
    scenes.write_realityscan(tmp_path / "scene")
    path = tmp_path / "scene" / "calib.csv"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    refused(tmp_path / "scene", message)


def test_large_and_unreadable_files_of_cameras(tmp_path, monkeypatch):
    for write, name in ((scenes.write_metashape, "cameras.xml"), (scenes.write_realityscan, "calib.csv")):
        root = write(tmp_path / name)
        with monkeypatch.context() as patch:
            patch.setattr("warpgs.io.capture.MAX_BYTES", 100)
            refused(root, f"{name}: cannot be read .is larger than 100 bytes.; export the cameras again")
        for photograph in root.rglob("*.png"):
            photograph.unlink()
        shutil.rmtree(root / "images", ignore_errors=True)
        refused(root, f"{name} lacks its photographs, beside it or in images")
        (root / name).unlink()
        (root / name).mkdir()
        refused(root, "no scene format found")
