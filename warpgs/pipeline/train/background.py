"""Colour behind a scene: from its files, the mean of its photographs, or the user's choice; and random colours in training."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence

import numpy as np
import torch

from warpgs.errors import UsageError
from warpgs.pipeline.metrics.region import counted_region
from warpgs.scene import Scene, View

Color = tuple[float, float, float]
"""Red, green and blue in [0, 1]."""
NAMED: dict[str, Color] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
CHOSEN = ("auto", "mean", "scene")
"""Names of colours that depend on the scene."""
BEHIND = 0x62616B67
"""Seed component that makes random backgrounds independent of other random numbers of a fit."""
LEVELS = 2**16 - 1
"""Number of levels to which colours are rounded before they are added: sums of integers are exact in any order."""


def color_of(text: str) -> Color | None:
    """Return the colour that a text names; None for a colour that depends on the scene.

    Args:
        text: auto, mean, scene, black, white, ``#rrggbb``, or three numbers in [0, 1] as ``r,g,b``.

    Raises:
        UsageError: The colour is invalid.
    """
    if text in CHOSEN:
        return None
    if text in NAMED:
        return NAMED[text]
    if re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        red, green, blue = bytes.fromhex(text[1:])
        return red / 255, green / 255, blue / 255
    parts = text.split(",")
    if len(parts) == 3 and all(re.fullmatch(r" *([01]|[01]?\.[0-9]{1,17}|[01]\.) *", p) for p in parts):
        red, green, blue = map(float, parts)
        if max(red, green, blue) <= 1:
            return red, green, blue
    raise UsageError(
        f"background {text[:60]!r} is not a colour: give auto, mean, scene, black, white, #rrggbb, or r,g,b in [0, 1]"
    )


def mean_color(views: list[View]) -> Color:
    """Return the mean colour of all unmasked pixels of views; it has the same bits on every machine."""
    total, count = np.zeros(3, np.int64), 0
    for v in views:
        pixels = v.image.reshape(-1, 3) if v.mask is None else v.image[v.mask]
        total += np.rint(pixels.astype(np.float64) * LEVELS).astype(np.int64).sum(axis=0)
        count += len(pixels)
    red, green, blue = (int(t) / (LEVELS * max(count, 1)) for t in total)
    return red, green, blue


def choose_background(wish: str, scene: Scene, train: list[View]) -> tuple[Color, str]:
    """Return the colour behind a scene, and a note for the user; no note if opaque views keep the scene's own background.

    Args:
        wish: As `FitConfig.background`.
        scene: The scene.
        train: Its training views.

    Raises:
        UsageError: ``wish`` is not a colour.
    """
    color = color_of(wish)
    if color is not None:
        return color, f"background: {wish}, {_words(color)}"
    if wish == "mean":
        color = mean_color(train)
        return color, f"background: the mean colour of the training views, {_words(color)}"
    cut_out = any(v.alpha is not None or counted_region(v)[1] == "foreground" for v in train)
    if wish == "auto" and not cut_out:
        color = mean_color(train)
        return color, f"background: the mean colour of the training views, {_words(color)}; change it with --background"
    if wish == "auto":
        return scene.background, f"background: {_words(scene.background)}, since the views show a cut-out object"
    return scene.background, f"background: {_words(scene.background)}, from the scene's files" if cut_out else ""


def over_background(scene: Scene, color: Color) -> Scene:
    """Return the scene over another background [3]; images change where views are transparent."""
    if color == scene.background:
        return scene
    shift = np.float32(color) - np.float32(scene.background)

    def moved(v: View) -> View:
        if v.alpha is None:
            return v
        return dataclasses.replace(v, image=np.clip(v.image + (1 - v.alpha[..., None]) * shift, 0, 1))

    return dataclasses.replace(scene, background=color, views=tuple(map(moved, scene.views)))


def over(image: torch.Tensor, alpha: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
    """Return an image [H, W, 3] of opacity ``alpha`` [H, W] over another background: its own background plus ``shift`` [3]."""
    return image + (1 - alpha)[..., None] * shift


def random_shift(seed: int, step: int, background: Sequence[float]) -> tuple[float, float, float]:
    """Return a random colour, uniform in [0, 1], minus the scene's background [3]; it depends on seed and step only."""
    red, green, blue = (b - a for a, b in zip(background, np.random.default_rng([seed, step, BEHIND]).random(3).tolist()))
    return red, green, blue


def _words(color: Color) -> str:
    """Return a colour as text, #rrggbb."""
    return "#" + "".join(f"{round(255 * c):02x}" for c in color)
