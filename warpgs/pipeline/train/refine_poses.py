"""Refinement of training poses: an increment of each camera, learned with the Gaussians.

A training view i > 0 is rendered from T_i viewmat_i, where T_i turns by a rotation w_i about the camera's centre and moves by
t_i in the camera's axes. The first camera stays, so that the scene as a whole cannot turn or wander away; what is left free,
its size, no image shows. The rotation is Cayley's map of w / 2, of angle 2 atan(|w| / 2): for small w that of exp(w), without
a case for w = 0, and with the same bits on every processor.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import torch

from warpgs.pipeline.train.views import TrainingView, ViewStack

ROTATION, TRANSLATION = "pose_rotation", "pose_translation"
"""Names of the parameters of each view in `Learned.views`: w [rad] and t [u], shape [V, 3] each."""


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


def moved(viewmats: torch.Tensor, numbers: torch.Tensor, rotation: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """Return camera_from_world [B, 4, 4] of views after their increments; that of view 0 stays as it is.

    Args:
        viewmats: camera_from_world as given, shape [B, 4, 4].
        numbers: Number of each among the training views, int64, shape [B].
        rotation: w of each [rad], shape [B, 3].
        translation: t of each [u], shape [B, 3].
    """
    free = (numbers != 0).to(viewmats.dtype)[:, None]
    motion = increments(rotation * free, translation * free)
    # four products, not a matrix product, whose order of summation is the library's
    products = [motion[..., k : k + 1] * viewmats[..., k : k + 1, :] for k in range(4)]
    return products[0] + products[1] + products[2] + products[3]


def first_increments(views: int, device: torch.device) -> dict[str, torch.Tensor]:
    """Return the parameters of as many views before the first step, zeros [V, 3], by name."""
    return {name: torch.zeros(views, 3, device=device) for name in (ROTATION, TRANSLATION)}


class GivenPoses:
    """Poses of the training views as they were given, which increments count from."""

    def __init__(self, views: list[TrainingView]):
        """Keep the poses of the views, in their order."""
        self.viewmats = torch.stack([v.camera.viewmat for v in views])

    @staticmethod
    def owned(views: list[TrainingView]) -> list[TrainingView]:
        """Return the views with poses of their own, which `show` may overwrite."""
        return [replace(v, camera=replace(v.camera, viewmat=v.camera.viewmat.clone())) for v in views]

    def restore(self, stacks: Iterable[ViewStack]) -> None:
        """Write the given poses into stacks that were made of views as `show` left them."""
        for stack in stacks:
            stack.viewmats.copy_(self.viewmats[stack.numbers])

    @torch.no_grad()
    def show(self, views: list[TrainingView], params: Mapping[str, torch.Tensor]) -> None:
        """Write the poses as they are now into the views, which density strategies render from."""
        numbers = torch.arange(len(views), device=self.viewmats.device)
        now = moved(self.viewmats, numbers, params[ROTATION], params[TRANSLATION])
        for view, viewmat in zip(views, now, strict=True):
            view.camera.viewmat.copy_(viewmat)
