"""diff-gaussian-rasterization's classes on our rasterizer: change `diff_gaussian_rasterization` to `warpgs.compat.inria`."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from warpgs.constants import POSE_TOLERANCE, rule_named
from warpgs.errors import UsageError
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import ActivatedGaussians, Camera, CovarianceGaussians, RasterizedGaussians

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__


RULE = rule_named("inria")
"""Cut-offs of diff-gaussian-rasterization (2023)."""
DEPTH_OF_NOTHING = 15.0
"""Median depth of pixels that are not half opaque, in the fork of Dynamic 3D Gaussians."""
PACKED = (0, 1, 2, 1, 3, 4, 2, 4, 5)
"""Place of each entry of a covariance in its packed form xx, xy, xz, yy, yz, zz."""


class GaussianRasterizationSettings(NamedTuple):
    """Camera and options of a `GaussianRasterizer`, with the field names of diff-gaussian-rasterization.

    Matrices are for row vectors, ``x @ viewmatrix``, shape [4, 4] or [1, 4, 4].
    """

    image_height: int
    """Height of the image [px]."""
    image_width: int
    """Width of the image [px]."""
    tanfovx: float
    """Tangent of half the horizontal angle of view; the focal length is ``image_width / (2 tanfovx)``."""
    tanfovy: float
    """Tangent of half the vertical angle of view."""
    bg: Tensor
    """Background colour, shape [3], or [D] for colours of D channels. Differentiable."""
    scale_modifier: float
    """Factor of ``scales``."""
    viewmatrix: Tensor
    """Transposed pose, camera from world. Differentiable."""
    projmatrix: Tensor
    """``viewmatrix`` times the transposed projection; read for the principal point."""
    sh_degree: int
    """Degree of the spherical harmonics to use, 0 to 4."""
    campos: Tensor
    """Not read: the camera centre follows from ``viewmatrix``."""
    prefiltered: bool
    """False."""
    debug: bool | None = None
    """False; None for the fork of Dynamic 3D Gaussians and SplaTAM, which does not have it."""
    antialiasing: bool | None = None
    """True for antialiased renders; None for versions before October 2024, which do not have it."""


class _Screen(torch.autograd.Function):
    """Pass on means [N, 3]; ``means2D`` gets the gradient of the projected means, the last in ``kept``, times ``half`` [px]."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, means2D: Tensor, kept: list[Tensor], half: tuple[float, float]) -> Tensor:
        """Return the means."""
        ctx.kept, ctx.half = kept, half
        return means.view_as(means)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None, None]:
        """Return the gradients of means and ``means2D``; that of the projected means was kept before this node is reached."""
        x, y = ctx.kept.pop().unbind(1)
        return gradient, torch.stack([x * ctx.half[0], y * ctx.half[1], torch.zeros_like(x)], 1), None, None


def _camera(settings: GaussianRasterizationSettings) -> Camera:
    """Return the camera of the settings; UsageError where their matrices and angles contradict each other."""
    height, width, *tangents = settings[:4]
    if (where := settings.viewmatrix.device) != settings.projmatrix.device:
        raise UsageError(f"viewmatrix is on {where}, projmatrix on {settings.projmatrix.device}; move both to the Gaussians")
    matrices = settings.viewmatrix.detach().reshape(4, 4), settings.projmatrix.detach().reshape(4, 4)
    pose, projection = torch.stack(matrices).double().cpu()  # both at once, since a GPU is waited for
    off = [float(pose[:3, 2] @ projection[:3, axis]) for axis in (0, 1)]
    lens = [[1 / tangents[0], 0, 0], [0, 1 / tangents[1], 0], [*off, 1], [0, 0, 0]]
    given = projection[:, [0, 1, 3]]  # the third column, for a depth buffer, has no meaning here
    error = (pose @ pose.new_tensor(lens) - given).abs()
    largest = given.abs().amax(1, keepdim=True).clamp_min(1e-3)  # a camera at the origin has a translation of rounding errors
    if not bool((error <= POSE_TOLERANCE * largest).all()):
        raise UsageError("projmatrix is not viewmatrix times a projection of tanfovx, tanfovy; give both matrices transposed")
    # the product of both matrices is rounded, in float32 by up to a thousandth of a pixel
    (fx, cx), (fy, cy) = ((s / (2 * t), round(s / 2 * (1 + o), 3)) for s, t, o in zip((width, height), tangents, off))
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64, device="cpu")
    return Camera(settings.viewmatrix.reshape(4, 4).T, K, width, height)


def _planes(image: Tensor) -> Tensor:
    """Return an image [H, W, D] as a copy [D, H, W], which may be edited in place."""
    return image.movedim(-1, 0).clone(memory_format=torch.contiguous_format)


class GaussianRasterizer(nn.Module):
    """Renders Gaussians by the arguments of diff-gaussian-rasterization, with its cut-offs (rule `inria`)."""

    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        """Keep the settings.

        Args:
            raster_settings: Camera and options.

        Raises:
            UsageError: ``prefiltered`` or ``debug`` is True.
        """
        super().__init__()
        if raster_settings.prefiltered:
            raise UsageError("prefiltered=True is not supported: Gaussians outside of the view are always culled; give False")
        if raster_settings.debug:
            raise UsageError("debug=True is not supported: errors name the wrong argument, and no file is written; give False")
        self.raster_settings = raster_settings

    def markVisible(self, positions: Tensor) -> Tensor:
        """Return which positions are beyond the near plane, 0.2 u.

        Args:
            positions: World positions [u], shape [N, 3].

        Returns:
            True beyond the near plane, bool, shape [N].
        """
        return self._depths(positions.detach()) > RULE.near

    def _depths(self, positions: Tensor) -> Tensor:
        """Return depths [u] along the axis of the camera, shape [N]."""
        axis = self.raster_settings.viewmatrix.reshape(4, 4)[:, 2].to(positions)
        return positions @ axis[:3] + axis[3]

    def forward(
        self, means3D: Tensor, means2D: Tensor, opacities: Tensor, shs: Tensor | None = None,
        colors_precomp: Tensor | None = None, scales: Tensor | None = None, rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        """Render Gaussians. Differentiable as `warpgs.rasterize`.

        Args:
            means3D: World positions [u], shape [N, 3].
            means2D: Of any values, shape [N, 3]. Its ``grad`` becomes the gradient of the projected means in units of half the
                image, that is times W/2 and H/2 of the gradient per px; the third column is 0.
            opacities: Opacities in [0, 1], shape [N, 1] or [N].
            shs: Spherical-harmonics coefficients, shape [N, K, 3].
            colors_precomp: Colours in place of ``shs``, shape [N, D]; not clamped.
            scales: Standard deviations [u], shape [N, 3].
            rotations: Rotations wxyz of any length, shape [N, 4].
            cov3D_precomp: Covariances xx, xy, xz, yy, yz, zz [u^2] in place of scales and rotations, shape [N, 6].

        Returns:
            Image [D, H, W], and radii [px], int32 [N], 0 where a Gaussian is culled. With settings that have ``antialiasing``
            (3DGS since October 2024), also the sum of weighted inverse depths [1/u], shape [1, H, W]. With settings that have
            neither ``antialiasing`` nor ``debug`` (the fork of Dynamic 3D Gaussians and SplaTAM), also the median depth [u],
            shape [1, H, W], without gradient; 15 where alpha is below 1/2.

        Raises:
            TypeError: An argument has the wrong type.
            UsageError: Not exactly one of ``shs`` and ``colors_precomp``, or of scales with rotations and ``cov3D_precomp``, is
                given; or the matrices contradict the angles of view.
            ValueError: A shape is wrong, as in `warpgs.rasterize`.
        """
        settings, means = self.raster_settings, means3D
        kept: list[Tensor] = []
        if (shs is None) == (colors_precomp is None):
            raise UsageError("give either shs or colors_precomp: the other must be None")
        if {scales is None, rotations is None} != {cov3D_precomp is not None}:
            raise UsageError("give either scales and rotations, or cov3D_precomp: the other must be None")
        camera = _camera(settings)
        if means2D.shape != means3D.shape:
            raise ValueError(f"means2D must have the shape of means3D, {list(means3D.shape)}, not {list(means2D.shape)}")
        if means2D.requires_grad:
            means = _Screen.apply(means3D, means2D, kept, (camera.width / 2, camera.height / 2))  # type: ignore[no-untyped-call]
        gaussians: RasterizedGaussians
        if cov3D_precomp is not None:
            gaussians = CovarianceGaussians(means, cov3D_precomp[:, PACKED].reshape(-1, 3, 3), opacities.reshape(-1), shs)
        else:
            assert scales is not None and rotations is not None  # checked above
            scales = scales if settings.scale_modifier == 1 else scales * settings.scale_modifier
            gaussians = ActivatedGaussians(means, rotations, scales, opacities.reshape(-1), shs)
        inverse, median = settings.antialiasing is not None, settings.antialiasing is None and settings.debug is None
        options = RasterizeOptions(
            rule=RULE, sh_degree=None if shs is None else settings.sh_degree, background=settings.bg, colors=colors_precomp,
            antialiased=bool(settings.antialiasing), median_depth=median,
            features=1 / self._depths(means3D).clamp_min(RULE.near)[:, None] if inverse else None,
        )  # fmt: skip
        render = rasterize(gaussians, camera, options)
        if render.projected.requires_grad:
            render.projected.register_hook(lambda gradient: kept.append(gradient[0, :, :2]))
        results = _planes(render.rgb), render.projected.detach()[0, :, 10].clamp_max(2**30).int()
        if render.features is not None:
            return *results, _planes(render.features)
        if render.median_depth is not None:
            depths = render.median_depth.detach()[None]
            return *results, torch.where(depths > 0, depths, DEPTH_OF_NOTHING)
        return results
