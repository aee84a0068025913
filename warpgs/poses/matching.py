"""Matches between photographs: which pairs, and the network that matches them."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from warpgs.errors import DataError, expect, explained
from warpgs.files import replacing
from warpgs.io.image_files import decode_png
from warpgs.onnx import Model, fixed_size
from warpgs.process import Say, counted

# Pairs of photographs that are worth matching, where all pairs would be too many: neighbours in order, and look-alikes.
#
# Photographs look alike if their descriptors, of SIFT or a network, belong to the same visual words. The small
# vocabulary of words is made from the descriptors themselves (tf-idf: Sivic and Zisserman, "Video Google", 2003). Sums
# of integer products are exact in float32 while they are below 2^24, so the order of additions changes no bit.

WORDS = 256
"""Size of the vocabulary."""
SAMPLES = 20_000
"""Number of descriptors from which the vocabulary is made."""
ROUNDS = 8
"""Rounds of k-means."""
NEIGHBOURS = {"photographs": 2, "video": 10}
"""Number of neighbours on each side, in the order of names, that a photograph is matched with, by kind of source."""
LOOKALIKES = {"photographs": 20, "video": 5}
"""Number of most similar photographs that a photograph is matched with, by kind of source."""


def vocabulary(descriptors: list[np.ndarray], seed: int = 0) -> np.ndarray:
    """Return a vocabulary's words, integers as float32 [W, D], by k-means on sampled descriptors, uint8 [K, D] each."""
    generator = np.random.default_rng(seed)
    rows = np.concatenate(descriptors).astype(np.float32)
    rows = rows[np.sort(generator.permutation(len(rows))[:SAMPLES])]
    centers = rows[generator.permutation(len(rows))[:WORDS]]
    for _ in range(ROUNDS):
        nearest = _nearest(rows, centers)
        counts = np.bincount(nearest, minlength=len(centers))
        sums = np.stack([np.bincount(nearest, column, len(centers)) for column in rows.T], 1)
        centers = np.where(counts[:, None] > 0, np.round(sums / np.maximum(counts, 1)[:, None]).astype(np.float32), centers)
    return centers


def _nearest(rows: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Return the number of the nearest centre of each row [K]; of several equally near, the first."""
    return np.argmin((centers * centers).sum(1)[None] - 2 * (rows @ centers.T), axis=1)


def similarity(descriptors: list[np.ndarray], seed: int = 0) -> np.ndarray:
    """Return the cosine of the tf-idf vectors of each pair of photographs, in [0, 1], float64 [N, N]."""
    if not any(len(d) for d in descriptors):
        return np.zeros((len(descriptors), len(descriptors)))
    words = vocabulary(descriptors, seed)
    counts = np.stack([np.bincount(_nearest(d.astype(np.float32), words), minlength=len(words)) for d in descriptors])
    vectors = np.sqrt(counts) * np.log(1 + len(descriptors) / np.maximum((counts > 0).sum(0), 1))
    lengths = np.sqrt((vectors * vectors).sum(1, keepdims=True))
    vectors = vectors / np.where(lengths > 0, lengths, 1)
    return np.stack([(vectors * row).sum(1) for row in vectors])


def choose_pairs(descriptors: list[np.ndarray], kind: str, seed: int = 0) -> list[tuple[int, int]]:
    """Choose pairs of photographs to match, in ascending order, by their descriptors, uint8 [K, D] each."""
    count, alike = len(descriptors), similarity(descriptors, seed)
    np.fill_diagonal(alike, -1)
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + 1 + NEIGHBOURS[kind]))}
    for i, row in enumerate(alike):
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in np.argsort(-row, kind="stable")[: LOOKALIKES[kind]] if row[j] >= 0}
    return sorted(pairs)


# Keypoints and matches of photographs by a network that the user names, for photographs without a pose from SIFT.
#
# The network is one ONNX file. It takes an image with colours in [0, 1]. Its outputs are `keypoints` [K, 2] in pixels
# of its input (centres at +0.5), `scores` [K] (positive for a keypoint), and `descriptors` [K, D] of length 1.

OUTPUTS = ("keypoints", "scores", "descriptors")
SIDE = 1024
"""Longer side at which the network sees a photograph [px]."""
MULTIPLE = 32
"""Divisor of both sides [px], the coarsest stride of such networks."""
MAX_KEYPOINTS = 4096
"""Largest number of keypoints of a photograph; those with the highest scores are kept."""
MAX_CHANNELS = 256
"""Largest number of entries of a descriptor."""
MIN_COSINE = 0.82
"""Smallest cosine between the descriptors of a match, as in XFeat (Potje et al. 2024)."""
TURN_SIDE, TURN_KEYPOINTS = 512, 512
"""Longer side [px] and number of keypoints of a photograph for the search of rotations between photographs."""
TURN_GAIN = 2
"""A photograph counts as rotated if rotating it gives at least this many times the matches: networks are not rotation
invariant."""
WHOLE = 2047
"""Factor of descriptors before they are rounded: sums of their products stay below 2^24, where float32 is exact."""


Features = tuple[np.ndarray, np.ndarray]
"""Keypoints of a photograph: positions [px of the photograph], float32 [K, 2], pixel centres at +0.5, and descriptors times
`WHOLE`, integers as int16 [K, D]."""


class Matcher(Model):
    """An opened network for keypoints; ``size`` are height and width [px] that the graph fixes, None where both are free."""

    def __init__(self, path: str | Path, threads: int = 0):
        super().__init__(path, threads=threads)
        remedy = "give a file of `warpgs priors export --model xfeat`"
        kind, shape = self.inputs[0][1:] if len(self.inputs) == 1 else ("", [])
        if len(shape) != 4 or shape[:2] != [1, 3] or kind != "tensor(float)":
            raise DataError(f"{path}: a matcher takes one float image 1 x 3 x height x width; {remedy}")
        if missing := [n for n in OUTPUTS if n not in self.outputs]:
            raise DataError(f"{path}: is not a matcher, because it lacks the output {' and '.join(missing)}; {remedy}")
        self.size = fixed_size(self.path, shape[2:])

    def features(self, image: np.ndarray, turns: int = 0, side: int = SIDE, most: int = MAX_KEYPOINTS) -> Features:
        """Return the keypoints of an image, uint8 RGB [H, W, 3], after ``turns`` quarter turns to the left."""
        import cv2

        image = np.ascontiguousarray(np.rot90(image, turns))
        height, width = image.shape[:2]
        scale = side / max(height, width) / MULTIPLE
        h, w = self.size or (max(1, round(scale * height)) * MULTIPLE, max(1, round(scale * width)) * MULTIPLE)
        seen = cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA if w <= width else cv2.INTER_CUBIC)
        colors = (seen.astype(np.float32) / 255).transpose(2, 0, 1)[None]
        keypoints, scores, descriptors = self.outputs_of(colors, names=OUTPUTS)
        self._check(keypoints, scores, descriptors, h, w)
        order = np.argsort(-scores, kind="stable")[:most]
        order = order[scores[order] > 0]
        pixels = keypoints[order] * np.array([width / w, height / h])
        for _ in range(turns % 4):
            pixels, height, width = np.stack([height - pixels[:, 1], pixels[:, 0]], 1), width, height
        return pixels.astype(np.float32), np.round(descriptors[order] * WHOLE).astype(np.int16)

    def _check(self, keypoints: np.ndarray, scores: np.ndarray, descriptors: np.ndarray, h: int, w: int) -> None:
        """Raise a DataError if the outputs are not keypoints of an image of ``h`` x ``w`` px."""
        shapes = ", ".join(f"{n} {list(a.shape)}" for n, a in zip(OUTPUTS, (keypoints, scores, descriptors)))
        count = len(scores) if scores.ndim == 1 else -1
        with explained(f"{self.path}: its outputs are unusable", "check its weights, or export it again", ValueError):
            fit = keypoints.shape == (count, 2) and descriptors.ndim == 2 and len(descriptors) == count
            expect(fit, f"it returned {shapes}, not K x 2, K and K x D numbers")
            expect(0 < descriptors.shape[1] <= MAX_CHANNELS, f"descriptors have {descriptors.shape[1]} numbers")
            sound = all(a.dtype.kind == "f" and np.isfinite(a).all() for a in (keypoints, scores, descriptors))
            expect(sound, "they contain NaN or infinity, or are not floating-point")
            there, inside = scores > 0, (keypoints >= 0) & (keypoints <= [w, h])
            placed = inside[there].all() and (np.abs(np.linalg.norm(descriptors[there], axis=1) - 1) < 1e-2).all()
            expect(placed, "keypoints must be in the image, descriptors of length 1")


def mutual_matches(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the pairs of descriptors [K, D] that are each other's most similar, if above `MIN_COSINE`, uint32 [M, 2]."""
    if not (len(a) and len(b)):
        return np.zeros((0, 2), np.uint32)
    products = a.astype(np.float32) @ b.astype(np.float32).T
    best, back = products.argmax(1), products.argmax(0)
    rows = np.arange(len(best))
    good = (back[best] == rows) & (products[rows, best] > MIN_COSINE * WHOLE**2)
    return np.stack([rows[good], best[good]], 1).astype(np.uint32)


def quarter_turns(matcher: Matcher, images: Iterable[np.ndarray], pairs: Sequence[tuple[int, int]]) -> list[int]:
    """Return the quarter turns to the left after which photographs have the same side up; for most photographs 0."""
    # each pair is matched with the second photograph in all turns; those with most matches, a spanning tree, decide
    found = [[matcher.features(image, t, TURN_SIDE, TURN_KEYPOINTS)[1] for t in range(4)] for image in images]
    links = []
    for i, j in pairs:
        counts = [len(mutual_matches(found[i][0], turned)) for turned in found[j]]
        best = int(np.argmax(counts))
        turn = best if counts[best] >= TURN_GAIN * counts[0] else 0
        links.append((-counts[turn], i, j, turn))
    group = {i: {i: 0} for i in range(len(found))}  # photographs joined so far, each with its turns
    for _, i, j, turn in sorted(links):
        if group[i] is not group[j]:
            more = group[i][i] + turn - group[j][j]
            group[i].update({k: (t + more) % 4 for k, t in group[j].items()})
            group.update(dict.fromkeys(group[j], group[i]))
    turns = [group[i][i] for i in range(len(found))]
    first = int(np.argmax(np.bincount(turns, minlength=4))) if turns else 0
    return [(t - first) % 4 for t in turns]


def write_matches(matcher: Matcher, images: Sequence[Path], out: Path, kind: str, exhaustive: int, progress: Say) -> list[int]:
    """Write keypoints and matches of photographs for the worker; return the indices of the photographs that it rotated."""
    found = [matcher.features(decode_png(image)) for image in counted(images, progress, "finding features", "photographs")]
    pairs = [(i, j) for j in range(len(found)) for i in range(j)]
    if len(found) > exhaustive:
        pairs = choose_pairs([(d // 16 + 128).astype(np.uint8) for _, d in found], kind)
    turned = []
    if kind == "photographs":
        progress("finding turned photographs")
        turns = quarter_turns(matcher, map(decode_png, images), pairs)
        turned = [i for i, t in enumerate(turns) if t]
        for i in turned:
            found[i] = matcher.features(decode_png(images[i]), turns[i])
    matches = [mutual_matches(found[i][1], found[j][1]) for i, j in counted(pairs, progress, "matching", "pairs")]
    with replacing(out) as (file, _):
        np.savez(
            file, keypoints=np.concatenate([p for p, _ in found]), per_photograph=np.array([len(p) for p, _ in found]),
            pairs=np.array(pairs).reshape(-1, 2), matches=np.concatenate(matches), counts=np.array([len(m) for m in matches]),
        )  # fmt: skip
    return turned
