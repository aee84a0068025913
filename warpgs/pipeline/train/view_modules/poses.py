"""Refinement of training poses: an increment of each camera, learned with the Gaussians.

A training view i > 0 is rendered from T_i viewmat_i, where T_i rotates by w_i about the camera's centre and moves by
t_i in the camera's axes. The first camera stays fixed, so that the scene as a whole cannot rotate or drift. Its scale remains
free, but does not change any image. The rotation is Cayley's map of w / 2; its angle is 2 atan(|w| / 2). For small w it is
close to exp(w). It needs no special case for w = 0, and has the same bits on every processor.

A focal length that is not known exactly can be learned too: fx and fy of every view of one camera are multiplied by
s = (2 + z) / (2 - z), which is exp(z) to second order and positive for |z| < 2. Views with the same intrinsics and size count
as one camera. All rows of one camera hold the same z: a view uses the mean of its camera's rows, so each row gets the same
gradient.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from warpgs.errors import UsageError
from warpgs.geometry import matmul, nearest_rotation
from warpgs.pipeline.train.schedule import check_lrs, log_linear
from warpgs.pipeline.train.view_modules.base import CAMERA_BYTES, FittedViews, Tensors, ViewModule, register
from warpgs.runtime.step_sizes import PROJECTION, Needs, StepSizes
from warpgs.scene import Camera, View

ROTATION, TRANSLATION = "pose_rotation", "pose_translation"
"""Names of the parameters: w [rad] and t [u], shape [V, 3] each."""
FOCAL, CAMERA_NUMBER = "pose_focal", "pose_camera"
"""Names of the parameters of a learned focal length: z, and the index of the view's camera, a constant; shape [V, 1] each."""
SHOWN_LENSES = 3
"""Largest number of cameras whose focal length is in the summary."""
RULE = (
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
    """Return camera_from_world [B, 4, 4] of views after their increments; differentiable.

    Args:
        viewmats: camera_from_world as given, shape [B, 4, 4].
        rotation: w of each view [rad], shape [B, 3].
        translation: t of each view [u], shape [B, 3].
    """
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
    focal = K[:, :2, :2] * factor[:, None, None]
    return torch.cat([torch.cat([focal, K[:, :2, 2:]], 2), K[:, 2:]], 1)


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


def similar_cameras(
    cameras: Mapping[str, Camera], given: Sequence[Camera], refined: Sequence[Camera], names: Sequence[str]
) -> dict[str, Camera]:
    """Return the named cameras after the similarity that best maps given cameras to refined ones, by name.

    Args:
        cameras: Cameras by name, in the world of the given ones.
        given: Cameras before refinement.
        refined: The same cameras after refinement, in the same order.
        names: Names of the cameras to return.
    """
    R, scale, t = similarity(given, refined)
    found = {}
    for name in names:
        turned, center = matmul(cameras[name].viewmat[:3, :3], R.T), scale * matmul(R, cameras[name].center) + t
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = turned, -matmul(turned, center)
        found[name] = replace(cameras[name], viewmat=viewmat)
    return found


def refined_cameras(
    given: Mapping[str, Camera], train: Sequence[str], test: Sequence[str], params: Tensors
) -> dict[str, Camera]:
    """Return the cameras of all views after refinement: training ones by their own increments, held-out ones by `RULE`.

    If focal lengths are learned, a held-out view has the focal length of the training views of its camera. If no training view
    has its intrinsics, the mean factor over all training views is used.

    Args:
        given: Cameras as given, in scene units, by name.
        train: Names of the training views, in the order of the fit.
        test: Names of the held-out views.
        params: Parameters of the training views.
    """
    motions = increments(*(params[n].detach().cpu().double() for n in (ROTATION, TRANSLATION))).numpy()
    found = dict(given)
    for name, motion in zip(train, motions, strict=True):
        found[name] = replace(given[name], viewmat=matmul(motion, given[name].viewmat))
    found |= similar_cameras(given, [given[n] for n in train], [found[n] for n in train], test)
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


def pose_figures(
    given: Mapping[str, Camera], refined: Mapping[str, Camera], train: Sequence[str], held_out: bool, scale: float
) -> dict[str, Any]:
    """Return the changes by refinement, for metrics.json.

    Args:
        given: Cameras before refinement, in scene units.
        refined: Cameras after refinement.
        train: Names of the training views.
        held_out: Whether there are held-out views.
        scale: Scene units per unit of the scene's files.

    Returns:
        ``views``, the turn [degrees] and the shift of the centre [units of the files] of each training view; ``cameras``, the
        focal length [px] of each camera before and after, if any changed; and ``summary``.
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
        more = f" and {len(lenses) - SHOWN_LENSES} more" if len(lenses) > SHOWN_LENSES else ""
        summary = f"{summary}; focal length {', '.join(changes[:SHOWN_LENSES])}{more}"
    return found | {"summary": f"{summary}; {RULE}" if held_out else summary}


@register("refine_poses")
@dataclass(frozen=True)
class RefinePoses(ViewModule):
    """Learn a small correction of each training camera except the first, for inexact poses (docs/your-photos.md)."""

    start: float = 0.2
    """Fraction of the steps after which refinement of poses starts, in [0, 1): at first the Gaussians are inaccurate."""
    rotation_lr: float = 2e-4
    """Learning rate of the rotations of the training cameras [rad], when refinement starts."""
    translation_lr: float = 2e-4
    """Learning rate of the translations of the training cameras, in units of the scene's extent."""
    focal_lr: float | None = None
    """Learning rate of the logarithm of each camera's focal length, shared by all its views; None to keep it fixed."""
    decay: float = 0.1
    """Learning rates at the last step, as a fraction of the first ones; log-linear in between."""

    def __post_init__(self) -> None:
        lrs = {"rotation_lr": self.rotation_lr, "translation_lr": self.translation_lr, "focal_lr": self.focal_lr}
        check_lrs(self.name, **lrs, decay=self.decay)
        if not 0 <= self.start < 1:
            raise UsageError(f"refine_poses: `start` must be at least 0 and less than 1, not {self.start}")

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

    def cameras(
        self, given: Mapping[str, Camera], train: Sequence[str], test: Sequence[str], params: Tensors
    ) -> Mapping[str, Camera]:
        """Return `refined_cameras`."""
        return refined_cameras(given, train, test, params)

    def figures(self, fitted: FittedViews) -> dict[str, Any]:
        """Return `pose_figures`."""
        return pose_figures(fitted.given, fitted.cameras, fitted.train, bool(fitted.test), fitted.scale)
