"""The poison fuzz in small: non-finite Gaussians are not there at all, finite extremes are drawn right or not at all."""

import pytest
import torch

from tests.gaussians import camera, cloud
from tests.numerics.fuzz import REFERENCE_LIMIT, SLOTS, VALUES, Case, failures, fuzz, make_case, non_finite, reference_error
from warpgs.scene import Gaussians


def test_the_fuzz_is_as_wide_as_it_says():
    """14 slots, 22 values, and each value reaches each slot."""
    assert len(SLOTS) == 14 and len(VALUES) == 22
    case = make_case(0, 3)
    again = make_case(0, 3)
    same = zip(case.gaussians.tensors().values(), again.gaussians.tensors().values())
    assert all(torch.equal(a.view(torch.int32), b.view(torch.int32)) for a, b in same)
    assert bool(non_finite(case.gaussians).any()) and not bool((non_finite(case.gaussians) & ~case.poisoned).any())


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


def test_a_failure_is_counted_and_named(monkeypatch, capsys):
    """The line of a broken scene has the call that makes it again; the last line says how many there were."""
    monkeypatch.setattr("tests.numerics.fuzz.failures", lambda case, device: (["all of it"], 0))
    monkeypatch.setattr("tests.numerics.fuzz.reference_error", lambda *_: (0.0, 0, 0))
    assert fuzz("cpu", 1, 5, 100) == 1
    out = capsys.readouterr().out
    assert "make_case(5, 0, 100)" in out and out.splitlines()[-1].startswith("1 failures in ")


def test_the_fuzz_sees_a_gaussian_that_is_painted(monkeypatch):
    """The checks themselves: a Gaussian taken for non-finite although it is drawn is reported in every picture."""
    case = make_case(0, 3, 200)
    quiet = Gaussians(**{n: t.nan_to_num(0.1, 0.1, 0.1) for n, t in case.gaussians.tensors().items()})
    assert failures(Case(quiet, case.poisoned, case.camera, case.rule), "cpu")[0] == []
    monkeypatch.setattr("tests.numerics.fuzz.non_finite", lambda g: torch.arange(len(g)) % 2 == 0)
    wrong, _ = failures(Case(quiet, case.poisoned, case.camera, case.rule), "cpu")
    assert any("were drawn" in w for w in wrong) and any("rgb changes" in w for w in wrong)
    assert any("v_means is not zero" in w for w in wrong)
