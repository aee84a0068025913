"""Markov chain Monte Carlo: relocation of dead Gaussians onto live ones, and perturbation of all (Kheradmand et al. 2024).

"3D Gaussian Splatting as Markov Chain Monte Carlo", arXiv 2404.09591. Equation numbers are that paper's.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import torch
import warp as wp

from warpgs.kernels import launch
from warpgs.kernels.native import Floats
from warpgs.kernels.update import Setting
from warpgs.pipeline.model.table import DensityUpdate
from warpgs.pipeline.train.strategies.base import Growth, Strategy, register
from warpgs.scene import Gaussians
from warpgs.schema import Checked, Within

MAX_COPIES = 51
"""Largest number of Gaussians that replace one Gaussian at an event, as in the authors' program."""
MAX_OPACITY = 1 - 2**-24
"""Largest opacity in relocation; it is below 1, so that the logit is finite."""
NOISE_STREAM = 0x6D636D63
"""Constant mixed into the seed, so that noise and opacity dropout use different random numbers."""
GATE_SLOPE, GATE_OPACITY = 100.0, 0.005
"""Perturbation fades above the opacity `GATE_OPACITY`: sigmoid(-slope (opacity - `GATE_OPACITY`)), eq. 8 with k = 100, and with
t = 0.995 for 1 - opacity."""


@dataclass(frozen=True)
class MCMCConfig(Checked, group="mcmc."):
    """Settings of strategy mcmc; the defaults are the paper's."""

    start: Annotated[int, Within(0)] = 500
    """Steps before Gaussians are first relocated and added; at most a quarter of the fit."""
    every: Annotated[int, Within(1)] = 100
    """Steps between events that relocate and add Gaussians."""
    stop_fraction: Annotated[float, Within(0, 1)] = 0.83
    """Fraction of the fit after which no Gaussians are added or relocated; 25,000 of 30,000 steps in the paper."""
    growth: Annotated[float, Within(0, 1)] = 0.05
    """Gaussians added at an event, as a fraction of the current number, up to --max-gaussians."""
    min_opacity: Annotated[float, Within(0, 0.5)] = 0.005
    """Largest opacity of a dead Gaussian, in [0, 0.5]."""
    noise_lr: Annotated[float, Within(0, 1e9)] = 5e5
    """Size of the perturbation, as a multiple of the learning rate of the means."""
    opacity_weight: Annotated[float, Within(0, 1e9)] = 0.01
    """Weight of the mean opacity in the loss."""
    scale_weight: Annotated[float, Within(0, 1e9)] = 0.01
    """Weight of the mean axis length [1/u] in the loss."""


@torch.no_grad()
def relocated(opacities: torch.Tensor, copies: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return opacity and scale factor of each of N Gaussians that replace one Gaussian in one place (eq. 9).

    The new opacity is 1 - (1 - o)^(1/N), so that the N Gaussians together are as opaque at the centre as the original. The
    scales shrink such that the integral over a line through the centre is unchanged. Both are computed in float64, since the
    sum alternates. ``opacities`` o [M] are in (0, 1), and ``copies`` N [M] from 1 to `MAX_COPIES`.
    """
    o, N = opacities.double(), copies.double()
    new = -torch.expm1(torch.log1p(-o) / N)
    integral = torch.zeros_like(o)
    for i in range(1, int(copies.max()) + 1 if len(copies) else 0):
        # i - 1 others lie in front of the i-th of N: new (1 - new)^(i - 1), integrated power by power
        terms = [math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1) for k in range(i)]
        integral += torch.where(copies >= i, sum(terms), 0)
    return new.to(opacities), (o / integral).to(opacities)


@wp.kernel(enable_backward=False, module="warpgs.pipeline.train.strategies.mcmc")
def move(
    begin: int, settings: Floats, seed: int, noise_lr: float, going: wp.array(dtype=wp.bool),
    quats: wp.array(dtype=wp.vec4), log_scales: wp.array(dtype=wp.vec3), logits: Floats,
    # outputs
    means: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Add noise to the mean of a Gaussian."""
    i = begin + wp.tid()
    if not going[0]:
        return
    # one stream of numbers for each seed and step, one part of it for each Gaussian
    state = wp.rand_init(wp.randi(wp.rand_init(seed, int(settings[Setting.NUMBER]))), i)
    noise = wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state))
    q = quats[i]
    rotation = wp.quat_to_matrix(wp.normalize(wp.quat(q[1], q[2], q[3], q[0])))
    s = log_scales[i]
    variances = wp.vec3(wp.exp(2.0 * s[0]), wp.exp(2.0 * s[1]), wp.exp(2.0 * s[2]))
    opacity = 1.0 / (1.0 + wp.exp(-logits[i]))
    gate = 1.0 / (1.0 + wp.exp(wp.static(GATE_SLOPE) * (opacity - wp.static(GATE_OPACITY))))
    moved = rotation * wp.cw_mul(variances, wp.transpose(rotation) * noise)
    means[i] = means[i] + moved * (gate * noise_lr * settings[Setting.MEANS_LR])


def perturb(gaussians: Gaussians, settings: torch.Tensor, going: torch.Tensor, *, seed: int, noise_lr: float) -> None:
    """Add noise, multiplied by each Gaussian's covariance, to its mean, in place; opaque Gaussians get less noise (eq. 8).

    The noise depends only on seed, step and row, so it is the same on every device and in a resumed fit. Step number and
    learning rate are read from ``settings`` [7]; if ``going`` [1] is False, nothing changes.
    """
    g = {n: t.detach() for n, t in gaussians.tensors().items()}
    inputs = [settings, seed, noise_lr, going, g["quats"], g["log_scales"], g["logit_opacities"], g["means"]]
    launch.launch(move, len(gaussians), inputs, settings.device)


@register("mcmc")
class MCMC(Strategy):
    """Relocation of dead Gaussians, addition of new ones up to ``max_gaussians``, and perturbation of all."""

    Config = MCMCConfig

    @classmethod
    def warmup_config(cls, own):
        """Return the settings with an event after every step."""
        return replace(own, start=0, every=1)

    def growth(self) -> Growth:
        """Return the times of relocation and addition."""
        steps = self.context.phases.planned
        return Growth(min(self.config.start, steps // 4), int(self.config.stop_fraction * steps))

    def regularisation(self, phase, gaussians):
        """Return the weighted mean opacity plus the weighted mean axis length, shape []; unneeded Gaussians fade."""
        c = self.config
        # in float64, since the rounding of float32's functions depends on the processor
        opacity, scale = gaussians.logit_opacities.double().sigmoid().mean(), gaussians.log_scales.double().exp().mean()
        return (c.opacity_weight * opacity + c.scale_weight * scale).to(gaussians.log_scales.dtype)

    def after_step(self, phase, settings, going):
        """Perturb the means; nothing changes if ``going`` [1] is False. ``settings`` has shape [7]."""
        t = self.context
        perturb(t.table.gaussians, settings, going, seed=t.seed ^ NOISE_STREAM, noise_lr=self.config.noise_lr)

    def due(self, step: int) -> bool:
        """Return whether Gaussians are relocated and added after a step."""
        return self.growth().due(step, self.config.every)

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Relocate dead Gaussians, then add new ones."""
        t = self.context
        opacities = t.gaussians.logit_opacities.sigmoid()
        dead = torch.nonzero(opacities <= self.config.min_opacity).squeeze(1)
        if 0 < len(dead) < len(t.table):
            yield self._copied(torch.where(opacities <= self.config.min_opacity, 0, opacities), len(dead), onto=dead)
        count = min(t.capacity, int((1 + self.config.growth) * len(t.table))) - len(t.table)
        if count > 0:
            yield self._copied(t.gaussians.logit_opacities.sigmoid(), count, onto=None)

    def _copied(self, weights: torch.Tensor, count: int, onto: torch.Tensor | None) -> DensityUpdate:
        """Return the change that samples ``count`` Gaussians by weight [N] and copies each, onto rows or as new rows."""
        t = self.context
        # on the CPU, where the numbers are the same for every device
        sampled = torch.multinomial(weights.cpu().double(), count, replacement=True, generator=t.generator).to(t.device)
        sources, place, times = torch.unique(sampled, return_inverse=True, return_counts=True)
        g = t.gaussians
        opacities = g.logit_opacities[sources].sigmoid().clamp(self.config.min_opacity, MAX_OPACITY)
        new, factor = relocated(opacities, (times + 1).clamp_max(MAX_COPIES))
        values = {n: v[sources] for n, v in g.tensors().items()}
        values["logit_opacities"] = torch.logit(new.clamp(self.config.min_opacity, MAX_OPACITY))
        values["log_scales"] = values["log_scales"] + factor.log()[:, None]
        copies = {n: v[place] for n, v in values.items()}
        everything = torch.arange(len(t.table), device=t.device)
        if onto is None:
            return DensityUpdate(everything, copies, sampled, overwritten=sources, values=values)
        nothing = {n: v[:0] for n, v in values.items()}
        both = {n: torch.cat([v, copies[n]]) for n, v in values.items()}
        return DensityUpdate(everything, nothing, sampled[:0], overwritten=torch.cat([sources, onto]), values=both)
