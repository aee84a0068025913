"""NexusGS (Zheng et al., CVPR 2025, arXiv 2503.18794) as a preset: start from epipolar depth, and its densification.

    warpgs fit path/to/scene --out run --preset examples/rivals/nexusgs.py:nexusgs --split llff:3

Of the paper: the start by flow, with depth where the match is at most 1 px from its epipolar line, of the source view that is
least sensitive to errors along the line (`--init.source flow`), and a point for each such pixel (`merge-px` and `fill-px` 0);
growth until the last step with a threshold of 5e-4, into four Gaussians (`NexusGS`); opacities lowered to 0.05 every 3000
steps; a scale rate of 0.03. Constants are those of the authors' code for LLFF; that the paper has the same ones is not
confirmed. Ours: checks of the flow there and back, the parallax and the sign of the depth.
Missing here: the flow of FlowFormer++; give its files or its network with `--init.flow`, which is `dis` otherwise.
"""

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass

from warpgs.train import CloneSplit, DensityUpdate, register_strategy

import torch

PARENT_SCALE = 0.8
"""A child's scale is the parent's, divided by this factor and the number of children, as in 3DGS."""


@dataclass(frozen=True)
class NexusConfig:
    """Settings of the strategy."""

    children: int = 4
    """Gaussians that replace a split one; not confirmed by the paper."""


def split(rows: dict[str, torch.Tensor], children: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Return the children of each Gaussian of rows [S, ...], shape [children S, ...]; the first S are at their parents' means.

    The other offsets are random, with the parents' standard deviations times ``children - 1``.
    """
    count, others = len(rows["means"]), children - 1
    added = {n: t.repeat(children, *[1] * (t.ndim - 1)) for n, t in rows.items()}
    noise = torch.randn(others * count, 3, generator=generator).to(rows["means"].device)  # repeatable: the fit's generator
    noise = torch.cat([torch.zeros_like(rows["means"]), noise * others * added["log_scales"][count:].exp()])
    w, *vector = (added["quats"] / added["quats"].norm(dim=1, keepdim=True)).unbind(1)
    axis = torch.stack(vector, 1)
    cross = 2 * torch.linalg.cross(axis, noise)
    added["means"] = added["means"] + noise + w[:, None] * cross + torch.linalg.cross(axis, cross)
    added["log_scales"] = added["log_scales"] - math.log(PARENT_SCALE * children)
    return added


@register_strategy("nexusgs")
class NexusGS(CloneSplit):
    """Clones and splits as 3DGS, but a large Gaussian becomes four, as far as the capacity allows; else two."""

    Config = NexusConfig

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Refine, with more children of each split, then reset opacities, each if it is due."""
        for change in super().update(step):
            yield self.widened(change)

    def widened(self, change: DensityUpdate) -> DensityUpdate:
        """Return the change with all children of the Gaussians that it splits into two."""
        children, context = self.config.children, self.context
        parents, counts = change.parents.unique(return_counts=True)
        free = max(0, context.capacity - len(change.keep) - len(change.parents))
        parents = parents[counts == 2][: free // max(1, children - 2)]
        rows = {n: t[parents] for n, t in context.gaussians.tensors().items()}
        new = split(rows, children, context.generator)
        stay = ~torch.isin(change.parents, parents)
        return dataclasses.replace(
            change,
            added={n: torch.cat([t[stay], new[n]]) for n, t in change.added.items()},
            parents=torch.cat([change.parents[stay], parents.repeat(children)]),
        )


nexusgs = {
    "base": "3dgs",
    "about": "NexusGS (Zheng et al. 2025), 30000 steps",
    "strategy": NexusGS,
    "steps": 30_000,
    "sh-every": 500,
    "init.source": "flow",
    "init.merge-px": 0,
    "init.fill-px": 0,
    "optimizer.scales-lr": 0.03,
    "density.gradient": 5e-4,
    "density.stop-fraction": 1.0,
    "density.prune-size": 0,
    "density.reset-every": 3000,
    "density.reset-opacity": 0.05,
}
