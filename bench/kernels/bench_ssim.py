"""Time of structural similarity.

usage: python -m bench.kernels.bench_ssim
"""

import torch

from bench import inputs
from bench.harness import Case, backward_of, main
from warpgs.kernels.ssim import ssim


def cases(device, tiny):
    for width, height in inputs.sizes(device, tiny):
        pair = torch.rand(2, height, width, 3, generator=torch.Generator().manual_seed(0)).to(device)
        image, target = pair[0].clone().requires_grad_(), pair[1]

        def work(image=image, target=target):
            return ssim(image, target)

        yield Case("ssim", "forward", {"image": f"{width}x{height}"}, work)
        yield Case("ssim", "backward", {"image": f"{width}x{height}"}, backward_of(work(), [image]))


if __name__ == "__main__":
    main(cases)
