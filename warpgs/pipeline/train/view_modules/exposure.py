"""Exposure of training views: an affine map of rendered colours for each view, learned with the Gaussians.

A camera with automatic exposure and white balance changes the colours between photographs. With exposures a step compares the
view's image with A rgb + b of its render. The learned parameters are the 12 numbers of [A - 1 | b], which start at zero. A step
subtracts their mean over all training views, so that the model has the mean exposure. Otherwise all exposures could become
darker and the Gaussians brighter, with the same colours in the training views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from warpgs.errors import UsageError
from warpgs.pipeline.metrics.evaluate import render_view
from warpgs.pipeline.metrics.matched_psnr import RULE, matched_psnr
from warpgs.pipeline.train.schedule import check_lrs, log_linear
from warpgs.pipeline.train.view_modules.base import FittedViews, Tensors, ViewModule, register
from warpgs.runtime.derivatives import first_order
from warpgs.runtime.step_sizes import FLOAT, LOSS, Needs, StepSizes
from warpgs.scene import View

EXPOSURE = "exposure_affine"
"""Name of the parameters: rows of [A - 1 | b], shape [V, 12]."""
CHANNELS = 3
GRAY = 0.5
"""Gray for which the brightness under an exposure is reported."""


def exposure_of(rows: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
    """Return the exposure [..., 12] of views: their parameters ``own`` [..., 12] minus the mean of all views' ``rows`` [V, 12].

    No gradient flows through the mean: only the rows of ``own`` get one.
    """
    # in float64, so that the float32 result is the same for any number of threads
    return own - rows.detach().mean(0, dtype=torch.float64).to(own.dtype)


class _Exposed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rgb: torch.Tensor, exposure: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(rgb, exposure)
        m = exposure.view(CHANNELS, CHANNELS + 1)
        # explicit sums, since the order of summation in a matrix product depends on the library
        found = rgb + m[:, CHANNELS]
        for k in range(CHANNELS):
            found += rgb[..., k : k + 1] * m[:, k]
        return found

    @staticmethod
    @first_order
    def backward(ctx: Any, v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        rgb, exposure = ctx.saved_tensors
        m = exposure.view(CHANNELS, CHANNELS + 1)
        v_rgb = v.clone()
        for c in range(CHANNELS):
            v_rgb += v[..., c : c + 1] * m[c, :CHANNELS]
        columns = [(v * rgb[..., k : k + 1]).sum((0, 1), dtype=torch.float64) for k in range(CHANNELS)]
        columns.append(v.sum((0, 1), dtype=torch.float64))
        return v_rgb, torch.stack(columns, -1).reshape(-1).to(exposure.dtype)


def exposed(rgb: torch.Tensor, exposure: torch.Tensor) -> torch.Tensor:
    """Return colours [H, W, 3] under an exposure [12], rows of [A - 1 | b]; differentiable in both."""
    found: torch.Tensor = _Exposed.apply(rgb, exposure)
    return found


@register("exposure")
@dataclass(frozen=True)
class Exposure(ViewModule):
    """Learn an affine map of colours for each training view, for photographs with different brightness or white balance.

    Held-out views and renders do not use the maps: scores are those of the model's own colours (docs/your-photos.md).
    """

    lr: float = 5e-3
    """Learning rate of the exposures at the start."""
    decay: float = 0.1
    """Learning rate at the last step, as a fraction of the first; log-linear in between."""
    weight: float = 0.01
    """Weight of the squared difference between each view's exposure and the identity, in [0, 1000]."""

    def __post_init__(self) -> None:
        check_lrs(self.name, lr=self.lr, decay=self.decay)
        if not 0 <= self.weight <= 1000:
            raise UsageError(f"exposure: `weight` must be between 0 and 1000, not {self.weight}")

    def check(self, views: Sequence[View]) -> None:
        """Check that no view has an alpha channel: an exposure would change the background with the object.

        Raises:
            UsageError: A view has an alpha channel.
        """
        for v in views:
            if v.alpha is not None:
                raise UsageError(
                    f"--exposure does not support images with an alpha channel, such as {v.name}; leave out --exposure"
                )

    def parameters(self, views: Sequence[View]) -> dict[str, torch.Tensor]:
        """Return zeros, shape [V, 12]."""
        return {EXPOSURE: torch.zeros(len(views), CHANNELS * (CHANNELS + 1), dtype=torch.float32, device="cpu")}

    def lrs(self, progress: float, extent: float) -> dict[str, float]:
        """Return the learning rate, which falls from the first step on."""
        return {EXPOSURE: self.lr * log_linear(1.0, self.decay, progress)}

    def values(self, params: Tensors, numbers: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return `exposure_of` the views, shape [B, 12]."""
        rows = params[EXPOSURE]
        return {EXPOSURE: exposure_of(rows, rows.index_select(0, numbers))}

    def after_render(self, rgb: torch.Tensor, values: Tensors) -> torch.Tensor:
        """Return `exposed` colours, shape [H, W, 3]."""
        return exposed(rgb, values[EXPOSURE])

    def regularisation(self, values: Tensors) -> torch.Tensor:
        """Return ``weight`` times the sum of squares of [A - 1 | b], shape []: it pulls exposures towards the identity."""
        square = values[EXPOSURE].double().square().sum()
        return (self.weight * square).to(values[EXPOSURE].dtype)

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of the render after its exposure, which exists beside the plain render."""
        return {LOSS: FLOAT * CHANNELS * sizes.pixels}

    def figures(self, fitted: FittedViews) -> dict[str, Any]:
        """Return the learned exposures and their effect.

        Returns:
            ``views``, for each training view [A | b] as 3 rows of 4, and ``gain``, the mean over channels of a middle gray
            after exposure, divided by that gray; ``matched_psnr``, the mean PSNR of held-out views after colour matching [dB],
            None without held-out views; ``summary``.
        """
        rows = fitted.params[EXPOSURE].double()
        numbers = exposure_of(rows, rows).detach().cpu().numpy().reshape(-1, CHANNELS, CHANNELS + 1)
        maps = numbers + np.eye(CHANNELS, CHANNELS + 1)
        gains = (maps[..., :CHANNELS].sum(-1) + maps[..., CHANNELS] / GRAY).mean(-1)
        each = zip(fitted.train, maps, gains, strict=True)
        views = [{"name": n, "affine": m.tolist(), "gain": float(g)} for n, m, g in each]
        summary = (
            f"exposures learned: the training views are {gains.min():.2f} to {gains.max():.2f} times as bright as the model, "
            "which has their mean exposure; scores use renders without learned exposures"
        )
        renders = ((v, render_view(fitted.gaussians, v, fitted.options)[0]) for v in fitted.test)
        scores = [s for v, image in renders if np.isfinite(s := matched_psnr(v, image))]
        mean = float(np.mean(scores)) if scores else None
        if mean is not None:
            summary += f"; held-out PSNR {mean:.2f} dB {RULE}"
        return {"views": views, "matched_psnr": mean, "summary": summary}
