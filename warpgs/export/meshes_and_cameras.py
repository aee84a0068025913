"""Files of meshes and of cameras for other programs."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from warpgs.errors import DataError, UsageError
from warpgs.export.gltf import glb
from warpgs.files import filling, is_empty, make_folder, write_bytes, write_json, write_text
from warpgs.geometry import pinhole_of, quaternions
from warpgs.scene import Camera, Mesh
from warpgs.version import __version__

SUFFIXES = (".ply", ".glb")
"""Suffixes of the files that can be written."""
MAX_BYTES = 2**32 - 2**16
"""Largest buffer of a glTF file: its lengths are 32-bit numbers, and some are of its document."""


def check_suffix(path: str | os.PathLike[str]) -> None:
    """Check that a mesh can be written to such a file."""
    suffix = Path(path).suffix
    if suffix.lower() not in SUFFIXES:
        raise UsageError(f"{path}: format {suffix or '(none)'} is not supported; use {' or '.join(SUFFIXES)}")


def write_mesh(path: str | os.PathLike[str], mesh: Mesh, up: np.ndarray | None = None) -> None:
    """Write a mesh to a .ply or .glb file, atomically."""
    path = Path(path)
    check_suffix(path)
    if not (np.isfinite(mesh.vertices).all() and np.isfinite(mesh.colors).all()):
        raise DataError(f"{path}: not written, the mesh holds numbers that are not finite; make it again")
    if mesh.faces.size and not (mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)):
        raise DataError(f"{path}: not written, a triangle refers to a missing vertex; make the mesh again")
    if path.suffix.lower() == ".ply":
        write_bytes(path, *_ply(mesh))
    else:
        write_bytes(path, *_glb(path, mesh, up))


def _ply(mesh: Mesh) -> list[bytes]:
    """Return header, vertices and faces: float32 positions, 8-bit colours, lists of three int32."""
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment warpgs {__version__}\nelement vertex {len(mesh.vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    vertices = np.empty(len(mesh.vertices), [("position", "<f4", 3), ("color", "u1", 3)])
    vertices["position"], vertices["color"] = mesh.vertices, np.round(255 * np.clip(mesh.colors, 0, 1))
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, mesh.faces
    return [header.encode("ascii"), vertices.tobytes(), faces.tobytes()]


def linear(colors: np.ndarray) -> np.ndarray:
    """Return sRGB colours in [0, 1] as linear colours (IEC 61966-2-1), which glTF stores; the shape is unchanged."""
    c = np.clip(colors.astype(np.float64), 0, 1)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def rotation_to_y(up: np.ndarray) -> list[float]:
    """Return the shortest rotation that turns a direction [3], of any length, to +y, as a unit quaternion xyzw, shape [4]."""
    x, y, z = np.asarray(up, np.float64) / np.linalg.norm(up)
    if y < -1 + 1e-12:
        return [1.0, 0.0, 0.0, 0.0]
    q = np.array([-z, 0.0, x, 1.0 + y])  # cross product of up and +y, and 1 plus their dot product
    unit: list[float] = (q / np.linalg.norm(q)).tolist()
    return unit


def _glb(path: Path, mesh: Mesh, up: np.ndarray | None) -> list[bytes]:
    """Return the chunks of a glTF 2.0 file: one node, one unlit mesh, positions, colours and triangles.

    Positions are float32 relative to their middle, the node's translation, because float32 is coarse far from the origin.
    """
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2 if len(mesh.vertices) else np.zeros(3)
    positions = (mesh.vertices - middle).astype("<f4")
    colors = np.full((len(mesh.vertices), 4), 65535, "<u2")
    colors[:, :3] = np.round(65535 * linear(mesh.colors))
    arrays = [positions.tobytes(), colors.tobytes(), mesh.faces.astype("<u4").tobytes()]
    starts = np.cumsum([0, *map(len, arrays)]).tolist()
    rotation = [0.0, 0.0, 0.0, 1.0] if up is None else rotation_to_y(up)
    extent = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()} if len(positions) else {}
    kinds = [
        (5126, "VEC3", len(positions), extent),
        (5123, "VEC4", len(colors), {"normalized": True}),
        (5125, "SCALAR", mesh.faces.size, {}),
    ]
    text = {
        "asset": {"version": "2.0", "generator": f"warpgs {__version__}"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], "rotation": rotation}, {"mesh": 0, "translation": middle.tolist()}],
        "materials": [{"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "buffers": [{"byteLength": starts[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": begin, "byteLength": len(a), "target": target}
            for begin, a, target in zip(starts, arrays, (34962, 34962, 34963))
        ],
        "accessors": [
            {"bufferView": i, "componentType": kind, "type": form, "count": count, **more}
            for i, (kind, form, count, more) in enumerate(kinds)
        ],
    }  # fmt: skip
    if starts[-1] > MAX_BYTES:
        raise DataError(
            f"{path}: a mesh of {starts[-1]:,} bytes is beyond the 4 GiB of a .glb file; ask for fewer triangles, or write .ply"
        )
    return glb(text, *arrays)


# Cameras as files for other programs: cameras.json of the INRIA 3DGS code, which splat editors read, transforms.json,
# COLMAP.
#
# Images are named by number, so that the files contain no name or path of the user.

NAMES = ("cameras.json", "transforms.json", "sparse")
"""Names of files, and of a folder, that determine the format."""
MAX_OFF_CENTER = 0.01
"""Distance from the image centre [px] above which a note reports that the file does not store the principal point."""


def holds_cameras(path: Path) -> bool:
    """Return whether a file name is that of a camera format."""
    return path.name in NAMES


def write_cameras(path: Path, cameras: list[Camera]) -> list[str]:
    """Write cameras in the format of the file name; returns notes for the user."""
    if not holds_cameras(path):
        raise UsageError(f"{path}: cameras go to {' or '.join(NAMES[:2])}, or to a folder named {NAMES[2]} (COLMAP)")
    bent = sum(c.model != "pinhole" for c in cameras)
    notes = [f"{bent} of {len(cameras)} cameras are written without their lens distortion, as pinholes"] if bent else []
    cameras = [pinhole_of(c) for c in cameras]
    if path.name == "transforms.json":
        write_json(path, {"camera_model": "PINHOLE", "frames": [_frame(i, c) for i, c in enumerate(cameras)]})
    elif path.name == "sparse":
        if path.exists() and not (path.is_dir() and is_empty(path)):
            raise UsageError(f"{path}: exists already and may be a reconstruction; give another folder")
        with filling(path) as temporary:
            make_folder(temporary / "0")
            for name, text in _colmap(cameras).items():
                write_text(temporary / "0" / name, text)
    else:
        write_json(path, [_inria(i, c) for i, c in enumerate(cameras)])
        off = max((max(abs(c.K[0, 2] - c.width / 2), abs(c.K[1, 2] - c.height / 2)) for c in cameras), default=0.0)
        if off > MAX_OFF_CENTER:
            notes.append(
                "cameras.json stores no principal points, which are up to "
                f"{off:.1f} px off the image centre; write transforms.json to keep them"
            )
    return notes


def _world_from_camera(camera: Camera) -> np.ndarray:
    """Return the pose [4, 4] from the camera's axes to the world's."""
    pose = np.eye(4)
    pose[:3, :3] = camera.viewmat[:3, :3].T
    pose[:3, 3] = camera.center
    return pose


def _inria(number: int, camera: Camera) -> dict[str, object]:
    """Return the row of a camera; the format has no principal point."""
    pose = _world_from_camera(camera)
    return {
        "id": number, "img_name": f"{number:04d}", "width": camera.width, "height": camera.height,
        "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist(),
        "fy": float(camera.K[1, 1]), "fx": float(camera.K[0, 0]),
    }  # fmt: skip


def _frame(number: int, camera: Camera) -> dict[str, object]:
    """Return the frame of a camera, with the axes of OpenGL."""
    pose = _world_from_camera(camera)
    pose[:3, 1:3] *= -1
    return {
        "file_path": f"images/{number:04d}.png", "w": camera.width, "h": camera.height,
        "fl_x": float(camera.K[0, 0]), "fl_y": float(camera.K[1, 1]), "cx": float(camera.K[0, 2]), "cy": float(camera.K[1, 2]),
        "transform_matrix": pose.tolist(),
    }  # fmt: skip


def _colmap(cameras: list[Camera]) -> dict[str, str]:
    """Return COLMAP's text files by name: a camera for each lens, images without points, and no points."""
    import torch

    lenses: dict[tuple, int] = {}
    rows = []
    rotations = torch.from_numpy(np.stack([np.array(c.viewmat[:3, :3], np.float64) for c in cameras]))
    for i, (c, quat) in enumerate(zip(cameras, quaternions(rotations).tolist()), 1):
        lens = (c.width, c.height, *(float(v) for v in (c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2])))
        number = lenses.setdefault(lens, len(lenses) + 1)
        values = [*quat, *(float(v) for v in c.viewmat[:3, 3])]
        rows.append(f"{i} {' '.join(map(repr, values))} {number} {i - 1:04d}.png\n\n")  # the second line would hold its points
    return {
        "cameras.txt": "".join(f"{n} PINHOLE {' '.join(map(repr, lens))}\n" for lens, n in lenses.items()),
        "images.txt": "".join(rows),
        "points3D.txt": "",
    }
