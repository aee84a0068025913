"""LPIPS, the distance of two images in the features of a classifier (Zhang et al. 2018), from weights the user names."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from warpgs.pipeline.metrics.lpips_weights import Net, read_lpips

MODES = ("legacy", "standard")
"""legacy: colours are passed unchanged, in [0, 1], as the evaluation code of Kerbl et al. 2023 and its descendants do;
standard: rescaled to [-1, 1], as Zhang et al. 2018 trained the heads. The same images score differently."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""ImageNet's mean and deviation of colours in [-1, 1] (PerceptualSimilarity, scaling layer)."""
NORM_FLOOR = 1e-10
"""Added to the length of a feature vector before dividing by it (PerceptualSimilarity, normalize_tensor)."""


@dataclass(frozen=True)
class Lpips:
    """A network with its heads, ready to measure."""

    net: Net
    tensors: dict[str, torch.Tensor]
    version: str
    """Version of the heads: 0.0, 0.1, or unknown."""
    sha256: str
    """SHA-256 of the file that the weights came from, hexadecimal."""

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
                head = self.tensors[f"lin{i}.model.1.weight"].view(-1, 1, 1)
                total += float(((x[0] - x[1]).square() * head).sum(0).mean())
        return total

    def measure(self, image: np.ndarray, target: np.ndarray) -> dict[str, float]:
        """Return the distance of two images [H, W, 3] in [0, 1] in every mode, by the names of `variants`."""
        return {f"lpips_{self.net.name}_{mode}": self.distance(image, target, mode) for mode in MODES}

    def variants(self) -> dict[str, str]:
        """Return the definition of each score, for result files and reports."""
        base = f"{self.net.title}, heads {self.version}, weights SHA-256 {self.sha256[:12]}, inputs in "
        inputs = {"legacy": "[0, 1] (un-rescaled, as in the code of 3D Gaussian splatting)", "standard": "[-1, 1]"}
        return {f"lpips_{self.net.name}_{mode}": base + inputs[mode] for mode in MODES}


def load_lpips(path: Path, device: torch.device) -> Lpips:
    """Load LPIPS with the weights of a file that `warpgs convert-lpips` wrote.

    Raises:
        DataError: The file is missing, damaged, or of another kind.
    """
    net, tensors, header = read_lpips(path)
    return Lpips(net, {n: t.to(device) for n, t in tensors.items()}, header.get("version", "unknown"), header["sha256"])
