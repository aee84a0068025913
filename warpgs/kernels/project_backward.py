"""Gradients of one projected Gaussian, for all backward kernels of `project`. Comments name sections of docs/project.md."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.kernels import sh
from warpgs.kernels.covariance import make_covariance
from warpgs.kernels.functions import make_projection
from warpgs.kernels.project_inputs import PROJECTED_SIZE


@functools.cache
def make_functions(real, camera_model: str, parameters: str, antialiased: bool, bases: int, lanes: bool = False):
    """Make the functions that compute the gradients of a Gaussian's parameters from the gradient of the projected Gaussian.

    Args:
        real: wp.float32 or wp.float64.
        camera_model: Name of the camera model, whose functions are compiled in.
        parameters: Kind of the Gaussians' parameters (`ProjectSettings.parameters`).
        antialiased: True where opacities were multiplied by `compensation`.
        bases: Number of basis values that a colour may have (`sh.bases_for`).
        lanes: As in `make_projection`. If True, functions take a projected Gaussian and its gradient as vectors, not as rows of
            arrays.
    """
    m = make_projection(real, camera_model, parameters, lanes)
    vec2 = m.vec2
    vec3 = m.vec3
    vec4 = m.vec4
    values = sh.make_functions(real, bases).values
    mat33 = m.mat33
    basis_backward = sh.make_functions(real, bases).basis_backward
    c = make_covariance(real)

    row = wp.types.vector(PROJECTED_SIZE, real) if lanes else wp.array2d(dtype=real)

    @wp.func
    def at(values: row, i: int, k: int) -> real:
        """Return a number of a projected Gaussian."""
        if wp.static(lanes):
            return values[k]
        else:
            return values[i, k]

    @wp.struct
    class ShapeGradient:
        """Gradients through the projected mean, the factor and the depth of one projected Gaussian."""

        mean: vec3  # without the part through the colour
        quat: vec4
        log_scale: vec3
        position: vec3  # of the position in the camera
        turned: mat33  # of camera rotation times Gaussian rotation, or times the factor of the covariance
        unit: vec4  # no gradient, but the unit quaternion; unused for covariances
        K: mat33

    @wp.func
    def covariance_2d(
        e: m.Ellipse, projected: row, v_projected: row, i: int, low_pass: real
    ) -> vec3:  # fmt: skip
        """Return the gradients of xx, of each xy and of yy of the projected covariance [px^2] (section 9)."""
        u11 = at(projected, i, 2)
        u12 = at(projected, i, 3)
        u22 = at(projected, i, 4)
        h11 = at(v_projected, i, 2) * u11 + at(v_projected, i, 3) * u12
        h12 = at(v_projected, i, 3) * u22
        h22 = at(v_projected, i, 4) * u22
        V = real(-0.5) * vec3(
            h11 * u11 * u11,
            (h11 * u12 + h12 * u22) * u11,
            (h11 * u12 + real(2.0) * h12 * u22) * u12 + h22 * u22 * u22,
        )
        if wp.static(antialiased):
            compensation = m.compensation(e)
            if compensation > real(0.0):
                aa = wp.dot(e.m1, e.m1)
                cc = wp.dot(e.m2, e.m2)
                by_opacity = real(0.5) * at(v_projected, i, 5) * (at(projected, i, 5) / compensation) / compensation
                by_opacity *= low_pass * e.shrink * e.shrink * e.shrink * e.shrink / e.det
                V += by_opacity * (vec3(cc * e.c + e.b * e.b, -e.b * (cc + e.a), aa * e.a + e.b * e.b) / e.det)
        return V

    @wp.func
    def shape(
        mean: vec3, quat: vec4, log_scale: vec3, view: m.mat44, K: mat33, lens: wp.array(dtype=real),
        width: real, height: real, near: real, low_pass: real,
        projected: row, v_projected: row, i: int,
    ) -> ShapeGradient:  # fmt: skip
        g = ShapeGradient()
        e = m.ellipse(mean, quat, log_scale, view, K, lens, width, height, near, low_pass)
        rotation = mat33(
            view[0, 0], view[0, 1], view[0, 2],
            view[1, 0], view[1, 1], view[1, 2],
            view[2, 0], view[2, 1], view[2, 2],
        )  # fmt: skip

        # factor -> projected axes (section 4); v_u and u are both per shrunk pixel
        inv_c = real(1.0) / wp.sqrt(e.c)
        inv_det = real(1.0) / wp.sqrt(e.det)
        t11 = at(v_projected, i, 2) * e.shrink * (e.c * inv_c * inv_det)
        t12 = at(v_projected, i, 3) * e.shrink * (-e.b * inv_c * inv_det)
        t22 = at(v_projected, i, 4) * e.shrink * inv_c
        # twice v_det det and v_c c, times shrink; det and c divide vectors of their own size, or needles overflow
        s_det = -(t11 + t12) * e.shrink
        s_c = (t11 - t12 - t22) * e.shrink
        v_b = -at(v_projected, i, 3) * e.shrink * inv_c * (e.shrink * inv_det)
        blur = low_pass * e.shrink * e.shrink
        normal = wp.cross(e.m1, e.m2)
        per_det = real(1.0) / e.det
        per_c = real(1.0) / e.c
        v_m1 = s_det * (per_det * (wp.cross(e.m2, normal) + blur * e.m1)) + v_b * e.m2
        v_m2 = s_det * (per_det * (wp.cross(normal, e.m1) + blur * e.m2)) + v_b * e.m1 + s_c * (per_c * e.m2)
        if wp.static(antialiased):  # compensation -> projected axes (section 4)
            compensation = m.compensation(e)
            if compensation > real(0.0):
                unit = wp.normalize(normal / wp.max(wp.abs(normal)))  # divided, since its square could underflow
                v_compensation = at(v_projected, i, 5) * (at(projected, i, 5) / compensation) * e.shrink
                by_normal = blur * (wp.dot(e.m1, e.m1) + wp.dot(e.m2, e.m2) + blur) * per_det * inv_det
                by_blur = compensation * (blur * per_det)
                v_m1 += v_compensation * (by_normal * wp.cross(e.m2, unit) - by_blur * e.m1)
                v_m2 += v_compensation * (by_normal * wp.cross(unit, e.m1) - by_blur * e.m2)

        # projected axes -> camera axes (section 3)
        v_axes = m.axes_backward(e.position, K, lens, e.expansion_point, v_m1, v_m2)
        axes0 = vec3(e.axes[0, 0], e.axes[0, 1], e.axes[0, 2])
        axes1 = vec3(e.axes[1, 0], e.axes[1, 1], e.axes[1, 2])
        axes2 = vec3(e.axes[2, 0], e.axes[2, 1], e.axes[2, 2])
        g0 = vec3(v_axes[0, 0], v_axes[0, 1], v_axes[0, 2])
        g1 = vec3(v_axes[1, 0], v_axes[1, 1], v_axes[1, 2])
        g2 = vec3(v_axes[2, 0], v_axes[2, 1], v_axes[2, 2])
        if wp.static(parameters == "activated"):  # the axes divided by the scales, which may be 0
            turned = rotation * m.rotation(e.quat)
            axes0 = vec3(turned[0, 0], turned[0, 1], turned[0, 2])
            axes1 = vec3(turned[1, 0], turned[1, 1], turned[1, 2])
            axes2 = vec3(turned[2, 0], turned[2, 1], turned[2, 2])
        v_turned = v_axes  # gradient of camera rotation times Gaussian rotation, or of camera rotation times factor
        if wp.static(parameters == "covariances"):
            V = covariance_2d(e, projected, v_projected, i, low_pass)
            rows = m.project_axes(e.position, K, lens, e.expansion_point, rotation)
            packed = c.gradient(rows.first, rows.second, V[0], V[1], V[2])
            g.quat = packed.off
            g.log_scale = packed.diagonal
        else:
            g.log_scale = wp.cw_mul(g0, axes0) + wp.cw_mul(g1, axes1) + wp.cw_mul(g2, axes2)
            v_turned = v_axes * wp.diag(e.scales)
            v_unit = m.rotation_backward(e.quat, wp.transpose(rotation) * v_turned)
            g.quat = (v_unit - e.quat * wp.dot(e.quat, v_unit)) / e.quat_length

        # mean in the image, Jacobian and depth -> position in the camera (section 3)
        v_pixel = vec2(at(v_projected, i, 0), at(v_projected, i, 1))
        p = m.position_backward(
            e.position, K, lens, e.pixel, e.expansion_point, e.axes, v_m1, v_m2, v_pixel, at(v_projected, i, 9)
        )  # fmt: skip
        g.position = p.v_position
        g.mean = wp.transpose(rotation) * g.position
        g.turned = v_turned
        g.unit = e.quat
        g.K = p.v_K
        return g

    @wp.func
    def color(projected: row, v_projected: row, i: int) -> vec3:
        """Return the gradient of the colour before its clamp at zero (section 5)."""
        v_color = vec3(at(v_projected, i, 6), at(v_projected, i, 7), at(v_projected, i, 8))
        for channel in range(3):
            if not (at(projected, i, 6 + channel) > real(0.0)):  # clamped at zero
                v_color[channel] = real(0.0)
        return v_color

    @wp.func
    def centered(d: vec4, w: values) -> vec3:
        """Return the gradient of the mean through its viewing direction ``d``; ``w`` is that of the basis (section 5)."""
        v_centered = vec3()
        unit = vec3(d[0], d[1], d[2])
        if wp.static(lanes):
            v_unit = basis_backward(unit, w)
            v_centered = (v_unit - unit * wp.dot(unit, v_unit)) / wp.where(d[3] > real(0.0), d[3], real(wp.inf))
        elif d[3] > real(0.0):
            v_unit = basis_backward(unit, w)
            v_centered = (v_unit - unit * wp.dot(unit, v_unit)) / d[3]
        return v_centered

    @wp.func
    def logit(projected: row, v_projected: row, i: int, logit_opacity: real) -> real:
        """Return the gradient of the opacity's logit, or of the opacity itself (section 6)."""
        if wp.static(parameters != "stored"):
            return at(v_projected, i, 5) * (at(projected, i, 5) / logit_opacity)  # the factor of the opacity, or 1
        return at(v_projected, i, 5) * at(projected, i, 5) * m.sigmoid(-logit_opacity)

    @wp.func
    def view_gradient(
        view: m.mat44, mean: vec3, quat: vec4, log_scale: vec3, position: vec3, turned: mat33, unit: vec4, v_centered: vec3
    ) -> m.mat44:  # fmt: skip
        """Return the gradient of the view matrix; arguments are a Gaussian, fields of its ShapeGradient, and `centered`."""
        rotation = mat33(
            view[0, 0], view[0, 1], view[0, 2],
            view[1, 0], view[1, 1], view[1, 2],
            view[2, 0], view[2, 1], view[2, 2],
        )  # fmt: skip
        t = vec3(view[0, 3], view[1, 3], view[2, 3])
        if wp.static(parameters == "covariances"):
            turning = c.factor(quat, log_scale)
        else:
            turning = m.rotation(unit)
        v_rotation = wp.outer(position, mean) + wp.outer(t, v_centered) + turned * wp.transpose(turning)
        v_t = position + rotation * v_centered
        v_view = m.mat44()
        for row in range(3):
            for column in range(3):
                v_view[row, column] = v_rotation[row, column]
            v_view[row, 3] = v_t[row]
        return v_view

    return SimpleNamespace(
        ShapeGradient=ShapeGradient, shape=shape, color=color, centered=centered, logit=logit, view_gradient=view_gradient
    )
