"""The depth term of `examples/`: a correlation with the prior, nothing without one, and what a fit makes of it."""

import dataclasses
import math
import sys

import numpy as np
import pytest
import torch

from tests.example_terms import DepthCorrelation
from tests.pipeline.test_loss import maps
from tests.scenes import photos, priors, seeds
from warpgs.errors import UsageError
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import TrainingView, half_size
from warpgs.render.rasterize import rasterize
from warpgs.scene import Prior

CPU = torch.device("cpu")
EXAMPLE = sys.modules[DepthCorrelation.__module__]
FLAT, MIN_ALPHA, depth_disagreement = EXAMPLE.FLAT, EXAMPLE.MIN_ALPHA, EXAMPLE.depth_disagreement
GUIDED = FitConfig(
    steps=40, init=InitConfig(source="points"), density=DensityConfig(start=1000), loss_terms=(DepthCorrelation(0.5),)
)


def correlation(depth, alpha, disparity, mask) -> float:
    """Pearson's, by numpy, of inverse depth and disparity over what counts."""
    counts = (alpha > MIN_ALPHA) if mask is None else (alpha > MIN_ALPHA) & (mask > 0)
    return float(np.corrcoef(1 / depth[counts].double().numpy(), disparity[counts].double().numpy())[0, 1])


@pytest.mark.parametrize("masked", [False, True])
def test_depth_term_is_one_minus_the_correlation(dtype, masked):
    """Over the opaque pixels that the mask keeps: what the others hold changes nothing."""
    depth, alpha, disparity, mask = maps(dtype)
    mask = mask if masked else None
    value = float(depth_disagreement(depth, alpha, disparity, mask))
    assert value == pytest.approx(1 - correlation(depth, alpha, disparity, mask), abs=1e-12 if dtype == torch.float64 else 1e-6)
    hidden = alpha <= MIN_ALPHA if mask is None else (alpha <= MIN_ALPHA) | (mask == 0)
    assert 10 < int(hidden.sum()) < 80
    other = depth_disagreement(torch.where(hidden, 0, depth), alpha, torch.where(hidden, 1, disparity), mask)
    assert float(other) == value


@pytest.mark.parametrize("masked", [False, True])
def test_gradient_of_the_depth_term(masked):
    """Against central differences in float64; hidden pixels have none, and alpha only decides what counts."""
    depth, alpha, disparity, mask = maps()
    mask = mask if masked else None
    depth.requires_grad_(), alpha.requires_grad_()
    assert torch.autograd.gradcheck(lambda d: depth_disagreement(d, alpha, disparity, mask), depth, eps=1e-6, atol=1e-9)
    gradient, none = torch.autograd.grad(
        depth_disagreement(depth, alpha, disparity, mask), (depth, alpha), allow_unused=True, materialize_grads=True
    )
    hidden = alpha <= MIN_ALPHA if mask is None else (alpha <= MIN_ALPHA) | (mask == 0)
    assert bool((gradient[hidden] == 0).all()) and bool((gradient[~hidden] != 0).all()) and not bool(none.any())


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1.0, 1e12, 1e30])
def test_depth_term_has_no_unit(scale):
    """In float32, for depths in any unit, value and gradient are those of float64."""
    depth, alpha, disparity, mask = maps()
    wide = (depth * scale).float().requires_grad_()
    exact = wide.detach().double().requires_grad_()
    value = depth_disagreement(wide, alpha.float(), disparity.float(), mask.float())
    truth = depth_disagreement(exact, alpha, disparity, mask)
    assert float(value.detach()) == pytest.approx(float(truth.detach()), abs=2e-6)
    (found,), (wanted,) = torch.autograd.grad(value, wide), torch.autograd.grad(truth, exact)
    assert float((found.double() - wanted).abs().max() / wanted.abs().max()) < 1e-5


@pytest.mark.parametrize("flat", ["depth", "prior", "both", "masked", "thin", "one pixel"])
def test_constant_maps_have_no_depth_term(dtype, flat):
    """Where a correlation would be 0 / 0 the term and its gradient are 0."""
    depth, alpha, disparity, mask = maps(dtype)
    if flat in ("depth", "both"):
        depth = torch.full_like(depth, 0.3) * (1 + 0.1 * FLAT * depth)
    if flat in ("prior", "both"):
        disparity = torch.zeros_like(disparity)
    if flat in ("masked", "one pixel"):
        mask = torch.zeros_like(mask)
    if flat == "one pixel":
        mask[4, 5], alpha[4, 5] = 1, 1
    if flat == "thin":
        alpha = torch.zeros_like(alpha)
    value = depth_disagreement(depth.requires_grad_(), alpha, disparity, mask)
    value.backward()
    assert float(value.detach()) == 0 and bool((depth.grad == 0).all())


def test_depth_term_hides_no_nan():
    """A depth or a prior that is no number where pixels count makes the loss none."""
    depth, alpha, disparity, mask = maps(torch.float32)
    at = tuple(torch.nonzero((alpha > MIN_ALPHA) & (mask > 0))[0].tolist())
    for place in (0, 1, 2):
        given = [depth.clone(), alpha.clone(), disparity.clone()]
        given[place][at] = math.nan
        assert place == 1 or math.isnan(float(depth_disagreement(*given, mask)))
    nothing = [torch.full_like(depth, math.nan), torch.full_like(alpha, math.nan), disparity]
    assert math.isnan(float(depth_disagreement(*nothing, mask)))


def test_depth_term_reaches_the_gaussians():
    """The whole way from means to the term, in float64, against central differences along a random direction."""
    view, prior = photos(1)[0], priors(photos(1))[0]
    fit = Trainer(
        [view], seeds(), dataclasses.replace(GUIDED, init=InitConfig(source="points", opacity=0.9)), CPU, priors=[prior]
    )
    tensors = {n: t.double() for n, t in fit.gaussians.tensors().items()}
    disparity = torch.as_tensor(prior.disparity, dtype=torch.float64)

    def term(means: torch.Tensor) -> torch.Tensor:
        r = rasterize(type(fit.gaussians)(**{**tensors, "means": means}), view.camera)
        return depth_disagreement(r.depth, torch.ones_like(r.alpha), disparity, (r.alpha.detach() > 0.9).double())

    means, towards = tensors["means"].requires_grad_(), torch.randn(60, 3, generator=torch.Generator().manual_seed(1)).double()
    (gradient,) = torch.autograd.grad(term(means), means)
    with torch.no_grad():
        step = 1e-7 * towards
        slope = float((term(means + step) - term(means - step)) / 2e-7)
    assert abs(slope) > 0.1 and float((gradient * towards).sum()) == pytest.approx(slope, rel=1e-4)


def fitted(config: FitConfig, found: list[Prior] | None = None) -> Trainer:
    views = photos(3)
    fit = Trainer(views, seeds(), config, CPU, priors=priors(views) if found is None else found)
    for _ in range(config.steps):
        fit.advance()
    return fit


def agreement(fit: Trainer, wanted: list[Prior]) -> float:
    """Mean correlation of a fit's depths with given disparities."""
    renders = [rasterize(fit.gaussians, v.camera) for v in fit.views]
    return float(np.mean([correlation(r.depth, r.alpha, torch.as_tensor(p.disparity), None) for r, p in zip(renders, wanted)]))


def test_a_fit_follows_its_priors():
    """Whichever way round the prior is: depth comes nearer to it than it began, and than under the other."""
    straight = priors(photos(3))
    turned = [dataclasses.replace(p, disparity=1 - p.disparity) for p in straight]
    start = fitted(dataclasses.replace(GUIDED, steps=1), straight)
    fits = [fitted(GUIDED, given) for given in (straight, turned)]
    for given, own, other in ((straight, *fits), (turned, *reversed(fits))):
        assert agreement(own, given) > max(agreement(start, given), agreement(other, given)) + 0.1


def test_term_ends_when_it_should():
    """Off from the first step on it is as if it had no weight, to the bit; while it is on it is not."""
    plain = fitted(dataclasses.replace(GUIDED, loss_terms=()))
    for until, same in ((0.0, True), (0.5, False)):
        fit = fitted(dataclasses.replace(GUIDED, loss_terms=(DepthCorrelation(0.5, until),)))
        assert torch.equal(fit.gaussians.means, plain.gaussians.means) == same
    assert [len(fit.plan_of(s).terms) for s in (1, 20, 21, 40)] == [2, 2, 1, 1]


def test_half_size_views_keep_their_disparity():
    """Each pixel has the mean of what it covers, whatever channels a map has."""
    view = photos(1)[0]
    whole = TrainingView.of(view, CPU)
    (disparity,) = DepthCorrelation().needs(whole, priors([view])[0]).values()
    whole = dataclasses.replace(whole, maps={"disparity": disparity, "two": torch.stack([disparity, 1 - disparity], 2)})
    half = half_size(whole).maps
    assert torch.allclose(half["disparity"], disparity.reshape(16, 2, 20, 2).mean((1, 3)), atol=1e-6)
    assert torch.allclose(half["two"][..., 1], 1 - half["disparity"], atol=1e-6) and half["two"].shape == (16, 20, 2)
    assert half_size(TrainingView.of(view, CPU)).maps == {}


@pytest.mark.parametrize("bad", [{"weight": -1}, {"weight": math.nan}, {"weight": math.inf}, {"until": 2}])
def test_bad_weights_are_refused(bad):
    """At once, by name."""
    with pytest.raises(UsageError, match=f"{next(iter(bad))} {next(iter(bad.values()))}"):
        DepthCorrelation(**bad)
