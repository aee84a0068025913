"""Projection in plain Warp: several Gaussians abreast in the lanes of a CPU, and float64 on every device."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.constants import LARGEST_COEFFICIENT
from warpgs.kernels import ellipse, sh
from warpgs.kernels.cameras import types_of
from warpgs.kernels.ellipse import PROJECTED_SIZE, arrays_of, make_projection, make_spans
from warpgs.kernels.native import EXACT, Ints

LANES = 16
"""Gaussians of a task."""


@functools.cache
def make_lanes(real, size: int):
    """Make the type of vectors of ``size`` numbers for all lanes, and its functions; a loop over the lanes vectorises."""
    vector, Rows = wp.types.vector(size, real), wp.array2d(dtype=real)
    lane_vectors = wp.types.vector(size * LANES, real)  # each number of all lanes is contiguous
    count = wp.constant(size)

    @wp.func(inline=True)
    def at(entry: wp.ref[real]) -> real:
        """Return an entry of a vector that is taken by reference; Warp would copy the vector otherwise."""
        return entry

    @wp.func(inline=True)
    def put(v: vector, lane: wp.int32, to: wp.ref[lane_vectors]):
        """Store the vector of a lane."""
        for k in range(count):  # Warp unrolls loops that hold a `wp.static`
            to[wp.static(k * LANES) + lane] = v[k]

    @wp.func(inline=True)
    def load(rows: Rows, i: wp.int32, lane: wp.int32, to: wp.ref[lane_vectors]):
        """Store a row of a table in a lane."""
        for k in range(count):
            to[wp.static(k * LANES) + lane] = rows[i, k]

    @wp.func(inline=True)
    def add(hit: bool, v: vector, lane: wp.int32, to: wp.ref[lane_vectors]):
        """Add to the vector of a lane if it is hit."""
        for k in range(count):
            to[wp.static(k * LANES) + lane] = at(to[wp.static(k * LANES) + lane]) + wp.where(hit, v[k], real(0.0))

    @wp.func(inline=True)
    def get(vectors: wp.ref[lane_vectors], lane: wp.int32) -> vector:
        """Return the vector of a lane."""
        v = vector()
        for k in range(count):
            v[k] = at(vectors[wp.static(k * LANES) + lane])
        return v

    return SimpleNamespace(vectors=lane_vectors, vector=vector, put=put, load=load, add=add, get=get)


@functools.cache
def make_shapes(real, parameters: str):
    """Make the record of a task's Gaussians, and the function that stores one; lanes beyond the last hold zeros."""
    scales_of = make_projection(real, "pinhole", parameters).scales_of
    three, four = make_lanes(real, 3), make_lanes(real, 4)
    _, vec3, vec4, *_ = types_of(real)

    @wp.struct
    class Shapes:
        """Parameters of the Gaussians, or their gradients."""

        mean: three.vectors  # [u]
        quat: four.vectors
        scale: three.vectors  # activated [u]

    @wp.func(inline=True)
    def store(mean: vec3, quat: vec4, log_scale: vec3, lane: wp.int32, shapes: wp.ref[Shapes]):
        """Store a Gaussian in its lane."""
        three.put(mean, lane, shapes.mean)
        four.put(quat, lane, shapes.quat)
        three.put(scales_of(log_scale), lane, shapes.scale)

    return SimpleNamespace(Shapes=Shapes, store=store)


# The forward kernel of `project` for the CPU, in plain Warp.
#
# A task projects `LANES` Gaussians. Most operations are loops over the lanes without branches, which the compiler
# vectorises. Loads, calls of the C library, and colours are done for one Gaussian at a time.


@functools.cache
def make_forward(real, camera_model: str, parameters: str, antialiased: bool, bases: int):
    """Make the kernel; arguments are those of `project_cuda.make_forward`."""
    m = make_projection(real, camera_model, parameters, lanes=True)
    s = make_spans(real)
    g = make_shapes(real, parameters)
    three, four, row, basis = (make_lanes(real, size) for size in (3, 4, PROJECTED_SIZE, bases))
    basis_of = sh.make_functions(real, bases).basis
    _, vec3, _, _, _, Reals = types_of(real)
    Vec3s, Vec4s, Mat33s, Mat44s, Rows, Vec3Rows = arrays_of(real)
    lane_reals, lane_ints = (wp.types.vector(LANES, kind) for kind in (real, wp.int32))

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT)
    def forward(
        begin: int,
        means: Vec3s, quats: Vec4s, log_scales: Vec3s,
        logit_opacities: Reals, coefficients: Vec3Rows,
        viewmats: Mat44s, Ks: Mat33s, lenses: Rows,
        opacity_factors: Reals,
        width: int, height: int, origin_x: int, origin_y: int, window_width: int, window_height: int,
        tile_size: int, sh_count: int,
        near: real, far: real, low_pass: real, alpha_cut: real, square_sigma: real,
        # outputs
        projected: Rows, tile_counts: Ints,
    ):  # fmt: skip
        task = begin + wp.tid()
        count = means.shape[0]
        tasks = (count + LANES - 1) // LANES
        camera = task // tasks
        first = (task - camera * tasks) * LANES
        used = wp.min(LANES, count - first)
        view = viewmats[camera]
        K = Ks[camera]
        lens = lenses[camera]

        shapes = g.Shapes()
        opacity = lane_reals()
        for lane in range(used):
            n = first + lane
            g.store(means[n], quats[n], log_scales[n], lane, shapes)
            opacity[lane] = m.opacity_of(logit_opacities[n])
            if opacity_factors.shape[0] > 0:
                opacity[lane] = opacity[lane] * opacity_factors[n]

        valid = lane_ints()
        rows = row.vectors()  # without colours, and at first without sides
        shrink = lane_reals()
        covariances = three.vectors()
        for lane in range(LANES):
            e = m.ellipse(
                three.get(shapes.mean, lane), four.get(shapes.quat, lane), three.get(shapes.scale, lane),
                view, K, lens, real(width), real(height), near, low_pass,
            )  # fmt: skip
            if wp.static(antialiased):
                opacity[lane] = opacity[lane] * m.compensation(e)
            factor = m.factor_of(e)
            o = opacity[lane]
            shown = m.finite3(factor) and m.depth_of(e.position) <= far and o - o == real(0.0)
            valid[lane] = wp.where(shown and o > real(0.0) and o >= alpha_cut, e.valid, 0)
            v = row.vector()
            v[0] = e.pixel[0]
            v[1] = e.pixel[1]
            v[2] = factor[0]
            v[3] = factor[1]
            v[4] = factor[2]
            v[5] = o
            v[9] = m.depth_of(e.position)
            row.put(v, lane, rows)
            shrink[lane] = e.shrink
            three.put(vec3(e.a, e.b, e.c), lane, covariances)

        reach = lane_reals()
        for lane in range(used):
            if valid[lane] != 0:
                reach[lane] = s.reach_of(opacity[lane], alpha_cut, square_sigma)
        begin_row = lane_ints()
        end_row = lane_ints()
        tiles = lane_ints()
        for lane in range(LANES):
            c = three.get(covariances, lane)
            half = s.half_sides(c[0], c[1], c[2], shrink[lane], reach[lane], alpha_cut, square_sigma)
            p = row.get(rows, lane)
            span = s.tile_rows(p[1], half[1], origin_y, window_height, tile_size)
            begin_row[lane] = wp.where(valid[lane] != 0, span[0], 0)
            end_row[lane] = wp.where(valid[lane] != 0, span[1], 0)
            rows[10 * LANES + lane] = half[0]
            rows[11 * LANES + lane] = half[1]
        most = int(0)
        for lane in range(used):
            most = wp.max(most, end_row[lane] - begin_row[lane])
        for k in range(most):
            for lane in range(LANES):
                y = begin_row[lane] + k
                p = row.get(rows, lane)
                factor = vec3(p[2], p[3], p[4])
                span = s.tile_columns(p[0], p[1], factor, reach[lane], p[10], p[11], y, origin_x, window_width, tile_size)
                tiles[lane] = tiles[lane] + wp.where(y < end_row[lane], span[1] - span[0], 0)

        # last, since it reads the most
        values = basis.vectors()
        for lane in range(LANES):
            d = m.direction(three.get(shapes.mean, lane), view)
            basis.put(basis_of(vec3(d[0], d[1], d[2])), lane, values)
        for lane in range(used):
            n = first + lane
            i = camera * count + n
            color = vec3(real(0.5), real(0.5), real(0.5))
            if tiles[lane] > 0:
                largest = vec3()
                k = int(0)
                while k < sh_count:
                    coefficient = coefficients[wp.max(n, 0), wp.max(k, 0)]
                    color += values[wp.max(k, 0) * LANES + lane] * coefficient
                    for channel in range(3):  # a NaN makes the colour one
                        size = wp.abs(coefficient[channel])
                        largest[channel] = wp.where(largest[channel] < size, size, largest[channel])
                    k += 1
                if not (m.finite3(color) and wp.max(largest) <= real(LARGEST_COEFFICIENT)):
                    tiles[lane] = 0
            tile_counts[i] = tiles[lane]
            v = row.vector()
            if tiles[lane] > 0:
                v = row.get(rows, lane)
                for channel in range(3):
                    v[6 + channel] = wp.max(color[channel], real(0.0))
            for k in range(PROJECTED_SIZE):
                projected[i, k] = v[k]

    return forward


@functools.cache
def make_backward(real, camera_model: str, parameters: str, antialiased: bool, bases: int, camera_gradients: bool):
    """Make the kernel; each task sums over all cameras, so no sum needs atomics. Arguments are those of `make_forward`."""
    m = make_projection(real, camera_model, parameters, lanes=True)
    f = ellipse.make_functions(real, camera_model, parameters, antialiased, bases, lanes=True)
    gaussians = make_shapes(real, parameters)
    three, four, nine, row, basis = (make_lanes(real, size) for size in (3, 4, 9, PROJECTED_SIZE, bases))
    basis_of = sh.make_functions(real, bases).basis
    _, vec3, _, mat33, mat44, Reals = types_of(real)
    Vec3s, Vec4s, Mat33s, Mat44s, Rows, Vec3Rows = arrays_of(real)
    vec9 = wp.types.vector(9, real)
    lane_reals, lane_ints = (wp.types.vector(LANES, kind) for kind in (real, wp.int32))

    @wp.func
    def flat(a: mat33) -> vec9:
        return vec9(a[0, 0], a[0, 1], a[0, 2], a[1, 0], a[1, 1], a[1, 2], a[2, 0], a[2, 1], a[2, 2])

    @wp.func
    def square(v: vec9) -> mat33:
        return mat33(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8])

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT)
    def backward(
        begin: int,
        means: Vec3s, quats: Vec4s, log_scales: Vec3s,
        logit_opacities: Reals, coefficients: Vec3Rows,
        viewmats: Mat44s, Ks: Mat33s, lenses: Rows,
        width: int, height: int, sh_count: int, near: real, low_pass: real,
        projected: Rows, tile_counts: Ints, v_projected: Rows,
        # outputs; those of the cameras zero on entry
        v_means: Vec3s, v_quats: Vec4s, v_log_scales: Vec3s,
        v_logit_opacities: Reals, v_coefficients: Vec3Rows,
        v_viewmats: wp.array2d(dtype=mat44), v_Ks: wp.array2d(dtype=mat33),
    ):  # fmt: skip
        count = means.shape[0]
        first = (begin + wp.tid()) * LANES
        used = wp.min(LANES, count - first)
        shapes = gaussians.Shapes()
        for lane in range(used):
            n = first + lane
            gaussians.store(means[n], quats[n], log_scales[n], lane, shapes)

        # sums over the cameras; the number of cameras that saw a lane; whether this one does
        sums = gaussians.Shapes()
        v_logit = lane_reals()
        views = lane_ints()
        seen = lane_ints()
        rows = row.vectors()
        v_rows = row.vectors()
        values = basis.vectors()
        weights = basis.vectors()
        centered = three.vectors()
        positions = three.vectors()  # these four for the gradients of the cameras
        turned = nine.vectors()
        units = four.vectors()
        v_K = nine.vectors()
        for camera in range(viewmats.shape[0]):
            view = viewmats[camera]
            K = Ks[camera]
            lens = lenses[camera]
            for lane in range(used):
                i = camera * count + first + lane
                seen[lane] = wp.where(tile_counts[i] > 0, 1, 0)
                if tile_counts[i] > 0:
                    row.load(projected, i, lane, rows)
                    row.load(v_projected, i, lane, v_rows)
            for lane in range(LANES):
                g = f.shape(
                    three.get(shapes.mean, lane), four.get(shapes.quat, lane), three.get(shapes.scale, lane),
                    view, K, lens, real(width), real(height), near, low_pass, row.get(rows, lane), row.get(v_rows, lane), 0,
                )  # fmt: skip
                hit = seen[lane] != 0
                three.add(hit, g.mean, lane, sums.mean)
                four.add(hit, g.quat, lane, sums.quat)
                three.add(hit, g.log_scale, lane, sums.scale)
                if wp.static(camera_gradients):
                    three.put(g.position, lane, positions)
                    nine.put(flat(g.turned), lane, turned)
                    four.put(g.unit, lane, units)
                    nine.put(flat(g.K), lane, v_K)
            for lane in range(LANES):
                d = m.direction(three.get(shapes.mean, lane), view)
                basis.put(basis_of(vec3(d[0], d[1], d[2])), lane, values)
            for lane in range(used):
                if seen[lane] != 0:
                    n = wp.max(first + lane, 0)
                    p = row.get(rows, lane)
                    v_p = row.get(v_rows, lane)
                    v_logit[lane] = v_logit[lane] + f.logit(p, v_p, 0, logit_opacities[n])
                    v_color = f.color(p, v_p, 0)
                    k = int(0)
                    while k < sh_count:
                        o = wp.max(k, 0)
                        weights[o * LANES + lane] = wp.dot(coefficients[n, o], v_color)
                        v_coefficient = values[o * LANES + lane] * v_color
                        if views[lane] > 0:
                            v_coefficient += v_coefficients[n, o]
                        v_coefficients[n, o] = v_coefficient
                        k += 1
                    views[lane] = views[lane] + 1
            for lane in range(LANES):
                d = m.direction(three.get(shapes.mean, lane), view)
                v_centered = f.centered(d, basis.get(weights, lane))
                hit = seen[lane] != 0
                three.put(v_centered, lane, centered)
                three.add(hit, v_centered, lane, sums.mean)
            if wp.static(camera_gradients):
                for lane in range(used):
                    if seen[lane] != 0:
                        n = first + lane
                        v_centered = three.get(centered, lane)
                        v_viewmats[camera, n] = f.view_gradient(
                            view, means[n], quats[n], log_scales[n], three.get(positions, lane),
                            square(nine.get(turned, lane)), four.get(units, lane), v_centered,
                        )  # fmt: skip
                        v_Ks[camera, n] = square(nine.get(v_K, lane))
        for lane in range(used):
            n = first + lane
            v_means[n] = three.get(sums.mean, lane)
            v_quats[n] = four.get(sums.quat, lane)
            v_log_scales[n] = three.get(sums.scale, lane)
            v_logit_opacities[n] = v_logit[lane]
            k = wp.where(views[lane] > 0, sh_count, 0)
            while k < v_coefficients.shape[1]:
                v_coefficients[n, k] = vec3()
                k += 1

    return backward
