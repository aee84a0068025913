"""Pixels of an image that count, for the fit and for the score: its mask's, or the object where it stands before black."""

from __future__ import annotations

import numpy as np

from warpgs.scene import View

OPAQUE = 0.5
"""Opacity above which a pixel of a cut-out object shows it."""
DARK = 16 / 255
"""Brightness below which the brightest channel of a pixel belongs to a black background, in [0, 1]."""
DARK_FRACTION = 0.3
"""Fraction of dark pixels from which on an image with a dark border shows an object on black."""


def scored_region(view: View) -> tuple[np.ndarray | None, str]:
    """Return the pixels that a render is scored on, bool [H, W], and their name; None for all.

    The view's score mask where it has one (DTU's protocol), else the region of `counted_region`.
    """
    if view.score_mask is not None:
        return view.score_mask, "score mask"
    return counted_region(view)


def counted_region(view: View) -> tuple[np.ndarray | None, str]:
    """Return the pixels of a view that count in its fit, bool [H, W], and their name; None for all.

    The view's mask where it has one; else the bright pixels where it shows an object on black, because a black frame around
    a small object would otherwise decide the score.
    """
    if view.mask is not None and not view.mask.all():
        return view.mask, "mask"
    dark = view.image.max(-1) < DARK
    border = np.concatenate([dark[0], dark[-1], dark[:, 0], dark[:, -1]])
    if dark.mean() >= DARK_FRACTION and border.mean() >= 0.5 and not dark.all():
        return ~dark, "foreground"
    return None, "all"


def fitted_region(view: View) -> tuple[np.ndarray | None, str]:
    """Return the pixels behind which a fit may start Gaussians, bool [H, W], and their name; None for all.

    The opaque ones that its mask keeps where the view knows its opacity, else the region of `counted_region`.
    """
    if view.alpha is None:
        return counted_region(view)
    opaque = view.alpha > OPAQUE
    return opaque if view.mask is None else opaque & view.mask, "object"
