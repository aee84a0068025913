"""Scores of a view against what they mean on pictures whose scores are known."""

import numpy as np
import pytest
import torch

from warpgs.errors import UsageError
from warpgs.pipeline.train.sampling import (
    ImportanceConfig,
    blur,
    geometry_score,
    importance,
    normalized,
    render_score,
    semantic_score,
    weights,
)


def grid(height: int = 40, width: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    y, x = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    return x, y


def test_blur_keeps_constants_and_sums():
    """A constant stays, an impulse becomes the Gaussian itself."""
    assert torch.allclose(blur(torch.full((9, 8), 0.3)), torch.tensor(0.3))
    impulse = torch.zeros(21, 21)
    impulse[10, 10] = 1
    x, y = grid(21, 21)
    expected = torch.exp(-0.5 * ((x - 10) ** 2 + (y - 10) ** 2))
    assert torch.allclose(blur(impulse), expected / expected[7:14, 7:14].sum(), atol=1e-4)


def test_normalized_is_robust_and_scale_free():
    """One wild pixel changes nothing; a factor and an offset change nothing; a constant has score 0."""
    score = torch.rand(50, 60, generator=torch.Generator().manual_seed(0))
    spoiled = score.clone()
    spoiled[0, 0] = 1e6
    assert torch.allclose(normalized(score)[1:], normalized(spoiled)[1:], atol=2e-3)
    assert torch.allclose(normalized(7 * score - 3), normalized(score), atol=1e-5)
    assert normalized(score).min() == 0 and normalized(score).max() == 1
    assert not bool(normalized(torch.full((4, 4), 0.7)).any())
    assert not bool(normalized(score, torch.zeros(50, 60, dtype=torch.bool)).any())


def test_geometry_score_finds_the_step_and_the_curved_patch():
    """A plane has one score, since all its gradients are the same; a step and a bowl on it stand out."""
    x, y = grid()
    plane = 0.01 * x + 0.02 * y
    inner = geometry_score(plane, 0.5)[6:-6, 6:-6]
    assert float(inner.max() - inner.min()) < 1e-3
    step = plane + (x > 25)
    score = geometry_score(step, 0.5)
    assert bool((score[5:-5, 25:27] > 0.9).all()) and float(score[5:-5, 32:45].max()) < 0.1
    bowl = plane + torch.where((x - 12) ** 2 + (y - 20) ** 2 < 64, 0.02 * ((x - 12) ** 2 + (y - 20) ** 2 - 64), 0)
    middle = (20, 12)  # no gradient there but that of the plane
    assert geometry_score(bowl, 2.0)[middle] > geometry_score(bowl, 0.0)[middle] + 0.1


def test_semantic_score_is_the_papers_product():
    """F_seg (omega_boundary + omega_foreground), up to the scale of the view."""
    generator = torch.Generator().manual_seed(1)
    confidence, boundary, foreground = torch.rand(3, 30, 40, generator=generator)
    product = confidence * (boundary + foreground)
    score = semantic_score(confidence, boundary, foreground)
    inner = (score > 0) & (score < 1)
    assert np.corrcoef(score[inner], product[inner])[0, 1] > 0.999999


def test_render_score_is_the_length_of_the_colour_difference():
    """Largest where the pictures differ most, by the norm over channels."""
    image, rendered = torch.zeros(30, 30, 3), torch.zeros(30, 30, 3)
    rendered[4:14, 4:14] = torch.tensor([0.3, 0.0, 0.4])  # length 0.5
    rendered[18:28, 18:28, 0] = 0.45
    score = render_score(rendered, image)
    assert score[9, 9] == 1 and abs(float(score[23, 23]) - 0.9) < 5e-3 and score[0, 29] == 0


@pytest.mark.parametrize(
    "switches, expected",
    [
        ((True, True, True), (0.4, 0.2, 0.4)),
        ((False, True, True), (0, 1 / 3, 2 / 3)),
        ((True, False, True), (0.5, 0, 0.5)),
        ((True, True, False), (2 / 3, 1 / 3, 0)),
        ((False, False, False), (0, 0, 0)),
    ],
)
def test_weights_renormalise(switches, expected):
    """The rows of the ablation table."""
    found = weights(ImportanceConfig(), **dict(zip(("render", "semantic", "geometry"), switches)))
    assert np.allclose(found, expected)


def test_importance_is_the_weighted_sum_and_uniform_without_weights():
    """w . s; without any score every pixel counts the same."""
    scores = tuple(torch.full((2, 3), v) for v in (0.5, 0.25, 1.0))
    assert torch.allclose(importance(scores, (0.4, 0.2, 0.4)), torch.tensor(0.65))
    assert torch.equal(importance(scores, (0, 0, 0)), torch.ones(2, 3))


def test_negative_weight_is_refused():
    """The message names the field."""
    with pytest.raises(UsageError, match="semantic"):
        ImportanceConfig(semantic=-0.1)
