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
from warpgs.pipeline.metrics import lpips

PACKAGE = Path(warpgs.__file__).parent
OPENING = {
    "open", "open_file", "open_input", "read_bytes", "read_file", "read_input", "read_start", "read_text", "input_digest",
    "fromfile", "imdecode", "imread", "safe_open", "HeifImageFile", "InferenceSession", "VideoCapture",
    "ZipFile",
}  # fmt: skip
"""Names of functions and classes that open a file or decode what one holds."""
PARSING = {"json.load", "json.loads", "np.load", "schema.parse", "schema.read", "torch.load", "msgspec.msgpack.decode"}
"""The same with their modules."""

READERS = {
    "export/base.py": {"reading": "splat"},
    "export/ply.py": {"start_of": "ply", "_read": "ply"},
    "export/gltf.py": {"_split": "glTF"},
    "export/sog.py": {"SOG.is_antialiased": "SOG", "decode": "SOG", "_member": "SOG", "_meta": "SOG", "_pixels": "SOG"},
    "io/transforms.py": {"_json": "cameras"},
    "io/colmap.py": {"_BinaryFile.__init__": "colmap", "_lines": "colmap"},
    "io/image_files.py": {"_raster": "any image", "read_image_file": "any image"},
    "io/others.py": {"_read_matrices": "dtu", "read_camera_rows": "middlebury"},
    "io/maps.py": {"mapped_array": "given maps"},
    "pipeline/farm/work.py": {"_scores": "scores", "write_thumbnail": "render of a job"},
    "pipeline/farm/job.py": {"_read": "list of jobs", "read_job_record": "record of a job"},
    "pipeline/films/paths.py": {"read_keyframes": "keyframes"},
    "pipeline/metrics/lpips.py": {
        "_check_unpacked": "LPIPS state dict",
        "_read_state": "LPIPS state dict",
        "read_lpips": "LPIPS weights",
    },
    "pipeline/model/edit.py": {"_box_of_file": "crop box", "box_of": "crop box"},
    "pipeline/model/table.py": {"load": "model file"},
    "pipeline/run/folder.py": {"load_checkpoint": "checkpoint", "read_record": "run record"},
    "pipeline/train/presets.py": {"_read": "preset"},
    "poses/photographs.py": {
        "_coded_again": "heic",
        "to_jpeg": "heic by its process",
        "_check_container": "video",
        "_frames": "video",
    },
    "poses/find.py": {"read_poses_record": "record of poses"},
    "priors/networks.py": {"MapCache._read": "stored maps", "read_side_file": "description of a network"},
    "priors/flow.py": {"read_flo": "flow"},
    "report/progress.py": {"read_events": "events"},
    "locks.py": {"_signed": "signature of a lock"},
    "onnx.py": {"read_model": "network", "start_session": "network"},
    "schema.py": {"parse": "scores", "read": "scores"},
    "viewer/server.py": {"read_frame": "frame of a websocket"},
}
"""Name of the fuzzer's reader by file and function."""

OWN = "reads what this process wrote just before"
PIPE = "reads lines of a process that warpgs started, by a pipe that nobody else writes to"
PRIVATE = "reads a file of the farm's private folder, which nobody else may enter"
DIGEST = "reads bytes that it does not look into"
SYSTEM = "reads what the system says"
LAYER = "opens for others, which are named here"
REASONS = {
    "export/sog.py": {"SOG.is_antialiased": "SOG", "encode": "writes"},
    "files.py": {"appending": "writes", "writing": "writes", "read_file": LAYER,
        "open_input": LAYER, "read_input": LAYER, "read_start": LAYER, "input_digest": LAYER},
    "folders.py": {"Folder.open": LAYER, "Folder.open_regular": LAYER, "_opened": LAYER,
        "_own_file": "writes"},
    "pipeline/farm/work.py": {"_with_lpips": OWN},
    "pipeline/farm/slurm.py": {"main": PRIVATE,
        "SlurmEngine._answered": PRIVATE, "SlurmEngine._output": PRIVATE},
    "pipeline/farm/job.py": {"job_of": PIPE,
        "file_digest": DIGEST},
    "pipeline/farm/farm.py": {"LocalEngine._compile": PIPE, "LocalEngine.wait": PIPE},
    "pipeline/farm/worker.py": {"main": PIPE},
    "pipeline/metrics/coverage.py": {"coverage_section": OWN},
    "pipeline/run/commands.py": {"render": "opens a writer of a film"},
    "pipeline/run/folder.py": {"check_same": "copies a value"},
    "pipeline/run/results.py": {"sampling_report_of": "reads images for `webp`, which is named here"},
    "plugins.py": {"module_digest": DIGEST},
    "poses/find.py": {"find_poses": OWN, "_digest": DIGEST},
    "poses/photographs.py": {"main": PIPE},
    "poses/mapping.py": {"_lines": PIPE,
        "main": PIPE, "match": OWN, "import_photographs": OWN, "matched": OWN, "verify_learned": OWN},
    "priors/export.py": {"_own_weights": "reads weights of 45 MB with safetensors, as the readers named here do",
        "package_files": "reads files whose SHA-256 must be known", "_backbone": "loads weights whose SHA-256 is known",
        "onnx_bytes": OWN},
    "report/film.py": {"_decoded_sizes": OWN},
    "report/images.py": {"webp": OWN},
    "report/overview.py": {"_rendered": OWN, "_with_legend": OWN},
    "kernels/native.py": {"source": "reads a file of the package",
        "exclusive": "opens a lock"},
    "device.py": {"_text": SYSTEM,
        "processor_name": SYSTEM},
    "process.py": {"utf8_name": "opens by another name for readers that are named here",
        "hidden_stderr": "opens /dev/null for writing",
        "_send_to_null": "opens /dev/null for writing"},
    "ranks.py": {"machine": SYSTEM},
    "viewer/window.py": {"Panel._add_sampling": "reads an image for `decode`, whose reader is named here"},
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
    monkeypatch.setattr(lpips, "NETS", dict(lpips.NETS))
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
