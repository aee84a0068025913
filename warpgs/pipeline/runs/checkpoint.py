"""Checkpoints: safetensors for numbers, JSON for the rest, replaced atomically and verified; never a pickle."""

from __future__ import annotations

import hashlib
import json
import math
import os
from pathlib import Path
from typing import Any

import torch

from warpgs import schema
from warpgs.errors import DataError, NotFiniteError
from warpgs.files import write_bytes
from warpgs.input_files import open_input, unread_reason
from warpgs.version import __version__

TENSORS = "checkpoint.safetensors"
FORMAT = 2
"""Version of the format of run folders: config.json and the checkpoint. warpgs 0.1.0 wrote version 1."""
DTYPES = {
    torch.float64: "F64",
    torch.float32: "F32",
    torch.int64: "I64",
    torch.int32: "I32",
    torch.uint8: "U8",
    torch.bool: "BOOL",
}
"""Names of scalar types in the format."""


def safetensors_chunks(tensors: dict[str, torch.Tensor], metadata: dict[str, str]) -> list[memoryview | bytes]:
    """Return a safetensors file in pieces; pieces of CPU tensors share their memory, so nothing is copied."""
    ordered = sorted(tensors.items(), key=lambda item: (-item[1].element_size(), item[0]))  # aligned for every reader
    parts = [t.detach().cpu().contiguous().reshape(-1).view(torch.uint8) for _, t in ordered]
    header: dict[str, Any] = {"__metadata__": metadata}
    end = 0
    for (name, t), part in zip(ordered, parts):
        begin, end = end, end + len(part)
        header[name] = {"dtype": DTYPES[t.dtype], "shape": list(t.shape), "data_offsets": [begin, end]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return [len(text).to_bytes(8, "little"), text, *(p.numpy().data for p in parts)]


def save_checkpoint(folder: Path, tensors: dict[str, torch.Tensor], state: dict[str, Any]) -> Path:
    """Write a checkpoint; the previous checkpoint is replaced only when the new one is complete on disk.

    ``state`` is stored in the header of the same file, so tensors and state always belong to the same step.

    Args:
        folder: The run folder.
        tensors: Of the types in `DTYPES`, on any device.
        state: Values that JSON can hold.

    Returns:
        The file's path.

    Raises:
        NotFiniteError: A tensor holds a NaN or an infinity; the previous checkpoint is untouched.
        ResourceError: The disk is full or not writable; the previous checkpoint is untouched.
    """
    path = folder / TENSORS
    for name, t in tensors.items():
        # minimum and maximum suffice, without a copy: torch returns NaN if any value is NaN
        if t.is_floating_point() and t.numel() and not all(math.isfinite(float(v)) for v in t.aminmax()):
            raise NotFiniteError(
                f"{path} was not written: {name} holds non-finite values; results after the last checkpoint are invalid. "
                "--resume would repeat the same steps; fit again into a new --out with lower learning rates"
            )
    metadata = {"format": str(FORMAT), "version": __version__, "state": json.dumps(state)}
    chunks = safetensors_chunks(tensors, metadata)
    digest = hashlib.sha256()
    for chunk in chunks:
        digest.update(chunk)
    write_bytes(path, *chunks, digest.digest())
    return path


def load_checkpoint(folder: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Read a checkpoint back.

    Returns:
        Tensors by name on the CPU, shapes [...] as they were saved, and the state.

    Raises:
        DataError: The checkpoint is missing, truncated, altered, or of another format.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    path = folder / TENSORS
    try:
        with open_input(path, folder) as file:
            body = file.read(max(0, os.fstat(file.fileno()).st_size - 32))
            digest = file.read(33)
    except FileNotFoundError as e:
        raise DataError(f"{folder} holds no {TENSORS}: no checkpoint yet; run `warpgs fit` first") from e
    except OSError as e:
        raise DataError(f"{path}: cannot be read ({unread_reason(e)}); restore the file, or fit again") from e
    if hashlib.sha256(body).digest() != digest:
        raise DataError(f"{path}: the checksum does not match: the file was truncated or altered; restore it, or fit again")
    try:
        tensors = load(body)
        length = int.from_bytes(body[:8], "little")
        metadata = json.loads(body[8 : 8 + length])["__metadata__"] or {}
    except (SafetensorError, KeyError, ValueError) as e:
        raise DataError(f"{path} is not a warpgs checkpoint ({e})") from e
    if metadata.get("format") != str(FORMAT):
        version = metadata.get("version", "0.1.0")
        raise DataError(
            f"{path}: warpgs {version} wrote this checkpoint, in a format that warpgs {__version__} does not read. Open it "
            f"with warpgs {version}, or fit the scene again into a new --out"
        )
    try:
        state = schema.parse(metadata["state"])
        schema.mapping(schema.anything)(state, "")
    except (KeyError, schema.SchemaError) as e:
        raise DataError(f"{path}: the stored state is incomplete or damaged ({e}); restore the file, or fit again") from e
    return tensors, state
