"""What each Gaussian may be: its highest degree of harmonics and its least width, held after every step."""

from __future__ import annotations

import torch

from warpgs.pipeline.train.strategies.clone_split import DensityUpdate

FINEST = 12**-0.5
"""Least standard deviation of an axis, in pixels of the nearest view that sees the Gaussian: that of one pixel's box filter."""
NONE = torch.finfo(torch.float32).min
"""Least log scale of a Gaussian that has no limit."""
FLOAT = 4
"""Bytes of a stored number."""


def model_bytes(degrees: torch.Tensor) -> int:
    """Bytes of a model whose Gaussians have these degrees [N] and store no coefficient above: float32, nothing compressed."""
    return FLOAT * int((11 + 3 * (degrees.long() + 1) ** 2).sum())


def truncated(sh: torch.Tensor, degrees: torch.Tensor) -> torch.Tensor:
    """Coefficients [N, K, 3] with zeros above each Gaussian's degree [N], int."""
    bands = torch.arange(sh.shape[1], device=sh.device).add(0.5).sqrt().long()
    return torch.where((bands <= degrees[:, None])[..., None], sh, 0)


def pack(sh: torch.Tensor, degrees: torch.Tensor) -> torch.Tensor:
    """The coefficients [N, K, 3] that Gaussians of these degrees [N] have, one after the other, in one row.

    Raises:
        ValueError: The degrees do not ascend: stored degree-sorted, equal degrees make one uniform block.
    """
    if bool((degrees.diff() < 0).any()):
        raise ValueError("degrees must ascend; sort the Gaussians by degree first")
    blocks = [sh[degrees == d, : (d + 1) ** 2].reshape(-1) for d in range(4)]
    return torch.cat(blocks)


def unpack(packed: torch.Tensor, degrees: torch.Tensor) -> torch.Tensor:
    """The coefficients [N, K, 3] that `pack` stored, K that of the highest degree, zeros above each Gaussian's degree."""
    highest = int(degrees.max()) if len(degrees) else 0
    sh, at = packed.new_zeros(len(degrees), (highest + 1) ** 2, 3), 0
    for d in range(highest + 1):
        rows = degrees == d
        size = 3 * (d + 1) ** 2 * int(rows.sum())
        sh[rows, : (d + 1) ** 2] = packed[at : at + size].reshape(-1, (d + 1) ** 2, 3)
        at += size
    return sh


class ParameterBounds:
    """Limits of every Gaussian, row by row in step with the optimizer."""

    def __init__(self, count: int, degree: int, device: torch.device):
        self.highest = degree
        """Degree of new Gaussians."""
        self.degree = torch.full((count,), degree, dtype=torch.int32, device=device)
        """Highest degree that each may have, shape [N]."""
        self.floor = torch.full((count,), NONE, device=device)
        """Least log scale of each, shape [N]."""
        self.level = torch.zeros(count, dtype=torch.int32, device=device)
        """Level of growth that each came with, 0 for those before, shape [N]."""
        self.growing = 0
        """Level that new Gaussians come with."""

    @torch.no_grad()
    def enforce(self, params: dict[str, torch.Tensor]) -> None:
        """Bring parameters to where they may be, in place.

        A second time changes nothing, so a recorded step that is not taken may end with it.
        """
        log_scales, sh = params["log_scales"].detach(), params["sh"].detach()
        log_scales.copy_(torch.maximum(log_scales, self.floor[:, None]))
        if self.highest > 0:
            sh.copy_(truncated(sh, self.degree))

    def set_footprint(self, footprint: torch.Tensor) -> None:
        """Take the least scales from the width of a pixel [N] [u]; where that is 0, there is none."""
        self.floor = torch.log(FINEST * footprint).clamp_min(NONE)

    def apply(self, change: DensityUpdate) -> None:
        """Follow a change of the set: what grew from another has its limits, but the level of now."""
        for name, fresh in (("degree", self.highest), ("floor", NONE), ("level", self.growing)):
            old = getattr(self, name)
            new = old.new_full((len(change.parents),), fresh)
            if name != "level" and len(new):
                new = torch.where(change.parents >= 0, old[change.parents.clamp_min(0)], new)
            setattr(self, name, torch.cat([old[change.keep], new]))

    def reorder(self, order: torch.Tensor) -> None:
        """Row i becomes what row ``order[i]`` was."""
        self.degree, self.floor, self.level = self.degree[order], self.floor[order], self.level[order]

    def state(self) -> dict[str, torch.Tensor]:
        """All by name, for the checkpoint."""
        return {"limits.degree": self.degree, "limits.floor": self.floor, "limits.level": self.level}

    def load(self, state: dict[str, torch.Tensor]) -> None:
        """Take over what `state` gave."""
        device = self.degree.device
        self.degree, self.floor, self.level = (state[f"limits.{n}"].to(device) for n in ("degree", "floor", "level"))
