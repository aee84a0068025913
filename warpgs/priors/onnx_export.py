"""Conversion of torch networks to the bytes of ONNX files."""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warpgs.errors import ResourceError
from warpgs.suggestion import install_extras
from warpgs.temporary import temporary_folder

if TYPE_CHECKING:
    import torch

REMEDY = install_extras("export")


@contextlib.contextmanager
def folder_for_files() -> Iterator[Path]:
    """Give a folder that is removed at the end of the block.

    Raises:
        ResourceError: The files in it cannot be written.
    """
    try:
        with temporary_folder() as folder:
            yield folder.path
    except OSError as e:
        raise ResourceError(
            f"temporary files cannot be written ({e.strerror or e}); free some disk space, or set TMPDIR (TEMP on Windows) to "
            "another folder"
        ) from e


def onnx_bytes(
    network: torch.nn.Module, image: torch.Tensor, outputs: Sequence[str], sizes: dict[int, Any] | None = None
) -> bytes:
    """Return the bytes of an ONNX file for a network that takes one image.

    Args:
        network: The network, ready for inference.
        image: An input, shape [1, 3, h, w].
        outputs: Names of the network's outputs.
        sizes: Sizes that axes of the image may have, by axis; None if only the sizes of ``image`` are allowed.

    Raises:
        ResourceError: A package is missing, or temporary files cannot be written.
    """
    import torch

    try:
        import onnxscript  # noqa: F401
    except ImportError as e:
        raise ResourceError(f"onnxscript, which writes ONNX for torch, is not installed; {REMEDY}") from e
    exporter = logging.getLogger("torch.onnx")
    before = exporter.level
    exporter.setLevel(logging.ERROR)
    try:
        with folder_for_files() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            path = folder / "network.onnx"
            torch.onnx.export(
                network, (image,), path, input_names=["image"], output_names=list(outputs),
                dynamic_shapes=None if sizes is None else (sizes,), dynamo=True, external_data=False, verbose=False,
            )  # fmt: skip
            return path.read_bytes()
    finally:
        exporter.setLevel(before)
