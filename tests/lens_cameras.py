"""Cameras with each lens, and the same lens by OpenCV."""

import dataclasses

import cv2
import numpy as np
import torch

from tests.gaussians import camera
from warpgs.scene import Camera

COEFFICIENTS = {
    "orthographic": (),
    "opencv": (-0.2, 0.05, 0.01, -0.02, 0.01, 0.03, -0.02, 0.01),
    "fisheye": (0.05, -0.02, 0.01, -0.002),
}
"""Strong ones, all of them other than 0."""
LENSES = list(COEFFICIENTS)


def lens_camera(model: str, **options) -> Camera:
    """Return `tests.gaussians.camera` with a lens; an orthographic one shows about the same at depth 4."""
    cam = camera(**options)
    K = cam.K.clone()
    if model == "orthographic":
        K[..., [0, 1], [0, 1]] /= 4
    lens = torch.tensor(COEFFICIENTS[model], dtype=torch.float64).to(K)
    distortion = lens.expand(*K.shape[:-2], len(lens)).contiguous() if len(lens) else None
    return dataclasses.replace(cam, K=K, model=model, distortion=distortion)


def opencv_pixels(model: str, coefficients, K: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return the pixels [N, 2] of positions in the camera [N, 3] as OpenCV has them."""
    zero, lens = np.zeros(3), np.array(coefficients, float)
    if model == "fisheye":
        return cv2.fisheye.projectPoints(positions[:, None], zero, zero, K, lens)[0][:, 0]
    return cv2.projectPoints(positions, zero, zero, K, lens)[0][:, 0]
