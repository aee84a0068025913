"""Time of computing the path costs of an image's depth planes, beside numpy, which takes a line of pixels at a time."""

import numpy as np
import torch

from bench.lib import inputs, roofline
from bench.lib.timing import OURS, Task
from warpgs.kernels.sweep import scanline_costs
from warpgs.priors.sweep import UNIT, step_limits

AXES = ("image",)
NUMPY = "numpy"
PROGRAMS = {OURS: ("forward",), NUMPY: ("forward",)}
PLANES = 64


def path_costs(costs: np.ndarray, image: np.ndarray, small_step: float, large_step: float, *, down: bool) -> np.ndarray:
    """Return the sum of the path costs along columns or rows, in numpy, to run in parallel on several threads."""
    total = np.zeros_like(costs)
    c, t, colors = (a if down else a.swapaxes(0, 1) for a in (costs, total, image))
    bounds, small = step_limits(colors, small_step, large_step), np.int16(round(small_step * UNIT))
    for order, edge in ((range(len(c)), -1), (range(len(c) - 1, -1, -1), 0)):
        path = None
        for k in order:
            if path is None:
                path = c[k].copy()
            else:
                lowest = path.min(1, keepdims=True)
                step = np.minimum(path, lowest + bounds[k + edge, :, None])
                path += small
                np.minimum(step[:, 1:], path[:, :-1], out=step[:, 1:])
                np.minimum(step[:, :-1], path[:, 1:], out=step[:, :-1])
                step -= lowest
                step += c[k]
                path = step
            t[k] += path
    return total


def tasks(point, device, wanted):
    image = inputs.image(point.width, point.height, torch.device("cpu")).numpy()
    costs = np.random.default_rng(0).integers(0, UNIT + 1, (point.height, point.width, PLANES)).astype(np.int16)
    there = torch.from_numpy(costs).to(device)
    bounds = [torch.full(s, UNIT // 2, dtype=torch.int32, device=device)
              for s in ((point.height - 1, point.width), (point.height, point.width - 1))]  # fmt: skip
    yield Task(OURS, "forward", lambda: scanline_costs(there, *bounds, 123), roofline.scanlines(point.pixels, PLANES))
    if wanted(NUMPY, "forward"):
        yield Task(NUMPY, "forward", lambda: [path_costs(costs, image, 0.03, 0.5, down=down) for down in (True, False)])
