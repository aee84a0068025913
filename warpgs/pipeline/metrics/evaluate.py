"""Scores of a model on held-out images: PSNR, SSIM in two variants, LPIPS, and baselines without a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch

from warpgs.kernels.ssim import ssim
from warpgs.pipeline.metrics.lpips import Lpips
from warpgs.pipeline.metrics.psnr import psnr
from warpgs.pipeline.metrics.region import scored_region
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Gaussians, View
from warpgs.scene_checks import checked_views

VARIANTS = {
    "psnr": "of images rounded to 8 bits, over the scored pixels alone; mean over images",
    "ssim": "as in 3DGS papers: 11 x 11 Gaussian window, sigma 1.5, zero padding, all pixels and channels",
    "ssim_skimage": "scikit-image, as in NeRF papers: the same window, without the border; about 0.005 lower",
}
"""Definition of PSNR and SSIM, for result files and reports. Scores by other definitions are not comparable."""
ALPHA_VARIANTS = {
    "psnr_whole": "of views with an alpha channel: over all unmasked pixels, with the background of the fit behind both images",
    "psnr_foreground": "as psnr_whole, but only over the pixels with an opacity above 0.5",
    "alpha_empty": "mean rendered alpha over the pixels with an opacity below 0.02: 0 is ideal",
    "alpha_object": "mean rendered alpha over the pixels with an opacity above 0.98: 1 is ideal",
}
"""Definition of each score of views with an alpha channel. A mean covers only the views with pixels for the score."""
EMPTY, OPAQUE, OBJECT = 0.02, 0.5, 0.98
"""Opacity below which a pixel is empty, above which it shows the object, and above which it shows only the object."""
MASKED = "where a view has a mask, SSIM and LPIPS compare both images with white outside of it"
NO_LPIPS = "not measured: no --lpips-weights were given"
SSIM_WINDOW = 11
"""Side of the window of SSIM [px]."""


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
        plain: dict[str, Any] = asdict(self)
        return {k: v for k, v in plain.items() if k not in ("lpips", "opacity")} | self.opacity | self.lpips


def to_8_bit(image: np.ndarray) -> np.ndarray:
    """Round an image in [0, 1] to the values that an 8-bit file can hold, float32."""
    levels: np.ndarray = np.round(np.clip(image, 0, 1) * 255).astype(np.float32)
    return levels / 255


def over_white(image: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Return the image [H, W, 3] with white where ``region`` [H, W] is False."""
    return np.where(region[..., None], image, np.float32(1))


def _opacity_scores(
    image: np.ndarray, target: np.ndarray, alpha: np.ndarray, true: np.ndarray, mask: np.ndarray | None
) -> dict[str, float]:
    """Return the scores of `ALPHA_VARIANTS` for images of 8 bits [H, W, 3], a rendered and a true alpha and a mask [H, W]."""
    counted = np.ones(true.shape, bool) if mask is None else mask
    regions = {"psnr_whole": counted, "psnr_foreground": counted & (true > OPAQUE)}
    scores = {k: psnr(image, target, r) if r.any() else float("nan") for k, r in regions.items()}
    for name, r in (("alpha_empty", counted & (true < EMPTY)), ("alpha_object", counted & (true > OBJECT))):
        scores[name] = float(alpha[r].mean(dtype=np.float64)) if r.any() else float("nan")
    return scores


def score(view: View, image: np.ndarray, lpips: Lpips | None = None, alpha: np.ndarray | None = None) -> ViewMetrics:
    """Compare a rendered image [H, W, 3], and its alpha [H, W] if the view has an alpha channel, with the image of its view.

    Masks are used as in DTU's protocol (Niemeyer et al. 2022 and later papers): PSNR over the mask's pixels alone, SSIM and
    LPIPS on both images with white outside the mask.
    """
    from skimage.metrics import structural_similarity

    region, name = scored_region(view)
    image, target = to_8_bit(image), to_8_bit(view.image)
    decibels = psnr(image, target, region)
    opacity = {} if alpha is None or view.alpha is None else _opacity_scores(image, target, alpha, view.alpha, view.mask)
    if region is not None and name != "foreground":
        image, target = over_white(image, region), over_white(target, region)
    similarity = float(ssim(torch.from_numpy(image), torch.from_numpy(target)).mean())
    if min(image.shape[:2]) >= SSIM_WINDOW:
        cropped = structural_similarity(  # type: ignore[no-untyped-call]
            image, target, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=-1
        )
    else:
        cropped = float("nan")  # the window does not fit
    distances = {} if lpips is None else lpips.measure(image, target)
    return ViewMetrics(view.name, decibels, similarity, float(cropped), name, distances, opacity)


def options_for(
    rule: str, background: tuple[float, float, float], gaussians: Gaussians, antialiased: bool = False
) -> RasterizeOptions:
    """Return the rasterizer's options for a model: its cut-offs, its background, and whether it is antialiased."""
    return RasterizeOptions(rule=rule, background=gaussians.means.new_tensor(background), antialiased=antialiased)


@torch.no_grad()
def render_view(gaussians: Gaussians, view: View, options: RasterizeOptions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render a view; returns colours [H, W, 3], depth [u] [H, W] and alpha [H, W] as numpy arrays."""
    r = rasterize(gaussians, view.camera, options)
    return r.rgb.cpu().numpy(), r.depth.cpu().numpy(), r.alpha.cpu().numpy()


def evaluate(
    gaussians: Gaussians, views: Sequence[View], options: RasterizeOptions | None = None, lpips: Lpips | None = None
) -> list[ViewMetrics]:
    """Render views and score each against its image, as a fit does.

    Args:
        gaussians: N Gaussians in the units of the views' cameras: scene units for the views of a `Scene`.
        views: Views with images; use held-out views for a meaningful score.
        options: Options of the rasterizer, such as `FitResult.options`; None for the defaults.
        lpips: Network for LPIPS (`load_lpips`); None to skip LPIPS.

    Returns:
        The scores of each view, in order; `summarize` gives their means.

    Raises:
        DataError: A field of a view is invalid; the message names the view, the field and the fix.
    """
    views = checked_views(views)
    options = RasterizeOptions() if options is None else options
    rendered = ((v, render_view(gaussians, v, options)) for v in views)
    return [score(v, image, lpips, alpha) for v, (image, _, alpha) in rendered]


def baselines(train: list[View], test: list[View]) -> dict[str, float]:
    """Return the mean PSNR [dB] over the test views of two predictions without 3D, which any useful fit beats.

    ``mean_photo``: the mean of the training images; ``nearest_photo``: the image of the nearest training camera. Training
    images whose size differs from the test view's are left out, and so is a baseline without any score.
    """
    scores: dict[str, list[float]] = {"mean_photo": [], "nearest_photo": []}
    for view in test:
        same = [v for v in train if v.image.shape == view.image.shape]
        if not same:
            continue
        region, _ = scored_region(view)
        nearest = min(same, key=lambda v: float(np.linalg.norm(v.camera.center - view.camera.center)))
        scores["mean_photo"].append(psnr(to_8_bit(np.mean([v.image for v in same], axis=0)), view.image, region))
        scores["nearest_photo"].append(psnr(nearest.image, view.image, region))
    return {name: float(np.mean(values)) for name, values in scores.items() if values}


def summarize(metrics: list[ViewMetrics]) -> dict[str, float]:
    """Return the means over views of every numeric score; empty without views.

    Means of opacity scores are over the views that have such a score.
    """
    if not metrics:
        return {}
    rows = [m.row() for m in metrics]
    means = {key: float(np.mean([r[key] for r in rows])) for key in ("psnr", "ssim", "ssim_skimage", *metrics[0].lpips)}
    for key in ALPHA_VARIANTS:
        known = [r[key] for r in rows if not np.isnan(r.get(key, np.nan))]
        means |= {key: float(np.mean(known))} if known else {}
    return means


def variants(lpips: Lpips | None) -> dict[str, str]:
    """Return the definition of each score but those of `ALPHA_VARIANTS`, and how masks are used."""
    return VARIANTS | {"masks": MASKED} | ({"lpips": NO_LPIPS} if lpips is None else lpips.variants())
