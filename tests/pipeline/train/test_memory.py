"""Memory of a fit: what it says it needs, a limit that is kept to, and the second try after running out."""

import contextlib
import copy
import dataclasses

import numpy as np
import pytest
import torch

from tests.allocations import Allocations
from tests.example_terms import DepthCorrelation
from tests.gaussians import camera, cloud, leaves
from tests.pipeline.train.fits import same_bits
from tests.pipeline.train.test_trainer import BUSY, fitted
from tests.scenes import photos, priors, seeds
from warpgs.app.cli import main
from warpgs.device import StepSizes, add_needs
from warpgs.errors import OutOfMemoryError, ResourceError
from warpgs.kernels import blend, project, tiles
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.paper.strategy import PaperConfig
from warpgs.pipeline.train import trainer as trainer_module
from warpgs.pipeline.train.loss import LOSS_TERMS, LossTerm
from warpgs.pipeline.train.memory import most_instances, plan, plan_summary
from warpgs.pipeline.train.schedule import PhaseConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.step import StepTaker
from warpgs.pipeline.train.stopping import StoppingConfig
from warpgs.pipeline.train.strategies import sampling
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer, run
from warpgs.pipeline.train.view_modules import Exposure, RefinePoses
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import View
from warpgs.synthetic.demo import split_spec, write_demo

# What a fit says it needs is what its tensors take, and a limit is kept to.

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


@pytest.mark.parametrize(
    ("size", "count", "changes"),
    [
        ((40, 32), 60, {}), ((400, 300), 60, {}), ((40, 32), 5000, {}), ((40, 32), 5000, {"batch": 3}),
        ((40, 32), 5000, {"batch": 8}), ((400, 300), 60, {"loss_terms": (DepthCorrelation(0.1),)}),
        ((40, 32), 20_000, {"view_modules": (RefinePoses(),)}), ((400, 300), 60, {"view_modules": (Exposure(),)}),
    ],
)  # fmt: skip
@pytest.mark.parametrize("change", [list, masked])
def test_plan_covers_a_step_and_not_much_more(change, size, count, changes):
    """From few Gaussians on many pixels to many on few, with and without masks, terms on depth, and view modules."""
    views = change(photos(2, *size))
    fit = Trainer(views, seeds(count), dataclasses.replace(STEADY, **changes), CPU, priors=priors(views))
    fit.advance()
    found = measured(fit, 2)
    planned = fit.layout.step(count, instances(fit))
    assert fit.layout.sums == {1: 0, 3: 1, 8: 3}[fit.batch] and fit.layout.sizes.depth == ("loss_terms" in changes)
    assert fit.memory["planned"] >= 0.95 * planned and found <= planned <= 1.25 * found + 20_000


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
            if name != "numbers":
                tensors += [t for t in (value if isinstance(value, tuple) else [value]) if isinstance(t, torch.Tensor)]
    tensors += [t for s in fit.stacks.values() for rows in s.maps.values() for t in rows]
    storages = (t.untyped_storage() for t in tensors)  # what several share is counted once
    assert fit.layout.held(500) == sum({s._cdata: s.nbytes() for s in storages}.values())


def test_plan_covers_density_events_and_held_out_blocks():
    """A set that doubles within a step: the heaviest moment is then the growing itself."""
    fit = Trainer(photos(2), seeds(4000), GROWING, CPU)
    fit.advance()
    found = measured(fit, 1)
    layout, after = fit.layout, len(fit.gaussians)
    assert after > 5000
    assert found <= layout.held(after) + layout.event(4000, after) <= 1.1 * found
    # whole views beside those without their blocks, through growth and its end
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
    # on CUDA it takes 33 numbers a tile while a view is rendered; the image's gradient takes more
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
    whole = free.layout.step(1200, free.memory["instances"])
    need = (whole + free.layout.smallest(1200)) // 2
    limited = Trainer(views, seeds(1200), dataclasses.replace(config, memory_limit=need), CPU)
    said, cap = plan_summary(limited.memory), limited.memory["cap"]
    assert cap < 4000 and f"at most {cap:,} Gaussians, not 4,000" in said and "chunks" in said
    assert limited.memory["planned"] <= need and limited.memory["planned_at_cap"] <= need
    peak = 0
    for _ in range(config.steps):
        free.advance()
        peak = max(peak, measured(limited, 1))
    assert peak <= need < whole
    assert 1200 < len(limited.gaussians) <= limited.memory["cap"]
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
    layout = Trainer(photos(3, 504, 378), seeds(60), STEADY, CPU).layout
    layout.sizes = dataclasses.replace(layout.sizes, cuda=True)
    many = {"count": 20_000, "instances": 200_000, "most": 20_000, "available": 2**40, "capacity_factor": 1.3}

    def planned(limit: int | None, **other) -> dict:
        layout.graphs = 1
        return plan(layout, **many | other, limit=limit)

    wide = planned(2**33)
    assert not wide["graph_refused"] and not wide["chunked"] and layout.graphs == 1
    needed = layout.step(20_000, 200_000)
    assert layout.step(9, 99, graphs=3) - layout.held(9) == 3 * (layout.step(9, 99) - layout.held(9))
    tight = planned(needed)
    assert tight["graph_refused"] and layout.graphs == 0 and not tight["chunked"]
    assert "without a CUDA graph" in plan_summary(tight) and planned(needed - 2**20)["chunked"]
    open_end = planned(None, most=10**6, available=2**29)
    assert "set --memory-limit" in plan_summary(open_end) and open_end["lowered_from"] is None


@pytest.mark.cuda
@pytest.mark.parametrize("captured", [True, False])
def test_limit_holds_on_cuda(captured):
    """What torch's allocator counted at its peak lies below the limit, in chunks and in captured steps."""
    device = torch.device("cuda", 0)
    views = photos(4, 160, 120)
    config = dataclasses.replace(STEADY, steps=60, density=DensityConfig(start=10, every=10, gradient=2e-5), max_gaussians=4000)
    free = Trainer(views, seeds(1200), dataclasses.replace(config, cuda_graph=captured), device)
    most = 4 * free.memory["planned_at_cap"] if captured else free.layout.smallest(1500)
    del free
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated(device)
    fit = Trainer(views, seeds(1200), dataclasses.replace(config, cuda_graph=captured, memory_limit=most), device)
    assert bool(fit.layout.graphs) == captured
    torch.cuda.reset_peak_memory_stats(device)
    while fit.step < 60:
        fit.advance(100)
    assert torch.cuda.max_memory_allocated(device) - before <= most


# A step that runs out of memory is tried once more with less, and what cannot go on is saved.

CUDA = torch.device("cuda", 0)


def no_memory(*_, **__):
    raise RuntimeError("[enforce fail at alloc_cpu.cpp:124] DefaultCPUAllocator: can't allocate memory: 1 bytes")


def failing(monkeypatch, owner, name: str, calls: set[int]):
    """Have some calls of a function, counted from 1, find no memory."""
    honest, count = getattr(owner, name), []

    def scarce(*arguments, **keywords):
        count.append(1)
        return no_memory() if len(count) in calls else honest(*arguments, **keywords)

    monkeypatch.setattr(owner, name, scarce)


def saved(fit: Trainer) -> tuple[dict, dict]:
    tensors, plain = fit.state()
    return {n: t.to("cpu", copy=True) for n, t in tensors.items()}, copy.deepcopy(plain)


def finished(fit: Trainer, states: list) -> list[int]:
    seen = []

    def on_step(report):
        seen.append(report.step)
        if report.step % 10 == 0:
            states.append(saved(fit))

    def restore(_):
        if not states:
            return False
        fit.load(*states[-1])
        return True

    run(fit, on_step, lambda f: states.append(saved(f)), lambda: False, restore)
    return seen


def test_a_step_is_tried_again_and_nothing_else_changes(monkeypatch):
    """The same bits as without the lack; it is said once for each."""
    reference = fitted(BUSY, 60)
    fit = fitted(BUSY, 0)
    failing(monkeypatch, StepTaker, "step", {3, 30})
    assert finished(fit, []) == list(range(1, 61))
    assert same_bits(fit, reference)
    assert len(fit.messages) == 2 and "step 3 ran out of memory" in fit.messages[0]


def test_a_step_that_fails_twice_ends_the_fit_and_is_saved(monkeypatch):
    """The state saved is that before the step, with its view still to come; a fit that continues from it is the same."""
    reference, fit, states = fitted(BUSY, 60), fitted(BUSY, 0), []
    failing(monkeypatch, StepTaker, "step", {26, 27})
    with pytest.raises(OutOfMemoryError, match=r"step 26 .*--memory-limit.*--downscale.*--resume") as found:
        finished(fit, states)
    assert found.value.exit_code == 4 and states[-1][1]["step"] == 25
    again = fitted(BUSY, 0)
    again.load(*states[-1])
    finished(again, [])
    assert same_bits(again, reference)


def test_where_not_even_the_smallest_step_fits_the_state_is_saved(monkeypatch):
    """Nothing is free when the step is to be tried again."""
    fit, states = fitted(BUSY, 0), []
    failing(monkeypatch, StepTaker, "step", {26})
    monkeypatch.setattr(trainer_module, "available_bytes", lambda _: 0)
    with pytest.raises(ResourceError, match="smallest step needs") as found:
        finished(fit, states)
    assert found.value.exit_code == 4 and states[-1][1]["step"] == 25


@pytest.mark.parametrize(("calls", "ends"), [({2}, False), ({2, 3}, True)])
def test_a_change_of_the_set_starts_from_the_last_saved_state(monkeypatch, calls, ends):
    """Half a change is nothing to go on from: steps since the last save are taken again; a second lack there ends the fit."""
    reference, fit, states = fitted(BUSY, 60), fitted(BUSY, 0), []
    failing(monkeypatch, fit.table, "apply", calls)
    if ends:
        with pytest.raises(OutOfMemoryError) as found:
            finished(fit, states)
        assert not found.value.intact
        return
    seen = finished(fit, states)
    assert set(seen) == set(range(1, 61)) and len(seen) >= 60
    assert same_bits(fit, reference)


def test_a_change_with_nothing_saved_before_ends_the_fit_and_other_errors_pass(monkeypatch):
    fit = fitted(BUSY, 0)
    failing(monkeypatch, fit.table, "apply", {1})
    with pytest.raises(OutOfMemoryError):
        run(fit, lambda _: None, lambda _: None, lambda: False)

    def broken(*_):
        raise RuntimeError("something else")

    monkeypatch.setattr(StepTaker, "step", broken)
    with pytest.raises(RuntimeError, match="something else"):
        finished(fitted(BUSY, 0), [])


class OtherProgram:
    """A program that takes memory of the device and gives it back, as this process sees it: torch is limited to the rest."""

    def __init__(self, monkeypatch):
        self.held, self.free, self.limit = [], torch.cuda.mem_get_info, 0
        self.total = torch.cuda.get_device_properties(CUDA).total_memory
        monkeypatch.setattr(torch.cuda, "mem_get_info", self.left)

    def left(self, device):
        if not self.limit:
            return self.free(device)
        return max(0, self.limit - torch.cuda.memory_reserved(device)), self.total

    def take_all_but(self, mib: int):
        """Leave so many MiB free, beside what torch holds."""
        torch.cuda.empty_cache()
        self.limit = torch.cuda.memory_reserved(CUDA) + mib * 2**20
        torch.cuda.set_per_process_memory_fraction(self.limit / self.total, CUDA)

    def take_what_torch_holds(self):
        """Take what torch keeps for later, too: some of it lies in pieces that it cannot give back."""
        for mib in (64, 8, 1):
            with contextlib.suppress(torch.OutOfMemoryError):
                while True:
                    self.held.append(torch.empty(mib * 2**20, dtype=torch.uint8, device=CUDA))

    def give_back(self):
        self.held, self.limit = [], 0
        torch.cuda.set_per_process_memory_fraction(1.0, CUDA)


@pytest.fixture
def other(monkeypatch):
    program = OtherProgram(monkeypatch)
    yield program
    program.give_back()


@pytest.mark.cuda
def test_a_full_device_is_noticed_and_the_fit_goes_on(other):
    """Steps go on in chunks, one by one, and end as they should."""
    fit, states = Trainer(photos(4, 1600, 1200), seeds(), BUSY, CUDA), []
    fit.advance()
    other.take_all_but(300)
    seen = finished(fit, states)
    assert seen == list(range(2, 61))
    assert any("ran out of memory" in m for m in fit.messages), fit.messages
    assert all(bool(torch.isfinite(t).all()) for t in fit.gaussians.tensors().values())


@pytest.mark.cuda
def test_a_device_without_memory_ends_the_fit_which_goes_on_later(other):
    """Class 4 with the state saved; once the other program has ended, a fit continued from it comes to its end."""
    fit, states = Trainer(photos(4, 1600, 1200), seeds(), BUSY, CUDA), []
    states.append(saved(fit))
    other.take_all_but(2)
    other.take_what_torch_holds()
    with pytest.raises(ResourceError) as found:
        finished(fit, states)
    assert found.value.exit_code == 4
    other.give_back()
    again = Trainer(photos(4, 1600, 1200), seeds(), BUSY, CUDA)
    again.load(*states[-1])
    finished(again, [])
    assert all(bool(torch.isfinite(t).all()) for t in again.gaussians.tensors().values())


@pytest.mark.cuda
def test_2000_steps_beside_a_program_that_comes_and_goes(other):
    density = dataclasses.replace(BUSY.density, every=25, stop_fraction=0.9)
    config = dataclasses.replace(BUSY, steps=2000, density=density, max_gaussians=30_000)
    random, states, seen, ended, said = np.random.default_rng(0), [], set(), 0, []

    def on_step(report):
        seen.add(report.step)
        if report.step % 50 == 0:
            states[:] = [saved(fit)]
            other.give_back()
            if report.step % 100 == 50:
                other.take_all_but(int(2 ** random.uniform(3, 10)))

    def restore(_):
        fit.load(*states[-1])
        return True

    fit = Trainer(photos(4, 1200, 900), seeds(), config, CUDA)
    states.append(saved(fit))
    while fit.step < config.steps:
        try:
            run(fit, on_step, lambda f: states.append(saved(f)), lambda: False, restore)
        except ResourceError as e:
            assert e.exit_code == 4
            ended += 1
            other.give_back()
            said += fit.messages
            fit = Trainer(photos(4, 1200, 900), seeds(), config, CUDA)  # as --resume does
            fit.load(*states[-1])
    said += fit.messages
    print(f"ended {ended} times with class 4, went on {len(said)} times")
    assert ended + len(said) > 0
    assert seen == set(range(1, 2001))
    assert all(bool(torch.isfinite(t).all()) for t in fit.gaussians.tensors().values())
