"""The error budget: every line, on every frozen scene, on every device."""

import pytest
import torch

from tests.numerics.budget import CASES, broken, measure, tile_size_of
from tests.numerics.scenes import SCENES
from tests.numerics.split import gradient_errors, split
from warpgs.constants import RULES


@pytest.mark.parametrize(("rule", "name"), CASES, ids=[f"{r}-{n}" for r, n in CASES])
def test_budget(device, rule, name):
    """E of pictures and gradients beside P32 and below the caps; bands counted, what happens in them bounded."""
    scene = SCENES[name]()
    found = measure(scene, RULES[rule], split(scene, RULES[rule], device, tile_size_of(rule)))
    assert not (lines := broken(scene, found)), "\n" + "\n".join(lines)


def test_fog_under_the_cut_is_approximation_not_error(device):
    """A thousand layers below the cut hide most of what is behind: all of it A, none of it E."""
    s = split(SCENES["faint_fog"](), RULES["exact"], device, with_model=True)
    hidden = s.model.images["alpha"]
    assert float(hidden.mean()) > 0.8
    assert not bool(s.kernel.images["alpha"].any()) and not bool(s.truth.images["alpha"].any())
    assert torch.equal(s.kernel.images["rgb"].float(), s.truth.images["rgb"].float())
    # nothing is drawn, so this is a plain sum: as a product of matrices it erred 1.1e-6
    assert gradient_errors(s, "background")["E max"] < 4e-7


def test_a_picture_moved_by_half_a_pixel_breaks_the_budget(device):
    """The budget sees what it must see: a wrong pixel centre, and a gradient of the wrong sign."""
    scene = SCENES["random_cloud"]()
    s = split(scene, RULES["exact"], device)
    clean = measure(scene, RULES["exact"], s)
    s.kernel.images["rgb"][1:, 1:] = 0.25 * sum(
        s.truth.images["rgb"][1 - dy : 48 - dy, 1 - dx : 64 - dx] for dy in (0, 1) for dx in (0, 1)
    )
    s.kernel.gradients["quats"][0] *= -1
    lines = broken(scene, measure(scene, RULES["exact"], s))
    assert not broken(scene, clean)
    assert any("max E of rgb" in x for x in lines) and any("relative L2 of v_quats" in x for x in lines)
