"""Edits of a finished model: filters, merging and compression."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
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
from warpgs.pipeline.model.table import DensityUpdate, truncated
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import C0, Camera, Gaussians

SEEN = 4 / 255
"""Least blending weight at which a view sees a Gaussian: with less, the Gaussian changes no pixel by more than 4 of 255
levels."""
PROBES = 2
"""Random images per view for the Fisher sensitivity."""


@dataclass(frozen=True)
class Coverage:
    """Coverage of each Gaussian by all training views; tensors of shape [N] on the device of the Gaussians."""

    maxima: torch.Tensor
    """Largest blending weight over all pixels of all views (RadSplat, arXiv 2403.13806); a sum of weights would be small for
    thin Gaussians."""
    views: torch.Tensor
    """Number of views with a weight of at least `SEEN`, int64."""


@torch.no_grad()
def coverage(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions) -> Coverage:
    """Render every view once; measure each Gaussian's largest blending weight, and the number of views that see it.

    Args:
        gaussians: N Gaussians.
        cameras: Cameras of the training views, tensors.
        options: Settings of the rasterizer.
    """
    count, means = len(gaussians), gaussians.means
    maxima, views = means.new_zeros(count), torch.zeros(count, dtype=torch.int64, device=means.device)
    for c in cameras:
        weights = rasterize(gaussians, c, replace(options, contributions=True)).weight_maxima[0]
        maxima = torch.maximum(maxima, weights)
        views += weights >= SEEN
    return Coverage(maxima, views)


@torch.enable_grad()  # the caller may have switched gradients off, as the trainer does when the set changes
def fisher(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions, seed: int) -> torch.Tensor:
    """Estimate the change of the images when a Gaussian moves by its own width or its axes grow.

    The result is the trace of PUP-3DGS' sensitivity, in units of the Gaussian's width (arXiv 2406.10219, eq. 6: the sum over
    pixels of the outer product of the colour's gradient with respect to mean and scale). PUP uses the log-determinant instead.
    With random signs e as the gradient of an image, the backward pass gives J^T e; the mean of the squares of J^T e is the
    diagonal of J^T J.

    Args:
        gaussians: N Gaussians.
        cameras: Cameras of the training views, tensors.
        options: Settings of the rasterizer.
        seed: Seed of the signs, the same on every device.

    Returns:
        Sensitivities, at least 0, shape [N].
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

    Args:
        opacity: a and b, shape [P, 2].
        area: `_area` of both, shape [P, 2].
        own: Covariances of G and H, shape [P, 2, 3, 3].
        means: Their means, shape [P, 2, 3].
    """
    squares, axes = torch.linalg.eigh(own.sum(1))
    squares = squares.clamp_min(1e-30)
    apart = (axes.transpose(1, 2) @ (means[:, 0] - means[:, 1])[..., None]).squeeze(-1)
    together = torch.exp(-0.5 * (apart.square() / squares).sum(1)) / squares[:, 1:].prod(1).sqrt()
    return (opacity * area).sum(1) - opacity.prod(1) * area.prod(1) * together


@dataclass(frozen=True)
class Merges:
    """Pairs that could become one, the cheapest first."""

    first: torch.Tensor
    """Row of one Gaussian of each pair, int64, shape [P]; no row occurs twice in ``first`` and ``second`` together."""
    second: torch.Tensor
    """Row of the other Gaussian of each pair, int64, shape [P]."""
    merged: dict[str, torch.Tensor]
    """Merged Gaussian of each pair: rows of the five tensors, shape [P, ...]."""

    def change(self, count: int, taken: int) -> DensityUpdate:
        """Return the change that merges the first ``taken`` pairs in a set of ``count`` Gaussians."""
        stays = torch.ones(count, dtype=torch.bool, device=self.first.device)
        stays[self.first[:taken]] = False
        stays[self.second[:taken]] = False
        added = {n: t[:taken] for n, t in self.merged.items()}
        return DensityUpdate(torch.nonzero(stays).squeeze(1), added, self.first[:taken])


def _curve(means: torch.Tensor, shift: float) -> torch.Tensor:
    """Return the rows of means [N, 3] along the Morton curve of their bounding box, enlarged by ``shift`` on one side."""
    low, high = means.amin(0), means.amax(0)
    boxed = torch.cat([means, (low - shift * (high - low))[None]])
    return torch.argsort(morton_codes(boxed)[:-1], stable=True)


@torch.no_grad()
def merges(gaussians: Gaussians, maxima: torch.Tensor, kinds: torch.Tensor, odd: bool, shift: float = 0.0) -> Merges:
    """Pair neighbours along the Morton curve, and compute the merged Gaussian of each pair.

    Mean, covariance and colours are those of the mixture, weighted by opacity times face-on area. The product of the new
    opacity and the new area is the area that the pair covers face on; the overlap counts once. If this needs an opacity above
    `OPAQUE`, the two longer axes grow instead: otherwise a surface of opaque Gaussians would get holes. The cost of a pair is
    its largest blending weight times the sum of three terms. They are the difference of the colours; the logarithm of new over
    old covered area, since distant pairs or pairs of different planes bulge; and the logarithm of the factor by which the area
    had to grow.

    Args:
        gaussians: N Gaussians.
        maxima: Largest blending weight of each, shape [N].
        kinds: Only Gaussians of the same kind are paired, int, shape [N].
        odd: Pair the second with the third, and so on, instead of the first with the second.
        shift: Fraction of the cloud's size by which the curve is moved, so that neighbours in two large cells can be paired.
    """
    order = _curve(gaussians.means, shift)[int(odd) :]
    order = order[: len(order) // 2 * 2].reshape(-1, 2)
    order = order[kinds[order[:, 0]] == kinds[order[:, 1]]]
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
    weight = maxima.detach()[order].amax(1).double().cpu()
    cost = weight * (colour + bulge + grown)
    cost = torch.where(torch.isfinite(cost), cost, torch.inf)
    ranks = torch.argsort(cost, stable=True)
    ranks = ranks[torch.isfinite(cost[ranks])]
    device = gaussians.means.device
    chosen = order[ranks.to(device)]
    return Merges(chosen[:, 0], chosen[:, 1], {n: t[ranks].to(device, gaussians.means.dtype) for n, t in merged.items()})


INNER = 0.02
"""Fraction of the means that is left out at each end of each axis when the size of the scene is measured."""
NEEDLE_LENGTH = 0.2
"""A Gaussian beyond the ratio `NEEDLE` is removed if it is longer than this fraction of the scene's size: shorter needles are
hairs and edges of a good model. With a tenth instead, removal costs up to 0.08 dB on held-out views
(docs/decisions/014-formats.md)."""
MAX_BOX_BYTES = 65536
"""Largest size of a file that describes a box [bytes]."""


@dataclass(frozen=True)
class Box:
    """A box with any orientation."""

    center: tuple[float, float, float]
    """Middle [file units]."""
    size: tuple[float, float, float]
    """Full lengths of the sides [file units]."""
    rotation: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Rotation matrix, shape [3, 3]; its columns are the directions of the sides in the world."""


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
    """Return the box of a user's text.

    Args:
        text: JSON with center, size and optionally rotation; the name of a .json file with this JSON; or six numbers separated
            by commas: the least x, y, z and the largest x, y, z.

    Raises:
        DataError: The file cannot be read, or does not describe a box.
        UsageError: The text is invalid, or a side is not longer than 0.
    """
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
            raise UsageError(
                "--crop: rotation must be a rotation matrix: its columns are not perpendicular, or not of length 1"
            )
    if not (size > 0).all():
        raise UsageError(f"--crop: the box has sides of {', '.join(f'{s:g}' for s in size)}; each must be longer than 0")
    a, b, c = (tuple(map(float, v)) for v in (center, size, rotation[0]))
    return Box(a, b, (c, tuple(map(float, rotation[1])), tuple(map(float, rotation[2]))))  # type: ignore[arg-type]


def _box_of_file(path: Path) -> Box:
    """Return the box of a JSON file, as the viewer saves it; DataError if the file has no box."""
    try:
        text = read_input(path, MAX_BOX_BYTES).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as e:
        why = unread_reason(e) if isinstance(e, OSError) else e
        raise DataError(f"{path}: cannot be read as a box ({why}); give a JSON file with center and size") from e
    try:
        if not text.lstrip().startswith("{"):
            raise UsageError("expected a JSON object with center and size")
        return box_of(text)
    except UsageError as e:
        raise DataError(f"{path}: not a box ({e}); save the box again in the viewer") from e


def select(gaussians: Gaussians, keep: torch.Tensor) -> Gaussians:
    """Return the Gaussians selected by ``keep``, bool [N] or rows [K]."""
    return Gaussians(**{name: t[keep] for name, t in gaussians.tensors().items()})


def inside(gaussians: Gaussians, box: Box) -> torch.Tensor:
    """Return whether each mean is in a box, bool [N]; box and Gaussians are in the same units."""
    offsets = gaussians.means.double() - torch.tensor(box.center, dtype=torch.float64, device=gaussians.means.device)
    directions = np.array(box.rotation).T
    out = torch.ones(len(gaussians), dtype=torch.bool, device=offsets.device)
    for direction, side in zip(directions, box.size):
        along = sum(float(d) * offsets[:, i] for i, d in enumerate(direction))
        out &= along.abs() <= side / 2
    return out


def disturbing(gaussians: Gaussians, maxima: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
    """Return the floaters and needles, each under the first reason that applies, bool [N] by reason.

    Args:
        gaussians: N Gaussians.
        maxima: Largest blending weight of each over all training views, shape [N]; None without views.
    """
    out = {}
    free = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    if not len(gaussians):
        return out
    means = gaussians.means.double().cpu().numpy()
    low, high = np.quantile(means, [INNER, 1 - INNER], axis=0)
    size = max(math.sqrt(float(((high - low) ** 2).sum())), 1e-30)
    longest, middle = long_axes(gaussians.log_scales.double())
    needle = longest - middle > math.log(NEEDLE) + ROUNDING  # a fit holds many at the ratio itself
    found = {
        "larger than the scene": longest > math.log(size),
        f"needles over {NEEDLE:g} times as long as wide": needle & (longest > math.log(NEEDLE_LENGTH * size)),
    }
    if maxima is not None:
        found = {"seen by no training view": maxima < SEEN} | found
    for reason, where in found.items():
        out[reason] = where & free
        free &= ~where
    return out


def limit_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return the same Gaussians without the harmonics above a degree.

    Raises:
        UsageError: The degree is not 0 to 4.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise UsageError(f"--sh-degree {degree}: harmonics have degrees 0 to {MAX_DEGREE}")
    return replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2].contiguous())


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation [3, 3] by an angle [rad] about an axis [3] of any length (Rodrigues).

    Raises:
        UsageError: The axis has length 0, or a number is not finite.
    """
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


def largest_fraction(accepted: Callable[[float], bool], rounds: int = ROUNDS) -> float:
    """Return the largest accepted fraction in [0, 1], by bisection; 1 is tried first, 0 needs no test.

    The result itself was accepted, or is 0; if acceptance is not monotone, a larger fraction may be accepted, too.
    """
    if accepted(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(rounds):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if accepted(middle) else (low, middle)
    return low


def _ranks(values: torch.Tensor) -> torch.Tensor:
    """Return the place of each value [N] in ascending order, equal values by row, int64 [N]."""
    places = torch.empty(len(values), dtype=torch.int64, device=values.device)
    places[torch.argsort(values, stable=True)] = torch.arange(len(values), device=values.device)
    return places


def prune_order(maxima: torch.Tensor, sensitivity: torch.Tensor) -> torch.Tensor:
    """Return the rows of the Gaussians in the order in which they may be removed, int64 [N].

    Gaussians are ranked by largest contribution and by Fisher sensitivity; the higher of both ranks decides. So a Gaussian is
    removed only if both scores are low; thin Gaussians and wide faint ones stay if one score is high.

    Args:
        maxima: Largest blending weight of each Gaussian, shape [N].
        sensitivity: Result of `fisher`, shape [N].
    """
    return torch.argsort(torch.maximum(_ranks(maxima), _ranks(sensitivity)), stable=True)


def keep_last(order: torch.Tensor, fraction: float) -> torch.Tensor:
    """Return the rows that remain after the first ``fraction`` of an order is removed; at least one remains.

    Args:
        order: Rows, int64, shape [N].
        fraction: Fraction to remove, in [0, 1].

    Returns:
        Rows in ascending order, int64, shape [K].
    """
    return order[min(len(order) - 1, int(fraction * len(order))) :].sort().values


def rows_of(gaussians: Gaussians, keep: torch.Tensor) -> Gaussians:
    """Return the Gaussians of the rows ``keep``, int64 [K] or bool [N]."""
    return Gaussians(**{n: t[keep] for n, t in gaussians.tensors().items()})


def changed(gaussians: Gaussians, change: DensityUpdate) -> Gaussians:
    """Return the set of Gaussians after a change."""
    return Gaussians(**{n: torch.cat([t[change.keep], change.added[n]]) for n, t in gaussians.tensors().items()})


def with_degrees(gaussians: Gaussians, degrees: torch.Tensor) -> Gaussians:
    """Return the same Gaussians with zeros for coefficients above their degrees [N]."""
    return Gaussians(**(gaussians.tensors() | {"sh": truncated(gaussians.sh, degrees)}))


def degree_order(gaussians: Gaussians, seen: Coverage) -> torch.Tensor:
    """Return the rows of the Gaussians by ascending need for harmonics, int64 [N].

    The need is the norm of the coefficients above degree 0, times the largest blending weight. In an orthonormal basis, this
    norm is proportional to the standard deviation of the colour over directions.
    """
    return torch.argsort(gaussians.sh[:, 1:].square().sum((1, 2)).sqrt() * seen.maxima, stable=True)


def stored_degrees(sh: torch.Tensor) -> torch.Tensor:
    """Return the highest degree at which coefficients [N, K, 3] of each Gaussian are not all zero, int32 [N]."""
    bands = torch.arange(sh.shape[1], device=sh.device).add(0.5).sqrt().to(torch.int32)
    return torch.where((sh != 0).any(2), bands, 0).amax(1)


def drop_unused_sh(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians without degrees that none of them uses; a file stores equally many coefficients for all."""
    degrees = stored_degrees(gaussians.sh)
    highest = int(degrees.max()) if len(degrees) else 0
    return Gaussians(**(gaussians.tensors() | {"sh": gaussians.sh[:, : (highest + 1) ** 2].contiguous()}))


@dataclass(frozen=True)
class ViewSet:
    """The training views for measurements on a model."""

    cameras: list[Camera]
    """Cameras with tensors on the device of the model."""
    options: RasterizeOptions
    """Options for rendering the views."""
    seed: int
    """Seed of the random signs of `fisher`."""

    def coverage(self, gaussians: Gaussians) -> Coverage:
        """Return the coverage of each Gaussian by these views, as `coverage` measures it."""
        return coverage(gaussians, self.cameras, self.options)

    def fisher(self, gaussians: Gaussians) -> torch.Tensor:
        """Return the sensitivity of these views to each Gaussian, as `fisher` estimates it, shape [N]."""
        return fisher(gaussians, self.cameras, self.options, self.seed)


def cheapest(gaussians: Gaussians, pairs: Merges, accepted: Callable[[Gaussians], bool]) -> int:
    """Return how many pairs, the cheapest first, may be merged so that the result is accepted."""
    count, total = len(gaussians), len(pairs.first)
    return int(total * largest_fraction(lambda s: accepted(changed(gaussians, pairs.change(count, int(s * total))))))


def merge_neighbours(
    gaussians: Gaussians, kinds: torch.Tensor, view_set: ViewSet, accepted: Callable[[Gaussians, float], bool]
) -> Gaussians:
    """Merge pairs, cheapest first, in rounds while they are worthwhile; return the smaller set.

    Args:
        gaussians: The set.
        kinds: Only Gaussians with the same number are paired, int, shape [N].
        view_set: Training views.
        accepted: Test whether a model is good enough when a fraction in [0, 1] of the allowed loss may be spent. The fraction
            grows over the first `RAMP` rounds, because the cheapest pairs of one round cost less than the last merged pairs of
            the round before.
    """
    idle = 0
    for number in range(PASSES):
        part = min(1.0, (number + 1) / RAMP)
        pairs = merges(gaussians, view_set.coverage(gaussians).maxima, kinds, odd=bool(number % 2), shift=number / PASSES)
        taken = cheapest(gaussians, pairs, lambda g, part=part: accepted(g, part))
        if taken:
            change = pairs.change(len(gaussians), taken)
            gaussians, kinds = changed(gaussians, change), torch.cat([kinds[change.keep], kinds[change.parents]])
        idle = 0 if taken > WORTHWHILE * len(gaussians) else idle + 1
        if (idle >= 2 and part == 1) or len(gaussians) < 2:
            break
    return gaussians


def dispensable(gaussians: Gaussians, view_set: ViewSet, accepted: Callable[[Gaussians], bool]) -> torch.Tensor:
    """Return the rows to keep, ascending, int64 [K]; as many rows are removed as ``accepted`` allows."""
    order = prune_order(view_set.coverage(gaussians).maxima, view_set.fisher(gaussians))
    return keep_last(order, largest_fraction(lambda s: accepted(rows_of(gaussians, keep_last(order, s)))))


def needed_degrees(gaussians: Gaussians, view_set: ViewSet, accepted: Callable[[Gaussians], bool]) -> torch.Tensor:
    """Return the degree of each Gaussian: 0 for as many as ``accepted`` allows, unchanged for the others.

    Args:
        gaussians: N Gaussians.
        view_set: Training views.
        accepted: Test whether a model is good enough.

    Returns:
        Degrees, int32, shape [N].
    """
    order = degree_order(gaussians, view_set.coverage(gaussians))
    degrees = stored_degrees(gaussians.sh)

    def lowered(fraction: float) -> torch.Tensor:
        result = degrees.clone()
        result[order[: int(fraction * len(order))]] = 0
        return result

    return lowered(largest_fraction(lambda s: accepted(with_degrees(gaussians, lowered(s)))))


@dataclass(frozen=True)
class Pruned:
    """A smaller model."""

    gaussians: Gaussians
    """Gaussians of the smaller model, by ascending degree."""
    degrees: torch.Tensor
    """Degree of each Gaussian, int32, shape [N], ascending."""


def prune_model(
    gaussians: Gaussians, kinds: torch.Tensor, view_set: ViewSet, accepted: Callable[[Gaussians, float], bool]
) -> Pruned:
    """Lower degrees, merge neighbours, then remove Gaussians, as far as is accepted.

    Args:
        gaussians: N Gaussians.
        kinds: Only Gaussians with the same number are merged, int, shape [N].
        view_set: The training views.
        accepted: Test whether a model is good enough when a fraction in [0, 1] of the allowed loss may be spent.

    Returns:
        The smaller model, which was accepted with fraction 1; the model itself if nothing may be removed.
    """
    degrees, model = stored_degrees(gaussians.sh), gaussians
    if bool((degrees > 0).any()):
        model = with_degrees(model, needed_degrees(model, view_set, lambda g: accepted(g, DEGREES_FRACTION)))

    begin = DEGREES_FRACTION
    model = merge_neighbours(model, kinds, view_set, lambda g, part: accepted(g, begin + part * (MERGE_FRACTION - begin)))
    keep = dispensable(model, view_set, lambda g: accepted(g, 1.0))
    degrees = stored_degrees(model.sh[keep])
    order = torch.argsort(degrees, stable=True)
    return Pruned(rows_of(model, keep[order]), degrees[order])
