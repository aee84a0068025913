"""The rasterizer as one differentiable call: Gaussians and cameras in, pictures out."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from warpgs.constants import RULES, Rule
from warpgs.errors import UsageError
from warpgs.kernels.blend import blend, contributions
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles
from warpgs.render import graphed
from warpgs.render.chunked import Frame, blend_in_bands, contributions_in_bands
from warpgs.scene import Camera, Gaussians, Render

TILE_SIZES = (8, 16)


@dataclass(frozen=True)
class RasterizeOptions:
    """How to draw; the defaults are exact."""

    rule: str | Rule = "exact"
    """Cut-offs: exact, balanced, fast (docs/trade.md), gsplat, inria, or a Rule of your own."""
    sh_degree: int | None = None
    """Spherical-harmonics degree used; None for all that is stored."""
    background: torch.Tensor | None = None
    """Colour behind the scene, shape [3] or [C, 3]; None for black. Gradients flow into it."""
    tile_size: int = 16
    """Side of a tile [px]: 8 or 16. The picture does not depend on it."""
    contributions: bool = False
    """Also report each Gaussian's blending weight, summed and at its largest."""
    memory_budget: int | None = None
    """Bytes that the (Gaussian, tile) instances may take; None for four fifths of what is free."""
    deterministic: bool = True
    """Sum gradients in a fixed order, so that the same inputs give the same bits. False takes less memory on CUDA."""
    opacity_factors: torch.Tensor | None = None
    """Numbers that the opacities are multiplied by, at least 0, shape [N]; 0 hides a Gaussian. Not differentiable."""
    capacity: int | None = None
    """Room for this many (Gaussian, tile) instances instead of as many as there are. Nothing is then read back from the
    device, so the call can be captured in a CUDA graph; look at `Render.overflow` before using the result."""
    window: tuple[int, int, int, int] | None = None
    """Left, top, width and height [px] of the part to draw: the pictures are the crop of the whole ones, to the bit. Edges lie
    at multiples of ``tile_size`` or at the picture's. None for all."""
    max_instances: int | None = None
    """Draw a picture of more (Gaussian, tile) instances than this in bands that have no more, and each band again for its
    gradients: the same picture in less memory and more time. None for all at once. Not with ``capacity``."""
    record: bool = True
    """On CUDA, replay what a loop repeats: the same bits in half the time. Of small calls with gradients, in a fixed order,
    without opacity_factors, contributions and bounds (docs/decisions/010-recorded-calls.md). False where other threads wait for
    the whole device, as torch.cuda.synchronize does."""

    def repeatable(self) -> bool:
        """Whether calls with these options may be recorded."""
        others = (self.opacity_factors, self.memory_budget, self.capacity, self.max_instances)
        return self.record and self.deterministic and not self.contributions and all(o is None for o in others)


def _checked_window(camera: Camera, options: RasterizeOptions) -> tuple[int, int, int, int]:
    width, height, side = camera.width, camera.height, options.tile_size
    if options.window is None:
        return 0, 0, width, height
    x, y, w, h = options.window
    inside = 0 <= x < x + w <= width and 0 <= y < y + h <= height
    if not inside or x % side or y % side or ((x + w) % side and x + w != width) or ((y + h) % side and y + h != height):
        raise UsageError(
            f"window {options.window} does not fit: in a picture of {width} x {height} px its edges must lie at multiples of "
            f"{side} px or at the picture's edges"
        )
    return x, y, w, h


def _as_batch(array, like: torch.Tensor, rows: int) -> torch.Tensor:
    if isinstance(array, torch.Tensor) and array.ndim == 3 and array.dtype == like.dtype and array.device == like.device:
        return array
    tensor = torch.as_tensor(array, dtype=like.dtype, device=like.device)
    return tensor.reshape(-1, rows, rows) if tensor.ndim < 3 else tensor


def _backgrounds(background, viewmats: torch.Tensor) -> torch.Tensor:
    background = torch.as_tensor(background, dtype=viewmats.dtype, device=viewmats.device)
    return background.expand(len(viewmats), 3) if background.ndim == 1 else background


def rasterize(gaussians: Gaussians, camera: Camera, options: RasterizeOptions = RasterizeOptions()) -> Render:
    """Draw Gaussians as one camera, or each camera of a batch, sees them.

    Differentiable in the five tensors of ``gaussians``, in ``camera.viewmat`` and ``camera.K`` where those are tensors that
    require gradients, and in ``options.background``. Float32 or float64, CPU or CUDA, as the tensors are; the same inputs
    give the same bits every time, unless ``options.deterministic`` is False. Cameras are moved to the type and device of
    ``gaussians.means``.

    Args:
        gaussians: The scene, N Gaussians.
        camera: One camera ([4, 4], [3, 3]) or C of them ([C, 4, 4], [C, 3, 3]).
        options: How to draw.

    Returns:
        The pictures; without a leading axis for a single camera. To get gradients of the projected means, call
        ``render.projected.retain_grad()`` before the backward pass: they are ``render.projected.grad[..., :2]``.

    Raises:
        ResourceError: The Gaussians touch more tiles than memory allows.
        TypeError: A scalar type is neither float32 nor float64, or they differ.
        UsageError: The rule's name or the tile size is unknown, the window cuts tiles, or options exclude each other.
        ValueError: A shape or device disagrees; the message names argument, wanted and found.
    """
    rule = options.rule if isinstance(options.rule, Rule) else RULES.get(options.rule)
    if rule is None:
        raise UsageError(f"unknown rule {options.rule!r}: choose one of {', '.join(RULES)}, or give a Rule")
    means = gaussians.means
    if options.tile_size not in TILE_SIZES:
        raise UsageError(f"tile size {options.tile_size} is not one of {', '.join(map(str, TILE_SIZES))}")
    most = options.max_instances
    if most is not None and (options.capacity is not None or most < 1):
        raise UsageError("max_instances must be at least 1 and does not go with a capacity")
    viewmats, Ks = _as_batch(camera.viewmat, means, 4), _as_batch(camera.K, means, 3)
    x, y, width, height = window = _checked_window(camera, options)
    size = {"width": width, "height": height}
    degree = gaussians.sh_degree if options.sh_degree is None else options.sh_degree
    backgrounds = None if options.background is None else _backgrounds(options.background, viewmats)
    sources = (*gaussians.tensors().values(), viewmats, Ks)
    if means.is_cuda and options.repeatable():
        frame = graphed.Frame(camera.width, camera.height, window, degree, rule, options.tile_size)
        found = graphed.recorder(means.device).render(sources, backgrounds, frame)
        if found is not None:
            return _render(camera, *found)
    backgrounds = _backgrounds(means.new_zeros(3), viewmats) if backgrounds is None else backgrounds

    projected, tile_counts = project(
        *sources, width=camera.width, height=camera.height, degree=degree, rule=rule,
        tile_size=options.tile_size, window=window, opacity_factors=options.opacity_factors,
    )  # fmt: skip
    if most is not None and int(tile_counts.sum()) > most:
        frame = Frame(camera.width, camera.height, window, degree, rule, options.tile_size, most, options.deterministic)
        factors = () if options.opacity_factors is None else (options.opacity_factors,)
        sources = (*sources, *factors)
        images = blend_in_bands(projected, backgrounds, frame, sources)
        weights = contributions_in_bands(projected, frame, sources) if options.contributions else (None, None)
        return _render(camera, images, projected, tile_counts, *weights)
    overflow = None if options.capacity is None else torch.zeros(1, dtype=torch.int32, device=means.device)
    tiles = bin_tiles(
        projected, tile_counts, **size, tile_size=options.tile_size, rule=rule,
        budget_bytes=options.memory_budget, capacity=options.capacity, overflow=overflow, origin=(x, y),
    )  # fmt: skip
    how = {**size, "rule": rule, "origin": (x, y)}
    images = blend(projected, tiles, backgrounds, **how, deterministic=options.deterministic)
    weights = contributions(projected, tiles, **how) if options.contributions else (None, None)
    return _render(camera, images, projected, tile_counts, *weights, overflow)


def _render(camera: Camera, images: tuple[torch.Tensor, ...], *rest) -> Render:
    # not p[0], whose gradient would be a copy among zeros
    return Render(*(p.squeeze(0) if len(camera.viewmat.shape) == 2 else p for p in images), *rest)
