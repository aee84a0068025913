"""The format glTF with the extension KHR_gaussian_splatting, in float32: .glb, or .gltf with embedded numbers.

Axis lengths are stored without a logarithm, opacities after the sigmoid, rotations xyzw. Coordinates have y up: a half turn
about z from those of PLY.
"""

import base64
import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.errors import expect
from warpgs.export import base
from warpgs.geometry import pose_of, rotation_matrices
from warpgs.scene import ORIGIN, base_colors

EXTENSION = "KHR_gaussian_splatting"
COLOR_SPACE = "srgb_rec709_display"
GLB, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
MAX_PARTS = 100_000
"""Largest number of lists and objects in a document; each takes some thirty times as much memory as its text."""
MAX_VALUES = 300_000
"""Largest number of commas in a document: each separates two values, which take up to a hundred bytes."""
SUPPORTED = {EXTENSION, "KHR_mesh_quantization"}
"""Extensions that a file may require; the second one permits integers as positions."""
MAX_COPIES = 32
"""Largest number of nodes that may show the Gaussians: each makes a copy of them."""
MAX_SHEAR = 1e-4
"""Largest difference of a node's transformation from a similarity, relative to its scale; float32 leaves 1e-6."""
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_CODES = {"u2": 5123, "u4": 5125, "f4": 5126}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_TINY = 1e-37


def linear(colors: np.ndarray) -> np.ndarray:
    """Return sRGB colours in [0, 1] as linear colours (IEC 61966-2-1), which glTF stores; the shape is unchanged."""
    c = np.clip(colors.astype(np.float64), 0, 1)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def glb(document: dict[str, Any], *body: bytes) -> list[bytes]:
    """Return the bytes of a .glb file of a document and the parts of its buffer."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = sum(map(len, body))
    head = struct.pack("<IIIII", GLB, 2, 28 + len(text) + size, len(text), JSON_CHUNK)
    return [head, text, struct.pack("<II", size, BINARY_CHUNK), *body]


def buffer_of(columns: Sequence[tuple[str, np.ndarray]], *more: bytes) -> tuple[dict[str, Any], list[bytes]]:
    """Return the members of a document for columns of its type, positions first, and for ``more`` files, with their bytes."""
    pieces = [*(np.ascontiguousarray(values).tobytes() for _, values in columns), *more]
    starts = np.cumsum([0, *map(len, pieces)]).tolist()
    views: list[dict[str, int]] = [{"buffer": 0, "byteOffset": at, "byteLength": len(p)} for at, p in zip(starts, pieces)]
    accessors: list[dict[str, Any]] = []
    for kind, values in columns:
        code = values.dtype.str[1:]
        views[len(accessors)]["target"] = 34963 if code == "u4" else 34962  # indices, or attributes
        accessor = {"bufferView": len(accessors), "componentType": _CODES[code], "count": len(values), "type": kind}
        accessor |= {"normalized": True} if code == "u2" else {}
        if not accessors and len(values):  # glTF requires the bounds of positions
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        accessors.append(accessor)
    return {"buffers": [{"byteLength": starts[-1]}], "bufferViews": views, "accessors": accessors}, pieces


def _document(arrays: base.Arrays, origin: np.ndarray | None) -> tuple[dict[str, Any], bytes]:
    """Return the glTF document and its binary buffer."""
    a = base.half_turn({k: np.asarray(v) for k, v in arrays.items()}, "z")
    attributes = {
        "POSITION": ("VEC3", a["means"]),
        f"{EXTENSION}:ROTATION": ("VEC4", base.unit_quats(a["quats"])[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": ("VEC3", np.clip(np.exp(a["log_scales"].astype(np.float64)), _TINY, 3e38)),
        f"{EXTENSION}:OPACITY": ("SCALAR", base.sigmoid(a["logit_opacities"])),
    }
    for k in range(a["sh"].shape[1]):
        degree = math.isqrt(k)
        attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree * degree}"] = ("VEC3", a["sh"][:, k])
    # for programs that show Gaussians as points
    opacities, colors = attributes[f"{EXTENSION}:OPACITY"][1][:, None], linear(base_colors(a["sh"][:, :1]))
    attributes["COLOR_0"] = ("VEC4", base.rounded(65535 * np.concatenate([colors, opacities], 1), 65535).astype("<u2"))
    columns = [(kind, values.astype("<u2" if name == "COLOR_0" else "<f4")) for name, (kind, values) in attributes.items()]
    members, pieces = buffer_of(columns)
    extension = {"kernel": "ellipse", "colorSpace": COLOR_SPACE, "sortingMethod": "cameraDistance", "projection": "perspective"}
    names = {name: i for i, name in enumerate(attributes)}
    document = {
        "asset": {"version": "2.0", "generator": "warpgs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": names, "mode": 0, "extensions": {EXTENSION: extension}}]}],
        **members,
    }
    if origin is not None and origin.any():
        document["extras"] = {ORIGIN: origin.tolist()}
    return document, b"".join(pieces)


def decode(path: Path, data: bytes) -> base.Arrays:
    """Return the Gaussians of a .glb or .gltf file's bytes, in the axes of PLY."""
    document, body = _split(data)
    buffers = document.get("buffers")
    one = isinstance(buffers, list) and len(buffers) == 1 and isinstance(buffers[0], dict)
    expect(one, "it does not have exactly one buffer")
    if (uri := buffers[0].get("uri")) is not None:
        body = _inside(uri)
    primitive, mesh = _primitive(document)
    names, places = primitive["attributes"], _places(document, mesh)

    def values(name: str) -> np.ndarray:
        expect(name in names, f"the attribute {name} is missing")
        return _accessor(document, body, names[name], whole=name in ("POSITION", f"{EXTENSION}:SCALE"))

    degrees = [d for d in range(4) if f"{EXTENSION}:SH_DEGREE_{d}_COEF_0" in names]
    whole = degrees and degrees == list(range(len(degrees)))
    expect(whole, f"it has harmonics of degrees {degrees}, but degrees must start at 0 and have no gap")
    orders = [(math.isqrt(k), k - math.isqrt(k) ** 2) for k in range(base.SH_SIZES[degrees[-1]])]
    means = values("POSITION")
    turns, scales, opacities = (values(f"{EXTENSION}:{name}") for name in ("ROTATION", "SCALE", "OPACITY"))
    harmonics = [values(f"{EXTENSION}:SH_DEGREE_{d}_COEF_{c}") for d, c in orders]
    n = len(means)
    expect(all(len(v) == n for v in (turns, scales, opacities, *harmonics)), "its attributes differ in length")
    three = {v.shape[1] for v in (means, scales, *harmonics)} == {3}
    expect(three, "a position, scale or harmonic does not have three components")

    def logs(part: slice) -> np.ndarray:
        lengths = _rows(scales, part)
        expect(not (lengths < 0).any(), "an axis has a negative length")
        return np.log(np.maximum(lengths, _TINY))

    arrays = {
        "sh": base.by_rows(n, (len(harmonics), 3), lambda p: np.stack([_rows(table, p) for table in harmonics], 1)),
        "means": base.by_rows(n, (3,), lambda p: _rows(means, p)),
        "quats": base.by_rows(n, (4,), lambda p: _rows(turns, p)[:, [3, 0, 1, 2]]),
        "log_scales": base.by_rows(n, (3,), logs),
        "logit_opacities": base.by_rows(n, (), lambda p: base.logits(_rows(opacities, p)[:, 0], 2.0**-22)),
    }
    copies = [arrays, *({name: array.copy() for name, array in arrays.items()} for _ in places[1:])]
    for copy, place in zip(copies, places):
        if not np.array_equal(place, np.eye(4)):
            copy["means"] = copy["means"].astype(np.float64)  # a translation may be in map coordinates
            base.transform_in_place(copy, place[:3, :3], place[:3, 3])
    if places[1:]:
        arrays = {name: np.concatenate([copy[name] for copy in copies]) for name in arrays}
    base.half_turn_in_place(arrays, "z")
    return arrays


def _places(document: dict[str, Any], mesh: int) -> list[np.ndarray]:
    """Return the transformation [4, 4] of each node that shows a mesh, with those of its parents."""
    nodes = document.get("nodes", [])
    below = {str(child) for n in nodes for child in n.get("children", [])}
    roots = [i for i in range(len(nodes)) if str(i) not in below]
    if document.get("scenes"):
        roots = list(_item(document, "scenes", document.get("scene", 0)).get("nodes", []))
    left, seen, found = [(i, np.eye(4)) for i in reversed(roots)], set(), []
    while left:
        i, above = left.pop()
        node = _item(document, "nodes", i)
        place = above @ _matrix_of(node)
        expect(i not in seen, f"node {i} has two parents")
        seen.add(i)
        left += [(child, place) for child in reversed(node.get("children", []))]
        if node.get("mesh") == mesh:
            repeated = "EXT_mesh_gpu_instancing" in (node.get("extensions") or ())
            expect(not repeated, f"node {i} repeats the Gaussians (EXT_mesh_gpu_instancing), which is not supported")
            product = place[:3, :3].T @ place[:3, :3]
            square = np.trace(product) / 3
            alike = square > 0 and np.isfinite(place).all() and np.abs(product / square - np.eye(3)).max() <= MAX_SHEAR
            expect(alike, f"node {i} scales Gaussians by different factors, 0 or with shear; apply that in another program")
            found.append(place)
    shown = len(found) <= MAX_COPIES and (found or not any(n.get("mesh") == mesh for n in nodes))
    expect(shown, f"its scene shows the Gaussians {len(found)} times (supported: 1 to {MAX_COPIES})")
    return found or [np.eye(4)]


def _matrix_of(node: dict[str, Any]) -> np.ndarray:
    """Return the transformation [4, 4] of a node, float64."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    turn = np.array(node.get("rotation", [0, 0, 0, 1]), np.float64)[[3, 0, 1, 2]]
    scales, translation = (np.array(node.get(k, [v] * 3), np.float64).reshape(3) for k, v in (("scale", 1), ("translation", 0)))
    return pose_of(rotation_matrices(turn / np.sqrt((turn * turn).sum())) * scales, translation)


def _rows(block: np.ndarray, part: slice) -> np.ndarray:
    """Return rows of an accessor's numbers [P, W]: float32, or in float64 the fractions that integers stand for."""
    if block.dtype.kind == "f":
        return block[part].astype(np.float32)
    return np.maximum(block[part] / float(np.iinfo(block.dtype).max), -1.0)


def _split(data: bytes) -> tuple[dict[str, Any], bytes | memoryview]:
    """Return the document and the binary chunk (maybe empty) of a file."""
    body: bytes | memoryview = b""
    if data[:4] == b"glTF":
        expect(len(data) >= 20, "its header is truncated")
        _, version, total, size, kind = struct.unpack_from("<IIIII", data)
        sound = version == 2 and kind == JSON_CHUNK and 20 + size <= total <= len(data)
        expect(sound, f"its header is invalid: version {version}, {total} bytes, in a file of {len(data)}")
        text, rest = data[20 : 20 + size], memoryview(data)[20 + size : total]
        if len(rest) >= 8:
            size, kind = struct.unpack_from("<II", rest)
            expect(kind == BINARY_CHUNK, f"its second chunk is not binary: type {kind:#010x}")
            expect(size <= len(rest) - 8, f"its binary chunk of {size} bytes is truncated")
            body = rest[8 : 8 + size]
    else:
        text = data
    expect(text.count(b"[") + text.count(b"{") <= MAX_PARTS, f"its JSON has more than {MAX_PARTS:,} lists and objects")
    expect(text.count(b",") <= MAX_VALUES, f"its JSON has more than {MAX_VALUES:,} values")
    document = json.loads(text)
    expect(isinstance(document, dict), "its JSON is not an object")
    return document, body


def _inside(uri: object) -> bytes:
    """Return the bytes of a data URI; other URIs are rejected, so that a file cannot choose other files to open."""
    head, comma, text = uri.partition(",") if isinstance(uri, str) else ("", "", "")
    embedded = head.startswith("data:") and head.endswith(";base64") and comma
    expect(embedded, "its numbers are in another file, which is not opened; combine both into one .glb")
    return base64.b64decode(text, validate=True)


def _primitive(document: dict[str, Any]) -> tuple[dict[str, Any], int]:
    """Return the one primitive of Gaussians and the number of its mesh; DataError for features that are not supported."""
    for name in document.get("extensionsRequired", []):
        expect(name in SUPPORTED, f"it requires the extension {str(name)[:40]}, which is not supported")
    primitives = [(p, i) for i, mesh in enumerate(document.get("meshes", [])) for p in mesh["primitives"]]
    found = [(p, i) for p, i in primitives if EXTENSION in p.get("extensions", {})]
    expect(len(found) == 1, f"it has {len(found)} primitives with {EXTENSION}; exactly one is supported")
    extension = found[0][0]["extensions"][EXTENSION]
    kernel, space = extension.get("kernel"), extension.get("colorSpace")
    expect((kernel, space) == ("ellipse", COLOR_SPACE), f"kernel {str(kernel)[:40]!r} or {str(space)[:40]} is not supported")
    expect(not extension.get("extensions"), "its Gaussians are compressed by a further extension; export them uncompressed")
    return found[0]


def _item(document: dict[str, Any], table: str, at: object) -> dict[str, Any]:
    """Return an object of a list of the document."""
    rows = document.get(table)
    there = isinstance(rows, list) and type(at) is int and 0 <= at < len(rows) and isinstance(rows[at], dict)
    expect(there, f"{table} {str(at)[:20]} does not exist")
    return rows[at]


def _accessor(document: dict[str, Any], body: bytes | memoryview, index: object, whole: bool) -> np.ndarray:
    """Return the numbers of an accessor, checked to lie in the file; ``whole`` to allow integers that are not normalised."""

    def count(row: dict[str, Any], key: str, default: int | None = None) -> int:
        value = row.get(key, default)
        fits = type(value) is int and 0 <= value <= len(body)
        expect(fits, f"{key} {str(value)[:20]!r} does not fit into the {len(body)} bytes of its buffer")
        return value

    accessor = _item(document, "accessors", index)
    view = _item(document, "bufferViews", accessor.get("bufferView"))
    kind, width = _KINDS.get(accessor.get("componentType")), _WIDTHS.get(accessor.get("type"))
    expect(kind and width and "sparse" not in accessor and view.get("buffer") == 0, f"accessor {index} has an unsupported type")
    normalized = accessor.get("normalized") is True
    expect(kind == "<f4" or normalized or whole, f"accessor {index} contains integers that are not normalised")
    dtype = np.dtype(kind)
    size, rows = dtype.itemsize * width, count(accessor, "count")
    stride = count(view, "byteStride", size) or size
    start, offset, length = count(view, "byteOffset", 0), count(accessor, "byteOffset", 0), count(view, "byteLength")
    last = offset + (rows - 1) * stride + size if rows else 0
    within = stride >= size and start + length <= len(body) and last <= length
    expect(within, f"accessor {index} reaches beyond its {length} bytes")
    if not rows:
        return np.empty((0, width), np.float32)
    numbers = np.ndarray((rows, width), dtype, body, start + offset, (stride, dtype.itemsize))
    return numbers if kind == "<f4" or normalized else numbers.astype(np.float32)


@base.register("glb")
class BinaryGltf(base.Format):
    """Binary glTF."""

    suffix = ".glb"
    description = "glTF 2.0 with KHR_gaussian_splatting, binary, float32; Cesium, 3D engines"
    decode = staticmethod(decode)

    def encode(self, arrays: base.Arrays) -> list[bytes]:
        """Return the bytes of a file."""
        return glb(*_document(arrays, self.origin))

    def origin_in(self, path: Path) -> object:
        """Return the origin in the document's extras."""
        with base.reading(path, whole=True) as file:
            extras = _split(file.read())[0].get("extras")
        return extras.get(ORIGIN) if isinstance(extras, dict) else None

    def is_own(self, path: Path) -> bool:
        """Return whether the document names warpgs as its generator."""
        with base.reading(path, whole=True) as file:
            return bool(_split(file.read())[0].get("asset") == {"version": "2.0", "generator": "warpgs"})


@base.register("gltf")
class TextGltf(BinaryGltf):
    """Text glTF."""

    suffix = ".gltf"
    description = "glTF 2.0 with KHR_gaussian_splatting, text with embedded numbers"

    def encode(self, arrays: base.Arrays) -> list[bytes]:
        """Return the bytes of a file, with its numbers embedded as base64."""
        document, body = _document(arrays, self.origin)
        document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
        return [json.dumps(document, separators=(",", ":")).encode()]
