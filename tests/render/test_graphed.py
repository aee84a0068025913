"""Which calls are planned, when kernels are recorded, and what a plan draws without graphs: all that needs no GPU."""

import dataclasses
import gc
import itertools
import weakref

import pytest
import torch

from tests.gaussians import camera, cloud, leaves
from warpgs.constants import RULES
from warpgs.render import graphed
from warpgs.render.graphed import MIN_CALLS, Frame, Recorder, call_key
from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.runtime.cuda_graph import PAID, GraphPool
from warpgs.scene import Camera, Gaussians

CPU = torch.device("cpu")
FRAME = Frame(18, 17, (0, 0, 18, 17), 1, RULES["exact"], 16)


class Counted:
    """A plan that draws nothing, for calls of as many instances as `seen` says."""

    made, seen = 0, 100

    def __init__(self, frame, cameras, capacity, graphs):
        type(self).made += 1
        self.room, self.instances, self.drawn = capacity - 1024, 0, 0

    def render(self, sources, backgrounds):
        self.instances = type(self).seen
        fits = self.instances <= self.room
        self.drawn += fits
        return "pictures" if fits else None


class NoGraphPool(GraphPool):
    """Memory is never enough to record in, as turns out at the end."""

    def capture(self, work):
        work()
        raise torch.OutOfMemoryError


@pytest.fixture
def surroundings(monkeypatch):
    """Those of tensors on a CPU are as good."""
    monkeypatch.setattr(graphed, "_usual_surroundings", lambda device: True)


@pytest.fixture
def recorder(monkeypatch, surroundings) -> Recorder:
    """One whose plans draw nothing; a call has `Counted.seen` instances."""
    Counted.made, Counted.seen = 0, 100
    monkeypatch.setattr(graphed, "Plan", Counted)
    monkeypatch.setattr(graphed.project, "project", lambda *_, **__: (None, torch.tensor([Counted.seen])))
    return Recorder(GraphPool(CPU))


def sources_of(gaussians: Gaussians, cam: Camera) -> tuple[torch.Tensor, ...]:
    return (*gaussians.tensors().values(), cam.viewmat[None], cam.K[None])


def batch(**size) -> tuple[torch.Tensor, ...]:
    return sources_of(leaves(cloud(20)), camera(dtype=torch.float32, **size))


def test_the_third_of_equal_calls_is_planned(recorder):
    """Another camera is the same call; other tensors, another size or another background are not, and begin anew."""
    own, other = batch(), batch()
    moved = (*own[:5], own[5] + 1, own[6] * 2)
    background = torch.zeros(1, 3)
    assert [recorder.render(s, None, FRAME) for s in (own, moved, own, own)] == [None] * (MIN_CALLS - 1) + ["pictures"] * 2
    assert Counted.made == 1
    assert recorder.render(other, None, FRAME) is None and recorder.plan is None
    assert recorder.render(own, background, FRAME) is None
    assert recorder.render(own, None, dataclasses.replace(FRAME, degree=0)) is None
    recorder.forget()
    assert [recorder.render(other, None, FRAME) for _ in range(3)][-1] == "pictures" and Counted.made == 2


def test_a_plan_without_room_is_made_anew_for_what_was_seen(recorder):
    """Four cameras in turn, of which one sees twice as much: made twice in all, not in every round."""
    own, drawn = batch(), []
    for step in range(400):
        Counted.seen = 200 if step % 4 == 3 else 100
        drawn.append(recorder.render(own, None, FRAME))
    assert Counted.made == 2 and drawn.count("pictures") > 380 and None not in drawn[40:]


def test_plans_that_do_not_pay_are_made_less_and_less(recorder):
    """Two models trained five steps each in turn; after one that drew often enough a new one is made soon."""
    own, other = batch(), batch()
    for step in range(1000):
        recorder.render(own if step // 5 % 2 else other, None, FRAME)
    assert 1 <= Counted.made <= 3
    recorder.forget()
    for tensors in (own, other, own):
        assert [recorder.render(tensors, None, FRAME) for _ in range(PAID + MIN_CALLS)].count(None) == MIN_CALLS - 1


def test_what_cannot_be_recorded_is_not(recorder, monkeypatch):
    """No gradients wanted, float64, rows that are not contiguous, too many records, too little memory."""
    own = batch()
    monkeypatch.setattr(graphed, "MOST", 19)
    assert call_key(own, None, FRAME) is None
    monkeypatch.setattr(graphed, "MOST", 20)
    assert call_key(own, None, FRAME) is not None
    with torch.no_grad():
        assert call_key(own, None, FRAME) is None
    assert call_key(tuple(t.detach() for t in own), None, FRAME) is None
    assert call_key(tuple(t.double() for t in own), None, FRAME) is None
    assert call_key((own[0].T.contiguous().T, *own[1:]), None, FRAME) is None
    assert call_key(own, torch.zeros(1, 3), FRAME) is not None and call_key(own, torch.zeros(3), FRAME) is None
    monkeypatch.setattr(graphed, "available_bytes", lambda device: 0)
    assert [recorder.render(own, None, FRAME) for _ in range(5)] == [None] * 5 and Counted.made == 0


def test_options_that_decide_more_than_the_picture_are_not_recorded():
    """Each of them by itself."""
    assert RasterizeOptions(background=torch.ones(3), sh_degree=1).repeatable()
    assert not RasterizeOptions(record=False).repeatable()
    for other in (
        {"deterministic": False}, {"contributions": True}, {"capacity": 5}, {"memory_budget": 5},
        {"max_instances": 5}, {"opacity_factors": torch.ones(3)},
    ):  # fmt: skip
        assert not RasterizeOptions(**other).repeatable()


def drawn(gaussians, cam, background, recorder=None):
    """Pictures, records, counts and all gradients; of the cameras too."""
    params = list(gaussians.tensors().values())
    cam = dataclasses.replace(cam, viewmat=cam.viewmat.clone().requires_grad_(), K=cam.K.clone().requires_grad_())
    background = background.clone().requires_grad_()
    if recorder is None:
        r = rasterize(gaussians, cam, RasterizeOptions(background=background))
        rgb, alpha, depth, projected, counts = r.rgb, r.alpha, r.depth, r.projected, r.tile_counts
    else:
        frame = Frame(cam.width, cam.height, (0, 0, cam.width, cam.height), gaussians.sh_degree, RULES["exact"], 16)
        found = recorder.render((*params, cam.viewmat, cam.K), background, frame)
        if found is None:
            return None
        (rgb, alpha, depth), projected, counts = found
    loss = (rgb**2).sum() + alpha.sum() + 0.1 * depth.sum()
    gradients = torch.autograd.grad(loss, [*params, projected, cam.viewmat, cam.K, background], retain_graph=True)
    only_alpha = torch.autograd.grad(alpha.sum(), [*params, background], retain_graph=True)
    (v_unused,) = torch.autograd.grad(projected[..., :2].sum(), params[0])
    return [t.detach() for t in (rgb, alpha, depth, projected, counts, *gradients, *only_alpha, v_unused)]


def test_a_plan_draws_what_the_rasterizer_draws(surroundings):
    """To the bit, batches and backgrounds and gradients of cameras included; where nothing can be recorded."""
    g, own = leaves(cloud(300)), Recorder(NoGraphPool(CPU))
    cams = camera(70, 50, 3, torch.float32)
    backgrounds = torch.rand(3, 3, generator=torch.Generator().manual_seed(3))
    found = [drawn(g, cams, backgrounds, own) for _ in range(MIN_CALLS + 1)]
    assert found[: MIN_CALLS - 1] == [None] * (MIN_CALLS - 1)
    wanted = drawn(g, cams, backgrounds)
    for each in found[MIN_CALLS - 1 :]:
        assert all(torch.equal(a, b) for a, b in itertools.zip_longest(each, wanted))


def test_a_plan_without_room_says_so(surroundings):
    """The call runs as usual, and the next plan has room for it."""
    g, own = leaves(cloud(300)), Recorder(NoGraphPool(CPU))
    cam = camera(70, 50, 1, torch.float32)
    sources = (*g.tensors().values(), cam.viewmat, cam.K)
    frame = Frame(70, 50, (0, 0, 70, 50), g.sh_degree, RULES["exact"], 16)
    for _ in range(MIN_CALLS):
        found = own.render(sources, None, frame)
    assert found is not None
    own.plan.capacity = own.plan.instances - 1
    assert own.render(sources, None, frame) is None and own.plan is None
    for _ in range(2 * MIN_CALLS):
        found = own.render(sources, None, frame)
    assert found is not None and own.plan.capacity > own.plan.instances


def planned(own: Recorder, g: Gaussians, cam: Camera):
    """What the first call gives that is drawn by a plan."""
    frame = Frame(cam.width, cam.height, (0, 0, cam.width, cam.height), g.sh_degree, RULES["exact"], 16)
    return [own.render((*g.tensors().values(), cam.viewmat, cam.K), None, frame) for _ in range(MIN_CALLS)][-1]


def test_a_plan_is_gone_when_nobody_holds_it(surroundings):
    """Without a collection of garbage: graphs hold memory of the device. A backward pass that is still to come holds it."""
    g, own = leaves(cloud(50)), Recorder(NoGraphPool(CPU))
    cam = camera(70, 50, 1, torch.float32)
    found = planned(own, g, cam)
    gone, loss = weakref.ref(own.plan), found[0][0].sum()
    gc.disable()
    try:
        own.forget()
        del found
        assert gone() is not None
        loss.backward()
        del loss
        assert gone() is None and bool(g.means.grad.any())
    finally:
        gc.enable()


def test_where_recording_failed_calls_run_as_usual(recorder):
    """For good, or until recordings are forgotten."""
    own = batch()
    recorder.graphs.failed = True
    assert [recorder.render(own, None, FRAME) for _ in range(9)] == [None] * 9
    recorder.forget()
    assert [recorder.render(own, None, FRAME) for _ in range(MIN_CALLS)][-1] == "pictures"


def test_torchs_default_type_is_not_the_plans(surroundings):
    """The background that nobody gave is of the Gaussians' type."""
    g, own = leaves(cloud(50)), Recorder(NoGraphPool(CPU))
    cam = camera(70, 50, 1, torch.float32)
    usual = torch.get_default_dtype()
    torch.set_default_dtype(torch.bfloat16)
    try:
        found = planned(own, g, cam)
    finally:
        torch.set_default_dtype(usual)
    assert torch.equal(found[0][0], rasterize(g, cam).rgb)


def test_gaussians_that_change_in_number_before_the_backward_pass(surroundings):
    """Swapped where autograd does not see it: an error instead of memory beside the gradients."""
    g, own = leaves(cloud(50)), Recorder(NoGraphPool(CPU))
    cam = camera(70, 50, 1, torch.float32)
    found = planned(own, g, cam)
    g.means.data = torch.zeros(70, 3)
    with pytest.raises(RuntimeError, match="50 Gaussians were drawn, and now there are 70"):
        found[0][0].sum().backward()
