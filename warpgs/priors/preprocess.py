"""Input and output of a network, described by flags, by a JSON file beside the model, or assumed with a note."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from warpgs import schema
from warpgs.errors import DataError, UsageError
from warpgs.input_files import unread_reason
from warpgs.priors.session import Network

IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
"""Mean and standard deviation of ImageNet's colours, which torchvision's and Depth Anything's networks expect."""
HALF = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
"""Mean and standard deviation for colours in [-1, 1], which DPT (Ranftl et al. 2021) expects."""


@dataclass(frozen=True)
class Preprocessing:
    """Size and colours of a network's input, and the meaning of its output."""

    size: int
    """Shorter side [px] of the input, unless the graph fixes the size."""
    multiple: int
    """Both sides are multiples of this [px], unless the graph fixes the size."""
    mean: tuple[float, float, float]
    """Colour subtracted from colours in [0, 1], red first."""
    std: tuple[float, float, float]
    """Divisor of the colours after ``mean`` is subtracted, red first."""
    output: str
    """Meaning of the output: disparity, depth or classes."""

    def prepare(self, network: Network, image: np.ndarray) -> np.ndarray:
        """Return the input, float32, shape [h, w, 3], for an image [H, W, 3] in [0, 1]; both have the same field of view."""
        height, width = network.size or self.free_size(*image.shape[:2])
        return (resize(image, height, width) - np.float32(self.mean)) / np.float32(self.std)

    def free_size(self, height: int, width: int) -> tuple[int, int]:
        """Return an input size (height, width) [px] with the proportions of an image, rounded to `multiple`."""
        scale = self.size / min(height, width)
        h, w = (max(1, round(scale * side / self.multiple)) * self.multiple for side in (height, width))
        return h, w


def resize(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return an image [H, W] or [H, W, C] at another size, float32, pixel centres aligned at +0.5.

    If neither side grows, pixels are averaged over areas, so that fine texture does not alias; else they are interpolated
    linearly.
    """
    import cv2

    shrinks = height <= image.shape[0] and width <= image.shape[1]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    if image.ndim == 2:
        return cv2.resize(np.ascontiguousarray(image, np.float32), (width, height), interpolation=method)
    # OpenCV averages over areas in at most four channels at a time
    parts = [np.ascontiguousarray(image[..., i : i + 4], np.float32) for i in range(0, image.shape[2], 4)]
    return np.dstack([cv2.resize(p, (width, height), interpolation=method) for p in parts])


def _numbers(value: object) -> bool:
    real = isinstance(value, (list, tuple)) and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in value)
    return real and len(value) == 3 and all(abs(v) < 1e6 for v in value)


def _whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= 16384


KEYS: dict[str, tuple[str, Callable[[object], bool]]] = {
    "size": ("a whole number of pixels", _whole),
    "multiple": ("a whole number of pixels", _whole),
    "mean": ("three numbers", _numbers),
    "std": ("three numbers above 0", lambda v: _numbers(v) and all(x > 0 for x in v)),
    "output": ("disparity, depth or classes", lambda v: v in ("disparity", "depth", "classes")),
}


def check_value(key: str, value: object, where: str, error: type[Exception] = UsageError) -> None:
    """Check that a value may describe a network's input or output.

    Raises:
        UsageError: The value is invalid; ``error`` instead, if given.
    """
    wanted, good = KEYS[key]
    if not good(value):
        raise error(f"{where}: {key} must be {wanted}, not {value!r}")


def side_file(model: Path) -> Path:
    """Return the path of the JSON file that describes a model: its name with .json appended."""
    return model.with_name(model.name + ".json")


def read_side_file(model: Path) -> dict:
    """Return the entries of the JSON file beside a model; none without such a file.

    Raises:
        DataError: The file is not a JSON object, or has an unknown key or value.
    """
    path = side_file(model)
    if not os.path.lexists(path):
        return {}
    try:
        values = schema.read(path)
    except (OSError, schema.SchemaError) as e:
        why = unread_reason(e) if isinstance(e, OSError) else e
        raise DataError(f"{path}: cannot be read ({why}); fix or remove it") from e
    if not isinstance(values, dict):
        raise DataError(f"{path}: holds no JSON object; write one with the keys {', '.join(KEYS)}")
    for key, value in values.items():
        if key not in KEYS:
            raise DataError(f"{path}: the key {key!r} is unknown; {', '.join(KEYS)} are supported")
        check_value(key, value, str(path), DataError)
    return values


def describe(network: Network, flags: dict, defaults: Preprocessing, flag: str) -> tuple[Preprocessing, list[str]]:
    """Return the description of a network: flags override the file beside the model, and the file overrides the defaults.

    Args:
        network: The opened model.
        flags: Values of flags by field name; None or 0 where a flag was not given.
        defaults: Values for everything that neither the flags nor the file give.
        flag: Prefix of the flags' names, for notes.

    Returns:
        The description, and notes on values that were assumed.

    Raises:
        DataError: The file beside the model is invalid.
        UsageError: A size was requested that the graph does not allow.
    """
    given = {k: v for k, v in flags.items() if v}
    values = read_side_file(network.path) | given
    if network.size and given.get("size", min(network.size)) != min(network.size):
        height, width = network.size
        raise UsageError(f"--{flag}-size {given['size']}: {network.path} takes {width} x {height} px only; leave the flag out")
    needed = ["mean", "std"] + ([] if network.size else ["size", "multiple"]) + (["output"] if flag == "depth" else [])
    assumed = [k for k in needed if k not in values]
    values = asdict(defaults) | values
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    notes = []
    if assumed:
        assumed_text = ", ".join(
            f"{k} {' '.join(map(str, v)) if isinstance(v, tuple) else v}" for k, v in values.items() if k in assumed
        )
        notes.append(
            f"{network.path.name}: assumed {assumed_text}; change it with --{flag}-... or {side_file(network.path).name}"
        )
    return Preprocessing(**values), notes
