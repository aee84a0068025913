"""Matching costs are those of OpenCV."""

import numpy as np
import pytest

from tests.priors.rigs import still_life
from tests.reference import plane_costs
from warpgs.priors.sweep import UNIT, matching_costs_cpu
from warpgs.scene import Camera, View


@pytest.mark.parametrize("size", [(7, 160), (160, 5), (1, 1), (40, 70)])
def test_costs_are_those_of_opencv(size):
    """Costs differ from those of OpenCV's warps and blurs by rounding, in images of any size, and at their borders."""
    height, width = size
    views = []
    for v in still_life()[0]:
        c = v.camera
        views.append(View(v.name, Camera(c.viewmat, c.K, width, height), np.resize(v.image[40:], (height, width, 3))))
    views[2] = still_life()[0][2]  # of another size
    inverses = np.linspace(1 / 12, 1 / 2, 21)
    found = matching_costs_cpu(views[1], [views[0], views[2]], inverses, 7).numpy()
    wanted = plane_costs.matching_costs(views[1], [views[0], views[2]], inverses, 7).transpose(1, 2, 0)
    off = np.abs(found[..., :21] / UNIT - wanted)
    # a pixel at the very border is inside for one and outside for the other
    assert found.shape == (height, width, 32) and np.quantile(off, 0.995) < 0.01 and off.mean() < 2e-3
    assert (found[..., 21:] == UNIT).all()
