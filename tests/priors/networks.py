"""Tiny ONNX files with known answers, written byte by byte (field numbers of onnx.proto): nothing else need be installed."""

from pathlib import Path

import numpy as np

CLASSES = 21


def varint(n: int) -> bytes:
    out = bytearray()
    while n >= 128:
        out.append(n & 127 | 128)
        n >>= 7
    return bytes([*out, n])


def field(number: int, value: int | str | bytes) -> bytes:
    """Return one protobuf field: a whole number, or bytes with their length."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


def tensor(name: str, values: np.ndarray) -> bytes:
    dims = b"".join(field(1, n) for n in values.shape)
    return dims + field(2, 1) + field(8, name) + field(9, values.astype("<f4").tobytes())


def external_tensor(name: str, shape: tuple[int, ...], location: str) -> bytes:
    entry = field(1, "location") + field(2, location)
    return b"".join(field(1, n) for n in shape) + field(2, 1) + field(8, name) + field(13, entry) + field(14, 1)


def value(name: str, shape: tuple, kind: int = 1) -> bytes:
    dims = b"".join(field(1, field(1, d) if isinstance(d, int) else field(2, d)) for d in shape)
    return field(1, name) + field(2, field(1, field(1, kind) + field(2, dims)))


def node(kind: str, inputs: list[str], outputs: list[str], domain: str = "", attributes: bytes = b"") -> bytes:
    names = b"".join(field(1, n) for n in inputs) + b"".join(field(2, n) for n in outputs)
    return names + field(4, kind) + attributes + (field(7, domain) if domain else b"")


def whole_attribute(name: str, number: int) -> bytes:
    return field(5, field(1, name) + field(3, number) + field(20, 2))


def graph(nodes: list[bytes], tensors: list[bytes], inputs: list[bytes], outputs: list[bytes]) -> bytes:
    parts = {1: nodes, 2: ["g"], 5: tensors, 11: inputs, 12: outputs}
    return b"".join(field(number, value) for number, values in parts.items() for value in values)


def model(body: bytes, more: bytes = b"") -> bytes:
    return field(1, 8) + field(7, body) + field(8, field(1, "") + field(2, 17)) + more


def linear(
    weights: np.ndarray,
    bias: np.ndarray,
    *,
    size: tuple = ("h", "w"),
    layout: str = "nchw",
    then: str = "",
    inputs: int = 1,
    outputs: int = 1,
    kind: int = 1,
) -> bytes:
    """Return a network whose C outputs at a pixel are ``weights [C, 3] @ x + bias [C]``, then one more operator."""
    count = len(weights)
    if layout == "nchw":
        shapes, first = ((1, 3, *size), (1, count, *size)), node("Conv", ["x", "W", "b"], ["y"])
        tensors = [tensor("W", weights.reshape(count, 3, 1, 1)), tensor("b", bias)]
        nodes, axis = [first], 1
    else:
        shapes, axis = ((1, *size, 3), (1, *size, count)), 3
        tensors = [tensor("W", weights.T), tensor("b", bias)]
        nodes = [node("MatMul", ["x", "W"], ["xW"]), node("Add", ["xW", "b"], ["y"])]
    if then:
        nodes.append(node(then, ["y"], ["z"], attributes=whole_attribute("axis", axis) if then == "Softmax" else b""))
    last = "z" if then else "y"
    nodes += [node("Neg", [last], [f"more{i}"]) for i in range(1, outputs)]
    # an input that nothing reads is still an input
    ins = [value("x", shapes[0], kind)] + [value(f"in{i}", shapes[0]) for i in range(1, inputs)]
    outs = [value(last, shapes[1])] + [value(f"more{i}", shapes[1]) for i in range(1, outputs)]
    return model(graph(nodes, tensors, ins, outs))


def matcher(
    keypoints: np.ndarray, scores: np.ndarray, descriptors: np.ndarray, size: tuple = ("h", "w"), named: str = "scores"
) -> bytes:
    """Return a network that finds the same keypoints in every image; ``named`` is the name of its second output."""
    found = {"keypoints": keypoints, named: scores, "descriptors": descriptors}
    nodes = [node("Identity", [f"the_{n}"], [n]) for n in found]
    outs = [value(n, a.shape) for n, a in found.items()]
    return model(graph(nodes, [tensor(f"the_{n}", a) for n, a in found.items()], [value("image", (1, 3, *size))], outs))


def write(path: Path, data: bytes) -> str:
    path.write_bytes(data)
    return str(path)


DEPTH_WEIGHTS, DEPTH_BIAS = np.array([[0.7, 0.2, 0.4]]), np.array([3.0])


def depth_network(path: Path, **options) -> str:
    """Write a network that gives 0.7 r + 0.2 g + 0.4 b + 3 of its input."""
    return write(path, linear(DEPTH_WEIGHTS, DEPTH_BIAS, **options))


def segmentation_weights() -> tuple[np.ndarray, np.ndarray]:
    """Return weights for background on dark, class 3 on red, class 15 on blue; other classes are unlikely."""
    weights, bias = np.zeros((CLASSES, 3)), np.full(CLASSES, -6.0)
    bias[[0, 3, 15]] = 2.0, 0.0, 0.0
    weights[3, 0] = weights[15, 2] = 5.0
    return weights, bias


def segmentation_network(path: Path, **options) -> str:
    return write(path, linear(*segmentation_weights(), **options))
