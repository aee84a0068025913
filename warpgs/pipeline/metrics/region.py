"""Pixels that a fit and its scores use: those of a mask, or of an object on a black background."""

from __future__ import annotations

import numpy as np

from warpgs.io.black_background import dark_pixels
from warpgs.scene import View

OPAQUE = 0.5
"""Opacity above which a pixel of a cut-out object shows it."""


def scored_region(view: View) -> tuple[np.ndarray | None, str]:
    """Return the pixels that a render is scored on, bool [H, W], and their name; None for all.

    These are the pixels of the view's score mask, if any (DTU's protocol), else the region of `counted_region`.
    """
    if view.score_mask is not None:
        return view.score_mask, "score mask"
    return counted_region(view)


def counted_region(view: View) -> tuple[np.ndarray | None, str]:
    """Return the pixels of a view that a fit compares with the render, bool [H, W], and their name; None for all.

    These are the pixels of the view's mask, if any. Without a mask, they are the bright pixels of a view of an object on black,
    because a black frame around a small object would dominate the score.
    """
    if view.mask is not None and not view.mask.all():
        return view.mask, "mask"
    dark = dark_pixels(view.image)
    return (None, "all") if dark is None else (~dark, "foreground")


def fitted_region(view: View) -> tuple[np.ndarray | None, str]:
    """Return the pixels behind which a fit may start Gaussians, bool [H, W], and their name; None for all.

    These are the opaque pixels within the mask if the view has an alpha channel, else the region of `counted_region`.
    """
    if view.alpha is None:
        return counted_region(view)
    opaque = view.alpha > OPAQUE
    return opaque if view.mask is None else opaque & view.mask, "object"
