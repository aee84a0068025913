"""Starting, densifying, losing and saving at the extremes of data and settings (docs/extremes.md)."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings, strategies as st

from bench.lib.kernel_calls import adam_step
from tests.gaussians import cloud
from tests.pipeline.train import fits
from tests.reference.neighbours import mean_square_distances_reference
from tests.scenes import photos, priors, seeds
from warpgs.errors import DataError, NotFiniteError, UsageError
from warpgs.export.ply import write_ply
from warpgs.io.load import normalization_of, normalize_points, normalize_view
from warpgs.kernels.neighbours import mean_square_distances
from warpgs.kernels.ssim import differences, ssim
from warpgs.pipeline.metrics.scores import quantiles
from warpgs.pipeline.model.limits import LimitConfig
from warpgs.pipeline.model.start import InitConfig, initial_gaussians
from warpgs.pipeline.model.table import Column, DensityUpdate, Table
from warpgs.pipeline.paper.scores import geometry_gate, normalized
from warpgs.pipeline.paper.strategy import PaperConfig
from warpgs.pipeline.run.folder import TENSORS, load_checkpoint, save_checkpoint
from warpgs.pipeline.train.loss import LossConfig, photometric_loss
from warpgs.pipeline.train.schedule import OptimizerConfig, PhaseConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.stopping import StoppingConfig
from warpgs.pipeline.train.strategies import clone_split
from warpgs.pipeline.train.strategies.clone_split import DensityConfig, refine
from warpgs.pipeline.train.strategies.sampling import MethodConfig, SamplerConfig, sample_pixels
from warpgs.pipeline.train.trainer import Trainer, run
from warpgs.render.rasterize import rasterize
from warpgs.scene import Normalization, PointCloud

POINTS = InitConfig(source="points")
few = settings(derandomize=True, deadline=None, database=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def gray(points) -> PointCloud:
    points = np.asarray(points, float).reshape(-1, 3)
    return PointCloud(points, np.full((len(points), 3), 0.5, np.float32))


def taken(views, cloud_, device, steps: int = 3, **more) -> Trainer:
    fit = Trainer(views, cloud_, FitConfig(steps=steps, init=POINTS, sh_degree=0, **more), device)
    for _ in range(steps):
        assert math.isfinite(fit.advance()[0].loss)
    assert all(bool(torch.isfinite(t).all()) for t in fit.state()[0].values() if t.is_floating_point())
    return fit


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("identical", [False, True])
def test_few_points_and_identical_ones_get_a_width(device, count, identical):
    """As many neighbours as there are; a floor of 1e-6 and a ceiling of a tenth of the scene's extent."""
    points = np.zeros((count, 3)) if identical else np.eye(4, 3)[:count] * 2.0
    g = initial_gaussians(gray(points), POINTS, 0, 5.0, device)
    assert g.means.shape == (count, 3) and bool(torch.isfinite(g.log_scales).all())
    widths = g.log_scales.exp()
    if count:
        wanted = 1e-6 * 5.0 if identical or count == 1 else 0.1 * 5.0
        assert torch.allclose(widths, torch.full_like(widths, wanted), rtol=1e-5)


def test_clusters_closer_than_squares_can_tell(device, dtype):
    """Two clusters 1e-20 apart: distances finite, exact where their squares are, and a width above zero."""
    points = torch.zeros(8, 3, dtype=dtype)
    points[4:, 0] = 1e-20
    found = mean_square_distances(points.to(device)).cpu()
    assert not bool(found.any())  # three neighbours coincide
    spread = torch.zeros(4, 3, dtype=dtype)
    spread[:, 0] = torch.tensor([0.0, 1e-20, 2e-20, 3e-20])
    found = mean_square_distances(spread.to(device)).cpu()
    wanted = mean_square_distances_reference(spread.double(), 3)
    assert torch.allclose(found.double(), wanted, rtol=1e-4 if dtype is torch.float32 else 1e-12, atol=2e-45)
    g = initial_gaussians(gray(spread.numpy()), POINTS, 0, 1.0, device)
    assert torch.allclose(g.log_scales.exp(), torch.full((4, 3), 1e-6, device=device), rtol=1e-5)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("source", ["points", "random"])
def test_cameras_without_extent(device, count, source):
    """The extent, which rates and thresholds are shares of, stays positive; no Gaussian is pruned for being too large."""
    views = [dataclasses.replace(photos(1)[0], name=f"{i}.png") for i in range(count)]  # all in one place
    n = normalization_of(views, seeds(), "here")
    points = normalize_points(seeds(), n, "here")
    assert 0 < n.scale < math.inf
    views = [normalize_view(v, n) for v in views]
    density = DensityConfig(start=1, every=1, stop_fraction=1.0)
    init = InitConfig(source=source, random_count=60)
    fit = Trainer(views, points, FitConfig(steps=4, init=init, sh_degree=0, density=density), device)
    assert 0 < fit.context.extent < math.inf and fit.lrs(1)["means"] > 0
    # what stands before the near plane would never be drawn, and never be moved
    assert int(rasterize(fit.gaussians, fit.views[0].camera).visible.sum()) >= 20
    fit.strategy.gradients.was_reset = True  # size pruning is on
    for _ in range(4):
        assert math.isfinite(fit.advance()[0].loss)
    assert len(fit.gaussians) >= 30


def test_pruning_everything_leaves_one_and_the_fit_goes_on(device, monkeypatch):
    """A threshold that no opacity reaches: one Gaussian stays at each event, and later steps still work."""
    density = DensityConfig(start=1, every=2, stop_fraction=1.0, gradient=math.inf)
    monkeypatch.setattr(clone_split, "PRUNE_OPACITY", 1.0)
    fit = taken(photos(2), seeds(), device, steps=8, density=density)
    assert len(fit.gaussians) == 1


def test_a_set_of_none_is_legal_and_refinement_that_changes_nothing_changes_no_bit(device):
    """No rows: a step, refinement, a change of the set and columns work on nothing."""
    g = cloud(0, device=device)
    table = Table.of_gaussians(g, {"seen": Column(0.0)})
    fits.adam_step(table, {n: torch.zeros_like(t) for n, t in table.params.items()})
    none = torch.zeros(0, dtype=torch.int64, device=device)
    table.apply(DensityUpdate(none, g.tensors(), none))
    change = refine(
        g, torch.zeros(0, device=device), DensityConfig(), extent=1.0, capacity=9, after_reset=False,
        generator=torch.Generator(),
    )  # fmt: skip
    assert len(change.keep) == len(change.parents) == len(table) == 0
    assert all(t.shape[0] == 0 for t in table.state().values())
    # nothing pulled at and nothing faint: all rows stay, with their moments
    g = cloud(30, device=device)
    g.logit_opacities[:] = 1.0
    change = refine(
        g, torch.zeros(30, device=device), DensityConfig(), extent=1.0, capacity=100, after_reset=False,
        generator=torch.Generator(),
    )  # fmt: skip
    assert torch.equal(change.keep.cpu(), torch.arange(30)) and len(change.parents) == 0


def poison(fit: Trainer, name: str, where: str, value: float) -> None:
    """Put a value into the gradient of a tensor's first row from the next step on, or into the tensor itself."""
    if where == "gradient":

        def spoil(gradient: torch.Tensor) -> torch.Tensor:
            gradient = gradient.clone()
            gradient[0] = value
            return gradient

        fit.table.params[name].register_hook(spoil)
    else:
        fit.table.params[name].detach()[0] = value


@pytest.mark.parametrize(
    ("name", "where", "value"),
    [
        ("means", "gradient", math.nan), ("sh", "gradient", math.inf), ("logit_opacities", "gradient", math.nan),
        ("log_scales", "parameter", math.inf), ("quats", "parameter", math.nan),
    ],
)  # fmt: skip
def test_what_is_no_number_is_never_saved(device, tmp_path, name, where, value):
    """The Gaussian is culled, so the loss stays finite; the next checkpoint is refused by name, and the last one is whole."""
    config = FitConfig(
        steps=6, init=POINTS, sh_degree=0, density=DensityConfig(start=100), checkpoint_every=2,
        cuda_graph=False,
    )  # fmt: skip
    fit, saved = Trainer(photos(2), seeds(), config, device), []

    def save(current: Trainer) -> None:
        save_checkpoint(tmp_path, *current.state())
        saved.append(current.step)

    def on_step(report) -> None:
        assert math.isfinite(report.loss)

    original = fit.advance

    def advance(limit: int):
        if fit.step == 3:
            poison(fit, name, where, value)
        return original(limit)

    fit.advance = advance
    with pytest.raises(NotFiniteError, match=rf"(params|exp_avg|exp_avg_sq)\.{name} holds non-finite values.*--resume"):
        run(fit, on_step, save, lambda: False)
    tensors, state = load_checkpoint(tmp_path)
    assert saved == [2] and state["step"] == 2
    assert all(bool(torch.isfinite(t).all()) for t in tensors.values() if t.is_floating_point())
    with pytest.raises(DataError, match="finite"):
        write_ply(tmp_path / "model.ply", fit.gaussians, Normalization(np.zeros(3), 1.0))
    assert sorted(p.name for p in tmp_path.iterdir()) == [TENSORS]


def test_adam_keeps_a_bad_row_to_itself(device, dtype):
    """A gradient that is no number spoils its own element; every other has the bits it would have had."""
    generator = torch.Generator().manual_seed(0)
    param, grad = torch.randn(2, 300, 3, generator=generator, dtype=torch.float64).to(device, dtype)
    grad[17, 1] = math.nan
    found = []
    for g in (grad, grad.nan_to_num(nan=0.5)):
        p, mean, square = param.clone(), torch.zeros_like(param), torch.zeros_like(param)
        adam_step(p, g.contiguous(), mean, square, lr=0.1, step=1)
        found.append(p)
    same = found[0] == found[1]
    assert not bool(same[17, 1]) and int((~same).sum()) == 1


WEIGHTS = st.lists(st.sampled_from([0.0, -0.0, 1e-38, 0.5, 1.0, 3e38, math.nan, math.inf, -1.0]), min_size=1, max_size=30)


@few
@given(WEIGHTS, st.integers(0, 40), st.booleans())
def test_sampling_weights_of_any_kind(device, weights, count, random):
    """Zero, negative and NaN are never drawn, infinite ones first; as many come back as could be drawn, none twice."""
    score = torch.tensor([weights], device=device)
    gate = torch.ones_like(score, dtype=torch.bool)
    uniform = torch.rand(score.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    at = sample_pixels(score, gate, count, uniform if random else None)
    allowed = [i for i, w in enumerate(weights) if w > 0]
    columns = at[:, 1].tolist()
    assert len(columns) == len(set(columns)) == min(count, len(allowed)) and set(columns) <= set(allowed)
    infinite = {i for i in allowed if math.isinf(weights[i])}
    assert infinite <= set(columns) or set(columns) <= infinite


def test_more_pixels_than_2_to_the_24(device):
    """A photograph of 24 megapixels has more numbers than torch.quantile takes; gate and draw work on it."""
    count = 2**24 + 16
    score = torch.linspace(0, 1, count, device=device).view(16, -1)
    gate, used = geometry_gate(score, torch.ones_like(score, dtype=torch.bool), 0.6, 100)
    assert used == 0.6 and abs(float(gate.float().mean()) - 0.4) < 1e-3
    at = sample_pixels(score, gate, 100, torch.rand(score.shape, dtype=torch.float64))
    assert len(at) == 100 and bool(gate[at[:, 0], at[:, 1]].all())
    assert float(normalized(score).max()) == 1.0


@few
@given(st.lists(st.floats(-1e6, 1e6, width=32), min_size=1, max_size=60), st.floats(0, 1))
def test_quantiles_are_those_of_numpy(values, fraction):
    found = quantiles(torch.tensor(values, dtype=torch.float64), fraction)[0]
    assert math.isclose(float(found), float(np.quantile(np.array(values), fraction)), rel_tol=1e-12, abs_tol=1e-9)


@pytest.mark.parametrize("value", [0.0, 0.5, 0.6, 1.0])
@pytest.mark.parametrize(("height", "width"), [(1, 1), (5, 7), (10, 11), (40, 50)])
def test_constant_images_of_any_size(device, dtype, value, height, width):
    """Equal: exactly 1. A hair apart: at most 1, with a finite gradient. The summed form agrees."""
    image = torch.full((height, width, 3), value, dtype=dtype, device=device)
    assert bool((ssim(image, image) == 1).all())
    assert float(differences(image, image).abs().max()) == 0
    for step in (1e-7, 1e-3, -1e-3):
        leaf = (image + step).requires_grad_()
        similar = ssim(leaf, image)
        similar.sum().backward()
        assert float(similar.detach().max()) <= 1 and float(similar.detach().min()) > 0.9 - 1e4 * abs(step) * (value == 0)
        assert bool(torch.isfinite(leaf.grad).all())


def test_views_of_which_nothing_counts(device):
    """All pixels masked in one view, or in all: no division by zero, and nothing moves for a view that says nothing."""
    views = photos(2)
    hidden = [dataclasses.replace(v, mask=np.zeros(v.image.shape[:2], bool)) for v in views]
    fit = taken(hidden, seeds(), device, steps=2)
    first = initial_gaussians(seeds(), POINTS, 0, fit.context.extent, device)
    assert all(torch.equal(a, b) for a, b in zip(fit.gaussians.tensors().values(), first.tensors().values()))
    taken([hidden[0], views[1]], seeds(), device, steps=4)
    with pytest.raises(DataError, match="masks or alpha hide all pixels"):
        Trainer(hidden, None, FitConfig(init=InitConfig(source="random")), device)


@pytest.mark.parametrize("fraction", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("masked", ["all", "all but one"])
def test_masks_that_leave_nothing_or_one_pixel(device, fraction, masked):
    """The mean is over what counts, over nothing it is 0, and what is hidden may be anything; gradients stay at what counts."""
    mask = torch.zeros(12, 13, device=device)
    if masked == "all but one":
        mask[5, 6] = 1
    generator = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 12, 13, 3, generator=generator).to(device)
    leaf = image.requires_grad_()
    loss = photometric_loss(leaf, target, mask, fraction)
    loss.backward()
    assert math.isfinite(float(loss.detach())) and bool(torch.isfinite(leaf.grad).all())
    moved = torch.nonzero(leaf.grad.abs().sum(-1)).tolist()
    assert moved == ([] if masked == "all" else [[5, 6]])
    assert (float(loss.detach()) == 0) == (masked == "all")
    if masked == "all but one" and fraction == 0:
        assert float(loss.detach()) == pytest.approx(float((image - target).detach().abs()[5, 6].mean()), rel=1e-6)
    other = (torch.where(mask[..., None] > 0, t.detach(), 1 - t.detach()) for t in (image, target))
    assert torch.equal(photometric_loss(*other, mask, fraction), loss.detach())


NUMBERS = [math.nan, math.inf, -1, 0, 1e-300, 1, 3, 1e300]
KINDS = [
    DensityConfig, OptimizerConfig, LossConfig, SamplerConfig, PhaseConfig, PaperConfig,
    InitConfig, StoppingConfig, LimitConfig, FitConfig,
]  # fmt: skip
SHORT = FitConfig(
    steps=4, init=InitConfig(source="points"), sh_degree=1, sh_every=2, phases=PhaseConfig(coarse=200),
    density=DensityConfig(start=1, every=2, stop_fraction=1.0, gradient=1e-6),
    max_gaussians=200, strategy="paper", strategy_config=PaperConfig(pm=False),
    method=MethodConfig(hier=True),
)  # fmt: skip


def composed(part, name: str, value, config=SHORT):
    """The short fit with one field of one of its parts changed, or None without such a part; a part's own checks run."""
    if type(config) is part:
        return dataclasses.replace(config, **{name: value})
    own = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    changed = ((n, composed(part, name, value, c)) for n, c in own.items() if dataclasses.is_dataclass(c))
    return next((dataclasses.replace(config, **{n: c}) for n, c in changed if c is not None), None)


def test_the_list_of_settings_is_complete():
    """Whatever settings dataclass a fit is composed of is in the list above, but those without numbers."""
    parts = [getattr(c, f.name) for c in (SHORT, SHORT.method) for f in dataclasses.fields(c)]
    held = {type(p).__name__ for p in parts if dataclasses.is_dataclass(p)} | {"FitConfig"}
    assert held - {k.__name__ for k in KINDS} == {"PriorConfig", "MethodConfig"}


@pytest.mark.parametrize(
    "numbers", [(math.nan, -1, 0, 1e300), pytest.param(NUMBERS, marks=pytest.mark.slow)], ids=["few", "all"]
)
@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.__name__)
def test_a_setting_is_refused_or_works(kind, numbers):
    """Any number in any field, zero intervals too: a UsageError at once, or steps, events and resets that stay finite."""
    views, points = photos(1, 12, 10), seeds(12)
    known, refused = priors(views), 0
    torch.set_num_threads(1)  # everything is tiny
    for field in dataclasses.fields(kind):
        # bytes of memory and numbers of points are amounts of work, not numbers that could be wrong
        if type(field.default) not in (int, float) or field.name in ("memory_limit", "random_count", "steps"):
            continue
        for value in numbers:
            if type(field.default) is int and value not in range(-9, 10):
                continue  # the command line reads whole numbers
            try:
                config = composed(kind, field.name, type(field.default)(value))
            except UsageError:
                refused += 1
                continue
            fit = Trainer(views, points, config, torch.device("cpu"), priors=known)
            for _ in range(2):
                assert math.isfinite(fit.advance()[0].loss), (field.name, value)
            fit.table.reset_opacities(config.density.reset_opacity)
            fit.strategy.gradients.was_reset = True
            assert math.isfinite(fit.advance()[0].loss), (field.name, value)
            for name, t in fit.table.state().items():
                assert bool(torch.isfinite(t).all()), (field.name, value, name)
    assert refused > 0
