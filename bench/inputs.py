"""Seeded inputs for the benches of single ops."""

from __future__ import annotations

import torch

from warpgs.scene import Camera, Gaussians


def counts(device: torch.device, tiny: bool) -> list[int]:
    """Numbers of Gaussians."""
    return [100] if tiny else [1000, 10_000, 100_000] + ([1_000_000] if device.type == "cuda" else [])


def sizes(device: torch.device, tiny: bool) -> list[tuple[int, int]]:
    """Widths and heights [px]."""
    return [(40, 30)] if tiny else [(256, 256), (504, 378)] + ([(1920, 1080)] if device.type == "cuda" else [])


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


def camera(width: int, height: int, device: torch.device) -> Camera:
    """One camera at the origin, as a batch of one."""
    K = torch.tensor([[[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]]])
    return Camera(torch.eye(4)[None].to(device), K.to(device), width, height)
