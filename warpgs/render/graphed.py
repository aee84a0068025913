"""Rasterizer calls that repeat: on CUDA their kernels are captured as graphs, and replayed.

At training sizes, launching twenty kernels takes the host longer than running them takes the GPU. Each step of a training loop
calls the rasterizer with the same tensors, which hold new values, and with another camera. The memory requests of the steps
repeat as well, so torch allocates at the same addresses. A captured graph is replayed if a call has the addresses of the
capture; otherwise the kernels are launched one by one. Both give the same bits. Replays need more memory only for the spare
capacity for instances.
"""

import contextlib
import functools
import math
import os
import threading
import weakref

import torch
import warp as wp

from warpgs.device import available_bytes
from warpgs.kernels import blend, launch, project
from warpgs.kernels.cameras import CAMERA_MODELS
from warpgs.kernels.ellipse import ProjectInputs
from warpgs.kernels.falloff import Pass
from warpgs.kernels.graphs import MIN_REPLAYS, Allocator, GraphedFunction, GraphPool, fetch
from warpgs.kernels.tiles import BYTES_PER_INSTANCE, InstanceMemory, Tiles, bin_tiles, grid, running_counts, split_sum, sums_fit
from warpgs.means2d import count_passes

MIN_CALLS = 3
"""Number of calls in a row with equal keys (`call_key`) before kernels are captured. It doubles after a capture that is
replayed fewer than `MIN_REPLAYS` times."""
CAPACITY_FACTOR = 1.05
"""Capacity for visible Gaussians and for instances, as a multiple of the number needed. If an earlier call with the same key
exceeded its capacity, the larger number that either call needed is used."""
SPARE = 1024
"""Number that is added to the capacities for visible Gaussians and for instances."""
MAX_PROJECTED = 2**23
"""Largest number of projected Gaussians of a captured call. Larger calls take the GPU so long that a graph has no gain."""
MAX_MEMORY_FRACTION = 0.05
"""Largest fraction of the free memory that instances may take; calls that need more are not captured."""


Counts = tuple[int, int]
"""Numbers of Gaussians that touch a tile, and of (Gaussian, tile) instances: those that a render needs, or has memory for."""


class GraphedRasterizer:
    """Render and gradients of one set of tensors for any camera, as four functions with graphs (`GraphedFunction`)."""

    def __init__(self, settings: Pass, cameras: int, capacity: Counts, graphs: GraphPool, gradients: bool = True):
        """Prepare the functions for C ``cameras``; nothing is rendered yet."""
        self.settings, self.cameras, self.capacity, self.device = settings, cameras, capacity, graphs.device
        self.gradients, self.needed = gradients, (0, 0)  # numbers that the last call needed
        self._coefficients = CAMERA_MODELS.find(settings.camera_model).coefficients
        self.rendered = 0
        """Number of renders within the capacity."""
        on_gpu = self.device.type == "cuda"
        self._host_total = wp.zeros(1, dtype=wp.int64, device="cpu", pinned=on_gpu)
        self._total, self._stream = self._host_total.numpy(), graphs.stream
        self._total_ready = torch.cuda.Event() if on_gpu else None
        self._table = wp.zeros(3, dtype=wp.uint64, device="cpu", pinned=on_gpu)
        self._addresses = self._table.numpy()
        own = weakref.proxy(self)  # so that this object and its graphs are freed with the last reference
        self._forward_project, self._forward_blend, self._backward_blend, self._backward_project = (
            GraphedFunction(functools.partial(getattr(GraphedRasterizer, name), own), graphs)
            for name in ("_project_and_count", "_bin_and_blend", "_blend_gradients", "_project_gradients")
        )
        self._sums: torch.Tensor | None = None
        self._no_factors = torch.empty(0, dtype=torch.float32, device=self.device)

    @functools.cached_property
    def _black(self) -> torch.Tensor:
        return torch.zeros(self.cameras, 3, dtype=torch.float32, device=self.device)

    def render(self, inputs: ProjectInputs, backgrounds: torch.Tensor | None):
        """Return images, projected Gaussians [C, N, 12] and tile counts [C, N]; None if the call exceeds the capacity."""
        of_cameras = [t.contiguous() for t in inputs[5:8]]
        self._addresses[:] = [t.data_ptr() for t in of_cameras]  # no longer read: the last call has finished
        (cameras, *projection), _ = self._forward_project(*inputs[:5])
        if self._total_ready is not None:
            self._total_ready.record(self._stream)
        backgrounds = self._black if backgrounds is None else backgrounds.contiguous()
        images, block = self._forward_blend(*projection, backgrounds.detach())
        projected = projection[0]
        if self.gradients:
            passes: list[bool] = []  # backward passes: both nodes add to it
            projected = _projected(self, cameras, projection, passes, *inputs[:7])
            images = _blended(projected, backgrounds, self, projection[1], images, block, passes)
            count_passes(projected, passes)
        if self._total_ready is not None:
            self._total_ready.synchronize()  # only now, so that the device works meanwhile
        self.needed = split_sum(int(self._total[0]), projection[1].numel())
        if self.needed[0] > self.capacity[0] or self.needed[1] > self.capacity[1]:
            return None
        self.rendered += 1
        return images, projected, projection[1]

    def _inputs(self, gaussians, cameras: torch.Tensor) -> ProjectInputs:
        """Return all inputs; ``gaussians`` are five tensors [...], and ``cameras`` [F] holds the camera tensors, flattened."""
        first, second = 16 * self.cameras, 25 * self.cameras
        viewmats, Ks = cameras[:first].view(-1, 4, 4), cameras[first:second].view(-1, 3, 3)
        distortion = cameras[second:].view(self.cameras, self._coefficients)
        return ProjectInputs(*gaussians, viewmats, Ks, distortion, self._no_factors)

    def _project_and_count(self, allocator: Allocator, *gaussians: torch.Tensor) -> tuple[torch.Tensor, ...]:
        # a copy: the backward pass may come after the next call has put its cameras at the same addresses
        cameras = allocator.output(((25 + self._coefficients) * self.cameras,), torch.float32, self.device)
        fetch(self._table.ptr, 16 * self.cameras, 25 * self.cameras, cameras)
        _, counts = project.project_tensors(self._inputs(gaussians, cameras), self.settings, allocator)
        self._sums = running_counts(counts.view(-1), wp.float32, out=self._sums)  # no copy: used only within the call
        with launch.stream_of(self.device):
            wp.copy(self._host_total, wp.from_torch(self._sums[-1:]))
        return ()

    def _bin_and_blend(self, allocator: Allocator, projected, counts, backgrounds) -> tuple[torch.Tensor, ...]:
        overflow = allocator.workspace((1,), torch.int32, self.device)  # not read, since the sums show it first
        visible, instances = self.capacity
        memory = InstanceMemory(None, instances, overflow, allocator, (self._sums, visible))
        settings, save = self.settings, self.gradients
        tiles = bin_tiles(projected, counts, settings, memory, save)
        _, _, _, *saved = blend.composite(projected, tiles, backgrounds, settings, save=save, allocator=allocator)
        if not save:
            return ()
        return *(t for t in tiles.tensors() if t is not tiles.counts), *saved

    def _blend_gradients(self, allocator: Allocator, projected, counts, backgrounds, rgb, depth, block, *v_images) -> tuple[()]:
        ranges, ids, slots, starts, tile_ids, total, *saved = self._forward_blend.saved(block)
        tiles = Tiles(self.settings.tile_size, ranges, ids, slots, starts, counts.view(-1), tile_ids, total)
        saved = (rgb, depth, *saved)
        blend.composite_gradients(projected, tiles, backgrounds, self.settings, saved, v_images, allocator)
        return ()

    def _project_gradients(self, allocator: Allocator, *inputs: torch.Tensor) -> tuple[()]:
        *gaussians, cameras, projected, counts, v_projected = inputs
        given = self._inputs(gaussians, cameras)[:8], self.settings, projected, counts, v_projected
        project.project_gradients(*given, wants_camera=False, allocator=allocator)
        return ()

    def blend_gradients(self, saved: tuple[torch.Tensor, ...], v_images, wants_backgrounds: bool):
        """Return gradients of projected Gaussians [C, N, 12] and of backgrounds [C, 3], with None for unwanted backgrounds."""
        v_images = [None if v is None else v.contiguous() for v in v_images]
        (v_projected,), _ = self._backward_blend(*saved, *v_images)
        if not wants_backgrounds:
            return v_projected, None
        return v_projected, blend.background_gradient(self._forward_blend.saved(saved[5])[6], v_images[0])

    def project_gradients(self, saved: tuple[torch.Tensor, ...], v_projected: torch.Tensor | None, wants_camera: bool):
        """Return the gradients of the seven tensors that `project` takes, in their shapes [...]."""
        *gaussians, cameras, projected, counts = saved
        if v_projected is None or wants_camera:
            inputs = self._inputs(gaussians, cameras)[:8]
            return project.project_gradients(inputs, self.settings, projected, counts, v_projected, wants_camera=wants_camera)
        found, _ = self._backward_project(*saved, v_projected.contiguous())
        return *found, None, None


class _Projected(torch.autograd.Function):
    """The projected Gaussians as an autograd result of the seven tensors."""

    @staticmethod
    def forward(ctx, rasterizer, cameras, projection, passes, *inputs):
        launch.keep(ctx, *inputs[:5], cameras, *projection)  # viewmats and Ks are in cameras
        ctx.rasterizer, ctx.passes = rasterizer, passes
        ctx.set_materialize_grads(False)
        return projection[0]

    @staticmethod
    @launch.first_order
    def backward(ctx, v_projected):
        ctx.passes.append(True)
        wants_camera = ctx.needs_input_grad[9] or ctx.needs_input_grad[10]  # viewmats and Ks
        return None, None, None, None, *ctx.rasterizer.project_gradients(launch.kept(ctx), v_projected, wants_camera)


class _Blended(torch.autograd.Function):
    """The images as an autograd result of projected Gaussians and backgrounds."""

    @staticmethod
    def forward(ctx, projected, backgrounds, rasterizer, counts, images, block, passes):
        rgb, _, depth = images
        launch.keep(ctx, projected, counts, backgrounds, rgb, depth, block)
        ctx.rasterizer, ctx.passes = rasterizer, passes
        ctx.set_materialize_grads(False)
        return tuple(images)

    @staticmethod
    @launch.first_order
    def backward(ctx, *v_images):
        ctx.passes.append(True)
        found = ctx.rasterizer.blend_gradients(launch.kept(ctx), v_images, ctx.needs_input_grad[1])
        return *found, None, None, None, None, None


# torch.autograd.Function.apply looks for functorch's wrappers first, which doubles the time
_projected, _blended = (super(torch.autograd.Function, node).apply for node in (_Projected, _Blended))


class Recorder:
    """History of the calls on one stream, and the rasterizer of calls that repeat often enough."""

    def __init__(self, graphs: GraphPool, gradients: bool = True):
        self.graphs, self.gradients = graphs, gradients
        self.rasterizer: GraphedRasterizer | None = None
        """Rasterizer of the calls with the current key; None before there were enough of them."""
        self.min_calls = MIN_CALLS
        """Number of equal calls in a row before kernels are captured."""
        self._key, self._calls, self._too_large = None, 0, False
        self._exceeded: tuple[tuple | None, Counts] = (None, (0, 0))
        """Key of the last call that exceeded its capacity, and the numbers that this call needed."""

    def render(self, inputs: ProjectInputs, backgrounds: torch.Tensor | None, settings: Pass):
        """Return the result of `GraphedRasterizer.render`, over ``backgrounds`` [C, 3]; None if no graphs can be used."""
        key = None if self.graphs.failed else call_key(inputs, backgrounds, settings, self.gradients)
        if key is None or not self.graphs.lock.acquire(blocking=False):
            return None
        try:
            if key != self._key:
                self._drop()
                self._key = key
            self._calls += 1
            if self._calls < self.min_calls or self._too_large:
                return None
            if self.rasterizer is None:
                self.rasterizer = self._made(inputs, settings)
            if self.rasterizer is None:
                return None
            try:
                found = self.rasterizer.render(inputs, backgrounds)
            except BaseException:
                if self.graphs.stream is not None:
                    with contextlib.suppress(RuntimeError):  # the first error is raised below
                        self.graphs.stream.synchronize()  # the device reads memory of the rasterizer
                self._drop()
                raise
            if found is None:
                self._exceeded = (key, self.rasterizer.needed)
                self._drop()
            return found
        finally:
            self.graphs.lock.release()

    def _made(self, inputs: ProjectInputs, settings: Pass) -> GraphedRasterizer | None:
        """Return a rasterizer, unless its instances would take too much memory."""
        before = self._exceeded[1] if self._exceeded[0] == self._key else (0, 0)
        visible, instances = (CAPACITY_FACTOR * max(n, m) for n, m in zip(count_needed(inputs, settings), before))
        self._too_large = instances * BYTES_PER_INSTANCE > MAX_MEMORY_FRACTION * available_bytes(self.graphs.device)
        if self._too_large:
            return None
        cameras = len(inputs.viewmats)
        capacity = min(int(visible) + SPARE, cameras * len(inputs.means)), int(instances) + SPARE
        return GraphedRasterizer(settings, cameras, capacity, self.graphs, self.gradients)

    def _drop(self) -> None:
        if self.rasterizer is not None:
            self.min_calls = MIN_CALLS if self.rasterizer.rendered >= MIN_REPLAYS else 2 * self.min_calls
        self.rasterizer, self._key, self._calls, self._too_large = None, None, 0, False

    def clear(self) -> None:
        """Free all memory and reset the state, as before the first call."""
        with self.graphs.lock:
            self._drop()
            self.graphs.release()
            self.min_calls, self._exceeded = MIN_CALLS, (None, (0, 0))


@torch.no_grad()
def count_needed(inputs: ProjectInputs, settings: Pass) -> Counts:
    """Return the numbers that a render needs."""
    counts = project.project_inputs(inputs, settings)[1]
    visible, instances = torch.stack([(counts > 0).sum(), counts.sum()]).tolist()
    return visible, instances


def call_key(inputs: ProjectInputs, backgrounds: torch.Tensor | None, settings: Pass, gradients: bool = True) -> tuple | None:
    """Return what calls must have in common to use one rasterizer; None for calls that cannot be captured, or gain nothing."""
    means, viewmats = inputs.means, inputs.viewmats
    cameras = viewmats.shape[0]  # len of a tensor takes ten times as long
    projected, tiles = means.shape[0] * cameras, math.prod(grid(*settings.window[2:], settings.tile_size))
    small = 0 < projected <= MAX_PROJECTED and sums_fit(projected, tiles)
    # without gradients in the main thread alone: a viewer renders in another one, beside a loop that may wait for the device
    here = gradients or threading.current_thread() is threading.main_thread()
    fit = all(t.is_contiguous() and t.dtype == torch.float32 and t.device == means.device for t in inputs[:5])
    if backgrounds is not None:
        fit = fit and tuple(backgrounds.shape) == (cameras, 3)
    if not (small and fit and here) or torch.is_inference_mode_enabled() or not _can_capture(means.device):
        return None
    places = [(t.data_ptr(), t.shape) for t in inputs[:5]]
    return *places, viewmats.shape, inputs.Ks.shape, inputs.distortion.shape, backgrounds is None, settings


def _can_capture(device: torch.device) -> bool:
    """Return whether calls can be captured now, on this device."""
    # nor with hooks on saved tensors, as activation checkpointing sets: it needs the same number of saved tensors each time
    if _UNCACHED or wp.config.verify_cuda:
        return False
    hooks = torch._C._autograd._top_saved_tensors_default_hooks(True)
    # torch.cuda's own functions take several times as long
    return hooks is None and device.index == torch._C._cuda_getDevice() and not torch._C._cuda_isCurrentStreamCapturing()


_UNCACHED = os.environ.get("PYTORCH_NO_CUDA_MEMORY_CACHING") is not None
_RECORDERS: dict[tuple[torch.device, int, bool], Recorder] = {}


def recorder(device: torch.device, gradients: bool = True) -> Recorder:
    """Return the recorder of torch's current stream on a CUDA device, for calls with or without ``gradients``."""
    key = (device, launch.warp_stream(device).cuda_stream, gradients)
    return _RECORDERS.get(key) or _RECORDERS.setdefault(key, Recorder(GraphPool(device), gradients))


def clear_graph_cache() -> None:
    """Free the memory of all captured graphs; running loops are captured again."""
    for found in list(_RECORDERS.values()):
        found.clear()
