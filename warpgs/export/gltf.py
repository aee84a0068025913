"""The format glTF with the extension KHR_gaussian_splatting, in float32: .glb, or .gltf with embedded numbers.

Axis lengths are stored without a logarithm, opacities after the sigmoid, rotations xyzw. Coordinates have y up: a half turn
about z from those of PLY.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.export.base import (
    SH_SIZES,
    Arrays,
    Format,
    by_rows,
    half_turn,
    half_turn_in_place,
    logits,
    malformed,
    parts,
    register,
    sigmoid,
    unit_quats,
)

EXTENSION = "KHR_gaussian_splatting"
COLOR_SPACE = "srgb_rec709_display"
GLB, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
MAX_PARTS = 100_000
"""Largest number of lists and objects in a document; each takes some thirty times as much memory as its text."""
MAX_VALUES = 300_000
"""Largest number of commas in a document: each separates two values, which take up to a hundred bytes."""
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_TINY = 1e-37


def encode_glb(arrays: Arrays) -> list[bytes]:
    """Return the bytes of a .glb file."""
    return glb(*_document(arrays))


def glb(document: dict[str, Any], *body: bytes) -> list[bytes]:
    """Return the bytes of a .glb file of a document and the parts of its buffer."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = sum(map(len, body))
    head = struct.pack("<IIIII", GLB, 2, 28 + len(text) + size, len(text), JSON_CHUNK)
    return [head, text, struct.pack("<II", size, BINARY_CHUNK), *body]


def encode_gltf(arrays: Arrays) -> list[bytes]:
    """Return the bytes of a .gltf file, with its numbers embedded as base64."""
    document, body = _document(arrays)
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
    return [json.dumps(document, separators=(",", ":")).encode()]


def _document(arrays: Arrays) -> tuple[dict[str, Any], bytes]:
    """Return the glTF document and its binary buffer."""
    a = half_turn({k: np.asarray(v) for k, v in arrays.items()}, "z")
    scales = np.clip(np.exp(a["log_scales"].astype(np.float64)), _TINY, 3e38)
    attributes = {
        "POSITION": ("VEC3", a["means"]),
        f"{EXTENSION}:ROTATION": ("VEC4", unit_quats(a["quats"])[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": ("VEC3", scales),
        f"{EXTENSION}:OPACITY": ("SCALAR", sigmoid(a["logit_opacities"])),
    }
    for k in range(a["sh"].shape[1]):
        degree = math.isqrt(k)
        attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree * degree}"] = ("VEC3", a["sh"][:, k])
    views: list[dict] = []
    accessors: list[dict] = []
    parts_of_body: list[bytes] = []
    start = 0
    for name, (kind, given) in attributes.items():
        values = np.ascontiguousarray(given, "<f4")
        views.append({"buffer": 0, "byteOffset": start, "byteLength": values.nbytes, "target": 34962})
        accessor = {"bufferView": len(accessors), "componentType": 5126, "count": len(values), "type": kind}
        if name == "POSITION":  # glTF requires the bounds of positions
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        accessors.append(accessor)
        parts_of_body.append(values.tobytes())
        start += values.nbytes
    extension = {"kernel": "ellipse", "colorSpace": COLOR_SPACE, "sortingMethod": "cameraDistance", "projection": "perspective"}
    names = {name: i for i, name in enumerate(attributes)}
    document = {
        "asset": {"version": "2.0", "generator": "warpgs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": names, "mode": 0, "extensions": {EXTENSION: extension}}]}],
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return document, b"".join(parts_of_body)


def decode(path: Path, data: bytes) -> Arrays:
    """Return the Gaussians of a .glb or .gltf file's bytes, in the axes of PLY."""
    document, body = _split(path, data)
    buffers = document.get("buffers")
    if not isinstance(buffers, list) or len(buffers) != 1 or not isinstance(buffers[0], dict):
        raise malformed(path, "it does not have exactly one buffer")
    if (uri := buffers[0].get("uri")) is not None:
        body = _inside(path, uri)
    primitive = _primitive(path, document)
    names = primitive["attributes"]

    def values(name: str) -> np.ndarray:
        if name not in names:
            raise malformed(path, f"the attribute {name} is missing")
        return _accessor(path, document, body, names[name])

    degrees = [d for d in range(4) if f"{EXTENSION}:SH_DEGREE_{d}_COEF_0" in names]
    if degrees != list(range(len(degrees))) or not degrees:
        raise malformed(path, f"it has harmonics of degrees {degrees}, but degrees must start at 0 and have no gap")
    orders = [(math.isqrt(k), k - math.isqrt(k) ** 2) for k in range(SH_SIZES[degrees[-1]])]
    means, turns, scales, opacities = (
        values(name) for name in ("POSITION", *(f"{EXTENSION}:{n}" for n in ("ROTATION", "SCALE", "OPACITY")))
    )
    harmonics = [values(f"{EXTENSION}:SH_DEGREE_{d}_COEF_{c}") for d, c in orders]
    n = len(means)
    if any(len(v) != n for v in (turns, scales, opacities, *harmonics)):
        raise malformed(path, "its attributes differ in length")
    if {v.shape[1] for v in (means, scales, *harmonics)} != {3}:
        raise malformed(path, "a position, scale or harmonic does not have three components")

    def logs(part: slice) -> np.ndarray:
        lengths = _rows(scales, part)
        if (lengths < 0).any():
            raise malformed(path, "an axis has a negative length")
        return np.log(np.maximum(lengths, _TINY))

    sh = np.empty((n, len(harmonics), 3), np.float32)
    for k, table in enumerate(harmonics):
        for part in parts(n):
            sh[part, k] = _rows(table, part)
    arrays = {
        "sh": sh,
        "means": by_rows(n, (3,), lambda p: _rows(means, p)),
        "quats": by_rows(n, (4,), lambda p: _rows(turns, p)[:, [3, 0, 1, 2]]),
        "log_scales": by_rows(n, (3,), logs),
        "logit_opacities": by_rows(n, (), lambda p: logits(_rows(opacities, p)[:, 0], 2.0**-22)),
    }
    half_turn_in_place(arrays, "z")
    return arrays


def _rows(block: np.ndarray, part: slice) -> np.ndarray:
    """Return rows of an accessor's numbers [P, W]: float32, or in float64 the fractions that integers stand for."""
    if block.dtype.kind == "f":
        return block[part].astype(np.float32)
    return np.maximum(block[part] / float(np.iinfo(block.dtype).max), -1.0)


def _split(path: Path, data: bytes) -> tuple[dict[str, Any], bytes | memoryview]:
    """Return the document and the binary chunk (maybe empty) of a file."""
    body: bytes | memoryview = b""
    if data[:4] == b"glTF":
        if len(data) < 20:
            raise malformed(path, "its header is truncated")
        _, version, total, size, kind = struct.unpack_from("<IIIII", data)
        if version != 2 or kind != JSON_CHUNK or not 20 + size <= total <= len(data):
            raise malformed(path, f"its header is invalid: version {version}, {total} bytes, in a file of {len(data)} bytes")
        text, rest = data[20 : 20 + size], memoryview(data)[20 + size : total]
        if len(rest) >= 8:
            size, kind = struct.unpack_from("<II", rest)
            if kind != BINARY_CHUNK:
                raise malformed(path, f"its second chunk is not binary: type {kind:#010x}")
            if size > len(rest) - 8:
                raise malformed(path, f"its binary chunk of {size} bytes is truncated")
            body = rest[8 : 8 + size]
    else:
        text = data
    if text.count(b"[") + text.count(b"{") > MAX_PARTS:
        raise malformed(path, f"its JSON has more than {MAX_PARTS:,} lists and objects")
    if text.count(b",") > MAX_VALUES:
        raise malformed(path, f"its JSON has more than {MAX_VALUES:,} values")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as e:
        raise malformed(path, "its JSON cannot be read") from e
    if not isinstance(document, dict):
        raise malformed(path, "its JSON is not an object")
    return document, body


def _inside(path: Path, uri: object) -> bytes:
    """Return the bytes of a data URI; other URIs are rejected, so that a file cannot choose other files to open."""
    head, comma, text = uri.partition(",") if isinstance(uri, str) else ("", "", "")
    if not (head.startswith("data:") and head.endswith(";base64") and comma):
        raise malformed(path, "its numbers are in another file, which is not opened; combine both into one .glb")
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as e:
        raise malformed(path, "its base64 numbers cannot be read") from e


def _primitive(path: Path, document: dict[str, Any]) -> dict[str, Any]:
    """Return the one primitive of Gaussians; DataError for features that are not supported."""
    meshes, nodes = document.get("meshes"), document.get("nodes", [])
    found = []
    for mesh in meshes if isinstance(meshes, list) else []:
        primitives = mesh.get("primitives") if isinstance(mesh, dict) else None
        for p in primitives if isinstance(primitives, list) else []:
            if isinstance(p, dict) and isinstance(p.get("extensions"), dict) and EXTENSION in p["extensions"]:
                found.append(p)
    if len(found) != 1:
        raise malformed(path, f"it has {len(found)} primitives with {EXTENSION}; exactly one is supported")
    extension = found[0]["extensions"][EXTENSION]
    kernel, space = (extension.get(k) if isinstance(extension, dict) else None for k in ("kernel", "colorSpace"))
    if (kernel, space) != ("ellipse", COLOR_SPACE):
        given = f"kernel {str(kernel)[:40]!r} or colour space {str(space)[:40]!r} is not supported"
        raise malformed(path, f"{given} (supported: 'ellipse', {COLOR_SPACE!r})")
    if isinstance(extension, dict) and extension.get("extensions"):
        raise malformed(path, "its Gaussians are compressed by a further extension; export them uncompressed")
    if not isinstance(found[0].get("attributes"), dict):
        raise malformed(path, "its primitive has no attributes")
    moved = {"matrix", "translation", "rotation", "scale"}
    if any(not isinstance(n, dict) or moved & n.keys() for n in (nodes if isinstance(nodes, list) else [None])):
        raise malformed(path, "a node transforms its mesh; apply the transformations, and export again")
    return found[0]


def _accessor(path: Path, document: dict[str, Any], body: bytes | memoryview, index: object) -> np.ndarray:
    """Return the numbers of an accessor, checked to lie in the file."""

    def item(table: str, at: object) -> dict[str, Any]:
        rows = document.get(table)
        if not isinstance(rows, list) or type(at) is not int or not 0 <= at < len(rows) or not isinstance(rows[at], dict):
            raise malformed(path, f"{table} {str(at)[:20]} does not exist")
        return rows[at]

    def count(row: dict[str, Any], key: str, default: int | None = None) -> int:
        value = row.get(key, default)
        if type(value) is not int or not 0 <= value <= len(body):
            raise malformed(path, f"{key} {str(value)[:20]!r} does not fit into the {len(body)} bytes of its buffer")
        return value

    accessor = item("accessors", index)
    view = item("bufferViews", accessor.get("bufferView"))
    kind, width = _KINDS.get(accessor.get("componentType")), _WIDTHS.get(accessor.get("type"))
    if kind is None or width is None or "sparse" in accessor or view.get("buffer") != 0:
        raise malformed(path, f"accessor {index} has an unsupported type")
    if kind != "<f4" and accessor.get("normalized") is not True:
        raise malformed(path, f"accessor {index} contains integers that are not normalised")
    dtype = np.dtype(kind)
    size, rows = dtype.itemsize * width, count(accessor, "count")
    stride = count(view, "byteStride", size) or size
    start, offset, length = count(view, "byteOffset", 0), count(accessor, "byteOffset", 0), count(view, "byteLength")
    if stride < size or start + length > len(body) or (rows and offset + (rows - 1) * stride + size > length):
        raise malformed(path, f"accessor {index} reaches beyond its {length} bytes")
    if not rows:
        return np.empty((0, width), np.float32)
    return np.ndarray((rows, width), dtype, body, start + offset, (stride, dtype.itemsize))


@register("glb")
class BinaryGltf(Format):
    """Binary glTF."""

    suffix = ".glb"
    description = "glTF 2.0 with KHR_gaussian_splatting, binary, float32; Cesium, 3D engines"
    encode = staticmethod(encode_glb)
    decode = staticmethod(decode)


@register("gltf")
class TextGltf(Format):
    """Text glTF."""

    suffix = ".gltf"
    description = "glTF 2.0 with KHR_gaussian_splatting, text with embedded numbers"
    encode = staticmethod(encode_gltf)
    decode = staticmethod(decode)
