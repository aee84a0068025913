"""Time of projecting N Gaussians into one camera, SH degree 3.

usage: python -m bench.kernels.bench_project
"""

from bench import inputs
from bench.harness import Case, backward_of, main
from warpgs.constants import RULES
from warpgs.kernels.project import project


def cases(device, tiny):
    for count in inputs.counts(device, tiny):
        tensors = list(inputs.gaussians(count, device).tensors().values())
        camera = inputs.camera(504, 378, device)

        def work(tensors=tensors, camera=camera):
            size = {"width": camera.width, "height": camera.height}
            return project(*tensors, camera.viewmat, camera.K, **size, degree=3, rule=RULES["exact"])[0]

        yield Case("project", "forward", {"N": count}, work)
        yield Case("project", "backward", {"N": count}, backward_of(work(), tensors))


if __name__ == "__main__":
    main(cases)
