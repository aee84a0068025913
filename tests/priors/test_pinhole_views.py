"""Views of lenses as pinholes, and depth back in the pixels of the lens."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from tests.gaussians import cloud
from tests.lens_cameras import lens_camera
from warpgs.errors import UsageError
from warpgs.priors.given_depth import lens_depth, pinhole_view
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, View, ViewDepth


def arrays(camera: Camera) -> Camera:
    """Return the camera with arrays of numpy."""
    return dataclasses.replace(
        camera, **{n: v.numpy() for n, v in vars(camera).items() if isinstance(v, torch.Tensor)}
    )  # fmt: skip


@pytest.mark.parametrize("model", ["opencv", "fisheye"])
def test_a_lens_view_becomes_that_of_a_pinhole_and_back(model):
    """Small Gaussians rendered by either camera: images agree but for interpolation, and depth comes back to the lens."""
    gaussians, cam = cloud(400, torch.float32), lens_camera(model, width=120, height=90, dtype=torch.float32)
    pinhole = dataclasses.replace(cam, model="pinhole", distortion=None)
    gaussians = dataclasses.replace(gaussians, log_scales=gaussians.log_scales.clamp(-2.5, -2.3).mean(1, True).repeat(1, 3))
    shown, wanted = rasterize(gaussians, cam), rasterize(gaussians, pinhole)
    view = View("a.png", arrays(cam), shown.rgb.numpy(), score_mask=np.ones((90, 120), bool), alpha=shown.alpha.numpy())
    found = pinhole_view(view)
    assert found.camera.model == "pinhole" and found.camera.distortion is None and np.array_equal(found.camera.K, view.camera.K)
    inner = found.mask if found.mask is not None else np.ones((90, 120), bool)
    assert inner.mean() > 0.8 and np.array_equal(found.score_mask, inner)
    # a first-order footprint and a bilinear sample of features of 4 px differ by a few levels; no resampling, by more than 60
    change = np.abs(shown.rgb.numpy() - wanted.rgb.numpy())[inner].mean()
    assert np.abs(found.image - wanted.rgb.numpy())[inner].mean() < 0.15 * change
    assert np.abs(found.alpha - wanted.alpha.numpy())[inner].mean() < 0.15 * change
    depth = ViewDepth(wanted.depth.numpy(), wanted.alpha.numpy() > 0.5, np.ones((90, 120), np.float32))
    back = lens_depth(view.camera, depth)
    both = back.valid & (shown.alpha.numpy() > 0.5)
    # where neighbouring pixels show one depth; the nearest pixel is taken
    assert both.mean() > 0.3 and np.median(np.abs(back.depth / shown.depth.numpy() - 1)[both]) < 0.01
    assert not back.depth[~back.valid].any() and np.isinf(back.sensitivity[~back.valid]).all()


@pytest.mark.parametrize("model", ["opencv", "fisheye"])
def test_depth_moves_with_its_pixel(model):
    """Each pixel of the lens has the depth of the pinhole's pixel that OpenCV names, a fisheye as distance."""
    cam = arrays(lens_camera(model, width=120, height=90))
    x, y = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
    ramp = (1 + x / 120 + y / 30).astype(np.float32)
    back = lens_depth(cam, ViewDepth(ramp, np.ones((90, 120), bool), ramp))
    undistort = cv2.fisheye.undistortPoints if model == "fisheye" else cv2.undistortPoints
    rays = undistort(np.stack([x, y], -1).reshape(-1, 1, 2), cam.K, cam.distortion)[:, 0]
    u, v = (rays * np.diag(cam.K)[:2] + cam.K[:2, 2]).T
    inside = (u > 0.01) & (v > 0.01) & (u < 119.99) & (v < 89.99)
    wanted = 1 + (np.floor(u) + 0.5) / 120 + (np.floor(v) + 0.5) / 30
    if model == "fisheye":
        wanted *= np.hypot(1, np.linalg.norm(rays, axis=1))
    moved = np.abs(wanted.reshape(90, 120) - ramp)[inside.reshape(90, 120)]
    error = np.abs(back.depth.ravel() - wanted)[inside & back.valid.ravel()]
    # rounding may floor a few pixels to a neighbour, an iteration of OpenCV's ends at 0.01 px
    assert moved.mean() > 0.01 and (error < 1e-5).mean() > 0.95 and error.max() < 0.1
    assert inside.mean() > 0.7 and (back.valid.ravel() == inside).mean() > 0.97


def test_pinholes_stay_and_parallel_rays_are_refused():
    """The view and the depth of a pinhole are the same objects."""
    cam = arrays(lens_camera("orthographic", width=8, height=6))
    view = View("a.png", dataclasses.replace(cam, model="pinhole"), np.zeros((6, 8, 3), np.float32))
    depth = ViewDepth(*(np.zeros((6, 8), t) for t in (np.float32, bool, np.float32)))
    assert pinhole_view(view) is view and lens_depth(view.camera, depth) is depth
    with pytest.raises(UsageError, match="camera model 'orthographic': start from points"):
        pinhole_view(dataclasses.replace(view, camera=cam))
