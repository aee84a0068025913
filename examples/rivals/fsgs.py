"""FSGS (Zhu et al., ECCV 2024, arXiv 2312.00451) as a plug-in: proximity-guided unpooling, and correlation with given depth.

    warpgs fit path/to/scene --out run --preset examples/rivals/fsgs.py:fsgs --split llff:3

A Gaussian is far from its neighbours if its mean distance to the three nearest ones exceeds a threshold. Then a Gaussian is
added in the middle of each edge to them (`FSGS`). Rendered depth correlates with a depth map of the view (`FsgsDepth`): that of
`--depths`, else the disparity of `--depth-model`, else of the depth sweep.
Constants are those of the authors' `train.py` and `arguments` (VITA-Group/FSGS, 034e21ba); that the paper has the same ones
is not confirmed.
Missing here: the network DPT in the loop, which estimates depth of renders from random cameras (weight 0.5, from step 2000 to
9500). The authors add Gaussians only at those larger than the extent, whose mean squared distance exceeds 5 extents in units of
the files; ours is a distance in extents of the scene.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import warpgs
from warpgs.train import (
    CloneSplit,
    DensityUpdate,
    LossInputs,
    Prior,
    TrainingView,
    register_loss_term,
    register_strategy,
    total,
)

import torch

NEIGHBOURS = 3
"""Edges of each Gaussian in the proximity graph."""
CHUNK = 2**24
"""Largest number of distances that are in memory at the same time."""
MIN_ALPHA = 0.5
"""Opacity above which a pixel has a depth."""
FLAT = 1e-6
"""Variance, relative to the squared mean, up to which a map is constant and has no correlation."""


@dataclass(frozen=True)
class FsgsConfig:
    """Settings of the strategy."""

    distance: float = 1.0
    """Mean distance to the nearest Gaussians above which some are added, as a fraction of the scene's extent
    (Proximity-guided Gaussian Unpooling). The authors' threshold is 0.9 to 1.3 extents on fern, horns, room and trex."""
    until: float = 0.2
    """Fraction of the steps after which none are added by distance: 2000 of 10,000."""


def neighbours(means: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return distances to the nearest other points of each point [N, 3], and their rows, shape [N, 3]; N is at least 4."""
    near, start = [], 0
    for part in means.split(max(1, CHUNK // len(means))):
        distances = torch.cdist(part, means, compute_mode="donot_use_mm_for_euclid_dist")
        rows = torch.arange(len(part), device=means.device)
        distances[rows, start + rows] = torch.inf  # no neighbour of itself
        near.append(distances.topk(NEIGHBOURS, largest=False))
        start += len(part)
    return torch.cat([n.values for n in near]), torch.cat([n.indices for n in near])


@register_strategy("fsgs")
class FSGS(CloneSplit):
    """Clones and splits as 3DGS; early in a fit, also adds Gaussians in the middle of long edges of the proximity graph."""

    Config = FsgsConfig

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Refine and reset opacities, each if it is due; then add Gaussians between distant ones."""
        yield from super().update(step)
        if self.gradients.refines(step) and step <= self.config.until * self.context.steps:
            yield self.unpooled()

    def unpooled(self) -> DensityUpdate:
        """Return the change that adds Gaussians with the size and opacity of the edge's end, not rotated, and gray."""
        context, gaussians = self.context, self.context.gaussians
        everyone = torch.arange(len(gaussians), device=context.device)
        if len(gaussians) <= NEIGHBOURS:
            return DensityUpdate(everyone)
        distances, ends = neighbours(gaussians.means)
        far = (distances.mean(1) > self.config.distance * context.extent).nonzero().squeeze(1)
        free = max(0, context.capacity - len(gaussians))
        begins, ends = far.repeat_interleave(NEIGHBOURS)[:free], ends[far].flatten()[:free]
        added = {n: t[ends] for n, t in gaussians.tensors().items()}
        added["means"] = (gaussians.means[begins] + added["means"]) / 2
        added["quats"] = torch.zeros_like(added["quats"]).index_fill(1, torch.zeros_like(everyone[:1]), 1.0)
        added["sh"] = torch.zeros_like(added["sh"])
        return DensityUpdate(everyone, added, ends)


def correlation(a: torch.Tensor, b: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Return Pearson's correlation of two maps over the pixels with weight 1, not 0, all [H, W]; 0 if a map is constant."""
    count = weight.sum().clamp_min(1)
    one, two = (m - (total(m * weight) / count).expand(len(m), 1) for m in (a, b))
    one, two = one * weight, two * weight
    of_one, of_two = total(one * one) / count, total(two * two) / count
    flat = (of_one <= FLAT * total(a.detach() ** 2 * weight) / count) | (of_two <= FLAT * total(b**2 * weight) / count)
    spread = torch.where(flat, 1, of_one).sqrt() * torch.where(flat, 1, of_two).sqrt()
    return torch.where(flat, 0, total(one * two) / count / spread)


@register_loss_term("fsgs_depth")
@dataclass(frozen=True)
class FsgsDepth(warpgs.LossTerm):
    """1 minus the correlation of rendered depth with a depth map of the view, in the first part of a fit."""

    needs_outputs: ClassVar[tuple[str, ...]] = ("alpha", "depth")
    needs_priors: ClassVar[bool] = True
    weight: float = 0.05
    """Weight of the term, in [0, 1000]."""
    until: float = 0.95
    """Fraction of the steps in which the term is active: 9500 of 10,000; the authors' weight falls to 0.001 then."""

    def needs(self, view: TrainingView, prior: Prior | None) -> dict[str, torch.Tensor]:
        """Return depth, negated disparity where none is given, and 1 where the map is known, else 0, shape [H, W, 2]."""
        if view.depth is not None:
            return {"fsgs_depth": torch.stack([view.depth, (view.depth > 0).to(view.depth.dtype)], -1)}
        assert prior is not None  # `needs_priors`
        disparity = torch.as_tensor(prior.disparity, dtype=torch.float32, device=view.image.device)
        return {"fsgs_depth": torch.stack([-disparity, torch.ones_like(disparity)], -1)}

    def active(self, step: int, steps: int) -> bool:
        """Return whether the step lies in the first fraction ``until`` of all steps."""
        return step <= self.until * steps

    def __call__(self, inputs: LossInputs) -> torch.Tensor:
        """Compute the weighted term, shape []; 1 times the weight if a map is constant."""
        given, known = inputs.target.maps["fsgs_depth"].unbind(-1)
        known = (known == 1) & (inputs.outputs["alpha"] > MIN_ALPHA)  # half-sized views have means over pixels
        known = known if inputs.target.mask is None else known & (inputs.target.mask > 0)
        depth = torch.where(known, inputs.outputs["depth"], 0)
        return self.weight * (1 - correlation(depth, given, known.to(depth.dtype)))


fsgs = {
    "base": "3dgs",
    "about": "FSGS (Zhu et al. 2024), 10000 steps",
    "strategy": FSGS,
    "loss-terms": [FsgsDepth],
    "loss.depth-weight": 0,
    "steps": 10_000,
    "sh-every": 500,
    "optimizer.scales-lr": 0.005,
    "density.gradient": 5e-4,
    "density.stop-fraction": 1.0,
    "density.prune-size": 0,
    "density.reset-every": 3000,
    "density.reset-opacity": 0.05,
}
