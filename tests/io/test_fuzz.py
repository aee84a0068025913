"""Readers of foreign bytes either understand them or say DataError; nothing else gets out, and nothing large is allocated."""

import json
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.io import scenes
from warpgs.errors import DataError, UsageError
from warpgs.io import colmap, dtu, llff, middlebury, transforms
from warpgs.io.decoding import decode
from warpgs.io.load import load_scene
from warpgs.io.splits import split_views

FUZZ = settings(
    max_examples=2 * settings.default.max_examples, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
)
FILES = {**scenes.colmap_bin(), **scenes.colmap_txt()}
READERS = {
    "cameras": colmap.read_cameras,
    "images": colmap.read_poses,
    "points3D": lambda path: colmap.read_points(path, {1: "a", 2: "b"}),
}


@st.composite
def damaged(draw, data: bytes) -> bytes:
    """Change a few bytes of the data, remove, insert or cut a part; now and then return any bytes."""
    if draw(st.integers(0, 9)) == 0:
        return draw(st.binary(max_size=200))
    out = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(len(out) - 1, 0)))
        kind = draw(st.sampled_from(["replace", "remove", "insert", "cut"]))
        nasty = st.sampled_from([b"\xff" * 8, b"nan", b"1e999", b"-", b"\n"])
        piece = draw(st.binary(min_size=1, max_size=9) | nasty)
        if kind == "replace":
            out[at : at + len(piece)] = piece
        elif kind == "remove":
            del out[at : at + len(piece)]
        elif kind == "insert":
            out[at:at] = piece
        else:
            del out[at:]
    return bytes(out)


def survives(read, name: str, data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(data)
        try:
            read(path)
        except DataError as e:
            assert name in str(e) and len(str(e)) > len(name) + 20


@pytest.mark.parametrize("name", sorted(FILES))
@given(data=st.data())
@FUZZ
def test_damaged_colmap_files(name, data):
    survives(READERS[name.partition(".")[0]], name, data.draw(damaged(FILES[name])))


def archive(save, *arguments, **arrays) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("a.npz" if arrays else "a.npy")
        save(path, *arguments, **arrays)
        return path.read_bytes()


OTHERS = {
    "poses_bounds.npy": (llff.read_rows, archive(np.save, scenes.llff_rows())),
    "cameras.npz": (dtu._read_matrices, archive(np.savez, **scenes.dtu_matrices())),
    "tiny_par.txt": (middlebury.read_rows, scenes.middlebury_text().encode()),
    "transforms.json": (transforms.read_json, b'{"w": 1, "frames": [{"file_path": "a.png", "transform_matrix": [[1, 2]]}]}'),
    "a.png": (decode, None),
}


@pytest.mark.parametrize("name", sorted(OTHERS))
@given(data=st.data())
@FUZZ
def test_damaged_files_of_the_other_formats(name, data):
    read, good = OTHERS[name]
    if good is None:
        with tempfile.TemporaryDirectory() as folder:
            scenes.save(Path(folder) / "a.png", scenes.image(0))
            good = (Path(folder) / "a.png").read_bytes()
    survives(read, name, data.draw(damaged(good)))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
KEYS = ["file_path", "transform_matrix", "mask_path", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k4", "camera_model"]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return scenes.write_transforms(tmp_path_factory.mktemp("fuzz"))


@given(key=st.sampled_from([*KEYS, "camera_angle_x", "is_fisheye"]), value=JSON, drop=st.sampled_from(["fl_x", "w", "none"]))
@FUZZ
def test_any_value_of_any_key_of_a_frame(root, key, value, drop):
    content = scenes.transforms_json(**({drop: None} if drop != "none" else {}))
    content["frames"][1][key] = value
    try:
        text = json.dumps(content)
    except ValueError:  # lone surrogates are written escaped; nothing else can fail
        return
    (root / "transforms.json").write_text(text)
    try:
        load_scene(root)
    except DataError as e:
        assert "transforms.json" in str(e) or "photo1.png" in str(e)


@given(spec=st.text(max_size=30) | st.from_regex(r"(llff|dtu|blender|every|train=|test=):?[0-9a-z./;=,]*", fullmatch=True))
@FUZZ
def test_any_split(root, spec):
    scene = SimpleNamespace(views=[SimpleNamespace(name=n) for n in scenes.NAMES])
    try:
        split = split_views(scene, spec)
    except (DataError, UsageError):
        return
    assert set(split.train).isdisjoint(split.test) and set(split.train) | set(split.test) <= set(scenes.NAMES)
