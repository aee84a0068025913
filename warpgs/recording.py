"""Calls of the rasterizer that repeat: on CUDA their kernels are recorded once as graphs, and replayed.

At training sizes the host takes longer to start twenty kernels than the GPU to run them. A loop repeats its calls: the same
tensors, with other values in them, and another camera. The third such call in a row records projection, binning and blending;
from then on they are replayed in two graphs, and the backward pass is that of every call. The bits are the same.

What a replay writes is overwritten by the next. So pictures, records and counts are copied before anyone sees them, and while
some backward pass still needs the rest, calls run as if there were no recording.
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
ROOM = 1.1
"""Instances that a recording has room for, as a multiple of those of the call that recorded it."""
MOST = 2**19
"""Records beyond which the GPU takes longer than the host, so that a recording would gain nothing."""
SHARE = 0.05
"""Part of the free memory that a recording may take; beyond it calls are not recorded."""


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

    def __init__(self, sources: tuple[torch.Tensor, ...], frame: Frame, instances: int):
        """Record.

        Args:
            sources: The seven tensors that `project` takes. Of the first five the addresses are recorded, and nothing is kept.
            frame: What is drawn.
            instances: (Gaussian, tile) instances of the call at hand.
        """
        *inputs, viewmats, Ks = (t.detach() for t in sources)
        device = viewmats.device
        self.frame, self.capacity = frame, int(ROOM * instances) + 1024
        self.viewmats, self.Ks, self.backgrounds = viewmats.clone(), Ks.clone(), viewmats.new_zeros(len(viewmats), 3)
        self._on_host = wp.zeros(1, dtype=wp.int64, device="cpu", pinned=True)
        self.instances = self._on_host.numpy()
        """Of the last replay."""
        self.counted = torch.cuda.Event()
        self.lease: StorageWeakRef | None = None
        self.count: torch.cuda.CUDAGraph | None = None
        window, how = frame.window, {"degree": frame.degree, "rule": frame.rule, "tile_size": frame.tile_size}
        self.how = (window[:2], *window[2:], frame.rule, True)

        def count():
            made = project(*inputs, self.viewmats, self.Ks, width=frame.width, height=frame.height, **how, window=window)
            total = made[1].sum().view(1)
            with bridge.stream_of(device):
                wp.copy(self._on_host, bridge.view(total, wp.int64).array())
            return *made, total

        def draw():
            overflow = torch.zeros(1, dtype=torch.int32, device=device)  # nobody looks: the count on the host tells before
            tiles = bin_tiles(
                self.splats, self.tile_counts, width=window[2], height=window[3], tile_size=frame.tile_size, rule=frame.rule,
                origin=window[:2], capacity=self.capacity, overflow=overflow,
            )  # fmt: skip
            return tiles, composite(self.splats, tiles, self.backgrounds, *self.how[:-1], keep=True)

        def draw_backward():
            return gradients(self.splats, self.tiles, self.backgrounds, self.how, self.saved, self.v_rgb, None, None, False)[0]

        self._lent: list[object] = []
        stream = torch.cuda.Stream(device)
        stream.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(stream), torch.no_grad():
            for capture in (False, True):  # a first run loads what may not be loaded while recording
                self.count, (self.splats, self.tile_counts, self._total) = self._run(count, capture)
                self.draw, (self.tiles, (rgb, alpha, depth, *rest)) = self._run(draw, capture)
                self.saved, self.v_rgb = (rgb, depth, *rest), torch.zeros_like(rgb)
                self.shown = [self.splats, self.tile_counts.view(torch.float32), rgb, alpha, depth]
                self.draw_backward, self.v_splats = self._run(draw_backward, capture)
                stream.synchronize()
        torch.cuda.current_stream(device).wait_stream(stream)

    def _run(self, work: Callable[[], object], capture: bool):
        """A graph of ``work``, or None, and what it returned."""
        if not capture:
            return None, work()
        graph, (result, lent) = bridge.capture(work, None if self.count is None else self.count.pool())
        self._lent.append(lent)
        return graph, result

    def replay(self, sources: tuple[torch.Tensor, ...], backgrounds: torch.Tensor | None):
        """Pictures, records and tile counts of the seven tensors that `project` takes; None where that takes another way."""
        if self.lease is not None and not self.lease.expired():
            return None
        with torch.no_grad():
            torch._foreach_copy_([self.viewmats, self.Ks], list(sources[5:]))
            if backgrounds is None:
                backgrounds = self.backgrounds  # black since they were made
            else:
                self.backgrounds.copy_(backgrounds)
            self.count.replay()
            self.counted.record()
            self.draw.replay()
            copies = [torch.empty_like(t) for t in self.shown]
            torch._foreach_copy_(copies, self.shown)
        self.counted.synchronize()
        if self.overflowed():
            return None
        splats, tile_counts, *pictures = copies
        f, lease = self.frame, torch.empty(0)
        made = splats, tile_counts.view(torch.int32)
        splats, tile_counts = projected(sources, (f.width, f.height), f.degree, f.rule, *made)
        pictures = _Replayed.apply(splats, backgrounds, self, pictures, lease)
        self.lease = StorageWeakRef(lease.untyped_storage())
        return pictures, splats, tile_counts

    def backward(self, v_rgb, v_alpha, v_depth, wants_backgrounds: bool) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Gradients of records and backgrounds of the last replay."""
        if v_rgb is None or v_alpha is not None or v_depth is not None:
            of = (self.splats, self.tiles, self.backgrounds, self.how, self.saved)
            return gradients(*of, v_rgb, v_alpha, v_depth, wants_backgrounds)
        self.v_rgb.copy_(v_rgb)
        self.draw_backward.replay()
        return self.v_splats.clone(), background_gradient(self.saved[2], v_rgb) if wants_backgrounds else None

    def overflowed(self) -> bool:
        """Whether the last replay had more instances than there is room for."""
        return int(self.instances[0]) > self.capacity


class _Replayed(torch.autograd.Function):
    """Pictures that a replay left. What their backward pass needs stays with the recording while the lease is saved."""

    @staticmethod
    def forward(ctx, splats, backgrounds, recording, pictures, lease):
        ctx.save_for_backward(lease)
        ctx.recording = recording
        ctx.set_materialize_grads(False)
        return tuple(pictures)

    @staticmethod
    @once_differentiable
    def backward(ctx, *v_pictures):
        _ = ctx.saved_tensors  # torch's error where the graph was freed
        return *ctx.recording.backward(*v_pictures, ctx.needs_input_grad[1]), None, None, None


@dataclass
class Recorder:
    """What the calls on one device were, and the recording of the last that came often enough."""

    last: tuple | None = None
    times: int = 0
    recorded: tuple | None = None
    recording: Recording | None = None
    replays: int = 0
    """Calls that were replayed."""
    lock: threading.Lock = field(default_factory=threading.Lock)

    def render(self, sources: tuple[torch.Tensor, ...], backgrounds: torch.Tensor | None, frame: Frame):
        """What `Recording.replay` returns; None where the call is to run as usual."""
        if not self.lock.acquire(blocking=False):
            return None
        try:
            key = call_key(sources, backgrounds, frame)
            if key is None:
                return None
            if key != self.recorded:
                self.times = self.times + 1 if key == self.last else 1
                self.last = key
                if self.times < CALLS:
                    return None
                self._record(key, sources, frame)
            if self.recording is None:
                return None
            found = self.recording.replay(sources, backgrounds)
            if found is not None:
                self.replays += 1
            elif self.recording.overflowed():
                self.forget()
            return found
        finally:
            self.lock.release()

    def _record(self, key: tuple, sources: tuple[torch.Tensor, ...], frame: Frame) -> None:
        self.forget()
        with torch.no_grad():
            size = {"width": frame.width, "height": frame.height, "window": frame.window}
            how = {"degree": frame.degree, "rule": frame.rule, "tile_size": frame.tile_size}
            instances = int(project(*sources, **size, **how)[1].sum())
        self.recorded = key
        if ROOM * instances * BYTES_PER_INSTANCE < SHARE * available_bytes(sources[0].device):
            self.recording = Recording(sources, frame, instances)

    def forget(self) -> None:
        """Drop the recording and its memory; the next calls run as usual."""
        self.last, self.times, self.recorded, self.recording = None, 0, None, None


def call_key(sources: tuple[torch.Tensor, ...], backgrounds: torch.Tensor | None, frame: Frame) -> tuple | None:
    """What calls must share to share a recording.

    None for what cannot be recorded, and for what need not be: large calls, and those without gradients.
    """
    means, viewmats = sources[0], sources[5]
    small = 0 < len(means) * len(viewmats) <= MOST
    fit = means.dtype == torch.float32 and torch.is_grad_enabled() and any(t.requires_grad for t in sources)
    if not (small and fit) or torch.is_inference_mode_enabled() or torch.cuda.is_current_stream_capturing():
        return None
    places = []
    for t in sources[:5]:
        if not (t.is_contiguous() and t.dtype == torch.float32 and t.device == means.device):
            return None
        places.append((t.data_ptr(), t.shape))
    stream = bridge.warp_stream(means.device).cuda_stream
    return *places, viewmats.shape, sources[6].shape, None if backgrounds is None else backgrounds.shape, frame, stream


_RECORDERS: dict[torch.device, Recorder] = {}


def recorder(device: torch.device) -> Recorder:
    """That of a CUDA device."""
    return _RECORDERS.setdefault(device, Recorder())
