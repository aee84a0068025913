"""What a photograph shows, as three maps: how sure the labels are, where they change, and what is not background.

Paper, Multi-Modal Importance Assessment: S_semantic = F_seg(I) (omega_boundary + omega_foreground).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from warpgs.errors import DataError
from warpgs.priors.opencv import alone, own_code
from warpgs.priors.preprocess import IMAGENET, Preprocessing, resize
from warpgs.priors.session import Network

CLASSES = 21
"""PASCAL VOC: background first, then 20 kinds of things."""
USUAL = Preprocessing(512, 32, *IMAGENET, output="classes")
BOUNDARY_WIDTH = 2 / 500
"""Standard deviation of omega_boundary, in image widths: 2 px at 500 px."""
LEAST_FOREGROUND = 0.01
"""With a smaller mean the network knows nothing that the photograph shows."""
EVENNESS = 1000.0
"""Strength by which saliency is evened out within flat pieces [px^2]."""
L0_WEIGHT, L0_GROWTH = 0.04, 2.0
"""Weight of a gradient, and growth per round, of L0 smoothing (Xu et al. 2011, who use 0.02 and 2 for photographs: twice that
weight drops foliage and gravel and keeps outlines)."""
EDGE_LOW, EDGE_HIGH = 100.0, 250.0
"""Canny's thresholds on the smoothed picture, sums of absolute Sobel derivatives of 8-bit colours."""


@dataclass(frozen=True)
class SemanticMaps:
    """float32, shape [H, W], in [0, 1]; see `warpgs.scene.Prior`."""

    confidence: np.ndarray
    boundary: np.ndarray
    foreground: np.ndarray


def _softmax(logits: np.ndarray) -> np.ndarray:
    e = np.exp(logits - logits.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


def class_probabilities(network: Network, preprocessing: Preprocessing, image: np.ndarray) -> np.ndarray:
    """Probability of each of the 21 classes at every pixel, float32, shape [H, W, 21], for a photograph [H, W, 3] in [0, 1].

    An output that already sums to one is taken for probabilities; any other for logits, resized before the softmax.

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
    """omega_boundary of a label map [H, W]: exp(-d^2 / 2 s^2), float32.

    d is the distance [px] to the nearest pixel with a neighbour (of four) of another label, s = 2 px per 500 px of width. 0
    everywhere where all labels are the same.
    """
    edge = np.zeros(labels.shape, bool)
    across, down = labels[:, 1:] != labels[:, :-1], labels[1:] != labels[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return _falloff(edge)


def _falloff(edge: np.ndarray) -> np.ndarray:
    """exp(-d^2 / 2 s^2) of the distance to the nearest True pixel [H, W]; 0 where there is none."""
    import cv2

    if not edge.any():
        return np.zeros(edge.shape, np.float32)
    distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    squares = np.rint(distance.astype(float) ** 2)  # whole numbers, whatever the last digits of their roots
    return np.exp(-0.5 / (BOUNDARY_WIDTH * edge.shape[1]) ** 2 * squares).astype(np.float32)


def network_semantics(network: Network, preprocessing: Preprocessing, image: np.ndarray) -> SemanticMaps:
    """The three maps that a segmentation network gives for a photograph [H, W, 3] in [0, 1].

    Raises:
        DataError: As `class_probabilities`.
    """
    p = class_probabilities(network, preprocessing, image)
    foreground = np.clip(1 - p[..., 0], 0, 1)
    return SemanticMaps(np.clip(p.max(-1), 0, 1), boundary_weight(p.argmax(-1)), foreground)


def classical_semantics(image: np.ndarray) -> SemanticMaps:
    """The three maps without a network, from colours [H, W, 3] in [0, 1] alone.

    L0 smoothing (Xu et al. 2011) flattens texture; what Canny finds in the rest are the boundaries. Foreground is
    fine-grained saliency (Montabone and Soto 2010), evened out within the flat pieces. Confidence is that of a decision
    between foreground and background.
    """
    import cv2

    pixels = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    flat = np.clip(cv2.ximgproc.l0Smooth(pixels, None, L0_WEIGHT, L0_GROWTH), 0, 255).astype(np.uint8)
    boundary = _falloff(cv2.Canny(flat, EDGE_LOW, EDGE_HIGH) > 0)
    done, saliency = cv2.saliency.StaticSaliencyFineGrained_create().computeSaliency(pixels)
    if not done:
        raise DataError(f"the saliency of a photograph of {image.shape[1]} x {image.shape[0]} px cannot be computed")
    even = cv2.ximgproc.fastGlobalSmootherFilter(flat, saliency.astype(np.float32), EVENNESS, 8.0)
    low, high = np.percentile(even, [2, 98])
    foreground = np.clip((even - low) / max(high - low, 1e-6), 0, 1).astype(np.float32)
    return SemanticMaps(np.maximum(foreground, 1 - foreground), boundary, foreground)


def classical_maps(images: Sequence[np.ndarray]) -> list[SemanticMaps]:
    """Return `classical_semantics` of each image; a thread works on one, so results do not depend on the number of threads."""
    with alone(), ThreadPoolExecutor(os.cpu_count() or 1, initializer=own_code) as pool:  # OpenCV lets other threads run
        return list(pool.map(classical_semantics, images))


def knows_foreground(maps: SemanticMaps) -> bool:
    """Whether the maps tell an object from its background.

    They do not where the mean foreground stays below 1 % (tabletop scans hold no VOC class), or where every pixel is labelled
    background, however unsurely.
    """
    mean = float(maps.foreground.mean())
    return mean >= LEAST_FOREGROUND and (bool(maps.boundary.any()) or mean >= 0.5)
