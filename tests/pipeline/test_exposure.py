"""Exposures of training views: the map and its gradients, fits of photographs that differ in brightness, their run folders."""

import dataclasses
import json

import numpy as np
import pytest
import torch

import warpgs
from tests import scenes
from warpgs.app.cli import main
from warpgs.errors import UsageError
from warpgs.pipeline.metrics.scores import matched_psnr
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.stopping import rendered
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.view_modules import EXPOSURE, Exposure, RefinePoses, exposed, exposure_of
from warpgs.pipeline.train.views import half_size
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.synthetic.demo import split_spec, write_demo

CPU = torch.device("cpu")


def test_the_map_and_its_gradients():
    """Against a matrix product, and against differences."""
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(5, 7, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    m = torch.randn(12, generator=generator, dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(exposed(rgb, m), rgb + rgb @ m.view(3, 4)[:, :3].T + m.view(3, 4)[:, 3])
    assert torch.autograd.gradcheck(exposed, (rgb, m))
    zero = torch.zeros(12)
    assert torch.equal(exposed(rgb.float(), zero), rgb.float())
    rows = torch.randn(4, 12, generator=generator)
    assert exposure_of(rows, rows).mean(0).abs().max() < 1e-6


def dimmed(views, gains):
    """The views with their colours multiplied by a gain each [3]."""
    return [dataclasses.replace(v, image=(v.image * np.float32(g)).astype(np.float32)) for v, g in zip(views, gains)]


def test_photographs_of_many_exposures_make_one_model(tmp_path):
    """Held-out views, of the mean exposure, score better than without; the gains that are found are those that were made."""
    write_demo(tmp_path, views=12, width=48, height=36)
    scene = warpgs.load_scene(tmp_path)
    gains = 0.6 + 0.4 * np.array([[0.5, 0.4, 0.6], [0, 0, 0], [1, 1, 1], [0.2, 0.3, 0.1], [0.8, 0.7, 0.9], [0.5, 0.6, 0.4]])
    gains = np.concatenate([gains, gains[::-1]])[:, None, None]
    off = dimmed(scene.views, gains)
    half = scene.views[::2], dimmed(scene.views[1::2], [gains[::2].mean(0)] * 6)
    views = tuple(v for pair in zip(off[::2], half[1]) for v in pair)
    scene = dataclasses.replace(scene, views=views)
    split = f"train={','.join(v.name for v in views[::2])};test={','.join(v.name for v in views[1::2])}"
    config = FitConfig(steps=200, half_resolution=0.5)
    plain, found = (
        warpgs.fit(scene, dataclasses.replace(config, view_modules=m), split=split, device="cpu", verbose=False)
        for m in ((), (Exposure(),))
    )
    assert found.metrics["test"]["psnr"] > plain.metrics["test"]["psnr"] + 0.5
    figures = found.metrics["view_modules"]["exposure"]
    made = gains[::2, 0, 0].mean(-1) / gains[::2].mean()
    np.testing.assert_allclose([r["gain"] for r in figures["views"]], made, atol=0.05)


def fitted(views, steps, config):
    trainer = Trainer(views, scenes.seeds(), dataclasses.replace(config, steps=steps), CPU)
    while trainer.step < steps:
        trainer.advance()
    return trainer


@pytest.mark.slow
def test_steps_on_any_number_of_threads_and_continued_ones_have_the_same_bits():
    views, whole = dimmed(scenes.photos(4), [0.6, 1, 0.8, 0.9]), None
    config = FitConfig(steps=40, half_resolution=0.25, view_modules=(Exposure(), RefinePoses()))
    before = torch.get_num_threads()
    for threads in (1, 2):
        torch.set_num_threads(threads)
        try:
            found = fitted(views, 40, config).state()[0]
        finally:
            torch.set_num_threads(before)
        whole = whole or found
        assert all(torch.equal(t, found[n]) for n, t in whole.items())
    first, second = (Trainer(views, scenes.seeds(), config, CPU) for _ in range(2))
    while first.step < 20:
        first.advance()
    second.load(*first.state())
    while second.step < 40:
        second.advance()
    assert whole[f"views.params.{EXPOSURE}"].any()
    assert all(torch.equal(t, whole[n]) for n, t in second.state()[0].items())


def test_strategies_see_the_exposures_of_now():
    """Held-out blocks are compared with renders under the exposure of their view: else growth would end too early."""
    views = dimmed(scenes.photos(4), [0.6, 1, 0.8, 0.9])
    trainer = Trainer(views, scenes.seeds(), FitConfig(steps=40, view_modules=(Exposure(),), half_resolution=0.0), CPU)
    shown = [v.learned.values[EXPOSURE] for v in trainer.views]
    assert not torch.stack(shown).any()
    trainer.learned.views.table.params[EXPOSURE].data[0] = 0.3
    trainer.show_learned()
    assert torch.stack(shown).abs().min() > 0.05 and torch.stack(shown).mean(0).abs().max() < 1e-6
    options = RasterizeOptions(background=trainer.background)
    plain = rasterize(trainer.gaussians, trainer.views[0].camera, options).rgb
    assert torch.equal(rendered(trainer.gaussians, trainer.views[0], options), exposed(plain, shown[0]))
    assert half_size(trainer.views[0]).learned.values[EXPOSURE] is shown[0]


def test_runs_tell_their_exposures(tmp_path):
    """metrics.json and the report; `eval` scores without exposures, as the fit did; a resumed run has the same figures."""
    write_demo(tmp_path / "scene", views=8, width=32, height=32)
    flags = ["--preset", "3dgs", "--steps", "8", "--init.source", "random", "--init.random-count", "60", "--device", "cpu"]
    words = ["fit", str(tmp_path / "scene"), "--out", str(tmp_path / "run"), *flags, "--split", split_spec(8), "--exposure"]
    assert main(words) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    rows, summary = (metrics["view_modules"]["exposure"][key] for key in ("views", "summary"))
    assert len(rows) == 6 and np.shape(rows[0]["affine"]) == (3, 4) and rows[0]["gain"] != 1
    assert "scores use renders without learned exposures" in summary
    assert summary in (tmp_path / "run" / "report.html").read_text()
    assert main(["eval", str(tmp_path / "run"), "--device", "cpu"]) == 0
    scores = json.loads((tmp_path / "run" / "eval.json").read_text())
    assert scores["test"] == metrics["test"] and scores["train"] == metrics["train"]
    assert main([*words, "--resume"]) == 0
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["view_modules"] == metrics["view_modules"]


def test_views_that_know_their_opacity_have_no_exposure():
    views = [dataclasses.replace(v, alpha=np.ones(v.image.shape[:2], np.float32)) for v in scenes.photos(3)]
    with pytest.raises(UsageError, match=r"--exposure does not support images with an alpha channel, such as 00.png"):
        Trainer(views, scenes.seeds(), FitConfig(steps=4, view_modules=(Exposure(),)), CPU)


def test_matched_colours_score_as_equal():
    """A render of half the brightness and another tint is the photograph after the map; a photograph of one colour, too."""
    view = scenes.photos(1)[0]
    assert matched_psnr(view, 0.5 * view.image[..., ::-1] + 0.1) > 45
    flat = dataclasses.replace(view, image=np.full_like(view.image, 0.5))
    assert matched_psnr(flat, np.full_like(view.image, 0.2)) > 45
