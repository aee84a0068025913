"""How good a fit is on photographs it has not seen: PSNR, SSIM in two variants, LPIPS, and what guessing would score."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import numpy as np
import torch

from warpgs.kernels.ssim import ssim
from warpgs.pipeline.metrics.lpips import Lpips
from warpgs.pipeline.metrics.psnr import psnr
from warpgs.pipeline.metrics.region import scored_region
from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.scene import Gaussians, View

VARIANTS = {
    "psnr": "of images rounded to 8 bits, over the scored pixels alone; mean over images",
    "ssim": "as the 3DGS line has it: 11 x 11 Gaussian window, sigma 1.5, zero padding, all pixels and channels",
    "ssim_skimage": "of scikit-image, as NeRF papers have it: the same window, border left out; about 0.005 lower",
}
"""What each figure is, for result files and reports. Every paper's table depends on these words."""
MASKED = "where a view has a mask, SSIM and LPIPS compare both images with white outside of it"
NO_LPIPS = "not measured: no --lpips-weights were given"


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
    """Which pixels count: all, mask, score mask, or foreground (the object on a black background)."""
    lpips: dict[str, float] = field(default_factory=dict)
    """LPIPS by variant (`lpips_vgg_legacy`); empty where no weights were given, NaN where the image is too small."""

    def row(self) -> dict:
        """Every figure by name, flat, as result files have it."""
        plain = asdict(self)
        return {k: v for k, v in plain.items() if k != "lpips"} | plain["lpips"]


def to_8_bit(image: np.ndarray) -> np.ndarray:
    """Colours clamped to [0, 1] and rounded to multiples of 1/255, as a saved PNG holds them."""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.float32) / 255


def over_white(image: np.ndarray, region: np.ndarray) -> np.ndarray:
    """The image [H, W, 3] with white where ``region`` [H, W] is False."""
    return np.where(region[..., None], image, np.float32(1))


def score(view: View, image: np.ndarray, lpips: Lpips | None = None) -> ViewMetrics:
    """Compare a rendered image [H, W, 3] with the photograph of its view.

    With a mask the recipe is that of DTU's protocol (Niemeyer et al. 2022 and all since): PSNR over the mask's pixels alone,
    SSIM and LPIPS on both images with white outside of it.
    """
    from skimage.metrics import structural_similarity

    region, name = scored_region(view)
    image, target = to_8_bit(image), to_8_bit(view.image)
    decibels = psnr(image, target, region)
    if region is not None and name != "foreground":
        image, target = over_white(image, region), over_white(target, region)
    similarity = float(ssim(torch.from_numpy(image), torch.from_numpy(target)).mean())
    if min(image.shape[:2]) >= 11:
        cropped = structural_similarity(
            image, target, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=-1
        )
    else:
        cropped = float("nan")  # the window does not fit
    distances = {} if lpips is None else lpips.measure(image, target)
    return ViewMetrics(view.name, decibels, similarity, float(cropped), name, distances)


@torch.no_grad()
def render_view(gaussians: Gaussians, view: View, options: RasterizeOptions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours [H, W, 3], depth [u] [H, W] and alpha [H, W] of the Gaussians as the view's camera sees them, numpy."""
    r = rasterize(gaussians, view.camera, options)
    return r.rgb.cpu().numpy(), r.depth.cpu().numpy(), r.alpha.cpu().numpy()


def baselines(train: list[View], test: list[View]) -> dict[str, float]:
    """Mean PSNR [dB] over the test views of two predictions that need no 3D: a fit that is worth anything beats both.

    ``mean_photo``: the mean of the training photos; ``nearest_photo``: the training photo taken from nearest by. Photos of
    another size than the test view's are left out; a guess that no view allows is left out too.
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
    """Means over views of every figure that is a number; empty where there are no views."""
    if not metrics:
        return {}
    rows = [m.row() for m in metrics]
    return {key: float(np.mean([r[key] for r in rows])) for key in ("psnr", "ssim", "ssim_skimage", *metrics[0].lpips)}


def variants(lpips: Lpips | None) -> dict[str, str]:
    """What each figure is, LPIPS included; where there are no weights it says that it was not measured."""
    return VARIANTS | {"masks": MASKED} | ({"lpips": NO_LPIPS} if lpips is None else lpips.variants())
