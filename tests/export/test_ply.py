import dataclasses
import os
import re
import struct
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.gaussians import cloud
from warpgs.errors import DataError, ResourceError
from warpgs.export.base import read_gaussians, write_gaussians
from warpgs.export.ply import read_ply, write_ply
from warpgs.files import MAX_HEADER_BYTES
from warpgs.pipeline.run.export import convert
from warpgs.scene import Gaussians, Normalization, base_colors


def make(n=7, degree=3):
    return cloud(n, degree=degree)


def split(path):
    head, body = path.read_bytes().split(b"end_header\n", 1)
    return head.decode().splitlines(), body


def ply(lines, body=b"", form="binary_little_endian"):
    return ("\n".join(["ply", f"format {form} 1.0", *lines, "end_header"]) + "\n").encode() + body


NAMES = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
PROPERTIES = [f"property float {n}" for n in NAMES]
ROW = np.arange(1, 15, dtype="<f4").tobytes()


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("n", [0, 1, 7])
def test_round_trip_is_exact(tmp_path, monkeypatch, degree, n):
    """Also of more rows than are written at a time."""
    monkeypatch.setattr("warpgs.export.ply.CHUNK_ROWS", 3)
    model = make(n, degree)
    write_ply(tmp_path / "a.ply", model, Normalization())
    back = read_ply(tmp_path / "a.ply")
    for name, tensor in model.tensors().items():
        got = getattr(back, name)
        assert got.dtype == torch.float32 and got.device.type == "cpu"
        assert torch.equal(got, tensor), name


def test_layout_on_disk(tmp_path):
    """Names and bytes spelled out by hand: channel-major coefficients, wxyz, logits and logarithms."""
    sh = torch.arange(12, dtype=torch.float32).reshape(1, 4, 3)  # coefficient k of channel c is 3 k + c
    model = Gaussians(
        torch.tensor([[1.0, 2, 3]]), torch.tensor([[0.5, 0.1, 0.2, 0.3]]), torch.tensor([[-1.0, -2, -3]]),
        torch.tensor([2.5]), sh,
    )  # fmt: skip
    write_ply(tmp_path / "a.ply", model, Normalization())
    lines, body = split(tmp_path / "a.ply")
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2".split() + [f"f_rest_{i}" for i in range(9)]
    names += "opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    comments = ["comment SplatRenderMode: default", "comment antialiased 0"]
    assert lines[:5] == ["ply", "format binary_little_endian 1.0", *comments, "element vertex 1"]
    assert lines[5:] == [f"property float {n}" for n in names]
    rest = [3, 6, 9, 4, 7, 10, 5, 8, 11]
    want = [1, 2, 3, 0, 0, 0, 0, 1, 2, *rest, 2.5, -1, -2, -3, 0.5, 0.1, 0.2, 0.3]
    assert body == struct.pack(f"<{len(want)}f", *want)
    # unknown properties and elements are ignored
    path = tmp_path / "a.ply"
    lines = ["comment end_header is not here", "obj_info x", "element camera 2", "property double f", "property uchar g",
             "element vertex 1", "property uchar red", *PROPERTIES, "property double error",
             "element face 1", "property list uchar int vertex_indices"]  # fmt: skip
    path.write_bytes(ply(lines, b"\0" * 18 + b"\7" + ROW + b"\0" * 8 + b"\3" + b"\0" * 12))
    model = read_ply(path)
    assert model.means.tolist() == [[1, 2, 3]] and model.sh.tolist() == [[[4, 5, 6]]]
    assert model.quats.tolist() == [[11, 12, 13, 14]] and model.logit_opacities.tolist() == [7]
    lines = ["element vertex 1", *(f"property double {n}" for n in reversed(NAMES))]  # any order, doubles, CRLF
    path.write_bytes(ply(lines).replace(b"\n", b"\r\n") + np.arange(14, 0, -1, dtype="<f8").tobytes())
    assert read_ply(path).means.tolist() == [[1, 2, 3]] and read_ply(path).log_scales.tolist() == [[8, 9, 10]]


@pytest.mark.parametrize("text", [False, True])
def test_doubles_in_map_coordinates(tmp_path, text):
    """Doubles of other programs keep their digits, in both units, and in the file that they are converted to."""
    rows = np.random.default_rng(0).normal(size=(50, 14))
    rows[:, :3] += [441_000, 5_500_000, 130]
    header = ["element vertex 50", *(f"property double {n}" for n in NAMES)]
    body = "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist()).encode() if text else rows.astype("<f8").tobytes()
    (tmp_path / "a.ply").write_bytes(ply(header, body, "ascii" if text else "binary_little_endian"))
    normalization = Normalization(np.array([441_000.5, 5_500_000.25, 130]), 0.2)
    convert(tmp_path / "a.ply", tmp_path / "b.ply")
    for name in ("a.ply", "b.ply"):
        back, scene = read_ply(tmp_path / name), read_gaussians(tmp_path / name, normalization, units="scene")
        np.testing.assert_allclose(back.means.numpy(), rows[:, :3], rtol=0, atol=1e-6)
        assert back.means.dtype == torch.float64 and scene.means.dtype == torch.float32
        np.testing.assert_allclose(scene.means.numpy(), 0.2 * (rows[:, :3] - normalization.offset), rtol=0, atol=1e-6)
    rows[7, 0] = 1e300
    (tmp_path / "a.ply").write_bytes(ply(header, rows.astype("<f8").tobytes()))
    with pytest.warns(UserWarning) as warned:
        assert len(read_ply(tmp_path / "a.ply")) == 49
    assert ["1 of 50 Gaussians left out" in str(w.message) for w in warned] == [True]


@pytest.mark.parametrize("words", ["1 2", "1 2 nan", "a b c", "1 2 3 4"])
def test_origins_that_are_none(tmp_path, words):
    (tmp_path / "a.ply").write_bytes(ply([f"comment warpgs_origin {words}", "element vertex 1", *PROPERTIES], ROW))
    with pytest.raises(DataError, match=r"a\.ply: warpgs_origin must be three numbers.*export the file again"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "logit_opacities", "sh"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_non_finite_is_refused_by_name_and_the_old_file_stays(tmp_path, name, value):
    path = tmp_path / "a.ply"
    path.write_bytes(b"old")
    model = make()
    getattr(model, name).view(-1)[0] = value
    with pytest.raises(DataError, match=rf"a\.ply.*1 of \d+ values of {name} are not finite"):
        write_ply(path, model, Normalization())
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_opacities_given_as_logits_are_named(tmp_path):
    """Written nevertheless: a small model may have such logits."""
    model = dataclasses.replace(make(), logit_opacities=torch.linspace(0.1, 0.9, len(make())))
    with pytest.warns(UserWarning, match=r"a\.ply: all logit_opacities are in \[0, 1\].*stored\(\) makes logits"):
        write_ply(tmp_path / "a.ply", model, Normalization())
    assert torch.equal(read_ply(tmp_path / "a.ply").logit_opacities, model.logit_opacities)


def test_units_folders_and_files_that_cannot_be_used(tmp_path):
    with pytest.raises(DataError, match="means"):
        write_ply(tmp_path / "a.ply", make(), Normalization(np.zeros(3), 1e-39))
    for scale in (0.0, -1.0, float("nan")):
        with pytest.raises(DataError, match="normalization"):
            write_ply(tmp_path / "a.ply", make(), Normalization(np.zeros(3), scale))
    assert not list(tmp_path.iterdir())
    with pytest.raises(ResourceError, match="cannot be written"):
        write_ply(tmp_path / "no" / "a.ply", make(), Normalization())
    with pytest.raises(DataError, match="cannot be read"):
        read_ply(tmp_path / "a.ply")
    write_gaussians(tmp_path / "a.compressed.ply", make(5, 1), units="file")
    with pytest.raises(DataError, match=r"is a compressed PLY file.*use warpgs\.export\.read_gaussians"):
        read_ply(tmp_path / "a.compressed.ply")


@pytest.mark.parametrize("fsync,words", [(28, "No space left"), (None, "only 400 of .* bytes were written")])
def test_a_failing_disk_leaves_the_old_file(tmp_path, monkeypatch, fsync, words):
    """Some file systems report no error: then the size tells."""
    path = tmp_path / "a.ply"
    path.write_bytes(b"old")

    def full(descriptor):
        if fsync is None:
            return os.truncate(descriptor, 400)
        raise OSError(fsync, "No space left on device")

    monkeypatch.setattr("warpgs.files.os.fsync", full)
    with pytest.raises(ResourceError, match=words):
        write_ply(path, make(), Normalization())
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("form", ["ascii", "binary_big_endian", "binary_little_endian"])
@pytest.mark.parametrize("eol", [b"\n", b"\r\n"])
def test_files_of_other_programs(tmp_path, form, eol):
    model, path = make(5, 2), tmp_path / "a.ply"
    write_ply(path, model, Normalization())
    lines, body = split(path)
    values = np.frombuffer(body, "<f4").reshape(5, -1)
    comments = ["comment J\u00f6rg\u2028", "comment", "comment LATIN caf\u00e9", "obj_info \x0b "]
    lines[1:4] = [f"format {form} 1.0 ", *comments, "element camera 1", "property uchar f"]
    header = eol.join(line.encode("latin-1" if "LATIN" in line else "utf-8") for line in [*lines, "end_header ", ""])
    data = {"ascii": b"7" + eol + eol.join(" ".join(map(repr, row)).encode() for row in values.tolist())}
    data |= {"binary_big_endian": b"\7" + values.astype(">f4").tobytes(), "binary_little_endian": b"\7" + body}
    path.write_bytes(header + data[form])
    back = read_ply(path)
    for name, tensor in model.tensors().items():
        assert torch.equal(getattr(back, name), tensor), name


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("rest", [0, 9])
def test_colours_in_bytes(tmp_path, form, rest):
    """Nerfstudio and others write red, green and blue in the place of f_dc; where both stand, f_dc is the colour."""
    kinds = {n: "u1" if n in ("red", "green", "blue") else "f4" for n in ("x", "y", "z", "red", "green", "blue")}
    kinds |= dict.fromkeys([*(f"f_rest_{i}" for i in range(rest)), *NAMES[6:]], "f4")
    rows = np.ones(2, [(n, {"binary_big_endian": ">"}.get(form, "<") + k) for n, k in kinds.items()])
    rows["red"], rows["green"], rows["blue"] = (0, 255), (51, 102), (255, 0)
    words = {"u1": "uchar", "f4": "float"}
    lines = ["element vertex 2", *(f"property {words[k]} {n}" for n, k in kinds.items())]
    text = "".join(" ".join(f"{v:g}" for v in row) + "\n" for row in rows.tolist()).encode()
    path = tmp_path / "a.ply"
    path.write_bytes(ply(lines, text if form == "ascii" else rows.tobytes(), form))
    gaussians = read_ply(path)
    wanted = torch.tensor([[0, 0.2, 1], [1, 0.4, 0]])
    assert torch.allclose(base_colors(gaussians.sh), wanted, atol=1e-6) and gaussians.sh.shape[1] == 1 + rest // 3
    path.write_bytes(path.read_bytes().replace(b"uchar red", b"char red"))
    with pytest.raises(DataError, match="properties missing: f_dc_0, f_dc_1, f_dc_2"):
        read_ply(path)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_the_filter_of_mip_splatting_is_applied(tmp_path, form):
    """Each Gaussian is convolved with a ball of its own filter_3D, which keeps its mass; scales of 0 stay finite."""
    log_scales = np.array([[-3.0, -2, -1], [-1, -1, -1], [-4, -np.inf, -1]])
    opacities, widths, path = np.array([0.9, 0.5, 0.7]), np.array([0.2, 0.0, 0.1]), tmp_path / "a.ply"
    logits = np.log(opacities) - np.log1p(-opacities)
    rows = np.column_stack([np.ones((3, 6)), logits, log_scales, np.ones((3, 4)), widths]).astype("<f4")
    text = "".join(" ".join(map(str, row)) + "\n" for row in rows.tolist()).encode()
    head = ply(["element vertex 3", *PROPERTIES, "property float filter_3D"]).replace(b"binary_little_endian", form.encode())
    path.write_bytes(head + (text if form == "ascii" else rows.tobytes()))
    with pytest.warns(UserWarning, match=r"a\.ply: filter_3D of Mip-Splatting is applied to sizes and opacities") as caught:
        back = read_ply(path)
    assert len(caught) == 1
    squares = np.exp(2 * log_scales) + widths[:, None] ** 2
    wanted = opacities * np.sqrt(np.prod(np.exp(2 * log_scales) / squares, axis=1))
    assert np.allclose(back.log_scales.exp().square(), squares, rtol=1e-5)
    assert np.allclose(back.logit_opacities.sigmoid(), wanted, atol=1e-6) and bool(back.logit_opacities.isfinite().all())


@pytest.mark.parametrize("own", [False, True])
def test_gaussians_with_bad_numbers_are_left_out(tmp_path, own):
    """With a warning; in our own file, or if the caller is strict, they are an error."""
    model, path = make(7), tmp_path / "a.ply"
    write_ply(path, model, Normalization())
    lines, body = split(path)
    values = np.frombuffer(body, "<f4").reshape(7, -1).copy()
    values[1, 20], values[2, -6], values[4, -4:], values[5, 0] = np.nan, np.inf, 0, -np.inf
    head = "\n".join([*(line for line in lines if own or "comment" not in line), "end_header\n"])
    path.write_bytes(head.encode() + values.tobytes())
    with pytest.raises(DataError, match="means of Gaussian 5 is not finite"):
        read_gaussians(path, strict=True)
    if own:
        with pytest.raises(DataError, match="means of Gaussian 5 is not finite"):
            read_ply(path)
        return
    for read in (read_ply, read_gaussians):
        with pytest.warns(UserWarning, match=r"4 of 7 Gaussians left out.*\(means of Gaussian 5 is not finite") as caught:
            back = read(path)
        assert len(caught) == 1 and caught[0].filename == __file__ and torch.equal(back.means, model.means[[0, 3, 6]])


@pytest.mark.parametrize("n,final", [(200, True), (200, False), (50, True)])
def test_final_opacities_and_lengths_get_a_note(tmp_path, n, final):
    """Some programs store them in place of logits and logarithms; a few Gaussians may have such numbers by chance."""
    model, path = make(n), tmp_path / "a.ply"
    if final:
        model = replace(model, logit_opacities=model.logit_opacities.sigmoid(), log_scales=model.log_scales.exp())
    write_ply(path, model, Normalization())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        back = read_ply(path)
    assert torch.equal(back.log_scales, model.log_scales)
    words = "opacities look activated"
    assert [bool(re.search(words, str(w.message))) for w in caught] == [True] * (final and n == 200)


REST = [f"property float f_rest_{i}" for i in range(9)]
MALFORMED = {
    "empty": (b"", "start with 'ply'"),
    "not ply": (b"solid cube\n", "start with 'ply'"),
    "no end": (b"ply\nformat binary_little_endian 1.0\n", "no 'end_header'"),
    "long header": (b"ply\n" + b"comment a\n" * (MAX_HEADER_BYTES // 10) + b"end_header\n", "no 'end_header'"),
    "other format": (ply([]).replace(b"little", b"middle"), "its format is binary_middle_endian 1.0, not one of"),
    "short text": (
        ply(["element vertex 2", *PROPERTIES], b"1 2 3\n" * 20, "ascii"),
        "Gaussians 0 to 1 are not rows of 14 numbers",
    ),
    "words": (ply(["element vertex 1", *PROPERTIES], b"one " * 14, "ascii"), "convert string 'one'"),
    "huge text": (ply(["element vertex 999999999", *PROPERTIES], b"1 " * 14, "ascii"), "truncated"),
    "no format": (b"ply\nelement vertex 0\nend_header\n", "not given"),
    "no vertex": (ply(["element face 0"]), "one 'element vertex'"),
    "two vertices": (ply(["element vertex 0", "element vertex 0"]), "one 'element vertex'"),
    "negative count": (ply(["element vertex -1", *PROPERTIES]), "is invalid"),
    "endless count": (ply(["element vertex " + "9" * 5000, *PROPERTIES]), "is invalid"),
    "huge count": (ply(["element vertex 999999999999999999", *PROPERTIES], ROW), "truncated"),
    "truncated": (ply(["element vertex 2", *PROPERTIES], ROW), "end at byte .*, but the file has"),
    "property first": (ply(["property float x"]), "is invalid"),
    "odd type": (ply(["element vertex 0", "property half x"]), "is invalid"),
    "twice": (ply(["element vertex 1", *PROPERTIES, "property float x"], ROW * 2), "appears twice"),
    "missing": (ply(["element vertex 1", *PROPERTIES[1:]], ROW), "missing: x"),
    "flat": (ply(["element vertex 1", *(p for p in PROPERTIES if "scale_2" not in p)], ROW), "2DGS"),
    "half a degree": (ply(["element vertex 0", *PROPERTIES, *REST[:5]]), "5 f_rest"),
    "gap": (ply(["element vertex 0", *PROPERTIES, *REST[:8], "property float f_rest_9"]), "missing: f_rest_8"),
    "vertex list": (ply(["element vertex 0", *PROPERTIES, "property list uchar int i"]), "'vertex' has list"),
    "list before": (ply(["element face 1", "property list uchar int i", "element vertex 0"]), "'face' has list"),
    "nan": (ply(["element vertex 1", *PROPERTIES], ROW[:24] + b"\0\0\xc0\x7f" + ROW[28:]), "logit_opacities of Gaussian 0"),
    "zero rotation": (ply(["element vertex 1", *PROPERTIES], ROW[:40] + bytes(16)), "zero length"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_files_are_told_with_path_and_remedy(tmp_path, name):
    data, message = MALFORMED[name]
    path = tmp_path / "bad.ply"
    path.write_bytes(data)
    with pytest.raises(DataError, match=message) as error:
        read_ply(path)
    assert str(path) in str(error.value) and "Export" in str(error.value)


def test_infinite_logits_and_axes_without_length(tmp_path):
    """Other programs write them for opacities of 0 and 1, and for flat Gaussians; infinities elsewhere are refused."""
    inf, path = np.float32(np.inf), tmp_path / "a.ply"
    header = ply(["element vertex 1", *PROPERTIES])
    for logit, wanted in ((inf, 1.0), (-inf, 0.0)):
        row = np.frombuffer(ROW, "<f4").copy()
        row[NAMES.index("opacity")], row[NAMES.index("scale_2")] = logit, -inf
        path.write_bytes(header + row.tobytes())
        model = read_ply(path)
        assert abs(float(model.logit_opacities.sigmoid()) - wanted) < 1e-12 and 0 < float(model.log_scales.exp()[0, 2]) < 1e-36
    for name, tensor in {"x": "means", "scale_0": "log_scales", "f_dc_0": "sh", "rot_0": "quats"}.items():
        row = np.frombuffer(ROW, "<f4").copy()
        row[NAMES.index(name)] = inf
        path.write_bytes(header + row.tobytes())
        with pytest.raises(DataError, match=f"{tensor} of Gaussian 0 is not finite"):
            read_ply(path)
