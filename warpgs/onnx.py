"""Networks as ONNX files: checked before they are loaded, run by ONNX Runtime."""

import contextlib
import hashlib
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from warpgs.device import usable_cores
from warpgs.errors import DataError, ResourceError, expect, explained
from warpgs.files import read_file

# Check of an ONNX file by its bytes, before onnxruntime loads it: nothing outside the file may be loaded.
#
# The wire format is protobuf; field numbers are those of onnx.proto (ONNX IR version 3 and later).

DOMAINS = ("", "ai.onnx", "ai.onnx.ml", "com.microsoft")
"""Operator sets that onnxruntime contains; any other needs a library of foreign code, or a function in the file."""
MAX_NESTING = 32
"""Largest depth of graphs within graphs (If, Loop, Scan), and of functions that call functions, that is accepted."""
MAX_NODES = 100_000
"""Largest number of nodes once functions are inlined, which onnxruntime does while it loads a file."""

PARTS: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "tensor": {},
}
"""Messages in the fields of each message, as far as they lead to tensors and nodes."""
MODEL_GRAPH, MODEL_OPSET, MODEL_FUNCTION = 7, 8, 25
FUNCTION_NAME, FUNCTION_DOMAIN, NODE_TYPE, NODE_DOMAIN = 1, 10, 4, 7
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
            expect(0 <= length <= len(data) - at, f"a field of wire type {wire} reaches beyond the data")
            value, at = data[at : at + length], at + length
        expect(0 < number <= MAX_FIELD, f"invalid field number {number}")
        fields.append((number, value))
    return fields


def _text(message: Message, number: int) -> str:
    """Return the text of a field, maybe empty; of duplicate fields the last one, as in protobuf."""
    texts = [v for n, v in message if n == number and isinstance(v, memoryview)]
    return bytes(texts[-1]).decode("utf-8", "replace") if texts else ""


def _walk(kind: str, message: Message, depth: int = 0) -> Iterator[tuple[str, Message]]:
    """Yield a message and all that it holds, as far as `PARTS` leads; ValueError where graphs are nested too deep."""
    expect(depth <= MAX_NESTING, f"graphs nested deeper than {MAX_NESTING}")
    yield kind, message
    for number, value in message:
        if (part := PARTS[kind].get(number)) and isinstance(value, memoryview):
            yield from _walk(part, _message(value), depth + (part == "graph"))


def check_onnx(data: bytes, path: Path) -> None:
    """Check that bytes are an ONNX model without external data and without custom operators."""
    with explained(f"{path}: not an ONNX model", "export it again, as with `torch.onnx.export`", (ValueError, IndexError)):
        model = _message(memoryview(data))
        graphs = sum(n == MODEL_GRAPH and isinstance(v, memoryview) for n, v in model)
        sound = graphs == 1 and any(n == MODEL_OPSET for n, _ in model)
        expect(sound, "it has several graphs, or names no operator set" if graphs else "it has no graph")
        # exporters store compositions of standard operators as functions in the file
        functions = [_message(v) for n, v in model if n == MODEL_FUNCTION and isinstance(v, memoryview)]
        own: dict[tuple[str, str], list[Message]] = {}
        for f in functions:
            nodes = own.setdefault((_text(f, FUNCTION_DOMAIN), _text(f, FUNCTION_NAME)), [])
            nodes += [part for kind, part in _walk("function", f) if kind == "node"]
        sizes: dict[tuple[str, str], int] = {}

        def size(part: Message, above: int = 0) -> int:
            """Return the number of nodes of which a node consists once its function is inlined."""
            operator = _text(part, NODE_DOMAIN), _text(part, NODE_TYPE)
            if operator not in sizes:
                expect(above <= MAX_NESTING, f"functions nested deeper than {MAX_NESTING}, or that call themselves")
                sizes[operator] = sum(size(inner, above + 1) for inner in own[operator]) if operator in own else 1
            return sizes[operator]

        count = 0
        for kind, part in _walk("model", model):
            count += size(part) if kind == "node" else 0
            expect(count <= MAX_NODES, f"more than {MAX_NODES:,} nodes once its functions are inlined")
            if kind == "tensor" and any(n == TENSOR_EXTERNAL or (n == TENSOR_LOCATION and v != 0) for n, v in part):
                raise DataError(f"{path}: its weights are in another file. Save one file: `onnx.save(onnx.load(FILE), OUT)`")
            if kind == "node" and (domain := _text(part, NODE_DOMAIN)) not in DOMAINS:
                if (operator := (domain, _text(part, NODE_TYPE))) not in own:
                    raise DataError(f"{path}: {'::'.join(operator)} is not part of ONNX; export with standard operators")


PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}
SILENT = 4
"""Severity of fatal errors alone: onnxruntime prints others raw, with the names in the file, before it raises them."""
MAX_MODEL_BYTES = 2**31
"""Largest model [bytes]: the largest message of protobuf."""


def read_model(path: Path) -> bytes:
    """Return the bytes of an ONNX file, checked to need no other files."""
    data = read_file(path, most=MAX_MODEL_BYTES, fix="give the path of an ONNX file", what="the model ")
    check_onnx(data, path)
    return data


def _first_line(error: Exception) -> str:
    """Return the first line of an error's message, at most 200 letters."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)[:200]


T = TypeVar("T")
PATIENCE = 5.0
"""Longest time [s] to wait for onnxruntime to end after a signal."""


def _interruptible(call: Callable[[], T], cancel: Callable[[], object]) -> T:
    """Return the result of a ``call`` of onnxruntime, which ``cancel`` ends at Ctrl-C or SIGTERM."""
    answers: queue.SimpleQueue[tuple[T] | Exception] = queue.SimpleQueue()

    def run() -> None:
        try:
            answers.put((call(),))
        except Exception as e:  # onnxruntime's errors share no base but Exception
            answers.put(e)

    try:
        # in a thread: the main one handles signals only while it runs Python; a Loop may be endless, and constants take long to
        # fold. A raw queue: after an interrupt, locks of concurrent.futures may stay locked
        # (docs/decisions/030-threads-of-a-launch.md)
        threading.Thread(target=run, daemon=True).start()
        answer = answers.get()
    except BaseException:
        cancel()
        with contextlib.suppress(queue.Empty):
            answers.get(timeout=PATIENCE)  # a run that is not ended would use the session while the process ends
        raise
    if isinstance(answer, Exception):
        raise answer
    return answer[0]


def start_session(data: bytes, path: Path, provider: str, threads: int) -> Any:
    """Return an `InferenceSession` for the bytes of a checked ONNX file."""
    import onnxruntime as ort

    there = [name for name, long in PROVIDERS.items() if long in ort.get_available_providers()]
    remedy = "`pip uninstall onnxruntime`, then `pip install onnxruntime-gpu[cuda,cudnn]`; or leave the flag out"
    if provider not in there:
        raise ResourceError(f"--onnx-provider {provider}: this onnxruntime has only {', '.join(there)}. {remedy}")
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads or usable_cores()
    options.inter_op_num_threads = 1
    options.log_severity_level = SILENT
    options.use_deterministic_compute = True
    try:
        # without onnxruntime's own second try on the CPU, which it prints
        session = _interruptible(
            lambda: ort.InferenceSession(data, options, providers=[PROVIDERS[provider]], enable_fallback=0),
            lambda: options.set_load_cancellation_flag(True),
        )
    except Exception as e:
        if provider != "cpu":
            start_session(data, path, "cpu", threads)  # DataError where the file is at fault
            raise ResourceError(f"--onnx-provider {provider}: onnxruntime cannot use it ({_first_line(e)}). {remedy}") from e
        raise DataError(f"{path}: onnxruntime cannot load it ({_first_line(e)}); export it again, with older operators") from e
    # onnxruntime continues without a provider if its libraries are missing
    if PROVIDERS[provider] not in session.get_providers():
        raise ResourceError(f"--onnx-provider {provider}: onnxruntime finds no {provider} libraries or device. {remedy}")
    return session


def fixed_size(path: Path, sides: Sequence[object]) -> tuple[int, int] | None:
    """Return height and width [px] that an input fixes, or None where both are free."""
    fixed = [side for side in sides if isinstance(side, int) and side > 0]
    if len(fixed) == 1:
        raise DataError(f"{path}: its input fixes only one side of the image; export it with both fixed or both free")
    return (fixed[0], fixed[1]) if fixed else None


class Model:
    """An opened ONNX file; ``inputs`` are name, type and shape of each input, ``outputs`` the names of the outputs."""

    def __init__(self, path: str | Path, provider: str = "cpu", threads: int = 0):
        self.path = Path(path)
        data = read_model(self.path)
        self.session, self.sha256 = start_session(data, self.path, provider, threads), hashlib.sha256(data).hexdigest()
        with explained(f"{path}: the name of an input or output is not UTF-8", "export it again", UnicodeDecodeError):
            self.inputs: list[tuple[str, str, list]] = [(i.name, i.type, i.shape) for i in self.session.get_inputs()]
            self.outputs: list[str] = [o.name for o in self.session.get_outputs()]

    @property
    def title(self) -> str:
        """File name and first digits of the hash, for reports."""
        return f"{self.path.name} (SHA-256 {self.sha256[:12]})"

    def outputs_of(self, *images: np.ndarray, names: Sequence[str] | None = None) -> list[np.ndarray]:
        """Return the outputs for batches of images, one for each input."""
        from onnxruntime import RunOptions

        feed = {name: np.ascontiguousarray(image) for (name, _, _), image in zip(self.inputs, images, strict=True)}
        options = RunOptions()
        refused = f"{self.path}: onnxruntime refuses an input of {' x '.join(map(str, images[0].shape))}"
        # onnxruntime's errors share no base but Exception
        with explained(refused, f"describe it in {self.path.name}.json", Exception):
            answer = _interruptible(lambda: self.session.run(names, feed, options), lambda: setattr(options, "terminate", True))
            return [np.asarray(output) for output in answer]
