"""One pass of the rasterizer: the tensors and settings of a render, projection, binning and blending."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch

from warpgs.constants import Rule
from warpgs.kernels import blend as blending, launch, sh
from warpgs.kernels.ellipse import ProjectInputs, checked_factors, nothing, packed_covariances
from warpgs.kernels.falloff import Pass
from warpgs.kernels.tiles import AS_NEEDED, InstanceMemory, Tiles, bin_tiles
from warpgs.kernels.walk import contributions, heaviest, median_depth
from warpgs.scene import ActivatedGaussians, Camera, CovarianceGaussians, RasterizedGaussians, Tensors

# `rasterize`, chunked and graphed rendering and the training step all call these functions, each with its own way to
# allocate memory.

Images = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
"""Colour [C, H, W, 3], or [C, H, W, D] of Gaussians with D channels; alpha and expected depth [C, H, W]."""


def as_batch(array: Any, like: torch.Tensor, axes: int = 2) -> torch.Tensor:
    """Return an array as a tensor [C, ...] of the type and device of ``like``; ``axes`` is the array's ndim for one camera."""
    tensor: torch.Tensor = array
    if isinstance(array, np.ndarray):
        array = array.copy()  # the backward pass reads it, and an edit of an array would go unnoticed
    if not (isinstance(array, torch.Tensor) and array.dtype == like.dtype and array.device == like.device):
        tensor = torch.as_tensor(array, dtype=like.dtype, device=like.device)
    return tensor[None] if tensor.ndim == axes else tensor


def _for_each(name: str, array: Any, like: torch.Tensor, axes: int = 2) -> torch.Tensor:
    """Return the array ``name`` of a camera as a tensor [C, ...], with an entry for each of the poses ``like`` [C, 4, 4]."""
    tensor, cameras = as_batch(array, like, axes), like.shape[0]
    own = list(tensor.shape[1:])
    if tensor.ndim != axes + 1 or tensor.shape[0] not in (1, cameras):
        raise ValueError(f"camera.{name} must have shape {own} or {[cameras, *own]}, as viewmat, not {list(array.shape)}")
    return tensor if tensor.shape[0] == cameras else tensor.expand(cameras, *own).contiguous()


def inputs_of(gaussians: RasterizedGaussians, camera: Camera, opacity_factors: torch.Tensor | None = None) -> ProjectInputs:
    """Return a render's tensors, in the type and on the device of the means; ``opacity_factors`` [N], None for 1."""
    means = gaussians.means
    viewmats = as_batch(camera.viewmat, means)
    Ks = _for_each("K", camera.K, viewmats)
    if camera.distortion is None:
        distortion = nothing((viewmats.shape[0], 0), means.dtype, means.device)
    else:
        distortion = _for_each("distortion", camera.distortion, viewmats, 1)
    factors = checked_factors(means, opacity_factors)
    if isinstance(gaussians, CovarianceGaussians):
        launch.check(means=(means, "N 3"), covars=(gaussians.covars, "N 3 3"))
        _, covars, opacities, sh = gaussians.tensors().values()
        return ProjectInputs(means, *packed_covariances(covars), opacities, sh, viewmats, Ks, distortion, factors)
    return ProjectInputs(*gaussians.tensors().values(), viewmats, Ks, distortion, factors)


def parameters_of(gaussians: RasterizedGaussians) -> str:
    """Return the kind of the Gaussians' parameters (`Pass.parameters`)."""
    if isinstance(gaussians, CovarianceGaussians):
        return "covariances"
    return "activated" if isinstance(gaussians, ActivatedGaussians) else "stored"


def pass_of(camera: Camera, degree: int, rule: Rule, **others: Any) -> Pass:
    """Return the settings of a render of a whole image; ``others`` are further fields of `Pass`."""
    size = camera.width, camera.height
    named = {"window": (0, 0, *size), "camera_model": camera.model, **others}
    return Pass(size, rule=rule, sh_count=sh.coefficient_count(degree), **named)


def bin_and_blend(
    projected: torch.Tensor, tile_counts: torch.Tensor, backgrounds: torch.Tensor, settings: Pass,
    memory: InstanceMemory = AS_NEEDED, colors: torch.Tensor | None = None,
) -> Images:  # fmt: skip
    """Bin and blend projected Gaussians [C, N, 12]; ``colors`` as in `blend`."""
    tiles = bin_tiles(projected, tile_counts, settings, memory, needs_slots((projected, backgrounds, colors)))
    return blending.blend(projected, tiles, backgrounds, settings, colors)


def needs_slots(tensors: Iterable[torch.Tensor | None]) -> bool:
    """Return whether autograd is on and one of the tensors, of any shape [...], requires gradients."""
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)


def further_of(projected: torch.Tensor, tiles: Tiles, settings: Pass, weights: bool, median: bool, k: int) -> Tensors:
    """Return further fields of `Render` by name: weights [C, N], median depth [C, H, W], and the ``k`` heaviest Gaussians."""
    found = {}
    if weights:
        found["weight_sums"], found["weight_maxima"] = contributions(projected, tiles, settings)
    if median:
        found["median_depth"] = median_depth(projected, tiles, settings)
    if k:
        found |= dict(zip(("heaviest_ids", "heaviest_weights", "blend_counts"), heaviest(projected, tiles, k, settings)))
    return found
