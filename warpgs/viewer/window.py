"""The window of the viewer: its content, maps, panel and saved views."""

from __future__ import annotations

import dataclasses
import itertools
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from warpgs.errors import DataError, UsageError, WarpgsError
from warpgs.export.base import format_of, read_with_antialiasing
from warpgs.export.ply import write_ply
from warpgs.files import read_file, readable, remove_leftovers, write_json
from warpgs.geometry import camera_extent, convert_box, convert_camera, convert_gaussians, matmul, pose_of, rotation_matrices
from warpgs.io.image_files import decode
from warpgs.mesh.views import MIN_ALPHA
from warpgs.pipeline.films.paths import fov_y
from warpgs.pipeline.metrics.coverage import DepthView, classes_of, coverage_map, depth_views
from warpgs.pipeline.metrics.scores import Renders
from warpgs.pipeline.model.clean import REASONS, counted_lines, in_colors, reasons_of
from warpgs.pipeline.model.edit import any_of, coverage, first_reasons, inside, select
from warpgs.pipeline.model.table import FittedModel
from warpgs.pipeline.run import level
from warpgs.pipeline.run.commands import RULE, scene_of, write_clean
from warpgs.pipeline.run.folder import TENSORS, StoredRun, load_checkpoint, open_run
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.sampling import FINE
from warpgs.process import say
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.report.images import coverage_image, depth_map, error_map, resized
from warpgs.scene import Box, Camera, Gaussians, Normalization, View
from warpgs.viewer import html
from warpgs.viewer.server import guarded, said

if TYPE_CHECKING:
    import viser


@dataclass(frozen=True)
class Content:
    """A model and its description."""

    title: str
    """Name to show: the name of the folder or the file."""
    model: FittedModel
    """Gaussians, cameras by name, background and rule; without cameras where a file has none."""
    stem: Path
    """Beginning of the paths of files that are saved from the viewer: RUN for RUN/crop.json, x for x-crop.json beside x.ply."""
    fine: torch.Tensor | None = None
    """True for Gaussians of the fine layer, bool, shape [N]; None without layers."""
    views: Mapping[str, View] = field(default_factory=dict)
    """Views by name, with their photographs; empty if the scene cannot be read."""
    sheet: Path | None = None
    """PNG that shows where fine Gaussians were placed, or None."""

    def saved(self, name: str) -> Path:
        """Return the path of a file that is saved from the viewer."""
        return self.stem / name if self.stem.is_dir() else self.stem.with_name(f"{self.stem.name}-{name}")


def content_of_run(folder: Path, device: str | torch.device = "cpu", views: Mapping[str, View] | None = None) -> Content:
    """Read a run, finished or still going."""
    run = open_run(folder, device)
    means, level = run.gaussians().means, load_checkpoint(folder)[0].get("columns.level")
    # a fit that continues may have written another checkpoint in between
    fine = (level == FINE).to(means.device) if level is not None and level.shape == (len(means),) else None
    sheet = max((folder / "sampling").glob("*.png"), default=None)
    return Content(folder.resolve().name, run, folder, fine, views or {}, sheet)


def views_of(content: Content, reader: str | None = None) -> tuple[dict[str, View], list[str]]:
    """Return the views of a run's scene by name, and notes for the user where they cannot be read."""
    if not isinstance(content.model, StoredRun):
        return {}, []
    try:
        _, train, test = scene_of(content.model, reader)
    except WarpgsError as e:
        return {}, [f"cameras are shown without photographs, since the scene cannot be read: {e}"]
    return {v.name: v for v in [*train, *test]}, []


def content_of_file(path: Path, device: str = "cpu") -> Content:
    """Read a file of Gaussians of any format; it is centred and scaled for the viewer."""
    stored, antialiased, notes = read_with_antialiasing(path, None, "file")
    for note in notes:
        say(f"  {note}")
    if not len(stored):
        raise DataError(f"{path}: contains no Gaussians; export the model again")
    low, high = np.percentile(stored.means.double().numpy(), [5, 95], axis=0)
    normalization = Normalization((low + high) / 2, 1 / max(0.5 * float(np.linalg.norm(high - low)), 1e-12))
    gaussians = convert_gaussians(stored, normalization, "file", "scene")
    gaussians = dataclasses.replace(gaussians, **{n: t.float().to(device) for n, t in gaussians.tensors().items()})
    rule = FitConfig.rule if format_of(path).is_own(path) else RULE
    model = FittedModel(gaussians, normalization, {}, (), (), rule, (0.0, 0.0, 0.0), 0, antialiased=antialiased)
    return Content(path.name, model, path.with_suffix(""))


def modified(folder: Path) -> float | None:
    """Return when the last checkpoint of a run was written [s]; None without one."""
    try:
        return (folder / TENSORS).stat().st_mtime
    except OSError:
        return None


CROP, PATH = "crop.json", "path.json"
"""Names of the files in a run folder."""
MAX_KEYFRAMES = 1000
"""Largest number of keyframes of a path: half an hour at the default of 2 s between them."""


def box_json(box: Box, normalization: Normalization) -> dict[str, Any]:
    """Return a box in file units: ``center`` [3], ``size`` [3], and ``rotation`` [3, 3] from its axes to the world's."""
    center, size, rotation = convert_box(box, normalization, "scene", "file")
    return {"center": center.tolist(), "size": size.tolist(), "rotation": rotation.tolist()}


def keyframe(camera: Camera, seconds: float, normalization: Normalization) -> dict[str, Any]:
    """Return a camera of a path as JSON."""
    viewmat = convert_camera(camera, normalization, "scene", "file").viewmat
    c2w = pose_of(viewmat[:3, :3].T, -(viewmat[:3, :3] * viewmat[:3, 3:]).sum(0))
    return {"c2w": c2w.tolist(), "fov_y": fov_y(camera), "seconds": seconds}


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
        return next((n for n, c in cameras if html.stands_at(camera, c, NEAR * self.extent)), None)

    @torch.no_grad()
    def image(self, kind: str, camera: Camera, gaussians: Gaussians, sh_degree: int) -> tuple[np.ndarray, str]:
        """Return an image as uint8, shape [H, W, 3], and its description."""
        model, note = self.content.model, MAPS[kind]
        options = dataclasses.replace(model.options(), sh_degree=min(sh_degree, gaussians.sh_degree), record=False)
        name = self.view_at(camera) if kind == ERROR else None
        view = self.content.views.get(name or "")
        if kind == COVERAGE and not model.train:
            kind, note = RENDER, "a file of Gaussians has no training cameras; open its run"
        elif kind == ERROR and view is None:
            why = "the photographs cannot be read" if name else "step into a camera, by a click or by its name"
            kind, note = RENDER, f"the error map cannot be shown: {why}"
        if kind == RENDER:
            rgb = rasterize(gaussians, camera, options.for_display(gaussians)).rgb
            return (255 * rgb.clamp(0, 1)).round().to(torch.uint8).cpu().numpy(), note
        r = rasterize(gaussians, camera if kind != ERROR or view is None else view.camera, options)
        colors = r.rgb.cpu().numpy()
        if kind == DEPTH:
            colors = depth_map(r.depth.cpu().numpy(), r.alpha.cpu().numpy())
        elif kind == COVERAGE:
            depth = torch.where(r.alpha >= MIN_ALPHA, r.depth, 0)
            seen = classes_of(coverage_map(depth, camera, self._depth_views(options))[0], (depth <= 0) & model.transparent)
            colors = coverage_image(colors, seen["0"], seen["1"])
        elif view is not None:
            colors, note = placed(error_map(colors, view.image), view.camera, camera), f"{name}: {note}"
        return np.round(255 * np.clip(colors, 0, 1)).astype(np.uint8), note

    def _depth_views(self, options: RasterizeOptions) -> list[DepthView]:
        if self._depths is None:
            model, views = self.content.model, self.content.views
            masks = [v.mask if (v := views.get(n)) else None for n in model.train]
            self._depths = depth_views(Renders(model.gaussians(), options), [model.cameras()[n] for n in model.train], masks)
        return self._depths


def placed(image: np.ndarray, own: Camera, camera: Camera) -> np.ndarray:
    """Resample an image [H, W, 3] of the camera ``own`` for a camera at the same pose; gray outside the image."""
    import cv2

    K = matmul(np.asarray(camera.K), np.linalg.inv(own.K))  # pixel centres lie at +0.5 here, and at whole numbers in OpenCV
    K[:2, 2] += 0.5 * (np.diag(K)[:2] - 1)
    size = (camera.width, camera.height)
    return np.asarray(cv2.warpAffine(image, K[:2], size, flags=cv2.INTER_LINEAR, borderValue=(0.25, 0.25, 0.25)))


ALL_LAYERS, COARSE_LAYER, FINE_LAYER = "all", "coarse", "fine"
"""Layers to show."""
NOWHERE = "(choose one)"
BOX, GIZMO = "/crop/box", "/crop"


class Panel:
    """Controls that all browsers share."""

    def __init__(self, server: viser.ViserServer, content: Content, window: Window, maps: bool):
        """Make the controls that are useful for the model."""
        self.server, self.content, self.window = server, content, window
        self.keyframes: list[dict[str, Any]] = []
        gui = server.gui
        self._status = gui.add_markdown("")
        self.kind = gui.add_dropdown("show", (GAUSSIANS, *MAPS) if maps else (GAUSSIANS,), initial_value=GAUSSIANS)
        degree = content.model.gaussians().sh_degree
        self.degree = gui.add_slider(
            "SH degree", 0, max(degree, 1), 1, degree, disabled=degree == 0, visible=maps,
            hint="spherical-harmonics degree of a render; Gaussians that the browser draws have degree 0",
        )  # fmt: skip
        self.layer = gui.add_dropdown(
            "layer", (ALL_LAYERS, COARSE_LAYER, FINE_LAYER), initial_value=ALL_LAYERS, visible=content.fine is not None
        )
        self.cameras = gui.add_checkbox("cameras", True, visible=bool(content.model.scene_cameras))
        self.limits = gui.add_checkbox(
            "limits", True, hint="stay where photographs show the scene", visible=len(content.model.scene_cameras) > 1
        )
        self.limits.on_update(guarded(lambda _: self.window.limit()))
        self._note = gui.add_markdown("", visible=False)
        for control in (self.kind, self.degree, self.layer, self.cameras):
            control.on_update(guarded(lambda _: self.window.redraw()))
        self._add_stepping()
        self._add_sampling()
        self._add_crop()
        self._add_clean_up(maps)
        self._add_keyframes()
        self._add_ruler()
        self.tell(content)

    def crop_box(self) -> Box | None:
        """Return the box outside of which nothing is to be shown; None for everything."""
        if not self._crop.value:
            return None
        center, size = np.asarray(self._gizmo.position, np.float64), np.asarray(self._size.value, np.float64)
        return center, size, rotation_matrices(np.asarray(self._gizmo.wxyz))

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
        if names := {readable(name): name for name in self.content.model.scene_cameras}:  # viser takes UTF-8 alone
            chooser = self.server.gui.add_dropdown("step into", (NOWHERE, *names), initial_value=NOWHERE)

            def step(event: Any) -> None:
                if chooser.value != NOWHERE:
                    self.window.step_into(names[chooser.value], event.client)

            chooser.on_update(guarded(step))
        reset = self.server.gui.add_button("Reset", hint="back to the first camera")
        reset.on_click(guarded(lambda event: self.window.move(self.window.first, event.client)))

    def _add_sampling(self) -> None:
        """Add the fit's image of the places where fine Gaussians were placed."""
        sheet, run = self.content.sheet, self.content.stem
        if sheet is None:
            return

        def show(event: Any) -> None:
            image = np.round(255 * decode(sheet, data=read_file(sheet, run))[0]).astype(np.uint8)
            with event.client.gui.add_modal("Where fine Gaussians were placed") as modal:
                event.client.gui.add_image(image, format="jpeg")
                event.client.gui.add_button("close").on_click(lambda _: modal.close())

        button = self.server.gui.add_button("show sampling", hint="where fine Gaussians were placed")
        button.on_click(guarded(show, self.explain))

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
            self._gizmo.visible = shown = bool(self._crop.value)
            scene.add_box(BOX, dimensions=self._size.value, wireframe=True, color=(240, 200, 60), visible=shown)
            self.window.redraw()

        self._crop.on_update(guarded(draw))
        self._size.on_update(guarded(draw))
        self._gizmo.on_update(guarded(lambda event: self.window.redraw() if event.phase == "end" else None))

        def store(_: Any) -> None:
            if (box := self.crop_box()) is None:
                return self.explain("no crop box yet: tick crop, and move the box")
            self._save(CROP, box_json(box, self.content.model.normalization))

        save.on_click(guarded(store, self.explain))

    def _add_clean_up(self, shown: bool) -> None:
        """Add controls that colour what a clean-up would remove, remove it, and put it back; they write nothing but a copy."""
        gui = self.server.gui
        with gui.add_folder("Clean up", expand_by_default=False, visible=shown):
            self.in_colors = gui.add_checkbox("preview", False, hint="colour what would go")
            self.reasons = {name: gui.add_checkbox(name, True, hint=words) for name, (words, *_) in REASONS.items()}
            counts = gui.add_markdown("")
            remove, undo, save = (gui.add_button(t) for t in ("remove", "undo", "save a copy"))

        def show(_: Any = None) -> None:
            if shows := bool(self.in_colors.value):
                counts.content = "finding what would go"
            lines = counted_lines(self.window.going() if shows else {}) or ["nothing would go"] * shows
            removed = sum(int(where.sum()) for masks in self.window.removed for where in masks.values())
            counts.content = "\n".join(f"- {line}" for line in [*lines, f"{removed:,} removed"])
            self.window.redraw()

        for control in (self.in_colors, *self.reasons.values()):
            control.on_update(guarded(show, self.explain))
        remove.on_click(guarded(lambda _: show(self.window.remove()), self.explain))
        undo.on_click(guarded(lambda _: show(self.window.undo()), self.explain))
        save.on_click(guarded(lambda _: self.explain(self.window.save_copy()), self.explain))

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
            if len(self.keyframes) >= MAX_KEYFRAMES:
                return self.explain(f"a path has at most {MAX_KEYFRAMES:,} keyframes")
            at = self.keyframes[-1]["seconds"] + float(seconds.value) if self.keyframes else 0.0
            self.keyframes.append(keyframe(self.window.camera_of(event.client), at, self.content.model.normalization))
            changed()

        def pop(_: Any) -> None:
            del self.keyframes[-1:]
            changed()

        def store(_: Any) -> None:
            if not self.keyframes:
                raise UsageError("add a camera first")
            self._save(PATH, self.keyframes)

        add.on_click(guarded(append))
        remove.on_click(guarded(pop))
        save.on_click(guarded(store, self.explain))

    def _add_ruler(self) -> None:
        """Add controls that measure between picked points, and set the scale and the ground of a run's files by them."""
        gui, scene, run = self.server.gui, self.server.scene, isinstance(self.content.model, StoredRun)
        with gui.add_folder("Ruler", expand_by_default=False):
            measure, self.measured = gui.add_checkbox("click points", False), gui.add_markdown("")
            length = gui.add_number("length [m]", 1.0, min=0.0, max=1e6, step=0.001, visible=run)
            buttons = [gui.add_button(text, visible=run) for text in ("set scale", "set ground", "level by photographs")]
        places: list[level.Place] = []

        def start(_: Any) -> None:
            scene.remove_click_callback()
            if measure.value:
                places.clear()
                scene.remove_by_name("/ruler")
                scene.on_click()(guarded(pick, self.explain))

        def pick(event: Any) -> None:
            place, n = self.window.place_at(event.client, *event.screen_pos), self.content.model.normalization
            if places:
                distance, error = level.distance(n, places[-1], place)
                said = f"{distance:.4g} {n.unit} between the last two, uncertain by {100 * error:.2g} %"
                self.measured.content = f"{len(places) + 1} points; {said}{level.matches([*places, place])}"
            places.append(place)
            scene.add_icosphere(f"/ruler/{len(places)}", 0.01 * self.window.extent, (255, 221, 51), position=place[0])

        def store(least: int, change: Callable[[StoredRun], level.Levelled]) -> None:
            if len(places) < least:
                raise UsageError(f"pick {least} points first")
            said = level.store(self.content.stem, "cpu", change)
            self.window.show(content_of_run(self.content.stem, self.content.model.gaussians().means.device, self.content.views))
            self.measured.content = _plain(" ".join(said))

        measure.on_update(guarded(start))
        by_length = lambda r: level.scaled(r.normalization, places[-2:], [length.value])  # noqa: E731
        ways = (2, by_length), (3, lambda r: level.grounded(r, places)), (0, level.photographed)
        for button, way in zip(buttons, ways):
            button.on_click(guarded(lambda _, way=way: store(*way), self.explain))

    def _save(self, name: str, values: Any) -> None:
        """Write a file beside the model, and show its path."""
        path = self.content.saved(name)
        remove_leftovers(path.parent)
        write_json(path, values)
        say(f"saved {path}")
        self.explain(f"saved {path}")


def _plain(text: str) -> str:
    """Return text in UTF-8, with the special characters of Markdown escaped."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]()<>#|!" else c for c in readable(text))


PHOTO_SIDE = 256
"""Longer side of the photographs on the cameras [px]."""
MAP_SIDE = {"cpu": 480, "cuda": 1280}
"""Longer side of an image that is rendered here, by device [px]."""
SETTLED = 0.15
"""Time without motion of a browser's camera before an image is rendered for it [s]."""
HIDDEN = 8.0
"""Cameras nearer than this to a browser's eye, in sizes of their frusta, are hidden: photographs would look like the scene."""
TRAIN_COLOR, TEST_COLOR = (20, 150, 150), (224, 138, 44)


class Window:
    """Shows a model to all browsers that are connected; a later model of a fit replaces it."""

    def __init__(self, server: viser.ViserServer, content: Content, maps: bool = True):
        """Show a model."""
        self.server, self.content = server, content
        cameras = list(content.model.scene_cameras.values())
        train = [content.model.scene_cameras[n] for n in content.model.train]
        # the limits include held-out cameras, too, because the user can step into each, without those far off the rest
        gaussians = content.model.gaussians()
        self._photographs, known = (html.middle_first(some, gaussians) for some in (train, cameras))
        self._rig = [*self._photographs, *known] or [html.camera_before(gaussians)]
        self.first = self._rig[0]
        self.extent = camera_extent(cameras) if len(cameras) > 1 else 0.1 * html.distance_ahead(self.first, gaussians)
        self.maps = Maps(content, self.extent)
        self.removed: list[dict[str, torch.Tensor]] = []
        self._reasons: dict[str, torch.Tensor] | None = None
        self._frusta: dict[str, Any] = {}
        self._drawn: dict[int, tuple[Any, ...]] = {}
        self._lock, self._wake, self._open = threading.RLock(), threading.Event(), True
        rig, up = cameras or [self.first], content.model.normalization.up
        self._place = html.place_first_camera(server, self.first, gaussians, rig, up)
        server.scene.set_background_image(html.plain_background(content.model.background), format="png")
        self._widest = self._narrow = self._limits = html.turning_limits(self._rig, *self._place)
        self._measures, self._unmeasured = maps, content.model if maps else None
        self.panel = Panel(server, content, self, maps)
        self.limit()
        self._draw_cameras()
        self.redraw()
        server.on_client_connect(guarded(self._connected))
        self._thread = threading.Thread(target=self._render_maps, name="viewer maps", daemon=True)
        self._thread.start()

    def show(self, content: Content) -> None:
        """Show another state of the model, with the same cameras."""
        with self._lock:
            self.content, self.maps = content, Maps(content, self.extent)
            self._unmeasured = content.model if self._measures else None
            self.removed, self._reasons = [], None
            self.panel.tell(content)
            self.redraw()

    def close(self) -> None:
        """End the rendering of images; the owner of the window stops the server."""
        self._open = False
        self._wake.set()
        self._thread.join(timeout=10)

    def shown(self) -> Gaussians:
        """Return the Gaussians of the layer and the crop box selected in the panel."""
        gaussians, fine, layer = self.content.model.gaussians(), self.content.fine, self.panel.layer.value
        keep = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
        if fine is not None and layer != ALL_LAYERS:
            keep &= fine if layer == FINE_LAYER else ~fine
        if (box := self.panel.crop_box()) is not None:
            keep &= inside(gaussians, box)
        if self.panel.in_colors.value:
            gaussians = in_colors(gaussians, self.going())
        keep &= ~self._gone()
        return Gaussians(**{n: t.detach()[keep] for n, t in gaussians.tensors().items()})

    def _gone(self) -> torch.Tensor:
        """Return which Gaussians were removed in the panel, bool [N]."""
        masks = [where for found in self.removed for where in found.values()]
        return any_of(masks, self.content.model.gaussians().logit_opacities)

    def going(self) -> dict[str, torch.Tensor]:
        """Return what the panel's reasons would remove of the Gaussians that are left, each under one reason, bool [N]."""
        with self._lock:
            model, left = self.content.model, ~self._gone()
            if self._reasons is None:
                cameras = [model.scene_cameras[name] for name in model.train]
                maxima = coverage(model.gaussians(), cameras, model.options())[0] if cameras else None
                self._reasons = reasons_of(model.gaussians(), maxima)
            return first_reasons({n: w & left for n, w in self._reasons.items() if self.panel.reasons[n].value})

    def remove(self) -> None:
        """Remove what the panel's reasons name, in the viewer alone; UsageError if that is nothing, or everything."""
        with self._lock:
            found = self.going()
            goes = any_of(found.values(), self._gone())
            if not goes.any() or (goes | self._gone()).all():
                raise UsageError("nothing would go" if not goes.any() else "everything would go; choose fewer reasons")
            self.removed.append(found)

    def undo(self) -> None:
        """Put back what was removed last."""
        if not self.removed:
            raise UsageError("nothing was removed")
        self.removed.pop()

    def save_copy(self) -> str:
        """Write what is left as a run folder, or as a PLY, beside the model; returns a line for the user."""
        if not self.removed:
            raise UsageError("nothing was removed; press remove first")
        model, stem = self.content.model, self.content.stem.resolve()
        names = (f"{stem.name}-pruned{more}" for more in itertools.chain([""], map("-{}".format, itertools.count(2))))
        if isinstance(model, StoredRun):
            found = {n: any_of([f[n] for f in self.removed if n in f], self._gone()) for n in self.panel.reasons}
            return write_clean(model, next(p for n in names if not (p := stem.with_name(n)).exists()), found)[-1]
        path = next(p for n in names if not (p := stem.with_name(f"{n}.ply")).exists())
        left = select(model.gaussians(), ~self._gone())
        write_ply(path, left, model.normalization, antialiased=model.antialiased)
        return f"{len(left):,} Gaussians in {path}"

    def redraw(self) -> None:
        """Send the current view to the browsers: the Gaussians, or images at each browser's camera."""
        with self._lock, self.server.atomic():
            if self.panel.kind.value == GAUSSIANS:
                arrays, scale, _ = html.packed(self.shown())
                self.server.scene.add_gaussian_splats("/gaussians", *arrays, scale=scale)
            else:
                self.server.scene.remove_by_name("/gaussians")
            self._hide_near()
            self._drawn.clear()
        self._wake.set()

    def limit(self, model: FittedModel | None = None) -> None:
        """Send the limits of turning to the browsers, as the panel switches them; narrow them to what a model supports."""
        if model is not None:
            self._narrow = self._limits = html.supported(model.gaussians(), self._photographs, *self._place, *self._widest)
        html.add_limits(self.server, self.first.center - self._place[0], *self._limits, bool(self.panel.limits.value))

    def _draw_cameras(self) -> None:
        """Draw the cameras with their photographs; a click steps into one."""
        model = self.content.model
        centers = np.array([c.center for c in model.scene_cameras.values()]).reshape(-1, 3)
        gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2) + np.where(np.eye(len(centers)), np.inf, 0)
        size = 0.25 * float(np.median(gaps.min(1))) if len(centers) > 1 else 0.5 * self.extent
        for number, (name, camera) in enumerate(model.scene_cameras.items()):
            view = self.content.views.get(name)
            frustum = self.server.scene.add_camera_frustum(
                f"/cameras/{number}", fov_y(camera), camera.width / camera.height, thickness=0.02 * size,
                scale=frustum_scale(camera, size),
                color=TEST_COLOR if name in model.test else TRAIN_COLOR, image=None if view is None else _small(view.image),
                format="jpeg", wxyz=html.wxyz_of(camera), position=camera.center, cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            frustum.on_click(guarded(lambda event, name=name: self.step_into(name, event.client)))
            self._frusta[name] = frustum

    def step_into(self, name: str, client: viser.ClientHandle | None) -> None:
        """Give a browser, or all browsers if ``client`` is None, the pose and field of view of a camera of the model."""
        self.move(self.content.model.scene_cameras[name], client)

    def move(self, camera: Camera, client: viser.ClientHandle | None) -> None:
        """Give a browser, or all browsers if ``client`` is None, the pose of a camera, and show its whole image."""
        forward, up = np.asarray(camera.viewmat[2, :3]), -np.asarray(camera.viewmat[1, :3])
        ahead = html.distance_ahead(camera, self.content.model.gaussians())
        self._limits = self._narrow if camera is self.first else self._widest  # cameras to step into are within the latter
        self.limit()
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
        size = max(int(state.image_width), 16), max(int(state.image_height), 16)
        factor = 1.0 if side is None else min(1.0, side / max(size))
        return html.camera_at(state.wxyz, state.position, state.fov, *(max(16, round(factor * length)) for length in size))

    def place_at(self, client: viser.ClientHandle, x: float, y: float) -> level.Place:
        """Return the surface point at a place of a browser's image, from (0, 0) at the upper left to (1, 1)."""
        model = self.content.model
        camera = self.camera_of(client, MAP_SIDE[model.gaussians().means.device.type])
        with self._lock:
            return level.place_at(model, camera, x * camera.width, y * camera.height, self.photographs())

    def photographs(self) -> dict[str, np.ndarray]:
        """Return the training photographs [H, W, 3] by name; none if the scene cannot be read."""
        return {n: self.content.views[n].image for n in self.content.model.train if n in self.content.views}

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
            if frustum.visible != (visible := bool(self.panel.cameras.value) and not hidden):
                frustum.visible = visible

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
            model, self._unmeasured = self._unmeasured, None
            if model is not None:
                guarded(self.limit)(model)
            for client in list(self.server.get_clients().values()):
                try:
                    self._render_for(client)
                except AssertionError:  # the browser has not sent its camera yet; its message will wake this thread
                    continue
                except Exception as e:  # there may be no memory for this image; the next one may be smaller
                    self.panel.explain(f"no image: {said(e)}")

    def _render_for(self, client: viser.ClientHandle) -> None:
        """Put the image that the panel selects behind a browser's scene, unless it is there already."""
        kind, degree, state = self.panel.kind.value, int(self.panel.degree.value), client.camera
        asked = (kind, degree, tuple(state.position), tuple(state.wxyz), state.fov, state.image_width, state.image_height)
        asked = (kind,) if kind == GAUSSIANS else asked
        if self._drawn.get(client.client_id) == asked:
            return
        with self._lock:
            self._drawn[client.client_id] = asked
            if kind == GAUSSIANS:
                client.scene.set_background_image(html.plain_background(self.content.model.background), format="png")
                self.panel.explain("")
                return
            camera = self.camera_of(client, MAP_SIDE[self.content.model.gaussians().means.device.type])
            image, note = self.maps.image(kind, camera, self.shown(), degree)
        client.scene.set_background_image(image, format="jpeg", jpeg_quality=90)
        self.panel.explain(note)


def frustum_scale(camera: Camera, size: float) -> float:
    """Return viser's scale of a frustum: ``size`` [u], or less, so that its picture is at most 2.5 sizes ahead."""
    # viser keeps the volume of frusta, so that those of long lenses reach far ahead: their pictures would cover the model
    return size * min(1.0, 2.5 * (math.tan(0.5 * fov_y(camera)) ** 2 * camera.width / camera.height / 3) ** (1 / 3))


def _small(image: np.ndarray) -> np.ndarray:
    """Return a photograph as uint8 with a longer side of at most `PHOTO_SIDE`."""
    factor = min(1.0, PHOTO_SIDE / max(image.shape[:2]))
    height, width = (max(1, round(factor * side)) for side in image.shape[:2])
    return np.asarray(resized(image, width, height))
