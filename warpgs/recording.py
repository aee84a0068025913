"""Calls of the rasterizer that repeat: on CUDA their kernels are recorded once as graphs, and replayed.

At training sizes the host takes longer to start twenty kernels than the GPU to run them. A loop repeats its calls: the same
tensors, with other values in them, and another camera. The third such call in a row records projection, binning and blending;
from then on they are replayed in two graphs, and the backward pass is that of every call. The bits are the same.

What a replay writes is overwritten by the next. So pictures, records and counts are copied before anyone sees them, and while
some backward pass still needs the rest, calls run as if there were no recording.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

import torch
from torch.multiprocessing.reductions import StorageWeakRef

from warpgs.constants import Rule
from warpgs.kernels import bridge
from warpgs.kernels.blend import blended, composite
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

    def size(self) -> dict[str, int]:
        """Of the picture, as `project` takes it."""
        return {"width": self.width, "height": self.height}

    def part(self) -> dict[str, int]:
        """Of the window, as `bin_tiles` takes it."""
        return {"width": self.window[2], "height": self.window[3]}


class Recording:
    """Projection, binning and blending of one set of tensors, replayed for any camera."""

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
        self.instances = torch.zeros(1, dtype=torch.int64, pin_memory=True)
        """Of the last replay, on the host."""
        self.counted = torch.cuda.Event()
        self.lease: StorageWeakRef | None = None
        how = {"degree": frame.degree, "rule": frame.rule, "tile_size": frame.tile_size}

        def count():
            made = project(*inputs, self.viewmats, self.Ks, **frame.size(), **how, window=frame.window)
            return *made, made[1].sum().view(1)

        def draw():
            overflow = torch.zeros(1, dtype=torch.int32, device=device)  # nobody looks: the sum of the counts tells before
            origin, rule = frame.window[:2], frame.rule
            binned = bin_tiles(
                self.splats, self.tile_counts, **frame.part(), tile_size=frame.tile_size, rule=rule, origin=origin,
                capacity=self.capacity, overflow=overflow,
            )  # fmt: skip
            of = (origin, *frame.window[2:], rule, True)
            return binned, composite(self.splats, binned, self.backgrounds, *of)

        stream = torch.cuda.Stream(device)
        stream.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(stream), torch.no_grad():
            self.splats, self.tile_counts, _ = count()  # a first run loads what may not be loaded while recording
            draw()
            stream.synchronize()
            self.count, self._first = bridge.capture(count)
            self.splats, self.tile_counts, self.total = self._first[0]
            self.draw, self._second = bridge.capture(draw, self.count.pool())
            self.tiles, self.made = self._second[0]
        torch.cuda.current_stream(device).wait_stream(stream)

    def replay(self, sources: tuple[torch.Tensor, ...], backgrounds: torch.Tensor | None):
        """Pictures, records and tile counts of the seven tensors that `project` takes; None where that takes another way."""
        if self.lease is not None and not self.lease.expired():
            return None
        viewmats, Ks = sources[5:]
        with torch.no_grad():
            self.viewmats.copy_(viewmats)
            self.Ks.copy_(Ks)
            if backgrounds is None:
                backgrounds = self.backgrounds  # black since they were made
            else:
                self.backgrounds.copy_(backgrounds)
            self.count.replay()
            self.instances.copy_(self.total, non_blocking=True)
            self.counted.record()
            self.draw.replay()
            splats, tile_counts, rgb = self.splats.clone(), self.tile_counts.clone(), self.made[0].clone()
            alpha, depth = torch.stack(self.made[1:3]).unbind()
        self.counted.synchronize()
        if self.overflowed():
            return None
        f, lease = self.frame, torch.empty(0)
        splats, tile_counts = projected(sources, (f.width, f.height), f.degree, f.rule, splats, tile_counts)
        frame = (f.window[:2], *f.window[2:], f.rule, True)
        # whoever saves the rest for a backward pass saves the lease with it
        pictures = blended(splats, backgrounds, self.tiles, frame, (rgb, alpha, depth, *self.made[3:], lease))
        self.lease = StorageWeakRef(lease.untyped_storage())
        return pictures, splats, tile_counts

    def overflowed(self) -> bool:
        """Whether the last replay had more instances than there is room for."""
        return int(self.instances) > self.capacity


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
            how = {"degree": frame.degree, "rule": frame.rule, "tile_size": frame.tile_size, "window": frame.window}
            instances = int(project(*sources, **frame.size(), **how)[1].sum())
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
