"""Merging with moments, against the mixture's own."""

import math

import pytest
import torch

from tests.gaussians import cloud
from warpgs.geometry import quaternions, rotation_matrices
from warpgs.pipeline.model.edit import OPAQUE, covariances, merges
from warpgs.scene import Gaussians


def test_rotations_there_and_back():
    """Every quaternion, also a half turn about an axis, gives its rotation, and the rotation gives it back up to its sign."""
    q = torch.nn.functional.normalize(
        torch.randn(200, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), dim=1
    )
    q = torch.cat([q, torch.eye(4, dtype=torch.float64), torch.tensor([[0, 1.0, 1, 0]], dtype=torch.float64) / math.sqrt(2)])
    r = rotation_matrices(q)
    assert torch.allclose(r @ r.transpose(1, 2), torch.eye(3, dtype=torch.float64).expand_as(r), atol=1e-12)
    assert torch.allclose(torch.linalg.det(r), torch.ones(len(r), dtype=torch.float64))
    assert torch.allclose((quaternions(r) * q).sum(1).abs(), torch.ones(len(r), dtype=torch.float64), atol=1e-12)
    turn = rotation_matrices(torch.tensor([[math.cos(0.3), 0, 0, math.sin(0.3)]]))[0]
    assert torch.allclose(turn[:2, 0], torch.tensor([math.cos(0.6), math.sin(0.6)]))


def test_moments_of_a_pair():
    """Mean, covariance and colours of the mixture; what the pair covers stays."""
    g = cloud(2, seed=3)
    pairs = merges(g, torch.ones(2), torch.zeros(2), odd=False)
    assert sorted([*pairs.first.tolist(), *pairs.second.tolist()]) == [0, 1]
    areas = g.log_scales.double().exp().sort(1).values[:, 1:].prod(1)
    mass = g.logit_opacities.double().sigmoid() * areas
    fraction = (mass / mass.sum())[:, None]
    mean = (fraction * g.means.double()).sum(0)
    apart = g.means.double() - mean
    cov = covariances(g.quats.double(), g.log_scales.double()) + apart[:, :, None] * apart[:, None, :]
    merged = {n: t.double() for n, t in pairs.merged.items()}
    assert torch.allclose(merged["means"][0], mean, atol=1e-6)
    assert torch.allclose(covariances(merged["quats"], merged["log_scales"])[0], (fraction[:, None] * cov).sum(0), atol=1e-6)
    assert torch.allclose(merged["sh"][0], (fraction[:, None] * g.sh.double()).sum(0), atol=1e-6)
    new = merged["logit_opacities"].sigmoid() * merged["log_scales"].exp().sort(1).values[:, 1:].prod(1)
    assert 0.5 * float(mass.sum()) < float(new) < float(mass.sum()) * (1 + 1e-6)


def flat_pair(apart: float, opacity: float, widths=(0.3, 0.2)) -> Gaussians:
    """Two thin discs in the plane z = 0."""
    rows = {n: t[[0, 0]].clone() for n, t in cloud(1).tensors().items()}
    rows["means"] = torch.tensor([[0.0, 0, 0], [apart, 0, 0]])
    rows["quats"] = torch.tensor([[1.0, 0, 0, 0]] * 2)
    rows["log_scales"] = torch.log(torch.tensor([[widths[0], widths[1], 1e-3]] * 2))
    rows["logit_opacities"] = torch.logit(torch.full((2,), opacity))
    return Gaussians(**rows)


@pytest.mark.parametrize("apart, opacity", [(0.1, 0.4), (0.4, 0.6), (0.5, 0.97), (0.05, 0.97)])
def test_a_pair_covers_what_it_covered(apart, opacity):
    """The integral of alpha, added up pixel by pixel, is that of the pair, also where opacity has no more room."""
    x, y = torch.meshgrid(*[torch.linspace(-3, 3, 601, dtype=torch.float64)] * 2, indexing="ij")

    def covered(rows) -> float:
        left = torch.ones_like(x)
        for mean, scale, logit in zip(rows["means"].double(), rows["log_scales"].double().exp(), rows["logit_opacities"]):
            flat = scale.sort().values  # the long axis is x in both
            left = left * (
                1
                - logit.double().sigmoid() * torch.exp(-0.5 * (((x - mean[0]) / flat[2]) ** 2 + ((y - mean[1]) / flat[1]) ** 2))
            )
        return float((1 - left).sum()) * 1e-4

    g = flat_pair(apart, opacity)
    merged = merges(g, torch.ones(2), torch.zeros(2), odd=False).merged
    assert covered(merged) == pytest.approx(covered(g.tensors()), rel=1e-3)
    assert float(merged["logit_opacities"].sigmoid()) <= OPAQUE + 1e-6


def test_a_gaussian_in_two_halves_becomes_one_again():
    """Two faint ones in the same place are one of nearly twice the opacity, in the same place."""
    g = cloud(1)
    rows = {n: t[[0, 0]] for n, t in g.tensors().items()}
    rows["logit_opacities"] = torch.logit(torch.full((2,), 0.02))
    pairs = merges(Gaussians(**rows), torch.ones(2), torch.zeros(2), odd=False)
    assert torch.allclose(pairs.merged["logit_opacities"].sigmoid(), torch.tensor([0.04 - 0.5 * 0.02**2]), atol=1e-5)
    assert torch.allclose(pairs.merged["means"], g.means, atol=1e-6) and torch.allclose(pairs.merged["sh"], g.sh)


def test_pairs_are_disjoint_cheapest_first_and_of_one_kind():
    """No row twice; other kinds stay apart; like neighbours come before unlike ones; a change has a parent for every row."""
    g = cloud(101)
    kinds = torch.arange(101) % 2
    for odd in (False, True):
        pairs = merges(g, torch.ones(101), kinds, odd)
        rows = torch.cat([pairs.first, pairs.second])
        assert len(rows) == len(rows.unique()) > 20 and bool((kinds[pairs.first] == kinds[pairs.second]).all())
    means = torch.tensor([[0.0, 0, 1], [0.01, 0, 1], [5, 5, 1], [5.01, 5, 1]])
    four = {n: t[[0, 0, 0, 0]].clone() for n, t in cloud(1).tensors().items()} | {"means": means}
    four["sh"][2] += 1
    pairs = merges(Gaussians(**four), torch.ones(4), torch.zeros(4), odd=False)
    assert {int(pairs.first[0]), int(pairs.second[0])} == {0, 1} and len(pairs.first) == 2
    change = pairs.change(4, 1)
    assert change.keep.tolist() == [2, 3] and change.parents.tolist() == pairs.first[:1].tolist()
    assert all(len(t) == 1 for t in change.added.values())
