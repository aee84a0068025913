"""Flow from files, from OpenCV and from a network."""

import struct
from pathlib import Path

import numpy as np
import pytest

from tests.priors.flo_files import write_flo
from tests.priors.rigs import still_life
from tests.priors.test_epipolar import exact_flow
from warpgs.errors import DataError, UsageError
from warpgs.priors.flow import flo_names, flow_between, read_flo, resize_flow
from warpgs.scene import Camera, View


def test_flo_round_trip(tmp_path):
    """Every bit comes back; what is not finite comes back as unknown."""
    flow = np.random.default_rng(0).normal(0, 30, (5, 7, 2)).astype(np.float32)
    flow[2, 3] = np.nan, 1
    write_flo(tmp_path / "a.flo", flow)
    again = read_flo(tmp_path / "a.flo")
    unknown = np.isnan(again).all(2)
    assert unknown.sum() == 1 and unknown[2, 3] and np.array_equal(again[~unknown], flow[~unknown])


@pytest.mark.parametrize(
    "raw, reason",
    [
        (b"", "not a Middlebury"),
        (b"PIEH", "not a Middlebury"),
        (b"JUNK" + bytes(20), "not a Middlebury"),
        (b"PIEH" + struct.pack("<ii", 0, 3), "0 x 3"),
        (b"PIEH" + struct.pack("<ii", -4, 3), "-4 x 3"),
        (b"PIEH" + struct.pack("<ii", 2**30, 2**30) + bytes(8), "sides must be"),
        (b"PIEH" + struct.pack("<ii", 2, 2) + bytes(31), "43 bytes"),
        (b"PIEH" + struct.pack("<ii", 2, 2) + bytes(33), "45 bytes"),
    ],
)
def test_malformed_flo_is_named(tmp_path, raw, reason):
    """The file is of another kind, has absurd sizes, too few or too many bytes."""
    (tmp_path / "bad.flo").write_bytes(raw)
    with pytest.raises(DataError, match=reason) as e:
        read_flo(tmp_path / "bad.flo")
    assert "bad.flo" in str(e.value)


def test_missing_flo_is_named(tmp_path):
    """There is no such file."""
    with pytest.raises(DataError, match=r"none\.flo"):
        read_flo(tmp_path / "none.flo")


def test_resize_scales_the_steps():
    """An affine motion stays the same motion at every size, also where the second image has a size of its own."""
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(30) + 0.5)
    flow = np.stack([2 + 0.1 * x, -1 + 0.05 * y], 2).astype(np.float32)
    big = resize_flow(flow, 80, 90)
    u, v = np.meshgrid((np.arange(80) + 0.5) / 2, (np.arange(90) + 0.5) / 3)
    inner = (slice(3, -3), slice(3, -3))
    assert np.allclose(
        big[inner], np.stack([2 * (2 + 0.1 * u), 3 * (-1 + 0.05 * v)], 2)[inner], atol=0.01
    )  # OpenCV resamples at 1/32 px
    other = resize_flow(flow, 40, 30, (20, 15))
    assert np.allclose(np.stack([x, y], 2) + other, (np.stack([x, y], 2) + flow) / 2, atol=0.01)
    assert resize_flow(flow, 40, 30) is flow


def test_folder_of_flow(tmp_path):
    """Both naming schemes are found and resized; a missing pair is None, a folder without flow an error."""
    views, depths = still_life()
    with pytest.raises(DataError, match=r"000-to-001\.flo"):
        flow_between(views, str(tmp_path))
    flow = exact_flow(views, depths)
    write_flo(tmp_path / "000-to-001.flo", flow(0, 1))
    write_flo(tmp_path / "001_1_0.flo", resize_flow(flow(1, 0), 320, 240))
    between = flow_between(views, str(tmp_path))
    assert np.array_equal(between(0, 1), flow(0, 1)) and between(0, 1) is between(0, 1)
    assert np.median(np.abs(between(1, 0) - flow(1, 0))) < 0.02
    assert between(2, 0) is None
    assert flo_names(views, 0, 2) == ["000-to-002.flo", "000_0_2.flo", "000.png_0_2.flo"]
    (tmp_path / "002-to-000.flo").write_bytes(b"PIEH")
    with pytest.raises(DataError, match=r"002-to-000"):
        flow_between(views, str(tmp_path))(2, 0)


@pytest.mark.parametrize("kind, limit", [("dis", 0.5), ("deepflow", 1.0), ("sparse", 2.0)])
def test_computed_flow_is_near_the_true_one(kind, limit):
    """On ray-cast neighbours half of all pixels are within the limit [px], also with a smaller second image."""
    import cv2

    views, depths = still_life()
    found, true = flow_between(views, kind)(0, 1), exact_flow(views, depths)(0, 1)
    assert found.shape == true.shape and np.median(np.linalg.norm(true, axis=2)) > 3
    assert np.median(np.linalg.norm(found - true, axis=2)) < limit
    if kind == "dis":
        c = views[1].camera
        small = Camera(c.viewmat, np.diag([0.5, 0.5, 1]) @ c.K, c.width // 2, c.height // 2)
        image = cv2.resize(views[1].image, (small.width, small.height), interpolation=cv2.INTER_AREA)
        pair = [views[0], View("small.png", small, image)]
        half = exact_flow(pair, [depths[0]])(0, 1)
        assert np.median(np.linalg.norm(flow_between(pair, kind)(0, 1) - half, axis=2)) < limit


def test_views_without_features_have_no_sparse_flow():
    """Gray images without a match give None."""
    camera = still_life()[0][0].camera
    views = [View(n, camera, np.full((120, 160, 3), 0.5, np.float32)) for n in ("a.png", "b.png")]
    assert flow_between(views, "sparse")(0, 1) is None


def varint(n: int) -> bytes:
    out = b""
    while n >= 0x80:
        out, n = out + bytes([n & 0x7F | 0x80]), n >> 7
    return out + bytes([n])


def message(*fields: tuple[int, object]) -> bytes:
    """Return a protocol-buffer message of numbered fields: whole numbers, bytes or text."""
    out = b""
    for number, value in fields:
        if isinstance(value, int):
            out += varint(number << 3) + varint(value)
        else:
            value = value.encode() if isinstance(value, str) else value
            out += varint(number << 3 | 2) + varint(len(value)) + value
    return out


def network(path: Path, weights: np.ndarray, bias: np.ndarray, sides=("h", "w"), inputs=("a", "b")) -> Path:
    """Return an ONNX file (field numbers of onnx.proto): a 1x1 convolution of the difference b - a of two images."""

    def value(name: str, channels: int) -> bytes:
        dims = [message((1, 1)), message((1, channels))]
        dims += [message((1, s)) if isinstance(s, int) else message((2, s)) for s in sides]
        tensor = message((1, 1), (2, message(*((1, d) for d in dims))))
        return message((1, name), (2, message((1, tensor))))

    def constant(name: str, array: np.ndarray) -> bytes:
        return message(*((1, n) for n in array.shape), (2, 1), (9, array.astype("<f4").tobytes()), (8, name))

    second = inputs[-1]
    nodes = [
        message((1, second), (1, "a"), (2, "d"), (4, "Sub")),
        message((1, "d"), (1, "k"), (1, "o"), (2, "flow"), (4, "Conv")),
    ]
    graph = message(
        *((1, n) for n in nodes), (2, "g"), (5, constant("k", weights.reshape(2, 3, 1, 1))), (5, constant("o", bias)),
        *((11, value(n, 3)) for n in inputs), (12, value("flow", 2)),
    )  # fmt: skip
    path.write_bytes(message((1, 8), (8, message((1, ""), (2, 13))), (7, graph)))
    return path


@pytest.mark.parametrize("value_range, factor", [("255", 255), ("unit", 1), ("signed", 2)])
def test_network_of_known_flow(tmp_path, value_range, factor):
    """With images of one colour, u is the difference of reds in the network's range and v is constant; odd sizes work."""
    camera = Camera(np.eye(4), np.eye(3), 20, 13)
    views = [View(f"{r}.png", camera, np.full((13, 20, 3), [r, 0.5, 0.1], np.float32)) for r in (0.25, 0.75)]
    path = network(tmp_path / "net.onnx", np.array([[1.0, 0, 0], [0, 0, 0]]), np.array([0.0, -2]))
    flow = flow_between(views, str(path), value_range)(0, 1)
    assert flow.shape == (13, 20, 2)
    # run at 24 x 16
    assert np.allclose(flow, [0.5 * factor * 20 / 24, -2 * 13 / 16], atol=1e-4)


def test_network_of_one_size(tmp_path):
    """A network with fixed sides gets images of that size, and its flow is scaled back."""
    camera = Camera(np.eye(4), np.eye(3), 20, 10)
    views = [View(n, camera, np.zeros((10, 20, 3), np.float32)) for n in "ab"]
    path = network(tmp_path / "net.onnx", np.zeros((2, 3)), np.array([4.0, 4]), sides=(40, 40))
    assert np.allclose(flow_between(views, str(path))(0, 1), [2, 1], atol=1e-5)


def test_files_that_are_no_flow_network(tmp_path):
    """The file is no ONNX model, has one input instead of two, or does not exist."""
    views, _ = still_life()
    (tmp_path / "junk.onnx").write_bytes(b"no network")
    with pytest.raises(DataError, match="junk"):
        flow_between(views, str(tmp_path / "junk.onnx"))
    one = network(tmp_path / "one.onnx", np.zeros((2, 3)), np.zeros(2), inputs=("a",))
    with pytest.raises(DataError, match="two images"):
        flow_between(views, str(one))
    with pytest.raises(UsageError, match="deepflow"):
        flow_between(views, str(tmp_path / "nowhere"))
    with pytest.raises(UsageError, match="signed"):
        flow_between(views, "dis", "0..1")
