"""Edits of a finished model: filters and compression."""

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgs.errors import DataError, UsageError
from warpgs.files import read_input, unread_reason
from warpgs.geometry import matmul
from warpgs.kernels.sh import MAX_DEGREE
from warpgs.pipeline.model.limits import NEEDLE, ROUNDING, long_axes
from warpgs.pipeline.model.table import truncated
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Box, Camera, Gaussians

SEEN = 4 / 255
"""Least blending weight at which a view sees a Gaussian: with less, the Gaussian changes no pixel by more than 4 of 255
levels."""
PROBES = 16
"""Least number of random images over all views for the sensitivities."""


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
def sensitivities(
    gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions, seed: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Estimate three squared changes of the images for each Gaussian, summed over pixels, at least 0, shape [N].

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
    return total[0], total[1], total[2]


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
        raise UsageError(f"{what} takes {' x '.join(map(str, shape))} finite numbers, not {str(value)[:60]}")
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
        low, high = numbers_of(value, (6,), "--crop: a box").reshape(2, 3)
        center, size, rotation = (low + high) / 2, high - low, np.eye(3)
    else:
        center, size = (numbers_of(value.get(key), (3,), f"--crop: {key}") for key in ("center", "size"))
        rotation = numbers_of(value.get("rotation", np.eye(3).tolist()), (3, 3), "--crop: rotation")
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


def disturbing(gaussians: Gaussians, maxima: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
    """Return the `floaters`, each under its first reason alone."""
    return first_reasons(floaters(gaussians, maxima))


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
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * matmul(cross, cross)


def levelling(up: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] that turns an upward direction [3] to -y, which is up in PLY files, by the shortest way."""
    u = np.asarray(up, np.float64) / math.sqrt(float((np.asarray(up) ** 2).sum()))
    axis = np.cross(u, [0.0, -1.0, 0.0])
    angle = math.atan2(math.sqrt(float((axis**2).sum())), -float(u[1]))
    return rotation_about(axis if angle % math.pi > 1e-12 else np.array([1.0, 0.0, 0.0]), angle)


TRIES = 8
"""Largest number of steps in the search for the largest fraction."""
AIM = 0.9
"""A search ends at this part of the allowed loss; it costs about 1 % of the Gaussians that could be removed."""
FAR_APART = 50
"""Ratio of the losses at both ends of a search above which it goes on in the middle."""
DEGREES_FRACTION = 1 / 3
"""Part of the allowed loss that lower degrees may use up. Removal may use up the rest."""
REPEATS = 3
"""Largest number of searches for a model that keeps the limit on all views."""


Loss = Callable[[Gaussians, bool], float]
"""The loss of a model, on all views or on a few."""


def largest_fraction(loss: Callable[[float], float], allowed: float) -> float:
    """Return the largest fraction in [0, 1] that was tried and has at most the allowed loss; 1 is tried first, 0 needs no test.

    The logarithm of the loss is nearly linear in the fraction, so the next one is on the line through the losses at both ends;
    if these are far apart, as at a step, it is the middle.
    """
    low, high, at = 0.0, 1.0, 1.0
    below = above = least = 0.01 * allowed
    for _ in range(TRIES):
        lost = loss(at)
        if lost <= allowed:
            low, below = at, max(lost, least)
        else:
            high, above = at, lost
        if low == 1 or AIM * allowed <= lost <= allowed:
            break
        steep = not above < FAR_APART * below  # or not finite
        part = 0.5 if steep else math.log(math.sqrt(AIM) * allowed / below) / math.log(above / below)
        at = low + (high - low) * min(0.9, max(0.1, part))
    return low


def keep_last(order: torch.Tensor, fraction: float) -> torch.Tensor:
    """Return the rows, ascending, that remain after the first ``fraction`` of an order [N] is removed; at least one remains."""
    return order[min(len(order) - 1, int(fraction * len(order))) :].sort().values


def stored_degrees(sh: torch.Tensor) -> torch.Tensor:
    """Return the highest degree at which coefficients [N, K, 3] of each Gaussian are not all zero, int32 [N]."""
    bands = torch.arange(sh.shape[1], device=sh.device).add(0.5).sqrt().to(torch.int32)
    return torch.where((sh != 0).any(2), bands, 0).amax(1)


def by_degree(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians by ascending degree, without degrees that none of them uses."""
    return drop_unused_sh(select(gaussians, torch.argsort(stored_degrees(gaussians.sh), stable=True)))


def drop_unused_sh(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians without degrees that none of them uses; a file stores equally many coefficients for all."""
    return limit_degree(gaussians, int(stored_degrees(gaussians.sh).max()) if len(gaussians) else 0)


def lower_degrees(gaussians: Gaussians, need: torch.Tensor, loss: Callable[[Gaussians], float], allowed: float) -> Gaussians:
    """Return the set without harmonics above degree 0 in as many Gaussians as the allowed loss permits, least need first."""
    order, degrees = torch.argsort(need, stable=True), stored_degrees(gaussians.sh)

    def lowered(fraction: float) -> Gaussians:
        some = degrees.clone()
        some[order[: int(fraction * len(order))]] = 0
        return replace(gaussians, sh=truncated(gaussians.sh, some))

    return lowered(largest_fraction(lambda s: loss(lowered(s)), allowed))


def prune_model(
    gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions, seed: int, loss: Loss, allowed: float
) -> tuple[Gaussians, float]:
    """Lower degrees, then remove Gaussians; return the smaller set, by ascending degree, and its loss on all views.

    The loss is at most ``allowed``. A search on few views is repeated for less if the loss on all views is too large; degrees
    stay if lower ones alone lose too much there.
    ``cameras`` are those of all training views, tensors. The first to go have the least product of PUP-3DGS' sensitivity and of
    the change without them; by one of both alone, fewer could go at the same loss.
    """
    space, removal, harmonics = sensitivities(gaussians, cameras, options, seed)
    order, lowered, aim = torch.argsort(space.sqrt() * removal.sqrt(), stable=True), gaussians, allowed
    if bool((stored_degrees(gaussians.sh) > 0).any()):
        lowered = lower_degrees(gaussians, harmonics, lambda g: loss(g, False), DEGREES_FRACTION * allowed)
        lowered = lowered if loss(lowered, True) <= allowed else gaussians
    for _ in range(REPEATS):
        fraction = largest_fraction(lambda s: loss(select(lowered, keep_last(order, s)), False), aim)
        model = by_degree(select(lowered, keep_last(order, fraction)))
        if (lost := loss(model, True)) <= allowed:
            return model, lost
        aim *= AIM * allowed / lost
    return by_degree(gaussians), 0.0
