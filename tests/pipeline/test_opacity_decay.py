"""Decay of opacities: its values, steps that are not taken, when it is chosen, and fits that are continued."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from tests.scenes import view_stub
from tests.tolerances import OPACITY_DECAY
from warpgs.errors import UsageError
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import OptimizerConfig
from warpgs.pipeline.train.settings import EXTRAPOLATED_VIEWS, ONE_LAYER_VIEWS, settings_by_views
from warpgs.pipeline.train.step import LEAST_LOGIT, decay_opacities

GOING = torch.tensor([True])


def test_a_fraction_of_every_opacity_goes():
    """Opaque and faint ones lose the same fraction."""
    opacities = torch.tensor([1e-6, 0.01, 0.5, 0.99, 1 - 1e-6], dtype=torch.float64)
    logits = torch.logit(opacities).float()
    before = logits.double().sigmoid()
    decay_opacities(logits, 0.01, GOING)
    error = (logits.double().sigmoid() / (0.99 * before) - 1).abs().max()
    assert float(error) < OPACITY_DECAY


def test_what_is_faint_or_infinite_stays_and_nothing_hides_a_nan():
    """Beyond the least logit nothing decays; full opacity becomes 1 less the fraction; NaN stays NaN."""
    logits = torch.tensor([-math.inf, 2 * LEAST_LOGIT, math.inf, math.nan])
    decay_opacities(logits, 0.25, GOING)
    assert logits[:2].tolist() == [-math.inf, 2 * LEAST_LOGIT] and logits[3].isnan()
    assert math.isclose(float(logits[2].sigmoid()), 0.75, rel_tol=1e-6)


def test_a_step_that_is_not_taken_changes_nothing():
    """Nor does a decay of 0, or of less than a rounding."""
    logits = torch.linspace(-3, 3, 7)
    for fraction, going in ((0.1, torch.tensor([False])), (0.0, GOING), (1e-300, GOING)):
        now = logits.clone()
        decay_opacities(now, fraction, going)
        assert torch.equal(now, logits)


@pytest.mark.parametrize(
    ("views", "alpha", "few"),
    [
        (EXTRAPOLATED_VIEWS + 1, None, True), (ONE_LAYER_VIEWS, None, True), (ONE_LAYER_VIEWS + 1, None, False),
        (3, 1.0, True), (ONE_LAYER_VIEWS, 1.0, True), (ONE_LAYER_VIEWS + 1, 1.0, False),
    ],
)  # fmt: skip
def test_few_views_have_one_layer_and_decay(views, alpha, few):
    """The choice is named; what is given holds."""
    train = [view_stub(alpha=alpha)] * views
    config, notes = settings_by_views(PRESETS["default"], train, "cuda")
    assert (config.optimizer.opacities_decay, config.method.hier) == ((0.001, False) if few else (0.0, True))
    assert ("one layer" in " ".join(notes)) == few
    given = dataclasses.replace(config, optimizer=dataclasses.replace(config.optimizer, opacities_decay=0.02))
    assert settings_by_views(given, train, "cuda")[0].optimizer.opacities_decay == 0.02


@pytest.mark.parametrize("decay", [-0.1, 0.2, math.nan])
def test_a_decay_out_of_range_is_refused(decay):
    """Also one that is no number."""
    with pytest.raises(UsageError, match="opacities-decay"):
        OptimizerConfig(opacities_decay=decay)
