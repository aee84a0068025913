"""Where functions put their tensors, by how long those live: so that kernels that were recorded find them again.

And how a recorded kernel finds what is elsewhere each time.
"""

from __future__ import annotations

import functools
import math

import torch
import warp as wp

from warpgs.runtime import interop

ALIGNMENT = 256
"""Bytes that parts of a block begin at multiples of: what sorts and 16-byte loads need, and whole cache lines."""


class Allocator:
    """Asks torch for each tensor."""

    def output(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        """A tensor that the caller may keep."""
        return torch.empty(shape, dtype=dtype, device=device)

    def saved(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        """One that the backward pass needs."""
        return torch.empty(shape, dtype=dtype, device=device)

    def workspace(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        """One that nobody needs when the function is done."""
        return torch.empty(shape, dtype=dtype, device=device)


TORCH = Allocator()


def _bytes(shape: tuple[int, ...], dtype: torch.dtype) -> int:
    return -(-math.prod(shape) * dtype.itemsize // ALIGNMENT) * ALIGNMENT


class SizingAllocator(Allocator):
    """Asks torch, and takes down what a function asks for."""

    def __init__(self):
        self.outputs: list[tuple[torch.Tensor, tuple[int, ...]]] = []
        """Of the caller's tensors: an empty one of its kind, and the shape."""
        self.saved_bytes = self.workspace_bytes = 0

    def output(self, shape, dtype, device):
        """See `Memory`."""
        tensor = super().output(shape, dtype, device)
        self.outputs.append((tensor.new_empty(0), tuple(shape)))
        return tensor

    def saved(self, shape, dtype, device):
        """See `Memory`."""
        self.saved_bytes += _bytes(shape, dtype)
        return super().saved(shape, dtype, device)

    def workspace(self, shape, dtype, device):
        """See `Memory`."""
        self.workspace_bytes += _bytes(shape, dtype)
        return super().workspace(shape, dtype, device)


class Arena(Allocator):
    """What a measured function asks for the next time: tensors for the caller, and parts of two blocks."""

    def __init__(self, measured: SizingAllocator, byte: torch.Tensor, workspace: torch.Tensor | None = None):
        """Ask torch for all of it.

        Args:
            measured: What the function asked for.
            byte: Any tensor of bytes on the device. (`new_empty` takes half the time of `torch.empty`.)
            workspace: A block that nobody else uses now; None for one of its own.
        """
        self.outputs = [kind.new_empty(shape) for kind, shape in measured.outputs]
        """The caller's tensors, in the order in which the function asks for them."""
        self.block = byte.new_empty(measured.saved_bytes) if measured.saved_bytes else None
        """What is kept; None where nothing is."""
        self._workspace = byte.new_empty(measured.workspace_bytes) if workspace is None else workspace
        self.begin()

    def begin(self) -> None:
        """Hand out the same again, from the first."""
        self._asked = self._saved_to = self._workspace_to = 0

    def addresses(self) -> tuple[int, ...]:
        """Of all memory that is handed out."""
        block = 0 if self.block is None else self.block.data_ptr()
        return *[t.data_ptr() for t in self.outputs], block, self._workspace.data_ptr()

    def place(self, tensor: torch.Tensor) -> tuple[int, tuple[int, ...], torch.dtype]:
        """Where a kept tensor is: what `part` takes after the block."""
        begin = tensor.data_ptr() - self.block.data_ptr() if tensor.numel() else 0  # without entries it has no address
        return begin, tuple(tensor.shape), tensor.dtype

    def output(self, shape, dtype, device):
        """See `Memory`."""
        tensor = self.outputs[self._asked]
        self._asked += 1
        return tensor

    def saved(self, shape, dtype, device):
        """See `Memory`."""
        begin, self._saved_to = self._saved_to, self._saved_to + _bytes(shape, dtype)
        return part(self.block, begin, shape, dtype)

    def workspace(self, shape, dtype, device):
        """See `Memory`."""
        begin, self._workspace_to = self._workspace_to, self._workspace_to + _bytes(shape, dtype)
        return part(self._workspace, begin, shape, dtype)


def part(block: torch.Tensor, begin: int, shape: tuple[int, ...], dtype: torch.dtype) -> torch.Tensor:
    """Bytes of a block from ``begin`` on as a tensor."""
    return block[begin : begin + math.prod(shape) * dtype.itemsize].view(dtype).view(shape)


@functools.cache
def _make_fetch():
    @wp.func_native(
        """
        // volatile: the host has written since the last replay
        const volatile unsigned long long* addresses = reinterpret_cast<const volatile unsigned long long*>(table);
        const float* from = reinterpret_cast<const float*>(addresses[item < first ? 0 : 1]);
        out.data[item] = from[item < first ? item : item - first];
        """
    )
    def body(item: int, table: wp.uint64, first: int, out: wp.array(dtype=float)): ...

    @wp.kernel(enable_backward=False, module="warpgs.runtime.allocator.fetch")
    def fetch(begin: int, table: wp.uint64, first: int, out: wp.array(dtype=float)):
        body(begin + wp.tid(), table, first, out)

    return fetch


def fetch(table: int, first: int, out: torch.Tensor) -> None:
    """Copy two tensors behind each other, from wherever they are when the kernel runs.

    Args:
        table: Address of two addresses of float32 numbers, in memory that the device of ``out`` can read.
        first: Numbers that are at the first of them; the rest is at the second.
        out: Where to, float32, contiguous.
    """
    interop.launch(_make_fetch(), out.numel(), [table, first, interop.view(out.view(-1), wp.float32)], out.device)
