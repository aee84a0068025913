"""Dropout: as often as asked, never twice the same, always the same for one seed and step."""

import pytest
import torch

from tests.reference.dropout import expected_factors
from warpgs.kernels.update import Setting, opacity_dropout

COUNT = 20_000


def factors(device, p: float, step: int = 1, seed: int = 0) -> torch.Tensor:
    settings = Setting.row(dropout=p, number=step, step=step, means_lr=0.1, shift=(0.2, 0.3, 0.4))
    return opacity_dropout(COUNT, torch.tensor(settings, dtype=torch.float32, device=device), seed)


def test_frequencies(device):
    """Both values occur as often as the probability says (within 3.9 standard deviations), for several steps and seeds."""
    for p, step, seed in ((0.2, 1, 0), (0.05, 9_999, 0), (0.5, 3, 7)):
        values, chances = expected_factors(p)
        drawn = factors(device, p, step, seed).double().cpu()
        dropped = int((drawn == 0).sum())
        assert torch.allclose(drawn[drawn > 0], torch.tensor(values[1]), rtol=1e-6)
        assert abs(dropped - COUNT * chances[0]) < 3.9 * (COUNT * chances.prod()) ** 0.5


def test_nothing_is_dropped_at_zero(device):
    """p = 0 leaves every opacity as it is."""
    assert bool((factors(device, 0.0) == 1).all())


def test_same_seed_and_step_same_factors(device):
    """Repeatable; another step or seed hides others: about half of what either hides at p = 0.5."""
    first = factors(device, 0.5, 4, 2)
    assert torch.equal(first, factors(device, 0.5, 4, 2))
    for other in (factors(device, 0.5, 5, 2), factors(device, 0.5, 4, 3)):
        assert 0.45 < float((first == other).float().mean()) < 0.55


def test_neighbours_are_independent(device):
    """Neighbouring Gaussians are hidden independently of each other."""
    hidden = (factors(device, 0.5) == 0).double()
    assert abs(float(torch.corrcoef(torch.stack([hidden[1:], hidden[:-1]]))[0, 1])) < 0.03


@pytest.mark.cuda
def test_every_device_draws_the_same():
    """A fit that moves to another device hides the same Gaussians."""
    assert torch.equal(factors("cpu", 0.3, 17), factors("cuda", 0.3, 17).cpu())


def test_bad_settings():
    """Settings of another shape are refused by name."""
    with pytest.raises(ValueError, match="settings"):
        opacity_dropout(3, torch.zeros(3), 0)
