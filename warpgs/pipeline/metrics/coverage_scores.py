"""Scores of held-out views split by coverage: pixels that no training view saw, that one saw, that more saw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch.nn.functional import interpolate

from warpgs.kernels.ssim import ssim
from warpgs.pipeline.metrics.coverage_map import MIN_ALPHA, TOLERANCE, Coverage, DepthView, coverage_map, depth_views, match
from warpgs.pipeline.metrics.evaluate import over_white, render_view, to_8_bit
from warpgs.pipeline.metrics.psnr import psnr_of
from warpgs.pipeline.metrics.region import scored_region
from warpgs.priors.pinhole_views import pinhole_view
from warpgs.render.options import RasterizeOptions
from warpgs.runtime.terminal import counted
from warpgs.scene import Gaussians, View

CLASSES = {
    "0": "seen by no training view", "1": "seen by one", "2+": "seen by two or more", "background": "transparent, empty",
}  # fmt: skip
"""Classes of pixels, with a description of each for the user. If no view of a scene has an alpha channel, no pixel is
background."""
BINS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, np.inf)
"""Upper bounds of the classes of depth difference, each with its expected error; the last class has no bound."""
PROBED = 6
"""Largest number of training views that are compared with each other, evenly spaced: 6 give 30 ordered pairs."""


@torch.no_grad()
def photo_errors(train: Sequence[View], training: Sequence[DepthView]) -> np.ndarray | None:
    """Measure how much two training photographs of the same point differ in colour, as a function of the difference in depth.

    Each photograph is warped to another view by the model's depth and compared with the photograph there, pixel by pixel. The
    result estimates the error of a pixel from its least depth difference to a training view. The estimate uses the data that
    the model was fitted to. It includes differences between the photographs, such as reflections and exposure.

    Args:
        train: Training views.
        training: Their depths, from `depth_views`.

    Returns:
        Mean squared errors of colours in [0, 1] by class of `BINS`, float64, shape [8]; a class without pixels has the value of
        the class before it. None if no pixel of a photograph can be compared.
    """
    chosen = np.unique(np.linspace(0, len(train) - 1, min(PROBED, len(train))).round().astype(int))
    photos = {i: _photo(train[i], training[i]) for i in chosen}
    total, count = np.zeros(len(BINS)), np.zeros(len(BINS))
    for i in chosen:
        for j in chosen:
            if i == j:
                continue
            m = match(training[i].depth, training[i].camera, training[j])
            inside = torch.isfinite(m.difference)
            error = (_sampled(photos[j], m.u[inside], m.v[inside]) - photos[i][inside]).double().square().mean(1)
            index = _bin(m.difference[inside].cpu().numpy())
            total += np.bincount(index, error.cpu().numpy(), len(BINS))
            count += np.bincount(index, minlength=len(BINS))
    if not count.any():
        return None
    found = np.divide(total, count, out=np.full(len(BINS), np.nan), where=count > 0)
    known = np.flatnonzero(count)
    filled: np.ndarray = found[known[np.maximum(np.searchsorted(known, np.arange(len(BINS)), "right") - 1, 0)]]
    return filled


def _bin(difference: np.ndarray) -> np.ndarray:
    """Return the class of `BINS` of each difference."""
    return np.searchsorted(np.asarray(BINS, np.float32), difference)


def _photo(view: View, at: DepthView) -> torch.Tensor:
    """Return the image of a view at the size of its depth, on the device of the depth, shape [H, W, 3]."""
    image = torch.as_tensor(view.image, dtype=torch.float32, device=at.depth.device)
    if image.shape[:2] == at.depth.shape:
        return image
    return interpolate(image.permute(2, 0, 1)[None], at.depth.shape, mode="area")[0].permute(1, 2, 0)


def _sampled(image: torch.Tensor, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Return the colours [S, 3] of an image [H, W, 3] at columns and rows [S] [px], linear between pixels."""
    height, width = image.shape[:2]
    x, y = (u - 0.5).clamp(0, width - 1), (v - 0.5).clamp(0, height - 1)
    left, top = x.long(), y.long()
    right, bottom = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1)
    a, b = (x - left)[:, None], (y - top)[:, None]
    above = (1 - a) * image[top, left] + a * image[top, right]
    below = (1 - a) * image[bottom, left] + a * image[bottom, right]
    return (1 - b) * above + b * below


def classes_of(coverage: Coverage, transparent: bool) -> dict[str, np.ndarray]:
    """Return the pixels of each class of `CLASSES`, bool [H, W], every pixel in one.

    Args:
        coverage: Coverage of the render.
        transparent: True if the scene has an alpha channel: a pixel without a surface is then background, else unseen.
    """
    counts, empty = coverage.counts.cpu().numpy(), coverage.empty.cpu().numpy() & transparent
    return {"0": (counts == 0) & ~empty, "1": counts == 1, "2+": counts >= 2, "background": empty}


def _sums(view: View, image: np.ndarray, classes: dict[str, np.ndarray], expected: np.ndarray | None) -> dict[str, np.ndarray]:
    """Return for each class the number of scored pixels and the sums over them of squared error, SSIM and expected error."""
    region, kind = scored_region(view)
    image, target = to_8_bit(image), to_8_bit(view.image)
    error = np.square(image.astype(np.float64) - target).mean(-1)
    if region is not None and kind != "foreground":
        image, target = over_white(image, region), over_white(target, region)
    similarity = ssim(torch.from_numpy(image), torch.from_numpy(target)).numpy().astype(np.float64).mean(-1)
    maps = [np.ones_like(error), error, similarity, np.zeros_like(error) if expected is None else expected]
    inside = {c: m if region is None else m & region for c, m in classes.items()}
    return {c: np.array([values[m].sum() for values in maps]) for c, m in inside.items()}


def _row(sums: dict[str, np.ndarray], expected: bool) -> dict[str, dict[str, Any]]:
    """Return the figures of each class that has pixels."""
    pixels, error = (sum(s[i] for s in sums.values()) for i in (0, 1))
    rows = {}
    for name, (count, squares, similarity, foretold) in sums.items():
        if count:
            rows[name] = {
                "pixels": int(count), "share_of_pixels": float(count / pixels),
                "share_of_error": float(squares / error) if error else 0.0,
                "psnr": psnr_of(float(squares / count)), "ssim": float(similarity / count),
                "expected_psnr": psnr_of(float(foretold / count)) if expected else None,
            }  # fmt: skip
    return rows


def score_by_coverage(
    gaussians: Gaussians,
    train: Sequence[View],
    test: Sequence[View],
    options: RasterizeOptions,
    show: Callable[[View, np.ndarray, dict[str, np.ndarray]], object] = lambda *_: None,
    tell: Callable[[str], object] = lambda line: None,
) -> dict[str, Any]:
    """Split the scores of held-out views by the number of training views that see the point at each pixel.

    Views with a lens model are scored as a pinhole would show them.

    Args:
        gaussians: N Gaussians in the units of the views' cameras.
        train: Training views, at least one.
        test: Held-out views, at least one.
        options: Options of the rasterizer.
        show: Called for each held-out view with its render [H, W, 3] and the pixels of each class, bool [H, W].
        tell: Called with a line before each view is rendered.

    Returns:
        ``classes``: over all held-out views together, by class, the number of scored ``pixels``, their ``share_of_pixels`` and
        ``share_of_error`` (squared), and their ``psnr`` [dB], ``ssim`` and ``expected_psnr`` [dB] (by `photo_errors`; None with
        a single training view); ``views``: the same values for each view by ``name``;
        ``depth_differences`` and ``photo_psnr``: the table of `photo_errors`; ``tolerance``; ``summary``, a sentence.

    Raises:
        UsageError: A camera has no pinhole of the same K, such as an orthographic one.
    """
    tell("checking coverage")
    train, test = ([pinhole_view(v) for v in views] for views in (train, test))
    training = depth_views(gaussians, [v.camera for v in train], options, [v.mask for v in train])
    errors = photo_errors(train, training)
    transparent = any(v.alpha is not None for v in (*train, *test))
    views, total = [], {c: np.zeros(4) for c in CLASSES}
    for view in counted(test, tell, "checking coverage", "views"):
        image, depth, alpha = render_view(gaussians, view, options)
        surface = torch.from_numpy(np.where(alpha >= MIN_ALPHA, depth, 0)).to(gaussians.means.device)
        found = coverage_map(surface, view.camera, training)
        classes = classes_of(found, transparent)
        expected = None if errors is None else errors[_bin(found.difference.cpu().numpy())]
        sums = _sums(view, image, classes, expected)
        show(view, image, classes)
        views.append({"name": view.name, "classes": _row(sums, errors is not None)})
        total = {c: total[c] + sums[c] for c in CLASSES}
    pooled = _row(total, errors is not None)
    return {
        "classes": pooled, "views": views, "tolerance": TOLERANCE, "depth_differences": list(BINS[:-1]),
        "photo_psnr": None if errors is None else [psnr_of(e) for e in errors.tolist()], "summary": _summary(pooled),
    }  # fmt: skip


def _summary(rows: dict[str, dict[str, Any]]) -> str:
    """Return a sentence for the user: the fraction of pixels that no training view saw, and the fraction of the error there."""
    unseen = rows.get("0")
    if unseen is None:
        return "every held-out pixel was seen by a training view"
    pixels, error = (f"{100 * unseen[f'share_of_{what}']:.3g} %" for what in ("pixels", "error"))
    return f"{pixels} of the held-out pixels were seen by no training view; they account for {error} of the squared error"
