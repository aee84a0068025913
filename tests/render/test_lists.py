"""Lists of cameras of different sizes, of scenes and of options: the bits of separate calls."""

import dataclasses

import pytest
import torch

from tests.gaussians import camera, cloud, leaves
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import ActivatedGaussians


def cameras(device):
    """Two single cameras and a batch, of three sizes."""
    made = [camera(*size, dtype=torch.float32, device=device) for size in ((40, 30), (18, 57))]
    return [*made, camera(25, 25, cameras=2, dtype=torch.float32, device=device)]


def gradients(renders, gaussians):
    """Gradients of all images by all tensors."""
    tensors = [t for g in gaussians for t in g.tensors().values()]
    return torch.autograd.grad(sum(r.rgb.square().sum() + r.depth.sum() for r in renders), tensors)


def test_cameras_of_different_sizes(device):
    """One scene: a render for each camera, in their order, as separate calls give them; a tuple is a list."""
    scene, cams = leaves(cloud(80, device=device)), cameras(device)
    options = RasterizeOptions(rule="balanced", background=torch.tensor([0.2, 0.4, 0.6], device=device))
    separate = [rasterize(scene, cam, options) for cam in cams]
    together = rasterize(scene, tuple(cams), options)
    assert [r.rgb.shape[-3:-1] for r in together] == [(30, 40), (57, 18), (25, 25)]
    for a, b in zip(separate, together, strict=True):
        assert torch.equal(a.rgb, b.rgb) and torch.equal(a.depth, b.depth)
    for a, b in zip(gradients(separate, [scene]), gradients(together, [scene]), strict=True):
        assert torch.equal(a, b) and bool(a.any())


def test_scenes_of_different_counts_and_options(device):
    """A scene and options for each camera: as many Gaussians as each has, of either kind, with colours of its own."""
    stored = [leaves(cloud(n, device=device, seed=n)) for n in (30, 0, 70)]
    t = {n: v.detach() for n, v in stored[2].tensors().items()}
    last = (t["means"], t["quats"], t["log_scales"].exp(), t["logit_opacities"].sigmoid())
    scenes = [*stored[:2], ActivatedGaussians(*(v.requires_grad_() for v in last), sh=stored[2].sh)]
    options = [RasterizeOptions(colors=torch.rand(30, 5).to(device)), RasterizeOptions(), RasterizeOptions(antialiased=True)]
    separate = [rasterize(g, c, o) for g, c, o in zip(scenes, cameras(device), options)]
    together = rasterize(scenes, cameras(device), options)
    for a, b in zip(separate, together, strict=True):
        assert torch.equal(a.rgb, b.rgb) and a.rgb.shape == b.rgb.shape
    own = [scenes[2]]
    assert all(torch.equal(a, b) for a, b in zip(gradients(separate[2:], own), gradients(together[2:], own)))


def test_lists_that_do_not_go_together(device):
    """Lengths are compared, and what is no camera is named; no camera gives no render."""
    scene, cams = cloud(5, device=device), cameras(device)
    assert rasterize(scene, []) == []
    with pytest.raises(ValueError, match="2 gaussians for 3 cameras: give one for all, or one for each camera"):
        rasterize([scene, scene], cams)
    with pytest.raises(ValueError, match="1 options for 3 cameras"):
        rasterize(scene, cams, [RasterizeOptions()])
    with pytest.raises(TypeError, match=r"gaussians must be an instance .* a list of gaussians requires a list of cameras"):
        rasterize([scene], cams[0])
    with pytest.raises(TypeError, match="camera must be an instance of Camera, not str"):
        rasterize(scene, [cams[0], "left"])
    with pytest.raises(ValueError, match=r"camera.K must have shape"):
        rasterize(scene, [cams[0], dataclasses.replace(cams[0], K=torch.eye(4))])
