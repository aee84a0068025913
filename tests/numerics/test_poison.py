"""The poison fuzz in small: non-finite Gaussians are not there at all, finite extremes are drawn right or not at all."""

import pytest
import torch

from tests.gaussians import camera, cloud
from tests.numerics.fuzz import REFERENCE_LIMIT, SLOTS, VALUES, Case, failures, make_case, non_finite, reference_error
from warpgs.scene import Gaussians


@pytest.mark.parametrize("slot", range(len(SLOTS)), ids=[f"{n}{k}" for n, k in SLOTS])
def test_every_value_in_every_slot(device, slot):
    """22 Gaussians of a cloud, each with one value of the list in this slot, one after the other and all together."""
    name, column = SLOTS[slot]
    gaussians = cloud(3 * len(VALUES))
    gaussians.tensors()[name].view(3 * len(VALUES), -1)[1::3, column] = torch.tensor(VALUES)
    poisoned = torch.zeros(3 * len(VALUES), dtype=torch.bool)
    poisoned[1::3] = True
    for rule in ("exact", "gsplat-1.5", "inria"):
        case = Case(gaussians, poisoned, camera(40, 30, cameras=2, dtype=torch.float32), rule)
        assert int(non_finite(gaussians).sum()) == (3 if name in ("log_scales", "logit_opacities") else 4)
        assert failures(case, device)[0] == []


def test_random_scenes_and_finite_extremes(device):
    """Ten scenes, a poisoned share of up to 95 %; what is drawn of finite extremes is what float64 draws."""
    for number in range(10):
        assert failures(make_case(1, number, largest=2000), device)[0] == [], number
    drawn = 0
    for number in range(20):
        error, _, visible = reference_error(2, number, device)
        assert error <= REFERENCE_LIMIT, number
        drawn += visible
    assert drawn > 100


def test_the_fuzz_sees_a_gaussian_that_is_painted(monkeypatch):
    """The checks themselves: a Gaussian taken for non-finite although it is drawn is reported in every picture."""
    case = make_case(0, 3, 200)
    quiet = Gaussians(**{n: t.nan_to_num(0.1, 0.1, 0.1) for n, t in case.gaussians.tensors().items()})
    assert failures(Case(quiet, case.poisoned, case.camera, case.rule), "cpu")[0] == []
    monkeypatch.setattr("tests.numerics.fuzz.non_finite", lambda g: torch.arange(len(g)) % 2 == 0)
    wrong, _ = failures(Case(quiet, case.poisoned, case.camera, case.rule), "cpu")
    assert any("were drawn" in w for w in wrong) and any("rgb changes" in w for w in wrong)
    assert any("v_means is not zero" in w for w in wrong)
