"""Allocators, which group a function's tensors by lifetime, so that captured kernels find them at the same addresses.

For tensors that are at another address each time, `fetch` reads the address when the kernel runs.
"""

from __future__ import annotations

import functools
import math

import torch
import warp as wp

from warpgs.runtime import interop
from warpgs.runtime.cuda_source import source

ALIGNMENT = 256
"""Alignment of the parts of a block [bytes]: enough for sorts and 16-byte loads, and whole cache lines."""


class Allocator:
    """Provider of a function's tensors; this class allocates each with torch."""

    def output(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        """Return a new tensor of a shape [...] that the caller may keep."""
        return torch.empty(shape, dtype=dtype, device=device)

    def saved(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        """Return a new tensor of a shape [...] that the backward pass needs."""
        return torch.empty(shape, dtype=dtype, device=device)

    def workspace(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        """Return a new tensor of a shape [...] that is needed only until the function returns."""
        return torch.empty(shape, dtype=dtype, device=device)


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
        self.saved_bytes = self.workspace_bytes = 0
        """Sizes of all saved tensors, and of all workspace, with alignment."""

    def output(self, shape, dtype, device):
        """Return a new tensor of a shape [...], and note its shape."""
        tensor = super().output(shape, dtype, device)
        self.outputs.append((tensor.new_empty(0), tuple(shape)))
        return tensor

    def saved(self, shape, dtype, device):
        """Return a new tensor of a shape [...], and add its size to `saved_bytes`."""
        self.saved_bytes += _bytes(shape, dtype)
        return super().saved(shape, dtype, device)

    def workspace(self, shape, dtype, device):
        """Return a new tensor of a shape [...], and add its size to `workspace_bytes`."""
        self.workspace_bytes += _bytes(shape, dtype)
        return super().workspace(shape, dtype, device)


class Arena(Allocator):
    """An allocator of the tensors that a function requested before: outputs one by one, the others as parts of two blocks."""

    def __init__(self, sizes: SizingAllocator, byte: torch.Tensor, workspace: torch.Tensor | None = None):
        """Ask torch for all of the memory.

        Args:
            sizes: Allocator that the function ran with before.
            byte: Any tensor of bytes on the device. (`new_empty` takes half the time of `torch.empty`.)
            workspace: A block that is not in use; None to allocate one.
        """
        self.outputs = [kind.new_empty(shape) for kind, shape in sizes.outputs]
        """Output tensors, in the order in which the function asks for them."""
        self.block = byte.new_empty(sizes.saved_bytes) if sizes.saved_bytes else None
        """Block of the saved tensors, or None."""
        self._workspace = byte.new_empty(sizes.workspace_bytes) if workspace is None else workspace
        self.begin()

    def begin(self) -> None:
        """Start again: the next requests get the same tensors, from the first on."""
        self._asked = self._saved_to = self._workspace_to = 0

    def addresses(self) -> tuple[int, ...]:
        """Return the addresses of all memory that is handed out."""
        block = 0 if self.block is None else self.block.data_ptr()
        return *[t.data_ptr() for t in self.outputs], block, self._workspace.data_ptr()

    def place(self, tensor: torch.Tensor) -> tuple[int, tuple[int, ...], torch.dtype]:
        """Return the place of a saved tensor [...], as the arguments of `part` that follow the block."""
        begin = tensor.data_ptr() - self.block.data_ptr() if tensor.numel() else 0  # an empty tensor has no address
        return begin, tuple(tensor.shape), tensor.dtype

    def output(self, shape, dtype, device):
        """Return the next of the output tensors, of the given shape [...]."""
        tensor = self.outputs[self._asked]
        self._asked += 1
        return tensor

    def saved(self, shape, dtype, device):
        """Return the next part of the block, as a tensor of a shape [...]."""
        begin, self._saved_to = self._saved_to, self._saved_to + _bytes(shape, dtype)
        return part(self.block, begin, shape, dtype)

    def workspace(self, shape, dtype, device):
        """Return the next part of the workspace, as a tensor of a shape [...]."""
        begin, self._workspace_to = self._workspace_to, self._workspace_to + _bytes(shape, dtype)
        return part(self._workspace, begin, shape, dtype)


def part(block: torch.Tensor, begin: int, shape: tuple[int, ...], dtype: torch.dtype) -> torch.Tensor:
    """Return a part of a block of bytes [B], from byte ``begin`` on, as a tensor of ``shape`` [...]."""
    return block[begin : begin + math.prod(shape) * dtype.itemsize].view(dtype).view(shape)


@functools.cache
def make_fetch():
    """Make the kernel of `fetch`."""

    @wp.func_native(source("allocator_fetch.cu"))
    def body(item: int, table: wp.uint64, first: int, second: int, out: wp.array(dtype=float)): ...

    @wp.kernel(enable_backward=False, module="warpgs.runtime.allocator.fetch")
    def fetch(begin: int, table: wp.uint64, first: int, second: int, out: wp.array(dtype=float)):
        body(begin + wp.tid(), table, first, second, out)

    return fetch


def fetch(table: int, first: int, second: int, out: torch.Tensor) -> None:
    """Copy three tensors into one, from the addresses that a table holds when the kernel runs.

    Args:
        table: Address of a table of three addresses of float32 numbers, in memory that the device of ``out`` can read.
        first: Count of numbers at the first address.
        second: Count of numbers at the first two addresses together; the rest is at the third.
        out: Result, float32, contiguous, any shape.
    """
    interop.launch(make_fetch(), out.numel(), [table, first, second, interop.flat(out, wp.float32)], out.device)
