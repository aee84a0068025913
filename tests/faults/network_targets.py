"""Networks, their weights and the maps that they made, for the fuzzer: what runs, and what is kept on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from tests.faults.format_targets import zip_member
from tests.faults.model_targets import SMALL, onnx_field, tensors_body, tensors_header
from tests.faults.mutations import rarely, zip_bomb
from tests.faults.targets import Target, register
from tests.priors import networks as nw
from warpgs import onnx
from warpgs.pipeline.metrics import lpips
from warpgs.poses import matching
from warpgs.priors import flow, networks
from warpgs.scene import Camera, View

# ---- weights of LPIPS as others publish them ---------------------------------------------------------------------------


def state_files(root: Path) -> list[Path]:
    lpips.NETS["small"] = SMALL  # the real ones have millions of weights
    for name in ("heads", "backbone"):
        state = {n: torch.ones(s) for n, s in SMALL.shapes().items() if n.startswith("lin") == (name == "heads")}
        torch.save(state, root / f"{name}.pth")
    return [root / "backbone.pth", root / "heads.pth"]


def converted(root: Path, path: Path) -> object:
    (root / "out.safetensors").unlink(missing_ok=True)
    lpips.convert_lpips(root / "backbone.pth", root / "heads.pth", root / "out.safetensors")
    return lpips.read_lpips(root / "out.safetensors")


STATES = (lpips._read_state, lpips._net_of, lpips.convert_lpips)
register(Target("LPIPS state dict", state_files, converted, STATES, (zip_member, rarely(zip_bomb, zip_member)), lines=0.8))

# ---- maps on disk ------------------------------------------------------------------------------------------------------

IMAGE = np.random.default_rng(0).random((6, 9, 3), np.float32)
NAMES = ("a", "b")


def map_files(root: Path) -> list[Path]:
    maps = tuple(np.full((6, 9), v, np.float32) for v in (0.25, 1.0))
    networks.MapCache(root).maps(IMAGE, NAMES, {"model": "x"}, lambda: maps)
    return list(root.glob("*.safetensors"))


def maps_of(root: Path, path: Path) -> tuple[np.ndarray, ...] | None:
    store = networks.MapCache(root)
    found = store._read(path, NAMES, IMAGE.shape[:2])
    assert found is not None or not path.exists() or str(path) in store.notes[0]
    return found


def map_nonsense(found: tuple[np.ndarray, ...]) -> str:
    return "" if all(m.shape == (6, 9) and m.min() >= 0 and m.max() <= 1 for m in found) else "a map is none"


register(
    Target(
        "stored maps", map_files, maps_of, (networks.MapCache._read,), (tensors_header, tensors_body), nonsense=map_nonsense
    )
)  # fmt: skip

# ---- networks in onnxruntime -------------------------------------------------------------------------------------------


def network_files(root: Path) -> list[Path]:
    for layout in ("nchw", "nhwc"):
        (root / f"{layout}.onnx").write_bytes(nw.linear(np.eye(3), np.zeros(3), layout=layout))
    return sorted(root.glob("*.onnx"))


NETWORK = (networks.Network.__init__, onnx.Model.__init__, onnx.start_session, onnx.read_model)
register(
    Target(
        "network", network_files, lambda root, path: networks.Network(path, threads=1), NETWORK,
        (onnx_field, onnx_field, onnx_field), lines=0.7, share=0.3,
    )
)  # fmt: skip


def matcher_files(root: Path) -> list[Path]:
    (root / "matcher.onnx").write_bytes(nw.matcher(np.array([[3.0, 4.0]]), np.ones(1), np.array([[0.6, 0.8]])))
    return [root / "matcher.onnx"]


def matched(root: Path, path: Path) -> matching.Features:
    return matching.Matcher(path, threads=1).features(np.zeros((8, 8, 3), np.uint8))


def matcher_nonsense(found: matching.Features) -> str:
    pixels, descriptors = found
    inside = (pixels >= 0) & (pixels <= 8)
    return "" if inside.all() and len(pixels) == len(descriptors) else "a keypoint is none"


register(
    Target(
        "matcher", matcher_files, matched, (matching.Matcher.__init__, matching.Matcher.features, matching.Matcher._check),
        (onnx_field, onnx_field, onnx_field), nonsense=matcher_nonsense, lines=0.6, share=0.2,
    )
)  # fmt: skip


def flow_networks(root: Path) -> list[Path]:
    """Write a network of flow for images of one size, one for any size, and one whose output is no flow."""
    for name, (size, count) in {"fixed": ((8, 8), 2), "any": (("h", "w"), 2), "image": ((8, 8), 3)}.items():
        nodes = [nw.node("Sub", ["a", "b"], ["x"]), nw.node("Conv", ["x", "W"], ["y"])]
        tensors = [nw.tensor("W", np.ones((count, 3, 1, 1)))]
        images = [nw.value(n, (1, 3, *size)) for n in "ab"]
        (root / f"{name}.onnx").write_bytes(nw.model(nw.graph(nodes, tensors, images, [nw.value("y", (1, count, *size))])))
    return sorted(root.glob("*.onnx"))


def flow_by_network(root: Path, path: Path) -> np.ndarray:
    camera = Camera(np.eye(4), np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), 9, 6)
    return flow._network(path)(View("a", camera, IMAGE), View("b", camera, 1 - IMAGE))


def flow_nonsense(found: np.ndarray) -> str:
    return "" if found.shape == (6, 9, 2) and found.dtype == np.float32 else "no flow"


register(
    Target(
        "flow network", flow_networks, flow_by_network, (flow._network,), (onnx_field, onnx_field, onnx_field),
        nonsense=flow_nonsense, share=0.3,
    )
)  # fmt: skip
