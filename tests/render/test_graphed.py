"""Graphed calls as far as they need no GPU: which are captured, when, and the results without graphs."""

import dataclasses
import gc
import itertools
import weakref
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from tests.gaussians import camera, cloud, leaves
from tests.kernels.test_graphs import Full
from warpgs.constants import RULES
from warpgs.errors import UsageError
from warpgs.kernels.ellipse import ProjectInputs
from warpgs.kernels.falloff import Pass
from warpgs.kernels.graphs import GraphPool
from warpgs.means2d import projected_means
from warpgs.render import graphed
from warpgs.render.compose import inputs_of, pass_of
from warpgs.render.graphed import MIN_CALLS, SPARE, Recorder, call_key
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

CPU = torch.device("cpu")
SETTINGS = Pass((18, 17), (0, 0, 18, 17), RULES["exact"], 4)


class Counted:
    """A rasterizer that renders nothing, for calls of `seen` instances."""

    made, seen = 0, 100

    def __init__(self, settings, cameras, capacity, graphs, gradients):
        type(self).made += 1
        self.limit, self.needed, self.rendered = capacity[1] - SPARE, None, 0

    def render(self, sources, backgrounds):
        self.needed = 5, type(self).seen
        fits = self.needed[1] <= self.limit
        self.rendered += fits
        return "images" if fits else None


@pytest.fixture
def surroundings(monkeypatch):
    monkeypatch.setattr(graphed, "_can_capture", lambda device: True)


@pytest.fixture
def recorder(monkeypatch, surroundings) -> Recorder:
    """A recorder whose rasterizers render nothing; a call has `Counted.seen` instances."""
    Counted.made, Counted.seen = 0, 100
    monkeypatch.setattr(graphed, "GraphedRasterizer", Counted)
    monkeypatch.setattr(graphed, "count_needed", lambda *_: (5, Counted.seen))
    return Recorder(GraphPool(CPU))


@pytest.fixture
def small(surroundings):
    return leaves(cloud(50)), Recorder(Full(CPU)), camera(70, 50, 1, torch.float32)


def batch(**size) -> ProjectInputs:
    return inputs_of(leaves(cloud(20)), camera(dtype=torch.float32, **size))


def test_calls_that_cannot_be_captured_are_not(recorder, monkeypatch):
    """Float64, rows that are not contiguous, too many Gaussians, too little memory; images without gradients in a thread."""
    own = batch()
    monkeypatch.setattr(graphed, "MAX_PROJECTED", 19)
    assert call_key(own, None, SETTINGS) is None
    monkeypatch.setattr(graphed, "MAX_PROJECTED", 20)
    assert call_key(own, None, SETTINGS) is not None
    assert call_key(own, None, SETTINGS, gradients=False) is not None
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(call_key, own, None, SETTINGS, gradients=False).result() is None
        assert pool.submit(call_key, own, None, SETTINGS).result() is not None
    with torch.inference_mode():
        assert call_key(own, None, SETTINGS, gradients=False) is None
    assert call_key(ProjectInputs(*(t.double() for t in own)), None, SETTINGS) is None
    assert call_key(own._replace(means=own.means.T.contiguous().T), None, SETTINGS) is None
    assert call_key(own, torch.zeros(1, 3), SETTINGS) is not None and call_key(own, torch.zeros(3), SETTINGS) is None
    monkeypatch.setattr(graphed, "available_bytes", lambda device: 0)
    assert [recorder.render(own, None, SETTINGS) for _ in range(5)] == [None] * 5 and Counted.made == 0


def test_calls_of_large_scenes_are_captured(surroundings):
    """2.8M Gaussians at 3840 x 2160 px; not where a running sum might overflow."""
    given = batch()
    own = given._replace(**{n: torch.empty(2_794_625, *t.shape[1:], device="meta") for n, t in zip(given._fields[:5], given)})
    large = dataclasses.replace(SETTINGS, size=(3840, 2160), window=(0, 0, 3840, 2160))
    assert call_key(own, None, large) is not None
    assert call_key(own, None, dataclasses.replace(large, window=(0, 0, 2**18, 2**18))) is None


def test_options_beyond_the_image_are_not_captured():
    assert RasterizeOptions(background=torch.ones(3), sh_degree=1).repeatable()
    assert not RasterizeOptions(record=False).repeatable()
    for other in (
        {"deterministic": False}, {"contributions": True}, {"capacity": 5}, {"memory_budget": 5},
        {"max_instances": 5}, {"opacity_factors": torch.ones(3)},
    ):  # fmt: skip
        assert not RasterizeOptions(**other).repeatable()


def results(gaussians, cam, background, recorder=None):
    params = list(gaussians.tensors().values())
    cam = dataclasses.replace(cam, viewmat=cam.viewmat.clone().requires_grad_(), K=cam.K.clone().requires_grad_())
    background = background.clone().requires_grad_()
    if recorder is None:
        r = rasterize(gaussians, cam, RasterizeOptions(background=background))
        rgb, alpha, depth, projected, counts = r.rgb, r.alpha, r.depth, r.projected, r.tile_counts
    else:
        settings = pass_of(cam, gaussians.sh_degree, RULES["exact"])
        found = recorder.render(inputs_of(gaussians, cam), background, settings)
        if found is None:
            return None
        (rgb, alpha, depth), projected, counts = found
    loss = (rgb**2).sum() + alpha.sum() + 0.1 * depth.sum()
    gradients = torch.autograd.grad(loss, [*params, projected, cam.viewmat, cam.K, background], retain_graph=True)
    only_alpha = torch.autograd.grad(alpha.sum(), [*params, background], retain_graph=True)
    (v_unused,) = torch.autograd.grad(projected[..., :2].sum(), params[0])
    return [t.detach() for t in (rgb, alpha, depth, projected, counts, *gradients, *only_alpha, v_unused)]


def test_a_graphed_rasterizer_gives_the_same_bits(surroundings):
    g, own = leaves(cloud(300)), Recorder(Full(CPU))
    cams = camera(70, 50, 3, torch.float32)
    backgrounds = torch.rand(3, 3, generator=torch.Generator().manual_seed(3))
    found = [results(g, cams, backgrounds, own) for _ in range(MIN_CALLS + 1)]
    assert found[: MIN_CALLS - 1] == [None] * (MIN_CALLS - 1)
    wanted = results(g, cams, backgrounds)
    for each in found[MIN_CALLS - 1 :]:
        assert all(torch.equal(a, b) for a, b in itertools.zip_longest(each, wanted))
    # and keep nothing for a backward pass
    g, own = leaves(cloud(300)), Recorder(Full(CPU), gradients=False)
    cam = camera(70, 50, 2, torch.float32)
    settings = pass_of(cam, g.sh_degree, RULES["exact"])
    with torch.no_grad():
        for _ in range(MIN_CALLS + 1):
            found = own.render(inputs_of(g, cam), None, settings)
        wanted = rasterize(g, cam)
    assert own.rasterizer.rendered == 2 and len(own.rasterizer._forward_blend._places) == 0
    for a, b in zip((*found[0], *found[1:]), (wanted.rgb, wanted.alpha, wanted.depth, wanted.projected, wanted.tile_counts)):
        assert torch.equal(a, b) and not a.requires_grad


def test_other_planes_are_another_graph(surroundings):
    """Near and far plane of the rule count, in the image and in gradients."""
    g, cam, own = leaves(cloud(200)), camera(64, 48, dtype=torch.float32), Recorder(Full(CPU))
    for planes in ({}, {"near": 3.5, "far": 4.5}, {"far": 4.0}):
        settings = dataclasses.replace(SETTINGS, size=(64, 48), window=(0, 0, 64, 48))
        settings = dataclasses.replace(settings, rule=dataclasses.replace(RULES["exact"], **planes))
        calls = [own.render(inputs_of(g, cam), None, settings) for _ in range(4 * MIN_CALLS)]  # each time twice as many
        assert calls[0] is None
        found = calls[-1]
        images = found[0][0][0], rasterize(g, cam, RasterizeOptions(**planes)).rgb
        gradients = (torch.autograd.grad(i.square().sum(), list(g.tensors().values())) for i in images)
        assert torch.equal(*images) and all(torch.equal(a, b) for a, b in zip(*gradients))


@pytest.mark.parametrize("short", [(1, 0), (0, 1)], ids=["visible", "instances"])
def test_a_rasterizer_that_is_too_small_says_so(surroundings, short):
    """The call runs without graphs, and the next rasterizer has the capacity."""
    g, own = leaves(cloud(300)), Recorder(Full(CPU))
    cam = camera(70, 50, 1, torch.float32)
    sources = inputs_of(g, cam)
    settings = pass_of(cam, g.sh_degree, RULES["exact"])
    for _ in range(MIN_CALLS):
        found = own.render(sources, None, settings)
    assert found is not None
    own.rasterizer.capacity = tuple(n - one for n, one in zip(own.rasterizer.needed, short))
    assert own.render(sources, None, settings) is None and own.rasterizer is None
    for _ in range(2 * MIN_CALLS):
        found = own.render(sources, None, settings)
    assert found is not None and all(n <= most for n, most in zip(own.rasterizer.needed, own.rasterizer.capacity))


def first_graphed(own: Recorder, g: Gaussians, cam: Camera):
    settings = pass_of(cam, g.sh_degree, RULES["exact"])
    return [own.render(inputs_of(g, cam), None, settings) for _ in range(MIN_CALLS)][-1]


def test_a_rasterizer_is_freed_when_nobody_holds_it(small):
    """It needs no garbage collection: graphs hold memory of the device. A backward pass still to come holds it."""
    g, own, cam = small
    found = first_graphed(own, g, cam)
    gone, loss = weakref.ref(own.rasterizer), found[0][0].sum()
    gc.disable()
    try:
        own.clear()
        del found
        assert gone() is not None
        loss.backward()
        del loss
        assert gone() is None and bool(g.means.grad.any())
    finally:
        gc.enable()


@pytest.mark.parametrize("loss", ["image", "projected", "up to projected"])
def test_backward_passes_are_counted(small, loss):
    """Projected means read after a pass are refused; those read before hold its gradients."""
    g, own, cam = small
    first_graphed(own, g, cam)
    settings = pass_of(cam, g.sh_degree, RULES["exact"])
    for early in (True, False):
        images, projected, _ = own.render(inputs_of(g, cam), None, settings)
        means2d = projected_means([projected], False) if early else None
        y = projected[..., :2].sum() if loss == "projected" else images[0].sum()
        torch.autograd.grad(y, projected if loss == "up to projected" else g.means)
        assert means2d is None or bool(means2d.grad.any())
        with pytest.raises(UsageError, match=r"read render\.means2d before the backward pass"):
            projected_means([projected], False)


def test_the_third_of_equal_calls_is_captured(recorder):
    """Another camera is the same call; other tensors, settings or another background are not, and begin anew."""
    own, other = batch(), batch()
    moved = own._replace(viewmats=own.viewmats + 1, Ks=own.Ks * 2)
    background = torch.zeros(1, 3)
    assert [recorder.render(s, None, SETTINGS) for s in (own, moved, own, own)] == [None] * (MIN_CALLS - 1) + ["images"] * 2
    assert Counted.made == 1
    assert recorder.render(other, None, SETTINGS) is None and recorder.rasterizer is None
    assert recorder.render(own, background, SETTINGS) is None
    assert recorder.render(own, None, dataclasses.replace(SETTINGS, sh_count=1)) is None
    recorder.clear()
    assert [recorder.render(other, None, SETTINGS) for _ in range(3)][-1] == "images" and Counted.made == 2
    # until the recorder is cleared
    own = batch()
    recorder.graphs.failed = True
    assert [recorder.render(own, None, SETTINGS) for _ in range(9)] == [None] * 9
    recorder.clear()
    assert [recorder.render(own, None, SETTINGS) for _ in range(MIN_CALLS)][-1] == "images"


def test_a_default_type_does_not_matter_and_a_change_in_number_is_an_error(small):
    """A default background is of the Gaussians' type."""
    g, own, cam = small
    usual = torch.get_default_dtype()
    torch.set_default_dtype(torch.bfloat16)
    try:
        found = first_graphed(own, g, cam)
    finally:
        torch.set_default_dtype(usual)
    assert torch.equal(found[0][0], rasterize(g, cam).rgb)
    # a swap that autograd does not see would write beside the gradients
    g, own, cam = small
    found = first_graphed(own, g, cam)
    g.means.data = torch.zeros(70, 3)
    with pytest.raises(RuntimeError, match=r"replaced between .*\[50, 3\].*, now .*\[70, 3\]"):
        found[0][0].sum().backward()
