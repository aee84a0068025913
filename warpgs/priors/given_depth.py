"""Depth that the user gives: its scale in the scene, and views without distortion."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from warpgs import geometry
from warpgs.errors import DataError, UsageError, listed
from warpgs.priors.flow import nearest_views, no_depth, pixel_grid
from warpgs.scene import Camera, GivenDepth, PointCloud, View, ViewDepth

# Given depth: converted to the scene's units, checked against consistent depth, and used instead of the depth of a
# sweep.
#
# Derived in docs/decisions/022-given-depth.md. Depths are compared with the references of their view: depth of the
# sweep that other views confirm, and points of the reconstruction that the view saw. Maps of unknown scale and shift
# are fitted to the references.

MIN_OVERLAP = 50
"""Smallest number of references in a view with which a map is compared, or to which it is fitted."""
MAX_RATIO = 1.25
"""Largest median ratio of metric depth to its references in a view, or inverse of that ratio; other maps are rejected."""
NEAR = 0.05
"""Relative difference of depths up to which they count as one surface."""
GOOD, MIN_GOOD = 0.1, 0.5
"""A value of a fitted map is good if it differs from its reference by at most the first fraction; the second is the smallest
fraction of good values."""
EXACT = 0.015
"""Median relative difference up to which a fitted map is treated like a metric one; maps of networks differ by more."""
MIN_CONFIDENCE = 0.5
"""Smallest confidence at which a given depth may place Gaussians."""
ROUNDS = 20
"""Rounds of reweighted least squares."""
NEIGHBORS = 4
"""Number of nearest other views that a map is compared with."""
MAX_POINTS = 2**18
"""Largest number of pixels of a map that are compared; larger maps are subsampled on a grid."""
SHOWN = 5
"""Number of views that a message names."""


@dataclass(frozen=True)
class Alignment:
    """Conversion of a view's given map to scene units, and how well it agrees with the references."""

    scale: float = 1.0
    """Factor of the values."""
    shift: float = 0.0
    """Offset, in the unit of the scaled values."""
    references: int = 0
    """Number of references."""
    difference: float = float("nan")
    """Median relative difference from the references; NaN without references."""
    why_not: str = ""
    """Reason why the map is not used; empty if it is used."""

    def depth(self, given: GivenDepth) -> np.ndarray:
        """Return the z-depth [u] of a map, float32 [H, W]; 0 for missing values, or where it would not be positive."""
        known = given.values > 0
        found = np.where(known, given.values.astype(np.float64) * self.scale + self.shift, 0)
        known &= found > 0
        with np.errstate(divide="ignore", over="ignore"):
            inverted = 1 / np.where(known, found, 1) if given.kind == "disparity" else found
            return np.where(known, inverted, 0).astype(np.float32)


def any_given(views: Sequence[View]) -> bool:
    """Return whether any view has given depth."""
    return any(v.depth is not None for v in views)


def fit_line(values: np.ndarray, wanted: np.ndarray) -> tuple[float, float]:
    """Return scale and shift that map values [N] to ``wanted`` [N], above 0, with the smallest relative differences."""
    # least squares, reweighted by Cauchy's function, from the line through the medians of the lower and upper third
    order = np.argsort(values, kind="stable")
    third = max(1, len(order) // 3)
    low, high = order[:third], order[-third:]
    run = float(np.median(values[high]) - np.median(values[low]))
    scale = float(np.median(wanted[high]) - np.median(wanted[low])) / run if run > 0 else 0.0
    shift = float(np.median(wanted - scale * values))
    for _ in range(ROUNDS):
        off = np.abs((scale * values + shift) / wanted - 1)
        weight = 1 / (wanted**2 * (1 + (off / max(1.5 * float(np.median(off)), 1e-6)) ** 2))
        total = weight.sum()
        x, y = values - (weight * values).sum() / total, wanted - (weight * wanted).sum() / total
        square = float((weight * x * x).sum())
        if not square > 0:
            return 0.0, shift
        scale = float((weight * x * y).sum()) / square
        shift = float((weight * (wanted - scale * values)).sum() / total)
    return scale, shift


def references(view: View, found: ViewDepth | None, known: PointCloud) -> tuple[np.ndarray, np.ndarray]:
    """Return values of a view's given depth [N], and the references [N] [u] at the same pixels, float64."""
    assert view.depth is not None
    sure = np.zeros(view.depth.values.shape) if found is None else np.where(found.valid, found.depth, 0).astype(np.float64)
    if known.tracks is not None:
        _, rows, columns, z = geometry.seen_pixels(view.camera, known.seen_by({view.name}).points)
        order = np.argsort(-z, kind="stable")  # of two in one pixel the nearer is written last
        sure[rows[order], columns[order]] = z[order]
    at = (view.depth.values > 0) & (sure > 0)
    if view.depth.confidence is not None:
        at &= view.depth.confidence >= MIN_CONFIDENCE
    return view.depth.values[at].astype(np.float64), sure[at]


def align(view: View, found: ViewDepth | None, known: PointCloud) -> Alignment:
    """Return the conversion of a view's given depth to scene units; metric depth is only compared with the references."""
    assert view.depth is not None
    values, wanted = references(view, found, known)
    count, kind = len(values), view.depth.kind
    if count < MIN_OVERLAP:
        few = f"{count} depths are known at its pixels, and the fit needs at least {MIN_OVERLAP}"
        return Alignment(references=count, why_not="" if kind == "metric" else few)
    scale, shift = (1.0, 0.0) if kind == "metric" else fit_line(values, 1 / wanted if kind == "disparity" else wanted)
    fitted = scale * values + shift
    with np.errstate(divide="ignore"):
        fitted = np.where(fitted > 0, 1 / fitted if kind == "disparity" else fitted, 0)
    off = np.abs(fitted / wanted - 1)
    ratio, good, why_not = float(np.median(values / wanted)), float((off <= GOOD).mean()), ""
    if kind == "metric":
        if not 1 / MAX_RATIO <= ratio <= MAX_RATIO:
            why_not = f"its depths are {ratio:.4g} times those that the views confirm"
    elif good < MIN_GOOD:
        why_not = f"{good:.0%} of its depths are within {GOOD:.0%} of depths that other views confirm"
    elif not scale > 0:
        other = "relative" if kind == "disparity" else "disparity"
        why_not = f"its values change with depth in the wrong direction; are they {other}?"
    return Alignment(scale, shift, count, float(np.median(off)), why_not)


def votes(views: Sequence[View], depths: Sequence[np.ndarray], index: int) -> np.ndarray:
    """Count the other views that confirm each depth of a view, and that see through it, int [2, H, W]."""
    own = depths[index]
    step = math.ceil(math.sqrt(np.count_nonzero(own) / MAX_POINTS)) if own.any() else 1
    coarse = own[::step, ::step]
    rows, columns = np.nonzero(coarse)
    pixels, z = np.stack([columns, rows], 1) * step + 0.5, coarse[rows, columns].astype(np.float64)
    points = geometry.back_project(views[index].camera, pixels, z)
    counts = np.zeros((2, *coarse.shape), int)
    for j in nearest_views(views, index, NEIGHBORS):
        seen, r, c, there = geometry.seen_pixels(views[j].camera, points)
        other = depths[j][r, c]
        known = other > 0
        at = rows[seen], columns[seen]
        counts[0][at] += known & (np.abs(there - other) <= NEAR * other)
        counts[1][at] += known & (there < (1 - NEAR) * other)
    return counts.repeat(step, 1).repeat(step, 2)[:, : own.shape[0], : own.shape[1]]


def with_given_depth(
    views: Sequence[View], found: Sequence[ViewDepth] | None, known: PointCloud
) -> tuple[list[ViewDepth], list[str]]:
    """Return the depth of each view (pinholes), combined with its given depth, and notes."""
    # A metric map, or one that fits its references closely, replaces the estimate. Any other is used only where another view
    # confirms it and the estimate is missing or differs. Depths that more views see through than confirm are dropped.
    before = [no_depth(v) for v in views] if found is None else list(found)
    made = [None if v.depth is None else align(v, d, known) for v, d in zip(views, before, strict=True)]
    none = [np.zeros(v.image.shape[:2], np.float32) for v in views]
    given = [zeros if a is None or a.why_not else a.depth(v.depth) for v, a, zeros in zip(views, made, none, strict=True)]
    refused = [f"{v.name}: {a.why_not}" for v, a in zip(views, made, strict=True) if a is not None and a.why_not]
    if len(refused) == sum(a is not None for a in made):
        remedy = "Check --depth-kind, start from a sweep (--init.source sweep), or leave out --depths"
        if any(v.depth is not None and v.depth.kind == "metric" for v in views):
            remedy = "Set --depth-unit to the length of the maps' unit, or use --depth-kind relative if the cameras differ"
        raise DataError(f"no depth map can be used: {'; '.join(refused[:SHOWN])}. {remedy}")
    best = [np.where(g > 0, g, np.where(d.valid, d.depth, 0)) for g, d in zip(given, before, strict=True)]
    after, removed, total = [], 0, 0
    for i, (view, a, d) in enumerate(zip(views, made, before, strict=True)):
        known = given[i] > 0
        if view.depth is None or a is None or not known.any():
            after.append(d)
            continue
        confirm, through = votes(views, best, i)
        own = known & (through <= confirm)
        removed, total = removed + int((known & ~own).sum()), total + int(known.sum())
        placing = own if view.depth.confidence is None else own & (view.depth.confidence >= MIN_CONFIDENCE)
        if view.depth.kind != "metric" and not a.difference <= EXACT:
            placing = placing & (confirm > 0) & (~d.valid | (np.abs(d.depth - given[i]) > NEAR * given[i]))
        after.append(replace(
            d, depth=np.where(placing, given[i], d.depth).astype(np.float32), valid=d.valid | placing,
            sensitivity=np.where(placing, 0, d.sensitivity).astype(np.float32), given=np.where(own, given[i], 0),
        ))  # fmt: skip
    return after, _notes(made, refused, removed / max(1, total))


def _notes(made: Sequence[Alignment | None], refused: Sequence[str], removed: float) -> list[str]:
    """Return notes on maps that are used and left out."""
    used = [a for a in made if a is not None and not a.why_not]
    compared = [a for a in used if a.references >= MIN_OVERLAP]
    words = [f"given depth: used in {len(used)} of {len(made)} views"]
    if compared:
        off = [a.difference for a in compared]
        words.append(f"median difference from depths of other views: {np.median(off):.1%} (worst view {max(off):.1%})")
    if len(compared) < len(used):
        words.append(f"{len(used) - len(compared)} of these views without a comparison")
    if removed:
        words.append(f"{removed:.1%} of the given depths left out, because other views see through them")
    notes = ["; ".join(words)]
    if refused:
        notes.append(f"given depth: {len(refused)} maps are not used: {listed(refused, SHOWN)}")
    return notes


def pinhole_view(view: View) -> View:
    """Return a view resampled to a pinhole of the same K and size; a pinhole's view is returned unchanged."""
    import cv2

    camera = view.camera
    if camera.model == "pinhole":
        return view
    if camera.model not in geometry.CENTRAL:
        raise UsageError(f"no depth for {camera.model!r} cameras: give --init.source points, --strategy mcmc or clone_split")
    shape = (camera.height, camera.width)
    x, y = (_lens_pixels(camera) - 0.5).reshape(*shape, 2).astype(np.float32).transpose(2, 0, 1)  # OpenCV's centres are whole
    inside = (x >= -0.5) & (x <= camera.width - 0.5) & (y >= -0.5) & (y <= camera.height - 0.5)

    def moved(raster: np.ndarray) -> np.ndarray:
        return cv2.remap(raster.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def picked(raster: np.ndarray) -> np.ndarray:
        return cv2.remap(raster, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)

    mask, score_mask = (None if m is None else inside & (moved(m) > 0.5) for m in (view.mask, view.score_mask))
    mask = inside if mask is None else mask
    alpha = None if view.alpha is None else np.clip(moved(view.alpha), 0, 1) * inside
    if (depth := view.depth) is not None:
        sure = None if depth.confidence is None else picked(depth.confidence)
        depth = replace(depth, values=picked(depth.values), confidence=sure)
    return replace(
        view, camera=replace(camera, model="pinhole", distortion=None), image=moved(view.image),
        mask=None if mask.all() else mask, score_mask=score_mask, alpha=alpha, depth=depth,
    )  # fmt: skip


def lens_depth(camera: Camera, found: ViewDepth) -> ViewDepth:
    """Map depth found in a `pinhole_view` to the pixels of the original camera; invalid where the pinhole sees nothing."""
    if camera.model == "pinhole":
        return found
    plane = (pixel_grid(camera) - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    with np.errstate(all="ignore"):
        rays = geometry.from_plane(camera.model, camera.distortion, plane)
        pixels = rays[:, :2] / rays[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
        size = np.array([camera.width, camera.height])
        seen = (rays[:, 2] > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)  # a NaN is not seen
    columns, rows = np.floor(np.where(seen[:, None], pixels, 0)).astype(int).T
    shape = (camera.height, camera.width)

    def taken(raster: np.ndarray) -> np.ndarray:
        return raster[rows, columns].reshape(shape)

    valid = taken(found.valid) & seen.reshape(shape)
    per_z = np.where(seen, 1 / np.where(seen, rays[:, 2], 1), 0).reshape(shape)  # rays have depth 1
    depth = np.where(valid, taken(found.depth) * per_z, 0).astype(np.float32)
    sensitivity = np.where(valid, taken(found.sensitivity) * per_z, np.inf).astype(np.float32)
    given = None if found.given is None else (taken(found.given) * per_z).astype(np.float32)
    return replace(found, depth=depth, valid=valid, sensitivity=sensitivity, given=given)


def _lens_pixels(camera: Camera) -> np.ndarray:
    """Return for each pixel of a pinhole with the same K the lens pixel [H * W, 2] in its direction; far off if none exists."""
    plane = (pixel_grid(camera) - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    positions = np.concatenate([plane, np.ones((len(plane), 1))], 1)
    with np.errstate(all="ignore"):
        found = geometry.to_plane(camera.model, camera.distortion, positions) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    return np.where(geometry.on_lens(camera.model, camera.distortion, positions)[:, None] & np.isfinite(found), found, -1e6)
