"""Time of evaluating spherical harmonics for N directions.

usage: python -m bench.kernels.bench_sh
"""

import torch

from bench import inputs
from bench.harness import Case, backward_of, main
from warpgs.kernels.sh import evaluate_sh


def cases(device, tiny):
    for count in inputs.counts(device, tiny):
        sh = inputs.gaussians(count, device).sh
        dirs = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(1)), dim=1).to(
            device
        )
        dirs.requires_grad_()
        for degree in (0, 3):

            def work(sh=sh, dirs=dirs, degree=degree):
                return evaluate_sh(sh, dirs, degree)

            yield Case("sh", "forward", {"N": count, "degree": degree}, work)
            yield Case("sh", "backward", {"N": count, "degree": degree}, backward_of(work(), [sh, dirs]))


if __name__ == "__main__":
    main(cases)
