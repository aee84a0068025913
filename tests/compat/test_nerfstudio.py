"""The method of nerfstudio, on stand-ins for the classes of nerfstudio that it uses; nerfstudio itself is no dependency."""

import dataclasses
import importlib
import sys
import threading
import tomllib
import types
from pathlib import Path

import numpy as np
import pytest
import torch

import warpgs

FLIP = np.array([1.0, -1.0, -1.0])
"""From the axes of OpenCV to those of nerfstudio, and back."""


class Cameras:
    """nerfstudio's cameras: world from camera, y up and z backward."""

    def __init__(self, cameras):
        worlds = [np.linalg.inv(c.viewmat)[:3] * np.append(FLIP, 1) for c in cameras]
        self.camera_to_worlds = torch.tensor(np.array(worlds), dtype=torch.float32)
        self.Ks = torch.tensor(np.array([c.K for c in cameras]), dtype=torch.float32)
        self.width, self.height = (torch.tensor([[getattr(c, n)] for c in cameras]) for n in ("width", "height"))

    def get_intrinsics_matrices(self):
        return self.Ks


@dataclasses.dataclass
class SplatfactoModelConfig:
    _target: type = None
    background_color: str = "random"
    rasterize_mode: str = "classic"
    warmup_length: int = 500


class SplatfactoModel(torch.nn.Module):
    def __init__(self, config, seed_points=None):
        super().__init__()
        self.config, self.crop_box, self.seed_points = config, None, seed_points
        self.populate_modules()

    def populate_modules(self):
        assert self.seed_points is None  # nerfstudio moves these to CUDA
        self.gauss_params = torch.nn.ParameterDict({"features_rest": torch.zeros(100, 15, 3)})

    means = property(lambda self: self.gauss_params["means"])
    features_rest = property(lambda self: self.gauss_params["features_rest"])


@dataclasses.dataclass
class TrainerConfig:
    _target: type = None
    method_name: str = ""
    pipeline: object = None
    optimizers: dict = None
    logging: object = None
    vis: str = ""
    steps_per_save: int = 0
    machine: object = dataclasses.field(default_factory=lambda: types.SimpleNamespace(seed=42))


class Trainer:
    def __init__(self, config, data, model, base_dir):
        self.config, self.base_dir, self.device, self._start_step = config, base_dir, "cpu", 0
        self.pipeline = types.SimpleNamespace(datamanager=data, model=model)
        self.train_lock, self.viewer_state, self.training_state = threading.Lock(), object(), "training"
        self.events = []

    def _init_viewer_state(self):
        self.events.append("viewer")

    def _update_viewer_state(self, step):
        with self.train_lock:  # as the thread that renders
            self.events.append(("show", step, len(self.pipeline.model.means)))

    def save_checkpoint(self, step):
        self.events.append(("save", step, len(self.pipeline.model.means)))

    def _after_train(self):
        self.save_checkpoint(self.step)


class Config(types.SimpleNamespace):
    """A class of settings."""


@pytest.fixture
def plugin(monkeypatch):
    """The module of the entry point, between the stand-ins."""
    parts = {
        "cameras.cameras": {"Cameras": Cameras},
        "configs.base_config": {"LocalWriterConfig": Config, "LoggingConfig": Config},
        "data.datamanagers.full_images_datamanager": {"FullImageDatamanager": object, "FullImageDatamanagerConfig": Config},
        "data.dataparsers.nerfstudio_dataparser": {"NerfstudioDataParserConfig": Config},
        "engine.trainer": {"Trainer": Trainer, "TrainerConfig": TrainerConfig},
        "models.splatfacto": {"SplatfactoModel": SplatfactoModel, "SplatfactoModelConfig": SplatfactoModelConfig},
        "pipelines.base_pipeline": {"VanillaPipelineConfig": Config},
        "plugins.types": {"MethodSpecification": Config},
    }
    for name, values in parts.items():
        module = types.ModuleType(f"nerfstudio.{name}")
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, module.__name__, module)
    text = (Path(warpgs.__file__).parent.parent / "pyproject.toml").read_text("utf-8")
    (entry,) = tomllib.loads(text)["project"]["entry-points"]["nerfstudio.method_configs"].values()
    name, _, attribute = entry.partition(":")
    monkeypatch.delitem(sys.modules, name, raising=False)
    module = importlib.import_module(name)
    assert getattr(module, attribute).config.method_name == "warpgs"
    yield module
    sys.modules.pop(name)


def data_of(scene, batches):
    """A datamanager of nerfstudio with a scene of ours; reading its images changes its cameras, as when it undistorts."""

    class Data:
        train_dataset = types.SimpleNamespace(
            cameras=None, image_filenames=[Path(scene.path) / "images" / v.name for v in scene.views]
        )
        train_dataparser_outputs = types.SimpleNamespace(
            metadata={
                "points3D_xyz": torch.tensor(scene.points.points, dtype=torch.float32),
                "points3D_rgb": torch.tensor(scene.points.colors * 255).byte(),
            },
            save_dataparser_transform=lambda path: path.write_text("{}"),
        )

        @property
        def cached_train(self):
            self.train_dataset.cameras = Cameras([v.camera for v in scene.views])
            return batches

        def get_datapath(self):
            return Path(scene.path)

    return Data()


def test_a_fit_becomes_a_splatfacto_model(plugin, demo, tmp_path, monkeypatch):
    """nerfstudio's cameras show what the cameras of the fit show, on its background; viewer and checkpoints follow; a crop."""
    results, fit = [], warpgs.fit
    monkeypatch.setattr(warpgs, "fit", lambda *of, **options: results.append(fit(*of, **options)) or results[0])
    scene = warpgs.load_scene(demo)
    data = data_of(scene, [{"image": torch.tensor(v.image * 255).byte()} for v in scene.views])
    model = plugin.WarpgsModel(plugin.WarpgsModelConfig(preset="quick"), seed_points=object())
    trainer = plugin.WarpgsTrainer(plugin.WarpgsTrainerConfig(max_num_iterations=40, steps_per_save=25), data, model, tmp_path)
    trainer.train()
    assert (tmp_path / "dataparser_transforms.json").is_file() and trainer.events[0] == "viewer"
    assert [e[:2] for e in trainer.events[1:]] == [
        ("show", 10),
        ("show", 20),
        ("save", 25),
        ("show", 30),
        ("show", 40),
        ("save", 40),
    ]
    assert not trainer.train_lock.locked() and min(e[2] for e in trainer.events[1:]) > 100
    assert model.get_param_groups() == {} and model.get_training_callbacks(None) == []

    cameras = Cameras([v.camera for v in scene.views])
    outputs, shape = model.get_outputs(cameras), scene.views[0].image.shape[:2]
    wanted = warpgs.rasterize(results[0].gaussians(), scene.views[0].camera, results[0].options())
    torch.testing.assert_close(outputs["rgb"], wanted.rgb.clamp(0, 1), atol=1e-4, rtol=0)
    assert torch.equal(outputs["background"][0, 0], model.behind) and 0.2 < float(model.behind.mean()) < 0.8
    assert {n: tuple(t.shape) for n, t in outputs.items()} == {
        "rgb": (*shape, 3), "depth": (*shape, 1), "accumulation": (*shape, 1), "background": (*shape, 3)
    }  # fmt: skip
    assert float(outputs["depth"].min()) > 0 and model.features_rest.shape[1:] == (15, 3)
    model.crop_box = types.SimpleNamespace(within=lambda means: means[:, 0] > float(means[:, 0].median()))
    cropped = model.get_outputs(cameras)["accumulation"]
    assert 0 < float(cropped.mean()) < float(outputs["accumulation"].mean())
    model.crop_box = types.SimpleNamespace(within=lambda means: means[:, 0] > 1e9)
    assert not model.get_outputs(cameras)["accumulation"].any()


def test_the_training_set_is_read_whole(plugin, demo):
    """Pixels of bytes and floats, masks, transparency on black, points, and names that differ by folder."""
    scene = warpgs.load_scene(demo)
    alpha = torch.rand(*scene.views[0].image.shape[:2], 1, generator=torch.Generator().manual_seed(0))
    colors = torch.tensor(scene.views[0].image)
    data = data_of(scene, [{"image": torch.cat([colors, alpha], -1)}, {"image": (colors * 255).byte(), "mask": alpha > 0.5}])
    read = plugin.scene_of(data)
    assert read.views[0].name == f"images/{scene.views[0].name}" and np.array_equal(read.views[0].alpha, alpha[..., 0])
    np.testing.assert_allclose(read.views[0].image, colors * alpha, atol=1e-6)
    np.testing.assert_allclose(read.views[1].image, colors, atol=1 / 255)
    assert np.array_equal(read.views[1].mask, alpha[..., 0] > 0.5) and read.views[0].mask is read.views[1].alpha is None
    np.testing.assert_allclose(read.points.points, scene.points.points, atol=1e-5)
    for view, wanted in zip(read.views, scene.views):
        np.testing.assert_allclose(view.camera.viewmat, wanted.camera.viewmat, atol=1e-6)
        np.testing.assert_allclose(view.camera.K, wanted.camera.K, rtol=1e-6)


def test_what_has_no_effect_is_refused(plugin, tmp_path):
    """A setting of splatfacto's training, and a checkpoint to continue from."""
    with pytest.raises(warpgs.UsageError, match=r"--pipeline\.model\.warmup-length .*preset FILE\.toml"):
        plugin.WarpgsModel(plugin.WarpgsModelConfig(warmup_length=1))
    trainer = plugin.WarpgsTrainer(plugin.WarpgsTrainerConfig(), None, None, tmp_path)
    trainer._start_step = 100
    with pytest.raises(warpgs.UsageError, match="cannot continue"):
        trainer.train()
