"""Time of projecting N Gaussians into cameras."""

from bench.lib import inputs, roofline
from bench.lib.timing import OURS, passes
from warpgs.constants import RULES
from warpgs.kernels.project import project

AXES = ("count", "degree", "cameras")
PROGRAMS = {OURS: ("forward", "backward")}


def tasks(point, device, wanted):
    tensors = list(inputs.gaussians(point.count, device, point.degree).tensors().values())
    camera = inputs.camera(point.width, point.height, device, point.cameras)
    size = {"width": point.width, "height": point.height}

    def work():
        return project(*tensors, camera.viewmat, camera.K, **size, degree=point.degree, rule=RULES["exact"])[0]

    yield from passes(OURS, work, tensors, wanted, roofline.project(point.count, point.cameras, point.degree))
