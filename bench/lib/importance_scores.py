"""Scores of pixels for placing fine Gaussians, and gains to compare the scores with.

Candidates are fine Gaussians behind every second pixel of a training view, as an event would place them. The gain of a
candidate over some views is the change of their squared error by its opacity. The first order comes from one backward pass over
all candidates at once, which are almost transparent. The second order uses the curvature of Hutchinson's estimator.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch

from warpgs.constants import Rule
from warpgs.geometry import project_tensors
from warpgs.pipeline.train.sampling import SamplerConfig, blur, fine_gaussians, gains, normalized, residual_of, valid_pixels
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

STRIDE = 2
"""Distance between candidates [px]."""
FAINT = 5e-4
"""Opacity of candidates: all together hide one hundredth of what is behind them."""
LINEAR = Rule("linear", alpha_cut=1e-5)
"""Cut-offs with which candidates are rendered."""
SIGNS = 4
"""Number of images of random signs for estimating a curvature."""
HIDDEN = 6, 0.3
"""Number of renders with opacity dropout whose spread is a score, and their dropout probability."""
NEARLY = 0.05
"""Largest relative difference of depth at which another view sees a point."""


@dataclasses.dataclass(frozen=True)
class Candidates:
    """Candidates of one training view."""

    view: TrainingView
    gate: torch.Tensor
    """Pixels at which an event could place one, bool, shape [H, W]."""
    depth: torch.Tensor
    """Depth that an event would place them at [u], shape [H, W]."""
    at: torch.Tensor
    """Rows and columns of those candidates that pass the gate, shape [K, 2]."""
    rows: dict[str, torch.Tensor]
    """Their parameters, shape [K, ...]."""

    def whole(self, values: torch.Tensor) -> torch.Tensor:
        """Return a map [H, W] of one value per candidate [K], repeated over the pixels between them, 0 where there is none."""
        height, width = self.gate.shape
        coarse = values.new_zeros(-(-height // STRIDE), -(-width // STRIDE))
        coarse[self.at[:, 0] // STRIDE, self.at[:, 1] // STRIDE] = values
        full = coarse.repeat_interleave(STRIDE, 0).repeat_interleave(STRIDE, 1)
        return full[:height, :width].contiguous()


def candidates(gaussians: Gaussians, view: TrainingView, sampler: SamplerConfig, gated: bool, options: RasterizeOptions):
    """Return the candidates of a view, at the depths at which an event places fine Gaussians."""
    render = rasterize(gaussians, view.camera, options)
    depth, alpha = render.depth, render.alpha
    if sampler.depth == "consistent" and view.consistent is not None:
        known = view.consistent > 0
        depth = torch.where(known, view.consistent, depth)
        alpha = torch.where(known, 1.0, 0.0 if gated else alpha)
    gate = valid_pixels(alpha, depth, view.countable, sampler)
    sparse = torch.zeros_like(gate)
    sparse[::STRIDE, ::STRIDE] = gate[::STRIDE, ::STRIDE]
    at = torch.nonzero(sparse)
    faint = dataclasses.replace(sampler, opacity=FAINT)
    return Candidates(view, gate, depth, at, fine_gaussians(view.camera, view.image, depth, at, faint, gaussians.sh.shape[1]))


def opacity_slopes(
    gaussians: Gaussians, extra: dict[str, torch.Tensor] | None, views: Sequence[TrainingView], background: torch.Tensor,
    generator: torch.Generator,
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    """Return the effect of opacities on the sum of squared errors of each view: -slope and half the curvature, each [V, N].

    Args:
        gaussians: The model.
        extra: Rows of candidates, whose effects are returned; None for the effects of the model's own Gaussians.
        views: Views whose pixels count by their masks.
        background: Colour behind the scene, shape [3].
        generator: Generator of random signs, on the CPU.
    """
    rows = gaussians.tensors()
    if extra is not None:
        rows = {n: torch.cat([t, extra[n]]) for n, t in rows.items()}
    first = 0 if extra is None else len(gaussians)
    logits = rows["logit_opacities"].clone().requires_grad_()
    model = Gaussians(**(rows | {"logit_opacities": logits}))
    opacity = torch.sigmoid(logits.detach())
    slope_of_logit = (opacity * (1 - opacity)).clamp_min(1e-12)
    options = RasterizeOptions(rule=LINEAR if extra is not None else "exact", background=background, record=False)
    down, bend = [], []
    for view in views:
        with torch.enable_grad():
            rgb = view.seen(rasterize(model, view.camera, options).rgb)
        counts = torch.ones_like(view.image[..., :1]) if view.countable is None else view.countable[..., None]
        error = 2 * (rgb.detach() - view.image) * counts
        (slope,) = torch.autograd.grad(rgb, logits, error, retain_graph=True)
        squares = torch.zeros_like(opacity)
        for k in range(SIGNS):
            signs = torch.randint(0, 2, rgb.shape, generator=generator).to(rgb) * 2 - 1
            (part,) = torch.autograd.grad(rgb, logits, signs * counts, retain_graph=k + 1 < SIGNS)
            squares += (part / slope_of_logit).square() / SIGNS
        down.append((-slope / slope_of_logit)[first:])
        bend.append(squares[first:])
    return torch.stack(down), torch.stack(bend)


def best_opacity_gain(down: torch.Tensor, bend: torch.Tensor) -> torch.Tensor:
    """Return the largest fall of the squared error by an opacity in [0, 1], from -slope and half the curvature, [N] each."""
    opacity = torch.where(bend > 0, 0.5 * down / bend.clamp_min(1e-12), 1.0).clamp(0, 1)
    return opacity * down - opacity.square() * bend


def residual_elsewhere(
    gaussians: Gaussians, points: torch.Tensor, views: Sequence[TrainingView], options: RasterizeOptions
) -> torch.Tensor:
    """Return the mean blurred squared error at points [K, 3] over the views that see them, [K]; 0 if no view does."""
    total, count = points.new_zeros(len(points)), points.new_zeros(len(points))
    for view in views:
        render = rasterize(gaussians, view.camera, options)
        error = blur((view.seen(render.rgb) - view.image).square().mean(-1), 2.0)
        pixels, depth = project_tensors(view.camera, points)
        size = torch.tensor([view.camera.width, view.camera.height]).to(pixels)
        seen = (depth > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)
        columns, rows = torch.where(seen[:, None], pixels, 0).long().unbind(1)
        seen &= (render.depth[rows, columns] - depth).abs() < NEARLY * depth
        total += torch.where(seen, error[rows, columns], 0)
        count += seen
    return total / count.clamp_min(1)


def warped_gains(
    gaussians: Gaussians,
    found: Sequence[Candidates],
    views: Sequence[TrainingView],
    footprint: float,
    options: RasterizeOptions,
) -> list[dict[str, torch.Tensor]]:
    """Return the gains of the candidates of each view as the package computes them, without rendering them, [K] each."""
    residuals = []
    for view in views:
        render = rasterize(gaussians, view.camera, options)
        residuals.append(residual_of(view, view.seen(render.rgb), render.depth, footprint))
    scores = []
    for number, c in enumerate(found):
        points, colors = c.rows["means"], c.view.image[c.at[:, 0], c.at[:, 1]]
        total, own = gains(points, colors, residuals), gains(points, colors, residuals[number : number + 1])
        scores.append({"warped": total, "warped own": own, "warped others": total - own})
    return scores


def signed_residual(residual: torch.Tensor, footprint: float) -> torch.Tensor:
    """Return the length of a signed colour difference [H, W, 3] after a blur by a footprint [px], shape [H, W]."""
    return torch.stack([blur(channel.contiguous(), footprint) for channel in residual.unbind(-1)], -1).norm(dim=-1)


def dropout_spread(gaussians: Gaussians, camera: Camera, options: RasterizeOptions, generator: torch.Generator) -> torch.Tensor:
    """Return the standard deviation of renders with opacity dropout, over the colours, shape [H, W]."""
    count, p = HIDDEN
    images = []
    for _ in range(count):
        kept = (torch.rand(len(gaussians), generator=generator) >= p).to(gaussians.means) / (1 - p)
        images.append(rasterize(gaussians, camera, dataclasses.replace(options, opacity_factors=kept)).rgb)
    return torch.stack(images).var(0).sum(-1).sqrt()


def carried(gaussians: Gaussians, camera: Camera, values: torch.Tensor, options: RasterizeOptions) -> torch.Tensor:
    """Return the image [H, W] of a value per Gaussian [N]."""
    background = values.new_zeros(1)
    return rasterize(gaussians, camera, dataclasses.replace(options, colors=values[:, None], background=background)).rgb[..., 0]


def image_scores(
    gaussians: Gaussians, own: Candidates, pull: torch.Tensor, footprint: float, options: RasterizeOptions,
    generator: torch.Generator,
) -> dict[str, torch.Tensor]:  # fmt: skip
    """Return the scores of a view that need no other view, each [H, W]; ``pull`` [N] is the gradient of each Gaussian."""
    view = own.view
    render = rasterize(gaussians, view.camera, options)
    residual = view.seen(render.rgb) - view.image
    length = blur(residual.norm(dim=-1))
    smooth = torch.stack([blur(c.contiguous(), footprint) for c in view.image.unbind(-1)], -1)
    detail = blur((view.image - smooth).norm(dim=-1))
    dy, dx = torch.gradient(view.image.mean(-1))
    depths = (gaussians.means * view.camera.viewmat[2, :3]).sum(1) + view.camera.viewmat[2, 3]
    focal = 0.5 * (view.camera.K[0, 0] + view.camera.K[1, 1])
    size = carried(
        gaussians, view.camera, gaussians.log_scales.mean(1).exp() * focal / depths.clamp_min(1e-6), options
    ) / render.alpha.clamp_min(1e-3)  # fmt: skip
    pooled = torch.nn.functional.max_pool2d(own.depth[None, None], 5, 1, 2)[0, 0]
    lowest = -torch.nn.functional.max_pool2d(-own.depth[None, None], 5, 1, 2)[0, 0]
    assert view.geometry is not None
    semantic = torch.zeros_like(view.geometry) if view.semantic is None else view.semantic
    scores = {
        "uniform": torch.ones_like(length), "residual": length, "semantic": semantic, "geometry": view.geometry,
        "package": 0.4 * normalized(length, own.gate) + 0.2 * semantic + 0.4 * view.geometry,
        "signed": signed_residual(residual, footprint), "detail": detail, "residual*detail": length * detail,
        "edges": blur(torch.hypot(dx, dy)), "size": size, "residual*size": length * size,
        "dropout": blur(dropout_spread(gaussians, view.camera, options, generator)),
        "pull": carried(gaussians, view.camera, pull, options),
        "occlusion": (pooled - lowest) / own.depth.clamp_min(1e-6),
    }  # fmt: skip
    return {name: score[own.at[:, 0], own.at[:, 1]] for name, score in scores.items()}


def gain_scores(
    gaussians: Gaussians, found: Sequence[Candidates], views: Sequence[TrainingView], background: torch.Tensor,
    generator: torch.Generator,
) -> list[dict[str, torch.Tensor]]:  # fmt: skip
    """Return, for the candidates of each view, their gains over all training views, and over the others alone, [K] each."""
    extra = {n: torch.cat([c.rows[n] for c in found]) for n in found[0].rows}
    down, bend = opacity_slopes(gaussians, extra, views, background, generator)
    scores, first = [], 0
    for number, c in enumerate(found):
        part = slice(first, first + len(c.at))
        others = [i for i in range(len(views)) if i != number]
        slope, curve = down[:, part], bend[:, part]
        total, rest = slope.sum(0), slope[others].sum(0)
        scores.append({
            "gain": total, "gain others": rest, "best": best_opacity_gain(total, curve.sum(0)),
            "best others": best_opacity_gain(rest, curve[others].sum(0)),
            "agreed": torch.minimum(slope[number], rest).clamp_min(0) + 1e-3 * total.clamp_min(0),
        })  # fmt: skip
        first += len(c.at)
    return scores


def held_out_scores(
    gaussians: Gaussians, found: Sequence[Candidates], held: Sequence[TrainingView], options: RasterizeOptions,
    background: torch.Tensor, generator: torch.Generator,
) -> list[dict[str, torch.Tensor]]:  # fmt: skip
    """Return the oracles: for the candidates of each view, the gain in left-out views, and the error there."""
    extra = {n: torch.cat([c.rows[n] for c in found]) for n in found[0].rows}
    down, bend = (t.sum(0) for t in opacity_slopes(gaussians, extra, held, background, generator))
    error = residual_elsewhere(gaussians, extra["means"], held, options)
    scores = {"oracle gain": down, "oracle best": best_opacity_gain(down, bend), "oracle residual": error}
    sizes = [len(c.at) for c in found]
    parts = {name: values.split(sizes) for name, values in scores.items()}
    return [{name: parts[name][i] for name in scores} for i in range(len(found))]


def ranks(values: torch.Tensor) -> torch.Tensor:
    """Return the ranks of values [K], float64; equal ones share their mean."""
    _, inverse, count = torch.unique(values, return_inverse=True, return_counts=True)
    last = count.cumsum(0).double()
    return (last - 0.5 * (count.double() - 1))[inverse]


def spearman(score: torch.Tensor, truth: torch.Tensor) -> float:
    """Return Spearman's correlation of two tensors [K]; 0 where one is constant."""
    a, b = ranks(score), ranks(truth)
    a, b = a - a.mean(), b - b.mean()
    scale = float(a.norm() * b.norm())
    return float((a * b).sum()) / scale if scale > 0 else 0.0


def lift(score: torch.Tensor, truth: torch.Tensor, fraction: float) -> float:
    """Return the mean truth of the candidates with the highest scores [K], divided by that of all; equal scores share it."""
    count = max(1, round(fraction * len(score)))
    least = score.topk(count).values[-1]
    above, equal = score > least, score == least
    top = float(truth[above].sum()) + (count - int(above.sum())) * float(truth[equal].mean())
    mean = float(truth.mean())
    return top / count / mean if mean else math.nan
