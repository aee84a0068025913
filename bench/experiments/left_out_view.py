"""Strategy holdout with a whole training view as evidence, in place of blocks of every view; measured in docs/complexity.md.

``python -m bench.presets DATA --rows fern:3 --presets default default:strategy=left_out_view``
"""

from __future__ import annotations

import torch

from warpgs.pipeline.train.strategies.base import register
from warpgs.pipeline.train.strategies.holdout import Holdout
from warpgs.pipeline.train.strategies.holdout_blocks import Blocks, sample_blocks
from warpgs.pipeline.train.views import TrainingView

MIN_VIEWS = 3
"""Fewest training views of which one is left out; below, blocks of every view are held out."""


def center(viewmat: torch.Tensor) -> torch.Tensor:
    """Return the centre of a camera from its matrix [4, 4], float64, shape [3] [u]."""
    m = torch.as_tensor(viewmat).double()
    return -m[:3, :3].T @ m[:3, 3]


def central_view(centers: torch.Tensor) -> int:
    """Return the number of the camera whose summed distance to the others is least, from centers [V, 3] [u]."""
    return int(torch.cdist(centers, centers).sum(1).argmin())


@register("left_out_view")
class LeftOutView(Holdout):
    """Holdout whose blocks tile the most central training view, which is not trained on until growth ends."""

    def hold_out(self, views: list[TrainingView]) -> tuple[list[Blocks], list[TrainingView]]:
        """Return blocks that tile the left-out view and none of the others, and the other views."""
        if len(views) < MIN_VIEWS:
            return super().hold_out(views)
        chosen = central_view(torch.stack([center(v.camera.viewmat) for v in views]))
        none = Blocks(1, torch.zeros(0, 2, dtype=torch.int64))
        own = sample_blocks([views[chosen]], 1.0, self.trainer.config.seed)[0]
        return [own if i == chosen else none for i in range(len(views))], [v for i, v in enumerate(views) if i != chosen]
