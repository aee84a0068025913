"""LPIPS, and the weights that it needs."""

import hashlib
import math
import os
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
import torch.nn.functional as F

from warpgs.errors import DataError, UsageError, expect, explained
from warpgs.files import open_input, read_tensors, remove_leftovers, tensor_pieces, write_bytes

FORMAT = "warpgs-lpips-1"
TAP = ("tap",)
"""A layer whose features are compared."""


@dataclass(frozen=True)
class Net:
    """The convolutional layers of a classifier, with the numbers of torchvision (`features.N`)."""

    name: str
    """vgg or alex."""
    title: str
    """Name as papers write it."""
    layers: tuple[tuple[Any, ...], ...]
    """Layers in order: ("conv", number, inputs, outputs, kernel, stride, padding), ("pool", kernel, stride), or ("tap",) after
    a rectified convolution whose features are compared."""
    smallest: int
    """Shortest image side for which the last compared layer has at least a pixel [px]."""
    published: str
    """First digits of the SHA-256 of torchvision's file, as in the name of that file."""

    @property
    def channels(self) -> tuple[int, ...]:
        """Channels of the five compared layers."""
        return tuple(layer[3] for layer, after in zip(self.layers, self.layers[1:]) if after == TAP)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the names of all tensors of a converted file with their shapes."""
        shapes: dict[str, tuple[int, ...]] = {}
        for _, number, inputs, outputs, kernel, _, _ in (layer for layer in self.layers if layer[0] == "conv"):
            shapes[f"features.{number}.weight"] = (outputs, inputs, kernel, kernel)
            shapes[f"features.{number}.bias"] = (outputs,)
        return shapes | {f"lin{i}.model.1.weight": (1, c, 1, 1) for i, c in enumerate(self.channels)}


def _conv(number: int, inputs: int, outputs: int, kernel: int = 3, stride: int = 1, padding: int = 1) -> tuple[Any, ...]:
    return ("conv", number, inputs, outputs, kernel, stride, padding)


NETS = {
    # Simonyan and Zisserman 2015, network D; compared after the last rectification of each block
    "vgg": Net(
        "vgg", "VGG16",
        (
            _conv(0, 3, 64), _conv(2, 64, 64), TAP, ("pool", 2, 2),
            _conv(5, 64, 128), _conv(7, 128, 128), TAP, ("pool", 2, 2),
            _conv(10, 128, 256), _conv(12, 256, 256), _conv(14, 256, 256), TAP, ("pool", 2, 2),
            _conv(17, 256, 512), _conv(19, 512, 512), _conv(21, 512, 512), TAP, ("pool", 2, 2),
            _conv(24, 512, 512), _conv(26, 512, 512), _conv(28, 512, 512), TAP,
        ),
        16, "397923af",
    ),
    # Krizhevsky 2014, one tower; compared after every rectification
    "alex": Net(
        "alex", "AlexNet",
        (
            _conv(0, 3, 64, 11, 4, 2), TAP, ("pool", 3, 2), _conv(3, 64, 192, 5, 1, 2), TAP, ("pool", 3, 2),
            _conv(6, 192, 384), TAP, _conv(8, 384, 256), TAP, _conv(10, 256, 256), TAP,
        ),
        31, "7be5be79",
    ),
}  # fmt: skip
"""Zhang et al. 2018, section 3; layer numbers of torchvision's vgg16 and alexnet."""

HEADS = {
    "b9e4236260c3dd988fc79d2a48d645d885afcbb21f9fd595e6744cf7419b582c": "0.0",
    "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868": "0.1",
    "18720f55913d0af89042f13faa7e536a6ce1444a0914e6db9461355ece1e8cd5": "0.0",
    "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0": "0.1",
}
"""SHA-256 of the heads vgg.pth and alex.pth that github.com/richzhang/PerceptualSimilarity publishes, and their version."""


def _read_state(path: Path) -> tuple[dict[str, torch.Tensor], str]:
    """Return the tensors of a .pth file by name, and the file's SHA-256."""
    # torch, pickle and zipfile raise a dozen types on malformed files
    fix = "download it again, and give a .pth file with a state dict"
    with explained(f"{path}: cannot be read as a torch state dict", fix, Exception), open_input(path) as file:
        _check_unpacked(file)
        # weights_only: tensors and plain containers, nothing that could run
        state = torch.load(file, map_location="cpu", weights_only=True)
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if not isinstance(state, dict):
        raise DataError(f"{path}: holds a {type(state).__name__}, not a state dict of named tensors; save only the weights")
    return state, digest


def _check_unpacked(file: BinaryIO) -> None:
    """Check that an archive unpacks to no more than its own size, since torch does not compress."""
    if zipfile.is_zipfile(file):
        with zipfile.ZipFile(file) as archive:
            unpacked = sum(member.file_size for member in archive.infolist())
        expect(unpacked <= file.seek(0, os.SEEK_END), f"it unpacks to {unpacked:,} bytes, more than its size")
    file.seek(0)


def _net_of(heads: dict[str, torch.Tensor], path: Path) -> Net:
    shapes = {k: tuple(v.shape) for k, v in heads.items() if isinstance(v, torch.Tensor)}
    for net in NETS.values():
        if shapes == {k: v for k, v in net.shapes().items() if k.startswith("lin")}:
            return net
    raise DataError(f"{path}: heads of an unsupported network; give PerceptualSimilarity's vgg.pth or alex.pth")


def convert_lpips(backbone: Path, heads: Path, out: Path) -> list[str]:
    """Join a torchvision backbone and LPIPS heads into a file without pickles; returns lines on the file and its sources."""
    if os.path.exists(out):
        raise UsageError(f"{out} exists already; choose another --out")
    head_state, head_hash = _read_state(heads)
    net = _net_of(head_state, heads)
    state, backbone_hash = _read_state(backbone)
    tensors = {}
    for name, shape in net.shapes().items():
        source, path = (head_state, heads) if name.startswith("lin") else (state, backbone)
        value = source.get(name)
        if not isinstance(value, torch.Tensor) or tuple(value.shape) != shape:
            fault = f"is {list(value.shape)}" if isinstance(value, torch.Tensor) else "is missing"
            raise DataError(f"{path}: {name} {fault}, expected {list(shape)}; give torchvision's weights of {net.title}")
        if not bool(torch.isfinite(value).all()):
            raise DataError(f"{path}: {name} is not finite; download it again from its source")
        tensors[name] = value.float().contiguous()
    version = HEADS.get(head_hash, "unknown")
    metadata = {
        "format": FORMAT, "net": net.name, "version": version, "backbone_sha256": backbone_hash, "heads_sha256": head_hash,
    }  # fmt: skip
    remove_leftovers(out.parent)
    write_bytes(out, *tensor_pieces(tensors, metadata))
    notes = [f"{out}: LPIPS with {net.title}, heads of version {version}"]
    if not backbone_hash.startswith(net.published):
        notes.append(f"{backbone} is not torchvision's published file (SHA-256 {net.published}...); scores are not comparable")
    if version == "unknown":
        notes.append(f"{heads} is neither v0.0 nor v0.1 of the published heads; scores are not comparable")
    return notes


def read_lpips(path: Path) -> tuple[Net, dict[str, torch.Tensor], dict[str, str]]:
    """Read a converted file: the network, its tensors by name (float32, CPU), and the header with the file's SHA-256."""
    fix = "write the file again with `warpgs convert-lpips`"
    tensors, metadata, data = read_tensors(path, "`warpgs convert-lpips` writes one", fix)
    with explained(f"{path}: holds no LPIPS weights", fix, ValueError):
        expect(metadata.get("format") == FORMAT and metadata.get("net") in NETS, "it names no format and network")
        net = NETS[metadata["net"]]
        for name, shape in net.shapes().items():
            expect(name in tensors and tuple(tensors[name].shape) == shape, f"no {name} of shape {list(shape)}")
            finite = tensors[name].dtype == torch.float32 and torch.isfinite(tensors[name]).all()
            expect(finite, f"{name} is not finite float32")
    return net, tensors, {**metadata, "sha256": hashlib.sha256(data).hexdigest()}


# LPIPS, the distance of two images in the features of a classifier (Zhang et al. 2018), from weights the user names.

MODES = ("legacy", "standard")
"""legacy: colours are passed unchanged, in [0, 1], as the evaluation code of Kerbl et al. 2023 and its descendants do;
standard: rescaled to [-1, 1], as Zhang et al. 2018 trained the heads. The same images score differently."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""ImageNet's mean and deviation of colours in [-1, 1] (PerceptualSimilarity, scaling layer)."""
NORM_FLOOR = 1e-10
"""Added to the length of a feature vector before dividing by it (PerceptualSimilarity, normalize_tensor)."""


class Lpips:
    """A network with its heads, ready to measure."""

    def __init__(self, path: Path, device: torch.device):
        """Load the weights of a file that `warpgs convert-lpips` wrote."""
        self.net, tensors, self.header = read_lpips(path)
        self.tensors = {n: t.to(device) for n, t in tensors.items()}

    def _features(self, images: torch.Tensor) -> Iterator[torch.Tensor]:
        """Yield the compared activations of images [2, 3, H, W], each of unit length along its channels."""
        x = images
        for layer in self.net.layers:
            if layer[0] == "conv":
                name = f"features.{layer[1]}"
                x = F.conv2d(x, self.tensors[f"{name}.weight"], self.tensors[f"{name}.bias"], layer[5], layer[6]).relu_()
            elif layer[0] == "pool":
                x = F.max_pool2d(x, layer[1], layer[2])
            else:
                yield x / (x.square().sum(1, keepdim=True).sqrt() + NORM_FLOOR)

    @torch.no_grad()
    def distance(self, image: np.ndarray, target: np.ndarray, mode: str) -> float:
        """Return LPIPS of two images [H, W, 3] in [0, 1]: 0 for equal images; NaN if they are too small for the network."""
        if min(image.shape[:2]) < self.net.smallest:
            return math.nan
        device = self.tensors["lin0.model.1.weight"].device
        pair = torch.from_numpy(np.stack([image, target])).float().to(device).permute(0, 3, 1, 2)
        if mode == "standard":
            pair = 2 * pair - 1
        shift, scale = (pair.new_tensor(v).view(1, 3, 1, 1) for v in (SHIFT, SCALE))
        total = 0.0
        # a metric must not depend on the device: torch's default lets CUDA round convolutions to 10 bits of mantissa
        with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False):
            for i, x in enumerate(self._features((pair - shift) / scale)):
                total += float(((x[0] - x[1]).square() * self.tensors[f"lin{i}.model.1.weight"].view(-1, 1, 1)).sum(0).mean())
        return total

    def measure(self, image: np.ndarray, target: np.ndarray) -> dict[str, float]:
        """Return the distance of two images [H, W, 3] in [0, 1] in every mode, by the names of `variants`."""
        return {f"lpips_{self.net.name}_{mode}": self.distance(image, target, mode) for mode in MODES}

    def variants(self) -> dict[str, str]:
        """Return the definition of each score, for result files and reports."""
        version, digest = self.header.get("version", "unknown"), self.header["sha256"][:12]
        base = f"{self.net.title}, heads {version}, weights SHA-256 {digest}, inputs in "
        inputs = {"legacy": "[0, 1] (un-rescaled, as in the code of 3D Gaussian splatting)", "standard": "[-1, 1]"}
        return {f"lpips_{self.net.name}_{mode}": base + inputs[mode] for mode in MODES}
