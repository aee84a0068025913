"""Scores of rendered views: PSNR, SSIM and LPIPS within the scored region, after matching of colours, and moved cameras."""

import math
import threading
import warnings
from collections.abc import Iterable, Sequence
from concurrent.futures import CancelledError
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch

from warpgs.device import in_background
from warpgs.errors import listed
from warpgs.geometry import back_project, inverse, matmul, project_points, resized
from warpgs.io.images import dark_pixels, without_masked
from warpgs.kernels.ssim import RADIUS, ssim
from warpgs.kernels.update import squared_error
from warpgs.pipeline.metrics.lpips import Lpips
from warpgs.priors.flow import nearest_views, pixel_grid
from warpgs.process import Task
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians, View, checked_views


def quantiles(values: torch.Tensor, *fractions: float) -> list[torch.Tensor]:
    """Return quantiles of numbers [N], N at least 1, for fractions in [0, 1], linear between neighbours; a NaN ranks last."""
    # torch.quantile rejects more than 2^24 numbers, and photographs may have more pixels.
    ordered = values.sort().values
    ranks = [fraction * (len(ordered) - 1) for fraction in fractions]
    return [torch.lerp(ordered[int(r)], ordered[min(int(r) + 1, len(ordered) - 1)], r - int(r)) for r in ranks]


OPAQUE = 0.5
"""Opacity above which a pixel of a cut-out object shows it."""


def scored_region(view: View) -> tuple[np.ndarray | None, str]:
    """Return the pixels that a render is scored on, bool [H, W], and their name; None for all."""
    return counted_region(view) if view.score_mask is None else (view.score_mask, "score mask")


def counted_region(view: View) -> tuple[np.ndarray | None, str]:
    """Return the pixels of a view that a fit compares with the render, bool [H, W], and their name; None for all."""
    # These are the pixels of the view's mask, if any. Without a mask, they are the bright pixels of a view of an object on
    # black, because a black frame around a small object would dominate the score.
    if view.mask is not None and not view.mask.all():
        return view.mask, "mask"
    dark = dark_pixels(view.image)
    return (None, "all") if dark is None else (~dark, "foreground")


def fitted_region(view: View) -> tuple[np.ndarray | None, str]:
    """Return the pixels behind which a fit may start Gaussians, bool [H, W], and their name; None for all."""
    if view.alpha is None:
        return counted_region(view)
    opaque = view.alpha > OPAQUE
    return opaque if view.mask is None else opaque & view.mask, "object"


def masked_mse(rgb: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Return the mean squared error of a render [H, W, 3], clamped to [0, 1], over the pixels where the mask [H, W] is 1."""
    if mask is None:
        return squared_error(rgb, target) / rgb.numel()
    return ((rgb.clamp(0, 1) - target) ** 2 * mask[..., None]).sum() / (3 * mask.sum().clamp_min(1))


def psnr_of(mse: float) -> float:
    """Return the PSNR [dB] of a mean squared error of images in [0, 1]; infinite for 0."""
    return float("inf") if mse == 0 else -10 * math.log10(mse)


def psnr(image: np.ndarray, target: np.ndarray, region: np.ndarray | None = None) -> float:
    """Return the PSNR [dB] of two images in [0, 1], over all channels of the pixels in ``region`` [H, W]; infinite if equal."""
    difference = image.astype(np.float64) - target
    if region is not None:
        difference = np.compress(region.ravel(), difference.reshape(region.size, *image.shape[2:]), axis=0)
    mse = float(np.square(difference, out=difference).mean())
    # numpy's logarithm, which sometimes rounds differently from math.log10: published figures stay the same
    return float("inf") if mse == 0 else -10 * float(np.log10(mse))


VARIANTS = {
    "psnr": "of images rounded to 8 bits, over the scored pixels alone; mean over images",
    "ssim": "as in 3DGS papers: 11 x 11 Gaussian window, sigma 1.5, zero padding, all pixels and channels",
    "ssim_skimage": "scikit-image, as in NeRF papers: the same window, without the border; about 0.005 lower",
    "masks": "where a view has a mask, SSIM and LPIPS compare both images with white outside of it",
}
"""Definition of PSNR and SSIM, for result files and reports. Scores by other definitions are not comparable."""
ALPHA_VARIANTS = {
    "psnr_whole": "of views with an alpha channel: over all unmasked pixels, with the background of the fit behind both images",
    "psnr_foreground": "as psnr_whole, but only over the pixels with an opacity above 0.5",
    "alpha_empty": "mean rendered alpha over the pixels with an opacity below 0.02: 0 is ideal",
    "alpha_object": "mean rendered alpha over the pixels with an opacity above 0.98: 1 is ideal",
}
"""Definition of each score of views with an alpha channel. A mean covers only the views with pixels for the score."""
EMPTY, HALF, OBJECT = 0.02, 0.5, 0.98
"""Opacity below which a pixel is empty, above which it shows the object, and above which it shows only the object."""


@dataclass(frozen=True)
class ViewMetrics:
    """Scores of one view."""

    name: str
    """Name of the view."""
    psnr: float
    """Peak signal-to-noise ratio [dB] after rounding to 8 bits, over the scored pixels."""
    ssim: float
    """Mean structural similarity, 3DGS variant (zero padding, every pixel)."""
    ssim_skimage: float
    """Mean structural similarity, scikit-image variant (Gaussian weights, border cropped)."""
    region: str
    """Scored pixels: all, mask, score mask, or foreground (the object on a black background)."""
    lpips: dict[str, float] = field(default_factory=dict)
    """LPIPS by variant (`lpips_vgg_legacy`); empty without weights, NaN if the image is too small."""
    opacity: dict[str, float] = field(default_factory=dict)
    """Scores by the names of `ALPHA_VARIANTS`, NaN if the view has no such pixels; empty if the view is opaque."""

    def row(self) -> dict[str, Any]:
        """Return all scores by name, flat, as in result files."""
        row: dict[str, Any] = asdict(self)
        opacity, lpips = row.pop("opacity"), row.pop("lpips")
        return {**row, **opacity, **lpips}


def to_8_bit(image: np.ndarray) -> np.ndarray:
    """Round an image in [0, 1] to the values that an 8-bit file can hold, float32."""
    levels: np.ndarray = np.round(np.clip(image, 0, 1) * 255).astype(np.float32, copy=False)
    levels /= 255
    return levels


def over_white(image: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Return the image [H, W, 3] with white where ``region`` [H, W] is False."""
    return np.where(region[..., None], image, np.float32(1))


def scored_pair(view: View, image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, str]:
    """Return a render of a view and its photograph as they are compared, in 8 bits; the scored pixels, and their name."""
    # Masks are used as in DTU's protocol (Niemeyer et al. 2022 and later papers): PSNR over the mask's pixels alone, SSIM and
    # LPIPS on both images with white outside the mask.
    region, name = scored_region(view)
    image, target = to_8_bit(image), to_8_bit(view.image)
    if region is not None and name != "foreground":
        image, target = over_white(image, region), over_white(target, region)
    return image, target, region, name


def _opacity_scores(
    image: np.ndarray, target: np.ndarray, alpha: np.ndarray, true: np.ndarray, mask: np.ndarray | None
) -> dict[str, float]:
    """Return the scores of `ALPHA_VARIANTS` for images of 8 bits [H, W, 3], a rendered and a true alpha and a mask [H, W]."""
    counted = np.ones(true.shape, bool) if mask is None else mask
    regions = {"psnr_whole": counted, "psnr_foreground": counted & (true > HALF)}
    scores = {k: psnr(image, target, r) if r.any() else float("nan") for k, r in regions.items()}
    for name, r in (("alpha_empty", counted & (true < EMPTY)), ("alpha_object", counted & (true > OBJECT))):
        scores[name] = float(alpha[r].mean(dtype=np.float64)) if r.any() else float("nan")
    return scores


def score(view: View, image: np.ndarray, lpips: Lpips | None = None, alpha: np.ndarray | None = None) -> ViewMetrics:
    """Compare a rendered image [H, W, 3], and its alpha [H, W] if the view has an alpha channel, with the image of its view."""
    opacity = {}
    if alpha is not None and view.alpha is not None:
        opacity = _opacity_scores(to_8_bit(image), to_8_bit(view.image), alpha, view.alpha, view.mask)
    image, target, region, name = scored_pair(view, image)
    decibels = psnr(image, target, region)
    similarity = ssim(torch.from_numpy(image), torch.from_numpy(target))
    # both variants have one window: they differ only where it reaches beyond the border; NaN where it does not fit
    cropped = similarity[RADIUS:-RADIUS, RADIUS:-RADIUS].mean(dtype=torch.float64)
    distances = {} if lpips is None else lpips.measure(image, target)
    return ViewMetrics(view.name, decibels, float(similarity.mean()), float(cropped), name, distances, opacity)


KEPT_BYTES = 2**29
"""Most host memory of renders that are kept [bytes]: 140 of 504 x 378 px, 20 of 1333 x 1000 px."""


class Renders:
    """Renders of a finished model by camera, each made once while all fit into `KEPT_BYTES`."""

    def __init__(self, gaussians: Gaussians, options: RasterizeOptions):
        """Begin without a render."""
        self.gaussians, self.options, self._left = gaussians, options, KEPT_BYTES
        self._kept: dict[int, tuple[Camera, tuple[np.ndarray, np.ndarray, np.ndarray]]] = {}
        self._lock, self.ended = threading.Lock(), False
        """Whether the fit ends with an error: threads that still render get one, too."""

    @torch.no_grad()
    def __call__(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return colours [H, W, 3], depth [u] [H, W] and alpha [H, W] as numpy arrays, which nobody may change."""
        with self._lock:
            if self.ended:
                raise CancelledError
            if id(camera) in self._kept:  # a kept camera lives, so no other has its id
                return self._kept[id(camera)][1]
            r = rasterize(self.gaussians, camera, self.options)
            images = r.rgb.cpu().numpy(), r.depth.cpu().numpy(), r.alpha.cpu().numpy()
            if (size := sum(a.nbytes for a in images)) <= self._left:
                self._left -= size
                self._kept[id(camera)] = camera, images
            return images


def render_view(gaussians: Gaussians, view: View, options: RasterizeOptions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render a view; returns colours [H, W, 3], depth [u] [H, W] and alpha [H, W] as numpy arrays."""
    return Renders(gaussians, options)(view.camera)


@runtime_checkable
class Fitted(Protocol):
    """Gaussians with the options of their fit, such as `FittedModel`."""

    def gaussians(self) -> Gaussians:
        """Return the Gaussians in scene units."""

    def options(self) -> RasterizeOptions:
        """Return the options that the fit renders with."""


MOVED = 1e-3
"""Difference of a pose [u] above which a view was loaded with other flags, such as other left-out photographs."""
NOTICED = 0.5 / 255
"""Mean part of the background in a view's pixels above which it matters which one it is: half a level of an 8-bit image."""


def evaluate(
    gaussians: Gaussians | Fitted, views: Sequence[View], options: RasterizeOptions | None = None,
    lpips: Lpips | str | Path | None = None,
) -> list[ViewMetrics]:  # fmt: skip
    """Render views and score each against its image, as a fit does.

    Args:
        gaussians: A fitted model, such as the result of `fit`, which has the options of its fit; or N Gaussians in the units of
            the views' cameras: scene units for the views of a `Scene`.
        views: Views with images; use held-out views for a meaningful score.
        options: Options of the rasterizer; None for those of the fitted model. With Gaussians alone, None is a black background
            and the rule exact, with a warning if an opaque view shows much of the background.
        lpips: File of `warpgs convert-lpips`; None to leave LPIPS out.

    Returns:
        The scores of each view, in order.

    Raises:
        DataError: A field of a view is invalid; the message names the view, the field and the fix.
    """
    views, known = checked_views(views), options is not None or isinstance(gaussians, Fitted)
    cameras = getattr(gaussians, "scene_cameras", {})
    if isinstance(gaussians, Fitted):
        options = gaussians.options() if options is None else options
        gaussians = gaussians.gaussians()
    options = RasterizeOptions() if options is None else options
    lpips = Lpips(Path(lpips), gaussians.means.device) if isinstance(lpips, (str, Path)) else lpips
    scores, doubts = [], []
    for v in views:
        image, _, alpha = render_view(gaussians, v, options)
        scores.append(score(v, image, lpips, alpha))
        doubts += _doubts(v, alpha, options, known)
        if v.name in cameras and not np.allclose(cameras[v.name].viewmat, v.camera.viewmat, atol=MOVED):
            doubts.append(f"the pose of view {v.name} is not that of the fit; load the scene with the flags of the fit")
    if doubts:
        warnings.warn(f"evaluate: {doubts[0]}", stacklevel=2)
    return scores


def _doubts(view: View, alpha: np.ndarray, options: RasterizeOptions, known: bool) -> list[str]:
    """Return a reason to doubt the background of a render with this alpha [H, W], if any; ``known`` if it was given."""
    region, name = scored_region(view)
    if view.alpha is not None:
        empty, behind = view.alpha < EMPTY, np.zeros(3) if options.background is None else options.background
        colors = view.image[empty] - torch.as_tensor(behind).detach().cpu().numpy()
        if empty.any() and float(np.abs(colors.mean(0)).max()) > EMPTY:
            fix = "give options with the background of the views"
            return [f"view {view.name} is over another background than the render, so colours differ; {fix}"]
    elif not known and name != "foreground":
        shown = 1 - float((alpha if region is None else alpha[region]).mean())
        if shown > NOTICED:
            fix = "give the result of the fit instead of its Gaussians, or options with the background of the fit"
            return [f"{shown:.1%} of view {view.name} shows the background, taken as black; {fix}"]
    return []


def baselines(train: list[View], test: list[View]) -> dict[str, float]:
    """Return the mean PSNR [dB] over the test views of two predictions without 3D, which any useful fit beats."""
    # ``mean_photo``: the mean of the training images; ``nearest_photo``: the image of the nearest training camera. Training
    # images whose size differs from the test view's are left out, and so is a baseline without any score.
    train = in_background(without_masked, ((v,) for v in train))
    same = {s: [v for v in train if v.image.shape == s] for s in {v.image.shape for v in test}}
    means = {s: to_8_bit(np.asarray(sum(v.image for v in own) / np.float32(len(own)))) for s, own in same.items() if own}

    def scores(view: View) -> tuple[float, float]:
        shape, (region, _) = view.image.shape, scored_region(view)
        nearest = min(same[shape], key=lambda v: float(np.linalg.norm(v.camera.center - view.camera.center)))
        return psnr(means[shape], view.image, region), psnr(nearest.image, view.image, region)

    rows = in_background(scores, ((v,) for v in test if v.image.shape in means))
    return {name: float(np.mean(values)) for name, values in zip(("mean_photo", "nearest_photo"), zip(*rows))}


def summarize(metrics: list[ViewMetrics]) -> dict[str, float]:
    """Return the means over views of every numeric score; empty without views."""
    if not metrics:
        return {}
    rows = [m.row() for m in metrics]
    means = {key: float(np.mean([r[key] for r in rows])) for key in ("psnr", "ssim", "ssim_skimage", *metrics[0].lpips)}
    for key in ALPHA_VARIANTS:
        known = [r[key] for r in rows if not np.isnan(r.get(key, np.nan))]
        means |= {key: float(np.mean(known))} if known else {}
    return means


def variants(lpips: Lpips | None, alpha: bool = False) -> dict[str, str]:
    """Return the definition of each score, with those of `ALPHA_VARIANTS` if ``alpha``, and how masks are used."""
    networks = {"lpips": "not measured: no --lpips-weights were given"} if lpips is None else lpips.variants()
    return VARIANTS | networks | (ALPHA_VARIANTS if alpha else {})


MATCHED_RULE = "over the right half of each view, after an affine colour map fitted to its left half"
"""Definition of the score, as text for the user."""
RIDGE = 1e-6
"""Added to the variances of the colours, so that an image of one colour has a map, too: a deviation of 0.001 of full range."""


def matched_psnr(view: View, image: np.ndarray) -> float:
    """Return the PSNR [dB] of a render [H, W, 3] of a view by `MATCHED_RULE`; NaN if a half has no scored pixel."""
    region, _ = scored_region(view)
    left = np.ones(view.image.shape[:2], bool) if region is None else region.copy()
    right, middle = left.copy(), left.shape[1] // 2
    left[:, middle:], right[:, :middle] = False, False
    if not (left.any() and right.any()):
        return float("nan")
    # the map in least squares
    a, b = image[left].astype(np.float64), view.image[left].astype(np.float64)
    of_a, of_b = a.mean(0), b.mean(0)
    a, b = a - of_a, b - of_b
    matrix = matmul(matmul(b.T, a) / len(a), inverse(matmul(a.T, a) / len(a) + RIDGE * np.eye(3)))
    mapped = matmul(image[right].astype(np.float64), matrix.T) + (of_b - matmul(matrix, of_a))
    return psnr(to_8_bit(mapped), to_8_bit(view.image[right]))


MAX_PIXELS = 20_000
"""Largest number of pixels of the reduced views that are compared."""
MIN_RESIDUAL = 0.05
"""Least residual, in [0, 1], of a pixel that differs from the model."""
MIN_FACTOR = 3.0
"""Least ratio of a differing pixel's residual to the residual of other views at the same point."""
FLOOR = 0.005
"""Lower bound, in [0, 1], of the residual of other views in the ratio for `MIN_FACTOR`."""
MIN_VIEWS = 2
"""Fewest other views that must show a point."""
MIN_TRAINING = 6
"""Fewest training views for this check: with fewer, the model can fit objects that only one view shows."""
NEIGHBORS = 8
"""Number of nearest views in which a point is looked up."""
MAX_DEPTH_ERROR = 0.1
"""Largest relative difference between the depths at which two views show the same point."""
MIN_AREA = 0.004
"""Least area of a reported region, as a fraction of the image; in static scenes regions reach 0.002 (decision 019)."""
MAX_MISFIT = 5.0
"""A view fits badly as a whole if its median residual exceeds the median over views by this factor; no region of it is
reported."""
HIGH_MISFIT = 0.002
"""The fit is too early for this check if the median over views of their median residuals exceeds this; finished fits reach
0.001."""
LOW_MISFIT = 0.0005
"""Lower bound, in [0, 1], of the median over views to which `MAX_MISFIT` is applied."""
SMOOTHING = 32
"""Image width divided by the side of the square in which residuals are averaged."""


_Small = tuple[Camera, np.ndarray, np.ndarray, np.ndarray]
"""A view reduced to `MAX_PIXELS`: its camera, residuals, depths and the mask of its pixels that count, [H, W] each."""


def _reduced(view: View, rgb: np.ndarray, depth: np.ndarray, alpha: np.ndarray) -> _Small:
    """Return the small view of a render; its residuals are those beyond what a shift by one pixel explains."""
    import cv2

    c = view.camera
    small = resized(c, min(1.0, (MAX_PIXELS / (c.width * c.height)) ** 0.5))
    size = small.width, small.height
    photo, mask = without_masked(view).image, np.ones(alpha.shape) if view.mask is None else view.mask
    image, rgb = (cv2.resize(a.astype(np.float32), size, interpolation=cv2.INTER_AREA) for a in (photo, np.clip(rgb, 0, 1)))
    depth, alpha, mask = (cv2.resize(a.astype(np.float32), size, interpolation=cv2.INTER_NEAREST) for a in (depth, alpha, mask))
    around = np.ones((3, 3), np.uint8)
    beyond = np.maximum(np.maximum(cv2.erode(image, around) - rgb, rgb - cv2.dilate(image, around)), 0).mean(-1)
    side = max(3, round(small.width / SMOOTHING) | 1)
    return small, cv2.blur(beyond, (side, side)), depth, (alpha > 0.5) & (depth > 0) & (mask > 0)


def _residuals_elsewhere(small: Sequence[_Small], index: int, others: Sequence[int], at: np.ndarray) -> np.ndarray:
    """Return the residuals of other views at the points of pixels ``at`` [P] of one view, NaN where not shown, [others, P]."""
    camera, _, depth, _ = small[index]
    points = back_project(camera, pixel_grid(camera)[at], depth.ravel()[at].astype(float))
    found = np.full((len(others), len(points)), np.nan)
    for row, j in zip(found, others):
        other, residual, depth, _ = small[j]
        pixels, z = project_points(other, points)
        inside = np.flatnonzero((z > 0) & (pixels >= 1).all(1) & (pixels < [other.width - 1, other.height - 1]).all(1))
        x, y = pixels[inside].astype(int).T
        shown = np.abs(depth[y, x] - z[inside]) < MAX_DEPTH_ERROR * z[inside]
        row[inside[shown]] = residual[y[shown], x[shown]]
    return found


def moved_fractions(views: Sequence[View], renders: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> list[float]:
    """Return the fraction of each training view's pixels, in [0, 1], in regions that other views show differently.

    Renders are those of `render_view`.
    """
    # A pixel is included if the view's residual is much larger than the residuals of other views at the same point, and at
    # least two other views show this point. All fractions are 0 for fewer than `MIN_TRAINING` views, and for an unconverged
    # fit.
    import cv2

    fractions = [0.0] * len(views)
    if len(views) < MIN_TRAINING:
        return fractions
    small = in_background(_reduced, ((v, *r) for v, r in zip(views, renders, strict=True)))
    misfits = [float(np.median(residual)) for _, residual, _, _ in small]
    usual = float(np.median(misfits))

    def fraction(i: int) -> float:
        _, residual, _, counts = small[i]
        at = np.flatnonzero(counts & (residual > MIN_RESIDUAL))
        elsewhere = np.sort(_residuals_elsewhere(small, i, nearest_views(views, i, NEIGHBORS), at), axis=0)  # NaN last
        shown = np.isfinite(elsewhere).sum(0)
        low, high = (np.take_along_axis(elsewhere, n[None], 0)[0] for n in (np.maximum(shown - 1, 0) // 2, shown // 2))
        typical = np.nan_to_num((low + high) / 2)  # the median
        differs = np.zeros(residual.shape, bool)
        differs.flat[at] = (shown >= MIN_VIEWS) & (residual.flat[at] > MIN_FACTOR * np.maximum(typical, FLOOR))
        _, _, statistics, _ = cv2.connectedComponentsWithStats(differs.astype(np.uint8))
        areas = statistics[1:, cv2.CC_STAT_AREA] / residual.size
        return round(float(areas[areas >= MIN_AREA].sum()), 4)

    compared = [i for i, m in enumerate(misfits) if usual <= HIGH_MISFIT and m <= MAX_MISFIT * max(usual, LOW_MISFIT)]
    for i, value in zip(compared, in_background(fraction, ((i,) for i in compared))):
        fractions[i] = value
    return fractions


def moved_notes(fractions: dict[str, float]) -> list[str]:
    """Return a note that names the views with moved regions, the largest fraction of moved pixels first; empty without any."""
    named = sorted(((f, name) for name, f in fractions.items() if f > 0), reverse=True)
    words = listed([f"{name} ({f:.1%} of its pixels)" for f, name in named], 6)
    return [Task(f"something may have moved in {words}: look, and mask it out")] if named else []
