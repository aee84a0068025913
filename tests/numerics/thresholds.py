"""Where float32 may rightly decide otherwise than float64: pixels with a Gaussian within rounding of a threshold.

Derivation of every closeness: docs/numerics.md. A pixel outside these bands has no excuse.
"""

from __future__ import annotations

import dataclasses

import torch

from tests.reference.low_precision import Frame, Inputs, ProjectedGaussians, layers, parts, projected_of
from warpgs.constants import Rule

EPS = 2.0**-23
"""Spacing of float32 at 1."""


@dataclasses.dataclass(frozen=True)
class Band:
    """Pixels near a threshold, and by how much the picture may jump there."""

    reasons: dict[str, torch.Tensor]
    """Mask [H, W] by threshold: alpha cut, stop, clamp, near, equal depth, square."""
    jump: torch.Tensor
    """Largest change of colour or alpha that the decisions in question can make, [H, W]."""
    layers: int
    """Most Gaussians that a pixel blends."""
    largest_color: float
    """Largest colour of any Gaussian or of the background, at least 1."""
    largest_depth: float
    """Largest depth of any Gaussian [u]."""

    @property
    def mask(self) -> torch.Tensor:
        """Pixels in any band [H, W]."""
        return torch.stack(list(self.reasons.values())).any(0)


def ulp(value: float) -> float:
    """Spacing of float32 at a value."""
    x = torch.tensor(value, dtype=torch.float32)
    return float(torch.nextafter(x, torch.tensor(float("inf"))) - x)


def uncertainties(inputs: Inputs, projected: ProjectedGaussians, frame: Frame) -> tuple[torch.Tensor, torch.Tensor]:
    """How far rounding may move each projected mean [px] and each depth [u]: two tensors [N]."""
    reach = inputs.means[projected.ids].norm(dim=1) + inputs.viewmat[:3, 3].norm()
    depth = 2 * EPS * reach
    focal = torch.maximum(inputs.K[0, 0], inputs.K[1, 1])
    size = max(frame.width, frame.height)
    pixel = 2**0.5 * (1.5 * ulp(size) + depth * (focal + size) / projected.depths)
    return pixel, depth


@torch.no_grad()
def band(inputs: Inputs, frame: Frame, rule: Rule, tile_size: int = 16) -> Band:
    """Bands of the float64 picture of a rule."""
    projected = projected_of(inputs, frame, rule)
    width, height = frame.window[2:]
    count = len(projected.ids)
    names = ("cut", "stop", "clamp", "near", "order", "square")
    if count == 0:
        nothing = torch.zeros(height, width)
        return Band({n: nothing.bool() for n in names}, nothing.double(), 0, 1.0, 1.0)
    pixel, depth = uncertainties(inputs, projected, frame)
    # an axis of s1 px turned by a rounded rotation moves its end across the other axis
    short, long = projected.sigmas.clamp_min(rule.low_pass**0.5).unbind(1)
    largest = float(torch.cat([projected.colors.flatten(), inputs.background, torch.ones(1).double()]).max())
    lags = 1
    while lags < count and bool((projected.depths[lags:] - projected.depths[:-lags] <= 2 * depth[lags:]).any()):
        lags += 1
    at_near = bool(
        ((inputs.means @ inputs.viewmat[2, :3] + inputs.viewmat[2, 3] - rule.near).abs() <= float(depth.max())).any()
    )

    flags, jumps, most = {n: [] for n in names}, [], 0
    wider = dataclasses.replace(rule, square_sigma=rule.square_sigma * (1 + 64 * EPS))
    narrower = dataclasses.replace(rule, square_sigma=rule.square_sigma * (1 - 64 * EPS))
    spans = zip(*(parts(projected, frame, r, tile_size) for r in (rule, wider, narrower)))
    for (pixels, reach), (_, wide), (_, narrow) in spans:
        f = layers(pixels, reach, projected, rule)
        most = max(most, int(f.blended.sum(0).max()))
        r = f.power.clamp_min(0).sqrt()
        u = 64 * EPS + r * (pixel[:, None] + 8 * EPS * r * long[:, None]) / short[:, None]
        running = f.before >= rule.transmittance_stop * (1 - 1e-3)
        reached = torch.ones_like(running) if wide is None else wide
        cut = running & reached & (torch.log(f.raw / rule.alpha_cut).abs() <= u)
        above = torch.log(f.raw / rule.alpha_max)
        clamped = above > u
        clamp = running & f.drawn & (above.abs() <= u)
        # relative error of transmittance: those of 1 - alpha add up
        alpha = torch.where(f.drawn, f.alpha, 0)
        each = torch.where(clamped, 0, u) * alpha / (1 - alpha).clamp_min(1 - rule.alpha_max) + 4 * EPS / (1 - alpha)
        drift = torch.cumsum(torch.where(f.drawn, each, 0), 0)
        if rule.inclusive_stop:
            tested, drift = f.before, torch.cat([torch.zeros_like(drift[:1]), drift[:-1]])
        else:
            tested = f.before * (1 - alpha)
        stop = f.drawn & ((tested - rule.transmittance_stop).abs() <= drift * rule.transmittance_stop)
        order, swapped = torch.zeros_like(cut), torch.zeros_like(r)
        for lag in range(1, lags):
            close = (projected.depths[lag:] - projected.depths[:-lag] <= 2 * depth[lag:])[:, None]
            both = close & running[:-lag] & f.drawn[:-lag] & f.drawn[lag:]
            order[:-lag] |= both
            swapped[:-lag] += torch.where(both, f.before[:-lag] * alpha[:-lag] * alpha[lag:], 0)
        square = torch.zeros_like(cut) if wide is None else running & (wide != narrow) & (f.alpha >= rule.alpha_cut)
        found = {"cut": cut, "stop": stop, "clamp": clamp, "order": order, "square": square}
        for name, where in found.items():
            flags[name].append(where.any(0))
        flags["near"].append(torch.full_like(cut[0], at_near))
        # a Gaussian more or less changes the pixel by its weight; a stop, by all that it lets through
        jump = torch.where(cut | square, f.before * f.alpha, 0) + torch.where(stop, f.before, 0) + swapped
        jumps.append(largest * (jump.sum(0) + float(at_near)))
    shape = (height, width)
    reasons = {n: torch.cat(v).view(shape) for n, v in flags.items()}
    return Band(reasons, torch.cat(jumps).view(shape), most, largest, float(projected.depths.max()))
