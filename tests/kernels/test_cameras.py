"""The seam for camera models: a model that only this file knows renders, with right gradients."""

import dataclasses

import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, hand_placed, leaves
from tests.parallel_camera import NAME
from warpgs.constants import RULES
from warpgs.errors import UsageError
from warpgs.kernels.project import project
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize

BENDS = [[0.05, -0.02, 0.03, 0.01], [-0.04, 0.02, 0.01, 0.03]]


def parallel(**options):
    """Return a parallel camera that shows about what `camera` shows at depth 4."""
    cam = camera(**options)
    K = cam.K.clone()
    K[..., 0, 0] /= 4
    K[..., 1, 1] /= 4
    return dataclasses.replace(cam, K=K, model=NAME, distortion=K.new_zeros(*K.shape[:-2], 4))


def test_gradcheck_of_another_model(device):
    """Finite differences agree for Gaussians, poses and intrinsics; each camera has its own coefficients."""
    gaussians, cam = leaves(hand_placed(device=device)), parallel(cameras=2, device=device)
    bends = torch.tensor(BENDS).to(cam.K)
    inputs = [*gaussians.tensors().values(), cam.viewmat.requires_grad_(), cam.K.requires_grad_()]

    def values(*tensors):
        options = {
            "width": cam.width,
            "height": cam.height,
            "degree": 3,
            "rule": SMOOTH,
            "camera_model": cam.model,
            "distortion": bends,
        }
        return project(*tensors, **options)[0][..., :10]

    assert bool((values(*inputs) != 0).all())
    assert torch.autograd.gradcheck(values, inputs, eps=1e-6, atol=1e-7, rtol=1e-5, nondet_tol=0.0)


@pytest.mark.parametrize("max_instances", [None, 100])
def test_another_model_renders(device, dtype, max_instances):
    """Depth does not matter to a parallel projection: Gaussians moved away along its axis give the same colours and alpha."""
    gaussians, cam = cloud(60, dtype, device), parallel(width=40, height=30, dtype=dtype, device=device)
    options = RasterizeOptions(sh_degree=0, max_instances=max_instances)
    moved = dataclasses.replace(gaussians, means=gaussians.means + torch.tensor([0, 0, 4.0]).to(gaussians.means))
    near, far = rasterize(gaussians, cam, options), rasterize(moved, cam, options)
    assert float(near.alpha.max()) > 0.5
    assert torch.allclose(near.rgb, far.rgb, atol=1e-5) and torch.allclose(near.alpha, far.alpha, atol=1e-5)
    pinhole = dataclasses.replace(cam, model="pinhole", distortion=None, K=camera(40, 30, dtype=dtype, device=device).K)
    images = [rasterize(g, pinhole, options).alpha for g in (gaussians, moved)]
    assert not torch.allclose(*images, atol=0.1)


def test_unknown_models_are_refused():
    """The error names the models there are."""
    cam = dataclasses.replace(camera(dtype=torch.float32), model="fish")
    with pytest.raises(UsageError, match=r"unknown camera model 'fish'; choose one of fisheye, opencv, orthographic, pinhole"):
        rasterize(cloud(3), cam)
    options = {"width": 18, "height": 17, "degree": 1, "rule": RULES["exact"], "camera_model": "fish"}
    with pytest.raises(UsageError, match="unknown camera model 'fish'"):
        project(*cloud(3).tensors().values(), cam.viewmat[None], cam.K[None], **options)


def test_coefficients_of_another_number_are_refused():
    """The error names both numbers; coefficients that require gradients are refused, since they have none."""
    cam = parallel(dtype=torch.float32)
    for wrong in (None, cam.K.new_zeros(3)):
        with pytest.raises(UsageError, match=f"'{NAME}' takes 4 coefficients of distortion, found {0 if wrong is None else 3}"):
            rasterize(cloud(3), dataclasses.replace(cam, distortion=wrong))
    with pytest.raises(UsageError, match=r"'pinhole' takes no distortion, found 4 coefficients.* model=.fisheye. \(4\)"):
        rasterize(cloud(3), dataclasses.replace(cam, model="pinhole"))
    learned = dataclasses.replace(cam, distortion=cam.K.new_zeros(4).requires_grad_())
    with pytest.raises(UsageError, match="gradients of distortion coefficients are not supported"):
        rasterize(leaves(cloud(3)), learned)
