"""Opacity decay against opacities in float64."""

import numpy as np
import pytest
import torch

from tests.reference.opacity_decay import decayed
from warpgs.kernels.update import opacity_decay


@pytest.mark.parametrize("factor", [0.5, 0.995, 0.999, 1 - 1e-6])
def test_opacities_are_multiplied(device, factor):
    """From 2e-9 to 1 - 2e-9, within a rounding of float32."""
    logits = torch.linspace(-20, 20, 1001)
    found = opacity_decay(logits.to(device), factor).cpu().numpy()
    assert np.abs(found - decayed(logits.numpy(), factor)).max() <= 1e-6
    assert (found < logits.numpy()).all() or factor > 0.999


def test_ends_and_what_is_no_number(device):
    """An opacity of 1 becomes the factor, one of 0 stays; a NaN is not hidden; nothing from nothing."""
    found = opacity_decay(torch.tensor([np.inf, -np.inf, np.nan, -100.0], device=device), 0.75).cpu()
    assert float(found[0].sigmoid()) == pytest.approx(0.75) and float(found[1]) == -np.inf and bool(found[2].isnan())
    assert float(found[3]) == pytest.approx(-100 + np.log(0.75), abs=1e-5)
    assert opacity_decay(found[:0].to(device), 0.5).shape == (0,)
    for wrong in (0.0, 1.0, np.nan):
        with pytest.raises(ValueError, match="factor"):
            opacity_decay(found.to(device), wrong)
