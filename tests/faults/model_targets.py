"""Files of models and run folders for the fuzzer: Gaussians, networks, weights, flow, checkpoints and their records."""

from __future__ import annotations

import hashlib
import json
import struct
from pathlib import Path

import numpy as np
import torch

from tests.faults.mutations import Change, damage, json_value, number, text_line, text_number
from tests.faults.targets import Target, not_finite, register, writing
from tests.gaussians import cloud
from tests.io import scenes
from tests.priors import networks as nw
from warpgs import files, onnx
from warpgs.export import ply
from warpgs.export.base import read_gaussians
from warpgs.files import write_json
from warpgs.io.load import Split, load_scene
from warpgs.pipeline.metrics import lpips
from warpgs.pipeline.model import table
from warpgs.pipeline.run import folder
from warpgs.pipeline.run.request import SceneRequest
from warpgs.pipeline.train.presets import PRESETS
from warpgs.priors import flow, networks
from warpgs.scene import Gaussians, Normalization


def nonsense(g: Gaussians) -> str:
    return not_finite(**{n: t.numpy() for n, t in g.tensors().items()})


# ---- PLY -------------------------------------------------------------------------------------------------------------


def ply_header(change: Change) -> Change:
    """Return the change of a PLY file's header alone."""

    def changed(data: bytes, rng: np.random.Generator) -> bytes:
        head, end, body = data.partition(b"end_header\n")
        return change(head, rng) + end + body

    return changed


def ply_body(data: bytes, rng: np.random.Generator) -> bytes:
    head, end, body = data.partition(b"end_header\n")
    return head + end + number(body, rng)


def ply_files(root: Path) -> list[Path]:
    ply.write_ply(root / "a.ply", cloud(3), Normalization())
    text = (root / "a.ply").read_bytes()
    more = b"element face 2\nproperty uchar material\nelement vertex"
    before = text.replace(b"element vertex", more, 1).replace(b"end_header\n", b"end_header\n\1\2", 1)
    (root / "b.ply").write_bytes(
        before.replace(b"\nend_header", b"\nelement tail 1\nproperty list uchar int x\nend_header") + bytes(1)
    )
    head, _, body = text.partition(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(3, -1).tolist()
    lines = "".join(" ".join(map(repr, row)) + "\n" for row in rows)
    (root / "c.ply").write_bytes(head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + lines.encode())
    # as nerfstudio exports colours, and a rotation of zero length
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property")]
    kinds = [(n, "u1" if "f_dc" in n else "<f4") for n in names]
    table = np.array(
        [tuple(0 if "f_dc" in n or ("rot" in n and not i) else v for n, v in zip(names, row)) for i, row in enumerate(rows)],
        kinds,
    )
    for i, color in enumerate((b"red", b"green", b"blue")):
        head = head.replace(b"float f_dc_%d" % i, b"uchar " + color)
    (root / "d.ply").write_bytes(head + b"end_header\n" + table.tobytes())
    return [root / f"{name}.ply" for name in "abcd"]


PLY = (ply._plain, files.ply_header, ply.declared, ply._locate_vertices, ply._check_properties)
PLY_CHANGES = (ply_header(text_number), ply_header(text_line), ply_body, ply_body)
register(Target("ply", ply_files, lambda root, path: read_gaussians(path), PLY, PLY_CHANGES, nonsense=nonsense))

# ---- safetensors -----------------------------------------------------------------------------------------------------


def tensors_header(data: bytes, rng: np.random.Generator) -> bytes:
    """Change the JSON header of a safetensors file; its length stays right."""
    length = int.from_bytes(data[:8], "little")
    head, body = data[8 : 8 + length], data[8 + length :]
    try:
        header = json.loads(head)
        inner = header.get("__metadata__")
    except (ValueError, AttributeError):
        return data
    if isinstance(inner, dict) and inner and rng.random() < 0.7:
        key = sorted(inner)[int(rng.integers(len(inner)))]
        value = str(inner[key]).encode()
        change = (json_value, text_number, damage)[int(rng.integers(3))]
        header["__metadata__"] = inner | {key: change(value, rng).decode("utf-8", "replace")}
        head = json.dumps(header).encode()
    else:
        head = json_value(head, rng)
    head += b" " * (-len(head) % 8)
    return struct.pack("<Q", len(head)) + head + body


def in_order(data: bytes) -> bytes:
    """Return a safetensors file with its header in alphabetical order, which the library leaves to chance."""
    length = int.from_bytes(data[:8], "little")
    head = json.dumps(json.loads(data[8 : 8 + length]), sort_keys=True).encode()
    head += b" " * (-len(head) % 8)
    return struct.pack("<Q", len(head)) + head + data[8 + length :]


def tensors_body(data: bytes, rng: np.random.Generator) -> bytes:
    start = 8 + int.from_bytes(data[:8], "little")
    return data[:start] + number(data[start:], rng)


def with_digest(data: bytes) -> bytes:
    return data[:-32] + hashlib.sha256(data[:-32]).digest()


def within_digest(change: Change) -> Change:
    return lambda data, rng: with_digest(change(data[:-32], rng) + bytes(32))


def model_files(root: Path) -> list[Path]:
    path = root / "m.safetensors"
    table.save(path, cloud(3), Normalization(np.array([1.0, 2, 3]), 0.5))
    path.write_bytes(in_order(path.read_bytes()))
    return [path]


register(
    Target(
        "model file", model_files, lambda root, path: table.load(path).scene_gaussians, (table.load,),
        (tensors_header, tensors_body), nonsense=nonsense,
    )
)  # fmt: skip


def checkpoints(root: Path) -> list[Path]:
    state = {"step": 7, "random": [1, 2, 3], "rates": {"means": 0.1}}
    return [folder.save_checkpoint(root, {f"params.{n}": t for n, t in cloud(3).tensors().items()}, state)]


def checkpoint_nonsense(loaded: tuple) -> str:
    sound = isinstance(loaded[1], dict) and all(isinstance(t, torch.Tensor) for t in loaded[0].values())
    return "" if sound else "the state is no table"


CHECKPOINT_CHANGES = tuple(within_digest(c) for c in (tensors_header, tensors_header, tensors_body, damage))
register(
    Target(
        "checkpoint", checkpoints, lambda root, path: folder.load_checkpoint(root), (folder.load_checkpoint,),
        CHECKPOINT_CHANGES, with_digest, checkpoint_nonsense,
    )
)  # fmt: skip

SMALL = lpips.Net("small", "a small network", (("conv", 0, 3, 4, 3, 1, 1), lpips.TAP), 3, "")


def lpips_files(root: Path) -> list[Path]:
    from safetensors.torch import save

    lpips.NETS["small"] = SMALL  # the real ones have millions of weights
    tensors = {n: torch.ones(s) for n, s in SMALL.shapes().items()}
    metadata = {"format": lpips.FORMAT, "net": "small", "version": "0.1", "backbone_sha256": "1", "heads_sha256": "2"}
    (root / "w.safetensors").write_bytes(in_order(save(tensors, metadata)))
    return [root / "w.safetensors"]


def lpips_nonsense(loaded: tuple) -> str:
    net, tensors, header = loaded
    if any(tuple(tensors[n].shape) != s for n, s in net.shapes().items()) or not isinstance(header["sha256"], str):
        return "a tensor has another shape"
    return not_finite(**{n: tensors[n].float().numpy() for n in net.shapes()})


register(
    Target(
        "LPIPS weights", lpips_files, lambda root, path: lpips.read_lpips(path), (lpips.read_lpips,),
        (tensors_header, tensors_body), nonsense=lpips_nonsense,
    )
)  # fmt: skip

# ---- networks and flow -----------------------------------------------------------------------------------------------


def onnx_files(root: Path) -> list[Path]:
    relu = nw.node("Relu", ["x"], ["y"])
    x, y = nw.value("x", (1, 3, 8, 8)), nw.value("y", (1, 3, 8, 8))
    inner = nw.graph([relu], [nw.tensor("k", np.ones(2))], [], [y])
    value = nw.field(1, "value") + nw.field(5, nw.tensor("v", np.ones(2))) + nw.field(6, inner)
    value += nw.field(22, nw.field(1, nw.tensor("s", np.ones(1))))
    own = nw.field(1, "Own") + nw.field(10, "own") + nw.field(7, relu) + nw.field(11, value)
    nodes = [nw.node("Own", ["x"], ["y"], "own"), nw.node("If", ["x"], ["y"], attributes=nw.field(5, value))]
    graph = nw.graph(nodes, [], [x], [y]) + nw.field(15, nw.field(1, nw.tensor("s", np.ones(1))))
    whole = nw.model(graph, nw.field(25, own) + nw.field(20, nw.field(1, inner)))
    files = {"a": whole, "b": nw.linear(np.eye(3), np.zeros(3)), "c": nw.linear(np.eye(3), np.zeros(3), layout="nhwc")}
    foreign = nw.graph([nw.node("Run", ["x"], ["y"], "evil")], [nw.external_tensor("k", (1,), "w")], [x], [y])
    return writing({f"{name}.onnx": data for name, data in (files | {"d": nw.model(foreign)}).items()})(root)


def onnx_field(data: bytes, rng: np.random.Generator) -> bytes:
    try:
        fields = onnx._message(memoryview(data))
    except (ValueError, IndexError):
        return data
    if not fields:
        return data
    i, kind = int(rng.integers(len(fields))), int(rng.integers(8))
    value = fields[i][1]
    values = [value]
    if isinstance(value, int):
        values = [(int(rng.integers(4)), value + 1, 2**32 + 1)[int(rng.integers(3))]] if kind < 4 else [value]
    elif kind < 5:
        values = [onnx_field(bytes(value), rng)]
    elif kind == 5:
        values = [number(bytes(value), rng)]
    elif kind == 6:
        values = [value, value]
    else:
        values = []
    out = b""
    for j, (n, v) in enumerate(fields):
        for part in values if j == i else [v]:
            out += nw.field(n, part if isinstance(part, int) else bytes(part))
    return out


def check_onnx(root: Path, path: Path) -> bytes:
    data = path.read_bytes() if path.is_file() else b""
    onnx.check_onnx(data, path)
    return data


PARTS = (onnx.check_onnx, onnx._walk, onnx._message, onnx._varint, onnx._text)
register(Target("onnx", onnx_files, check_onnx, PARTS, (onnx_field, onnx_field, onnx_field)))


FLOW = np.random.default_rng(0).normal(size=(5, 4, 2)).astype("<f4").tobytes()
FLO = {"a.flo": flow.FLO_MAGIC.tobytes() + struct.pack("<ii", 4, 5) + FLOW}


register(
    Target(
        "flow", writing(FLO), lambda root, path: flow.read_flo(path), (flow.read_flo,),
        (lambda data, rng: data[:12] + number(data[12:], rng),),
        nonsense=lambda f: "" if f.ndim == 3 and f.dtype == np.float32 and not np.isinf(f).any() else "no flow",
    )
)  # fmt: skip
SIDE = {"size": 518, "multiple": 14, "mean": [0.5, 0.4, 0.3], "std": [0.2, 0.2, 0.2], "output": "depth"}

register(
    Target(
        "description of a network", writing({"m.onnx.json": json.dumps(SIDE).encode()}),
        lambda root, path: networks.read_side_file(root / "m.onnx"), (networks.read_side_file,),
        (json_value, json_value, text_number),
        nonsense=lambda values: "" if isinstance(values, dict) and set(values) <= set(networks.KEYS) else "no description",
    )
)  # fmt: skip


# ---- run folders -----------------------------------------------------------------------------------------------------


def run_files(root: Path) -> list[Path]:
    scene = load_scene(scenes.write_colmap(root / "scene"))
    names = tuple(v.name for v in scene.views)
    request, split = SceneRequest(str(root / "scene")).with_scale("cpu"), Split(names[1:], names[:1])
    record = folder.record_of(request, PRESETS["quick"], scene, split, ["a note"], torch.device("cpu"))
    record["scene"]["path"], record["versions"] = "/", {"warpgs": "0.2.0"}  # the same on every machine
    write_json(root / folder.CONFIG, record)
    checkpoints(root)
    return [root / folder.CONFIG]


def run_nonsense(run: folder.StoredRun) -> str:
    cameras = run.scene_cameras.values()
    bad = [not_finite(viewmat=c.viewmat, K=c.K) for c in cameras] + [not_finite(offset=run.normalization.offset)]
    whole = all(c.viewmat.shape == (4, 4) and c.K.shape == (3, 3) and min(c.width, c.height) > 0 for c in cameras)
    return "".join(bad) or ("" if whole else "a camera is none")


def runs(root: Path) -> list[Path]:
    """Write the records of runs: of this version, of earlier ones with settings of then, and what others refuse."""
    (root / "own").mkdir()
    record = json.loads(run_files(root / "own")[0].read_bytes())
    config = record["config"]
    records = {
        "own": record, "earlier": record | {"config": config | {"checkpoint_seconds": 60}},
        "lost": record | {"config": config | {"priors": config["priors"] | {"cache": False}}},
        "untrained": record | {"train": []}, "bare": {"format": folder.FORMAT},
    }  # fmt: skip
    for name, values in records.items():
        (root / name).mkdir(exist_ok=True)
        write_json(root / name / folder.CONFIG, values)
    made, degrees = cloud(3).tensors(), torch.tensor([0, 1, 1])
    tensors = {f"params.{n}": t for n, t in made.items() if n != "sh"}
    tensors |= {"params.sh_packed": table.pack(made["sh"], degrees), "degrees": degrees}  # as `warpgs prune` leaves it
    packed = folder.save_checkpoint(root / "earlier", tensors, {"step": 7})
    checkpoints(root / "lost")
    return [*(root / name / folder.CONFIG for name in records), packed]


def run_changed(data: bytes, rng: np.random.Generator) -> bytes:
    changes = (json_value, json_value, text_number) if data.startswith(b"{") else CHECKPOINT_CHANGES
    return changes[int(rng.integers(len(changes)))](data, rng)


register(
    Target(
        "run record", runs, lambda root, path: folder.open_run(path.parent, "cpu"), (folder.read_record, folder.open_run),
        (run_changed,), nonsense=run_nonsense,
    )
)  # fmt: skip
