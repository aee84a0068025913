"""Pairs of photographs that are worth matching, where all pairs would be too many: neighbours in order, and look-alikes.

Photographs look alike if their descriptors, of SIFT or a network, belong to the same visual words. The small vocabulary of
words is made from the descriptors themselves (tf-idf: Sivic and Zisserman, "Video Google", 2003). Sums of integer products
are exact in float32 while they are below 2^24, so the order of additions changes no bit.
"""

from __future__ import annotations

import numpy as np

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
    """Return the words of a vocabulary, integers as float32 [W, D], by k-means on sampled descriptors.

    Args:
        descriptors: Descriptors of each photograph, by SIFT or a network, uint8 [K, D].
        seed: Seed of the sample.
    """
    generator = np.random.default_rng(seed)
    rows = np.concatenate(descriptors).astype(np.float32)
    rows = rows[np.sort(generator.permutation(len(rows))[:SAMPLES])]
    centers = rows[generator.permutation(len(rows))[:WORDS]]
    for _ in range(ROUNDS):
        nearest = _nearest(rows, centers)
        counts = np.bincount(nearest, minlength=len(centers))
        sums = np.stack([np.bincount(nearest, column, len(centers)) for column in rows.T], 1)
        means = np.round(sums / np.maximum(counts, 1)[:, None]).astype(np.float32)
        centers = np.where(counts[:, None] > 0, means, centers)
    return centers


def _nearest(rows: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Return the number of the nearest centre of each row [K]; of several equally near, the first."""
    return np.argmin((centers * centers).sum(1)[None] - 2 * (rows @ centers.T), axis=1)


def similarity(descriptors: list[np.ndarray], seed: int = 0) -> np.ndarray:
    """Return the similarity of each pair of photographs: the cosine of their tf-idf vectors, in [0, 1], float64 [N, N].

    Args:
        descriptors: Descriptors of each photograph, by SIFT or a network, uint8 [K, D].
        seed: Seed of the vocabulary.
    """
    if not any(len(d) for d in descriptors):
        return np.zeros((len(descriptors), len(descriptors)))
    words = vocabulary(descriptors, seed)
    counts = np.stack([np.bincount(_nearest(d.astype(np.float32), words), minlength=len(words)) for d in descriptors])
    photographs = np.maximum((counts > 0).sum(0), 1)
    vectors = np.sqrt(counts) * np.log(1 + len(descriptors) / photographs)
    lengths = np.sqrt((vectors * vectors).sum(1, keepdims=True))
    vectors = vectors / np.where(lengths > 0, lengths, 1)
    return np.stack([(vectors * row).sum(1) for row in vectors])


def choose_pairs(descriptors: list[np.ndarray], kind: str, seed: int = 0) -> list[tuple[int, int]]:
    """Choose the pairs of photographs to match, each as two indices, the smaller one first, in ascending order.

    Args:
        descriptors: Descriptors of each photograph, by SIFT or a network, in the order of names, uint8 [K, D].
        kind: photographs or video, which determines `NEIGHBOURS` and `LOOKALIKES`.
        seed: Seed of the vocabulary.
    """
    count, alike = len(descriptors), similarity(descriptors, seed)
    np.fill_diagonal(alike, -1)
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + 1 + NEIGHBOURS[kind]))}
    for i, row in enumerate(alike):
        best = np.argsort(-row, kind="stable")[: LOOKALIKES[kind]]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in best if row[j] >= 0}
    return sorted(pairs)
