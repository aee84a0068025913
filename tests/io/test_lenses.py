"""Lenses that are kept: the same point lands on the same pixel through the camera as through the lens of the file."""

import numpy as np
import pytest

from tests.io import scenes
from tests.lens_cameras import opencv_pixels
from warpgs import geometry
from warpgs.errors import DataError, UsageError
from warpgs.geometry import project_points
from warpgs.io.load import load_scene

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
        point = scenes.POINT
        wanted = scenes.pixel(i)
        if model != "pinhole":
            padded = np.zeros(4 if model == "fisheye" else 8)
            padded[: len(terms)] = terms
            assert np.array_equal(camera.distortion, padded)
            in_camera = scenes.VIEWMATS[i, :3, :3] @ point + scenes.VIEWMATS[i, :3, 3]
            wanted = opencv_pixels(model, padded, scenes.K, in_camera[None])[0]
        n = scene.normalization
        found, _ = project_points(camera, n.scale * (point - n.offset)[None])
        np.testing.assert_allclose(found[0], wanted, atol=1e-8)


@pytest.mark.parametrize("name", COLMAP)
@pytest.mark.parametrize("write", [scenes.write_colmap, scenes.write_colmap_txt], ids=["bin", "txt"])
def test_colmap_lenses_are_kept(name, write, tmp_path):
    parameters, model, terms = COLMAP[name]
    scene = load_scene(write(tmp_path, model=name, parameters=parameters), lenses="native")
    lands(scene, model, terms)
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


def test_errors_name_the_way_to_keep_a_lens(tmp_path):
    """Undistorting stays the default; terms that no model here has are refused either way."""
    scenes.write_colmap(tmp_path / "a", model="OPENCV_FISHEYE", parameters=COLMAP["OPENCV_FISHEYE"][0])
    with pytest.raises(DataError, match=r"OPENCV_FISHEYE is not supported.*or fit with --lenses native"):
        load_scene(tmp_path / "a")
    for values, message in (
        ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE is not supported.*or fit them with --lenses native"),
        ({"is_fisheye": True}, "is_fisheye belongs to a fisheye.*or fit them with --lenses native"),
    ):
        scenes.write_transforms(tmp_path / "b", scenes.transforms_json(fl_x=F, **values))
        with pytest.raises(DataError, match=message):
            load_scene(tmp_path / "b")
    for values, message in (
        ({"k4": 0.1}, "k4 belongs to a fisheye or rational lens"),
        ({"is_fisheye": True, "p1": 0.1}, "p1 is not supported for a fisheye"),
        ({"is_fisheye": True, "fisheye_crop_radius": 9}, "fisheye_crop_radius is not supported for a fisheye"),
    ):
        scenes.write_transforms(tmp_path / "b", scenes.transforms_json(fl_x=F, **values))
        with pytest.raises(DataError, match=message):
            load_scene(tmp_path / "b", lenses="native")
    with pytest.raises(UsageError, match="--lenses must be undistort or native, not 'both'"):
        load_scene(tmp_path / "b", lenses="both")
