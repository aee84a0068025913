"""A ball of opaque Gaussians, red on one side and blue on the other, and cameras that look at it."""

import numpy as np
import torch

from warpgs.geometry import look_at
from warpgs.scene import C0, Camera, Gaussians

RADIUS = 1.0
CENTER = np.array([0.4, -0.2, 0.3])
RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)


def ball(count: int = 3000) -> Gaussians:
    i = np.arange(count) + 0.5
    y, turn = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - y * y)
    out = np.stack([r * np.cos(turn), y, r * np.sin(turn)], 1)
    colors = np.where(out[:, :1] > 0, RED, BLUE)
    spacing = RADIUS * np.sqrt(4 * np.pi / count)
    return Gaussians(
        torch.tensor(CENTER + RADIUS * out, dtype=torch.float32),
        torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4).contiguous(),
        torch.full((count, 3), float(np.log(0.45 * spacing))),
        torch.full((count,), 3.0),
        torch.tensor((colors - 0.5) / C0, dtype=torch.float32)[:, None],
    )


def cameras(directions: np.ndarray, side: int = 72) -> list[Camera]:
    """Return cameras 3.5 u from the centre, in directions [C, 3], that look at it."""
    K = np.array([[1.4 * side, 0, side / 2 + 0.3], [0, 1.4 * side, side / 2 - 0.2], [0, 0, 1.0]])
    found = []
    for d in directions:
        up = np.array([0.0, -1, 0]) if abs(d[1]) < 0.9 else np.array([1.0, 0, 0])
        found.append(Camera(look_at(CENTER + 3.5 * d / np.linalg.norm(d), CENTER, up), K, side, side))
    return found


ALL_SIDES = np.concatenate([np.eye(3), -np.eye(3), np.array([[1, 1, 1], [-1, 1, 1], [1, -1, -1], [-1, -1, 1]])])
"""Directions around the ball."""
