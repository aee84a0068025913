"""Refinement of training poses: an increment of each camera, learned with the Gaussians.

A training view i > 0 is rendered from T_i viewmat_i, where T_i turns by a rotation w_i about the camera's centre and moves by
t_i in the camera's axes. The first camera stays, so that the scene as a whole cannot turn or wander away; what is left free,
its size, no image shows. The rotation is Cayley's map of w / 2, of angle 2 atan(|w| / 2): for small w that of exp(w), without
a case for w = 0, and with the same bits on every processor.
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
RULE = (
    "held-out views are moved by the one similarity that takes the given training cameras to the refined ones best; their "
    "own images are not looked at"
)
"""Rule for the poses of held-out views, for people."""


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
        rotation: w of each [rad], shape [B, 3].
        translation: t of each [u], shape [B, 3].
    """
    motion = increments(rotation, translation)
    # four products, not a matrix product, whose order of summation is the library's
    products = [motion[..., k : k + 1] * viewmats[..., k : k + 1, :] for k in range(4)]
    return products[0] + products[1] + products[2] + products[3]


def similarity(given: Sequence[Camera], refined: Sequence[Camera]) -> tuple[np.ndarray, float, np.ndarray]:
    """Return rotation [3, 3], scale and translation [3] from the world of given cameras to that of refined ones.

    The rotation is the mean of the cameras' own; scale and translation are least squares over their centres. Where all centres
    are one, the scale is 1.
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
    """Return the named cameras after the similarity that takes given cameras to refined ones best, by name.

    Args:
        cameras: Cameras by name, in the world of the given ones.
        given: Cameras before.
        refined: The same cameras after, in the same order.
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

    Args:
        given: Cameras as given, in scene units, by name.
        train: Names of the training views, in the order of the fit.
        test: Names of the held-out views.
        params: Increments of the training views, shape [V, 3] each.
    """
    motions = increments(*(params[n].detach().cpu().double() for n in (ROTATION, TRANSLATION))).numpy()
    found = dict(given)
    for name, motion in zip(train, motions, strict=True):
        found[name] = replace(given[name], viewmat=matmul(motion, given[name].viewmat))
    return found | similar_cameras(given, [given[n] for n in train], [found[n] for n in train], test)


def pose_figures(
    given: Mapping[str, Camera], refined: Mapping[str, Camera], train: Sequence[str], held_out: bool, scale: float
) -> dict[str, Any]:
    """Return what refinement changed, as metrics.json holds it.

    Args:
        given: Cameras before, in scene units.
        refined: Cameras after.
        train: Names of the training views.
        held_out: Whether there are held-out views.
        scale: Scene units per unit of the scene's files.

    Returns:
        ``views``, the turn [degrees] and the shift of the centre [units of the files] of each training view, and ``summary``.
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
        f"poses refined: {len(train)} training cameras turned by {np.median(degrees):.3f} degrees in the median, "
        f"{max(degrees):.3f} at most, and moved by {np.median(units):.4g} and {max(units):.4g} units; the first one is fixed"
    )
    return {"views": rows, "summary": f"{summary}; {RULE}" if held_out else summary}


@register("refine_poses")
@dataclass(frozen=True)
class RefinePoses(ViewModule):
    """Learn an increment of each training camera but the first, for poses that are a little off (docs/your-photos.md)."""

    start: float = 0.2
    """Fraction of the steps before poses are refined, in [0, 1): the first Gaussians tell nothing of them."""
    rotation_lr: float = 2e-4
    """Learning rate of the training cameras' rotations [rad] from then on."""
    translation_lr: float = 2e-4
    """The same of their translations, times the scene's extent."""
    decay: float = 0.1
    """Fraction of both that is left at the last step; log-linear between."""

    def __post_init__(self) -> None:
        check_lrs(self.name, rotation_lr=self.rotation_lr, translation_lr=self.translation_lr, decay=self.decay)
        if not 0 <= self.start < 1:
            raise UsageError(f"refine_poses start must be at least 0 and less than 1, not {self.start}")

    def parameters(self, views: Sequence[View]) -> dict[str, torch.Tensor]:
        """Return zeros, shape [V, 3] each."""
        return {name: torch.zeros(len(views), 3) for name in (ROTATION, TRANSLATION)}

    def lrs(self, progress: float, extent: float) -> dict[str, float]:
        """Return the learning rates of rotations [rad] and translations [u], zero before ``start``."""
        begun = (progress - self.start) / (1 - self.start)
        left = log_linear(1.0, self.decay, begun) if begun >= 0 else 0.0
        return {ROTATION: self.rotation_lr * left, TRANSLATION: self.translation_lr * extent * left}

    def values(self, params: Tensors, numbers: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return w and t of the views, shape [B, 3] each, zeros for view 0."""
        free = (numbers != 0).to(params[ROTATION].dtype)[:, None]
        return {n: params[n].index_select(0, numbers) * free for n in (ROTATION, TRANSLATION)}

    def before_render(self, camera: Camera, values: Tensors) -> Camera:
        """Return the camera after the increments of its views."""
        return replace(camera, viewmat=moved(camera.viewmat, values[ROTATION], values[TRANSLATION]))

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
