"""The error budget on every scene and device."""

import pytest

from tests.numerics.budget import CASES, broken, measure, split, tile_size_of
from tests.numerics.scenes import SCENES
from warpgs.constants import RULES

QUICK = {("exact", "wall"), ("exact", "random_cloud"), ("exact", "faint_fog"), ("inria", "wall")}
"""Cases without a mark: an ordinary scene, a stress scene, the most layers, and another rule."""


@pytest.mark.parametrize(
    ("rule", "name"), [pytest.param(*c, id="-".join(c), marks=() if c in QUICK else pytest.mark.slow) for c in CASES]
)
def test_budget(device, rule, name):
    scene = SCENES[name]()
    found = measure(scene, RULES[rule], split(scene, RULES[rule], device, tile_size_of(rule)))
    assert not (lines := broken(scene, found)), "\n" + "\n".join(lines)


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
