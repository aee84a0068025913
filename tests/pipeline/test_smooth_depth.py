"""Smoothness of rendered depth: values, gradients, when it is chosen, memory, and fits."""

from __future__ import annotations

import torch

from tests.scenes import photos
from warpgs.pipeline.train.loss_terms.smooth_depth import BOUND, CONFIRMED, EDGE, SmoothDepth, depth_roughness
from warpgs.pipeline.train.views import TrainingView

CPU = torch.device("cpu")


def flat(depth: torch.Tensor, **changed) -> float:
    """Return the roughness of depth before an even image, all of it opaque."""
    given = {"alpha": torch.ones_like(depth), "image": torch.zeros(*depth.shape, 3), "weight": torch.ones_like(depth)}
    given = {n: t.to(depth.dtype) for n, t in (given | changed).items() if n != "mask"}
    return float(depth_roughness(depth, *given.values(), changed.get("mask")))


def test_a_plane_is_smooth_and_a_bend_is_not():
    """By hand: a bend of one pixel, its bound, edges of colour, weights, transparent and masked pixels, and no unit."""
    y, x = torch.meshgrid(torch.arange(6.0).double(), torch.arange(7.0).double(), indexing="ij")
    plane = 1 / (0.5 + 0.02 * x + 0.03 * y)
    assert flat(plane) < 1e-12
    bent = torch.ones(3, 3, dtype=torch.float64)
    bent[1, 1] = 1.02  # both rows of its own, and four of its neighbours' see no bend: they lie at the border
    rough = 2 * (2 * 1.02 - 2) / 9
    assert abs(flat(bent) - rough) < 1e-12 and abs(flat(1e6 * bent) - rough) < 1e-9
    far = bent.clone()
    far[1, 1] = 3
    assert abs(flat(far) - 2 * BOUND / 9) < 1e-12
    image = torch.zeros(3, 3, 3)
    image[:, 2] = EDGE  # an edge along rows alone
    assert abs(flat(bent, image=image) - rough * (1 + torch.e**-1) / 2) < 1e-8
    assert abs(flat(bent, weight=torch.full((3, 3), 0.2)) - 0.2 * rough) < 1e-8
    alpha, mask = torch.ones(3, 3), torch.ones(3, 3)
    alpha[1, 0] = mask[0, 1] = 0
    assert abs(flat(bent, alpha=alpha) - rough / 2) < 1e-12 and abs(flat(bent, mask=mask) - rough / 2) < 1e-12
    assert flat(torch.ones(2, 2)) == 0 and torch.isnan(torch.tensor(flat(bent * torch.nan)))


def test_gradients_in_float64():
    """Below the bound, and 0 beyond it."""
    g = torch.Generator().manual_seed(0)
    depth = (1 + 0.02 * torch.rand(5, 6, generator=g, dtype=torch.float64)).requires_grad_()
    image, weight = torch.rand(5, 6, 3, generator=g, dtype=torch.float64), torch.rand(5, 6, generator=g, dtype=torch.float64)
    alpha = torch.ones(5, 6, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda d: depth_roughness(d, alpha, image, weight, None), depth)


def test_confirmed_pixels_count_less():
    """All count alike where no depth is consistent."""
    view = TrainingView.of(photos(1, 4, 4)[0], CPU)
    assert torch.equal(SmoothDepth().needs(view, None)["smooth_depth"], torch.ones(4, 4))
    consistent = torch.zeros(4, 4)
    consistent[1] = 2.0
    found = SmoothDepth().needs(TrainingView(view.camera, view.image, consistent=consistent), None)["smooth_depth"]
    assert torch.equal(found, torch.where(consistent > 0, CONFIRMED, 1.0))
