"""Every file that a user names, or a scene or a run holds, as a pipe, a device, a socket, a folder, empty, or unreadable.

Each ends in a plain error at once, and the list is proved complete: each module that opens files is tried here.
"""

import ast
import importlib.machinery
import importlib.util
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

import warpgs
from tests.io import scenes
from tests.test_files import special
from warpgs.errors import WarpgsError
from warpgs.export.base import read_gaussians, suffixes
from warpgs.export.ply import start_of
from warpgs.export.sog import SOG
from warpgs.export.spz import SPZ
from warpgs.files import read_file
from warpgs.io import folder as folders
from warpgs.io import images, transforms
from warpgs.io.folder import READERS
from warpgs.io.load import load_scene
from warpgs.io.maps import read_numbers
from warpgs.pipeline.farm.job import RECORD, file_digest, list_jobs, read_job_record
from warpgs.pipeline.films.paths import read_keyframes
from warpgs.pipeline.metrics.lpips import convert_lpips, read_lpips
from warpgs.pipeline.model.edit import box_of
from warpgs.pipeline.run import folder as run_folder
from warpgs.pipeline.run.folder import TENSORS, load_checkpoint
from warpgs.pipeline.train.presets import preset_settings
from warpgs.plugins import Registry
from warpgs.poses import find as poses_record
from warpgs.poses import photographs
from warpgs.poses.find import find_poses, source_digest
from warpgs.poses.photographs import is_heic
from warpgs.priors import export, flow, networks
from warpgs.priors.networks import MapCache, Network
from warpgs.report.progress import read_events
from warpgs.scene import Camera, Normalization, View

KINDS = ("pipe", "device", "socket", "folder", "unreadable", "empty")
PACKAGE = Path(warpgs.__file__).parent
CAMERA = Camera(np.eye(4), np.eye(3), 8, 8)
IMAGE = np.zeros((8, 8, 3), np.float32)


def side_file(path):
    """Read the description of a network, which lies beside it."""
    path.rename(networks.side_file(path))
    return networks.read_side_file(path)


def flow_folder(path):
    """Read the folder of flow files in which the first one is special."""
    views = [View(f"{n}.png", CAMERA, IMAGE) for n in "ab"]
    path.rename(path.with_name("a-to-b.flo"))
    return flow._from_folder(path.parent, views)(0, 1)


def cached(path):
    """Look a map up in a cache whose entry is special: it is made again."""
    cache = MapCache(path.parent)
    key = cache._path(IMAGE, ("m",), {})
    path.rename(key)
    cache.maps(IMAGE, ("m",), {}, lambda: (np.zeros((8, 8), np.float32),))
    raise WarpgsError(*cache.notes or [f"{key}: was not there"])


def job_record(path):
    """Read job.json: one that is not whole counts as none, and the job runs again."""
    if read_job_record(path.parent) is None:
        raise WarpgsError("no record")


def weights(path):
    """Read the weights of a network that is exported."""
    export._fcn_resnet18(export.ExportRequest("fcn-resnet18", str(path)))


def package(path):
    """Read the files of an installed package whose code is special."""
    found = importlib.machinery.ModuleSpec(export.PACKAGE, None, origin=str(path.with_name("__init__.py")))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(importlib.util, "find_spec", lambda name: found)
        export.package_files()


DOORS = {
    **{f"a{suffix}": ("export.base", read_gaussians) for suffix in suffixes()},
    "b.ply": ("export.ply", warpgs.read_ply),
    "c.ply": ("export.ply", start_of),
    "b.spz": ("export.spz", lambda p: SPZ().is_antialiased(p)),
    "b.sog": ("export.sog", lambda p: SOG().is_antialiased(p)),
    "cameras.json": ("io.transforms", transforms.read_cameras),
    "transforms.json": ("io.transforms", transforms.read_cameras),
    **{f"a{suffix}": ("io.image_files", folders.read_mask) for suffix in images.SUFFIXES},
    "a.heif": ("io.images", lambda p: is_heic(p) or folders.read_mask(p)),
    **{f"a{suffix}": ("poses.find", lambda p: find_poses(p, p.parent / "out")) for suffix in photographs.SUFFIXES},
    "b.mp4": ("poses.photographs", lambda p: photographs.write_frames(p, p.parent, 3, lambda line: None)),
    "path.json": ("pipeline.films.paths", lambda p: read_keyframes(p, CAMERA, Normalization())),
    "preset.toml": ("pipeline.train.presets", preset_settings),
    "crop.json": ("pipeline.model.edit", lambda p: box_of(str(p))),
    "jobs.jsonl": ("pipeline.farm.job", lambda p: list_jobs(str(p))),
    RECORD: ("pipeline.farm.job", job_record),
    "artefact": ("pipeline.farm.job", file_digest),
    "render.png": ("files", lambda p: read_file(p, p.parent)),
    "model.onnx": ("onnx", Network),
    "flow.onnx": ("onnx", flow._network),
    "side.onnx": ("priors.networks", side_file),
    "a.flo": ("priors.flow", flow.read_flo),
    "b.flo": ("priors.flow", flow_folder),
    "map": ("priors.networks", cached),
    "a.npy": ("io.maps", read_numbers),
    "model.py": ("priors.export", package),
    "fcn.safetensors": ("priors.export", weights),
    "lpips.safetensors": ("pipeline.metrics.lpips", read_lpips),
    "heads.pth": ("pipeline.metrics.lpips", lambda p: convert_lpips(p, p, p.parent / "out")),
    "model.safetensors": ("pipeline.model.table", warpgs.load),
    TENSORS: ("pipeline.run.folder", lambda p: load_checkpoint(p.parent)),
    run_folder.CONFIG: ("schema", lambda p: run_folder.read_record(p.parent)),
    poses_record.JSON: ("schema", lambda p: poses_record.read_poses_record(p.parent)),
    "metrics.jsonl": ("report.progress", read_events),
    "plugin.py": ("plugins", lambda p: Registry("reader", object, None).load(f"{p}:Class")),
}  # fmt: skip
"""By the name of a file: the module that opens it, and what reads it."""
PROBED = {"plugin.py", "b.flo"}
"""Files that are looked for first, where one of another kind counts as none."""
EMPTY_IS_FINE = {"preset.toml", "metrics.jsonl", "artefact", "plugin.py", "render.png"}
"""Files that may be empty: a preset without changes, a log of no events, any bytes, code without the class."""


@pytest.fixture(autouse=True)
def no_hang():
    """End a reader that hangs: nothing here reads more than a few kilobytes."""

    def late(*_):
        raise AssertionError("the reader hangs")

    if not hasattr(signal, "SIGALRM"):
        yield
        return
    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(120)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def plain(call, *names):
    """Check that a call ends in one sentence that names a file, with the exit code of a usage or data error."""
    with pytest.raises(WarpgsError) as e:
        call()
    text = str(e.value)
    assert e.value.exit_code in (2, 3, 4, 5) and "Traceback" not in text and "\n" not in text
    return text


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", DOORS)
def test_files_that_are_named(name, kind, tmp_path):
    if kind == "empty" and name in EMPTY_IS_FINE:
        return
    path = special(kind, tmp_path / name)
    text = plain(lambda: DOORS[name][1](path))
    assert name in text or tmp_path.name in text or text == "no record"
    if kind in ("pipe", "device", "socket") and text != "no record" and name not in PROBED:
        assert "is not a regular file" in text or (kind == "device" and "is a link" in text)


def parts_of(kind, root):
    """Return the files of a scene to try: what holds its cameras, an image, and a mask."""
    scene = scenes.WRITERS[kind](root)
    files = [p for p in scene.rglob("*") if p.is_file()]
    pictures = sorted(p for p in files if p.suffix == ".png")
    return scene, [p.relative_to(scene) for p in files if p not in pictures] + [pictures[0].relative_to(scene)]


@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_files_of_a_scene(kind, tmp_path):
    """Frames of an image that is none are skipped by name; all else ends in a plain error, or the scene goes without it."""
    original, parts = parts_of(kind, tmp_path / "original")
    for number, part in enumerate(parts):
        for what in KINDS:
            scene = tmp_path / f"{number} {what}"
            shutil.copytree(original, scene)
            (scene / part).unlink()
            special(what, scene / part)
            try:
                found = load_scene(scene)
            except WarpgsError as e:
                assert e.exit_code == 3 and scene.name in str(e)
            else:
                assert len(found.views) < scenes.VIEWS or any(part.name.split(".")[0] in n for n in found.notes)


@pytest.mark.parametrize("what", KINDS)
def test_masks_of_a_scene(what, tmp_path):
    for folder, form in (("masks", "photo{}.png"), ("idrmasks", "{:03d}.png")):
        scene = scenes.write_colmap(tmp_path / folder / "scene")
        for i in range(scenes.VIEWS):
            scenes.save(scene / folder / form.format(i), np.full((12, 16), 255, np.uint8))
        first = scene / folder / form.format(0)
        first.unlink()
        special(what, first)
        if folder == "masks" and what != "empty":  # no file, so no mask
            assert len(load_scene(scene).views) == scenes.VIEWS
        else:
            assert first.name in plain(lambda scene=scene: load_scene(scene)) or what != "empty"


def test_photographs(tmp_path):
    """A photograph that is no file is none of the photographs."""
    for name in "abc":
        scenes.save(tmp_path / f"{name}.png", scenes.image(0))
    before = source_digest(tmp_path)
    for what in KINDS[:-1]:
        special(what, tmp_path / f"{what}.png")
    assert source_digest(tmp_path) == before
    special("empty", tmp_path / "d.png")
    text = plain(lambda: find_poses(tmp_path, tmp_path.parent / f"{tmp_path.name}-out"))
    assert "d.png" in text or "pycolmap" in text


def calls(tree):
    """Yield the names of the functions that code calls."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")


def test_every_module_that_opens_files_is_tried():
    opening = {"open_input", "read_input", "read_start", "read_file", "read_tensors", "input_digest"}
    modules = set()
    for path in PACKAGE.rglob("*.py"):
        if opening & set(calls(ast.parse(path.read_text("utf-8")))):
            modules.add(".".join(path.relative_to(PACKAGE).with_suffix("").parts))
    tried = {module for module, _ in DOORS.values()} | {"files"}
    of_scenes = {"io.colmap", "io.others"}
    of_runs = {"pipeline.farm.work", "pipeline.metrics.coverage", "pipeline.run.results", "viewer.window"}  # as render.png
    assert modules - tried == of_scenes | of_runs, "add what is new to DOORS"
    assert {name.split()[0] for name in scenes.WRITERS} - {"instant-ngp", "blender"} == set(READERS.names())


def test_formats_are_all_tried():
    assert {f"a{s}" for s in (*suffixes(), *images.SUFFIXES, *photographs.SUFFIXES)} <= DOORS.keys()
