"""The two scores that follow from a prior: against the formulas on maps whose derivatives are known."""

import numpy as np
import pytest

from warpgs.priors.scores import curvature, geometric_score, normalized, semantic_score
from warpgs.scene import Prior


def test_semantic_score_is_the_product_of_the_paper():
    rng = np.random.default_rng(0)
    maps = [rng.random((6, 8), np.float32) for _ in range(4)]
    score = semantic_score(Prior(*maps, "depth", "labels"))
    np.testing.assert_allclose(score, maps[1].astype(float) * (maps[2] + maps[3]), rtol=1e-6)


def test_normalized_takes_percentiles_to_zero_and_one():
    found = normalized(np.linspace(5, 9, 1001).reshape(7, 143))
    assert found.min() == 0 and found.max() == 1 and found.dtype == np.float32
    np.testing.assert_allclose(found.ravel()[500], 0.5, atol=1e-6)
    assert (found.ravel()[:20] == 0).all() and (found.ravel()[-20:] == 1).all()
    assert (normalized(np.full((3, 3), 4.0)) == 0).all()
    lone = np.zeros((20, 20))
    lone[3, 4] = 5
    assert normalized(lone)[3, 4] == 1 and normalized(lone).sum() == 1


def test_a_plane_has_no_complexity_and_a_step_has_most_at_its_edge():
    x = np.mgrid[:40, :60][1] / 60
    assert geometric_score(np.zeros((40, 60), np.float32)).max() == 0
    step = np.where(x > 0.5, 0.9, 0.1).astype(np.float32)
    score = geometric_score(step)
    edge = int(np.argmax(np.diff(step[0]))) + 1
    assert score[:, edge - 1 : edge + 1].min() >= 1 and score[:, : edge - 6].max() == 0 == score[:, edge + 6 :].max()
    # a step across and a step down are the same thing
    np.testing.assert_allclose(geometric_score(step.T.copy()).T, score, atol=1e-6)


@pytest.mark.parametrize(("a", "b", "c"), [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.5, -2, 0.7), (0, 0, 0)])
def test_curvature_is_the_frobenius_norm_of_the_hessian(a, b, c):
    """Of a x^2 + b x y + c y^2, where it is constant; a tilt adds nothing."""
    y, x = np.mgrid[:40, :50] / 50
    found = curvature(a * x**2 + b * x * y + c * y**2 + 0.3 * x - 0.2 * y)[8:-8, 8:-8]
    np.testing.assert_allclose(found, np.sqrt((2 * a) ** 2 + 2 * b**2 + (2 * c) ** 2) / 50**2, rtol=1e-2, atol=1e-6)


def test_the_weight_of_curvature_is_a_factor():
    d = np.random.default_rng(0).random((30, 40), np.float32)
    zero, half, one = (geometric_score(d, w).astype(float) for w in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(half - zero, 0.5 * (one - zero), atol=1e-6)
    assert zero.max() == 1 and one.max() <= 2
