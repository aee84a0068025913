"""Costs, paths and best planes of a depth sweep on a GPU: torch for costs and parabola, a Warp kernel for the paths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from warpgs.kernels.plane_costs import NEUTRAL
from warpgs.priors.sweep_cpu import path_costs
from warpgs.priors.sweep_planes import (
    NOISE,
    PLANES_AT_ONCE,
    UNIT,
    SweepConfig,
    gray_of,
    plane_homography,
)
from warpgs.scene import View

MAPS = 24
"""Number of float32 maps of a plane that exist while its costs are computed."""


def needed_bytes(view: View, planes: int) -> int:
    """Return the largest device memory [bytes] that `inverse_depths` takes for a view and ``planes`` planes."""
    return view.camera.width * view.camera.height * (4 * planes + 4 * MAPS * min(planes, PLANES_AT_ONCE))


def matching_costs(view: View, others: Sequence[View], inverses: np.ndarray, window: int, device: torch.device) -> torch.Tensor:
    """Return the costs of `sweep_cpu.matching_costs`, without its padding planes, int16, shape [H, W, D], on the device."""

    def box(maps: torch.Tensor) -> torch.Tensor:
        r = window // 2
        return torch.nn.functional.avg_pool2d(torch.nn.functional.pad(maps, (r, r, r, r), mode="reflect"), window, 1)

    own, *grays = [torch.from_numpy(gray_of(v))[None, None].to(device) for v in (view, *others)]
    width, height = view.camera.width, view.camera.height
    x = torch.arange(width, dtype=torch.float32, device=device)
    y = torch.arange(height, dtype=torch.float32, device=device)[:, None]
    mean = box(own)
    variance = (box(own * own) - mean * mean).clamp(min=0) + NOISE
    costs = torch.empty(height, width, len(inverses), dtype=torch.int16, device=device)
    for first in range(0, len(inverses), PLANES_AT_ONCE):
        chosen, least, total = inverses[first : first + PLANES_AT_ONCE], None, 0
        for other, gray in zip(others, grays):
            to_other = np.stack([plane_homography(view.camera, other.camera, w) for w in chosen])
            H = torch.from_numpy(to_other).to(device, torch.float32)[..., None, None]  # [P, 3, 3, 1, 1]
            p = [H[:, i, 0] * x + H[:, i, 1] * y + H[:, i, 2] for i in range(3)]
            sides = (other.camera.width, other.camera.height)
            # with centres as grid_sample has them without align_corners; with it, torch would load cuDNN
            at = torch.stack([(2 * p[i] / p[2] + 1) / n - 1 for i, n in enumerate(sides)], -1)  # [P, H, W, 2]
            # outside is -1, which is less than any colour, also where a pixel is partly outside
            raised = (gray + 1).expand(len(chosen), -1, -1, -1)
            warped = torch.nn.functional.grid_sample(raised, at, align_corners=False) - 1
            m = box(warped)
            v = (box(warped * warped) - m * m).clamp(min=0) + NOISE
            cost = 0.5 - 0.5 * (box(own * warped) - mean * m) / (variance * v).sqrt()
            cost = torch.where(warped >= 0, cost, NEUTRAL)
            total = total + cost
            least = cost if least is None else torch.minimum(least, cost)
        found = (0.5 * least + total * (0.5 / len(others))).clamp(0, 1) * UNIT
        costs[..., first : first + len(chosen)] = found.round()[:, 0].permute(1, 2, 0).to(torch.int16)
    return costs


def best_inverse(costs: torch.Tensor, inverses: np.ndarray) -> np.ndarray:
    """Return inverse depths [1/u] as `plane_depths.best_inverses` does, float64, shape [H, W], on the host."""
    k = costs.argmin(2, keepdim=True).clamp(1, len(inverses) - 2)
    left, middle, right = (costs.gather(2, k + o).double() for o in (-1, 0, 1))
    bend = left - 2 * middle + right
    offset = torch.where(bend > 1e-9, 0.5 * (left - right) / bend.clamp(min=1e-9), 0).clamp(-1, 1)
    return (inverses[0] + (k + offset) * (inverses[1] - inverses[0]))[..., 0].cpu().numpy()


@torch.no_grad()
def inverse_depths(
    view: View, others: Sequence[View], planes: np.ndarray, config: SweepConfig, device: torch.device
) -> np.ndarray:
    """Return inverse depths [1/u] of a view, float64, shape [H, W], by sweeping planes against at least one other view."""
    costs = matching_costs(view, others, planes, config.window, device)
    return best_inverse(path_costs(costs, view.image, config.small_step, config.large_step), planes)
