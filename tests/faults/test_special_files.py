"""Every file that a user names, or a scene or a run holds, as a pipe, a device, a socket, a folder, empty, or unreadable.

Each ends in a plain error at once; all readers of the fuzzer are tried.
"""

import importlib.machinery
import importlib.util
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

import warpgs
from tests.faults.targets import all_targets
from tests.io import scenes
from tests.test_files import special
from warpgs.errors import WarpgsError
from warpgs.export.ply import start_of
from warpgs.export.sog import SOG
from warpgs.export.spz import SPZ
from warpgs.files import input_digest, read_file
from warpgs.io import folder as folders, image_files, images
from warpgs.io.folder import READERS
from warpgs.io.load import load_scene
from warpgs.io.maps import read_numbers
from warpgs.pipeline.metrics import lpips
from warpgs.plugins import Registry
from warpgs.poses.find import find_poses, source_digest
from warpgs.priors import export
from warpgs.report.progress import read_events

KINDS = ("pipe", "device", "socket", "folder", "unreadable", "empty")


def package(path):
    found = importlib.machinery.ModuleSpec(export.PACKAGE, None, origin=str(path.with_name("__init__.py")))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(importlib.util, "find_spec", lambda name: found)
        export.package_files()


MORE = {
    **{f"a{suffix}": lambda p: find_poses(p, p.parent / "out") for suffix in image_files.VIDEO_SUFFIXES},
    **{f"mask{suffix}": folders.SceneFolder(Path(), images.ReadOptions(allow_outside=True)).mask for suffix in images.SUFFIXES},
    "b.ply": warpgs.read_ply, "c.ply": start_of, "b.spz": lambda p: SPZ().is_antialiased(p),
    "b.sog": lambda p: SOG().is_antialiased(p), "artefact": input_digest, "render.png": lambda p: read_file(p, p.parent),
    "metrics.jsonl": read_events, "a.npy": read_numbers, "model.py": package,
    "plugin.py": lambda p: Registry("reader", object, None).load(f"{p}:Class"),
    "fcn.safetensors": lambda p: export._fcn_resnet18(export.ExportRequest("fcn-resnet18", str(p))),
}  # fmt: skip
"""Readers by the name of a file, beside those of the fuzzer."""
NO_FILES = {"frame of a websocket", "request to the viewer", "onnx", "events", "origin"}
"""Readers of bytes that the fuzzer or another one of the list has read; beside a model, what is no file states no origin."""
FILES = [n for n, t in all_targets().items() if t.prepare.__module__ != "tests.faults.scene_targets" and n not in NO_FILES]
PROBED = {"plugin.py"}
"""Files that are looked for first, where one of another kind counts as none."""
EMPTY_IS_FINE = {"preset", "metrics.jsonl", "artefact", "plugin.py", "render.png"}
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


def plain(error):
    """Check that an error is one sentence, with an exit code of ours; return it."""
    text = str(error)
    assert error.exit_code in (2, 3, 4, 5) and "Traceback" not in text and "\n" not in text
    return text


@pytest.mark.parametrize("name", [*FILES, *MORE])
def test_files_that_are_named(name, tmp_path, monkeypatch):
    """Each ends in a plain error, or is passed over as one that is not there."""
    monkeypatch.setattr(lpips, "NETS", dict(lpips.NETS))
    target = all_targets().get(name)
    path, *_ = [tmp_path / name] if target is None else target.prepare(tmp_path)
    for kind in KINDS:
        if kind == "empty" and name in EMPTY_IS_FINE:
            continue
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        if kind == "socket":  # whose name is short
            special(kind, tmp_path / "s").rename(path)
        else:
            special(kind, path)
        try:
            found = MORE[name](path) if target is None else target.read(tmp_path, path)
        except WarpgsError as e:
            text = plain(e)
            assert path.name in text or tmp_path.name in text, (kind, text)
            if kind in ("pipe", "device", "socket") and name not in PROBED:
                assert "is not a regular file" in text or (kind == "device" and "is a link" in text), (kind, text)
        else:
            assert target is not None and found is None, kind


def parts_of(kind, root):
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
            with pytest.raises(WarpgsError) as e:
                load_scene(scene)
            assert first.name in plain(e.value) or what != "empty"


def test_photographs(tmp_path):
    for i, name in enumerate("abc"):
        scenes.save(tmp_path / f"{name}.png", scenes.image(i))
    before = source_digest(tmp_path)
    for what in KINDS[:-1]:
        special(what, tmp_path / f"{what}.png")
    assert source_digest(tmp_path) == before
    special("empty", tmp_path / "d.png")
    with pytest.raises(WarpgsError) as e:
        find_poses(tmp_path, tmp_path.parent / f"{tmp_path.name}-out")
    text = plain(e.value)
    assert "d.png" in text or "pycolmap" in text


def test_formats_are_all_tried():
    """`test_every_reader_is_fuzzed_or_has_a_reason` proves the same of functions that open files."""
    assert {name.split()[0] for name in scenes.WRITERS} - {"instant-ngp", "blender"} == set(READERS.names())
