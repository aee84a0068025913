"""CUDA graphs of torch's and Warp's kernels: capture, replay, memory, and functions with a graph for each set of addresses.

`CapturedGraph` is one graph. `GraphedFunction` captures a function of tensors once for each set of addresses, and replays it.
"""

import contextlib
import functools
import gc
import math
import threading
import warnings
from collections.abc import Callable

import torch
import warp as wp

from warpgs.kernels import launch
from warpgs.kernels.native import Floats, cuda_kernel, source

MAX_GRAPHS = 8
"""Largest number of graphs of a function, one for each set of addresses; a loop that keeps its last result alternates between
two sets."""
MIN_REPLAYS = 30
"""Number of replays that save as much time as one capture takes."""
FREE_CAPTURES = 16
"""Number of captures that a function may make without a gain: at the start of a loop, addresses do not repeat yet."""
SMALL_BYTES = 2**16
"""Largest workspace that is kept between calls [bytes]: allocating one at each call would be slower."""

ALIGNMENT = 256
"""Alignment of the parts of a block [bytes]: enough for sorts and 16-byte loads, and whole cache lines."""


class Allocator:
    """Provider of tensors by lifetime, so that captured kernels find them at the same addresses; this class asks torch."""

    def new(self, kind: str, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        """Return a new tensor of a shape [...]."""
        return torch.empty(shape, dtype=dtype, device=device)

    def output(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        """Return a new tensor of a shape [...] that the caller may keep."""
        return self.new("output", shape, dtype, device)

    def saved(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        """Return a new tensor of a shape [...] that the backward pass needs."""
        return self.new("saved", shape, dtype, device)

    def workspace(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        """Return a new tensor of a shape [...] that is needed only until the function returns."""
        return self.new("workspace", shape, dtype, device)


TORCH = Allocator()
"""The allocator of torch."""


def _bytes(shape: tuple[int, ...], dtype: torch.dtype) -> int:
    """Return the aligned size of a tensor [bytes]."""
    return -(-math.prod(shape) * dtype.itemsize // ALIGNMENT) * ALIGNMENT


class SizingAllocator(Allocator):
    """An allocator of torch that records the requested sizes."""

    def __init__(self):
        self.outputs: list[tuple[torch.Tensor, tuple[int, ...]]] = []
        """For each output tensor, an empty tensor of its type and device, and its shape."""
        self.bytes = {"saved": 0, "workspace": 0}
        """Sizes of all saved tensors, and of all workspace, with alignment."""

    def new(self, kind, shape, dtype, device):
        """Return a new tensor of a shape [...], and note its shape or its size."""
        tensor = super().new(kind, shape, dtype, device)
        if kind == "output":
            self.outputs.append((tensor.new_empty(0), tuple(shape)))
        else:
            self.bytes[kind] += _bytes(shape, dtype)
        return tensor


class Arena(Allocator):
    """An allocator of the tensors that a function requested before: outputs one by one, the others as parts of two blocks."""

    def __init__(self, sizes: SizingAllocator, byte: torch.Tensor, workspace: torch.Tensor | None = None):
        """Ask torch for all memory of a function that ran with ``sizes``; ``byte`` is any tensor of bytes."""
        self.outputs = [kind.new_empty(shape) for kind, shape in sizes.outputs]
        """Output tensors, in the order in which the function asks for them."""
        self.block = byte.new_empty(sizes.bytes["saved"]) if sizes.bytes["saved"] else None
        """Block of the saved tensors, or None."""
        self._workspace = byte.new_empty(sizes.bytes["workspace"]) if workspace is None else workspace
        self.begin()

    def begin(self) -> None:
        """Start again: the next requests get the same tensors, from the first on."""
        self._left, self._ends = iter(self.outputs), {"saved": 0, "workspace": 0}

    def addresses(self) -> tuple[int, ...]:
        """Return the addresses of all memory that is handed out."""
        block = 0 if self.block is None else self.block.data_ptr()
        return *[t.data_ptr() for t in self.outputs], block, self._workspace.data_ptr()

    def place(self, tensor: torch.Tensor) -> tuple[int, tuple[int, ...], torch.dtype]:
        """Return the place of a saved tensor [...], as the arguments of `part` that follow the block."""
        begin = tensor.data_ptr() - self.block.data_ptr() if tensor.numel() else 0  # an empty tensor has no address
        return begin, tuple(tensor.shape), tensor.dtype

    def new(self, kind, shape, dtype, device):
        """Return the next of the output tensors, or the next part of a block, as a tensor of a shape [...]."""
        if kind == "output":
            return next(self._left)
        begin = self._ends[kind]
        self._ends[kind] += _bytes(shape, dtype)
        return part(self.block if kind == "saved" else self._workspace, begin, shape, dtype)


def part(block: torch.Tensor, begin: int, shape: tuple[int, ...], dtype: torch.dtype) -> torch.Tensor:
    """Return a part of a block of bytes [B], from byte ``begin`` on, as a tensor of ``shape`` [...]."""
    return block[begin : begin + math.prod(shape) * dtype.itemsize].view(dtype).view(shape)


@cuda_kernel(source("allocator_fetch.cu"), "begin + wp.tid()", "warpgs.runtime.allocator.fetch")
def fetch_kernel(item: int, table: wp.uint64, first: int, second: int, out: Floats):
    """Copy the numbers of `fetch`, one a thread."""


def fetch(table: int, first: int, second: int, out: torch.Tensor) -> None:
    """Fill ``out`` from a table of three addresses, read when the kernel runs; ``second`` counts the first two's numbers."""
    launch.launch(fetch_kernel, out.numel(), [table, first, second, out], out.device)


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
        """Capture the work on a stream that is not the default one; it neither reads from the device nor loads kernels."""
        # ``pool`` is that of a graph to share memory with: it must never be replayed at the same time, nor leave results there.
        # Raises RuntimeError where the work cannot be captured. torch.cuda.graph would collect garbage and empty the cache each
        # time, which takes 80 ms
        self._graph, caller = torch.cuda.CUDAGraph(), torch.cuda.current_stream(stream.device)
        # for what the work reads; and a capture sets numbers of torch's generator that graphs in flight may still read
        stream.wait_stream(caller)
        try:
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
        finally:
            caller.wait_stream(stream)

    def replay(self) -> object:
        """Run the graph on the current stream; return what the work returned."""
        self._graph.replay()
        return self.result

    def pool(self) -> tuple[int, int]:
        """Return the handle of the graph's memory, for graphs that share it."""
        return self._graph.pool()


class GraphMemory:
    """Account of the memory of deleted graphs, which torch keeps and does not reuse."""

    def __init__(self, device: torch.device):
        self.device = device
        self.reserved = torch.cuda.memory_reserved(device)
        """Bytes that torch held when memory was last given back."""

    def give_back(self, limit: int) -> None:
        """Return unused memory once torch holds ``limit`` bytes more than at the last return; the device waits milliseconds."""
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
        self._keeper: CapturedGraph | None = None

    @functools.cached_property
    def byte(self) -> torch.Tensor:
        """Empty tensor of bytes on the device, shape [0]."""
        return torch.empty(0, dtype=torch.uint8, device=self.device)

    @functools.cached_property
    def _aside(self) -> torch.cuda.Stream:
        return torch.cuda.Stream(self.device)

    @torch.no_grad()
    def capture(self, work: Callable[[], object]) -> CapturedGraph:
        """Return a graph of ``work``, captured on a separate stream, or raise what `CapturedGraph` raises."""
        if self._keeper is None:  # holds the shared memory, which torch would not reuse once the last graph is gone
            self._keeper = CapturedGraph(lambda: torch.zeros(1, device=self.device, dtype=torch.float32), self._aside)
        return CapturedGraph(work, self._aside, self._keeper.pool())

    def release(self) -> None:
        """Keep no memory for later graphs, and forget that a capture failed."""
        self._keeper, self.failed = None, False


class GraphedFunction:
    """A function of tensors, captured as a graph for each set of their addresses, up to MAX_GRAPHS."""

    def __init__(self, function: Callable[..., tuple[torch.Tensor, ...]], graphs: GraphPool):
        """Prepare a function of an `Allocator` and of tensors or Nones, always of the same shapes; nothing is captured yet."""
        # It gets its memory from the allocator, does not read from the device, and returns the saved tensors that `saved` is to
        # find.
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
                if sizes.bytes["workspace"] <= SMALL_BYTES:
                    self._workspace = self.graphs.byte.new_empty(sizes.bytes["workspace"])
            arena = Arena(self._sizes, self.graphs.byte, self._workspace)
            key = (*[0 if t is None else t.data_ptr() for t in inputs], *arena.addresses())
            graph = None
            if self.graphs.stream is None or not torch._C._cuda_isCurrentStreamCapturing():  # nor does other code capture
                graph = self._graphs.get(key) or self._capture(key, arena, inputs)
            if graph is None:
                self._run(arena, inputs)
            else:
                graph.replay()
                self.replays += 1
                self.graphs.replays += 1
        return arena.outputs, arena.block

    def saved(self, block: torch.Tensor) -> list[torch.Tensor]:
        """Return the tensors [...] that the function returned when it filled a block [B]."""
        return [part(block, *place) for place in self._places]

    @torch.no_grad()
    def _run(self, arena: Arena, inputs: tuple[torch.Tensor | None, ...]) -> None:
        """Call the function without a graph."""
        arena.begin()  # a capture may have ended half way
        self._places = [arena.place(t) for t in self.function(arena, *inputs)]

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
