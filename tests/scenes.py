"""Small scenes with photographs, rings of cameras, and textured planes whose depth is known."""

import math
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import torch

from warpgs.geometry import look_at
from warpgs.render.rasterize import rasterize
from warpgs.scene import C0, Camera, Gaussians, PointCloud, Prior, View

# A tiny scene that Gaussians can fit exactly: three coloured ones, photographed by the rasterizer itself.


def three_gaussians() -> Gaussians:
    """Red, green and blue, at three depths, on nothing."""
    colors = torch.tensor([[0.9, 0.2, 0.1], [0.15, 0.8, 0.2], [0.2, 0.3, 0.95]])
    return Gaussians(
        means=torch.tensor([[-0.35, 0.0, 0.1], [0.3, -0.2, -0.2], [0.1, 0.3, 0.3]]),
        quats=torch.tensor([[1.0, 0, 0, 0], [0.9, 0.2, 0.1, 0.0], [0.8, 0, 0.3, 0.4]]),
        log_scales=torch.log(torch.tensor([[0.2, 0.15, 0.2], [0.25, 0.1, 0.12], [0.15, 0.2, 0.1]])),
        logit_opacities=torch.logit(torch.tensor([0.9, 0.85, 0.95])),
        sh=((colors - 0.5) / C0)[:, None],
    )


def ring(count: int, width: int = 40, height: int = 32) -> list[Camera]:
    """Cameras on an arc of 70 degrees that look at the origin from 2.2 u away."""
    K = np.array([[1.3 * width, 0, 0.5 * width + 0.7], [0, 1.3 * width, 0.5 * height - 0.4], [0, 0, 1.0]])
    cameras = []
    for i, angle in enumerate(np.radians(np.linspace(-35, 35, count))):
        center = 2.2 * np.array([math.sin(angle), 0.15 * (-1) ** i, -math.cos(angle)])
        cameras.append(Camera(look_at(center, np.zeros(3), np.array([0.0, -1, 0])), K, width, height))
    return cameras


def photos(count: int = 6, width: int = 40, height: int = 32) -> list[View]:
    gaussians = three_gaussians()
    return [
        View(f"{i:02d}.png", camera, rasterize(gaussians, camera).rgb.clamp(0, 1).numpy())
        for i, camera in enumerate(ring(count, width, height))
    ]


def seeds(count: int = 60) -> PointCloud:
    """Gray points around the three means."""
    generator = np.random.default_rng(0)
    means = three_gaussians().means.numpy().astype(np.float64)
    points = means[generator.integers(3, size=count)] + 0.12 * generator.standard_normal((count, 3))
    return PointCloud(points, np.full((count, 3), 0.5, np.float32))


def priors(views: list[View]) -> list[Prior]:
    """A tilted plane with a step in it, the bright half of the picture in front, boundaries at the step."""
    found = []
    for v in views:
        height, width = v.image.shape[:2]
        y, x = np.mgrid[:height, :width].astype(np.float32)
        step = (x > width // 2).astype(np.float32)
        boundary = np.exp(-(((x - width / 2) / 3) ** 2)).astype(np.float32)
        disparity = 0.2 * y / height + 0.1 * (x / width) ** 2 + 0.5 * step
        found.append(Prior(disparity / disparity.max(), 0.5 + 0.4 * step, boundary, step, "a plane", "a step"))
    return found


def view_stub(width: int = 504, height: int = 378, **changed: object) -> SimpleNamespace:
    """What the choice of settings reads of a view; all its pixels count unless changed. Its image is small at any size."""
    camera = SimpleNamespace(width=width, height=height)
    return SimpleNamespace(
        **({"camera": camera, "image": np.ones((6, 8, 3)), "mask": None, "alpha": None, "alpha_estimated": False} | changed)
    )


# Photographs of a flat card, computed ray by ray: what a model of it needs is known beforehand.

SUPER = 3
"""Rays along each side of a pixel."""
HALF = 0.7, 0.5
"""Half width and height of the card [u]; it stands in the plane z = 0."""


def textured_photos(
    colour: Callable[[np.ndarray, np.ndarray, float], np.ndarray], count: int = 4, width: int = 96, height: int = 72,
    half: tuple[float, float] = HALF, cameras=None,
) -> list[View]:  # fmt: skip
    """Views of a card on black; ``colour`` takes x, y on the card [u] and the camera's place on the arc, -1 to 1."""
    cameras = ring(count, width, height) if cameras is None else cameras
    views = []
    for i, c in enumerate(cameras):
        rows, columns = np.meshgrid(
            (np.arange(SUPER * height) + 0.5) / SUPER, (np.arange(SUPER * width) + 0.5) / SUPER, indexing="ij"
        )
        rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(c.K).T @ c.viewmat[:3, :3]
        center = c.center
        along = -center[2] / rays[..., 2]
        x, y = (center[k] + along * rays[..., k] for k in (0, 1))
        place = center[0] / 2.2 / np.sin(np.radians(35))
        inside = (np.abs(x) <= half[0]) & (np.abs(y) <= half[1]) & (along > 0)
        fine = np.where(inside[..., None], colour(x, y, place), 0)
        image = fine.reshape(height, SUPER, width, SUPER, 3).mean((1, 3))
        views.append(View(f"{i:02d}.png", c, (np.round(255 * image) / 255).astype(np.float32)))
    return views
