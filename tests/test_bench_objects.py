"""Objects with true alpha in the bench are scored right before other backgrounds."""

import numpy as np
import torch

from bench.lib.backgrounds import ply_scores
from tests import gaussians as sets
from warpgs import RasterizeOptions, rasterize
from warpgs.scene import View


def test_a_ply_is_right_before_every_background_where_the_truth_is_rendered_by_itself():
    """What the Gaussians themselves look like over a colour is no error before any background; another opacity is one."""
    ours, camera, gray = sets.cloud(40), sets.camera(dtype=torch.float32), (0.5, 0.25, 0.75)
    r = rasterize(ours, camera, RasterizeOptions(background=torch.tensor(gray)))
    view = View("a", camera, r.rgb.clamp(0, 1).numpy(), alpha=r.alpha.numpy())
    assert 0.02 < view.alpha.mean() < 0.98
    right = ply_scores(ours, [view], gray)
    assert set(right) == {"ply_black", "ply_white", "ply_pattern"} and min(right.values()) > 45
    denser = View("a", camera, view.image, alpha=np.sqrt(view.alpha))
    wrong = ply_scores(ours, [denser], gray)
    assert max(wrong.values()) < 35
