"""`sweep` on a GPU: the same costs, paths and parabola in float32, by torch.

Torch and not kernels of our own: it takes a tenth of a second a view, and only once a fit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from warpgs.priors.sweep import EDGE, NO_OPINION, NOISE, PLANES_AT_ONCE, SweepConfig, gray_of, plane_homography
from warpgs.scene import View

VOLUMES = 4
"""Float32 volumes [H, W, D] that one view takes at a time, what their parts take included."""


def needed_bytes(view: View, planes: int) -> int:
    """Device memory that `inverse_depths` takes for a view and that many planes [bytes]."""
    return 4 * VOLUMES * planes * view.camera.width * view.camera.height


def matching_costs(view: View, others: Sequence[View], inverses: np.ndarray, window: int, device: torch.device) -> torch.Tensor:
    """As `sweep.matching_costs`, but float32 of shape [H, W, D] on the device."""

    def box(maps: torch.Tensor) -> torch.Tensor:
        r = window // 2
        return torch.nn.functional.avg_pool2d(torch.nn.functional.pad(maps, (r, r, r, r), mode="reflect"), window, 1)

    own, *grays = [torch.from_numpy(gray_of(v))[None, None].to(device) for v in (view, *others)]
    width, height = view.camera.width, view.camera.height
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([columns, rows, torch.ones_like(rows)]).reshape(3, -1).to(device, torch.float32)
    mean = box(own)
    variance = (box(own * own) - mean * mean).clamp(min=0) + NOISE
    costs = torch.empty(height, width, len(inverses), device=device)
    for first in range(0, len(inverses), PLANES_AT_ONCE):
        chosen, least, total = inverses[first : first + PLANES_AT_ONCE], None, 0
        for other, gray in zip(others, grays):
            to_other = np.stack([plane_homography(view.camera, other.camera, w) for w in chosen])
            p = torch.from_numpy(to_other).to(device, torch.float32) @ pixels
            size = torch.tensor([other.camera.width - 1, other.camera.height - 1], dtype=torch.float32, device=device)
            at = (p[:, :2] / p[:, 2:]).transpose(1, 2).reshape(len(chosen), height, width, 2) * (2 / size) - 1
            # outside is -1, which is less than any colour, also where a pixel is partly outside
            raised = (gray + 1).expand(len(chosen), -1, -1, -1)
            warped = torch.nn.functional.grid_sample(raised, at, align_corners=True) - 1
            m = box(warped)
            v = (box(warped * warped) - m * m).clamp(min=0) + NOISE
            cost = 0.5 - 0.5 * (box(own * warped) - mean * m) / (variance * v).sqrt()
            cost = torch.where(warped >= 0, cost, NO_OPINION)
            total = total + cost
            least = cost if least is None else torch.minimum(least, cost)
        costs[..., first : first + len(chosen)] = (0.5 * least + total * (0.5 / len(others)))[:, 0].permute(1, 2, 0)
    return costs


def _add_paths(total: torch.Tensor, costs: torch.Tensor, limits: torch.Tensor, small_step: float) -> None:
    """Add the costs of paths along the first axis and against it to ``total``; all [L, B, D], ``limits`` [L - 1, B]."""
    last = len(costs) - 1
    both = torch.stack([limits, limits.flip(0)], 1)[..., None]
    path = costs[[0, last]]
    total[0] += path[0]
    total[last] += path[1]
    for k in range(1, last + 1):
        lowest, beside = path.amin(2, keepdim=True), path + small_step
        path = torch.minimum(path, lowest + both[k - 1])
        torch.minimum(path[..., 1:], beside[..., :-1], out=path[..., 1:])
        torch.minimum(path[..., :-1], beside[..., 1:], out=path[..., :-1])
        path -= lowest
        path[0] += costs[k]
        path[1] += costs[last - k]
        total[k] += path[0]
        total[last - k] += path[1]


def path_costs(costs: torch.Tensor, image: np.ndarray, small_step: float, large_step: float) -> torch.Tensor:
    """As the sum of `sweep.path_costs` down and across, but of float32 costs [H, W, D] on their device, in their unit."""
    total, colors = torch.zeros_like(costs), torch.from_numpy(image).to(costs.device)
    for c, t, i in ((costs, total, colors), (costs.transpose(0, 1), total.transpose(0, 1), colors.transpose(0, 1))):
        jumps = i.diff(dim=0).abs().amax(2)
        _add_paths(t, c, (large_step * torch.exp(-jumps / EDGE)).clamp(min=1.5 * small_step), small_step)
    return total


def best_inverse(costs: torch.Tensor, inverses: np.ndarray) -> np.ndarray:
    """As `sweep.best_inverse`: inverse depths, float64, shape [H, W], on the host."""
    k = costs.argmin(2, keepdim=True).clamp(1, len(inverses) - 2)
    left, middle, right = (costs.gather(2, k + o).double() for o in (-1, 0, 1))
    bend = left - 2 * middle + right
    offset = torch.where(bend > 1e-9, 0.5 * (left - right) / bend.clamp(min=1e-9), 0).clamp(-1, 1)
    return (inverses[0] + (k + offset) * (inverses[1] - inverses[0]))[..., 0].cpu().numpy()


@torch.no_grad()
def inverse_depths(
    view: View, others: Sequence[View], planes: np.ndarray, config: SweepConfig, device: torch.device
) -> np.ndarray:
    """Inverse depths [1/u] of a view, float64, shape [H, W], by sweeping the planes against at least one other view."""
    costs = matching_costs(view, others, planes, config.window, device)
    return best_inverse(path_costs(costs, view.image, config.small_step, config.large_step), planes)
