"""Kinds of views in a fit: other camera models, lenses from a folder, the antialiasing filter, objects cut out."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

import warpgs
from tests.io.scenes import save
from tests.parallel_camera import NAME
from tests.pipeline.train.fits import advanced
from tests.scenes import photos, ring, seeds, three_gaussians
from warpgs import geometry
from warpgs.app.cli import main
from warpgs.errors import UsageError
from warpgs.export.base import read_with_antialiasing
from warpgs.export.meshes_and_cameras import write_cameras
from warpgs.geometry import look_at, pinhole_of, seen_pixels
from warpgs.io.images import list_images
from warpgs.kernels.neighbours import pixel_size
from warpgs.kernels.update import SHIFT
from warpgs.pipeline.films.paths import framed
from warpgs.pipeline.metrics.scores import fitted_region, score
from warpgs.pipeline.model import limits, start as init
from warpgs.pipeline.model.depth_points import carve, hull_points, in_empty_region, silhouettes
from warpgs.pipeline.model.limits import LimitConfig, camera_rows
from warpgs.pipeline.model.start import InitConfig, initial_points, random_points
from warpgs.pipeline.run.commands import open_file
from warpgs.pipeline.train import step, trainer
from warpgs.pipeline.train.loss import INSIDE, AlphaDifference, CertainOpacity, LossConfig, LossInputs, Target
from warpgs.pipeline.train.memory import most_instances
from warpgs.pipeline.train.schedule import over, random_shift
from warpgs.pipeline.train.settings import FitConfig, settings_by_views
from warpgs.pipeline.train.setup import prepare
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import TrainingView, half_size, stack_views, with_alpha
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, PointCloud, Scene, View
from warpgs.synthetic.demo import split_spec, write_demo
from warpgs.viewer.window import content_of_file, content_of_run

# A fit of views whose camera model is not a pinhole: model and coefficients reach every place that renders.

CPU = torch.device("cpu")
CONFIG = FitConfig(
    steps=40, strategy="clone_split", init=InitConfig(source="points"), max_gaussians=60, half_resolution=0.0, dropout=0.0,
    batch=1,
)  # fmt: skip
BEND = (0.15, -0.05, -0.1, 0.08)


def bent(camera: Camera, bend: tuple[float, ...] = BEND) -> Camera:
    """Return a parallel camera that shows about what a pinhole shows at the distance of the scene's middle."""
    distance = np.linalg.norm(camera.center)
    K = np.diag([1 / distance, 1 / distance, 1]) @ camera.K
    K[:2, 2] = camera.K[:2, 2]
    return dataclasses.replace(camera, K=K, model=NAME, distortion=np.array(bend))


def views(count: int = 4) -> list[View]:
    found = []
    for i, camera in enumerate(ring(count, 40, 32)):
        c = bent(camera, tuple((-1) ** i * b for b in BEND))
        found.append(View(f"{i:02d}.png", c, rasterize(three_gaussians(), c).rgb.clamp(0, 1).numpy()))
    return found


@pytest.fixture(scope="module")
def fit() -> Trainer:
    return Trainer(views(), seeds(), CONFIG, CPU)


def rendered_alone(fit: Trainer, number: int, **options) -> torch.Tensor:
    """Return a view's image from the fit's Gaussians, by its own camera."""
    camera = views()[number].camera
    return rasterize(fit.gaussians, camera, RasterizeOptions(rule=fit.config.rule, sh_degree=0, **options)).rgb


@pytest.mark.slow
def test_the_fit_explains_what_the_model_shows():
    """As pinholes, the same cameras leave nearly twice the error."""
    lost = [dataclasses.replace(v, camera=dataclasses.replace(v.camera, model="pinhole", distortion=None)) for v in views()]
    errors = []
    for train in (views(), lost):
        trainer, mse = Trainer(train, seeds(), dataclasses.replace(CONFIG, steps=200), CPU), []
        while trainer.step < trainer.steps:
            mse += [10 ** (-report.psnr / 10) for report in trainer.advance()]
        errors.append(np.mean(mse[-4:]))
    assert errors[0] < 0.7 * errors[1]


def first_error(fit: Trainer, number: int, captured: bool) -> float:
    """Return the mean squared error of a view's render in the first step."""
    options, plan, buffers = fit.context.render_options(), fit.plan_of(1), fit.taker.buffers
    (stack,) = fit.stacks.values()
    buffers.load([number], [[0.0] * buffers.lr_rows.shape[1]], [fit.settings(1)])
    render = step.eager_renderer(options, None)
    if captured:
        capacity = step.instance_capacity(fit.gaussians, stack, plan.degree, options)
        render = step.captured_renderer(options, capacity, buffers.stop)
    fit.taker.view_gradients(stack, buffers, plan, render)
    return buffers.result()[2][0][1]


def check_instances(fit: Trainer, ways: list[tuple[list[Camera], RasterizeOptions]]) -> None:
    """Check that capacity of captured steps and the memory plan count what the first way renders, and not the second."""
    most, other = (max(int(rasterize(fit.gaussians, c, o).tile_counts.sum()) for c in cameras) for cameras, o in ways)
    assert most_instances(fit.gaussians, [v.camera for v in fit.views], fit.context.render_options()) == most != other
    (stack,) = fit.stacks.values()
    capacity = step.instance_capacity(fit.gaussians, stack, 0, fit.context.render_options())
    assert capacity == int(step.CAPACITY_FACTOR * most) + 1024


@pytest.mark.parametrize("captured", [False, True], ids=["eager", "fixed capacity"])
def test_a_step_renders_by_the_views_own_camera(fit, captured):
    """The loss of the first step is that of an image which `rasterize` renders alone, to the bit."""
    for number in range(4):
        wanted = float(((rendered_alone(fit, number) - torch.as_tensor(views()[number].image)) ** 2).mean())
        assert first_error(fit, number, captured) == pytest.approx(wanted, rel=1e-6) and wanted > 1e-3


def test_chunks_memory_and_half_sizes_know_the_model(fit):
    """Chunks count the tiles of each window by the same camera; coefficients do not depend on the size, and stacks have one."""
    whole, chunks = rendered_alone(fit, 1), rendered_alone(fit, 1, max_instances=20)
    assert torch.equal(whole, chunks)
    camera = ring(1, 160, 128)[0]
    for number in (1, -1):
        c = bent(camera, (0.8 * number, 0.0, -0.8 * number, 0.0))
        renders = [rasterize(three_gaussians(), c, RasterizeOptions(max_instances=most)) for most in (None, 20)]
        assert torch.equal(renders[0].rgb, renders[1].rgb) and float(renders[0].alpha.max()) > 0.5
    options = RasterizeOptions(rule=fit.config.rule, sh_degree=0)
    own = [v.camera for v in views()]
    pinholes = [dataclasses.replace(c, model="pinhole", distortion=None) for c in own]
    check_instances(fit, [(own, options), (pinholes, options)])
    for shown, view in zip(fit.views, views()):
        for camera in (shown.camera, half_size(shown).camera):
            assert camera.model == NAME and np.allclose(camera.distortion, view.camera.distortion)
    mixed = Trainer([*views(2), *photos(2, 40, 32)], seeds(), CONFIG, CPU)
    assert sorted(s.camera.model for s in mixed.stacks.values()) == ["pinhole", NAME]
    assert all(mixed.views[i].camera.model == s.camera.model for s in mixed.stacks.values() for i in s.numbers)


def test_what_cannot_be_rendered_is_refused_before_the_first_step():
    first, *rest = views(2)
    for change, words in (({"model": "fish"}, "unknown camera model 'fish'"), ({"distortion": np.zeros(2)}, "takes 4")):
        wrong = dataclasses.replace(first, camera=dataclasses.replace(first.camera, **change))
        with pytest.raises(UsageError, match=words):
            Trainer([*rest, wrong], seeds(), CONFIG, CPU)


def test_a_fit_of_such_views_is_scored_written_and_opened_again(tmp_path):
    """The whole command, with scores and report; a note names the checks that compare views, which are left out."""
    scene = Scene("memory", "none", tuple(views()), points=seeds())
    done = warpgs.fit(scene, CONFIG, steps=3, split="every:4", out=tmp_path / "run", device="cpu", verbose=False)
    assert "coverage" not in done.metrics and any(NAME in n and "cannot be compared" in n for n in done.notes)
    assert done.metrics["rule"]["max"] < 2e-6  # the same kernels in float32 and float64: measured 1.3e-7
    assert (tmp_path / "run" / "report.html").is_file()
    opened = warpgs.open_run(tmp_path / "run").cameras()["01.png"]
    assert opened.model == NAME and np.array_equal(opened.distortion, views()[1].camera.distortion)


@pytest.mark.parametrize("changes", [{"init_source": "random"}, {"strategy": "sampling"}])
def test_settings_that_compare_views_are_refused_before_the_first_step(changes):
    scene = Scene("memory", "none", tuple(views()), points=seeds())
    with pytest.raises(UsageError, match=r"--preset 3dgs --init\.source points"):
        warpgs.fit(scene, CONFIG, device="cpu", verbose=False, **changes)


# A fit through a lens from a folder to its scores, and what each command makes of such a run.

LENS = ("OPENCV_FISHEYE", "fisheye", (2.0, 0, 0, 0))
"""A lens that shows less of the scene than the pinhole of the same K."""
LENS_CPU = ["--device", "cpu"]


@pytest.fixture(scope="module")
def lens_run(tmp_path_factory):
    """A run of the default preset on the demo scene as a fisheye takes it: images through the lens, cameras that say so."""
    folder = tmp_path_factory.mktemp("lens")
    write_demo(folder / "scene", views=8, width=64, height=48)
    cameras = folder / "scene" / "sparse" / "0" / "cameras.txt"
    number, _, width, height, *K = cameras.read_text().splitlines()[-1].split()
    fx, fy, cx, cy = map(float, K)
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    rays = geometry.from_plane(LENS[1], np.array(LENS[2]), np.stack([(x - cx) / fx, (y - cy) / fy], -1))
    at = rays[..., :2] / rays[..., 2:] * [fx, fy] + [cx - 0.5, cy - 0.5]
    for path in list_images(folder / "scene" / "images"):
        image = cv2.imread(str(path))[..., ::-1]
        save(path, cv2.remap(image, *np.moveaxis(at.astype(np.float32), -1, 0), cv2.INTER_LINEAR))
    cameras.write_text(f"{number} {LENS[0]} {width} {height} {' '.join(K)} {' '.join(map(str, LENS[2]))}\n")
    flags = ["--lenses", "native", "--steps", "8", "--split", split_spec(8), *LENS_CPU]
    assert main(["fit", str(folder / "scene"), "--out", str(folder / "run"), *flags]) == 0
    return folder / "run"


@pytest.mark.slow
def test_the_default_fit_goes_through_the_lens(lens_run):
    """Images are those of the float64 reference through the lens, and coverage is known."""
    record, metrics = (json.loads((lens_run / f"{n}.json").read_text()) for n in ("config", "metrics"))
    assert record["scene"]["lenses"] == "native"
    assert {c["model"] for c in record["cameras"].values()} == {"fisheye"}
    assert metrics["rule"]["mean"] < 1e-5 and metrics["coverage"]["classes"]


@pytest.mark.slow
def test_depth_found_in_other_views_is_that_of_the_lens(lens_run):
    scene = warpgs.load_scene(lens_run.parent / "scene", lenses="native")
    config, _ = settings_by_views(FitConfig(steps=2, init=InitConfig(source="sweep")), list(scene.views), "cpu")
    depths = prepare(list(scene.views), None, config, torch.device("cpu"), [], lambda: None)[1].depths
    errors = []
    for view, found in zip(scene.views, depths, strict=True):
        own = np.array([view.name in t for t in scene.points.tracks])
        _, rows, columns, exact = seen_pixels(view.camera, scene.points.points[own])
        valid = found.valid[rows, columns]
        errors.append(np.abs(found.depth[rows, columns][valid] / exact[valid] - 1))
    # 0.009; where the lens is read as a pinhole 0.045
    assert sum(map(len, errors)) > 500 and np.median(np.concatenate(errors)) < 0.018


@pytest.mark.slow
def test_commands_know_the_lens_or_take_its_pinhole(lens_run, tmp_path, capsys):
    """Scores go through the lens; films, meshes and files of cameras take the pinhole of the same K, which a note says."""
    stored = warpgs.open_run(lens_run, "cpu")
    camera = next(iter(stored.cameras().values()))
    assert camera.model == "fisheye" and camera.distortion.tolist() == list(LENS[2])
    before = json.loads((lens_run / "metrics.json").read_text())["test"]
    assert main(["eval", str(lens_run), *LENS_CPU]) == 0
    assert json.loads((lens_run / "metrics.json").read_text())["test"]["psnr"] == pytest.approx(before["psnr"], abs=1e-6)
    assert (
        main(["render", str(lens_run), "--path", "interpolate", "--frames", "2", "--out", str(tmp_path / "film"), *LENS_CPU])
        == 0
    )
    assert main(["mesh", str(lens_run), "--out", str(tmp_path / "m.ply"), "--resolution", "16", *LENS_CPU]) == 0
    capsys.readouterr()
    assert main(["export", str(lens_run), "--to", str(tmp_path / "transforms.json")]) == 0
    assert "written without their lens distortion, as pinholes" in capsys.readouterr().out
    frame = json.loads((tmp_path / "transforms.json").read_text())["frames"][0]
    assert frame["fl_x"] == pytest.approx(camera.K[0, 0])


@pytest.mark.slow
def test_orthographic_views_are_fitted_from_points(tmp_path):
    views = []
    for i, c in enumerate(ring(8)):
        K = np.concatenate([c.K[:, :2] / 2.2, c.K[:, 2:]], 1)
        c = dataclasses.replace(c, K=K, model="orthographic")
        views.append(View(f"{i}.png", c, rasterize(three_gaussians(), c).rgb.clamp(0, 1).numpy()))
    scene = Scene("", "own", tuple(views), points=seeds())
    options = {"device": "cpu", "verbose": False, "split": "every:4"}
    result = warpgs.fit(scene, "3dgs", steps=60, init={"source": "points"}, out=tmp_path / "run", **options)
    # 16.7 dB; 16.8 by pinholes
    assert result.metrics["test"]["psnr"] > 16 and "coverage" not in result.metrics
    assert result.metrics["rule"]["mean"] < 1e-5 and (tmp_path / "run" / "report.html").is_file()
    with pytest.raises(UsageError, match=r"camera model orthographic: .* --init.source points"):
        warpgs.fit(scene, steps=2, **options)
    with pytest.raises(UsageError, match="'orthographic'"):
        warpgs.render_path(result, "turntable", out=tmp_path / "film", frames=2)


def test_a_pinhole_in_place_of_a_lens():
    camera = dataclasses.replace(ring(1)[0], model="opencv", distortion=np.ones(8))
    found = pinhole_of(camera)
    assert (found.model, found.distortion) == ("pinhole", None) and found.K is camera.K and found.viewmat is camera.viewmat
    assert framed(camera, (20, 16)).model == "pinhole" and pinhole_of(found) is found
    parallel = Camera(camera.viewmat, camera.K, 40, 32, "orthographic")
    with pytest.raises(UsageError, match="only pinhole cameras are supported here, not 'orthographic'"):
        pinhole_of(parallel)


# An antialiased fit: every part renders with the filter, from the first step to the files of the run.

# points far below a pixel in size, so that every render with the filter is another than without
SMALL = InitConfig(source="points", scale_factor=0.02)
FILTERED_CONFIG = warpgs.FitConfig(steps=6, init=SMALL, antialiased=True, cpu_limit=False)
SPLIT = "train=00.png,01.png,02.png,03.png;test=04.png"


@pytest.fixture(scope="module")
def free():
    """No limit of the smallest size, so that the filter is all that differs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(limits, "MIN_PIXELS", 0.0)
        yield


def scene() -> Scene:
    return Scene("", "made", tuple(photos(5)), seeds(), fingerprint="x", pixels="as made")


def filtered(gaussians, camera, antialiased: bool = True) -> np.ndarray:
    """Render without anything of a fit."""
    return rasterize(gaussians, camera, RasterizeOptions(antialiased=antialiased, record=False)).rgb.detach().cpu().numpy()


@pytest.fixture(scope="module")
def filtered_run(tmp_path_factory):
    """The result of a fit with a run folder, and the models that it showed."""
    shown = []
    folder = tmp_path_factory.mktemp("antialiased") / "run"
    result = warpgs.fit(scene(), FILTERED_CONFIG, split=SPLIT, out=folder, device="cpu", verbose=False, on_model=shown.append)
    return result, shown


@pytest.mark.usefixtures("free")
@pytest.mark.parametrize("captured", [False, True], ids=["eager", "fixed capacity"])
def test_a_step_renders_with_the_filter(device, captured):
    """Its error is that of an image which `rasterize` renders alone; memory is planned for its instances."""
    fit = Trainer(photos(4), seeds(), FILTERED_CONFIG, device)
    errors = [((filtered(fit.gaussians, fit.views[1].camera, a) - photos(4)[1].image) ** 2).mean() for a in (True, False)]
    assert first_error(fit, 1, captured) == pytest.approx(errors[0], rel=1e-5)
    assert abs(errors[0] - errors[1]) > 1e-3 * errors[0]
    check_instances(fit, [([v.camera for v in fit.views], RasterizeOptions(antialiased=a)) for a in (True, False)])


@pytest.mark.usefixtures("free")
def test_scores_models_and_images_have_the_filter(filtered_run):
    result, shown = filtered_run
    stored = warpgs.open_run(result.folder, "cpu")
    models = [result, shown[-1], stored, content_of_run(result.folder).model]
    assert all(m.antialiased and m.options().antialiased for m in models)
    test = scene().view("04.png")
    image = filtered(stored.gaussians(), test.camera)
    assert result.metrics["test"]["psnr"] == score(test, image).psnr
    assert np.abs(image - filtered(stored.gaussians(), test.camera, False)).max() > 0.01
    kept = np.asarray(Image.open(result.folder / "renders" / "04.png").convert("RGB")) / 255
    assert np.abs(kept[:, : image.shape[1]] - image.clip(0, 1)).max() < 1 / 255
    assert result.metrics["rule"]["max"] < 1e-4, "the reference has the filter"
    assert json.loads((result.folder / "config.json").read_text())["config"]["antialiased"] is True
    assert any("antialiased" in note for note in result.notes)


@pytest.mark.usefixtures("free")
def test_no_axis_is_below_what_cameras_resolve(monkeypatch):
    """With the default limit every axis ends at 0.45 px or above of the finest camera; without the flag many are below."""
    monkeypatch.setattr(limits, "MIN_PIXELS", 0.2**0.5)
    rows = camera_rows(ring(4), CPU)
    below = []
    for antialiased in (True, False):
        fit = Trainer(
            photos(4), seeds(), dataclasses.replace(FILTERED_CONFIG, limits=LimitConfig(), antialiased=antialiased), CPU
        )
        advanced(fit)
        smallest = pixel_size(fit.gaussians.means, rows, 0.2**0.5)
        below.append(int((fit.gaussians.log_scales < smallest[:, None] - 1e-5).sum()))
    assert below[0] == 0 < below[1]


@pytest.mark.usefixtures("free")
def test_the_flag_and_the_files(tmp_path, capsys):
    """Of the run, its exports and its pruned model: those that can say so do, of others the command tells."""
    write_demo(tmp_path / "scene", views=8, width=40, height=32)
    flags = ["--preset", "3dgs", "--steps", "2", "--init.source", "random", "--init.random-count", "30", "--device", "cpu"]
    for name, own in (("with", ["--antialiased"]), ("without", [])):
        assert main(["fit", str(tmp_path / "scene"), "--out", str(tmp_path / name), *flags, *own]) == 0
        assert warpgs.open_run(tmp_path / name, "cpu").antialiased is bool(own)
        data = (tmp_path / name / "point_cloud.ply").read_bytes()
        assert (b"comment antialiased 1" in data[:500]) is bool(own)
        for file in ("a.spz", "a.splat"):
            assert main(["export", str(tmp_path / name), "--to", str(tmp_path / name / file), "--no-clean"]) == 0
            assert read_with_antialiasing(tmp_path / name / file, None, "file")[1] is (bool(own) and file == "a.spz")
        assert ("choose the antialiased mode in your viewer" in capsys.readouterr().out) is bool(own)
        assert content_of_file(tmp_path / name / "a.spz").model.options().antialiased is bool(own)
        write_cameras(tmp_path / "cameras.json", ring(2))
        opened, notes = open_file(tmp_path / name / "point_cloud.ply", tmp_path / "cameras.json", "exact", "cpu")
        assert opened.antialiased is bool(own) and any("declares an antialiased model" in note for note in notes) is bool(own)
    assert main(["prune", str(tmp_path / "with"), "--keep-psnr", "1", "--device", "cpu"]) == 0
    assert warpgs.open_run(tmp_path / "with-pruned", "cpu").antialiased
    assert read_with_antialiasing(tmp_path / "with-pruned" / "point_cloud.ply", None, "file")[1]


# Objects that are cut out: views that know their opacity, the loss over other backgrounds, the hull, and where fits
# start.

WHITE = (1.0, 1.0, 1.0)
CUTOUT = FitConfig(
    steps=80, init=InitConfig(source="points"), density=DensityConfig(start=10, every=10), dropout=0.2, half_resolution=0.2
)


def cutouts(count: int = 4) -> list[View]:
    views = []
    for i, camera in enumerate(ring(count)):
        render = rasterize(three_gaussians(), camera, RasterizeOptions(background=torch.ones(3)))
        views.append(View(f"{i}", camera, render.rgb.clamp(0, 1).numpy(), alpha=render.alpha.numpy()))
    return views


def balls(count: int = 8, side: int = 40) -> list[View]:
    """Views of a ball of radius 0.4 around the origin from 4 u away, all around it."""
    views = []
    for angle in 2 * np.pi * np.arange(count) / count:
        center = 4 * np.array([np.sin(angle), 0.3 * np.cos(3 * angle), -np.cos(angle)])
        K = np.array([[2.0 * side, 0, side / 2], [0, 2.0 * side, side / 2], [0, 0, 1]])
        camera = Camera(look_at(center, np.zeros(3), np.array([0, -1.0, 0])), K, side, side)
        y, x = np.mgrid[:side, :side] + 0.5 - side / 2
        distance = np.linalg.norm(center)
        ball = np.hypot(x, y) < 2 * side * 0.4 / np.sqrt(distance**2 - 0.4**2)
        image = np.where(ball[..., None], np.float32([0.2, 0.4, 0.6]), np.float32(1))
        views.append(View(f"{angle:.2f}", camera, image, alpha=ball.astype(np.float32)))
    return views


def fitted(views: list[View], loss: LossConfig, steps: int | None = None, points: PointCloud | None = None) -> Trainer:
    return advanced(Trainer(views, points or seeds(), dataclasses.replace(CUTOUT, loss=loss), CPU, WHITE), steps)


def alpha_errors(fit: Trainer, views: list[View]) -> tuple[float, float]:
    """Mean rendered opacity where the truth is empty, and what is missing of it where the truth is nearly opaque."""
    alphas = [rasterize(fit.gaussians, v.camera).alpha.numpy() for v in views]
    true = np.stack([v.alpha for v in views])
    return float(np.stack(alphas)[true < 0.02].mean()), float(1 - np.stack(alphas)[true > 0.9].mean())


def test_views_carry_their_opacity_over_any_background():
    """Opaque pixels stay, empty ones show the other colour, and render and photograph have the same background."""
    view = cutouts(1)[0]
    shift = torch.tensor([-0.9, -0.3, 0.0])
    black = rasterize(three_gaussians(), view.camera, RasterizeOptions(background=1 + shift)).rgb
    shown = over(torch.from_numpy(view.image), torch.from_numpy(view.alpha), shift)
    assert torch.allclose(shown, black, atol=1e-6)
    shifts = np.array([random_shift(3, step, WHITE) for step in range(200)])
    assert (shifts <= 0).all() and (shifts >= -1).all() and np.allclose(shifts.mean(0), -0.5, atol=0.1)
    assert random_shift(3, 7, WHITE) == random_shift(3, 7, WHITE) != random_shift(4, 7, WHITE)
    # an opaque view among others gets one; at half the size it is a mean, and stacks share its memory
    first, second = cutouts(2)
    both = with_alpha([dataclasses.replace(first, alpha=None), second])
    assert (both[0].alpha == 1).all() and both[1] is second
    assert with_alpha([both[0]]) == [both[0]]
    views = [TrainingView.of(v, CPU) for v in both]
    half = half_size(views[1])
    assert torch.allclose(half.alpha, torch.from_numpy(second.alpha.reshape(16, 2, 20, 2).mean((1, 3))), atol=1e-6)
    _, stacks, _ = stack_views([*views, half], 2)
    assert [len(s.alphas) for s in stacks.values()] == [2, 1]
    assert torch.equal(views[1].countable, (views[1].alpha > 0.5).float())


@pytest.mark.parametrize("masked", [False, True])
def test_alpha_term_is_a_mean_absolute_difference(masked):
    """Over the pixels that count; views without an opacity have none."""
    rendered, true, kept = torch.rand(3, 9, 11, generator=torch.Generator().manual_seed(0))
    mask = (kept > 0.3).float() if masked else None
    image = torch.zeros(9, 11, 3)

    def term(alpha: torch.Tensor | None) -> float:
        target = Target(image, mask, {}, alpha)
        return float(AlphaDifference(0.5)(LossInputs({"alpha": rendered}, target, None, None, torch.ones(()))))

    expected = (rendered - true).abs()[mask > 0].mean() if masked else (rendered - true).abs().mean()
    assert term(true) == pytest.approx(0.5 * float(expected), rel=1e-5) and term(None) == 0


def test_opacity_counts_only_away_from_the_edge_of_an_object_on_black():
    """At 4 px of an image whose diagonal is 800 px; the term is the mean over all pixels, by hand."""
    alpha = torch.zeros(480, 640)
    alpha[100:200, 300:400] = 1
    view = TrainingView(None, torch.zeros(480, 640, 3), alpha=alpha)
    certain = CertainOpacity(0.5).needs(view, None)["certain"]
    expected = torch.ones(480, 640)
    expected[96:204, 296:404] = 0
    expected[104:196, 304:396] = -INSIDE
    assert torch.equal(certain, expected)
    outputs, target = {"alpha": torch.full((480, 640), 0.2)}, Target(view.image, None, {"certain": certain})
    inputs, term = LossInputs(outputs, target, None, None, None), CertainOpacity(0.5)
    both = 0.2 * (480 * 640 - 108 * 108) + 0.8 * INSIDE * 92 * 92
    assert float(term(inputs)) == pytest.approx(0.5 * both / (480 * 640), rel=1e-5)
    mask = torch.zeros(480, 640)
    mask[:, :300] = 1  # 4 columns of it are near the object
    masked = dataclasses.replace(inputs, target=dataclasses.replace(target, mask=mask))
    assert float(term(masked)) == pytest.approx(0.5 * 0.2 * (1 - 4 * 108 / (480 * 300)), rel=1e-5)
    assert not term.needs(dataclasses.replace(view, alpha=None), None)["certain"].any()


@pytest.mark.parametrize(
    ("loss", "estimated"),
    [(LossConfig(alpha_weight=0), False), (LossConfig(), False), (LossConfig(), True)],
    ids=["background", "alpha", "estimated"],
)
def test_each_way_empties_what_is_empty(loss, estimated, monkeypatch):
    """Without opacities Gaussians in the colour of the background are left where nothing is."""
    if loss.alpha_weight:
        monkeypatch.setattr(trainer, "random_shift", lambda *_: (0.0, 0.0, 0.0))
    monkeypatch.setattr(init, "on_object", lambda start, views: start)
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (200, 3))
    white = PointCloud(np.concatenate([seeds().points, points]), np.ones((len(seeds()) + 200, 3), np.float32))
    views = cutouts()
    plain = alpha_errors(fitted([dataclasses.replace(v, alpha=None) for v in views], LossConfig(), points=white), views)[0]
    given = [dataclasses.replace(v, alpha=np.float32(v.alpha > 0.02), alpha_estimated=True) for v in views]
    empty, missing = alpha_errors(fitted(given if estimated else views, loss, points=white), views)
    assert empty < 0.3 * plain and missing < (0.1 if loss.alpha_weight else 1)  # by colour alone it takes more steps


def test_opaque_views_have_no_shift_and_an_estimated_opacity_is_a_target_only_where_it_is_empty():
    """An estimated one says where Gaussians start and are sampled; alpha_weight 0 leaves the loss of opaque views."""
    assert fitted(cutouts(), LossConfig(), 0).settings(5)[SHIFT] != (0, 0, 0)
    estimated = {"alpha_estimated": True}
    for change, weight, more in (({"alpha": None}, 1, []), (estimated, 0, []), (estimated, 1, ["certain"])):
        fit = fitted([dataclasses.replace(v, **change) for v in cutouts()], LossConfig(alpha_weight=weight), 1)
        assert [t.name for t in fit.terms] == ["photometric", *more] and fit.settings(5)[SHIFT] == (0, 0, 0)
    assert fit.views[0].countable is not None and fit.layout.sizes.cutout


def test_hull_of_a_ball_and_starts_on_it():
    """All points lie near its surface, in its colour, and none in the empty region of a view."""
    views = balls()
    cloud, how = hull_points(views, 2)
    distance = np.linalg.norm(cloud.points, axis=1)
    assert len(cloud) > 100 and f"{len(cloud):,} points on the hull of 8 silhouettes" in how
    assert (distance > 0.3).all() and (distance < 0.6).all()
    assert np.allclose(cloud.colors, [0.2, 0.4, 0.6], atol=1e-6)
    shapes = silhouettes(views)
    assert not in_empty_region(shapes, cloud.points).any()
    assert in_empty_region(shapes, np.array([[0, 0, 0], [0, 0.6, 0], [0.6, 0, 0]])).tolist() == [False, True, True]
    assert hull_points([views[0], dataclasses.replace(views[1], alpha=None)], 2)[0].points.shape == (0, 3)
    # a hole in one silhouette of twelve carves nothing; the same hole in a second one does
    many = balls(12)
    torn, also = (dataclasses.replace(v, alpha=np.zeros_like(v.alpha)) for v in many[:2])
    assert len(carve(silhouettes([torn, *many[1:]]))[0]) > 100 and len(carve(silhouettes([torn, also, *many[2:]]))[0]) == 0
    # whatever the source, no point starts in a place that is empty in a view
    assert fitted_region(views[0])[1] == "object"
    everywhere = PointCloud(np.random.default_rng(0).uniform(-0.8, 0.8, (3000, 3)), np.ones((3000, 3), np.float32))
    starts = [initial_points(views, everywhere, InitConfig(source=s), np.random.default_rng(0)) for s in ("hull", "points")]
    assert "left out: they are in an empty area of a view" in starts[1].how
    for cloud in (*(s.cloud for s in starts), random_points(views, 200, np.random.default_rng(0))[0]):
        assert len(cloud) >= 100 and not in_empty_region(shapes, cloud.points).any()
