"""Networks that turn an image into a map, run by onnxruntime from one ONNX file that the user names."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpgs.errors import DataError, UsageError
from warpgs.runtime.onnx_session import PROVIDERS, first_line, read_model, start_session

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


@dataclass(frozen=True)
class Network:
    """An opened model with one image as input and one map as output."""

    path: Path
    """File of the model."""
    sha256: str
    """SHA-256 of the file, hexadecimal."""
    session: InferenceSession
    """The onnxruntime session."""
    layout: str
    """Order of the input's axes: nchw or nhwc."""
    size: tuple[int, int] | None
    """Height and width [px] that the graph fixes; None where both are free."""
    type: type
    """Scalar type of the input."""

    @property
    def title(self) -> str:
        """File name and first digits of the hash, for reports."""
        return f"{self.path.name} (SHA-256 {self.sha256[:12]})"

    def run(self, image: np.ndarray) -> np.ndarray:
        """Return the output, float32 of any shape, for one prepared image [h, w, 3].

        Raises:
            DataError: onnxruntime cannot run the graph, or the output is NaN, infinite, or the same number everywhere.
        """
        batch = image[None] if self.layout == "nhwc" else image.transpose(2, 0, 1)[None]
        feed = {self.session.get_inputs()[0].name: np.ascontiguousarray(batch, dtype=self.type)}
        try:
            (output,) = self.session.run(None, feed)
        except Exception as e:  # onnxruntime's errors share no base but Exception
            shape = " x ".join(map(str, batch.shape))
            raise DataError(f"{self.path}: onnxruntime cannot run it on an input of {shape} ({first_line(e)}); see --help for "
                            "the flags that set its input") from e  # fmt: skip
        output = np.asarray(output)
        if output.dtype.kind != "f":
            raise DataError(f"{self.path}: its output is of type {output.dtype}, not scores; leave argmax out of the export")
        output = output.astype(np.float32)
        if not np.isfinite(output).all():
            raise DataError(f"{self.path}: its output holds NaN or infinity; check mean and standard deviation, or its weights")
        if output.size == 0 or not output.max() > output.min():
            raise DataError(f"{self.path}: its output is the same number everywhere; check the model's weights")
        return output


def _input_axes(path: Path, shape: list) -> tuple[str, tuple[int, int] | None]:
    """Return layout and fixed size (height, width) of an input shape; names and None stand for free axes."""
    dims = [d if isinstance(d, int) and d > 0 else None for d in shape]
    text = " x ".join(str(d) for d in shape)
    if len(dims) != 4 or dims[0] not in (1, None):
        raise DataError(f"{path}: its input is {text}; one image, 1 x 3 x height x width or 1 x height x width x 3, is needed")
    if dims[1] in (3, None) and (dims[1] == 3 or dims[3] != 3):
        layout, sides = "nchw", (dims[2], dims[3])
    elif dims[3] == 3:
        layout, sides = "nhwc", (dims[1], dims[2])
    else:
        raise DataError(f"{path}: neither the second nor the last axis of its input, {text}, has the 3 channels of an image")
    if (sides[0] is None) != (sides[1] is None):
        raise DataError(f"{path}: its input, {text}, fixes only one side of the image; export it with both fixed or both free")
    return layout, None if sides[0] is None else sides


def open_network(path: str | Path, *, provider: str = "cpu", threads: int = 0) -> Network:
    """Open an ONNX file and check that it maps one image to one output.

    Args:
        path: The file; its weights must be inside.
        provider: cpu or cuda.
        threads: CPU threads; 0 for as many as the process may use.

    Returns:
        The network.

    Raises:
        UsageError: The provider is neither cpu nor cuda.
        DataError: The file is missing or not an ONNX model, needs other files or custom operators, or does not map one image to
            one output.
        ResourceError: onnxruntime or the provider is missing.
    """
    if provider not in PROVIDERS:
        raise UsageError(f"onnx-provider {provider!r} is not one of {', '.join(PROVIDERS)}")
    path = Path(path)
    data = read_model(path)
    session = start_session(data, path, provider, threads)
    try:
        return _checked(path, data, session)
    except UnicodeDecodeError as e:
        raise DataError(f"{path}: the name of an input or an output is not UTF-8; export the network again") from e


def _checked(path: Path, data: bytes, session: Any) -> Network:
    """Return the network of a session that has one input and one output; DataError for others."""
    inputs, outputs = session.get_inputs(), session.get_outputs()
    for what, found in (("input", inputs), ("output", outputs)):
        names = ", ".join(f.name for f in found)  # read even if unused: names that are not UTF-8 fail here
        if len(found) != 1:
            raise DataError(f"{path}: it has {len(found)} {what}s ({names}); export it with only one")
    if inputs[0].type not in TYPES:
        raise DataError(f"{path}: its input is a {inputs[0].type}; float or float16 is needed")
    layout, size = _input_axes(path, inputs[0].shape)
    return Network(path, hashlib.sha256(data).hexdigest(), session, layout, size, TYPES[inputs[0].type])
