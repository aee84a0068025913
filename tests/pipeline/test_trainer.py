"""The loop: repeatable, resumable, and honest when something is wrong."""

import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.scenes import photos, seeds
from warpgs.errors import DataError, NotFiniteError, UsageError
from warpgs.geometry import look_at
from warpgs.kernels.neighbours import morton_codes
from warpgs.pipeline.metrics.scores import counted_region
from warpgs.pipeline.model.start import InitConfig, empty_votes, initial_gaussians, initial_points, nearest, random_points
from warpgs.pipeline.model.table import Table
from warpgs.pipeline.run.folder import TENSORS, load_checkpoint, save_checkpoint
from warpgs.pipeline.train.loss import photometric_loss
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import OptimizerConfig, log_linear, sh_degree
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies import clone_split
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.scene import Camera, PointCloud, View
from warpgs.synthetic.demo import split_spec, write_demo

CPU = torch.device("cpu")
BUSY = FitConfig(
    steps=60,
    sh_every=15,
    init=InitConfig(source="points"),
    density=DensityConfig(start=10, every=10, reset_every=20),
    optimizer=OptimizerConfig(opacities_decay=0.002),
)


def fitted(config: FitConfig, steps: int, background=(0.0, 0.0, 0.0)) -> Trainer:
    fit = Trainer(photos(4), seeds(), config, CPU, background)
    for _ in range(steps):
        fit.advance()
    return fit


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


def test_nearest_points():
    """Against a search tree, over more pairs than are held at a time, the nearest first."""
    from scipy.spatial import cKDTree

    generator = np.random.default_rng(0)
    points, queries = generator.uniform(0, 500, (700, 2)), generator.uniform(0, 500, (3000, 2))
    assert np.array_equal(nearest(points, queries, 5), cKDTree(points).query(queries, k=5)[1])


def test_same_seed_same_bits_and_threads_do_not_matter():
    """Two fits with one seed agree bit for bit, also for another number of threads; another seed does not."""
    torch.set_num_threads(1)
    first = fitted(BUSY, 40).state()[0]
    torch.set_num_threads(2)
    again = fitted(BUSY, 40).state()[0]
    other = fitted(FitConfig(**{**vars(BUSY), "seed": 1}), 40).state()[0]
    assert first.keys() == again.keys() and all(torch.equal(first[k], again[k]) for k in first)
    assert not torch.equal(first["params.means"][:10], other["params.means"][:10])


def test_continued_fit_equals_uninterrupted_one(tmp_path):
    """Saved in the middle of densification, loaded elsewhere, continued: the same bits at the end."""
    straight = fitted(BUSY, 60)
    broken = fitted(BUSY, 27)
    save_checkpoint(tmp_path, *broken.state())
    resumed = Trainer(photos(4), seeds(), BUSY, CPU)
    resumed.load(*load_checkpoint(tmp_path))
    for _ in range(33):
        resumed.advance()
    a, b = straight.state()[0], resumed.state()[0]
    assert len(straight.gaussians) != len(seeds())
    assert all(torch.equal(a[k], b[k]) for k in a)


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


def test_all_that_goes_by_row_is_sorted_together():
    """Parameters, moments and columns of a Gaussian stay together."""
    fit = fitted(FitConfig(steps=9, init=InitConfig(source="points"), strategy="sampling"), 3)
    table = fit.table
    table.columns["created_step"] = torch.arange(len(fit.gaussians), dtype=torch.int32)
    before = {name: t.clone() for name, t in table.state().items()}
    table.sort_along_curve()
    rows = table.columns["created_step"].long()
    assert not bool((rows.diff() > 0).all()) and bool((rows.sort().values.diff() == 1).all())
    assert all(torch.equal(t, before[name][rows]) for name, t in table.state().items()) and len(before) == 15 + 4
    assert all(t.requires_grad and t.is_leaf for t in table.params.values())


def test_masked_pixels_do_not_count():
    """What a mask hides may hold anything, even NaN-free nonsense, without changing the fit."""
    views = photos(2)
    mask = np.ones(views[0].image.shape[:2], bool)
    mask[:, :8] = False
    results = []
    for filling in (0.0, 1.0):
        changed = []
        for v in views:
            image = v.image.copy()
            image[~mask] = filling
            changed.append(View(v.name, v.camera, image, mask))
        fit = Trainer(changed, seeds(), FitConfig(steps=5, init=InitConfig(source="points")), CPU)
        reports = [r for _ in range(5) for r in fit.advance()]
        results.append((fit.gaussians.means, [r.psnr for r in reports]))
    assert torch.equal(results[0][0], results[1][0]) and results[0][1] == results[1][1]


def test_fully_masked_view_has_loss_zero():
    """No pixel counts: loss 0, gradient 0, no division by zero."""
    image = torch.rand(9, 8, 3, requires_grad=True)
    loss = photometric_loss(image, torch.rand(9, 8, 3), torch.zeros(9, 8))
    loss.backward()
    assert float(loss.detach()) == 0 and not bool(image.grad.any())


def test_loss_of_known_images():
    """L1 alone is the mean difference; equal images have loss 0."""
    a, b = torch.full((12, 12, 3), 0.75), torch.full((12, 12, 3), 0.5)
    assert abs(float(photometric_loss(a, b, None, 0.0)) - 0.25) < 1e-7
    assert abs(float(photometric_loss(a, a, None))) < 1e-7


def test_loss_that_is_no_number_stops_the_fit():
    """A NaN in a photograph is named, not trained on."""
    views = photos(2)
    bad = [View(v.name, v.camera, np.full_like(v.image, np.nan)) for v in views]
    fit = Trainer(bad, seeds(), FitConfig(steps=3, init=InitConfig(source="points")), CPU)
    before = fit.gaussians.means.clone()
    with pytest.raises(NotFiniteError, match="loss became nan at step 1"):
        fit.advance()
    assert torch.equal(fit.gaussians.means, before)


def test_every_view_comes_once_before_any_comes_again():
    """Views are drawn like cards."""
    fit = fitted(FitConfig(steps=9, init=InitConfig(source="points")), 0)
    drawn = [fit.next_view() for _ in range(12)]
    assert all(sorted(drawn[i : i + 4]) == [0, 1, 2, 3] for i in (0, 4, 8))


def test_schedules():
    """Ends and middle of the log-linear decay; degrees rise one at a time."""
    assert log_linear(1e-2, 1e-4, 0) == pytest.approx(1e-2) and log_linear(1e-2, 1e-4, 1) == pytest.approx(1e-4)
    assert log_linear(1e-2, 1e-4, 0.5) == pytest.approx(1e-3)
    assert [sh_degree(s, 10, 2) for s in (1, 10, 11, 21, 500)] == [0, 0, 1, 2, 2]


def test_first_gaussians():
    """Width from the three nearest, colour from the point, coincident points with a floor, a lone one with a ceiling."""
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


def test_points_of_other_views_are_not_used():
    """A track that only a held-out view belongs to must not seed the fit."""
    cloud = PointCloud(np.zeros((2, 3)), np.zeros((2, 3), np.float32), (frozenset({"00.png"}), frozenset({"09.png"})))
    assert len(cloud.seen_by({"00.png", "01.png"})) == 1


def test_no_training_view_is_an_error():
    """An empty list of views stops at once."""
    with pytest.raises(DataError, match="no training view"):
        Trainer([], seeds(), FitConfig(), CPU)


def test_config_survives_json():
    """What a run folder stores gives the same configuration back; an unknown field is refused."""
    stored = json.loads(json.dumps(BUSY.to_json()))
    assert FitConfig.from_json(stored) == BUSY and FitConfig.from_json(stored).fingerprint() == BUSY.fingerprint()
    with pytest.raises(UsageError, match="another version"):
        FitConfig.from_json({**stored, "bogus": 1})
    earlier = {**stored, "loss": stored["loss"] | {"exposure_weight": 0.01}}  # a setting without effect, since removed
    assert FitConfig.from_json(earlier) == BUSY
    assert all(isinstance(p, FitConfig) and p.preset == name for name, p in PRESETS.items())


def test_every_preset_is_named_and_described():
    """By a line about it, which the help shows, and in the table of docs/presets.md."""
    assert all(PRESETS.described().values())
    table = (Path(__file__).parents[2] / "docs" / "presets.md").read_text("utf-8")
    rows = " ".join(line.split("|")[1] for line in table.splitlines() if line.startswith("| `"))
    for name in PRESETS:
        assert f"`{name}`" in rows, name


@pytest.mark.parametrize("bad", [{"steps": 0}, {"sh_every": 0}, {"rule": "best"}, {"max_gaussians": 0}, {"strategy": "best"}])
def test_bad_configuration_is_refused(bad):
    """A setting that cannot work is an error at once."""
    with pytest.raises(UsageError):
        FitConfig(**bad)


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
def test_interrupted_fit_saves_the_step_in_progress(tmp_path):
    """Ctrl-C ends with exit code 130 and a checkpoint of the last whole step, from which --resume goes on."""
    write_demo(tmp_path / "scene", views=8, width=48, height=36)
    # tests may run in the background, where a shell has Ctrl-C ignored and their children inherit that
    heeding = (
        "import signal, sys; signal.signal(2, signal.default_int_handler); from warpgs.app.cli import main; sys.exit(main())"
    )
    command = [
        sys.executable, "-c", heeding, "fit", str(tmp_path / "scene"), "--split", split_spec(8), "--steps", "100000",
        "--device", "cpu", "--out", str(tmp_path / "run"), "--preset", "3dgs", "--init.source", "random",
        "--init.random-count", "60",
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for line in process.stdout:
        if line.startswith("step"):
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
        "--checkpoint-every", "10", "--checkpoint-seconds", "0",
        "--density.start", "10", "--density.every", "10",
    ]  # fmt: skip
    # stands still after the first checkpoint, says so, and waits for the end
    stand_still = (
        "import sys\nfrom warpgs.app.cli import main\nfrom warpgs.pipeline.run import fit, folder\n"
        "def save(*a, **k):\n    made(*a, **k)\n    print('saved', flush=True)\n    sys.stdin.read()\n"
        "made = folder.save_checkpoint\nfit.save_checkpoint = save\nsys.exit(main(sys.argv[1:]))"
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
