"""Networks as ONNX files: checked before they are loaded, run by ONNX Runtime."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from warpgs.device import usable_cores
from warpgs.errors import DataError, ResourceError
from warpgs.files import read_input, unread_reason

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


# Check of an ONNX file by its bytes, before onnxruntime loads it: nothing outside the file may be loaded.
#
# The wire format is protobuf; field numbers are those of onnx.proto (ONNX IR version 3 and later).

DOMAINS = ("", "ai.onnx", "ai.onnx.ml", "com.microsoft")
"""Operator sets that onnxruntime contains; any other needs a library of foreign code, or a function in the file."""
MAX_NESTING = 32
"""Largest depth of graphs within graphs (If, Loop, Scan) that is accepted."""

MODEL_GRAPH, MODEL_OPSET, MODEL_TRAINING, MODEL_FUNCTION = 7, 8, 20, 25
TRAINING_GRAPHS = (1, 2)
GRAPH_NODE, GRAPH_INITIALIZER, GRAPH_SPARSE = 1, 5, 15
FUNCTION_NAME, FUNCTION_NODE, FUNCTION_DOMAIN, FUNCTION_ATTRIBUTE = 1, 7, 10, 11
NODE_TYPE, NODE_ATTRIBUTE, NODE_DOMAIN = 4, 5, 7
ATTRIBUTE_TENSORS, ATTRIBUTE_GRAPHS, ATTRIBUTE_SPARSE = (5, 10), (6, 11), (22, 23)
SPARSE_TENSORS = (1, 2)
TENSOR_NAME, TENSOR_EXTERNAL, TENSOR_LOCATION = 8, 13, 14
MAX_FIELD = 2**29 - 1
"""Largest field number of protobuf; its parser drops the higher bits, so that a larger number would stand for another field."""

Message = list[tuple[int, "int | memoryview"]]


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 64:
        byte = data[at]
        value |= (byte & 127) << shift
        at += 1
        if byte < 128:
            return value, at
        shift += 7
    raise ValueError("a number of more than 64 bits")


def _message(data: memoryview) -> Message:
    """Return field numbers and values, integers or bytes; ValueError or IndexError if the data is not protobuf."""
    fields, at = [], 0
    while at < len(data):
        key, at = _varint(data, at)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value, at = _varint(data, at)
        else:
            length, at = _varint(data, at) if wire == 2 else ({1: 8, 5: 4}.get(wire, -1), at)
            if not 0 <= length <= len(data) - at:
                raise ValueError(f"a field of wire type {wire} reaches beyond the data")
            value, at = data[at : at + length], at + length
        if not 0 < number <= MAX_FIELD:
            raise ValueError(f"invalid field number {number}")
        fields.append((number, value))
    return fields


def _parts(message: Message, *numbers: int) -> Iterator[Message]:
    return (_message(v) for n, v in message if n in numbers and isinstance(v, memoryview))


def _text(message: Message, number: int) -> str:
    """Return the text of a field, maybe empty; of duplicate fields the last one, as in protobuf."""
    texts = [v for n, v in message if n == number and isinstance(v, memoryview)]
    return bytes(texts[-1]).decode("utf-8", "replace") if texts else ""


class _Walk:
    """A walk through every node and tensor of a model; it rejects models that need other files or foreign code."""

    def __init__(self, path: Path, own: set[tuple[str, str]]):
        self.path, self.own = path, own

    def tensor(self, tensor: Message) -> None:
        if any(n == TENSOR_EXTERNAL or (n == TENSOR_LOCATION and v != 0) for n, v in tensor):
            raise DataError(
                f"{self.path}: the weights of {_text(tensor, TENSOR_NAME) or 'a constant'!r} are in another file, which is "
                f"not read. Save the model as one file: `onnx.save(onnx.load(FILE), OUT)`, or export it without external data"
            )

    def node(self, node: Message, depth: int) -> None:
        domain, kind = _text(node, NODE_DOMAIN), _text(node, NODE_TYPE)
        if domain not in DOMAINS and (domain, kind) not in self.own:
            raise DataError(
                f"{self.path}: the operator {domain}::{kind} is not part of ONNX and would need foreign code to run. "
                "Export the model with standard operators"
            )
        self.attributes(node, NODE_ATTRIBUTE, depth)

    def attributes(self, message: Message, number: int, depth: int) -> None:
        for attribute in _parts(message, number):
            for tensor in _parts(attribute, *ATTRIBUTE_TENSORS):
                self.tensor(tensor)
            for sparse in _parts(attribute, *ATTRIBUTE_SPARSE):
                self.sparse(sparse)
            for graph in _parts(attribute, *ATTRIBUTE_GRAPHS):
                self.graph(graph, depth + 1)

    def function(self, function: Message) -> None:
        self.attributes(function, FUNCTION_ATTRIBUTE, 0)
        for node in _parts(function, FUNCTION_NODE):
            self.node(node, 0)

    def sparse(self, sparse: Message) -> None:
        for tensor in _parts(sparse, *SPARSE_TENSORS):
            self.tensor(tensor)

    def graph(self, graph: Message, depth: int = 0) -> None:
        if depth > MAX_NESTING:
            raise ValueError(f"graphs nested deeper than {MAX_NESTING}")
        for tensor in _parts(graph, GRAPH_INITIALIZER):
            self.tensor(tensor)
        for sparse in _parts(graph, GRAPH_SPARSE):
            self.sparse(sparse)
        for node in _parts(graph, GRAPH_NODE):
            self.node(node, depth)


def check_onnx(data: bytes, path: Path) -> None:
    """Check that bytes are an ONNX model without external data and without custom operators."""
    try:
        model = _message(memoryview(data))
        graphs, functions = list(_parts(model, MODEL_GRAPH)), list(_parts(model, MODEL_FUNCTION))
        if len(graphs) != 1 or not any(n == MODEL_OPSET for n, _ in model):
            raise ValueError("it has no graph" if not graphs else "it has several graphs, or names no operator set")
        # exporters store compositions of standard operators as functions in the file
        walk = _Walk(path, {(_text(f, FUNCTION_DOMAIN), _text(f, FUNCTION_NAME)) for f in functions})
        walk.graph(graphs[0])
        for function in functions:
            walk.function(function)
        for training in _parts(model, MODEL_TRAINING):
            for graph in _parts(training, *TRAINING_GRAPHS):
                walk.graph(graph)
    except (ValueError, IndexError) as e:
        raise DataError(f"{path}: not an ONNX model ({e}); give a file written by `torch.onnx.export` or a similar tool") from e


PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}
ERRORS_ONLY = 3
MAX_MODEL_BYTES = 2**31
"""Largest model [bytes]: the largest message of protobuf."""


def read_model(path: Path) -> bytes:
    """Return the bytes of an ONNX file, checked to need no other files."""
    try:
        data = read_input(path, MAX_MODEL_BYTES)
    except OSError as e:
        raise DataError(f"{path}: the model cannot be read ({unread_reason(e)}); give the path of an ONNX file") from e
    check_onnx(data, path)
    return data


def first_line(error: Exception) -> str:
    """Return the first line of an error's message, at most 200 letters."""
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__


def start_session(data: bytes, path: Path, provider: str, threads: int) -> InferenceSession:
    """Return a session for the bytes of a checked ONNX file."""
    try:
        import onnxruntime as ort
    except ImportError as e:
        raise ResourceError(f"{path}: onnxruntime is needed, and cannot be imported ({e}); `pip install onnxruntime`") from e
    there = [name for name, long in PROVIDERS.items() if long in ort.get_available_providers()]
    remedy = "`pip uninstall onnxruntime`, then `pip install onnxruntime-gpu[cuda,cudnn]`; or leave the flag out"
    if provider not in there:
        raise ResourceError(
            f"--onnx-provider {provider}: this onnxruntime {ort.__version__} has only {', '.join(there)}. {remedy}"
        )
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads or usable_cores()
    options.inter_op_num_threads = 1
    options.log_severity_level = ERRORS_ONLY
    options.use_deterministic_compute = True
    try:
        # without onnxruntime's own second try on the CPU, which it prints
        session = ort.InferenceSession(data, options, providers=[PROVIDERS[provider]], enable_fallback=0)
    except Exception as e:
        if provider != "cpu":
            start_session(data, path, "cpu", threads)  # DataError where the file is at fault
            raise ResourceError(f"--onnx-provider {provider}: onnxruntime cannot use it ({first_line(e)}). {remedy}") from e
        raise DataError(f"{path}: onnxruntime {ort.__version__} cannot load it ({first_line(e)}); export it again, perhaps "
                        "with an older operator set") from e  # fmt: skip
    # onnxruntime continues without a provider if its libraries are missing
    if PROVIDERS[provider] not in session.get_providers():
        raise ResourceError(f"--onnx-provider {provider}: onnxruntime finds no {provider} libraries or device. {remedy}")
    return session
