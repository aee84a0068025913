"""Inverse depths of a view by sweeping planes on the CPU: kernels for costs, paths and the best plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from warpgs.kernels.plane_costs import plane_costs
from warpgs.kernels.plane_depths import best_inverses
from warpgs.kernels.scanlines import scanline_costs
from warpgs.priors.sweep_planes import NOISE, UNIT, SweepConfig, gray_of, plane_homographies, step_limits
from warpgs.scene import View


def matching_costs(view: View, others: Sequence[View], inverses: np.ndarray, window: int) -> torch.Tensor:
    """Return the disagreement of views at D inverse depths [1/u] in units of 1 / `UNIT`, as `plane_costs` does."""
    homographies = plane_homographies(view.camera, [o.camera for o in others], inverses)
    return plane_costs(gray_of(view), [gray_of(o) for o in others], homographies, window, NOISE, UNIT)


def path_costs(costs: torch.Tensor, image: np.ndarray, small_step: float, large_step: float) -> torch.Tensor:
    """Return the sum of the semi-global path costs from four sides.

    Args:
        costs: Matching costs in units of 1 / `UNIT`, int16, shape [H, W, D], on any device.
        image: Colours in [0, 1] whose edges allow jumps, shape [H, W, 3].
        small_step: Penalty for a change of one plane.
        large_step: Penalty for any other change, less across edges of the image (`step_limits`).

    Returns:
        Sums in units of 1 / `UNIT`, int16, shape [H, W, D].
    """
    down, across = (
        torch.from_numpy(step_limits(colors, small_step, large_step).astype(np.int32)).to(costs.device)
        for colors in (image, image.swapaxes(0, 1))
    )
    return scanline_costs(costs, down, across.T, round(small_step * UNIT))


def inverse_depths(view: View, others: Sequence[View], planes: np.ndarray, config: SweepConfig) -> np.ndarray:
    """Return inverse depths [1/u] of a view, float64, shape [H, W], by sweeping planes against at least one other view.

    Args:
        view: The view.
        others: Views to compare it with.
        planes: Inverse depths [1/u] of the planes, ascending, shape [D].
        config: Window, penalties.
    """
    costs = matching_costs(view, others, planes, config.window)
    return best_inverses(path_costs(costs, view.image, config.small_step, config.large_step), planes)
