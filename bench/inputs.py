"""Seeded inputs for all benches."""

from __future__ import annotations

import torch

from warpgs.scene import Camera, Gaussians


def gaussians(count: int, device: torch.device, degree: int = 3) -> Gaussians:
    """A cloud in front of `camera` whose Gaussians shrink as their number grows, so that cover stays alike."""
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
    """A batch of cameras that look along +z: the first at the origin, each further one 0.1 u to the side."""
    K = torch.tensor([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]])
    viewmats = torch.eye(4).repeat(cameras, 1, 1)
    viewmats[:, 0, 3] = -0.1 * torch.arange(cameras)
    return Camera(viewmats.to(device), K.repeat(cameras, 1, 1).to(device), width, height)


def image(width: int, height: int, device: torch.device, seed: int = 0) -> torch.Tensor:
    """Random colours in [0, 1], shape [H, W, 3]."""
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed)).to(device)
