"""Drawing pixels and placing Gaussians: frequencies, gates, and geometry that can be checked by projecting back."""

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from tests.scenes import ring
from warpgs import geometry
from warpgs.errors import UsageError
from warpgs.pipeline.train.sampling import SUPPORT, SamplerConfig, fine_gaussians, geometry_gate, sample_pixels, valid_pixels
from warpgs.scene import C0, Camera


def drawn_counts(score: torch.Tensor, gate: torch.Tensor, count: int, repeats: int) -> np.ndarray:
    generator, counts = torch.Generator().manual_seed(0), np.zeros(score.shape, int)
    for _ in range(repeats):
        at = sample_pixels(score, gate, count, generator, random=True).numpy()
        assert len(np.unique(at, axis=0)) == len(at) == count
        counts[at[:, 0], at[:, 1]] += 1
    return counts


def test_frequencies_are_proportional_to_the_score():
    """One pixel a draw: chi-square against S / sum S within the gate, never outside it."""
    score = torch.arange(1.0, 25).reshape(4, 6)
    gate = torch.ones(4, 6, dtype=torch.bool)
    gate[2] = False
    counts = drawn_counts(score, gate, 1, 4000)
    expected = (score * gate).numpy() / float((score * gate).sum())
    assert not counts[2].any()
    assert chisquare(counts[gate], 4000 * expected[gate]).pvalue > 1e-4


def test_several_pixels_are_drawn_without_replacement():
    """Of two pixels out of three with weights 1, 1, 2, the heavy one is missing in one draw of six (successive sampling)."""
    score = torch.tensor([[1.0, 1.0, 2.0]])
    counts = drawn_counts(score, torch.ones(1, 3, dtype=torch.bool), 2, 3000)[0]
    # P(missing heavy) = 2 * (1/4) (1/3) = 1/6
    assert chisquare([counts[2], 3000 - counts[2]], [2500, 500]).pvalue > 1e-4


def test_pixels_without_score_are_never_drawn_and_fewer_come_back():
    """Asked for five, two have a score: two come back."""
    score = torch.zeros(3, 4)
    score[1, 2], score[0, 3] = 0.5, 1e-6
    at = sample_pixels(score, torch.ones(3, 4, dtype=torch.bool), 5, torch.Generator(), random=True)
    assert at.tolist() == [[0, 3], [1, 2]]


def test_without_adaptive_placement_the_highest_are_taken():
    """Deterministic top n within the gate."""
    score = torch.rand(8, 9, generator=torch.Generator().manual_seed(3))
    gate = score < 0.9
    at = sample_pixels(score, gate, 5, torch.Generator(), random=False)
    lowest = score[at[:, 0], at[:, 1]].min()
    assert int((score[gate] >= lowest).sum()) == 5


def test_gate_keeps_the_quantile_and_never_starves():
    """40 % pass at quantile 0.6; where too few would, the quantile falls; a constant score lets all valid pixels pass."""
    score = torch.rand(50, 40, generator=torch.Generator().manual_seed(0))
    valid = torch.ones(50, 40, dtype=torch.bool)
    gate, used = geometry_gate(score, valid, 0.6, 10)
    assert used == 0.6 and abs(float(gate.float().mean()) - 0.4) < 0.01
    assert score[gate].min() > score[~gate].max()
    gate, used = geometry_gate(score, valid, 0.6, 400)  # needs 1600 of 2000
    assert used < 0.25 and int(gate.sum()) >= SUPPORT * 400
    gate, used = geometry_gate(torch.zeros(50, 40), valid, 0.6, 10)
    assert used == 0 and torch.equal(gate, valid)
    gate, used = geometry_gate(score, ~valid, 0.6, 10)
    assert used == 0 and not bool(gate.any())


def test_valid_pixels_have_depth_and_lie_inside():
    """Thin, infinite, masked and border pixels are out."""
    alpha, depth, mask = torch.ones(10, 12), torch.ones(10, 12), torch.ones(10, 12)
    alpha[4, 4], depth[4, 5], depth[4, 6], mask[4, 7] = 0.4, torch.inf, 0, 0
    valid = valid_pixels(alpha, depth, mask, SamplerConfig())
    assert valid.sum() == 6 * 8 - 4 and not bool(valid[4, 4:8].any()) and not bool(valid[:2].any())


def test_back_projection_is_undone_by_projection():
    """To 1e-5 px in float32."""
    camera = ring(5)[1]
    pixels = np.random.default_rng(0).uniform(0, 30, (50, 2))
    depths = np.random.default_rng(1).uniform(0.5, 8, 50)
    tensors = Camera(torch.as_tensor(camera.viewmat), torch.as_tensor(camera.K), camera.width, camera.height)
    points = geometry.back_project_tensors(tensors, torch.as_tensor(pixels), torch.as_tensor(depths))
    again, z = geometry.project_points(camera, points.numpy())
    assert np.abs(again - pixels).max() < 1e-10 and np.abs(z - depths).max() < 1e-10


def test_fine_gaussians_stand_behind_their_pixels():
    """Centre, colour, opacity, and a width of one pixel at their depth."""
    camera = ring(5)[3]
    tensors = Camera(
        *(torch.as_tensor(t, dtype=torch.float32) for t in (camera.viewmat, camera.K)), camera.width, camera.height
    )
    image = torch.rand(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(0))
    depth = torch.full((camera.height, camera.width), 2.5)
    at = torch.tensor([[3, 7], [20, 30]])
    rows = fine_gaussians(tensors, image, depth, at, SamplerConfig(), 4)
    pixels, z = geometry.project_points(camera, rows["means"].double().numpy())
    assert np.allclose(pixels, [[7.5, 3.5], [30.5, 20.5]], atol=1e-5) and np.allclose(z, 2.5)
    assert torch.allclose(rows["sh"][:, 0] * C0 + 0.5, image[at[:, 0], at[:, 1]]) and not bool(rows["sh"][:, 1:].any())
    assert torch.allclose(rows["logit_opacities"].sigmoid(), torch.tensor(0.1))
    assert torch.allclose(rows["log_scales"].exp(), torch.tensor(2.5 / camera.K[0, 0], dtype=torch.float32))


def test_bad_settings_are_named():
    """Out of range: said before anything starts."""
    for bad in ({"fraction": 0}, {"gate_quantile": 1}, {"opacity": 1}, {"footprint": 0}, {"border": -1}):
        with pytest.raises(UsageError, match="sampler"):
            SamplerConfig(**bad)
