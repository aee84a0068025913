"""Objects photographed on black: how they are recognised, and the dark pixels around them as transparency."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warpgs.scene import View

DARK = 16 / 255
"""Brightness below which the brightest channel of a pixel belongs to a black background, in [0, 1]."""
DARK_FRACTION = 0.3
"""Fraction of dark pixels from which on an image with a dark border shows an object on black."""


def dark_pixels(image: np.ndarray) -> np.ndarray | None:
    """Return the dark pixels, bool [H, W], of an image [H, W, 3] that shows an object on black; None for any other image.

    At least `DARK_FRACTION` of its pixels and half of its border are dark, and not all are.
    """
    dark: np.ndarray = image.max(-1) < DARK
    border = np.concatenate([dark[0], dark[-1], dark[:, 0], dark[:, -1]])
    return dark if dark.mean() >= DARK_FRACTION and border.mean() >= 0.5 and not dark.all() else None


def joined_to_border(pixels: np.ndarray) -> np.ndarray:
    """Return those of the pixels, bool [H, W], that lead to the border over others, sideways or up and down."""
    import cv2

    _, labels = cv2.connectedComponents(pixels.astype(np.uint8), connectivity=4)
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    joined: np.ndarray = pixels & np.isin(labels, border)
    return joined


def cut_from_black(views: list[View]) -> tuple[list[View], str]:
    """Give views that all show an object on black an opacity: 0 for dark pixels joined to the border, 1 for all others.

    Dark pixels that the object encloses may be part of it and stay opaque. Views of which any has an opacity or a mask, or
    shows something else, stay as they are.

    Args:
        views: The views of a scene.

    Returns:
        The views, and a note for the user; empty where nothing is changed.
    """
    done, empty = [], 0.0
    for v in views:
        dark = dark_pixels(v.image) if v.alpha is None and v.mask is None else None
        if dark is None:
            return views, ""
        outside = joined_to_border(dark)
        empty += float(outside.mean()) / len(views)
        alpha = 1 - outside.astype(np.float32)
        done.append(replace(v, image=v.image * alpha[..., None], alpha=alpha))
    return done, (
        f"every image shows an object on black: {empty:.1%} of the pixels, dark and joined to the border, are taken for "
        "transparent; --no-black-is-empty leaves them black"
    )
