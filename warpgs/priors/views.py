"""What networks say of each view: depth and saliency."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Annotated

import numpy as np

from warpgs.errors import DataError, UsageError, listed
from warpgs.onnx import PROVIDERS
from warpgs.priors import networks
from warpgs.process import Detail, Say, counted, silent
from warpgs.scene import Prior, View, ViewDepth
from warpgs.schema import Checked

# Semantics of an image as three maps: confidence of the labels, their boundaries, and foreground.
#
# In the paper's section on Multi-Modal Importance Assessment: S_semantic = F_seg(I) (omega_boundary +
# omega_foreground).

CLASSES = 21
"""Number of PASCAL VOC classes: background first, then 20 kinds of things."""
DEFAULTS = networks.Preprocessing(512, 32, *networks.IMAGENET, output="classes")
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


Maps = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Confidence, boundary and foreground of `warpgs.scene.Prior`: float32, shape [H, W], in [0, 1]."""


def class_probabilities(network: networks.Network, preprocessing: networks.Preprocessing, image: np.ndarray) -> np.ndarray:
    """Return the probability of each of the 21 classes at each pixel of an image [H, W, 3], float32 [H, W, 21]."""
    output = network.run(preprocessing.prepare(network, image))
    if output.ndim != 4 or output.shape[0] != 1 or CLASSES not in (output.shape[1], output.shape[3]):
        raise DataError(f"{network.path}: its output, {output.shape}, is not [1, {CLASSES}, height, width], scores of VOC")
    scores = output[0].transpose(1, 2, 0) if output.shape[1] == CLASSES else output[0]
    are_probabilities = bool((scores >= 0).all()) and np.allclose(scores.sum(-1), 1, atol=1e-3)
    scores = networks.resize(scores, *image.shape[:2])
    if are_probabilities:
        return scores
    e = np.exp(scores - scores.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


def boundary_weight(labels: np.ndarray) -> np.ndarray:
    """Return omega_boundary of a label map [H, W]: exp(-d^2 / 2 s^2) of the distance d [px] to another label, float32."""
    edge = np.zeros(labels.shape, bool)
    for differs, sides in ((labels[:, 1:] != labels[:, :-1], (edge[:, 1:], edge[:, :-1])),
                           (labels[1:] != labels[:-1], (edge[1:], edge[:-1]))):  # fmt: skip
        for side in sides:
            side |= differs
    return _falloff(edge)


def _falloff(edge: np.ndarray) -> np.ndarray:
    """Return exp(-d^2 / 2 s^2) of the distance d to the nearest True pixel, shape [H, W]; 0 without one."""
    import cv2

    if not edge.any():
        return np.zeros(edge.shape, np.float32)
    distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # squares are whole numbers, without the rounding errors of their roots
    return np.exp(-0.5 / (BOUNDARY_WIDTH * edge.shape[1]) ** 2 * np.rint(distance.astype(float) ** 2)).astype(np.float32)


def network_semantics(network: networks.Network, preprocessing: networks.Preprocessing, image: np.ndarray) -> Maps:
    """Return the maps of an image [H, W, 3] in [0, 1] by a segmentation network."""
    p = class_probabilities(network, preprocessing, image)
    return np.clip(p.max(-1), 0, 1), boundary_weight(p.argmax(-1)), np.clip(1 - p[..., 0], 0, 1)


def _fast_length(length: int) -> int:
    """Return the largest number up to ``length`` [px] with the prime factors 2, 3 and 5 only, for fast Fourier transforms."""
    while 30**16 % length:
        length -= 1
    return length


def classical_semantics(image: np.ndarray) -> Maps:
    """Return saliency as foreground and edges as boundaries of an image [H, W, 3] in [0, 1], without a network."""
    import cv2

    height, width = image.shape[:2]
    shrink = (MAX_PIXELS / (height * width)) ** 0.5
    if shrink < 1:
        small = classical_semantics(networks.resize(image, *(_fast_length(max(1, int(shrink * n))) for n in (height, width))))
        confidence, boundary, foreground = (np.clip(networks.resize(part, height, width), 0, 1) for part in small)
        return confidence, boundary, foreground
    pixels = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    flat = np.clip(cv2.ximgproc.l0Smooth(pixels, None, L0_WEIGHT, L0_GROWTH), 0, 255).astype(np.uint8)
    boundary = _falloff(cv2.Canny(flat, EDGE_LOW, EDGE_HIGH) > 0)
    saliency = cv2.saliency.StaticSaliencyFineGrained_create().computeSaliency(pixels)[1]
    even = cv2.ximgproc.fastGlobalSmootherFilter(flat, saliency.astype(np.float32), SMOOTHING, 8.0)
    low, high = np.percentile(even, [2, 98])
    foreground = np.clip((even - low) / max(high - low, 1e-6), 0, 1).astype(np.float32)
    return np.maximum(foreground, 1 - foreground), boundary, foreground


def classical_maps(images: Sequence[np.ndarray], tell: Say = silent) -> list[Maps]:
    """Return `classical_semantics` of each image, each by one thread, so that results do not depend on their number."""
    with networks.single_threaded_opencv(), ThreadPoolExecutor(os.cpu_count() or 1, initializer=networks.without_ipp) as pool:
        made = [pool.submit(classical_semantics, image) for image in images]
        return [m.result() for m in counted(made, tell, "finding salient regions", "views")]


def knows_foreground(boundary: np.ndarray, foreground: np.ndarray) -> bool:
    """Return whether maps separate an object from its background."""
    # a network finds nothing in tabletop scans, which hold no VOC class
    mean = float(foreground.mean())
    return mean >= MIN_FOREGROUND and (bool(boundary.any()) or mean >= 0.5)


MIN_CONSISTENT = 50
"""Smallest number of pixels with a geometrically consistent depth; below it a view's depth counts as unknown."""
MAX_OBJECT_FRACTION = 0.9
"""Largest fraction of the image that an object's region covers; a larger region only shows that a mask cuts something off."""


@dataclass(frozen=True)
class PriorConfig(Checked):
    """Networks for priors; without networks, classical methods are used. FILE.onnx.json describes the input of FILE.onnx."""

    depth_model: str | None = None
    """ONNX file of a monocular depth network (DPT, MiDaS, Depth Anything); without one, depth comes from the other views."""
    depth_guides: bool = False
    """Use the depth network's map in views without a map of --depths, to place Gaussians and guide the fit."""
    segmentation_model: str | None = None
    """ONNX file of a segmentation network for the 21 PASCAL VOC classes; without one, saliency and edges are used."""
    onnx_provider: Annotated[str, tuple(PROVIDERS)] = "cpu"
    """Device of the networks: cpu or cuda."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.depth_guides and self.depth_model is None:
            raise UsageError("--depth-guides requires --depth-model; for maps from files, give --depths instead")


Source = Callable[[int], tuple[networks.Arrays, str]]
"""Function from the index of a view to its maps, float32 [H, W] each, and a phrase on their source."""


def _by_network(
    kind: str, views: Sequence[View], config: PriorConfig, threads: int, cache: networks.MapCache, notes: list[str]
) -> Source:
    """Return the source of the disparity, or of the semantic maps, of a network."""
    is_depth = kind == "depth"
    network = networks.Network(getattr(config, f"{kind}_model"), config.onnx_provider, threads)
    how, messages = networks.describe(network, networks.DEFAULTS if is_depth else DEFAULTS, kind)
    if (how.output == "classes") is is_depth:
        raise DataError(f"{network.path}: its output is {how.output}, which is not for --{kind}-model; check the flags")
    notes += [f"{'depth' if is_depth else 'semantics'}: {network.title} gives {how.output}", *messages]
    decided_by = {"model": network.sha256, "provider": config.onnx_provider, **asdict(how)}
    names = ("disparity",) if is_depth else ("confidence", "boundary", "foreground")

    def made(image: np.ndarray) -> networks.Arrays:
        return (networks.network_disparity(network, how, image),) if is_depth else network_semantics(network, how, image)

    def maps(i: int) -> tuple[networks.Arrays, str]:
        found = cache.maps(views[i].image, names, decided_by, lambda: made(views[i].image))
        return found, f"{how.output} by {network.title}"

    return maps


def _by_views(views: Sequence[View], depths: Sequence[ViewDepth] | None, notes: list[str]) -> Source:
    """Return the source of disparity from the depth that other views confirm."""
    if depths is None:
        notes.append("depth: neither a network nor other views gave depth, so the importance has no geometry score")
        return lambda i: ((np.zeros(views[i].image.shape[:2], np.float32),), "none")
    fractions = [float(d.valid.mean()) for d in depths]
    notes.append(Detail(f"depth: from the other views, at {min(fractions):.1%} to {max(fractions):.1%} of the pixels"))
    if poor := [v.name for v, d in zip(views, depths) if d.valid.sum() < MIN_CONSISTENT]:
        notes.append(f"no consistent depth in {', '.join(poor)}, so there is no geometry score there; --depth-model adds depth")

    def disparity(i: int) -> tuple[networks.Arrays, str]:
        view, d = views[i], depths[i]
        if d.valid.sum() < MIN_CONSISTENT:
            return (np.zeros(d.depth.shape, np.float32),), "none"
        completed = networks.complete_disparity(view.image, d.depth, d.valid, d.sensitivity)
        return (completed,), f"depth consistent with other views at {fractions[i]:.1%} of the pixels, completed"

    return disparity


def _fall_back(found: list, views: Sequence[View], regions: Sequence[np.ndarray | None], classical: bool, notes: list[str]):
    """Return maps and sources, an unknown foreground replaced by the region of the view, or by zeros without a region."""
    replaced, empty, result = [], [], []
    for ((confidence, boundary, foreground), source), view, region in zip(found, views, regions):
        known = knows_foreground(boundary, foreground)
        # a region that covers nearly all only shows that a mask cuts off a frame or a passer-by
        if region is not None and 0 < float(region.mean()) <= MAX_OBJECT_FRACTION and (classical or not known):
            replaced.append(view.name)
            foreground, source = region.astype(np.float32), f"{source}; foreground from the view's mask or black background"
            if classical:  # saliency is an estimate, a region is known
                confidence = np.ones_like(foreground)
            else:
                boundary = boundary_weight(region)
        elif not known:
            empty.append(view.name)
            boundary = foreground = np.zeros_like(foreground)
            source = "none: almost no foreground and no object mask"
        result.append((confidence, boundary, foreground, source))
    reason = "a mask is more reliable than saliency" if classical else "the network finds hardly any foreground"
    if replaced:
        words = f"semantics: {reason}, so the object's mask or black background gave the foreground of {listed(replaced, 5)}"
        notes.append(Detail(words) if classical else words)
    if empty:
        notes.append(f"semantics: no score for {listed(empty, 5)}, which have hardly any foreground and no object mask")
    return result


def view_priors(
    views: Sequence[View], config: PriorConfig, *, depths: Callable[[], Sequence[ViewDepth] | None] = lambda: None,
    regions: Sequence[np.ndarray | None] | None = None, threads: int = 0, tell: Say = silent,
) -> tuple[list[Prior], list[str]]:  # fmt: skip
    """Return a prior for the pixels of each view before anything is fitted, and notes on choices and assumptions."""
    notes: list[str] = []
    classical = config.segmentation_model is None
    cache = networks.MapCache(networks.cache_folder())
    # both are opened before either runs: a wrong file is found at once
    opened = None if config.depth_model is None else _by_network("depth", views, config, threads, cache, notes)
    if classical:
        notes.append(Detail("semantics: saliency as foreground, edges as boundaries; --segmentation-model adds a network"))
        found = [(maps, "saliency and edges") for maps in classical_maps([v.image for v in views], tell)]
    else:
        semantics = _by_network("segmentation", views, config, threads, cache, notes)
        found = [semantics(i) for i in counted(range(len(views)), tell, "finding salient regions", "views")]
    maps = _fall_back(found, views, regions or [None] * len(views), classical, notes)
    disparity = opened or _by_views(views, depths(), notes)
    priors = []
    for i in counted(range(len(views)), tell, "finding disparity", "views"):
        (confidence, boundary, foreground, source), ((d,), where) = maps[i], disparity(i)
        priors.append(Prior(d, confidence, boundary, foreground, where, source))
    return priors, notes + cache.notes
