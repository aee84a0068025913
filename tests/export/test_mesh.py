"""Meshes as files, read back by numpy, by VTK and by pygltflib."""

import json
import struct

import numpy as np
import pytest

from warpgs.errors import DataError, UsageError
from warpgs.export.meshes_and_cameras import linear, rotation_to_y, write_mesh
from warpgs.scene import Mesh

TETRAHEDRON = Mesh(
    np.array([[1000.0, 0, -5], [1001, 0, -5], [1000, 2, -5], [1000, 0, -2]]),
    np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32),
    np.array([[0, 0, 0], [1, 0, 0.5], [0.2, 1, 0], [1, 1, 1]], np.float32),
)


def glb(path):
    """Return the document and the binary chunk of a .glb file, whose lengths are checked."""
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON") and length % 4 == 0
    binary, second = struct.unpack_from("<I4s", data, 20 + length)
    assert second == b"BIN\0" and binary % 4 == 0 and 28 + length + binary == len(data)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def test_ply_is_read_by_vtk(tmp_path):
    """Positions, triangles and 8-bit colours."""
    import pyvista

    write_mesh(tmp_path / "a.ply", TETRAHEDRON)
    found = pyvista.read(tmp_path / "a.ply")
    assert np.array_equal(found.points, TETRAHEDRON.vertices) and np.array_equal(found.regular_faces, TETRAHEDRON.faces)
    colors = np.asarray(found.point_data["RGB"])
    assert np.array_equal(colors[:, :3], np.round(255 * TETRAHEDRON.colors))


def test_glb_holds_the_mesh(tmp_path):
    """Positions around their middle with its translation, bounds, linear colours, triangles, aligned views."""
    write_mesh(tmp_path / "a.glb", TETRAHEDRON)
    text, data = glb(tmp_path / "a.glb")
    arrays = []
    for accessor, dtype in zip(text["accessors"], ("<f4", "<u2", "<u4"), strict=True):
        view = text["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        arrays.append(np.frombuffer(data, dtype, view["byteLength"] // np.dtype(dtype).itemsize, view["byteOffset"]))
    positions, colors, indices = arrays[0].reshape(-1, 3), arrays[1].reshape(-1, 4), arrays[2]
    inner, outer = text["nodes"][1], text["nodes"][0]
    assert np.allclose(positions + np.array(inner["translation"]), TETRAHEDRON.vertices) and outer["rotation"] == [0, 0, 0, 1]
    assert text["accessors"][0]["min"] == positions.min(0).tolist() and text["accessors"][0]["max"] == positions.max(0).tolist()
    assert np.array_equal(indices.reshape(-1, 3), TETRAHEDRON.faces) and (colors[:, 3] == 65535).all()
    assert np.allclose(colors[:, :3] / 65535, linear(TETRAHEDRON.colors), atol=1e-5)
    assert linear(np.array([0.0, 0.04, 0.5, 1.0])) == pytest.approx([0, 0.04 / 12.92, 0.21404, 1], abs=1e-5)


def test_glb_is_read_by_trimesh(tmp_path):
    """Another reader, which comes with viser, finds what was written."""
    library = pytest.importorskip("trimesh")
    write_mesh(tmp_path / "a.glb", TETRAHEDRON, np.array([0, 0, 1.0]))
    (found,) = library.load(tmp_path / "a.glb", process=False).geometry.values()
    assert np.array_equal(found.faces, TETRAHEDRON.faces) and found.vertices.shape == (4, 3)
    colors = found.visual.vertex_attributes["color"]
    assert np.allclose(colors[:, :3] / 65535, linear(TETRAHEDRON.colors), atol=1e-5)


@pytest.mark.parametrize("up", [(0, 1, 0), (0, -1, 0), (0, 0, 2), (-3, 0, 0), (0.3, -0.9, 0.2), (1e-9, -1, 0)])
def test_upwards_becomes_y(up):
    """The quaternion xyzw turns the direction to +y."""
    x, y, z, w = rotation_to_y(np.array(up, float))
    v, q = np.array(up, float) / np.linalg.norm(up), np.array([x, y, z])
    turned = v + 2 * np.cross(q, np.cross(q, v) + w * v)
    assert np.allclose(turned, [0, 1, 0], atol=1e-6) and np.isclose(x * x + y * y + z * z + w * w, 1)


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_what_is_no_mesh_is_not_written(tmp_path, suffix):
    """Numbers that are not finite, triangles of missing vertices, other suffixes."""
    path = tmp_path / f"a{suffix}"
    bad = TETRAHEDRON.vertices.copy()
    bad[1, 1] = np.nan
    with pytest.raises(DataError, match="not finite"):
        write_mesh(path, Mesh(bad, TETRAHEDRON.faces, TETRAHEDRON.colors))
    with pytest.raises(DataError, match="missing vertex"):
        write_mesh(path, Mesh(TETRAHEDRON.vertices[:3], TETRAHEDRON.faces, TETRAHEDRON.colors[:3]))
    with pytest.raises(UsageError, match=r"use \.ply or \.glb"):
        write_mesh(tmp_path / f"a.obj{suffix[1:]}", TETRAHEDRON)
    assert not list(tmp_path.iterdir())
