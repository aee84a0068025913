"""Sessions of onnxruntime for untrusted ONNX files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from warpgs.errors import DataError, ResourceError
from warpgs.input_files import read_input, unread_reason
from warpgs.runtime.onnx_file import check_onnx
from warpgs.runtime.processor import usable_cores

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}
ERRORS_ONLY = 3
MAX_MODEL_BYTES = 2**31
"""Largest model [bytes]: the largest message of protobuf."""


def read_model(path: Path) -> bytes:
    """Return the bytes of an ONNX file, checked to need no other files.

    Raises:
        DataError: The file cannot be read, is not an ONNX model, or needs other files or foreign operators.
    """
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
    """Return a session for the bytes of a checked ONNX file.

    Args:
        data: The file, from `read_model`.
        path: Its name, for messages.
        provider: cpu or cuda.
        threads: CPU threads; 0 for as many as the process may use.

    Raises:
        DataError: onnxruntime cannot load the model.
        ResourceError: onnxruntime or the provider is missing.
    """
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
