"""Adam (Kingma and Ba 2015) in place: one pass over parameter, gradient and both moments."""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.kernels.compiler import ROLLED
from warpgs.runtime import interop
from warpgs.runtime.cuda_source import source

BETAS = (0.9, 0.999)
"""Decay rates of the two moments (Kingma and Ba 2015)."""
EPS = 1e-15
"""Number added to the root of the second moment, as in Kerbl et al. 2023, since gradients are tiny."""
LANES = 16
"""Elements that are updated together on a CPU, in a loop that vectorises."""
SEGMENT = 4096
"""Elements that one task updates on a CPU, a multiple of `LANES`."""


@functools.cache
def make_functions(real):
    """Make the update of one element, in three functions."""

    @wp.func
    def decayed(m: real, g: real, beta1: real, rest1: real) -> real:
        """Return the running mean of the gradient."""
        return beta1 * m + rest1 * g

    @wp.func
    def decayed_square(s: real, g: real, beta2: real, rest2: real) -> real:
        """Return the running mean of the squared gradient."""
        return beta2 * s + rest2 * g * g

    @wp.func
    def moved(p: real, m: real, s: real, lr: real, root_correction2: real, eps: real) -> real:
        """Return the parameter after the step."""
        return p - lr * m / (wp.sqrt(s) / root_correction2 + eps)

    return SimpleNamespace(decayed=decayed, decayed_square=decayed_square, moved=moved)


@functools.cache
def make_kernel(real, split: bool, lanes: int):
    """Make the update kernel; each task updates a segment of the flat parameter, ``lanes`` elements at a time.

    Args:
        real: wp.float32 or wp.float64.
        split: True where the first numbers of each row have a learning rate of their own, which costs some arithmetic.
        lanes: Number of elements that are updated at a time.
    """
    values = wp.types.vector(lanes, real)
    f = make_functions(real)

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def update(
        begin: int, gradient: wp.array(dtype=real), length: int, row: int, head: int, head_lr: real, lr: real,
        beta1: real, beta2: real, rest1: real, rest2: real, root_correction2: real, eps: real,
        # outputs
        parameter: wp.array(dtype=real), mean: wp.array(dtype=real), square: wp.array(dtype=real),
    ):  # fmt: skip
        task = begin + wp.tid()
        first = task * length
        end = wp.min(first + length, parameter.shape[0])
        p = values()
        m = values()
        s = values()
        for start in range(first, end, lanes):
            # Warp counts negative indices from the end; the compiler vectorises only if it can exclude them
            base = wp.max(start, 0)
            phase = real(base % row) + real(0.5)
            if base + lanes <= end:
                for lane in range(lanes):
                    i = base + lane
                    g = gradient[i]
                    m[lane] = f.decayed(mean[i], g, beta1, rest1)
                    s[lane] = f.decayed_square(square[i], g, beta2, rest2)
                    step = lr
                    if wp.static(split):
                        # position in the row, from its middle, so that rounding cannot change the entry
                        place = (phase + real(lane)) / real(row)
                        step = wp.where((place - wp.floor(place)) * real(row) < real(head), head_lr, lr)
                    p[lane] = f.moved(parameter[i], m[lane], s[lane], step, root_correction2, eps)
                for lane in range(lanes):
                    parameter[base + lane] = p[lane]
                    mean[base + lane] = m[lane]
                    square[base + lane] = s[lane]
            else:
                for i in range(base, end):
                    g = gradient[i]
                    mean[i] = f.decayed(mean[i], g, beta1, rest1)
                    square[i] = f.decayed_square(square[i], g, beta2, rest2)
                    step = lr
                    if wp.static(split):
                        step = wp.where(i % row < head, head_lr, lr)
                    parameter[i] = f.moved(parameter[i], mean[i], square[i], step, root_correction2, eps)

    return update


@functools.cache
def make_scheduled_kernel():
    """Make the CUDA update kernel in float32: four elements per thread, learning rates in memory, so a graph can replay it."""

    @wp.func_native(source("adam_update.cu"))
    def update_body(
        four: int, gradient: wp.array(dtype=float), row: int, head: int, lrs: wp.array(dtype=float),
        beta1: float, beta2: float, rest1: float, rest2: float, eps: float, skip: wp.array(dtype=int),
        parameter: wp.array(dtype=float), mean: wp.array(dtype=float), square: wp.array(dtype=float),
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, grid_stride=False, module="warpgs.kernels.adam.scheduled")
    def update(
        begin: int, gradient: wp.array(dtype=float), row: int, head: int, lrs: wp.array(dtype=float),
        beta1: float, beta2: float, rest1: float, rest2: float, eps: float, skip: wp.array(dtype=int),
        # outputs
        parameter: wp.array(dtype=float), mean: wp.array(dtype=float), square: wp.array(dtype=float),
    ):  # fmt: skip
        update_body(
            wp.tid(), gradient, row, head, lrs, beta1, beta2, rest1, rest2, eps, skip, parameter, mean, square
        )  # fmt: skip

    return update


def scheduled_lrs(lr: float, step: int, betas: tuple[float, float] = BETAS, head_lr: float | None = None) -> list[float]:
    """Return corrected learning rates of a row's first and other numbers, and the root of the second moment's correction."""
    correction1, correction2 = 1 - betas[0] ** step, 1 - betas[1] ** step
    return [(lr if head_lr is None else head_lr) / correction1, lr / correction1, correction2**0.5]


def adam_scheduled(
    param: torch.Tensor, grad: torch.Tensor, exp_avg: torch.Tensor, exp_avg_sq: torch.Tensor, lrs: torch.Tensor,
    skip: torch.Tensor, *, head: int, betas: tuple[float, float] = BETAS, eps: float = EPS,
) -> None:  # fmt: skip
    """Update as `adam_step` does, in float32, with learning rates in memory, so that a CUDA graph can replay it.

    Args:
        param: Parameter, contiguous, shape [N, ...].
        grad: Its gradient, same shape.
        exp_avg: Running mean of the gradient, same shape, contiguous.
        exp_avg_sq: Running mean of the squared gradient, same shape, contiguous.
        lrs: Result of `scheduled_lrs`, float32, shape [3].
        skip: Flag, int32, shape [1]; nothing is updated if it is not 0.
        head: How many numbers, from the start of a row, take the first learning rate; 0 for none.
        betas: Decay of the two running means.
        eps: Number added to the square root of the second moment.
    """
    if param.numel() == 0:
        return
    if param.device.type == "cpu":
        if int(skip) == 0:
            _update(param, grad, exp_avg, exp_avg_sq, lrs.tolist(), head, betas, eps)
        return
    inputs = [
        interop.view(grad.contiguous().view(-1), wp.float32), param[0].numel(), head, interop.view(lrs, wp.float32),
        *betas, 1 - betas[0], 1 - betas[1], eps, interop.view(skip, wp.int32),
        *(interop.view(t.view(-1), wp.float32) for t in (param, exp_avg, exp_avg_sq)),
    ]  # fmt: skip
    interop.launch(make_scheduled_kernel(), -(-param.numel() // 4), inputs, param.device)


def _update(param, grad, exp_avg, exp_avg_sq, lrs: list[float], head: int, betas: tuple[float, float], eps: float) -> None:
    """Launch the generic kernel, which is used on a CPU and for float64."""
    real, device = interop.real_of(param), param.device
    length, lanes = (SEGMENT, LANES) if device.type == "cpu" else (1, 1)
    flat = [interop.view(t.view(-1), real) for t in (param, exp_avg, exp_avg_sq)]
    head_lr, lr, root_correction2 = lrs
    with interop.stream_of(device):
        inputs = [
            interop.view(grad.contiguous().view(-1), real), length, param[0].numel(), head, head_lr, lr,
            *betas, 1 - betas[0], 1 - betas[1], root_correction2, eps, *flat,
        ]  # fmt: skip
        kernel = make_kernel(real, head > 0, lanes)
        interop.launch(kernel, -(-param.numel() // length), inputs, device, cost=max(1, length // 16))


def adam_step(
    param: torch.Tensor,
    grad: torch.Tensor,
    exp_avg: torch.Tensor,
    exp_avg_sq: torch.Tensor,
    *,
    lr: float,
    step: int,
    betas: tuple[float, float] = BETAS,
    eps: float = EPS,
    head_lr: float | None = None,
    head: int = 0,
) -> None:
    """Update a parameter and its moments in place, with bias correction as in `torch.optim.Adam`.

    Args:
        param: Parameter, contiguous, shape [N, ...].
        grad: Its gradient, same shape.
        exp_avg: Running mean of the gradient, same shape, contiguous.
        exp_avg_sq: Running mean of the squared gradient, same shape, contiguous.
        lr: Learning rate.
        step: Number of this step, from 1.
        betas: Decay rates of the two moments.
        eps: Number added to the square root of the second moment.
        head_lr: Learning rate of the first ``head`` numbers of each of the N rows; None for ``lr``.
        head: How many numbers, from the start of a row, take ``head_lr``; 0 for none.

    Raises:
        TypeError: A scalar type is neither float32 nor float64, or scalar types differ.
        ValueError: A shape or device is wrong, a tensor to be updated is not contiguous, or ``step`` is below 1.
    """
    pattern = " ".join(str(s) for s in param.shape)
    interop.check(param=(param, pattern), grad=(grad, pattern), exp_avg=(exp_avg, pattern), exp_avg_sq=(exp_avg_sq, pattern))
    if not (param.is_contiguous() and exp_avg.is_contiguous() and exp_avg_sq.is_contiguous()):
        raise ValueError("param, exp_avg and exp_avg_sq are updated in place and must be contiguous")
    if step < 1:
        raise ValueError(f"step must be at least 1, not {step}")
    if param.numel() == 0:
        return
    lrs = scheduled_lrs(lr, step, betas, head_lr)
    if param.is_cuda and param.dtype == torch.float32:
        # one kernel for this and for captured steps, so that both give the same bits
        skip = torch.zeros(1, dtype=torch.int32, device=param.device)
        on_device = torch.tensor(lrs, device=param.device, dtype=torch.float32)
        adam_scheduled(param, grad, exp_avg, exp_avg_sq, on_device, skip, betas=betas, eps=eps, head=head)
        return
    _update(param, grad, exp_avg, exp_avg_sq, lrs, head, betas, eps)
