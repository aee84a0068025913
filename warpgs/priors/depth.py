"""Relative inverse depth of a photograph: from a monocular network, or completed from what other views confirm."""

from __future__ import annotations

import numpy as np

from warpgs.errors import DataError
from warpgs.priors.opencv import alone
from warpgs.priors.preprocess import HALF, Preprocessing, resize
from warpgs.priors.session import Network

USUAL = Preprocessing(384, 32, *HALF, output="disparity")
"""DPT (Ranftl et al. 2021), the paper's network."""
CLIP = (0.5, 99.5)
"""Percentiles that confirmed inverse depths are clipped to: one wrong match must not decide the range of the map."""
COLOR_SIGMA = 8.0
"""Colour difference [1/255] that the completion takes for an edge, times e."""
REACHES = ((10.0, 1.0), (100.0, 1e-3), (1000.0, 1e-6))
"""Lengths [px] over which confirmed depths spread within an even surface, and how much each counts: the far ones matter only
where nothing near says anything."""
WORST = 1e3
"""Largest ratio of an error to the median error that is told apart: no confirmed depth counts less than a millionth."""
FLOOR = 1e-9
"""Weight of the mean of all confirmed depths, for pixels that edges shut off from every one of them."""


def unit_range(values: np.ndarray) -> np.ndarray:
    """Values scaled to [0, 1] by their minimum and maximum, float32; 0 everywhere where both are equal."""
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return np.zeros(values.shape, np.float32)
    return ((values.astype(np.float64) - low) / (high - low)).astype(np.float32)


def network_disparity(network: Network, preprocessing: Preprocessing, image: np.ndarray) -> np.ndarray:
    """Disparity that a monocular network (DPT, MiDaS, Depth Anything and their like) sees in a photograph.

    Args:
        network: The opened model; its output is [1, h, w], [1, 1, h, w], [1, h, w, 1] or [h, w].
        preprocessing: How to feed it, and whether it gives disparity or depth.
        image: Colours in [0, 1], shape [H, W, 3].

    Returns:
        Relative inverse depth in [0, 1], larger is nearer, float32, shape [H, W].

    Raises:
        DataError: The output is no map, or depth that is not positive.
    """
    output = network.run(preprocessing.prepare(network, image))
    shape = output.shape
    if len(shape) == 4 and shape[1] != 1:
        output = output[..., 0] if shape[3] == 1 else output
    elif len(shape) == 4:
        output = output[:, 0]
    if output.ndim == 3 and shape[0] == 1:
        output = output[0]
    if output.ndim != 2:
        raise DataError(f"{network.path}: its output has the shape {shape}, not that of one depth map; is it a depth network?")
    if preprocessing.output == "depth":
        if not output.min() > 0:
            raise DataError(
                f"{network.path}: its depth goes down to {output.min():.3g}, and a depth must be above 0; "
                "if it gives inverse depth, use --depth-output disparity"
            )
        output = 1 / output
    return unit_range(resize(output, *image.shape[:2]))


def complete_disparity(image: np.ndarray, depth: np.ndarray, valid: np.ndarray, sensitivity: np.ndarray) -> np.ndarray:
    """Fill the gaps of a depth map in inverse depth, along surfaces of even colour and not across colour edges.

    Inverse depths spread by a fast global smoother (Min et al. 2014), a solver of weighted least squares that the photograph
    guides, as the ratio of smoothed ``w / z`` and smoothed ``w``. The weight w falls with the change of 1 / z as the match
    slides by a pixel, so that badly conditioned depths yield to their neighbours.

    Args:
        image: Colours in [0, 1], shape [H, W, 3].
        depth: z-depth [u], shape [H, W].
        valid: True where the depth counts, shape [H, W]; at least one pixel.
        sensitivity: |dz/dpx| [u/px], at least 0, shape [H, W]; infinite counts least.

    Returns:
        Relative inverse depth in [0, 1], larger is nearer, float32, shape [H, W].

    Raises:
        DataError: No pixel is valid.
    """
    valid = valid & (depth > 0) & np.isfinite(depth)
    if not valid.any():
        raise DataError("no pixel has a depth, so there is nothing to complete; use --depth-model, or other views")
    inverse = np.zeros(depth.shape, np.float64)
    inverse[valid] = 1 / depth[valid].astype(np.float64)
    inverse[valid] = np.clip(inverse[valid], *np.percentile(inverse[valid], CLIP))
    low, high = inverse[valid].min(), inverse[valid].max()
    if not high > low:
        return np.zeros(depth.shape, np.float32)
    error = sensitivity[valid] * inverse[valid] ** 2  # |d(1/z)/dpx|
    known = error[np.isfinite(error)]
    scale = max(float(np.median(known)) if len(known) else 0.0, 1e-6 * high)
    ratio = np.minimum(np.where(np.isfinite(error), error, np.inf) / scale, WORST)
    weight = np.zeros(depth.shape, np.float32)
    weight[valid] = 1 / (1 + ratio**2)
    return unit_range(_spread(image, ((inverse - low) / (high - low)).astype(np.float32), weight))


def _spread(image: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Weighted smooth values [H, W]: near where there are any, from ever farther where there are none."""
    import cv2

    guide = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    received = np.full(values.shape, FLOOR)
    total = received * np.average(values, weights=weight)
    with alone():
        for reach, share in REACHES:
            # in one dimension the smoother's response falls as exp(-x / sqrt(lambda))
            smoother = cv2.ximgproc.createFastGlobalSmootherFilter(guide, reach**2, COLOR_SIGMA)
            total += share * smoother.filter(weight * values)
            received += share * smoother.filter(weight)
    return total / received
