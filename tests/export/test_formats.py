"""Formats of files: each reads back what it wrote, says how it is rendered, and a stranger's file ends in one sentence."""

import base64
import dataclasses
import gzip
import importlib.util
import json
import re
import struct
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.faults import format_targets
from tests.gaussians import cloud, shapes_of
from warpgs.app.cli import main
from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.export import base, gltf, sog, spz
from warpgs.export.base import (
    FORMATS,
    Format,
    arrays_of,
    format_of,
    gaussians_of,
    half_turn,
    read_gaussians,
    read_with_antialiasing,
    suffixes,
    write_gaussians,
)
from warpgs.export.gltf import linear
from warpgs.export.meshes_and_cameras import rotation_to_y, write_mesh
from warpgs.export.ply import FLAT, read_ply
from warpgs.geometry import rotation_matrices
from warpgs.kernels.sh import basis
from warpgs.pipeline.run.export import convert
from warpgs.scene import Mesh, Normalization

GOLDEN = Path(__file__).parent / "golden"
SUFFIXES = suffixes()


def model(n=300, degree=3, seed=0):
    return cloud(n, seed=seed, degree=degree)


def same_rotation(a, b):
    a, b = (torch.nn.functional.normalize(q.double(), dim=1) for q in (a, b))
    return float(torch.minimum((a - b).abs().amax(1), (a + b).abs().amax(1)).max())


def differences(a, b):
    out = {n: float((getattr(a, n).double() - getattr(b, n).double()).abs().max()) for n in ("means", "log_scales")}
    out["opacity"] = float((a.logit_opacities.sigmoid() - b.logit_opacities.sigmoid()).abs().max())
    out["rotation"] = same_rotation(a.quats, b.quats)
    count = min(a.sh.shape[1], b.sh.shape[1])
    out["dc"] = float((a.sh[:, 0] - b.sh[:, 0]).abs().max())
    out["rest"] = float((a.sh[:, 1:count] - b.sh[:, 1:count]).abs().max()) if count > 1 else 0.0
    return out


EXTENT = 4.0  # largest side of the box of `cloud`
LOG_SPAN = 3.0  # range of its log scales
QUANTA = {  # half a step of each attribute, with a little room for rounding in float32
    ".ply": (0, 0, 0, 0, 0, 0),
    ".gltf": (0, 2e-6, 2e-7, 2e-7, 0, 0),
    ".glb": (0, 2e-6, 2e-7, 2e-7, 0, 0),
    ".splat": (0, 2e-6, 0.51 / 255, 0.02, 0.51 / 255 / 0.282, 0),
    ".spz": (1e-6, 0.51 / 16, 0.51 / 255, 0.003, 0.51 / 38.25, 0.51 / 128),
    ".compressed.ply": (0.51 * EXTENT / 1023, 0.51 * LOG_SPAN / 1023, 0.51 / 255, 0.004, 0.01, 8 / 256),
    ".sog": (1e-3, 2 * LOG_SPAN / 255, 0.51 / 255, 0.009, 0.02, 0.02),
}


def test_degree_4_is_refused_where_a_format_lacks_it(tmp_path):
    """The error names the remedies, and nothing is written; PLY holds it, and .splat holds colours alone."""
    made = model(n=5, degree=4)
    for suffix in (".compressed.ply", ".sog", ".glb", ".gltf"):
        path = tmp_path / f"a{suffix}"
        with pytest.raises(DataError, match=r"degree 4 is too high; give --sh-degree 3, or \.ply"):
            write_gaussians(path, made, units="file")
        assert not path.exists()
    for suffix, count in ((".ply", 25), (".spz", 25), (".splat", 1)):
        write_gaussians(tmp_path / f"a{suffix}", made, units="file")
        assert read_gaussians(tmp_path / f"a{suffix}").sh.shape == (5, count, 3)


@pytest.mark.parametrize(
    "suffix,degree", [(s, d) for s in SUFFIXES for d in range(5) if d <= 3 or format_of(f"a{s}").max_degree == 4]
)
def test_round_trip_is_within_the_quantum(suffix, degree, tmp_path):
    made = model(degree=degree)
    write_gaussians(tmp_path / f"a{suffix}", made, units="file")
    back = read_gaussians(tmp_path / f"a{suffix}")
    assert back.sh.shape[1] == (1 if suffix == ".splat" else made.sh.shape[1])
    for (name, difference), limit in zip(differences(made, back).items(), QUANTA[suffix]):
        assert difference <= limit, (name, difference)
    if degree == 1:  # units of the scene lead to the files
        n = Normalization(np.array([1.0, -2.0, 3.0]), 2.0)
        write_gaussians(tmp_path / f"a{suffix}", made, n, units="scene")
        stored, back = read_gaussians(tmp_path / f"a{suffix}"), read_gaussians(tmp_path / f"a{suffix}", n, units="scene")
        assert torch.allclose(stored.means.double(), made.means.double() / 2 + torch.tensor([1.0, -2.0, 3.0]), atol=5e-3)
        assert torch.allclose(back.log_scales, made.log_scales, atol=0.05)


@pytest.mark.parametrize("unit", [0.0, -40.0])
@pytest.mark.parametrize("suffix,limit", [(".compressed.ply", 0.51 * 23 / 1023), (".sog", 0.03)])
def test_an_axis_without_length_leaves_its_neighbours(suffix, limit, unit, tmp_path):
    """Other programs write such Gaussians, which took the steps of the scales around them; at any unit of the file."""
    made = arrays_of(model(degree=0))
    made["log_scales"] = made["log_scales"] + np.float32(unit)
    made["log_scales"][3, 1] = FLAT
    write_gaussians(tmp_path / f"a{suffix}", gaussians_of(tmp_path, made), units="file")
    back = arrays_of(read_gaussians(tmp_path / f"a{suffix}"))["log_scales"]
    assert back[3, 1] < unit - 15
    back[3, 1] = FLAT
    assert np.abs(back - made["log_scales"]).max() <= limit


@pytest.mark.parametrize("version", spz.VERSIONS)
def test_versions_of_spz(version, tmp_path):
    if version == 4:
        pytest.importorskip("zstandard")
    made = model(degree=2)
    (tmp_path / "a.spz").write_bytes(b"".join(spz.encode(arrays_of(made), version)))
    found = differences(made, read_gaussians(tmp_path / "a.spz"))
    assert found["rotation"] < (0.1 if version == 2 else 0.003) and found["rest"] <= 0.51 / 128 and found["means"] < 1e-6
    with pytest.raises(UsageError, match="SPZ version 5"):
        spz.encode(arrays_of(made), 5)


AXES = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}  # in those of PLY


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(
    "system,name", [*enumerate("LDB RDB LUB RUB LDF RDF LUF RUF".split(), 1), (0, "RUB"), (11, "LFU"), (12, "RFU"), (14, "RBD")]
)
def test_extensions_of_spz(version, system, name, tmp_path):
    """One names the axes of the file, with or without a mirror; others and a cut end are skipped, as by Niantic's library."""
    if version == 4:
        pytest.importorskip("zstandard")
    made, path = model(20, degree=4), tmp_path / "a.spz"
    matrix = np.array([AXES[letter] for letter in name], float)  # from the axes of PLY to those of the file
    stored = {name: array.copy() for name, array in arrays_of(made).items()}
    base.transform_in_place(stored, matrix, np.zeros(3))
    data = b"".join(spz.encode(half_turn(stored, "x"), version))
    records = struct.pack("<III", 0xADBE0002, 4, 9) + struct.pack("<IIIII", 7, 0, 0xADBE0003, 4, system) + b"\1\2\3"

    def written(records):
        if version == 3:
            plain = bytearray(gzip.decompress(data))
            plain[14] |= 2
            path.write_bytes(gzip.compress(plain + records))
        else:
            head = bytearray(data[:32])
            head[14] |= 2
            head[16:20] = struct.pack("<I", 32 + len(records))
            path.write_bytes(head + records + data[32:])

    written(records)
    back = read_gaussians(path)
    found = differences(made, back)
    assert found["means"] < 2e-6 and found["rest"] <= 0.51 / 128 * 3 and found["dc"] <= QUANTA[".spz"][4]
    shapes = [shapes_of(g) for g in (made, back)]
    assert torch.allclose(*shapes, rtol=0.3, atol=0.02 * float(shapes[0].abs().max()))
    written(records.replace(struct.pack("<II", 4, system), struct.pack("<II", 4, 17)))
    with pytest.raises(DataError, match="coordinate system 17 is unknown"):
        read_gaussians(path)


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".gltf", ".splat"])
def test_the_page_names_the_bytes_of_a_gaussian(suffix, tmp_path):
    """Of formats whose size does not depend on the values."""
    n, path = 10_000, tmp_path / f"a{suffix}"
    write_gaussians(path, model(n), units="file")
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text("utf-8")
    named = re.search(rf"^\| `{re.escape(suffix)}` \|[^|]*\|[^|]*\| (\d+) \|", page, re.MULTILINE)
    assert abs(path.stat().st_size / n - int(named[1])) < 1


def test_axes_and_nodes_on_disk(tmp_path):
    made = model(n=1, degree=0)
    x, y, z = made.means[0].tolist()
    document, body = gltf._split(b"".join(gltf.BinaryGltf().encode(arrays_of(made))))
    assert np.allclose(np.frombuffer(body, "<f4", 3), [-x, -y, z])  # y up
    plain = gzip.decompress(spz.encode(arrays_of(made))[0])
    fixed = [int.from_bytes(plain[16 + 3 * i : 19 + 3 * i], "little", signed=True) / 2.0 ** plain[13] for i in range(3)]
    assert np.allclose(fixed, [x, -y, -z], atol=1e-5)  # x right, y up, z back
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["extensions"]["KHR_gaussian_splatting"]["colorSpace"] == "srgb_rec709_display"
    assert {"POSITION", "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0"} <= primitive["attributes"].keys()
    # the translation of a node is added in float64
    made = model(50)
    document, body = gltf._document(arrays_of(made), None)
    document["nodes"][0]["translation"] = [441_000.25, 5_500_000.5, 130.0]
    (tmp_path / "a.glb").write_bytes(b"".join(gltf.glb(document, body)))
    back = read_gaussians(tmp_path / "a.glb").means
    wanted = made.means.double() + torch.tensor([-441_000.25, -5_500_000.5, 130.0], dtype=torch.float64)
    assert back.dtype == torch.float64 and torch.allclose(back, wanted, rtol=0, atol=1e-6)
    # scales and positions may be plain integers; programs without Gaussians show points in linear colours, with opacities
    path, made = tmp_path / "a.glb", arrays_of(model(5, 1))
    document, body = gltf._split(encoded(".glb"))
    color = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert (color["componentType"], color["type"], color["normalized"]) == (5123, "VEC4", True)
    view = document["bufferViews"][color["bufferView"]]
    colors = np.frombuffer(body, "<u2", 20, view["byteOffset"]).reshape(5, 4) / 65535
    wanted = linear(0.28209479 * made["sh"][:, 0] + 0.5)
    assert np.allclose(colors, np.column_stack([wanted, base.sigmoid(made["logit_opacities"])]), atol=1e-5)

    def change(document):
        document["accessors"][2] |= {"componentType": 5121}
        document["accessors"][0] |= {"componentType": 5122}
        document["extensionsRequired"] = ["KHR_mesh_quantization"]

    path.write_bytes(with_document(change))
    scales, means = body[document["bufferViews"][2]["byteOffset"] :][:15], body[document["bufferViews"][0]["byteOffset"] :][:30]
    back = read_gaussians(path)
    lengths = np.frombuffer(scales, "u1").reshape(5, 3).astype("f4")
    assert np.allclose(back.log_scales.exp(), np.maximum(lengths, gltf._TINY), rtol=1e-5)
    assert np.array_equal(back.means, np.frombuffer(means, "<i2").reshape(5, 3) * [-1, -1, 1])


def test_names_say_the_format_and_bad_numbers_and_long_palettes(tmp_path, monkeypatch):
    assert format_of("A.Compressed.PLY").name == "compressed_ply" and format_of("a.b.ply").name == "ply"
    with pytest.raises(UsageError, match=r"format \.obj is not supported; use one of"):
        format_of("a.obj")
    (tmp_path / "meta.json").touch()
    with pytest.raises(UsageError, match=r"is the folder of a SOG model; give .*meta\.json"):
        read_gaussians(tmp_path)
    with pytest.raises(DataError, match="holds no Gaussian"):
        write_gaussians(tmp_path / "a.sog", model(n=0), units="file")
    with pytest.raises(DataError, match="cannot be read"):
        read_gaussians(tmp_path / "none.spz")
    made = model()
    write_gaussians(tmp_path / "a.compressed.ply", made, units="file")
    (tmp_path / "a.compressed.ply").rename(tmp_path / "a.ply")  # a compressed PLY may have a plain name
    assert differences(made, read_gaussians(tmp_path / "a.ply"))["means"] < 0.01
    # numbers that are none are not written
    made = model()
    made.means[3, 1] = torch.nan
    for suffix in SUFFIXES:
        with pytest.raises(DataError, match=r"1 of \d+ values of means are not finite"):
            write_gaussians(tmp_path / f"bad{suffix}", made, units="file")
    assert not list(tmp_path.glob("bad*"))
    made.means[3, 1] = 1e8
    with pytest.raises(DataError, match="SPZ coordinates reach 8388607, and one is"):
        write_gaussians(tmp_path / "a.spz", made, units="file")
    # more rows of harmonics than a palette
    monkeypatch.setattr(sog, "PALETTE", 64)
    made = model(n=200, degree=1)
    write_gaussians(tmp_path / "a.sog", made, units="file")
    back = read_gaussians(tmp_path / "a.sog")
    assert 0.02 < differences(made, back)["rest"] < float(made.sh[:, 1:].max() - made.sh[:, 1:].min())
    assert len(torch.unique(back.sh[:, 1:], dim=0)) <= 64


def test_palettes_follow_the_number_of_gaussians(tmp_path):
    """An eighth of the rows; repeated rows are exact, but for a few; opaque Gaussians decide over faint ones."""
    n, rows = 20_000, 500
    made = arrays_of(model(n, degree=2))
    made["sh"][:, 1:] = made["sh"][np.random.default_rng(0).integers(rows, size=n), 1:]
    found, labels = sog._palette(made["sh"][:, 1:].reshape(n, -1).astype(float), np.ones(n))
    assert rows <= len(found) <= n // 8
    assert list(dict.fromkeys(labels.tolist())) == [*range(len(found))]  # in the order of their use
    exact = (np.abs(found[labels].reshape(n, -1, 3) - made["sh"][:, 1:]) < 1e-9).all((1, 2))
    assert exact.mean() > 0.99
    write_gaussians(tmp_path / "a.sog", gaussians_of(tmp_path, made), units="file")
    back = arrays_of(read_gaussians(tmp_path / "a.sog"))["sh"][:, 1:]
    assert rows <= len(np.unique(back, axis=0)) <= len(found) and np.abs(back - made["sh"][:, 1:])[exact].max() <= 0.02
    values, opaque = np.random.default_rng(1).normal(size=(n, 9)), np.arange(n) % 50 == 0
    found, labels = sog._palette(values, np.where(opaque, 1, 1e-3))
    error = np.abs(found[labels] - values).mean(1)
    assert error[opaque].mean() < 0.7 * error[~opaque].mean()


def test_sog_in_a_folder(tmp_path):
    """Of the same images as in the archive; names and links lead to no other folder, and a half-written model is none."""
    made, archive, path = model(200), tmp_path / "a.sog", tmp_path / "new" / "folder" / "meta.json"
    for there in (archive, path):
        write_gaussians(there, made, Normalization(np.array([441_000.0, 5_500_000, 130])), antialiased=True)
    files = {p.name: p.read_bytes() for p in path.parent.iterdir()}
    assert files == format_targets.members_of(archive.read_bytes())
    with pytest.warns(UserWarning, match="its Gaussians are antialiased"):
        back, packed = read_gaussians(path), read_gaussians(archive)
    assert back.means.dtype == torch.float64 and all(torch.equal(a, packed.tensors()[n]) for n, a in back.tensors().items())
    lines = convert(path, tmp_path / "other" / "meta.json")
    assert re.search(r"200 Gaussians in .*meta.json, \d+ KiB", lines[-1])
    assert len(read_gaussians(tmp_path / "other" / "meta.json")) == 200
    assert sog.SOG().size(path) == sum(map(len, files.values()))
    for name in ("../a.sog", "folder/../meta.json", str(archive), "..", "", 3, "a\\b.webp"):
        meta = json.loads(files["meta.json"])
        meta["quats"]["files"][0] = name
        refused(
            path,
            json.dumps(meta).encode(),
            f"not a usable .json file: {re.escape(repr(str(name)[:40]))} is not a file beside it",
        )
    path.write_bytes(files["meta.json"])
    (path.parent / "quats.webp").rename(tmp_path / "quats.webp")
    (path.parent / "quats.webp").symlink_to(tmp_path / "quats.webp")
    refused(path, files["meta.json"], "'quats.webp' is not a file beside it")
    with pytest.raises(DataError, match="not finite"):
        write_gaussians(path, dataclasses.replace(made, means=made.means * torch.nan), units="file")
    assert path.is_file()
    (path.parent / "sh0.webp").unlink()
    (path.parent / "sh0.webp").mkdir()
    with pytest.raises(ResourceError, match=r"sh0.webp: .*cannot be written"):
        write_gaussians(path, made, units="file")
    assert not path.exists()


def test_sog_that_does_not_fit_on_the_disk_leaves_the_old_one(tmp_path):
    """All images are on the disk before the first is replaced; a limit on the size of files stands for a full disk."""
    resource = pytest.importorskip("resource", reason="Windows has no limit on the size of files")
    path, limits = tmp_path / "meta.json", resource.getrlimit(resource.RLIMIT_FSIZE)
    write_gaussians(path, model(200), units="file")
    old = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(ResourceError, match=r"cannot be written.*the old file is untouched"):
            write_gaussians(path, model(3000), units="file")
        with pytest.raises(ResourceError, match=r"cannot be written(?!.*old file)"):
            write_gaussians(tmp_path / "new.ply", model(3000), units="file")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == old
    write_gaussians(path, model(3000), units="file")
    assert len(read_gaussians(path)) == 3000


@pytest.mark.parametrize("suffix", [s for s in SUFFIXES if s != ".ply"])
def test_golden_files(suffix):
    """The bytes of today are read tomorrow; `make(seed=5)` wrote them."""
    made = model(n=20, degree=3, seed=5)
    for (name, difference), limit in zip(differences(made, read_gaussians(GOLDEN / f"twenty{suffix}")).items(), QUANTA[suffix]):
        assert difference <= limit, (name, difference)


FOREIGN = {  # name of the file: limits on means, log scales, opacity, entries of rotation matrices, degree 0, the rest
    "splat_transform.glb": (1e-6, 2e-6, 2e-7, 1e-6, 1e-6, 1e-6),
    "splat_transform.sog": (1e-3, 2 * LOG_SPAN / 255, 1.01 / 255, 0.03, 0.02, 0.002),
    "splat_transform.compressed.ply": (*QUANTA[".compressed.ply"][:3], 0.01, *QUANTA[".compressed.ply"][4:]),
    "splat_transform_3.spz": (2e-4, 0.51 / 16, 0.51 / 255, 0.01, 0.51 / 38.25, 0.54 / 8),
    "splat_transform_4.spz": (2e-4, 0.51 / 16, 0.51 / 255, 0.01, 0.51 / 38.25, 0.54 / 8),
}
"""Files that splat-transform 3.7.0 wrote of the same Gaussians. Its SPZ has harmonics of 4 bits above degree 1."""


@pytest.mark.parametrize("suffix", [".spz", ".splat"])
def test_side_files(suffix, tmp_path):
    """A format without a place for the origin has a side file, which a later file near the origin removes."""
    made, path, side = model(50), tmp_path / f"a{suffix}", tmp_path / f"a{suffix}.origin.json"
    there = Normalization(np.array([441_000.5, 5_500_000.25, 130]), 0.2)
    write_gaussians(path, made, there)
    assert json.loads(side.read_text()) == {"warpgs_origin": [441_000.0, 5_500_000.0, 130.0]}  # half to even
    assert torch.allclose(read_gaussians(path, there, units="scene").means, made.means, atol=1e-5)
    for bad in ("[", "[1]", "{}", '{"warpgs_origin": [1, 2]}'):
        side.write_text(bad)
        with pytest.raises(DataError, match=r"(?i)export (the|it) "):
            read_gaussians(path)
    write_gaussians(path, made, Normalization())
    assert not side.exists() and read_gaussians(path).means.dtype == torch.float32


@pytest.mark.parametrize("name", FOREIGN)
def test_files_of_splat_transform(name):
    if name.endswith("4.spz"):
        pytest.importorskip("zstandard")
    made, back = model(n=20, degree=3, seed=5), read_gaussians(GOLDEN / name)
    if name.endswith(".spz"):
        back = gaussians_of(GOLDEN / name, half_turn(arrays_of(back), "x"))
    order = torch.cdist(made.means, back.means).argmin(1)
    assert len(back) == 20 and sorted(order.tolist()) == list(range(20))
    back = type(back)(**{n: t[order] for n, t in back.tensors().items()})
    found = differences(made, back)
    axes = [rotation_matrices(torch.nn.functional.normalize(g.quats.double(), dim=1)).abs() for g in (made, back)]
    found["rotation"] = float((axes[0] - axes[1]).abs().max())
    if name.endswith(".sog"):  # its 16 rows of harmonics are means of one to three Gaussians each
        found["rest"] = float((made.sh - back.sh)[:, 1:].abs().amax((1, 2)).median())
    for (attribute, difference), limit in zip(found.items(), FOREIGN[name]):
        assert difference <= limit, (attribute, difference)


# ---- strangers' files ------------------------------------------------------------------------------------------------


def encoded(suffix, n=5, degree=1):
    return b"".join(format_of(f"a{suffix}").encode(arrays_of(model(n, degree))))


def refused(path, data, match="not a usable"):
    path.write_bytes(data)
    with pytest.raises(DataError, match=match) as e:
        read_gaussians(path)
    assert "\n" not in str(e.value) and len(str(e.value)) < 400 + len(str(path))


CUT = [s for s in SUFFIXES if s != ".ply"]


@pytest.mark.parametrize("suffix", CUT)
def test_every_truncation_is_noticed(suffix, tmp_path):
    data = encoded(suffix)
    step = max(1, len(data) // 150)
    for length in [*range(0, min(64, len(data))), *range(64, len(data) - 1, step)]:
        if suffix == ".splat" and length % 32 == 0:
            continue  # fewer Gaussians, as far as the format can tell
        refused(tmp_path / f"a{suffix}", data[:length])


def with_a_bad_one(suffix, own):
    """Return a file with numbers that are not finite, ours or not, and how many Gaussians have them."""
    if suffix == ".sog":

        def change(meta, members):
            meta["scales"]["codebook"][255] = float("nan")
            meta["asset"]["generator"] = "warpgs" if own else "else"

        return repacked(change), 1
    arrays = arrays_of(model(300, degree=1))
    arrays["means"][7, 1] = np.inf
    with np.errstate(all="ignore"):
        data = b"".join(format_of(f"a{suffix}").encode(arrays))
    other = (b'"warpgs"', b'"warpgx"') if suffix in (".glb", ".gltf") else (b"comment antialiased 0\n", b"")
    return data if own else data.replace(*other), 256 if suffix == ".compressed.ply" else 1


@pytest.mark.parametrize("suffix", [s for s in SUFFIXES if s not in (".ply", ".spz")])  # SPZ has no such numbers
def test_gaussians_with_bad_numbers_are_left_out_of_any_format(suffix, tmp_path):
    """Of another program's file, with their number; one of ours is damaged. Compressed PLY loses the whole chunk."""
    path = tmp_path / f"a{suffix}"
    data, count = with_a_bad_one(suffix, own=False)
    path.write_bytes(data)
    with pytest.warns(UserWarning, match=rf"{count} of \d+ Gaussians left out.* is not finite") as caught:
        back = read_gaussians(path)
    assert len(caught) == 1 and len(back) == (4 if suffix == ".sog" else 300 - count)
    assert any(f" {count} of " in line and "left out" in line for line in convert(path, tmp_path / "b.ply"))
    with pytest.raises(DataError, match="is not finite"):
        read_gaussians(path, strict=True)
    if suffix != ".splat":  # which does not tell its program
        refused(path, with_a_bad_one(suffix, own=True)[0], "is not finite")


def test_counts_chunks_and_numbers_that_lie(tmp_path):
    head = spz.HEADER.pack(spz.MAGIC, 3, 2**31, 3, 12, 0, 0)
    refused(tmp_path / "a.spz", gzip.compress(head + bytes(1000)), "2147483648 Gaussians in")
    more = gzip.compress(spz.HEADER.pack(spz.MAGIC, 3, 5, 0, 12, 0, 0) + bytes(10**6))
    refused(tmp_path / "a.spz", more, "the file has more")
    bomb = gzip.compress(spz.HEADER.pack(spz.MAGIC, 3, 100_000, 0, 12, 0, 0) + bytes(20 * 100_000))
    refused(tmp_path / "a.spz", bomb, f"announces 100000 Gaussians in only {len(bomb)} bytes")
    if importlib.util.find_spec("zstandard"):
        import zstandard

        bomb = zstandard.ZstdCompressor().compress(bytes(10**7))
        toc = b"".join(struct.pack("<QQ", len(bomb), s) for s in (9 * 5, 5, 15, 15, 20))
        head = spz.HEADER_4.pack(spz.MAGIC, 4, 5, 0, 12, 0, 5, spz.HEADER_4.size)
        refused(tmp_path / "a.spz", head + toc + 5 * bomb, "stream 0 does not hold its 45 bytes")
    lines = ["ply", "format binary_little_endian 1.0", "element chunk 99999999999", "property float min_x"]
    lines += ["element vertex 1", "property uint packed_position", "end_header\n"]
    refused(tmp_path / "a.compressed.ply", "\n".join(lines).encode(), "truncated")
    # a chunk's size beyond the end, a second chunk of another kind, NaN, an axis of negative length, a rotation of zero length
    data = bytearray(encoded(".glb"))
    start = 20 + struct.unpack_from("<I", data, 12)[0]
    size = struct.unpack_from("<I", data, start)[0]
    for chunk, match in (((size + 1, gltf.BINARY_CHUNK), "is truncated"), ((size, 7), "is not binary")):
        struct.pack_into("<II", data, start, *chunk)
        refused(tmp_path / "a.glb", bytes(data), match)
    document = json.loads(encoded(".gltf"))
    head, _, text = document["buffers"][0]["uri"].partition(",")
    body = struct.pack("<f", float("nan")) + base64.b64decode(text)[4:]
    document["buffers"][0]["uri"] = head + "," + base64.b64encode(body).decode()
    refused(tmp_path / "a.gltf", json.dumps(document).encode(), "means of Gaussian 0 is not finite")
    row = np.frombuffer(encoded(".splat", degree=0), base._ROW).copy()
    row["scale"][2, 1] = -1
    refused(tmp_path / "a.splat", row.tobytes(), "axis of Gaussian 2 has a negative length")
    made = arrays_of(model(5, 1))
    made["quats"][2] = 0
    base.transform_in_place(made, placed(TURN)[:3, :3], np.zeros(3))
    with pytest.raises(DataError, match="the rotation of Gaussian 2 has zero length"):
        gaussians_of(tmp_path, made)


def repacked(change):
    members = format_targets.members_of(encoded(".sog"))
    meta = json.loads(members["meta.json"])
    change(meta, members)
    members["meta.json"] = json.dumps(meta).encode()
    return format_targets.archive_of(members)


def set_to(*keys, value):
    def change(meta, members):
        for key in keys[:-1]:
            meta = meta[key]
        meta[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    "change,match",
    [
        (set_to("count", value=10**12), "Gaussians in"),
        (set_to("count", value=1000), "pixels for 1000"),
        (set_to("version", value=1), "version 2"),
        (set_to("model", value="2dgs"), "model '2dgs'"),
        (set_to("means", "files", 0, value="../../etc/passwd"), "not in the archive"),
        (set_to("means", "mins", 0, value=1e300), "not finite"),
        (set_to("scales", "codebook", value=[1.0]), "codebook"),
        (set_to("scales", value=None), "is invalid"),
        (set_to("shN", "count", value=3), "beyond the 3 rows"),
        (set_to("shN", "bands", value=7), "7 degrees"),
        (lambda meta, members: members.update({"quats.webp": bytes(10**7)}), "would take"),
        (lambda meta, members: members.update({f"{i}": b"" for i in range(1500)}), "table of contents"),
        # elsewhere: behind a comment, or where the record of a large archive says
        (encoded(".sog")[:-2] + b"\1\0x", "table of contents"),
        (encoded(".sog")[:-22] + b"PK\6\7" + bytes(16) + encoded(".sog")[-22:], "table of contents"),
    ],
)
def test_archives_that_lie(change, match, tmp_path):
    refused(tmp_path / "a.sog", repacked(change) if callable(change) else change, match)


def with_document(change):
    document, body = gltf._split(encoded(".glb"))
    change(document)
    return format_targets.glb(json.dumps(document).encode(), bytes(body))


def at(*keys, value):
    return lambda document: set_to(*keys, value=value)(document, {})


EXTENSION = ("meshes", 0, "primitives", 0, "extensions", "KHR_gaussian_splatting")


@pytest.mark.parametrize(
    "change,match",
    [
        (at("accessors", 0, "count", value=10**15), "does not fit"),
        (at("accessors", 0, "count", value=6), "reaches beyond"),
        (at("accessors", 1, "byteOffset", value=-4), "does not fit"),
        (at("accessors", 1, "componentType", value=5125), "unsupported type"),
        (at("bufferViews", 0, "byteStride", value=1), "reaches beyond"),
        (at("accessors", 0, "bufferView", value=99), "does not exist"),
        (at("buffers", 0, "uri", value="../../secret.bin"), "another file"),
        (at("buffers", 0, "uri", value="http://example.org/a.bin"), "another file"),
        (at(*EXTENSION, "kernel", value="box"), "kernel 'box'"),
        (at(*EXTENSION, "colorSpace", value="lin_rec709_display"), "lin_rec709"),
        (at("nodes", 0, value={"mesh": 0, "scale": [2, 2, 3]}), "node 0 scales Gaussians by different factors"),
        (at("nodes", 0, value={"mesh": 0, "scale": [0, 0, 0]}), "node 0 scales Gaussians by different factors, 0"),
        (at("nodes", 0, value={"mesh": 0, "rotation": [0, 0, 0, 0]}), "node 0 scales Gaussians"),
        (at("nodes", 0, value={"mesh": 0, "matrix": [1, 2, 3]}), "content is invalid"),
        (at("nodes", 0, value={"mesh": 0, "children": [0]}), "node 0 has two parents"),
        (at("nodes", 0, value={"mesh": 0, "children": [7]}), "nodes 7 does not exist"),
        (at("nodes", 0, value={"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}), "EXT_mesh_gpu_instancing"),
        (at("scenes", 0, "nodes", value=[]), "shows the Gaussians 0 times"),
        (lambda d: d.update(nodes=[{"mesh": 0}] * 33, scenes=[{"nodes": list(range(33))}]), "shows the Gaussians 33 times"),
        (at("extensionsRequired", value=["KHR_gaussian_splatting", "EXT_unknown"]), "requires the extension EXT_unknown"),
        (at("asset", value=[0] * 300_001), "values"),
        (lambda d: d["meshes"].append(d["meshes"][0]), "2 primitives"),
        (lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop("POSITION"), "POSITION is missing"),
    ],
)
def test_documents_that_lie(change, match, tmp_path):
    refused(tmp_path / "a.glb", with_document(change), match)


TURN = {"rotation": [0.5, -0.1, 0.3, 0.8], "scale": [2, 2, 2], "translation": [1, 2, 3]}
MIRROR = {"matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]}
HALF = {"rotation": [1, 0, 0, 0]}


def placed(node):
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    turn = rotation_matrices(np.array(node["rotation"], float)[[3, 0, 1, 2]] / np.linalg.norm(node["rotation"]))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn * np.array(node.get("scale", 1)), node.get("translation", 0)
    return matrix


@pytest.mark.parametrize(
    "nodes,roots,wanted",
    [
        ([{"mesh": 0, "matrix": np.eye(4).ravel().tolist()}], [0], [np.eye(4)]),
        ([{"mesh": 0, "translation": [0, 0, 0]}, {"camera": 0, "scale": [1, 2, 3]}], [0, 1], [np.eye(4)]),
        ([{"mesh": 0, **TURN}], [0], [placed(TURN)]),
        ([{"mesh": 0, **MIRROR}], [0], [placed(MIRROR)]),
        ([{"mesh": 0, **TURN}, {"children": [0], **HALF}], [1], [placed(HALF) @ placed(TURN)]),
        ([{"mesh": 0, **HALF}, {"mesh": 0}, {"mesh": 0, **TURN}], [0, 1], [placed(HALF), np.eye(4)]),
        ([{"mesh": 0, **HALF, "children": [1]}, {"mesh": 0, **TURN}], None, [placed(HALF), placed(HALF) @ placed(TURN)]),
    ],
    ids=["identity", "camera", "turned", "mirrored", "parent", "two of the scene", "no scene"],
)
def test_nodes_place_gaussians(nodes, roots, wanted, tmp_path):
    """Means, shapes and colours follow all nodes above the mesh; each node that shows it has a copy of it."""
    shown = {"nodes": nodes, "scenes": [{"nodes": roots}] if roots else []}
    (tmp_path / "a.glb").write_bytes(with_document(lambda document: document.update(shown)))
    plain, back = gltf.decode(Path("a.glb"), encoded(".glb")), read_gaussians(tmp_path / "a.glb")
    made = gaussians_of(Path("a.glb"), plain)
    if len(wanted) == 1 and np.array_equal(wanted[0], np.eye(4)):
        assert all(torch.equal(t, getattr(made, name)) for name, t in back.tensors().items())
    flip = torch.diag(torch.tensor([-1.0, -1, 1, 1], dtype=torch.float64))  # glTF's axes
    d = torch.nn.functional.normalize(torch.randn(9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)), dim=1)
    for i, matrix in enumerate(wanted):
        m = flip @ torch.from_numpy(matrix) @ flip
        part = type(back)(**{name: t[5 * i : 5 * i + 5] for name, t in back.tensors().items()})
        assert torch.allclose(part.means.double(), made.means.double() @ m[:3, :3].T + m[:3, 3], atol=1e-5)
        assert torch.allclose(shapes_of(part), m[:3, :3] @ shapes_of(made) @ m[:3, :3].T, rtol=1e-4, atol=1e-7)
        turned = torch.nn.functional.normalize(d @ m[:3, :3].T, dim=1)
        before, after = (torch.einsum("dk,nkc->dnc", basis(v)[:, :4], g.sh.double()) for v, g in ((d, made), (turned, part)))
        assert torch.allclose(before, after, atol=1e-5)
    assert len(back) == 5 * len(wanted)


# Files that say how they are rendered: antialiased or not, in our words and in those of other programs.


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_say_that_they_are_antialiased(suffix, tmp_path):
    for antialiased in (True, False):
        path = tmp_path / f"{antialiased}{suffix}"
        write_gaussians(path, model(), units="file", antialiased=antialiased)
        expected = antialiased and format_of(path).declares
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            read_gaussians(path)
            if suffix == ".ply":
                read_ply(path)
        assert [("antialiased=True" in str(w.message), w.filename) for w in caught] == [(True, __file__)] * len(caught)
        assert len(caught) == expected * (1 + (suffix == ".ply"))
        again = tmp_path / f"{antialiased}-again.spz"
        convert(path, again)
        assert read_with_antialiasing(again, None, "file")[1] is expected
    declaring = {".ply", ".compressed.ply", ".spz", ".sog"}
    assert format_of(path).declares == (suffix in declaring)
    if suffix == ".spz" and importlib.util.find_spec("zstandard"):
        write_gaussians(path, model(), units="file", format=spz.SPZ(spz.SPZConfig(version=4)), antialiased=True)
        assert read_with_antialiasing(path, None, "file")[1]


def test_comments_of_other_programs(tmp_path):
    """The last of them decides; other ways of rendering are refused."""
    path = tmp_path / "a.ply"
    for suffix in (".ply", ".compressed.ply"):
        write_gaussians(tmp_path / f"a{suffix}", model(), units="file")
        data = (tmp_path / f"a{suffix}").read_bytes()
        assert b"comment SplatRenderMode: default\ncomment antialiased 0\n" in data
        path.write_bytes(data.replace(b"comment antialiased 0", b"comment SplatRenderMode: 2dgs"))
        with pytest.raises(DataError, match="'2dgs'"):
            read_gaussians(path)
        for line, expected in ((b"SplatRenderMode: mip", True), (b"antialiased 1", True), (b"antialiased 0", False)):
            path.write_bytes(data.replace(b"comment antialiased 0", b"comment SplatRenderMode: mip\ncomment " + line))
            assert read_with_antialiasing(path, None, "file")[1] is expected


# A file format of one's own: one class in one file, written and read by the commands and from Python.

OWN = '''
import io
from dataclasses import dataclass

import numpy as np

from warpgs.export.base import Format


@dataclass(frozen=True)
class Options:
    packed: bool = False
    """Make the archive smaller,
    in more time."""


class Archive(Format):
    """Arrays of numpy."""

    suffix = ".mine"
    Config = Options

    def encode(self, arrays):
        out = io.BytesIO()
        (np.savez_compressed if self.config.packed else np.savez)(out, **arrays)
        return [out.getvalue()]

    def decode(self, path, data):
        with np.load(io.BytesIO(data), allow_pickle=False) as found:
            return dict(found)


class Nameless(Format):
    pass


class Written(Format):
    suffix = ".txt"

    def encode(self, arrays):
        return [b"%d" % len(arrays["means"])]
'''


@pytest.fixture
def own(tmp_path, monkeypatch, own_file):
    FORMATS.names()
    monkeypatch.setattr(FORMATS, "_classes", dict(FORMATS._classes))
    write_gaussians(tmp_path / "a.ply", cloud(40), units="file")
    return own_file("mine.py", OWN)


def test_one_file_adds_a_format(own, tmp_path, capsys):
    """To convert to it and back, with options of its own, bit for bit; Python takes a class, an object or its place."""
    spec, flags = f"{own}:Archive", ["--no-clean"]
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.mine"), "--format", spec, *flags]) == 0
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.spz"), "--spz.version", "2", *flags]) == 0
    assert np.frombuffer(gzip.decompress((tmp_path / "b.spz").read_bytes())[4:8], "<u4") == 2  # an option of ours
    small = ["--archive.packed", *flags]
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "c.mine"), "--format", spec, *small]) == 0
    assert (tmp_path / "c.mine").stat().st_size < (tmp_path / "b.mine").stat().st_size
    assert main(["convert", str(tmp_path / "c.mine"), str(tmp_path / "d.ply"), "--format", spec]) == 0
    assert (tmp_path / "d.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()
    with pytest.raises(SystemExit):
        main(["convert", "--format", spec, "--help"])
    said = " ".join(capsys.readouterr().out.replace("│", "").split())
    assert "--archive.packed" in said and "Make the archive smaller, in more time" in said
    cls = FORMATS.load(f"{own}:Archive")
    for i, choice in enumerate((cls, cls(), cls(cls.Config(packed=True)), f"{own}:Archive")):
        write_gaussians(tmp_path / f"{i}.mine", cloud(40), units="file", format=choice)
        back = read_gaussians(tmp_path / f"{i}.mine", format=choice)
        assert torch.equal(back.means, cloud(40).means)
    assert (tmp_path / "2.mine").stat().st_size < (tmp_path / "1.mine").stat().st_size
    lines = convert(tmp_path / "0.mine", tmp_path / "o.spz", formats=[cls])
    assert any("the format rounds positions" in line for line in lines)
    spec = f"{own}:Written"  # it may write alone; then it is not read back to tell what was rounded
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "n.txt"), "--format", spec, "--no-clean"]) == 0
    assert (tmp_path / "n.txt").read_text() == "40"
    with pytest.raises(UsageError, match="can be written but not read"):
        read_gaussians(tmp_path / "n.txt", format=spec)


def test_a_registered_format_is_found_by_its_suffix(own, tmp_path, capsys):
    """In the help too; those of ours keep their files; a name with a colon is never imported."""

    @FORMATS.register("rows")
    class Rows(Format):
        """Rows of numbers. More."""

        suffix = ".rows"

    @FORMATS.register("taken")
    class Taken(Format):
        suffix = ".ply"

    assert ".rows" in suffixes() and type(format_of("a.rows")) is Rows and format_of("a.ply").name == "ply"
    assert type(format_of("a.ply", Taken)) is Taken and FORMATS.described()["rows"] == "Rows of numbers"
    for command in ("export", "convert"):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        assert ".rows" in capsys.readouterr().out
    before = set(sys.modules)
    for find, name, words in ((FORMATS.find, own, "does not load your code"), (format_of, own.name, "is not supported")):
        with pytest.raises(UsageError, match=words):
            find(f"{name}:Archive")
    assert not any("mine" in n for n in set(sys.modules) - before)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["b.other", "--format", "{own}:Archive"], "expected a name that ends in .mine"),
        (["b.mine"], "format .mine is not supported"),
        (["b.mine", "--format", "{own}:Nameless"], "the suffix '' of "),
        (["b.mine", "--format", "{own}:np"], "must be a class that derives from warpgs.Format"),
        (["b.mine", "--format", "best"], "unknown format 'best'; choose one of"),
        (["b.mine", "--format", "{own}:Archive", "--spz.version", "2"], "--spz.* are not options of the format"),
        (["b.spz", "--spz.version", "9"], "SPZ version 9"),
        (["cameras.json", "--format", "{own}:Archive"], "--format does not apply to cameras"),
    ],
)
def test_mistakes_are_one_sentence(own, tmp_path, capsys, flags, said):
    name, *more = (word.format(own=own) for word in flags)
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / name), *more]) == 2
    text = capsys.readouterr().err
    assert said in text and len(text.splitlines()) == 1 and not (tmp_path / name).exists()


# Meshes as files, read back by numpy, by VTK and by pygltflib.

TETRAHEDRON = Mesh(
    np.array([[1000.0, 0, -5], [1001, 0, -5], [1000, 2, -5], [1000, 0, -2]]),
    np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32),
    np.array([[0, 0, 0], [1, 0, 0.5], [0.2, 1, 0], [1, 1, 1]], np.float32),
)


def glb(path):
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON") and length % 4 == 0
    binary, second = struct.unpack_from("<I4s", data, 20 + length)
    assert second == b"BIN\0" and binary % 4 == 0 and 28 + length + binary == len(data)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def test_meshes_are_read_by_vtk_and_trimesh(tmp_path):
    """Positions, triangles and colours, of 8 bits and linear; trimesh comes with viser."""
    import pyvista

    write_mesh(tmp_path / "a.ply", TETRAHEDRON)
    found = pyvista.read(tmp_path / "a.ply")
    assert np.array_equal(found.points, TETRAHEDRON.vertices) and np.array_equal(found.regular_faces, TETRAHEDRON.faces)
    colors = np.asarray(found.point_data["RGB"])
    assert np.array_equal(colors[:, :3], np.round(255 * TETRAHEDRON.colors))
    library = pytest.importorskip("trimesh")
    write_mesh(tmp_path / "a.glb", TETRAHEDRON, np.array([0, 0, 1.0]))
    (found,) = library.load(tmp_path / "a.glb", process=False).geometry.values()
    assert np.array_equal(found.faces, TETRAHEDRON.faces) and found.vertices.shape == (4, 3)
    colors = found.visual.vertex_attributes["color"]
    assert np.allclose(colors[:, :3] / 65535, linear(TETRAHEDRON.colors), atol=1e-5)


def test_glb_holds_the_mesh(tmp_path):
    """Positions around their middle with its translation, bounds, linear colours, triangles, aligned views."""
    write_mesh(tmp_path / "a.glb", TETRAHEDRON)
    text, data = glb(tmp_path / "a.glb")
    arrays = []
    for accessor, dtype in zip(text["accessors"], ("<f4", "<u2", "<u4"), strict=True):
        view = text["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        arrays.append(np.frombuffer(data, dtype, view["byteLength"] // np.dtype(dtype).itemsize, view["byteOffset"]))
    positions, colors, indices = arrays[0].reshape(-1, 3), arrays[1].reshape(-1, 4), arrays[2]
    inner, outer = text["nodes"][1], text["nodes"][0]
    assert np.allclose(positions + np.array(inner["translation"]), TETRAHEDRON.vertices) and outer["rotation"] == [0, 0, 0, 1]
    assert text["accessors"][0]["min"] == positions.min(0).tolist() and text["accessors"][0]["max"] == positions.max(0).tolist()
    assert np.array_equal(indices.reshape(-1, 3), TETRAHEDRON.faces) and (colors[:, 3] == 65535).all()
    assert np.allclose(colors[:, :3] / 65535, linear(TETRAHEDRON.colors), atol=1e-5)
    assert linear(np.array([0.0, 0.04, 0.5, 1.0])) == pytest.approx([0, 0.04 / 12.92, 0.21404, 1], abs=1e-5)
    # the quaternion xyzw turns a direction to +y
    for up in ((0, 1, 0), (0, -1, 0), (0, 0, 2), (-3, 0, 0), (0.3, -0.9, 0.2), (1e-9, -1, 0)):
        x, y, z, w = rotation_to_y(np.array(up, float))
        v, q = np.array(up, float) / np.linalg.norm(up), np.array([x, y, z])
        turned = v + 2 * np.cross(q, np.cross(q, v) + w * v)
        assert np.allclose(turned, [0, 1, 0], atol=1e-6) and np.isclose(x * x + y * y + z * z + w * w, 1)
    # and what lies ahead to -z, unless that is up or down
    for up, ahead, front in (
        ((0, 0, 3), (0, 5, 1), (0, 1, 0)),
        ((0, -1, 0), (0, 0, 1), (0, 0, 1)),
        ((0, 0, 1), (0, 0, -2), None),
    ):
        q = rotation_to_y(np.array(up, float), np.array(ahead, float))
        turn = rotation_matrices(torch.tensor([[q[3], *q[:3]]], dtype=torch.float64))[0].numpy()
        assert np.allclose(turn @ up, [0, np.linalg.norm(up), 0]) and np.isclose(np.linalg.det(turn), 1)
        assert np.allclose(turn @ front, [0, 0, -1]) if front else q == rotation_to_y(np.array(up, float))


def test_glb_holds_the_texture(tmp_path):
    """Corners keep their places; vertices are shared where corners agree; a triangle without a place keeps its colours."""
    uv = np.array([[[0, 0], [0, 1], [1, 0]], [[0, 0], [1, 0], [1, 1]], [[0.5, 1]] * 3, [[0.5, 1]] * 3], np.float32)
    texture = np.random.default_rng(0).integers(0, 255, (8, 8, 3), np.uint8)
    write_mesh(tmp_path / "a.glb", dataclasses.replace(TETRAHEDRON, texture=texture, uv=uv))
    text, data = glb(tmp_path / "a.glb")
    views = [data[v["byteOffset"] : v["byteOffset"] + v["byteLength"]] for v in text["bufferViews"]]
    kinds = ((np.dtype("<f4"), 3), (np.dtype("<u2"), 4), (np.dtype("<u4"), 3), (np.dtype("<f4"), 2))
    positions, colors, faces, places = (np.frombuffer(v, d).reshape(-1, n) for v, (d, n) in zip(views, kinds))
    assert np.allclose(positions[faces] + text["nodes"][1]["translation"], TETRAHEDRON.vertices[TETRAHEDRON.faces])
    assert np.array_equal(places[faces], uv) and [a["count"] for a in text["accessors"]] == [len(positions), 8, 12, 8] == [
        8,
        8,
        12,
        8,
    ]
    assert (colors[faces[:2]] == 65535).all()
    assert np.allclose(colors[faces[2:], :3] / 65535, linear(TETRAHEDRON.colors)[TETRAHEDRON.faces[2:]], atol=1e-5)
    image = cv2.imdecode(np.frombuffer(views[4], np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(image.astype(int) - texture).mean() < 12 and all(v["byteOffset"] % 4 == 0 for v in text["bufferViews"])
    (primitive,) = text["meshes"][0]["primitives"]
    assert primitive["attributes"] == {"POSITION": 0, "COLOR_0": 1, "TEXCOORD_0": 3}
    assert text["materials"][primitive["material"]]["pbrMetallicRoughness"]["baseColorTexture"] == {"index": 0}
    assert (text["textures"], text["images"]) == ([{"source": 0}], [{"bufferView": 4, "mimeType": "image/jpeg"}])


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_what_is_no_mesh_is_not_written(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    bad = TETRAHEDRON.vertices.copy()
    bad[1, 1] = np.nan
    with pytest.raises(DataError, match="not finite"):
        write_mesh(path, Mesh(bad, TETRAHEDRON.faces, TETRAHEDRON.colors))
    with pytest.raises(DataError, match="missing vertex"):
        write_mesh(path, Mesh(TETRAHEDRON.vertices[:3], TETRAHEDRON.faces, TETRAHEDRON.colors[:3]))
    with pytest.raises(UsageError, match=r"use \.ply or \.glb"):
        write_mesh(tmp_path / f"a.obj{suffix[1:]}", TETRAHEDRON)
    assert not list(tmp_path.iterdir())
    write_mesh(path, TETRAHEDRON, None, np.array([441_000.0, 5_500_000.0, 130.0]))
    stated = b"comment warpgs_origin 441000.0 5500000.0 130.0\n" if suffix == ".ply" else b'"warpgs_origin":[441000.0,'
    assert stated in path.read_bytes()[:1500]
