"""Broken LLFF, DTU and Middlebury scenes, and broken images in any format, end in a message."""

import numpy as np
import pytest

from tests.io import scenes
from tests.io.scenes import refused


def test_llff_counts_must_agree(tmp_path):
    scenes.write_llff(tmp_path)
    (tmp_path / "images" / "photo4.png").unlink()
    refused(tmp_path, r"poses_bounds.npy: has 5 poses, but .*images holds 4 images.*Copy the scene again")


def llff_with(tmp_path, row, column, value):
    scenes.write_llff(tmp_path)
    rows = scenes.llff_rows()
    rows[row, column] = value
    np.save(tmp_path / "poses_bounds.npy", rows)
    return tmp_path


@pytest.mark.parametrize(
    "column,value,message",
    [
        (3, np.nan, r"poses_bounds.npy, image 'photo2.png': the pose is not finite"),
        (0, 5.0, r"poses_bounds.npy, image 'photo2.png': the pose is not rigid"),
        (14, 0.0, r"'photo2.png': focal lengths"),
        (4, -12.0, r"'photo2.png': the camera's image size"),
        (9, 99.0, r"photo2.png: the image is 16 x 12 px, its camera 99 x 12"),
    ],
)
def test_llff_rows(column, value, message, tmp_path):
    refused(llff_with(tmp_path, 2, column, value), message)


def test_llff_mirrored(tmp_path):
    scenes.write_llff(tmp_path)
    rows = scenes.llff_rows()
    rows[:, [0, 5, 10]] *= -1
    np.save(tmp_path / "poses_bounds.npy", rows)
    refused(tmp_path, r"image 'photo0.png': the pose mirrors the scene \(determinant -1\); two axes are probably swapped")


@pytest.mark.parametrize("array", [np.zeros((5, 16)), np.zeros(17), np.array([["a"] * 17] * 5), np.zeros((5, 17), complex)])
def test_llff_arrays_of_another_kind(array, tmp_path):
    scenes.write_llff(tmp_path)
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
    if name.endswith("npy"):
        with (tmp_path / name).open("wb") as f:
            np.savez(f, a=np.zeros(3))
        refused(tmp_path, "is an archive of arrays, not one array")


def test_numpy_headers_that_announce_more_than_there_is(tmp_path):
    scenes.write_llff(tmp_path)
    with (tmp_path / "poses_bounds.npy").open("wb") as f:
        np.lib.format.write_array_header_1_0(f, {"descr": "<f8", "fortran_order": False, "shape": (10**13, 17)})
        f.write(b"\0" * 64)
    refused(tmp_path, r"poses_bounds.npy: cannot be read as a numpy array")


def test_archives_beyond_any_number_of_cameras(tmp_path):
    """zipfile makes ten times its size of a table of contents."""
    scenes.write_dtu(tmp_path)
    with (tmp_path / "cameras.npz").open("wb") as f:
        f.truncate(2**24 + 1)
    refused(tmp_path, r"cameras.npz: cannot be read as an archive of arrays \(OSError: .*is larger than 16 MiB")


def dtu_with(tmp_path, **changes):
    scenes.write_dtu(tmp_path)
    matrices = {k: v for k, v in (scenes.dtu_matrices() | changes).items() if v is not None}
    np.savez(tmp_path / "cameras.npz", **matrices)
    return tmp_path


SKEW = np.block([[np.array([[20, 5, 8], [0, 20, 6], [0, 0, 1.0]]), np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])


@pytest.mark.parametrize(
    "changes,message",
    [
        ({"world_mat_4": None}, r"cameras.npz: has 4 cameras, but .*image holds 5 images"),
        ({"world_mat_4": None, "world_mat_7": np.eye(4)}, r"image '000004.png': world_mat_4 is missing"),
        ({"world_mat_1": np.zeros((4, 4))}, r"image '000001.png': the projection matrix is not finite or not invertible"),
        ({"world_mat_1": np.full((4, 4), np.nan)}, r"cameras.npz: world_mat_1 must be finite and \[4, 4\]"),
        ({"scale_mat_1": np.eye(3)}, r"cameras.npz: scale_mat_1 must be finite and \[4, 4\]; its shape is \[3, 3\]"),
        ({"world_mat_1": SKEW}, r"image '000001.png': the camera is skewed by 5 px"),
    ],
)
def test_dtu_archives(changes, message, tmp_path):
    refused(dtu_with(tmp_path, **changes), message)


@pytest.mark.parametrize(
    "old,new,message",
    [
        ("5\n", "6\n", r"tiny_par.txt: announces 6 images and lists 5; it is truncated"),
        ("5\n", "x\n", r"tiny_par.txt: cannot be understood"),
        ("photo1.png 20.0", "photo1.png nan", r"tiny_par.txt, line 3, image 'photo1.png': needs 21 finite numbers .*has 20"),
        ("photo1.png 20.0", "photo1.png", r"line 3, image 'photo1.png': needs 21 finite numbers .*has 20"),
        ("photo1.png 20.0 0.0", "photo1.png 20.0 3.0", r"line 3, image 'photo1.png': the camera is skewed by 3 px"),
        ("photo1.png 20.0", "photo1.png -20.0", r"line 3, image 'photo1.png': focal lengths"),
        ("photo1.png 20.0", "photo9.png 20.0", r"photo9.png: the image file is missing"),
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


@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_corrupt_images_are_named(kind, tmp_path):
    scenes.WRITERS[kind](tmp_path)
    path = sorted(tmp_path.rglob("*.png"))[2]
    path.write_bytes(path.read_bytes()[:60])
    refused(tmp_path, rf"{path.name}: the image cannot be decoded: it ends within a chunk. Restore it")
