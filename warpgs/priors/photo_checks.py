"""Faults of photographs that explain a bad model: blur, and light or colours that differ from photograph to photograph.

Two photographs are compared at points that both show: SIFT matches that agree with the poses. So the checks see only
differences in blur and colour, not in content (docs/scenes.md, "Photograph checks").
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch

from warpgs.errors import listed
from warpgs.priors.flow import Features, agreeing_matches, nearest_views, sift_features
from warpgs.priors.networks import single_threaded_opencv, without_ipp
from warpgs.process import Task
from warpgs.scene import View

MIN_SHARPNESS = 0.87
"""Sharpness below which a photograph is reported. Untouched photographs of five scenes have 0.88 and more; photographs blurred
by a disk of 3 px have 0.5 to 0.85 (docs/decisions/019-thresholds.md)."""
MAX_BRIGHTNESS = 1.2
"""Factor of brightness, up or down, beyond which a photograph is reported; it stays below 1.1 at constant exposure."""
MAX_TINT = 1.1
"""The white balance is reported if a channel's factor differs from the factor of brightness by more than this ratio, up or
down."""
NEIGHBORS = 4
"""Each photograph is compared with this many nearest ones, and with all that have it among their nearest ones."""
MIN_MATCHES = 10
"""Smallest number of matches for a comparison of two photographs."""
MIN_AGREEMENT, MIN_TRIED = 0.3, 50
"""Fraction of the matches that agree with the poses below which cameras are doubted, and fewest matches that tell. Right
cameras of twelve captures have 0.41 and more; inverse poses, other axes and a focal length 14 times too short at most 0.26."""
MAX_FEATURES = 1000
"""Largest number of features of a photograph, which bounds the time of a comparison."""
MAX_PIXELS = 100_000
"""Number of pixels to which a photograph is reduced for the search of features; sharpness is measured at its full size."""
FINE, COARSE = 1.0, 2.0
"""Standard deviations of the Gaussian filters that separate fine from coarse detail [px]."""
PATCH = 15
"""Side of the square around a match in which detail and colour are measured [px]."""
NOISE = 0.1 / 255**2
"""Mean square that is added to both bands of detail: differences below one level of an 8-bit image are noise."""
DARKEST, BRIGHTEST = 0.04, 0.94
"""Colours in [0, 1] between which brightness is compared: outside, a photograph is black or clipped."""
REMEDY = "fix it in the camera, or try --exposure"
"""Remedy for photographs with different colours."""
MAX_NAMED = 6
"""Number of photographs that a note names."""


@dataclass(frozen=True)
class PhotoCheck:
    """Comparison of one photograph with others at matched points; figures are None if there are too few matches."""

    name: str
    """Name of the view."""
    compared_with: int
    """Number of photographs that this one could be compared with."""
    matches: int
    """Number of its features that match one of another photograph."""
    agreeing: int
    """Number of these matches that agree with the poses."""
    sharpness: float | None
    """Ratio of fine to coarse detail, divided by the same ratio of the other photographs; 1 if equally sharp."""
    brightness: float | None
    """Brightness relative to the other photographs: the geometric mean of ``channels``."""
    channels: tuple[float, float, float] | None
    """Red, green and blue relative to the other photographs."""


Places = tuple[Features, np.ndarray, np.ndarray]
"""Features of a photograph, the logarithm of fine over coarse detail [N] and the mean colours [N, 3] in [0, 1] around them."""


def _places(view: View) -> Places:
    import cv2

    features = sift_features(view, MAX_PIXELS, MAX_FEATURES)
    columns, rows = features[0].astype(int).T
    gray = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)
    fine, coarse = (cv2.GaussianBlur(gray, (0, 0), sigma) for sigma in (FINE, COARSE))
    bands = [cv2.blur((a - b) ** 2, (PATCH, PATCH))[rows, columns].astype(float) for a, b in ((gray, fine), (fine, coarse))]
    colors = cv2.blur(view.image, (PATCH, PATCH))[rows, columns].astype(float)
    return features, 0.5 * np.log((bands[0] + NOISE) / (bands[1] + NOISE)), colors


def _difference(views: Sequence[View], places: Sequence[Places | None], i: int, j: int) -> tuple[int, int, np.ndarray | None]:
    """Return numbers of matches and of agreeing ones, and log factors of photograph i over j; None with few matches.

    Factors [4] are those of detail, red, green and blue, NaN if unknown.
    """
    (first, detail_a, colors_a), (second, detail_b, colors_b) = places[i], places[j]
    ids, _, tried = agreeing_matches(views[i], views[j], first, second, min_angle=0.0)
    if len(ids) < MIN_MATCHES:
        return tried, len(ids), None
    detail = np.median(detail_a[ids[:, 0]] - detail_b[ids[:, 1]])
    both = np.stack([colors_a[ids[:, 0]], colors_b[ids[:, 1]]])
    usable = ((both > DARKEST) & (both < BRIGHTEST)).all((0, 2))
    colors = np.median(np.log(both[0, usable] / both[1, usable]), axis=0) if usable.sum() >= MIN_MATCHES else [np.nan] * 3
    return tried, len(ids), np.array([detail, *colors])


def _typical(differences: list[float]) -> float | None:
    """Return the median; with two middle values, the number between them nearest to 0; None if all are NaN."""
    # a faulty photograph differs from most others, so the choice does not hide it
    if not (known := sorted(d for d in differences if np.isfinite(d))):
        return None
    middle = known[(len(known) - 1) // 2], known[len(known) // 2]
    return 0.0 if middle[0] < 0 < middle[1] else min(middle, key=abs)


def check_photos(views: Sequence[View], stopped: Callable[[], bool] = lambda: False) -> list[PhotoCheck]:
    """Compare each photograph with the nearest ones, until ``stopped``; ``views`` include those that are held out."""
    pairs = sorted({(min(i, j), max(i, j)) for i in range(len(views)) for j in nearest_views(views, i, NEIGHBORS)})
    with single_threaded_opencv(), ThreadPoolExecutor(torch.get_num_threads(), initializer=without_ipp) as pool:
        places = [*pool.map(lambda view: None if stopped() else _places(view), views)]
        found = [*pool.map(lambda pair: (0, 0, None) if stopped() else _difference(views, places, *pair), pairs)]
    differences: list[list[np.ndarray]] = [[] for _ in views]
    counts = np.zeros((len(views), 2), int)
    for pair, (tried, agreeing, difference) in zip(pairs, found, strict=True):
        for k, sign in zip(pair, (1, -1), strict=True):
            counts[k] += tried, agreeing
            differences[k] += [] if difference is None else [sign * difference]
    return [_check(v.name, d, *map(int, n)) for v, d, n in zip(views, differences, counts, strict=True)]


def _check(name: str, differences: list[np.ndarray], *matches: int) -> PhotoCheck:
    """Return the check of a photograph from its differences to others, as `_difference` gives them, and numbers of matches."""
    detail, *colors = (_typical([float(d[k]) for d in differences]) for k in range(4))
    factor = None if detail is None else round(math.exp(detail), 3)
    if len(known := [c for c in colors if c is not None]) < 3:
        return PhotoCheck(name, len(differences), *matches, factor, None, None)
    channels = tuple(round(math.exp(c), 3) for c in known)
    return PhotoCheck(name, len(differences), *matches, factor, round(math.exp(sum(known) / 3), 3), channels)


def photo_notes(checks: Sequence[PhotoCheck]) -> list[str]:
    """Return notes on photographs with faults, and on photographs that could not be compared; an empty list without any."""
    blurred = sorted((c for c in checks if c.sharpness is not None and c.sharpness < MIN_SHARPNESS), key=lambda c: c.sharpness)
    known = [c for c in checks if c.brightness is not None]
    exposed = [c for c in known if not 1 / MAX_BRIGHTNESS <= c.brightness <= MAX_BRIGHTNESS]
    exposed.sort(key=lambda c: -abs(math.log(c.brightness)))
    tints = [(c.name, c.channels) for c in known if any(not 1 / MAX_TINT <= k / c.brightness <= MAX_TINT for k in c.channels)]
    faults = (
        ("less detail than in other photographs of the same places, probably blur", "look at them, and remove blurred ones",
         [f"{c.name} ({c.sharpness:.2f} x as sharp)" for c in blurred]),
        ("exposure differs from neighbouring photographs", REMEDY,
         [f"{c.name} ({c.brightness:.2f} x as bright)" for c in exposed]),
        ("white balance differs from neighbouring photographs", REMEDY,
         [f"{name} (red {red:.2f}, green {green:.2f}, blue {blue:.2f} x)" for name, (red, green, blue) in tints]),
    )  # fmt: skip
    notes: list[str] = [Task(f"{what}: {listed(named, MAX_NAMED)}; {remedy}") for what, remedy, named in faults if named]
    tried, agreeing = sum(c.matches for c in checks), sum(c.agreeing for c in checks)
    if tried >= 2 * MIN_TRIED and agreeing < MIN_AGREEMENT * tried:  # both photographs count a match
        share = f"only {agreeing / tried:.0%} of {tried // 2:,} matches agree with them"
        remedy = "check direction (from camera to world, or back) and axes of poses, and that focal lengths are in pixels"
        return [Task(f"the cameras do not fit the photographs: {share}; {remedy}"), *notes]
    alone = [c.name for c in checks if not c.compared_with]
    return [*notes, *([f"blur and exposure not checked, too few matches: {listed(alone, MAX_NAMED)}"] if alone else [])]
