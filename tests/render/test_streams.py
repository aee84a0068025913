"""Loops and fits on a CUDA stream of their own: torch does not warn of AccumulateGrad nodes on another stream."""

import dataclasses
import warnings

import pytest
import torch

from tests.gaussians import camera, cloud, leaves
from tests.scenes import photos, seeds
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.view_modules import Exposure, RefinePoses
from warpgs.render.graphed import MIN_CALLS
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize

pytestmark = pytest.mark.cuda
CUDA = torch.device("cuda", 0)


@pytest.fixture(autouse=True)
def the_warning_is_an_error():
    """It raises each time that torch has a reason for it."""
    before = torch.is_warn_always_enabled()
    torch.set_warn_always(True)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="The AccumulateGrad node")
        yield
    torch.set_warn_always(before)


@pytest.fixture(params=[False, True], ids=["default stream", "own stream"])
def stream(request):
    """Torch's current stream while a test runs."""
    own = torch.cuda.Stream() if request.param else torch.cuda.current_stream()
    own.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(own):
        yield own
    torch.cuda.current_stream().wait_stream(own)


def test_the_warning_is_seen():
    """Where a loop keeps a render of another stream, which ties the leaves to that stream."""
    g, cam = leaves(cloud(50, device=CUDA)), camera(20, 12, dtype=torch.float32, device=CUDA)
    held, own = rasterize(g, cam).rgb, torch.cuda.Stream()
    own.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(own), pytest.raises(UserWarning, match="stream does not match"):
        rasterize(g, cam).rgb.sum().backward()
    torch.cuda.current_stream().wait_stream(own)
    assert held.requires_grad


@pytest.mark.parametrize("record", [True, False])
@pytest.mark.parametrize(
    "more", [{}, {"absgrad": True, "contributions": True, "median_depth": True, "heaviest": 2}], ids=["", "all"]
)
def test_a_training_loop_does_not_warn(stream, record, more):
    """An optimizer over Gaussians, pose and background; a render is kept from step to step, as loops that log do."""
    g, cam = leaves(cloud(300, device=CUDA)), camera(70, 50, dtype=torch.float32, device=CUDA)
    pose, background = cam.viewmat.clone().requires_grad_(), torch.zeros(3, device=CUDA, requires_grad=True)
    optimizer = torch.optim.Adam([*g.tensors().values(), pose, background], lr=1e-3)
    target = rasterize(g, cam).rgb.detach() * 0.9
    losses = []
    for _ in range(3 * MIN_CALLS):
        options = RasterizeOptions(background=background, record=record, **more)
        render = rasterize(g, dataclasses.replace(cam, viewmat=pose), options)
        means2d = render.means2d if more else None
        loss = (render.rgb - target).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.detach())
    assert float(losses[-1]) < float(losses[0]) and bool(torch.isfinite(pose.grad).all())
    assert means2d is None or bool(means2d.absgrad.any())


def test_a_loop_that_moves_to_another_stream_does_not_warn():
    """Where nothing holds the graph of the last step: leaves that were used on one stream are used on another."""
    g, cam = leaves(cloud(300, device=CUDA)), camera(70, 50, dtype=torch.float32, device=CUDA)
    for own in (torch.cuda.current_stream(), torch.cuda.Stream(), torch.cuda.current_stream()):
        own.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(own):
            for _ in range(2 * MIN_CALLS):
                rasterize(g, cam).rgb.square().mean().backward()
        torch.cuda.current_stream().wait_stream(own)
    assert bool(g.means.grad.any())


@pytest.mark.parametrize("batch", [1, 2])
def test_a_fit_does_not_warn(stream, batch):
    """Steps from Python, then replayed; poses and exposures are leaves, too, and Gaussians are added in between."""
    density = DensityConfig(start=5, every=10)
    modules = (RefinePoses(start=0), Exposure())
    config = FitConfig(steps=40, batch=batch, density=density, view_modules=modules, init=InitConfig(source="points"))
    trainer = Trainer(photos(4), seeds(), config, CUDA)
    count = len(trainer.gaussians)
    while trainer.step < config.steps:
        trainer.advance()
    assert len(trainer.gaussians) != count
