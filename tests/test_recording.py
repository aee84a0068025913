"""Which calls are recorded, when a recording is made anew, and how long it is lent: all that needs no GPU."""

import dataclasses
import weakref
from types import SimpleNamespace

import pytest
import torch

from tests.splats import camera, cloud, leaves
from warpgs import recording
from warpgs.constants import RULES
from warpgs.rasterizer import RasterizeOptions
from warpgs.recording import CALLS, PAID, Frame, Recorder, call_key
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
