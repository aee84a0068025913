"""gsplat 1.6.0's `rasterization` and what its callers need, on our rasterizer: change `gsplat` to `warpgs.compat.gsplat`."""

import enum
import functools
from collections import UserDict
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from warpgs.constants import TILE_SIZE, rule_named
from warpgs.errors import UsageError
from warpgs.geometry import rotation_matrices
from warpgs.kernels.project import project_inputs
from warpgs.kernels.sh import basis, coefficient_count
from warpgs.kernels.tiles import bin_tiles, grid
from warpgs.means2d import projected_means
from warpgs.render.compose import inputs_of, parameters_of
from warpgs.render.options import RasterizeOptions, image_settings
from warpgs.render.rasterize import rasterize
from warpgs.scene import ActivatedGaussians, Camera, CovarianceGaussians, RasterizedGaussians, Render


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__


class UnsupportedError(UsageError, NotImplementedError, ValueError):
    """An argument of gsplat that the rasterizer lacks; a RuntimeError and a ValueError, since gsplat raises either."""


class RollingShutterType(enum.IntEnum):
    """Order in which a camera exposes its pixels; only ``GLOBAL`` is supported."""

    ROLLING_TOP_TO_BOTTOM = 0
    ROLLING_LEFT_TO_RIGHT = 1
    ROLLING_BOTTOM_TO_TOP = 2
    ROLLING_RIGHT_TO_LEFT = 3
    GLOBAL = 4


class RendererConfig:
    """Base class of gsplat's choices of kernels."""

    def __init__(self) -> None:
        """Raise TypeError for the base class itself, as gsplat's own test wants it."""
        if type(self) is RendererConfig:
            raise TypeError("RendererConfig is a base class: use RendererConfig_MixedBatch()")


class RendererConfig_MixedBatch(RendererConfig):
    """gsplat's default, which changes nothing here."""


class RendererConfig_ParallelBatch(RendererConfig):
    """A choice for ``with_eval3d=True``, so not supported."""


MODELS = {"pinhole": "pinhole", "ortho": "orthographic", "fisheye": "fisheye"}
"""Our camera models by gsplat's names."""
CHOICES = {
    "camera_model": tuple(MODELS),
    "render_mode": ("RGB", "D", "ED", "RGB+D", "RGB+ED"),
    "rasterize_mode": ("classic", "antialiased"),
}
"""Supported values of arguments."""
MISSING = {
    "gradients are dense": ("sparse_grad",),
    "a call renders in one process; several GPUs can divide the views": ("distributed",),
    "Gaussians are projected by the Jacobian, and evaluated in the image": ("with_ut", "with_eval3d"),
    "give warpgs.gaussian_normals as extra_signals": ("return_normals",),
    "a camera has a pose and a lens; lidar coefficients and rays do not apply": ("lidar_coeffs", "rays"),
    "lenses have radial and tangential coefficients": ("thin_prism_coeffs", "ftheta_coeffs"),
    "it needs with_ut=True, which is missing, too": ("external_distortion_coeffs",),
    "an image has one pose; rolling shutter is not modelled": ("rolling_shutter", "viewmats_rs"),
}
"""Why arguments are missing, or what to use; None, False and `RollingShutterType.GLOBAL` are accepted."""


def _check_arguments(arguments: dict[str, Any]) -> None:
    """Raise UnsupportedError with name and reason of all arguments without a meaning here; ValueError for missing colours."""
    refused = {}
    for why, names in MISSING.items():
        for name in names:
            value = arguments[name]
            if not (value is None or value is False or (name == "rolling_shutter" and value == RollingShutterType.GLOBAL)):
                refused[f"{name}={value}" if isinstance(value, (bool, enum.Enum)) else name] = why
    for name, known in CHOICES.items():
        if arguments[name] not in known:
            refused[f"{name}={arguments[name]!r}"] = f"it must be one of {', '.join(known)}"
    config, model = arguments["renderer_config"], arguments["camera_model"]
    kinds = [kind.__name__ for kind in type(config).__mro__]  # by name: gsplat's own classes are accepted, too
    if config is not None and "RendererConfig" not in kinds:
        raise TypeError(f"renderer_config must be RendererConfig_MixedBatch() or None, not {config!r}")
    if config is not None and "RendererConfig_MixedBatch" not in kinds:
        refused[f"renderer_config={kinds[0]}"] = "all but RendererConfig_MixedBatch are for with_eval3d=True"
    if not arguments["global_z_order"] and model != "fisheye":
        refused["global_z_order=False"] = "only fisheyes are sorted by distance"
    if arguments["global_z_order"] and model == "fisheye" and arguments["render_mode"] != "RGB":
        refused["global_z_order=True"] = "depths of fisheyes are distances; give global_z_order=False, or z as extra_signals"
    for name, models in (("radial_coeffs", ("pinhole", "fisheye")), ("tangential_coeffs", ("pinhole",))):
        if arguments[name] is not None and model not in models:
            refused[f"{name} with camera_model={model!r}"] = "this lens has no such coefficients"
    if refused:
        raise UnsupportedError("\n".join(f"warpgs does not support {name}: {why}" for name, why in refused.items()))
    if arguments["colors"] is None and "RGB" in (mode := arguments["render_mode"]):
        raise ValueError(f"colors must be given in render_mode {mode!r}: only D and ED have none")
    if name := next((name for name, value in arguments.items() if isinstance(value, np.ndarray)), ""):
        raise TypeError(f"{name} must be a tensor, not an array; torch.as_tensor({name}) makes one")
    if (poses := arguments["viewmats"]).ndim < 3 or poses.shape[-2:] != (4, 4):
        raise ValueError(f"viewmats must have shape [..., C, 4, 4], not {list(poses.shape)}; viewmats[None] is one camera")


def _lens(model: str, radial: Tensor | None, tangential: Tensor | None, poses: Tensor) -> tuple[str, Tensor | None]:
    """Return model and distortion [..., C, P] of a `Camera` with ``poses`` [..., C, 4, 4]."""
    if model == "fisheye":
        return model, poses.new_zeros(*poses.shape[:-2], 4) if radial is None else radial
    if radial is None and tangential is None:
        return MODELS[model], None
    radial = poses.new_zeros(*poses.shape[:-2], 6) if radial is None else radial
    tangential = poses.new_zeros(*poses.shape[:-2], 2) if tangential is None else tangential
    return "opencv", torch.cat([radial[..., :2], tangential, radial[..., 2:]], -1)


def _channels(
    means: Tensor, viewmats: Tensor, colors: Tensor | None, degree: int | None, backgrounds: Tensor | None,
    features: Tensor | None, features_degree: int | None,
) -> tuple[Tensor | None, Tensor | None, int | None, Tensor | None, Tensor | None, Tensor | None]:  # fmt: skip
    """Return harmonics or colours, the degree of harmonics, backgrounds, features and their backgrounds, for our rasterizer."""
    harmonics, behind = None, None
    assert colors is not None  # `_check_arguments` has refused it
    if features is not None and backgrounds is not None and backgrounds.shape[-1] > (count := colors.shape[-1]):
        backgrounds, behind = backgrounds[..., :count], backgrounds[..., count:]
    if degree is not None and colors.shape[-1] == 3:
        harmonics, colors = colors[:, : coefficient_count(degree)], None
    elif degree is not None:
        colors, degree = (spherical_harmonics(degree, means, viewmats, colors) + 0.5).clamp_min(0), None
    if features is not None and features_degree is not None:
        features = spherical_harmonics(features_degree, means, viewmats, features) + 0.5
    return harmonics, colors, degree, backgrounds, features, behind


BY_VIEW = ("viewmats", "Ks", "distortion", "backgrounds")
"""Arrays of a scene with a row for each camera."""


def _part(batch: torch.Size, scene: int, views: slice, name: str, values: Tensor | None) -> Any:
    """Return the values of one of the scenes of a batch, and of some of its cameras."""
    if values is None:
        return None
    if values.shape[: len(batch)] != batch:
        raise ValueError(f"{name} must have the batch axes {list(batch)} of means, not shape {list(values.shape)}")
    values = values.flatten(0, len(batch) - 1)[scene] if batch else values
    return values[views] if name in BY_VIEW or (name in ("colors", "extra_signals") and values.ndim == 3) else values


class _Meta(UserDict[str, Any]):
    """A dictionary. A value that is a function is computed when it is first read."""

    def __getitem__(self, name: str) -> Any:
        """Return a value."""
        self.data[name] = value() if callable(value := self.data[name]) else value
        return self.data[name]


def rasterization(
    means: Tensor, quats: Tensor | None, scales: Tensor | None, opacities: Tensor, colors: Tensor | None, viewmats: Tensor,
    Ks: Tensor, width: int, height: int, near_plane: float = 0.01, far_plane: float = 1e10, radius_clip: float = 0.0,
    eps2d: float = 0.3, sh_degree: int | None = None, packed: bool = True, tile_size: int | None = None,
    backgrounds: Tensor | None = None, render_mode: str = "RGB", sparse_grad: bool = False, absgrad: bool = False,
    rasterize_mode: str = "classic", channel_chunk: int = 32, distributed: bool = False, camera_model: str = "pinhole",
    segmented: bool = False, covars: Tensor | None = None, with_ut: bool = False, with_eval3d: bool = False,
    return_normals: bool = False, global_z_order: bool = True, rays: Tensor | None = None, radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None, thin_prism_coeffs: Tensor | None = None, ftheta_coeffs: Any = None,
    lidar_coeffs: Any = None, external_distortion_coeffs: Any = None, rolling_shutter: Any = RollingShutterType.GLOBAL,
    viewmats_rs: Tensor | None = None, ut_params: Any = None, extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None, renderer_config: Any = None,
) -> tuple[Tensor, Tensor, _Meta]:  # fmt: skip
    """Render Gaussians by the arguments of gsplat 1.6.0, in its order, with its cut-offs (rule `gsplat-1.6`).

    Shapes have the same batch axes "..." in all arguments, or none. Differentiable as `warpgs.rasterize`.

    Args:
        means: World positions [u], shape [..., N, 3].
        quats: Rotations wxyz of any length, shape [..., N, 4]; not read with ``covars``.
        scales: Standard deviations [u], shape [..., N, 3]; not read with ``covars``.
        opacities: Opacities in [0, 1], shape [..., N].
        colors: Colours, shape [..., N, D] or [..., C, N, D]; with ``sh_degree`` coefficients [N, K, D]. Not read in the modes D
            and ED.
        viewmats: Poses, camera from world, shape [..., C, 4, 4].
        Ks: Intrinsics [px], shape [..., C, 3, 3].
        width: Width of the images [px].
        height: Height of the images [px].
        near_plane: Nearest depth [u].
        far_plane: Farthest depth [u], at most 1e10.
        radius_clip: Gaussians are left out of a view if neither radius is larger [px].
        eps2d: Variance added to projected Gaussians [px^2].
        sh_degree: Degree of the spherical harmonics in ``colors``, 0 to 4; None for colours.
        packed: True for ``meta`` with one row for each visible Gaussian of a view.
        tile_size: 8 or 16 [px]; None for 16.
        backgrounds: Colours behind the Gaussians, shape [..., C, D], or [..., C, D + E] with ``extra_signals``.
        render_mode: RGB, D (sum of weighted depths), ED (mean depth), RGB+D or RGB+ED.
        sparse_grad: Not supported.
        absgrad: True for ``meta["means2d"].absgrad``, for at most 11 channels.
        rasterize_mode: classic or antialiased.
        channel_chunk: Ignored: it changes no result.
        distributed: Not supported.
        camera_model: pinhole, ortho or fisheye. Fisheyes are sorted by distance.
        segmented: Ignored: it changes no result.
        covars: Covariances [u^2] in place of ``quats`` and ``scales``, shape [..., N, 3, 3]; the upper triangle is read.
        with_ut: Not supported.
        with_eval3d: Not supported.
        return_normals: Not supported.
        global_z_order: True for depths along z. False for distances, of fisheyes only.
        rays: Not supported.
        radial_coeffs: Distortion, shape [..., C, 6], of fisheyes [..., C, 4].
        tangential_coeffs: Distortion of pinholes, shape [..., C, 2].
        thin_prism_coeffs: Not supported.
        ftheta_coeffs: Not supported.
        lidar_coeffs: Not supported.
        external_distortion_coeffs: Not supported.
        rolling_shutter: ``RollingShutterType.GLOBAL``.
        viewmats_rs: Not supported.
        ut_params: Ignored, since ``with_ut`` is not supported.
        extra_signals: Further channels, as ``colors``, of any number E; not clamped.
        extra_signals_sh_degree: Degree of spherical harmonics in ``extra_signals``; None for values.
        renderer_config: None or ``RendererConfig_MixedBatch()``.

    Returns:
        Images [..., C, H, W, D], with the depth as last channel; alphas [..., C, H, W, 1]; and ``meta`` with gsplat's keys.
        Entries of ``meta`` that take time are computed when they are read. ``means2d`` has gradients after the backward pass.

    Raises:
        UnsupportedError: An argument is not supported; the message names each one, and why.
        TypeError: An argument has the wrong type.
        UsageError: An option is out of range.
        ValueError: A shape is wrong, or a value of a camera, as in `warpgs.rasterize`.
    """
    _check_arguments(locals())
    batch, cameras = means.shape[:-2], viewmats.shape[-3]
    if "RGB" not in render_mode:
        colors, backgrounds, sh_degree = means.new_zeros(*means.shape[:-1], 1), None, None
    channels = _channels(means, viewmats, colors, sh_degree, backgrounds, extra_signals, extra_signals_sh_degree)
    harmonics, colors, sh_degree, backgrounds, features, behind = channels
    lens, distortion = _lens(camera_model, radial_coeffs, tangential_coeffs, viewmats)
    rule, size = replace(rule_named("gsplat-1.6"), low_pass=eps2d), TILE_SIZE if tile_size is None else tile_size
    # an opacity factor holds for all cameras of a call, so a clip needs a call for each camera
    views = [slice(c, c + 1) for c in range(cameras)] if radius_clip > 0 else [slice(None)]
    kind: Any = ActivatedGaussians if covars is None else CovarianceGaussians
    # the upper triangle of covariances alone is read, and has the whole gradient
    form = {"quats": quats, "scales": scales} if covars is None else {"covars": covars.triu() + covars.triu(1).mT}
    renders = []
    for scene, view in [(scene, view) for scene in range(batch.numel()) for view in views]:
        of = functools.partial(_part, batch, scene, view)
        shape = {name: of(name, values) for name, values in form.items()}
        gaussians = kind(means=of("means", means), opacities=of("opacities", opacities), sh=harmonics, **shape)
        camera = Camera(of("viewmats", viewmats), of("Ks", Ks), width, height, lens, of("distortion", distortion))
        options = RasterizeOptions(
            rule=rule, near=near_plane, far=far_plane, sh_degree=sh_degree, tile_size=size, absgrad=absgrad,
            colors=of("colors", colors), background=of("backgrounds", backgrounds), features=of("extra_signals", features),
            feature_background=of("backgrounds", behind), antialiased=rasterize_mode == "antialiased",
        )  # fmt: skip
        if radius_clip > 0:
            options = replace(options, opacity_factors=_above(radius_clip, gaussians, camera, options))
        renders.append(rasterize(gaussians, camera, options))

    sizes = *batch, cameras, height, width
    alphas = _joined(renders, "alpha").reshape(*sizes, 1)
    images = [_joined(renders, "rgb").reshape(*sizes, -1)] if "RGB" in render_mode else []
    if render_mode != "RGB":
        depths = _joined(renders, "depth").reshape(*sizes, 1)
        images.append(depths if "ED" in render_mode else depths * alphas)
    meta = _meta(renders, camera, options, (*batch, cameras), packed)
    if features is not None:
        meta["render_extra_signals"] = _joined(renders, "features").reshape(*sizes, -1)
    if camera_model == "fisheye" and global_z_order:
        del meta["depths"]  # the rasterizer has distances
    return torch.cat(images, -1), alphas.clone(), meta  # copies, which may be edited in place


def _above(radius: float, gaussians: RasterizedGaussians, camera: Camera, options: RasterizeOptions) -> Tensor:
    """Return 1 for each Gaussian [N] with a radius above the given one in the single view of a camera [px], else 0."""
    settings = replace(image_settings(camera, 0, options), parameters=parameters_of(gaussians))
    projected, _ = project_inputs(inputs_of(gaussians, camera), settings)
    return (_radii(projected)[0] > radius).any(-1).to(projected.dtype)


def _radii(projected: Tensor) -> Tensor:
    """Return half the sides [px] of the boxes of projected Gaussians [C, N, 12], int32 [C, N, 2]; 0 if culled."""
    return projected.detach()[..., 10:12].ceil().clamp_max(2**30).int()


def _joined(renders: list[Render], name: str) -> Tensor:
    """Return a field [C, ...] of all renders."""
    values = [getattr(render, name) for render in renders]
    return values[0] if len(values) == 1 else torch.cat(values)


def _meta(renders: list[Render], camera: Camera, options: RasterizeOptions, views: tuple[int, ...], packed: bool) -> _Meta:
    """Return ``meta`` of `rasterization` for views [..., C]."""
    projected, counts = _joined(renders, "projected"), _joined(renders, "tile_counts")
    radii, count, (columns, rows) = _radii(projected), counts.shape[1], grid(camera.width, camera.height, options.tile_size)
    visible = (radii > 0).all(-1).flatten().nonzero().squeeze(1) if packed else None

    def of_each(values: Tensor) -> Tensor:
        """Return values [views, N, ...] by views and Gaussians, or one row for each visible Gaussian of a view."""
        return values.reshape(*views, *values.shape[1:]) if visible is None else values.flatten(0, 1)[visible]

    def conics() -> Tensor:
        xx, xy, yy = projected[..., 2:5].unbind(-1)
        return of_each(torch.stack([xx * xx, xx * xy, xy * xy + yy * yy], -1))

    @functools.cache
    def instances() -> tuple[Tensor, Tensor, Tensor]:
        """Return keys (view, tile, bits of the depth) of the instances, their Gaussians, and each tile's first instance."""
        tiles = columns * rows
        binned = bin_tiles(projected, counts, image_settings(camera, 0, options), slotted=False)
        used = binned.tile_ids < tiles * len(projected)
        ids, owners = binned.tile_ids[used].long(), binned.gaussian_ids[used].long()
        bits = projected.detach()[..., 9].flatten()[owners].float().view(torch.int32)
        keys = (ids // tiles << (tiles - 1).bit_length() | ids % tiles) << 32 | bits.long()
        starts = torch.searchsorted(ids, torch.arange(tiles * len(projected), device=ids.device))
        owners = owners if visible is None else torch.searchsorted(visible, owners)
        return keys, owners.int(), starts.int().reshape(*views, rows, columns)

    return _Meta(
        batch_ids=None if visible is None else visible // (count * views[-1]),
        camera_ids=None if visible is None else visible // count % views[-1],
        gaussian_ids=None if visible is None else visible % count,
        radii=of_each(radii), conics=conics, depths=lambda: of_each(projected[..., 9]),
        means2d=projected_means([render.projected for render in renders], options.absgrad, of_each),
        opacities=lambda: of_each(projected[..., 5]), tiles_per_gauss=lambda: of_each(counts),
        isect_ids=lambda: instances()[0], flatten_ids=lambda: instances()[1], isect_offsets=lambda: instances()[2],
        tile_width=columns, tile_height=rows, tile_size=options.tile_size, width=camera.width, height=camera.height,
        n_batches=len(projected) // views[-1], n_cameras=views[-1],
    )  # fmt: skip


def spherical_harmonics(
    degrees_to_use: int, means: Tensor, viewmats: Tensor, coeffs: Tensor, masks: Tensor | None = None,
    batch_ids: Tensor | None = None, camera_ids: Tensor | None = None, gaussian_ids: Tensor | None = None,
    viewmats_rs: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Return spherical harmonics of Gaussians in the directions in which cameras see them, by the arguments of gsplat 1.6.0.

    Differentiable in means, poses and coefficients.

    Args:
        degrees_to_use: Degree, 0 to 4.
        means: World positions [u], shape [..., N, 3].
        viewmats: Poses, camera from world, shape [..., C, 4, 4].
        coeffs: Coefficients, shape [N, K, D] of any D; of packed rows [R, K, D].
        masks: False where the result is 0, shape [..., C, N] or [R]; None for True.
        batch_ids: Flat batch index of each packed row [R]; None for 0.
        camera_ids: Camera of each packed row [R].
        gaussian_ids: Gaussian of each packed row [R]; None for all Gaussians in all cameras.
        viewmats_rs: Further poses; the camera is then half way between both.

    Returns:
        Values [..., C, N, D], or [R, D] of packed rows. No 0.5 is added.

    Raises:
        ValueError: The degree is not 0 to 4, or there are fewer coefficients.
    """
    used = coefficient_count(degrees_to_use)
    if coeffs.shape[-2] < used:
        raise ValueError(f"coeffs must have at least {used} rows for degree {degrees_to_use}, not shape {list(coeffs.shape)}")
    poses = [viewmats] if viewmats_rs is None else [viewmats, viewmats_rs]
    centers = torch.stack([-(pose[..., :3, :3].mT @ pose[..., :3, 3:]).squeeze(-1) for pose in poses]).mean(0)
    if gaussian_ids is None:
        rays = means[..., None, :, :] - centers[..., None, :]
    else:
        scene = torch.zeros_like(gaussian_ids) if batch_ids is None else batch_ids
        places, eyes = (t.reshape(-1, *t.shape[-2:]) for t in (means, centers))
        rays = places[scene, gaussian_ids] - eyes[scene, camera_ids]
    values = torch.einsum("...nk,nkd->...nd", basis(torch.nn.functional.normalize(rays, dim=-1))[..., :used], coeffs[:, :used])
    return values if masks is None else values * masks[..., None]


def quat_to_rotmat(quats: Tensor) -> Tensor:
    """Return rotation matrices [..., 3, 3] of quaternions wxyz of any length, shape [..., 4]. Differentiable.

    Args:
        quats: Quaternions, shape [..., 4].

    Returns:
        Rotation matrices, shape [..., 3, 3].
    """
    return torch.as_tensor(rotation_matrices(torch.nn.functional.normalize(quats, dim=-1)))


__all__ = [name for name in sorted(globals()) if name[0] != "_" and getattr(globals()[name], "__module__", "") == __name__]
