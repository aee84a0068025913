"""Opening networks: what is taken, and everything that is refused before it runs."""

import hashlib

import numpy as np
import pytest

from tests.priors import networks as nw
from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.priors.networks import open_network

EYE, ZERO = np.eye(3), np.zeros(3)


def test_a_network_knows_its_file_layout_and_size(tmp_path):
    path = nw.depth_network(tmp_path / "a.onnx", size=(8, 12))
    network = open_network(path, threads=1)
    assert (network.layout, network.size) == ("nchw", (8, 12))
    assert network.sha256 == hashlib.sha256((tmp_path / "a.onnx").read_bytes()).hexdigest()
    assert network.title == f"a.onnx (SHA-256 {network.sha256[:12]})"
    assert network.session.get_providers() == ["CPUExecutionProvider"]
    assert network.session.get_session_options().intra_op_num_threads == 1
    free = open_network(nw.depth_network(tmp_path / "b.onnx", layout="nhwc"))
    assert (free.layout, free.size) == ("nhwc", None)


@pytest.mark.parametrize("layout", ["nchw", "nhwc"])
def test_an_image_goes_in_with_its_axes_in_order(tmp_path, layout):
    path = nw.write(tmp_path / "a.onnx", nw.linear(EYE, ZERO, layout=layout))
    image = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)
    output = open_network(path).run(image)[0]
    np.testing.assert_allclose(output if layout == "nhwc" else output.transpose(1, 2, 0), image, rtol=1e-6)


GOOD = nw.linear(EYE, ZERO)
REFUSED = {
    "empty": (b"", "not an ONNX model"),
    "text": (b"an image, not a network", "not an ONNX model"),
    "png": (b"\x89PNG\r\n\x1a\n" + bytes(64), "not an ONNX model"),
    "cut off": (GOOD[: len(GOOD) // 2], "not an ONNX model"),
    "no graph": (nw.field(1, 8) + nw.field(8, nw.field(2, 17)), "it has no graph"),
    "two inputs": (nw.linear(EYE, ZERO, inputs=2), r"2 inputs \(x, in1\)"),
    "two outputs": (nw.linear(EYE, ZERO, outputs=2), r"2 outputs \(y, more1\)"),
    "four channels": (
        nw.model(nw.graph([nw.node("Relu", ["x"], ["y"])], [], [nw.value("x", (1, 4, 8, 9))], [nw.value("y", (1, 4, 8, 9))])),
        "has the 3 channels",
    ),
    "a batch": (
        nw.model(nw.graph([nw.node("Relu", ["x"], ["y"])], [], [nw.value("x", (2, 3, 8, 8))], [nw.value("y", (2, 3, 8, 8))])),
        "one image",
    ),
    "three axes": (
        nw.model(nw.graph([nw.node("Relu", ["x"], ["y"])], [], [nw.value("x", (3, 8, 8))], [nw.value("y", (3, 8, 8))])),
        "one image",
    ),
    "one free side": (nw.linear(EYE, ZERO, size=(8, "w")), "fixes only one side"),
    "whole numbers": (
        nw.model(
            nw.graph([nw.node("Abs", ["x"], ["y"])], [], [nw.value("x", (1, 3, 8, 8), 2)], [nw.value("y", (1, 3, 8, 8), 2)])
        ),
        r"tensor\(uint8\); float",
    ),
    "foreign operator": (
        nw.model(
            nw.graph([nw.node("Run", ["x"], ["y"], "evil")], [], [nw.value("x", (1, 3, 8, 8))], [nw.value("y", (1, 3, 8, 8))]),
            nw.field(8, nw.field(1, "evil") + nw.field(2, 1)),
        ),
        "evil::Run is not part of ONNX",
    ),
    "unknown operator": (
        nw.model(nw.graph([nw.node("Frob", ["x"], ["y"])], [], [nw.value("x", (1, 3, 8, 8))], [nw.value("y", (1, 3, 8, 8))])),
        "cannot load it",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_files_that_are_refused(tmp_path, name, capsys):
    data, message = REFUSED[name]
    path = nw.write(tmp_path / "m.onnx", data)
    with pytest.raises(DataError, match=message) as e:
        open_network(path)
    assert path in str(e.value) and capsys.readouterr().out == ""


OUTSIDE = nw.external_tensor("k", (1,), "weights.bin")
CONSTANT = nw.field(1, "value") + nw.field(5, OUTSIDE) + nw.field(20, 4)


def placed(where: str) -> bytes:
    """Return a model with a tensor of a side file in one of the places that a model has for tensors."""
    x, y = nw.value("x", (1, 3, "h", "w")), nw.value("y", (1, 3, "h", "w"))
    add, constant = nw.node("Add", ["x", "k"], ["y"]), nw.node("Constant", [], ["k"], attributes=nw.field(5, CONSTANT))
    inner = nw.graph([constant], [], [], [])
    graph, more = nw.graph([add], [], [x], [y]), b""
    own = nw.field(1, "Own") + nw.field(10, "own")
    if where == "initializer":
        graph = nw.graph([add], [OUTSIDE], [x], [y])
    elif where == "attribute":
        graph = nw.graph([constant, add], [], [x], [y])
    elif where == "branch":
        branch = nw.field(5, nw.field(1, "then_branch") + nw.field(6, inner) + nw.field(20, 5))
        graph = nw.graph([nw.node("If", ["c"], ["y"], attributes=branch)], [], [x], [y])
    elif where.startswith("sparse"):
        graph += nw.field(15, nw.field(2 if where.endswith("indices") else 1, OUTSIDE))
    elif where == "list of tensors":
        graph = nw.graph([nw.node("Add", [], [], attributes=nw.field(5, nw.field(10, OUTSIDE))), add], [], [x], [y])
    elif where == "function":
        more = nw.field(25, own + nw.field(7, constant))
    elif where == "default of a function":
        more = nw.field(25, own + nw.field(11, CONSTANT))
    elif where == "graph in a default of a function":
        more = nw.field(25, own + nw.field(11, nw.field(1, "body") + nw.field(6, inner)))
    else:
        more = nw.field(20, nw.field({"first step of training": 1, "training": 2}[where], inner))
    return nw.model(graph, more)


@pytest.mark.parametrize(
    "where",
    [
        "initializer", "attribute", "branch", "sparse values", "sparse indices", "list of tensors", "function",
        "default of a function", "graph in a default of a function", "first step of training", "training",
    ],
)  # fmt: skip
def test_weights_in_another_file_are_refused_though_it_exists(tmp_path, where, monkeypatch):
    np.ones(1, "<f4").tofile(tmp_path / "weights.bin")
    monkeypatch.chdir(tmp_path)  # onnxruntime would look for them here
    path = nw.write(tmp_path / "m.onnx", placed(where))
    with pytest.raises(DataError, match="weights of 'k' are in another file"):
        open_network(path)


def test_what_protobuf_would_read_otherwise_is_refused(tmp_path):
    """A key of 33 bits stands for another field there, and of a text that is given twice the last holds."""
    key = nw.varint((1 << 32) + (13 << 3 | 2))
    entry = nw.field(1, "location") + nw.field(2, "weights.bin")
    hidden = nw.field(1, 1) + nw.field(2, 1) + nw.field(8, "k") + key + nw.varint(len(entry)) + entry
    x, y = nw.value("x", (1, 3, "h", "w")), nw.value("y", (1, 3, "h", "w"))
    add = nw.node("Add", ["x", "k"], ["y"])
    with pytest.raises(DataError, match="field number"):
        open_network(nw.write(tmp_path / "m.onnx", nw.model(nw.graph([add], [hidden], [x], [y]))))
    twice = add + nw.field(7, "ai.on") + nw.field(7, "nx")
    with pytest.raises(DataError, match="nx::Add is not part of ONNX"):
        open_network(nw.write(tmp_path / "m.onnx", nw.model(nw.graph([twice], [], [x], [y]))))


def test_functions_that_travel_in_the_file_are_welcome(tmp_path):
    """Exporters of torch put composed operators into functions of domains of their own."""
    twice = nw.field(1, "Twice") + nw.field(10, "own") + nw.field(4, "a") + nw.field(5, "b")
    twice += nw.field(7, nw.node("Add", ["a", "a"], ["b"])) + nw.field(9, nw.field(1, "") + nw.field(2, 17))
    x, y = nw.value("x", (1, 3, "h", "w")), nw.value("y", (1, 3, "h", "w"))
    more = nw.field(25, twice) + nw.field(8, nw.field(1, "own") + nw.field(2, 1))
    path = nw.write(tmp_path / "m.onnx", nw.model(nw.graph([nw.node("Twice", ["x"], ["y"], "own")], [], [x], [y]), more))
    image = np.random.default_rng(0).normal(size=(4, 4, 3)).astype(np.float32)
    np.testing.assert_allclose(open_network(path).run(image)[0], 2 * image.transpose(2, 0, 1))


def test_nested_graphs_end(tmp_path):
    body = nw.graph([], [], [], [])
    for _ in range(200):
        body = nw.graph([nw.node("If", [], [], attributes=nw.field(5, nw.field(6, body)))], [], [], [])
    with pytest.raises(DataError, match="nested deeper"):
        open_network(nw.write(tmp_path / "m.onnx", nw.model(body)))


def test_no_bytes_crash_the_reader(tmp_path):
    """Damaged files raise a DataError or still work."""
    rng = np.random.default_rng(5)
    for i in range(150):
        data = bytearray(GOOD)
        for at in rng.integers(len(data), size=rng.integers(1, 6)):
            data[at] = rng.integers(256)
        try:
            open_network(nw.write(tmp_path / f"{i}.onnx", bytes(data)))
        except DataError as e:
            assert f"{i}.onnx" in str(e)


def test_a_missing_file_and_an_unknown_provider(tmp_path):
    with pytest.raises(DataError, match="cannot be read"):
        open_network(tmp_path / "none.onnx")
    with pytest.raises(UsageError, match="'tpu' is not one of cpu, cuda"):
        open_network(tmp_path / "none.onnx", provider="tpu")


def test_cuda_where_onnxruntime_has_none(tmp_path, monkeypatch):
    import onnxruntime

    path = nw.depth_network(tmp_path / "a.onnx")
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["AzureExecutionProvider", "CPUExecutionProvider"])
    with pytest.raises(ResourceError, match=r"has only cpu\. .*onnxruntime-gpu"):
        open_network(path, provider="cuda")
    # it may also promise CUDA and then run without: libraries are missing
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CUDAExecutionProvider", "CPUExecutionProvider"])
    start = onnxruntime.InferenceSession
    monkeypatch.setattr(onnxruntime, "InferenceSession", lambda data, options, **_: start(data, options))
    with pytest.raises(ResourceError, match="finds no cuda libraries or device"):
        open_network(path, provider="cuda")

    # or fail on the device, which a damaged file would do on the CPU, too
    def broken(data, options, providers, **_):
        if providers == ["CUDAExecutionProvider"]:
            raise RuntimeError("CUDA failure 100: no device")
        return start(data, options, providers=providers)

    monkeypatch.setattr(onnxruntime, "InferenceSession", broken)
    with pytest.raises(ResourceError, match=r"--onnx-provider cuda: onnxruntime cannot use it \(CUDA failure 100"):
        open_network(path, provider="cuda")
    with pytest.raises(DataError, match="cannot load it"):
        open_network(nw.write(tmp_path / "m.onnx", REFUSED["unknown operator"][0]), provider="cuda")


@pytest.mark.parametrize(
    ("weights", "bias", "message"),
    [(EYE, [0, np.nan, 0], "NaN or infinity"), (EYE, [0, np.inf, 0], "NaN or infinity"), (0 * EYE, [2, 2, 2], "same number")],
)
def test_outputs_that_say_nothing_are_refused(tmp_path, weights, bias, message):
    network = open_network(nw.write(tmp_path / "m.onnx", nw.linear(weights, np.array(bias, float))))
    with pytest.raises(DataError, match=message):
        network.run(np.random.default_rng(0).random((4, 4, 3), np.float32))


def test_labels_instead_of_scores_are_refused(tmp_path):
    x, y = nw.value("x", (1, 3, "h", "w")), nw.value("y", (1, 1, "h", "w"), 7)
    argmax = nw.node("ArgMax", ["x"], ["y"], attributes=nw.whole_attribute("axis", 1))
    network = open_network(nw.write(tmp_path / "m.onnx", nw.model(nw.graph([argmax], [], [x], [y]))))
    with pytest.raises(DataError, match="leave argmax out"):
        network.run(np.random.default_rng(0).random((4, 4, 3), np.float32))


def test_a_size_that_the_graph_cannot_take_is_said(tmp_path):
    x, y = nw.value("x", (1, 3, "h", "w")), nw.value("y", (1, 3, "h", "w"))
    graph = nw.graph([nw.node("Add", ["x", "k"], ["y"])], [nw.tensor("k", np.ones((1, 3, 8, 8)))], [x], [y])
    network = open_network(nw.write(tmp_path / "m.onnx", nw.model(graph)))
    with pytest.raises(DataError, match="cannot run it on an input of 1 x 3 x 5 x 5"):
        network.run(np.random.default_rng(0).random((5, 5, 3), np.float32))


def test_names_that_are_not_utf8_are_refused(tmp_path):
    """onnxruntime loads such a network, and fails only where the name is read."""
    path = nw.depth_network(tmp_path / "a.onnx", size=(8, 12))
    name = open_network(path).session.get_inputs()[0].name.encode()
    file = tmp_path / "a.onnx"
    file.write_bytes(file.read_bytes().replace(name, b"\xff" * len(name)))
    with pytest.raises(DataError, match=r"a\.onnx"):
        open_network(path)
