"""The window of the viewer: a model in the browser, with its cameras, and the panel beside it."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from warpgs.geometry import camera_extent
from warpgs.report.images import resized
from warpgs.scene import Camera, Gaussians
from warpgs.viewer.callbacks import guarded, said
from warpgs.viewer.camera_conventions import camera_at, camera_before, distance_ahead, fov_y, wxyz_of
from warpgs.viewer.content import Content
from warpgs.viewer.html import middle_first, place_first_camera, plain_background
from warpgs.viewer.maps import GAUSSIANS, Maps
from warpgs.viewer.packing import packed
from warpgs.viewer.panel import ALL, FINE, Panel

if TYPE_CHECKING:
    import viser

PHOTO_SIDE = 256
"""Longer side of the photographs on the cameras [px]."""
MAP_SIDE = {"cpu": 480, "cuda": 1280}
"""Longer side of an image that is rendered here, by device [px]."""
SETTLED = 0.15
"""Time without motion of a browser's camera before an image is rendered for it [s]."""
HIDDEN = 3.0
"""Cameras nearer than this to a browser's eye, in sizes of their frusta, are hidden, because they would cover the scene."""
TRAIN_COLOR, TEST_COLOR = (20, 150, 150), (224, 138, 44)


class Window:
    """Shows a model to all browsers that are connected; a later model of a fit replaces it."""

    def __init__(self, server: viser.ViserServer, content: Content, maps: bool = True):
        """Show a model.

        Args:
            server: The server, without anything in its scene.
            content: The model.
            maps: Whether images may be rendered here: False while a fit runs in this process.
        """
        self.server, self.content = server, content
        cameras = list(content.model.scene_cameras.values())
        self.first = self._first_camera()
        self.extent = (
            camera_extent(cameras) if len(cameras) > 1 else 0.1 * distance_ahead(self.first, content.model.gaussians())
        )
        self.maps = Maps(content, self.extent)
        self._frusta: dict[str, Any] = {}
        self._drawn: dict[int, tuple[Any, ...]] = {}
        self._lock, self._wake, self._open = threading.RLock(), threading.Event(), True
        place_first_camera(server, self.first, content.model.gaussians(), cameras or [self.first])
        server.scene.set_background_image(plain_background(content.model.background), format="png")
        self.panel = Panel(server, content, self, maps)
        self._draw_cameras()
        self.redraw()
        server.on_client_connect(guarded(self._connected))
        self._thread = threading.Thread(target=self._render_maps, name="viewer maps", daemon=True)
        self._thread.start()

    def _first_camera(self) -> Camera:
        """Return the middle training camera, or a camera in front of a model without cameras."""
        model = self.content.model
        cameras = middle_first([model.scene_cameras[n] for n in model.train] or list(model.scene_cameras.values()))
        return cameras[0] if cameras else camera_before(model.gaussians())

    def show(self, content: Content) -> None:
        """Show another state of the model, with the same cameras."""
        with self._lock:
            self.content, self.maps = content, Maps(content, self.extent)
            self.panel.tell(content)
            self.redraw()

    def close(self) -> None:
        """End the rendering of images; the owner of the window stops the server."""
        self._open = False
        self._wake.set()
        self._thread.join(timeout=10)

    def shown(self) -> Gaussians:
        """Return the Gaussians of the layer and the crop box selected in the panel."""
        gaussians, fine = self.content.model.gaussians(), self.content.fine
        keep = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
        if fine is not None and self.panel.layer() != ALL:
            keep &= fine if self.panel.layer() == FINE else ~fine
        box = self.panel.crop_box()
        if box is not None:
            keep &= box.contains(gaussians.means)
        return Gaussians(**{n: t.detach()[keep] for n, t in gaussians.tensors().items()})

    def redraw(self) -> None:
        """Send the current view to the browsers: the Gaussians, or images at each browser's camera."""
        with self._lock, self.server.atomic():
            if self.panel.kind() == GAUSSIANS:
                s = packed(self.shown())
                self.server.scene.add_gaussian_splats(
                    "/gaussians", s.centers, s.covariances, s.colors, s.opacities, scale=s.scale
                )
            else:
                self.server.scene.remove_by_name("/gaussians")
            self._hide_near()
            self._drawn.clear()
        self._wake.set()

    def _draw_cameras(self) -> None:
        """Draw the cameras with their photographs; a click steps into one."""
        model = self.content.model
        centers = np.array([c.center for c in model.scene_cameras.values()]).reshape(-1, 3)
        gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2) + np.where(np.eye(len(centers)), np.inf, 0)
        size = 0.4 * float(np.median(gaps.min(1))) if len(centers) > 1 else 0.5 * self.extent
        for number, (name, camera) in enumerate(model.scene_cameras.items()):
            view = self.content.views.get(name)
            frustum = self.server.scene.add_camera_frustum(
                f"/cameras/{number}", fov_y(camera), camera.width / camera.height, scale=size, thickness=0.02 * size,
                color=TEST_COLOR if name in model.test else TRAIN_COLOR, image=None if view is None else _small(view.image),
                format="jpeg", wxyz=wxyz_of(camera), position=camera.center, cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            frustum.on_click(guarded(lambda event, name=name: self.step_into(name, event.client)))
            self._frusta[name] = frustum

    def step_into(self, name: str, client: viser.ClientHandle | None) -> None:
        """Give a browser, or all browsers if ``client`` is None, the pose and field of view of a camera of the model."""
        self._move(self.content.model.scene_cameras[name], client)

    def reset(self, client: viser.ClientHandle | None) -> None:
        """Move the camera of a browser, or of all browsers if ``client`` is None, back to where it started."""
        self._move(self.first, client)

    def _move(self, camera: Camera, client: viser.ClientHandle | None) -> None:
        """Give a browser, or all browsers if ``client`` is None, the pose of ``camera``, and show its whole image."""
        forward, up = np.asarray(camera.viewmat[2, :3]), -np.asarray(camera.viewmat[1, :3])
        ahead = distance_ahead(camera, self.content.model.gaussians())
        for c in [client] if client is not None else list(self.server.get_clients().values()):
            with c.atomic():
                c.camera.position = camera.center
                c.camera.look_at = camera.center + ahead * forward
                c.camera.up_direction = up
                c.camera.fov = fov_y(camera, c.camera.aspect)
        self._hide_near()

    def camera_of(self, client: viser.ClientHandle, side: int | None = None) -> Camera:
        """Return a browser's camera in scene units, at its own size, or with a longer side of at most ``side`` [px]."""
        state = client.camera
        width, height = max(int(state.image_width), 16), max(int(state.image_height), 16)
        factor = 1.0 if side is None else min(1.0, side / max(width, height))
        size = max(16, round(factor * width)), max(16, round(factor * height))
        return camera_at(state.wxyz, state.position, state.fov, *size)

    def _connected(self, client: viser.ClientHandle) -> None:
        client.camera.fov = fov_y(self.first, client.camera.aspect)
        client.camera.on_update(guarded(lambda _: (self._hide_near(), self._wake.set())))
        self._wake.set()

    def _hide_near(self) -> None:
        """Hide the cameras near the eye of a browser, because their photographs would fill the view."""
        eyes = self._eyes()
        for name, frustum in self._frusta.items():
            center = self.content.model.scene_cameras[name].center
            hidden = any(np.linalg.norm(eye - center) < HIDDEN * frustum.scale for eye in eyes)
            if frustum.visible != (self.panel.shows_cameras() and not hidden):
                frustum.visible = not frustum.visible

    def _eyes(self) -> list[np.ndarray]:
        """Return the position [3] of each browser's camera; until a browser sends it, the position of the first camera."""
        eyes = []
        for client in self.server.get_clients().values():
            try:
                eyes.append(np.asarray(client.camera.position))
            except AssertionError:  # the browser has not sent its camera yet
                eyes.append(self.first.center)
        return eyes or [self.first.center]

    def _render_maps(self) -> None:
        """Render an image for each browser after a change of its camera or choices, until the window is closed."""
        while self._open:
            self._wake.wait()
            self._wake.clear()
            time.sleep(SETTLED)
            if self._wake.is_set() or not self._open:
                continue  # still moving
            for client in list(self.server.get_clients().values()):
                try:
                    self._render_for(client)
                except AssertionError:  # the browser has not sent its camera yet; its message will wake this thread
                    continue
                except Exception as e:  # there may be no memory for this image; the next one may be smaller
                    self.panel.explain(f"no image: {said(e)}")

    def _render_for(self, client: viser.ClientHandle) -> None:
        """Put the image that the panel selects behind a browser's scene, unless it is there already."""
        kind, degree = self.panel.kind(), self.panel.sh_degree()
        state = client.camera
        asked = (kind, degree, tuple(state.position), tuple(state.wxyz), state.fov, state.image_width, state.image_height)
        asked = (kind,) if kind == GAUSSIANS else asked
        if self._drawn.get(client.client_id) == asked:
            return
        with self._lock:
            self._drawn[client.client_id] = asked
            if kind == GAUSSIANS:
                client.scene.set_background_image(plain_background(self.content.model.background), format="png")
                self.panel.explain("")
                return
            camera = self.camera_of(client, MAP_SIDE[self.content.model.gaussians().means.device.type])
            image, note = self.maps.image(kind, camera, self.shown(), degree)
        client.scene.set_background_image(image, format="jpeg", jpeg_quality=90)
        self.panel.explain(note)


def _small(image: np.ndarray) -> np.ndarray:
    """Return a photograph as uint8 with a longer side of at most `PHOTO_SIDE`."""
    factor = min(1.0, PHOTO_SIDE / max(image.shape[:2]))
    return np.asarray(resized(image, max(1, round(factor * image.shape[1])), max(1, round(factor * image.shape[0]))))
