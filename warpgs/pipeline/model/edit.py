"""Edits of a finished model: filters and compression."""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgs import geometry, schema
from warpgs.constants import ALPHA_CUT
from warpgs.errors import UsageError, explained
from warpgs.files import read_input
from warpgs.kernels.sh import MAX_DEGREE
from warpgs.pipeline.model.limits import NEEDLE, ROUNDING, long_axes
from warpgs.pipeline.model.table import truncated
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import Render, rasterize
from warpgs.scene import Box, Camera, Gaussians

SEEN = 4 / 255
"""Least blending weight at which a view sees a Gaussian. Without it, a pixel changes by its weight times the difference between
its colour and what is behind: with less weight by less than 4 of 255 levels, even for white before black."""
PROBES = 16
"""Least number of random images over all views for the sensitivities."""
AT_ONCE = 2**21
"""Gaussians or pixels of the views that are rendered at a time without a memory limit, about 64 bytes each."""


def batch_of(cameras: Sequence[Camera]) -> Camera:
    """Return cameras of one image size and model as one batch."""
    first, stack = cameras[0], np.stack if isinstance(cameras[0].viewmat, np.ndarray) else torch.stack
    distortion = None if first.distortion is None else stack([c.distortion for c in cameras])
    return replace(first, viewmat=stack([c.viewmat for c in cameras]), K=stack([c.K for c in cameras]), distortion=distortion)


def in_batches(gaussians: Gaussians, cameras: Iterable[Camera], options: RasterizeOptions) -> Iterator[Render]:
    """Render cameras, neighbours of one image size and model in one call."""
    for (width, height, _), same in itertools.groupby(cameras, lambda c: (c.width, c.height, c.model)):
        left = [*same]
        count = 1 if options.max_instances else max(1, AT_ONCE // max(len(gaussians), width * height))
        while left:
            yield rasterize(gaussians, batch_of(left[:count]), options)
            left = left[count:]


@torch.no_grad()
def coverage(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions) -> tuple[torch.Tensor, torch.Tensor]:
    """Render all views; return each Gaussian's largest blending weight [N], and how many views see it, int64 [N].

    The largest weight is the score of RadSplat (arXiv 2403.13806); a sum of weights would be small for thin Gaussians. Rays end
    where less than `ALPHA_CUT` of the light is left, which no weight exceeds; so smaller weights may be too small.
    """
    rule = options.cut_offs()
    if rule.inclusive_stop:  # else the Gaussian at the stop has no weight
        rule = replace(rule, transmittance_stop=max(ALPHA_CUT, rule.transmittance_stop))
    options = replace(options, contributions=True, sh_degree=0, rule=rule)
    maxima = gaussians.means.new_zeros(len(gaussians))
    views = torch.zeros_like(maxima, dtype=torch.int64)
    for render in in_batches(gaussians, cameras, options):
        maxima = torch.maximum(maxima, render.weight_maxima.amax(0))
        views += (render.weight_maxima >= SEEN).sum(0)
    return maxima, views


@torch.enable_grad()  # the caller may have switched gradients off
def sensitivities(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions, seed: int) -> torch.Tensor:
    """Estimate three squared changes of the images for each Gaussian, summed over pixels, at least 0, shape [3, N].

    The first is the trace of PUP-3DGS' sensitivity, in units of the Gaussian's width (arXiv 2406.10219, eq. 6: the sum over
    pixels of the outer product of the colour's gradient with respect to mean and scale). PUP uses the log-determinant instead.
    The second is the change when it is removed, since a pixel is linear in each opacity. The third is the change when its
    harmonics above degree 0 are removed. With random signs e, the same on every device, as the gradient of an image, the
    backward pass gives J^T e; the mean of the squares of J^T e is the diagonal of J^T J.
    """
    wanted = ("means", "log_scales", "logit_opacities", "sh")
    leaves = {n: t.detach().clone().requires_grad_(n in wanted) for n, t in gaussians.tensors().items()}
    width = leaves["log_scales"].detach().exp().amax(1, keepdim=True)
    clear = (-leaves["logit_opacities"].detach()).sigmoid().clamp_min(ROUNDING)  # d opacity / d logit = opacity * clear
    harmonics = leaves["sh"].detach().flatten(1)[:, 3:]
    generator, probes = torch.Generator().manual_seed(seed), -(-PROBES // len(cameras))
    total = width.new_zeros(3, len(width))
    for camera in cameras:
        rgb = rasterize(Gaussians(**leaves), camera, options).rgb
        for probe in range(probes):
            signs = (2 * torch.randint(2, rgb.shape, generator=generator, device="cpu") - 1).to(rgb)
            means, scales, logits, sh = torch.autograd.grad(
                rgb, [leaves[n] for n in wanted], signs, retain_graph=probe + 1 < probes
            )
            total[0] += ((means * width).square().sum(1) + scales.square().sum(1)) / probes
            total[1] += (logits / clear).square() / probes
            total[2] += torch.einsum("nk,nk->n", sh.flatten(1)[:, 3:], harmonics).square() / probes  # fast on a CPU
    return total


INNER = 0.02
"""Fraction of the means that is left out at each end of each axis when the size of the scene is measured."""
NEEDLE_LENGTH = 0.2
"""A Gaussian beyond the ratio `NEEDLE` is removed if it is longer than this fraction of the scene's size: shorter needles are
hairs and edges of a good model. With a tenth instead, removal costs up to 0.08 dB on held-out views
(docs/decisions/014-formats.md)."""
UNSEEN, LARGE = "seen by no training view", "larger than the scene"
NEEDLES = f"needles over {NEEDLE:g} times as long as wide"
"""Reasons to remove a Gaussian."""
MAX_BOX_BYTES = 65536
"""Largest size of a file that describes a box [bytes]."""


def numbers_of(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Return finite numbers of a shape; UsageError if ``value`` is anything else."""
    try:
        array = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        count = " x ".join(map(str, shape)) or "one"
        raise UsageError(f"{what} takes {count} finite number{'s' * bool(shape)}, not {str(value)[:60]}")
    return array


_THREE = schema.items(schema.number(), 3)
BOX = schema.fields({"center": _THREE, "size": _THREE}, {"rotation": schema.items(_THREE, 3)})
"""Schema of a box in a file."""


def box_of(text: str) -> Box:
    """Return the box of a text: least and largest corner, x,y,z,X,Y,Z; or a .json file, as the viewer saves it."""
    if text.lower().endswith(".json"):
        fix = "save the box again in the viewer"
        with explained(f"{text}: cannot be read as a box", fix, (OSError, schema.SchemaError)):
            values = schema.parse(read_input(Path(text), MAX_BOX_BYTES))
            BOX(values, "the box")
        center, size = np.array(values["center"], np.float64), np.array(values["size"], np.float64)
        rotation = np.array(values.get("rotation", np.eye(3)), np.float64)
    else:
        low, high = numbers_of(text.split(","), (6,), "--crop: a box (x,y,z,X,Y,Z, or a .json file)").reshape(2, 3)
        center, size, rotation = (low + high) / 2, high - low, np.eye(3)
    if np.abs(geometry.matmul(rotation, rotation.T) - np.eye(3)).max() > 1e-3:
        raise UsageError(f"--crop {text[:60]}: rotation must be a rotation matrix: its columns perpendicular and of length 1")
    if not (size > 0).all():
        raise UsageError(
            f"--crop {text[:60]}: the box has sides of {', '.join(f'{s:g}' for s in size)}; each must be longer than 0"
        )
    return center, size, rotation


def select(gaussians: Gaussians, keep: torch.Tensor) -> Gaussians:
    """Return the Gaussians selected by ``keep``, bool [N] or rows [K]."""
    return Gaussians(**{name: t[keep] for name, t in gaussians.tensors().items()})


def inside(gaussians: Gaussians, box: Box) -> torch.Tensor:
    """Return whether each mean is in a box, bool [N]; box and Gaussians are in the same units."""
    return torch.from_numpy(geometry.inside(gaussians.means.double().cpu().numpy(), box)).to(gaussians.means.device)


def size_of(gaussians: Gaussians) -> float:
    """Return the diagonal of the box that holds the means but for `INNER` at each end of each axis."""
    low, high = np.quantile(gaussians.means.double().cpu().numpy(), [INNER, 1 - INNER], axis=0)
    return max(math.sqrt(float(((high - low) ** 2).sum())), 1e-30)


def floaters(gaussians: Gaussians, maxima: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
    """Return the floaters and needles, bool [N] by reason; several may apply to one Gaussian.

    ``maxima`` [N] are the largest blending weights over all training views, None without views.
    """
    if not len(gaussians):
        return {}
    size = size_of(gaussians)
    longest, middle = long_axes(gaussians.log_scales.double())
    needle = longest - middle > math.log(NEEDLE) + ROUNDING  # a fit holds many at the ratio itself
    reasons = {} if maxima is None else {UNSEEN: maxima < SEEN}
    reasons[LARGE] = longest > math.log(size)
    reasons[NEEDLES] = needle & (longest > math.log(NEEDLE_LENGTH * size))
    return reasons


def first_reasons(reasons: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return masks [N] in which each Gaussian has only the first of its reasons."""
    masks = list(reasons.values())
    return {reason: masks[i] & ~any_of(masks[:i], masks[i]) for i, reason in enumerate(reasons)}


def any_of(masks: Iterable[torch.Tensor], like: torch.Tensor) -> torch.Tensor:
    """Return where any of some masks [N] is true; nowhere without one, in the shape of ``like``."""
    return torch.stack([torch.zeros_like(like, dtype=torch.bool), *masks]).any(0)


def limit_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return the same Gaussians without the harmonics above a degree; UsageError if it is not 0 to 4."""
    if not 0 <= degree <= MAX_DEGREE:
        raise UsageError(f"--sh-degree {degree}: harmonics have degrees 0 to {MAX_DEGREE}")
    return replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2].contiguous())


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation [3, 3] by an angle [rad] about an axis [3] of any length but 0 (Rodrigues)."""
    length = math.sqrt(float((np.asarray(axis) ** 2).sum()))
    if not (math.isfinite(length) and length > 0 and math.isfinite(angle)):
        raise UsageError("--rotate: the axis has length 0, or a number is not finite")
    x, y, z = np.asarray(axis, np.float64) / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * geometry.matmul(cross, cross)


def levelling(up: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] that turns an upward direction [3] to -y, which is up in PLY files, by the shortest way."""
    u = np.asarray(up, np.float64) / math.sqrt(float((np.asarray(up) ** 2).sum()))
    axis = np.cross(u, [0.0, -1.0, 0.0])
    angle = math.atan2(math.sqrt(float((axis**2).sum())), -float(u[1]))
    return rotation_about(axis if angle % math.pi > 1e-12 else np.array([1.0, 0.0, 0.0]), angle)


TRIES = 12
"""Largest number of models that a search tries on few views; about four are needed."""
AIM = 0.9
"""A search ends at this part of the allowed loss; it costs about 1 % of the Gaussians that could be removed."""
DEGREES_FRACTION = 1 / 3
"""Part of the changes that lower degrees may cause. Removal may cause the rest."""
REPEATS = 3
"""Largest number of searches for a model that keeps the limit on all views."""


Loss = Callable[[Gaussians, bool], float]
"""The loss of a model, on all views or on a few."""


def largest_budget(
    tried: dict[float, float], loss: Callable[[float], float], first: float, most: float, allowed: float
) -> float:
    """Return the largest budget that was tried and has at most the allowed loss, or 0; adds to ``tried``, the losses by budget.

    The loss is about a power of the budget: the next one is on the line through the nearest two losses, in logarithms. Between
    budgets that are known to be too small and too large, every second one is in the middle: a large loss has an upper bound.
    ``first`` is tried first; none is above ``most``.
    """
    target = math.sqrt(AIM) * allowed
    for _ in range(TRIES):
        low = max((budget for budget, lost in tried.items() if lost <= allowed), default=0.0)
        high = min((budget for budget in tried if budget > low), default=math.inf)
        if low >= most or (low > 0 and tried[low] >= AIM * allowed):
            break
        at, near = first, sorted(tried, reverse=high == math.inf)[:2] if low == 0 or high == math.inf else [low, high]
        if near:
            # from a thousandth of the allowed loss to a thousand times as much, which also stands for NaN
            losses = [1e-3 * max(1.0, min(1e6, 1e3 * tried[budget] / allowed)) for budget in near]
            ends = [math.log(budget) for budget in near]
            power = math.log(losses[1] / losses[0]) / (ends[1] - ends[0]) if len(near) > 1 else 1.0
            step = math.log(target / allowed / losses[0]) / min(5.0, max(0.2, power))
            if low > 0 and high < math.inf:
                part = 0.5 if len(tried) % 2 else min(0.9, max(0.1, step / (ends[1] - ends[0])))
                step = part * (ends[1] - ends[0])
            at = min(most, near[0] * math.exp(step))
        tried[min(at, most)] = loss(min(at, most))
    return max((budget for budget, lost in tried.items() if lost <= allowed), default=0.0)


def importance(space: torch.Tensor, removal: torch.Tensor) -> torch.Tensor:
    """Return the scores [N] by which Gaussians are removed, the least first, from their `sensitivities`.

    A score is the product of PUP-3DGS' sensitivity and of the change without the Gaussian; by one of both alone, fewer could go
    at the same loss.
    """
    return space.sqrt() * removal.sqrt()


def cheapest(scores: torch.Tensor, changes: torch.Tensor, budget: float) -> torch.Tensor:
    """Return the rows of least score [N] whose changes [N] add up to at most ``budget``, bool [N]; at least one row is not."""
    order, chosen = torch.argsort(scores, stable=True), torch.zeros_like(scores, dtype=torch.bool)
    # on a CPU one after another: the same bits each time
    chosen[order[: min(int((changes[order].double().cpu().cumsum(0) <= budget).sum()), len(order) - 1)]] = True
    return chosen


def stored_degrees(sh: torch.Tensor) -> torch.Tensor:
    """Return the highest degree at which coefficients [N, K, 3] of each Gaussian are not all zero, int32 [N]."""
    return torch.where((sh != 0).any(2), torch.arange(sh.shape[1], device=sh.device).add(0.5).sqrt().to(torch.int32), 0).amax(1)


def by_degree(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians by ascending degree, without degrees that none of them uses."""
    return drop_unused_sh(select(gaussians, torch.argsort(stored_degrees(gaussians.sh), stable=True)))


def drop_unused_sh(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians without degrees that none of them uses; a file stores equally many coefficients for all."""
    return limit_degree(gaussians, int(stored_degrees(gaussians.sh).max()) if len(gaussians) else 0)


def prune_model(
    gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions, seed: int, loss: Loss, allowed: float, first: float
) -> tuple[Gaussians, float]:
    """Lower degrees and remove Gaussians; return the smaller set, by ascending degree, and its loss on all views.

    The loss is at most ``allowed``. `sensitivities` ranks everything once; they also add up to a budget, of which degrees take
    `DEGREES_FRACTION`. The search is for the budget: it begins with ``first``, on few views, and is repeated for less if the
    loss on all views is too large; degrees stay if lower ones alone lose too much there. ``cameras`` are those of all training
    views, tensors.
    """
    space, removal, harmonics = sensitivities(gaussians, cameras, options, seed)
    scores, degrees, aim = importance(space, removal), stored_degrees(gaussians.sh), allowed
    most, tried = float((removal + harmonics).double().sum()) / DEGREES_FRACTION, dict[float, float]()

    def lowered(budget: float) -> Gaussians:
        chosen = cheapest(harmonics, harmonics, DEGREES_FRACTION * budget)
        return replace(gaussians, sh=truncated(gaussians.sh, torch.where(chosen, 0, degrees)))

    def smaller(budget: float) -> Gaussians:
        return select(lowered(budget) if lowers else gaussians, ~cheapest(scores, removal, (1 - DEGREES_FRACTION) * budget))

    lowers = bool((degrees > 0).any())
    for repeat in range(REPEATS):
        budget = largest_budget(tried, lambda budget: loss(smaller(budget), False), first, most, aim)
        model = by_degree(smaller(budget))
        if (lost := loss(model, True)) <= allowed:
            return model, lost
        if repeat == 0 and lowers and loss(lowered(budget), True) > allowed:
            lowers = False
            tried.clear()
        else:
            aim = AIM * min(aim, tried.get(budget, aim)) * allowed / lost
    return by_degree(gaussians), 0.0
