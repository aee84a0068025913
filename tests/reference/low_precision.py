"""Whole images by three references of the rasterizer, dense and differentiable by autograd: `r64`, `r64c` and `p32`.

`r64` is the truth of the model: float64, every Gaussian in every pixel. `r64c` is the truth of the algorithm: float64 with
the cut-offs of a rule. `p32` is what a plain program gets: `r64c` line by line in float32, in the textbook form with an
inverse covariance ("conic"), whose quadratic form cancels for needles.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import torch
from torch.utils.checkpoint import checkpoint

from tests.reference.project import project_reference
from warpgs.constants import LARGEST_ALPHA, Rule

PAIRS = 1 << 22
"""Gaussian-pixel pairs at a time: pixels are worked on in parts, each computed again for its gradient, to bound memory."""


class Frame(NamedTuple):
    """Size of the whole image [px], spherical-harmonics degree, and the part that is rendered: left, top, width, height."""

    width: int
    height: int
    degree: int
    window: tuple[int, int, int, int]


class Inputs(NamedTuple):
    """All inputs that an image depends on smoothly; of one scalar type, shapes as `rasterize` takes them, one camera."""

    means: torch.Tensor
    quats: torch.Tensor
    log_scales: torch.Tensor
    logit_opacities: torch.Tensor
    sh: torch.Tensor
    viewmat: torch.Tensor
    K: torch.Tensor
    background: torch.Tensor

    def to(self, dtype: torch.dtype) -> Inputs:
        """Return the same numbers as leaves of another type on the CPU."""
        return Inputs(*(t.detach().cpu().to(dtype).requires_grad_() for t in self))


class Images(NamedTuple):
    """rgb [H, W, 3], alpha [H, W], depth [H, W] of the window."""

    rgb: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor


class ProjectedGaussians(NamedTuple):
    """Gaussians front to back: conics xx, xy, yy; ``ids`` among the inputs; ``sigmas`` [N, 2] of the axes [px], short first."""

    means: torch.Tensor
    conics: torch.Tensor
    opacities: torch.Tensor
    colors: torch.Tensor
    depths: torch.Tensor
    ids: torch.Tensor
    sigmas: torch.Tensor


class Layers(NamedTuple):
    """Effect of every Gaussian in every pixel, [N, P]: Mahalanobis distance squared, alpha before its clamp and after, whether
    it passes the cut, transmittance in front of it were there no stop, whether it is blended."""

    power: torch.Tensor
    raw: torch.Tensor
    alpha: torch.Tensor
    drawn: torch.Tensor
    before: torch.Tensor
    blended: torch.Tensor


def model(rule: Rule) -> Rule:
    """A rule without its cut-offs. Near plane and pixel filter stay: without them the model is not defined."""
    return dataclasses.replace(
        rule, name="model", alpha_cut=0.0, alpha_max=LARGEST_ALPHA, transmittance_stop=0.0,
        inclusive_stop=True, square_sigma=0.0,
    )  # fmt: skip


def projected_of(inputs: Inputs, frame: Frame, rule: Rule) -> ProjectedGaussians:
    """Project, leave out what lies before the near plane or has no inverse covariance, and sort by depth, ties by number."""
    means, covs, colors, depths, opacities = project_reference(
        *inputs[:5], inputs.viewmat[None], inputs.K[None],
        width=frame.width, height=frame.height, degree=frame.degree, low_pass=rule.low_pass,
    )  # fmt: skip
    a, b, c = covs[0, :, 0, 0], covs[0, :, 0, 1], covs[0, :, 1, 1]
    det = a * c - b * b
    sound = (depths[0] >= rule.near) & (det > 0)
    ids = torch.argsort(depths[0].detach(), stable=True)
    ids = ids[sound[ids]]
    conics = torch.stack([c, -b, a], -1)[ids] / det[ids, None]
    sigmas = torch.linalg.eigvalsh(covs[0].detach()[ids].double()).clamp_min(0).sqrt().to(means.dtype)
    return ProjectedGaussians(means[0][ids], conics, opacities[ids], colors[0][ids], depths[0][ids], ids, sigmas)


def squares(projected: ProjectedGaussians, frame: Frame, rule: Rule, tile_size: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return for each Gaussian the columns [N, W] and rows [N, H] of the tiles that its square touches."""
    flags = []
    half = torch.ceil(rule.square_sigma * projected.sigmas[:, 1]).double()
    for axis, size in enumerate((frame.width, frame.height)):
        mean = projected.means[:, axis].detach().double()
        margin = 0.01 + 2e-6 * (mean.abs() + half)
        inside = ((torch.arange(size) + 0.5)[None] - mean[:, None]).abs() <= (half + margin)[:, None]
        padded = torch.nn.functional.pad(inside, (0, -size % tile_size)).view(len(mean), -1, tile_size)
        touched = padded.any(-1).repeat_interleave(tile_size, 1)
        begin, count = frame.window[axis], frame.window[2 + axis]
        flags.append(touched[:, begin : begin + count])
    return flags[0], flags[1]


def pixel_centers(frame: Frame, dtype: torch.dtype) -> torch.Tensor:
    """Centres of the window's pixels [px], row by row, [P, 2]."""
    x, y, width, height = frame.window
    ys, xs = torch.meshgrid(
        torch.arange(y, y + height, dtype=dtype) + 0.5, torch.arange(x, x + width, dtype=dtype) + 0.5, indexing="ij"
    )
    return torch.stack([xs, ys], -1).view(-1, 2)


def layers(pixels: torch.Tensor, reach: torch.Tensor | None, projected: ProjectedGaussians, rule: Rule) -> Layers:
    """Kerbl et al. 2023, equation 3, with the cut-offs of a rule; ``reach`` [N, P] is True where tiles let one contribute."""
    dx = pixels[None, :, 0] - projected.means[:, 0, None]
    dy = pixels[None, :, 1] - projected.means[:, 1, None]
    xx, xy, yy = (projected.conics[:, k, None] for k in range(3))
    power = xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy
    raw = projected.opacities[:, None] * torch.exp(-0.5 * power)
    alpha = torch.where(raw > rule.alpha_max, torch.full_like(raw, rule.alpha_max), raw)
    drawn = (power >= 0) & (alpha >= rule.alpha_cut)  # a negative power is the conic's rounding, and skipped everywhere
    if reach is not None:
        drawn = drawn & reach
    # transmittance never grows, so the first Gaussian that fails the stop ends the pixel for all behind it
    before = torch.empty_like(alpha)
    T = torch.ones_like(before[0])
    for i, row in enumerate(torch.where(drawn, alpha, 0).detach()):
        before[i] = T
        T = T * (1 - row)
    after = torch.cat([before[1:], T[None]])
    blended = drawn & ((before if rule.inclusive_stop else after) >= rule.transmittance_stop)
    return Layers(power, raw, alpha, drawn, before, blended)


def composite(found: Layers, projected: ProjectedGaussians, background: torch.Tensor) -> torch.Tensor:
    """Colour, alpha and depth [P, 5], front to back, every sum in the scalar type of the inputs."""
    T = torch.ones_like(found.power[0])
    sums = T.new_zeros(len(T), 5)
    values = torch.cat([projected.colors, projected.depths[:, None], torch.ones_like(projected.depths[:, None])], 1)
    for alpha, value in zip(torch.where(found.blended, found.alpha, 0), values):
        sums = sums + (alpha * T)[:, None] * value
        T = T * (1 - alpha)
    total = sums[:, 4:]
    depth = sums[:, 3:4] / torch.where(total > 0, total, 1)
    return torch.cat([sums[:, :3] + T[:, None] * background, 1 - T[:, None], depth], 1)


def parts(projected: ProjectedGaussians, frame: Frame, rule: Rule, tile_size: int):
    """Pixels part by part, with what tiles let each Gaussian reach there (None: everything)."""
    pixels = pixel_centers(frame, projected.means.dtype)
    count = max(1, PAIRS // max(1, len(projected.means)))
    columns = rows = None
    if rule.square_sigma > 0:
        columns, rows = squares(projected, frame, rule, tile_size)
    for begin in range(0, len(pixels), count):
        numbers = torch.arange(begin, min(begin + count, len(pixels)))
        width = frame.window[2]
        reach = None if columns is None else columns[:, numbers % width] & rows[:, numbers // width]
        yield pixels[begin : begin + count], reach


def draw(inputs: Inputs, frame: Frame, rule: Rule, tile_size: int = 16) -> Images:
    """Return the images in the scalar type of the inputs, differentiable in all of them."""
    projected = projected_of(inputs, frame, rule)
    width, height = frame.window[2:]
    if len(projected.ids) == 0:
        empty = inputs.means.new_zeros(height, width)
        return Images(inputs.background.expand(height, width, 3), empty, empty)

    def part(pixels, reach, background, *fields):
        those = ProjectedGaussians(*fields)
        return composite(layers(pixels, reach, those, rule), those, background)

    made = [
        checkpoint(part, pixels, reach, inputs.background, *projected, use_reentrant=False)
        for pixels, reach in parts(projected, frame, rule, tile_size)
    ]
    picture = torch.cat(made).view(height, width, 5)
    return Images(picture[..., :3], picture[..., 3], picture[..., 4])


def r64(inputs: Inputs, frame: Frame, rule: Rule) -> Images:
    """The truth of the model that a rule approximates."""
    return draw(_checked(inputs, torch.float64), frame, model(rule))


def r64c(inputs: Inputs, frame: Frame, rule: Rule, tile_size: int = 16) -> Images:
    """The truth of the algorithm."""
    return draw(_checked(inputs, torch.float64), frame, rule, tile_size)


def p32(inputs: Inputs, frame: Frame, rule: Rule, tile_size: int = 16) -> Images:
    """The plain program in float32."""
    return draw(_checked(inputs, torch.float32), frame, rule, tile_size)


def _checked(inputs: Inputs, dtype: torch.dtype) -> Inputs:
    if any(t.dtype != dtype for t in inputs):
        raise TypeError(f"this twin works in {dtype}: give it inputs.to({dtype})")
    return inputs
