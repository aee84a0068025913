"""View modules: they learn parameters of each training view together with the Gaussians."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np
import torch

from warpgs.device import FLOAT, LOSS, PROJECTION, Needs, StepSizes
from warpgs.errors import UsageError, listed
from warpgs.geometry import matmul, nearest_rotation, pose_at
from warpgs.kernels.launch import first_order
from warpgs.pipeline.metrics.scores import MATCHED_RULE, matched_psnr, render_view
from warpgs.pipeline.train.schedule import LearningRate, log_linear
from warpgs.plugins import Registry
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Camera, Gaussians, Tensors, View
from warpgs.schema import Checked, Within

Cameras = Mapping[str, Camera]
"""Cameras by the names of their views."""
CAMERA_BYTES = 4 * (16 + 9)
"""Bytes per Gaussian if cameras are learned: its part of the gradients of view matrix and intrinsics, before the sum over
Gaussians."""


@dataclass(frozen=True)
class FittedViews:
    """A finished fit, for `ViewModule.figures`."""

    params: Tensors
    """Parameters of the module, by name, shape [V, ...]."""
    train: tuple[str, ...]
    """Names of the training views, in the order of their parameters."""
    test: Sequence[View]
    """Held-out views, with their cameras after the fit."""
    given: Cameras
    """Camera of each view before the fit, in scene units [u], by name."""
    cameras: Cameras
    """Camera of each view after the fit, in scene units [u], by name."""
    scale: float
    """Scene units per unit of the scene's files."""
    gaussians: Gaussians
    """The fitted model."""
    options: RasterizeOptions
    """Options for rendering the model."""


@dataclass(frozen=True)
class ViewModule(Checked):
    """Parameters of each training view that a fit learns together with the Gaussians.

    To write a module, derive a frozen dataclass; its fields are its settings.

    The parameters have a row for each training view. Dense Adam updates them, as in `torch.optim.Adam`: a step has gradients
    only in the rows of its own views, and the other rows move by their decaying momentum. Checkpoints store parameters and
    moments; a module has no other state.

    `values`, `before_render`, `after_render` and `regularisation` are part of the captured step: they must not read back
    from the device, and their tensors must have the same shapes at each call.
    """

    name: ClassVar[str] = ""
    """Name in the registry."""

    def check(self, views: Sequence[View]) -> None:
        """Check at the start of a fit that the training views can have the parameters.

        Raises:
            UsageError: The training views cannot have the parameters.
        """

    def parameters(self, views: Sequence[View]) -> dict[str, torch.Tensor]:
        """Return the parameters before the first step, by name, float32, shape [V, ...]: a row for each training view.

        No two modules of a fit may use the same parameter name.
        """
        return {}

    def lrs(self, progress: float, extent: float) -> dict[str, float]:
        """Return the learning rate of each parameter by name.

        Args:
            progress: Fraction of the fit that is done, in [0, 1].
            extent: Size of the scene [u].
        """
        return {}

    def values(self, params: Tensors, numbers: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the values of some views for `before_render` and `after_render`: by default their rows; differentiable.

        Args:
            params: Parameters of all training views, by name, shape [V, ...].
            numbers: Indices of the B views among all training views, int64, shape [B].

        Returns:
            Tensors by the names of the parameters, shape [B, ...].
        """
        return {n: t.index_select(0, numbers) for n, t in params.items()}  # not t[numbers], which reads them back

    def before_render(self, camera: Camera, values: Tensors) -> Camera:
        """Return the camera for rendering the views; viewmat and intrinsics may change, and are differentiable.

        Args:
            camera: Camera of B views as given, viewmat [B, 4, 4] and K [B, 3, 3]; at half the size in some steps.
            values: Result of `values` for these views, [B, ...].
        """
        return camera

    def after_render(self, rgb: torch.Tensor, values: Tensors) -> torch.Tensor:
        """Return the colours [H, W, 3] of one view after the module, which reads its ``values`` [...]; differentiable."""
        return rgb

    def regularisation(self, values: Tensors) -> torch.Tensor | None:
        """Return a loss term for the step's view, shape []; None for no term. ``values`` [...] belong to this view."""
        return None

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes that the module needs at the moments of a step; none by default.

        A module with `before_render` needs `CAMERA_BYTES` for each Gaussian in the backward pass of projection.
        """
        return {}

    def cameras(self, given: Cameras, train: Sequence[str], test: Sequence[str], params: Tensors) -> Cameras:
        """Return the cameras of all views after the fit, for scores and renders; by default the given ones.

        The images of held-out views are not available, so that nothing is learned from them.

        Args:
            given: Camera of each view, numpy, in scene units [u], by name.
            train: Names of the training views.
            test: Names of the held-out views.
            params: Parameters of the training views, by name, shape [V, ...].
        """
        return given

    def figures(self, fitted: FittedViews) -> dict[str, Any]:
        """Return the learned values as plain numbers for metrics.json; ``summary`` is a note for output and report."""
        return {"summary": f"view module {self.name}: {', '.join(fitted.params)} of {len(fitted.train)} training views learned"}


VIEW_MODULES = Registry("view module", ViewModule, __name__)
"""View modules by name; those in the modules of this folder are built in."""
register = register_view_module = VIEW_MODULES.register


# Exposure of training views: an affine map of rendered colours for each view, learned with the Gaussians.
#
# A camera with automatic exposure and white balance changes the colours between photographs. With exposures a step
# compares the view's image with A rgb + b of its render. The learned parameters are the 12 numbers of [A - 1 | b],
# which start at zero. A step subtracts their mean over all training views, so that the model has the mean exposure.
# Otherwise all exposures could become darker and the Gaussians brighter, with the same colours in the training views.

EXPOSURE = "exposure_affine"
"""Name of the parameters: rows of [A - 1 | b], shape [V, 12]."""
CHANNELS = 3
GRAY = 0.5
"""Gray for which the brightness under an exposure is reported."""


def exposure_of(rows: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
    """Return the exposure [..., 12] of views: their parameters ``own`` [..., 12] minus the mean of all views' ``rows`` [V, 12].

    No gradient flows through the mean: only the rows of ``own`` get one.
    """
    # in float64, so that the float32 result is the same for any number of threads
    return own - rows.detach().mean(0, dtype=torch.float64).to(own.dtype)


class _Exposed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rgb: torch.Tensor, exposure: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(rgb, exposure)
        m = exposure.view(CHANNELS, CHANNELS + 1)
        # explicit sums, since the order of summation in a matrix product depends on the library
        found = rgb + m[:, CHANNELS]
        for k in range(CHANNELS):
            found += rgb[..., k : k + 1] * m[:, k]
        return found

    @staticmethod
    @first_order
    def backward(ctx: Any, v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        rgb, exposure = ctx.saved_tensors
        m = exposure.view(CHANNELS, CHANNELS + 1)
        v_rgb = v.clone()
        for c in range(CHANNELS):
            v_rgb += v[..., c : c + 1] * m[c, :CHANNELS]
        columns = [(v * rgb[..., k : k + 1]).sum((0, 1), dtype=torch.float64) for k in range(CHANNELS)]
        columns.append(v.sum((0, 1), dtype=torch.float64))
        return v_rgb, torch.stack(columns, -1).reshape(-1).to(exposure.dtype)


def exposed(rgb: torch.Tensor, exposure: torch.Tensor) -> torch.Tensor:
    """Return colours [H, W, 3] under an exposure [12], rows of [A - 1 | b]; differentiable in both."""
    found: torch.Tensor = _Exposed.apply(rgb, exposure)
    return found


@register("exposure")
@dataclass(frozen=True)
class Exposure(ViewModule, group="exposure."):
    """Learn an affine map of colours for each training view, for photographs with different brightness or white balance.

    Held-out views and renders do not use the maps: scores are those of the model's own colours (docs/your-photos.md).
    """

    lr: LearningRate = 5e-3
    """Learning rate of the exposures at the start."""
    decay: LearningRate = 0.1
    """Learning rate at the last step, as a fraction of the first; log-linear in between."""
    weight: Annotated[float, Within(0, 1000)] = 0.01
    """Weight of the squared difference between each view's exposure and the identity, in [0, 1000]."""

    def check(self, views: Sequence[View]) -> None:
        """Check that no view has an alpha channel: an exposure would change the background with the object."""
        for v in views:
            if v.alpha is not None:
                raise UsageError(f"--exposure cannot fit images with an alpha channel, such as {v.name}; omit --exposure")

    def parameters(self, views: Sequence[View]) -> dict[str, torch.Tensor]:
        """Return zeros, shape [V, 12]."""
        return {EXPOSURE: torch.zeros(len(views), CHANNELS * (CHANNELS + 1), dtype=torch.float32, device="cpu")}

    def lrs(self, progress: float, extent: float) -> dict[str, float]:
        """Return the learning rate, which falls from the first step on."""
        return {EXPOSURE: self.lr * log_linear(1.0, self.decay, progress)}

    def values(self, params: Tensors, numbers: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return `exposure_of` the views, shape [B, 12]."""
        rows = params[EXPOSURE]
        return {EXPOSURE: exposure_of(rows, rows.index_select(0, numbers))}

    def after_render(self, rgb: torch.Tensor, values: Tensors) -> torch.Tensor:
        """Return `exposed` colours, shape [H, W, 3]."""
        return exposed(rgb, values[EXPOSURE])

    def regularisation(self, values: Tensors) -> torch.Tensor:
        """Return ``weight`` times the sum of squares of [A - 1 | b], shape []: it pulls exposures towards the identity."""
        return (self.weight * values[EXPOSURE].double().square().sum()).to(values[EXPOSURE].dtype)

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of the render after its exposure, which exists beside the plain render."""
        return {LOSS: FLOAT * CHANNELS * sizes.pixels}

    def figures(self, fitted: FittedViews) -> dict[str, Any]:
        """Return the learned exposures and their effect.

        ``views`` has for each training view [A | b] as 3 rows of 4, and ``gain``, the mean over channels of a middle gray after
        exposure, divided by that gray. ``matched_psnr`` is the mean PSNR of held-out views after colour matching [dB], None
        without held-out views.
        """
        rows = fitted.params[EXPOSURE].double()
        numbers = exposure_of(rows, rows).detach().cpu().numpy().reshape(-1, CHANNELS, CHANNELS + 1)
        maps = numbers + np.eye(CHANNELS, CHANNELS + 1)
        gains = (maps[..., :CHANNELS].sum(-1) + maps[..., CHANNELS] / GRAY).mean(-1)
        each = zip(fitted.train, maps, gains, strict=True)
        views = [{"name": n, "affine": m.tolist(), "gain": float(g)} for n, m, g in each]
        summary = (
            f"exposures learned: the training views are {gains.min():.2f} to {gains.max():.2f} times as bright as the model, "
            "which has their mean exposure; scores use renders without learned exposures"
        )
        renders = ((v, render_view(fitted.gaussians, v, fitted.options)[0]) for v in fitted.test)
        scores = [s for v, image in renders if np.isfinite(s := matched_psnr(v, image))]
        mean = float(np.mean(scores)) if scores else None
        if mean is not None:
            summary += f"; held-out PSNR {mean:.2f} dB {MATCHED_RULE}"
        return {"views": views, "matched_psnr": mean, "summary": summary}


# Refinement of training poses: an increment of each camera, learned with the Gaussians.
#
# A training view i > 0 is rendered from T_i viewmat_i, where T_i rotates by w_i about the camera's centre and moves by
# t_i in the camera's axes. The first camera stays fixed, so that the scene as a whole cannot rotate or drift. Its scale
# remains free, but does not change any image. The rotation is Cayley's map of w / 2; its angle is 2 atan(|w| / 2). For
# small w it is close to exp(w). It needs no special case for w = 0, and has the same bits on every processor.
#
# A focal length that is not known exactly can be learned too: fx and fy of every view of one camera are multiplied by s
# = (2 + z) / (2 - z), which is exp(z) to second order and positive for |z| < 2. Views with the same intrinsics and size
# count as one camera. All rows of one camera hold the same z: a view uses the mean of its camera's rows, so each row
# gets the same gradient.

ROTATION, TRANSLATION = "pose_rotation", "pose_translation"
"""Names of the parameters: w [rad] and t [u], shape [V, 3] each."""
FOCAL, CAMERA_NUMBER = "pose_focal", "pose_camera"
"""Names of the parameters of a learned focal length: z, and the index of the view's camera, a constant; shape [V, 1] each."""
POSE_RULE = (
    "held-out cameras are moved by the similarity that best maps the given training cameras to the refined ones; held-out "
    "images are not used"
)
"""Rule for the poses of held-out views, as text for the user."""


def increments(rotation: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """Return rigid motions [..., 4, 4] for rotations w [rad] and translations t [u], shape [..., 3]; differentiable."""
    x, y, z = (rotation / 2).unbind(-1)
    s = 2 / (1 + x * x + y * y + z * z)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    rows = (
        (1 - s * (y * y + z * z), s * (x * y - z), s * (x * z + y), translation[..., 0]),
        (s * (x * y + z), 1 - s * (x * x + z * z), s * (y * z - x), translation[..., 1]),
        (s * (x * z - y), s * (y * z + x), 1 - s * (x * x + y * y), translation[..., 2]),
        (zero, zero, zero, one),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def moved(viewmats: torch.Tensor, rotation: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """Return camera_from_world [B, 4, 4] of views after their increments w [rad] and t [u], [B, 3] each; differentiable."""
    motion = increments(rotation, translation)
    # four products, since the order of summation in a matrix product depends on the library
    products = [motion[..., k : k + 1] * viewmats[..., k : k + 1, :] for k in range(4)]
    return products[0] + products[1] + products[2] + products[3]


def camera_numbers(cameras: Sequence[Camera]) -> list[int]:
    """Return a number for each view's camera: views with the same intrinsics and size have the same number."""
    numbers: dict[tuple[bytes, int, int], int] = {}
    return [numbers.setdefault((np.asarray(c.K, np.float64).tobytes(), c.width, c.height), len(numbers)) for c in cameras]


def focal_factors(params: Tensors, numbers: torch.Tensor) -> torch.Tensor:
    """Return the factor s of the focal length of views with these indices [B], shape [B]; differentiable."""
    camera = params[CAMERA_NUMBER][:, 0]
    same = (camera.index_select(0, numbers)[:, None] == camera).to(camera.dtype)
    z = (same * params[FOCAL][:, 0]).sum(1) / same.sum(1)
    return (2 + z) / (2 - z)


def zoomed(K: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
    """Return intrinsics [B, 3, 3] with fx and fy times a factor [B]; differentiable."""
    return torch.cat([torch.cat([K[:, :2, :2] * factor[:, None, None], K[:, :2, 2:]], 2), K[:, 2:]], 1)


def similarity(given: Sequence[Camera], refined: Sequence[Camera]) -> tuple[np.ndarray, float, np.ndarray]:
    """Return rotation [3, 3], scale and translation [3] from the world of the given cameras to the world of the refined ones.

    The rotation is the mean of the cameras' rotations. Scale and translation are least squares over the camera centres. If all
    centres coincide, the scale is 1.
    """
    turned = sum(matmul(r.viewmat[:3, :3].T, g.viewmat[:3, :3]) for g, r in zip(given, refined))
    R = nearest_rotation(np.asarray(turned) / len(given))
    a, b = (np.array([c.center for c in cameras]) for cameras in (given, refined))
    from_mean, to_mean = matmul(a - a.mean(0), R.T), b - b.mean(0)
    size = (from_mean**2).sum()
    scale = float((from_mean * to_mean).sum() / size) if size > 0 else 1.0
    return R, scale, b.mean(0) - scale * matmul(R, a.mean(0))


def refined_cameras(given: Cameras, train: Sequence[str], test: Sequence[str], params: Tensors) -> dict[str, Camera]:
    """Return the cameras of all views after refinement: training ones by their own increments, held-out ones by `POSE_RULE`.

    If focal lengths are learned, a held-out view has the focal length of the training views of its camera. If no training view
    has its intrinsics, the mean factor over all training views is used.
    """
    motions = increments(*(params[n].detach().cpu().double() for n in (ROTATION, TRANSLATION))).numpy()
    found = dict(given)
    for name, motion in zip(train, motions, strict=True):
        found[name] = replace(given[name], viewmat=matmul(motion, given[name].viewmat))
    R, scale, t = similarity([given[n] for n in train], [found[n] for n in train])
    for name in test:
        turned, center = matmul(given[name].viewmat[:3, :3], R.T), scale * matmul(R, given[name].center) + t
        found[name] = replace(given[name], viewmat=pose_at(turned, center))
    if FOCAL not in params:
        return found
    exact = {n: params[n].detach().cpu().double() for n in (FOCAL, CAMERA_NUMBER)}
    factors = focal_factors(exact, torch.arange(len(train), device="cpu")).tolist()
    numbers = dict(zip([*train, *test], camera_numbers([given[n] for n in (*train, *test)])))
    of_camera = {numbers[n]: f for n, f in zip(train, factors)}
    for name in (*train, *test):
        factor = of_camera.get(numbers[name], float(np.mean(factors)))
        found[name] = replace(found[name], K=np.asarray(given[name].K) * [[factor, 1, 1], [1, factor, 1], [1, 1, 1]])
    return found


def pose_figures(given: Cameras, refined: Cameras, train: Sequence[str], held_out: bool, scale: float) -> dict[str, Any]:
    """Return the changes by refinement, for metrics.json; ``scale`` is scene units per unit of the scene's files.

    ``views`` has the turn [degrees] and the shift of the centre [units of the files] of each training view; ``cameras`` the
    focal length [px] of each camera before and after, if any changed.
    """
    rows = []
    for name in train:
        turn = matmul(refined[name].viewmat[:3, :3], given[name].viewmat[:3, :3].T)
        # by the sine of half the angle, since its cosine has no digits left at small angles
        sine = min(1.0, float(np.linalg.norm(turn - np.eye(3))) / np.sqrt(8))
        shift = float(np.linalg.norm(refined[name].center - given[name].center)) / scale
        rows.append({"name": name, "degrees": float(np.degrees(2 * np.arcsin(sine))), "units": shift})
    degrees, units = ([r[key] for r in rows] for key in ("degrees", "units"))
    summary = (
        f"poses refined: {len(train)} training cameras; median rotation {np.median(degrees):.3f} degrees, largest "
        f"{max(degrees):.3f}; median shift {np.median(units):.4g} units, largest {max(units):.4g}; the first camera is fixed"
    )
    first = dict(zip(reversed(camera_numbers([given[n] for n in train])), reversed(train)))
    lenses = [
        {"views": sum(np.array_equal(given[n].K, given[name].K) for n in train),
         "given": float(given[name].K[0, 0]), "focal": float(refined[name].K[0, 0])}
        for _, name in sorted(first.items())
    ]  # fmt: skip
    found: dict[str, Any] = {"views": rows}
    if any(lens["given"] != lens["focal"] for lens in lenses):
        found["cameras"] = lenses
        changes = [f"{r['focal']:.1f} px, given {r['given']:.1f} ({r['focal'] / r['given'] - 1:+.1%})" for r in lenses]
        summary = f"{summary}; focal length {listed(changes, 3)}"
    return found | {"summary": f"{summary}; {POSE_RULE}" if held_out else summary}


@register("refine_poses")
@dataclass(frozen=True)
class RefinePoses(ViewModule, group="refine-poses."):
    """Learn a small correction of each training camera except the first, for inexact poses (docs/your-photos.md)."""

    start: Annotated[float, Within(0, 1, ")")] = 0.2
    """Fraction of the steps after which refinement of poses starts, in [0, 1): at first the Gaussians are inaccurate."""
    rotation_lr: LearningRate = 2e-4
    """Learning rate of the rotations of the training cameras [rad], when refinement starts."""
    translation_lr: LearningRate = 2e-4
    """Learning rate of the translations of the training cameras, in units of the scene's extent."""
    focal_lr: LearningRate | None = None
    """Learning rate of the logarithm of each camera's focal length, shared by all its views; None to keep it fixed."""
    decay: LearningRate = 0.1
    """Learning rates at the last step, as a fraction of the first ones; log-linear in between."""

    def parameters(self, views: Sequence[View]) -> dict[str, torch.Tensor]:
        """Return zeros, shape [V, 3] each; for learned focal lengths also zeros and the camera of each view, [V, 1] each."""
        found = {name: torch.zeros(len(views), 3, dtype=torch.float32, device="cpu") for name in (ROTATION, TRANSLATION)}
        if self.focal_lr is not None:
            numbers = torch.tensor(camera_numbers([v.camera for v in views]), dtype=torch.float32, device="cpu")
            found |= {FOCAL: torch.zeros(len(views), 1, dtype=torch.float32, device="cpu"), CAMERA_NUMBER: numbers[:, None]}
        return found

    def lrs(self, progress: float, extent: float) -> dict[str, float]:
        """Return the learning rates of rotations [rad], translations [u] and focal lengths, zero before ``start``."""
        begun = (progress - self.start) / (1 - self.start)
        left = log_linear(1.0, self.decay, begun) if begun >= 0 else 0.0
        found = {ROTATION: self.rotation_lr * left, TRANSLATION: self.translation_lr * extent * left}
        return found | ({FOCAL: self.focal_lr * left, CAMERA_NUMBER: 0.0} if self.focal_lr is not None else {})

    def values(self, params: Tensors, numbers: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return w and t of the views, shape [B, 3] each, zeros for view 0; and factors of learned focal lengths [B]."""
        free = (numbers != 0).to(params[ROTATION].dtype)[:, None]
        found = {n: params[n].index_select(0, numbers) * free for n in (ROTATION, TRANSLATION)}
        return found | ({FOCAL: focal_factors(params, numbers)} if FOCAL in params else {})

    def before_render(self, camera: Camera, values: Tensors) -> Camera:
        """Return the camera after the increments of its views, with its learned focal length."""
        K = zoomed(camera.K, values[FOCAL]) if FOCAL in values else camera.K
        return replace(camera, viewmat=moved(camera.viewmat, values[ROTATION], values[TRANSLATION]), K=K)

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of the gradient of the camera."""
        return {PROJECTION: CAMERA_BYTES * sizes.count}

    def cameras(self, given: Cameras, train: Sequence[str], test: Sequence[str], params: Tensors) -> Cameras:
        """Return `refined_cameras`."""
        return refined_cameras(given, train, test, params)

    def figures(self, fitted: FittedViews) -> dict[str, Any]:
        """Return `pose_figures`."""
        return pose_figures(fitted.given, fitted.cameras, fitted.train, bool(fitted.test), fitted.scale)
