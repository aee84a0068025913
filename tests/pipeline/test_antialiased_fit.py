"""An antialiased fit: every part renders with the filter, from the first step to the files of the run."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from PIL import Image

import warpgs
from tests.scenes import photos, ring, seeds
from warpgs.app.cli import main
from warpgs.export.base import read_with_antialiasing
from warpgs.export.meshes_and_cameras import write_cameras
from warpgs.kernels.neighbours import pixel_size
from warpgs.pipeline.metrics.scores import score
from warpgs.pipeline.model import limits
from warpgs.pipeline.model.limits import LimitConfig, TrainingCameras
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.commands import open_file
from warpgs.pipeline.train import step
from warpgs.pipeline.train.memory import most_instances
from warpgs.pipeline.train.trainer import Trainer
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Scene
from warpgs.synthetic.demo import write_demo
from warpgs.viewer.window import content_of_file, content_of_run

CPU = torch.device("cpu")
# points far below a pixel in size, so that every render with the filter is another than without
SMALL = InitConfig(source="points", scale_factor=0.02)
CONFIG = warpgs.FitConfig(steps=6, init=SMALL, antialiased=True, cpu_limit=False)
SPLIT = "train=00.png,01.png,02.png,03.png;test=04.png"


@pytest.fixture(autouse=True, scope="module")
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
def run(tmp_path_factory):
    """The result of a fit with a run folder, and the models that it showed."""
    shown = []
    folder = tmp_path_factory.mktemp("antialiased") / "run"
    result = warpgs.fit(scene(), CONFIG, split=SPLIT, out=folder, device="cpu", verbose=False, on_model=shown.append)
    return result, shown


@pytest.mark.parametrize("captured", [False, True], ids=["eager", "fixed capacity"])
def test_a_step_renders_with_the_filter(device, captured):
    """Its error is that of an image which `rasterize` renders alone; memory is planned for its instances."""
    fit = Trainer(photos(4), seeds(), CONFIG, device)
    options, plan, view = fit.context.render_options(), fit.plan_of(1), fit.views[1]
    (stack,) = fit.stacks.values()
    fit.buffers.load([1], [[0.0] * fit.buffers.lr_rows.shape[1]], [fit.settings(1)])
    render = step.eager_renderer(options, None)
    if captured:
        render = step.captured_renderer(options, 10_000, fit.buffers.stop)
    step.view_gradients(fit.learned, stack, fit.buffers, plan, render)
    errors = [((filtered(fit.gaussians, view.camera, a) - photos(4)[1].image) ** 2).mean() for a in (True, False)]
    assert fit.buffers.result()[2][0][1] == pytest.approx(errors[0], rel=1e-5)
    assert abs(errors[0] - errors[1]) > 1e-3 * errors[0]
    cameras = [v.camera for v in fit.views]
    wanted = [
        max(int(rasterize(fit.gaussians, c, RasterizeOptions(antialiased=a)).tile_counts.sum()) for c in cameras)
        for a in (True, False)
    ]
    assert most_instances(fit.gaussians, cameras, options) == wanted[0] != wanted[1]
    assert step.instance_capacity(fit.gaussians, stack, 0, options) == int(step.CAPACITY_FACTOR * wanted[0]) + 1024


@pytest.mark.cuda
def test_captured_steps_are_the_eager_ones(device):
    """The same Gaussians, to the bit, with CUDA graphs and without."""
    fits = [Trainer(photos(4), seeds(), dataclasses.replace(CONFIG, cuda_graph=g), device) for g in (True, False)]
    for fit in fits:
        while fit.step < CONFIG.steps:
            fit.advance(CONFIG.steps)
    for name, t in fits[0].gaussians.tensors().items():
        assert torch.equal(t, fits[1].gaussians.tensors()[name]), name


def test_scores_models_and_images_have_the_filter(run):
    """Of the fit, of each step, of the folder, of the viewer; scores and images are of renders with it."""
    result, shown = run
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


def test_a_continued_fit_equals_one_in_one_go(run, tmp_path):
    """A run that stopped half-way, to the bit; and not without the setting, which is another fit."""

    def stop(report):
        if report.step == CONFIG.steps // 2:
            raise KeyboardInterrupt

    whole, _ = run
    how = {"split": SPLIT, "out": tmp_path / "run", "device": "cpu", "verbose": False}
    config = dataclasses.replace(CONFIG, checkpoint_every=1, checkpoint_seconds=0.0)
    with pytest.raises(KeyboardInterrupt):
        warpgs.fit(scene(), config, on_step=stop, **how)
    with pytest.raises(warpgs.errors.UsageError, match="antialiased"):
        warpgs.fit(scene(), dataclasses.replace(config, antialiased=False), resume=True, **how)
    result = warpgs.fit(scene(), config, resume=True, **how)
    for name, t in result.gaussians().tensors().items():
        assert torch.equal(t, getattr(whole.gaussians(), name)), name


def test_no_axis_is_below_what_cameras_resolve(monkeypatch):
    """With the default limit every axis ends at 0.45 px or above of the finest camera; without the flag many are below."""
    monkeypatch.setattr(limits, "MIN_PIXELS", 0.2**0.5)
    rows = TrainingCameras.of(ring(4), CPU).rows
    below = []
    for antialiased in (True, False):
        fit = Trainer(photos(4), seeds(), dataclasses.replace(CONFIG, limits=LimitConfig(), antialiased=antialiased), CPU)
        while fit.step < CONFIG.steps:
            fit.advance()
        smallest = pixel_size(fit.gaussians.means, rows, 0.2**0.5)
        below.append(int((fit.gaussians.log_scales < smallest[:, None] - 1e-5).sum()))
    assert below[0] == 0 < below[1]


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
