"""The seam for camera models: a model that only this file knows renders, with right gradients."""

import dataclasses
import functools
from types import SimpleNamespace

import pytest
import torch
import warp as wp

from tests.gaussians import SMOOTH, camera, cloud, hand_placed, leaves
from warpgs.constants import RULES
from warpgs.errors import UsageError
from warpgs.kernels.cameras.base import CameraModel, register
from warpgs.kernels.project import project
from warpgs.render.rasterize import RasterizeOptions, rasterize


@register("test_orthographic")
class Orthographic(CameraModel):
    """Parallel projection: K[0, 0] and K[1, 1] are pixels per unit of length, whatever the depth."""

    @staticmethod
    def make_functions(real):
        return make_orthographic(real)


@functools.cache
def make_orthographic(real):
    vec2 = wp.types.vector(2, real)
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)

    @wp.struct
    class Rows:
        first: vec3
        second: vec3

    @wp.struct
    class Gradients:
        v_position: vec3
        v_K: mat33

    @wp.func
    def in_range(position: vec3, lens: wp.array(dtype=real), near: real) -> wp.bool:
        return position[2] >= near and wp.isfinite(position[2])

    @wp.func
    def pixel_of(position: vec3, K: mat33, lens: wp.array(dtype=real)) -> vec2:
        return vec2(K[0, 0] * position[0] + K[0, 2], K[1, 1] * position[1] + K[1, 2])

    @wp.func
    def expansion_point(pixel: vec2, width: real, height: real) -> vec2:
        return pixel

    @wp.func
    def project_axes(position: vec3, K: mat33, lens: wp.array(dtype=real), point: vec2, axes: mat33) -> Rows:
        rows = Rows()
        rows.first = K[0, 0] * vec3(axes[0, 0], axes[0, 1], axes[0, 2])
        rows.second = K[1, 1] * vec3(axes[1, 0], axes[1, 1], axes[1, 2])
        return rows

    @wp.func
    def axes_backward(
        position: vec3, K: mat33, lens: wp.array(dtype=real), point: vec2, v_first: vec3, v_second: vec3
    ) -> mat33:
        g0 = K[0, 0] * v_first
        g1 = K[1, 1] * v_second
        zero = real(0.0)
        return mat33(g0[0], g0[1], g0[2], g1[0], g1[1], g1[2], zero, zero, zero)

    @wp.func
    def position_backward(
        position: vec3, K: mat33, lens: wp.array(dtype=real), pixel: vec2, point: vec2, axes: mat33,
        v_first: vec3, v_second: vec3, v_pixel: vec2, v_depth: real,
    ) -> Gradients:  # fmt: skip
        g = Gradients()
        g.v_position = vec3(v_pixel[0] * K[0, 0], v_pixel[1] * K[1, 1], v_depth)
        v_K = mat33()
        v_K[0, 0] = v_pixel[0] * position[0] + wp.dot(v_first, vec3(axes[0, 0], axes[0, 1], axes[0, 2]))
        v_K[1, 1] = v_pixel[1] * position[1] + wp.dot(v_second, vec3(axes[1, 0], axes[1, 1], axes[1, 2]))
        v_K[0, 2] = v_pixel[0]
        v_K[1, 2] = v_pixel[1]
        g.v_K = v_K
        return g

    return SimpleNamespace(
        in_range=in_range, pixel_of=pixel_of, expansion_point=expansion_point, project_axes=project_axes,
        axes_backward=axes_backward, position_backward=position_backward,
    )  # fmt: skip


def orthographic(**options):
    """Return a parallel camera that shows about what `camera` shows at depth 4."""
    cam = camera(**options)
    K = cam.K.clone()
    K[..., 0, 0] /= 4
    K[..., 1, 1] /= 4
    return dataclasses.replace(cam, K=K, model="test_orthographic")


def test_gradcheck_of_another_model(device):
    """Finite differences agree for Gaussians, poses and intrinsics."""
    gaussians, cam = leaves(hand_placed(device=device)), orthographic(cameras=2, device=device)
    inputs = [*gaussians.tensors().values(), cam.viewmat.requires_grad_(), cam.K.requires_grad_()]

    def values(*tensors):
        options = {"width": cam.width, "height": cam.height, "degree": 3, "rule": SMOOTH, "camera_model": cam.model}
        return project(*tensors, **options)[0][..., :10]

    assert bool((values(*inputs) != 0).all())
    assert torch.autograd.gradcheck(values, inputs, eps=1e-6, atol=1e-7, rtol=1e-5, nondet_tol=0.0)


@pytest.mark.parametrize("max_instances", [None, 100])
def test_another_model_renders(device, dtype, max_instances):
    """Depth does not matter to a parallel projection: Gaussians moved away along its axis give the same colours and alpha."""
    gaussians, cam = cloud(60, dtype, device), orthographic(width=40, height=30, dtype=dtype, device=device)
    options = RasterizeOptions(sh_degree=0, max_instances=max_instances)
    moved = dataclasses.replace(gaussians, means=gaussians.means + torch.tensor([0, 0, 4.0]).to(gaussians.means))
    near, far = rasterize(gaussians, cam, options), rasterize(moved, cam, options)
    assert float(near.alpha.max()) > 0.5
    assert torch.allclose(near.rgb, far.rgb, atol=1e-5) and torch.allclose(near.alpha, far.alpha, atol=1e-5)
    pinhole = dataclasses.replace(cam, model="pinhole", K=camera(40, 30, dtype=dtype, device=device).K)
    images = [rasterize(g, pinhole, options).alpha for g in (gaussians, moved)]
    assert not torch.allclose(*images, atol=0.1)


def test_unknown_models_are_refused():
    """The error names the models there are."""
    cam = dataclasses.replace(camera(dtype=torch.float32), model="fisheye")
    with pytest.raises(UsageError, match=r"no camera model 'fisheye'; choose one of pinhole"):
        rasterize(cloud(3), cam)
    options = {"width": 18, "height": 17, "degree": 1, "rule": RULES["exact"], "camera_model": "fisheye"}
    with pytest.raises(UsageError, match="no camera model 'fisheye'"):
        project(*cloud(3).tensors().values(), cam.viewmat[None], cam.K[None], **options)
