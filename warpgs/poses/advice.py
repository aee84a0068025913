"""Advice on photographs and their poses: why a photograph has no pose, and what to photograph next."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from warpgs.poses.mapping import Mapping

MIN_KEYPOINTS = 100
"""Keypoints below which a photograph shows too little to match: a blank wall, darkness, blur."""
MIN_MATCHES = 15
"""Number of matches that a pair needs, all in agreement with one motion of the camera."""
WEAK_MATCHES = 60
"""Matches below which the link between two photographs is called weak: a few wrong matches bend the poses."""
WIDE_ANGLE = 30.0
"""Angle between the optical axes of neighbours [degrees] beyond which SIFT finds few matches."""
MAX_ADVICE = 8
"""Number of pieces of advice that are given, the most urgent first."""


def partners(found: Mapping, i: int) -> list[tuple[int, int]]:
    """Return the photographs that photograph ``i`` matches, each with the number of matches, most matches first."""
    return sorted(found.links.get(i, ()), key=lambda link: (-link[1], link[0]))


def reason(found: Mapping, i: int, names: Sequence[str]) -> str:
    """Return why a photograph has no pose, in words that follow its name."""
    keypoints = found.keypoints[i]
    if keypoints < MIN_KEYPOINTS:
        return f"has {keypoints} keypoints, too few to match: a blank wall, darkness or blur"
    best = partners(found, i)
    if not best:
        return f"has {keypoints:,} keypoints and matches no other photograph"
    j, n = best[0]
    matched = f"has {keypoints:,} keypoints and {n} matches with {names[j]}"
    if j in found.views:
        return f"{matched}, too few of them at places of known depth"
    group = next((g for g in found.groups[1:] if i in g), ())
    together = f", in a separate group of {len(group)}" if group else ""
    return f"{matched}, which has no pose either{together}"


def axis_angle(found: Mapping, i: int, j: int) -> float:
    """Return the angle between the optical axes of two views [degrees]."""
    cosine = float((found.views[i].rotation[2] * found.views[j].rotation[2]).sum())
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def neighbours(found: Mapping) -> list[tuple[int, int, float]]:
    """Return the pairs of views that connect all views by the smallest angles (a minimum spanning tree), with their angles."""
    last, *left = list(found.views) or [-1]
    nearest: dict[int, tuple[float, int]] = dict.fromkeys(left, (math.inf, -1))
    tree = []
    while nearest:
        for j, best in nearest.items():
            nearest[j] = min(best, (axis_angle(found, last, j), last))
        (angle, i), last = min((best, j) for j, best in nearest.items())
        del nearest[last]
        tree.append((min(i, last), max(i, last), angle))
    return sorted(tree)


def advice(found: Mapping, names: Sequence[str]) -> list[str]:
    """Return what to photograph next, a sentence each, the most urgent first; empty if nothing is missing."""
    said = []
    for i in range(len(names)):
        if i not in found.views:
            best = partners(found, i)
            if found.keypoints[i] < MIN_KEYPOINTS:
                said.append(f"take {names[i]} again: sharp, in good light, with a textured object in view")
            elif best:
                said.append(f"take two or three photographs between {names[i]} and {names[best[0][0]]}, in small steps")
            else:
                said.append(f"take photographs from {names[i]} to the others, each overlapping the previous one by two thirds")
    tree = neighbours(found)
    for i, j, angle in sorted(tree, key=lambda t: -t[2]):
        if angle > WIDE_ANGLE:
            said.append(
                f"take one or two photographs between {names[i]} and {names[j]}, whose axes differ by {angle:.0f} degrees"
            )
    for i in found.views:
        best = [(n, j) for j, n in partners(found, i) if j in found.views]
        if best and best[0][0] < WEAK_MATCHES:
            said.append(f"take a photograph between {names[i]} and {names[best[0][1]]}, which share only {best[0][0]} matches")
    more = len(said) - MAX_ADVICE
    return said[:MAX_ADVICE] + ([f"and {more} more; begin with those above"] if more > 0 else [])
