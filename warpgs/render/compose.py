"""One pass of the rasterizer: projection, binning and blending, with the settings of each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from warpgs.constants import Rule
from warpgs.kernels import blend as blending
from warpgs.kernels import launch, sh
from warpgs.kernels.blend import blend, blend_channels, contributions
from warpgs.kernels.ellipse import ProjectInputs, ProjectSettings, checked_factors, nothing, packed_covariances
from warpgs.kernels.falloff import BlendSettings
from warpgs.kernels.project import project_inputs
from warpgs.kernels.tiles import AS_NEEDED, InstanceMemory, Tiles, bin_tiles
from warpgs.kernels.walk import heaviest, median_depth
from warpgs.scene import ActivatedGaussians, Camera, CovarianceGaussians, RasterizedGaussians

Window = tuple[int, int, int, int]
"""Left, top, width and height [px]."""


@dataclass(frozen=True)
class RenderSettings:
    """Image, window, cut-offs and camera model of a render."""

    width: int
    """Width of the whole image [px]."""
    height: int
    """Height of the whole image [px]."""
    window: Window
    """Part of the image to render."""
    degree: int
    """Spherical-harmonics degree used."""
    rule: Rule
    """Cut-offs."""
    tile_size: int = 16
    """Side of a tile [px]."""
    camera_model: str = "pinhole"
    """Name of the camera model."""
    parameters: str = "stored"
    """Kind of the Gaussians' parameters (`ProjectSettings.parameters`)."""
    absgrad: bool = False
    """True to sum magnitudes of the gradients of projected means, too (`BlendSettings.absgrad`)."""
    antialiased: bool = False
    """True to reduce the opacity of Gaussians that the pixel filter widens (`ProjectSettings.antialiased`)."""

    def projection(self) -> ProjectSettings:
        """Return the settings of the projection."""
        size, count = (self.width, self.height), sh.coefficient_count(self.degree)
        variant = (self.camera_model, self.parameters, self.antialiased)
        return ProjectSettings(size, self.window, count, self.rule, self.tile_size, *variant)

    def of_window(self) -> dict[str, Any]:
        """Return the window's size and position, and the rule, as keyword arguments of binning and blending."""
        x, y, width, height = self.window
        return {"width": width, "height": height, "rule": self.rule, "origin": (x, y)}

    def blending(self, deterministic: bool = True) -> BlendSettings:
        """Return the settings of blending; True for ``deterministic`` sums gradients in a fixed order."""
        x, y, width, height = self.window
        return BlendSettings((x, y), width, height, self.rule, deterministic, self.absgrad)


# Project, bin, blend: the steps from Gaussians to images.
#
# `rasterize`, chunked and graphed rendering and the training step all call these functions, each with its own way to
# allocate memory. Only `RenderSettings` holds the camera model, the spherical-harmonics degree, the cut-offs and the
# window of a render.

Images = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
"""Colour [C, H, W, 3], or [C, H, W, D] of Gaussians with D channels; alpha and expected depth [C, H, W]."""


@dataclass(frozen=True)
class Composed:
    """A render, with its projected Gaussians and their tiles."""

    images: Images
    """Colour, alpha and depth."""
    projected: torch.Tensor
    """Projected Gaussians, shape [C, N, 12]."""
    tile_counts: torch.Tensor
    """Number of tiles that each Gaussian touches, int32, shape [C, N]."""
    tiles: Tiles
    """(Gaussian, tile) instances: the Gaussians that touch each tile."""


def as_batch(array: Any, like: torch.Tensor, axes: int = 2) -> torch.Tensor:
    """Return an array as a tensor [C, ...] of the type and device of ``like``; ``axes`` is the array's ndim for one camera."""
    tensor: torch.Tensor = array
    if not (isinstance(array, torch.Tensor) and array.dtype == like.dtype and array.device == like.device):
        tensor = torch.as_tensor(array, dtype=like.dtype, device=like.device)
    return tensor[None] if tensor.ndim == axes else tensor


def _for_each(name: str, array: Any, like: torch.Tensor, axes: int = 2) -> torch.Tensor:
    """Return the array ``name`` of a camera as a tensor [C, ...], with an entry for each of the poses ``like`` [C, 4, 4]."""
    tensor, cameras = as_batch(array, like, axes), like.shape[0]
    own = list(tensor.shape[1:])
    if tensor.ndim != axes + 1 or tensor.shape[0] not in (1, cameras):
        raise ValueError(
            f"camera.{name} must have shape {own} or {[cameras, *own]} to match camera.viewmat, not {list(array.shape)}"
        )
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
    """Return the kind of the Gaussians' parameters (`ProjectSettings.parameters`)."""
    if isinstance(gaussians, CovarianceGaussians):
        return "covariances"
    return "activated" if isinstance(gaussians, ActivatedGaussians) else "stored"


def settings_of(camera: Camera, degree: int, rule: Any, **others: Any) -> RenderSettings:
    """Return the settings of a render of a whole image; ``others`` are further fields of `RenderSettings`."""
    window = (0, 0, camera.width, camera.height)
    named = {"window": window, "camera_model": camera.model, **others}
    return RenderSettings(camera.width, camera.height, degree=degree, rule=rule, **named)


def bin_projected(
    projected: torch.Tensor, tile_counts: torch.Tensor, settings: RenderSettings, memory: InstanceMemory = AS_NEEDED,
    slotted: bool = True, listed: torch.Tensor | None = None,
) -> Tiles:  # fmt: skip
    """Return for each tile of the window the Gaussians [C, N, 12] that touch it, front to back (`bin_tiles`)."""
    named = {"memory": memory, "slotted": slotted, "listed": listed, **settings.of_window()}
    return bin_tiles(projected, tile_counts, tile_size=settings.tile_size, **named)


def compose(
    inputs: ProjectInputs, backgrounds: torch.Tensor, settings: RenderSettings, memory: InstanceMemory = AS_NEEDED,
    deterministic: bool = True,
) -> Composed:  # fmt: skip
    """Render a window of the images of C cameras over backgrounds [C, 3]. Differentiable as `project` and `blend` are."""
    projected, tile_counts = project_inputs(inputs, settings.projection())
    tiles, images = bin_and_blend(projected, tile_counts, backgrounds, settings, memory, deterministic)
    return Composed(images, projected, tile_counts, tiles)


def bin_and_blend(
    projected: torch.Tensor, tile_counts: torch.Tensor, backgrounds: torch.Tensor, settings: RenderSettings,
    memory: InstanceMemory = AS_NEEDED, deterministic: bool = True, colors: torch.Tensor | None = None,
) -> tuple[Tiles, Images]:  # fmt: skip
    """Bin and blend projected Gaussians [C, N, 12]; arguments are those of `compose` and `images_of`."""
    tiles = bin_projected(projected, tile_counts, settings, memory, needs_slots((projected, backgrounds, colors)))
    return tiles, images_of(projected, tiles, backgrounds, settings, deterministic, colors)


def needs_slots(tensors: Iterable[torch.Tensor | None]) -> bool:
    """Return whether autograd is on and one of the tensors, of any shape [...], requires gradients."""
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)


def images_of(
    projected: torch.Tensor, tiles: Tiles, backgrounds: torch.Tensor, settings: RenderSettings, deterministic: bool = True,
    colors: torch.Tensor | None = None,
) -> Images:  # fmt: skip
    """Return the images of binned Gaussians: in their own colours, or in channels [1, N, D] or [C, N, D] of ``colors``."""
    named = {"deterministic": deterministic, "absgrad": settings.absgrad, **settings.of_window()}
    if colors is None:
        return blend(projected, tiles, backgrounds, **named)
    return blend_channels(projected, tiles, colors, backgrounds, **named)


def weights_of(projected: torch.Tensor, tiles: Tiles, settings: RenderSettings) -> tuple[torch.Tensor, torch.Tensor]:
    """Return sum and maximum of each Gaussian's blending weights, shape [C, N] each (`contributions`)."""
    return contributions(projected, tiles, **settings.of_window())


def median_depth_of(projected: torch.Tensor, tiles: Tiles, settings: RenderSettings) -> torch.Tensor:
    """Return the depth [u] at which transmittance falls to one half, shape [C, H, W] (`median_depth`)."""
    return median_depth(projected, tiles, **settings.of_window())


def heaviest_of(
    projected: torch.Tensor, tiles: Tiles, settings: RenderSettings, k: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return ids and weights [C, H, W, k] of the k heaviest Gaussians, and the number blended [C, H, W] (`heaviest`)."""
    return heaviest(projected, tiles, k, **settings.of_window())


@torch.no_grad()
def count_instances(inputs: ProjectInputs, settings: RenderSettings) -> torch.Tensor:
    """Return the number of (Gaussian, tile) instances of a render, int64, shape []."""
    return project_inputs(inputs, settings.projection())[1].sum()


def composite_into(
    projected: torch.Tensor, tile_counts: torch.Tensor, backgrounds: torch.Tensor, settings: RenderSettings,
    memory: InstanceMemory, save: bool = True,
) -> tuple[Tiles, Sequence[torch.Tensor]]:  # fmt: skip
    """Bin and blend [C, N, 12] without autograd, in the allocator's memory; also return the backward pass's tensors."""
    tiles = bin_projected(projected, tile_counts, settings, memory, save)
    found = blending.composite(projected, tiles, backgrounds, settings.blending(), save=save, allocator=memory.allocator)
    return tiles, found
