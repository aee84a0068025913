"""warpgs as a method of nerfbaselines: the method and its registration.

    pip install nerfbaselines
    export NERFBASELINES_REGISTER=$PWD/examples/methods/nerfbaselines_warpgs.py PYTHONPATH=$PWD/examples/methods
    nerfbaselines train --method warpgs --backend python --data path/to/scene --output results --set steps=1000

An iteration of nerfbaselines is a whole fit, since `warpgs.fit` chooses and ends its steps. `--set` takes arguments of
`warpgs.fit`, such as ``preset=quick`` or ``seed=1``.
"""

import json
import os
from pathlib import Path
from typing import Any

import warpgs

import numpy as np
import torch
from nerfbaselines import Method, register

INFO = {
    "method_id": "warpgs",
    "required_features": frozenset(("color", "points3D_xyz", "points3D_rgb")),
    "supported_camera_models": frozenset(("pinhole",)),  # nerfbaselines undistorts the others
    "supported_outputs": ("color", "depth", "accumulation"),
}
MODEL, SETTINGS = "gaussians.safetensors", "settings.json"


def value_of(setting: Any) -> Any:
    """Return a number, truth value or list that `--set` passed as text; other text as it is."""
    try:
        return json.loads(setting) if isinstance(setting, str) else setting
    except ValueError:
        return setting


def camera_of(camera: Any, normalization: warpgs.Normalization) -> warpgs.Camera:
    """Return a camera of nerfbaselines, world from camera in the axes of OpenCV, in scene units."""
    pose, (fx, fy, cx, cy) = camera.poses.astype(np.float64), camera.intrinsics.astype(np.float64)
    viewmat = np.eye(4)
    viewmat[:3, :3] = pose[:3, :3].T
    viewmat[:3, 3] = -viewmat[:3, :3] @ (normalization.scale * (pose[:3, 3] - normalization.offset))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    width, height = map(int, camera.image_sizes)
    return warpgs.Camera(viewmat, K, width, height)


def scene_of(dataset: dict[str, Any], background: list[float]) -> warpgs.Scene:
    """Return a training set in scene units: the mean camera in the origin, the farthest at a distance of 1 / 1.1."""
    centers = dataset["cameras"].poses[:, :3, 3].astype(np.float64)
    offset = centers.mean(0)
    scale = 1 / (1.1 * float(np.linalg.norm(centers - offset, axis=1).max()))
    normalization, views = warpgs.Normalization(offset, scale), []
    for i, camera in enumerate(dataset["cameras"]):
        image = dataset["images"][i].astype(np.float32) / 255
        alpha = image[..., 3] if image.shape[-1] == 4 else None
        if alpha is not None:
            image = image[..., :3] * alpha[..., None] + np.array(background, np.float32) * (1 - alpha[..., None])
        mask = None if dataset["masks"] is None else dataset["masks"][i] > 0
        name = os.path.relpath(dataset["image_paths"][i], dataset["image_paths_root"])
        views.append(warpgs.View(name, camera_of(camera, normalization), image, mask=mask, alpha=alpha))
    points = None
    if dataset["points3D_xyz"] is not None:
        points = warpgs.PointCloud(scale * (dataset["points3D_xyz"] - offset), dataset["points3D_rgb"] / np.float32(255))
    r, g, b = background
    return warpgs.Scene(dataset["image_paths_root"], "nerfbaselines", tuple(views), points, normalization, background=(r, g, b))


class Warpgs(Method):  # type: ignore[misc]
    """A fit of warpgs."""

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: dict[str, Any] | None = None,
        config_overrides: dict[str, Any] | None = None,
    ) -> None:
        """Load a checkpoint, or keep the training set for the first iteration."""
        self.checkpoint, self.dataset = checkpoint, train_dataset
        self.model: warpgs.Model | None = None
        arguments = {name: value_of(setting) for name, setting in (config_overrides or {}).items()}
        self.settings: dict[str, Any] = {"arguments": arguments, "background": [0, 0, 0], "antialiased": False}
        self.device = "cuda" if torch.cuda.is_available() else "cpu"
        if checkpoint is not None:
            self.model = warpgs.load(Path(checkpoint) / MODEL, self.device)
            self.settings = json.loads((Path(checkpoint) / SETTINGS).read_text("utf-8"))

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        """Return what nerfbaselines needs to know before it reads a scene."""
        return INFO

    def get_info(self) -> dict[str, Any]:
        """Return the number of iterations, and what was loaded."""
        loaded = {"loaded_step": None if self.checkpoint is None else 1, "loaded_checkpoint": self.checkpoint}
        return {**INFO, **loaded, "num_iterations": 1, "hparams": self.settings["arguments"]}

    def train_iteration(self, step: int) -> dict[str, float]:
        """Fit the training set; return loss and PSNR of the last step."""
        assert self.dataset is not None, "this method was loaded to render: pass train_dataset"
        color = self.dataset["metadata"].get("background_color")
        background = [0.0, 0.0, 0.0] if color is None else [float(c) / 255 for c in color]
        reports: list[warpgs.StepReport] = []
        result = warpgs.fit(
            scene_of(self.dataset, background), device=self.device, on_step=reports.append, **self.settings["arguments"]
        )
        self.model, self.checkpoint = result, None
        self.settings |= {"background": result.background, "antialiased": result.antialiased}
        return {"loss": reports[-1].loss, "psnr": reports[-1].psnr, "num_gaussians": float(reports[-1].count)}

    def save(self, path: str) -> None:
        """Write the model and its settings into a folder."""
        assert self.model is not None, "there is no model before the first iteration"
        os.makedirs(path, exist_ok=True)
        if self.checkpoint is None:
            warpgs.save(Path(path) / MODEL, self.model.gaussians(), self.model.normalization)
        else:  # the same bytes again: a safetensors header has no fixed order
            (Path(path) / MODEL).write_bytes((Path(self.checkpoint) / MODEL).read_bytes())
        (Path(path) / SETTINGS).write_text(json.dumps(self.settings), "utf-8")

    def render(self, camera: Any, *, options: dict[str, Any] | None = None) -> dict[str, np.ndarray]:
        """Render one camera; depth is in the units of the data set."""
        assert self.model is not None, "there is no model before the first iteration"
        background = torch.tensor(self.settings["background"], dtype=torch.float32, device=self.device)
        chosen = warpgs.RasterizeOptions(background=background, antialiased=self.settings["antialiased"])
        with torch.no_grad():
            render = warpgs.rasterize(self.model.gaussians(), camera_of(camera.item(), self.model.normalization), chosen)
        images = {"color": render.rgb.clamp(0, 1), "accumulation": render.alpha}
        images["depth"] = render.depth / self.model.normalization.scale
        return {name: image.cpu().numpy() for name, image in images.items()}


if __name__ != "nerfbaselines_warpgs":  # nerfbaselines runs this file to register it, and then imports it
    register(
        {
            "id": "warpgs",
            "method_class": "nerfbaselines_warpgs:Warpgs",
            "backends_order": ["python"],
            "metadata": {"name": "warpgs", "description": "Sparse-view Gaussian splatting with NVIDIA Warp."},
        }
    )
