"""Scene folders of every format, with masks, for the fuzzer."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.faults.mutations import Change, json_value, many_rows, rarely, text_line, text_number
from tests.faults.targets import Target, not_finite, register
from tests.io import scenes
from warpgs.io import capture, colmap, load, maps, others, transforms
from warpgs.scene import Scene

MAX_PIXELS = 10_000


def read_scene(folder: Path, path: Path) -> Scene:
    """Read the scene that the changed file belongs to, with the options that the name of its folder asks for."""
    root = folder / path.relative_to(folder).parts[0]
    return load.load_scene(
        root, max_pixels=MAX_PIXELS, downscale=2 if "small" in root.name else 1,
        lenses="native" if "native" in root.name else "undistort",
    )  # fmt: skip


def nonsense(scene: Scene) -> str:
    """Say what no caller of `load_scene` should have to check."""
    for v in scene.views:
        K, R = v.camera.K, v.camera.viewmat[:3, :3]
        if bad := not_finite(viewmat=v.camera.viewmat, K=K, image=v.image):
            return bad
        if not (K[0, 0] > 0 and K[1, 1] > 0 and np.abs(R @ R.T - np.eye(3)).max() < 1e-9 and np.linalg.det(R) > 0):
            return "a camera is none"
        if not (v.image.min() >= 0 and v.image.max() <= 1 and v.image.shape == (v.camera.height, v.camera.width, 3)):
            return "an image is none"
        if any(m is not None and (m.shape != v.image.shape[:2] or not m.any()) for m in (v.mask, v.score_mask)):
            return "a mask is none"
    points = scene.points
    if points is not None:
        if bad := not_finite(points=points.points.astype(np.float32), colors=points.colors):
            return bad
        if points.tracks is not None and len(points.tracks) != len(points.points):
            return "tracks are none"
        if np.abs(points.points).max(initial=0) > 1e13:
            return "points are none"
    n = scene.normalization
    return not_finite(offset=n.offset, scale=np.array(n.scale))


def matrices_changed(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a .npy or .npz file through numpy: a number, the shape, the type, or the set of arrays."""
    try:
        with io.BytesIO(data) as f:
            loaded = np.load(f, allow_pickle=False)
            arrays = {"": loaded} if isinstance(loaded, np.ndarray) else {k: loaded[k] for k in loaded.files}
    except Exception:  # not whole: another change came first
        return data
    key = list(arrays)[int(rng.integers(len(arrays)))]
    array, kind = arrays[key].copy(), int(rng.integers(8))
    if kind <= 3 and array.size and array.dtype.kind == "f":
        at = int(rng.integers(array.size))
        values = (array.flat[at] * (1 + 1e-5 * rng.standard_normal()), *(0, 1, -1, np.nan, np.inf, 1e300, 1e-320, 1e12, 5e-324))
        array.flat[at] = values[0 if rng.random() < 0.5 else int(rng.integers(len(values)))]
    elif kind == 4 and array.ndim:
        array = (array[:-1], array[None], array.T, np.concatenate([array, array]))[int(rng.integers(4))]
    elif kind == 5 and array.dtype.kind != "S":  # text is no number
        array = array.astype(("f4", "i8", "u1", "c16", "S3", "?")[int(rng.integers(6))])
    elif kind == 6 and key:
        del arrays[key]
    elif kind == 7 and key:
        arrays[key + "0"] = array
    if key in arrays:
        arrays[key] = array
    out = io.BytesIO()
    if "" in arrays:
        np.save(out, arrays[""])
    else:
        np.savez(out, **arrays)
    return out.getvalue()


def add(name: str, writers: dict[str, Callable[[Path], object]], parser: tuple, changes: tuple[Change, ...]) -> None:
    """Register a format: writers of its variants by the folder of each, whose files but images are changed."""

    def prepare(folder: Path) -> list[Path]:
        for key, write in writers.items():
            write(folder / key)
        return sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix not in (".png", ".bmp"))

    register(Target(name, prepare, read_scene, parser, changes, nonsense=nonsense))


def write_frames(root: Path) -> Path:
    """Write a transforms scene with what a frame may have."""
    content = scenes.transforms_json(k1=0.01, camera_model="OPENCV", ply_file_path="x.ply")
    content["frames"][1] |= {"fl_x": 21.0, "cx": 8.5, "mask_path": "masks/photo2.png", "w": 16}
    content["frames"][3] |= {"file_path": "images/photo3"}
    content["frames"].append({"file_path": "images/gone.png", "transform_matrix": scenes.opengl(0)})
    for i in (1, 2):
        scenes.save(root / "masks" / f"photo{i}.png", np.tile(np.array([0, 255], np.uint8).repeat(8), (12, 1)))
    return scenes.write_transforms(root, content)


def write_native(root: Path) -> Path:
    """Write a transforms scene of a fisheye whose frames name their maps."""
    content = scenes.transforms_json(camera_model="OPENCV_FISHEYE", k1=0.01, k4=0.001, depth_unit_scale_factor=0.5)
    content["frames"][0] |= {"depth_file_path": "d.npy", "normal_file_path": "n.npy"}
    root.mkdir()
    np.save(root / "d.npy", np.ones((scenes.HEIGHT, scenes.WIDTH), np.float32))
    np.save(root / "n.npy", np.tile(np.float32([0, 0, -1]), (scenes.HEIGHT, scenes.WIDTH, 1)))
    return scenes.write_transforms(root, content)


def write_points(root: Path) -> None:
    scenes.write_transforms(root, scenes.transforms_json(ply_file_path="pc.ply"))
    (root / "pc.ply").write_bytes(PLY)


def write_exr(root: Path) -> None:
    content = scenes.transforms_json()
    content["frames"][0] |= {"depth_file_path": "d.exr"}
    scenes.write_transforms(root, content)


def write_dtu(root: Path) -> Path:
    scenes.save(root / "mask" / "003.png", np.tile(np.array([0, 255], np.uint8).repeat(8), (12, 1)))
    return scenes.write_dtu(root)


def write_small(root: Path, names: tuple[str, ...]) -> None:
    """Write a reconstruction with a ready-made folder of small images, which have names of their own."""
    scenes.write_colmap_txt(root)
    scenes.save_images(root / "images_2", names, 8, 6)


def radial(writer, model: str, *terms: float) -> Callable[[Path], object]:
    return functools.partial(writer, model=model, parameters=(20, *((20,) if model == "OPENCV" else ()), 8, 6, *terms))


PLY = b"""ply
format ascii 1.0
element vertex 2
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
end_header
0.1 0.2 0.3 255 0 51
-0.2 0.1 0.0 9 9 9
"""


def binary_ply() -> bytes:
    head = PLY[: PLY.index(b"end_header") + 11].replace(b"ascii", b"binary_little_endian")
    for name, i in ((b"red", b"0"), (b"green", b"1"), (b"blue", b"2")):
        head = head.replace(b"uchar " + name, b"float f_dc_" + i)
    return head + np.array([[0.1, 0.2, 0.3, 1, -1, 0.5], [-0.2, 0.1, 0, 0, 0, 0]], "<f4").tobytes()


def write_ply(root: Path, points: bytes = PLY) -> None:
    """Write a reconstruction with its points as PLY, and names with another suffix than the files."""
    scenes.write_colmap_txt(root, names=tuple(f"C:\\photo{i}.png" for i in range(scenes.VIEWS)))
    scenes.save_images(root / "images")
    (root / "sparse" / "points3D.txt").unlink()
    (root / "sparse" / "points3D.ply").write_bytes(points)


def write_nerfstudio(root: Path) -> None:
    applied = [[1, 0, 0, 0.1], [0, 0, 1, 0], [0, -1, 0, 0]]
    scenes.write_transforms(root, scenes.transforms_json(ply_file_path="pc.ply", applied_transform=applied, applied_scale=2))
    (root / "pc.ply").write_bytes(PLY)


TEXT = (text_number, text_number, text_line)
COLMAP = {
    "bin": radial(scenes.write_colmap, "OPENCV", 0.01, 0.001, 0.001, 0.001), "txt": scenes.write_colmap_txt,
    "radial": radial(scenes.write_colmap_txt, "SIMPLE_RADIAL", 0.01),
    "small stems": functools.partial(write_small, names=tuple(f"photo{i}.bmp" for i in range(scenes.VIEWS))),
    "ply": write_ply, "binary ply": functools.partial(write_ply, points=binary_ply()),
    "small order": functools.partial(write_small, names=tuple(f"image{i}.bmp" for i in range(scenes.VIEWS))),
}  # fmt: skip
FRAMES = {
    "own": write_frames, "ngp": scenes.write_ngp, "blender": scenes.write_blender, "ply": write_nerfstudio,
    "native": write_native, "native frames": write_frames, "points": write_points,
    "exr": write_exr,
}  # fmt: skip
FRAMES_PARSER = (
    transforms.files_of, transforms._json, transforms.read_json, transforms._inner_names,
    transforms._image_paths,
    transforms._number, transforms.lens_of, transforms.matrix_of, transforms._image_path,
    transforms._named_maps, transforms._points, transforms._disagreement, transforms.TransformsReader,
)  # fmt: skip
DTU = (others.decompose, others._centred, others._lens, others._read_matrices, others._number, others._masks, others.DTUReader)
MIDDLEBURY = (others.files_of, others.read_camera_rows, others._centred, others._lens, others.MiddleburyReader)
add("colmap", COLMAP, (colmap,), TEXT)
add("transforms", FRAMES, FRAMES_PARSER, (rarely(many_rows, json_value), json_value, text_number))
add("llff", {"a": scenes.write_llff}, (others.read_poses_bounds, others.LLFFReader), (matrices_changed,))
add("dtu", {"a": write_dtu}, DTU, (matrices_changed,))
add("middlebury", {"a": scenes.write_middlebury}, MIDDLEBURY, TEXT)


def xml_bomb(data: bytes, rng: np.random.Generator) -> bytes:
    doubled = "".join(f"<!ENTITY e{i + 1} '&e{i};&e{i};'>" for i in range(40)).encode()
    if rng.random() < 0.5:
        return b"<!DOCTYPE d [<!ENTITY e0 'ha'>" + doubled + b"]>" + data.replace(b"<chunk", b"<a>&e40;</a><chunk")
    return data.replace(b"<cameras>", b"<cameras>" + b"<a/>" * int(rng.integers(2**12, 2**20)))


TERMS = "".join(f"<{t}>0.01</{t}>" for t in ("cx", "cy", "b1", "k1", "k2", "k3", "p1", "p2"))
METASHAPE = {
    "frame": functools.partial(scenes.write_metashape, terms=TERMS),
    "native fisheye": functools.partial(scenes.write_metashape, terms="<k4>0.01</k4>", kind="fisheye"),
}  # fmt: skip
REALITYSCAN = {
    "lens": functools.partial(scenes.write_realityscan, lens="0.01,0.01,0.01,0.01,0.01,0,0.01,0.01"),
    "native": functools.partial(scenes.write_realityscan, lens="", header=scenes.RC_HEADER.partition(",px")[0]),
}  # fmt: skip
SHARED = (capture.CaptureReader, capture._points, capture._lens)
XML = (capture._xml, capture._Builder, capture._numbers, capture._sensor_lens, capture.MetashapeReader)
CSV = (capture._film_lens, capture.RealityScanReader)
add("metashape", METASHAPE, (*SHARED, *XML), (rarely(xml_bomb, text_number), text_number, text_line))
add("realityscan", REALITYSCAN, (*SHARED, *CSV), TEXT)


def write_maps(folder: Path) -> list[Path]:
    """Write maps of every kind for the images of a scene each."""
    shape = (scenes.HEIGHT, scenes.WIDTH)
    x = np.broadcast_to(np.linspace(-0.4, 0.4, scenes.WIDTH), shape)
    normals = np.stack([x, 0 * x, -np.sqrt(1 - x**2)], -1).astype(np.float32)
    metres = np.linspace(1, 3, x.size, dtype=np.float32).reshape(shape)
    for kind in ("png", "npy"):
        scenes.write_colmap(folder / kind)
        for name in ("depths", "normals"):
            (folder / kind / name).mkdir()
    scenes.save(folder / "png" / "depths" / "photo1.png", (1000 * metres).astype(np.uint16))
    scenes.save(folder / "png" / "depths" / "photo1.confidence.png", np.full(shape, 200, np.uint8))
    scenes.save(folder / "png" / "normals" / "photo1.png", np.round((normals + 1) * 127.5).astype(np.uint8))
    np.save(folder / "npy" / "depths" / "photo1.npy", metres)
    np.save(folder / "npy" / "depths" / "photo1.confidence.npy", metres / 3)
    np.save(folder / "npy" / "normals" / "photo1.npy", normals)
    return sorted(p for kind in ("png", "npy") for name in ("depths", "normals") for p in (folder / kind / name).iterdir())


def read_mapped(folder: Path, path: Path) -> Scene:
    root = folder / path.relative_to(folder).parts[0]
    return load.load_scene(root, max_pixels=MAX_PIXELS, depths=root / "depths", normals=root / "normals")


def nonsense_of_maps(scene: Scene) -> str:
    """Say what of the maps no part of a fit should have to check."""
    for v in scene.views:
        depth, size = v.depth, (v.camera.height, v.camera.width)
        sure = None if depth is None else depth.confidence
        if bad := not_finite(depth=None if depth is None else depth.values, confidence=sure, normals=v.normals):
            return bad
        if depth is not None and not (depth.values.shape == size and depth.values.min() >= 0 and depth.values.any()):
            return "a depth map is none"
        if sure is not None and not (sure.shape == size and sure.min() >= 0 and sure.max() <= 1):
            return "a confidence is none"
        if v.normals is not None:
            lengths = np.linalg.norm(v.normals, axis=-1)
            if v.normals.shape != (*size, 3) or not ((lengths == 0) | (np.abs(lengths - 1) < 1e-4)).all():
                return "normals are none"
    return nonsense(scene)


register(
    Target(
        "given maps", write_maps, read_mapped, (maps, maps), (matrices_changed,), nonsense=nonsense_of_maps,
        lines=0.7,
    )
)  # fmt: skip


def write_masked(folder: Path) -> list[Path]:
    root = scenes.write_colmap(folder / "a")
    half = np.tile(np.array([0, 255], np.uint8).repeat(8), (12, 1))
    for i in range(scenes.VIEWS):
        scenes.save(root / "idrmasks" / f"{i:03d}.png", half)
        scenes.save(root / "masks" / f"photo{i}.png", half)
    return [*sorted((root / "masks").iterdir()), *sorted((root / "idrmasks").iterdir())]
