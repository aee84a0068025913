"""Semantics of an image as three maps: confidence of the labels, their boundaries, and foreground.

In the paper's section on Multi-Modal Importance Assessment: S_semantic = F_seg(I) (omega_boundary + omega_foreground).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from warpgs.errors import DataError
from warpgs.priors.opencv import single_threaded_opencv, without_ipp
from warpgs.priors.preprocess import IMAGENET, Preprocessing, resize
from warpgs.priors.session import Network
from warpgs.runtime.terminal import counted

CLASSES = 21
"""Number of PASCAL VOC classes: background first, then 20 kinds of things."""
DEFAULTS = Preprocessing(512, 32, *IMAGENET, output="classes")
BOUNDARY_WIDTH = 2 / 500
"""Standard deviation of omega_boundary, in image widths: 2 px at 500 px."""
MIN_FOREGROUND = 0.01
"""Smallest mean foreground; below it the network recognises nothing in the image."""
SMOOTHING = 1000.0
"""Strength of the smoothing of saliency within flat regions [px^2]."""
L0_WEIGHT, L0_GROWTH = 0.04, 2.0
"""Weight of a gradient, and growth per round, of L0 smoothing. Xu et al. 2011 use 0.02 and 2 for photographs; twice that weight
drops foliage and gravel and keeps outlines."""
MAX_PIXELS = 50_000
"""Largest number of pixels that `classical_semantics` processes; larger images are reduced first, since smoothing takes 0.6 s
at 504 x 378 px."""
EDGE_LOW, EDGE_HIGH = 100.0, 250.0
"""Canny's thresholds on the smoothed image: sums of absolute Sobel derivatives of 8-bit colours."""


@dataclass(frozen=True)
class SemanticMaps:
    """The semantic maps of `warpgs.scene.Prior`: float32, shape [H, W], in [0, 1]."""

    confidence: np.ndarray
    boundary: np.ndarray
    foreground: np.ndarray


def _softmax(logits: np.ndarray) -> np.ndarray:
    e = np.exp(logits - logits.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


def class_probabilities(network: Network, preprocessing: Preprocessing, image: np.ndarray) -> np.ndarray:
    """Return the probability of each of the 21 classes at every pixel of an image [H, W, 3] in [0, 1].

    An output that already sums to one is treated as probabilities. Any other output is treated as logits, which are resized
    before the softmax.

    Returns:
        Probabilities, float32, shape [H, W, 21].

    Raises:
        DataError: The output is not 1 x 21 x h x w or 1 x h x w x 21.
    """
    output = network.run(preprocessing.prepare(network, image))
    if output.ndim != 4 or output.shape[0] != 1 or CLASSES not in (output.shape[1], output.shape[3]):
        raise DataError(
            f"{network.path}: its output has the shape {output.shape}; scores of the {CLASSES} PASCAL VOC classes, "
            f"1 x {CLASSES} x height x width, are needed"
        )
    scores = output[0].transpose(1, 2, 0) if output.shape[1] == CLASSES else output[0]
    are_probabilities = bool((scores >= 0).all()) and np.allclose(scores.sum(-1), 1, atol=1e-3)
    scores = resize(scores, *image.shape[:2])
    return scores if are_probabilities else _softmax(scores)


def boundary_weight(labels: np.ndarray) -> np.ndarray:
    """Return omega_boundary of a label map [H, W]: exp(-d^2 / 2 s^2), float32, shape [H, W].

    d is the distance [px] to the nearest pixel with a neighbour (of four) of another label, and s = 2 px per 500 px of width.
    The result is 0 everywhere where all labels are the same.
    """
    edge = np.zeros(labels.shape, bool)
    across, down = labels[:, 1:] != labels[:, :-1], labels[1:] != labels[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return _falloff(edge)


def _falloff(edge: np.ndarray) -> np.ndarray:
    """Return exp(-d^2 / 2 s^2) of the distance d to the nearest True pixel, shape [H, W]; 0 without one."""
    import cv2

    if not edge.any():
        return np.zeros(edge.shape, np.float32)
    distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    squares = np.rint(distance.astype(float) ** 2)  # whole numbers, without the rounding errors of their roots
    return np.exp(-0.5 / (BOUNDARY_WIDTH * edge.shape[1]) ** 2 * squares).astype(np.float32)


def network_semantics(network: Network, preprocessing: Preprocessing, image: np.ndarray) -> SemanticMaps:
    """Return the maps of an image [H, W, 3] in [0, 1] by a segmentation network.

    Raises:
        DataError: The output is not 1 x 21 x h x w or 1 x h x w x 21.
    """
    p = class_probabilities(network, preprocessing, image)
    foreground = np.clip(1 - p[..., 0], 0, 1)
    return SemanticMaps(np.clip(p.max(-1), 0, 1), boundary_weight(p.argmax(-1)), foreground)


def _fast_length(length: int) -> int:
    """Return the largest number up to ``length`` with the prime factors 2, 3 and 5 only, for fast Fourier transforms.

    Transforms of other lengths take up to ten times as long. ``length`` is the side of a reduced image, at least 1 [px].
    """
    while length > 1:
        rest = length
        for factor in (2, 3, 5):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            break
        length -= 1
    return length


def classical_semantics(image: np.ndarray) -> SemanticMaps:
    """Return the maps of an image [H, W, 3] in [0, 1] without a network, from its colours.

    L0 smoothing (Xu et al. 2011) flattens texture; Canny's edges in the result are the boundaries. Foreground is
    fine-grained saliency (Montabone and Soto 2010), smoothed within the flat regions. Confidence is the larger of foreground
    and 1 - foreground. Images above `MAX_PIXELS` are reduced, and their maps enlarged.

    Raises:
        DataError: OpenCV cannot compute the saliency.
    """
    import cv2

    height, width = image.shape[:2]
    shrink = (MAX_PIXELS / (height * width)) ** 0.5
    if shrink < 1:
        small = classical_semantics(resize(image, *(_fast_length(max(1, int(shrink * n))) for n in (height, width))))
        parts = (np.clip(resize(part, height, width), 0, 1) for part in (small.confidence, small.boundary, small.foreground))
        return SemanticMaps(*parts)
    pixels = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    flat = np.clip(cv2.ximgproc.l0Smooth(pixels, None, L0_WEIGHT, L0_GROWTH), 0, 255).astype(np.uint8)
    boundary = _falloff(cv2.Canny(flat, EDGE_LOW, EDGE_HIGH) > 0)
    done, saliency = cv2.saliency.StaticSaliencyFineGrained_create().computeSaliency(pixels)
    if not done:
        raise DataError(f"the saliency of an image of {image.shape[1]} x {image.shape[0]} px cannot be computed")
    even = cv2.ximgproc.fastGlobalSmootherFilter(flat, saliency.astype(np.float32), SMOOTHING, 8.0)
    low, high = np.percentile(even, [2, 98])
    foreground = np.clip((even - low) / max(high - low, 1e-6), 0, 1).astype(np.float32)
    return SemanticMaps(np.maximum(foreground, 1 - foreground), boundary, foreground)


def classical_maps(images: Sequence[np.ndarray], tell: Callable[[str], object] = lambda line: None) -> list[SemanticMaps]:
    """Return `classical_semantics` of each image; ``tell`` is called with a line for each.

    Each image is processed by one thread, so results do not depend on the number of threads.
    """
    with single_threaded_opencv(), ThreadPoolExecutor(os.cpu_count() or 1, initializer=without_ipp) as pool:
        made = [pool.submit(classical_semantics, image) for image in images]
        return [m.result() for m in counted(made, tell, "finding salient regions", "views")]


def knows_foreground(maps: SemanticMaps) -> bool:
    """Return whether the maps separate an object from its background.

    They do not if the mean foreground is below 1 % (tabletop scans hold no VOC class). They also do not if there is no boundary
    and the mean foreground is below a half.
    """
    mean = float(maps.foreground.mean())
    return mean >= MIN_FOREGROUND and (bool(maps.boundary.any()) or mean >= 0.5)
