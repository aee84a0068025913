"""The rasterizer: `rasterize` checks what it is given, renders it, and `select_rule` measures its rules."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from numbers import Real
from typing import Any, overload

import numpy as np
import torch
from torch import Tensor

from warpgs.constants import K_TOLERANCE, POSE_TOLERANCE
from warpgs.device import free_for
from warpgs.errors import ResourceError, UsageError, expect, explained
from warpgs.kernels import launch
from warpgs.kernels.blend import blend
from warpgs.kernels.blend_cuda import image_tile
from warpgs.kernels.cameras import check_camera
from warpgs.kernels.ellipse import ProjectInputs
from warpgs.kernels.falloff import WIDTHS, Pass
from warpgs.kernels.project import project_inputs
from warpgs.kernels.tiles import BYTES_PER_INSTANCE, InstanceMemory, bin_tiles, grid
from warpgs.means2d import count_passes
from warpgs.render import compose, graphed
from warpgs.render.chunked import blend_chunked, further_chunked
from warpgs.render.options import RasterizeOptions
from warpgs.scene import ActivatedGaussians, Camera, CovarianceGaussians, Gaussians, RasterizedGaussians, Render

Window = tuple[int, int, int, int]
"""Left, top, width and height [px]."""

# Checks of the arrays of a camera. Values on a GPU are not checked: reading them would wait for the device.


def check_arrays(camera: Camera) -> None:
    """Check a camera's types and shapes, and the values of its arrays in main memory."""
    for name, rows, check in (("viewmat", 4, _check_pose), ("K", 3, _check_intrinsics)):
        given: Any = getattr(camera, name)
        _check_type(name, given)
        if given.ndim not in (2, 3) or tuple(given.shape[-2:]) != (rows, rows):
            raise ValueError(f"camera.{name} must have shape [{rows}, {rows}] or [C, {rows}, {rows}], not {list(given.shape)}")
        if getattr(given, "is_cuda", False):
            continue
        listed = given.tolist()  # Python numbers take a third of the time of tensors
        for i, matrix in enumerate(listed if given.ndim == 3 else (listed,)):
            where = f"camera.{name}[{i}]" if given.ndim == 3 else f"camera.{name}"
            if not all(math.isfinite(value) for row in matrix for value in row):
                raise ValueError(f"{where} has non-finite values: {matrix}")
            check(matrix, where)
    distortion: Any = camera.distortion
    if distortion is not None:
        _check_type("distortion", distortion)
        if distortion.ndim not in (1, 2):
            raise ValueError(f"camera.distortion must have shape [P] or [C, P], not {list(distortion.shape)}")
        if not (getattr(distortion, "is_cuda", False) or all(map(math.isfinite, distortion.reshape(-1).tolist()))):
            raise ValueError(f"camera.distortion has non-finite values: {distortion.tolist()}")
    for name in ("width", "height"):
        if not isinstance(size := getattr(camera, name), (int, np.integer)):
            raise TypeError(f"camera.{name} must be a whole number of pixels, not {size!r}")


def _check_type(name: str, array: Any) -> None:
    """Raise TypeError where a value is not a dense array of real numbers, and ValueError for a device without kernels."""
    if not isinstance(array, (np.ndarray, Tensor)):
        raise TypeError(f"camera.{name} must be a numpy array or a tensor, not {type(array).__name__}; give numpy.array(...)")
    kind = str(array.dtype).removeprefix("torch.")
    if isinstance(array, Tensor):
        launch.check_device(f"camera.{name}", array)
    if kind in ("float16", "bfloat16") or not kind.startswith(("float", "int", "uint", "bool")):
        raise TypeError(f"camera.{name} must be float32 or float64, not {array.dtype}, which would shift the image")


def _check_intrinsics(matrix: list[list[float]], where: str) -> None:
    """Raise ValueError where the intrinsics have a skew, a focal length of 0, or a wrong last row."""
    (fx, skew, _), (below, fy, _), (left, middle, last) = matrix
    if not (fx and fy):
        raise ValueError(f"{where} must have focal lengths other than 0, not {fx:g} and {fy:g}")
    if max(map(abs, (left, middle, last - 1))) > K_TOLERANCE:
        raise ValueError(f"{where} must have the last row 0, 0, 1, not {left:g}, {middle:g}, {last:g}; divide K by K[2, 2]")
    if max(abs(skew), abs(below)) > K_TOLERANCE:
        raise ValueError(f"{where} has a skew of {skew or below:g} px, which is not supported; undistort the images")


def _check_pose(matrix: list[list[float]], where: str) -> None:
    """Raise ValueError where the pose is not rigid; a reflection is allowed, since the mirrored image is correct."""
    (a, b, c, _), (d, e, f, _), (g, h, i, _), (p, q, r, s) = matrix
    if max(map(abs, (p, q, r, s - 1))) > POSE_TOLERANCE:
        raise ValueError(f"{where} must have the last row 0, 0, 0, 1, not {p:g}, {q:g}, {r:g}, {s:g}; is it transposed?")
    products = (
        a * a + b * b + c * c - 1, d * d + e * e + f * f - 1, g * g + h * h + i * i - 1,
        a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i,
    )  # fmt: skip
    off = max(map(abs, products))
    if not off <= POSE_TOLERANCE:  # products of huge numbers overflow
        raise ValueError(f"{where} scales or shears: R R^T is off by {off:.2g} from the identity; divide its rows by the scale")


INTEGERS = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)
"""Types of pixel coordinates."""


def checked_pixels(pixels: Tensor, cameras: int, device: torch.device) -> Tensor:
    """Return pixels [P, 2] or [C, P, 2] of C cameras as int64 on a device, shape [1, P, 2] or [C, P, 2]."""
    if not isinstance(pixels, Tensor) or pixels.dtype not in INTEGERS:
        raise TypeError(f"pixels must be a tensor of integers, columns and rows, not {getattr(pixels, 'dtype', type(pixels))}")
    launch.check_device("pixels", pixels)
    if pixels.ndim not in (2, 3) or pixels.shape[-1] != 2 or (pixels.ndim == 3 and len(pixels) != cameras):
        raise ValueError(f"pixels must have shape [P, 2] or [{cameras}, P, 2], not {list(pixels.shape)}")
    found = pixels.to(device, torch.int64)
    return found if found.ndim == 3 else found[None]


def window_of(pixels: Tensor, camera: Camera, tile_size: int) -> Window:
    """Return the smallest window of whole tiles that holds pixels [..., P, 2]; the pixels are read from the device."""
    if not pixels.shape[-2]:
        return 0, 0, min(tile_size, camera.width), min(tile_size, camera.height)
    flat = pixels.reshape(-1, 2)
    (left, top), (right, bottom) = torch.stack([flat.amin(0), flat.amax(0)]).tolist()
    if left < 0 or top < 0 or right >= camera.width or bottom >= camera.height:
        raise ValueError(f"pixels in columns {left}-{right}, rows {top}-{bottom} leave the {camera.width} x {camera.height} px")
    x, y = left // tile_size * tile_size, top // tile_size * tile_size
    width = min((right // tile_size + 1) * tile_size, camera.width) - x
    return x, y, width, min((bottom // tile_size + 1) * tile_size, camera.height) - y


def listed_tiles(pixels: Tensor, settings: Pass, cameras: int) -> Tensor:
    """Return a mask [T] over the tiles of C cameras, for `bin_tiles`: True where one of ``pixels`` [1 or C, P, 2] is inside."""
    (x, y, width, height), size = settings.window, settings.tile_size
    columns, rows = grid(width, height, size)
    places = (pixels[..., 1] - y) // size * columns + (pixels[..., 0] - x) // size  # windows begin at edges of tiles
    places = places + columns * rows * torch.arange(cameras, device=pixels.device)[:, None]
    listed = torch.zeros(cameras * columns * rows, dtype=torch.bool, device=pixels.device)
    listed[places.reshape(-1)] = True
    return listed


def at_pixels(image: Tensor, pixels: Tensor, window: Window) -> Tensor:
    """Read a window's images [C, H, W, ...] at pixels [1, P, 2] or [C, P, 2]; return values [C, P, ...]. Differentiable."""
    cameras = torch.arange(len(image), device=image.device)[:, None]
    return image[cameras, pixels[..., 1] - window[1], pixels[..., 0] - window[0]]


BOUND_ROUNDING = 2.0**-29
"""Largest rounding error of a float64 render, as a fraction of the largest colour. A relative error e of every alpha changes a
colour by at most 2 e: alpha shifts weight between its own colour and the colours behind, and the weights sum to 1. float64
rounds 2^29 times finer than float32, so e is at most 2^-30 if the relative error of a float32 alpha is at most 1/2."""


WITHOUT_GRADIENT = ("weight_sums", "weight_maxima", "median_depth", "heaviest_weights", "error_bound")
"""Real-valued outputs without a gradient: a backward pass through them raises an error."""

WHOLE = ("weight_sums", "weight_maxima", "overflow")
"""Further outputs that are not images: they have one entry for each Gaussian, or a single one."""

ARGUMENTS = ((Gaussians, ActivatedGaussians, CovarianceGaussians), (Camera,), (RasterizeOptions,))
"""Types of the arguments of `rasterize`."""


def _check_arguments(gaussians: RasterizedGaussians, camera: Camera, options: RasterizeOptions) -> None:
    """Check types, the camera's arrays, and the shape of ``sh``; non-finite Gaussians are culled, not rejected."""
    for name, given, kinds in zip(("gaussians", "camera", "options"), (gaussians, camera, options), ARGUMENTS, strict=True):
        if not isinstance(given, kinds):
            listed = isinstance(given, (list, tuple))
            order = f"a list of {name} requires a list of cameras" if listed else "call rasterize(gaussians, camera, options)"
            wanted = " or ".join(", ".join(kind.__name__ for kind in kinds).rsplit(", ", 1))
            raise TypeError(f"{name} must be an instance of {wanted}, not {type(given).__name__}; {order}")
    if gaussians.sh is None and options.colors is None:
        raise UsageError("gaussians have no sh: give sh=..., or RasterizeOptions(colors=...)")
    _check_tensor("means", gaussians.means)  # first, since missing harmonics are made like the means
    for name, tensor in gaussians.tensors().items():
        _check_tensor(name, tensor)
    check_arrays(camera)
    sh = gaussians.tensors()["sh"]
    if sh.ndim != 3 or sh.shape[1] != (gaussians.sh_degree + 1) ** 2:
        raise ValueError(f"sh must have shape [N, K, 3], where K is 1, 4, 9, 16 or 25, not {list(sh.shape)}")
    _check_activated(gaussians)


_LOOKED_AT: set[torch.device] = set()
"""CUDA devices on which Gaussians were rendered: values there are checked once, since reading them waits for the device."""


def _check_activated(gaussians: RasterizedGaussians) -> None:
    """Raise ValueError where opacities are logits, or scales logarithms; on CUDA only in the first call."""
    device, cuda = gaussians.means.device, gaussians.means.is_cuda
    if isinstance(gaussians, Gaussians) or device in _LOOKED_AT or (cuda and torch.cuda.is_current_stream_capturing()):
        return
    # bounds that the steps of an optimizer may cross, but hardly any model's logits and log scales keep
    logits, logs = "in [0, 1]; torch.sigmoid makes them from logits", "at least 0; torch.exp makes them from log scales"
    for name, most, fix in (("opacities", 2.0, logits), ("scales", math.inf, logs)):
        values = getattr(gaussians, name, gaussians.means[:0])
        if values.numel() and values.is_floating_point():
            low, high = map(float, values.detach().aminmax())
            if -math.inf < low < -1 or most < high < math.inf:
                raise ValueError(f"{name} are from {low:.3g} to {high:.3g}, but must be {fix}")
    if cuda:
        _LOOKED_AT.add(device)


def _check_tensor(name: str, value: Any) -> None:
    """Raise TypeError where a value is not a tensor, and ValueError for a device without kernels."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a tensor, not {type(value).__name__}; torch.as_tensor makes one")
    launch.check_device(name, value)


def _checked_window(camera: Camera, options: RasterizeOptions) -> Window:
    """Return the part to render; UsageError where its edges do not fit the image and its tiles."""
    width, height, side = camera.width, camera.height, options.tile_size
    if options.window is None:
        return 0, 0, width, height
    x, y, w, h = options.window
    inside = 0 <= x < x + w <= width and 0 <= y < y + h <= height
    if not inside or x % side or y % side or ((x + w) % side and x + w != width) or ((y + h) % side and y + h != height):
        raise UsageError(f"window {options.window}: edges must be multiples of {side} px, or edges of the image")
    return x, y, w, h


def _checked_channels(name: str, values: Tensor | None, inputs: ProjectInputs) -> Tensor | None:
    """Return channels, given as [N, D] or [C, N, D], in shape [1, N, D] or [C, N, D]."""
    if values is None:
        return None
    pattern = "C N D" if isinstance(values, Tensor) and values.ndim == 3 else "N D"
    if pattern == "C N D" and name == "colors" and len(values) == len(inputs.means) != len(inputs.viewmats):
        found = list(values.shape)
        raise ValueError(f"colors {found} are neither [N, D] nor [C, N, D]; harmonics need sh_degree, or Gaussians with sh")
    launch.check(means=(inputs.means, "N 3"), viewmats=(inputs.viewmats, "C 4 4"), **{name: (values, pattern)})
    if values.shape[-1] == 0:
        raise ValueError(f"{name} must have at least one channel, not shape {list(values.shape)}")
    return values if values.ndim == 3 else values[None]


def _check_memory(window: Window, layers: "list[Layer]", heaviest: int, like: Tensor) -> None:
    """Raise ResourceError where the images [C, H, W, D] of the layers need more memory than the device of ``like`` has free."""
    # and alpha, depth, transmittance, sum of weights
    channels = sum(backgrounds.shape[1] + 4 for _, backgrounds in layers) + 2 * heaviest
    needed = len(layers[0][1]) * window[2] * window[3] * channels * like.element_size()
    free = free_for(needed, like.device)
    if needed > free:
        size = f"{window[2]} x {window[3]} px need {needed:,} bytes, and {free:,} are free on {like.device}"
        raise ResourceError(f"images of {size}: render smaller images, fewer cameras at once, or a window of an image")


Layer = tuple[Tensor | None, Tensor]
"""Values that are blended into one image: channels of each Gaussian [1, N, D] or [C, N, D], None for the spherical harmonics;
and backgrounds [C, D]."""


def _as_tensor(values: Any) -> Tensor:
    """Return numbers as a tensor, where they are or on the CPU, whatever torch's default device; an array is copied."""
    values = values.copy() if isinstance(values, np.ndarray) else values
    return torch.as_tensor(values, device=getattr(values, "device", "cpu"))


def _layer(name: str, background: Any, colors: Tensor | None, inputs: ProjectInputs) -> Layer:
    """Return channels [..., D] with their background (one, a batch, or None for zeros); ``name`` is the background's option."""
    channels, like = 3 if colors is None else colors.shape[-1], inputs.viewmats
    if background is None:  # outside of the try block: a full GPU is not a wrong background
        background = like.new_zeros(channels)
    try:
        values = _as_tensor(background)
        if values.is_complex() or values.dtype == torch.uint8:
            raise TypeError(values.dtype)
    except (RuntimeError, TypeError, ValueError) as e:
        raise TypeError(f"{name} must be numbers, 1.0 for white: [{channels}] or [C, {channels}], not {background!r}") from e
    launch.check_device(name, values)
    values = values.to(like)
    if values.ndim not in (1, 2) or values.shape[-1] != channels or (values.ndim == 2 and len(values) != len(like)):
        raise ValueError(f"{name} must have shape [{channels}] or [C, {channels}], C={len(like)}, not {list(values.shape)}")
    return colors, values.expand(len(like), channels) if values.ndim == 1 else values


@overload
def rasterize(gaussians: RasterizedGaussians, camera: Camera, options: RasterizeOptions = ...) -> Render: ...
@overload
def rasterize(
    gaussians: RasterizedGaussians | Sequence[RasterizedGaussians], camera: Sequence[Camera],
    options: RasterizeOptions | Sequence[RasterizeOptions] = ...,
) -> list[Render]: ...  # fmt: skip
def rasterize(
    gaussians: RasterizedGaussians | Sequence[RasterizedGaussians], camera: Camera | Sequence[Camera],
    options: RasterizeOptions | Sequence[RasterizeOptions] = RasterizeOptions(),
) -> Render | list[Render]:  # fmt: skip
    """Render Gaussians from one camera, from each camera of a batch, or from a list of cameras one by one.

    Differentiable in the tensors of ``gaussians``, in ``camera.viewmat`` and ``camera.K`` (as tensors that require
    gradients), and in the colours, features and backgrounds of ``options``. Type (float32 or float64) and device (CPU or
    CUDA) are those of ``gaussians.means``; cameras and backgrounds are converted to them. The same inputs give the same
    bits every time, unless ``options.deterministic`` is False. There are no second derivatives, torch.func is not
    supported, and torch.compile breaks its graph here.

    Args:
        gaussians: N Gaussians, given by log scales and logits of opacities (`Gaussians`), by scales and opacities
            (`ActivatedGaussians`), or by covariances and opacities (`CovarianceGaussians`).
        camera: One camera ([4, 4], [3, 3]), or a batch of C cameras with one image size ([C, 4, 4], [C, 3, 3]). Or a list of
            cameras and batches, of any image sizes; then ``gaussians`` and ``options`` are lists of the same length, or single
            values for all cameras.
        options: Options.

    Returns:
        The images, without a leading axis for a single camera; a list of renders for a list of cameras. Read ``render.means2d``
        before the backward pass. Its ``grad`` then holds the gradients of the projected means.

    Raises:
        ResourceError: The images, or the tiles that the Gaussians touch, need more memory than is available.
        TypeError: An argument has the wrong type; or a scalar type is neither float32 nor float64, or scalar types differ.
        UsageError: The rule, the tile size or the camera model is unknown; the window cuts tiles; options exclude each other or
            are out of range; a transform of torch.func is active; or a second derivative is requested.
        ValueError: A shape is wrong, or Gaussians, colours and features are on different devices (the message names argument,
            expected and found); opacities are logits or scales logarithms (on CUDA only in the first call); the near or far
            plane is out of range; a pixel is outside the image; or lists differ in length. For cameras that are not on a GPU,
            also: an array has a non-finite number, ``K`` has a skew or a focal length of 0, ``viewmat`` scales or shears, or
            either matrix has a wrong last row.
    """
    if torch.compiler.is_dynamo_compiling():
        torch._dynamo.graph_break(msg="rasterize runs outside of compiled graphs: leave out fullgraph=True")
        eager: Render | list[Render] = torch.compiler.disable(rasterize)(gaussians, camera, options)
        return eager
    if isinstance(camera, (list, tuple)):
        each = [given if isinstance(given, (list, tuple)) else [given] * len(camera) for given in (gaussians, options)]
        for name, given in zip(("gaussians", "options"), each):
            if len(given) != len(camera):
                raise ValueError(f"{len(given)} {name} for {len(camera)} cameras: give one for all, or one for each camera")
        return [_render(*one) for one in zip(each[0], camera, each[1])]
    return _render(gaussians, camera, options)  # type: ignore[arg-type]


def _render(gaussians: RasterizedGaussians, camera: Camera, options: RasterizeOptions) -> Render:
    """Return what `rasterize` returns for one camera or a batch [C, ...] of them."""
    launch.refuse_transforms()
    _check_arguments(gaussians, camera, options)
    check_camera(camera)
    inputs = compose.inputs_of(gaussians, camera, options.opacity_factors)
    degree = gaussians.sh_degree if options.sh_degree is None else options.sh_degree
    degree = degree if options.colors is None else 0  # unused harmonics: read as few as possible
    pixels = None if options.pixels is None else checked_pixels(options.pixels, len(inputs.viewmats), inputs.means.device)
    window = _checked_window(camera, options) if pixels is None else window_of(pixels, camera, options.tile_size)
    shared = {n: getattr(options, n) for n in ("tile_size", "absgrad", "antialiased", "deterministic")}
    settings = compose.pass_of(
        camera, degree, options.cut_offs(), window=window, parameters=compose.parameters_of(gaussians), **shared
    )
    colors = _checked_channels("colors", options.colors, inputs)
    features = _checked_channels("features", options.features, inputs)
    if options.absgrad and (features is not None or (colors is not None and colors.shape[-1] > WIDTHS[-1])):
        raise UsageError(f"absgrad takes at most {WIDTHS[-1]} channels of colors and no features: render more in a second call")
    if options.max_error is not None:
        if compose.needs_slots(t for t in (*inputs, options.background) if isinstance(t, Tensor)):
            raise UsageError("max_error renders without gradients: call rasterize under torch.no_grad(), or leave it out")
        settings = replace(settings, max_error=float(options.max_error))
        if inputs.means.is_cuda and inputs.means.dtype == torch.float32:
            settings = replace(settings, tile_size=image_tile(settings))
    if inputs.means.is_cuda and options.repeatable():
        backgrounds = None if options.background is None else _layer("background", options.background, None, inputs)[1]
        gradients = compose.needs_slots((*inputs, backgrounds))
        found = graphed.recorder(inputs.means.device, gradients).render(inputs, backgrounds, settings)
        if found is not None:
            return _as_render(camera, *found)
    layers = [_layer("background", options.background, colors, inputs)]
    if features is not None:
        layers.append(_layer("feature_background", options.feature_background, features, inputs))
    _check_memory(settings.window, layers, options.heaviest, inputs.means)
    images, projected, tile_counts, maps = _rasterize(inputs, layers, settings, options, pixels)
    if pixels is not None:
        images = tuple(at_pixels(image, pixels, window) for image in images)
        maps = {name: at_pixels(values, pixels, window) for name, values in maps.items()}
    count_passes(projected)
    render = _as_render(camera, images, projected, tile_counts, **maps)
    if options.error_bound:
        render = replace(render, error_bound=_error_bound(render.rgb.detach(), gaussians, camera, options))
    refusing: dict[str, Any] = {}
    for name in WITHOUT_GRADIENT:  # a gradient through an output that has none becomes an error
        if (values := getattr(render, name)) is not None:
            refusing[name] = launch.without_gradient(name, values, render.rgb if name == "error_bound" else render.projected)
    return replace(render, absgrad=bool(options.absgrad), **refusing)


@torch.no_grad()
def _error_bound(rgb: Tensor, gaussians: RasterizedGaussians, camera: Camera, options: RasterizeOptions) -> Tensor:
    """Return a bound [..., H, W] on the error of colours [..., H, W, D]; see `RasterizeOptions.error_bound`."""

    def doubled(holder: Any) -> dict[str, Any]:
        values = {f.name: getattr(holder, f.name) for f in fields(holder)}
        return {n: v.double() if isinstance(v, Tensor) and v.is_floating_point() else v for n, v in values.items()}

    only_rgb: dict[str, Any] = {"features": None, "feature_background": None, "contributions": False, "median_depth": False}
    only_rgb |= {"heaviest": 0, "absgrad": False}
    reference = RasterizeOptions(**doubled(options) | only_rgb | {"rule": "exact", "error_bound": False, "record": False})
    found = rasterize(type(gaussians)(**doubled(gaussians)), Camera(**doubled(camera)), reference)
    colors = found.projected[..., 6:9] if reference.colors is None else reference.colors
    background = found.rgb.new_zeros(1) if reference.background is None else _as_tensor(reference.background).to(found.rgb)
    largest = torch.cat([colors.reshape(-1), background.reshape(-1)]).abs().amax()
    bound = (rgb - found.rgb).abs().amax(-1) + BOUND_ROUNDING * largest
    return torch.nextafter(bound.to(rgb.dtype), torch.full_like(bound, torch.inf, dtype=rgb.dtype))


def _rasterize(
    inputs: ProjectInputs, layers: list[Layer], settings: Pass, options: RasterizeOptions, pixels: Tensor | None
) -> tuple[Any, ...]:
    """Return images, projected Gaussians [C, N, 12], tile counts [C, N], and the further fields of `Render` by name."""
    projected, tile_counts = project_inputs(inputs, settings)
    further = options.contributions, options.median_depth, options.heaviest
    most, budget = options.max_instances, options.memory_budget
    if most is not None and budget is not None:
        most = min(most, budget // BYTES_PER_INSTANCE)
    if most is not None and int(tile_counts.sum()) > most:
        memory, own = InstanceMemory(budget), inputs.detached()
        images = [blend_chunked(projected, behind, colors, settings, most, memory, *own) for colors, behind in layers]
        maps = further_chunked(projected, settings, most, own, memory, *further) if any(further) else {}
    else:
        overflow = None if options.capacity is None else torch.zeros(1, dtype=torch.int32, device=projected.device)
        memory = InstanceMemory(budget, options.capacity, overflow)
        slotted = options.contributions or compose.needs_slots([projected, *(t for layer in layers for t in layer)])
        listed = None if pixels is None else listed_tiles(pixels, settings, len(projected))
        tiles = bin_tiles(projected, tile_counts, settings, memory, slotted, listed)
        images = [blend(projected, tiles, backgrounds, settings, colors) for colors, backgrounds in layers]
        maps = compose.further_of(projected, tiles, settings, *further)
        if overflow is not None:
            maps["overflow"] = overflow
    if len(images) > 1:
        maps["features"] = images[1][0]
    return images[0], projected, tile_counts, maps


def _as_render(camera: Camera, images: Sequence[Tensor], projected: Tensor, tile_counts: Tensor, **maps: Any) -> Render:
    """Return the render, with images [C, H, W, ...] that have no leading axis for a single camera."""
    if len(camera.viewmat.shape) == 2:  # not image[0], whose gradient would be a copy among zeros
        images = [image.squeeze(0) for image in images]
        maps = {name: values if name in WHOLE else values.squeeze(0) for name, values in maps.items()}
    rgb, alpha, depth, *bounds = images
    if bounds:
        maps["error_bound"] = bounds[0][..., None, None].expand_as(alpha)
    return Render(rgb, alpha, depth, projected, tile_counts, **maps)


FASTEST_FIRST = ("fast", "balanced", "exact")
"""Rules to choose from; each skips all that the next one skips, and more."""
DEFAULTS = RasterizeOptions()
"""Default options."""
MEASURES: dict[str, Callable[[Tensor], Tensor]] = {"mean": torch.mean, "max": torch.amax}
"""Reductions over the pixels of a view, by name."""


@torch.no_grad()
def select_rule(
    gaussians: Gaussians, cameras: Iterable[Camera], *, max_error: float, measure: str = "mean",
    options: RasterizeOptions = DEFAULTS,
) -> tuple[str, float]:  # fmt: skip
    """Return the fastest of the rules `fast`, `balanced` and `exact` whose error is at most ``max_error`` in every given view.

    Each view is rendered with `RasterizeOptions.error_bound`, so the limit covers cut-offs and float32, and holds only for
    these Gaussians, cameras and options. Each view takes up to three renders in float32 and three in float64.

    Args:
        gaussians: The scene, N Gaussians.
        cameras: Views to measure.
        max_error: Largest error against rule `exact`, in units of the colours, usually [0, 1].
        measure: ``mean`` or ``max`` over the pixels of a view; the error of a pixel is the largest of its channels.
        options: Options of the renders, such as the background; their rule is not used.

    Returns:
        The name of the rule, and its largest measured error over the views.

    Raises:
        UsageError: No rule keeps the limit, ``cameras`` is empty or a single camera, ``max_error`` is not a positive number, or
            the measure is unknown.
    """
    with explained("select_rule cannot choose", "correct this argument", ValueError, UsageError):
        positive = isinstance(max_error, Real) and 0 < max_error < math.inf
        expect(positive, f"max_error must be a positive number, such as 0.002, not {max_error!r}")
        expect(measure in MEASURES, f"measure {measure!r} is not one of {', '.join(MEASURES)}")
        views, error = [] if isinstance(cameras, Camera) else list(cameras), 0.0
        expect(views, "give a list of at least one camera: [camera]")
    for rule in FASTEST_FIRST:
        error, own = 0.0, replace(options, rule=rule, error_bound=True)
        for camera in views:
            bound = rasterize(gaussians, camera, own).error_bound
            assert bound is not None
            error = max(error, float(MEASURES[measure](bound)))
            if error > max_error:
                break
        else:
            return rule, error
    raise UsageError(f"rounding alone gives a {measure} error of {error:.1e}; raise max_error, or give Gaussians as float64")
