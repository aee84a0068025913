"""Where Gaussians are added and removed during a fit: clone, split, prune (Kerbl et al. 2023, section 5.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from warpgs.errors import UsageError
from warpgs.scene import Gaussians, Render

REST = 500
"""Steps before the set is left alone in which no opacity is reset any more: what is transparent then stays so."""


@dataclass(frozen=True)
class DensityConfig:
    """Thresholds and times of densification."""

    start: int = 500
    """First step after which Gaussians are added and removed."""
    every: int = 100
    """Steps between two such events."""
    stop_share: float = 0.5
    """Share of the fit after which the set is left alone."""
    gradient: float = 2e-4
    """Mean gradient of the projected mean, in half image widths and heights, above which a Gaussian is densified."""
    clone_size: float = 0.01
    """Gaussians smaller than this share of the extent are cloned, larger ones split."""
    prune_opacity: float = 0.005
    """Gaussians below this opacity are removed."""
    prune_size: float = 0.1
    """Gaussians larger than this share of the extent are removed, once an opacity reset has happened, but not where more than
    half of all are; 0 for never."""
    reset_every: int = 0
    """Steps between opacity resets, 3000 in Kerbl et al. 2023; 0 for none. With few views a reset costs decibels that the
    rest of the fit does not win back (docs/decisions/002-no-opacity-reset.md)."""
    reset_opacity: float = 0.01
    """Largest opacity after a reset."""
    morton_order: bool = True
    """Whether the Gaussians are sorted along a Morton curve after each event (docs/decisions/009-morton-order.md)."""
    max_gaussians: int = 1_000_000
    """No more Gaussians than this, from the start on."""

    def __post_init__(self):
        if self.every < 1 or self.start < 0 or self.reset_every < 0 or self.max_gaussians < 1:
            raise UsageError("density: every and max gaussians must be at least 1, start and reset every at least 0")
        for name in ("stop_share", "prune_opacity"):
            if not 0 <= getattr(self, name) <= 1:
                raise UsageError(f"density {name.replace('_', ' ')} {getattr(self, name)} must lie between 0 and 1")
        for name in ("gradient", "clone_size", "prune_size"):
            if not getattr(self, name) >= 0:
                raise UsageError(f"density {name.replace('_', ' ')} must be at least 0, not {getattr(self, name)}")
        if not 0 < self.reset_opacity < 1:
            raise UsageError(f"density reset opacity {self.reset_opacity} must lie between 0 and 1")

    def times(self, steps: int) -> tuple[int, int, int]:
        """First event, interval and last event [steps] in a fit of that length; a short fit starts after a quarter of it."""
        return min(self.start, steps // 4), self.every, int(self.stop_share * steps)

    def due(self, step: int, steps: int, until: int) -> tuple[bool, bool]:
        """Whether the set is refined, and opacities reset, after a step of a fit in which ``until`` is the last such step."""
        start, every, _ = self.times(steps)
        refines = start < step <= until and step % every == 0
        return refines, self.reset_every > 0 and step <= until - REST and step % self.reset_every == 0


@dataclass(frozen=True)
class Refinement:
    """Which rows stay, and what is appended after them."""

    keep: torch.Tensor
    """Numbers of the surviving rows in ascending order, int64, shape [S]."""
    added: dict[str, torch.Tensor]
    """New rows of each of the five tensors."""
    parents: torch.Tensor
    """For each new row the number of the row it grew from, -1 for none, int64, shape [A]."""


class DensityStats:
    """What the backward passes since the last event said of each Gaussian."""

    def __init__(self, count: int, device: torch.device):
        self.gradient = torch.zeros(count, device=device)
        """Sum of the norms of the gradient of the projected mean, in half image sizes, shape [N]."""
        self.seen = torch.zeros(count, device=device)
        """Number of images in which the Gaussian was visible, shape [N]."""

    def add(self, render: Render) -> None:
        """Take in one backward pass; ``render.splats`` must have retained its gradient."""
        height, width = render.alpha.shape[-2:]
        self.add_gradient(render.splats.grad, render.visible, width, height)

    def add_gradient(self, v_splats: torch.Tensor, visible: torch.Tensor, width: int, height: int, weight=1) -> None:
        """The same from the gradient of the records [C, N, 12] and visibility [C, N]; ``weight`` 0 takes in nothing."""
        # a product with a tensor of the two sizes would copy them to the device, which a recorded step must not
        norms = torch.hypot(v_splats[..., 0] * (0.5 * width), v_splats[..., 1] * (0.5 * height))
        self.gradient += torch.where(visible, norms, 0).sum(0) * weight
        self.seen += visible.sum(0) * weight

    def apply(self, change: Refinement) -> None:
        """Keep what is known of the rows that stay; nothing is known of new ones."""
        fresh = torch.zeros(len(change.parents), device=self.seen.device)
        self.gradient = torch.cat([self.gradient[change.keep], fresh])
        self.seen = torch.cat([self.seen[change.keep], fresh])

    def state(self) -> dict[str, torch.Tensor]:
        """Both tensors by name, for the checkpoint."""
        return {"density.gradient": self.gradient, "density.seen": self.seen}

    def load(self, state: dict[str, torch.Tensor]) -> None:
        """Take over what `state` gave."""
        self.gradient = state["density.gradient"].to(self.gradient.device)
        self.seen = state["density.seen"].to(self.seen.device)


def _logit(p: float) -> float:
    """Return the inverse sigmoid of a number in [0, 1]; infinite at both ends."""
    return math.log(p / (1 - p)) if 0 < p < 1 else math.copysign(math.inf, p - 0.5)


def _exp(x: torch.Tensor) -> torch.Tensor:
    """Return e^x by way of float64: float32's has other last digits on other processors (MKL)."""
    return x.double().exp().to(x.dtype)


def _split(gaussians: dict[str, torch.Tensor], ids: torch.Tensor, generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Two children for each: drawn from the parent's own distribution, 1.6 times smaller (Kerbl et al. 2023)."""
    pair = ids.repeat(2)
    rows = {n: t[pair] for n, t in gaussians.items()}
    noise = torch.randn(len(pair), 3, generator=generator).to(ids.device) * _exp(rows["log_scales"])
    w, *vector = (rows["quats"] / rows["quats"].norm(dim=1, keepdim=True)).unbind(1)
    axis = torch.stack(vector, 1)
    cross = 2 * torch.linalg.cross(axis, noise)
    rows["means"] = rows["means"] + noise + w[:, None] * cross + torch.linalg.cross(axis, cross)
    rows["log_scales"] = rows["log_scales"] - math.log(1.6)
    return rows


def refine(
    gaussians: Gaussians,
    stats: DensityStats,
    config: DensityConfig,
    *,
    extent: float,
    after_reset: bool,
    generator: torch.Generator,
    growing: torch.Tensor | None = None,
    protected: torch.Tensor | None = None,
) -> Refinement:
    """Clone small Gaussians and split large ones where the image pulls at them; prune the transparent and the huge.

    Args:
        gaussians: The current set, N rows.
        stats: What the images said since the last event.
        config: Thresholds.
        extent: Size of the scene [u].
        after_reset: An opacity reset has happened, so size pruning is on.
        generator: CPU generator for the children's positions; the same numbers on every device.
        growing: Gaussians that may be cloned and split, bool, shape [N]; None for all.
        protected: Gaussians that are not pruned, bool, shape [N]; None for none.

    Returns:
        Rows that stay and rows to append. At least one Gaussian always stays, the most opaque.
    """
    with torch.no_grad():
        tensors = {n: t.detach() for n, t in gaussians.tensors().items()}
        scales = _exp(tensors["log_scales"].amax(1))
        logits = tensors["logit_opacities"]  # torch's sigmoid depends on the number of threads in its last digit
        pull = stats.gradient / stats.seen.clamp_min(1)
        grows = pull > config.gradient
        if growing is not None:
            grows &= growing
            pull = torch.where(growing, pull, 0)
        room = max(0, config.max_gaussians - len(gaussians))
        if int(grows.sum()) > room:
            strongest = torch.topk(pull, room).indices
            grows = torch.zeros_like(grows).index_fill(0, strongest, True) & grows
        small = scales <= config.clone_size * extent
        faint = ~(logits >= _logit(config.prune_opacity))
        if after_reset and config.prune_size > 0:
            huge = scales > config.prune_size * extent
            if 2 * int(huge.sum()) <= len(gaussians):  # else it is the extent that is small: the cameras stand close together
                faint |= huge
        if protected is not None:
            faint &= ~protected
        if bool(faint.all()):
            faint[logits.argmax()] = False
        cloned = torch.nonzero(grows & small & ~faint).squeeze(1)
        split = torch.nonzero(grows & ~small & ~faint).squeeze(1)
        remove = faint.clone()
        remove[split] = True
        children = _split(tensors, split, generator)
        added = {n: torch.cat([t[cloned], children[n]]) for n, t in tensors.items()}
        return Refinement(torch.nonzero(~remove).squeeze(1), added, torch.cat([cloned, split.repeat(2)]))
