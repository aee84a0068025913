"""Relative inverse depth of an image: from a monocular network, or completed from depths that are consistent between views."""

from __future__ import annotations

import numpy as np

from warpgs.errors import DataError
from warpgs.priors.opencv import single_threaded_opencv
from warpgs.priors.preprocess import HALF, Preprocessing, resize
from warpgs.priors.session import Network

DEFAULTS = Preprocessing(384, 32, *HALF, output="disparity")
"""Input and output of DPT (Ranftl et al. 2021), the paper's network."""
CLIP = (0.5, 99.5)
"""Percentiles to which consistent inverse depths are clipped: one wrong match must not decide the range of the map."""
COLOR_SIGMA = 8.0
"""Colour difference [1/255] at which the smoother's weight between neighbours falls to 1/e."""
REACHES = ((10.0, 1.0), (100.0, 1e-3), (1000.0, 1e-6))
"""Pairs of a length [px], over which consistent depths spread within a surface of uniform colour, and a weight. A long length
matters only where no consistent depth is near."""
MAX_ERROR_RATIO = 1e3
"""Largest ratio of an error to the median error; larger ratios are clipped, so no weight is below a millionth."""
MEAN_WEIGHT = 1e-9
"""Weight of the mean of all consistent depths, for pixels that edges separate from all of them."""


def unit_range(values: np.ndarray) -> np.ndarray:
    """Return values scaled to [0, 1] by their minimum and maximum, float32; 0 everywhere if both are equal."""
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return np.zeros(values.shape, np.float32)
    return ((values.astype(np.float64) - low) / (high - low)).astype(np.float32)


def network_disparity(network: Network, preprocessing: Preprocessing, image: np.ndarray) -> np.ndarray:
    """Return the disparity of an image by a monocular network (DPT, MiDaS, Depth Anything and the like).

    Args:
        network: The opened model; its output is [1, h, w], [1, 1, h, w], [1, h, w, 1] or [h, w].
        preprocessing: Size and colours of the network's input, and whether the output is disparity or depth.
        image: Colours in [0, 1], shape [H, W, 3].

    Returns:
        Relative inverse depth in [0, 1], larger is nearer, float32, shape [H, W].

    Raises:
        DataError: The output is not a map, or holds depths that are not positive.
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
                f"{network.path}: its smallest depth is {output.min():.3g}, but depths must be above 0; "
                "if the network gives inverse depth, use --depth-output disparity"
            )
        output = 1 / output
    return unit_range(resize(output, *image.shape[:2]))


def complete_disparity(image: np.ndarray, depth: np.ndarray, valid: np.ndarray, sensitivity: np.ndarray) -> np.ndarray:
    """Fill the gaps of a depth map in inverse depth, along surfaces of uniform colour and not across colour edges.

    The result is the ratio of smoothed ``w / z`` and smoothed ``w``, by the fast global smoother (Min et al. 2014), a solver
    of weighted least squares that the image guides. The weight w is small where 1 / z changes much when the match shifts by
    one pixel. So badly conditioned depths have less weight than their neighbours.

    Args:
        image: Colours in [0, 1], shape [H, W, 3].
        depth: z-depth [u], shape [H, W].
        valid: True where the depth is consistent, shape [H, W]; at least one pixel.
        sensitivity: |dz/dpx| [u/px], at least 0, shape [H, W]; infinite values get the smallest weight.

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
    ratio = np.minimum(np.where(np.isfinite(error), error, np.inf) / scale, MAX_ERROR_RATIO)
    weight = np.zeros(depth.shape, np.float32)
    weight[valid] = 1 / (1 + ratio**2)
    return unit_range(_spread(image, ((inverse - low) / (high - low)).astype(np.float32), weight))


def _spread(image: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return values [H, W] smoothed by weight: from nearby pixels if these have weight, else from farther ones."""
    import cv2

    guide = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    received = np.full(values.shape, MEAN_WEIGHT)
    total = received * np.average(values, weights=weight)
    with single_threaded_opencv():
        for reach, fraction in REACHES:
            # in one dimension the smoother's response falls as exp(-x / sqrt(lambda))
            smoother = cv2.ximgproc.createFastGlobalSmootherFilter(guide, reach**2, COLOR_SIGMA)
            total += fraction * smoother.filter(weight * values)
            received += fraction * smoother.filter(weight)
    return total / received
