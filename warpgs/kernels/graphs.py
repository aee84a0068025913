"""CUDA graphs of torch's and Warp's kernels: capture, replay, memory, and functions with a graph for each set of addresses.

`CapturedGraph` is one graph. `GraphedFunction` captures a function of tensors once for each set of addresses, and replays it.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import threading
import warnings
from collections.abc import Callable

import torch
import warp as wp

from warpgs.kernels import launch
from warpgs.kernels.launch import Arena, SizingAllocator, part

MAX_GRAPHS = 8
"""Largest number of graphs of a function, one for each set of addresses; a loop that keeps its last result alternates between
two sets."""
MIN_REPLAYS = 30
"""Number of replays that save as much time as one capture takes."""
FREE_CAPTURES = 16
"""Number of captures that a function may make without a gain: at the start of a loop, addresses do not repeat yet."""
SMALL_BYTES = 2**16
"""Largest workspace that is kept between calls [bytes]: allocating one at each call would be slower."""

_CAPTURING = threading.Lock()
"""Lock held during a capture."""


@contextlib.contextmanager
def _no_collection():
    """Switch off garbage collection: it might free another graph, which must not happen during a capture."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


class CapturedGraph:
    """A CUDA graph of the kernels that torch and Warp launch in one call, and the objects that it needs."""

    def __init__(self, work: Callable[[], object], stream: torch.cuda.Stream, pool: tuple[int, int] | None = None):
        """Capture the work; nothing runs yet.

        The caller lets ``stream`` wait for what ``work`` reads, and lets other streams wait for ``stream`` if necessary.

        Args:
            work: A function that neither reads from the device nor loads kernels: call it once before, to load them.
            stream: Stream to capture on, not the default one.
            pool: `pool` of a graph to share memory with. That graph must never be replayed at the same time, nor leave results
                in the shared memory. None for own memory.

        Raises:
            RuntimeError: The work cannot be captured; `torch.OutOfMemoryError` where its memory does not fit.
        """
        # torch.cuda.graph would collect garbage and empty the cache each time, which takes 80 ms
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.stream(stream), _CAPTURING, _no_collection():
            here = launch.warp_stream(torch.device("cuda"))
            # other threads may allocate meanwhile, and wait for streams and events, but not for the whole device
            self._graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                wp.capture_begin(stream=here, external=True)
                try:
                    self.result = work()
                    """Return value of the work."""
                finally:
                    self._lent = wp.capture_end(stream=here)  # memory of Warp that the graph uses
            finally:
                self._graph.capture_end()

    def replay(self) -> None:
        """Run the graph on the current stream."""
        self._graph.replay()

    def pool(self) -> tuple[int, int]:
        """Return the handle of the graph's memory, for graphs that share it."""
        return self._graph.pool()


class GraphMemory:
    """Account of the memory that torch keeps for deleted graphs.

    A graph has its own memory. torch keeps that memory after the graph is deleted, and does not reuse it.
    """

    def __init__(self, device: torch.device):
        self.device = device
        self.reserved = torch.cuda.memory_reserved(device)
        """Bytes that torch held when memory was last given back."""

    def give_back(self, limit: int) -> None:
        """Return unused memory to the device once torch holds ``limit`` bytes more than when memory was last given back.

        Returning memory takes milliseconds, in which the device waits.
        """
        if torch.cuda.memory_reserved(self.device) - self.reserved > limit:
            torch.cuda.empty_cache()
            self.reserved = torch.cuda.memory_reserved(self.device)


class GraphPool:
    """Graphs of one stream of a device that share memory, since only one of them is replayed at a time."""

    def __init__(self, device: torch.device):
        self.device = device
        self.stream = torch.cuda.current_stream(device) if device.type == "cuda" else None
        self.lock = threading.RLock()
        self.replays = 0
        """Number of replays so far."""
        self.failed = False
        """True once a capture failed for another reason than lack of memory."""
        self._aside: torch.cuda.Stream | None = None
        self._keeper: CapturedGraph | None = None

    @functools.cached_property
    def byte(self) -> torch.Tensor:
        """Empty tensor of bytes on the device, shape [0]."""
        return torch.empty(0, dtype=torch.uint8, device=self.device)

    def capturing(self) -> bool:
        """Return whether other code captures a graph on the current stream."""
        return self.stream is not None and torch._C._cuda_isCurrentStreamCapturing()

    def capture(self, work: Callable[[], object]) -> CapturedGraph:
        """Return a graph of ``work``, captured on a separate stream.

        Raises:
            RuntimeError: The work cannot be captured; `torch.OutOfMemoryError` where its memory does not fit.
        """
        if self._aside is None:
            self._aside = torch.cuda.Stream(self.device)
        here = torch.cuda.current_stream(self.device)
        self._aside.wait_stream(here)  # a capture sets numbers of torch's generator that graphs in flight may still read
        try:
            with torch.no_grad():
                # holds the shared memory, which torch would not reuse once the last graph is gone
                if self._keeper is None:
                    self._keeper = CapturedGraph(lambda: torch.zeros(1, device=self.device, dtype=torch.float32), self._aside)
                return CapturedGraph(work, self._aside, self._keeper.pool())
        finally:
            here.wait_stream(self._aside)

    def pool(self) -> tuple[int, int] | None:
        """Return the handle of the shared memory; None before the first capture."""
        return None if self._keeper is None else self._keeper.pool()

    def release(self) -> None:
        """Keep no memory for later graphs, and forget that a capture failed."""
        self._keeper, self.failed = None, False


class GraphedFunction:
    """A function of tensors, captured as a graph for each set of their addresses, up to MAX_GRAPHS."""

    def __init__(self, function: Callable[..., tuple[torch.Tensor, ...]], graphs: GraphPool):
        """Prepare the function; nothing is captured yet.

        Args:
            function: A function of an `Allocator` and of tensors or Nones, always of the same shapes. It gets its memory from
                the allocator, does not read from the device, and returns the saved tensors that `saved` is to find.
            graphs: Pool to capture graphs in.
        """
        self.function, self.graphs = function, graphs
        self.replays = self.captures = 0
        self._sizes: SizingAllocator | None = None
        self._workspace: torch.Tensor | None = None
        self._graphs: dict[tuple[int, ...], CapturedGraph] = {}
        self._places: list[tuple] = []

    def __call__(self, *inputs: torch.Tensor | None) -> tuple[list[torch.Tensor], torch.Tensor | None]:
        """Return the function's output tensors, and the block with its saved tensors (or None)."""
        with self.graphs.lock:
            if self._sizes is None:  # a first run, which also loads kernels: that is not possible during a capture
                sizes = SizingAllocator()
                with torch.no_grad():
                    self.function(sizes, *inputs)
                self._sizes = sizes
                if sizes.workspace_bytes <= SMALL_BYTES:
                    self._workspace = self.graphs.byte.new_empty(sizes.workspace_bytes)
            arena = Arena(self._sizes, self.graphs.byte, self._workspace)
            key = (*[0 if t is None else t.data_ptr() for t in inputs], *arena.addresses())
            graph = None
            if not self.graphs.capturing():
                graph = self._graphs.get(key) or self._capture(key, arena, inputs)
            if graph is None:
                with torch.no_grad():
                    self._run(arena, inputs)
            else:
                graph.replay()
                self.replays += 1
                self.graphs.replays += 1
        return arena.outputs, arena.block

    def saved(self, block: torch.Tensor) -> list[torch.Tensor]:
        """Return the tensors [...] that the function returned when it filled a block [B]."""
        return [part(block, *place) for place in self._places]

    def _run(self, arena: Arena, inputs: tuple[torch.Tensor | None, ...]) -> None:
        """Call the function without a graph."""
        arena.begin()  # a capture may have ended half way
        found = self.function(arena, *inputs)
        self._places = [arena.place(t) for t in found]

    def _capture(self, key: tuple[int, ...], arena: Arena, inputs: tuple[torch.Tensor | None, ...]) -> CapturedGraph | None:
        """Return a new graph; None if a capture would not pay or is not possible."""
        if self.graphs.failed or self.captures - FREE_CAPTURES > self.replays // MIN_REPLAYS:
            return None  # too many captures: addresses change too often
        self.captures += 1
        try:
            graph = self.graphs.capture(lambda: self._run(arena, inputs))
        except torch.OutOfMemoryError:
            return None
        except RuntimeError as error:  # of the driver, or of an allocator without support for graphs
            self.graphs.failed = True
            message = f"rasterizer calls are no longer captured as CUDA graphs, so small calls are slower: {error}"
            warnings.warn(message, stacklevel=2)
            return None
        if len(self._graphs) == MAX_GRAPHS:
            del self._graphs[next(iter(self._graphs))]
        self._graphs[key] = graph
        return graph
