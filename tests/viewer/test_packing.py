"""What the browser is given: covariances that half precision holds, boxes and keyframes in file units."""

import dataclasses
import math

import numpy as np
import torch

from tests.gaussians import cloud
from tests.scenes import ring, three_gaussians
from warpgs.geometry import convert_box, convert_camera, convert_gaussians, rotation_matrices
from warpgs.pipeline.films.paths import fov_y, rig_among
from warpgs.pipeline.model.edit import inside
from warpgs.scene import Normalization
from warpgs.viewer.html import LARGEST_HALF, camera_at, camera_before, distance_ahead, packed, stands_at, wxyz_of
from warpgs.viewer.window import box_json, keyframe


def test_half_precision_keeps_gaussians_of_any_scene():
    """Covariances keep ten bits at any size of the scene; in scene units those of a small one would vanish."""
    g = cloud(200)
    for factor in (1e-4, 1.0, 1e4):
        scaled = dataclasses.replace(g, means=factor * g.means, log_scales=g.log_scales + math.log(factor))
        (centers, covariances, *_), scale, _ = packed(scaled)
        half, exact = covariances.astype(np.float16).astype(np.float64), covariances.astype(np.float64)
        assert np.abs(half - exact).max(axis=(1, 2)).max() <= 1e-3 * np.abs(exact).max()
        traces = np.trace(half, axis1=1, axis2=2) * scale**2
        wanted = np.exp(2 * scaled.log_scales.double().numpy()).sum(1)
        np.testing.assert_allclose(traces, wanted, rtol=2e-3)
        np.testing.assert_allclose(scale * centers, scaled.means.numpy(), rtol=1e-5, atol=1e-6 * factor)
    g.log_scales[7, 1] += math.log(1e6)  # one axis of a million medians is counted, and finite
    (_, covariances, *_), _, shortened = packed(g)
    assert shortened == 1 and np.abs(covariances).max() <= LARGEST_HALF and np.isfinite(covariances.astype(np.float16)).all()
    # a box in file units holds the same points
    turn = rotation_matrices(np.array([0.8, 0.0, 0.6, 0.0]))
    g, box = cloud(300), (np.array([0.2, 0.1, 4.0]), np.array([2.0, 1.0, 1.5]), turn)
    within = inside(g, box)
    assert 0 < int(within.sum()) < len(within)
    n = Normalization(np.array([400.0, -20.0, 7.0]), 0.25, turn)
    stored = box_json(box, n)
    for back, part in zip(convert_box(tuple(map(np.array, stored.values())), n, "file", "scene"), box, strict=True):
        np.testing.assert_allclose(back, part, atol=1e-12)
    means = convert_gaussians(g, n, "scene", "file").means.double().numpy()
    local = (means - stored["center"]) @ np.array(stored["rotation"])
    again = (np.abs(local) <= np.array(stored["size"]) / 2 + 1e-4).all(1)
    assert (again == within.numpy()).mean() > 0.99
    assert not inside(dataclasses.replace(g, means=torch.eye(3) * 1.1), (np.zeros(3), np.full(3, 2.0), np.eye(3))).any()


def test_colors_of_degree_0_poses_there_and_back_and_keyframes_in_file_units():
    (*_, colors, opacities), _, _ = packed(three_gaussians())
    np.testing.assert_allclose(colors, 255 * np.array([[0.9, 0.2, 0.1], [0.15, 0.8, 0.2], [0.2, 0.3, 0.95]]), atol=0.51)
    np.testing.assert_allclose(opacities[:, 0], 255 * np.array([0.9, 0.85, 0.95]), atol=0.51)
    for c in ring(5):
        back = camera_at(wxyz_of(c), c.center, fov_y(c), c.width, c.height)
        np.testing.assert_allclose(back.viewmat, c.viewmat, atol=1e-12)
        assert abs(back.K[1, 1] - c.K[1, 1]) < 1e-9 and stands_at(back, c, 1e-9)
    first, second = ring(2)
    assert not stands_at(first, second, 1.0) and rig_among(ring(5), np.zeros((1, 3))).up @ [0, -1, 0] > 0.99
    assert rig_among([camera_before(three_gaussians())], three_gaussians().means.numpy()).up @ [0, -1, 0] > 0.99
    assert abs(distance_ahead(first, three_gaussians()) - 2.2) < 0.4
    assert distance_ahead(camera_before(three_gaussians()), three_gaussians()) > 0.3
    n, c = Normalization(np.array([4.0, -2.0, 7.0]), 0.25), ring(3)[0]
    k = keyframe(c, 1.5, n)
    c2w = np.array(k["c2w"])
    np.testing.assert_allclose(c2w @ convert_camera(c, n, "scene", "file").viewmat, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(c2w[:3, 3], c.center / 0.25 + n.offset, atol=1e-9)
    assert k["seconds"] == 1.5 and abs(k["fov_y"] - fov_y(c)) < 1e-12
