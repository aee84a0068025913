"""CUDA text: the bodies of native functions, which are files in the folder ``cuda`` of the kernels."""

import importlib.resources
import re

FOLDER = importlib.resources.files("warpgs") / "kernels" / "cuda"
"""Folder of the files."""


def source(name: str, **numbers: object) -> str:
    """Return the CUDA text of a file, with names in capitals replaced by numbers.

    A line ``#include "other.cu"`` is replaced by the text of that file of the folder.

    Args:
        name: Name of the file in the folder; an absolute path names a file elsewhere.
        numbers: Number, or any other text, that replaces each name.
    """
    text = re.sub(r'^#include "([\w.]+)"\n', lambda found: source(found[1]), (FOLDER / name).read_text("utf-8"), flags=re.M)
    for word, number in numbers.items():
        text = re.sub(rf"\b{word}\b", str(number), text)
    return text
