"""Effect of a fit's cut-offs on its own scene: error of training views against ``exact`` in float64, and saved time."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

from warpgs.constants import TILE_SIZE
from warpgs.lenses import MODELS
from warpgs.pipeline.metrics.psnr import psnr_of
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.render.reference import reference_image
from warpgs.scene import Camera, Gaussians, View

VIEWS = 3
"""Number of training views that are compared, sampled at random."""
SIDE = 64
"""Side of the part of each view that is compared [px], a multiple of the tile size."""


def _window(camera: Camera, generator: np.random.Generator) -> tuple[int, int, int, int]:
    """Sample a part of an image, [left, top, width, height], with edges at tile edges or image edges."""
    sides = []
    for length in (camera.width, camera.height):
        first = TILE_SIZE * int(generator.integers(max(0, length - SIDE) // TILE_SIZE + 1))
        sides.append((first, min(SIDE, length - first)))
    (x, width), (y, height) = sides
    return x, y, width, height


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Compute on one thread in the block: for many small tensors, threads wait for each other longer than they compute."""
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)


def _seconds(render: Callable[[], object], device: torch.device) -> float:
    """Return the wall time of the second of two calls [s]: the first loads kernels and allocates."""
    for _ in range(2):
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        began = time.perf_counter()
        render()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
    return time.perf_counter() - began


@torch.no_grad()
def rule_report_of(
    gaussians: Gaussians, views: list[View], options: RasterizeOptions, *, seed: int, half_resolution: float = 0.0
) -> dict[str, Any]:
    """Measure error and saved time of a rule on a scene; takes some tenths of a second.

    Three random views are rendered with the rule, as in the fit. 64 x 64 px of each are compared with the image of rule `exact`
    in float64. That image is computed by `warpgs.render.reference` without the kernels, or by the kernels if `warpgs.lenses`
    does not have the camera model.

    Args:
        gaussians: Gaussians of the finished fit, float32.
        views: Training views, at least one.
        options: Options of the rasterizer, with the name of the fit's cut-offs and a background.
        seed: Seed of the choice of views and parts.
        half_resolution: Fraction of the steps with views of half size.

    Returns:
        ``max``, ``mean`` and ``psnr`` [dB] (None if infinite) of the error of colours in [0, 1] over all parts; ``views`` by
        name with their compared parts; ``render_ms`` and, unless the rule is `exact`, ``exact_ms`` of one whole view; ``rule``;
        and ``summary``, the same figures as a sentence.
    """
    generator = np.random.default_rng(seed)
    chosen = [views[i] for i in sorted(generator.permutation(len(views))[:VIEWS])]
    device = gaussians.means.device
    assert options.background is not None
    options = dataclasses.replace(options, background=options.background.to(gaussians.means))
    rule, exact = options.rule, dataclasses.replace(options, rule="exact")
    errors, windows = [], {}
    for view in chosen:
        window = windows[view.name] = _window(view.camera, generator)
        found = rasterize(gaussians, view.camera, dataclasses.replace(options, window=window)).rgb
        # what reaches the part under `exact`; tiles are listed with a margin
        near = rasterize(gaussians, view.camera, dataclasses.replace(exact, window=window)).visible[0]
        part = Gaussians(**{n: t[near] for n, t in gaussians.tensors().items()})
        wanted = _wanted(part, view.camera, window, exact)
        errors.append((found.double() - wanted).abs().flatten())
    error = torch.cat(errors)
    whole = chosen[0].camera
    result = {
        "rule": rule, "max": float(error.max()), "mean": float(error.mean()), "psnr": psnr_of(float((error**2).mean())),
        "views": {n: list(w) for n, w in windows.items()}, "half_resolution": half_resolution,
        "render_ms": 1000 * _seconds(lambda: rasterize(gaussians, whole, options), device),
    }  # fmt: skip
    if rule != "exact":
        result["exact_ms"] = 1000 * _seconds(lambda: rasterize(gaussians, whole, exact), device)
    return result | {"summary": _summary(result)}


def _wanted(part: Gaussians, camera: Camera, window: tuple[int, int, int, int], exact: RasterizeOptions) -> torch.Tensor:
    """Return a part of an image under `exact` in float64; by the kernels for camera models that the reference lacks."""
    if camera.model in MODELS:
        with _one_thread():
            return reference_image(part, camera, window, exact.background, part.sh_degree, exact.antialiased)
    doubled = Gaussians(**{n: t.double() for n, t in part.tensors().items()})
    return rasterize(doubled, camera, dataclasses.replace(exact, background=exact.background.double(), window=window)).rgb


def _summary(r: dict[str, Any]) -> str:
    """Return the figures as one sentence for the user."""
    sizes = {f"{w} x {h} px" for _, _, w, h in r["views"].values()}
    where = f"on {' or '.join(sorted(sizes))} of {len(r['views'])} random training view{'s' if len(r['views']) > 1 else ''}"
    error = f"{r['mean']:.1e} on average and {r['max']:.1e} at most, {r['psnr']:.0f} dB, {where}"
    if r["rule"] == "exact":
        words = f"rule exact has no cut-offs; float32 differs from float64 by {error}"
    else:
        ratio = r["render_ms"] / r["exact_ms"]
        words = (
            f"images by rule {r['rule']} differ from images by rule exact in float64 by {error}; a view took "
            f"{r['render_ms']:.1f} ms, {abs(1 - ratio):.0%} {'less' if ratio <= 1 else 'more'} than with rule exact "
            f"({r['exact_ms']:.1f} ms)"
        )
    if r["half_resolution"] > 0:
        words += f"; {r['half_resolution']:.0%} of the steps used views of half size, with a quarter of the pixels"
    return words
