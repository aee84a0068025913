"""Files of meshes and of cameras for other programs."""

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.errors import DataError, UsageError, expect, explained
from warpgs.export.base import origin_comment
from warpgs.export.gltf import buffer_of, glb, linear
from warpgs.files import filling, is_empty, make_folder, write_bytes, write_json, write_text
from warpgs.geometry import pinhole_of, pose_of, quaternions
from warpgs.scene import ORIGIN, Camera, Mesh
from warpgs.version import __version__

SUFFIXES = (".ply", ".glb")
"""Suffixes of the files that can be written."""
MAX_BYTES = 2**32 - 2**16
"""Largest buffer of a glTF file: its lengths are 32-bit numbers, and some are of its document."""


def check_suffix(path: str | os.PathLike[str]) -> None:
    """Check that a mesh can be written to such a file."""
    if (suffix := Path(path).suffix).lower() not in SUFFIXES:
        raise UsageError(f"{path}: format {suffix or '(none)'} is not supported; use {' or '.join(SUFFIXES)}")


def write_mesh(
    path: str | os.PathLike[str], mesh: Mesh, up: np.ndarray | None = None, origin: np.ndarray | None = None,
    ahead: np.ndarray | None = None,
) -> None:  # fmt: skip
    """Write a mesh to a .ply or .glb file, atomically; the file states the ``origin`` [3] that its vertices are about.

    In a .glb file, ``up`` [3] becomes +y, and a viewer looks along ``ahead`` [3], if they are given.
    """
    path, origin = Path(path), np.zeros(3) if origin is None else origin
    check_suffix(path)
    with explained(f"{path}: not written", "make the mesh again", ValueError):
        expect(np.isfinite(mesh.vertices).all() and np.isfinite(mesh.colors).all(), "it holds numbers that are not finite")
        expect(((mesh.faces >= 0) & (mesh.faces < len(mesh.vertices))).all(), "a triangle refers to a missing vertex")
    turn = None if up is None else rotation_to_y(up, ahead)
    write_bytes(path, *(_ply(mesh, origin) if path.suffix.lower() == ".ply" else _glb(path, mesh, turn, origin)))


def _stated(origin: np.ndarray) -> dict[str, object]:
    """Return the JSON member that states an origin [3]; none for 0."""
    return {ORIGIN: origin.tolist()} if origin.any() else {}


def _ply(mesh: Mesh, origin: np.ndarray) -> list[bytes]:
    """Return header, vertices and faces: float32 positions, 8-bit colours, lists of three int32."""
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment warpgs {__version__}\n{origin_comment(origin)}"
        f"element vertex {len(mesh.vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    vertices = np.empty(len(mesh.vertices), [("position", "<f4", 3), ("color", "u1", 3)])
    vertices["position"], vertices["color"] = mesh.vertices, np.round(255 * np.clip(mesh.colors, 0, 1))
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, mesh.faces
    return [header.encode("ascii"), vertices.tobytes(), faces.tobytes()]


def rotation_to_y(up: np.ndarray, ahead: np.ndarray | None = None) -> list[float]:
    """Return the rotation of a direction [3] to +y, and of a level one ``ahead`` to -z, as a unit quaternion xyzw, shape [4].

    Without ``ahead``, or if it is upright, the rotation is the shortest.
    """
    x, y, z = unit_up = np.asarray(up, np.float64) / np.linalg.norm(up)
    side = np.zeros(3) if ahead is None else np.cross(ahead, unit_up)
    if (length := np.linalg.norm(side)) > 1e-6:
        import torch

        rows = np.stack([side / length, unit_up, np.cross(side / length, unit_up)])
        w, *xyz = quaternions(torch.from_numpy(rows[None]))[0].tolist()
        return [*xyz, w]
    if y < -1 + 1e-12:
        return [1.0, 0.0, 0.0, 0.0]
    q = np.array([-z, 0.0, x, 1.0 + y])  # cross product of up and +y, and 1 plus their dot product
    return (q / np.linalg.norm(q)).tolist()


def _jpeg(pixels: np.ndarray) -> bytes:
    """Return 8-bit colours [H, W, 3] as a JPEG file of full chroma, padded to a multiple of four bytes."""
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "JPEG", quality=92, subsampling=0)
    return data.getvalue() + b"\0" * (-len(data.getvalue()) % 4)


def _glb(path: Path, mesh: Mesh, rotation: list[float] | None, origin: np.ndarray) -> list[bytes]:
    """Return the chunks of a glTF 2.0 file: one turned node, one unlit mesh, positions, and colours or a texture.

    Positions are float32 relative to their middle, the node's translation, because float32 is coarse far from the origin.
    """
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2 if len(mesh.vertices) else np.zeros(3)
    positions, faces, colors = (mesh.vertices - middle).astype("<f4"), mesh.faces, mesh.colors
    attributes: dict[str, int] = {"POSITION": 0, "COLOR_0": 1}
    material: dict[str, Any] = {"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}
    textures: dict[str, Any] = {}
    coordinates: list[tuple[str, np.ndarray]] = []
    files: list[bytes] = []
    if mesh.texture is not None and mesh.uv is not None:  # which multiplies the colours: they are white where it shows
        shown = (mesh.uv != mesh.uv[:, :1]).any((1, 2))
        corners = np.concatenate([mesh.faces.reshape(-1, 1), mesh.uv.astype("<f4").view("<i4").reshape(-1, 2)], 1)
        corners, first, number = np.unique(corners, axis=0, return_index=True, return_inverse=True)
        faces, positions = number.reshape(-1, 3), positions[corners[:, 0]]
        colors = np.where(shown.repeat(3)[first, None], 1, mesh.colors[corners[:, 0]])
        coordinates, files = [("VEC2", np.ascontiguousarray(corners[:, 1:], "<i4").view("<f4"))], [_jpeg(mesh.texture)]
        textures = {"textures": [{"source": 0}], "images": [{"bufferView": 4, "mimeType": "image/jpeg"}]}
        attributes["TEXCOORD_0"] = 3
        material["pbrMetallicRoughness"] = {"baseColorTexture": {"index": 0}}
    levels = np.full((len(positions), 4), 65535, "<u2")
    levels[:, :3] = np.round(65535 * linear(colors))
    columns = [("VEC3", positions), ("VEC4", levels), ("SCALAR", faces.astype("<u4").reshape(-1)), *coordinates]
    members, pieces = buffer_of(columns, *files)
    text = {
        "asset": {"version": "2.0", "generator": f"warpgs {__version__}"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], "rotation": rotation or [0.0, 0.0, 0.0, 1.0]}, {"mesh": 0, "translation": middle.tolist()}],
        "materials": [material], **textures,
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 2, "material": 0}]}],
        **members,
    }  # fmt: skip
    if origin.any():
        text["extras"] = _stated(origin)
    if (size := sum(map(len, pieces))) > MAX_BYTES:
        raise DataError(f"{path}: a mesh of {size:,} bytes is over the 4 GiB of .glb; ask for less, or write .ply")
    return glb(text, *pieces)


# Cameras as files for other programs: cameras.json of the INRIA 3DGS code, which splat editors read, transforms.json,
# COLMAP.
#
# Images are named by number, so that the files contain no name or path of the user, unless the user asks for the names.

NAMES = ("cameras.json", "transforms.json", "sparse")
"""Names of files, and of a folder, that determine the format."""
MAX_OFF_CENTER = 0.01
"""Distance from the image centre [px] above which a note reports that the file does not store the principal point."""


def holds_cameras(path: Path) -> bool:
    """Return whether a file name is that of a camera format."""
    return path.name in NAMES


def write_cameras(
    path: Path, cameras: list[Camera], names: Sequence[str] | None = None, points: tuple[np.ndarray, np.ndarray] | None = None,
    origin: np.ndarray | None = None,
) -> list[str]:  # fmt: skip
    """Write cameras in the format of the file name; returns notes for the user.

    Args:
        path: The file, or a folder named sparse.
        cameras: N cameras in file units, about the origin.
        names: Names of their N images, relative to the folder of the images; None for numbers.
        points: Positions [P, 3] and colours [P, 3], 0 to 1, which only COLMAP's files hold: other trainers start from them.
        origin: Point [3] that the cameras are about, which the files state; None for 0.
    """
    origin = np.zeros(3) if origin is None else origin
    if not holds_cameras(path):
        raise UsageError(f"{path}: cameras go to {' or '.join(NAMES[:2])}, or to a folder named {NAMES[2]} (COLMAP)")
    bent = sum(c.model != "pinhole" for c in cameras)
    notes = [f"{bent} of {len(cameras)} cameras are written without their lens distortion, as pinholes"] if bent else []
    cameras = [pinhole_of(c) for c in cameras]
    images = [f"{i:04d}.png" for i in range(len(cameras))] if names is None else [n.removeprefix("images/") for n in names]
    if path.name == "transforms.json":
        frames = [_frame(n, c) for n, c in zip(images, cameras)]
        write_json(path, {"camera_model": "PINHOLE", "frames": frames} | _stated(origin))
    elif path.name == "sparse":
        if path.exists() and not (path.is_dir() and is_empty(path)):
            raise UsageError(f"{path}: exists already and may be a reconstruction; give another folder")
        if spaced := [name for name in images if len(name.split()) != 1]:
            raise UsageError(f"{path}: COLMAP's text files cannot hold the name {spaced[0]!r}; leave out --keep-names")
        with filling(path) as temporary:
            make_folder(temporary / "0")
            for name, text in _colmap(images, cameras, points).items():
                write_text(temporary / "0" / name, origin_comment(origin, "#") + text)
    else:
        stems = images if names is not None else [name.removesuffix(".png") for name in images]
        write_json(path, [_inria(i, n, c) | _stated(origin) for i, (n, c) in enumerate(zip(stems, cameras))])
        off = max((max(abs(c.K[0, 2] - c.width / 2), abs(c.K[1, 2] - c.height / 2)) for c in cameras), default=0.0)
        if off > MAX_OFF_CENTER:
            notes.append(f"cameras.json stores no principal points, which are up to {off:.1f} px off; write transforms.json")
    return notes


def _inria(number: int, name: str, camera: Camera) -> dict[str, object]:
    """Return the row of a camera; the format has no principal point."""
    pose = pose_of(camera.viewmat[:3, :3].T, camera.center)
    return {
        "id": number, "img_name": name, "width": camera.width, "height": camera.height,
        "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist(),
        "fy": float(camera.K[1, 1]), "fx": float(camera.K[0, 0]),
    }  # fmt: skip


def _frame(name: str, camera: Camera) -> dict[str, object]:
    """Return the frame of a camera, with the axes of OpenGL."""
    pose = pose_of(camera.viewmat[:3, :3].T, camera.center)
    pose[:3, 1:3] *= -1
    return {
        "file_path": f"images/{name}", "w": camera.width, "h": camera.height,
        "fl_x": float(camera.K[0, 0]), "fl_y": float(camera.K[1, 1]), "cx": float(camera.K[0, 2]), "cy": float(camera.K[1, 2]),
        "transform_matrix": pose.tolist(),
    }  # fmt: skip


def _colmap(names: list[str], cameras: list[Camera], points: tuple[np.ndarray, np.ndarray] | None) -> dict[str, str]:
    """Return COLMAP's text files by name: a camera for each lens, images, and points that no image names."""
    import torch

    lenses: dict[tuple, int] = {}
    rows = []
    rotations = torch.from_numpy(np.stack([np.array(c.viewmat[:3, :3], np.float64) for c in cameras]))
    for i, (c, quat) in enumerate(zip(cameras, quaternions(rotations).tolist()), 1):
        lens = (c.width, c.height, *(float(v) for v in (c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2])))
        number = lenses.setdefault(lens, len(lenses) + 1)
        values = [*quat, *(float(v) for v in c.viewmat[:3, 3])]
        rows.append(f"{i} {' '.join(map(repr, values))} {number} {names[i - 1]}\n\n")  # the second line would hold its points
    positions, colors = (np.empty((0, 3)),) * 2 if points is None else points
    shown = enumerate(zip(positions.tolist(), np.round(255 * np.clip(colors, 0, 1)).astype(int).tolist()), 1)
    return {
        "cameras.txt": "".join(f"{n} PINHOLE {' '.join(map(repr, lens))}\n" for lens, n in lenses.items()),
        "images.txt": "".join(rows),
        "points3D.txt": "".join(f"{i} {' '.join(map(repr, xyz))} {' '.join(map(str, rgb))} 0\n" for i, (xyz, rgb) in shown),
    }
