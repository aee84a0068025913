"""Checkpoints: safetensors for numbers, JSON for the rest, replaced atomically and verified; never a pickle."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import torch

from warpgs.errors import DataError
from warpgs.files import write_bytes

TENSORS = "checkpoint.safetensors"
FORMAT = 1


def save_checkpoint(folder: Path, tensors: dict[str, torch.Tensor], state: dict) -> Path:
    """Write one checkpoint, replacing the last one only once the new one is complete on disk.

    ``state`` travels in the header of the same file, so tensors and state can never be of two different steps.

    Args:
        folder: The run folder.
        tensors: Any tensors; stored from the CPU.
        state: Whatever JSON can hold.

    Returns:
        The file's path.

    Raises:
        ResourceError: The disk is full or not writable; the last checkpoint is untouched.
    """
    from safetensors.torch import save

    path = folder / TENSORS
    on_cpu = {n: t.detach().cpu().contiguous().clone() for n, t in tensors.items()}
    data = save(on_cpu, metadata={"format": str(FORMAT), "state": json.dumps(state)})
    write_bytes(path, data, hashlib.sha256(data).digest())
    return path


def load_checkpoint(folder: Path) -> tuple[dict[str, torch.Tensor], dict]:
    """Read a checkpoint back.

    Returns:
        Tensors on the CPU, and the state.

    Raises:
        DataError: There is none, or it is not whole: truncated, altered, or of another format.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    path = folder / TENSORS
    if not path.is_file():
        raise DataError(f"{folder} holds no {TENSORS}: there is nothing to continue or to render from; run `warpgs fit` first")
    data = path.read_bytes()
    body, digest = data[:-32], data[-32:]
    if hashlib.sha256(body).digest() != digest:
        raise DataError(f"{path}: the checksum does not match, so the file was truncated or altered; fit again, or restore it")
    try:
        tensors = load(body)
        length = int.from_bytes(body[:8], "little")
        metadata = json.loads(body[8 : 8 + length])["__metadata__"]
    except (SafetensorError, KeyError, ValueError) as e:
        raise DataError(f"{path} is not a warpgs checkpoint ({e})") from e
    if metadata.get("format") != str(FORMAT):
        raise DataError(f"{path} has checkpoint format {metadata.get('format')}, this version reads {FORMAT}")
    return tensors, json.loads(metadata["state"])
