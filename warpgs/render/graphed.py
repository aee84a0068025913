"""Calls of the rasterizer that repeat: on CUDA their kernels are recorded as graphs, and replayed.

At training sizes the host takes longer to start twenty kernels than the GPU to run them. A loop repeats its calls: the same
tensors, with other values in them, and another camera. What it asks memory for repeats, too, and so torch gives it the same
addresses. Kernels that were recorded at addresses are therefore replayed where a call gets those again, and started one by one
where it does not. The bits are the same, and so is the memory, but for room for a few more instances.
"""

from __future__ import annotations

import contextlib
import functools
import os
import weakref
from dataclasses import dataclass

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from warpgs.constants import Rule
from warpgs.kernels import blend, project, sh
from warpgs.kernels.tiles import BYTES_PER_INSTANCE, Tiles, bin_tiles
from warpgs.runtime import interop
from warpgs.runtime.allocator import Allocator, fetch
from warpgs.runtime.cuda_graph import PAID, GraphedFunction, GraphPool
from warpgs.runtime.device_memory import available_bytes

MIN_CALLS = 3
"""The call from which on kernels are recorded, of equal ones in a row. Where that did not pay, twice as many the next time."""
CAPACITY_FACTOR = 1.05
"""Instances that there is room for, as a multiple of the most that such calls were seen to have."""
MAX_PROJECTED = 2**19
"""Records beyond which the GPU takes longer than the host, so that a recording would gain nothing."""
FRACTION = 0.05
"""Part of the free memory that lists and states may take; beyond it calls are not recorded."""


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


class GraphedRasterizer:
    """Rendering of one set of tensors for any camera, and its gradients, as four works."""

    def __init__(self, frame: Frame, cameras: int, capacity: int, graphs: GraphPool):
        """Nothing is drawn yet.

        Args:
            frame: What is drawn.
            cameras: Pictures at a time.
            capacity: Instances that there is room for.
            graphs: Where to record.
        """
        x, y, width, height = frame.window
        self.frame, self.cameras, self.capacity, self.device = frame, cameras, capacity, graphs.device
        self.part = ((x, y), width, height, frame.rule)
        self.drawn = 0
        self.instances = 0
        """Of the last call."""
        on_gpu = self.device.type == "cuda"
        self._on_host = wp.zeros(1, dtype=wp.int64, device="cpu", pinned=on_gpu)
        self._seen, self._stream = self._on_host.numpy(), graphs.stream
        self._counted_by_now = torch.cuda.Event() if on_gpu else None
        self._table = wp.zeros(2, dtype=wp.uint64, device="cpu", pinned=on_gpu)
        self._addresses = self._table.numpy()
        # by proxy, so that a plan is gone, and its graphs with it, as soon as nobody holds it
        own = [
            functools.partial(f, weakref.proxy(self))
            for f in (
                GraphedRasterizer._counted,
                GraphedRasterizer._composed,
                GraphedRasterizer._v_projected,
                GraphedRasterizer._v_sources,
            )
        ]
        self._count, self._draw, self._blend_back, self._project_back = (GraphedFunction(f, graphs) for f in own)
        self._none = torch.empty(0, dtype=torch.float32, device=self.device)
        self._black: torch.Tensor | None = None

    def render(self, sources: tuple[torch.Tensor, ...], backgrounds: torch.Tensor | None):
        """Pictures, records and tile counts of the seven tensors that `project` takes; None where there is no room."""
        viewmats, Ks = sources[5].contiguous(), sources[6].contiguous()
        self._addresses[:] = viewmats.data_ptr(), Ks.data_ptr()  # nobody reads them any more: the last call was waited for
        (cameras, *made), _ = self._count(*sources[:5])
        if self._counted_by_now is not None:
            self._counted_by_now.record(self._stream)
        if backgrounds is None:
            if self._black is None:
                self._black = torch.zeros(len(sources[5]), 3, dtype=torch.float32, device=self.device)
            backgrounds = self._black
        backgrounds = backgrounds.contiguous()
        images, block = self._draw(*made, backgrounds.detach())
        projected = _projected(*sources, self, cameras, made)
        images = _drawn(projected, backgrounds, self, made[1], images, block)
        if self._counted_by_now is not None:
            self._counted_by_now.synchronize()  # not before: the device goes on meanwhile
        self.instances = int(self._seen[0])
        if self.instances > self.capacity:
            return None
        self.drawn += 1
        return images, projected, made[1]

    def _seven(self, sources, cameras: torch.Tensor) -> list[torch.Tensor]:
        """What `project` takes, of which the last two were put into one."""
        first = 16 * self.cameras
        return [*sources, cameras[:first].view(-1, 4, 4), cameras[first:].view(-1, 3, 3)]

    def _how(self) -> tuple[tuple[int, int], int, Rule]:
        return (self.frame.width, self.frame.height), sh.coefficient_count(self.frame.degree), self.frame.rule

    def _counted(self, allocator: Allocator, *sources: torch.Tensor) -> tuple[torch.Tensor, ...]:
        # a copy, since gradients are still to come when the next call's cameras are at the same addresses
        cameras = allocator.output((25 * self.cameras,), torch.float32, self.device)
        fetch(self._table.ptr, 16 * self.cameras, cameras)
        size, sh_count, rule = self._how()
        how = (self._none, size, self.frame.window, sh_count, rule, self.frame.tile_size)
        _, counts = project.records(self._seven(sources, cameras), *how, allocator)
        total = allocator.workspace((1,), torch.int64, self.device)
        torch.sum(counts.view(-1), 0, keepdim=True, dtype=torch.int64, out=total)
        with interop.stream_of(self.device):
            wp.copy(self._on_host, interop.view(total, wp.int64).array())
        return ()

    def _composed(self, allocator: Allocator, projected, counts, backgrounds) -> tuple[torch.Tensor, ...]:
        origin, width, height, rule = self.part
        overflow = allocator.workspace((1,), torch.int32, self.device).zero_()  # nobody looks: the count tells before
        tiles = bin_tiles(
            projected, counts, width=width, height=height, tile_size=self.frame.tile_size, rule=rule, origin=origin,
            capacity=self.capacity, overflow=overflow, allocator=allocator,
        )  # fmt: skip
        _, _, _, *rest = blend.composite(
            projected, tiles, backgrounds, *self.part, keep=True, deterministic=True, allocator=allocator
        )
        return *(t for t in tiles.tensors() if t is not tiles.counts), *rest

    def _v_projected(self, allocator: Allocator, projected, counts, backgrounds, rgb, depth, block, *v_images) -> tuple[()]:
        ranges, ids, slots, starts, tile_ids, total, *rest = self._draw.kept(block)
        tiles = Tiles(self.frame.tile_size, ranges, ids, slots, starts, counts.view(-1), tile_ids, total)
        blend.gradients(projected, tiles, backgrounds, (*self.part, True), (rgb, depth, *rest), *v_images, allocator)
        return ()

    def _v_sources(self, allocator: Allocator, *of: torch.Tensor) -> tuple[()]:
        *sources, cameras, projected, counts, v_projected = of
        project.gradients(self._seven(sources, cameras), *self._how(), projected, counts, v_projected, False, allocator)
        return ()

    def blend_back(self, saved: tuple[torch.Tensor, ...], v_images: tuple[torch.Tensor | None, ...], wants_backgrounds: bool):
        """Gradients of records and backgrounds."""
        v_images = [None if v is None else v.contiguous() for v in v_images]
        (v_projected,), _ = self._blend_back(*saved, *v_images)
        if not wants_backgrounds:
            return v_projected, None
        transmittances = self._draw.kept(saved[5])[6]
        return v_projected, blend.background_gradient(transmittances, v_images[0])

    def project_back(self, saved: tuple[torch.Tensor, ...], v_projected: torch.Tensor | None, wants_camera: bool):
        """Gradients of the seven tensors that `project` takes."""
        *sources, cameras, projected, counts = saved
        if len(sources[0]) != projected.shape[1]:  # by way of `.data`, which autograd does not see
            raise RuntimeError(
                f"{projected.shape[1]:,} Gaussians were drawn, and now there are {len(sources[0]):,}: draw again first"
            )
        if v_projected is None or wants_camera:
            return project.gradients(self._seven(sources, cameras), *self._how(), projected, counts, v_projected, wants_camera)
        found, _ = self._project_back(*saved, v_projected.contiguous())
        return *found, None, None


def _once(backward):
    """What torch's `once_differentiable` does, where that has anything to do."""
    checked = once_differentiable(backward)

    @functools.wraps(backward)
    def once(ctx, *gradients):
        return (checked if torch.is_grad_enabled() else backward)(ctx, *gradients)

    return once


class _Projected(torch.autograd.Function):
    """Records, as what follows from the tensors they were made of."""

    @staticmethod
    def forward(ctx, means, quats, log_scales, logit_opacities, coefficients, viewmats, Ks, plan, cameras, made):
        ctx.save_for_backward(means, quats, log_scales, logit_opacities, coefficients, cameras, *made)
        ctx.plan = plan
        ctx.set_materialize_grads(False)
        return made[0]

    @staticmethod
    @_once
    def backward(ctx, v_projected):
        wants_camera = ctx.needs_input_grad[5] or ctx.needs_input_grad[6]
        return *ctx.plan.project_back(ctx.saved_tensors, v_projected, wants_camera), None, None, None


class _Drawn(torch.autograd.Function):
    """Pictures, as what follows from records and backgrounds."""

    @staticmethod
    def forward(ctx, projected, backgrounds, plan, counts, images, block):
        rgb, _, depth = images
        ctx.save_for_backward(projected, counts, backgrounds, rgb, depth, block)
        ctx.plan = plan
        ctx.set_materialize_grads(False)
        return tuple(images)

    @staticmethod
    @_once
    def backward(ctx, *v_images):
        return *ctx.plan.blend_back(ctx.saved_tensors, v_images, ctx.needs_input_grad[1]), None, None, None, None


# Function.apply itself, which looks for functorch's wrappers first, takes as long again as what it calls
_projected, _drawn = (super(torch.autograd.Function, node).apply for node in (_Projected, _Drawn))


class Recorder:
    """What the calls on one stream were, and the plan of those that came often enough."""

    def __init__(self, graphs: GraphPool):
        self.graphs = graphs
        self.plan: GraphedRasterizer | None = None
        self.wanted = MIN_CALLS
        """Equal calls in a row that it takes."""
        self._key, self._times, self._too_large = None, 0, False
        self._most: tuple[tuple | None, int] = (None, 0)
        """A call that had more instances than there was room for, and how many."""

    def render(self, sources: tuple[torch.Tensor, ...], backgrounds: torch.Tensor | None, frame: Frame):
        """What `Plan.render` returns; None where the call is to run as usual."""
        key = None if self.graphs.failed else call_key(sources, backgrounds, frame)
        if key is None or not self.graphs.lock.acquire(blocking=False):
            return None
        try:
            if key != self._key:
                self._drop()
                self._key = key
            self._times += 1
            if self._times < self.wanted or self._too_large:
                return None
            if self.plan is None:
                self._make(sources, frame)
            if self.plan is None:
                return None
            try:
                found = self.plan.render(sources, backgrounds)
            except BaseException:
                if self.graphs.stream is not None:
                    with contextlib.suppress(RuntimeError):  # what went wrong is raised below
                        self.graphs.stream.synchronize()  # the device reads memory of the plan
                self._drop()
                raise
            if found is None:
                self._most = (key, self.plan.instances)
                self._drop()
            return found
        finally:
            self.graphs.lock.release()

    def _make(self, sources: tuple[torch.Tensor, ...], frame: Frame) -> None:
        with torch.no_grad():
            size = {"width": frame.width, "height": frame.height, "window": frame.window}
            how = {"degree": frame.degree, "rule": frame.rule, "tile_size": frame.tile_size}
            instances = int(project.project(*sources, **size, **how)[1].sum())
        if self._most[0] == self._key:
            instances = max(instances, self._most[1])
        self._too_large = CAPACITY_FACTOR * instances * BYTES_PER_INSTANCE > FRACTION * available_bytes(self.graphs.device)
        if not self._too_large:
            self.plan = GraphedRasterizer(frame, len(sources[5]), int(CAPACITY_FACTOR * instances) + 1024, self.graphs)

    def _drop(self) -> None:
        if self.plan is not None:
            self.wanted = MIN_CALLS if self.plan.drawn >= PAID else 2 * self.wanted
        self.plan, self._key, self._times, self._too_large = None, None, 0, False

    def forget(self) -> None:
        """Begin anew, as if there had been no call."""
        with self.graphs.lock:
            self._drop()
            self.graphs.release()
            self.wanted, self._most = MIN_CALLS, (None, 0)


def call_key(sources: tuple[torch.Tensor, ...], backgrounds: torch.Tensor | None, frame: Frame) -> tuple | None:
    """What calls must share to share a plan.

    None for what cannot be recorded, and for what need not be: large calls, and those without gradients.
    """
    means, viewmats = sources[0], sources[5]
    small = 0 < len(means) * len(viewmats) <= MAX_PROJECTED
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
    return *places, viewmats.shape, sources[6].shape, backgrounds is None, frame


def _usual_surroundings(device: torch.device) -> bool:
    """Not while a graph is being captured, on no other device than the current one, and without hooks on saved tensors.

    Checkpointing, which has such hooks, wants the same number of saved tensors each time. Nor where torch or Warp were told to
    do what no graph can hold: to ask the driver for each tensor, or to look for errors after each kernel.
    """
    if _UNCACHED or wp.config.verify_cuda:
        return False
    hooks = torch._C._autograd._top_saved_tensors_default_hooks(True)
    # those of torch.cuda take several times as long
    return hooks is None and device.index == torch._C._cuda_getDevice() and not torch._C._cuda_isCurrentStreamCapturing()


_UNCACHED = os.environ.get("PYTORCH_NO_CUDA_MEMORY_CACHING") is not None
_RECORDERS: dict[tuple[torch.device, int], Recorder] = {}


def recorder(device: torch.device) -> Recorder:
    """That of torch's current stream of a CUDA device."""
    key = (device, interop.warp_stream(device).cuda_stream)
    own = _RECORDERS.get(key)
    return own or _RECORDERS.setdefault(key, Recorder(GraphPool(device)))


def clear_graph_cache() -> None:
    """Give back the memory of what was recorded; loops that go on are recorded anew."""
    for own in list(_RECORDERS.values()):
        own.forget()
