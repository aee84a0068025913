"""Loss terms in a step: their sum, and what each is given."""

import dataclasses

import pytest
import torch

from tests.example_terms import DepthCorrelation
from tests.scenes import photos, priors, seeds
from warpgs.errors import UsageError
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train.loss import (
    LOSS_TERMS,
    AlphaDifference,
    LossConfig,
    LossInputs,
    LossTerm,
    Photometric,
    Target,
    built_in_terms,
    outputs_of,
    photometric_loss,
    total,
)
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.step import StepPlan, eager_renderer, total_loss, view_gradients
from warpgs.pipeline.train.strategies.base import Strategy
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.view_modules import ROTATION, RefinePoses

CPU = torch.device("cpu")
PLAIN = FitConfig(steps=8, init=InitConfig(source="points"), sh_degree=0)


@pytest.fixture(autouse=True)
def registry_as_it_was(monkeypatch):
    """What a test registers is gone after it."""
    LOSS_TERMS.names()
    monkeypatch.setattr(LOSS_TERMS, "_classes", dict(LOSS_TERMS._classes))


def maps(dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Depth from 1 to 5, alpha on both sides of the limit, disparity that knows a little of the depth, and a mask, [9, 11]."""
    generator = torch.Generator().manual_seed(0)
    depth, alpha, noise, kept = torch.rand(4, 9, 11, generator=generator, dtype=torch.float64)
    depth = 1 + 4 * depth
    disparity = (0.6 * noise + 0.4 / depth).clamp(0, 1)
    return depth.to(dtype), (0.3 + 0.7 * alpha).to(dtype), disparity.to(dtype), (kept > 0.3).to(dtype)


@pytest.mark.parametrize("shape", [(70_001,), (300, 401), (3, 40, 50, 3), (5,)])
def test_a_total_has_the_same_bits_for_any_number_of_threads(shape):
    """Of values per Gaussian, and of images."""
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


def test_built_in_terms_follow_from_the_weights():
    """An opacity term where views know theirs and it has a weight."""
    assert built_in_terms(LossConfig()) == (Photometric(0.2),)
    assert built_in_terms(LossConfig(alpha_weight=0.3), True) == (Photometric(0.2), AlphaDifference(0.3))
    assert built_in_terms(LossConfig(alpha_weight=0), True) == (Photometric(0.2),)


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
    with pytest.raises(UsageError, match="'silent' reads the output 'alpha', but did not request it; add it to needs_outputs"):
        fit.advance()
    assert not Trainer(photos(2), seeds(), PLAIN, CPU).layout.sizes.depth
    Silent.needs_outputs = ("normals",)
    with pytest.raises(UsageError, match=r"'silent' needs the output 'normals', which .* rgb, alpha, depth"):
        dataclasses.replace(PLAIN, loss_terms=(Silent(),))


def test_depth_has_a_gradient_where_a_term_reads_it(monkeypatch):
    """Else the backward pass of blending is not asked for one, which costs time."""
    seen = []
    gradients = torch.autograd.grad

    def noted(loss, wanted, *args, **more):
        names, nodes = set(), [loss.grad_fn]
        while nodes:
            node = nodes.pop()
            if node is not None and node.name() not in names | {"_BlendBackward"}:
                names.add(node.name())
            for parent, place in () if node is None else node.next_functions:
                if parent is not None and parent.name() == "_BlendBackward":
                    seen[-1].add(place)
                else:
                    nodes.append(parent)
        return gradients(loss, wanted, *args, **more)

    monkeypatch.setattr(torch.autograd, "grad", noted)
    for terms in ((), (DepthCorrelation(),)):
        seen.append(set())
        Trainer(photos(2), seeds(), dataclasses.replace(PLAIN, loss_terms=terms), CPU, priors=priors(photos(2))).advance()
    assert seen == [{0}, {0, 2}]


@pytest.mark.parametrize("batch", [1, 3])
def test_a_term_sees_camera_and_step(batch):
    """Those of each view of the step, at the size of its image; all views of a step have its number."""
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
    while fit.step < 8:
        fit.advance()
    camera = photos(1)[0].camera
    small, large = (20, camera.K[0, 0] / 2), (40, camera.K[0, 0])
    sizes = [(k, *(small if k <= 4 else large)) for k in range(1, 9) for _ in range(batch)]
    assert [(k, w) for k, w, _ in seen] == [(k, w) for k, w, _ in sizes]
    assert [f for *_, f in seen] == pytest.approx([f for *_, f in sizes])


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
    fit.learned.views.table.params[ROTATION].data[1] = torch.tensor([0.0, 0.2, 0.0])
    (stack,) = fit.stacks.values()
    fit.buffers.load([1], [[0.0] * fit.buffers.lr_rows.shape[1]], [fit.settings(1)])
    found = view_gradients(fit.learned, stack, fit.buffers, plan, eager_renderer(fit.context.render_options(), None))
    rotation = found.gradients[len(fit.table.params) + list(fit.learned.views.table.params).index(ROTATION)]
    assert float(rotation[1].abs().max()) > 10 and not bool(rotation[[0, 2]].any())
