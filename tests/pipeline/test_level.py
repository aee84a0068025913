"""Real sizes: a scene with known geometry, tilted and out of scale, gets its lengths, its ground and its place back."""

import dataclasses
import json
import math
import re
import shutil
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

import warpgs
from warpgs.app.cli import main
from warpgs.errors import DataError, ResourceError
from warpgs.export.base import write_gaussians
from warpgs.export.meshes_and_cameras import write_cameras
from warpgs.geometry import back_project, convert_camera, convert_points, logit, look_at, pose_at, project_points, quaternions
from warpgs.io.image_files import read_gps
from warpgs.io.transforms import read_cameras
from warpgs.pipeline.films.film import FilmSettings, plan_film
from warpgs.pipeline.films.paths import read_keyframes
from warpgs.pipeline.model.edit import rotation_about
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.model.table import save, similarity_values
from warpgs.pipeline.run import level
from warpgs.pipeline.run.folder import load_checkpoint, open_run, save_checkpoint
from warpgs.pipeline.run.level import metres_about, photographed
from warpgs.scene import Camera, Normalization
from warpgs.synthetic import raycast
from warpgs.synthetic.demo import camera_path, still_life

UNIT = 2.5
"""True metres per unit of the scene's files."""
TILT = rotation_about(np.array([0.6, 0.2, 0.7]), math.radians(35))
"""Rotation from true axes, in which -y is up, to those of the scene's files."""
SHAPES, CAMERAS = still_life(), camera_path(8, 96, 72)
NAMES, TRUE, UP = [f"images/{i:03d}.png" for i in range(8)], np.array([c.center for c in CAMERAS]), np.array([0.0, -1, 0])
PIXELS = np.mgrid[:96, :72].reshape(2, -1).T + 0.5
PLACE, EAST, NORTH = (-33.8568, 151.2153, 31.0), 92_539.5, 110_919.8
"""Latitude, longitude [deg] and height [m], and metres a degree there (NGA, length of a degree)."""
TO_EAST_NORTH_UP = 100 * np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
"""From true positions, as if of a hundred times as large a place."""


def surface(view, pixels=PIXELS):
    """True points [N, 3] [m] and shapes [N] at pixels [N, 2] of a view."""
    rays, eye = raycast.pixel_rays(CAMERAS[view].K, CAMERAS[view].viewmat, pixels), CAMERAS[view].center
    distances, shapes = raycast.cast(SHAPES, eye, rays)
    return eye + distances[:, None] * rays, shapes


POINTS, HIT = map(np.concatenate, zip(*map(surface, range(8))))


def exif(*place):
    a, b, height = map(float, place)
    a_parts, b_parts = ((float(int(v)), float(int(v % 1 * 60)), v * 60 % 1 * 60) for v in (abs(a), abs(b)))
    made = Image.Exif()
    made[0x8825] = {1: "NS"[a < 0], 2: a_parts, 3: "EW"[b < 0], 4: b_parts, 5: bytes([height < 0]), 6: abs(height)}
    return made


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A fit of the tilted scene; and a copy whose model is the true surfaces: a small disk at each pixel of each view."""
    folder = tmp_path_factory.mktemp("level")
    (folder / "scene" / "images").mkdir(parents=True)
    tilted = [dataclasses.replace(c, viewmat=pose_at(c.viewmat[:3, :3] @ TILT.T, TILT @ c.center / UNIT)) for c in CAMERAS]
    write_cameras(folder / "scene" / "transforms.json", tilted, NAMES)
    for i, (name, c) in enumerate(zip(NAMES, CAMERAS)):
        image = np.round(255 * raycast.render(SHAPES, raycast.Light(), c.K, c.viewmat, 96, 72)).astype(np.uint8)
        x, y, z = c.center @ TO_EAST_NORTH_UP + [400 * (i == 1), 300 * (i == 5), 0]  # two photographs are wrong
        place = exif(PLACE[0] + y / NORTH, PLACE[1] + x / EAST, PLACE[2] + z)
        Image.fromarray(image).save(folder / "scene" / name, exif=place)
    config = warpgs.FitConfig(steps=4, init=InitConfig(source="random", random_count=50))
    warpgs.fit(folder / "scene", config, split="every:4", out=folder / "fit", device="cpu", verbose=False)
    shutil.copytree(folder / "fit", folder / "run")
    n, (_, state) = open_run(folder / "run", "cpu").normalization, load_checkpoint(folder / "run")
    normals = np.empty_like(POINTS)
    for k, shape in enumerate(SHAPES):
        normals[HIT == k] = shape.normal(shape.local(POINTS[HIT == k])) @ (TILT @ shape.rotation).T
    sides = np.cross(normals, normals[:, [1, 2, 0]] * [1, 1, -1])
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    pixel = np.linalg.norm(POINTS - np.repeat(TRUE, len(PIXELS), 0), axis=1) / CAMERAS[0].K[0, 0] / UNIT * n.scale
    params = {
        "means": convert_points(POINTS @ TILT.T / UNIT, n, "file", "scene"), "sh": np.zeros((len(POINTS), 1, 3)),
        "quats": quaternions(torch.from_numpy(np.stack([sides, np.cross(normals, sides), normals], 2))),
        "log_scales": np.log(pixel[:, None] * [0.7, 0.7, 0.05]), "logit_opacities": np.full(len(POINTS), logit(0.9)),
    }  # fmt: skip
    save_checkpoint(folder / "run", {f"params.{k}": torch.as_tensor(v, dtype=torch.float32) for k, v in params.items()}, state)
    return folder


@pytest.fixture
def run(made, tmp_path):
    shutil.copytree(made / "run", tmp_path / "run")
    return tmp_path / "run"


def sh(*words):
    return main([*map(str, words), "--device", "cpu"])


def picks(views_and_pixels):
    return [f"{NAMES[view]}:{int(x)},{int(y)}" for view, (x, y) in views_and_pixels]


def ground():
    """Pixels of the floor, far apart and away from its edges, in different photographs."""
    for view, way in ((1, (-1, 2)), (2, (1, 2)), (6, (0.3, -2))):
        points, shapes = surface(view)
        floor = np.flatnonzero(cv2.erode(np.uint8(shapes == 3).reshape(96, 72), np.ones((7, 7)), borderType=0, borderValue=0))
        yield view, PIXELS[floor[np.argsort(points[floor][:, [0, 2]] @ way)[len(floor) // 20]]]


def poses(run, target):
    """Exported cameras: rotations from true axes to file axes, and centres, by view."""
    target.mkdir()
    assert main(["export", str(run), "--to", str(target / "transforms.json"), "--keep-names"]) == 0
    found = read_cameras(target / "transforms.json")[0]
    turns = [found[n].viewmat[:3, :3].T @ true.viewmat[:3, :3] for n, true in zip(NAMES, CAMERAS)]
    return turns, np.array([found[n].center for n in NAMES])


def steps(points):
    return np.linalg.norm(np.diff(points, axis=0), axis=1)


def degrees_apart(a, b):
    return math.degrees(math.acos(min(1.0, float(np.dot(a, b)))))


def test_files_get_a_length_and_a_level_ground(run, tmp_path, capsys):
    """Gaussians, cameras and mesh are in metres within 1 %, level within 1 degree, over a ground at 0; also if done twice."""
    ends = [(0, (20.5, 50.5)), (6, (70.5, 20.5))]
    length = steps(np.concatenate([surface(view, np.array([pixel]))[0] for view, pixel in ends]))[0]
    commands = ["--scale", *picks(ends), f"{100 * length}cm"], ["--ground", *picks(ground())]
    assert [sh("level", run, *words) for words in commands] == [0, 0]
    said = capsys.readouterr().out
    assert re.search("fitted; [12] of 2 picks were matched in training photographs", said), said
    percent, tilt = (float(re.search(rf"uncertain by ([0-9.]+) {unit}", said)[1]) for unit in ("%", "degrees"))
    n = open_run(run, "cpu").normalization
    turns, centers = poses(run, tmp_path / "cameras")
    assert 100 * abs(steps(centers) / steps(TRUE) - 1).max() < min(1, 2 * percent) and percent < 3
    assert all(degrees_apart(turn @ UP, UP) < min(1, 2 * tilt) for turn in turns) and tilt < 12
    assert ("pick more points, farther apart" in said) == (tilt > level.UNSURE)
    assert main(["export", str(run), "--to", str(tmp_path / "a.ply")]) == 0
    means = warpgs.read_ply(tmp_path / "a.ply").means.numpy()
    np.testing.assert_array_equal(means, warpgs.read_ply(run / "point_cloud.ply").means.numpy())
    np.testing.assert_allclose(steps(means[::977]), steps(POINTS[::977]), rtol=0.01)
    assert abs(means[HIT == 3, 1]).max() < 0.03 and means[HIT != 3, 1].mean() < -0.5
    assert sh("mesh", run, "--out", tmp_path / "a_mesh.ply", "--resolution", 48) == 0
    found, wanted = (np.percentile(v, [5, 95], axis=0) for v in (vertices(tmp_path / "a_mesh.ply"), means))
    np.testing.assert_allclose(found, wanted, atol=0.4)
    assert [sh("level", run, *words) for words in commands] == [0, 0]
    for name, value in vars(open_run(run, "cpu").normalization).items():
        if name not in ("unit", "place"):
            np.testing.assert_allclose(value, getattr(n, name), rtol=1e-9, atol=1e-9)


def test_renders_films_and_exports_agree_in_new_coordinates(made, tmp_path, capsys):
    """Anisotropic, view-dependent Gaussians: files, saved models, formats, films, keyframes and a continued fit."""
    shutil.copytree(made / "fit", tmp_path / "run")
    g = open_run(tmp_path / "run", "cpu").gaussians()
    g = dataclasses.replace(g, sh=0.3 * torch.randn(len(g), 16, 3, generator=torch.Generator().manual_seed(0)))
    assert sh("level", tmp_path / "run", "--up", "photographs") == 0
    before = open_run(tmp_path / "run", "cpu").normalization
    assert sh("level", tmp_path / "run", "--scale", "1,2,3", "-1,2.5,3", 4) == 0
    run = open_run(tmp_path / "run", "cpu")
    n, camera = run.normalization, run.scene_cameras[NAMES[2]]
    np.testing.assert_allclose(n.offset, before.offset * 4 / math.hypot(2, 0.5))  # about 0 of the files
    moved = convert_camera(camera, n, "scene", "file")
    np.testing.assert_allclose(convert_camera(moved, n, "file", "scene").viewmat, camera.viewmat, atol=1e-12)
    image = warpgs.rasterize(g, camera, run.options()).rgb
    write_gaussians(tmp_path / "a.ply", g, n)
    save(tmp_path / "a.safetensors", g, n)
    for other, seen in (
        (warpgs.read_ply(tmp_path / "a.ply"), moved), (warpgs.read_ply(tmp_path / "a.ply", n, units="scene"), camera),
        (warpgs.load(tmp_path / "a.safetensors").gaussians("file"), moved),
    ):  # fmt: skip
        assert image.std() > 0.01 and (warpgs.rasterize(other, seen, run.options()).rgb - image).abs().max() < 2e-3
    for suffix in (".spz", ".sog", ".glb"):
        target = tmp_path / f"b{suffix}"
        assert main(["export", str(run.folder), "--to", str(target), "--no-clean"]) == 0
        assert torch.cdist(run.gaussians("file").means, warpgs.export.read_gaussians(target).means).amin(1).max() < 0.01
    assert main(["export", str(run.folder), "--to", str(tmp_path / "cameras.json"), "--rotate", "level"]) == 0
    said = capsys.readouterr().out
    assert "rotated by 0.0 degrees" in said  # they are level already
    assert re.search("rounds positions, by at most [0-9.e-]+ m$", said, re.M) and "replaces" not in said
    key = {"c2w": np.linalg.inv(moved.viewmat).tolist(), "fov_y": 0.8, "seconds": 0}
    (tmp_path / "path.json").write_text(json.dumps([key]))
    np.testing.assert_allclose(read_keyframes(tmp_path / "path.json", camera, n)[0].camera.viewmat, camera.viewmat, atol=1e-9)
    for _, c in plan_film(run, "turntable", FilmSettings(frames=4)).cameras:
        assert abs(c.viewmat[0, :3] @ n.up) < 1e-6  # its horizontal axis is level
    ply = (tmp_path / "run" / "point_cloud.ply").read_bytes()
    assert main(["fit", "--out", str(tmp_path / "run"), "--resume"]) == 0
    assert (tmp_path / "run" / "point_cloud.ply").read_bytes() == ply
    assert similarity_values(open_run(tmp_path / "run", "cpu").normalization) == similarity_values(n)


def vertices(path):
    head, _, body = path.read_bytes().partition(b"end_header\n")
    return np.frombuffer(body, [("at", "<f4", 3), ("color", "u1", 3)], int(re.search(rb"vertex (\d+)", head)[1]))["at"]


def test_a_box_of_the_same_place_cuts_the_same_surface(run, tmp_path, capsys):
    """Before and after the files are turned and scaled; the box is turned, too."""
    assert sh("level", run, "--scale", "0,0,0", "1,0,0", UNIT) == 0
    surfaces, middle, axes = [], np.mean(POINTS[HIT == 0], axis=0) @ TILT.T, rotation_about(np.array([1.0, 0, 0]), 0.4)
    place = open_run(run, "cpu").normalization
    middle, axes = convert_points(middle[None], place, "file", "scene")[0], place.rotation @ axes
    for name in ("before", "after"):
        n = open_run(run, "cpu").normalization
        center = convert_points(middle[None], n, "scene", "file")[0].tolist()
        size = (np.array([1.5, 1.2, 1.0]) * place.scale / n.scale).tolist()
        box = tmp_path / "box.json"
        box.write_text(json.dumps({"center": center, "size": size, "rotation": (n.rotation.T @ axes).tolist()}))
        voxel = 0.06 * place.scale / n.scale
        assert sh("mesh", run, "--out", tmp_path / f"{name}.ply", "--voxel", voxel, "--crop", box) == 0
        assert f"voxel {voxel:.4g} m" in capsys.readouterr().out
        surfaces.append(convert_points(vertices(tmp_path / f"{name}.ply"), n, "file", "scene"))
        assert sh("level", run, "--ground", *picks(ground())) == 0
    assert len(surfaces[0]) == len(surfaces[1]) > 50
    np.testing.assert_allclose(*surfaces, atol=1e-4 * place.scale)


def test_coordinates_of_given_points_are_new_after_a_command(run, capsys):
    """They are printed, and with them a repeated command changes nothing; pixels need no such line."""
    ground_points, ends = ["0,0,0", "1,0,0.2", "0.1,1,0"], ["0.1,0.2,0.3", "-0.2,0.4,0.1"]
    for words, length in ((["--scale", *ends], ["2"]), (["--ground", *ground_points], [])):
        assert sh("level", run, *words, *length) == 0
        text = capsys.readouterr().out
        said = re.search(r"the points are now at (.+) \(", text)
        assert "count as exact" in text and "uncertain" not in text
        n = open_run(run, "cpu").normalization
        assert sh("level", run, words[0], *said[1].split(), *length) == 0
        again = open_run(run, "cpu").normalization
        for key in ("offset", "scale", "rotation"):
            np.testing.assert_allclose(getattr(again, key), getattr(n, key), rtol=1e-6, atol=1e-6)
        capsys.readouterr()
    assert sh("level", run, "--ground", *picks(ground())) == 0 and "now at" not in capsys.readouterr().out


def test_more_points_and_lengths_outvote_a_wrong_one(run, capsys):
    """Five of six points lie on a slanted plane, and three of four lengths agree: the others are named, and hardly count."""
    before = open_run(run, "cpu").normalization
    points = np.array([[-1, 0.3, -1], [1, 0.3, -1], [1, 0.3, 1], [-1, 0.3, 1], [0.2, 0.3, 0.4], [0.7, -0.2, 0.7]]) @ TILT.T
    assert sh("level", run, "--ground", *(",".join(map(str, point)) for point in points)) == 0
    assert "count as exact; point 6 is farthest off it, by 0.5 units" in capsys.readouterr().out
    placed = convert_points(
        convert_points(points, before, "file", "scene"), open_run(run, "cpu").normalization, "scene", "file"
    )
    np.testing.assert_allclose(placed[:, 1], [0, 0, 0, 0, 0, -0.5], atol=1e-4)
    lengths = "0,0,0 1,0,0 2  0,0,0 2,0,0 4  0,0,0 3,0,0 6  0,0,0 1,0,0 2.3"
    assert sh("level", run, "--scale", *lengths.split()) == 0
    said = capsys.readouterr().out
    assert re.search(r"files are 2(\.0000\d*)? times as large", said) and "+0.00, +0.00, +0.00, -13.04 % off" in said


def test_a_plane_is_as_sure_as_its_errors_say():
    """Of 2,000 planes through six points with unequal errors, over 60 % of the tilts are within their deviation."""
    random = np.random.default_rng(0)
    terms, errors = np.column_stack([np.ones(6), random.uniform(-1, 1, (6, 2))]), np.array([0.01, 0.01, 0.01, 0.02, 0.02, 0.2])
    fits = [level.least_squares(terms, random.normal(0, errors), errors**2)[:2] for _ in range(2000)]
    within = np.mean([np.square(found[1:]).sum() <= covariance[1:, 1:].trace() for found, covariance in fits])
    assert 0.6 < within < 0.95, within


def test_pixels_are_those_of_the_fit_and_a_wall_is_no_ground(run, made, tmp_path, capsys):
    """Larger files and points on a wall are answered; a level that replaces another says so."""
    shutil.copytree(made / "scene", tmp_path / "scene")
    with Image.open(tmp_path / "scene" / NAMES[1]) as image:
        image.resize((192, 144)).save(tmp_path / "scene" / NAMES[1])
    record = json.loads((run / "config.json").read_text())
    record["scene"]["path"] = str(tmp_path / "scene")
    (run / "config.json").write_text(json.dumps(record))
    wall = np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]]) @ TILT.T / UNIT
    assert sh("level", run, "--ground", *(",".join(map(str, point)) for point in wall)) == 0
    said = capsys.readouterr().out
    assert re.search("this tips the photographs by [6-9][0-9] degrees: are the points on a wall", said)
    assert f"`warpgs level {run} --up photographs` undoes it" in said and not re.search("replaces|pixels refer", said)
    assert sh("level", run, "--ground", *picks(ground())) == 0
    said = capsys.readouterr().out
    assert "this replaces the earlier level" in said and "wall" not in said
    assert "photographs of 96 x 72 px as fitted; the file has 192 x 144" in said
    assert sh("level", run, "--scale", f"{NAMES[0]}:20,50", f"{NAMES[6]}:70,20", "35mm") == 0
    said = capsys.readouterr().out
    said, alone = said.split("; pixels refer to photographs of 96 x 72 px as fitted; ")
    assert alone.startswith("0 of 2 picks were matched in training photographs: they cannot be read: ")


def test_the_error_of_a_pick_depends_on_what_confirms_it(run, monkeypatch):
    """Photographs, another camera of the model, from which it is not hidden, or nothing; a larger spread of depth counts.

    At an edge, the spread is the step to the other surface, and photographs are not asked.
    """
    stored = open_run(run, "cpu")
    first, second = (stored.scene_cameras[name] for name in stored.train[:2])
    model = SimpleNamespace(scene_cameras=stored.scene_cameras, train=stored.train[:2])
    ahead = project_points(second, back_project(first, np.array([[48.5, 36.5]]), np.array([2.0])))[1][0]
    places = [(np.zeros(3), np.zeros((3, 3)), "given")]
    for spread, shown, matched, source, wanted in (
        (0.07, 1.05, 2.0, "matched", 0.005), (0.0, 1.05, None, "shown", 0.04), (0.0, 0.8, None, "alone", 0.2),
        (0.079, 1.05, None, "shown", 0.04), (0.3, 1.05, 2.0, "edge", 0.15), (0.6, 0.8, None, "edge", 0.3),
    ):  # fmt: skip
        depths = {id(first): (None, 2.0, spread), id(second): (None, shown * ahead, 0.0)}
        monkeypatch.setattr(level, "pixel_depth", lambda _, camera, *more, depths=depths: depths[id(camera)])
        monkeypatch.setattr(level, "matched_depth", lambda *_, matched=matched: matched)
        places.append(level.place_at(model, first, 48, 36, {}))
        axis, pixel = first.viewmat[2, :3], 1 / first.K[0, 0]
        assert places[-1][2] == source and 0.999 * wanted < math.sqrt(axis @ places[-1][1] @ axis) / 2 < wanted + pixel
    edges = "; at an edge: point 6, point 7; pick places away from edges"
    assert level.matches(places) == "; 1 of 6 picks were matched in training photographs" + edges
    unmatched = [(*place[:2], "shown") for place in places[:2]]
    assert level.matches(unmatched).endswith(
        "0 of 2 picks were matched in training photographs; pick other places for a smaller error"
    )
    assert "edge" not in level.matches(places[:5])


def test_a_pick_at_an_edge_is_named(run, capsys):
    """Beside an object, the printed error covers the surface behind it; the other point is not named."""
    points, shapes = (v.reshape(96, 72, -1) for v in surface(0))
    depth = (points - TRUE[0]) @ CAMERAS[0].viewmat[2, :3]
    x, y = np.argwhere((shapes[5:-9, 5:-5, 0] == 4) & (depth[6:-8, 5:-5] > 1.2 * depth[5:-9, 5:-5]))[0] + 5
    assert sh("level", run, "--scale", *picks([(0, (x, y)), (0, (20, 50))]), 1) == 0
    said = capsys.readouterr().out
    assert "at an edge: point 1; pick places away from edges" in said
    assert float(re.search("uncertain by ([0-9.]+) %", said)[1]) > 10


def test_photographs_show_what_is_up():
    """All round and looking down, two of them on their side and one askew: within 1 degree; without agreement an error."""
    cameras = {}
    for i, roll in enumerate([0.5, -0.5, 0.5, 90, -0.5, 25, 0.5, -0.5, 90, 0.5, -0.5]):
        eye = np.array([3 * math.cos(0.5 * i), -1.5, 3 * math.sin(0.5 * i)])
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation_about(np.array([0, 0, 1.0]), math.radians(roll))
        cameras[str(i)] = Camera(viewmat @ look_at(eye, np.zeros(3), UP), CAMERAS[0].K, 96, 72)

    def levelled(train):
        n = Normalization(rotation=TILT)
        return photographed(SimpleNamespace(scene_cameras=cameras, train=train, normalization=n, folder="run"))

    n, line = levelled((*cameras,))
    assert degrees_apart(n.up, UP) < 1 and re.search("lean by 0.[45]", line) and "one way" not in line
    np.testing.assert_allclose(n.rotation.T @ n.up, UP, atol=1e-12)
    assert "all look one way" in levelled(("0",))[1]
    cameras["1"] = dataclasses.replace(cameras["0"], viewmat=np.diag([-1.0, -1, 1, 1]) @ cameras["0"].viewmat)
    with pytest.raises(DataError, match="no common upward direction; use --ground"):
        levelled(("0", "1"))


def test_gps_gives_place_and_north(run, made, tmp_path, capsys):
    """East, north and up in metres, though two photographs are off by 300 m; the ground's level keeps z up, and the heights."""
    assert sh("level", run, "--gps") == 0
    said = capsys.readouterr().out
    assert "GPS of 6 of 8 photographs" in said and float(re.search(r"at most ([0-9.]+) m off", said)[1]) < 0.1
    turns, centers = poses(run, tmp_path / "cameras")
    n = open_run(run, "cpu").normalization
    zero = metres_about(np.array([PLACE]), n.place)[0]
    np.testing.assert_allclose(centers - zero, TRUE @ TO_EAST_NORTH_UP, atol=0.2)
    assert all(degrees_apart(t @ UP, [0, 0, 1]) < 0.1 and degrees_apart(t @ [0, 0, 1], [0, 1, 0]) < 0.1 for t in turns)
    assert sh("level", run, "--ground", *picks(ground())) == 0 and "z is up" in capsys.readouterr().out
    assert np.linalg.norm(open_run(run, "cpu").normalization.offset - n.offset) < 5
    turns, _ = poses(run, tmp_path / "level")
    assert all(degrees_apart(t @ UP, [0, 0, 1]) < 1 and degrees_apart(t @ [0, 0, 1], [0, 1, 0]) < 1 for t in turns)
    for again in (False, True):
        assert sh("level", run, "--up", "photographs") == 0
        assert ("this replaces the earlier level" in capsys.readouterr().out) != again
    (tmp_path / "few" / "images").mkdir(parents=True)
    for name in NAMES[:2]:
        shutil.copy(made / "scene" / name, tmp_path / "few" / name)
    assert sh("level", run, "--gps", tmp_path / "few") == 3
    assert re.search("2 of 8 photographs have GPS that fits.* --gps FOLDER", capsys.readouterr().err)


def test_gps_that_is_not_found(run, made, tmp_path, capsys):
    """No folder, no file with the name of a view, no EXIF: each has its message; HEIC originals of copies are found by name."""
    folder = tmp_path / "originals"

    def error():
        assert sh("level", run, "--gps", folder) == 3
        return capsys.readouterr().err

    assert "no such folder; give the folder of the originals" in error()
    (folder / "images").mkdir(parents=True)
    assert f"no file has the name of a photograph, such as {NAMES[1]}; give the originals" in error()
    for name in NAMES[:3]:
        Image.new("RGB", (8, 8)).save(folder / name)
    assert re.search("none of the 3 photographs found in .* has GPS in EXIF. Copies often lose EXIF", error())
    record = json.loads((run / "config.json").read_text())
    renamed = {name: name.replace(".png", ".HEIC.jpg") for name in NAMES}
    record |= {key: [renamed[name] for name in record[key]] for key in ("train", "test")}
    record["cameras"] = {renamed[name]: camera for name, camera in record["cameras"].items()}
    (run / "config.json").write_text(json.dumps(record))
    for name in NAMES:
        (folder / name).with_suffix(".HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(40))
    assert re.search("none of the 8 .* EXIF of HEIC is not read: convert .* to JPEG .* such as images/000.HEIC.jpg", error())
    for name in NAMES:
        shutil.copy(made / "scene" / name, (folder / name).with_suffix(".HEIC"))
    assert sh("level", run, "--gps", folder) == 0


@pytest.mark.parametrize("failing", ["write_ply", "write_json"])
def test_an_error_while_files_are_replaced_says_to_repeat(run, monkeypatch, capsys, failing):
    """config.json is last, so that it has the old state until the PLY is new; repeated, both are new."""
    before = (run / "config.json").read_bytes()

    def full(*values, **more):
        raise ResourceError("the disk is full; free some space")

    with monkeypatch.context() as patch:
        patch.setattr(level, failing, full)
        assert sh("level", run, "--scale", *picks(ground())[:2], 3) == 4
    assert "the disk is full; free some space; then repeat the command" in capsys.readouterr().err
    assert (run / "config.json").read_bytes() == before
    assert sh("level", run, "--scale", *picks(ground())[:2], 3) == 0
    means = open_run(run, "cpu").gaussians("file").means
    np.testing.assert_allclose(warpgs.read_ply(run / "point_cloud.ply").means, means, rtol=1e-5, atol=1e-6)


def test_gps_of_files_is_read_with_bounds(tmp_path):
    for place in ((91, 0, 0), (10, 10, 9e9), (0, 0, 0), (10.5, -20.25, -30)):
        Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg", exif=exif(*place))
        data = (tmp_path / "a.jpg").read_bytes()
        assert read_gps(data) == (None if place[2] >= 0 else pytest.approx(place))
    assert {read_gps(data[:end]) for end in range(len(data))} <= {None, read_gps(data)}


BAD = {
    "outside": (["--scale", f"{NAMES[0]}:96,3", f"{NAMES[1]}:3,3", "1"], "96,3: outside of the image, which has 96 x 72 px"),
    "background": (["--scale", f"{NAMES[0]}:9,3", f"{NAMES[1]}:3,3", "1"], "shows empty background .opacity 0.0"),
    "equal": (["--scale", f"{NAMES[0]}:9,3", f"{NAMES[0]}:9,3", "1"], "the two points are equal"),
    "no length": (["--scale", "0,0,0", "1,2,3", "0"], "a length must be above 0 m, not 0"),
    "unknown": (["--scale", "images/00.png:9,3", f"{NAMES[0]}:9,3", "1"], "no view 'images/00.png'; did you mean images/00"),
    "nan": (["--scale", "1,2,nan", "1,2,3", "1"], "a point, VIEW:x,y or x,y,z, takes 3 finite numbers"),
    "unit": (
        ["--scale", "0,0,0", "1,0,0", "20in"],
        r"a length, such as 1.2 \(metres\), 20cm or 35mm, takes one finite number, not",
    ),
    "in line": (["--ground", "0,0,0", "1,0,0", "2,0,0"], "equal or nearly on a line"),
    "two": (["--ground", "0,0,0", "1,0,0"], "--ground at least three points, such as a.jpg:30,59"),
    "no length between": (["--scale", "0,0,0", "1,0,0"], "--scale takes two points and a length, such as a.jpg:41,22"),
    "no value": (["--scale"], "--scale takes two points and a length"),
    "nothing": ([], "give one of --scale"),
    "both": (["--up", "photographs", "--ground", "0,0,0", "1,0,0", "0,1,0"], "give one of --scale"),
}


@pytest.mark.parametrize("kind", BAD)
def test_picks_that_cannot_be_honoured(run, capsys, kind):
    words, message = BAD[kind]
    if kind == "background":
        tensors, state = load_checkpoint(run)
        tensors["params.logit_opacities"][:] = -9
        save_checkpoint(run, tensors, state)
    before = {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    assert sh("level", run, *words) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and re.search(message, error), error
    assert {p: p.read_bytes() for p in run.rglob("*") if p.is_file()} == before


def test_a_wavy_surface_is_averaged_and_another_one_left_out():
    """A slanted plane with waves beside a step: its depth at the step and in its middle, where single pixels are off by 1 %.

    Within 2 px of the step, the spread is the step; of background, it is `SAME`.
    """
    y, x = np.mgrid[0:360, 0:480]
    plane = 1 / (0.2 + 7e-5 * x - 4e-5 * y)
    depth = plane * (1 + 0.01 * np.sin(0.6 * x) * np.cos(0.7 * y))
    depth[:, 270:] *= 1.5
    depth[150, 180] *= 1.02
    depth[1, 0] = np.inf  # background
    for row, column, step in (
        (150, 180, 0), (121, 267, 0), (121, 269, 0.5), (10, 9, 0), (359, 91, 0), (181, 271, 1 / 3), (181, 272, 0), (3, 2, 0.04)
    ):  # fmt: skip
        z, spread, *_ = level.plane_depth(depth, row, column)
        true = plane[row, column] * (1.5 if column >= 270 else 1)
        assert abs(z / true - 1) < 3e-3 and (step - 3e-2 < spread / true < step + 3e-2 if step else 3e-3 < spread / true < 1e-2)
    alone = np.where(np.arange(4 * 9).reshape(4, 9) == 13, 2.0, np.inf)
    assert level.plane_depth(alone, 1, 4)[:2] == (2.0, 2 * level.SAME)


def test_a_pick_is_matched_in_other_photographs():
    """A textured slanted plane in three photographs: its depth within 0.3 %, from 2 % off, at a photograph's pixel or not.

    Beside an object before the plane, the part of the patch on the plane is compared, and none if this is less than half.
    """
    generator = np.random.default_rng(0)
    waves, phases = generator.normal(0, 25, (12, 2)), generator.uniform(0, 6, 12)
    cameras, photographs, depths, normal = {}, {}, {}, np.array([-0.2, -0.1, 1])  # z = 3 + .2 x + .1 y

    def plane(camera, pixels):
        """Places on the plane [N, 3] and inverse depths [N] at pixels of a camera that looks along z."""
        rays = back_project(camera, pixels, np.ones(len(pixels))) - camera.center
        inverse = (rays @ normal) / (3 - camera.center @ normal)
        return camera.center + rays / inverse[:, None], inverse

    for name, center in {"a": (0.0, 0, 0), "b": (0.3, 0, 0), "c": (0, 0.25, 0.1), "browser": (0.1, 0.4, -0.6)}.items():
        size = (64, 48) if name == "browser" else (128, 96)
        viewmat = np.eye(4)
        viewmat[:3, 3] = -np.array(center)
        cameras[name] = Camera(
            viewmat, np.array([[0.94 * size[0], 0, 0.5 * size[0]], [0, 0.94 * size[0], 0.5 * size[1]], [0, 0, 1]]), *size
        )
        pixels = np.mgrid[: size[1], : size[0]][::-1].reshape(2, -1).T + 0.5
        places, inverse = plane(cameras[name], pixels)
        before = back_project(cameras[name], pixels, np.full(len(pixels), 1.5 - center[2]))
        object = before[:, :1] < -0.35  # in a, columns up to 35
        grey = 0.5 + 0.05 * np.sin(np.where(object, before + 9, places)[:, :2] @ waves.T + phases).sum(1)
        photographs[name] = np.repeat(grey.reshape(*size[::-1], 1), 3, 2).astype(np.float32)
        depths[name] = np.where(object[:, 0], 1.5 - center[2], 1 / inverse).reshape(size[::-1])
    del photographs["browser"]
    for name, pixel in (("a", (39, 30)), ("a", (90, 60)), ("browser", (29, 20)), ("browser", (38, 17))):
        ends = np.add(pixel, [[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]])
        _, (inverse, right, down) = plane(cameras[name], ends)
        slopes = (right / inverse - 1, down / inverse - 1)
        for off in (0.98, 1.0, 1.02):
            asked = cameras, cameras[name], pixel, off / inverse, slopes, off * depths[name]
            assert abs(level.matched_depth(photographs, *asked) * inverse - 1) < 3e-3
        two = {n: p for n, p in photographs.items() if n != "b"}
        plain = {n: np.full_like(p, 0.5) if n == "a" else p for n, p in photographs.items()}
        for few in (two, {}) + (plain,) * (name == "a"):
            assert level.matched_depth(few, *asked) is None
    for pixel in ((3, 60), (37, 30)):  # its patch leaves the image, or is mostly on the object
        assert level.matched_depth(photographs, cameras, cameras["a"], pixel, 3.0, (0.0, 0.0), depths["a"]) is None
