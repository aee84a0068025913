"""Real sizes: a scene with known geometry, tilted and out of scale, gets its lengths, its ground and its place back."""

import dataclasses
import json
import math
import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

import warpgs
from warpgs.app.cli import main
from warpgs.errors import DataError
from warpgs.export.base import write_gaussians
from warpgs.export.meshes_and_cameras import write_cameras
from warpgs.geometry import convert_camera, convert_points, logit, look_at, pose_at, quaternions
from warpgs.io.image_files import read_gps
from warpgs.io.transforms import read_cameras
from warpgs.pipeline.films.film import FilmSettings, plan_film
from warpgs.pipeline.films.paths import read_keyframes, rig_of
from warpgs.pipeline.model.edit import rotation_about
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.model.table import save, similarity_values
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
NAMES = [f"images/{i:03d}.png" for i in range(8)]
PLACE, EAST, NORTH = (-33.8568, 151.2153, 31.0), 92_539.5, 110_919.8
"""Latitude, longitude [deg] and height [m], and metres a degree there (NGA, length of a degree)."""
TRUE = np.array([c.center for c in CAMERAS])
CONFIG = warpgs.FitConfig(steps=4, init=InitConfig(source="random", random_count=50))


def surface(view, pixels):
    """True points [N, 3] [m] and shapes [N] at pixels [N, 2] of a view."""
    rays, eye = raycast.pixel_rays(CAMERAS[view].K, CAMERAS[view].viewmat, pixels), CAMERAS[view].center
    distances, shapes = raycast.cast(SHAPES, eye, rays)
    return eye + distances[:, None] * rays, shapes


def exif(*place):
    """EXIF of a photograph that was taken there."""
    latitude, longitude, height = map(float, place)

    def parts(degrees):
        minutes = abs(degrees) % 1 * 60
        return float(int(abs(degrees))), float(int(minutes)), minutes % 1 * 60

    tags = {1: "NS"[latitude < 0], 2: parts(latitude), 3: "EW"[longitude < 0], 4: parts(longitude)}
    made = Image.Exif()
    made[0x8825] = tags | {5: bytes([height < 0]), 6: abs(height)}
    return made


def all_pixels():
    return np.mgrid[:96, :72].reshape(2, -1).T + 0.5


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A fit of the tilted scene; and a copy whose model is the true surfaces: a small disk at each pixel of each view."""
    folder = tmp_path_factory.mktemp("level")
    (folder / "scene" / "images").mkdir(parents=True)
    tilted = [dataclasses.replace(c, viewmat=pose_at(c.viewmat[:3, :3] @ TILT.T, TILT @ c.center / UNIT)) for c in CAMERAS]
    write_cameras(folder / "scene" / "transforms.json", tilted, NAMES)
    for i, (name, c) in enumerate(zip(NAMES, CAMERAS)):
        image = raycast.render(SHAPES, raycast.Light(), c.K, c.viewmat, 96, 72)
        x, y, z = 100 * c.center + [0, 0, 300 * (i == 5)]  # as if of a large place; one photograph is wrong
        save = Image.fromarray(np.round(255 * image).astype(np.uint8)).save
        save(folder / "scene" / name, exif=exif(PLACE[0] + z / NORTH, PLACE[1] + x / EAST, PLACE[2] - y))
    warpgs.fit(folder / "scene", CONFIG, split="every:4", out=folder / "fit", device="cpu", verbose=False)
    shutil.copytree(folder / "fit", folder / "run")
    run, (_, state) = open_run(folder / "run", "cpu"), load_checkpoint(folder / "run")
    points, shapes = map(np.concatenate, zip(*(surface(i, all_pixels()) for i in range(8))))
    normals = np.empty_like(points)
    for k, shape in enumerate(SHAPES):
        normals[shapes == k] = shape.normal(shape.local(points[shapes == k])) @ (TILT @ shape.rotation).T
    eyes, focal = np.repeat(TRUE, len(all_pixels()), 0), CAMERAS[0].K[0, 0]
    sides = np.cross(normals, normals[:, [1, 2, 0]] * [1, 1, -1])
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    quats = quaternions(torch.from_numpy(np.stack([sides, np.cross(normals, sides), normals], 2))).float()
    sizes = np.linalg.norm(points - eyes, axis=1, keepdims=True) / focal / UNIT * run.normalization.scale * [0.7, 0.7, 0.05]
    means = torch.from_numpy(convert_points(points @ TILT.T / UNIT, run.normalization, "file", "scene")).float()
    logs = torch.from_numpy(np.log(sizes)).float()
    new = {"means": means, "quats": quats, "log_scales": logs, "logit_opacities": torch.full((len(means),), logit(0.9))}
    new |= {"sh": torch.zeros(len(means), 1, 3)}
    save_checkpoint(folder / "run", {f"params.{n}": t for n, t in new.items()}, state)
    return folder


@pytest.fixture
def run(made, tmp_path):
    shutil.copytree(made / "run", tmp_path / "run")
    return tmp_path / "run"


def pick(view, x, y):
    """The words for a pixel, and its true point [m]."""
    return f"{NAMES[view]}:{x},{y}", surface(view, np.array([[x + 0.5, y + 0.5]]))[0][0]


def ground():
    """Words for pixels of the floor, far apart, in different photographs."""
    words = []
    for view, way in ((1, (-1, 2)), (2, (1, 2)), (6, (0.3, -2))):
        points, shapes = surface(view, all_pixels())
        floor = np.flatnonzero(shapes == 3)
        x, y = all_pixels()[floor[np.argsort(points[floor][:, [0, 2]] @ way)[len(floor) // 20]]]
        words.append(f"{NAMES[view]}:{int(x)},{int(y)}")
    return words


def sh(*words):
    return main([*map(str, words), "--device", "cpu"][: None if words[0] in ("level", "mesh") else -2])


def poses(run, target):
    """Exported cameras: rotations from true axes to file axes, and centres, by view."""
    target.mkdir()
    assert sh("export", run, "--to", target / "transforms.json", "--keep-names") == 0
    found = read_cameras(target / "transforms.json")[0]
    turns = [found[n].viewmat[:3, :3].T @ true.viewmat[:3, :3] for n, true in zip(NAMES, CAMERAS)]
    return turns, np.array([found[n].center for n in NAMES])


def vertices_of(path):
    data = path.read_bytes()
    count = int(re.search(rb"element vertex (\d+)", data)[1])
    rows = np.frombuffer(data, [("at", "<f4", 3), ("color", "u1", 3)], count, data.index(b"end_header\n") + 11)
    return rows["at"].astype(float)


def between(points):
    return np.linalg.norm(points[1:] - points[:-1], axis=1)


def degrees_apart(a, b):
    return math.degrees(math.acos(min(1.0, float(np.dot(a, b) / np.linalg.norm(a) / np.linalg.norm(b)))))


UP = np.array([0.0, -1, 0])


def test_files_get_a_length_and_a_level_ground(run, tmp_path, capsys):
    """Gaussians, cameras and mesh are in metres within 1 %, level within 1 degree, over a ground at 0; also if done twice."""
    assert sh("mesh", run, "--out", tmp_path / "before.ply", "--resolution", 48) == 0
    (a, p), (b, q) = pick(0, 20, 50), pick(6, 70, 20)
    commands = ["--scale", a, b, np.linalg.norm(p - q)], ["--ground", *ground()]
    assert [sh("level", run, *words) for words in commands] == [0, 0]
    said = capsys.readouterr().out
    percent, tilt = (float(re.search(rf"uncertain by ([0-9.]+) {unit}", said)[1]) for unit in ("%", "degrees"))
    once = open_run(run, "cpu").normalization
    turns, centers = poses(run, tmp_path / "cameras")
    off = 100 * abs(between(centers) / between(TRUE) - 1).max()
    assert off < min(1, 2 * percent) and percent < 3
    assert all(degrees_apart(turn @ UP, UP) < min(1, 2 * tilt) for turn in turns) and tilt < 5
    for name in ("run/point_cloud.ply", "a.ply"):
        if name == "a.ply":
            assert sh("export", run, "--to", tmp_path / name) == 0
        means = warpgs.read_ply(tmp_path / name).means.double().numpy()
        surfaces = np.concatenate([surface(i, all_pixels())[0] for i in range(8)])
        np.testing.assert_allclose(between(means[::977]), between(surfaces[::977]), rtol=0.01)
    floor = np.concatenate([surface(i, all_pixels())[1] for i in range(8)]) == 3
    assert abs(means[floor, 1]).max() < 0.03 and means[~floor, 1].mean() < -0.5
    assert sh("mesh", run, "--out", tmp_path / "after.ply", "--resolution", 48) == 0
    before, after = (vertices_of(tmp_path / f"{n}.ply") for n in ("before", "after"))
    np.testing.assert_allclose(np.ptp(after @ turns[0], axis=0), np.ptp(before @ TILT, axis=0) * UNIT, rtol=0.01)
    assert [sh("level", run, *words) for words in commands] == [0, 0]
    twice = open_run(run, "cpu").normalization
    for name in ("offset", "scale", "rotation", "up"):
        np.testing.assert_allclose(getattr(twice, name), getattr(once, name), rtol=1e-9, atol=1e-9)


def test_renders_films_and_exports_agree_in_new_coordinates(made, tmp_path):
    """Anisotropic, view-dependent Gaussians of a fit: every format, pruning, saving, keyframes and a continued fit."""
    shutil.copytree(made / "fit", tmp_path / "run")
    before = open_run(tmp_path / "run", "cpu")
    sh_values = torch.randn(len(before.gaussians()), 16, 3, generator=torch.Generator().manual_seed(0)) * 0.3
    assert sh("level", tmp_path / "run", "--up", "photographs") == 0
    assert sh("level", tmp_path / "run", "--scale", "1,2,3", "-1,2.5,3", 4) == 0
    stored = open_run(tmp_path / "run", "cpu")
    n = stored.normalization
    assert n.unit == "m" and n.scale == pytest.approx(before.normalization.scale * math.hypot(2, 0.5) / 4)
    model = dataclasses.replace(before.gaussians(), sh=sh_values)
    camera = stored.scene_cameras[NAMES[2]]
    image = warpgs.rasterize(model, camera, stored.options()).rgb.detach()
    assert image.std() > 0.01
    moved = convert_camera(camera, n, "scene", "file")
    np.testing.assert_allclose(convert_camera(moved, n, "file", "scene").viewmat, camera.viewmat, atol=1e-12)
    write_gaussians(tmp_path / "a.ply", model, n)
    save(tmp_path / "a.safetensors", model, n)
    for g, c in (
        (warpgs.read_ply(tmp_path / "a.ply"), moved),
        (warpgs.load(tmp_path / "a.safetensors").gaussians("file"), moved),
        (warpgs.read_ply(tmp_path / "a.ply", n, units="scene"), camera),
    ):
        near = dataclasses.replace(stored.options(), near=0.01 / n.scale if c is moved else None)
        assert (warpgs.rasterize(g, c, near).rgb.detach() - image).abs().max() < 2e-3
    for suffix in (".spz", ".sog", ".glb", ".splat"):
        assert sh("export", tmp_path / "run", "--to", tmp_path / f"b{suffix}", "--no-clean") == 0
        found = warpgs.export.read_gaussians(tmp_path / f"b{suffix}").means
        wanted = stored.gaussians("file").means
        assert torch.cdist(wanted, found).amin(1).max() < 0.01
    key = {"c2w": np.linalg.inv(moved.viewmat).tolist(), "fov_y": 0.8, "seconds": 0}
    (tmp_path / "path.json").write_text(json.dumps([key]))
    film = read_keyframes(tmp_path / "path.json", camera, n)[0].camera
    np.testing.assert_allclose(film.viewmat, camera.viewmat, atol=1e-9)
    heights = [c.center @ n.up for _, c in plan_film(stored, "turntable", FilmSettings(frames=8)).cameras]
    assert rig_of([camera] * 3, 2.0, n.up).up is n.up and len(heights) == 8
    ply = (tmp_path / "run" / "point_cloud.ply").read_bytes()
    assert sh("fit", "--out", tmp_path / "run", "--resume") == 0
    assert (tmp_path / "run" / "point_cloud.ply").read_bytes() == ply
    assert similarity_values(open_run(tmp_path / "run", "cpu").normalization) == similarity_values(n)


def test_photographs_show_what_is_up():
    """All round and looking down, two of them on their side and one askew: within 1 degree; without agreement an error."""
    eyes = [np.array([3 * math.cos(a), -1.5, 3 * math.sin(a)]) for a in np.arange(11) * 0.5]
    cameras = {f"{i}": Camera(look_at(e, np.zeros(3), UP), CAMERAS[0].K, 96, 72) for i, e in enumerate(eyes)}

    def held(names, roll):
        turn = np.eye(4)
        turn[:3, :3] = rotation_about(np.array([0, 0, 1.0]), math.radians(roll))
        return {n: dataclasses.replace(cameras[n], viewmat=turn @ cameras[n].viewmat) for n in names}

    for i, name in enumerate(cameras):
        cameras |= held([name], 0.5 * (-1) ** i)
    cameras |= held("38", 90) | held("5", 25)
    run = SimpleNamespace(scene_cameras=cameras, train=(*cameras,), normalization=Normalization(rotation=TILT), folder="run")
    n, line = photographed(run)
    assert degrees_apart(n.up, UP) < 1 and re.search(r"lean by 0.[45]", line) and "one way" not in line
    np.testing.assert_allclose(n.rotation.T @ n.up, [0, -1, 0], atol=1e-12)
    row = SimpleNamespace(**vars(run) | {"train": ("0",)})
    assert "all look one way" in photographed(row)[1]
    cameras |= held("1", 180)
    with pytest.raises(DataError, match="no common upward direction; use --ground"):
        photographed(SimpleNamespace(**vars(run) | {"train": ("1", "2")}))


def test_gps_gives_place_and_north(run, made, tmp_path, capsys):
    """East, north and up in metres, though one photograph is off by 300 m; later scales and levels keep z up."""
    assert sh("level", run, "--gps") == 0
    said = capsys.readouterr().out
    assert "GPS of 7 of 8 photographs" in said and float(re.search(r"at most ([0-9.]+) m off", said)[1]) < 0.1
    turns, centers = poses(run, tmp_path / "cameras")
    east_north_up = 100 * TRUE @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert abs(between(centers) / between(east_north_up) - 1).max() < 0.001
    n = open_run(run, "cpu").normalization
    zero = metres_about(np.array([PLACE]), n.place)[0]
    np.testing.assert_allclose(centers - zero, east_north_up, atol=0.2)
    assert all(degrees_apart(t @ UP, [0, 0, 1]) < 0.1 and degrees_apart(t @ [0, 0, 1], [0, 1, 0]) < 0.1 for t in turns)
    assert sh("level", run, "--ground", *ground()) == 0 and "z is up" in capsys.readouterr().out
    after = open_run(run, "cpu").normalization
    assert np.linalg.norm(after.offset - n.offset) < 5 and after.place.tolist() == n.place.tolist()  # heights stay
    few = tmp_path / "few" / "images"
    few.mkdir(parents=True)
    for count, name in enumerate([*NAMES[:2], *NAMES[2:]]):
        assert sh("level", run, "--gps", few.parent) == 3
        error = capsys.readouterr().err
        assert f"{count} of 8 photographs have GPS in EXIF that fits the poses" in error and "--gps FOLDER" in error
        if count == 2:
            break
        shutil.copy(made / "scene" / name, few.parent / name)
    data = (made / "scene" / NAMES[0]).read_bytes()
    found = np.array(read_gps(data))
    np.testing.assert_allclose(
        metres_about(found[None], np.array(PLACE))[0], 100 * TRUE[0] @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=0.2
    )
    with Image.open(made / "scene" / NAMES[0]) as image:
        for place in ((91, 0, 0), (10, 10, 9e9), (0, 0, 0)):
            image.save(tmp_path / "odd.jpg", exif=exif(*place))
            assert read_gps((tmp_path / "odd.jpg").read_bytes()) is None
        image.save(tmp_path / "deep.jpg", exif=exif(10, -20, -30))
    data = (tmp_path / "deep.jpg").read_bytes()
    np.testing.assert_allclose(read_gps(data), (10, -20, -30))
    for end in range(0, 400):
        assert read_gps(data[:end]) is None or end > 150


def empty(run):
    """A pixel of a view in which nothing is to be seen, after the Gaussians there are gone."""
    tensors, state = load_checkpoint(run)
    tensors["params.logit_opacities"][:] = -9
    save_checkpoint(run, tensors, state)


BAD = {
    "outside": (["--scale", f"{NAMES[0]}:96,3", f"{NAMES[1]}:3,3", "1"], "96,3: outside of the image, which has 96 x 72 px"),
    "before it": (["--scale", f"{NAMES[0]}:-1,3", f"{NAMES[1]}:3,3", "1"], "outside of the image"),
    "background": (["--scale", f"{NAMES[0]}:9,3", f"{NAMES[1]}:3,3", "1"], "shows empty background .opacity 0.0"),
    "equal": (["--scale", f"{NAMES[0]}:9,3", f"{NAMES[0]}:9,3", "1"], "the two points are equal"),
    "no length": (["--scale", "0,0,0", "1,2,3", "0"], "the length must be above 0 m, not 0"),
    "negative": (["--scale", "0,0,0", "1,2,3", "-2"], "the length must be above 0 m, not -2"),
    "unknown": (["--scale", "images/00.png:9,3", f"{NAMES[0]}:9,3", "1"], "no view 'images/00.png'; did you mean images/00"),
    "words": (["--scale", "a,b", "1,2,3", "1"], "a,b: expected VIEW:x,y"),
    "nan": (["--scale", "1,2,nan", "1,2,3", "1"], "expected VIEW:x,y"),
    "in line": (["--ground", "0,0,0", "1,0,0", "2,0,0"], "equal or nearly on a line"),
    "nothing": ([], "give one of --scale"),
    "both": (["--up", "photographs", "--ground", "0,0,0", "1,0,0", "0,1,0"], "give one of --scale"),
    "scale of GPS": (["--gps", "--scale", "0,0,0", "1,2,3", "1"], "give one of --scale"),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD)
def test_picks_that_cannot_be_honoured(run, capsys, kind):
    words, message = BAD[kind]
    if kind == "background":
        empty(run)
    before = {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    assert sh("level", run, *words) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and re.search(message, error), error
    assert {p: p.read_bytes() for p in run.rglob("*") if p.is_file()} == before
