"""The run folder: its files, what they must hold, and how they are opened."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import json
import math
import os
import platform
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch

from warpgs import schema
from warpgs.constants import K_TOLERANCE, POSE_TOLERANCE, RULES
from warpgs.errors import DataError, NotFiniteError, UsageError, similar_folder
from warpgs.files import is_empty, open_input, plain, unread_reason, write_bytes
from warpgs.io.images import CHOICES
from warpgs.io.load import Split
from warpgs.kernels.cameras import check_camera
from warpgs.locks import check_free, hold_folder
from warpgs.pipeline.model.table import FittedModel, checked_gaussians, unpack
from warpgs.pipeline.run.request import FitRequest, SceneRequest, choose_device
from warpgs.pipeline.train.settings import FitConfig, fingerprint, upgraded
from warpgs.pipeline.train.view_modules import FittedViews
from warpgs.pipeline.train.views import LearnedViews
from warpgs.poses.find import JSON as POSES
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Camera, Gaussians, Normalization, Scene, View
from warpgs.schema import Schema, SchemaError, fields, flag, items, mapping, number, one_of, or_null, real, text, whole
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
    if path.is_absolute() or path.name in ("", "..") or ".." in path.parts:
        raise SchemaError(f"{place} must be the relative path of an image, not {value[:60]!r}")


def _matrix(rows: int) -> Schema:
    return items(items(number(), rows), rows)


def _intrinsics(value: Any, place: str) -> None:
    """Allow intrinsics without skew, as `rasterize` needs them."""
    _matrix(3)(value, place)
    fixed = ((0, 1, 0), (1, 0, 0), (2, 0, 0), (2, 1, 0), (2, 2, 1))
    if any(abs(value[i][j] - wanted) > K_TOLERANCE for i, j, wanted in fixed):
        raise SchemaError(f"{place} must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    least, most = FOCAL_LENGTHS
    if not all(least <= abs(value[i][i]) <= most for i in (0, 1)):
        raise SchemaError(f"{place} must have focal lengths from {least:g} to {most:g} px")


def _pose(value: Any, place: str) -> None:
    """Allow rigid poses, as `rasterize` needs them."""
    _matrix(4)(value, place)
    pose = np.array(value, np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        errors = [pose[:3, :3] @ pose[:3, :3].T - np.eye(3), pose[3:] - (0, 0, 0, 1)]
    near = np.abs(pose[:3, 3]).max() <= MAX_TRANSLATION
    if not (near and all(np.abs(e).max() <= POSE_TOLERANCE for e in errors)):  # also where products overflow
        raise SchemaError(
            f"{place} must be a rotation and a translation within {MAX_TRANSLATION:g}, without scale, above the row 0, 0, 0, 1"
        )


_CAMERA = fields(
    {"viewmat": _pose, "K": _intrinsics, "width": whole(1, MAX_SIDE), "height": whole(1, MAX_SIDE)},
    {"model": text, "distortion": items(number())},
    others=False,
)
_SCENE = fields(
    {
        "path": or_null(text), "split": or_null(text), "downscale": whole(1), "strict": flag, "allow_outside": flag,
        **{name: one_of(*choices) for name, choices in CHOICES.items()}, "black_is_empty": flag,
        "score_masks": or_null(text), "reader": or_null(text),
    },
    {
        "max_pixels": whole(1), "max_side": whole(0), "reconstruction": or_null(text), "exclude": or_null(text),
        "depths": or_null(text), "normals": or_null(text),
        "depth_unit": or_null(number(above=0)), "matcher": or_null(text),
    },
    others=False,
)  # fmt: skip
_PARTS = items(fields({"name": text}))
_RECORD = fields(
    {
        "scene": _SCENE, "fingerprint": text, "train": items(_view_name), "test": items(_view_name), "notes": items(text),
        "normalization": fields({"offset": items(number(), 3), "scale": number(above=0)}),
        "background": items(number(), 3), "config_hash": text, "device": text, "versions": mapping(text),
        "config": fields(
            {"rule": one_of(*RULES), "seed": whole(0), "strategy": text, "loss_terms": _PARTS, "view_modules": _PARTS},
            {"antialiased": flag},
        ),
        "cameras": mapping(_CAMERA, _view_name),
    },
    {"scene_format": text, "transparent": flag, "own_code": mapping(text), "pruned": fields({"source": text})},
)  # fmt: skip


def check_record(record: Any) -> None:
    """Check the contents of config.json."""
    _RECORD(record, "")
    if not record["train"]:
        raise SchemaError("train must name a view")
    for name in [*record["train"], *record["test"]]:
        if name not in record["cameras"]:
            raise SchemaError(f"cameras lacks the view {name[:60]!r}")


MODEL_STATE = fields({"step": whole(0)}, {"cameras": mapping(_CAMERA, _view_name)})
"""Schema of a checkpoint's plain values from which a model is read."""
_SHAPE = fields(
    {n: number(0) for n in ("largest", "largest_over_radius", "largest_over_extent", "largest_over_distance")}
    | {n: number(0) for n in ("needles", "needles_by_opacity", "thin")}
    | {"radius": number(above=0), "extent": number(above=0), "beyond": whole(0)}
)
_PHOTOGRAPH = fields({
    "name": _view_name, "compared_with": whole(0), "sharpness": or_null(number(0)), "brightness": or_null(number(0)),
    "channels": or_null(items(number(0), 3)), "moved": or_null(number(0)),
})  # fmt: skip
_COVERED = mapping(
    fields({
        "pixels": whole(0), "share_of_pixels": number(0), "share_of_error": number(0), "psnr": or_null(real),
        "ssim": or_null(real), "expected_psnr": or_null(real),
    }),
    one_of("0", "1", "2+", "background"),
)  # fmt: skip
OPACITY = ("psnr_whole", "psnr_foreground", "alpha_empty", "alpha_object")
"""Scores of views with an alpha channel, defined in `warpgs.pipeline.metrics.scores`."""
METRICS = fields(
    {
        "test": mapping(or_null(real)), "train": mapping(or_null(real)),
        "views": items(fields({"name": text, "psnr": or_null(real)}, dict.fromkeys(OPACITY, or_null(real)))),
        "variants": mapping(text), "config_hash": text, "steps": whole(0),
        "protocol": fields({
            "split": text, "training_views": whole(0), "held_out_views": whole(0), "ground_truth": text,
            "resolution": items(text), "score_masks": whole(0),
        }),
    },
    {
        "gaussians": whole(0), "batch": whole(1), "ranks": whole(1), "seconds": fields({"total": number(0)}), "shape": _SHAPE,
        "photographs": items(_PHOTOGRAPH),
        "view_modules": mapping(fields({"summary": text})),
        "coverage": fields({
            "classes": _COVERED, "views": items(fields({"name": text, "classes": _COVERED})), "tolerance": number(0),
            "depth_differences": items(number(0)), "photo_psnr": or_null(items(or_null(real))), "summary": text,
        }),
    },
)  # fmt: skip
"""Schema of metrics.json and of eval.json."""


TENSORS = "checkpoint.safetensors"
FORMAT = 2
"""Version of the format of run folders: config.json and the checkpoint. warpgs 0.1.0 wrote version 1."""
DTYPES = {
    torch.float64: "F64",
    torch.float32: "F32",
    torch.int64: "I64",
    torch.int32: "I32",
    torch.uint8: "U8",
    torch.bool: "BOOL",
}
"""Names of scalar types in the format."""


def safetensors_chunks(tensors: dict[str, torch.Tensor], metadata: dict[str, str]) -> list[memoryview | bytes]:
    """Return a safetensors file in pieces; pieces of CPU tensors share their memory, so nothing is copied."""
    ordered = sorted(tensors.items(), key=lambda item: (-item[1].element_size(), item[0]))  # aligned for every reader
    parts = [t.detach().cpu().contiguous().reshape(-1).view(torch.uint8) for _, t in ordered]
    header: dict[str, Any] = {"__metadata__": metadata}
    end = 0
    for (name, t), part in zip(ordered, parts):
        begin, end = end, end + len(part)
        header[name] = {"dtype": DTYPES[t.dtype], "shape": list(t.shape), "data_offsets": [begin, end]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return [len(text).to_bytes(8, "little"), text, *(p.numpy().data for p in parts)]


def save_checkpoint(folder: Path, tensors: dict[str, torch.Tensor], state: dict[str, Any]) -> Path:
    """Write tensors and state, which JSON can hold, into one file, atomically; refuse non-finite tensors. Returns the path."""
    # ``state`` is stored in the header of the same file, so tensors and state always belong to the same step.
    path = folder / TENSORS
    for name, t in tensors.items():
        # minimum and maximum suffice, without a copy: torch returns NaN if any value is NaN
        if t.is_floating_point() and t.numel() and not all(math.isfinite(float(v)) for v in t.aminmax()):
            raise NotFiniteError(
                f"{path} was not written: {name} holds non-finite values; results after the last checkpoint are invalid. "
                "--resume would repeat the same steps; fit again into a new --out with lower learning rates"
            )
    metadata = {"format": str(FORMAT), "version": __version__, "state": json.dumps(state)}
    chunks = safetensors_chunks(tensors, metadata)
    digest = hashlib.sha256()
    for chunk in chunks:
        digest.update(chunk)
    write_bytes(path, *chunks, digest.digest())
    return path


def load_checkpoint(folder: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Read tensors by name, on the CPU, and state; refuse a damaged checkpoint or one of another format."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    path = folder / TENSORS
    try:
        with open_input(path, folder) as file:
            body = file.read(max(0, os.fstat(file.fileno()).st_size - 32))
            digest = file.read(33)
    except FileNotFoundError as e:
        raise DataError(f"{folder} holds no {TENSORS}: no checkpoint yet; run `warpgs fit` first") from e
    except OSError as e:
        raise DataError(f"{path}: cannot be read ({unread_reason(e)}); restore the file, or fit again") from e
    if hashlib.sha256(body).digest() != digest:
        raise DataError(f"{path}: the checksum does not match: the file was truncated or altered; restore it, or fit again")
    try:
        tensors = load(body)
        length = int.from_bytes(body[:8], "little")
        metadata = json.loads(body[8 : 8 + length])["__metadata__"] or {}
    except (SafetensorError, KeyError, ValueError) as e:
        raise DataError(f"{path} is not a warpgs checkpoint ({e})") from e
    if metadata.get("format") != str(FORMAT):
        version = metadata.get("version", "0.1.0")
        raise DataError(
            f"{path}: warpgs {version} wrote this checkpoint, in a format that warpgs {__version__} does not read. Open it "
            f"with warpgs {version}, or fit the scene again into a new --out"
        )
    try:
        state = schema.parse(metadata["state"])
        schema.mapping(schema.anything)(state, "")
    except (KeyError, schema.SchemaError) as e:
        raise DataError(f"{path}: the stored state is incomplete or damaged ({e}); restore the file, or fit again") from e
    return tensors, state


def cameras_of(scene: Scene) -> dict[str, Camera]:
    """Return the cameras of the views of a scene by name."""
    return {v.name: v.camera for v in scene.views}


def learned_cameras(scene: Scene, split: Split, learned: LearnedViews) -> Mapping[str, Camera]:
    """Return the cameras of all views of a scene after the view modules, by name."""
    return learned.cameras(cameras_of(scene), split.train, split.test)


def with_cameras(scene: Scene, cameras: Mapping[str, Camera]) -> Scene:
    """Return a scene in which the views named in a mapping have the mapping's cameras; other views are unchanged."""
    return replace(scene, views=tuple(replace(v, camera=cameras.get(v.name, v.camera)) for v in scene.views))


def learned_figures(
    learned: LearnedViews, scene: Scene, split: Split, given: Mapping[str, Camera], test: Sequence[View],
    gaussians: Gaussians, options: RasterizeOptions,
) -> dict[str, dict[str, Any]]:  # fmt: skip
    """Return the figures of each view module by its name, for metrics.json; ``given`` are the cameras before the fit."""
    cameras, scale = cameras_of(scene), scene.normalization.scale
    return {
        m.name: m.figures(FittedViews(learned.params_of(m), split.train, test, given, cameras, scale, gaussians, options))
        for m in learned.modules
    }


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
    """Read config.json of a run folder; its format is checked first."""
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
    stored, (record["config"], lost) = record["config"], upgraded(record["config"])
    if lost:
        record["lost"] = lost
    elif record["config"] != stored:
        record["config_hash"] = fingerprint(record["config"])
    return record


def check_same(record: dict[str, Any], stored: dict[str, Any], out: Path) -> None:
    """Check that a continued run has the same data, views, settings, user code and kind of device as before."""
    if "pruned" in stored:
        raise UsageError(
            f"--resume: {out} is a pruned model without the state of its fit; resume the original run, "
            f"{stored['pruned']['source']}"
        )
    _check_lost(stored, out)
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


def _check_lost(stored: dict[str, Any], out: Path) -> None:
    """Raise a UsageError if a run has settings that this version lacks."""
    if lost := stored.get("lost"):
        raise UsageError(
            f"--resume: the run in {out} has settings that warpgs {__version__} does not have: {', '.join(lost)}. Resume it "
            f"with warpgs {stored['versions'].get('warpgs', 'of that time')}, or fit again into a new --out"
        )


def check_checkpoint(state: dict[str, Any], stored: dict[str, Any], out: Path) -> None:
    """Check that a checkpoint belongs to the fit of its config.json: same settings, data and training views."""
    for key in ("config", "fingerprint", "train"):
        found, wanted = plain(state.get(key)), stored.get(key)
        if key == "config" and isinstance(found, dict):
            found = upgraded(found)[0]
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
        return {option: [n for n in found if isinstance(n, str) and ":" in n] for option, found in names.items()}

    for option, names in outside(then).items():
        if set(names) - set(outside(now)[option]):
            raise UsageError(
                f"--resume: the run in {out} was fitted with user code. A run folder never decides which code is loaded; give "
                f"{option} {','.join(names)} again"
            )


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
    """Return the request that continues a run, with the scene and all settings that the run was started with."""
    record = read_record(folder)
    _check_lost(record, folder)
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
