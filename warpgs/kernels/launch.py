"""Torch and Warp side by side: tensors as arrays, devices and streams, launches, derivatives."""

import _thread
import contextlib
import ctypes
import functools
import os
import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import Any

import torch
import warp as wp
from torch._subclasses.fake_tensor import FakeTensor

from warpgs.device import prepare_kernel_cache
from warpgs.errors import ResourceError, UsageError
from warpgs.kernels.native import load_module
from warpgs.openmp import warn_if_spinning
from warpgs.process import hidden_stderr

wp.config.log_level = wp.LOG_WARNING  # its banner and compile notes are not for users


prepare_kernel_cache()
# without a CUDA driver, Warp's native code prints a warning
with contextlib.nullcontext() if torch.cuda.is_available() else hidden_stderr():
    wp.init()  # device_from_torch fails before this

REALS = {torch.float32: wp.float32, torch.float64: wp.float64}
"""Warp's scalar type by torch's."""

CHUNKS_PER_THREAD = 8
"""Ranges per thread of a CPU launch: several, so that a few heavy tiles do not hold up the rest."""

FEW_THREADS = 4
"""Number of threads above which each gets half as many ranges: Python hands out ranges one at a time."""

SERIAL_WORK = 20_000
"""Work (items times cost) below which a launch stays on the calling thread: a hand-over costs 50 us. A range has at least half
as much work, unless there would be fewer ranges than threads."""

MAX_SIZE = 2**31 - 1
"""Largest number of entries of an axis, and of items of a launch: Warp indexes them with signed 32-bit integers."""


def _check_size(size: int) -> None:
    """Raise ResourceError where kernels cannot index so many entries."""
    if size > MAX_SIZE:
        raise ResourceError(f"kernels cannot index {size:,} entries, only {MAX_SIZE:,}; use fewer Gaussians, pixels or cameras")


def check_device(name: str, tensor: torch.Tensor) -> None:
    """Raise ValueError unless kernels can read the memory of a tensor [...]: on a CPU or a CUDA device, and allocated."""
    if not (tensor.is_cpu or tensor.is_cuda):
        raise ValueError(f"{name} is on {tensor.device}, but the kernels run on cpu and cuda only; .to('cpu') moves it")
    if type(tensor) is not torch.Tensor and isinstance(tensor, FakeTensor):
        raise ValueError(f"{name} is a fake tensor, without memory; leave FakeTensorMode before the call")
    if tensor.layout != torch.strided:
        raise TypeError(f"{name} must be dense, not {tensor.layout}; {name}.to_dense() converts it")


def is_native(tensor: torch.Tensor) -> bool:
    """Return whether the kernels with bodies in CUDA apply to a tensor [...]; otherwise those in plain Warp do."""
    return tensor.is_cuda and tensor.dtype == torch.float32


def real_of(tensor: torch.Tensor) -> type:
    """Return the Warp scalar type of a tensor [...]; TypeError unless float32 or float64."""
    if tensor.dtype not in REALS:
        raise TypeError(f"kernels take float32 or float64 tensors, not {tensor.dtype}")
    return REALS[tensor.dtype]


def set_threads(count: int) -> None:
    """Set the number of threads of CPU launches, at least 1. This sets torch's own number of threads, so both agree."""
    torch.set_num_threads(count)


def _serve(calls: SimpleQueue[Callable[[], None]]) -> None:
    """Make the calls of a queue, which must not raise."""
    # The locks of `concurrent.futures` and of `threading.Thread.start` can stay locked after an interrupt; the queue's cannot.
    while True:
        calls.get()()


@functools.cache
def _pool(count: int, process: int) -> SimpleQueue[Callable[[], None]]:
    """Return the queue that a number of threads of this process serve."""
    calls: SimpleQueue[Callable[[], None]] = SimpleQueue()
    for _ in range(count):
        _thread.start_new_thread(_serve, (calls,))
    return calls


@functools.cache
def _declared(kernel) -> tuple[tuple[object, int] | None, ...]:
    """Return for each argument after ``begin`` the Warp type of an array's elements and the axes of its tensor; else None."""
    types = [a.type for a in kernel.adj.args[1:]]
    return tuple((t.dtype, t.ndim + len(getattr(t.dtype, "_shape_", ()))) if isinstance(t, wp.array) else None for t in types)


def _shape(tensor: torch.Tensor, axes: int) -> tuple[int, ...]:
    """Return the sizes of a tensor [...] for a kernel with so many axes: as it is, flat with all gaps, or as rows."""
    if tensor.ndim == axes:
        return tuple(tensor.shape)
    count = tensor.numel()
    if axes == 1:
        return (1 + sum((n - 1) * step for n, step in zip(tensor.shape, tensor.stride())) if count else 0,)
    return count // max(tensor.shape[-1], 1), tensor.shape[-1]


def row_stride(tensor: torch.Tensor) -> int:
    """Return the number of entries from one row of the last axis of a tensor [..., K] to the next."""
    for axis in range(-2, -tensor.ndim - 1, -1):
        if tensor.shape[axis] > 1:  # the stride of an axis of one entry may be any number
            return tensor.stride(axis)
    return tensor.shape[-1]


def as_array(tensor: torch.Tensor, dtype, axes: int) -> wp.array:
    """Return the memory of a tensor [...] as a Warp array of the sizes of `_shape`, without a copy and without gradient."""
    shape, tensor = _shape(tensor, axes), tensor.detach()
    for size in shape:
        _check_size(size)
    tensor = tensor.as_strided(shape, (1,)) if axes == 1 < tensor.ndim else tensor.view(shape)
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False)


def warp_device(device: torch.device) -> wp.Device:
    """Return Warp's object for a torch device, also for a CUDA device without a number."""
    if device.type == "cuda" and device.index is None:
        device = torch.device("cuda", torch.cuda.current_device())
    return wp.device_from_torch(device)


@functools.cache
def _several_devices() -> bool:
    return torch.cuda.device_count() > 1


def _current(device: torch.device):
    """Return a context in which a CUDA device is current; afterwards the caller's device is current again.

    Warp makes a device current when it works there, and does not restore the previous device; torch then uses Warp's device.
    """
    return torch.cuda.device(device) if _several_devices() else contextlib.nullcontext()


@functools.cache
def _warp_stream(device: torch.device, pointer: int) -> wp.Stream:
    with _current(device):
        return wp.Stream(warp_device(device), cuda_stream=pointer)


def warp_stream(device: torch.device) -> wp.Stream:
    """Return torch's current stream of a CUDA device as Warp's object."""
    # torch.cuda.current_stream creates a Python object each time and is ten times slower
    index = torch.cuda.current_device() if device.index is None else device.index
    return _warp_stream(device, torch._C._cuda_getCurrentRawStream(index))


_LOADING = threading.Lock()
"""Lock held while a CPU module is loaded, since several threads must not compile at once. In debug mode it is also held while a
kernel runs, since kernels of that mode are not thread-safe."""
_SORTING = threading.RLock()
"""Lock held by a thread while it sorts: Warp has one stream for all threads of a device."""


@contextlib.contextmanager
def stream_of(device: torch.device):
    """Run Warp's own work (sorts, scans) on torch's current stream of that device; do nothing on a CPU.

    Kernels started with `launch` need no such context.
    """
    if device.type != "cuda":
        yield
        return
    wanted, where = warp_stream(device), warp_device(device)
    with _SORTING, _current(device):
        before = where.stream
        where.set_stream(wanted, sync=False)
        try:
            yield
        finally:
            where.set_stream(before, sync=False)


class _Recorded:
    """A kernel with a launch that is recorded once; later calls only replace its arguments.

    ``wp.launch`` packs and checks every argument anew. That took 47 us on an H200's host and 140 us on a CPU of 2.6 GHz. The
    recorded launch keeps the packed arguments; a call writes pointers, sizes and scalars into them.
    """

    def __init__(self, kernel, device: torch.device, block_dim: int):
        self.kernel, self.device, self.block_dim = kernel, warp_device(device), block_dim
        self.declared = _declared(kernel)
        self.command, self.known, self.dtypes = None, [], []
        self.lock = threading.Lock()  # autograd launches from a thread of its own

    def launch(self, count: int, inputs: Sequence, stream: wp.Stream) -> None:
        with self.lock:
            self.patched(count, inputs).launch(stream)

    def patched(self, count: int, inputs: Sequence) -> wp.Launch:
        """Return the recorded launch with these arguments; the first call records it."""
        if self.command is not None:
            self._patch(count, inputs)
            return self.command
        load_module(self.kernel.module, self.device, self.block_dim)
        self.dtypes = [getattr(value, "dtype", None) for value in inputs]
        packed = [0]
        for i, (value, array) in enumerate(zip(inputs, self.declared, strict=True)):
            if array:
                self._check(i, value)
                packed.append(as_array(value, *array))
            elif hasattr(value, "__ctype__"):  # a copy of the struct, since later calls write into it
                numbers = value.__ctype__()
                packed.append(type(value)(type(numbers).from_buffer_copy(numbers)))
            else:
                packed.append(value)
        command = wp.launch(self.kernel, count, inputs=packed, record_cmd=True, device=self.device, block_dim=self.block_dim)
        command.fwd_args = None  # else the first call's arrays would stay in memory
        self.known = [None] * len(inputs)
        self.command = command  # set last: after an interrupt there is no launch
        return command

    def _patch(self, count: int, inputs: Sequence) -> None:
        command, known = self.command, self.known
        if command.bounds.size != count:
            command.set_dim(count)
        for i, (value, array) in enumerate(zip(inputs, self.declared, strict=True)):
            packed = command.params[i + 2]  # after the bounds and ``begin``
            # In a loop most arguments are those of the call before, memory addresses included.
            if array:
                stride = row_stride(value) if 0 < value.ndim != array[1] else 0
                key = value.data_ptr(), value.shape, stride, value.dtype
                if known[i] == key:
                    continue
                self._check(i, value)
                shape = _shape(value, array[1])
                for size in shape[: packed.ndim]:
                    _check_size(size)  # it would wrap around
                known[i] = None  # an interrupt here must leave no half-written entry
                packed.data = key[0]
                for axis in range(packed.ndim):
                    packed.shape[axis] = shape[axis]
                if packed.ndim == 2:
                    packed.strides[0] = (stride or value.stride(0)) * value.element_size()
                known[i] = key
            elif known[i] != value:
                if hasattr(value, "__ctype__"):
                    ctypes.pointer(packed)[0] = value.__ctype__()  # copies its numbers
                elif isinstance(value, (int, float)):
                    packed.value = value
                else:  # vectors and matrices
                    command.set_param_at_index(i + 1, value)
                known[i] = value

    def _check(self, i: int, tensor: torch.Tensor) -> None:
        """Raise TypeError unless argument i, a tensor [...], has the recorded scalar type, and memory on the device."""
        kind, dtype = "cuda" if self.device.is_cuda else "cpu", tensor.dtype
        if dtype is self.dtypes[i] and tensor.device.type == kind and (tensor.data_ptr() or not tensor.numel()):
            return
        label = self.kernel.adj.args[i + 1].label  # after ``begin``
        found = "a FakeTensor without memory" if isinstance(tensor, FakeTensor) else f"{dtype} on {tensor.device}"
        raise TypeError(f"{self.kernel.key}: {label} must be {self.dtypes[i]} on {kind}, not {found}")


_recorded = functools.cache(_Recorded)


class _OfThread(threading.local):
    """Recorded launches on the CPU by thread and kernel: two threads may launch a kernel at once, with different arguments."""

    def __init__(self):
        self.recorded: dict[object, _Recorded] = {}
        self.shared: _SharedLaunch | None = None  # the last launch, if an interrupt may have left threads at work


_OF_THREAD = _OfThread()


class _SharedLaunch:
    """A recorded CPU launch whose ranges several threads process.

    The threads work in raw memory of the caller, so `run` leaves none at work, on whatever way it ends. A thread that starts
    after the end finds ``open`` False and touches nothing.
    """

    def __init__(self, kernel, recorded: wp.Launch, count: int, chunks: int, inputs: Sequence):
        self.kernel, self.recorded, self.count, self.chunks = kernel, recorded, count, chunks
        self.inputs = inputs  # keeps their memory
        self.left = iter(range(chunks))  # each thread processes the next range after finishing one
        self.open, self.ended, self.working, self.error = True, False, 0, None
        # Only `with` statements of raw locks are safe from interrupts: Condition and Event may stay locked.
        self.lock = threading.Lock()
        self.busy = threading.Lock()  # held while other threads work

    def run(self, pool: SimpleQueue, helpers: int) -> None:
        """Process all ranges on this thread and at most ``helpers`` others."""
        try:
            for _ in range(helpers):
                pool.put(self.help)
            self.work()  # here, too: each hand-over costs processor time
        finally:
            interrupt = None
            while not self.ended:
                try:  # around the call, since an interrupt may come before its first line
                    self.finish()
                except BaseException as error:  # a second Ctrl-C
                    interrupt = error
            if interrupt is not None:
                raise interrupt
        if self.error is not None:
            raise self.error

    def help(self) -> None:
        """Process ranges on another thread, unless the launch has ended."""
        with self.lock:
            if not self.open:
                return
            self.working += 1
            if self.working == 1:
                self.busy.acquire()
        try:
            self.work()
        except BaseException as error:
            self.error = error
        finally:
            with self.lock:
                self.working -= 1
                if self.working == 0:
                    self.busy.release()

    def work(self) -> None:
        """Process ranges until none is left."""
        first, count, chunks = self.recorded, self.count, self.chunks
        # a recorded launch of its own for each thread, which shares the packed arrays
        bounds, begin = type(first.bounds)((count,)), type(first.params[1])(0)
        params = [bounds, begin, *first.params[2:]]
        command = wp.Launch(self.kernel, first.device, hooks=first.hooks, params=params, bounds=bounds)
        for i in self.left:
            begin.value, end = count * i // chunks, count * (i + 1) // chunks
            bounds.shape[0] = bounds.size = end - begin.value
            command.launch()

    def finish(self) -> None:
        """Let no thread begin another range, and wait for those at work."""
        for _ in self.left:  # some are left after an error or an interrupt
            pass
        with self.lock:
            self.open = False
        with self.busy:
            self.ended = True
        self.inputs = ()  # a thread that has yet to start holds the launch, and must not hold the caller's memory


def launch(kernel, count: int, inputs: Sequence, device: torch.device, *, cost: int = 1, block_dim: int = 256) -> None:
    """Launch ``kernel`` over ``count`` independent items; its first argument is the number of the first item."""
    # Tensors become the arrays that the kernel declares (`as_array`); they are contiguous, or their rows are.
    # On a CPU, as many threads as torch uses share the items; results repeat, since each item has its own output memory.
    # ``cost`` is the rough work of an item in units of 10 ns, which decides whether threads pay. ``block_dim`` is CUDA's
    # threads per block.
    if count == 0:
        return
    _check_size(count)
    if device.type == "cuda":
        with _current(device):
            _recorded(kernel, device, block_dim).launch(count, inputs, warp_stream(device))
        return
    if device.type != "cpu":
        raise ValueError(f"{kernel.key}: the kernels run on cpu and cuda only, not on {device}")
    if _OF_THREAD.shared is not None:
        _OF_THREAD.shared.finish()
        _OF_THREAD.shared = None
    # A kernel of Warp 1.19 for x86 keeps a pointer into its stack in a static variable, which only optimised code leaves out.
    if wp.config.mode == "debug":
        with _LOADING:
            load_module(kernel.module, warp_device(device), 1)
            packed = [as_array(value, *array) if array else value for value, array in zip(inputs, _declared(kernel))]
            wp.launch(kernel, count, inputs=[0, *packed], device="cpu", record_tape=False)
        return
    recorded = _OF_THREAD.recorded.get(kernel)
    if recorded is None:
        with _LOADING:  # launches on a CPU are compiled for blocks of one thread
            recorded = _Recorded(kernel, device, 1)
            first = recorded.patched(count, inputs)
        _OF_THREAD.recorded[kernel] = recorded  # only now: a launch that failed has no command
    else:
        first = recorded.patched(count, inputs)
    threads = torch.get_num_threads()
    if threads == 1 or count == 1 or count * cost < SERIAL_WORK:
        first.launch()
        return
    warn_if_spinning()
    each = CHUNKS_PER_THREAD if threads <= FEW_THREADS else CHUNKS_PER_THREAD // 2
    chunks = min(count, threads * each, max(threads, 2 * count * cost // SERIAL_WORK))
    _OF_THREAD.shared = _SharedLaunch(kernel, first, count, chunks, inputs)
    _OF_THREAD.shared.run(_pool(threads - 1, os.getpid()), min(threads, chunks) - 1)
    _OF_THREAD.shared = None


@functools.cache
def _symbols(pattern: str) -> tuple[str | int, ...]:
    return tuple(int(symbol) if symbol.isdigit() else symbol for symbol in pattern.split())


def check(**tensors: tuple[torch.Tensor, str]) -> dict[str, int]:
    """Check shapes, types and devices of tensors against patterns, as ``means=(means, "N 3")``; return sizes by letter."""
    # A capital letter is a size that must agree wherever it occurs.
    sizes: dict[str, int] = {}
    first_name, first = "", None
    for name, (tensor, pattern) in tensors.items():
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name} must be a torch tensor, not {type(tensor).__name__}")
        check_device(name, tensor)
        if first is None:
            first_name, first = name, tensor
            if tensor.dtype not in REALS:
                levels = " / 255" * (tensor.dtype == torch.uint8)  # of an 8-bit image
                raise TypeError(f"{name} must be float32 or float64, not {tensor.dtype}; {name}.float(){levels} converts it")
        if tensor.dtype != first.dtype:
            raise TypeError(f"{name} is {tensor.dtype} but {first_name} is {first.dtype}; give both the same type")
        if tensor.device != first.device:
            raise ValueError(f"{name} is on {tensor.device} but {first_name} is on {first.device}; move one of them")
        wanted, found = _symbols(pattern), tensor.shape
        fits = len(wanted) == len(found)
        for symbol, size in zip(wanted, found):
            expected = symbol if type(symbol) is int else sizes.setdefault(symbol, size)
            fits = fits and expected == size
        if not fits:
            known = ", ".join(f"{k}={v}" for k, v in sizes.items())
            raise ValueError(f"{name} must have shape [{', '.join(map(str, wanted))}] ({known}), not {list(found)}")
    return sizes


class _Refusing(torch.autograd.Function):
    """Values that autograd connects to their sources, so that a gradient through them is an error and not silently zero."""

    @staticmethod
    def forward(ctx: Any, message: str, values: torch.Tensor, *sources: torch.Tensor | None) -> torch.Tensor:
        ctx.message = message
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> None:
        raise UsageError(ctx.message)


_NO_SECOND = "the kernels have no second derivatives: leave out create_graph=True, or detach the gradient"


def keep(ctx: Any, *tensors: torch.Tensor | None) -> None:
    """Save tensors of any shape [...] for the backward pass, in which `kept` returns them."""
    ctx.save_for_backward(*tensors)
    hooked = torch._C._autograd._top_saved_tensors_default_hooks(True) is not None  # may return copies
    ctx.places = [None if t is None else (t.shape, t.dtype, t.device, None if hooked else t.data_ptr()) for t in tensors]


def kept(ctx: Any) -> tuple[Any, ...]:
    """Return the tensors [...] that `keep` saved; RuntimeError where a ``.data`` was replaced, unseen by autograd."""
    # The gradient would be wrong, and with another shape or type the kernels would read and write out of bounds.
    tensors = ctx.saved_tensors
    for tensor, place in zip(tensors, ctx.places, strict=True):
        if tensor is None:
            continue
        *before, address = place
        now = [tensor.shape, tensor.dtype, tensor.device]
        if now != before or (address is not None and tensor.data_ptr() != address):
            raise RuntimeError(f"a .data was replaced between forward and backward pass ({before}, now {now}): render again")
    return tuple(tensors)


def first_order(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap the backward method of an autograd function, so that a second derivative by any saved tensor is an error."""
    # torch's `once_differentiable` would report instead that the tensor was not used. Without ``create_graph``, the wrapper
    # adds nothing.

    @functools.wraps(backward)
    def once(ctx: Any, *gradients: torch.Tensor | None) -> Any:
        if not torch.is_grad_enabled():
            return backward(ctx, *gradients)
        with torch.no_grad():
            found = backward(ctx, *gradients)
        sources = (*gradients, *ctx.saved_tensors)
        return tuple(None if v is None else _Refusing.apply(_NO_SECOND, v, *sources) for v in found)

    return once


def without_gradient(name: str, values: torch.Tensor, source: torch.Tensor) -> torch.Tensor:
    """Return values [...]; a gradient through them is an error where ``source`` [...] requires gradients."""
    message = f"{name} has no gradient: use {name}.detach(), or a loss of rgb, alpha, depth or features instead"
    found: torch.Tensor = _Refusing.apply(message, values, source)
    return found


def refuse_transforms() -> None:
    """Raise UsageError within a transform of torch.func."""
    if torch._C._are_functorch_transforms_active():
        raise UsageError("rasterize does not support torch.func: use torch.autograd.grad, or a batch of cameras for vmap")


@functools.lru_cache(maxsize=64)
def _array_at(address: int, size: int, dtype: object, device: torch.device) -> wp.array:
    """Return memory at an address as a Warp array, which does not own it; the caller must keep the tensor."""
    return wp.array(ptr=address, shape=size, dtype=dtype, device=warp_device(device))


def sort_pairs(keys: torch.Tensor, values: torch.Tensor, count: int, **bits: int) -> None:
    """Sort the first ``count`` pairs stably by their keys; the second half of both tensors [2 M] is workspace."""
    # On a GPU the sort runs on the stream of `stream_of`. ``bits`` are arguments of `wp.utils.radix_sort_pairs`.
    arrays = (_array_at(t.data_ptr(), t.numel(), wp.dtype_from_torch(t.dtype), t.device) for t in (keys, values))
    wp.utils.radix_sort_pairs(*arrays, count, **bits)
