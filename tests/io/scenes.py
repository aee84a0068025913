"""Tiny scenes, five images of 16 x 12 px seen by the same cameras, written in every format that warpgs reads."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from warpgs.errors import DataError
from warpgs.io.load import load_scene

VIEWS, WIDTH, HEIGHT, FOCAL = 5, 16, 12, 20.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
POINT = np.array([0.1, 0.2, 0.3])
NAMES = tuple(f"photo{i}.png" for i in range(VIEWS))
POINTS = np.array([[0.1, 0.2, 0.3], [-0.2, 0.1, 0.0], [0.0, -0.1, 0.2]])
TRACKS = ((0, 1, 2), (1, 4), (3,))
"""Indices of the views that saw each of POINTS."""


def viewmat(i: int) -> np.ndarray:
    angle = -0.6 + 0.3 * i
    center = np.array([3 * np.sin(angle), -0.4 + 0.1 * i, -3 * np.cos(angle)])
    z = -center / np.linalg.norm(center)
    x = np.cross([0.1, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = rotation, -rotation @ center
    return m


VIEWMATS = np.array([viewmat(i) for i in range(VIEWS)])


def pixel(i: int, point: np.ndarray = POINT) -> np.ndarray:
    x = VIEWMATS[i, :3, :3] @ point + VIEWMATS[i, :3, 3]
    return (K @ (x / x[2]))[:2]


def image(i: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Return RGB, uint8: red grows to the right, green downwards, blue with the view."""
    x, y = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    red, green = np.meshgrid(x, y)
    return np.round(255 * np.stack([red, green, np.full_like(red, i / VIEWS)], axis=-1)).astype(np.uint8)


def save(path: Path, rgb: np.ndarray, *options) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    order = {2: slice(None), 3: [2, 1, 0], 4: [2, 1, 0, 3]}
    data = rgb if rgb.ndim == 2 else np.ascontiguousarray(rgb[..., order[rgb.shape[2] if rgb.shape[2] > 2 else 2]])
    ok, encoded = cv2.imencode(path.suffix, data, list(options))
    assert ok
    path.write_bytes(encoded.tobytes())


def save_images(folder: Path, names=NAMES, width: int = WIDTH, height: int = HEIGHT) -> None:
    for i, name in enumerate(names):
        save(folder / name, image(i, width, height))


def quaternion(R: np.ndarray) -> np.ndarray:
    w = np.sqrt(max(1 + np.trace(R), 1e-12)) / 2
    return np.array([w, *(np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w))])


def pose_numbers(i: int) -> list[float]:
    """Return quaternion and translation of a view as COLMAP writes them."""
    return [*quaternion(VIEWMATS[i, :3, :3]), *VIEWMATS[i, :3, 3]]


MODELS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE",
)  # fmt: skip
"""COLMAP's camera models in the order of their ids."""
PINHOLE = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)


def colmap_bin(model="PINHOLE", parameters=PINHOLE, names=NAMES, size=(WIDTH, HEIGHT)) -> dict[str, bytes]:
    cameras = struct.pack("<QiiQQ", 1, 1, MODELS.index(model), *size) + struct.pack(f"<{len(parameters)}d", *parameters)
    images = struct.pack("<Q", len(names))
    for i, name in enumerate(names):
        seen = 2 if i == 0 else 0
        images += struct.pack("<i7di", i + 1, *pose_numbers(i), 1) + name.encode() + b"\0"
        images += struct.pack("<Q", seen) + struct.pack("<ddq", 1.0, 2.0, -1) * seen
    points = struct.pack("<Q", len(POINTS))
    for n, (point, track) in enumerate(zip(POINTS, TRACKS)):
        points += struct.pack("<Q3d3BdQ", n + 1, *point, 255, 0, 51, 0.5, len(track))
        points += b"".join(struct.pack("<ii", i + 1, 0) for i in track)
    return {"cameras.bin": cameras, "images.bin": images, "points3D.bin": points}


def colmap_txt(model="PINHOLE", parameters=PINHOLE, names=NAMES, size=(WIDTH, HEIGHT)) -> dict[str, bytes]:
    cameras = f"# Camera list\n1 {model} {size[0]} {size[1]} {' '.join(map(repr, map(float, parameters)))}\n"
    images = "# Image list\n"
    for i, name in enumerate(names):
        images += f"{i + 1} {' '.join(repr(float(v)) for v in pose_numbers(i))} 1 {name}\n"
        images += "1.0 2.0 -1 3.0 4.0 7\n" if i == 0 else "\n"
    points = "# 3D point list\n"
    for n, (point, track) in enumerate(zip(POINTS, TRACKS)):
        seen = "".join(f" {i + 1} 0" for i in track)
        points += f"{n + 1} {' '.join(repr(float(v)) for v in point)} 255 0 51 0.5{seen}\n"
    return {"cameras.txt": cameras.encode(), "images.txt": images.encode(), "points3D.txt": points.encode()}


def write_files(folder: Path, files: dict[str, bytes]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)


def write_colmap(root: Path, **options) -> Path:
    write_files(root / "sparse" / "0", colmap_bin(**options))
    save_images(root / "images", options.get("names", NAMES))
    return root


def write_colmap_txt(root: Path, **options) -> Path:
    write_files(root / "sparse", colmap_txt(**options))
    save_images(root / "images", options.get("names", NAMES))
    return root


def opengl(i: int) -> list[list[float]]:
    return (np.linalg.inv(VIEWMATS[i]) @ np.diag([1.0, -1, -1, 1])).tolist()


def transforms_json(names=NAMES, **shared) -> dict:
    shared = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2} | shared
    frames = [{"file_path": f"images/{n}", "transform_matrix": opengl(i)} for i, n in enumerate(names)]
    return {k: v for k, v in shared.items() if v is not None} | {"frames": frames}


def write_transforms(root: Path, content: dict | None = None, names=NAMES) -> Path:
    save_images(root / "images", names)
    (root / "transforms.json").write_text(json.dumps(content or transforms_json(names)))
    return root


def write_ngp(root: Path) -> Path:
    angle = 2 * np.arctan(WIDTH / 2 / FOCAL)
    return write_transforms(root, transforms_json(w=None, h=None, fl_x=None, fl_y=None, cx=None, cy=None, camera_angle_x=angle))


def write_blender(root: Path) -> Path:
    """Write three views in train, one each in val and test: left halves transparent, suffixes left out."""
    angle = 2 * np.arctan(WIDTH / 2 / FOCAL)
    parts = {"train": (0, 1, 2), "val": (3,), "test": (4,)}
    for part, ids in parts.items():
        frames = [{"file_path": f"./{part}/r_{i}", "transform_matrix": opengl(i)} for i in ids]
        for i in ids:
            alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
            alpha[:, : WIDTH // 2] = 0
            save(root / part / f"r_{i}.png", np.concatenate([image(i), alpha], axis=2))
        (root / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return root


def llff_rows() -> np.ndarray:
    rows = []
    for m in VIEWMATS:
        pose = np.linalg.inv(m)
        columns = [pose[:3, 1], pose[:3, 0], -pose[:3, 2], pose[:3, 3], [HEIGHT, WIDTH, FOCAL]]
        rows.append([*np.stack(columns, axis=1).ravel(), 1.0, 5.0])
    return np.array(rows)


def write_llff(root: Path) -> Path:
    save_images(root / "images")
    np.save(root / "poses_bounds.npy", llff_rows())
    return root


SCALE_MAT = np.array([[2.0, 0, 0, 0.3], [0, 2, 0, -0.1], [0, 0, 2, 0.2], [0, 0, 0, 1]])
K_WHOLE = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""Intrinsics for formats whose pixel centres lie at whole numbers."""


def dtu_matrices() -> dict[str, np.ndarray]:
    lift = np.eye(4)
    lift[:3, :3] = K_WHOLE
    worlds = {f"world_mat_{i}": -2.5 * (lift @ m) for i, m in enumerate(VIEWMATS)}  # projections are given up to a factor
    for world in worlds.values():
        world[3] = (0, 0, 0, 1)
    return worlds | {f"scale_mat_{i}": SCALE_MAT for i in range(VIEWS)}


def write_dtu(root: Path) -> Path:
    save_images(root / "image", [f"{i:06d}.png" for i in range(VIEWS)])
    np.savez(root / "cameras.npz", **dtu_matrices())
    return root


def middlebury_text() -> str:
    lines = [str(VIEWS)]
    for i, name in enumerate(NAMES):
        numbers = [*K_WHOLE.ravel(), *VIEWMATS[i, :3, :3].ravel(), *VIEWMATS[i, :3, 3]]
        lines.append(" ".join([name, *(repr(float(v)) for v in numbers)]))
    return "\n".join(lines) + "\n"


def write_middlebury(root: Path) -> Path:
    save_images(root)
    (root / "tiny_par.txt").write_text(middlebury_text())
    return root


COMPONENT = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), 2.0, np.array([0.5, -0.2, 0.1])
"""Rotation, scale and translation from the coordinates of Metashape's component to those of the scene."""
LABELS = tuple(n.removesuffix(".png") for n in NAMES)


def spaced(values) -> str:
    """Return numbers in full, with spaces between them."""
    return " ".join(repr(float(v)) for v in np.ravel(values))


METASHAPE_CAMERA = f'<camera sensor_id="0" label="a"><transform>{spaced(np.eye(4))}</transform></camera>'


def metashape_xml(terms: str = "", camera: str = "", kind: str = "frame", labels=LABELS) -> str:
    """Return cameras as Agisoft XML, with terms of the calibration, and with cameras behind ours."""
    R, s, t = COMPONENT
    rows = []
    for i, label in enumerate(labels):
        pose = np.linalg.inv(VIEWMATS[i])
        pose[:3, 3] = R.T @ (pose[:3, 3] - t) / s
        pose[:3, :3] = R.T @ pose[:3, :3]
        rows.append(
            f'<camera id="{i}" sensor_id="0" component_id="1" label="{label}"><transform>{spaced(pose)}</transform></camera>'
        )
    moved = f"<rotation>{spaced(R)}</rotation><translation>{spaced(t)}</translation><scale>{s}</scale>"
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    initial = f'<calibration type="{kind}" class="initial">{size}<f>9</f></calibration>'
    calibration = f'<calibration type="{kind}" class="adjusted">{size}<f>{FOCAL}</f>{terms}</calibration>'
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1"><sensors>'
        f'<sensor id="0" type="{kind}">{size}{initial}{calibration}</sensor></sensors>'
        f'<components><component id="1"><transform>{moved}</transform></component></components>'
        f'<cameras><group label="a">{"".join(rows[:2])}</group>{"".join(rows[2:])}{camera}</cameras></chunk></document>'
    )


def points_ply(points: np.ndarray = POINTS) -> bytes:
    head = "ply\nformat ascii 1.0\nelement vertex {}\n" + "".join(f"property float {c}\n" for c in "xyz")
    head += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    return (head.format(len(points)) + "".join(f"{spaced(p)} 255 0 51\n" for p in points)).encode()


def write_metashape(root: Path, **options) -> Path:
    save_images(root / "images")
    (root / "cameras.xml").write_text(metashape_xml(**options))
    (root / "points.ply").write_bytes(points_ply())
    return root


RC_HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"


def angles(R: np.ndarray) -> np.ndarray:
    """Return heading, pitch and roll [deg] of camera to world with OpenGL axes, Rz(-heading) Rx(pitch) Ry(roll)."""
    return np.degrees([np.arctan2(R[0, 1], R[1, 1]), np.arcsin(R[2, 1]), np.arctan2(-R[2, 0], R[2, 2])])


def realityscan_csv(lens: str = "0,0,0,0,0,0,0,0", header: str = RC_HEADER, names=NAMES) -> str:
    """Return cameras as RealityScan's CSV, with the principal point and the distortion of all."""
    lines = [f"#cameras {len(names)}", header]
    for i, name in enumerate(names):
        pose = np.array(opengl(i))
        numbers = [*pose[:3, 3], *angles(pose[:3, :3]), FOCAL * 36 / WIDTH]
        lines.append(",".join([name, *(repr(float(v)) for v in numbers), *([lens] if lens else [])]))
    return "\r\n".join(lines) + "\r\n"


def write_realityscan(root: Path, **options) -> Path:
    save_images(root)
    (root / "calib.csv").write_text(realityscan_csv(**options))
    (root / "calib.ply").write_bytes(points_ply())
    return root


WRITERS = {
    "colmap": write_colmap,
    "colmap text": write_colmap_txt,
    "transforms": write_transforms,
    "instant-ngp": write_ngp,
    "blender": write_blender,
    "llff": write_llff,
    "dtu": write_dtu,
    "middlebury": write_middlebury,
    "metashape": write_metashape,
    "realityscan": write_realityscan,
}


def link(path: Path, target: Path) -> None:
    try:
        path.symlink_to(target, target_is_directory=target.is_dir())
    except OSError:
        pytest.skip("this system does not let the user make links")


def refused(root: Path, message: str, **options) -> None:
    with pytest.raises(DataError, match=message):
        load_scene(root, **options)
