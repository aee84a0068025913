"""What a fit says it needs is what its tensors take, and a limit is kept to."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.allocations import Allocations
from tests.example_terms import DepthCorrelation
from tests.gaussians import camera, cloud, leaves
from tests.scenes import photos, priors, seeds
from warpgs.app.cli import main
from warpgs.device import StepSizes, add_needs
from warpgs.kernels import blend, project, tiles
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.paper.strategy import PaperConfig
from warpgs.pipeline.train.loss import LOSS_TERMS, LossTerm
from warpgs.pipeline.train.memory import most_instances, plan
from warpgs.pipeline.train.schedule import PhaseConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.stopping import StoppingConfig
from warpgs.pipeline.train.strategies import sampling
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.view_modules import Exposure, RefinePoses
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import View
from warpgs.synthetic.demo import split_spec, write_demo

CPU = torch.device("cpu")
STEADY = FitConfig(steps=1000, sh_every=1, init=InitConfig(source="points"), density=DensityConfig(start=500))
GROWING = dataclasses.replace(STEADY, density=DensityConfig(start=1, every=2, gradient=1e-9))


def masked(views: list[View]) -> list[View]:
    return [dataclasses.replace(v, mask=np.ones(v.image.shape[:2], bool)) for v in views]


def instances(fit: Trainer) -> int:
    return most_instances(fit.gaussians, [v.camera for v in fit.views], fit.context.render_options())


def measured(fit: Trainer, steps: int) -> int:
    """Bytes that the tensors of a fit take at the heaviest moment of some steps."""
    views = (t for v in fit.views for t in (*vars(v).values(), *v.maps.values()) if isinstance(t, torch.Tensor))
    stacks = (t for s in fit.stacks.values() for t in (*vars(s).values(), *s.maps.values()) if isinstance(t, torch.Tensor))
    with Allocations([*views, *stacks, *fit.table.state().values()]) as allocations:
        for _ in range(steps):
            fit.advance()
    return allocations.peak


@pytest.mark.parametrize("change", [list, masked])
@pytest.mark.parametrize("size", [(40, 32), (400, 300)])
@pytest.mark.parametrize("count", [60, 5000])
def test_plan_covers_a_step_and_not_much_more(change, size, count):
    """From few Gaussians on many pixels to many on few, with and without masks."""
    fit = Trainer(change(photos(2, *size)), seeds(count), STEADY, CPU)
    fit.advance()
    found = measured(fit, 2)
    planned = fit.layout.step(count, instances(fit))
    assert fit.memory.planned >= 0.95 * planned and found <= planned <= 1.25 * found + 20_000


@pytest.mark.parametrize("batch", [3, 8])
def test_plan_covers_the_sums_of_several_views(batch):
    """Their gradients and statistics, of many Gaussians on few pixels."""
    fit = Trainer(photos(2), seeds(5000), dataclasses.replace(STEADY, batch=batch), CPU)
    fit.advance()
    found = measured(fit, 2)
    planned = fit.layout.step(5000, instances(fit))
    assert fit.layout.sums == {3: 1, 8: 3}[batch] and found <= planned <= 1.1 * found


@pytest.mark.parametrize("change", [list, masked])
def test_plan_covers_the_depth_term(change):
    """A disparity a pixel that stays, and what a correlation and its gradient take."""
    views = change(photos(2, 400, 300))
    config = dataclasses.replace(STEADY, loss_terms=(DepthCorrelation(0.1),))
    fit = Trainer(views, seeds(60), config, CPU, priors=priors(views))
    fit.advance()
    found = measured(fit, 2)
    planned = fit.layout.step(60, instances(fit))
    assert fit.layout.sizes.depth and found <= planned <= 1.25 * found + 20_000


@pytest.mark.parametrize(("module", "size", "count"), [(RefinePoses(), (40, 32), 20_000), (Exposure(), (400, 300), 60)])
def test_plan_covers_what_is_learned_of_views(module, size, count):
    """A gradient of the camera for each Gaussian, and renders with and without their exposure."""
    fit = Trainer(photos(2, *size), seeds(count), dataclasses.replace(STEADY, view_modules=(module,)), CPU)
    fit.advance()
    found = measured(fit, 2)
    planned = fit.layout.step(count, instances(fit))
    assert found <= planned <= 1.25 * found + 20_000


def test_plan_covers_density_events():
    """A set that doubles within a step: the heaviest moment is then the growing itself."""
    fit = Trainer(photos(2), seeds(4000), GROWING, CPU)
    fit.advance()
    found = measured(fit, 1)
    layout, after = fit.layout, len(fit.gaussians)
    assert after > 5000
    assert found <= layout.held(after) + layout.event(4000, after) <= 1.1 * found


def test_plan_covers_sampling_events(monkeypatch):
    """Scores, renderings and contributions of all views, and the fine Gaussians that they lead to."""
    views = photos(3, 200, 150)
    monkeypatch.setattr(sampling, "MIN_ALPHA", 0.05)
    method = sampling.MethodConfig(hier=True, sampler=sampling.SamplerConfig(fraction=0.01, max_fraction=0.2))
    config = dataclasses.replace(
        STEADY, steps=40, strategy="paper", strategy_config=PaperConfig(pm=False), method=method, phases=PhaseConfig(1000, 1500)
    )
    fit = Trainer(views, seeds(1500), config, CPU, priors=priors(views))
    for _ in range(6):
        fit.advance()
    before = len(fit.gaussians)
    found, after = measured(fit, 4), len(fit.gaussians)
    assert len(fit.strategy.events) > 2 and any(e["evicted"] for e in fit.strategy.events) and before <= after
    planned = max(fit.layout.step(after, instances(fit)), fit.layout.held(after) + fit.layout.event(before, after))
    assert found <= planned <= 1.35 * found


def bytes_of_tensors(tensors) -> int:
    """Bytes of the memory of tensors, what several share counted once."""
    return sum({s._cdata: s.nbytes() for s in (t.untyped_storage() for t in tensors)}.values())


@pytest.mark.parametrize("stops", [False, True])
@pytest.mark.parametrize("strategy", ["clone_split", "sampling", "mcmc"])
def test_plan_counts_what_lasts(strategy, stops):
    """To the byte: every column of a strategy, each view once though a stack has it, whole views beside hidden ones."""
    views = masked(photos(4, 200, 150))
    config = dataclasses.replace(
        STEADY, steps=60, strategy=strategy, strategy_config=None, phases=PhaseConfig(4, 6),
        loss_terms=(DepthCorrelation(0.1),), half_resolution=0.0 if stops else 0.5,
        stopping=StoppingConfig(min_gain_db=0.1 * stops),
    )  # fmt: skip
    fit = Trainer(views, seeds(500), config, CPU, priors=priors(views))
    assert fit.stopping.active == stops
    tensors = list(fit.table.state().values())
    for v in (*fit.views, *fit.stacks.values(), *fit.stopping.whole):
        for name, value in (*vars(v).items(), *v.maps.items()):
            if name not in ("viewmats", "Ks", "numbers"):
                tensors += [t for t in (value if isinstance(value, tuple) else [value]) if isinstance(t, torch.Tensor)]
    tensors += [t for s in fit.stacks.values() for rows in s.maps.values() for t in rows]
    assert fit.layout.held(500) == bytes_of_tensors(tensors)


def test_plan_covers_held_out_blocks():
    """Whole views beside those without their blocks, through growth and its end."""
    views = photos(4, 200, 150)
    config = dataclasses.replace(GROWING, steps=30, sh_every=15, stopping=StoppingConfig(min_gain_db=50.0))
    fit = Trainer(views, seeds(1500), config, CPU)
    fit.advance()
    assert fit.stopping.active
    planned = found = 0
    while fit.step < fit.steps:
        before = len(fit.gaussians)
        found = max(found, measured(fit, 1))
        after = len(fit.gaussians)
        event = fit.layout.held(after) + fit.layout.event(before, max(before, after))
        planned = max(planned, fit.layout.step(max(before, after), instances(fit)), event)
    assert fit.stopping.ended is not None and found <= planned


@pytest.mark.parametrize("most", [400, 3000])
def test_plan_covers_chunks(most):
    """The same for steps that render in chunks."""
    views = photos(2, 200, 150)
    fit = Trainer(views, seeds(800), STEADY, CPU)
    fit.advance()
    assert instances(fit) > most
    fit.context.max_instances = most
    found = measured(fit, 2)
    assert found <= fit.layout.step(800, most, chunked=True) <= 1.3 * found


def test_kernels_declare_what_they_allocate(device):
    """What a render leaves until its loss, and the most that the backward pass of blending holds, but for a few numbers."""
    gaussians, cam = leaves(cloud(2000, device=device)), camera(240, 200, dtype=torch.float32, device=device)
    gaussians = dataclasses.replace(gaussians, log_scales=(gaussians.log_scales.detach() + 1).requires_grad_())
    with Allocations([*gaussians.tensors().values(), cam.viewmat, cam.K]) as allocations:
        begin = allocations.held
        render = rasterize(gaussians, cam, RasterizeOptions(record=False))
        left, allocations.peak = allocations.held - begin, 0
        render.rgb.sum().backward(inputs=[gaussians.means])
        most = allocations.peak - begin
    row, total = 4 * (11 + gaussians.sh[0].numel()), int(render.tile_counts.sum())
    sizes = StepSizes(240, 200, row, cuda=device.type == "cuda", count=2000, instances=total)
    declared = add_needs((project.step_bytes, tiles.step_bytes, blend.step_bytes), sizes)
    unseen = 8 * int((render.tile_counts == 0).sum())  # declared as if all were visible
    slack = 64 + 5 * 256 * 4 * sizes.cuda  # single numbers; states come in whole chunks
    assert abs(declared["loss"] - unseen - left) <= slack
    assert abs(declared["blending"] - unseen - most) <= 2 * slack


def test_the_order_of_tiles_is_part_of_a_sampling_event():
    """On CUDA it takes 33 numbers a tile while a view is rendered; later in a step the image's gradient takes more."""
    one, other = (StepSizes(240, 200, 56, cuda=cuda, count=2000, instances=9000) for cuda in (True, False))
    order = 15 * 13 * 132
    assert blend.step_bytes(one)["sampling"] - blend.step_bytes(other)["sampling"] == order < 12 * one.pixels


@dataclasses.dataclass(frozen=True)
class Copies(LossTerm):
    """A term that keeps copies of the render, their squares, and gradients of both."""

    count: int = 20
    declared: bool = True

    def bytes(self, sizes):
        return {"loss": 4 * self.count * 12 * sizes.pixels * self.declared}

    def __call__(self, inputs):
        return torch.stack([inputs.outputs["rgb"]] * self.count).square().sum() * 1e-9


@pytest.mark.parametrize("declared", [True, False])
def test_a_buffer_of_ones_own_is_planned_once_it_is_declared(monkeypatch, declared):
    """And one that is not is found by what a step holds."""
    monkeypatch.setitem(LOSS_TERMS._classes, "copies", Copies)
    monkeypatch.setattr(Copies, "name", "copies")
    config = dataclasses.replace(STEADY, loss_terms=(Copies(declared=declared),))
    fit = Trainer(photos(2, 200, 150), seeds(60), config, CPU)
    fit.advance()
    found, planned = measured(fit, 2), fit.layout.step(60, instances(fit))
    assert found <= planned <= 1.25 * found if declared else planned < 0.5 * found


def test_fit_keeps_to_its_limit(tmp_path):
    """A limit that forces chunks and fewer Gaussians: it is said, kept, and costs no quality."""
    views = photos(4, 160, 120)
    config = dataclasses.replace(
        STEADY, steps=24, sh_every=12, density=DensityConfig(start=5, every=5, gradient=2e-5), max_gaussians=4000
    )
    free = Trainer(views, seeds(1200), config, CPU)
    whole = free.layout.step(1200, free.memory.instances)
    need = (whole + free.layout.smallest(1200)) // 2
    limited = Trainer(views, seeds(1200), dataclasses.replace(config, memory_limit=need), CPU)
    said = limited.memory.summary()
    assert limited.memory.cap < 4000 and f"at most {limited.memory.cap:,} Gaussians, not 4,000" in said and "chunks" in said
    assert limited.memory.planned <= need and limited.memory.planned_at_cap <= need
    peak = 0
    for _ in range(config.steps):
        free.advance()
        peak = max(peak, measured(limited, 1))
    assert peak <= need < whole
    assert 1200 < len(limited.gaussians) <= limited.memory.cap
    ends = []
    for fit in (free, limited):
        renders = [
            rasterize(fit.gaussians, v.camera, RasterizeOptions(max_instances=fit.context.max_instances)).rgb for v in views
        ]
        ends.append(np.mean([-10 * np.log10(np.mean((r.numpy() - v.image) ** 2)) for r, v in zip(renders, views)]))
    assert abs(ends[0] - ends[1]) < 1.0


def test_limit_below_the_smallest_step_says_what_is_needed(tmp_path, capsys):
    """Before any step, with a way out, and no folder left behind."""
    write_demo(tmp_path / "scene", views=8, width=48, height=36)
    flags = ["fit", str(tmp_path / "scene"), "--split", split_spec(8), "--out", str(tmp_path / "run"), "--device", "cpu"]
    assert main([*flags, "--memory-limit", "64KiB"]) == 2
    assert "less than the" in (said := capsys.readouterr().err) and "that the smallest step needs" in said
    assert not (tmp_path / "run").exists()
    assert main([*flags, "--memory-limit", "lots"]) == 2 and "such as 2GiB" in capsys.readouterr().err


def test_captured_steps_are_given_up_where_they_need_more():
    """On CUDA a graph has capacity to spare; a limit between the two ways is kept by the smaller one."""
    made = Trainer(photos(3, 504, 378), seeds(60), STEADY, CPU).layout
    layout = dataclasses.replace(made, sizes=dataclasses.replace(made.sizes, cuda=True), graphs=1)
    single = dataclasses.replace(layout, graphs=0)
    many = {"count": 20_000, "instances": 200_000, "most": 20_000, "available": 2**40}
    wide, _ = plan(layout, **many, limit=2**33, capacity_factor=1.3)
    assert not wide.graph_refused and not wide.chunked
    needed = single.step(20_000, 200_000)
    tight, chosen = plan(layout, **many, limit=needed, capacity_factor=1.3)
    assert tight.graph_refused and chosen == single and not tight.chunked and "without a CUDA graph" in tight.summary()
    assert plan(layout, **many, limit=needed - 2**20, capacity_factor=1.3)[0].chunked
    open_end, _ = plan(layout, **{**many, "most": 10**6, "available": 2**29}, limit=None)
    assert "set --memory-limit" in open_end.summary() and open_end.lowered_from is None


@pytest.mark.cuda
@pytest.mark.parametrize("captured", [True, False])
def test_limit_holds_on_cuda(captured):
    """What torch's allocator counted at its peak lies below the limit, in chunks and in captured steps."""
    device = torch.device("cuda", 0)
    views = photos(4, 160, 120)
    config = dataclasses.replace(STEADY, steps=60, density=DensityConfig(start=10, every=10, gradient=2e-5), max_gaussians=4000)
    free = Trainer(views, seeds(1200), dataclasses.replace(config, cuda_graph=captured), device)
    most = 4 * free.memory.planned_at_cap if captured else free.layout.smallest(1500)
    del free
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated(device)
    fit = Trainer(views, seeds(1200), dataclasses.replace(config, cuda_graph=captured, memory_limit=most), device)
    assert bool(fit.layout.graphs) == captured
    torch.cuda.reset_peak_memory_stats(device)
    while fit.step < 60:
        fit.advance(100)
    assert torch.cuda.max_memory_allocated(device) - before <= most
