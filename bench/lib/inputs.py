"""Seeded inputs for all benches: a random cloud, and the photographed points of the garden that gsplat's tests use."""

from __future__ import annotations

import numpy as np
import torch

from warpgs.scene import C0, Camera, Gaussians


def gaussians(count: int, device: torch.device, degree: int = 3) -> Gaussians:
    """Return a cloud in front of `camera`. Its Gaussians shrink as their number grows, so that coverage stays similar."""
    generator = torch.Generator().manual_seed(0)
    means = (torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([4.0, 3.0, 2.0]) + torch.tensor([0.0, 0.0, 4.0])
    scales = (torch.rand(count, 3, generator=generator) + 0.1) * 0.8 * count ** (-1 / 3)
    tensors = {
        "means": means,
        "quats": torch.randn(count, 4, generator=generator),
        "log_scales": torch.log(scales),
        "logit_opacities": torch.randn(count, generator=generator),
        "sh": torch.randn(count, (degree + 1) ** 2, 3, generator=generator) * 0.2,
    }
    return Gaussians(**{n: t.to(device).requires_grad_() for n, t in tensors.items()})


def camera(width: int, height: int, device: torch.device, cameras: int = 1) -> Camera:
    """Return a batch of cameras that look along +z: the first at the origin, each further one 0.1 u to the side."""
    K = torch.tensor([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]])
    viewmats = torch.eye(4).repeat(cameras, 1, 1)
    viewmats[:, 0, 3] = -0.1 * torch.arange(cameras)
    return Camera(viewmats.to(device), K.repeat(cameras, 1, 1).to(device), width, height)


def image(width: int, height: int, device: torch.device, seed: int = 0) -> torch.Tensor:
    """Return random colours in [0, 1], shape [H, W, 3]."""
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed)).to(device)


def garden_inputs(
    path: str, *, tiles: int = 1, sh_degree: int = 3, width: int = 648, height: int = 420, seed: int = 0, device="cuda"
) -> tuple[Gaussians, Camera]:
    """Return Gaussians on the points of `test_garden.npz`, and its three cameras.

    Points within 2 u of the origin (112k of them), repeated on a grid of ``tiles`` x ``tiles`` cells. Scales
    are uniform up to 0.02 u, rotations and opacities uniform, colours the points' own with small random higher degrees.
    """
    data = np.load(path)
    points, colors = data["means3d"], data["colors"].astype(np.float32) / 255
    inside = (np.abs(points) < 2).all(1)
    points, colors = points[inside], colors[inside]
    shifts = [(i - tiles // 2, j - tiles // 2) for i in range(tiles) for j in range(tiles)]
    points = np.concatenate([points + np.array([4.0 * i, 4.0 * j, 0], np.float32) for i, j in shifts])
    colors = np.concatenate([colors] * len(shifts))

    generator = torch.Generator().manual_seed(seed)
    count, coefficients = len(points), (sh_degree + 1) ** 2
    sh = torch.randn(count, coefficients, 3, generator=generator) * 0.1
    # Colours keep half a step of 8 bits from 0: exactly there the clamp of colours at 0 has no gradient to compare.
    sh[:, 0] = (torch.from_numpy(colors).clamp_min(0.5 / 255) - 0.5) / C0
    tensors = {
        "means": torch.from_numpy(points),
        "quats": torch.randn(count, 4, generator=generator),
        "log_scales": torch.log(torch.rand(count, 3, generator=generator) * 0.02 + 1e-6),
        "logit_opacities": torch.logit(torch.rand(count, generator=generator).clamp(1e-4, 1 - 1e-4)),
        "sh": sh,
    }
    gaussians = Gaussians(**{n: t.float().to(device).contiguous().requires_grad_() for n, t in tensors.items()})
    Ks = data["Ks"].copy()
    Ks[:, 0] *= width / float(data["width"])
    Ks[:, 1] *= height / float(data["height"])
    viewmats = torch.from_numpy(data["viewmats"]).float().to(device)
    return gaussians, Camera(viewmats, torch.from_numpy(Ks).float().to(device), width, height)


def first_camera(camera: Camera) -> Camera:
    """Return the first camera of a batch, still a batch."""
    return Camera(camera.viewmat[:1], camera.K[:1], camera.width, camera.height)
