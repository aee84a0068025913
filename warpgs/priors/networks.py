"""Networks of the priors: input, session, cache of results, and monocular depth."""

import contextlib
import hashlib
import json
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from warpgs import schema
from warpgs.errors import DataError, ResourceError, expect, explained
from warpgs.files import read_input, write_bytes
from warpgs.folders import cache_home, private_folder
from warpgs.onnx import Model, fixed_size
from warpgs.process import say

T = TypeVar("T")


_OPENCV, _entered = threading.Lock(), list[int]()
"""Lock and entries of `single_threaded_opencv` by all threads: OpenCV's threads before the first, then 1 for each."""


@contextlib.contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """Keep OpenCV from starting threads in this process; our own threads call OpenCV in parallel."""
    # Starting threads takes longer than many calls, and the rounding of some depends on their number: with one,
    # distanceTransform uses IPP's code (see `without_ipp`), and the fast global smoother cuts an image into fewer stripes.
    import cv2

    with _OPENCV:
        if not _entered:
            _entered.append(cv2.getNumThreads())
            cv2.setNumThreads(1)
        _entered.append(1)
    try:
        yield
    finally:
        with _OPENCV:
            _entered.pop()
            if len(_entered) == 1:
                cv2.setNumThreads(_entered.pop())


def in_threads(function: Callable[..., T], *items: Iterable[Any], most: int = 1 << 16) -> list[T]:
    """Return the results of a function for each item, in their order, by as many threads as torch uses, or at ``most`` that."""
    with single_threaded_opencv(), ThreadPoolExecutor(min(most, torch.get_num_threads())) as pool:
        return list(pool.map(function, *items))


def without_ipp() -> None:
    """Turn IPP off for the calling thread: its instructions, and so their rounding, depend on the processor."""
    import cv2

    cv2.ipp.setUseIPP(False)


TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class Network(Model):
    """An opened network with one image as input and one map as output.

    ``layout`` is nchw or nhwc; ``size`` are height and width [px] that the graph fixes, None where both are free.
    """

    def __init__(self, path: str | Path, provider: str = "cpu", threads: int = 0):
        super().__init__(path, provider, threads)
        with explained(f"{path}: not a network of one image", "export it with one input and one output", ValueError):
            for what, names in (("input", [name for name, _, _ in self.inputs]), ("output", self.outputs)):
                expect(len(names) == 1, f"it has {len(names)} {what}s ({', '.join(names)})")
            ((_, kind, shape),) = self.inputs
            expect(kind in TYPES, f"its input is a {kind}; float or float16 is needed")
            dims, text = [d if isinstance(d, int) and d > 0 else None for d in shape], " x ".join(map(str, shape))
            image = len(dims) == 4 and dims[0] in (1, None)
            expect(image, f"its input is {text}, not 1 x 3 x height x width or 1 x height x width x 3")
            self.layout = "nchw" if dims[1] == 3 or (dims[1] is None and dims[3] != 3) else "nhwc"
            colors = self.layout == "nchw" or dims[3] == 3
            expect(colors, f"neither the second nor the last axis of its input, {text}, has the 3 channels of images")
        self.type = TYPES[kind]
        self.size = fixed_size(self.path, dims[2:] if self.layout == "nchw" else dims[1:3])

    def run(self, image: np.ndarray) -> np.ndarray:
        """Return the output, float32 of any shape, for one prepared image [h, w, 3]."""
        (output,) = self.outputs_of((image if self.layout == "nhwc" else image.transpose(2, 0, 1))[None].astype(self.type))
        fix = "check its weights, mean and standard deviation, and leave argmax out of the export"
        with explained(f"{self.path}: its output is unusable", fix, ValueError):
            expect(output.dtype.kind == "f", f"it is of type {output.dtype}, not scores")
            expect(np.isfinite(output := output.astype(np.float32)).all(), "it holds NaN or infinity")
            expect(output.size and output.max() > output.min(), "it is the same number everywhere")
        return output


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
    """Return an image [H, W] or [H, W, C] at another size, float32, pixel centres aligned at +0.5."""
    import cv2

    method = cv2.INTER_AREA if height <= image.shape[0] and width <= image.shape[1] else cv2.INTER_LINEAR
    if image.ndim == 2:
        return cv2.resize(np.ascontiguousarray(image, np.float32), (width, height), interpolation=method)
    # OpenCV averages over areas in at most four channels at a time
    parts = [np.ascontiguousarray(image[..., i : i + 4], np.float32) for i in range(0, image.shape[2], 4)]
    return np.dstack([cv2.resize(p, (width, height), interpolation=method) for p in parts])


KEYS: dict[str, schema.Schema] = {
    "size": schema.whole(1, 16384), "multiple": schema.whole(1, 16384), "mean": schema.items(schema.number(), 3),
    "std": schema.items(schema.number(above=0), 3), "output": schema.one_of("disparity", "depth", "classes"),
}  # fmt: skip
_DESCRIPTION = schema.fields({}, KEYS, others=False)


def side_file(model: Path) -> Path:
    """Return the path of the JSON file that describes a model: its name with .json appended."""
    return model.with_name(model.name + ".json")


def read_side_file(model: Path) -> dict:
    """Return the entries of the JSON file beside a model; none without such a file."""
    path, fix = side_file(model), f"fix it, with keys out of {', '.join(KEYS)}, or remove it"
    if not os.path.lexists(path):
        return {}
    with explained(f"{path}: cannot be read", fix, (OSError, schema.SchemaError)):
        return schema.read(path, rule=_DESCRIPTION)


def describe(network: Network, defaults: Preprocessing, kind: str) -> tuple[Preprocessing, list[str]]:
    """Return a network's description (the file beside a depth or segmentation model, over the defaults), and assumptions."""
    given = read_side_file(network.path)
    side = side_file(network.path).name
    if network.size and given.get("size", min(network.size)) != min(network.size):
        height, width = network.size
        raise DataError(f"{side}: size {given['size']}, but {network.path} takes {width} x {height} px only; leave size out")
    needed = ["mean", "std"] + ([] if network.size else ["size", "multiple"]) + (["output"] if kind == "depth" else [])
    assumed = [k for k in needed if k not in given]
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in (asdict(defaults) | given).items()}
    words = [f"{k} {' '.join(map(str, v)) if isinstance(v, tuple) else v}" for k, v in values.items() if k in assumed]
    notes = [f"{network.path.name}: assumed {', '.join(words)}; to change them, write {side}"] if assumed else []
    return Preprocessing(**values), notes


Arrays = tuple[np.ndarray, ...]
CODE = 1
"""Version of the code between image and maps; increased whenever the same inputs would produce other maps."""


def cache_folder() -> Path:
    """Return the cache folder: WARPGS_CACHE if set, else warpgs in the system's folder for caches."""
    if own := os.environ.get("WARPGS_CACHE"):
        asked = Path(os.path.expanduser(own))  # as a shell does, but not within quotes
        if own.startswith("~") and not asked.is_absolute():
            raise ResourceError(f"WARPGS_CACHE: the home folder of {own} is unknown; give an absolute path")
        return asked
    if (home := cache_home()) is None:
        say("warpgs: no home folder: maps are kept for this run only; set WARPGS_CACHE to a folder", error=True)
        return private_folder() / "maps"
    return home / "warpgs" / "Cache" if sys.platform == "win32" else home / "warpgs"


class MapCache:
    """A folder of maps; ``notes`` report damaged entries, which are computed again, and a folder that cannot be written."""

    def __init__(self, folder: Path):
        self.folder, self.notes = folder, list[str]()

    def maps(self, image: np.ndarray, names: tuple[str, ...], decided_by: dict, make: Callable[[], Arrays]) -> Arrays:
        """Return one map per name, float32 [H, W], of an image [H, W, 3], read from disk or computed by ``make``."""
        path = self._path(image, names, decided_by)
        if (maps := self._read(path, names, image.shape[:2])) is None:
            maps = make()
            self._write(path, names, maps)
        return maps

    def _path(self, image: np.ndarray, names: tuple[str, ...], decided_by: dict) -> Path:
        words = {"code": CODE, "names": names, "shape": image.shape, "type": str(image.dtype), **decided_by}
        key = hashlib.sha256(json.dumps(words, sort_keys=True).encode())
        key.update(np.ascontiguousarray(image).data)
        return self.folder / f"{key.hexdigest()}.safetensors"

    def _read(self, path: Path, names: tuple[str, ...], shape: tuple[int, int]) -> Arrays | None:
        import safetensors
        from safetensors.numpy import load

        try:
            stored = load(read_input(path))
            maps = tuple(stored[n] for n in names)
            sound = (m.dtype == np.float32 and m.shape == shape and ((m >= 0) & (m <= 1)).all() for m in maps)
            expect(all(sound), "it is damaged")
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError, KeyError, safetensors.SafetensorError) as e:
            self.notes.append(f"{path}: a stored map could not be read ({e}) and was computed again")
            return None
        return maps

    def _write(self, path: Path, names: tuple[str, ...], maps: Arrays) -> None:
        from safetensors.numpy import save

        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, save({n: np.ascontiguousarray(m) for n, m in zip(names, maps)}))
        except (OSError, ResourceError) as e:
            if not any(n.startswith("maps are not cached") for n in self.notes):
                self.notes.append(f"maps are not cached ({e}); set WARPGS_CACHE to another folder")


DEFAULTS = Preprocessing(384, 32, *HALF, output="disparity")
"""Input and output of DPT (Ranftl et al. 2021), the paper's network."""
CLIP = (0.5, 99.5)
"""Percentiles to which consistent inverse depths are clipped: one wrong match must not decide the range of the map."""
COLOR_SIGMA = 8.0
"""Colour difference [1/255] at which the smoother's weight between neighbours falls to 1/e."""
REACHES = ((10.0, 1.0), (100.0, 1e-3), (1000.0, 1e-6))
"""Pairs of a length [px], over which consistent depths spread within a surface of uniform colour, and a weight. A long length
matters only where no consistent depth is near."""
MAX_ERROR_RATIO = 1e3
"""Largest ratio of an error to the median error; larger ratios are clipped, so no weight is below a millionth."""
MEAN_WEIGHT = 1e-9
"""Weight of the mean of all consistent depths, for pixels that edges separate from all of them."""


def unit_range(values: np.ndarray) -> np.ndarray:
    """Return values scaled to [0, 1] by their minimum and maximum, float32; 0 everywhere if both are equal."""
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return np.zeros(values.shape, np.float32)
    return ((values.astype(np.float64) - low) / (high - low)).astype(np.float32)


def network_disparity(network: Network, preprocessing: Preprocessing, image: np.ndarray) -> np.ndarray:
    """Return the relative inverse depth of an image [H, W, 3] by a network, in [0, 1], float32 [H, W]."""
    output = network.run(preprocessing.prepare(network, image))
    shape = output.shape
    if len(shape) == 4:
        output = output[:, 0] if shape[1] == 1 else output[..., 0] if shape[3] == 1 else output
    if output.ndim == 3 and shape[0] == 1:
        output = output[0]
    if output.ndim != 2:
        raise DataError(f"{network.path}: its output has the shape {shape}, not that of one depth map; is it a depth network?")
    if preprocessing.output == "depth":
        if not output.min() > 0:
            raise DataError(f'{network.path}: has depths of 0; for disparity, write {{"output": "disparity"}} into its JSON')
        output = 1 / output
    return unit_range(resize(output, *image.shape[:2]))


def complete_disparity(image: np.ndarray, depth: np.ndarray, valid: np.ndarray, sensitivity: np.ndarray) -> np.ndarray:
    """Fill the gaps of a depth map [u] in inverse depth, not across colour edges; return [H, W] in [0, 1]."""
    # The ratio of smoothed w / z and smoothed w, by the fast global smoother (Min et al. 2014), which the image guides. The
    # weight w is small where 1 / z changes much when the match shifts by one pixel.
    import cv2

    valid = valid & (depth > 0) & np.isfinite(depth)
    inverse = 1 / depth[valid].astype(np.float64)
    inverse = np.clip(inverse, *np.percentile(inverse, CLIP))
    low, high = inverse.min(), inverse.max()
    if not high > low:
        return np.zeros(depth.shape, np.float32)
    error = sensitivity[valid] * inverse**2  # |d(1/z)/dpx|
    known = error[np.isfinite(error)]
    scale = max(float(np.median(known)) if len(known) else 0.0, 1e-6 * high)
    ratio = np.minimum(np.where(np.isfinite(error), error, np.inf) / scale, MAX_ERROR_RATIO)
    values, weight = np.zeros((2, *depth.shape), np.float32)
    values[valid], weight[valid] = (inverse - low) / (high - low), 1 / (1 + ratio**2)
    guide = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    received = np.full(depth.shape, MEAN_WEIGHT)
    total = received * np.average(values, weights=weight)
    with single_threaded_opencv():
        for reach, fraction in REACHES:
            # in one dimension the smoother's response falls as exp(-x / sqrt(lambda))
            smoother = cv2.ximgproc.createFastGlobalSmootherFilter(guide, reach**2, COLOR_SIGMA)
            total += fraction * smoother.filter(weight * values)
            received += fraction * smoother.filter(weight)
    return unit_range(total / received)
