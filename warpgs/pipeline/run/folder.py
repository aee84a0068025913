"""The run folder: its files, what they must hold, and how they are opened."""

import contextlib
import hashlib
import importlib.metadata
import json
import math
import os
import platform
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, get_type_hints

import numpy as np
import torch

from warpgs import schema
from warpgs.constants import RULES
from warpgs.errors import DataError, NotFiniteError, UsageError, expect, explained, similar_folder
from warpgs.files import is_empty, open_input, plain, tensor_pieces, tensors_of, write_bytes
from warpgs.io.load import Split
from warpgs.kernels.cameras import check_camera
from warpgs.locks import check_free, hold_folder
from warpgs.pipeline.model.table import SIMILARITY, FittedModel, checked_gaussians, similarity_of, similarity_values, unpack
from warpgs.pipeline.run.request import FitRequest, SceneRequest, choose_device
from warpgs.pipeline.train.settings import FitConfig, fingerprint, upgraded
from warpgs.poses.find import JSON as POSES
from warpgs.render.rasterize import check_arrays
from warpgs.scene import Camera, Scene
from warpgs.schema import SchemaError, fields, flag, items, mapping, number, one_of, or_null, real, text, whole
from warpgs.version import __version__

MAX_SIDE = 2**16
"""Largest width and height of a stored camera [px], far above those of any image."""
FOCAL_LENGTHS = 1e-9, 1e12
"""Least and largest focal length of a stored camera [px], or pixels per unit of an orthographic one."""
MAX_TRANSLATION = 1e12
"""Largest entry of the translation of a stored camera [u]: squares of distances stay finite in float32."""


def _view_name(value: Any, place: str) -> None:
    """Allow names of views: relative paths of files."""
    text(value, place)
    path = PurePosixPath(value)
    sound = not path.is_absolute() and path.name not in ("", "..") and ".." not in path.parts
    expect(sound, f"{place} must be the relative path of an image, not {value[:60]!r}")


_MATRICES = {name: items(items(number(), size), size) for name, size in (("viewmat", 4), ("K", 3))}
_SIZES = dict.fromkeys(("width", "height"), whole(1, MAX_SIDE))
_CAMERA = fields(_MATRICES | _SIZES, {"model": text, "distortion": items(number())}, others=False)
_SCENE = fields(
    {"path": or_null(text)},
    {name: schema.of_type(hint) for name, hint in get_type_hints(SceneRequest).items() if name != "path"}
    | {name: one_of(*choices) for name, choices in schema.rules_of(SceneRequest)}
    | {"downscale": whole(1)},
    others=False,
)
_PARTS = items(fields({"name": text}))
_RECORD = fields(
    {
        "scene": _SCENE, "fingerprint": text, "train": items(_view_name), "test": items(_view_name), "notes": items(text),
        "normalization": SIMILARITY,
        "background": items(number(), 3), "config_hash": text, "device": text, "versions": mapping(text),
        "config": fields(
            {"rule": one_of(*RULES), "seed": whole(0), "strategy": text, "loss_terms": _PARTS, "view_modules": _PARTS},
            {"antialiased": flag},
        ),
        "cameras": mapping(_CAMERA, _view_name),
    },
    {
        "scene_format": text, "transparent": flag, "own_code": mapping(text),
        "pruned": fields({"source": text}),
    },
)  # fmt: skip


MODEL_STATE = fields({"step": whole(0)}, {"cameras": mapping(_CAMERA, _view_name)})
"""Schema of a checkpoint's plain values from which a model is read."""
METRICS = fields(
    {
        "test": mapping(or_null(real)), "train": mapping(or_null(real)),
        "views": items(fields({"name": text, "psnr": or_null(real)})), "variants": mapping(text), "config_hash": text,
        "steps": whole(0),
        "protocol": fields({
            "split": text, "training_views": whole(0), "held_out_views": whole(0), "ground_truth": text,
            "resolution": items(text), "score_masks": whole(0),
        }),
    },
    {"gaussians": whole(0), "seconds": fields({"total": number(0)})},
)  # fmt: skip
"""Schema of what is read of metrics.json and eval.json."""


TENSORS = "checkpoint.safetensors"
FORMAT = 2
"""Version of the format of run folders: config.json and the checkpoint. warpgs 0.1.0 wrote version 1."""
RESTORE = "restore the file, or fit the scene again"


def save_checkpoint(folder: Path, tensors: dict[str, torch.Tensor], state: dict[str, Any]) -> Path:
    """Write tensors and state, which JSON can hold, into one file, atomically; refuse non-finite tensors. Returns the path."""
    # ``state`` is stored in the header of the same file, so tensors and state always belong to the same step.
    path = folder / TENSORS
    for name, t in tensors.items():
        # minimum and maximum suffice, without a copy: torch returns NaN if any value is NaN
        if t.is_floating_point() and t.numel() and not all(math.isfinite(float(v)) for v in t.aminmax()):
            lost = f"{name} holds non-finite values; results after the last checkpoint are invalid"
            fix = "--resume would repeat the same steps; fit again into a new --out with lower learning rates"
            raise NotFiniteError(f"{path} was not written: {lost}. {fix}")
    metadata = {"format": str(FORMAT), "version": __version__, "state": json.dumps(state)}
    chunks, digest = tensor_pieces(tensors, metadata), hashlib.sha256()
    for chunk in chunks:
        digest.update(chunk)
    write_bytes(path, *chunks, digest.digest())
    return path


def load_checkpoint(folder: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Read tensors by name, on the CPU, and state; refuse a damaged checkpoint or one of another format."""
    path = folder / TENSORS
    if not os.path.lexists(path):
        raise DataError(f"{folder} holds no {TENSORS}: no checkpoint yet; run `warpgs fit` first")
    with explained(f"{path}: not a whole checkpoint", RESTORE, (OSError, KeyError, ValueError)):
        with open_input(path, folder) as file:
            body = file.read(max(0, os.fstat(file.fileno()).st_size - 32))
            digest = file.read(33)
        expect(hashlib.sha256(body).digest() == digest, "the checksum does not match: the file was truncated or altered")
        tensors, metadata = tensors_of(body)
        if metadata.get("format") != str(FORMAT):
            raise DataError(_other_version(f"{path}: warpgs {metadata.get('version', '0.1.0')} wrote this checkpoint"))
        state = schema.parse(metadata["state"])
        schema.mapping(schema.anything)(state, "")
    return tensors, state


def _other_version(words: str) -> str:
    """Return a message on a file of another version; ``words`` say which version wrote which file."""
    fix = "Open it with that version, or fit the scene again into a new --out; point_cloud.ply stays readable"
    return f"{words}, in a format that warpgs {__version__} does not read. {fix}"


def cameras_of(scene: Scene) -> dict[str, Camera]:
    """Return the cameras of the views of a scene by name."""
    return {v.name: v.camera for v in scene.views}


def with_cameras(scene: Scene, cameras: Mapping[str, Camera]) -> Scene:
    """Return a scene in which the views named in a mapping have the mapping's cameras; other views are unchanged."""
    return replace(scene, views=tuple(replace(v, camera=cameras.get(v.name, v.camera)) for v in scene.views))


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
    """Lock a run folder for a fit: a new or empty one, or one with a run to continue; yields notes for the user."""
    _check_folder(out, resume)
    with hold_folder(out, *IMAGE_FOLDERS) as notes:
        _check_folder(out, resume)  # another process may have filled it before this one held it
        yield notes


def _check_folder(out: Path, resume: bool) -> None:
    """Raise a UsageError if a folder has no run to continue, or must be new but is not."""
    with explained(f"{out}: cannot be read", "choose another --out", kind=UsageError):
        if not (out / CONFIG).exists() and (out / POSED_SCENE / POSES).is_file():
            return
        if resume and not (out / CONFIG).is_file():
            raise UsageError(f"--resume: {out} holds no {CONFIG}; give the folder of a run")
        if not resume and out.exists() and not (out.is_dir() and is_empty(out)):
            check_free(out)
            raise UsageError(f"{out} exists already; choose another --out, or continue that run with --resume")


def camera_values(camera: Camera) -> dict[str, Any]:
    """Return the values of a camera for config.json; with coefficients if the model has some."""
    values = {n: v.tolist() if isinstance(v, np.ndarray) else v for n, v in vars(camera).items()}
    return values if camera.distortion is not None else {n: v for n, v in values.items() if n != "distortion"}


def _cameras(stored: dict[str, Any], path: Path) -> dict[str, Camera]:
    """Return the cameras of a file, from `camera_values`, by name; DataError if `rasterize` would refuse one."""
    found, (least, most) = {}, FOCAL_LENGTHS
    for name, values in stored.items():
        arrays = {k: np.array(values[k], np.float64) for k in ("viewmat", "K", "distortion") if values.get(k) is not None}
        camera = found[name] = Camera(**(values | arrays))
        with explained(f"{path}: incomplete or damaged: cameras.{name[:60]}", RESTORE, (UsageError, ValueError)):
            check_camera(camera)
            check_arrays(camera)
            within = np.abs(camera.viewmat[:3, 3]).max() <= MAX_TRANSLATION
            expect(within, f"viewmat must have a translation within {MAX_TRANSLATION:g}")
            focal = all(least <= abs(f) <= most for f in (camera.K[0, 0], camera.K[1, 1]))
            expect(focal, f"K must have focal lengths of {least:g} to {most:g}")
    return found


def record_of(
    request: SceneRequest, config: FitConfig, scene: Scene, split: Split, notes: list[str], device: torch.device
) -> dict[str, Any]:
    """Return the contents of config.json: format, scene, views, settings, device, versions and cameras."""
    return {
        "format": FORMAT,
        "scene": {**asdict(request), "path": str(Path(request.path).resolve()) if request.path else None},
        "scene_format": scene.format, "fingerprint": scene.fingerprint,
        "train": split.train, "test": split.test, "notes": notes,
        "normalization": similarity_values(scene.normalization),
        "background": scene.background, "transparent": scene.transparent,
        "config": config.to_json(), "config_hash": config.fingerprint(), "own_code": config.own_code(),
        "device": device.type, "versions": versions(),
        "cameras": {v.name: camera_values(v.camera) for v in scene.views},
    }  # fmt: skip


def read_record(folder: Path) -> dict[str, Any]:
    """Read config.json of a run folder; its format is checked first."""
    path = folder / CONFIG
    fix = "give a folder that `warpgs fit --out` filled"
    if not os.path.lexists(path):
        lack = f"not the folder of a run ({CONFIG} is missing)" if folder.exists() else "no such folder"
        if (folder / "scene" / "poses.json").is_file():
            lack, fix = "a fit saved only poses here, and no step", "give its whole command again, with the photographs"
        raise DataError(f"{folder}: {lack}; {(not folder.exists() and similar_folder(folder)) or fix}")
    with explained(f"{path}: not a record of a fit", fix, (OSError, ValueError)):
        record: dict[str, Any] = schema.read(path, folder)
        expect(isinstance(record, dict) and "config" in record, "it has no settings")
    if record.get("format") != FORMAT:  # version 0.1.0 stored no number
        stored = record.get("versions")
        version = stored.get("warpgs", "unknown") if isinstance(stored, dict) else "unknown"
        raise DataError(_other_version(f"{path}: warpgs {version} wrote this run"))
    with explained(f"{path}: incomplete or damaged", RESTORE, ValueError):
        _RECORD(record, "")
        expect(record["train"], "train must name a view")
        for name in [*record["train"], *record["test"]]:
            expect(name in record["cameras"], f"cameras lacks the view {name[:60]!r}")
    stored, (record["config"], lost) = record["config"], upgraded(record["config"])
    if lost:
        record["lost"] = lost
    elif record["config"] != stored:
        record["config_hash"] = fingerprint(record["config"])
    return record


SAME = {
    "fingerprint": "the scene (its images, cameras, points or maps, or a flag that changes them, like --downscale)",
    "train": "the set of training views", "test": "the set of held-out views", "config": "config", "device": "device",
    "own_code": "your own code",
}  # fmt: skip
"""Parts of config.json that stay the same in a continued run, as text for the user."""


def check_same(record: dict[str, Any], stored: dict[str, Any], out: Path) -> None:
    """Check that a continued run has the same data, views, settings, user code and kind of device as before."""
    if "pruned" in stored:
        raise UsageError(f"--resume: {out} is pruned, without the state of its fit; resume {stored['pruned']['source']}")
    _check_lost(stored, out)
    _check_named_again(record["config"], stored["config"], out)
    for key, words in SAME.items():
        now: Any = plain(record[key])
        then = stored.get(key, {})
        if now == then:
            continue
        if isinstance(now, dict):
            words += f" ({', '.join(k for k in now | then if now.get(k) != then.get(k))})"
        fix = f"give only --out {shlex.quote(str(out))} --resume; for other flags or code, give a new --out"
        raise UsageError(f"--resume: {words} differs from the run in {out}. To continue with the run's own flags, {fix}")


def _check_lost(stored: dict[str, Any], out: Path) -> None:
    """Raise a UsageError if a run has settings that this version lacks."""
    if lost := stored.get("lost"):
        lacking = f"the run in {out} has settings that this version of warpgs does not have: {', '.join(lost)}"
        code = f"the code that began it (warpgs {stored['versions'].get('warpgs', 'of that time')})"
        raise UsageError(f"--resume: {lacking}. Resume it with {code}, or fit again into a new --out")


def check_checkpoint(state: dict[str, Any], stored: dict[str, Any], out: Path) -> None:
    """Check that a checkpoint belongs to the fit of its config.json: same settings, data and training views."""
    for key in ("config", "fingerprint", "train"):
        found, wanted = plain(state.get(key)), stored.get(key)
        if key == "config" and isinstance(found, dict):
            found = upgraded(found)[0]
        if found != wanted:
            raise DataError(f"--resume: {key} differs between {out / TENSORS} and {CONFIG}; restore both, or fit again")


def _check_named_again(now: dict[str, Any], then: dict[str, Any], out: Path) -> None:
    """Raise a UsageError if a run used code from outside warpgs that is not named again."""
    for field in ("strategy", "loss_terms", "view_modules"):
        named, needed = (
            [value] if isinstance(value := config.get(field, []), str) else [part["name"] for part in value]
            for config in (now, then)
        )
        outside = [name for name in needed if ":" in name]
        if set(outside) - set(named):
            flags = (
                f"with --resume and all its flags, --{field.replace('_', '-')} {','.join(outside)} or the preset that named it"
            )
            fix = f"which no run folder may load; repeat the whole command of the fit, {flags}"
            raise UsageError(f"--resume: the run in {out} was fitted with user code, {fix}")


@dataclass(frozen=True, repr=False)
class StoredRun(FittedModel):
    """A finished or interrupted run, read from its folder."""

    folder: Path
    """The run folder."""
    record: dict[str, Any]
    """Contents of its config.json."""

    def notes(self) -> list[str]:
        """Return notes for the user: settings of a fit that no fit has now, and that a fit has not ended."""
        lost = self.record.get("lost", [])
        notes = [f"{self.folder}: fitted by another version, with {', '.join(lost)}"] if lost else []
        if "pruned" in self.record or (self.folder / METRICS_FILE).is_file():
            return notes
        why = f"the fit stopped after step {self.step:,}"
        return [*notes, f"{self.folder}: {why}; to finish, repeat the fit's command with --resume"]

    def scene_request(self, reader: str | None = None) -> SceneRequest:
        """Return the fitted scene with the options for reading it.

        Args:
            reader: A user-defined reader, if the scene was read with one. It must be named again, because a run folder never
                selects code.

        Raises:
            DataError: The scene was passed from Python and has no folder, or the folder is not there any more.
            UsageError: The scene was read with another user-defined reader.
        """
        return _stored_scene(self.folder, self.record, reader)


def _stored_scene(folder: Path, record: dict[str, Any], reader: str | None, moved: str | None = None) -> SceneRequest:
    """Return the scene of a run's record, as `StoredRun.scene_request` does, with its maps where it was ``moved``."""
    values, old = record["scene"], record["scene"]["path"]
    if old is None:
        raise DataError(f"{folder}: its scene was passed from Python; score it in Python, with warpgs.evaluate")
    if moved is not None:
        new = os.path.realpath(moved)
        inside = {n: v for n, v in values.items() if isinstance(v, str) and Path(v).is_relative_to(old)}
        values = values | {n: new + v[len(old) :] for n, v in inside.items()}
    request = SceneRequest(**values)
    if not os.path.exists(request.path) and (folder / POSED_SCENE / POSES).is_file():
        request = replace(request, path=str(folder / POSED_SCENE))  # the run folder was moved, and its scene with it
    if request.reader is not None and ":" in request.reader and reader != request.reader:
        raise UsageError(f"{folder}: its scene needs user code, which no folder may load; give --reader {request.reader} again")
    if not os.path.exists(request.path):
        again = f"`warpgs fit NEW_PLACE --out {shlex.quote(str(folder))} --resume`"
        fix = f"if it was moved, {again} stores its new place, and makes scores and report again"
        raise DataError(f"{request.path}: the scene of {folder} is gone; {fix}")
    return request


def stored_request(folder: Path, moved: str | None = None) -> FitRequest:
    """Return the request that continues a run, with all its settings, and its scene, which may have ``moved``."""
    record = read_record(folder)
    _check_lost(record, folder)
    _check_named_again({}, record["config"], folder)
    try:
        scene = _stored_scene(folder, record, None, moved)
    except UsageError as e:
        raise UsageError(f"{e}, with the scene and all other flags of the run") from e
    fix = f"{RESTORE}; a name of your own code needs the whole command of the fit, with --resume"
    with explained(f"{folder / CONFIG}: invalid settings", fix, (UsageError, SchemaError)):
        config = FitConfig.from_json(record["config"])
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
    path, (where, _) = folder / TENSORS, choose_device(device)
    record = read_record(folder)
    tensors, state = load_checkpoint(folder)
    found = {n.removeprefix("params."): t for n, t in tensors.items() if n.startswith("params.")}
    with explained(f"{path}: incomplete or damaged", RESTORE, ValueError):
        MODEL_STATE(state, "")
        if "sh_packed" in found and "degrees" in tensors:
            found["sh"] = unpack(found.pop("sh_packed"), tensors["degrees"])
    gaussians = checked_gaussians(found, str(path)).to(where)
    red, green, blue = map(float, record["background"])
    return StoredRun(
        gaussians,
        similarity_of(record["normalization"], str(folder / CONFIG)),
        _cameras(record["cameras"], folder / CONFIG) | _cameras(state.get("cameras", {}), path),
        tuple(record["train"]), tuple(record["test"]), record["config"]["rule"], (red, green, blue), state["step"], folder,
        record, transparent=record.get("transparent", False), antialiased=record["config"].get("antialiased", False),
    )  # fmt: skip
