"""Updates of a step: buffers of a step, Adam, decay of opacities, dropout."""

import functools
from enum import IntEnum
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.kernels import launch
from warpgs.kernels.native import ROLLED, source

# Bookkeeping of a captured step: its settings are read at the start, and its loss is stored at the end.
#
# Torch would launch about twenty kernels on a few numbers each, which would take a tenth of a step's time.

NOT_FINITE = 2
"""Value of the stop flag after a non-finite loss; the flag is 1 if the instances exceeded the capacity."""


class Setting(IntEnum):
    """Columns of the settings of a step, float32 of shape [7]: host and kernels read a setting by its column."""

    DROPOUT = 0
    """Probability that opacity dropout hides a Gaussian, in [0, 1)."""
    NUMBER = 1
    """Number of the step, or of the view if a step has several views; an integer from 1, below 2^24."""
    MEANS_LR = 2
    """Learning rate of the means [u]."""
    RED = 3
    """Red of the view's background minus red of the scene's background; green and blue follow (`SHIFT`)."""
    GREEN = 4
    BLUE = 5
    STEP = 6
    """Number of the step, the same for all views of a step; an integer from 1, below 2^24."""

    @classmethod
    def row(
        cls, *, dropout: float, number: int, step: int, means_lr: float, shift: tuple[float, float, float]
    ) -> tuple[float, ...]:
        """Return the settings of one step in the order of the columns, 7 numbers."""
        return dropout, number, means_lr, *shift, step


ERROR_LANES = 16
"""Neighbouring elements whose errors are summed together on a CPU, in a loop that vectorises."""
ERROR_SEGMENT = 4096
"""Elements whose errors a task sums on a CPU, a multiple of `ERROR_LANES`."""
SHIFT = slice(Setting.RED, Setting.BLUE + 1)
"""Columns of the difference of the backgrounds."""


@functools.cache
def make_step_kernels():
    """Make the two kernels."""

    @wp.kernel(enable_backward=False, module="warpgs.kernels.step_buffers")
    def begin_step(
        begin: int, counter: wp.array(dtype=wp.int64), view_rows: wp.array(dtype=wp.int64),
        lr_rows: wp.array2d(dtype=float), setting_rows: wp.array2d(dtype=float),
        viewmats: wp.array2d(dtype=float), Ks: wp.array2d(dtype=float), targets: wp.array2d(dtype=float),
        # outputs
        lrs: wp.array(dtype=float), settings: wp.array(dtype=float),
        viewmat: wp.array(dtype=float), K: wp.array(dtype=float), target: wp.array(dtype=float),
    ):  # fmt: skip
        i = begin + wp.tid()
        step = int(counter[0])
        view = int(view_rows[step])
        if i < target.shape[0]:
            target[i] = targets[view, i]
        if i < lrs.shape[0]:
            lrs[i] = lr_rows[step, i]
        if i < settings.shape[0]:
            settings[i] = setting_rows[step, i]
        if i < 16:
            viewmat[i] = viewmats[view, i]
        if i < 9:
            K[i] = Ks[view, i]

    @wp.kernel(enable_backward=False, module="warpgs.kernels.step_buffers")
    def end_step(
        begin: int, loss: wp.array(dtype=float), mse: wp.array(dtype=float),
        # outputs; all but the last are read, too
        counter: wp.array(dtype=wp.int64), stop: wp.array(dtype=int), history: wp.array2d(dtype=float),
        going: wp.array(dtype=wp.bool),
    ):  # fmt: skip
        step = int(counter[begin])
        history[step, 0] = loss[0]
        history[step, 1] = mse[0]
        if not wp.isfinite(loss[0]):
            stop[0] = wp.static(NOT_FINITE)
        going[0] = stop[0] == 0
        if stop[0] == 0:
            counter[0] = wp.int64(step + 1)

    return SimpleNamespace(begin_step=begin_step, end_step=end_step)


@functools.cache
def make_errors():
    """Make the kernel that sums squared errors on a CPU, one task per `ERROR_SEGMENT` elements."""
    values = wp.types.vector(ERROR_LANES, wp.float32)
    lanes, segment = wp.constant(ERROR_LANES), wp.constant(ERROR_SEGMENT)

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def squared_errors(
        begin: int, rgb: wp.array(dtype=float), target: wp.array(dtype=float),
        # outputs
        sums: wp.array(dtype=float),
    ):  # fmt: skip
        task = begin + wp.tid()
        base = task * segment
        end = wp.min(base + segment, rgb.shape[0])
        s = values()
        while base < end:
            o = wp.max(base, 0)
            base += lanes
            if base <= end:
                for lane in range(lanes):
                    p = rgb[o + lane]
                    d = wp.where(p < 0.0, 0.0, wp.where(p > 1.0, 1.0, p)) - target[o + lane]  # a NaN stays one
                    s[lane] = s[lane] + d * d
            else:
                for lane in range(end - o):
                    p = rgb[o + lane]
                    d = wp.where(p < 0.0, 0.0, wp.where(p > 1.0, 1.0, p)) - target[o + lane]
                    s[lane] = s[lane] + d * d
        total = float(0.0)
        for lane in range(lanes):
            total += s[lane]
        sums[task] = total

    return squared_errors


def squared_error(rgb: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the sum of squared errors of an image clamped to [0, 1], shape [], the same bits on any number of CPU threads.

    Args:
        rgb: Colours, shape [H, W, 3].
        target: Colours in [0, 1], shape [H, W, 3].
    """
    if rgb.device.type != "cpu" or rgb.dtype != torch.float32:
        return torch.nn.functional.mse_loss(rgb.clamp(0, 1), target, reduction="sum")
    tasks = -(-rgb.numel() // ERROR_SEGMENT)
    sums = rgb.new_empty(tasks)
    inputs = [*(launch.flat(t.contiguous(), wp.float32) for t in (rgb, target)), launch.view(sums, wp.float32)]
    launch.launch(make_errors(), tasks, inputs, rgb.device, cost=ERROR_SEGMENT // 10)
    return sums.sum()


def begin_step(
    counter: torch.Tensor, view_rows: torch.Tensor, lr_rows: torch.Tensor, setting_rows: torch.Tensor,
    viewmats: torch.Tensor, Ks: torch.Tensor, targets: torch.Tensor,
) -> tuple[torch.Tensor, ...]:  # fmt: skip
    """Return the inputs of the step whose number is in device memory. Tensors are float32 unless another type is given.

    Args:
        counter: Number of the step among the B steps that were prepared, int64, shape [1].
        view_rows: Number of each step's view, int64, shape [B].
        lr_rows: Learning rates of each step, shape [B, R].
        setting_rows: Settings of each step (`Setting`), shape [B, S].
        viewmats: camera_from_world of each view, shape [V, 4, 4].
        Ks: Intrinsics [px], shape [V, 3, 3].
        targets: Images, shape [V, H, W, 3].

    Returns:
        ``lrs`` [R], ``settings`` [S], ``viewmat`` [1, 4, 4], ``K`` [1, 3, 3] and ``target`` [H, W, 3].
    """
    found = (
        lr_rows.new_empty(lr_rows.shape[1]), setting_rows.new_empty(setting_rows.shape[1]),
        viewmats.new_empty(1, 4, 4), Ks.new_empty(1, 3, 3), targets.new_empty(targets.shape[1:]),
    )  # fmt: skip
    rows = [launch.view(t.view(len(t), -1), wp.float32) for t in (lr_rows, setting_rows, viewmats, Ks, targets)]
    numbers = [launch.view(t, wp.int64) for t in (counter, view_rows)]
    outputs = [launch.view(t.view(-1), wp.float32) for t in found]
    count = max(16, *(t.numel() for t in found))
    launch.launch(make_step_kernels().begin_step, count, [*numbers, *rows, *outputs], counter.device)
    return found


def end_step(
    loss: torch.Tensor, mse: torch.Tensor, counter: torch.Tensor, stop: torch.Tensor, history: torch.Tensor
) -> torch.Tensor:
    """Store a step's result, then increase the counter if ``stop`` is 0; else the step is not counted, and can be repeated.

    Args:
        loss: Loss, float32, shape []. If it is not finite, ``stop`` becomes NOT_FINITE.
        mse: Mean squared error, float32, shape [].
        counter: Number of the step, int64, shape [1]; increased by one if ``stop`` is 0.
        stop: 0, or the reason to stop, int32, shape [1].
        history: Loss and mean squared error of each step, float32, shape [B, 2].

    Returns:
        True if ``stop`` is 0, bool, shape [1].
    """
    going = torch.empty(1, dtype=torch.bool, device=loss.device)
    inputs = [
        *(launch.view(t.detach().view(1), wp.float32) for t in (loss, mse)), launch.view(counter, wp.int64),
        launch.view(stop, wp.int32), launch.view(history, wp.float32), launch.view(going, wp.bool),
    ]  # fmt: skip
    launch.launch(make_step_kernels().end_step, 1, inputs, loss.device)
    return going


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
def make_adam_kernel(real, split: bool, lanes: int):
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
        launch.view(grad.contiguous().view(-1), wp.float32), param[0].numel(), head, launch.view(lrs, wp.float32),
        *betas, 1 - betas[0], 1 - betas[1], eps, launch.view(skip, wp.int32),
        *(launch.view(t.view(-1), wp.float32) for t in (param, exp_avg, exp_avg_sq)),
    ]  # fmt: skip
    launch.launch(make_scheduled_kernel(), -(-param.numel() // 4), inputs, param.device)


def _update(param, grad, exp_avg, exp_avg_sq, lrs: list[float], head: int, betas: tuple[float, float], eps: float) -> None:
    """Launch the generic kernel, which is used on a CPU and for float64."""
    real, device = launch.real_of(param), param.device
    length, lanes = (SEGMENT, LANES) if device.type == "cpu" else (1, 1)
    flat = [launch.view(t.view(-1), real) for t in (param, exp_avg, exp_avg_sq)]
    head_lr, lr, root_correction2 = lrs
    with launch.stream_of(device):
        inputs = [
            launch.view(grad.contiguous().view(-1), real), length, param[0].numel(), head, head_lr, lr,
            *betas, 1 - betas[0], 1 - betas[1], root_correction2, eps, *flat,
        ]  # fmt: skip
        kernel = make_adam_kernel(real, head > 0, lanes)
        launch.launch(kernel, -(-param.numel() // length), inputs, device, cost=max(1, length // 16))


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
    launch.check(param=(param, pattern), grad=(grad, pattern), exp_avg=(exp_avg, pattern), exp_avg_sq=(exp_avg_sq, pattern))
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


# Opacity decay: multiply every opacity by a factor, so that only Gaussians that the views support stay opaque.
#
# After Binocular3DGS (Han et al. 2024, section 3.3), which multiplies by 0.995.


@functools.cache
def make_decay_kernel():
    """Make the kernel."""

    @wp.kernel(enable_backward=False, module="warpgs.kernels.opacity_decay")
    def decay(
        begin: int, logits: wp.array(dtype=float), factor: wp.float64,
        # outputs
        decayed: wp.array(dtype=float),
    ):  # fmt: skip
        i = begin + wp.tid()
        # in float64, since the rounding of float32's logarithm depends on the processor
        one, x = wp.float64(1.0), wp.float64(logits[i])
        # f o / (1 - f o) with o = 1 / (1 + exp(-x)); each form where its exponential is at most 1
        value = x + wp.log(factor) - wp.log(one + (one - factor) * wp.exp(wp.min(x, wp.float64(0.0))))
        if x > wp.float64(0.0):
            value = wp.log(factor) - wp.log(one - factor + wp.exp(-x))
        decayed[i] = wp.where(wp.isnan(x), logits[i], wp.float32(value))

    return decay


def opacity_decay(logits: torch.Tensor, factor: float) -> torch.Tensor:
    """Return the logits after multiplying the opacities by a factor.

    Args:
        logits: Logits of opacities, float32, shape [N]; a NaN stays NaN.
        factor: Factor, in (0, 1).

    Returns:
        Logits, float32, shape [N].

    Raises:
        ValueError: ``logits`` is not of shape [N], or the factor is out of range.
    """
    launch.check(logits=(logits, "N"))
    if not 0 < factor < 1:
        raise ValueError(f"factor must be above 0 and below 1, not {factor}")
    decayed = torch.empty_like(logits)
    inputs = [launch.view(logits, wp.float32), float(factor), launch.view(decayed, wp.float32)]
    launch.launch(make_decay_kernel(), len(logits), inputs, logits.device)
    return decayed


# Opacity dropout: hide random Gaussians for a step and make the others more opaque (DropGaussian, Park et al. 2025).


@functools.cache
def make_dropout_kernel():
    """Make the kernel; its settings are in memory, so that a CUDA graph can replay it."""

    @wp.kernel(enable_backward=False, module="warpgs.kernels.dropout")
    def sample(
        begin: int, settings: wp.array(dtype=float), seed: int,
        # outputs
        factors: wp.array(dtype=float),
    ):  # fmt: skip
        i = begin + wp.tid()
        p = settings[Setting.DROPOUT]
        # one stream of numbers for each seed and step, one number of it for each Gaussian
        state = wp.rand_init(wp.randi(wp.rand_init(seed, int(settings[Setting.NUMBER]))), i)
        factors[i] = wp.where(wp.randf(state) >= p, 1.0 / (1.0 - p), 0.0)

    return sample


def opacity_dropout(count: int, settings: torch.Tensor, seed: int) -> torch.Tensor:
    """Return factors for the opacities of ``count`` Gaussians: 0 with probability p, else 1 / (1 - p).

    The expected opacity is unchanged. The factors depend only on p, ``seed``, the number of the step or view (`Setting.NUMBER`)
    and the Gaussian's row, so they are the same on every device and in a resumed fit.

    Args:
        count: Number of Gaussians N.
        settings: Settings of the step, float32, shape [7]; `Setting.DROPOUT` is p.
        seed: Any 32-bit integer.

    Returns:
        Factors, float32, shape [N], on the device of ``settings``.

    Raises:
        ValueError: ``settings`` is not of shape [7].
    """
    launch.check(settings=(settings, str(len(Setting))))
    factors = torch.empty(count, dtype=torch.float32, device=settings.device)
    inputs = [launch.view(settings, wp.float32), seed, launch.view(factors, wp.float32)]
    launch.launch(make_dropout_kernel(), count, inputs, settings.device)
    return factors
