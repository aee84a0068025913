"""The bound of a render's error: never below the true error, and close to it."""

import dataclasses

import pytest
import torch

from tests.gaussians import camera, cloud
from tests.render.bound_scenes import HEIGHT, KINDS, WIDTH, bound_scene
from warpgs.constants import RULES, Rule
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.render.reference import reference_image
from warpgs.scene import Gaussians


def error_and_bound(number: int, device, rule) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the true error of a scene's render and its bound, float64, shape [H, W] each."""
    _, g, cam, background = bound_scene(number)
    truth = reference_image(g, cam, (0, 0, WIDTH, HEIGHT), background, 1)
    on_device = Gaussians(**{n: t.to(device) for n, t in g.tensors().items()})
    r = rasterize(on_device, cam, RasterizeOptions(rule=rule, background=background, error_bound=True))
    return (r.rgb.double().cpu() - truth).abs().amax(-1), r.error_bound.double().cpu()


def bounds(number: int, device) -> None:
    """Assert that the bounds of all rules hold in a scene, and are close where the cut-offs cost something."""
    for rule in (*RULES, Rule("own", alpha_cut=0.02, alpha_max=0.9, transmittance_stop=0.1, near=0.4, low_pass=0.5)):
        error, bound = error_and_bound(number, device, rule)
        assert bool((error <= bound).all()), (number, rule)
        # the rounding of float64 is 2e-9 of the largest colour, here at most 30, and float32 rounds a bound of 1 by 1.2e-7
        assert bool((bound <= error * (1 + 3e-7) + 6e-8).all()), (number, rule)


def test_the_bound_holds_and_is_tight(device):
    """Two scenes of each kind, under every rule and one that differs in everything."""
    for number in range(2 * len(KINDS)):
        bounds(number, device)


@pytest.mark.slow
def test_the_bound_holds_in_more_scenes(device):
    for number in range(2 * len(KINDS), 10 * len(KINDS)):
        bounds(number, device)


def test_haze_that_a_rule_drops(device):
    """Layers of 3.9/255 are opaque under `exact` and nothing under `fast`: the bound shows the whole colour that is lost."""
    g, count = cloud(1, device=device), 400
    haze = Gaussians(**{n: t.expand(count, *t.shape[1:]).clone() for n, t in g.tensors().items()})
    haze.means[:] = torch.tensor([0.0, 0.0, 4.0])
    haze.log_scales.fill_(9.0)
    haze.logit_opacities.fill_(float(torch.logit(torch.tensor(3.9 / 255))))
    haze.sh.fill_(0.0)
    options = RasterizeOptions(rule="fast", background=torch.full((3,), 1.5), error_bound=True)
    found = rasterize(haze, camera(20, 12, dtype=torch.float32, device=device), options)
    assert float(found.alpha.max()) == 0 and float(found.error_bound.min()) > 0.99


def test_it_goes_with_the_other_options(device):
    """Only on request; windows, chunks, batches and channels have it, with the same image."""
    g, cam = cloud(300, device=device), camera(50, 34, cameras=2, dtype=torch.float32, device=device)
    g.means.requires_grad_()
    options = RasterizeOptions(rule="fast", error_bound=True)
    whole, plain = rasterize(g, cam, options), rasterize(g, cam, RasterizeOptions(rule="fast"))
    assert plain.error_bound is None and not options.repeatable() and torch.equal(whole.rgb, plain.rgb)
    assert whole.error_bound.shape == (2, 34, 50)
    chunked = rasterize(g, cam, dataclasses.replace(options, max_instances=100, median_depth=True, contributions=True))
    assert torch.equal(chunked.error_bound, whole.error_bound)
    window = rasterize(g, cam, dataclasses.replace(options, window=(16, 16, 34, 18)))
    assert torch.equal(window.error_bound, whole.error_bound[:, 16:, 16:])
    colors = torch.rand(300, 5, device=device)
    channels = dataclasses.replace(options, colors=colors, features=colors, background=colors[0], opacity_factors=colors[:, 0])
    found = rasterize(g, cam, channels)
    exact = rasterize(g, cam, dataclasses.replace(channels, rule="exact", error_bound=False))
    off = (found.rgb - exact.rgb).detach().abs().amax(-1)
    # the reference is float64, this exact render float32: measured 4e-8 on average
    assert float(off.max()) > 1e-3 and float((found.error_bound.detach() - off).abs().mean()) < 1e-6
    none = Gaussians(**{n: t[:0] for n, t in g.tensors().items()})
    assert float(rasterize(none, cam, options).error_bound.detach().max()) < 1e-30
