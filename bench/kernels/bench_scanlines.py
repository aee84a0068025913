"""Time of the path costs of an image's depth planes, beside numpy, which a fit on a CPU uses."""

import numpy as np
import torch

from bench import inputs, roofline
from bench.harness import OURS, Task
from warpgs.kernels.scanlines import scanline_costs
from warpgs.priors.sweep_cpu import path_costs
from warpgs.priors.sweep_planes import UNIT

AXES = ("image",)
NUMPY = "numpy"
PROGRAMS = {OURS: ("forward",), NUMPY: ("forward",)}
PLANES = 64


def tasks(point, device, wanted):
    image = inputs.image(point.width, point.height, torch.device("cpu")).numpy()
    costs = np.random.default_rng(0).integers(0, UNIT + 1, (point.height, point.width, PLANES)).astype(np.int16)
    there = torch.from_numpy(costs).to(device)
    bounds = [torch.full(s, UNIT // 2, dtype=torch.int32, device=device)
              for s in ((point.height - 1, point.width), (point.height, point.width - 1))]  # fmt: skip
    yield Task(OURS, "forward", lambda: scanline_costs(there, *bounds, 123), roofline.scanlines(point.pixels, PLANES))
    if wanted(NUMPY, "forward"):
        yield Task(NUMPY, "forward", lambda: [path_costs(costs, image, 0.03, 0.5, down=down) for down in (True, False)])
