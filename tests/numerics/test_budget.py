"""The error budget on every scene and device, and that its references are what they claim."""

import dataclasses

import pytest
import torch

from tests.gaussians import SMOOTH, cloud
from tests.numerics.budget import CASES, band, broken, measure, split, tile_size_of
from tests.numerics.scenes import SCENES
from tests.reference.blend import blend_reference
from tests.reference.low_precision import Frame, model, p32, r64, r64c
from tests.reference.project import project_reference
from warpgs.constants import RULES

QUICK = {("exact", "wall"), ("exact", "random_cloud"), ("exact", "faint_fog"), ("inria", "wall")}
"""Cases without a mark: an ordinary scene, a stress scene, the most layers, and another rule."""


@pytest.mark.parametrize(
    ("rule", "name"), [pytest.param(*c, id="-".join(c), marks=() if c in QUICK else pytest.mark.slow) for c in CASES]
)
def test_budget(device, rule, name):
    """E of pictures and gradients beside P32 and below the caps; bands counted, what happens in them bounded."""
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


def small():
    """Forty round Gaussians, some of which the square of `inria` cuts off."""
    scene = SCENES["blobs"]()
    return scene.inputs(), scene.frame()


def loop(inputs, frame, rule, tile_size):
    """Pictures by the references of the ops, one camera."""
    means, covs, colors, depths, opacities = project_reference(
        *inputs[:5], inputs.viewmat[None], inputs.K[None],
        width=frame.width, height=frame.height, degree=frame.degree, low_pass=rule.low_pass,
    )  # fmt: skip
    how = (inputs.background, frame.width, frame.height, rule)
    return blend_reference(means[0], covs[0], opacities, colors[0], depths[0], *how, tile_size=tile_size)[:3]


@pytest.mark.parametrize("rule", ["exact", "gsplat-1.5", "inria", "smooth"])
@pytest.mark.parametrize("tile_size", [8, 16])
def test_dense_twin_equals_plain_loop(rule, tile_size):
    """Pictures and all gradients, to float64's rounding, whole and in a window."""
    inputs, frame = small()
    rule = SMOOTH if rule == "smooth" else RULES[rule]
    exact = inputs.to(torch.float64)
    wanted = loop(exact, frame, rule, tile_size)
    found = r64c(exact, frame, rule, tile_size)
    upstream = [torch.randn(p.shape, generator=torch.Generator().manual_seed(0), dtype=p.dtype) for p in wanted]
    gradients = [
        torch.autograd.grad(sum((p * u).sum() for p, u in zip(images, upstream)), list(exact), retain_graph=True)
        for images in (found, wanted)
    ]
    for a, b in zip((*found, *gradients[0]), (*wanted, *gradients[1])):
        assert float((a - b).detach().norm()) <= 1e-12 * float(b.detach().norm())
    part = r64c(exact, frame._replace(window=(16, 16, 48, 16)), rule, tile_size)
    for a, b in zip(part, found):
        assert torch.equal(a, b[16:32, 16:64])


def test_references_are_what_they_claim():
    """The model has no cut-offs, p32 is r64c in float32, and the square of `inria` matters in the scene above."""
    inputs, frame = small()
    exact = inputs.to(torch.float64)
    squareless = dataclasses.replace(RULES["inria"], square_sigma=0.0)
    a, b = (r64c(exact, frame, rule, 8).alpha for rule in (RULES["inria"], squareless))
    assert float((a - b).detach().abs().max()) > 1e-3
    inputs, frame = small()
    rule = RULES["exact"]
    a, b = p32(inputs.to(torch.float32), frame, rule).rgb, r64c(inputs.to(torch.float64), frame, rule).rgb
    assert a.dtype == torch.float32 and 0 < float((a - b).detach().abs().max()) < 1e-5
    with pytest.raises(TypeError, match=r"torch\.float32"):
        p32(inputs.to(torch.float64), frame, rule)
    with pytest.raises(TypeError, match=r"torch\.float64"):
        r64c(inputs.to(torch.float32), frame, rule)
    scene = SCENES["faint_fog"]()
    exact, frame = scene.inputs().to(torch.float64), scene.frame()._replace(window=(10, 10, 4, 4))
    rule = RULES["exact"]
    assert not bool(r64c(exact, frame, rule).alpha.any())
    free = r64(exact, frame, rule).alpha
    assert torch.equal(free, r64c(exact, frame, model(rule)).alpha) and float(free.detach().min()) > 0.5


@pytest.mark.parametrize("reason", ["cut", "stop", "clamp", "order", "near"])
def test_bands_find_their_threshold(reason):
    """A Gaussian put on a threshold is found by its band and no other, beside one that is not."""
    rule, middle = RULES["exact"], (16.0, 16.0)
    scene = SCENES["random_cloud"]()
    g = cloud(3, degree=0)
    g.means[:] = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 4.0], [0.0, 0.0, 5.0]])
    g.log_scales[:] = 6.0  # flat over the picture
    g.logit_opacities[:] = torch.logit(torch.tensor([0.5, 0.6, 0.7]))
    if reason == "cut":
        g.logit_opacities[1] = torch.logit(torch.tensor(rule.alpha_cut, dtype=torch.float64)).float()
    elif reason == "clamp":
        g.logit_opacities[1] = torch.logit(torch.tensor(rule.alpha_max, dtype=torch.float64)).float()
    elif reason == "stop":
        # two clamped layers leave 1e-4, the stop itself
        g.logit_opacities[:2] = 12.0
    elif reason == "order":
        g.means[1, 2] = g.means[0, 2]
    elif reason == "near":
        g.means[0, 2] = rule.near
    scene = dataclasses.replace(scene, gaussians=g)
    frame = Frame(32, 32, 0, (0, 0, *map(int, middle)))
    found = band(scene.inputs().to(torch.float64), frame, rule)
    assert {n for n, where in found.reasons.items() if bool(where.any())} == {reason}
