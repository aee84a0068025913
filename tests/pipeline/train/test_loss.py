"""Loss terms: their sum, given depth and normals, smoothness, and the terms of `examples/`."""

import dataclasses
import math
import sys

import numpy as np
import pytest
import torch

from tests.example_terms import DepthCorrelation, NormalSmoothness
from tests.pipeline.train.fits import advanced
from tests.pipeline.train.test_memory import STEADY, instances, measured
from tests.priors.rigs import still_life
from tests.scenes import photos, priors, seeds, three_gaussians
from warpgs.errors import UsageError
from warpgs.geometry import depth_normals
from warpgs.kernels import blend
from warpgs.kernels.roughness import BOUND
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train.loss import (
    CONFIRMED,
    EDGE,
    LOSS_TERMS,
    AlphaDifference,
    GivenDepthDifference,
    LossConfig,
    LossInputs,
    LossTerm,
    Photometric,
    SmoothDepth,
    Target,
    built_in_terms,
    depth_roughness,
    inverse_depth_difference,
    normal_difference,
    outputs_of,
    photometric_loss,
    total,
)
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.step import StepPlan, eager_renderer, total_loss
from warpgs.pipeline.train.strategies.base import Strategy
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.view_modules import ROTATION, RefinePoses
from warpgs.pipeline.train.views import TrainingView, half_size
from warpgs.priors.views import PriorConfig
from warpgs.render.rasterize import rasterize
from warpgs.scene import GivenDepth, Prior, View

# Loss terms in a step: their sum, and what each is given.

CPU = torch.device("cpu")
PLAIN = FitConfig(steps=8, init=InitConfig(source="points"), sh_degree=0)


def maps(dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Depth from 1 to 5, alpha on both sides of the limit, disparity that knows a little of the depth, and a mask, [9, 11]."""
    generator = torch.Generator().manual_seed(0)
    depth, alpha, noise, kept = torch.rand(4, 9, 11, generator=generator, dtype=torch.float64)
    depth = 1 + 4 * depth
    disparity = (0.6 * noise + 0.4 / depth).clamp(0, 1)
    return depth.to(dtype), (0.3 + 0.7 * alpha).to(dtype), disparity.to(dtype), (kept > 0.3).to(dtype)


@pytest.mark.parametrize("shape", [(70_001,), (300, 401), (3, 40, 50, 3), (5,)])
def test_a_total_has_the_same_bits_for_any_number_of_threads(shape):
    values, threads, found = torch.rand(shape, generator=torch.Generator().manual_seed(0)), torch.get_num_threads(), []
    try:
        for n in (1, 2, 3):
            torch.set_num_threads(n)
            found.append(float(total(values)))
    finally:
        torch.set_num_threads(threads)
    assert len(set(found)) == 1 and found[0] == pytest.approx(float(values.double().sum()), rel=1e-6)


def test_total_loss_is_the_sum_of_terms_and_of_what_the_strategy_adds():
    """The photometric loss alone, to the bit; then another term; then a regularisation."""
    depth, alpha, disparity, mask = maps(torch.float32)
    rgb, image = torch.rand(2, 9, 11, 3)
    target = Target(image, mask, {"disparity": disparity})
    inputs = LossInputs({"rgb": rgb, "alpha": alpha, "depth": depth}, target, None, None, torch.ones(()))
    strategy = Strategy.__new__(Strategy)

    def loss(*terms: LossTerm) -> torch.Tensor:
        return total_loss(StepPlan(0, False, terms, None), inputs, strategy)

    plain, both = loss(Photometric()), loss(Photometric(), DepthCorrelation(0.25))
    assert torch.equal(plain, photometric_loss(rgb, image, mask))
    assert float(both - plain) == pytest.approx(float(DepthCorrelation(0.25)(inputs)), abs=1e-6) and float(both - plain) > 0.01
    strategy.regularisation = lambda phase, gaussians: torch.tensor(2.0)
    assert torch.equal(loss(Photometric(), DepthCorrelation(0.25)), both + 2)


@pytest.mark.usefixtures("registries_as_they_were")
def test_a_term_reads_the_outputs_that_it_asks_for_alone():
    """Another one is an error that names term and output; one that no render has is refused with the settings."""

    @LOSS_TERMS.register("silent")
    @dataclasses.dataclass(frozen=True)
    class Silent(LossTerm):
        needs_outputs = ("depth",)

        def __call__(self, inputs):
            assert list(inputs.outputs) == ["depth"]
            return inputs.outputs["alpha"].mean()

    fit = Trainer(photos(2), seeds(), dataclasses.replace(PLAIN, loss_terms=(Silent(),)), CPU)
    assert fit.layout.sizes.depth and outputs_of(fit.terms) == ("rgb", "depth")
    with pytest.raises(UsageError, match="'silent' reads the output 'alpha'; add it to needs_outputs"):
        fit.advance()
    assert not Trainer(photos(2), seeds(), PLAIN, CPU).layout.sizes.depth
    Silent.needs_outputs = ("normals",)
    with pytest.raises(UsageError, match=r"'silent' needs the output 'normals', which .* rgb, alpha, depth"):
        dataclasses.replace(PLAIN, loss_terms=(Silent(),))


def test_depth_has_a_gradient_only_where_a_term_reads_it(monkeypatch):
    """Otherwise the backward pass of blending computes none, since that takes time."""
    upstream, composite_gradients = [], blend.composite_gradients

    def noted(projected, tiles, backgrounds, settings, saved, v_images, *others):
        upstream.append([v is not None for v in v_images])
        return composite_gradients(projected, tiles, backgrounds, settings, saved, v_images, *others)

    monkeypatch.setattr(blend, "composite_gradients", noted)
    for terms in ((), (SmoothDepth(0.5),)):
        config = dataclasses.replace(PLAIN, loss=LossConfig(smooth_weight=0), loss_terms=terms)
        Trainer(photos(2), seeds(), config, CPU).advance()
    assert upstream == [[True, False, False], [True, False, True]]  # colour, alpha, depth


@pytest.mark.usefixtures("registries_as_they_were")
@pytest.mark.parametrize("batch", [1, 3])
def test_a_term_sees_camera_and_step(batch):
    seen = []

    @LOSS_TERMS.register("witness")
    @dataclasses.dataclass(frozen=True)
    class Witness(LossTerm):
        needs_outputs = ()

        def needs(self, view, prior):
            return {"first": view.image.new_full(view.image.shape[:2], float(view.camera.viewmat[0, 3]))}

        def __call__(self, inputs):
            camera, maps = inputs.camera, inputs.target.maps
            assert camera.viewmat.shape == (4, 4) and camera.K.shape == (3, 3) and inputs.step.shape == ()
            assert (camera.height, camera.width) == inputs.target.image.shape[:2] and camera.model == "pinhole"
            assert torch.allclose(maps["first"], camera.viewmat[0, 3]) and len(inputs.gaussians) == 60
            seen.append((int(inputs.step), camera.width, float(camera.K[0, 0])))
            return 0 * inputs.gaussians.means.sum()

    config = dataclasses.replace(PLAIN, batch=batch, loss_terms=(Witness(),), half_resolution=0.5)
    fit = Trainer(photos(3), seeds(), config, CPU)
    advanced(fit)
    camera = photos(1)[0].camera
    small, large = (20, camera.K[0, 0] / 2), (40, camera.K[0, 0])
    sizes = [(k, *(small if k <= 4 else large)) for k in range(1, 9) for _ in range(batch)]
    assert [(k, w) for k, w, _ in seen] == [(k, w) for k, w, _ in sizes]
    assert [f for *_, f in seen] == pytest.approx([f for *_, f in sizes])


@pytest.mark.usefixtures("registries_as_they_were")
def test_a_refined_pose_learns_from_a_term():
    """The camera is that of the step: a gradient of its pose reaches the increment of its view, and of no other."""

    @LOSS_TERMS.register("puller")
    @dataclasses.dataclass(frozen=True)
    class Puller(LossTerm):
        def __call__(self, inputs):
            return 100 * inputs.camera.viewmat[0, 2]

    config = dataclasses.replace(PLAIN, view_modules=(RefinePoses(),), loss_terms=(Puller(),))
    fit = Trainer(photos(3), seeds(), config, CPU)
    plan = fit.plan_of(1)
    fit.learned.table.params[ROTATION].data[1] = torch.tensor([0.0, 0.2, 0.0])
    (stack,) = fit.stacks.values()
    fit.taker.buffers.load([1], [[0.0] * fit.taker.buffers.lr_rows.shape[1]], [fit.settings(1)])
    render = eager_renderer(fit.context.render_options(), None)
    gradients, *_ = fit.taker.view_gradients(stack, fit.taker.buffers, plan, render)
    rotation = gradients[len(fit.table.params) + list(fit.learned.table.params).index(ROTATION)]
    assert float(rotation[1].abs().max()) > 10 and not bool(rotation[[0, 2]].any())


# The term on normals of `examples/`: its value, and fits with it that are recorded and continued.

unevenness = sys.modules[NormalSmoothness.__module__].unevenness
SMOOTH = FitConfig(
    steps=24, init=InitConfig(source="points", opacity=0.9), sh_degree=0, density=DensityConfig(start=6, every=6),
    half_resolution=0.5, loss_terms=(NormalSmoothness(2.0, growth=10),),
)  # fmt: skip


def test_unevenness_is_a_weighted_mean_of_angles():
    """Two halves that face apart by 60 degrees; an edge of the image between them hides that; gradcheck in float64."""
    normals = torch.zeros(4, 6, 3, dtype=torch.float64)
    normals[:, :3, 2], normals[:, 3:] = -1, torch.tensor([0.75**0.5, 0, -0.5], dtype=torch.float64)
    image = torch.zeros(4, 6, 3, dtype=torch.float64)
    assert float(unevenness(normals, image)) == pytest.approx(0.5 * 4 / (4 * 5 + 3 * 6))
    image[:, 3:] = 1
    assert float(unevenness(normals, image)) < 1e-5
    assert float(unevenness(torch.zeros_like(normals), image)) == 0
    random = torch.nn.functional.normalize(torch.rand(4, 6, 3, dtype=torch.float64) - 0.5, dim=-1).requires_grad_()
    assert torch.autograd.gradcheck(lambda n: unevenness(n, image), random)


@pytest.mark.cuda
@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("given", [False, True], ids=["weight by step", "given maps"])
def test_recorded_steps_with_terms_equal_single_steps(batch, given):
    """On CUDA: the step's number and maps are read on the device, so that a replayed step has its own."""
    config = dataclasses.replace(CONFIG if given else SMOOTH, steps=24, batch=batch)
    views, device = mapped() if given else photos(4), torch.device("cuda", 0)
    without = dataclasses.replace(config, loss_terms=(), loss=LossConfig(depth_weight=0, normal_weight=0))
    configs = *(dataclasses.replace(config, cuda_graph=g) for g in (True, False)), without
    recorded, single, plain = (advanced(Trainer(views, seeds(), c, device)) for c in configs)
    assert all(torch.equal(t, single.state()[0][n]) for n, t in recorded.state()[0].items())
    assert not torch.equal(recorded.gaussians.means[:10], plain.gaussians.means[:10])


# Loss terms on given depth and normals: values, gradients, half size, memory, and fits that continue with the same
# bits.

CONFIG = FitConfig(
    steps=60, init=InitConfig(source="points", opacity=0.9), sh_degree=0, density=DensityConfig(start=6, every=6),
    half_resolution=0.5, loss=LossConfig(depth_weight=1, normal_weight=0.01),
)  # fmt: skip


def mapped(count: int = 4, width: int = 40, height: int = 32, normals: bool = True) -> list[View]:
    """Return views of the three Gaussians with their own depth and normals; the last has none."""
    views, found = photos(count, width, height), []
    for v in views[:-1]:
        r = rasterize(three_gaussians(), v.camera)
        depth = torch.where(r.alpha > 0.5, r.depth, 0)
        camera = dataclasses.replace(v.camera, viewmat=torch.eye(4), K=torch.as_tensor(v.camera.K, dtype=torch.float32))
        vectors = depth_normals(camera, depth).numpy() if normals else None
        found.append(dataclasses.replace(v, depth=GivenDepth(depth.numpy()), normals=vectors))
    return [*found, views[-1]]


def target_of(term, **fields) -> torch.Tensor:
    camera = photos(1)[0].camera
    view = TrainingView(camera, torch.zeros(*next(iter(fields.values())).shape[:2], 3), **fields)
    (found,) = term.needs(view, None).values()
    return found


def test_terms_on_given_depth_and_normals_are_means_with_the_right_gradients():
    """By hand: weights, pixels without depth, transparent and masked ones; no unit of length matters."""
    given = torch.tensor([[2.0, 4.0, 0.0, 4.0, 8.0]])
    weight = torch.tensor([[1.0, 0.5, 1.0, 1.0, 1.0]])
    depth, alpha = torch.tensor([[4.0, 2.0, 1.0, 1.0, 1.0]]), torch.tensor([[1.0, 1, 1, 0.3, 1]])
    mask = torch.tensor([[1.0, 1, 1, 1, 0]])
    target = target_of(GivenDepthDifference(), depth=given, depth_weight=weight)
    q = 4.0
    wanted = (abs(q / 4 - q / 2) + 0.5 * abs(q / 2 - q / 4)) / 1.5
    assert float(inverse_depth_difference(depth, alpha, target, mask)) == pytest.approx(wanted)
    far = target_of(GivenDepthDifference(), depth=1e6 * given, depth_weight=weight)
    assert float(inverse_depth_difference(1e6 * depth, alpha, far, mask)) == pytest.approx(wanted)
    nothing = target_of(GivenDepthDifference(), depth=0 * given)
    assert float(inverse_depth_difference(depth, alpha, nothing, None)) == 0
    assert torch.isnan(inverse_depth_difference(depth * torch.nan, alpha, target, mask))
    normals = torch.tensor([[[0.0, 0, -1], [0, 0, -1], [0, 0, 0], [1, 0, 0]]])
    given = torch.tensor([[[0.0, 0, -1], [0.6, 0, -0.8], [0, 0, -1], [0, 0, 0]]])
    assert float(normal_difference(normals, given, None)) == pytest.approx(0.5 * 0.2)
    assert float(normal_difference(normals, given, torch.tensor([[1.0, 0, 1, 1]]))) == 0
    assert float(normal_difference(normals, 0 * given, None)) == 0
    g = torch.Generator().manual_seed(0)
    depth = (torch.rand(5, 6, generator=g, dtype=torch.float64) + 1).requires_grad_()
    given = torch.rand(5, 6, generator=g, dtype=torch.float64) + 1
    given[1], alpha = 0, torch.rand(5, 6, generator=g, dtype=torch.float64)
    target = torch.stack([1.5 * (given > 0) / given.clamp_min(0.1), (given > 0).double(), 1.5 * (given > 0)], -1)
    assert torch.autograd.gradcheck(lambda d: inverse_depth_difference(d, alpha, target, None), depth)
    normals = torch.nn.functional.normalize(torch.rand(5, 6, 3, generator=g, dtype=torch.float64) - 0.5, dim=-1)
    other = torch.nn.functional.normalize(torch.rand(5, 6, 3, generator=g, dtype=torch.float64) - 0.5, dim=-1)
    other[2] = 0
    assert torch.autograd.gradcheck(lambda n: normal_difference(n, other, None), normals.requires_grad_())


def test_half_size_keeps_means():
    """Pixels without depth take no part, and few points keep their values; of other maps a pixel has the mean of its four."""
    given = torch.zeros(4, 4)
    given[0, 0], given[2, 2], given[2, 3] = 2.0, 4.0, 8.0
    view = TrainingView.of(photos(1, 4, 4)[0], CPU)
    view = dataclasses.replace(view, maps=GivenDepthDifference().needs(dataclasses.replace(view, depth=given), None))
    small = half_size(view).maps["given_depth"]
    exact = torch.tensor([[2.0, 1.0], [1.0, 16 / 3]])  # harmonic means
    alpha = torch.ones(2, 2)
    assert float(inverse_depth_difference(exact, alpha, small, None)) == pytest.approx(0, abs=1e-6)
    assert float(inverse_depth_difference(2 * exact, alpha, small, None)) > 0.3
    view = photos(1)[0]
    whole = TrainingView.of(view, CPU)
    (disparity,) = DepthCorrelation().needs(whole, priors([view])[0]).values()
    whole = dataclasses.replace(whole, maps={"disparity": disparity, "two": torch.stack([disparity, 1 - disparity], 2)})
    half = half_size(whole).maps
    assert torch.allclose(half["disparity"], disparity.reshape(16, 2, 20, 2).mean((1, 3)), atol=1e-6)
    assert torch.allclose(half["two"][..., 1], 1 - half["disparity"], atol=1e-6) and half["two"].shape == (16, 20, 2)
    assert half_size(TrainingView.of(view, CPU)).maps == {}


@pytest.mark.parametrize("term", ["depth", "normals", "smooth"])
def test_plan_covers_the_terms(term):
    """The maps that stay, and what the terms and their gradients take."""
    views = photos(2, 400, 300) if term == "smooth" else mapped(2, 400, 300, term == "normals")
    fit = Trainer(views, seeds(60), dataclasses.replace(STEADY, loss=LossConfig(smooth_weight=float(term == "smooth"))), CPU)
    fit.advance()
    found, planned = measured(fit, 2), fit.layout.step(60, instances(fit))
    assert found <= planned <= 1.25 * found + 20_000, (found, planned)


def test_terms_follow_from_the_views_the_weights_and_a_network():
    """`--depth-guides`: the network's disparity is fitted to what views confirm, and in the loss; it needs a network."""
    assert [t.name for t in Trainer(mapped(2), seeds(), CONFIG, CPU).terms] == ["photometric", "given_depth", "given_normals"]
    assert built_in_terms(LossConfig()) == (Photometric(0.2),)
    assert built_in_terms(LossConfig(alpha_weight=0.3), True) == (Photometric(0.2), AlphaDifference(0.3))
    assert built_in_terms(LossConfig(alpha_weight=0, depth_weight=0, normal_weight=0), True, True, True) == (Photometric(0.2),)
    views, depths = still_life()
    maps = [np.ones_like(d, np.float32) for d in depths]
    priors = [Prior((3 / d).astype(np.float32), *[m] * 3, "a network", "none") for d, m in zip(depths, maps)]
    network = PriorConfig(depth_model="depth.onnx", depth_guides=True)  # not opened: its maps are there
    fit = Trainer(views, None, FitConfig(steps=2, init=InitConfig(source="sweep"), priors=network), CPU, priors=priors)
    assert [t.name for t in fit.terms] == ["photometric", "given_depth"]
    assert any("given depth: used in 3 of 3 views" in n for n in fit.notes)
    for view, true in zip(fit.views, depths):
        scaled, weight, q = (m.numpy() for m in view.maps["given_depth"].unbind(-1))
        at = weight > 0
        assert at.mean() > 0.9 and np.median(np.abs(q[at] / scaled[at] / true[at] - 1)) < 0.005
    with pytest.raises(UsageError, match="--depth-guides requires --depth-model"):
        PriorConfig(depth_guides=True)


# Smoothness of rendered depth: values, gradients, when it is chosen, memory, and fits.


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
    # gradients below the bound
    g = torch.Generator().manual_seed(0)
    depth = (1 + 0.02 * torch.rand(5, 6, generator=g, dtype=torch.float64)).requires_grad_()
    image, weight = torch.rand(5, 6, 3, generator=g, dtype=torch.float64), torch.rand(5, 6, generator=g, dtype=torch.float64)
    alpha = torch.ones(5, 6, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda d: depth_roughness(d, alpha, image, weight, None), depth)
    # all count alike where no depth is consistent
    view = TrainingView.of(photos(1, 4, 4)[0], CPU)
    assert torch.equal(SmoothDepth().needs(view, None)["smooth_depth"], torch.ones(4, 4))
    consistent = torch.zeros(4, 4)
    consistent[1] = 2.0
    found = SmoothDepth().needs(TrainingView(view.camera, view.image, consistent=consistent), None)["smooth_depth"]
    assert torch.equal(found, torch.where(consistent > 0, CONFIRMED, 1.0))


def test_fits_follow_their_terms():
    def found(config: FitConfig) -> float:
        fit = advanced(Trainer(photos(4), seeds(), config, CPU))
        renders = [(v, rasterize(fit.gaussians, v.camera)) for v in fit.views]
        depths = [(v, torch.where(r.alpha > 0.5, r.depth, 0)) for v, r in renders]
        return sum(float(unevenness(depth_normals(v.camera, d), v.image)) for v, d in depths)

    assert found(SMOOTH) < 0.8 * found(dataclasses.replace(SMOOTH, loss_terms=()))

    def off(loss: LossConfig) -> float:
        fit, found = advanced(Trainer(mapped(), seeds(), dataclasses.replace(CONFIG, loss=loss), CPU)), []
        for v in mapped()[:-1]:
            r, given = rasterize(fit.gaussians, v.camera), torch.as_tensor(v.depth.values)
            at = (given > 0) & (r.alpha > 0.5)
            found.append(float((r.depth[at] / given[at] - 1).abs().mean()))
        return float(np.mean(found))

    assert off(CONFIG.loss) < 0.85 * off(LossConfig(depth_weight=0, normal_weight=0))

    def rough(weight: float) -> float:
        config = FitConfig(
            steps=40, init=InitConfig(source="points", opacity=0.9), sh_degree=0, half_resolution=0.5,
            loss=LossConfig(smooth_weight=weight),
        )  # fmt: skip
        fit, found = advanced(Trainer(photos(3), seeds(), config, CPU)), []
        for v in photos(3):
            r, image = rasterize(fit.gaussians, v.camera), torch.as_tensor(v.image, dtype=torch.float32)
            found.append(float(depth_roughness(r.depth, r.alpha, image, torch.ones_like(r.depth), None)))
        return sum(found)

    assert rough(30.0) < 0.9 * rough(0.0)


# The depth term of `examples/`: a correlation with the prior, nothing without one, and what a fit makes of it.

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
    """Over the opaque pixels that the mask keeps: what the others hold changes nothing, and they have no gradient."""
    depth, alpha, disparity, mask = maps(dtype)
    mask = mask if masked else None
    value = float(depth_disagreement(depth, alpha, disparity, mask))
    assert value == pytest.approx(1 - correlation(depth, alpha, disparity, mask), abs=1e-12 if dtype == torch.float64 else 1e-6)
    hidden = alpha <= MIN_ALPHA if mask is None else (alpha <= MIN_ALPHA) | (mask == 0)
    assert 10 < int(hidden.sum()) < 80
    other = depth_disagreement(torch.where(hidden, 0, depth), alpha, torch.where(hidden, 1, disparity), mask)
    assert float(other) == value
    # against central differences in float64; alpha only decides what counts
    depth, alpha, disparity, mask = maps()
    mask = mask if masked else None
    depth.requires_grad_(), alpha.requires_grad_()
    assert torch.autograd.gradcheck(lambda d: depth_disagreement(d, alpha, disparity, mask), depth, eps=1e-6, atol=1e-9)
    gradient, none = torch.autograd.grad(
        depth_disagreement(depth, alpha, disparity, mask), (depth, alpha), allow_unused=True, materialize_grads=True
    )
    hidden = alpha <= MIN_ALPHA if mask is None else (alpha <= MIN_ALPHA) | (mask == 0)
    assert bool((gradient[hidden] == 0).all()) and bool((gradient[~hidden] != 0).all()) and not bool(none.any())


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
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


def agreement(fit: Trainer, wanted: list[Prior]) -> float:
    renders = [rasterize(fit.gaussians, v.camera) for v in fit.views]
    return float(np.mean([correlation(r.depth, r.alpha, torch.as_tensor(p.disparity), None) for r, p in zip(renders, wanted)]))


def guided(config: FitConfig, given: list[Prior]) -> Trainer:
    return advanced(Trainer(photos(3), seeds(), config, CPU, priors=given))


def test_a_fit_follows_its_priors_until_the_term_ends():
    """Whichever way round the prior is: depth comes nearer to it than it began, and than under the other."""
    straight = priors(photos(3))
    turned = [dataclasses.replace(p, disparity=1 - p.disparity) for p in straight]
    start = guided(dataclasses.replace(GUIDED, steps=1), straight)
    fits = [guided(GUIDED, given) for given in (straight, turned)]
    for given, own, other in ((straight, *fits), (turned, *reversed(fits))):
        assert agreement(own, given) > max(agreement(start, given), agreement(other, given)) + 0.1
    # off from the first step on it is as if it had no weight, to the bit
    plain = guided(dataclasses.replace(GUIDED, loss_terms=()), priors(photos(3)))
    for until, same in ((0.0, True), (0.5, False)):
        fit = guided(dataclasses.replace(GUIDED, loss_terms=(DepthCorrelation(0.5, until),)), priors(photos(3)))
        assert torch.equal(fit.gaussians.means, plain.gaussians.means) == same
    assert [len(fit.plan_of(s).terms) for s in (1, 20, 21, 40)] == [2, 2, 1, 1]
