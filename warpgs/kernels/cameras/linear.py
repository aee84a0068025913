"""Products with a Jacobian of 2 x 3, for camera models that compute the whole Jacobian."""

import functools
from types import SimpleNamespace

import warp as wp


@functools.cache
def make_linear(real: type) -> SimpleNamespace:
    """Make the structs and products for one scalar type, wp.float32 or wp.float64."""
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)

    @wp.struct
    class Rows:
        """Two rows, of the Jacobian or of Jacobian times axes [px]."""

        first: vec3
        second: vec3

    @wp.struct
    class Gradients:
        """Gradients of the position in the camera and of the intrinsics."""

        v_position: vec3
        v_K: mat33

    @wp.func
    def rows_of(first: vec3, second: vec3) -> Rows:
        rows = Rows()
        rows.first = first
        rows.second = second
        return rows

    @wp.func
    def times_axes(jacobian: Rows, axes: mat33) -> Rows:
        turned = wp.transpose(axes)
        return rows_of(turned * jacobian.first, turned * jacobian.second)

    @wp.func
    def transposed_times(jacobian: Rows, v_first: vec3, v_second: vec3) -> mat33:
        return wp.outer(jacobian.first, v_first) + wp.outer(jacobian.second, v_second)

    return SimpleNamespace(
        Rows=Rows, Gradients=Gradients, rows_of=rows_of, times_axes=times_axes, transposed_times=transposed_times
    )
