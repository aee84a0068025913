"""Calls that repeat are replayed on CUDA: the same bits, whatever a loop does with what it got."""

import dataclasses
from types import SimpleNamespace

import pytest
import torch

from tests.splats import camera, cloud, leaves
from warpgs import recording
from warpgs.constants import RULES
from warpgs.rasterizer import RasterizeOptions, rasterize
from warpgs.recording import CALLS, Frame, Recorder, call_key
from warpgs.scene import Camera, Gaussians

FRAME = Frame(18, 17, (0, 0, 18, 17), 1, RULES["exact"], 16)


class Counted:
    """A recording that draws nothing: how often it was made and replayed, and when it was full or busy."""

    made, room = 0, 100

    def __init__(self, sources, frame, instances):
        type(self).made += 1
        self.busy = self.full = False

    def replay(self, sources, backgrounds):
        return None if self.busy or self.full else "pictures"

    def overflowed(self):
        return self.full


@pytest.fixture
def recorder(monkeypatch) -> Recorder:
    """One whose recordings draw nothing, for tensors of a CPU."""
    Counted.made = 0
    monkeypatch.setattr(recording, "Recording", Counted)
    monkeypatch.setattr(recording.bridge, "warp_stream", lambda device: SimpleNamespace(cuda_stream=7))
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: False)
    return Recorder()


def sources_of(gaussians: Gaussians, cam: Camera) -> tuple[torch.Tensor, ...]:
    return (*gaussians.tensors().values(), cam.viewmat[None], cam.K[None])


def batch(**size) -> tuple[torch.Tensor, ...]:
    return sources_of(leaves(cloud(20)), camera(dtype=torch.float32, **size))


def test_the_third_of_equal_calls_is_recorded(recorder):
    """Another camera is the same call; other tensors, another size or another background are not, and begin anew."""
    own, other = batch(), batch()
    moved = (*own[:5], own[5] + 1, own[6] * 2)
    background = torch.zeros(1, 3)
    assert [recorder.render(s, None, FRAME) for s in (own, moved, own, own)] == [None] * (CALLS - 1) + ["pictures"] * 2
    assert Counted.made == 1 and recorder.replays == 2
    assert recorder.render(other, None, FRAME) is None and recorder.render(own, background, FRAME) is None
    assert recorder.render(own, None, dataclasses.replace(FRAME, degree=0)) is None
    assert recorder.render(own, None, FRAME) == "pictures" and Counted.made == 1
    assert [recorder.render(other, None, FRAME) for _ in range(3)][-1] == "pictures" and Counted.made == 2


def test_a_full_recording_is_dropped_and_a_busy_one_is_not(recorder):
    """After more instances than there is room for, three calls record anew; beside an open backward pass a call just runs."""
    own = batch()
    for _ in range(CALLS):
        recorder.render(own, None, FRAME)
    recorder.recording.busy = True
    assert recorder.render(own, None, FRAME) is None and recorder.recording is not None
    recorder.recording.busy, recorder.recording.full = False, True
    assert recorder.render(own, None, FRAME) is None and recorder.recording is None
    assert [recorder.render(own, None, FRAME) for _ in range(3)] == [None, None, "pictures"] and Counted.made == 2


def test_what_cannot_be_recorded_is_not(recorder, monkeypatch):
    """No gradients wanted, float64, rows that are not contiguous, too many records, too little memory."""
    own = batch()
    monkeypatch.setattr(recording, "MOST", 19)
    assert call_key(own, None, FRAME) is None
    monkeypatch.setattr(recording, "MOST", 20)
    assert call_key(own, None, FRAME) is not None
    with torch.no_grad():
        assert call_key(own, None, FRAME) is None
    assert call_key(tuple(t.detach() for t in own), None, FRAME) is None
    assert call_key(tuple(t.double() for t in own), None, FRAME) is None
    assert call_key((own[0].T.contiguous().T, *own[1:]), None, FRAME) is None
    monkeypatch.setattr(recording, "available_bytes", lambda device: 0)
    assert [recorder.render(own, None, FRAME) for _ in range(5)] == [None] * 5 and Counted.made == 0


def test_options_that_decide_more_than_the_picture_are_not_recorded():
    """Each of them by itself."""
    assert RasterizeOptions().repeatable() and RasterizeOptions(background=torch.ones(3), sh_degree=1).repeatable()
    for other in (
        {"record": False}, {"deterministic": False}, {"contributions": True}, {"capacity": 5}, {"memory_budget": 5},
        {"max_instances": 5}, {"opacity_factors": torch.ones(3)},
    ):  # fmt: skip
        assert not RasterizeOptions(**other).repeatable()


CUDA = torch.device("cuda", 0)


def scene(count: int = 400, width: int = 70, height: int = 50) -> tuple[Gaussians, list[Camera]]:
    """Leaves on the GPU, and cameras that turn."""
    g, cams = leaves(cloud(count, device=CUDA)), camera(width, height, 4, torch.float32, CUDA)
    return g, [Camera(v, k, width, height) for v, k in zip(cams.viewmat, cams.K)]


@pytest.fixture
def fresh():
    """The recorder of the GPU, without a recording."""
    own = recording.recorder(CUDA)
    own.forget()
    own.replays = 0
    yield own
    own.forget()


def loop(record: bool, steps: int = 9, change: float = 0.01, **options):
    """Everything that a loop sees whose parameters move in place; of each step pictures, records, counts and gradients."""
    g, cams = scene()
    seen, params = [], list(g.tensors().values())
    for step in range(steps):
        r = rasterize(g, cams[step % 4], RasterizeOptions(record=record, **options))
        r.splats.retain_grad()
        loss = (r.rgb**2).sum()
        if step % 3 == 0:  # another backward kernel
            loss = loss + r.alpha.sum() + 0.1 * r.depth.sum()
        gradients = torch.autograd.grad(loss, params, retain_graph=True)
        (own,) = torch.autograd.grad(loss, r.splats)
        seen.append([t.detach() for t in (r.rgb, r.alpha, r.depth, r.splats, r.tile_counts, *gradients, own)])
        with torch.no_grad():
            for p in params:
                p += change * torch.sin(torch.arange(p.numel(), device=CUDA) + step).view(p.shape)
    return seen


def equal(a: list, b: list) -> bool:
    return len(a) == len(b) and all(torch.equal(x, y) for s, t in zip(a, b) for x, y in zip(s, t, strict=True))


@pytest.mark.cuda
@pytest.mark.parametrize("options", [{}, {"rule": "gsplat", "tile_size": 8}, {"sh_degree": 0, "window": (16, 0, 32, 32)}])
def test_a_loop_sees_the_same_bits(fresh, options):
    """Pictures, records, counts and gradients of every step, those of earlier steps too when all is over."""
    background = torch.tensor([0.2, 0.5, 0.1], device=CUDA)
    for more in ({}, {"background": background}):
        fresh.forget()
        before = fresh.replays
        assert equal(loop(True, **options, **more), loop(False, **options, **more))
        assert fresh.replays - before == 9 - CALLS + 1


@pytest.mark.cuda
def test_more_instances_than_room_are_drawn_as_usual(fresh):
    """Gaussians that grow twice: the same bits, and recorded anew."""
    g, cams = scene(3000)

    def picture(record):
        r = rasterize(g, cams[0], RasterizeOptions(record=record))
        return [r.rgb.detach(), *torch.autograd.grad(r.rgb.sum(), list(g.tensors().values()))]

    replays = []
    for step in range(12):
        assert equal([picture(True)], [picture(False)])
        replays.append(fresh.replays)
        if step in (5, 6):
            with torch.no_grad():
                g.log_scales.add_(1)
    assert replays[5] == 4 == replays[6] == replays[8] and replays[-1] == 7


@pytest.mark.cuda
def test_open_backward_passes_keep_what_they_need(fresh):
    """Two pictures before either gradient, a graph that is kept, and one that is thrown away unused."""
    g, cams = scene()
    params = list(g.tensors().values())

    def draw(i, record=True):
        return rasterize(g, cams[i], RasterizeOptions(record=record)).rgb

    def gradients(*pictures, **how):
        return torch.autograd.grad(sum((k + 1) * p.sum() for k, p in enumerate(pictures)), params, **how)

    for _ in range(CALLS):
        gradients(draw(0))
    assert fresh.replays == 1
    wanted = gradients(draw(1, False), draw(2, False))
    both = draw(1), draw(2)
    assert fresh.replays == 2 and equal([gradients(*both)], [wanted])
    kept = draw(3)
    once = gradients(kept, retain_graph=True)
    other = gradients(draw(0))
    assert fresh.replays == 3 and equal([gradients(kept)], [once]) and equal([other], [gradients(draw(0, False))])
    thrown = draw(1)
    assert fresh.replays == 4
    del thrown, kept, both
    draw(2)
    assert fresh.replays == 5


@pytest.mark.cuda
def test_cameras_and_backgrounds_have_gradients(fresh):
    """The pose, the intrinsics and the colour behind, each a tensor of its own at every call."""

    def run(record):
        g, cams = scene()
        seen = []
        for step in range(6):
            c = cams[step % 4]
            v, k, b = (t.clone().requires_grad_() for t in (c.viewmat, c.K, torch.full((3,), 0.1 * step, device=CUDA)))
            r = rasterize(g, dataclasses.replace(c, viewmat=v, K=k), RasterizeOptions(background=b, record=record))
            seen.append(torch.autograd.grad((r.rgb**2).sum() + r.depth.sum(), [v, k, b, g.means]))
        return seen

    assert equal(run(True), run(False)) and fresh.replays == 6 - CALLS + 1


@pytest.mark.cuda
def test_a_recording_keeps_no_parameters(fresh):
    """Their memory is free again once nobody else holds them."""
    g, cams = scene(30_000)
    for _ in range(CALLS + 1):
        rasterize(g, cams[0]).rgb.sum().backward()
    assert fresh.replays == 2
    held = torch.cuda.memory_allocated()
    size = sum(t.numel() * t.element_size() for t in g.tensors().values())
    del g
    assert held - torch.cuda.memory_allocated() >= 2 * size


@pytest.mark.cuda
def test_streams_do_not_share(fresh):
    """A loop that moves to another stream is recorded there anew."""
    g, cams = scene()
    wanted = rasterize(g, cams[0], RasterizeOptions(record=False)).rgb.detach()
    for stream in (torch.cuda.current_stream(), torch.cuda.Stream()):
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(5):
                r = rasterize(g, cams[0])
                r.rgb.sum().backward()
            assert torch.equal(r.rgb, wanted)
        torch.cuda.current_stream().wait_stream(stream)
    assert fresh.replays == 6
