"""Detection of empty frames, and of frames outside the captured area, while a film is rendered."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

EMPTY = 0.1
"""A frame shows nearly nothing if its mean alpha is below this fraction of the mean alpha of the training views' renders."""
MIN_COVERAGE = 0.002
"""A frame also shows nearly nothing if its mean alpha is below this value."""
BLACK = 1 / 255
"""Mean of the brightest channel below which a frame is black."""

OUTSIDE = 0.1
"""Fraction of a frame outside all photographs above which a note is printed."""


def _ranges(numbers: list[int]) -> str:
    """Return ascending numbers as text such as "3 to 7, 9 and 12 to 20"; after five ranges, the number of the others."""
    runs: list[list[int]] = []
    for n in numbers:
        if runs and n == runs[-1][1] + 1:
            runs[-1][1] = n
        else:
            runs.append([n, n])
    words = [str(a) if a == b else f"{a} to {b}" for a, b in runs[:5]]
    if len(runs) > 5:
        words.append(f"{sum(b - a + 1 for a, b in runs[5:])} more")
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


@dataclass
class FrameCheck:
    """Faults of the frames of a film, noticed while they are rendered."""

    coverage: float
    """Mean alpha of the training views' renders; 0 if unknown."""
    empty: list[int] = field(default_factory=list)
    """Numbers of the frames that show nearly nothing."""
    black: list[int] = field(default_factory=list)
    """Numbers of the other frames that are black."""
    outside: list[int] = field(default_factory=list)
    """Numbers of the other frames of which a fraction above `OUTSIDE` is outside all photographs."""
    count: int = 0
    """Number of checked frames."""

    def look(self, image: np.ndarray, alpha: np.ndarray, outside: float = 0.0) -> None:
        """Check the next frame: image [H, W, 3] and alpha [H, W] in [0, 1], and its fraction outside all photographs."""
        if float(alpha.mean(dtype=np.float64)) < max(EMPTY * self.coverage, MIN_COVERAGE):
            self.empty.append(self.count)
        elif float(image.max(2).mean(dtype=np.float64)) < BLACK:
            self.black.append(self.count)
        elif outside > OUTSIDE:
            self.outside.append(self.count)
        self.count += 1

    def notes(self, remedy: str, nearer: str) -> list[str]:
        """Return a line for the user on each fault, with advice: ``nearer`` for frames outside photographs, else ``remedy``."""
        return [
            f"{len(numbers)} of {self.count} frames {words} (frames {_ranges(numbers)}): {advice}"
            for numbers, words, advice in (
                (self.empty, "show nearly nothing", f"the path leaves the captured area; {remedy}"),
                (self.black, "are black", f"the camera is inside geometry, or the scene is unlit; {remedy}"),
                (
                    self.outside,
                    f"have over {OUTSIDE:.0%} of their pixels outside all photographs",
                    f"expect artefacts there; {nearer}",
                ),
            )
            if numbers
        ]
