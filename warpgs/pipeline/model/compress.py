"""Smaller models for the same images: lower degrees, merge neighbours and remove Gaussians, as far as a test accepts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from warpgs.pipeline.model.coverage import Coverage, coverage, fisher
from warpgs.pipeline.model.merge import Merges, merges
from warpgs.pipeline.model.sh_degrees import truncated
from warpgs.pipeline.model.table import DensityUpdate
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Camera, Gaussians

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
