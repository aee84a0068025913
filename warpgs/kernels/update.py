"""Updates of a step: buffers of a step, Adam, decay of opacities, dropout."""

import functools
from enum import IntEnum

import torch
import warp as wp
from torch import Tensor

from warpgs.kernels import launch
from warpgs.kernels.native import ROLLED, FloatRows, Floats, Ints, Longs, cuda_kernel, source

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


LANES = 16
"""Neighbouring elements that are processed together on a CPU, in a loop that vectorises."""
SEGMENT = 4096
"""Elements that one task processes on a CPU, a multiple of `LANES`."""
SHIFT = slice(Setting.RED, Setting.BLUE + 1)
"""Columns of the difference of the backgrounds."""


@wp.kernel(enable_backward=False, module="warpgs.kernels.update")
def begin_kernel(
    begin: int, counter: Longs, view_rows: Longs, lr_rows: FloatRows, setting_rows: FloatRows, viewmats: FloatRows,
    Ks: FloatRows, targets: FloatRows,
    # outputs
    lrs: Floats, settings: Floats, viewmat: Floats, K: Floats, target: Floats,
):  # fmt: skip
    """Copy what a step needs, by its number and the number of its view."""
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


@wp.kernel(enable_backward=False, module="warpgs.kernels.update")
def end_kernel(
    begin: int, loss: Floats, mse: Floats,
    # outputs; all but the last are read, too
    counter: Longs, stop: Ints, history: FloatRows, going: wp.array(dtype=wp.bool),
):  # fmt: skip
    """Store the loss and the error of a step, and count it."""
    step = int(counter[begin])
    history[step, 0] = loss[0]
    history[step, 1] = mse[0]
    if not wp.isfinite(loss[0]):
        stop[0] = NOT_FINITE
    going[0] = stop[0] == 0
    if stop[0] == 0:
        counter[0] = wp.int64(step + 1)


error_values = wp.types.vector(LANES, wp.float32)


@wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
def squared_errors(
    begin: int, rgb: Floats, target: Floats,
    # outputs
    sums: Floats,
):  # fmt: skip
    """Sum squared errors on a CPU, one task per `SEGMENT` elements."""
    task = begin + wp.tid()
    base = task * SEGMENT
    end = wp.min(base + SEGMENT, rgb.shape[0])
    s = error_values()
    while base < end:
        o = wp.max(base, 0)
        base += LANES
        if base <= end:
            for lane in range(LANES):
                p = rgb[o + lane]
                d = wp.where(p < 0.0, 0.0, wp.where(p > 1.0, 1.0, p)) - target[o + lane]  # a NaN stays one
                s[lane] = s[lane] + d * d
        else:
            for lane in range(end - o):
                p = rgb[o + lane]
                d = wp.where(p < 0.0, 0.0, wp.where(p > 1.0, 1.0, p)) - target[o + lane]
                s[lane] = s[lane] + d * d
    total = float(0.0)
    for lane in range(LANES):
        total += s[lane]
    sums[task] = total


def squared_error(rgb: Tensor, target: Tensor) -> Tensor:
    """Return the sum of squared errors of an image [H, W, 3] clamped to [0, 1]; the same bits on any number of CPU threads."""
    if rgb.device.type != "cpu" or rgb.dtype != torch.float32:
        return torch.nn.functional.mse_loss(rgb.clamp(0, 1), target, reduction="sum")
    tasks = -(-rgb.numel() // SEGMENT)
    sums = rgb.new_empty(tasks)
    launch.launch(squared_errors, tasks, [rgb.contiguous(), target.contiguous(), sums], rgb.device, cost=SEGMENT // 10)
    return sums.sum()


def begin_step(
    counter: Tensor, view_rows: Tensor, lr_rows: Tensor, setting_rows: Tensor, viewmats: Tensor, Ks: Tensor, targets: Tensor
) -> tuple[Tensor, ...]:
    """Return lrs [R], settings [S], viewmat [1, 4, 4], K [1, 3, 3] and target [H, W, 3] of the step in the counter [1]."""
    found = (
        lr_rows.new_empty(lr_rows.shape[1]), setting_rows.new_empty(setting_rows.shape[1]),
        viewmats.new_empty(1, 4, 4), Ks.new_empty(1, 3, 3), targets.new_empty(targets.shape[1:]),
    )  # fmt: skip
    rows = [t.view(len(t), -1) for t in (lr_rows, setting_rows, viewmats, Ks, targets)]
    launch.launch(begin_kernel, max(16, *(t.numel() for t in found)), [counter, view_rows, *rows, *found], counter.device)
    return found


def end_step(loss: Tensor, mse: Tensor, counter: Tensor, stop: Tensor, history: Tensor) -> Tensor:
    """Store a step's loss and error in ``history`` [B, 2]; count the step if ``stop`` [1] is 0, and return that, bool, [1]."""
    going = torch.empty(1, dtype=torch.bool, device=loss.device)
    launch.launch(end_kernel, 1, [loss, mse, counter, stop, history, going], loss.device)
    return going


BETAS = (0.9, 0.999)
"""Decay rates of the two moments (Kingma and Ba 2015)."""
EPS = 1e-15
"""Number added to the root of the second moment, as in Kerbl et al. 2023, since gradients are tiny."""


@functools.cache
def make_adam_kernel(real, split: bool, lanes: int):
    """Make the update kernel; ``split`` where the first numbers of each row have a learning rate of their own."""
    values, Reals = wp.types.vector(lanes, real), wp.array(dtype=real)

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

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def update(
        begin: int, gradient: Reals, length: int, row: int, head: int, head_lr: real, lr: real, beta1: real, beta2: real,
        rest1: real, rest2: real, root_correction2: real, eps: real,
        # outputs
        parameter: Reals, mean: Reals, square: Reals,
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
                    m[lane] = decayed(mean[i], g, beta1, rest1)
                    s[lane] = decayed_square(square[i], g, beta2, rest2)
                    step = lr
                    if wp.static(split):
                        # position in the row, from its middle, so that rounding cannot change the entry
                        place = (phase + real(lane)) / real(row)
                        step = wp.where((place - wp.floor(place)) * real(row) < real(head), head_lr, lr)
                    p[lane] = moved(parameter[i], m[lane], s[lane], step, root_correction2, eps)
                for lane in range(lanes):
                    parameter[base + lane] = p[lane]
                    mean[base + lane] = m[lane]
                    square[base + lane] = s[lane]
            else:
                for i in range(base, end):
                    g = gradient[i]
                    mean[i] = decayed(mean[i], g, beta1, rest1)
                    square[i] = decayed_square(square[i], g, beta2, rest2)
                    step = lr
                    if wp.static(split):
                        step = wp.where(i % row < head, head_lr, lr)
                    parameter[i] = moved(parameter[i], mean[i], square[i], step, root_correction2, eps)

    return update


@cuda_kernel(source("adam_update.cu"), "wp.tid()", "warpgs.kernels.adam.scheduled")
def scheduled_update(
    four: int, gradient: Floats, row: int, head: int, lrs: Floats, beta1: float, beta2: float, rest1: float, rest2: float,
    eps: float, skip: Ints,
    # outputs
    parameter: Floats, mean: Floats, square: Floats,
):  # fmt: skip
    """Update four elements per thread, with learning rates in memory, so that a graph can replay it."""


def scheduled_lrs(lr: float, step: int, betas: tuple[float, float] = BETAS, head_lr: float | None = None) -> list[float]:
    """Return corrected learning rates of a row's first and other numbers, and the root of the second moment's correction."""
    correction1, correction2 = 1 - betas[0] ** step, 1 - betas[1] ** step
    return [(lr if head_lr is None else head_lr) / correction1, lr / correction1, correction2**0.5]


def adam_scheduled(
    param: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, lrs: Tensor,
    skip: Tensor, *, head: int, betas: tuple[float, float] = BETAS, eps: float = EPS,
) -> None:  # fmt: skip
    """Update rows [N, ...] and their moments in place, as `torch.optim.Adam` does, unless ``skip`` [1] is not 0."""
    # ``lrs`` [3] are those of `scheduled_lrs`; the first ``head`` numbers of each row take the first. All tensors are float32
    # and contiguous.
    if param.numel() == 0:
        return
    if param.device.type == "cpu":
        if int(skip) == 0:
            update_rows(param, grad, exp_avg, exp_avg_sq, lrs.tolist(), head, betas, eps)
        return
    inputs = [
        grad.contiguous(), param[0].numel(), head, lrs, *betas, 1 - betas[0], 1 - betas[1], eps, skip,
        param, exp_avg, exp_avg_sq,
    ]  # fmt: skip
    launch.launch(scheduled_update, -(-param.numel() // 4), inputs, param.device)


def update_rows(param, grad, exp_avg, exp_avg_sq, lrs: list[float], head: int, betas: tuple[float, float], eps: float) -> None:
    """Launch the generic kernel, which is used on a CPU and for float64."""
    real, device = launch.real_of(param), param.device
    length, lanes = (SEGMENT, LANES) if device.type == "cpu" else (1, 1)
    head_lr, lr, root_correction2 = lrs
    inputs = [
        grad.contiguous(), length, param[0].numel(), head, head_lr, lr, *betas, 1 - betas[0], 1 - betas[1],
        root_correction2, eps, param, exp_avg, exp_avg_sq,
    ]  # fmt: skip
    kernel = make_adam_kernel(real, head > 0, lanes)
    launch.launch(kernel, -(-param.numel() // length), inputs, device, cost=max(1, length // 16))


# Opacity decay: multiply every opacity by a factor, so that only Gaussians that the views support stay opaque.
#
# After Binocular3DGS (Han et al. 2024, section 3.3), which multiplies by 0.995.


@wp.kernel(enable_backward=False, module="warpgs.kernels.update")
def decay(
    begin: int, logits: Floats, factor: wp.float64,
    # outputs
    decayed: Floats,
):  # fmt: skip
    """Multiply the opacity of a logit."""
    i = begin + wp.tid()
    # in float64, since the rounding of float32's logarithm depends on the processor
    one, x = wp.float64(1.0), wp.float64(logits[i])
    # f o / (1 - f o) with o = 1 / (1 + exp(-x)); each form where its exponential is at most 1
    value = x + wp.log(factor) - wp.log(one + (one - factor) * wp.exp(wp.min(x, wp.float64(0.0))))
    if x > wp.float64(0.0):
        value = wp.log(factor) - wp.log(one - factor + wp.exp(-x))
    decayed[i] = wp.where(wp.isnan(x), logits[i], wp.float32(value))


def opacity_decay(logits: Tensor, factor: float) -> Tensor:
    """Return the logits [N], float32, after multiplying the opacities by a factor in (0, 1); a NaN stays NaN."""
    launch.check(logits=(logits, "N"))
    if not 0 < factor < 1:
        raise ValueError(f"factor must be above 0 and below 1, not {factor}")
    decayed = torch.empty_like(logits)
    launch.launch(decay, len(logits), [logits, float(factor), decayed], logits.device)
    return decayed


# Opacity dropout: hide random Gaussians for a step and make the others more opaque (DropGaussian, Park et al. 2025).


@wp.kernel(enable_backward=False, module="warpgs.kernels.update")
def sample(
    begin: int, settings: Floats, seed: int,
    # outputs
    factors: Floats,
):  # fmt: skip
    """Draw a factor; the settings are in memory, so that a CUDA graph can replay it."""
    i = begin + wp.tid()
    p = settings[Setting.DROPOUT]
    # one stream of numbers for each seed and step, one number of it for each Gaussian
    state = wp.rand_init(wp.randi(wp.rand_init(seed, int(settings[Setting.NUMBER]))), i)
    factors[i] = wp.where(wp.randf(state) >= p, 1.0 / (1.0 - p), 0.0)


def opacity_dropout(count: int, settings: Tensor, seed: int) -> Tensor:
    """Return factors [N] for the opacities: 0 with probability p (`Setting.DROPOUT`), else 1 / (1 - p)."""
    # They depend only on p, ``seed``, the number of the step or view and the Gaussian's row, so they are the same on every
    # device and in a resumed fit.
    launch.check(settings=(settings, str(len(Setting))))
    factors = torch.empty(count, dtype=torch.float32, device=settings.device)
    launch.launch(sample, count, [settings, seed, factors], settings.device)
    return factors
