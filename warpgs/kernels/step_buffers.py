"""Bookkeeping of a captured step: its settings are read at the start, and its loss is stored at the end.

Torch would launch about twenty kernels on a few numbers each, which would take a tenth of a step's time.
"""

import functools
from enum import IntEnum
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.kernels.compiler import ROLLED
from warpgs.runtime import interop

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
"""Neighbouring elements whose errors are summed together on a CPU, in a loop that vectorises."""
SEGMENT = 4096
"""Elements whose errors a task sums on a CPU, a multiple of `LANES`."""
SHIFT = slice(Setting.RED, Setting.BLUE + 1)
"""Columns of the difference of the backgrounds."""


@functools.cache
def make_kernels():
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
    """Make the kernel that sums squared errors on a CPU, one task per `SEGMENT` elements."""
    values = wp.types.vector(LANES, wp.float32)
    lanes, segment = wp.constant(LANES), wp.constant(SEGMENT)

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
    tasks = -(-rgb.numel() // SEGMENT)
    sums = rgb.new_empty(tasks)
    inputs = [*(interop.flat(t.contiguous(), wp.float32) for t in (rgb, target)), interop.view(sums, wp.float32)]
    interop.launch(make_errors(), tasks, inputs, rgb.device, cost=SEGMENT // 10)
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
    rows = [interop.view(t.view(len(t), -1), wp.float32) for t in (lr_rows, setting_rows, viewmats, Ks, targets)]
    numbers = [interop.view(t, wp.int64) for t in (counter, view_rows)]
    outputs = [interop.view(t.view(-1), wp.float32) for t in found]
    count = max(16, *(t.numel() for t in found))
    interop.launch(make_kernels().begin_step, count, [*numbers, *rows, *outputs], counter.device)
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
        *(interop.view(t.detach().view(1), wp.float32) for t in (loss, mse)), interop.view(counter, wp.int64),
        interop.view(stop, wp.int32), interop.view(history, wp.float32), interop.view(going, wp.bool),
    ]  # fmt: skip
    interop.launch(make_kernels().end_step, 1, inputs, loss.device)
    return going
