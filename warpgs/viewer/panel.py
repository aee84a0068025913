"""The panel of the viewer: the image shown, stepping into cameras, the crop box, and keyframes of a path."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from warpgs.errors import WarpgsError
from warpgs.files import read_file, readable, remove_leftovers, write_json
from warpgs.geometry import rotation_matrices
from warpgs.io.decoding import decode
from warpgs.runtime.terminal import say
from warpgs.scene import Camera
from warpgs.viewer.callbacks import guarded
from warpgs.viewer.content import Content
from warpgs.viewer.maps import GAUSSIANS, MAPS
from warpgs.viewer.saved import CROP, MAX_KEYFRAMES, PATH, CropBox, keyframe

if TYPE_CHECKING:
    import viser

ALL, COARSE, FINE = "all", "coarse", "fine"
"""Layers to show."""
NOWHERE = "(choose one)"
BOX, GIZMO = "/crop/box", "/crop"


class Shown(Protocol):
    """Methods of the window that the panel calls."""

    def redraw(self) -> None:
        """Send the current image."""

    def step_into(self, name: str, client: Any) -> None:
        """Move a browser's camera to the model's camera of that name."""

    def reset(self, client: Any) -> None:
        """Move a browser's camera back to where pages start."""

    def camera_of(self, client: Any, side: int | None = None) -> Camera:
        """Return a browser's camera."""


class Panel:
    """Controls that all browsers share."""

    def __init__(self, server: viser.ViserServer, content: Content, window: Shown, maps: bool):
        """Make the controls that are useful for the model."""
        self.server, self.content, self.window = server, content, window
        self.keyframes: list[dict[str, Any]] = []
        self._lock = threading.Lock()
        gui = server.gui
        self._status = gui.add_markdown("")
        self._kind = gui.add_dropdown("show", (GAUSSIANS, *MAPS) if maps else (GAUSSIANS,), initial_value=GAUSSIANS)
        degree = content.model.gaussians().sh_degree
        self._degree = gui.add_slider(
            "SH degree", 0, max(degree, 1), 1, degree, disabled=degree == 0, visible=maps,
            hint="spherical-harmonics degree of a render; Gaussians that the browser draws have degree 0",
        )  # fmt: skip
        self._layer = gui.add_dropdown("layer", (ALL, COARSE, FINE), initial_value=ALL, visible=content.fine is not None)
        self._cameras = gui.add_checkbox("cameras", True, visible=bool(content.model.scene_cameras))
        self._note = gui.add_markdown("", visible=False)
        for control in (self._kind, self._degree, self._layer, self._cameras):
            control.on_update(guarded(lambda _: self.window.redraw()))
        self._add_stepping()
        self._add_sampling()
        self._add_crop()
        self._add_keyframes()
        self.tell(content)

    def kind(self) -> str:
        """Return the choice of image: `GAUSSIANS` or one of `MAPS`."""
        return str(self._kind.value)

    def sh_degree(self) -> int:
        """Return the degree of the colours of renders."""
        return int(self._degree.value)

    def layer(self) -> str:
        """Return the layer to be shown."""
        return str(self._layer.value)

    def shows_cameras(self) -> bool:
        """Return whether cameras are to be shown."""
        return bool(self._cameras.value)

    def crop_box(self) -> CropBox | None:
        """Return the box outside of which nothing is to be shown; None for everything."""
        if not self._crop.value:
            return None
        size = np.asarray(self._size.value, np.float64)
        return CropBox(np.asarray(self._gizmo.position, np.float64), size, rotation_matrices(np.asarray(self._gizmo.wxyz)))

    def tell(self, content: Content) -> None:
        """Write title, number of Gaussians, step and number of cameras."""
        self.content = content
        model = content.model
        parts = [f"{len(model.gaussians()):,} Gaussians"]
        parts += [f"step {model.step:,}"] if model.step else []
        parts += [f"{len(model.train)} training cameras, {len(model.test)} held out"] if model.scene_cameras else []
        self._status.content = f"**{_plain(content.title)}**\n\n{', '.join(parts)}"

    def explain(self, note: str) -> None:
        """Show a note about the image; hide an empty one."""
        self._note.content, self._note.visible = _plain(note), bool(note)

    def _add_stepping(self) -> None:
        names = {readable(name): name for name in self.content.model.scene_cameras}  # viser takes UTF-8 alone
        if names:
            chooser = self.server.gui.add_dropdown("step into", (NOWHERE, *names), initial_value=NOWHERE)

            def step(event: Any) -> None:
                if chooser.value != NOWHERE:
                    self.window.step_into(names[chooser.value], event.client)

            chooser.on_update(guarded(step))
        reset = self.server.gui.add_button("Reset", hint="back to the first camera")
        reset.on_click(guarded(lambda event: self.window.reset(event.client)))

    def _add_sampling(self) -> None:
        """Add the fit's image of the places where fine Gaussians were placed."""
        sheet, run = self.content.sheet, self.content.stem
        if sheet is None:
            return

        def show(event: Any) -> None:
            try:
                image = np.round(255 * decode(sheet, data=read_file(sheet, run))[0]).astype(np.uint8)
            except WarpgsError as e:
                return self.explain(str(e))
            with event.client.gui.add_modal("Where fine Gaussians were placed") as modal:
                event.client.gui.add_image(image, format="jpeg")
                event.client.gui.add_button("close").on_click(lambda _: modal.close())

        self.server.gui.add_button("show sampling", hint="where the fit placed fine Gaussians").on_click(guarded(show))

    def _add_crop(self) -> None:
        """Add a box that the user moves and rotates by its handles, and saves."""
        gui, scene, means = self.server.gui, self.server.scene, self.content.model.gaussians().means.cpu().double().numpy()
        low, high = np.percentile(means, [5, 95], axis=0)
        with gui.add_folder("Crop box", expand_by_default=False):
            self._crop = gui.add_checkbox("crop", False)
            self._size = gui.add_vector3("size [u]", tuple(np.maximum(high - low, 1e-3)), min=(1e-3,) * 3, step=0.01)
            save = gui.add_button("save crop box")
        length = 0.3 * float(np.linalg.norm(high - low))
        self._gizmo = scene.add_transform_controls(GIZMO, scale=length, position=tuple((low + high) / 2), visible=False)

        def draw(_: Any = None) -> None:
            self._gizmo.visible = bool(self._crop.value)
            scene.add_box(
                BOX, dimensions=self._size.value, wireframe=True, color=(240, 200, 60), visible=bool(self._crop.value)
            )
            self.window.redraw()

        self._crop.on_update(guarded(draw))
        self._size.on_update(guarded(draw))
        self._gizmo.on_update(guarded(lambda event: self.window.redraw() if event.phase == "end" else None))

        def store(_: Any) -> None:
            box = self.crop_box()
            if box is None:
                return self.explain("no crop box yet: tick crop, and move the box")
            self._save(CROP, box.to_json(self.content.model.normalization))

        save.on_click(guarded(store))

    def _add_keyframes(self) -> None:
        """Add controls that append the current camera to a path, and save the path."""
        gui = self.server.gui
        with gui.add_folder("Keyframes", expand_by_default=False):
            seconds = gui.add_number("seconds between", 2.0, min=0.1, max=600.0, step=0.1)
            add, remove, save = (gui.add_button(t) for t in ("add this camera", "remove the last", "save path"))
            count = gui.add_markdown("no keyframe")

        def changed() -> None:
            count.content = f"{len(self.keyframes)} keyframes" if self.keyframes else "no keyframe"

        def append(event: Any) -> None:
            with self._lock:
                if len(self.keyframes) >= MAX_KEYFRAMES:
                    return self.explain(f"a path has at most {MAX_KEYFRAMES:,} keyframes")
                at = self.keyframes[-1]["seconds"] + float(seconds.value) if self.keyframes else 0.0
                camera = self.window.camera_of(event.client)
                self.keyframes.append(keyframe(camera, at, self.content.model.normalization))
                changed()

        def pop(_: Any) -> None:
            with self._lock:
                del self.keyframes[-1:]
                changed()

        add.on_click(guarded(append))
        remove.on_click(guarded(pop))
        save.on_click(
            guarded(lambda _: self._save(PATH, self.keyframes) if self.keyframes else self.explain("add a camera first"))
        )

    def _save(self, name: str, values: Any) -> None:
        """Write a file beside the model, and show its path."""
        path = self.content.saved(name)
        remove_leftovers(path.parent)
        try:
            write_json(path, values)
        except WarpgsError as e:
            return self.explain(str(e))
        say(f"saved {path}")
        self.explain(f"saved {path}")


def _plain(text: str) -> str:
    """Return text in UTF-8, with the special characters of Markdown escaped."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]()<>#|!" else c for c in readable(text))
