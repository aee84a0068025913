"""Shared parts of the projection kernels of the CPU: the Gaussians of a task, a lane each, and the basis of their colours."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.kernels import sh
from warpgs.kernels.functions import make_projection

LANES = 16
"""Gaussians of a task."""


@functools.cache
def make_lanes(real, camera_model: str, parameters: str, bases: int):
    """Make the record of a task's Gaussians and its functions; arguments are those of `project_cpu_backward.make_backward`.

    A loop over the lanes vectorises, since each value of all lanes is contiguous.
    """
    m = make_projection(real, camera_model, parameters)
    basis_of = sh.make_functions(real, bases).basis
    vec3 = m.vec3
    vec4 = m.vec4
    lane_reals = wp.types.vector(LANES, real)
    lane_bases = wp.types.vector(bases * LANES, real)
    lanes = wp.constant(LANES)

    @wp.struct
    class Shapes:
        """Parameters of the Gaussians; lanes beyond the last hold zeros."""

        mean_x: lane_reals  # [u]
        mean_y: lane_reals
        mean_z: lane_reals
        quat_w: lane_reals
        quat_x: lane_reals
        quat_y: lane_reals
        quat_z: lane_reals
        scale_x: lane_reals  # activated [u]
        scale_y: lane_reals
        scale_z: lane_reals

    @wp.func(inline=True)
    def at(entry: wp.ref[real]) -> real:
        """Return an entry of a vector that is taken by reference; Warp would copy the vector otherwise."""
        return entry

    @wp.func(inline=True)
    def store(mean: vec3, quat: vec4, log_scale: vec3, lane: wp.int32, shapes: wp.ref[Shapes]):
        """Store a Gaussian in its lane."""
        scale = m.scales_of(log_scale)
        shapes.mean_x[lane] = mean[0]
        shapes.mean_y[lane] = mean[1]
        shapes.mean_z[lane] = mean[2]
        shapes.quat_w[lane] = quat[0]
        shapes.quat_x[lane] = quat[1]
        shapes.quat_y[lane] = quat[2]
        shapes.quat_z[lane] = quat[3]
        shapes.scale_x[lane] = scale[0]
        shapes.scale_y[lane] = scale[1]
        shapes.scale_z[lane] = scale[2]

    @wp.func(inline=True)
    def mean_of(s: wp.ref[Shapes], lane: wp.int32) -> vec3:
        """Return the mean of a lane [u]."""
        return vec3(at(s.mean_x[lane]), at(s.mean_y[lane]), at(s.mean_z[lane]))

    @wp.func(inline=True)
    def quat_of(s: wp.ref[Shapes], lane: wp.int32) -> vec4:
        """Return the quaternion of a lane."""
        return vec4(at(s.quat_w[lane]), at(s.quat_x[lane]), at(s.quat_y[lane]), at(s.quat_z[lane]))

    @wp.func(inline=True)
    def scales_of(s: wp.ref[Shapes], lane: wp.int32) -> vec3:
        """Return the activated scales of a lane [u]."""
        return vec3(at(s.scale_x[lane]), at(s.scale_y[lane]), at(s.scale_z[lane]))

    @wp.func(inline=True)
    def store_basis(d: vec4, lane: wp.int32, basis: wp.ref[lane_bases]):
        """Store the basis at a direction."""
        y = basis_of(vec3(d[0], d[1], d[2]))
        for k in range(wp.static(bases)):
            basis[k * lanes + lane] = y[k]

    return SimpleNamespace(
        Shapes=Shapes, lane_bases=lane_bases, at=at, store=store, mean_of=mean_of, quat_of=quat_of, scales_of=scales_of,
        store_basis=store_basis,
    )  # fmt: skip
