"""Held-out views whose cameras are moved to where their images fit a finished model best."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

import warpgs
from warpgs.scene import View

REFINE_STEPS = 100


def refined(gaussians: warpgs.Gaussians, view: View, options: warpgs.RasterizeOptions) -> View:
    """Return a view whose camera was moved to where its image fits a model best; the model is not changed."""
    device = gaussians.means.device
    start, target = (torch.as_tensor(a, dtype=torch.float32, device=device) for a in (view.camera.viewmat, view.image))
    twist = torch.zeros(6, device=device, requires_grad=True)
    optimizer = torch.optim.Adam([twist], lr=2e-3)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.05 ** (1 / REFINE_STEPS))
    still = replace(gaussians, **{n: t.detach() for n, t in gaussians.tensors().items()})
    for _ in range(REFINE_STEPS):
        optimizer.zero_grad()
        rgb = warpgs.rasterize(still, replace(view.camera, viewmat=_turned(start, twist)), options).rgb
        (rgb - target).square().mean().backward()
        optimizer.step()
        schedule.step()
    viewmat = _turned(start, twist).detach().cpu().numpy().astype(np.float64)
    return replace(view, camera=replace(view.camera, viewmat=viewmat))


def _turned(viewmat: torch.Tensor, twist: torch.Tensor) -> torch.Tensor:
    """Return a view matrix [4, 4] turned by ``twist[:3]`` [rad] and shifted by ``twist[3:]`` [u]."""
    x, y, z, *shift = twist.unbind()
    zero = torch.zeros_like(x)
    rows = [torch.stack(r) for r in ([zero, -z, y, shift[0]], [z, zero, -x, shift[1]], [-y, x, zero, shift[2]], [zero] * 4)]
    return torch.linalg.matrix_exp(torch.stack(rows)) @ viewmat
