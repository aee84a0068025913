"""Calls of the rasterizer that repeat: on CUDA their kernels are recorded once as graphs, and replayed.

At training sizes the host takes longer to start twenty kernels than the GPU to run them. A loop repeats its calls: the same
tensors, with other values in them, and another camera. The third such call in a row is recorded: projection, then binning and
blending, and the backward pass of blending. From then on the three graphs are replayed. The bits are the same.

What a replay writes is overwritten by the next. So whatever is shown is copied first, and while some backward pass still needs
the rest, calls run as if there were no recording.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
import warp as wp
from torch.autograd.function import once_differentiable
from torch.multiprocessing.reductions import StorageWeakRef

from warpgs.constants import Rule
from warpgs.kernels import bridge
from warpgs.kernels.blend import background_gradient, composite, gradients
from warpgs.kernels.project import project, projected
from warpgs.kernels.tiles import BYTES_PER_INSTANCE, available_bytes, bin_tiles

CALLS = 3
"""The call that records, of equal ones in a row."""
PAID = 30
"""Replays after which a recording was worth its while. After one that was not, twice as many calls are waited for."""
ROOM = 1.1
"""Instances that a recording has room for, as a multiple of the most that its calls were seen to have."""
MOST = 2**19
"""Records beyond which the GPU takes longer than the host, so that a recording would gain nothing."""
SHARE = 0.05
"""Part of the free memory that lists and states of a recording may take; beyond it calls are not recorded."""
DEAD_BYTES = 2**30
"""Memory of dropped recordings, which torch keeps for nobody, that may pile up before it is given back."""


@dataclass(frozen=True)
class Frame:
    """What is drawn besides Gaussians and cameras."""

    width: int
    """Of the picture [px]."""
    height: int
    """Of the picture [px]."""
    window: tuple[int, int, int, int]
    """Left, top, width and height of the part that is drawn [px]."""
    degree: int
    rule: Rule
    tile_size: int


class Recording:
    """Projection, binning and blending of one set of tensors, replayed for any camera; and the backward pass of blending."""

    def __init__(self, sources: tuple[torch.Tensor, ...], frame: Frame, instances: int, stream: torch.cuda.Stream):
        """Record.

        Args:
            sources: The seven tensors that `project` takes. Of the first five the addresses are recorded, and nothing is kept.
            frame: What is drawn.
            instances: Most (Gaussian, tile) instances that such a call was seen to have.
            stream: Where to record.
        """
        *inputs, viewmats, Ks = (t.detach() for t in sources)
        device, (x, y, width, height) = viewmats.device, frame.window
        self.frame, self.capacity, self.replays = frame, int(ROOM * instances) + 1024, 0
        self.viewmats, self.Ks, self.backgrounds = viewmats.clone(), Ks.clone(), viewmats.new_zeros(len(viewmats), 3)
        self.v_rgb = viewmats.new_zeros(len(viewmats), height, width, 3)
        self.part = ((x, y), width, height, frame.rule)
        self._on_host = wp.zeros(1, dtype=wp.int64, device="cpu", pinned=True)
        self.instances = self._on_host.numpy()
        """Of the last replay."""
        self.counted = torch.cuda.Event()
        self.lease: StorageWeakRef | None = None

        def count():
            how = {"degree": frame.degree, "rule": frame.rule, "tile_size": frame.tile_size, "window": frame.window}
            made = project(*inputs, self.viewmats, self.Ks, width=frame.width, height=frame.height, **how)
            total = made[1].sum().view(1)
            with bridge.stream_of(device):
                wp.copy(self._on_host, bridge.view(total, wp.int64).array())
            return *made, total

        def draw():
            overflow = torch.zeros(1, dtype=torch.int32, device=device)  # nobody looks: the count on the host tells before
            tiles = bin_tiles(
                self.splats, self.tile_counts, width=width, height=height, tile_size=frame.tile_size, rule=frame.rule,
                origin=(x, y), capacity=self.capacity, overflow=overflow,
            )  # fmt: skip
            return tiles, composite(self.splats, tiles, self.backgrounds, *self.part, keep=True)

        self._lent: list[object] = []
        self.count_graph: torch.cuda.CUDAGraph | None = None
        stream.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(stream), torch.no_grad():
            for capture in (False, True):  # a first run loads what may not be loaded while recording
                self.count_graph, (self.splats, self.tile_counts, self._total) = self._run(count, capture)
                self.draw_graph, (self.tiles, (rgb, alpha, depth, *rest)) = self._run(draw, capture)
                self.saved = (rgb, depth, *rest)
                self.shown = [self.splats, self.tile_counts.view(torch.float32), rgb, alpha, depth]
                self.backward_graph, (self.v_splats, _) = self._run(
                    lambda: self._gradients(self.v_rgb, None, None, False), capture
                )
                stream.synchronize()
        torch.cuda.current_stream(device).wait_stream(stream)

    def _run(self, work: Callable[[], object], capture: bool):
        """A graph of ``work``, or None, and what it returned."""
        if not capture:
            return None, work()
        graph, (result, lent) = bridge.capture(work, None if self.count_graph is None else self.count_graph.pool())
        self._lent.append(lent)
        return graph, result

    def busy(self) -> bool:
        """Whether a backward pass may still need what the last replay left."""
        return self.lease is not None and not self.lease.expired()

    def full(self) -> bool:
        """Whether the last replay had more instances than there is room for, so that nothing it left may be used."""
        return int(self.instances[0]) > self.capacity

    def replay(self, sources: tuple[torch.Tensor, ...], backgrounds: torch.Tensor | None):
        """Pictures, records and tile counts of the seven tensors that `project` takes; None where it is then `full`."""
        with torch.no_grad():
            torch._foreach_copy_([self.viewmats, self.Ks], list(sources[5:]))
            if backgrounds is None:
                backgrounds = self.backgrounds  # black since they were made
            else:
                self.backgrounds.copy_(backgrounds)
            self.count_graph.replay()
            self.counted.record()
            self.draw_graph.replay()
            copies = [torch.empty_like(t) for t in self.shown]
            torch._foreach_copy_(copies, self.shown)
        self.counted.synchronize()
        if self.full():
            return None
        splats, tile_counts, *pictures = copies
        f, made = self.frame, (splats, tile_counts.view(torch.int32))
        splats, tile_counts = projected(sources, (f.width, f.height), f.degree, f.rule, *made)
        pictures = self.lend(splats, backgrounds, pictures)
        self.replays += 1
        return pictures, splats, tile_counts

    def lend(self, splats: torch.Tensor, backgrounds: torch.Tensor, pictures: list[torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """The pictures as what follows from records and backgrounds; `busy` until their backward pass is done or given up."""
        lease = torch.empty(0)
        lease.recording = self  # only so: whoever keeps a picture whose gradient was taken keeps no recording
        pictures = _Replayed.apply(splats, backgrounds, pictures, lease)
        self.lease = StorageWeakRef(lease.untyped_storage())
        return pictures

    def backward(self, v_rgb, v_alpha, v_depth, wants_backgrounds: bool) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Gradients of records and backgrounds of the last replay."""
        if v_rgb is None or v_alpha is not None or v_depth is not None:
            return self._gradients(v_rgb, v_alpha, v_depth, wants_backgrounds)
        self.v_rgb.copy_(v_rgb)
        self.backward_graph.replay()
        return self.v_splats.clone(), background_gradient(self.saved[2], v_rgb) if wants_backgrounds else None

    def _gradients(self, *of) -> tuple[torch.Tensor, torch.Tensor | None]:
        return gradients(self.splats, self.tiles, self.backgrounds, (*self.part, True), self.saved, *of)


class _Replayed(torch.autograd.Function):
    """Pictures that a replay left. The lease is saved, and with it lives what their backward pass needs."""

    @staticmethod
    def forward(ctx, splats, backgrounds, pictures, lease):
        ctx.save_for_backward(lease)
        ctx.set_materialize_grads(False)
        return tuple(pictures)

    @staticmethod
    @once_differentiable
    def backward(ctx, *v_pictures):
        (lease,) = ctx.saved_tensors
        return *lease.recording.backward(*v_pictures, ctx.needs_input_grad[1]), None, None


@dataclass
class Recorder:
    """What the calls on one device were, and the recording of the last that came often enough."""

    last: tuple | None = None
    times: int = 0
    wanted: int = CALLS
    """Equal calls in a row that it takes."""
    most: tuple[tuple, int] | None = None
    """The call that had more instances than there was room for, and how many."""
    recorded: tuple | None = None
    recording: Recording | None = None
    replays: int = 0
    """Calls that were replayed."""
    kept: int = 0
    """Bytes that torch held after something was last given back."""
    stream: torch.cuda.Stream | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)

    def render(self, sources: tuple[torch.Tensor, ...], backgrounds: torch.Tensor | None, frame: Frame):
        """What `Recording.replay` returns; None where the call is to run as usual."""
        key = call_key(sources, backgrounds, frame)
        if key is None or not self.lock.acquire(blocking=False):
            return None
        try:
            if key == self.recorded:
                self.last = None
            else:
                self.times = self.times + 1 if key == self.last else 1
                self.last = key
                if self.times < self.wanted:
                    return None
                self._record(key, sources, frame)
            if self.recording is None or self.recording.busy():
                return None
            found = self.recording.replay(sources, backgrounds)
            if found is None:
                self.most = (key, int(self.recording.instances[0]))
                self._drop()
            else:
                self.replays += 1
            return found
        finally:
            self.lock.release()

    def _record(self, key: tuple, sources: tuple[torch.Tensor, ...], frame: Frame) -> None:
        self._drop()
        device = sources[0].device
        with torch.no_grad():
            size = {"width": frame.width, "height": frame.height, "window": frame.window}
            how = {"degree": frame.degree, "rule": frame.rule, "tile_size": frame.tile_size}
            instances = int(project(*sources, **size, **how)[1].sum())
        if self.most is not None and self.most[0] == key:
            instances = max(instances, self.most[1])
        if ROOM * instances * BYTES_PER_INSTANCE > SHARE * available_bytes(device):
            self.recorded = key  # not asked again
            return
        if torch.cuda.memory_reserved(device) - self.kept > DEAD_BYTES:
            torch.cuda.empty_cache()
            self.kept = torch.cuda.memory_reserved(device)
        self.stream = self.stream or torch.cuda.Stream(device)
        try:
            self.recording = Recording(sources, frame, instances, self.stream)
        except torch.OutOfMemoryError:
            torch.cuda.empty_cache()  # of what was tried; the call itself may well fit
        self.recorded = key

    def _drop(self) -> None:
        if self.recording is not None:
            self.wanted = CALLS if self.recording.replays >= PAID else 2 * self.wanted
        self.last, self.times, self.recorded, self.recording = None, 0, None, None

    def forget(self) -> None:
        """Drop the recording, as if there had been no call."""
        with self.lock:
            self._drop()
            self.wanted, self.most = CALLS, None


def call_key(sources: tuple[torch.Tensor, ...], backgrounds: torch.Tensor | None, frame: Frame) -> tuple | None:
    """What calls must share to share a recording.

    None for what cannot be recorded, and for what need not be: large calls, and those without gradients.
    """
    means, viewmats = sources[0], sources[5]
    small = 0 < len(means) * len(viewmats) <= MOST
    fit = means.dtype == torch.float32 and torch.is_grad_enabled() and any(t.requires_grad for t in sources)
    if not (small and fit) or torch.is_inference_mode_enabled() or not _usual_surroundings(means.device):
        return None
    if backgrounds is not None and tuple(backgrounds.shape) != (len(viewmats), 3):
        return None
    places = []
    for t in sources[:5]:
        if not (t.is_contiguous() and t.dtype == torch.float32 and t.device == means.device):
            return None
        places.append((t.data_ptr(), t.shape))
    stream = bridge.warp_stream(means.device).cuda_stream
    return *places, viewmats.shape, sources[6].shape, backgrounds is None, frame, stream


def _usual_surroundings(device: torch.device) -> bool:
    """Not while a graph is being captured, on no other device than the current one, and without hooks on saved tensors.

    Such hooks may drop the lease, and checkpointing wants the same number of tensors each time.
    """
    hooks = torch._C._autograd._top_saved_tensors_default_hooks(True)
    return hooks is None and device.index == torch.cuda.current_device() and not torch.cuda.is_current_stream_capturing()


_RECORDERS: dict[torch.device, Recorder] = {}


def recorder(device: torch.device) -> Recorder:
    """That of a CUDA device."""
    return _RECORDERS.setdefault(device, Recorder())


def forget_recordings() -> None:
    """Give back the memory of what was recorded; loops that go on are recorded anew."""
    for own in _RECORDERS.values():
        own.forget()
