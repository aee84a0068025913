"""Time of the parts of a captured step other than rendering and learning: reading its view and rates, storing its result."""

import torch

from bench.lib import inputs, roofline
from bench.lib.timing import OURS, Task
from warpgs.kernels.update import begin_step, end_step

AXES = ("image",)
PROGRAMS = {OURS: ("forward",)}


def tasks(point, device, wanted):
    targets = inputs.image(point.width, point.height, device)[None]
    cam = inputs.camera(point.width, point.height, device)
    numbers = [torch.zeros(1, dtype=torch.int64, device=device), torch.zeros(100, dtype=torch.int64, device=device)]
    rows = [torch.zeros(100, n, device=device) for n in (15, 2)]
    stop, history, value = torch.ones(1, dtype=torch.int32, device=device), torch.zeros(100, 2, device=device), targets.mean()

    def forward():
        found = begin_step(*numbers, *rows, cam.viewmat, cam.K, targets)
        end_step(value, value, numbers[0], stop, history)
        return found

    yield Task(OURS, "forward", forward, roofline.buffers(point.pixels))
