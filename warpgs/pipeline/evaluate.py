"""How good a fit is on photographs it has not seen: PSNR, SSIM in two variants, and what guessing would score."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import torch

from warpgs.kernels.ssim import ssim
from warpgs.pipeline.region import counted_region
from warpgs.rasterizer import RasterizeOptions, rasterize
from warpgs.scene import Gaussians, View


@dataclass(frozen=True)
class ViewMetrics:
    """Figures of one view."""

    name: str
    psnr: float
    """Peak signal-to-noise ratio [dB] after rounding to 8 bits, over the pixels that count."""
    ssim: float
    """Mean structural similarity, 3DGS variant (zero padding, every pixel)."""
    ssim_skimage: float
    """Mean structural similarity, scikit-image variant (Gaussian weights, border cropped)."""
    region: str
    """Which pixels count: all, mask, or foreground (the object on a black background)."""


def to_8_bit(image: np.ndarray) -> np.ndarray:
    """Colours clamped to [0, 1] and rounded to multiples of 1/255, as a saved PNG holds them."""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.float32) / 255


def psnr(image: np.ndarray, target: np.ndarray, region: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio [dB] of two images in [0, 1], over all channels of the pixels in ``region`` [H, W]."""
    difference = image.astype(np.float64) - target
    if region is not None:
        difference = difference[region]
    mse = float((difference**2).mean())
    return float("inf") if mse == 0 else -10 * float(np.log10(mse))


def score(view: View, image: np.ndarray) -> ViewMetrics:
    """Compare a rendered image [H, W, 3] with the photograph of its view."""
    from skimage.metrics import structural_similarity

    region, name = counted_region(view)
    image, target = to_8_bit(image), to_8_bit(view.image)
    similarity = float(ssim(torch.from_numpy(image), torch.from_numpy(target)).mean())
    if min(image.shape[:2]) >= 11:
        cropped = structural_similarity(
            image, target, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=-1
        )
    else:
        cropped = float("nan")  # the window does not fit
    return ViewMetrics(view.name, psnr(image, target, region), similarity, float(cropped), name)


@torch.no_grad()
def render_view(gaussians: Gaussians, view: View, options: RasterizeOptions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours [H, W, 3], depth [u] [H, W] and alpha [H, W] of the Gaussians as the view's camera sees them, numpy."""
    r = rasterize(gaussians, view.camera, options)
    return r.rgb.cpu().numpy(), r.depth.cpu().numpy(), r.alpha.cpu().numpy()


def guesses(train: list[View], test: list[View]) -> dict[str, float]:
    """Mean PSNR [dB] over the test views of two predictions that need no 3D: a fit that is worth anything beats both.

    ``mean_photo``: the mean of the training photos; ``nearest_photo``: the training photo taken from nearest by. Photos of
    another size than the test view's are left out; a guess that no view allows is left out too.
    """
    scores: dict[str, list[float]] = {"mean_photo": [], "nearest_photo": []}
    for view in test:
        same = [v for v in train if v.image.shape == view.image.shape]
        if not same:
            continue
        region, _ = counted_region(view)
        nearest = min(same, key=lambda v: float(np.linalg.norm(v.camera.center - view.camera.center)))
        scores["mean_photo"].append(psnr(to_8_bit(np.mean([v.image for v in same], axis=0)), view.image, region))
        scores["nearest_photo"].append(psnr(nearest.image, view.image, region))
    return {name: float(np.mean(values)) for name, values in scores.items() if values}


def summarize(metrics: list[ViewMetrics]) -> dict[str, float]:
    """Means over views of every figure that is a number; empty where there are no views."""
    if not metrics:
        return {}
    rows = [asdict(m) for m in metrics]
    return {key: float(np.mean([r[key] for r in rows])) for key in ("psnr", "ssim", "ssim_skimage")}
