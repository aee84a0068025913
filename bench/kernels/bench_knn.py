"""Time of finding the three nearest neighbours of N points.

usage: python -m bench.kernels.bench_knn
"""

import torch

from bench import inputs
from bench.harness import Case, main
from warpgs.kernels.knn import mean_square_distances


def cases(device, tiny):
    for count in inputs.counts(device, tiny):
        points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0)).to(device)

        def work(points=points):
            return mean_square_distances(points)

        yield Case("knn", "forward", {"N": count}, work)


if __name__ == "__main__":
    main(cases)
