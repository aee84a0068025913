"""Calls that repeat are replayed on CUDA: the same bits, whatever a loop does with what it got."""

import dataclasses
import weakref
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
import torch
import torch.utils.checkpoint

from tests.splats import camera, cloud, leaves
from warpgs import recording
from warpgs.constants import RULES
from warpgs.rasterizer import RasterizeOptions, rasterize
from warpgs.recording import CALLS, PAID, Frame, Recorder, call_key, forget_recordings
from warpgs.scene import Camera, Gaussians

FRAME = Frame(18, 17, (0, 0, 18, 17), 1, RULES["exact"], 16)


class Counted:
    """A recording that draws nothing, for calls of as many instances as `seen` says."""

    made, seen = 0, 100

    def __init__(self, sources, frame, instances, stream):
        type(self).made += 1
        self.room, self.instances, self.replays, self.waits = instances, [0], 0, False

    def busy(self):
        return self.waits

    def full(self):
        return self.instances[0] > self.room

    def replay(self, sources, backgrounds):
        self.instances = [type(self).seen]
        self.replays += not self.full()
        return None if self.full() else "pictures"


@pytest.fixture
def recorder(monkeypatch) -> Recorder:
    """One whose recordings draw nothing, for tensors of a CPU; a call has `Counted.seen` instances."""
    Counted.made, Counted.seen = 0, 100
    monkeypatch.setattr(recording, "Recording", Counted)
    monkeypatch.setattr(recording, "_usual_surroundings", lambda device: True)
    monkeypatch.setattr(recording, "project", lambda *_, **__: (None, torch.tensor([Counted.seen])))
    monkeypatch.setattr(recording.bridge, "warp_stream", lambda device: SimpleNamespace(cuda_stream=7))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 0)
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: None)
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


def test_a_busy_recording_is_left_alone(recorder):
    """Beside an open backward pass a call runs as usual, and the next is replayed again."""
    own = batch()
    for _ in range(CALLS):
        recorder.render(own, None, FRAME)
    recorder.recording.waits = True
    assert recorder.render(own, None, FRAME) is None
    recorder.recording.waits = False
    assert recorder.render(own, None, FRAME) == "pictures" and Counted.made == 1


def test_a_full_recording_is_made_anew_with_room_for_what_was_seen(recorder):
    """Four cameras in turn, of which one sees twice as much: recorded twice in all, not in every round."""
    own, drawn = batch(), []
    for step in range(400):
        Counted.seen = 200 if step % 4 == 3 else 100
        drawn.append(recorder.render(own, None, FRAME))
    assert Counted.made == 2 and drawn.count("pictures") > 380 and None not in drawn[40:]


def test_recordings_that_do_not_pay_are_made_less_and_less(recorder):
    """Two models trained five steps each in turn; after one that was replayed often enough a new one is made soon."""
    own, other = batch(), batch()
    for step in range(1000):
        recorder.render(own if step // 5 % 2 else other, None, FRAME)
    assert 1 <= Counted.made <= 3
    recorder.forget()
    for tensors in (own, other, own):
        assert [recorder.render(tensors, None, FRAME) for _ in range(PAID + CALLS)].count(None) == CALLS - 1


def test_a_call_that_does_not_fit_recorded_runs_as_usual(recorder, monkeypatch):
    """Memory that runs out while recording is nobody's error, and is not asked for again."""

    class Large(Counted):
        def __init__(self, *of):
            super().__init__(*of)
            raise torch.OutOfMemoryError

    monkeypatch.setattr(recording, "Recording", Large)
    own = batch()
    assert [recorder.render(own, None, FRAME) for _ in range(9)] == [None] * 9 and Large.made == 1


class Lender(recording.Recording):
    """What lends pictures, and nothing else."""

    def __init__(self):
        self.lease, self.calls = None, 0

    def backward(self, v_rgb, v_alpha, v_depth, wants_backgrounds):
        self.calls += 1
        return v_rgb.sum() * torch.ones(1, 2, 12), None


def test_a_lease_ends_with_its_backward_pass_or_its_graph():
    """Busy until the gradient is taken for the last time, whatever is kept of the pictures; or until the graph is gone."""
    own, splats = Lender(), torch.zeros(1, 2, 12, requires_grad=True)

    def pictures():
        return own.lend(splats, torch.zeros(1, 3), [torch.zeros(1, 4, 4, 3), torch.zeros(1, 4, 4), torch.zeros(1, 4, 4)])

    assert not own.busy()
    kept = pictures()
    loss = kept[0].sum()
    assert own.busy()
    (once,) = torch.autograd.grad(loss, splats, retain_graph=True)
    assert own.busy() and float(once[0, 0, 0]) == 48
    loss.backward()
    assert not own.busy() and own.calls == 2
    with pytest.raises(RuntimeError, match="second time"):
        loss.backward()
    thrown = pictures()
    assert own.busy()
    del thrown
    assert not own.busy()


def test_a_kept_loss_keeps_no_recording():
    """Once its gradient is taken."""
    own, splats = Lender(), torch.zeros(1, 2, 12, requires_grad=True)
    gone = weakref.ref(own)
    loss = own.lend(splats, torch.zeros(1, 3), [torch.zeros(1, 4, 4, 3), torch.zeros(1, 4, 4), torch.zeros(1, 4, 4)])[0].sum()
    del own
    assert gone() is not None
    loss.backward()
    assert gone() is None


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
    assert call_key(own, torch.zeros(1, 3), FRAME) is not None and call_key(own, torch.zeros(3), FRAME) is None
    monkeypatch.setattr(recording, "available_bytes", lambda device: 0)
    assert [recorder.render(own, None, FRAME) for _ in range(5)] == [None] * 5 and Counted.made == 0


def test_options_that_decide_more_than_the_picture_are_not_recorded():
    """Each of them by itself."""
    assert RasterizeOptions(record=True, background=torch.ones(3), sh_degree=1).repeatable()
    assert not RasterizeOptions().repeatable()
    for other in (
        {"deterministic": False}, {"contributions": True}, {"capacity": 5}, {"memory_budget": 5},
        {"max_instances": 5}, {"opacity_factors": torch.ones(3)},
    ):  # fmt: skip
        assert not RasterizeOptions(record=True, **other).repeatable()


CUDA = torch.device("cuda", 0)
RECORD = RasterizeOptions(record=True)


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
    for step in range(14):
        assert equal([picture(True)], [picture(False)])
        replays.append(fresh.replays)
        if step in (5, 6):
            with torch.no_grad():
                g.log_scales.add_(1)
    assert replays[5] == 4 == replays[11] and replays[-1] == 6  # it did not pay, so the sixth call is recorded, not the third


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
def test_batches_and_gradients_of_records(fresh):
    """Four cameras at once, each with a background of its own and stored column by column; what densification looks at."""
    g, _ = scene()
    cams = camera(70, 50, 4, torch.float32, CUDA)
    cams = dataclasses.replace(cams, viewmat=cams.viewmat.mT.contiguous().mT)
    backgrounds, seen = torch.rand(4, 3, device=CUDA), {}
    for record in (True, False):
        for _ in range(CALLS + 1):
            for t in g.tensors().values():
                t.grad = None
            r = rasterize(g, cams, RasterizeOptions(record=record, background=backgrounds))
            r.splats.retain_grad()
            (r.rgb * r.rgb).sum().backward()
        seen[record] = [r.rgb.detach(), r.splats.grad, *(t.grad for t in g.tensors().values())]
    assert fresh.replays == 2 and equal([seen[True]], [seen[False]])


@pytest.mark.cuda
def test_hooks_and_checkpoints_are_drawn_as_usual(fresh):
    """Saved tensors that go elsewhere, and a picture that is drawn again for its gradient."""
    g, cams = scene()
    params = list(g.tensors().values())

    def gradient(draw):
        return torch.autograd.grad(draw(g, cams[0]).rgb.sum(), params)

    wanted = gradient(rasterize)
    for _ in range(2 * CALLS):
        with torch.autograd.graph.save_on_cpu(pin_memory=True):
            assert equal([gradient(lambda *of: rasterize(*of, RECORD))], [wanted])
    assert fresh.replays == 0
    for _ in range(2 * CALLS):
        again = torch.utils.checkpoint.checkpoint(lambda: rasterize(g, cams[0], RECORD).rgb, use_reentrant=False)
        assert equal([torch.autograd.grad(again.sum(), params)], [wanted])


@pytest.mark.cuda
def test_threads_draw_what_they_would_alone(fresh):
    """Four at once, each with Gaussians of its own; at most one of them has the recording."""

    def work(seed):
        g = leaves(cloud(300, device=CUDA, seed=seed))
        cam, found = camera(70, 50, None, torch.float32, CUDA), {}
        for record in (False, True):
            for _ in range(12):
                r = rasterize(g, cam, RasterizeOptions(record=record))
                found[record] = [r.rgb.detach(), *torch.autograd.grad(r.rgb.sum(), list(g.tensors().values()))]
        return equal([found[True]], [found[False]])

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(work, range(4))) == [True] * 4


@pytest.mark.cuda
def test_a_device_that_is_not_the_current_one(fresh):
    """Its calls run as usual."""
    if torch.cuda.device_count() < 2:
        pytest.skip("one device")
    g, cams = scene()
    with torch.cuda.device(1):
        for _ in range(CALLS + 2):
            rasterize(g, cams[0], RECORD).rgb.sum().backward()
    assert fresh.replays == 0


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
        rasterize(g, cams[0], RECORD).rgb.sum().backward()
    assert fresh.replays == 2
    held = torch.cuda.memory_allocated()
    size = sum(t.numel() * t.element_size() for t in g.tensors().values())
    del g
    assert held - torch.cuda.memory_allocated() >= 2 * size
    held = torch.cuda.memory_allocated()
    forget_recordings()
    assert held - torch.cuda.memory_allocated() > 30_000 * 48


@pytest.mark.cuda
def test_streams_do_not_share(fresh):
    """A loop that moves to another stream is recorded there anew, and sees its own steps."""
    found = {}
    for record in (True, False):
        g, cams = scene()
        found[record] = []
        for stream in (torch.cuda.current_stream(), torch.cuda.Stream()):
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(2 * CALLS):
                    r = rasterize(g, cams[0], RasterizeOptions(record=record))
                    (step,) = torch.autograd.grad(r.rgb.sum(), g.means)
                    with torch.no_grad():
                        g.means.sub_(1e-4 * step)
                    found[record].append([r.rgb.detach(), step])
            torch.cuda.current_stream().wait_stream(stream)
    assert fresh.replays == 2 * (CALLS + 1) and equal(found[True], found[False])
