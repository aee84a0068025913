"""The loop: repeatable, resumable, honest when something is wrong, and warmed up without a trace."""

import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import torch

import warpgs
from tests.pipeline.train.fits import advanced
from tests.scenes import photos, priors, seeds
from warpgs.clock import Clock, timed
from warpgs.errors import DataError, NotFiniteError, UsageError
from warpgs.geometry import look_at
from warpgs.kernels.neighbours import morton_codes
from warpgs.pipeline.metrics.scores import counted_region
from warpgs.pipeline.model import start
from warpgs.pipeline.model.start import InitConfig, empty_votes, initial_gaussians, initial_points, nearest, random_points
from warpgs.pipeline.model.table import Table
from warpgs.pipeline.paper.strategy import UNIFORM
from warpgs.pipeline.run.fit import non_finite_parts
from warpgs.pipeline.run.folder import TENSORS, load_checkpoint, save_checkpoint
from warpgs.pipeline.train import setup, trainer as warmups
from warpgs.pipeline.train.loss import LossTerm, photometric_loss, register
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import OptimizerConfig, log_linear, sh_degree
from warpgs.pipeline.train.settings import FitConfig, settings_by_views
from warpgs.pipeline.train.setup import prepare
from warpgs.pipeline.train.strategies import clone_split
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.sampling import Sampling
from warpgs.pipeline.train.trainer import POINTS, STEPS, Trainer, background_warmup, run, warm_up
from warpgs.pipeline.train.view_modules import Exposure, RefinePoses
from warpgs.priors.views import PriorConfig
from warpgs.scene import Camera, PointCloud, Scene, View, ViewDepth
from warpgs.synthetic.demo import split_spec, write_demo

# The loop: repeatable, resumable, and honest when something is wrong.

CPU = torch.device("cpu")
BUSY = FitConfig(
    steps=60,
    sh_every=15,
    init=InitConfig(source="points"),
    density=DensityConfig(start=10, every=10, reset_every=20),
    optimizer=OptimizerConfig(opacities_decay=0.002),
)


def fitted(config: FitConfig, steps: int, background=(0.0, 0.0, 0.0)) -> Trainer:
    return advanced(Trainer(photos(4), seeds(), config, CPU, background), steps)


def test_random_points_stand_on_an_object_on_black():
    """A bright ball's silhouette in four views: points start inside its visual hull, not in the black before it."""
    views = []
    for angle in np.linspace(0, 2 * np.pi, 5)[:4]:
        center = 4 * np.array([np.sin(angle), 0, -np.cos(angle)])
        camera = Camera(
            look_at(center, np.zeros(3), np.array([0, -1.0, 0])), np.array([[60.0, 0, 20], [0, 60, 20], [0, 0, 1]]), 40, 40
        )
        y, x = np.mgrid[:40, :40] + 0.5
        ball = (x - 20) ** 2 + (y - 20) ** 2 < 6**2
        views.append(View(f"{angle:.1f}", camera, np.where(ball[..., None], 0.8, 0).astype(np.float32).repeat(3, 2)))
    regions = [counted_region(v) for v in views]
    assert empty_votes(views, regions, np.array([[0.0, 0, 0], [1.2, 0, 0], [0, 1.2, 0]])).tolist() == [0, 2, 4]
    cloud, how = random_points(views, 400, np.random.default_rng(0))
    assert "on the object (4 views show it on black)" in how
    assert len(cloud) == 400 and (cloud.colors == np.float32(0.8)).all()
    # without votes, one point in six stands before some view's black
    assert (empty_votes(views, regions, cloud.points) == 0).all()


def test_same_seed_same_bits_and_threads_do_not_matter():
    """Two fits with one seed agree bit for bit, also for another number of threads; another seed does not."""
    torch.set_num_threads(1)
    first = fitted(BUSY, 40).state()[0]
    torch.set_num_threads(2)
    again = fitted(BUSY, 40).state()[0]
    other = fitted(FitConfig(**{**vars(BUSY), "seed": 1}), 40).state()[0]
    assert first.keys() == again.keys() and all(torch.equal(first[k], again[k]) for k in first)
    assert not torch.equal(first["params.means"][:10], other["params.means"][:10])


def test_order_of_the_gaussians_changes_nothing_but_their_order(monkeypatch):
    """Sorted along the curve at each event or not: the same rows with their moments, bit for bit, as long as none splits."""
    results = []
    for morton in (True, False):
        density = DensityConfig(start=5, every=10, gradient=1e-5)
        monkeypatch.setattr(clone_split, "CLONE_SIZE", 1e9)
        if not morton:
            monkeypatch.setattr(Table, "sort_along_curve", lambda table: None)
        fit = fitted(FitConfig(steps=60, sh_every=15, init=InitConfig(source="points"), density=density), 30)
        assert bool((morton_codes(fit.gaussians.means).diff() >= 0).all()) == morton
        tensors = [t.flatten(1) if t.ndim > 1 else t[:, None] for t in fit.table.state().values()]
        results.append(sorted(map(tuple, torch.cat(tensors, 1).tolist())))
    assert len(results[0]) > 2 * len(seeds()) and results[0] == results[1]


def test_losses_views_and_schedules():
    """L1 alone is the mean difference; equal images have loss 0, and so has a masked view, without a gradient."""
    a, b = torch.full((12, 12, 3), 0.75), torch.full((12, 12, 3), 0.5)
    assert abs(float(photometric_loss(a, b, None, 0.0)) - 0.25) < 1e-7
    assert abs(float(photometric_loss(a, a, None))) < 1e-7
    image = torch.rand(9, 8, 3, requires_grad=True)
    loss = photometric_loss(image, torch.rand(9, 8, 3), torch.zeros(9, 8))
    loss.backward()
    assert float(loss.detach()) == 0 and not bool(image.grad.any())
    # views are drawn like cards
    fit = fitted(FitConfig(steps=9, init=InitConfig(source="points")), 0)
    drawn = [fit.next_view() for _ in range(12)]
    assert all(sorted(drawn[i : i + 4]) == [0, 1, 2, 3] for i in (0, 4, 8))
    # ends and middle of the log-linear decay; degrees rise one at a time
    assert log_linear(1e-2, 1e-4, 0) == pytest.approx(1e-2) and log_linear(1e-2, 1e-4, 1) == pytest.approx(1e-4)
    assert log_linear(1e-2, 1e-4, 0.5) == pytest.approx(1e-3)
    assert [sh_degree(s, 10, 2) for s in (1, 10, 11, 21, 500)] == [0, 0, 1, 2, 2]


def test_first_gaussians_and_nearest_points():
    """Width from the three nearest, colour from the point, coincident points with a floor, a lone one with a ceiling."""
    # against a search tree, over more pairs than are held at a time, the nearest first
    from scipy.spatial import cKDTree

    generator = np.random.default_rng(0)
    points, queries = generator.uniform(0, 500, (700, 2)), generator.uniform(0, 500, (3000, 2))
    assert np.array_equal(nearest(points, queries, 5), cKDTree(points).query(queries, k=5)[1])
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 2], [50, 50, 50]], float)
    cloud = PointCloud(points, np.full((5, 3), 0.8, np.float32))
    g = initial_gaussians(cloud, InitConfig(opacity=0.1), 3, extent=100.0, device=CPU)
    assert float(g.log_scales[0, 0].exp()) == pytest.approx(math.sqrt((1 + 4 + 4) / 3), rel=1e-5)
    assert float(g.log_scales[4].exp().max()) == pytest.approx(10.0)
    assert torch.allclose(g.sh[:, 0] * 0.28209479177387814 + 0.5, torch.tensor(0.8)) and not bool(g.sh[:, 1:].any())
    assert torch.allclose(g.logit_opacities.sigmoid(), torch.tensor(0.1))
    same = initial_gaussians(PointCloud(np.zeros((4, 3)), np.zeros((4, 3), np.float32)), InitConfig(), 3, 1.0, CPU)
    assert torch.allclose(same.log_scales.exp(), torch.tensor(1e-6))


def test_start_falls_back_to_random_and_says_so():
    """Too few points: a random start inside what the cameras see, named; asked for points: an error with a way out."""
    views = photos(4)
    few = PointCloud(np.zeros((3, 3)), np.zeros((3, 3), np.float32))
    cloud, how, *_ = initial_points(views, few, InitConfig(random_count=500), np.random.default_rng(0))
    assert len(cloud) == 500 and "500 random points" in how and "only 3 points" in how
    again, *_ = initial_points(views, few, InitConfig(random_count=500), np.random.default_rng(0))
    assert np.array_equal(cloud.points, again.points)
    with pytest.raises(DataError, match=r"--init.source random"):
        initial_points(views, None, InitConfig(source="points"), np.random.default_rng(0))


def test_a_start_of_more_points_than_allowed_is_drawn_from():
    """Some of the points, each once and the same every time, said so; wider, for they lie farther apart; and no more later."""
    most = len(seeds()) // 4
    config = dataclasses.replace(BUSY, density=dataclasses.replace(BUSY.density, gradient=1e-6), max_gaussians=most)
    whole, fit = fitted(BUSY, 0), fitted(config, 0)
    kept = (whole.gaussians.means[None] == fit.gaussians.means[:, None]).all(2)
    assert len(fit.gaussians) == most and bool((kept.sum(1) == 1).all()) and bool((kept.sum(0) <= 1).all())
    assert torch.equal(fitted(config, 0).gaussians.means, fit.gaussians.means)
    assert float(fit.gaussians.log_scales.mean()) > float(whole.gaussians.log_scales.mean()) + 0.1
    assert any(f"{most} of these {len(seeds())} points" in n and "--max-gaussians" in n for n in fit.notes)
    assert not any("max-gaussians" in n for n in whole.notes)
    assert len(fitted(config, 25).gaussians) <= most


def test_config_survives_json_and_every_preset_is_described():
    """What a run folder stores gives the same configuration back; an unknown field is refused."""
    stored = json.loads(json.dumps(BUSY.to_json()))
    assert FitConfig.from_json(stored) == BUSY and FitConfig.from_json(stored).fingerprint() == BUSY.fingerprint()
    with pytest.raises(UsageError, match="another version"):
        FitConfig.from_json({**stored, "bogus": 1})
    earlier = {**stored, "loss": stored["loss"] | {"exposure_weight": 0.01}}  # a setting without effect, since removed
    assert FitConfig.from_json(earlier) == BUSY
    assert all(isinstance(p, FitConfig) and p.preset == name for name, p in PRESETS.items())
    # by a line about it, which the help shows, and in the table of docs/presets.md
    assert all(PRESETS.described().values())
    table = (Path(__file__).parents[3] / "docs" / "presets.md").read_text("utf-8")
    rows = " ".join(line.split("|")[1] for line in table.splitlines() if line.startswith("| `"))
    for name in PRESETS:
        assert f"`{name}`" in rows, name


def test_checkpoint_that_is_not_whole_is_refused(tmp_path):
    """Truncated or altered anywhere, the file is named and nothing is loaded; a missing one says what to do."""
    with pytest.raises(DataError, match="warpgs fit"):
        load_checkpoint(tmp_path)
    path = save_checkpoint(tmp_path, {"a": torch.arange(50.0)}, {"step": 3})
    tensors, state = load_checkpoint(tmp_path)
    assert torch.equal(tensors["a"], torch.arange(50.0)) and state == {"step": 3}
    save_checkpoint(tmp_path, {"b": torch.zeros(0, 3), "c": torch.tensor(7), "d": torch.arange(3, dtype=torch.uint8)}, {})
    odd = load_checkpoint(tmp_path)[0]
    assert (
        odd["b"].shape == (0, 3) and odd["c"].item() == 7 and odd["c"].dtype == torch.int64 and odd["d"].tolist() == [0, 1, 2]
    )
    path = save_checkpoint(tmp_path, {"a": torch.arange(50.0)}, {"step": 3})
    whole = path.read_bytes()
    for broken in (whole[:-1], whole[:40], b"", whole[:100] + bytes([whole[100] ^ 1]) + whole[101:]):
        path.write_bytes(broken)
        with pytest.raises(DataError, match="checksum"):
            load_checkpoint(tmp_path)
    assert path.name == TENSORS


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals between processes")
def test_interrupted_fit_saves_the_step_in_progress(tmp_path, heeding):
    """Ctrl-C ends with exit code 130 and a checkpoint of the last whole step, from which --resume goes on."""
    write_demo(tmp_path / "scene", views=8, width=48, height=36)
    command = [
        *heeding, "fit", str(tmp_path / "scene"), "--split", split_spec(8), "--steps", "100000",
        "--device", "cpu", "--out", str(tmp_path / "run"), "--preset", "3dgs", "--init.source", "random",
        "--init.random-count", "60",
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for line in process.stdout:
        if line.startswith("fitting"):
            break
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and "--resume" in errors and "Traceback" not in errors
    _, state = load_checkpoint(tmp_path / "run")
    steps = [json.loads(x)["step"] for x in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert state["step"] == steps[-1] >= 1


@pytest.mark.fault
def test_resume_after_kill_gives_the_same_ply(tmp_path):
    """SIGKILL in the middle, --resume, and the PLY equals that of a run left alone, byte for byte."""
    write_demo(tmp_path / "scene", views=8, width=64, height=48)
    flags = [
        str(tmp_path / "scene"), "--split", split_spec(8), "--steps", "60", "--device", "cpu",
        "--checkpoint-every", "10",
        "--density.start", "10", "--density.every", "10",
    ]  # fmt: skip
    # stands still after the first checkpoint, says so, and waits for the end
    stand_still = (
        "import sys\nfrom warpgs.app.cli import main\nfrom warpgs.pipeline.run import folder\n"
        "def save(*a, **k):\n    made(*a, **k)\n    print('saved', flush=True)\n    sys.stdin.read()\n"
        "made = folder.save_checkpoint\nfolder.save_checkpoint = save\nsys.exit(main(sys.argv[1:]))"
    )

    def command(out: str, *more: str) -> list[str]:
        return [sys.executable, "-m", "warpgs", "fit", *flags, "--out", str(tmp_path / out), *more]

    subprocess.run(command("whole"), check=True, capture_output=True)
    waiting = [sys.executable, "-c", stand_still, *command("killed")[3:]]
    with subprocess.Popen(waiting, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert "saved\n" in iter(process.stdout.readline, "")
        process.kill()
    assert (tmp_path / "killed" / TENSORS).is_file() and not (tmp_path / "killed" / "point_cloud.ply").exists()
    subprocess.run(command("killed", "--resume"), check=True, capture_output=True)
    plys = [(tmp_path / run / "point_cloud.ply").read_bytes() for run in ("whole", "killed")]
    assert plys[0] == plys[1]
    logs = [
        [json.loads(x)["step"] for x in (tmp_path / r / "metrics.jsonl").read_text().splitlines()] for r in ("whole", "killed")
    ]
    assert logs[0] == logs[1] == list(range(1, len(logs[0]) + 1)) and len(logs[0]) > 20  # it may end before its 60 steps


# A loss that is not finite: the state before it is kept, and the error names step, view, term and tensors.


@register("nan_later")
@dataclasses.dataclass(frozen=True)
class NanLater(LossTerm):
    """A term on depth that is no number from some step on, by the number on the device."""

    needs_outputs = ("depth",)
    first: int = 15

    def __call__(self, inputs):
        return inputs.outputs["depth"].mean() * torch.where(inputs.step < self.first, 0.0, float("nan"))


def test_the_state_before_is_kept_and_the_error_names_the_term(tmp_path):
    """Checkpoint of the step before, the same end where the run is continued, and the same words without a folder."""
    views = tuple(photos(5))
    scene = Scene("", "made", views, seeds(), fingerprint="x", pixels="as made")
    config = dataclasses.replace(BUSY, loss_terms=(NanLater(),), half_resolution=0.5, dropout=0.1)
    split = f"train={','.join(v.name for v in views[:4])};test={views[4].name}"
    run = {"split": split, "device": "cpu", "verbose": False}
    told = r"nan at step 15, on .*\.png, in the loss term nan_later; all of its inputs and renders are finite\."
    with pytest.raises(NotFiniteError, match=told + r" .* saved in .*--resume would fail .* correct nan_later") as found:
        warpgs.fit(scene, config, out=tmp_path / "run", **run)
    assert load_checkpoint(tmp_path / "run")[1]["step"] == 14
    assert not list((tmp_path / "run").glob("not_finite*"))
    with pytest.raises(NotFiniteError) as again:
        warpgs.fit(scene, config, out=tmp_path / "run", resume=True, **run)
    assert str(again.value) == str(found.value)
    with pytest.raises(NotFiniteError, match=told + r" To fix it, correct nan_later, and fit again into a new --out$"):
        warpgs.fit(scene, config, **run)


@pytest.mark.parametrize("learned", [False, True], ids=["", "with poses and exposures"])
def test_tensors_that_are_not_finite_are_counted(learned):
    """Nothing in a sound step; then a NaN in the image of one view alone, and one in a parameter."""
    modules = (RefinePoses(rotation_lr=0.01), Exposure(lr=0.05)) if learned else ()
    fit = Trainer(photos(4), seeds(), dataclasses.replace(BUSY, dropout=0.3, view_modules=modules), CPU)
    for _ in range(3):
        fit.advance()
    before = fit.state()[0]
    assert non_finite_parts(fit, 1, 0) == ([], [])
    kind, row = fit.places[1 + fit.plan_of(4).half_size * len(fit.views)]
    image = fit.stacks[kind].images[row]
    image[:2, :3] = torch.nan
    terms, tensors = non_finite_parts(fit, 1, 0)
    assert terms == ["the loss term photometric"] and tensors == [f"image (18 of {image.numel():,} values)"]
    assert non_finite_parts(fit, 2, 0) == ([], [])
    assert all(torch.equal(t, before[n]) for n, t in fit.state()[0].items())
    if learned:
        fit.learned.table.params["exposure_affine"].data[2] = torch.nan
        terms, tensors = non_finite_parts(fit, 2, 0)
        assert "the loss term photometric" in terms and "the view module exposure" in terms
        assert {t.split(" (")[0] for t in tensors} == {"views.exposure_affine", "rendered rgb"}


# A warmup uses what a fit of the same settings uses, says what goes wrong, and leaves no trace in the fit.

WARMUP_CPU, CUDA = torch.device("cpu"), torch.device("cuda")
CHOSEN = {name: settings_by_views(config, photos(3), "cpu")[0] for name, config in PRESETS.items()}
"""Presets with every setting chosen, as a fit has them."""


@pytest.mark.parametrize("preset", PRESETS)
def test_every_part_of_a_fit_is_used(preset, monkeypatch):
    scored, config = [], CHOSEN[preset]
    score = warmups.score
    monkeypatch.setattr(warmups, "score", lambda view, image: scored.append(score(view, image)))
    fit = warm_up(config, WARMUP_CPU)
    assert fit.step == STEPS and len(fit.gaussians) > POINTS
    assert isinstance(fit.strategy, Sampling) == (preset in ("default", "quick", "paper-literal"))
    assert not isinstance(fit.strategy, Sampling) or len(fit.strategy.events) == 1
    assert len(scored) == 1 and 0 < scored[0].psnr < 30 and not fit.taker._graphs


def test_limits_of_the_real_fit_do_not_stop_it():
    """A memory limit is for the real fit alone; a bound on Gaussians holds; a warmup that nobody waits for ends."""
    fit = warm_up(dataclasses.replace(CHOSEN["quick"], memory_limit=1, half_resolution=0.5, max_gaussians=50), WARMUP_CPU)
    assert fit.step == STEPS and len(fit.gaussians) <= 50
    with pytest.raises(KeyboardInterrupt):
        warm_up(CHOSEN["quick"], WARMUP_CPU, lambda: True)


def test_only_a_free_gpu_is_warmed_up(monkeypatch):
    monkeypatch.setattr(warmups, "warm_up", lambda *_: pytest.fail("begun"))
    networks = dataclasses.replace(PRESETS["default"].priors, onnx_provider="cuda")
    for config, device in ((PRESETS["default"], WARMUP_CPU), (dataclasses.replace(PRESETS["default"], priors=networks), CUDA)):
        with background_warmup(config, device) as ready:
            assert ready() is None


def test_what_goes_wrong_is_raised_and_nothing_goes_on_after_the_block(monkeypatch):
    def fail(*_):
        raise RuntimeError("out of order")

    monkeypatch.setattr(warmups, "warm_up", fail)
    monkeypatch.setattr(torch.cuda, "device", lambda _: torch.no_grad())  # there may be none here
    with background_warmup(PRESETS["default"], CUDA) as ready, pytest.raises(RuntimeError, match="out of order"):
        ready()
    # an error in the block, such as a scene with nothing to start from, ends the warmup after the step it is in
    began, ended = threading.Event(), []

    def endless(config, device, stopped):
        began.set()
        while not stopped():
            pass
        ended.append(threading.current_thread())

    monkeypatch.setattr(warmups, "warm_up", endless)
    with pytest.raises(DataError), background_warmup(PRESETS["default"], CUDA):
        began.wait()
        raise DataError("nothing to start from")
    assert len(ended) == 1 and not ended[0].is_alive()


@pytest.mark.parametrize("changes", [{}, {"memory_limit": 10**9}, {"init": InitConfig(source="random")}])
def test_the_device_is_asked_for_last(changes, monkeypatch):
    """Semantics are found before `ready` is called, and a sweep comes after it, on the device or, under a limit, on the CPU."""
    order = []
    views = photos(3)
    monkeypatch.setattr(setup, "view_priors", lambda *a, depths, **k: (order.append("semantics"), depths(), ([], []))[-1])
    monkeypatch.setattr(start, "sweep_depths", lambda v, b, device, progress: (order.append(str(device)), consistent(v))[1])
    config = dataclasses.replace(PRESETS["default"], strategy="paper", strategy_config=None, **changes)
    _, begun, *_ = prepare(views, None, config, CUDA, None, lambda: order.append("ready"))
    swept = ["ready", "cpu" if "memory_limit" in changes else "cuda"] if "init" not in changes else []
    assert order == ["semantics", *swept, "ready"] and len(begun.cloud) > 100


@pytest.mark.parametrize(
    ("setting", "needed"),
    [
        ({}, False), ({"s_render": True}, False), ({"s_semantic": True}, True), ({"s_geometry": True}, True),
        ({"gate_quantile": 0.6}, True), ({"gate_quantile": 0.6, "ra": False}, False),
    ],
)  # fmt: skip
def test_priors_are_made_where_an_event_reads_them(setting, needed, monkeypatch):
    """Not for uniform sampling; a network that is named all the same gets a note."""
    asked = []
    monkeypatch.setattr(setup, "view_priors", lambda *a, **k: (asked.append(1), ([], []))[-1])
    base = PRESETS["default"]
    own = {"strategy": "paper", "strategy_config": dataclasses.replace(UNIFORM, **setting)} if setting else {}
    priors = PriorConfig(segmentation_model="labels.onnx")
    config = dataclasses.replace(base, **own, init=InitConfig(source="random"), priors=priors)
    *_, notes = prepare(photos(2), None, config, WARMUP_CPU, None, lambda: None)
    assert bool(asked) == needed
    assert any("--segmentation-model is not used" in note for note in notes) != needed


def consistent(views):
    size = views[0].image.shape[:2]
    return [ViewDepth(np.full(size, 3.0, np.float32), np.ones(size, bool), np.ones(size, np.float32)) for _ in views]


def test_missing_points_and_views_are_said_before_anything_takes_time(monkeypatch):
    """Before networks run and before the device is waited for."""
    monkeypatch.setattr(setup, "view_priors", lambda *a, **k: pytest.fail("begun"))
    config = dataclasses.replace(PRESETS["default"], init=InitConfig(source="points"))
    with pytest.raises(DataError, match="needs 3D points"):
        prepare(photos(2), None, config, WARMUP_CPU, None, lambda: pytest.fail("asked"))


@pytest.mark.parametrize("preset", ["default", "3dgs"])
def test_only_fits_that_sweep_warm_up_a_sweep(preset, monkeypatch):
    """And none under a memory limit, which leaves the sweep to the CPU."""
    swept = []
    monkeypatch.setattr(warmups, "sweep_depths", lambda views, *_, **__: swept.append(len(views)))
    warm_up(CHOSEN[preset], WARMUP_CPU)
    warm_up(dataclasses.replace(CHOSEN[preset], memory_limit=10**9), WARMUP_CPU)
    assert swept == ([2] if preset == "default" else [])


@pytest.mark.cuda
def test_a_fit_is_the_same_after_a_background_warmup():
    """Bit for bit that of a fit without one."""
    device, views = torch.device("cuda"), photos(3)
    config = dataclasses.replace(CHOSEN["quick"], steps=20)
    fits = []
    for warmed_up in (False, True):
        with background_warmup(config, device if warmed_up else WARMUP_CPU) as ready:
            fit = Trainer(views, seeds(), config, device, priors=priors(views), ready=ready)
        run(fit, lambda _: None, lambda _: None, lambda: False)
        fits.append(fit.gaussians.tensors())
    assert all(torch.equal(fits[0][n], fits[1][n]) for n in fits[0])


def test_reports_of_steps_count_as_their_time():
    now, views = [0.0], photos(2)
    fit = Trainer(views, seeds(), dataclasses.replace(CHOSEN["quick"], steps=6), WARMUP_CPU, priors=priors(views))

    def on_step(_) -> None:
        now[0] += 1

    with timed(Clock(now=lambda: now[0])) as clock:
        run(fit, on_step, lambda _: None, lambda: False)
    times = clock.seconds()
    assert times["other"] == 0 and sum(s for name, s in times.items() if name.startswith("steps (phase ")) == 6
