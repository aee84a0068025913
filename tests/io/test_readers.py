"""Readers: built-in ones and a user's own; links lead out of a scene only where the user allows it."""

import json
import os
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.io import scenes
from tests.io.scenes import link, refused
from warpgs.errors import UsageError
from warpgs.io.folder import Probe, Reader, all_readers, find_reader, loaders
from warpgs.io.load import load_scene
from warpgs.scene import Camera, Normalization, Scene, View

# Readers plug in: built-in ones by name, a user's own as an object, a class or module:Class.

EXAMPLE = Path(__file__).parents[2] / "examples" / "06_own_format.py"
FORMATS = ["colmap", "transforms", "llff", "dtu", "middlebury", "metashape", "realityscan"]


class Cameras(Reader):
    """Views made in memory; `change` spoils the scene."""

    name = "memory"
    description = "cameras.mem (made up)"

    def __init__(self, change=lambda scene: scene, missing=""):
        self.change, self.missing = change, missing

    def probe(self, folder):
        return Probe("cameras.mem", self.missing) if (folder / "cameras.mem").is_file() else None

    def read(self, folder, options):
        images = [(scenes.image(i) / 255).astype(np.float32) for i in range(scenes.VIEWS)]
        cameras = [Camera(m, scenes.K, scenes.WIDTH, scenes.HEIGHT) for m in scenes.VIEWMATS]
        views = [View(f"{9 - i}.png", c, images[i]) for i, c in enumerate(cameras)]
        return self.change(self.scene(folder, views, ["made in memory"], pixels=f"downscale {options.downscale}"))


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "cameras.mem").touch()
    return tmp_path


def test_formats_are_asked_in_order_and_camera_models_arrive(folder):
    assert [r.name for r in all_readers()] == FORMATS
    assert all(find_reader(name).name == name and find_reader(name).description for name in FORMATS)

    def fisheye(scene):
        lens = {"model": "fisheye", "distortion": np.zeros(4)}
        return replace(scene, views=tuple(replace(v, camera=replace(v.camera, **lens)) for v in scene.views))

    plain, other = load_scene(folder, reader=Cameras()), load_scene(folder, reader=Cameras(fisheye))
    assert {v.camera.model for v in other.views} == {"fisheye"} and plain.fingerprint != other.fingerprint


@pytest.mark.parametrize("own", [Cameras, Cameras(), "tests.io.test_readers:Cameras"])
def test_a_reader_of_ones_own_is_given_as_class_object_or_name(own, folder):
    scene = load_scene(folder, reader=own, downscale=3)
    assert (scene.format, scene.pixels, scene.notes) == ("memory", "downscale 3", ("made in memory",))
    assert [v.name for v in scene.views] == sorted(v.name for v in scene.views) and len(scene.fingerprint) == 64
    # normalised like any other scene: centred, the farthest camera at 1 / 1.1
    centers = np.array([v.camera.center for v in scene.views])
    np.testing.assert_allclose(centers.mean(0), 0, atol=1e-12)
    assert np.linalg.norm(centers, axis=1).max() == pytest.approx(1 / 1.1)


def test_a_reader_that_does_not_find_its_format_is_refused(tmp_path):
    scenes.write_transforms(scenes.write_llff(tmp_path))
    assert load_scene(tmp_path).format == "transforms" and load_scene(tmp_path, reader="llff").format == "llff"
    (tmp_path / "transforms.json").unlink()
    refused(tmp_path, r"reader colmap finds no scene of its format; the folder holds poses_b", reader="colmap")
    refused(tmp_path, r"reader memory finds no scene of its format", reader=Cameras())
    (tmp_path / "cameras.mem").touch()
    refused(tmp_path, "cameras.mem lacks its sounds. Copy the whole scene", reader=Cameras(missing="its sounds"))
    refused(tmp_path / "gone", "no such folder", reader=Cameras())


def test_what_a_reader_returns_is_checked(folder):
    """By the checks of `test_scene_checks`; too few views, too."""
    changes = {"image": np.zeros((3, 4, 3), np.float32)}
    spoil = lambda scene: replace(scene, views=(replace(scene.views[0], **changes), *scene.views[1:]))  # noqa: E731
    refused(folder, r"'9.png': image must be float32, in \[0, 1\], shape \[12, 16, 3\]; got shape", reader=Cameras(spoil))
    few = Cameras(lambda scene: replace(scene, views=scene.views[:1]))
    refused(folder, r"1 usable views, not at least 2 \(made in memory\)", reader=few)
    with pytest.raises(UsageError, match=r"Cameras\.read must return a Scene; it returned NoneType"):
        load_scene(folder, reader=Cameras(lambda s: None))
    with pytest.raises(UsageError, match="reader memory must return a Scene in file coordinates"):
        load_scene(folder, reader=Cameras(lambda s: replace(s, normalization=Normalization(np.zeros(3), 2.0))))


@pytest.mark.parametrize(
    "choice,message",
    [
        ("nerf", "unknown reader 'nerf'; choose one of colmap, dtu, .*, realityscan, transforms, or give module:Class"),
        ("no_such_module:A", "the reader 'no_such_module:A' cannot be imported"),
        ("no_such_file.py:A", "the reader 'no_such_file.py:A' cannot be imported"),
        ("warpgs.io.colmap:Nothing", "warpgs.io.colmap does not define Nothing"),
        ("warpgs.io.images:Lens", "is not a reader: it must be a class that derives from"),
        (dict, "dict is not a reader"),
        (3, "3 is not a reader; give a name"),
    ],
)
def test_choices_that_name_no_reader(choice, message, folder):
    with pytest.raises(UsageError, match=message):
        load_scene(folder, reader=choice)


def test_the_example_reads_back_what_it_writes(tmp_path, monkeypatch, capsys):
    """Run as a user runs it, once per way of naming the reader."""
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), "--out", str(tmp_path / "shots")])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    assert "shots: 8 views read" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), "--help"])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(EXAMPLE), run_name="__main__")
    assert "--reader examples/06_own_format.py:ShotsReader" in capsys.readouterr().out
    scene = load_scene(tmp_path / "shots", reader=f"{EXAMPLE}:ShotsReader")
    assert isinstance(scene, Scene) and scene.format == "shots" and len(scene.views) == 8
    csv = tmp_path / "shots" / "shots.csv"
    csv.write_text(csv.read_text().replace("shot3.png, ", "shot3.png, far, "))
    refused(tmp_path / "shots", r"shots.csv, line 4: cannot be understood", reader=f"{EXAMPLE}:ShotsReader")


# Links lead out of a scene only where the user allows it, in every format, for images, masks and score masks.


def moved_out(scene, path):
    outside = scene.parent / "elsewhere"
    outside.mkdir(exist_ok=True)
    path.rename(outside / path.name)
    link(path, outside / path.name)


def asks(scene):
    refused(scene, r"points outside the scene folder.*--allow-outside")
    assert len(load_scene(scene, allow_outside=True).views) == scenes.VIEWS


@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_an_image_that_is_a_link(kind, tmp_path):
    scene = scenes.WRITERS[kind](tmp_path / "scene")
    first = sorted(scene.rglob("*.png"))[0]
    inside = scene / "originals" / first.name
    inside.parent.mkdir()
    if not kind.startswith("colmap"):  # its names stay in the image folder
        first.rename(inside)
        link(first, inside)
        assert len(load_scene(scene).views) == scenes.VIEWS
        first = inside
    moved_out(scene, first)
    asks(scene)


@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_files_of_cameras_and_points_that_are_links(kind, tmp_path):
    scene = scenes.WRITERS[kind](tmp_path / "scene")
    files = [p for p in scene.rglob("*") if p.is_file() and p.suffix != ".png"]
    assert files
    for path in files:
        moved_out(scene, path)
        asks(scene)
        path.unlink()
        (tmp_path / "elsewhere" / path.name).rename(path)


@pytest.mark.parametrize("kind", FORMATS)
def test_folders_of_images_and_masks_that_are_links(kind, tmp_path):
    for whole in (False, True):
        scene = scenes.WRITERS[kind](tmp_path / f"{whole}" / "scene")
        mask = scene / "masks" / ("000000.png" if kind == "dtu" else "photo0.png")
        scenes.save(mask, np.full((12, 16), 255, np.uint8))
        assert any("masked by a mask file" in n for n in load_scene(scene).notes)
        moved_out(scene, mask.parent if whole else mask)
        asks(scene)
    if kind not in ("middlebury", "realityscan"):  # whose images are in the scene's own folder
        scene = scenes.WRITERS[kind](tmp_path / "images" / "scene")
        moved_out(scene, scene / ("image" if kind == "dtu" else "images"))
        asks(scene)


def test_score_masks_that_are_links(tmp_path):
    scene = scenes.write_colmap(tmp_path / "scene")
    for i in range(scenes.VIEWS):
        scenes.save(scene / "idrmasks" / f"{i:03d}.png", np.full((12, 16), 255, np.uint8))
    moved_out(scene, scene / "idrmasks")
    asks(scene)
    # a folder that the user names is his own choice, but its files stay in it
    named = tmp_path / "elsewhere" / "idrmasks"
    assert load_scene(scene, score_masks=named).views[0].score_mask is not None
    (named / "000.png").rename(tmp_path / "000.png")
    link(named / "000.png", tmp_path / "000.png")
    refused(scene, r"000.png: a link points outside", score_masks=named)


@pytest.mark.skipif(os.name == "nt", reason="Windows makes no such links")
@pytest.mark.parametrize("kind", scenes.WRITERS)
def test_links_that_lead_round_in_circles(kind, tmp_path):
    scene = scenes.WRITERS[kind](tmp_path / "scene")
    first = sorted(scene.rglob("*.png"))[0]
    first.unlink()
    link(first, first)
    if kind not in ("llff", "dtu", "middlebury"):  # frames without a file are skipped and named
        assert len(load_scene(scene).views) == scenes.VIEWS - 1
        return
    refused(scene, r"images.*Copy the scene again|cannot be read .*; restore it")


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_our_cameras_state_an_origin(tmp_path, kind):
    """A scene of cameras that `warpgs export` wrote is where the first scene was; a note names the point of its files."""
    root, origin = tmp_path / "a", np.array([441_000.0, 5_500_000.0, 130.0])
    names = ["transforms.json"] if kind == "transforms" else ["images.txt", "points3D.txt"]
    (scenes.write_transforms if kind == "transforms" else scenes.write_colmap_txt)(root)
    near = load_scene(root)
    for file in (p for name in names for p in root.rglob(name)):
        text = file.read_text()
        stated = {"warpgs_origin": origin.tolist()}
        line = f"# warpgs_origin {' '.join(map(repr, origin.tolist()))}\n"
        file.write_text(json.dumps(json.loads(text) | stated) if kind == "transforms" else line + text)
    far = load_scene(root)
    assert np.allclose(far.normalization.offset, near.normalization.offset + origin, rtol=0, atol=1e-6)
    for a, b in zip(near.views, far.views):
        assert np.allclose(a.camera.viewmat, b.camera.viewmat, atol=1e-6)
    assert near.points is None or np.allclose(near.points.points, far.points.points, atol=1e-6)
    said = [n for n in far.notes if n.startswith("map coordinates") and "are relative to 441000" in n]
    assert len(said) == 1 and not any("map coordinates" in n for n in near.notes)


@pytest.mark.parametrize(("cores", "free", "count"), [(2, 2**40, 2), (64, 2**40, 16), (64, 2**35, 8), (64, 2**30, 4)])
def test_more_images_are_read_at_a_time_where_memory_allows(cores, free, count, monkeypatch):
    monkeypatch.setattr("warpgs.io.folder.usable_cores", lambda: cores)
    monkeypatch.setattr("warpgs.io.folder.machine_memory", lambda: (free, free))
    assert loaders() == count
