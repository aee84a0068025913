"""Edits of a finished model: filters, merging and compression."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgs.errors import DataError, UsageError
from warpgs.files import read_input, unread_reason
from warpgs.geometry import matmul, quaternions, rotation_matrices
from warpgs.kernels.neighbours import morton_codes
from warpgs.kernels.sh import MAX_DEGREE
from warpgs.pipeline.model.limits import NEEDLE, ROUNDING, long_axes
from warpgs.pipeline.model.table import truncated
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import C0, Camera, Gaussians

SEEN = 4 / 255
"""Least blending weight at which a view sees a Gaussian: with less, the Gaussian changes no pixel by more than 4 of 255
levels."""
PROBES = 2
"""Random images per view for the Fisher sensitivity."""


@torch.no_grad()
def coverage(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions) -> tuple[torch.Tensor, torch.Tensor]:
    """Render all views (tensors); return each Gaussian's largest blending weight [N], and how many views see it, int64 [N].

    The largest weight is the score of RadSplat (arXiv 2403.13806); a sum of weights would be small for thin Gaussians.
    """
    maxima = gaussians.means.new_zeros(len(gaussians))
    views = torch.zeros_like(maxima, dtype=torch.int64)
    for c in cameras:
        weights = rasterize(gaussians, c, replace(options, contributions=True)).weight_maxima[0]
        maxima = torch.maximum(maxima, weights)
        views += weights >= SEEN
    return maxima, views


@torch.enable_grad()  # the caller may have switched gradients off
def fisher(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions, seed: int) -> torch.Tensor:
    """Estimate the change of the images when a Gaussian moves by its own width or its axes grow, at least 0, shape [N].

    The result is the trace of PUP-3DGS' sensitivity, in units of the Gaussian's width (arXiv 2406.10219, eq. 6: the sum over
    pixels of the outer product of the colour's gradient with respect to mean and scale). PUP uses the log-determinant instead.
    With random signs e, the same on every device, as the gradient of an image, the backward pass gives J^T e; the mean of the
    squares of J^T e is the diagonal of J^T J.
    """
    leaves = {n: t.detach().clone().requires_grad_(n in ("means", "log_scales")) for n, t in gaussians.tensors().items()}
    width = leaves["log_scales"].detach().exp().amax(1, keepdim=True)
    generator = torch.Generator().manual_seed(seed)
    total = width.new_zeros(len(width))
    for camera in cameras:
        rgb = rasterize(Gaussians(**leaves), camera, options).rgb
        for probe in range(PROBES):
            signs = (2 * torch.randint(2, rgb.shape, generator=generator, device="cpu") - 1).to(rgb)
            wanted = [leaves["means"], leaves["log_scales"]]
            v_means, v_scales = torch.autograd.grad(rgb, wanted, signs, retain_graph=probe + 1 < PROBES)
            total += ((v_means * width).square().sum(1) + v_scales.square().sum(1)) / PROBES
    return total


OPAQUE = 0.99
"""Largest opacity of a merged Gaussian: the largest that the rasterizer blends."""


def covariances(quats: torch.Tensor, log_scales: torch.Tensor) -> torch.Tensor:
    """Return covariances [N, 3, 3] [u^2] from quaternions wxyz [N, 4] and log scales [N, 3] [ln u]."""
    axes = rotation_matrices(torch.nn.functional.normalize(quats, dim=1)) * log_scales.exp()[:, None, :]
    return axes @ axes.transpose(1, 2)


def _area(log_scales: torch.Tensor) -> torch.Tensor:
    """Return the product of the two longer axes [u^2], the area that a Gaussian covers when seen face on, shape [N]."""
    return (log_scales.sum(1) - log_scales.amin(1)).exp()


def _covered(opacity: torch.Tensor, area: torch.Tensor, own: torch.Tensor, means: torch.Tensor) -> torch.Tensor:
    """Return 1 / (2 pi) times the integral of 1 - (1 - a G)(1 - b H) over the plane that both face [u^2], shape [P].

    The opacities a and b and both areas have shape [P, 2]; the covariances ``own`` of G and H [P, 2, 3, 3]; means [P, 2, 3].
    """
    squares, axes = torch.linalg.eigh(own.sum(1))
    squares = squares.clamp_min(1e-30)
    apart = (axes.transpose(1, 2) @ (means[:, 0] - means[:, 1])[..., None]).squeeze(-1)
    together = torch.exp(-0.5 * (apart.square() / squares).sum(1)) / squares[:, 1:].prod(1).sqrt()
    return (opacity * area).sum(1) - opacity.prod(1) * area.prod(1) * together


@torch.no_grad()
def merges(
    gaussians: Gaussians, maxima: torch.Tensor, odd: bool, shift: float = 0.0
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Pair neighbours along the Morton curve; return the rows of each pair [P, 2] and the merged Gaussians, cheapest first.

    Mean, covariance and colours are those of the mixture, weighted by opacity times face-on area. The product of the new
    opacity and the new area is the area that the pair covers face on; the overlap counts once. If this needs an opacity above
    `OPAQUE`, the two longer axes grow instead: otherwise a surface of opaque Gaussians would get holes. The cost of a pair is
    its largest blending weight (``maxima`` [N]) times the sum of three terms. They are the difference of the colours; the
    logarithm of new over old covered area, since distant pairs or pairs of different planes bulge; and the logarithm of the
    factor by which the area had to grow. ``odd`` pairs the second with the third, and so on. ``shift`` moves the curve by a
    fraction of the cloud's size, so that neighbours in two large cells can be paired.
    """
    low, high = gaussians.means.amin(0), gaussians.means.amax(0)
    boxed = torch.cat([gaussians.means, (low - shift * (high - low))[None]])
    order = torch.argsort(morton_codes(boxed)[:-1], stable=True)[int(odd) :]
    order = order[: len(order) // 2 * 2].reshape(-1, 2)
    g = {n: t.detach()[order].double().cpu() for n, t in gaussians.tensors().items()}
    opacity = g["logit_opacities"].sigmoid()
    area = torch.stack([_area(g["log_scales"][:, i]) for i in range(2)], 1)
    mass = opacity * area
    fraction = mass / mass.sum(1, keepdim=True)
    means = (fraction[..., None] * g["means"]).sum(1)
    apart = g["means"] - means[:, None]
    own = torch.stack([covariances(g["quats"][:, i], g["log_scales"][:, i]) for i in range(2)], 1)
    both = (fraction[..., None, None] * (own + apart[..., :, None] * apart[..., None, :])).sum(1)
    squares, axes = torch.linalg.eigh(both)  # in float64 on the CPU: the same on every device
    axes = axes * torch.linalg.det(axes)[:, None, None].sign()
    log_scales = 0.5 * squares.clamp_min(1e-30).log()
    wanted = _covered(opacity, area, own, g["means"]) / _area(log_scales)
    grown = (wanted / OPAQUE).clamp_min(1).log()
    log_scales[:, 1:] += 0.5 * grown[:, None]  # eigenvalues ascend
    merged = {
        "means": means, "quats": quaternions(axes), "log_scales": log_scales,
        "logit_opacities": wanted.clamp(1e-6, OPAQUE).logit(), "sh": (fraction[..., None, None] * g["sh"]).sum(1),
    }  # fmt: skip
    colour = (C0 * (g["sh"][:, 0, 0] - g["sh"][:, 1, 0])).abs().amax(1)
    bulge = (_area(log_scales) / area.sum(1)).log().clamp_min(0)
    cost = maxima.detach()[order].amax(1).double().cpu() * (colour + bulge + grown)
    ranks = torch.argsort(torch.where(torch.isfinite(cost), cost, torch.inf), stable=True)
    ranks = ranks[torch.isfinite(cost[ranks])]
    means = gaussians.means
    return order[ranks.to(means.device)], {n: t[ranks].to(means.device, means.dtype) for n, t in merged.items()}


def merged_pairs(gaussians: Gaussians, pairs: torch.Tensor, merged: dict[str, torch.Tensor], taken: int) -> Gaussians:
    """Return the set in which each of the first ``taken`` pairs of `merges` is one Gaussian."""
    stays = torch.ones(len(gaussians), dtype=torch.bool, device=pairs.device)
    stays[pairs[:taken].flatten()] = False
    return Gaussians(**{n: torch.cat([t[stays], merged[n][:taken]]) for n, t in gaussians.tensors().items()})


INNER = 0.02
"""Fraction of the means that is left out at each end of each axis when the size of the scene is measured."""
NEEDLE_LENGTH = 0.2
"""A Gaussian beyond the ratio `NEEDLE` is removed if it is longer than this fraction of the scene's size: shorter needles are
hairs and edges of a good model. With a tenth instead, removal costs up to 0.08 dB on held-out views
(docs/decisions/014-formats.md)."""
MAX_BOX_BYTES = 65536
"""Largest size of a file that describes a box [bytes]."""


Box = tuple[np.ndarray, np.ndarray, np.ndarray]
"""A box: middle [3] and full sides [3] [file units], and a rotation [3, 3] whose columns are the directions of the sides."""


def _numbers(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Return finite numbers of a shape; UsageError if ``value`` is anything else."""
    try:
        array = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise UsageError(f"--crop: {what} takes {' x '.join(map(str, shape))} finite numbers, not {str(value)[:60]}")
    return array


def box_of(text: str) -> Box:
    """Return the box of a text: least and largest corner, x,y,z,X,Y,Z; JSON with center, size, rotation; or a .json file."""
    if text.lower().endswith(".json"):
        return _box_of_file(Path(text))
    try:
        value = json.loads(text if text.lstrip().startswith("{") else f"[{text}]")
    except (ValueError, RecursionError) as e:
        forms = "six numbers separated by commas, JSON with center and size, or a .json file"
        raise UsageError(f"--crop {text[:60]}: give {forms}") from e
    if isinstance(value, list):
        low, high = _numbers(value, (6,), "a box").reshape(2, 3)
        center, size, rotation = (low + high) / 2, high - low, np.eye(3)
    else:
        center, size = (_numbers(value.get(key), (3,), key) for key in ("center", "size"))
        rotation = _numbers(value.get("rotation", np.eye(3).tolist()), (3, 3), "rotation")
    if np.abs(matmul(rotation, rotation.T) - np.eye(3)).max() > 1e-3:
        raise UsageError("--crop: rotation must be a rotation matrix: its columns are not perpendicular, or not of length 1")
    if not (size > 0).all():
        raise UsageError(f"--crop: the box has sides of {', '.join(f'{s:g}' for s in size)}; each must be longer than 0")
    return center, size, rotation


def _box_of_file(path: Path) -> Box:
    """Return the box of a JSON file, as the viewer saves it; DataError if the file has no box."""
    try:
        text = read_input(path, MAX_BOX_BYTES).decode("utf-8-sig")
        if not text.lstrip().startswith("{"):
            raise UsageError("expected a JSON object with center and size")
        return box_of(text)
    except (OSError, UnicodeDecodeError, UsageError) as e:
        raise DataError(f"{path}: cannot be read as a box ({unread_reason(e)}); save the box again in the viewer") from e


def select(gaussians: Gaussians, keep: torch.Tensor) -> Gaussians:
    """Return the Gaussians selected by ``keep``, bool [N] or rows [K]."""
    return Gaussians(**{name: t[keep] for name, t in gaussians.tensors().items()})


def inside(gaussians: Gaussians, box: Box) -> torch.Tensor:
    """Return whether each mean is in a box, bool [N]; box and Gaussians are in the same units."""
    center, size, rotation = box
    offsets = gaussians.means.double() - torch.tensor(center, dtype=torch.float64, device=gaussians.means.device)
    out = torch.ones(len(gaussians), dtype=torch.bool, device=offsets.device)
    for direction, side in zip(rotation.T, size):
        out &= sum(float(d) * offsets[:, i] for i, d in enumerate(direction)).abs() <= float(side) / 2
    return out


def disturbing(gaussians: Gaussians, maxima: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
    """Return the floaters and needles, each under the first reason that applies, bool [N] by reason.

    ``maxima`` [N] are the largest blending weights over all training views, None without views.
    """
    if not len(gaussians):
        return {}
    low, high = np.quantile(gaussians.means.double().cpu().numpy(), [INNER, 1 - INNER], axis=0)
    size = max(math.sqrt(float(((high - low) ** 2).sum())), 1e-30)
    longest, middle = long_axes(gaussians.log_scales.double())
    needle = longest - middle > math.log(NEEDLE) + ROUNDING  # a fit holds many at the ratio itself
    reasons = {} if maxima is None else {"seen by no training view": maxima < SEEN}
    reasons["larger than the scene"] = longest > math.log(size)
    reasons[f"needles over {NEEDLE:g} times as long as wide"] = needle & (longest > math.log(NEEDLE_LENGTH * size))
    free = torch.ones_like(needle)
    for reason, where in reasons.items():
        reasons[reason], free = where & free, free & ~where
    return reasons


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
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * matmul(cross, cross)


def levelling(up: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] that turns an upward direction [3] to -y, which is up in PLY files, by the shortest way."""
    u = np.asarray(up, np.float64) / math.sqrt(float((np.asarray(up) ** 2).sum()))
    axis = np.cross(u, [0.0, -1.0, 0.0])
    angle = math.atan2(math.sqrt(float((axis**2).sum())), -float(u[1]))
    return rotation_about(axis if angle % math.pi > 1e-12 else np.array([1.0, 0.0, 0.0]), angle)


ROUNDS = 5
"""Number of bisection steps in the search for the largest fraction."""
PASSES = 8
"""Largest number of rounds of merging: up to 2^8 neighbours become one."""
DEGREES_FRACTION, MERGE_FRACTION = 1 / 3, 2 / 3
"""Fractions of the allowed loss: the loss may reach the first after degrees are lowered, and the second after neighbours are
merged. Removal may use up the rest."""
RAMP = 3
"""Number of rounds over which the loss allowed for merging grows to its full value."""
WORTHWHILE = 0.02
"""Least fraction of the Gaussians that a round must merge away; merging ends after two rounds in a row with less."""


Accepted = Callable[[Gaussians, float], bool]
"""Whether a model is good enough when a fraction in [0, 1] of the allowed loss may be spent."""


def largest_fraction(accepted: Callable[[float], bool]) -> float:
    """Return the largest accepted fraction in [0, 1], by bisection; 1 is tried first, 0 needs no test.

    The result itself was accepted, or is 0; if acceptance is not monotone, a larger fraction may be accepted, too.
    """
    if accepted(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(ROUNDS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if accepted(middle) else (low, middle)
    return low


def prune_order(maxima: torch.Tensor, sensitivity: torch.Tensor) -> torch.Tensor:
    """Return the rows of the Gaussians in the order in which they may be removed, int64 [N].

    Gaussians are ranked by largest blending weight [N] and by the sensitivity of `fisher` [N], equal values by row; the higher
    of both ranks decides. So a Gaussian is removed only if both scores are low; thin Gaussians and wide faint ones stay if one
    score is high.
    """
    ranks = (torch.argsort(torch.argsort(values, stable=True)) for values in (maxima, sensitivity))
    return torch.argsort(torch.maximum(*ranks), stable=True)


def keep_last(order: torch.Tensor, fraction: float) -> torch.Tensor:
    """Return the rows, ascending, that remain after the first ``fraction`` of an order [N] is removed; at least one remains."""
    return order[min(len(order) - 1, int(fraction * len(order))) :].sort().values


def stored_degrees(sh: torch.Tensor) -> torch.Tensor:
    """Return the highest degree at which coefficients [N, K, 3] of each Gaussian are not all zero, int32 [N]."""
    bands = torch.arange(sh.shape[1], device=sh.device).add(0.5).sqrt().to(torch.int32)
    return torch.where((sh != 0).any(2), bands, 0).amax(1)


def drop_unused_sh(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians without degrees that none of them uses; a file stores equally many coefficients for all."""
    return limit_degree(gaussians, int(stored_degrees(gaussians.sh).max()) if len(gaussians) else 0)


def lower_degrees(gaussians: Gaussians, maxima: torch.Tensor, accepted: Callable[[Gaussians], bool]) -> Gaussians:
    """Return the set without harmonics above degree 0 in as many Gaussians as ``accepted`` allows, the least needed first.

    The need is the norm of the coefficients above degree 0, times the largest blending weight [N]. In an orthonormal basis,
    this norm is proportional to the standard deviation of the colour over directions.
    """
    order = torch.argsort(gaussians.sh[:, 1:].square().sum((1, 2)).sqrt() * maxima, stable=True)
    degrees = stored_degrees(gaussians.sh)

    def lowered(fraction: float) -> Gaussians:
        some = degrees.clone()
        some[order[: int(fraction * len(order))]] = 0
        return replace(gaussians, sh=truncated(gaussians.sh, some))

    return lowered(largest_fraction(lambda s: accepted(lowered(s))))


def merge_neighbours(gaussians: Gaussians, maxima_of: Callable[[Gaussians], torch.Tensor], accepted: Accepted) -> Gaussians:
    """Merge pairs, cheapest first, in rounds while they are worthwhile; return the smaller set.

    The allowed loss grows over the first `RAMP` rounds, because the cheapest pairs of one round cost less than the last merged
    pairs of the round before.
    """
    idle = 0
    for number in range(PASSES):
        part = min(1.0, (number + 1) / RAMP)
        pairs, merged = merges(gaussians, maxima_of(gaussians), odd=bool(number % 2), shift=number / PASSES)
        after = partial(merged_pairs, gaussians, pairs, merged)
        count = len(pairs)
        share = largest_fraction(lambda s, after=after, count=count, part=part: accepted(after(int(s * count)), part))
        taken = int(count * share)
        gaussians = after(taken)
        idle = 0 if taken > WORTHWHILE * len(gaussians) else idle + 1
        if (idle >= 2 and part == 1) or len(gaussians) < 2:
            break
    return gaussians


def prune_model(
    gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions, seed: int, accepted: Accepted
) -> Gaussians:
    """Lower degrees, merge neighbours, then remove Gaussians as far as ``accepted`` allows; return them by ascending degree.

    The result was accepted with fraction 1, or nothing could be removed. ``cameras`` are those of the training views, tensors.
    """

    def maxima_of(model: Gaussians) -> torch.Tensor:
        return coverage(model, cameras, options)[0]

    model, begin = gaussians, DEGREES_FRACTION
    if bool((stored_degrees(model.sh) > 0).any()):
        model = lower_degrees(model, maxima_of(model), lambda g: accepted(g, DEGREES_FRACTION))
    model = merge_neighbours(model, maxima_of, lambda g, part: accepted(g, begin + part * (MERGE_FRACTION - begin)))
    order = prune_order(maxima_of(model), fisher(model, cameras, options, seed))
    fraction = largest_fraction(lambda s: accepted(select(model, keep_last(order, s)), 1.0))
    model = select(model, keep_last(order, fraction))
    return select(model, torch.argsort(stored_degrees(model.sh), stable=True))
