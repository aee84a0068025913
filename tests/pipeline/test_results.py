"""What a fit leaves and says: scores, pictures, errors that it traded, and figures of sampling events."""

import contextlib
import dataclasses
import math

import cv2
import numpy as np
import pytest
import torch

from tests.gaussians import cloud
from tests.mesh.balls import ball, cameras
from tests.pipeline.test_sampling import CONFIG as UNIFORM, METHOD
from tests.scenes import photos, priors, seeds, three_gaussians
from warpgs.constants import RULES, TILE_SIZE
from warpgs.errors import ResourceError, UsageError
from warpgs.pipeline.films.paths import rig_among
from warpgs.pipeline.metrics.scores import Renders, render_view, score
from warpgs.pipeline.model.start import InitConfig, initial_gaussians
from warpgs.pipeline.paper.strategy import PaperConfig
from warpgs.pipeline.run import results
from warpgs.pipeline.run.folder import load_checkpoint, save_checkpoint
from warpgs.pipeline.run.results import (
    SHEET_WIDTH,
    evaluate_run,
    event_figures,
    images_kept,
    new_view,
    result_lines,
    rule_report_of,
    sampling_report_of,
    shown_steps,
    view_sheet,
)
from warpgs.pipeline.train.schedule import PhaseConfig, plan_phases
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies import sampling
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import TrainingView, half_size
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.report.images import CONTACT_GAP, CONTACT_HEAD, CONTACT_MARGIN, DOT, TITLE_SIZE, colored, webp
from warpgs.scene import Gaussians, View

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def scene():
    return initial_gaussians(seeds(), InitConfig(), 3, 1.0, CPU), photos(12)


def full(path, data):
    raise ResourceError(f"{path.name}: no space left")


def test_scores_are_those_of_their_views(scene, tmp_path):
    """Each row is the score of its view, whoever finished first; means are over these; every held-out view has its files."""
    gaussians, views = scene
    test, train, options = views[:10], views[10:], RasterizeOptions()
    found = evaluate_run(tmp_path, Renders(gaussians, options), train, test)
    wanted = [score(v, render_view(gaussians, v, options)[0]).row() for v in views]
    assert found["views"] == wanted[:10] and len({r["psnr"] for r in wanted}) == 12
    assert found["train"]["psnr"] == pytest.approx(sum(r["psnr"] for r in wanted[10:]) / 2)
    assert found["test"]["psnr"] == pytest.approx(sum(r["psnr"] for r in wanted[:10]) / 10)
    for folder in ("renders", "depth"):
        assert sorted(p.stem for p in (tmp_path / folder).iterdir()) == sorted(v.name.removesuffix(".png") for v in test)


def test_without_held_out_views_training_views_are_pictured(scene, tmp_path, monkeypatch):
    """No score is called held-out; a full disk ends the evaluation with its error, although another thread met it."""
    gaussians, views = scene
    renders = Renders(gaussians, RasterizeOptions())
    found = evaluate_run(tmp_path, renders, views[:2], [])
    assert found["test"] == {} and found["views"] == [] and found["baselines"] == {} and found["train"]["psnr"] > 5
    assert len(list((tmp_path / "renders").iterdir())) == 2
    monkeypatch.setattr(results, "write_bytes", full)
    with pytest.raises(ResourceError, match="no space left"):
        evaluate_run(tmp_path, renders, views[:1], views[1:3])


def test_the_first_image_is_a_new_view_where_two_photographs_agree():
    """Midway between two neighbours that show the ball, not between two that look away; none of one view or another lens."""
    near = np.array([[-0.3, 0, -1], [0.3, 0, -1]])
    back = np.diag([-1.0, 1, -1, 1])
    away = [dataclasses.replace(c, viewmat=back @ c.viewmat) for c in cameras(near + np.array([0, 3.0, 0]))]
    views = [View(name, c, np.zeros((72, 72, 3), np.float32)) for name, c in zip("abcd", [*away, *cameras(near)])]
    render = Renders(ball(), RasterizeOptions())
    rig = rig_among([v.camera for v in views[2:]], ball().means.numpy())
    ((image, words),) = new_view(rig, views, render)
    assert words == "a new viewpoint, between c and d"
    middle = rasterize(ball(), cameras(np.array([[0, 0, -1.0]]))[0]).rgb.numpy()
    np.testing.assert_allclose(image, middle, atol=0.15)
    flat = [dataclasses.replace(v, camera=dataclasses.replace(v.camera, model="orthographic")) for v in views]
    for none in (views[2:3], flat):
        assert new_view(rig, none, render) == []


def test_a_fit_ends_with_its_score_its_size_its_time_and_what_to_do_next(tmp_path):
    """The commands name the run as a shell takes it; time for kernels is told where there was some."""
    metrics = {
        "test": {"psnr": 24.5, "ssim": 0.8}, "train": {"psnr": 30.25}, "views": [{}, {}], "coverage": {"summary": "all seen"},
        "baselines": {"mean_photo": 12.0, "nearest_photo": 13.5}, "gaussians": 1234, "complexity": {"bytes": 2**20},
        "seconds": {"total": 70.0, "compiling": 20.0},
        "wall_seconds": {"import": 3.0, "kernels": 20.0, "steps (phase 1)": 40.0, "scoring": 12.0, "other": 0.2, "total": 75.2},
    }  # fmt: skip
    out = tmp_path / "my run"
    lines = result_lines(metrics, out)
    assert lines[0].startswith("held-out PSNR 24.50 dB, SSIM 0.800") and lines[0].endswith("(2 views)")
    assert "the nearest photograph 13.50 dB" in lines[1] and "all seen" in lines[2]
    compiled = "in 1 min 15 s, with kernels compiled once on this machine"
    assert lines[3] == f"1,234 Gaussians, 1.0 MiB, {compiled}: steps 40 s, kernels 20 s, scoring 12 s"
    assert lines[4] == f"report: {out / 'report.html'}"
    commands = [f"view '{out}'", f"render '{out}'", f"export '{out}' --to scene.html"]
    assert [line.split("  ")[1] for line in lines[6:]] == [f"warpgs {words}" for words in commands]
    asked = result_lines(metrics, out, ["remove blurred ones"])
    assert asked == [*lines[:4], "to do:", "  remove blurred ones", *lines[4:]]
    quick = {"seconds": {"total": 4.0}, "wall_seconds": {"import": 5.0, "total": 5.0}}
    unscored = result_lines(metrics | {"test": {}} | quick, None)
    assert unscored[0] == "training PSNR 30.25 dB (no score of new views: no view is held out)"
    figures = results._figures(metrics | {"test": {}}, 1.0)
    assert figures[0] == ("training PSNR: how well the photographs are repeated, not how good new views are", "30.25 dB")
    assert unscored[1].endswith("1.0 MiB, in 5 s: import 5 s")
    assert "held-out" not in " ".join(unscored) and "next:" not in unscored
    scored, unscored = (result_lines(metrics | more | {"region": "foreground"}, None)[0] for more in ({}, quick | {"test": {}}))
    assert scored.endswith("(2 views over foreground)") and "training PSNR 30.25 dB over foreground (no score" in unscored
    assert result_lines(metrics | {"region": "mask"}, None)[0].endswith("(2 views over unmasked pixels)")


# What a fit says it traded: errors that are true, the same for the same seed, and quick to find.

BACKGROUND = torch.tensor([0.2, 0.4, 0.6])
EXACT = RasterizeOptions(background=BACKGROUND)


def crowd(device) -> Gaussians:
    """Three Gaussians that the cameras see, and many faint ones about them, so that a cut-off leaves something out."""
    base, many = three_gaussians(), cloud(800, degree=0)
    means = (many.means - torch.tensor([0.0, 0, 4.0])) * 0.3
    many = dataclasses.replace(many, means=means, logit_opacities=many.logit_opacities - 2)
    return Gaussians(**{n: torch.cat([t, many.tensors()[n]]).to(device) for n, t in base.tensors().items()})


def test_error_is_the_difference_of_the_pictures(device):
    """For a coarse rule the figures are those of its pictures and exact's, whole pictures in float32, within float32."""
    g, seen = crowd(device), photos(2, 60, 48)  # smaller than a part: the parts are the pictures
    for rule in ("fast", "gsplat-1.5"):
        found = rule_report_of(g, seen, RasterizeOptions(rule=rule, background=BACKGROUND), seed=0)
        pairs = [
            [rasterize(g, v.camera, dataclasses.replace(EXACT, rule=r)).rgb.flatten() for r in (rule, "exact")] for v in seen
        ]
        off = torch.cat([(a - b).abs() for a, b in pairs]).cpu()
        assert found["mean"] == pytest.approx(float(off.mean()), rel=1e-2, abs=2e-6)
        assert found["max"] == pytest.approx(float(off.max()), rel=1e-2, abs=2e-5)
        assert found["psnr"] == pytest.approx(-10 * math.log10(float((off**2).mean())), abs=0.2)
        assert found["render_ms"] > 0 and found["exact_ms"] > 0 and f"images by rule {rule} differ" in found["summary"]
    assert float(off.max()) > 0
    with pytest.raises(UsageError, match=", ".join(RULES)):
        FitConfig(rule="quick")


def test_exact_trades_nothing_and_the_seed_draws_views_and_parts(device):
    """The arithmetic alone, and no second time; kernels and truth leave out a Gaussian that is no number."""
    found = rule_report_of(crowd(device), photos(5, 150, 100), EXACT, seed=3)
    assert 0 < found["mean"] < 2e-6 and "exact_ms" not in found and found["psnr"] > 90
    assert "has the cut-offs of 3DGS" in found["summary"] and "3 training views" in found["summary"]
    g = crowd(CPU)
    g.means[5] = float("nan")
    assert rule_report_of(g, photos(1, 150, 100), EXACT, seed=0)["mean"] < 2e-6
    # three views, parts of 64 px on tile edges or the picture's, others for another seed
    g, seen = crowd(CPU), photos(6, 150, 100)
    first, again, other = (rule_report_of(g, seen, EXACT, seed=s) for s in (0, 0, 1))
    assert first["views"] == again["views"] and first["mean"] == again["mean"] and first["views"] != other["views"]
    assert len(first["views"]) == 3
    for x, y, w, h in first["views"].values():
        assert x % TILE_SIZE == y % TILE_SIZE == 0 and x + w <= 150 and y + h <= 100 and 0 < w <= 64 and 0 < h <= 64
        assert all(side % TILE_SIZE == 0 or end == whole for side, end, whole in ((w, x + w, 150), (h, y + h, 100)))


@pytest.mark.parametrize("size", [(40, 32), (41, 33), (1, 1)])
def test_halved_views(size):
    """Means of the pixels covered, a camera that sees the same, and a mask that counts whole pixels alone."""
    width, height = size
    image, mask = np.random.default_rng(0).random((height, width, 3)).astype(np.float32), np.ones((height, width), bool)
    mask[0, -1] = False
    camera = dataclasses.replace(photos(1, width, height)[0].camera, model="fisheye")
    view = TrainingView.of(View("a", camera, image, mask), CPU)
    half = half_size(view)
    assert view.camera.model == half.camera.model == "fisheye"
    h, w = max(1, height // 2), max(1, width // 2)
    assert half.image.shape == (h, w, 3) and half.mask.shape == (h, w) and (half.camera.width, half.camera.height) == (w, h)
    if size == (40, 32):
        assert torch.allclose(half.image[3, 5], view.image[6:8, 10:12].mean((0, 1)))
        assert half.mask.sum() == w * h - 1 and half.mask[0, -1] == 0
    ray = torch.linalg.solve(view.camera.K.double(), torch.tensor([width, height, 1.0], dtype=torch.float64))
    # entries of K are rounded once each, so at most 2^-24 of a side, twice
    assert torch.allclose(half.camera.K.double() @ ray, torch.tensor([w, h, 1.0], dtype=torch.float64), rtol=1e-6)


def test_a_fit_starts_at_half_size_and_ends_whole(device):
    """The first steps see halved views; the share decides when; without it everything is as before."""
    config = FitConfig(steps=8, init=InitConfig(source="points"), half_resolution=0.5)
    fit = Trainer(photos(3), seeds(), config, device)
    assert [fit.plan_of(s).half_size for s in range(1, 9)] == [True] * 4 + [False] * 4
    sizes = []
    for _ in range(8):
        number = fit.next_view()
        fit.order.append(number)
        kind, _ = fit.places[number + fit.plan_of(fit.step + 1).half_size * len(fit.views)]
        sizes.append(fit.stacks[kind].camera.width)
        (report,) = fit.advance()
        assert math.isfinite(report.loss)
    assert sizes == [20] * 4 + [40] * 4 and len(fit.stacks) == 2 and len(fit.places) == 6
    plain = Trainer(photos(3), seeds(), dataclasses.replace(config, half_resolution=0.0), device)
    assert len(plain.stacks) == 1 and len(plain.places) == 3


# Images and figures of sampling events: they show what the event saw, and say what it did.

NAMES = ["00.png", "01.png", "02.png"]
CONFIG = dataclasses.replace(UNIFORM, strategy="paper", strategy_config=None)


@pytest.fixture(scope="module")
def tiny():
    """Three Gaussians are hardly opaque, and fits of 40 steps have no time for long protection."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampling, "MIN_ALPHA", 0.05)
        patch.setattr(sampling, "PROTECTED_STEPS", 10)
        yield


def fitted(config: FitConfig = CONFIG, steps: int = 0, out=None) -> Trainer:
    """Some steps of a fit of three views, with images of its events in ``out``."""
    views = photos(3)
    fit = Trainer(views, seeds(), config, CPU, priors=priors(views))
    with contextlib.nullcontext() if out is None else images_kept(fit, NAMES, out):
        for _ in range(steps):
            fit.advance()
    return fit


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out, seen, fit = tmp_path_factory.mktemp("run"), [], fitted()
    with images_kept(fit, NAMES, out):
        draw, shown, fit.strategy.shown = fit.strategy.on_event, fit.strategy.shown, None
        fit.strategy.on_event = lambda step, views: (step in shown and draw(step, views), seen.append((step, views)))
        while fit.step < CONFIG.steps:
            fit.advance()
    return fit, out, seen


def tile(sheet: np.ndarray, index: int, view, width: int = 320) -> np.ndarray:
    """The pixels of one tile of a sheet of five columns."""
    height = round(width * view.camera.height / view.camera.width)
    head, top = CONTACT_HEAD, CONTACT_MARGIN + TITLE_SIZE + 18
    x, y = CONTACT_MARGIN + index % 5 * (width + CONTACT_GAP), top + head + index // 5 * (head + height + CONTACT_GAP)
    return sheet[y : y + height, x : x + width]


@pytest.mark.usefixtures("tiny")
def test_events_are_shown_as_they_were_and_figures_add_up(run):
    """The first, and the first of the second half of phase 2; each has a file with a sheet for each of the three views."""
    phases = plan_phases(PhaseConfig(2000, 3000), 10_000)
    first, middle = sorted(shown_steps(phases))
    assert first == 2000 and 4500 <= middle < 4800 and middle in phases.events
    assert shown_steps(dataclasses.replace(phases, events=(2000,))) == {2000}
    assert shown_steps(dataclasses.replace(phases, events=())) == set()
    fit, out, _ = run
    files = sorted((out / "sampling").iterdir())
    assert [int(f.stem) for f in files] == sorted(shown_steps(fit.phases)) and len(files) == 2
    image = cv2.imread(str(files[0]))
    assert image.shape[0] % 3 == 0 and image.shape[1] == 2 * CONTACT_MARGIN + 5 * 320 + 4 * CONTACT_GAP
    # each map in its place; dots at the drawn pixels and nowhere else; the gate in two colours
    fit, _, seen = run
    step, event = seen[0]
    drawn, view = event[1], fit.views[1]
    sheet = view_sheet("01.png", step, view, fit.disparities[1], drawn, fit.strategy)
    big = {i: tile(sheet, i, view) for i in range(9)}
    H, W = view.camera.height, view.camera.width
    rows, columns = (((np.arange(n) + 0.5) * big[0].shape[i] / n).astype(int) for i, n in ((0, H), (1, W)))
    small = {i: t[rows][:, columns] for i, t in big.items()}
    np.testing.assert_allclose(small[0], drawn.rendered.numpy().clip(0, 1), atol=0.02)
    np.testing.assert_allclose(small[1], view.image.numpy(), atol=0.02)
    for i, found in zip((5, 6, 7, 8), drawn.scores.values(), strict=True):
        assert np.abs(small[i] - colored(found.numpy(), "INFERNO")).mean() < 0.02, i
    assert np.abs(small[2] - colored(fit.disparities[1], "TURBO")).mean() < 0.03
    gate = drawn.gate.numpy()
    assert 0.05 < gate.mean() < 0.95 and np.array_equal(small[3].mean(-1) > 0.5, gate)
    marked = np.abs(small[4] - np.float32(DOT) / 255).max(-1) < 0.02
    wanted = np.zeros((H, W), bool)
    wanted[tuple(drawn.at.T.numpy())] = True
    assert wanted.sum() == len(drawn.at) > 5 and np.array_equal(marked, wanted)
    # counts are those of the fit's own list; layers make up the set
    fit, _, seen = run
    figures = event_figures(fit)
    assert figures["events"] == {
        "count": len(seen), **{n: sum(e[n] for e in fit.strategy.events) for n in ("added", "evicted")},
        "samplings": 3 * len(seen), "widened": sum(v.quantile < 0.6 for _, views in seen for v in views),
    }  # fmt: skip
    assert 0 < figures["events"]["added"] <= sum(len(v.at) for _, views in seen for v in views)
    assert sum(figures["layers"].values()) == len(fit.gaussians)
    assert figures["layers"]["fine"] == int(fit.strategy.fine.sum()) > 0


@pytest.mark.usefixtures("tiny")
def test_story_follows_the_switches(run, tmp_path):
    fit, out, _ = run
    (out / "sampling" / "own.png").write_bytes(b"an image of the user's own")
    story = sampling_report_of(fit, out)
    (out / "sampling" / "own.png").unlink()
    assert "sampled at random" in story[0] and "above its 0.6 quantile" in story[0] and "rendered depth" in story[0]
    assert [c for c, _ in story[1]] == [f"sampling after step {s}" for s in sorted(shown_steps(fit.phases))]
    assert story[1][0][1] == webp(min((out / "sampling").iterdir()).read_bytes(), SHEET_WIDTH, 70)
    assert dict(zip(*story[2]))["sampling events"] == str(len(fit.strategy.events))

    def words_of(own, fraction=0.2):
        method = dataclasses.replace(METHOD, sampler=dataclasses.replace(METHOD.sampler, fraction=fraction))
        return sampling_report_of(fitted(dataclasses.replace(CONFIG, method=method, strategy_config=own), 8), tmp_path)[0]

    own = PaperConfig(agp=False, depth="consistent")
    words = words_of(own)
    assert "the highest in S_importance" in words and "other views confirm and with S_geometry" in words
    assert "all pixels that Gaussians cover" in words_of(dataclasses.replace(own, ra=False))
    words = words_of(PaperConfig(s_render=False, s_semantic=False, s_geometry=False), 0.01)
    assert "sampled uniformly at random" in words
    plain = fitted(dataclasses.replace(CONFIG, strategy="clone_split", strategy_config=None), 1)
    assert sampling_report_of(plain, tmp_path) is None


@pytest.mark.usefixtures("tiny")
def test_first_picture_outlives_a_continuation(run, tmp_path):
    """Stopped after the first event and continued: the same pictures, byte for byte, as of the fit that never stopped."""
    for until, count in ((10, 1), (CONFIG.steps, 2)):
        fit = fitted()
        if count == 2:
            fit.load(*load_checkpoint(tmp_path))
        with images_kept(fit, NAMES, tmp_path) as images_written:
            while fit.step < until:
                fit.advance()
            images_written()
            assert len(list((tmp_path / "sampling").iterdir())) == count
        save_checkpoint(tmp_path, *fit.state())
    straight, continued = ({f.name: f.read_bytes() for f in (d / "sampling").iterdir()} for d in (run[1], tmp_path))
    assert straight == continued and len(straight) == 2


@pytest.mark.usefixtures("tiny")
@pytest.mark.parametrize("cause", ["folder", "disk"])
def test_images_that_cannot_be_written_end_no_fit(tmp_path, monkeypatch, cause):
    """A file stands where their folder should be, or the disk is full: said of each, and the fit takes all its steps."""
    if cause == "disk":
        monkeypatch.setattr(results, "write_bytes", full)
    else:
        (tmp_path / "sampling").write_text("in the way")
    fit = fitted(CONFIG, CONFIG.steps, tmp_path)
    assert fit.strategy.on_event is None and len(fit.messages) == 2
    assert "an image of sampling events is missing from the report" in fit.messages[0]
    assert ("no space left" if cause == "disk" else "cannot be created") in fit.messages[0]


@pytest.mark.usefixtures("tiny")
def test_an_error_of_ours_in_an_image_is_not_hidden(tmp_path, monkeypatch):
    monkeypatch.setattr(results, "write_bytes", lambda path, data: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        fitted(CONFIG, CONFIG.steps, tmp_path)
