"""What a clean-up removes from a finished model, reason by reason, and how it is shown before."""

import math

import numpy as np
import torch

from warpgs.errors import UsageError
from warpgs.geometry import logit
from warpgs.pipeline.model.edit import LARGE, NEEDLES, SEEN, UNSEEN, any_of, floaters, size_of
from warpgs.scene import Gaussians, Tensors, base_coefficients

REASONS = {
    "opacity": ("opacity below 4/255", "blue", (0, 114, 255)),
    "unseen": (UNSEEN, "magenta", (230, 0, 190)),
    "size": (LARGE, "orange", (255, 140, 0)),
    "needles": (NEEDLES, "yellow", (255, 230, 0)),
    "distance": ("far outside of the scene", "red", (230, 30, 0)),
    "density": ("far from their neighbours", "green", (0, 190, 90)),
}
"""Description, name of the colour and colour of each reason, in the order in which they are tested."""
NEIGHBORS = 16
"""Neighbours that count for density; a group of fewer Gaussians can be an outlier."""
HELD, FAR = 0.98, 3.0
"""A Gaussian is far outside if it is more than `FAR` times as far from the middle as this fraction of them is."""
FAR_OUT, LEAST_RANGE = 3.0, 0.25
"""A density is an outlier if its logarithm is above the third quartile by this many interquartile ranges: Tukey's "far out"
(Exploratory Data Analysis, 1977), one in 900,000 of normally distributed values. The range counts as no less than the other
number, for Gaussians on a grid: then twice the spacing is an outlier."""
EXTENT = 3.0
"""Extent of a Gaussian in standard deviations. Without this limit, the removal of sparse ones cost 0.1 to 0.4 dB on held-out
views of quick fits, because large Gaussians have distant neighbours; with it, nothing."""
SHOWN_OPACITY, SHOWN_SIZE = 0.6, 0.003
"""Least opacity in which a Gaussian that would go is shown, and its largest axis as a fraction of the scene: unseen ones would
show nothing, and one larger than the scene would cover it."""


@torch.no_grad()
def reasons_of(gaussians: Gaussians, maxima: torch.Tensor | None) -> dict[str, torch.Tensor]:
    """Return what a clean-up may remove, bool [N] by name of `REASONS`; several reasons may apply to one Gaussian.

    ``maxima`` [N] are the largest blending weights over all training views (`coverage`), None without views. Distance is that
    from the median of all means; density is the mean distance to the nearest neighbours, relative to theirs (local outlier
    factor, Breunig et al. 2000), which does not take the sparse background of a scene for outliers; nor are Gaussians that
    reach their neighbours. Both are tested among the Gaussians without another reason.
    """
    from scipy.spatial import cKDTree

    by_words = floaters(gaussians, maxima)
    found = {"opacity": gaussians.logit_opacities.sigmoid() < SEEN}  # no weight is above the opacity
    found |= {name: by_words[words] for name, (words, *_) in REASONS.items() if words in by_words}
    rows = (~any_of(found.values(), found["opacity"])).nonzero()[:, 0]
    if len(rows) > NEIGHBORS:
        means = gaussians.means[rows].double().cpu().numpy()
        away = np.linalg.norm(means - np.median(means, axis=0), axis=1)
        distances, neighbors = cKDTree(means).query(means, NEIGHBORS + 1, workers=-1)
        spacing = np.maximum(distances[:, 1:].mean(1), 1e-9 * away.max() + 1e-30)
        factors = np.log(spacing / spacing[neighbors[:, 1:]].mean(1))
        low, high = np.quantile(factors, [0.25, 0.75])
        sparse = factors > high + FAR_OUT * max(high - low, LEAST_RANGE)
        alone = spacing > EXTENT * gaussians.log_scales[rows].double().exp().amax(1).cpu().numpy()
        for name, outliers in ("distance", away > FAR * np.quantile(away, HELD)), ("density", sparse & alone):
            found[name] = torch.zeros_like(found["opacity"])
            found[name][rows] = torch.from_numpy(outliers).to(rows.device)
    return found


def chosen_reasons(text: str) -> tuple[str, ...]:
    """Return the reasons of a text: names separated by commas, or all."""
    words = [word.strip() for word in text.split(",")]
    if unknown := [word for word in words if word not in (*REASONS, "all")]:
        raise UsageError(f"--clean {unknown[0][:60]}: give show, all, or some of {', '.join(REASONS)}, separated by commas")
    return tuple(REASONS) if "all" in words else tuple(words)


def counted_lines(found: Tensors) -> list[str]:
    """Return a line for each reason that applies to some Gaussians [N], with their number and their colour."""
    return [f"{n:,} {REASONS[r][0]} ({r}, {REASONS[r][1]})" for r, where in found.items() if (n := int(where.sum()))]


@torch.no_grad()
def in_colors(gaussians: Gaussians, found: Tensors) -> Gaussians:
    """Return Gaussians with those of each mask [N] in the colour of its reason, no fainter and no larger than can be seen."""
    means, quats, log_scales, logits, sh = (t.clone() for t in gaussians.tensors().values())
    for reason, where in found.items():
        sh[where], sh[where, 0] = 0.0, base_coefficients(means.new_tensor(REASONS[reason][2]) / 255)
        logits[where] = logits[where].clamp(min=logit(SHOWN_OPACITY))
        log_scales[where] = log_scales[where].clamp(max=math.log(SHOWN_SIZE * size_of(gaussians)))
    return Gaussians(means, quats, log_scales, logits, sh)
