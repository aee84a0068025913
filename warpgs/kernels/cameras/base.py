"""The interface of a camera model, and the table of models by name."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

from warpgs.errors import UsageError

CameraModel = Callable[[type], SimpleNamespace]
"""A function of a scalar type (wp.float32 or wp.float64) that returns six Warp functions as attributes. Below, ``position``
is a mean in camera coordinates [u] (+x right, +y down, +z forward), ``K`` the intrinsics [3, 3], ``pixel`` the result of
``pixel_of`` and J the Jacobian of ``pixel_of`` by the position, 2 x 3.

``in_range(position, near) -> bool``: True where the model can project this position. A NaN must give False.

``pixel_of(position, K) -> vec2``: The projected position [px].

``expansion_point(pixel, width, height) -> vec2``: The pixel at which J is taken [px]: ``pixel`` itself, clamped to somewhat
more than the image, since far outside of it a first-order expansion errs too much.

``project_axes(position, K, point, axes) -> Rows``: J times ``axes`` [3, 3], with J at the expansion point ``point``.
``Rows`` is a struct with two vec3, ``first`` and ``second``.

``axes_backward(position, K, point, v_first, v_second) -> mat33``: The gradient of ``axes`` from that of the two rows.

``position_backward(position, K, pixel, point, axes, v_first, v_second, v_pixel, v_depth) -> Gradients``: The gradients of
position and intrinsics from those of the two rows, of the pixel and of ``position[2]``. ``Gradients`` is a struct with
``v_position`` (vec3) and ``v_K`` (mat33). Where ``point`` equals ``pixel``, J moves with the position; else it does not.
"""

MODELS: dict[str, CameraModel] = {}
"""Models by name."""


def register(name: str) -> Callable[[CameraModel], CameraModel]:
    """Return a decorator that registers a camera model.

    Args:
        name: The name that `Camera.model` selects it by: letters, digits and underscores.

    Raises:
        UsageError: The name is taken, or has other characters; raised where the decorator is applied.
    """

    def add(model: CameraModel) -> CameraModel:
        if not name.isidentifier():
            raise UsageError(f"camera model name {name!r} must consist of letters, digits and underscores")
        if MODELS.get(name, model) is not model:
            raise UsageError(f"camera model {name!r} is registered already; choose another name")
        MODELS[name] = model
        return model

    return add
