"""Views at half their size, which a fit may start with: a quarter of the pixels, for the steps that place what is coarse."""

from __future__ import annotations

import torch
from torch.nn.functional import interpolate

from warpgs.pipeline.train.strategies.importance_sampling import TrainingView
from warpgs.scene import Camera


def halved(view: TrainingView) -> TrainingView:
    """The view with both sides halved, rounded down but to at least one pixel; without scores, which belong to whole views.

    Colours and disparities are means over what a pixel covers, and a pixel counts where all of that does.
    """
    c = view.camera
    width, height = max(1, c.width // 2), max(1, c.height // 2)
    scale = torch.tensor([width / c.width, height / c.height, 1.0], dtype=c.K.dtype, device=c.K.device)

    def mean(maps: torch.Tensor) -> torch.Tensor:
        return interpolate(maps[None], (height, width), mode="area")[0]

    image = mean(view.image.permute(2, 0, 1)).permute(1, 2, 0).contiguous()
    mask = None if view.mask is None else (mean(view.mask[None])[0] > 1 - 1e-4).to(view.mask.dtype)
    disparity = None if view.disparity is None else mean(view.disparity[None])[0]
    camera = Camera(c.viewmat, scale[:, None] * c.K, width, height)
    return TrainingView(camera, image, mask, disparity=disparity)
