"""Objects cut out of their surroundings: true alpha, thin parts, the same views in two formats."""

import json

import cv2
import numpy as np
import pytest

from warpgs.errors import UsageError
from warpgs.geometry import rotation_matrices
from warpgs.io.load import load_scene
from warpgs.scene import Camera
from warpgs.synthetic import demo, raycast

SIZE = {"views": 9, "width": 48, "height": 40}


def read(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / 255


def test_two_formats_show_the_same_object_to_the_same_cameras(tmp_path):
    specs = [demo.write_object(tmp_path / form, form=form, seed=3, **SIZE) for form in demo.FORMATS]
    assert specs[0] == specs[1] and specs[0].startswith("train=000.png,001.png") and specs[0].endswith(";test=008.png")
    transforms = json.loads((tmp_path / "transforms" / "transforms.json").read_text())
    rows = [r for r in (tmp_path / "colmap/sparse/0/images.txt").read_text().splitlines() if not r.startswith("#")][::2]
    for frame, row in zip(transforms["frames"], rows, strict=True):
        name = row.split()[-1]
        assert frame["file_path"] == f"images/{name}"
        rgba, rgb = read(tmp_path / "transforms/images" / name), read(tmp_path / "colmap/images" / name)
        alpha = rgba[..., 3]
        np.testing.assert_array_equal(alpha, read(tmp_path / "colmap/masks" / name))
        np.testing.assert_array_equal(rgba[alpha > 0][:, :3], rgb[alpha > 0])
        pose = np.array(frame["transform_matrix"])
        R = rotation_matrices(np.array(row.split()[1:5], float))
        np.testing.assert_allclose(R.T * [1, -1, -1], pose[:3, :3], atol=1e-9)
        np.testing.assert_allclose(-R.T @ np.array(row.split()[5:8], float), pose[:3, 3], atol=1e-9)
        assert 0.05 < alpha.mean() < 0.5 and ((alpha > 0) & (alpha < 1)).mean() > 0.02  # edges are soft
    assert len((tmp_path / "colmap/sparse/0/points3D.txt").read_text().splitlines()) > 10
    a, b = (load_scene(tmp_path / form, masks="cutout").views for form in demo.FORMATS)
    for left, right in zip(a, b, strict=True):
        np.testing.assert_array_equal(left.alpha, right.alpha)
        np.testing.assert_allclose(left.image, right.image, atol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_objects_have_holes_and_stay_in_the_frame(seed):
    shapes = demo.cut_out_object(seed)
    thin = [s for s in shapes if isinstance(s, raycast.Cylinder) and s.size < 0.05]
    assert len(thin) >= 10 and any(isinstance(s, raycast.Torus) for s in shapes)
    holes = 0
    for camera in demo.ring_cameras(9, 90, 90)[::4]:
        empty = raycast.render_rgba(shapes, demo.LIGHT, camera.K, camera.viewmat, 90, 90, 1)[..., 3] == 0
        assert empty[[0, -1]].all() and empty[:, [0, -1]].all()
        _, _, stats, _ = cv2.connectedComponentsWithStats(empty.astype(np.uint8), connectivity=4)
        holes += (stats[1:, cv2.CC_STAT_AREA] > 3).sum() - 1  # all but the surroundings
    assert holes >= 3


def test_seeds_differ_and_wishes_are_checked(tmp_path):
    a, b = (raycast.render_rgba(demo.cut_out_object(s), demo.LIGHT, c.K, c.viewmat, 32, 32, 1)[..., 3]
            for s, c in zip((0, 1), 2 * demo.ring_cameras(9, 32, 32)[:1]))  # fmt: skip
    assert (a != b).mean() > 0.05
    with pytest.raises(UsageError, match="transforms or colmap"):
        demo.write_object(tmp_path / "a", form="llff", **SIZE)
    with pytest.raises(UsageError, match="9 views or more"):
        demo.write_object(tmp_path / "a", views=8)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("angle", [0.3, 3.1, np.pi])
def test_poses_of_half_a_turn_are_written(axis, angle):
    s, c = np.sin(angle / 2) * np.eye(3)[axis], np.cos(angle / 2)
    R = rotation_matrices(np.array([c, *s]))
    viewmat = np.eye(4)
    viewmat[:3, :3] = R
    text = demo.colmap_text([Camera(viewmat, np.eye(3), 8, 8)], np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 1), bool))
    quat = np.array(text["images.txt"].splitlines()[3].split()[1:5], float)
    np.testing.assert_allclose(rotation_matrices(quat), R, atol=1e-9)
