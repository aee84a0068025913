"""The depth term: a correlation with the prior, nothing where there is none to be had, and what a fit makes of it."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.scenes import photos, priors, seeds
from warpgs.errors import UsageError
from warpgs.pipeline.model.init import InitConfig
from warpgs.pipeline.train.config import PRESETS, FitConfig
from warpgs.pipeline.train.loss import (
    FLAT,
    MIN_ALPHA,
    DepthCorrelation,
    LossConfig,
    Photometric,
    Target,
    built_in_terms,
    depth_disagreement,
    photometric_loss,
)
from warpgs.pipeline.train.step import StepPlan, total_loss
from warpgs.pipeline.train.strategies.base import Strategy
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import TrainingView, half_size
from warpgs.render.rasterize import rasterize
from warpgs.scene import Prior, Render

CPU = torch.device("cpu")
GUIDED = FitConfig(
    steps=40, init=InitConfig(source="points"), density=DensityConfig(start=1000), loss=LossConfig(depth_weight=0.5)
)


def maps(dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Depth from 1 to 5, alpha on both sides of the limit, disparity that knows a little of the depth, and a mask, [9, 11]."""
    generator = torch.Generator().manual_seed(0)
    depth, alpha, noise, kept = torch.rand(4, 9, 11, generator=generator, dtype=torch.float64)
    depth = 1 + 4 * depth
    disparity = (0.6 * noise + 0.4 / depth).clamp(0, 1)
    return depth.to(dtype), (0.3 + 0.7 * alpha).to(dtype), disparity.to(dtype), (kept > 0.3).to(dtype)


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


def plan_of(terms) -> StepPlan:
    return StepPlan(0, False, tuple(terms), None)


def test_total_loss_is_the_sum_of_terms_and_of_what_the_strategy_adds():
    """The photometric loss alone without a depth weight, to the bit; then the weighted depth term; then a regularisation."""
    depth, alpha, disparity, mask = maps(torch.float32)
    rgb, image = torch.rand(2, 9, 11, 3)
    render, target = Render(rgb, alpha, depth, rgb, rgb), Target(image, mask, {"disparity": disparity}, {})
    strategy = Strategy.__new__(Strategy)
    plain = total_loss(plan_of(built_in_terms(LossConfig())), render, target, None, strategy)
    terms = built_in_terms(LossConfig(depth_weight=0.25, depth_until=0.5))
    both = total_loss(plan_of(terms), render, target, None, strategy)
    assert terms == (Photometric(0.2), DepthCorrelation(0.25, 0.5)) and built_in_terms(LossConfig()) == (Photometric(),)
    assert torch.equal(plain, photometric_loss(rgb, image, mask))
    assert float(both - plain) == pytest.approx(0.25 * float(depth_disagreement(depth, alpha, disparity, mask)), abs=1e-6)
    strategy.regularisation = lambda phase, gaussians: torch.tensor(2.0)
    assert torch.equal(total_loss(plan_of(terms), render, target, None, strategy), both + 2)


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


def test_fit_follows_its_priors_without_sampling_events():
    """Whichever way round the prior is: depth comes nearer to it than it began, and than under the other."""
    straight = priors(photos(3))
    turned = [dataclasses.replace(p, disparity=1 - p.disparity) for p in straight]
    start = fitted(dataclasses.replace(GUIDED, steps=1), straight)
    fits = [fitted(GUIDED, given) for given in (straight, turned)]
    for given, own, other in ((straight, *fits), (turned, *reversed(fits))):
        assert agreement(own, given) > max(agreement(start, given), agreement(other, given)) + 0.1


def test_term_ends_when_it_should():
    """Off from the first step on it is as if it had no weight, to the bit; while it is on it is not."""
    plain = fitted(dataclasses.replace(GUIDED, loss=LossConfig()))
    for until, same in ((0.0, True), (0.5, False)):
        fit = fitted(dataclasses.replace(GUIDED, loss=LossConfig(depth_weight=0.5, depth_until=until)))
        assert torch.equal(fit.gaussians.means, plain.gaussians.means) == same
    assert [len(fit.plan_of(s).terms) for s in (1, 20, 21, 40)] == [2, 2, 1, 1]


def test_fit_says_in_which_views_it_has_the_term():
    """Without a prior that knows anything it is 0, which the user is told with a way out; its sources are told too."""
    nothing = [dataclasses.replace(p, disparity=np.zeros_like(p.disparity)) for p in priors(photos(3))]
    two = [*priors(photos(3))[:2], nothing[2]]
    short = dataclasses.replace(GUIDED, steps=1)
    assert any("depth term" in n and "2 of 3 views" in n for n in fitted(short, two).notes)
    told = Trainer(photos(3), seeds(), short, CPU).notes
    assert any("depth: none" in n for n in told) and any("0 of 3 views" in n and "--depth-model" in n for n in told)
    assert not any("depth" in n for n in fitted(dataclasses.replace(short, loss=LossConfig())).notes)


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


@pytest.mark.parametrize(
    "bad", [{"depth_weight": -1}, {"depth_weight": math.nan}, {"depth_weight": math.inf}, {"depth_until": 2}]
)
def test_bad_weights_are_refused(bad):
    """At once, by name."""
    with pytest.raises(UsageError, match=next(iter(bad)).replace("_", " ")):
        LossConfig(**bad)


def test_no_preset_has_the_depth_term():
    """It is a setting: no prior has been shown to help by it (docs/method.md)."""
    assert not any(c.loss.depth_weight > 0 for c in PRESETS.values())
