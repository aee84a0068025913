"""Gaussians and cameras that many tests draw: clouds, hand-placed ones, and cameras with lenses."""

import dataclasses

import cv2
import numpy as np
import torch

from warpgs.constants import RULES
from warpgs.geometry import rotation_matrices
from warpgs.scene import ActivatedGaussians, Camera, CovarianceGaussians, Gaussians

# Hand-placed and random scenes for the rasterizer's tests.

SMOOTH = dataclasses.replace(RULES["exact"], name="smooth", alpha_cut=0.0, transmittance_stop=0.0)
"""No cut-off and no stop: the image is a smooth function of everything, so finite differences can be trusted."""


def hand_placed(dtype=torch.float64, device="cpu", degree: int = 3) -> Gaussians:
    """Six Gaussians at distinct depths; the last two lie outside the image on either side, where the Jacobian is clamped."""
    generator = torch.Generator().manual_seed(3)
    means = [[-0.5, -0.3, 3.0], [0.4, 0.2, 3.5], [0.1, -0.2, 4.0], [-0.2, 0.4, 4.6], [3.3, 0.1, 3.2], [-0.3, -3.4, 3.7]]
    count = len(means)
    tensors = {
        "means": torch.tensor(means, dtype=torch.float64),
        "quats": torch.randn(count, 4, generator=generator, dtype=torch.float64),
        "log_scales": torch.log(torch.rand(count, 3, generator=generator, dtype=torch.float64) * 0.8 + 0.2),
        "logit_opacities": torch.tensor([0.5, -0.3, 1.0, 0.8, 0.3, 0.1], dtype=torch.float64),
        "sh": torch.randn(count, (degree + 1) ** 2, 3, generator=generator, dtype=torch.float64) * 0.1,
    }
    return Gaussians(**{n: t.to(device, dtype) for n, t in tensors.items()})


def cloud(count: int, dtype=torch.float32, device="cpu", seed: int = 0, degree: int = 1) -> Gaussians:
    """Many small Gaussians in front of `camera`."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    tensors = {
        "means": (rand(count, 3) - 0.5) * torch.tensor([4.0, 3.0, 2.0]) + torch.tensor([0.0, 0.0, 4.0]),
        "quats": rand(count, 4) - 0.5,
        "log_scales": torch.log(rand(count, 3) * 0.15 + 0.01),
        "logit_opacities": 4 * rand(count) - 2,
        "sh": rand(count, (degree + 1) ** 2, 3) - 0.5,
    }
    return Gaussians(**{n: t.to(device, dtype) for n, t in tensors.items()})


def camera(width: int = 18, height: int = 17, cameras: int | None = None, dtype=torch.float64, device="cpu") -> Camera:
    """A camera at the origin with an off-centre principal point; or a batch, each turned and shifted a little more."""
    focal = 1.2 * max(width, height)
    K = torch.tensor([[focal, 0, 0.5 * width + 0.3], [0, 1.1 * focal, 0.5 * height - 0.4], [0, 0, 1]], dtype=torch.float64)
    poses = []
    for i in range(cameras or 1):
        a, b = 0.11 * i, 0.07 * i
        turn_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        turn_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.from_numpy(turn_y @ turn_x)
        pose[:3, 3] = torch.tensor([0.1, -0.05, 0.2]) * i
        poses.append(pose)
    viewmats, Ks = torch.stack(poses).to(device, dtype), K.expand(len(poses), 3, 3).to(device, dtype)
    return Camera(viewmats, Ks, width, height) if cameras else Camera(viewmats[0], Ks[0], width, height)


def leaves(gaussians: Gaussians) -> Gaussians:
    return Gaussians(**{n: t.detach().clone().requires_grad_() for n, t in gaussians.tensors().items()})


def of_kind(kind: str, stored: Gaussians):
    """Return Gaussians held another way: stored, activated or covariances; they require gradients."""
    t = {n: v.detach() for n, v in stored.tensors().items()}
    scales, opacities = t["log_scales"].exp(), t["logit_opacities"].sigmoid()
    if kind == "covariances":
        half = rotation_matrices(torch.nn.functional.normalize(t["quats"])) * scales[:, None]
        values = (CovarianceGaussians, t["means"], half @ half.mT, opacities, t["sh"])
    elif kind == "activated":
        values = (ActivatedGaussians, t["means"], t["quats"], scales, opacities, t["sh"])
    else:
        values = (Gaussians, *t.values())
    return values[0](*(v.clone().requires_grad_() for v in values[1:]))


def shapes_of(g: Gaussians) -> torch.Tensor:
    axes = torch.as_tensor(rotation_matrices(torch.nn.functional.normalize(g.quats.double(), dim=1)))
    return axes @ torch.diag_embed((2 * g.log_scales.double()).exp()) @ axes.mT


def finite(*tensors) -> bool:
    return all(bool(torch.isfinite(t).all()) for t in tensors)


# Cameras with each lens, and the same lens by OpenCV.

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
