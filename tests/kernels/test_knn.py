"""Nearest-neighbour distances against all pairs."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from tests.reference.knn import mean_square_distances_reference
from warpgs.kernels.neighbours import mean_square_distances


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 33, 1500])
@pytest.mark.parametrize("k", [1, 3, 8])
def test_equal_all_pairs(device, dtype, count, k):
    """Exact for every size around the box size, and where there are fewer points than neighbours."""
    generator = torch.Generator().manual_seed(count)
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64).to(dtype)
    found = mean_square_distances(points.to(device), k).cpu()
    wanted = mean_square_distances_reference(points.double(), k) if count else torch.zeros(0, dtype=torch.float64)
    assert found.shape == (count,)
    assert torch.allclose(found.double(), wanted, rtol=1e-5 if dtype == torch.float32 else 1e-12, atol=0)


@pytest.mark.parametrize("count", [1024, 1025, 32_769, 50_000])
def test_every_level_of_boxes_is_searched(device, count):
    """One, two and three levels of boxes, and sets that end within a box of each, against a k-d tree."""
    points = np.random.default_rng(count).normal(size=(count, 3)) ** 3  # dense in the middle, sparse far out
    found = mean_square_distances(torch.as_tensor(points, device=device), 3).cpu().numpy()
    distances, _ = cKDTree(points).query(points, k=4)
    np.testing.assert_allclose(found, (distances[:, 1:] ** 2).mean(1), rtol=1e-12)


def test_clusters_lines_and_duplicates(device):
    """Shapes that a space-filling curve handles badly are still exact; coincident points have distance 0."""
    generator = torch.Generator().manual_seed(5)
    line = torch.zeros(300, 3, dtype=torch.float64)
    line[:, 0] = torch.rand(300, generator=generator, dtype=torch.float64) * 1e3
    cluster = torch.randn(300, 3, generator=generator, dtype=torch.float64) * 1e-6 + 1e3
    same = torch.full((10, 3), -4.0, dtype=torch.float64)
    points = torch.cat([line, cluster, same])
    found = mean_square_distances(points.to(device), 3).cpu()
    assert torch.allclose(found, mean_square_distances_reference(points, 3), rtol=1e-9, atol=0)
    assert not bool(found[-10:].any())
    assert not bool(mean_square_distances(same.to(device), 3).any())


def test_bad_input_is_refused():
    """NaN positions, a wrong shape and an impossible k are errors."""
    with pytest.raises(ValueError, match="non-finite"):
        mean_square_distances(torch.tensor([[0.0, 0, 0], [float("nan"), 0, 0]]))
    with pytest.raises(ValueError, match="points"):
        mean_square_distances(torch.zeros(4, 2))
    with pytest.raises(ValueError, match="k must be"):
        mean_square_distances(torch.zeros(4, 3), 0)
