"""Functions of tensors whose kernels are recorded as CUDA graphs, and replayed wherever they meet the same addresses again."""

from __future__ import annotations

import functools
import threading
import warnings
from collections.abc import Callable

import torch

from warpgs.runtime import interop
from warpgs.runtime.allocator import Arena, SizingAllocator, part

VARIANTS = 8
"""Sets of addresses that graphs are kept for: a loop that holds on to some result alternates between two."""
PAID = 30
"""Replays that are worth a recording."""
FREE = 16
"""Recordings of a work that need not have paid: a loop takes a while to settle."""
SMALL = 2**16
"""Bytes that are not worth asking for at each call."""


class GraphPool:
    """Records on one stream of a device, and replays one graph at a time."""

    def __init__(self, device: torch.device):
        self.device = device
        self.stream = torch.cuda.current_stream(device) if device.type == "cuda" else None
        self.lock = threading.RLock()
        self.replays = 0
        self.failed = False
        """Whether something could not be recorded, for another reason than want of memory."""
        self._aside: torch.cuda.Stream | None = None
        self._keeper: tuple | None = None

    @functools.cached_property
    def byte(self) -> torch.Tensor:
        """A tensor of bytes on the device, without any."""
        return torch.empty(0, dtype=torch.uint8, device=self.device)

    def capturing(self) -> bool:
        """Whether somebody records a graph of their own on the current stream."""
        return self.stream is not None and torch._C._cuda_isCurrentStreamCapturing()

    def capture(self, work: Callable[[], object]) -> tuple[object, object]:
        """A graph of ``work``, and what must live as long.

        Raises:
            RuntimeError: It cannot be recorded; `torch.OutOfMemoryError` where its memory does not fit.
        """
        if self._aside is None:
            self._aside = torch.cuda.Stream(self.device)
        here = torch.cuda.current_stream(self.device)
        self._aside.wait_stream(here)  # recording sets numbers of torch's generator that graphs in flight may still read
        try:
            return self._capture_aside(work)
        finally:
            here.wait_stream(self._aside)

    def _capture_aside(self, work: Callable[[], object]) -> tuple[object, object]:
        with torch.cuda.stream(self._aside), torch.no_grad():
            if self._keeper is None:  # memory that graphs share, and that torch would lend to nobody once the last is gone
                self._keeper = interop.capture(lambda: torch.zeros(1, device=self.device))
            graph, (_, lent) = interop.capture(work, self._keeper[0].pool())
        return graph, lent

    def pool(self) -> tuple[int, int] | None:
        """Of the memory that graphs use and nobody else."""
        return None if self._keeper is None else self._keeper[0].pool()

    def release(self) -> None:
        """Keep no memory for graphs to come, and try again."""
        self._keeper, self.failed = None, False


class GraphedFunction:
    """A function of tensors whose kernels are recorded for each set of addresses that it meets, up to VARIANTS."""

    def __init__(self, function: Callable[..., tuple[torch.Tensor, ...]], graphs: GraphPool):
        """Nothing is recorded yet.

        Args:
            function: Takes an `Allocator` and tensors or Nones, always of the same shapes; asks the allocator for what it
                makes, does not read from the device, and returns those saved tensors that `kept` is to find.
            graphs: Where to record.
        """
        self.function, self.graphs = function, graphs
        self.replays = self.recorded = 0
        self._measured: SizingAllocator | None = None
        self._workspace: torch.Tensor | None = None
        self._known: dict[tuple[int, ...], tuple] = {}
        self._places: list[tuple] = []

    def __call__(self, *inputs: torch.Tensor | None) -> tuple[list[torch.Tensor], torch.Tensor | None]:
        """The caller's tensors, and the block of those that are kept."""
        with self.graphs.lock:
            if self._measured is None:  # a first run, which also loads what may not be loaded while recording
                measured = SizingAllocator()
                with torch.no_grad():
                    self.function(measured, *inputs)
                self._measured = measured
                if measured.workspace_bytes <= SMALL:
                    self._workspace = self.graphs.byte.new_empty(measured.workspace_bytes)
            blocks = Arena(self._measured, self.graphs.byte, self._workspace)
            key = (*[0 if t is None else t.data_ptr() for t in inputs], *blocks.addresses())
            known = None
            if not self.graphs.capturing():
                known = self._known.get(key) or self._record(key, blocks, inputs)
            if known is None:
                with torch.no_grad():
                    self._run(blocks, inputs)
            else:
                known[0].replay()
                self.replays += 1
                self.graphs.replays += 1
        return blocks.outputs, blocks.block

    def saved(self, block: torch.Tensor) -> list[torch.Tensor]:
        """What the function returned when it made this block."""
        return [part(block, *place) for place in self._places]

    def _run(self, blocks: Arena, inputs: tuple[torch.Tensor | None, ...]) -> None:
        blocks.begin()  # a recording may have ended half way
        found = self.function(blocks, *inputs)
        self._places = [blocks.place(t) for t in found]

    def _record(self, key: tuple[int, ...], blocks: Arena, inputs: tuple[torch.Tensor | None, ...]) -> tuple | None:
        if self.graphs.failed or self.recorded - FREE > self.replays // PAID:
            return None  # the latter where addresses change too often
        self.recorded += 1
        try:
            known = self.graphs.capture(lambda: self._run(blocks, inputs))
        except torch.OutOfMemoryError:
            return None
        except RuntimeError as error:  # of the driver, or of an allocator that knows no graphs
            self.graphs.failed = True
            said = f"calls of the rasterizer are not recorded from here on, which makes small ones slower: {error}"
            warnings.warn(said, stacklevel=2)
            return None
        if len(self._known) == VARIANTS:
            del self._known[next(iter(self._known))]
        self._known[key] = known
        return known
