"""Run folders: contents and format of config.json, and reading of runs."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import platform
import shlex
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgs import schema
from warpgs.errors import DataError, UsageError
from warpgs.files import is_empty, plain
from warpgs.io.splits import Split
from warpgs.kernels.cameras.base import check_camera
from warpgs.pipeline.model.model_file import FittedModel, checked_gaussians
from warpgs.pipeline.model.sh_degrees import unpack
from warpgs.pipeline.runs.checkpoint import FORMAT, TENSORS, load_checkpoint
from warpgs.pipeline.runs.request import FitRequest, SceneRequest, choose_device
from warpgs.pipeline.runs.schemas import MODEL_STATE, check_record
from warpgs.pipeline.train.config import FitConfig
from warpgs.poses.record import JSON as POSES
from warpgs.runtime.folder_lock import check_free, hold_folder
from warpgs.scene import Camera, Gaussians, Normalization, Scene
from warpgs.suggestion import similar_folder
from warpgs.version import __version__

CONFIG = "config.json"
METRICS_FILE = "metrics.json"
"""File of scores, sizes and times, written at the end of a fit."""
IMAGE_FOLDERS = ("renders", "depth", "coverage", "sampling")
"""Folders in a run folder with the images that its fit writes."""
POSED_SCENE = "scene"
"""Folder in a run folder with the scene made from photographs without cameras."""


def versions() -> dict[str, str]:
    """Return the versions of all software that a result depends on, by name."""
    names = ("torch", "warp-lang", "numpy", "opencv-contrib-python-headless", "scikit-image", "safetensors")
    found = {"warpgs": __version__, "python": platform.python_version(), "system": platform.platform(terse=True)}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


@contextlib.contextmanager
def run_folder(out: Path, resume: bool) -> Iterator[list[str]]:
    """Lock a run folder for a fit: a new or empty one, or one with a run to continue; yields notes for the user.

    A folder with found poses only, from a fit that ended before its first step, is accepted with and without ``resume``.

    Raises:
        FolderHeldError: Another process writes into the folder.
        ResourceError: The folder cannot be written.
        UsageError: The folder is not empty, or has no run to continue.
    """
    _check_folder(out, resume)
    with hold_folder(out, *IMAGE_FOLDERS) as notes:
        _check_folder(out, resume)  # another process may have filled it before this one held it
        yield notes


def _check_folder(out: Path, resume: bool) -> None:
    """Raise a UsageError if a folder has no run to continue, or must be new but is not."""
    try:
        if not (out / CONFIG).exists() and (out / POSED_SCENE / POSES).is_file():
            return
        if resume and not (out / CONFIG).is_file():
            raise UsageError(f"--resume: {out} holds no {CONFIG}; give the folder of a run")
        if not resume and out.exists() and not (out.is_dir() and is_empty(out)):
            check_free(out)
            raise UsageError(f"{out} exists already; choose another --out, or continue that run with --resume")
    except OSError as e:
        raise UsageError(f"{out}: cannot be read ({e.strerror or e}); choose another --out") from e


def camera_values(camera: Camera) -> dict[str, Any]:
    """Return the values of a camera for config.json; with coefficients if the model has some."""
    values = {n: v.tolist() if isinstance(v, np.ndarray) else v for n, v in vars(camera).items()}
    return values if camera.distortion is not None else {n: v for n, v in values.items() if n != "distortion"}


def _camera(values: dict[str, Any]) -> Camera:
    """Return the camera from the result of `camera_values`; UsageError if its camera model is not supported."""
    arrays = {k: np.array(values[k], np.float64) for k in ("viewmat", "K", "distortion") if values.get(k) is not None}
    camera = Camera(**(values | arrays))
    check_camera(camera)
    return camera


def _cameras(stored: dict[str, Any], path: Path) -> dict[str, Camera]:
    """Return the cameras of a file by name; DataError if a camera model is not supported."""
    try:
        return {n: _camera(c) for n, c in stored.items()}
    except UsageError as e:
        raise DataError(f"{path}: {e}") from e


def record_of(
    request: SceneRequest, config: FitConfig, scene: Scene, split: Split, notes: list[str], device: torch.device
) -> dict[str, Any]:
    """Return the contents of config.json: format, scene, views, settings, device, versions and cameras."""
    return {
        "format": FORMAT,
        "scene": {**asdict(request), "path": str(Path(request.path).resolve()) if request.path else None},
        "scene_format": scene.format, "fingerprint": scene.fingerprint,
        "train": split.train, "test": split.test, "notes": notes,
        "normalization": {"offset": scene.normalization.offset.tolist(), "scale": scene.normalization.scale},
        "background": scene.background, "transparent": scene.transparent,
        "config": config.to_json(), "config_hash": config.fingerprint(), "own_code": config.own_code(),
        "device": device.type, "versions": versions(),
        "cameras": {v.name: camera_values(v.camera) for v in scene.views},
    }  # fmt: skip


def read_record(folder: Path) -> dict[str, Any]:
    """Read config.json of a run folder; its format is checked first.

    Raises:
        DataError: The folder is not a run, its record is incomplete, or another version of warpgs wrote it in an unsupported
            format; the message names that version and the fix.
    """
    path = folder / CONFIG
    try:
        record = schema.read(path, folder)
    except FileNotFoundError as e:
        lack = f"holds no run ({CONFIG} is missing)" if folder.is_dir() else "no such folder"
        near = "" if folder.is_dir() else similar_folder(folder)
        raise DataError(f"{folder}: {lack}; {near or 'give a folder that `warpgs fit --out` filled'}") from e
    except NotADirectoryError as e:
        raise DataError(f"{folder}: is a file, not the folder of a run; give a folder that `warpgs fit --out` filled") from e
    except (OSError, schema.SchemaError) as e:
        raise DataError(f"{path}: cannot be read ({e}); give a folder that `warpgs fit --out` filled") from e
    if not isinstance(record, dict) or "config" not in record:
        raise DataError(f"{path}: not a record of a fit; give a folder that `warpgs fit --out` wrote")
    if record.get("format") != FORMAT:  # version 0.1.0 stored no number
        stored = record.get("versions")
        version = stored.get("warpgs", "unknown") if isinstance(stored, dict) else "unknown"
        raise DataError(
            f"{path}: warpgs {version} wrote this run, in a format that warpgs {__version__} does not read. Open it with "
            f"warpgs {version}, or fit the scene again into a new --out; its point_cloud.ply stays readable"
        )
    try:
        check_record(record)
    except schema.SchemaError as e:
        raise DataError(f"{path}: incomplete or damaged: {e}; restore the file, or fit the scene again into a new --out") from e
    return record


def check_same(record: dict[str, Any], stored: dict[str, Any], out: Path) -> None:
    """Check that a continued run has the same data, views, settings, user code and kind of device as before.

    Raises:
        UsageError: The run differs, or its user code is not named again.
    """
    if "pruned" in stored:
        raise UsageError(
            f"--resume: {out} is a pruned model without the state of its fit; resume the original run, "
            f"{stored['pruned']['source']}"
        )
    _check_named_again(record["config"], stored["config"], out)
    for key in ("fingerprint", "train", "test", "config", "device", "own_code"):
        now, then = json.loads(json.dumps(record[key])), stored.get(key, {} if key == "own_code" else None)
        if now != then:
            if key == "own_code":
                raise UsageError(
                    f"--resume: the code of {', '.join(now or then or {})} has changed since the run in {out} began, or the "
                    "run did not record its version; restore the code, or give a new --out"
                )
            if isinstance(now, dict) and isinstance(then, dict):
                changed = [k for k in now if now[k] != then.get(k)]
                key = f"{key} ({', '.join(changed)})"
            words = {
                "fingerprint": "the scene (its images, cameras, points or maps, or a flag that changes them, like --downscale)",
                "train": "the set of training views", "test": "the set of held-out views",
            }  # fmt: skip
            options = [f"{k} was {stored['scene'].get(k)}" for k, v in record["scene"].items() if stored["scene"].get(k) != v]
            was = f" ({', '.join(o for o in options if not o.startswith('path '))})" if key != "device" else ""
            raise UsageError(
                f"--resume: {words.get(key, key)} differs from the run in {out}{was if len(was) > 3 else ''}. To continue with "
                f"the run's own flags, give only --out {shlex.quote(str(out))} --resume; for other flags, give a new --out"
            )


def check_checkpoint(state: dict[str, Any], stored: dict[str, Any], out: Path) -> None:
    """Check that a checkpoint belongs to the fit of its config.json: same settings, data and training views.

    Raises:
        DataError: The checkpoint belongs to another fit.
    """
    for key in ("config", "fingerprint", "train"):
        found, wanted = plain(state.get(key)), stored.get(key)
        if found != wanted:
            if isinstance(found, dict) and isinstance(wanted, dict):
                key = ", ".join(k for k in {**found, **wanted} if found.get(k) != wanted.get(k))
            raise DataError(
                f"--resume: {out / TENSORS} and {CONFIG} beside it belong to different fits: {key} differs. Restore both "
                "files of one run, or fit again into a new --out"
            )


def _check_named_again(now: dict[str, Any], then: dict[str, Any], out: Path) -> None:
    """Raise a UsageError if a run used code from outside warpgs that is not named again."""

    def outside(config: dict[str, Any]) -> dict[str, list[str]]:
        names = {"--strategy": [config.get("strategy")]}
        for field in ("loss_terms", "view_modules"):
            names[f"--{field.replace('_', '-')}"] = [part["name"] for part in config.get(field, [])]
        return {flag: [n for n in found if isinstance(n, str) and ":" in n] for flag, found in names.items()}

    for flag, names in outside(then).items():
        if set(names) - set(outside(now)[flag]):
            raise UsageError(
                f"--resume: the run in {out} was fitted with user code. A run folder never decides which code is loaded; give "
                f"{flag} {','.join(names)} again"
            )


@dataclass(frozen=True, repr=False)
class StoredRun(FittedModel):
    """A finished or interrupted run, read from its folder."""

    folder: Path
    """The run folder."""
    record: dict[str, Any]
    """Contents of its config.json."""

    def notes(self) -> list[str]:
        """Return a note for the user if the fit has not ended; nothing for a finished or a pruned run."""
        if "pruned" in self.record or (self.folder / METRICS_FILE).is_file():
            return []
        why = f"the fit stopped after step {self.step:,}"
        return [f"{self.folder}: {why}; to finish, repeat the fit's command with --resume"]

    def scene_request(self, reader: str | None = None) -> SceneRequest:
        """Return the fitted scene with the options for reading it.

        Args:
            reader: A user-defined reader, if the scene was read with one. It must be named again, because a run folder never
                selects code.

        Raises:
            DataError: The scene was passed from Python and has no folder.
            UsageError: The scene was read with another user-defined reader.
        """
        return _stored_scene(self.folder, self.record, reader)


def _stored_scene(folder: Path, record: dict[str, Any], reader: str | None) -> SceneRequest:
    """Return the scene of a run's record, as `StoredRun.scene_request` does."""
    if record["scene"]["path"] is None:
        raise DataError(
            f"{folder}: the scene was passed from Python and has no folder; score the model in Python with warpgs.evaluate"
        )
    request = SceneRequest(**record["scene"])
    if not os.path.exists(request.path) and (folder / POSED_SCENE / POSES).is_file():
        request = replace(request, path=str(folder / POSED_SCENE))  # the run folder was moved, and its scene with it
    if request.reader is not None and ":" in request.reader and reader != request.reader:
        raise UsageError(
            f"{folder}: the scene was read with user code. A run folder never decides which code is loaded; give --reader "
            f"{request.reader} again"
        )
    return request


def stored_request(folder: Path) -> FitRequest:
    """Return the request that continues a run, with the scene and all settings that the run was started with.

    Raises:
        DataError: The folder is not a run, its settings are invalid, or its scene was passed from Python.
        UsageError: The run used code from outside warpgs, which must be named again.
    """
    record = read_record(folder)
    try:
        scene = _stored_scene(folder, record, None)
        _check_named_again({}, record["config"], folder)
    except UsageError as e:
        raise UsageError(f"{e}, with the scene and all other flags of the run") from e
    try:
        config = FitConfig.from_json(record["config"])
    except (UsageError, schema.SchemaError) as e:
        raise DataError(f"{folder / CONFIG}: invalid settings ({e}); restore the file, or fit the scene again") from e
    return FitRequest(scene, folder, config, record["device"], resume=True)


def open_run(folder: str | Path, device: str | torch.device = "auto") -> StoredRun:
    """Read a finished or interrupted run.

    Args:
        folder: The run folder.
        device: Device of the tensors: auto, cpu, cuda, or a torch device.

    Raises:
        DataError: The folder is not a run folder, another version of warpgs wrote it, or its checkpoint is incomplete.
        ResourceError: The device is missing.
        UsageError: The name of the device is unknown.
    """
    folder = Path(folder)
    where, _ = choose_device(device)
    record = read_record(folder)
    offset, scale = record["normalization"]["offset"], record["normalization"]["scale"]
    red, green, blue = map(float, record["background"])
    tensors, state = load_checkpoint(folder)
    gaussians, step = _model_of(tensors, state, folder / TENSORS)
    cameras = _cameras(record["cameras"], folder / CONFIG) | _cameras(state.get("cameras", {}), folder / TENSORS)
    train, test, rule = tuple(record["train"]), tuple(record["test"]), record["config"]["rule"]
    return StoredRun(
        gaussians.to(where),
        Normalization(np.array(offset, np.float64), float(scale)),
        cameras, train, test, rule, (red, green, blue), step, folder, record, transparent=record.get("transparent", False),
        antialiased=record["config"].get("antialiased", False),
    )  # fmt: skip


def _model_of(tensors: dict[str, torch.Tensor], state: dict[str, Any], path: Path) -> tuple[Gaussians, int]:
    """Return the Gaussians of a checkpoint and the number of steps done; DataError if either is missing."""
    try:
        MODEL_STATE(state, "")
    except schema.SchemaError as e:
        raise DataError(f"{path}: stored state incomplete or damaged: {e}; restore the file, or fit the scene again") from e
    found = {n.removeprefix("params."): t for n, t in tensors.items() if n.startswith("params.")}
    if "sh_packed" in found and "degrees" in tensors:
        try:
            found["sh"] = unpack(found.pop("sh_packed"), tensors["degrees"])
        except ValueError as e:
            raise DataError(f"{path}: incomplete or damaged: {e}; restore the file, or fit the scene again") from e
    return checked_gaussians(found, str(path)), state["step"]
