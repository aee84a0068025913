"""Objects photographed on black: their detection, and transparency for the dark background."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warpgs.scene import View

DARK = 16 / 255
"""A pixel is dark if its brightest channel is below this value, in [0, 1]."""
DARK_FRACTION = 0.3
"""An image with a dark border shows an object on black if at least this fraction of its pixels is dark."""

HOLE = 0.001
"""An enclosed dark region is a hole in the object if it covers at least this fraction of the image."""


def dark_pixels(image: np.ndarray) -> np.ndarray | None:
    """Return the dark pixels, bool [H, W], of an image [H, W, 3] that shows an object on black; None for any other image.

    In such an image, at least `DARK_FRACTION` of the pixels and half of the border are dark, but not all pixels.
    """
    dark: np.ndarray = image.max(-1) < DARK
    border = np.concatenate([dark[0], dark[-1], dark[:, 0], dark[:, -1]])
    return dark if dark.mean() >= DARK_FRACTION and border.mean() >= 0.5 and not dark.all() else None


def empty_pixels(dark: np.ndarray) -> np.ndarray:
    """Return the dark pixels without an object in front of them, bool [H, W].

    The region of adjacent dark pixels (4 neighbours) around such a pixel touches the border, or covers at least `HOLE` of the
    image.
    """
    import cv2

    _, labels, found, _ = cv2.connectedComponentsWithStats(dark.astype(np.uint8), connectivity=4)
    empty = found[:, cv2.CC_STAT_AREA] >= HOLE * dark.size
    empty[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = True
    pixels: np.ndarray = dark & empty[labels]
    return pixels


def cut_from_black(views: list[View]) -> tuple[list[View], str]:
    """Make the dark pixels around an object and in its holes transparent, if all views show an object on black.

    All other pixels get an opacity of 1, and so do dark specks and cracks that the object encloses. If any view has an alpha
    channel or a mask, or shows something else, all views stay unchanged.

    Args:
        views: The views of a scene.

    Returns:
        The views, and a note for the user; an empty note if nothing is changed.
    """
    done, empty = [], 0.0
    for v in views:
        dark = dark_pixels(v.image) if v.alpha is None and v.mask is None else None
        if dark is None:
            return views, ""
        nothing = empty_pixels(dark)
        empty += float(nothing.mean()) / len(views)
        alpha = 1 - nothing.astype(np.float32)
        done.append(replace(v, image=v.image * alpha[..., None], alpha=alpha, alpha_estimated=True))
    return done, (
        f"every image shows an object on black: the dark pixels around the object and in its holes ({empty:.1%} of all "
        f"pixels) become transparent; --no-black-is-empty keeps them"
    )
