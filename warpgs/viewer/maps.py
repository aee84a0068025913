"""Images that the browser cannot draw, rendered here at its camera: view-dependent colours, depth, coverage, error."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import torch

from warpgs.geometry import matmul
from warpgs.pipeline.metrics.coverage_map import MIN_ALPHA, DepthView, coverage_map, depth_views
from warpgs.pipeline.metrics.coverage_scores import classes_of
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.report.coverage_image import coverage_image
from warpgs.report.images import depth_map, error_map
from warpgs.scene import Camera, Gaussians
from warpgs.viewer.camera_conventions import stands_at
from warpgs.viewer.content import Content

GAUSSIANS, RENDER, DEPTH, COVERAGE, ERROR = "Gaussians (browser)", "render", "depth", "coverage", "error"
MAPS = {
    RENDER: "view-dependent colours, by the rasterizer of the fit",
    DEPTH: "near: warm colours; far: cold colours; gray: opacity of at most one half",
    COVERAGE: "striped magenta: seen by no training view; amber: seen by one",
    ERROR: "difference from the photograph at the camera that you stepped into; 0.3 and more is brightest",
}
"""Images by name, with their descriptions."""
NEAR = 1e-3
"""Distance from a known camera, as a fraction of the cameras' extent, within which a browser's camera counts as there."""


class Maps:
    """Renders images of one model; depths of its training views are rendered once, when coverage is first requested."""

    def __init__(self, content: Content, extent: float):
        """Keep the model; ``extent`` is the extent of its cameras [u]."""
        self.content, self.extent = content, extent
        self._depths: list[DepthView] | None = None

    def view_at(self, camera: Camera) -> str | None:
        """Return the name of the model's camera at nearly the pose of ``camera``; None if there is no such camera."""
        cameras = self.content.model.scene_cameras.items()
        return next((n for n, c in cameras if stands_at(camera, c, NEAR * self.extent)), None)

    @torch.no_grad()
    def image(self, kind: str, camera: Camera, gaussians: Gaussians, sh_degree: int) -> tuple[np.ndarray, str]:
        """Return an image as uint8, shape [H, W, 3], and its description.

        Args:
            kind: One of `MAPS`.
            camera: Camera of the browser.
            gaussians: The Gaussians to show, in scene units: all of the model or some.
            sh_degree: Degree of the colours.
        """
        options = dataclasses.replace(self.content.model.options(), sh_degree=min(sh_degree, gaussians.sh_degree), record=False)
        drawn: dict[str, Callable[..., tuple[np.ndarray, str]]] = {
            RENDER: self._render, DEPTH: self._depth, COVERAGE: self._coverage, ERROR: self._error,
        }  # fmt: skip
        colors, note = drawn[kind](camera, gaussians, options)
        return np.round(255 * np.clip(colors, 0, 1)).astype(np.uint8), note

    def _render(self, camera: Camera, gaussians: Gaussians, options: RasterizeOptions) -> tuple[np.ndarray, str]:
        return rasterize(gaussians, camera, options).rgb.cpu().numpy(), MAPS[RENDER]

    def _depth(self, camera: Camera, gaussians: Gaussians, options: RasterizeOptions) -> tuple[np.ndarray, str]:
        r = rasterize(gaussians, camera, options)
        return depth_map(r.depth.cpu().numpy(), r.alpha.cpu().numpy()), MAPS[DEPTH]

    def _coverage(self, camera: Camera, gaussians: Gaussians, options: RasterizeOptions) -> tuple[np.ndarray, str]:
        model = self.content.model
        if not model.train:
            return self._render(camera, gaussians, options)[0], "a file of Gaussians has no training cameras; open its run"
        if self._depths is None:
            cameras = model.cameras()
            masks = [v.mask if (v := self.content.views.get(n)) else None for n in model.train]
            self._depths = depth_views(model.gaussians(), [cameras[n] for n in model.train], options, masks)
        r = rasterize(gaussians, camera, options)
        seen = classes_of(coverage_map(torch.where(r.alpha >= MIN_ALPHA, r.depth, 0), camera, self._depths), model.transparent)
        return coverage_image(r.rgb.cpu().numpy(), seen["0"], seen["1"]), MAPS[COVERAGE]

    def _error(self, camera: Camera, gaussians: Gaussians, options: RasterizeOptions) -> tuple[np.ndarray, str]:
        name = self.view_at(camera)
        view = self.content.views.get(name or "")
        if view is None:
            why = "the photographs cannot be read" if name else "step into a camera, by a click or by its name"
            return self._render(camera, gaussians, options)[0], f"the error map cannot be shown: {why}"
        render = rasterize(gaussians, view.camera, options).rgb.cpu().numpy()
        return placed(error_map(render, view.image), view.camera, camera), f"{name}: {MAPS[ERROR]}"


def placed(image: np.ndarray, own: Camera, camera: Camera) -> np.ndarray:
    """Resample an image [H, W, 3] of the camera ``own`` for a camera at the same pose; gray outside the image."""
    import cv2

    K = matmul(np.asarray(camera.K), np.linalg.inv(own.K))  # pixel centres lie at +0.5 here, and at whole numbers in OpenCV
    K[:2, 2] += 0.5 * (np.diag(K)[:2] - 1)
    size = (camera.width, camera.height)
    placed: np.ndarray = cv2.warpAffine(image, K[:2], size, flags=cv2.INTER_LINEAR, borderValue=(0.25, 0.25, 0.25))
    return placed
