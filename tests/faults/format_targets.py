"""File formats of Gaussians, and of cameras, for the fuzzer."""

from __future__ import annotations

import base64
import gzip
import importlib.util
import io
import json
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np

from tests.faults import mutations
from tests.faults.model_targets import nonsense, ply_body, ply_header
from tests.faults.mutations import Change, damage, json_value, number, rarely, text_line, text_number
from tests.faults.targets import Target, not_finite, register, writing
from tests.gaussians import cloud
from tests.io import scenes
from warpgs.errors import DataError
from warpgs.export import base, gltf, meshes_and_cameras as camera_writers, ply, sog, spz
from warpgs.export.base import arrays_of, gaussians_of
from warpgs.io import transforms
from warpgs.io.colmap import read_cameras, read_poses
from warpgs.pipeline.model import edit
from warpgs.scene import Normalization, checked_origin


def written(suffix: str):
    """Return the function that writes the valid files of a format: with harmonics and without."""

    def prepare(root: Path) -> list[Path]:
        made = cloud(5)
        paths = [root / f"a{suffix}", root / f"b{suffix}"]
        base.write_gaussians(paths[0], made, units="file")
        base.write_gaussians(paths[1], type(made)(**made.tensors() | {"sh": made.sh[:, :1]}), units="file")
        return paths

    return prepare


def add(name: str, suffix: str, parser: tuple, changes: tuple[Change, ...], prepare=None, repair=None, lines=0.9) -> None:
    """Register the reader of a format of Gaussians."""
    register(
        Target(
            name, prepare or written(suffix), lambda root, path: base.read_gaussians(path), (*parser, gaussians_of),
            changes, repair, nonsense, lines=lines,
        )
    )  # fmt: skip


# ---- compressed PLY and .splat -----------------------------------------------------------------------------------------

COMPRESSED = (ply.decode, ply.is_compressed, ply._harmonics, ply._table, ply._column, ply._unpack)
add("compressed PLY", ".compressed.ply", COMPRESSED, (ply_header(text_number), ply_header(text_line), ply_body, ply_body))
add("splat", ".splat", (base.Splat.decode,), (number, number))

# ---- SPZ ---------------------------------------------------------------------------------------------------------------


def inside_gzip(change: Change) -> Change:
    """Return a change of what a gzip stream holds; what is none is changed as it is."""

    def changed(data: bytes, rng: np.random.Generator) -> bytes:
        try:
            plain = zlib.decompressobj(31).decompress(data, 2**20)
        except zlib.error:
            return change(data, rng)
        return gzip.compress(change(plain, rng), mtime=0)

    return changed


def spz_files(root: Path) -> list[Path]:
    paths = []
    for version in spz.VERSIONS if importlib.util.find_spec("zstandard") else (2, 3):
        paths.append(root / f"v{version}.spz")
        paths[-1].write_bytes(b"".join(spz.encode(arrays_of(cloud(5)), version)))
    plain = bytearray(gzip.decompress(paths[1].read_bytes()))
    plain[14] |= spz.EXTENDED
    paths.append(root / "axes.spz")
    paths[-1].write_bytes(gzip.compress(plain + struct.pack("<IIIII", 7, 0, spz.COORDINATE_SYSTEM, 4, 12)))
    return paths


def spz_streams(data: bytes, rng: np.random.Generator) -> bytes:
    """Change what a stream of version 4 holds; its sizes stay right unless the content's length changes."""
    if not importlib.util.find_spec("zstandard") or data[:2] == b"\x1f\x8b" or len(data) < 32:
        return damage(data, rng)
    import zstandard

    count, place = struct.unpack_from("<BI", data, 15)
    try:
        table = [struct.unpack_from("<QQ", data, place + 16 * i) for i in range(count)]
        start = place + 16 * count
        which, parts = int(rng.integers(count)), []
        for i, (packed, plain) in enumerate(table):
            part = data[start : start + packed]
            start += packed
            if i == which:
                content = (number, damage)[int(rng.integers(2))](
                    zstandard.ZstdDecompressor().decompress(part, min(plain, 2**20)), rng
                )
                part = zstandard.ZstdCompressor().compress(content)
                plain = len(content) if rng.random() < 0.2 else plain
            parts.append((part, plain))
    except (struct.error, ValueError, OverflowError, MemoryError, zstandard.ZstdError):
        return data
    toc = b"".join(struct.pack("<QQ", len(p), n) for p, n in parts)
    return data[:place] + toc + b"".join(p for p, _ in parts)


SPZ = (spz.decode, spz._checked, spz._streams, spz._unpack, spz._coordinate_system)
SPZ_CHANGES = (
    rarely(mutations.spz_bomb, inside_gzip(lambda data, rng: number(data[:32], rng) + data[32:])),
    inside_gzip(number),
    inside_gzip(damage),
    spz_streams,
)
add("SPZ", ".spz", SPZ, SPZ_CHANGES, spz_files, lines=0.85)


def side_files(root: Path) -> list[Path]:
    base.write_gaussians(root / "a.spz", cloud(5), Normalization(np.array([441_000.0, 5_500_000, 130])))
    return [base.side_file(root / "a.spz")]


register(
    Target(
        "origin", side_files, lambda root, path: base.read_gaussians(root / "a.spz"), (base.Format.origin_in, checked_origin),
        (json_value, json_value, text_number), None, nonsense,
    )
)  # fmt: skip

# ---- archives ----------------------------------------------------------------------------------------------------------


def members_of(data: bytes) -> dict[str, bytes]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return {n: archive.read(n) for n in archive.namelist()}
    except (zipfile.BadZipFile, OSError, RuntimeError, NotImplementedError, ValueError, EOFError, zlib.error):
        return {}


def archive_of(members: dict[str, bytes], packed: bool = False) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED) as archive:
        for n, content in members.items():
            archive.writestr(zipfile.ZipInfo(n), content)
    return out.getvalue()


def zip_member(data: bytes, rng: np.random.Generator) -> bytes:
    if not (members := members_of(data)):
        return damage(data, rng)
    name, kind = sorted(members)[int(rng.integers(len(members)))], int(rng.integers(8))
    if kind == 0:
        del members[name]
    elif kind == 1:
        members[f"{name}x"] = members.pop(name)
    else:
        members[name] = (number if kind < 5 else damage)(members[name], rng)
    return archive_of(members)


# ---- SOG ---------------------------------------------------------------------------------------------------------------


def sog_member(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a file of the archive: values of meta.json, or an image's pixels, bytes or size."""
    members = members_of(data)
    names = sorted(members)
    if not names:
        return data
    name = "meta.json" if rng.random() < 0.6 and "meta.json" in members else names[int(rng.integers(len(names)))]
    if name.endswith(".webp") and rng.random() < 0.6:
        pixels = rng.integers(0, 256, (int(rng.integers(1, 6)), int(rng.integers(1, 9)), 4)).astype("u1")
        members[name] = sog._webp(pixels)
    else:
        members[name] = (json_value if name == "meta.json" else damage)(members[name], rng)
    if rng.random() < 0.1:
        members.pop(name)
    return archive_of(members, rng.random() < 0.3)


def sog_image(data: bytes, rng: np.random.Generator) -> bytes:
    """Put a large image of one colour in place of another."""
    members = members_of(data)
    names = sorted(n for n in members if n.endswith(".webp"))
    return archive_of(members | {names[int(rng.integers(len(names)))]: mutations.large_webp()}) if names else data


SOG = (sog.decode, sog._member, sog._pixels, sog._book, sog._palette_rows)
add("SOG", ".sog", SOG, (sog_member, sog_member, rarely(sog_image, rarely(mutations.zip_bomb, sog_member))))


def sog_folder(root: Path) -> list[Path]:
    base.write_gaussians(root / "meta.json", cloud(5), units="file", antialiased=True)
    return sorted(root.iterdir())


def sog_part(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a file of a folder: values of meta.json, half of them outside codebooks, or an image, or put another one there."""
    if data[:1] == b"{":
        try:
            meta = json.loads(data)
            key = sorted(meta)[int(rng.integers(len(meta)))]
        except ValueError:  # changed before
            return damage(data, rng)
        other = json.dumps(meta | {key: (-1, 10**9, "x", None, [], {})[int(rng.integers(6))]}).encode()
        return other if rng.random() < 0.5 else json_value(data, rng)
    return mutations.large_webp() if rng.random() < 0.02 else damage(data, rng)


register(
    Target(
        "SOG folder", sog_folder, lambda root, path: base.read_gaussians(root / "meta.json"),
        (*(f for f in SOG if f is not sog._member), sog._beside, gaussians_of), (sog_part, sog_part, text_number), None,
        nonsense, lines=0.85,  # meta.json is one of six files
    )
)  # fmt: skip

# ---- glTF --------------------------------------------------------------------------------------------------------------


def gltf_files(root: Path) -> list[Path]:
    paths = [*written(".glb")(root), *written(".gltf")(root), root / "c.glb"]
    document, part = gltf._split(paths[0].read_bytes())
    body = bytes(part)
    values = np.arange(20, dtype="u1") * 12
    for i, (kind, width) in enumerate((("VEC4", 4), ("SCALAR", 1))):
        view = {"buffer": 0, "byteOffset": len(body), "byteLength": len(values)}
        document["bufferViews"].append(view | ({"byteStride": 4} if width == 1 else {}))
        accessor = {"bufferView": len(document["bufferViews"]) - 1, "componentType": 5121, "normalized": True, "count": 5}
        document["accessors"][1 + 2 * i] = accessor | {"type": kind}
        body += values.tobytes()
    document["buffers"][0]["byteLength"] = len(body)
    document["nodes"] = [{"mesh": 0, "children": [1], "scale": [2, 2, 2]}, {"mesh": 0, "rotation": [0, 0.6, 0, 0.8]}]
    paths[-1].write_bytes(glb(json.dumps(document).encode(), body))
    return paths


def glb(text: bytes, body: bytes) -> bytes:
    """Return a .glb file of a document and its numbers."""
    text += b" " * (-len(text) % 4)
    head = struct.pack("<IIIII", gltf.GLB, 2, 28 + len(text) + len(body), len(text), gltf.JSON_CHUNK)
    return head + text + struct.pack("<II", len(body), gltf.BINARY_CHUNK) + body


def gltf_document(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a value of the document; the lengths around it stay right."""
    if not data.startswith(b"glTF"):
        return json_value(data, rng)
    try:
        document, body = gltf._split(data)
        return glb(json_value(json.dumps(document).encode(), rng), body)
    except (DataError, ValueError, KeyError, TypeError, struct.error, RecursionError):
        return data


def gltf_numbers(data: bytes, rng: np.random.Generator) -> bytes:
    if data.startswith(b"glTF"):
        return number(data, rng)
    try:
        document = json.loads(data)
        head, _, text = document["buffers"][0]["uri"].partition(",")
        body = number(base64.b64decode(text), rng)
        document["buffers"][0]["uri"] = f"{head},{base64.b64encode(body).decode()}"
        return json.dumps(document).encode()
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError):
        return data


GLTF = (gltf.decode, gltf._split, gltf._inside, gltf._primitive, gltf._accessor, gltf._places, gltf._matrix_of)
add("glTF", ".glb", GLTF, (gltf_document, gltf_document, gltf_numbers), gltf_files)

# ---- cameras and boxes -------------------------------------------------------------------------------------------------


def camera_paths(root: Path) -> list[Path]:
    scenes.write_colmap(root)
    found, _ = transforms.read_cameras(root)
    for name in camera_writers.NAMES[:2]:
        camera_writers.write_cameras(root / name, list(found.values()))
    camera_writers.write_cameras(root / "text" / "sparse", list(found.values()))
    tables = [root / "text" / "sparse" / "0" / f"{n}.txt" for n in ("cameras", "images")]
    tables += [root / "sparse" / "0" / f"{n}.bin" for n in ("cameras", "images")]
    return [root / camera_writers.NAMES[0], root / camera_writers.NAMES[1], *tables]


def read_any(root: Path, path: Path) -> dict:
    return transforms.read_cameras(path if path.suffix == ".json" else path.parents[1])[0]


def camera_nonsense(found: dict) -> str:
    sound = all(c.viewmat.shape == (4, 4) and c.K.shape == (3, 3) and min(c.width, c.height) > 0 for c in found.values())
    bad = "".join(not_finite(viewmat=c.viewmat, K=c.K) for c in found.values())
    return bad or ("" if sound and found else "a camera is none")


CAMERAS = (
    transforms.read_cameras, transforms._inria, transforms._transforms, transforms.colmap_folder, transforms._colmap,
    transforms._json, transforms.read_json, transforms._number, transforms.lens_of, transforms.matrix_of,
    read_cameras, read_poses,
)  # fmt: skip
CAMERA_CHANGES = (rarely(mutations.many_rows, json_value), json_value, text_number, text_line)
register(Target("cameras", camera_paths, read_any, CAMERAS, CAMERA_CHANGES, nonsense=camera_nonsense))


BOX = json.dumps({"center": [0.0, 1.0, 2.0], "size": [1.0, 2.0, 3.0], "rotation": np.eye(3).tolist()})
register(
    Target(
        "crop box", writing({"a.json": BOX.encode()}), lambda root, path: edit.box_of(str(path)),
        (edit.box_of,), (json_value, json_value, text_number), lines=0.85,
    )
)  # fmt: skip
