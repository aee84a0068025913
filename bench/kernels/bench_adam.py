"""Time of one Adam step over the colour coefficients of N Gaussians.

usage: python -m bench.kernels.bench_adam
"""

import torch

from bench import inputs
from bench.harness import Case, main
from warpgs.kernels.adam import adam_step


def cases(device, tiny):
    for count in inputs.counts(device, tiny):
        param, grad, mean, square = (torch.rand(count, 16, 3, device=device) for _ in range(4))

        def work(state=(param, grad, mean, square)):
            adam_step(*state, lr=1e-3, step=10, head_lr=1e-2, head=3)

        yield Case("adam", "forward", {"N": count, "numbers": param.numel()}, work)


if __name__ == "__main__":
    main(cases)
