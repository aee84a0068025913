"""The method `warpgs` of nerfstudio, `ns-train warpgs --data SCENE`, which finds it by entry point; nothing else imports it.

`warpgs.fit` replaces nerfstudio's training loop. The result is a splatfacto model that our rasterizer renders: the viewer,
`ns-render`, `ns-eval` and `ns-export gaussian-splat` use it as any splatfacto model.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification
from torch import Tensor

import warpgs

USED = {"_target", "preset", "background_color", "rasterize_mode", "color_corrected_metrics", "prompt"}
"""Settings of a model that have an effect."""
SHOWN = 10
"""Steps between models that the viewer gets."""


def camera_of(cameras: Cameras, index: int) -> warpgs.Camera:
    """Return one of nerfstudio's cameras (x right, y up, z backward) as a pinhole, as splatfacto does."""
    turned = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64, device="cpu")
    pose = cameras.camera_to_worlds[index].detach().cpu().double()
    viewmat = torch.eye(4, dtype=torch.float64, device="cpu")
    viewmat[:3, :3] = (pose[:, :3] * turned).mT
    viewmat[:3, 3] = -viewmat[:3, :3] @ pose[:, 3]
    K = cameras.get_intrinsics_matrices()[index].detach().cpu().double()
    return warpgs.Camera(viewmat, K, int(cameras.width[index]), int(cameras.height[index]))


def scene_of(data: FullImageDatamanager[Any]) -> warpgs.Scene:
    """Return the training set in nerfstudio's units. Its images are undistorted; transparent ones are shown on black."""
    views, folder = [], data.get_datapath()
    for i, batch in enumerate(data.cached_train):  # reading it undistorts images and cameras
        image, mask = batch["image"].cpu(), batch.get("mask")
        image = image.float() / 255 if image.dtype == torch.uint8 else image
        alpha = image[..., 3] if image.shape[-1] == 4 else None
        views.append(
            warpgs.View(
                name=os.path.relpath(data.train_dataset.image_filenames[i], folder),
                camera=camera_of(data.train_dataset.cameras, i),
                image=(image[..., :3] if alpha is None else image[..., :3] * alpha[..., None]).numpy(),
                mask=None if mask is None else mask.squeeze(-1).cpu().bool().numpy(),
                alpha=None if alpha is None else alpha.numpy(),
            )
        )
    found, points = data.train_dataparser_outputs.metadata, None
    if "points3D_xyz" in found:
        points = warpgs.PointCloud(found["points3D_xyz"].double().numpy(), (found["points3D_rgb"].float() / 255).numpy())
    return warpgs.Scene(str(folder), "nerfstudio", tuple(views), points)


@dataclass
class WarpgsModelConfig(SplatfactoModelConfig):
    """Settings of the model. Those of splatfacto's training have no effect."""

    _target: type = field(default_factory=lambda: WarpgsModel)
    preset: str = "default"
    """Preset of warpgs, or a .toml file with settings of the fit"""
    background_color: Literal["random", "black", "white"] = "random"
    """Colour behind the Gaussians; random for the one that warpgs chooses, such as the mean of the images"""


class WarpgsModel(SplatfactoModel):
    """A splatfacto model that our rasterizer renders."""

    config: WarpgsModelConfig
    behind: Tensor
    """Colour behind the Gaussians, shape [3]."""

    def populate_modules(self) -> None:
        """Begin with random Gaussians, which the fit replaces."""
        usual = WarpgsModelConfig()
        names = [f.name for f in fields(usual) if f.name not in USED]
        changed = [n.replace("_", "-") for n in names if getattr(self.config, n) != getattr(usual, n)]
        if changed:
            raise warpgs.UsageError(f"--pipeline.model.{changed[0]} is splatfacto's; use --pipeline.model.preset FILE.toml")
        self.seed_points = None
        super().populate_modules()
        self.register_buffer("behind", torch.zeros(3, dtype=torch.float32, device="cpu"))

    def get_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """Return nothing to optimise: the fit has its own optimizer."""
        return {}

    def get_training_callbacks(self, training_callback_attributes: object) -> list[Any]:
        """Return no callbacks: the fit has its own strategy."""
        return []

    def take(self, fitted: Any) -> None:
        """Copy the N Gaussians and the background of a `warpgs.FitResult`; absent coefficients of harmonics become 0."""
        values = {n: t.detach().clone() for n, t in fitted.gaussians().tensors().items()}
        rest = values["means"].new_zeros(len(values["means"]), self.features_rest.shape[1], 3)
        rest[:, : values["sh"].shape[1] - 1] = values["sh"][:, 1:]
        named = {
            "means": values["means"], "scales": values["log_scales"], "quats": values["quats"],
            "features_dc": values["sh"][:, 0], "features_rest": rest, "opacities": values["logit_opacities"][:, None],
        }  # fmt: skip
        self.gauss_params = torch.nn.ParameterDict({n: torch.nn.Parameter(t, requires_grad=False) for n, t in named.items()})
        self.behind = fitted.options().background

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:
        """Return rgb, depth, accumulation and background of one camera, shape [H, W, D]."""
        kept = slice(None) if self.crop_box is None else self.crop_box.within(self.means)
        parts = {n: t[kept] for n, t in self.gauss_params.items()}
        sh = torch.cat([parts["features_dc"][:, None], parts["features_rest"]], 1)
        shapes = parts["means"], parts["quats"], parts["scales"], parts["opacities"].squeeze(-1)
        options = warpgs.RasterizeOptions(background=self.behind, antialiased=self.config.rasterize_mode == "antialiased")
        render = warpgs.rasterize(warpgs.Gaussians(*shapes, sh), camera_of(camera, 0), options)
        return {
            "rgb": render.rgb.clamp(0, 1),
            "depth": torch.where(render.alpha > 0, render.depth, render.depth.max())[..., None],
            "accumulation": render.alpha[..., None],
            "background": self.behind.expand_as(render.rgb),
        }


@dataclass
class WarpgsTrainerConfig(TrainerConfig):
    """Settings of a training run."""

    _target: type = field(default_factory=lambda: WarpgsTrainer)
    max_num_iterations: int = 0
    """Number of steps; 0 for a number chosen by the number of images"""


class WarpgsTrainer(Trainer):
    """A trainer whose loop is `warpgs.fit`."""

    config: WarpgsTrainerConfig

    def train(self) -> None:
        """Fit, show and save the model."""
        if self._start_step:
            raise warpgs.UsageError("warpgs cannot continue a checkpoint of nerfstudio; leave out --load-dir")
        data, model, config = self.pipeline.datamanager, self.pipeline.model, self.config
        data.train_dataparser_outputs.save_dataparser_transform(Path(self.base_dir) / "dataparser_transforms.json")
        self._init_viewer_state()
        chosen: dict[str, Any] = {"steps": config.max_num_iterations} if config.max_num_iterations else {}
        if model.config.background_color != "random":
            chosen["background"] = model.config.background_color
        antialiased = model.config.rasterize_mode == "antialiased"
        with self.train_lock:
            result = warpgs.fit(
                scene_of(data), model.config.preset, device=self.device, on_model=self.after_step, antialiased=antialiased,
                seed=config.machine.seed, **chosen,
            )  # fmt: skip
            model.take(result)
        self.step = result.step
        self._after_train()

    def after_step(self, fitted: Any) -> None:
        """Save a checkpoint if one is due, and let the viewer render."""
        save = self.config.steps_per_save and fitted.step % self.config.steps_per_save == 0
        show = self.viewer_state is not None and fitted.step % SHOWN == 0
        if save or show:
            self.step = fitted.step
            self.pipeline.model.take(fitted)
        if save:
            self.save_checkpoint(fitted.step)
        if show:
            self.train_lock.release()  # the viewer renders in a thread of its own
            try:
                self._update_viewer_state(fitted.step)
                while self.training_state == "paused":
                    time.sleep(0.01)
            finally:
                self.train_lock.acquire()


METHOD = MethodSpecification(
    config=WarpgsTrainerConfig(
        method_name="warpgs",
        pipeline=VanillaPipelineConfig(
            datamanager=FullImageDatamanagerConfig(
                dataparser=NerfstudioDataParserConfig(load_3D_points=True), cache_images_type="uint8"
            ),
            model=WarpgsModelConfig(),
        ),
        optimizers={},
        logging=LoggingConfig(local_writer=LocalWriterConfig(enable=False)),  # a fit prints its own progress
        vis="viewer",
    ),
    description="Gaussians from 3 to 300 photographs, by warpgs",
)
