"""Time of binning N Gaussians into tiles, both sorts included.

usage: python -m bench.kernels.bench_tiles
"""

import torch

from bench import inputs
from bench.harness import Case, main
from warpgs.constants import RULES
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles


@torch.no_grad()
def cases(device, tiny):
    rule = RULES["exact"]
    for width, height in inputs.sizes(device, tiny):
        for count in inputs.counts(device, tiny):
            tensors = inputs.gaussians(count, device).tensors().values()
            camera, size = inputs.camera(width, height, device), {"width": width, "height": height}
            splats, tile_counts = project(*tensors, camera.viewmat, camera.K, **size, degree=0, rule=rule)

            def work(splats=splats, tile_counts=tile_counts, size=size):
                return bin_tiles(splats, tile_counts, **size, rule=rule)

            parameters = {"N": count, "image": f"{width}x{height}", "instances": int(tile_counts.sum())}
            yield Case("tiles", "forward", parameters, work)


if __name__ == "__main__":
    main(cases)
