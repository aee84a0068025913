"""The best plane is that of numpy, to the bit."""

import numpy as np
import torch

from tests.reference.plane_depths import best_inverse
from warpgs.kernels.sweep import best_inverses


def test_best_planes_are_those_of_numpy():
    """Ties go to the first plane, ends are moved inwards, and planes past the last do not count."""
    inverses = np.linspace(0.1, 0.5, 9)
    costs = np.random.default_rng(2).integers(0, 99, (6, 5, 16)).astype(np.int16)
    assert np.array_equal(best_inverses(torch.from_numpy(costs), inverses), best_inverse(costs[..., :9], inverses))
