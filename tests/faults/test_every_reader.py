"""Every function of warpgs that opens input is read by the fuzzer, or a reason stands here why it is not."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import warpgs
from tests.faults.fuzz import Worker
from tests.faults.targets import all_targets
from warpgs.pipeline.metrics import lpips_weights

PACKAGE = Path(warpgs.__file__).parent
OPENING = {
    "open", "open_file", "open_input", "read_bytes", "read_file", "read_input", "read_start", "read_text", "input_digest",
    "fromfile", "imdecode", "imread", "safe_open", "AvifImageFile", "HeifImageFile", "InferenceSession", "VideoCapture",
    "ZipFile",
}  # fmt: skip
"""Names of functions and classes that open a file or decode what one holds."""
PARSING = {"json.load", "json.loads", "np.load", "schema.parse", "schema.read", "torch.load", "msgspec.msgpack.decode"}
"""The same with their modules."""

READERS = {
    "export/base.py": {"Format.read": "splat"},
    "export/compressed_ply.py": {"start_of": "ply"},
    "export/gltf.py": {"_split": "glTF"},
    "export/ply.py": {"_read": "ply"},
    "export/sog.py": {"SOG.is_antialiased": "SOG", "decode": "SOG", "_member": "SOG", "_meta": "SOG", "_pixels": "SOG"},
    "export/spz.py": {"SPZ.is_antialiased": "SPZ"},
    "io/camera_files.py": {"_json": "cameras"},
    "io/colmap.py": {"_BinaryFile.__init__": "colmap", "_lines": "colmap"},
    "io/decoding.py": {"_raster": "any image", "read_image_file": "any image", "read_image_start": "heic by its process"},
    "io/dtu.py": {"_read_matrices": "dtu"},
    "io/image_formats/avif.py": {"open_image": "avif"},
    "io/llff.py": {"read_rows": "llff"},
    "io/map_files.py": {"_read_array": "given maps"},
    "io/middlebury.py": {"read_rows": "middlebury"},
    "io/transforms.py": {"read_json": "transforms"},
    "pipeline/farm/ensure_run.py": {"_scores": "scores"},
    "pipeline/farm/listing.py": {"_read": "list of jobs"},
    "pipeline/farm/record.py": {"read_record": "record of a job"},
    "pipeline/farm/work.py": {"write_thumbnail": "render of a job"},
    "pipeline/films/keyframes.py": {"read_keyframes": "keyframes"},
    "pipeline/metrics/lpips_weights.py": {
        "_check_unpacked": "LPIPS state dict",
        "_read_state": "LPIPS state dict",
        "read_lpips": "LPIPS weights",
    },
    "pipeline/model/filters.py": {"_box_of_file": "crop box", "box_of": "crop box"},
    "pipeline/model/model_file.py": {"load": "model file"},
    "pipeline/runs/checkpoint.py": {"load_checkpoint": "checkpoint"},
    "pipeline/runs/failed_step.py": {"read_failed_step": "failed step"},
    "pipeline/runs/folder.py": {"read_record": "run record"},
    "pipeline/train/presets.py": {"_read": "preset"},
    "poses/heic.py": {"_coded_again": "heic", "to_jpeg": "heic by its process"},
    "poses/record.py": {"read_record": "record of poses"},
    "poses/video.py": {"_check_container": "video", "_frames": "video"},
    "priors/cache.py": {"MapCache._read": "stored maps"},
    "priors/flow.py": {"_network": "flow network", "read_flo": "flow"},
    "priors/preprocess.py": {"read_side_file": "description of a network"},
    "report/events.py": {"read_events": "events"},
    "runtime/folder_lock.py": {"_signed": "signature of a lock"},
    "runtime/onnx_session.py": {"read_model": "network", "start_session": "network"},
    "schema.py": {"parse": "scores", "read": "scores"},
    "viewer/frames.py": {"read_frame": "frame of a websocket"},
}
"""Name of the fuzzer's reader by file and function."""

OWN = "reads what this process wrote just before"
PIPE = "reads lines of a process that warpgs started, by a pipe that nobody else writes to"
PRIVATE = "reads a file of the farm's private folder, which nobody else may enter"
DIGEST = "reads bytes that it does not look into"
SYSTEM = "reads what the system says"
LAYER = "opens for others, which are named here"
REASONS = {
    "export/sog.py": {"encode": "writes"},
    "files.py": {"appending": "writes", "writing": "writes", "read_file": LAYER},
    "input_files.py": {"open_input": LAYER, "read_input": LAYER, "read_start": LAYER, "input_digest": LAYER},
    "output_folders.py": {"Folder.open": LAYER, "Folder.open_regular": LAYER, "_opened": LAYER},
    "pipeline/farm/ensure_run.py": {"_with_lpips": OWN},
    "pipeline/farm/batch.py": {"main": PRIVATE},
    "pipeline/farm/job.py": {"job_of": PIPE},
    "pipeline/farm/local.py": {"LocalEngine._compile": PIPE, "LocalEngine.wait": PIPE},
    "pipeline/farm/record.py": {"file_digest": DIGEST},
    "pipeline/farm/slurm.py": {"SlurmEngine._answered": PRIVATE, "SlurmEngine._output": PRIVATE},
    "pipeline/farm/worker.py": {"main": PIPE},
    "pipeline/runs/coverage_report.py": {"coverage_section": OWN},
    "pipeline/runs/commands.py": {"render": "opens a writer of a film"},
    "pipeline/runs/folder.py": {"check_same": "copies a value"},
    "pipeline/runs/sampling_report.py": {"sampling_report_of": "reads images for `webp`, which is named here"},
    "plugins.py": {"module_digest": DIGEST},
    "poses/find.py": {"find_poses": OWN, "_digest": DIGEST},
    "poses/heic.py": {"main": PIPE},
    "poses/mapping.py": {"_lines": PIPE},
    "poses/worker.py": {
        "main": PIPE, "match": OWN, "import_photographs": OWN, "matched": OWN, "verify_learned": OWN,
    },
    "priors/export.py": {"_own_weights": "reads weights of 45 MB with safetensors, as the readers named here do"},
    "priors/export_matcher.py": {
        "package_files": "reads files whose SHA-256 must be known", "_backbone": "loads weights whose SHA-256 is known",
    },
    "priors/onnx_export.py": {"onnx_bytes": OWN},
    "report/film.py": {"_decoded_sizes": OWN},
    "report/images.py": {"webp": OWN},
    "report/overview.py": {"render_overview": OWN},
    "report/scene_plot.py": {"_rendered": OWN, "_with_legend": OWN},
    "runtime/cuda_source.py": {"source": "reads a file of the package"},
    "runtime/device_memory.py": {"_text": SYSTEM},
    "runtime/file_names.py": {"utf8_name": "opens by another name for readers that are named here"},
    "runtime/load_module.py": {"exclusive": "opens a lock"},
    "runtime/native_output.py": {"hidden_stderr": "opens /dev/null for writing"},
    "runtime/output_streams.py": {"_send_to_null": "opens /dev/null for writing"},
    "runtime/processor.py": {"processor_name": SYSTEM},
    "runtime/rank_watch.py": {"machine": SYSTEM},
    "temporary.py": {"_own_file": "writes"},
    "viewer/panel.py": {"Panel._add_sampling": "reads an image for `decode`, whose reader is named here"},
}  # fmt: skip
"""Why a function that opens something is not read by the fuzzer, by file and function."""


def opening(node: ast.AST, where: str = "", inside: bool = False) -> Iterator[str]:
    """Yield the name of each function below a node that opens or parses input; of functions in each other the outermost."""
    for child in ast.iter_child_nodes(node):
        function = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef))
        if (function or isinstance(child, ast.ClassDef)) and not inside:
            yield from opening(child, f"{where}.{child.name}".lstrip("."), function)
            continue
        if isinstance(child, ast.Call):
            called = ast.unparse(child.func)
            if called in PARSING or called.rpartition(".")[2] in OPENING:
                yield where
        yield from opening(child, where, inside)


def test_every_reader_is_fuzzed_or_has_a_reason():
    """Else add a reader to a module of tests/faults, and name it here; a name left over would hide the next such function."""
    files = {p.relative_to(PACKAGE).as_posix(): ast.parse(p.read_text("utf-8")) for p in PACKAGE.rglob("*.py")}
    found = {(f, function) for f, tree in files.items() for function in opening(tree)}
    named = {(f, n) for table in (READERS, REASONS) for f, names in table.items() for n in names}
    assert found == named
    assert {n for names in READERS.values() for n in names.values()} <= set(all_targets())


BY_TARGET = {t: [(f, n) for f, names in READERS.items() for n, of in names.items() if of == t] for t in all_targets()}


@pytest.mark.parametrize("target", [t for t, functions in BY_TARGET.items() if functions])
def test_the_fuzzer_calls_the_reader(target, tmp_path, monkeypatch):
    """The valid files of a target go through the functions that it stands for."""
    monkeypatch.setattr(lpips_weights, "NETS", dict(lpips_weights.NETS))
    called = set()

    def note(frame, event, argument):
        if event == "call":
            called.add((frame.f_code.co_filename, frame.f_code.co_qualname))

    sys.setprofile(note)
    try:
        Worker(all_targets()[target], 0, tmp_path)
    finally:
        sys.setprofile(None)
    assert {(str(PACKAGE / f), n) for f, n in BY_TARGET[target]} <= called
