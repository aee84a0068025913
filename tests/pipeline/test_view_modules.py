"""A view module of a user's own, in one file: fits, goes on from checkpoints, and stands in the report."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from tests.scenes import photos, seeds
from warpgs.app.cli import main
from warpgs.app.fit import request_of
from warpgs.errors import UsageError
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.folder import open_run
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.view_modules import VIEW_MODULES, Exposure, RefinePoses, ViewModule
from warpgs.pipeline.train.views import current
from warpgs.synthetic.demo import split_spec, write_demo

CPU = torch.device("cpu")
PLAIN = FitConfig(steps=60, init=InitConfig(source="points"), sh_degree=0)
OWN = '''
from dataclasses import dataclass, replace

import torch

import warpgs


@dataclass(frozen=True)
class Vignetting(warpgs.ViewModule):
    """Learn how much darker the corners of each view are."""

    lr: float = 0.02
    """Learning rate."""

    def parameters(self, views):
        return {"falloff": torch.zeros(len(views), 1)}

    def lrs(self, progress, extent):
        return {"falloff": self.lr * (1 - progress)}

    def after_render(self, rgb, values):
        rows, columns = (torch.linspace(-1, 1, n, device=rgb.device) for n in rgb.shape[:2])
        return rgb * (1 - values["falloff"] * (rows[:, None].square() + columns.square()) / 2)[..., None]

    def regularisation(self, values):
        return 1e-3 * values["falloff"].square().sum()

    def bytes(self, sizes):
        return {"loss": 4 * 5 * sizes.pixels}

    def figures(self, fitted):
        found = fitted.params["falloff"][:, 0].tolist()
        return {"views": dict(zip(fitted.train, found)), "summary": f"corners are up to {max(found):.6f} darker"}


@dataclass(frozen=True)
class Zoom(warpgs.ViewModule):
    """Learn a factor of each focal length."""

    def parameters(self, views):
        return {"zoom": torch.zeros(len(views), 1)}

    def lrs(self, progress, extent):
        return {"zoom": 1e-3}

    def before_render(self, camera, values):
        factor = 1 + values["zoom"][:, :, None] * torch.tensor([[1.0], [1.0], [0.0]]) * torch.tensor([1.0, 1.0, 0.0])
        return replace(camera, K=camera.K * factor)

    def cameras(self, given, train, test, params):
        zooms = zip(train, (1 + params["zoom"][:, 0]).tolist())
        return dict(given) | {n: replace(given[n], K=given[n].K * [[z, 1, 1], [1, z, 1], [1, 1, 1]]) for n, z in zooms}
'''


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The file, and the registry without what a test adds to it."""
    VIEW_MODULES.names()
    monkeypatch.setattr(VIEW_MODULES, "_classes", dict(VIEW_MODULES._classes))
    (tmp_path / "own.py").write_text(OWN)
    return str(tmp_path / "own.py")


def vignetted(views, falloffs):
    """The views, each darker in its corners by a fraction."""
    found = []
    for v, f in zip(views, falloffs):
        rows, columns = (np.linspace(-1, 1, n, dtype=np.float32) for n in v.image.shape[:2])
        shade = 1 - f * (rows[:, None] ** 2 + columns**2) / 2
        found.append(dataclasses.replace(v, image=(v.image * shade[..., None]).astype(np.float32)))
    return found


def advanced(fit: Trainer, until: int) -> Trainer:
    while fit.step < until:
        fit.advance()
    return fit


def test_its_parameters_are_learned_shown_and_kept(own):
    """What was made is found; strategies and a failed step see it; both sizes share it; a continued fit has the same bits."""
    vignetting = VIEW_MODULES.load(f"{own}:Vignetting")
    even, views = photos(3), vignetted(photos(3), [0.0, 0.6, 0.0])
    config = dataclasses.replace(PLAIN, view_modules=(vignetting(), RefinePoses()), half_resolution=0.5, steps=120)
    fit = advanced(Trainer(views, seeds(), config, CPU), 120)
    tensors, _ = fit.state()
    falloffs = tensors["views.params.falloff"][:, 0].tolist()
    without = advanced(Trainer(even, seeds(), config, CPU), 120).state()[0]["views.params.falloff"][:, 0].tolist()
    more = [a - b for a, b in zip(falloffs, without)]
    assert more[1] > 0.1 + max(more[0], more[2], 0)
    assert {"views.exp_avg.falloff", "views.params.pose_rotation"} <= tensors.keys()

    fit.show_learned()
    shown = fit.views[1].seen(torch.ones(32, 40, 3))
    assert fit.views[1].learned.values["falloff"].tolist() == falloffs[1:2] and float(shown[0, 0, 0] / shown[16, 20, 0]) < 0.95

    first = advanced(Trainer(views, seeds(), config, CPU), 70)
    second = Trainer(views, seeds(), FitConfig.from_json(json.loads(json.dumps(config.to_json()))), CPU)
    second.load(*first.state())
    assert all(torch.equal(t, tensors[n]) for n, t in advanced(second, 120).state()[0].items())


def test_a_run_with_one_of_ones_own(own, tmp_path, capsys):
    """Its figures and its summary are in metrics and report; its cameras open without its code; --resume names it again."""
    write_demo(tmp_path / "scene", views=8, width=32, height=32)
    flags = ["--preset", "3dgs", "--steps", "8", "--init.source", "random", "--init.random-count", "60", "--device", "cpu"]
    words = ["fit", str(tmp_path / "scene"), "--out", str(tmp_path / "run"), *flags, "--split", split_spec(8)]
    named = ["--view-modules", f"{own}:Vignetting,{own}:Zoom", "--vignetting.lr", "0.05", "--exposure"]
    assert main([*words, *named]) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    figures = metrics["view_modules"][f"{own}:Vignetting"]
    assert len(figures["views"]) == 6 and all(figures["views"].values()) and "exposure" in metrics["view_modules"]
    report = (tmp_path / "run" / "report.html").read_text()
    assert figures["summary"] in report and "Zoom: zoom of 6 training views learned" in report
    run, record = open_run(tmp_path / "run", "cpu"), json.loads((tmp_path / "run" / "config.json").read_text())
    for name, camera in run.scene_cameras.items():
        assert (camera.K[0, 0] != record["cameras"][name]["K"][0][0]) == (name in run.train)
    assert record["config"]["view_modules"][0] == {"name": f"{own}:Vignetting", "lr": 0.05}
    assert main(["eval", str(tmp_path / "run"), "--device", "cpu"]) == 0
    assert json.loads((tmp_path / "run" / "eval.json").read_text())["train"] == metrics["train"]
    capsys.readouterr()
    assert main([*words, "--exposure", "--resume"]) == 2
    assert f"give --view-modules {own}:Vignetting,{own}:Zoom again" in capsys.readouterr().err
    assert main([*words, *named, "--resume"]) == 0
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["view_modules"] == metrics["view_modules"]


def test_cameras_of_now_are_those_that_steps_render_from(own):
    """Intrinsics too, at both sizes; stacks keep what was given."""
    zoom = VIEW_MODULES.load(f"{own}:Zoom")()
    fit = advanced(Trainer(photos(3), seeds(), dataclasses.replace(PLAIN, view_modules=(zoom,), half_resolution=0.5), CPU), 20)
    factors = 1 + fit.learned.views.table.params["zoom"].detach()[:, 0]
    assert (factors != 1).all()
    given = [float(v.camera.K[0, 0]) for v in photos(3)]
    fit.show_learned()
    torch.testing.assert_close(torch.stack([v.camera.K[0, 0] for v in fit.views]), torch.tensor(given) * factors)
    fit.set_views(fit.views)
    for stack in fit.stacks.values():
        half = stack.size[0] / photos(1)[0].camera.width
        torch.testing.assert_close(stack.Ks[:, 0, 0], torch.tensor(given) * half)
        torch.testing.assert_close(current(stack, fit.learned.views).Ks[:, 0, 0], torch.tensor(given) * half * factors)


def test_each_of_ours_has_a_flag(own):
    """Beside --view-modules, which takes ours and a user's own; a farm's ``false`` is --no-."""

    def modules(*words):
        return request_of(["scene", "--out", "x", *words], "").config.view_modules

    assert VIEW_MODULES.names() == ["exposure", "refine_poses"]
    assert modules() == () == modules("--exposure", "--no-exposure")
    assert modules("--refine_poses", "--refine-poses.start", "0.5") == (RefinePoses(start=0.5),)
    assert modules("--exposure", "--exposure.lr=0.1", "--view-modules", "refine_poses") == (RefinePoses(), Exposure(lr=0.1))


def test_modules_that_cannot_be_are_refused(own):
    """Without a name of their own, twice, with one name for two parameters, and settings out of range."""

    @dataclasses.dataclass(frozen=True)
    class Unnamed(ViewModule):
        def parameters(self, views):
            return {"falloff": torch.zeros(len(views))}

    vignetting = VIEW_MODULES.load(f"{own}:Vignetting")()
    for modules, message in [
        ((Unnamed(),), "Unnamed has no registered name"),
        ((Exposure(), Exposure(lr=1.0)), "'exposure' is given twice"),
        ((0.5,), r"0\.5 is not a view module"),
    ]:
        with pytest.raises(UsageError, match=message):
            FitConfig(view_modules=modules)
    config = dataclasses.replace(PLAIN, view_modules=(vignetting, VIEW_MODULES.register("twin")(Unnamed)()))
    with pytest.raises(UsageError, match="Vignetting' and 'twin' both have a parameter 'falloff'; rename"):
        Trainer(photos(2), seeds(), config, CPU)
    for settings in ({"lr": 0.0}, {"decay": 2e6}, {"weight": -1.0}):
        with pytest.raises(UsageError, match=rf"exposure\.{next(iter(settings))} must be in "):
            Exposure(**settings)
    for settings in ({"rotation_lr": float("nan")}, {"start": 1.0}):
        with pytest.raises(UsageError, match=rf"refine-poses\.{next(iter(settings)).replace('_', '-')} must be in "):
            RefinePoses(**settings)
