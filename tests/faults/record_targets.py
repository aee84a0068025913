"""JSON records, lists and networks for the fuzzer: keyframes, scores, jobs, found poses, events, locks; networks and maps."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
from pathlib import Path

import cv2
import numpy as np
import torch

from tests.faults.format_targets import zip_member
from tests.faults.image_targets import png_checksums, png_rows
from tests.faults.model_targets import SMALL, onnx_field, run_files, tensors_body, tensors_header
from tests.faults.mutations import Change, json_value, many_rows, rarely, text_line, text_number, zip_bomb
from tests.faults.targets import Target, not_finite, register, writing
from tests.priors import networks as nw
from warpgs import onnx, schema
from warpgs.app import farm as farm_command
from warpgs.errors import DataError, UsageError
from warpgs.files import write_json
from warpgs.pipeline.farm import job, work
from warpgs.pipeline.films import paths
from warpgs.pipeline.metrics import lpips
from warpgs.pipeline.run import folder
from warpgs.pipeline.train import presets, settings
from warpgs.pipeline.train.settings import FitConfig
from warpgs.poses import find as poses_record, matching
from warpgs.priors import flow, networks
from warpgs.report import progress
from warpgs.scene import Camera, Normalization, View

JSON_CHANGES: tuple[Change, ...] = (json_value, json_value, rarely(many_rows, json_value), text_number)


def add(name: str, file: str, values: object, read, parser: tuple, **more) -> None:
    """Register the reader of one JSON file."""

    def prepare(root: Path) -> list[Path]:
        write_json(root / file, values)
        return [root / file]

    register(Target(name, prepare, read, parser, **({"changes": JSON_CHANGES} | more)))


# ---- camera paths ------------------------------------------------------------------------------------------------------

TEMPLATE = Camera(np.eye(4), np.array([[40.0, 0, 32], [0, 40, 24], [0, 0, 1]]), 64, 48)


def turned(angle: float) -> list[list[float]]:
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return [[c, 0.0, s, angle], [0.0, 1.0, 0.0, 0.5], [-s, 0.0, c, -2.0], [0.0, 0.0, 0.0, 1.0]]


PATH = [{"c2w": turned(0.3 * i), "fov_y": 0.8 + 0.1 * i, "seconds": 2.0 * i} for i in range(4)]
UNITS = Normalization(np.array([1.0, 2, 3]), 0.5)
add(
    "keyframes", "path.json", PATH, lambda root, path: paths.through(paths.read_keyframes(path, TEMPLATE, UNITS), 5),
    (paths.read_keyframes, paths.through), lines=0.85,
    nonsense=lambda cameras: "".join(not_finite(viewmat=c.viewmat, K=c.K) for c in cameras),
)  # fmt: skip

# ---- scores of a run ---------------------------------------------------------------------------------------------------

SCORES = {
    "test": {"psnr": 24.5, "ssim": 0.8}, "train": {"psnr": 30.25, "ssim": None}, "views": [{"name": "a.png", "psnr": 24.5}],
    "variants": {"lpips": "vgg 0.1"}, "config_hash": "ab12", "steps": 500, "gaussians": 7, "batch": 1, "ranks": 1,
    "seconds": {"total": 12.5},
    "protocol": {"split": "llff:8", "training_views": 3, "held_out_views": 1, "ground_truth": "as stored",
        "resolution": ["16 x 12"], "score_masks": 0},
}  # fmt: skip
SCHEMA = (
    schema.parse, schema.check_parts, schema.check_depth, schema.read, schema.text, schema.real, schema.whole(),
    schema.number(), schema.or_null(schema.text), schema.items(schema.text), schema.mapping(schema.text), schema.fields({}),
    schema._must,
)  # fmt: skip
"""What reads JSON and checks values, without what only makes a schema, once, when warpgs is imported."""
add("scores", "metrics.json", SCORES, lambda root, path: work._scores(path), (work._scores, *SCHEMA))

# ---- farms -------------------------------------------------------------------------------------------------------------

JOB = job.JobRecord("a", "ab12", "done", "fitted", seconds=1.5, psnr=24.5, files=dict.fromkeys(job.CHECKED, "ab12"))
add(
    "record of a job", job.RECORD, dataclasses.asdict(JOB), lambda root, path: job.read_job_record(root),
    (job.read_job_record, schema.fields, schema.mapping, schema.one_of), lines=0.6,
)  # fmt: skip

LINES = (
    {"scene": "a", "steps": 500, "strategy": "mcmc"}, {"scene": "b", "name": "second", "strict": True, "split": "llff:8"},
    {"scene": "c", "optimizer.scales_lr": 0.5},
)  # fmt: skip


job_files = writing({"jobs.jsonl": "".join(json.dumps(line) + "\n" for line in LINES).encode()})


def one_line(change: Change) -> Change:
    def changed(data: bytes, rng: np.random.Generator) -> bytes:
        lines = data.split(b"\n")
        i = int(rng.integers(len(lines)))
        lines[i] = change(lines[i], rng)
        return b"\n".join(lines)

    return changed


LINE_CHANGES = (one_line(json_value), one_line(json_value), one_line(text_number), text_line)
LISTING = (job.list_jobs, job._read, job._flag)
register(Target("list of jobs", job_files, lambda root, path: job.list_jobs(str(path)), LISTING, LINE_CHANGES))


def jobs_with_flags(root: Path, path: Path) -> list:
    """Read the flags of each job, too, as the command does."""
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            return farm_command.jobs_of(job.list_jobs(str(path)), [], root / "out")
    except UsageError as e:  # a wrong flag is told by its job, and the file is named on the command line
        raise UsageError(f"{path}: {e}") from e


register(Target("flags of jobs", job_files, jobs_with_flags, (farm_command.jobs_of,), LINE_CHANGES, lines=0.7, share=0.01))

# ---- found poses, events, locks ----------------------------------------------------------------------------------------

FOUND = {
    "format": 1, "source_sha256": "ab12", "notes": ["a note"], "advice": ["more photographs"],
    "mean_reprojection_error_px": 0.5,
    "points": 40, "method": "incremental", "pairs_tried": 3, "pairs_matched": 2, "pycolmap": "3.12",
    "cameras": [{"focal": 50.5, "distortion": 0.01, "width": 64, "height": 48}],
    "photographs": [
        {"name": "a.jpg", "sha256": "ab", "registered": True, "keypoints": 90, "points": 40, "matches": {"b.jpg": 30},
         "reason": None},
        {"name": "b.jpg", "sha256": "cd", "registered": False, "keypoints": 9, "points": 0, "matches": {},
         "reason": "has few keypoints"},
    ],
}  # fmt: skip


add(
    "record of poses", poses_record.JSON, FOUND,
    lambda root, path: poses_record.report_lines(poses_record.read_poses_record(root)),
    (poses_record.read_poses_record, poses_record.report_lines, schema.items), lines=0.85,
)  # fmt: skip


def event_files(root: Path) -> list[Path]:
    log = progress.EventLog(root / "metrics.jsonl")
    for step in range(1, 5):
        log.write(step=step, loss=0.5 / step, psnr=None if step == 2 else 20.0 + step)
    log.close()
    return [root / "metrics.jsonl"]


def events_of(root: Path, path: Path) -> list[dict] | None:
    """Read a log; None where no line is whole. A fit that goes on drops later events."""
    if not path.is_file():
        raise DataError(f"{path}: there is no log, and nobody reads one that is not there")
    found = progress.read_events(path)
    log = progress.EventLog(path, step=2)
    log.close()
    assert [e["step"] for e in progress.read_events(path)] == [e["step"] for e in found if e["step"] <= 2]
    return found or None


def events_nonsense(found: list[dict]) -> str:
    sound = all(isinstance(e["step"], int) and all(isinstance(v, (int, float)) for v in e.values()) for e in found)
    return "" if sound else "an event holds something else than numbers"


EVENTS = (progress.read_events, progress.EventLog.rewind)
register(Target("events", event_files, events_of, EVENTS, LINE_CHANGES, nonsense=events_nonsense, lines=0.75))


# ---- runs --------------------------------------------------------------------------------------------------------------

RESUMED = (folder.stored_request, folder._stored_scene, folder._check_named_again, FitConfig.from_json)


def resumed(root: Path, path: Path) -> object:
    request = folder.stored_request(root)
    json.dumps(request.config.to_json())
    return request


register(Target("continued run", run_files, resumed, RESUMED, JSON_CHANGES, lines=0.65))


# ---- presets -----------------------------------------------------------------------------------------------------------

PRESET = """base = "mcmc"
steps = 40
memory-limit = "2GiB"
loss-terms = "alpha"
depth-model = "d.onnx"
init.opacity = 0.25
cuda-graph = true

[alpha]
weight = 0.5
[mcmc]
noise-lr = 1e4
"""


def settings_of_preset(root: Path, path: Path) -> FitConfig:
    config, origin = presets.preset_settings(path)
    assert config.preset == path.name and str(path) in origin
    return FitConfig.from_json(json.loads(json.dumps(config.to_json(), allow_nan=False)))


PRESET_PARSER = (presets._read, presets._config_of_file, presets._config_of, settings.with_settings, settings._typed)
register(Target("preset", writing({"my.toml": PRESET.encode()}), settings_of_preset, PRESET_PARSER, LINE_CHANGES, lines=0.7))

# ---- images of a run ---------------------------------------------------------------------------------------------------


def render_files(root: Path) -> list[Path]:
    image = np.random.default_rng(0).integers(0, 256, (12, 48, 3)).astype("u1")
    (root / "renders").mkdir()
    cv2.imwrite(str(root / "renders" / "a.png"), image)
    return [root / "renders" / "a.png"]


def thumbnail(root: Path, path: Path) -> bytes | None:
    target = root / job.THUMBNAIL
    target.unlink(missing_ok=True)
    work.write_thumbnail(root / "renders", target)
    return target.read_bytes() if target.is_file() else None


register(Target("render of a job", render_files, thumbnail, (work.write_thumbnail,), (png_rows, png_rows), png_checksums))


# ---- weights of LPIPS as others publish them ---------------------------------------------------------------------------


def state_files(root: Path) -> list[Path]:
    lpips.NETS["small"] = SMALL  # the real ones have millions of weights
    for name in ("heads", "backbone"):
        state = {n: torch.ones(s) for n, s in SMALL.shapes().items() if n.startswith("lin") == (name == "heads")}
        torch.save(state, root / f"{name}.pth")
    return [root / "backbone.pth", root / "heads.pth"]


def converted(root: Path, path: Path) -> object:
    (root / "out.safetensors").unlink(missing_ok=True)
    lpips.convert_lpips(root / "backbone.pth", root / "heads.pth", root / "out.safetensors")
    return lpips.read_lpips(root / "out.safetensors")


STATES = (lpips._read_state, lpips._net_of, lpips.convert_lpips)
register(Target("LPIPS state dict", state_files, converted, STATES, (zip_member, rarely(zip_bomb, zip_member)), lines=0.8))

# ---- maps on disk ------------------------------------------------------------------------------------------------------

IMAGE = np.random.default_rng(0).random((6, 9, 3), np.float32)
NAMES = ("a", "b")


def map_files(root: Path) -> list[Path]:
    maps = tuple(np.full((6, 9), v, np.float32) for v in (0.25, 1.0))
    networks.MapCache(root).maps(IMAGE, NAMES, {"model": "x"}, lambda: maps)
    return list(root.glob("*.safetensors"))


def maps_of(root: Path, path: Path) -> tuple[np.ndarray, ...] | None:
    store = networks.MapCache(root)
    found = store._read(path, NAMES, IMAGE.shape[:2])
    assert found is not None or not path.exists() or str(path) in store.notes[0]
    return found


register(
    Target(
        "stored maps", map_files, maps_of, (networks.MapCache._read,), (tensors_header, tensors_body),
        nonsense=lambda maps: "" if all(m.shape == (6, 9) and 0 <= m.min() <= m.max() <= 1 for m in maps) else "a map is none",
    )
)  # fmt: skip

# ---- networks in onnxruntime -------------------------------------------------------------------------------------------


LINEAR = {f"{layout}.onnx": nw.linear(np.eye(3), np.zeros(3), layout=layout) for layout in ("nchw", "nhwc")}
NETWORK = (networks.Network.__init__, onnx.Model.__init__, onnx.start_session, onnx.read_model)
register(
    Target(
        "network", writing(LINEAR), lambda root, path: networks.Network(path, threads=1), NETWORK,
        (onnx_field, onnx_field, onnx_field), lines=0.7, share=0.3,
    )
)  # fmt: skip


MATCHER = {"matcher.onnx": nw.matcher(np.array([[3.0, 4.0]]), np.ones(1), np.array([[0.6, 0.8]]))}


def matcher_nonsense(found: matching.Features) -> str:
    pixels, descriptors = found
    inside = (pixels >= 0) & (pixels <= 8)
    return "" if inside.all() and len(pixels) == len(descriptors) else "a keypoint is none"


register(
    Target(
        "matcher", writing(MATCHER),
        lambda root, path: matching.Matcher(path, threads=1).features(np.zeros((8, 8, 3), np.uint8)),
        (matching.Matcher.__init__, matching.Matcher.features, matching.Matcher._check),
        (onnx_field, onnx_field, onnx_field), nonsense=matcher_nonsense, lines=0.6, share=0.2,
    )
)  # fmt: skip


def flow_networks(root: Path) -> list[Path]:
    """Write a network of flow for images of one size, one for any size, and one whose output is no flow."""
    for name, (size, count) in {"fixed": ((8, 8), 2), "any": (("h", "w"), 2), "image": ((8, 8), 3)}.items():
        nodes = [nw.node("Sub", ["a", "b"], ["x"]), nw.node("Conv", ["x", "W"], ["y"])]
        tensors = [nw.tensor("W", np.ones((count, 3, 1, 1)))]
        images = [nw.value(n, (1, 3, *size)) for n in "ab"]
        (root / f"{name}.onnx").write_bytes(nw.model(nw.graph(nodes, tensors, images, [nw.value("y", (1, count, *size))])))
    return sorted(root.glob("*.onnx"))


def flow_by_network(root: Path, path: Path) -> np.ndarray:
    camera = Camera(np.eye(4), np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), 9, 6)
    return flow._network(path)(View("a", camera, IMAGE), View("b", camera, 1 - IMAGE))


register(
    Target(
        "flow network", flow_networks, flow_by_network, (flow._network,), (onnx_field, onnx_field, onnx_field),
        nonsense=lambda found: "" if found.shape == (6, 9, 2) and found.dtype == np.float32 else "no flow", share=0.3,
    )
)  # fmt: skip
