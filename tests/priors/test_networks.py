"""Networks: what is taken and refused, and disparity and segments from networks with known answers."""

import hashlib
import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from tests.priors import networks as nw
from warpgs.errors import DataError, ResourceError
from warpgs.priors.networks import (
    DEFAULTS,
    HALF,
    IMAGENET,
    Network,
    Preprocessing,
    complete_disparity,
    describe,
    network_disparity,
    resize,
    unit_range,
)
from warpgs.priors.views import (
    _fast_length,
    boundary_weight,
    class_probabilities,
    classical_semantics,
    knows_foreground,
    network_semantics,
)

EYE, ZERO = np.eye(3), np.zeros(3)
FREE = (1, 3, "h", "w")


def one_node(
    kind: str, shape: tuple = FREE, out: tuple | None = None, *, domain="", scalar=1, of=("x",), tensors=(), attributes=b""
):
    node = nw.node(kind, list(of), ["y"], domain, attributes)
    outs = [nw.value("y", out or shape, 7 if kind == "ArgMax" else scalar)]
    more = nw.field(8, nw.field(1, domain) + nw.field(2, 1)) if domain else b""
    return nw.model(nw.graph([node], list(tensors), [nw.value("x", shape, scalar)], outs), more)


def opened(tmp_path, data: bytes, name="m.onnx", **options) -> Network:
    return Network(nw.write(tmp_path / name, data), **options)


def test_a_network_knows_its_file_layout_and_size(tmp_path):
    """And an image goes in with its axes in order."""
    network = Network(nw.depth_network(tmp_path / "a.onnx", size=(8, 12)), threads=1)
    assert (network.layout, network.size) == ("nchw", (8, 12))
    assert network.sha256 == hashlib.sha256((tmp_path / "a.onnx").read_bytes()).hexdigest()
    assert network.title == f"a.onnx (SHA-256 {network.sha256[:12]})"
    assert network.session.get_providers() == ["CPUExecutionProvider"]
    assert network.session.get_session_options().intra_op_num_threads == 1
    image = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)
    for layout in ("nchw", "nhwc"):
        free = opened(tmp_path, nw.linear(EYE, ZERO, layout=layout))
        assert (free.layout, free.size) == (layout, None)
        output = free.run(image)[0]
        np.testing.assert_allclose(output if layout == "nhwc" else output.transpose(1, 2, 0), image, rtol=1e-6)


GOOD = nw.linear(EYE, ZERO)
REFUSED = {
    "empty": (b"", "not an ONNX model"),
    "png": (b"\x89PNG\r\n\x1a\n" + bytes(64), "not an ONNX model"),
    "cut off": (GOOD[: len(GOOD) // 2], "not an ONNX model"),
    "no graph": (nw.field(1, 8) + nw.field(8, nw.field(2, 17)), "it has no graph"),
    "two graphs": (GOOD + GOOD, "it has several graphs"),
    "two inputs": (nw.linear(EYE, ZERO, inputs=2), r"2 inputs \(x, in1\)"),
    "two outputs": (nw.linear(EYE, ZERO, outputs=2), r"2 outputs \(y, more1\)"),
    "four channels": (one_node("Relu", (1, 4, 8, 9)), "has the 3 channels"),
    "a batch": (one_node("Relu", (2, 3, 8, 8)), "one image"),
    "three axes": (one_node("Relu", (3, 8, 8)), "one image"),
    "one free side": (nw.linear(EYE, ZERO, size=(8, "w")), "fixes only one side"),
    "whole numbers": (one_node("Abs", scalar=2), r"tensor\(uint8\); float"),
    "foreign operator": (one_node("Run", domain="evil"), "evil::Run is not part of ONNX"),
    "unknown operator": (one_node("Frob"), "cannot load it"),
    "a name that is not UTF-8, loaded but never read": (GOOD.replace(nw.field(1, "x"), nw.field(1, b"\xff")), "not UTF-8"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_files_that_are_refused(tmp_path, name, capsys):
    data, message = REFUSED[name]
    with pytest.raises(DataError, match=rf"m\.onnx.*{message}"):
        opened(tmp_path, data)
    assert capsys.readouterr().out == ""


OUTSIDE = nw.external_tensor("k", (1,), "weights.bin")
CONSTANT = nw.field(1, "value") + nw.field(5, OUTSIDE) + nw.field(20, 4)


def placed() -> dict[str, bytes]:
    """Return models with a tensor of a side file in each of the places that a model has for tensors."""
    x, y = nw.value("x", FREE), nw.value("y", FREE)
    add, constant = nw.node("Add", ["x", "k"], ["y"]), nw.node("Constant", [], ["k"], attributes=nw.field(5, CONSTANT))
    inner, own = nw.graph([constant], [], [], []), nw.field(1, "Own") + nw.field(10, "own")
    branch = nw.field(5, nw.field(1, "then_branch") + nw.field(6, inner) + nw.field(20, 5))
    listed = nw.node("Add", [], [], attributes=nw.field(5, nw.field(10, OUTSIDE)))
    plain = nw.graph([add], [], [x], [y])
    return {
        "initializer": nw.model(nw.graph([add], [OUTSIDE], [x], [y])),
        "attribute": nw.model(nw.graph([constant, add], [], [x], [y])),
        "branch": nw.model(nw.graph([nw.node("If", ["c"], ["y"], attributes=branch)], [], [x], [y])),
        "sparse values": nw.model(plain + nw.field(15, nw.field(1, OUTSIDE))),
        "sparse indices": nw.model(plain + nw.field(15, nw.field(2, OUTSIDE))),
        "list of tensors": nw.model(nw.graph([listed, add], [], [x], [y])),
        "function": nw.model(plain, nw.field(25, own + nw.field(7, constant))),
        "default of a function": nw.model(plain, nw.field(25, own + nw.field(11, CONSTANT))),
        "graph of a default": nw.model(plain, nw.field(25, own + nw.field(11, nw.field(1, "body") + nw.field(6, inner)))),
        "first step of training": nw.model(plain, nw.field(20, nw.field(1, inner))),
        "training": nw.model(plain, nw.field(20, nw.field(2, inner))),
    }


PLACED = placed()


@pytest.mark.parametrize("where", PLACED)
def test_weights_in_another_file_are_refused_though_it_exists(tmp_path, where, monkeypatch):
    np.ones(1, "<f4").tofile(tmp_path / "weights.bin")
    monkeypatch.chdir(tmp_path)  # onnxruntime would look for them here
    with pytest.raises(DataError, match="its weights are in another file"):
        opened(tmp_path, PLACED[where])


def test_what_protobuf_would_read_otherwise_is_refused(tmp_path):
    """A key of 33 bits stands for another field there, of a text that is given twice the last holds, and graphs may nest."""
    key = nw.varint((1 << 32) + (13 << 3 | 2))
    entry = nw.field(1, "location") + nw.field(2, "weights.bin")
    hidden = nw.field(1, 1) + nw.field(2, 1) + nw.field(8, "k") + key + nw.varint(len(entry)) + entry
    body = nw.graph([], [], [], [])
    for _ in range(200):
        body = nw.graph([nw.node("If", [], [], attributes=nw.field(5, nw.field(6, body)))], [], [], [])
    twice = nw.graph([nw.node("Add", ["x", "k"], ["y"]) + nw.field(7, "ai.on") + nw.field(7, "nx")], [], [], [])
    for data, words in (
        (one_node("Add", of=("x", "k"), tensors=[hidden]), "field number"), (nw.model(body), "nested deeper"),
        (nw.model(twice), "nx::Add is not part of ONNX"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=words):
            opened(tmp_path, data)


def test_functions_that_travel_in_the_file_are_welcome(tmp_path):
    """Exporters of torch put composed operators into functions of domains of their own."""
    twice = nw.field(1, "Twice") + nw.field(10, "own") + nw.field(4, "a") + nw.field(5, "b")
    twice += nw.field(7, nw.node("Add", ["a", "a"], ["b"])) + nw.field(9, nw.field(1, "") + nw.field(2, 17))
    image = np.random.default_rng(0).normal(size=(4, 4, 3)).astype(np.float32)
    network = opened(tmp_path, one_node("Twice", domain="own") + nw.field(25, twice))
    np.testing.assert_allclose(network.run(image)[0], 2 * image.transpose(2, 0, 1))


def nested_functions(depth: int, last: str) -> bytes:
    """Return a network of functions that each call the next one twice; the last one is ``last``."""
    imports = nw.field(9, nw.field(1, "") + nw.field(2, 17)) + nw.field(9, nw.field(1, "own") + nw.field(2, 1))
    body = b""
    for i in range(depth):
        inner, domain = (f"F{i + 1}", "own") if i < depth - 1 else (last, "own" if last.startswith("F") else "")
        nodes = [nw.node(inner, [a], [b], domain) for a, b in (("a", "m"), ("m", "b"))]
        named = nw.field(1, f"F{i}") + nw.field(10, "own") + nw.field(4, "a") + nw.field(5, "b")
        body += nw.field(25, named + b"".join(nw.field(7, n) for n in nodes) + imports)
    return one_node("F0", domain="own") + body


@pytest.mark.parametrize(("depth", "last"), [(25, "Neg"), (3, "F1"), (1, "F0")])
def test_functions_without_end_are_refused(depth, last, tmp_path):
    """onnxruntime inlines them while it loads the file, which no signal ends."""
    with pytest.raises(DataError, match=r"m\.onnx.*(functions are inlined|call themselves)"):
        opened(tmp_path, nested_functions(depth, last))
    opened(tmp_path, nested_functions(3, "Neg"))


def endless() -> bytes:
    image, yes = (1, 3, "h", "w"), nw.field(2, 9) + nw.field(8, "yes") + nw.field(9, b"\1")
    steps = [nw.node("Identity", ["c"], ["c2"]), nw.node("Neg", ["v"], ["v2"])]
    ins = [nw.value("i", (), 7), nw.value("c", (), 9), nw.value("v", image)]
    outs = [nw.value("c2", (), 9), nw.value("v2", image)]
    body = nw.field(5, nw.field(1, "body") + nw.field(6, nw.graph(steps, [], ins, outs)) + nw.field(20, 5))
    loop = nw.node("Loop", ["", "yes", "x"], ["y"], attributes=body)
    return nw.model(nw.graph([loop], [yes], [nw.value("x", image)], [nw.value("y", image)]))


def slow_to_load(count: int) -> bytes:
    """Return a network with constants that take long to fold: matrices are multiplied while it is loaded."""
    image = (1, 3, "h", "w")
    products = [nw.node("MatMul", ["c", "r"], ["m0"])]
    products += [nw.node("MatMul", [f"m{i}", "m0"], [f"m{i + 1}"]) for i in range(count)]
    products += [nw.node("ReduceMean", [f"m{count}"], ["k"]), nw.node("Mul", ["x", "k"], ["y"])]
    constants = [nw.tensor("c", np.full((2000, 1), 1 / 2000)), nw.tensor("r", np.ones((1, 2000)))]
    return nw.model(nw.graph(products, constants, [nw.value("x", image)], [nw.value("y", image)]))


RUN = """
import sys
import numpy as np
import onnxruntime
from warpgs.priors.networks import Network
from warpgs.process import interrupting_signals
load = onnxruntime.InferenceSession
def loading(*args, **kwargs):
    print("loads", flush=True)
    return load(*args, **kwargs)
with interrupting_signals():
    onnxruntime.InferenceSession = loading
    network = Network(sys.argv[1])
    print("runs", flush=True)
    network.run(np.ones((4, 4, 3), np.float32))
"""


def work_for(child: subprocess.Popen, seconds: float) -> None:
    """Wait until a process has worked so long [s of the processor], however busy the machine is, or has ended."""
    process = psutil.Process(child.pid)
    begun = process.cpu_times().user
    while child.poll() is None and process.cpu_times().user < begun + seconds:
        time.sleep(0.01)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("state", ["loads", "runs"])
def test_a_signal_ends_an_endless_network(number, state, tmp_path):
    path = nw.write(tmp_path / "m.onnx", slow_to_load(2000) if state == "loads" else endless())
    with subprocess.Popen(
        [sys.executable, "-c", RUN, path], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout.readline() == "loads\n" and (state == "loads" or child.stdout.readline() == "runs\n")
        work_for(child, 0.3)  # so that the work outside Python has begun
        child.send_signal(number)
        try:
            assert "KeyboardInterrupt" in child.communicate(timeout=60)[1]
        finally:
            child.kill()


def test_names_of_nodes_are_not_printed_raw(tmp_path, capfd):
    """onnxruntime prints the errors that it raises, with the names in the file."""
    named = nw.node("Add", ["x", "k"], ["y"]) + nw.field(3, "\x1b[31mevil")
    outs, k = [nw.value("y", FREE)], nw.tensor("k", np.ones((1, 3, 8, 8)))
    network = opened(tmp_path, nw.model(nw.graph([named], [k], [nw.value("x", FREE)], outs)))
    with pytest.raises(DataError, match="input of 1 x 3 x 5 x 5"):
        network.run(np.ones((5, 5, 3), np.float32))
    assert capfd.readouterr() == ("", "")


def test_cuda_where_onnxruntime_has_none(tmp_path, monkeypatch):
    import onnxruntime

    path = nw.depth_network(tmp_path / "a.onnx")
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["AzureExecutionProvider", "CPUExecutionProvider"])
    with pytest.raises(ResourceError, match=r"has only cpu\. .*onnxruntime-gpu"):
        Network(path, provider="cuda")
    # it may also promise CUDA and then run without: libraries are missing
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CUDAExecutionProvider", "CPUExecutionProvider"])
    start = onnxruntime.InferenceSession
    monkeypatch.setattr(onnxruntime, "InferenceSession", lambda data, options, **_: start(data, options))
    with pytest.raises(ResourceError, match="finds no cuda libraries or device"):
        Network(path, provider="cuda")

    # or fail on the device, which a damaged file would do on the CPU, too
    def broken(data, options, providers, **_):
        if providers == ["CUDAExecutionProvider"]:
            raise RuntimeError("CUDA failure 100: no device")
        return start(data, options, providers=providers)

    monkeypatch.setattr(onnxruntime, "InferenceSession", broken)
    with pytest.raises(ResourceError, match=r"--onnx-provider cuda: onnxruntime cannot use it \(CUDA failure 100"):
        Network(path, provider="cuda")
    with pytest.raises(DataError, match="cannot load it"):
        opened(tmp_path, REFUSED["unknown operator"][0], provider="cuda")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (nw.linear(EYE, np.array([0, np.nan, 0])), "NaN or infinity"), (nw.linear(EYE, np.array([0, np.inf, 0])), "NaN or inf"),
        (nw.linear(0 * EYE, np.array([2.0, 2, 2])), "same number"),
        (one_node("ArgMax", out=(1, 1, "h", "w"), attributes=nw.whole_attribute("axis", 1)), "leave argmax out"),
        (one_node("Add", of=("x", "k"), tensors=[nw.tensor("k", np.ones((1, 3, 8, 8)))]), "input of 1 x 3 x 5 x 5"),
    ],
)  # fmt: skip
def test_outputs_that_say_nothing_are_refused(tmp_path, data, message):
    with pytest.raises(DataError, match=rf"m\.onnx.*{message}"):
        opened(tmp_path, data).run(np.random.default_rng(0).random((5, 5, 3), np.float32))


# Disparity from networks with known answers, and from depth that is consistent between views at some pixels.

MEAN, STD = (0.4, 0.5, 0.6), (0.2, 0.25, 0.5)


def scaled(values):
    return (values - values.min()) / (values.max() - values.min())


def photo(height, width, seed=0):
    return np.random.default_rng(seed).random((height, width, 3), np.float32)


def response(image, mean=MEAN, std=STD):
    return ((image.astype(float) - mean) / std) @ nw.DEPTH_WEIGHTS[0] + nw.DEPTH_BIAS[0]


@pytest.mark.parametrize("layout", ["nchw", "nhwc"])
@pytest.mark.parametrize(("output", "sign"), [("disparity", 1), ("depth", -1)])
def test_normalisation_and_sign(tmp_path, layout, output, sign):
    """At the network's own size the map is the formula: colours normalised, depth inverted, scaled to [0, 1]."""
    image = photo(32, 64)
    how = Preprocessing(32, 32, MEAN, STD, output)
    if output == "depth":
        image = 0.5 + 0.5 * image  # keeps the response above 0
    found = network_disparity(Network(nw.depth_network(tmp_path / "d.onnx", layout=layout)), how, image)
    assert found.dtype == np.float32 and found.shape == (32, 64) and (found.min(), found.max()) == (0, 1)
    np.testing.assert_allclose(found, scaled(response(image) ** sign), atol=2e-6)


def test_resizing_keeps_pixel_centres(tmp_path):
    """A ramp stays a ramp through a network of a quarter of the size, flat only beyond its outermost centres."""
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(64) + 0.5)
    image = np.repeat((x / 200 + y / 150)[..., None], 3, 2).astype(np.float32)
    network = Network(nw.depth_network(tmp_path / "d.onnx", size=(16, 24)))
    found = network_disparity(network, Preprocessing(0, 0, (0.0,) * 3, (1.0,) * 3, "disparity"), image)
    np.testing.assert_allclose(found, scaled(x.clip(2, 94) / 200 + y.clip(2, 62) / 150), atol=1e-5)


def test_sizes_of_free_inputs_and_resizing():
    """Proportions and multiples are kept; linear up, mean down."""
    how = Preprocessing(384, 32, *HALF, "disparity")
    assert how.free_size(378, 504) == (384, 512) and how.free_size(1920, 1080) == (672, 384)
    assert how.free_size(10, 10_000)[0] == 384
    assert Preprocessing(518, 14, *HALF, "disparity").free_size(378, 504) == (518, 686)
    image = photo(8, 12)
    np.testing.assert_allclose(resize(image, 4, 6), image.reshape(4, 2, 6, 2, 3).mean((1, 3)), atol=1e-6)
    wide = resize(np.float32([[0, 1]]), 1, 4)
    np.testing.assert_allclose(wide, [[0, 0.25, 0.75, 1]], atol=1e-6)
    many = np.random.default_rng(1).random((9, 13, 21), np.float32)
    for size in ((7, 8), (20, 30), (9, 13), (7, 30)):
        found = resize(many, *size)
        np.testing.assert_array_equal(found, np.stack([resize(many[..., c], *size) for c in range(21)], -1))


def test_outputs_that_are_no_depth_are_refused(tmp_path):
    network = Network(nw.depth_network(tmp_path / "d.onnx"))
    with pytest.raises(DataError, match=r"has depths of 0; .* into its JSON"):
        network_disparity(network, Preprocessing(32, 32, (6.0,) * 3, (0.2,) * 3, "depth"), photo(32, 32))
    network = Network(nw.segmentation_network(tmp_path / "s.onnx"))
    with pytest.raises(DataError, match=r"shape \(1, 21, 384, 384\), not that of one depth map"):
        network_disparity(network, DEFAULTS, photo(32, 32))


def described(path):
    return describe(Network(path), DEFAULTS, "depth")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "cannot be read"),
        ("[1]", "must be an object"),
        ('{"men": [0, 0, 0]}', "men is unknown.* size, multiple, mean, std, output"),
        ('{"mean": [0, 0]}', "mean must be a list of 3"),
        ('{"mean": [0, 0, NaN]}', "must be a finite number"),
        ('{"std": [1, 1, 0]}', "must be a finite number above 0"),
        ('{"size": 1.5}', "size must be a whole number"),
        ('{"multiple": true}', "multiple must be a whole number"),
        ('{"output": "height"}', "output must be one of disparity, depth, classes, not 'height'"),
    ],
)
def test_side_files_with_faults(tmp_path, text, message):
    (tmp_path / "d.onnx.json").write_text(text)
    with pytest.raises(DataError, match=rf"d\.onnx\.json.*{message}"):
        described(nw.depth_network(tmp_path / "d.onnx"))


def test_the_side_file_comes_before_what_is_usual_and_not_against_the_graph(tmp_path):
    """Also the documented one."""
    path, side = nw.depth_network(tmp_path / "d.onnx"), tmp_path / "d.onnx.json"
    how, notes = described(path)
    assert how == DEFAULTS
    assert notes == [
        "d.onnx: assumed size 384, multiple 32, mean 0.5 0.5 0.5, std 0.5 0.5 0.5, output disparity; "
        "to change them, write d.onnx.json"
    ]
    side.write_text(json.dumps({"size": 518, "multiple": 14, "mean": IMAGENET[0], "std": IMAGENET[1], "output": "depth"}))
    assert described(path) == (Preprocessing(518, 14, *IMAGENET, "depth"), [])
    page = Path(__file__).parents[2] / "docs" / "priors.md"
    side.write_text(*re.findall(r"```json\n(.*?)```", page.read_text("utf-8"), re.DOTALL))
    assert described(path) == (Preprocessing(518, 14, *IMAGENET, "disparity"), [])
    path = nw.depth_network(tmp_path / "d.onnx", size=(32, 48))
    (tmp_path / "d.onnx.json").write_text(json.dumps({"size": 32}))
    assert described(path)[0].mean == DEFAULTS.mean
    (tmp_path / "d.onnx.json").write_text(json.dumps({"size": 64}))
    with pytest.raises(DataError, match=r"size 64, but .* takes 48 x 32 px only"):
        described(path)


def two_planes(height=60, width=80, seed=0):
    """Return a slanted near plane, red, before a far one, blue: colours and true inverse depth."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    near = (x > 25) & (x < 60) & (y > 15)
    image = np.where(near[..., None], [0.8, 0.2, 0.1], [0.1, 0.2, 0.7])
    image += np.random.default_rng(seed).normal(0, 0.005, image.shape)
    return image.astype(np.float32), np.where(near, 0.8 + 0.002 * y, 0.3), near


def test_gaps_are_filled_up_to_the_colour_edge_and_not_across():
    """Four valid pixels of a hundred suffice; the object's edge stays where the colours have it."""
    image, inverse, near = two_planes()
    valid = np.random.default_rng(1).random(near.shape) < 0.04
    depth = np.where(valid, 1 / inverse, 0).astype(np.float32)
    found = complete_disparity(image, depth, valid, np.where(valid, 0.01, np.inf))
    assert found.dtype == np.float32 and found.shape == near.shape and (found.min(), found.max()) == (0, 1)
    wanted = scaled(inverse)
    assert np.abs(found - wanted).max() < 0.08 and np.abs(found - wanted).mean() < 0.02
    assert ((found > 0.5) == near).all()
    again = complete_disparity(image, 1000 * depth, valid, np.where(valid, 10, np.inf))  # in another unit of length
    np.testing.assert_allclose(again, found, atol=1e-4)


def test_weights_are_those_of_inverse_depth():
    """Depths 1 and 2 with equally uncertain inverses get the same weight on one surface."""
    columns = np.arange(90) // 30 + np.zeros((40, 1), int)
    image = np.repeat((0.1 + 0.4 * columns)[..., None], 3, 2).astype(np.float32)
    board = np.indices((40, 90)).sum(0) % 2 == 0
    depth = np.where((columns == 0) | ((columns == 1) & board), 1.0, 2.0)
    found = complete_disparity(image, depth, np.ones(depth.shape, bool), 0.1 * depth**2)
    assert abs(found[5:-5, 35:55].mean() - 0.5) < 0.02
    assert found[:, :25].min() > 0.95 and found[:, 65:].max() < 0.05
    # every tenth depth is wrong by half; where its sensitivity is large too, the map hardly changes
    image, inverse, near = two_planes()
    rng = np.random.default_rng(2)
    valid, wrong = rng.random(near.shape) < 0.3, rng.random(near.shape) < 0.1
    truth, errors = scaled(inverse), []
    for factor, told in ((1, 1), (1.5, 50), (1.5, 1)):
        depth = np.where(valid, np.where(wrong, factor, 1) / inverse, 0)
        sensitivity = np.where(valid, np.where(wrong, told, 1) * 0.02 / inverse**2, np.inf)
        errors.append(np.abs(complete_disparity(image, depth, valid, sensitivity) - truth).mean())
    right, warned, fooled = errors
    assert warned < 1.1 * right and fooled > 1.7 * right, errors


def test_lone_wild_and_missing_depths():
    image, inverse, near = two_planes()
    lone, everywhere, unknown = np.zeros(near.shape, bool), np.ones(near.shape, bool), np.full(near.shape, np.inf)
    # a depth without a known sensitivity still counts, if least
    assert np.isfinite(complete_disparity(image, 1 / inverse, everywhere, unknown)).all()
    lone[30, 40] = True
    assert (complete_disparity(image, np.where(lone, 2.0, 0), lone, np.where(lone, 0.1, np.inf)) == 0).all()
    assert (unit_range(np.full((3, 4), 7.0)) == 0).all() and unit_range(np.array([[3.0, 5, 4]])).tolist() == [[0, 1, 0.5]]
    depth, sensitivity = 1 / inverse, np.full(near.shape, 0.1)
    depth[0, 0], sensitivity[0, 0] = 1e-6, 0  # a million times nearer than all else, and quite sure of it
    found = complete_disparity(image, depth, everywhere, sensitivity)
    assert found[near].mean() - found[~near].mean() > 0.8


# Maps of a segmentation network with known answers, the falloff of boundaries, and the classical stand-in.

PLAIN = Preprocessing(32, 32, (0.0,) * 3, (1.0,) * 3, "classes")


def shapes(height=32, width=64):
    image, labels = np.zeros((height, width, 3), np.float32), np.zeros((height, width), int)
    image[8:20, 6:24, 0], labels[8:20, 6:24] = 0.9, 3
    image[12:30, 40:58, 2], labels[12:30, 40:58] = 0.7, 15
    return image, labels


def brute_boundary(labels):
    """Return exp(-d^2 / 2 s^2) by the distances of every pixel to all pixels at a label change."""
    height, width = labels.shape
    padded = np.pad(labels, 1, mode="edge")
    near = [padded[1 + a : 1 + a + height, 1 + b : 1 + b + width] for a, b in ((0, 1), (1, 0), (0, -1), (-1, 0))]
    i, j = np.mgrid[:height, :width]
    d2 = np.min([(i - a) ** 2 + (j - b) ** 2 for a, b in np.argwhere(np.any([n != labels for n in near], 0))], axis=0)
    return np.exp(-d2 / (2 * (2 * width / 500) ** 2))


@pytest.mark.parametrize(
    "options", [{}, {"layout": "nhwc"}, {"size": (32, 64)}, {"then": "Softmax"}, {"layout": "nhwc", "then": "Softmax"}]
)
def test_maps_equal_the_formula(tmp_path, options):
    image, labels = shapes()
    maps = network_semantics(Network(nw.segmentation_network(tmp_path / "s.onnx", **options)), PLAIN, image)
    weights, bias = nw.segmentation_weights()
    p = np.exp(image.astype(float) @ weights.T + bias)
    p /= p.sum(-1, keepdims=True)
    assert (p.argmax(-1) == labels).all()
    for found, wanted in zip(maps, (p.max(-1), brute_boundary(labels), 1 - p[..., 0])):
        assert found.dtype == np.float32 and found.shape == labels.shape
        np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_a_coarse_network_puts_labels_where_they_are(tmp_path):
    """At a quarter of the size each label covers its object; a shift of half a pixel would show."""
    image, labels = np.zeros((128, 256, 3), np.float32), np.zeros((128, 256), int)
    image[32:80, 64:160, 0], labels[32:80, 64:160] = 0.9, 3
    network = Network(nw.segmentation_network(tmp_path / "s.onnx", size=(32, 64)))
    p = class_probabilities(network, PLAIN, image)
    found = p.argmax(-1)
    # the object's outline lies on the coarse grid, so errors are the same on all sides
    assert (found == 3).sum() == pytest.approx((labels == 3).sum(), rel=0.06)
    rows, columns = np.nonzero(found == 3)
    assert (rows.min() + rows.max(), columns.min() + columns.max()) == (32 + 79, 64 + 159)
    np.testing.assert_allclose(p.sum(-1), 1, atol=1e-5)


def test_boundaries_and_known_foreground():
    assert (boundary_weight(np.zeros((5, 7), int)) == 0).all()
    labels = np.zeros((4, 1000), int)
    labels[:, 500:] = 1
    weight = boundary_weight(labels)
    assert weight[0, 499] == weight[0, 500] == 1
    np.testing.assert_allclose(weight[2, 504], np.exp(-0.5), rtol=1e-6)  # 4 px at 1000 px
    for foreground, boundary, known in ((0.02, 1, True), (0.009, 1, False), (0.1, 0, False), (0.9, 0, True)):
        maps = np.full((10, 10), float(boundary)), np.full((10, 10), foreground)
        assert knows_foreground(*maps) is known, "without a boundary every label is background, or an object"
    # the largest product of 2, 3 and 5 up to a length
    products = sorted(2**a * 3**b * 5**c for a in range(10) for b in range(6) for c in range(4))
    for length in (1, 7, 193, 258, 511, 997):
        assert _fast_length(length) == max(p for p in products if p <= length)


def test_classical_maps_show_an_object_and_its_outline():
    """A bright textured disc on dark ground is salient, with a boundary along its outline and none far away."""
    y, x = np.mgrid[:96, :128] + 0.5
    radius = np.hypot(x - 70, y - 45)
    disc = radius < 22
    image = np.where(disc[..., None], [0.9, 0.7, 0.2], [0.1, 0.12, 0.15])
    image = np.clip(image + np.random.default_rng(0).normal(0, 0.01, image.shape), 0, 1).astype(np.float32)
    confidence, boundary, foreground = maps = classical_semantics(image)
    for m in maps:
        assert m.dtype == np.float32 and m.shape == disc.shape and 0 <= m.min() <= m.max() <= 1
    assert foreground[disc].mean() > 2 * foreground[radius > 40].mean() + 0.1
    assert boundary[np.abs(radius - 22) < 0.7].mean() > 0.5 and boundary[np.abs(radius - 22) > 6].max() < 0.01
    np.testing.assert_array_equal(confidence, np.maximum(foreground, 1 - foreground))
    wall = classical_semantics(np.full((40, 50, 3), 0.5, np.float32))
    assert all(np.isfinite(m).all() for m in wall) and not wall[1].any()
