"""The scene of the demo, and objects cut out."""

import json

import cv2
import numpy as np
import pytest

from warpgs.errors import ResourceError, UsageError
from warpgs.geometry import rotation_matrices
from warpgs.io.load import load_scene
from warpgs.scene import Camera
from warpgs.synthetic import demo, raycast

SIZE = {"views": 9, "width": 128, "height": 96}


def lines(path):
    return [row for row in path.read_text().splitlines() if not row.startswith("#")]


def matrix(w, x, y, z):
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def parse(folder):
    model = folder / "sparse" / "0"
    (camera,) = lines(model / "cameras.txt")
    number, kind, width, height, *params = camera.split()
    assert (number, kind) == ("1", "PINHOLE")
    rows, views = lines(model / "images.txt"), {}
    for head, body in zip(rows[::2], rows[1::2]):
        i, *pose, camera_id, name = head.split()
        q, t = np.array(pose[:4], float), np.array(pose[4:], float)
        assert camera_id == "1" and abs(np.linalg.norm(q) - 1) < 1e-9
        observed = np.array(body.split(), float).reshape(-1, 3)
        image = cv2.imread(str(folder / "images" / name))[..., ::-1] / 255
        views[int(i)] = {"name": name, "R": matrix(*q), "t": t, "observed": observed, "image": image}
    points = {}
    for row in lines(model / "points3D.txt"):
        i, x, y, z, r, g, b, error, *track = row.split()
        pairs = [(int(a), int(c)) for a, c in zip(track[::2], track[1::2])]
        assert float(error) == 0
        points[int(i)] = (np.array([x, y, z], float), np.array([r, g, b], float) / 255, pairs)
    return (int(width), int(height), *map(float, params)), views, points


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "new" / "scene"
    spec = demo.write_demo(folder, **SIZE)
    return folder, spec, *parse(folder)


def project(camera, view, x):
    _, _, fx, fy, cx, cy = camera
    p = view["R"] @ x + view["t"]
    return np.array([fx * p[0] / p[2] + cx, fy * p[1] / p[2] + cy]), p[2]


def test_images_fill_the_frame_and_tracks_respect_occlusion(made):
    folder, _, camera, views, points = made
    assert sorted(p.name for p in (folder / "images").iterdir()) == [f"{i:03d}.png" for i in range(9)]
    assert camera[:2] == (128, 96) and camera[4] != 64 and camera[5] != 48  # off-centre on purpose
    for view in views.values():
        assert view["image"].shape == (96, 128, 3) and view["image"].std() > 0.15
        assert (view["image"].max(axis=2) == 0).mean() < 0.002
    hidden = 0
    for shape in demo.still_life():
        if not isinstance(shape, raycast.Sphere):
            continue
        for x, _, track in points.values():
            seen = {i for i, _ in track}
            for i, view in views.items():
                eye = -view["R"].T @ view["t"]
                s = np.clip(np.dot(shape.center - eye, x - eye) / np.dot(x - eye, x - eye), 0, 1)
                inside = np.linalg.norm(eye + s * (x - eye) - shape.center) < 0.999 * shape.size
                assert not (inside and i in seen)
                (u, v), depth = project(camera, view, x)
                hidden += inside and depth > 0 and 2 < u < 126 and 2 < v < 94
    assert hidden > 20  # the scene does hide points from some views
    # points reproject onto their observations, in the colours there
    _, _, camera, views, points = made
    errors = []
    for number, (x, rgb, track) in points.items():
        assert len(track) >= 2 and len({i for i, _ in track}) == len(track)
        for i, k in track:
            u, v, back = views[i]["observed"][k]
            xy, depth = project(camera, views[i], x)
            assert back == number and depth > 0 and np.abs(xy - (u, v)).max() < 0.01 and 0 < u < 128 and 0 < v < 96
            patch = cv2.getRectSubPix(views[i]["image"].astype(np.float32), (1, 1), tuple(xy - 0.5))
            errors.append(np.abs(patch[0, 0] - rgb).max())
    assert len(points) > 300 and len(errors) == sum(len(v["observed"]) for v in views.values())
    assert np.median(errors) < 0.03 and np.quantile(errors, 0.95) < 0.15


def test_the_split_interpolates_and_copies_do_not_help(made):
    """Held-out views lie between training views, and neither one of these nor their mean resembles them."""
    _, spec, _, views, _ = made
    train, test = (part.split("=")[1].split(",") for part in spec.split(";"))
    assert spec.startswith("train=") and ";test=" in spec
    assert len(train) == 6 and sorted(train + test) == sorted(v["name"] for v in views.values())
    centers = {v["name"]: (-v["R"].T @ v["t"])[:2] for v in views.values()}
    xs = np.array([centers[n] for n in train])
    assert all((centers[n] > xs.min(axis=0)).all() and (centers[n] < xs.max(axis=0)).all() for n in test)
    image = {v["name"]: v["image"] for v in views.values()}

    def psnr(a, b):
        return -10 * np.log10(np.mean((a - b) ** 2))

    mean = np.mean([image[n] for n in train], axis=0)
    assert np.mean([psnr(mean, image[n]) for n in test]) < 16
    assert np.mean([max(psnr(image[m], image[n]) for m in train) for n in test]) < 16


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    size = {"views": 8, "width": 48, "height": 36}
    specs = [demo.write_demo(tmp_path / n, **size, seed=s) for n, s in (("a", 3), ("b", 3), ("c", 4))]
    a, b, c = ({p.relative_to(tmp_path / n): p.read_bytes() for p in (tmp_path / n).rglob("*.*")} for n in "abc")
    assert len(a) == 11 and a == b and specs[0] == specs[1]
    assert all(a[k] != c[k] for k in a if k.suffix == ".png")


@pytest.mark.parametrize("empty", [False, True])
def test_a_full_disk_leaves_no_half_a_scene(tmp_path, monkeypatch, empty):
    """The third file cannot be written: nothing is there afterwards, or the empty folder of before."""
    folder, written = tmp_path / "scene", []
    if empty:
        folder.mkdir()

    def write(path, content):
        if len(written) == 2:
            raise ResourceError("no space left")
        written.append(path.write_bytes(content))

    monkeypatch.setattr(demo, "write_bytes", write)
    with pytest.raises(ResourceError, match="no space"):
        demo.write_demo(folder, views=8, width=32, height=32)
    assert list(tmp_path.rglob("*")) == [folder] * empty


def test_demos_that_cannot_be_written(tmp_path):
    """Too small, in the way of something, or of an unknown form; what is there stays."""
    (tmp_path / "file").write_text("")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").touch()
    cases = [("d", {"views": 7}, "at least 8"), ("d", {"width": 31}, "at least 32"), ("d", {"height": 8}, "at least 32")]
    cases += [("file", {}, "is a file"), ("full", {}, "not empty"), ("file/below", {}, "cannot be written")]
    for name, change, words in cases:
        error = ResourceError if name == "file/below" else UsageError
        with pytest.raises(error, match=words):
            demo.write_demo(tmp_path / name, **(SIZE | change))
    with pytest.raises(UsageError, match="at least 9 views"):
        demo.write_object(tmp_path / "d", views=8)
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["file", "full", "mine"]


def surface_equation(shape, p):
    """Return a value that is zero on the surface of a shape, by textbook formulas, at local positions."""
    x, y, z = p.T
    if isinstance(shape, raycast.Plane):
        return z
    if isinstance(shape, raycast.Sphere):
        return np.sqrt(x**2 + y**2 + z**2) - shape.size
    if isinstance(shape, raycast.Box):
        return np.max(np.abs(p) - shape.half, axis=1)
    if isinstance(shape, raycast.Cylinder):
        return np.maximum(np.hypot(x, z) - shape.size, np.abs(y) - shape.half_height)
    return (x**2 + y**2 + z**2 + shape.ring**2 - shape.tube**2) ** 2 - 4 * shape.ring**2 * (x**2 + z**2)


@pytest.mark.parametrize("number", range(10))
def test_hits_lie_on_the_surface_and_nothing_lies_before_them(number):
    shape = demo.still_life()[number]
    rng = np.random.default_rng(number)
    eye = np.array([0.1, -0.6, 0.0])
    aim = np.array(shape.center) + rng.normal(size=(400, 3)) * min(shape.radius, 1.5) * 0.5
    d = (aim - eye) / np.linalg.norm(aim - eye, axis=1, keepdims=True)
    t, index = raycast.cast([shape], eye, d)
    hit = index == 0
    assert hit.sum() > 100 and np.isinf(t[~hit]).all()
    p, d, t = shape.local(eye + t[hit, None] * d[hit]), d[hit] @ shape.rotation, t[hit]
    assert np.abs(surface_equation(shape, p)).max() < 1e-6
    normals = shape.normal(p)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    start = surface_equation(shape, shape.local(eye[None]))[0]
    cosine = np.einsum("ij,ij->i", normals, d)
    assert (cosine[np.abs(cosine) > 0.05] < 0).all()
    for s in np.linspace(0.02, 0.98, 40):
        along = surface_equation(shape, shape.local(eye[None]) + (s * t)[:, None] * d)
        assert (np.sign(along) == np.sign(start)).all()


# Objects cut out of their surroundings: true alpha, thin parts, the same views in two formats.

CUT_OUT_SIZE = {"views": 9, "width": 48, "height": 40}


def read(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / 255


def test_two_formats_show_the_same_object_to_the_same_cameras(tmp_path):
    specs = [demo.write_object(tmp_path / form, form=form, seed=3, **CUT_OUT_SIZE) for form in demo.FORMATS]
    assert specs[0] == specs[1] and specs[0].startswith("train=000.png,001.png") and specs[0].endswith(";test=008.png")
    transforms = json.loads((tmp_path / "transforms" / "transforms.json").read_text())
    rows = [r for r in (tmp_path / "colmap/sparse/0/images.txt").read_text().splitlines() if not r.startswith("#")][::2]
    for frame, row in zip(transforms["frames"], rows, strict=True):
        name = row.split()[-1]
        assert frame["file_path"] == f"images/{name}"
        rgba, rgb = read(tmp_path / "transforms/images" / name), read(tmp_path / "colmap/images" / name)
        alpha = rgba[..., 3]
        np.testing.assert_array_equal(alpha, read(tmp_path / "colmap/masks" / name))
        np.testing.assert_array_equal(rgba[alpha > 0][:, :3], rgb[alpha > 0])
        pose = np.array(frame["transform_matrix"])
        R = rotation_matrices(np.array(row.split()[1:5], float))
        np.testing.assert_allclose(R.T * [1, -1, -1], pose[:3, :3], atol=1e-9)
        np.testing.assert_allclose(-R.T @ np.array(row.split()[5:8], float), pose[:3, 3], atol=1e-9)
        assert 0.05 < alpha.mean() < 0.5 and ((alpha > 0) & (alpha < 1)).mean() > 0.02  # edges are soft
    assert len((tmp_path / "colmap/sparse/0/points3D.txt").read_text().splitlines()) > 10
    a, b = (load_scene(tmp_path / form, masks="cutout").views for form in demo.FORMATS)
    for left, right in zip(a, b, strict=True):
        np.testing.assert_array_equal(left.alpha, right.alpha)
        np.testing.assert_allclose(left.image, right.image, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_objects_have_holes_and_stay_in_the_frame(seed):
    shapes = demo.cut_out_object(seed)
    assert str([s.center for s in shapes]) != str([s.center for s in demo.cut_out_object(seed + 1)])
    thin = [s for s in shapes if isinstance(s, raycast.Cylinder) and s.size < 0.05]
    assert len(thin) >= 10 and any(isinstance(s, raycast.Torus) for s in shapes)
    holes = 0
    for camera in demo.ring_cameras(9, 90, 90)[::4]:
        empty = raycast.render_rgba(shapes, demo.LIGHT, camera.K, camera.viewmat, 90, 90, 1)[..., 3] == 0
        assert empty[[0, -1]].all() and empty[:, [0, -1]].all()
        _, _, stats, _ = cv2.connectedComponentsWithStats(empty.astype(np.uint8), connectivity=4)
        holes += (stats[1:, cv2.CC_STAT_AREA] > 3).sum() - 1  # all but the surroundings
    assert holes >= 3


@pytest.mark.parametrize("angle", [0.3, 3.1, np.pi])
def test_poses_of_half_a_turn_are_written(angle):
    for axis in np.eye(3):
        R = rotation_matrices(np.array([np.cos(angle / 2), *np.sin(angle / 2) * axis]))
        viewmat = np.eye(4)
        viewmat[:3, :3] = R
        text = demo.colmap_text([Camera(viewmat, np.eye(3), 8, 8)], np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 1), bool))
        quat = np.array(text["images.txt"].splitlines()[3].split()[1:5], float)
        np.testing.assert_allclose(rotation_matrices(quat), R, atol=1e-9)
