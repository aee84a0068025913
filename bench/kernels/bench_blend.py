"""Time of compositing N binned Gaussians.

usage: python -m bench.kernels.bench_blend
"""

import torch

from bench import inputs
from bench.harness import Case, backward_of, main
from warpgs.constants import RULES
from warpgs.kernels.blend import blend
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles


def cases(device, tiny):
    rule = RULES["exact"]
    for width, height in inputs.sizes(device, tiny):
        for count in inputs.counts(device, tiny):
            tensors = inputs.gaussians(count, device).tensors().values()
            camera, size = inputs.camera(width, height, device), {"width": width, "height": height}
            splats, tile_counts = project(*tensors, camera.viewmat, camera.K, **size, degree=0, rule=rule)
            tiles = bin_tiles(splats, tile_counts, **size, rule=rule)
            leaf, background = splats.detach().requires_grad_(), torch.zeros(1, 3, device=device)

            def work(leaf=leaf, tiles=tiles, background=background, size=size):
                return blend(leaf, tiles, background, **size, rule=rule)[0]

            parameters = {"N": count, "image": f"{width}x{height}", "instances": len(tiles.slots)}
            yield Case("blend", "forward", parameters, work)
            yield Case("blend", "backward", parameters, backward_of(work(), [leaf]))


if __name__ == "__main__":
    main(cases)
