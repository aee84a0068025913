"""The interface of a camera model, and the models by name."""

from __future__ import annotations

from types import SimpleNamespace
from typing import ClassVar

from warpgs.errors import UsageError
from warpgs.plugins import Registry
from warpgs.scene import Camera


class CameraModel:
    """A camera model: Warp functions that map a point in camera coordinates to a pixel, and their gradients."""

    name: ClassVar[str]
    """Name of the model in `Camera.model`."""
    coefficients: int = 0
    """Number P of coefficients in `Camera.distortion`."""

    @staticmethod
    def make_functions(real: type) -> SimpleNamespace:
        """Make the functions for one scalar type, wp.float32 or wp.float64.

        Below, ``position`` is a mean in camera coordinates [u] (+x right, +y down, +z forward), ``K`` the intrinsics [3, 3],
        ``lens`` the coefficients of distortion, a Warp array [P], ``pixel`` the result of ``pixel_of`` and J the Jacobian of
        ``pixel_of`` by the position, 2 x 3. The namespace has:

        ``in_range(position, lens, near) -> bool``: True if the model can project this position. A NaN must give False.

        ``depth_of(position) -> real``: The depth [u], above 0 where ``in_range`` is True. It orders the Gaussians and is
        rendered.

        ``pixel_of(position, K, lens) -> vec2``: The projected position [px].

        ``expansion_point(pixel, width, height) -> vec2``: The pixel at which J is evaluated [px]: ``pixel``, or ``pixel``
        clamped to the image plus a margin if a first-order expansion would be too inaccurate far outside the image.

        ``project_axes(position, K, lens, point, axes) -> Rows``: J times ``axes`` [3, 3], with J at the expansion point
        ``point``. ``Rows`` is a struct with two vec3, ``first`` and ``second``.

        ``axes_backward(position, K, lens, point, v_first, v_second) -> mat33``: The gradient of ``axes`` from the gradients of
        the two rows.

        ``position_backward(position, K, lens, pixel, point, axes, v_first, v_second, v_pixel, v_depth) -> Gradients``: The
        gradients of position and intrinsics from those of the two rows, of the pixel and of the depth.
        ``Gradients`` is a struct with ``v_position`` (vec3) and ``v_K`` (mat33). Where ``point`` equals ``pixel``, J depends on
        the position; otherwise J is constant. The coefficients have no gradient.

        Raises:
            TypeError: The class does not define this function.
        """
        raise TypeError("a camera model must define make_functions(real); warpgs/kernels/cameras/pinhole.py is an example")


CAMERA_MODELS = Registry("camera model", CameraModel, "warpgs.kernels.cameras")
"""Camera models by name."""
register = CAMERA_MODELS.register


def check_camera(camera: Camera) -> type[CameraModel]:
    """Return the model of a camera, or of a batch.

    Raises:
        UsageError: The model is unknown, the number of coefficients does not match it, or the coefficients require gradients,
            which are not supported.
    """
    model = CAMERA_MODELS.find(camera.model)
    found = 0 if camera.distortion is None else camera.distortion.shape[-1]
    if found and not model.coefficients:
        others = ', or give model="opencv" (8) or model="fisheye" (4)' if camera.model == "pinhole" else ""
        raise UsageError(
            f"the camera model {camera.model!r} takes no distortion, found {found} coefficients; leave distortion out{others}"
        )
    if found != model.coefficients:
        raise UsageError(
            f"the camera model {camera.model!r} takes {model.coefficients} coefficients of distortion, found {found}; give "
            "Camera.distortion the shape [P] or [C, P], zeros for a lens without distortion"
        )
    if getattr(camera.distortion, "requires_grad", False):
        raise UsageError(
            "gradients of distortion coefficients are not supported, only those of the pose and of K: give "
            "Camera.distortion.detach()"
        )
    return model
