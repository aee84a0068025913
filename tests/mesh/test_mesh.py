"""Meshes: depth along rays, agreement of views, the grid, its triangles, and a ball that becomes a ball."""

import dataclasses
import json
import re

import numpy as np
import pytest
import torch

from tests.mesh.balls import ALL_SIDES, CENTER, RADIUS, RED, ball, cameras
from warpgs import rasterize
from warpgs.app.cli import main
from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.geometry import project_points, rotation_matrices
from warpgs.mesh import fuse as fusing, views
from warpgs.mesh.fuse import parts
from warpgs.mesh.views import (
    SurfaceView,
    SurfaceViews,
    agreed,
    depth_map,
    neighbours,
    sample_surface,
    surface_depth,
    surface_view,
    weighted_median,
)
from warpgs.pipeline.films.paths import common_up
from warpgs.pipeline.run import export as run_mesh
from warpgs.pipeline.run.folder import METRICS_FILE, StoredRun
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Camera, Gaussians, Mesh, Normalization

RENDER = RasterizeOptions()


@pytest.fixture(scope="module")
def fused():
    return fusing.fuse(ball(), cameras(ALL_SIDES), RENDER, fusing.MeshOptions(voxel=0.07))


def test_the_ball_is_found_in_its_colours(fused):
    """Its vertices lie around the sphere, closer on average than half a voxel, on every side; its inside was not seen."""
    away = fused.mesh.vertices - CENTER
    distances = np.abs(np.linalg.norm(away, axis=1) - RADIUS)
    assert distances.mean() < 0.035 and np.quantile(distances, 0.99) < 0.14
    assert (np.abs(away).max(0) > 0.95).all() and fused.plan.voxel == 0.07 and 0.02 < fused.unseen < 0.5
    assert fused.extracted >= len(fused.mesh.faces) > 500
    x = fused.mesh.vertices[:, 0] - CENTER[0]
    red = fused.mesh.colors[:, 0] > fused.mesh.colors[:, 2]
    assert (red == (x > 0))[np.abs(x) > 0.15].all()
    assert np.abs(fused.mesh.colors[x > 0.3] - RED).mean() < 0.05
    hidden = CENTER + np.array([[0.2, 0, 0], [-99, 0, 0]])
    more = dataclasses.replace(fused.mesh, vertices=np.concatenate([fused.mesh.vertices, hidden]))
    colors, count = fusing.vertex_colors(
        more, SurfaceViews(ball(), cameras(ALL_SIDES), RENDER, "median"), fused.plan.truncation
    )
    assert count == fused.uncolored + 2 and np.array_equal(colors[:-2], fused.mesh.colors)
    assert colors[-2, 0] > 0.5 > colors[-2, 2] and colors[-1, 2] > 0.5 > colors[-1, 0]


def test_each_triangle_shows_the_view_in_which_it_is_largest(fused):
    """The texture has the colours of the vertices, without a seam; no texture where triangles are as fine as pixels."""
    mesh = fused.mesh
    height, width = mesh.texture.shape[:2]
    columns, rows = np.clip((mesh.uv.mean(1) * [width, height]).astype(int), 0, [width - 1, height - 1]).T
    flat = (mesh.uv == mesh.uv[:, :1]).all((1, 2))
    assert flat.mean() < 0.2 and mesh.texture.dtype == np.uint8 and max(height, width) <= 4096
    assert (mesh.texture[rows[flat], columns[flat]] == 255).all() and mesh.uv.min() >= 0 and mesh.uv.max() <= 1
    texels, colors = mesh.texture[rows, columns] / 255, mesh.colors[mesh.faces].mean(1)
    off = np.abs(texels - colors).max(1)[~flat]
    assert np.median(off) < 0.03 and np.quantile(off, 0.95) < 0.3
    views = SurfaceViews(ball(), cameras(ALL_SIDES), RENDER, "median")
    plain = dataclasses.replace(mesh, texture=None, uv=None)
    assert fusing.textured(plain, views, fused.plan.truncation, 1.0) is plain
    again = fusing.textured(plain, views, fused.plan.truncation, 0.02)
    assert np.array_equal(again.uv, mesh.uv) and np.array_equal(again.texture, mesh.texture)
    largest = np.max([doubled_areas(project_points(c, mesh.vertices)[0][mesh.faces]) for c in cameras(ALL_SIDES)], axis=0)
    assert np.median(doubled_areas(mesh.uv * [width, height])[~flat]) > 0.5 * np.median(largest)


def doubled_areas(corners: np.ndarray) -> np.ndarray:
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def test_a_mesh_of_the_subject_alone():
    """What a third of the cameras look at, at a finer voxel; or what is in a box; an empty box is an error."""
    far = dataclasses.replace(ball(), means=ball().means + torch.tensor([9.0, 0, 0]))
    both = Gaussians(*(torch.cat(pair) for pair in zip(ball().tensors().values(), far.tensors().values())))
    front = cameras(np.array([[0, 0, -1], [0.2, 0, -1], [0, 0.2, -1], [0.1, 0.1, -1], [0.2, 0.2, -1]]))
    shift = np.eye(4) - 9 * np.eye(4)[:, :1] * np.eye(4)[3:]
    aside = [dataclasses.replace(c, viewmat=c.viewmat @ shift) for c in front[:2]]
    views, options = [*front, *aside], fusing.MeshOptions(resolution=24)
    whole = fusing.fuse(both, views, RENDER, options).mesh
    assert whole.vertices[:, 0].max() > 9
    cropped = fusing.fuse(both, views, RENDER, dataclasses.replace(options, crop="auto"))
    assert cropped.mesh.vertices[:, 0].max() < 1.7 and cropped.plan.voxel < 0.15
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
    box = CENTER + np.array([9, 0, -1]), np.array([1.2, 1.0, 2.0]), turn
    part = fusing.fuse(both, views, RENDER, fusing.MeshOptions(voxel=0.1, crop=box)).mesh
    inside = (part.vertices - box[0]) @ turn
    assert len(part.faces) > 50 and (np.abs(inside) <= box[1] / 2).all() and (np.abs(inside).max(0)[:2] > 0.4).all()
    with pytest.raises(DataError, match="no surface is inside the box"):
        fusing.fuse(both, views, RENDER, fusing.MeshOptions(crop=(box[0] + 99, *box[1:])))
    with pytest.raises(UsageError, match="--crop must be auto or a box, not 'subject'"):
        fusing.MeshOptions(crop="subject")


def test_holes_are_filled_on_request():
    """Uncertain and contradicted depths count a thousandth, so certain ones win; small holes are closed, large ones stay."""
    c = cameras(np.array([[0, 0, -1.0]]))[0]
    mist = dataclasses.replace(ball(), logit_opacities=torch.full((3000,), -1.0))
    open_view, filled = surface_view(mist, c, RENDER), surface_view(mist, c, RENDER, fill=True)
    unsure = (open_view.depth == 0) & (filled.depth > 0)
    assert 100 < int(unsure.sum()) and torch.equal(open_view.depth[~unsure], filled.depth[~unsure])
    assert 0 < float(filled.weights[unsure].max()) <= 1e-3 and not bool(open_view.weights[unsure].any())
    assert len(sample_surface(filled, 10**6)[0]) == len(sample_surface(open_view, 10**6)[0])
    contradicted = agreed(wall(0.0), [depth_map(wall(0.5, 6.0), 2)], fill=True)
    assert bool((contradicted.depth == 4).all()) and float(contradicted.weights[:, 20:].max()) == pytest.approx(1e-3)
    mesh = fusing.extract(*grid_of(sphere))
    middles = mesh.vertices[mesh.faces].mean(1)
    hole = (np.linalg.norm(middles - [1, 0, 0], axis=1) < 0.25) | (np.linalg.norm(middles - np.array([-1, 0, 0]), axis=1) < 0.7)
    holed = dataclasses.replace(mesh, faces=mesh.faces[~hole])
    closed = fusing.fill_holes(holed, 0.5)
    area, normals, added = areas_and_normals(dataclasses.replace(closed, faces=closed.faces[len(holed.faces) :]))
    assert area.sum() == pytest.approx(0.202, rel=0.1) and (added[:, 0] > 0.9).all()
    assert ((normals * added).sum(1) > 0).all(), "they face outwards"


def test_the_back_that_nobody_saw_stays_open():
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        found.append(
            fusing.fuse(
                ball(), cameras(np.array([[0, 0, -1], [0.3, 0, -1], [0, 0.3, -1]])), RENDER, fusing.MeshOptions(voxel=0.07)
            )
        )
    away = found[0].mesh.vertices - CENTER
    assert away[:, 2].max() < 0.5 and away[:, 2].min() < -0.9
    assert np.array_equal(found[0].mesh.vertices, found[1].mesh.vertices)
    assert np.array_equal(found[0].mesh.colors, found[1].mesh.colors)
    # a view knows the ball's front, emptiness beside it, trust that falls towards the edge; the mean depth on request
    c = cameras(np.array([[0, 0, -1.0]]))[0]
    view, mean = surface_view(ball(), c, RENDER), surface_view(ball(), c, RENDER, "mean")
    assert float(view.depth[36, 36]) == pytest.approx(2.5, abs=0.05) and bool(torch.isinf(view.depth[0]).all())
    assert float(view.weights[36, 36]) > 0.8 and bool((view.weights[0] == 1).all())
    near_edge = view.weights[36, 7:10].mean()
    assert float(near_edge) < 0.7 and not torch.equal(view.depth, mean.depth)
    points, footprints = sample_surface(view, 1000)
    assert 200 < len(points) < 1200 and np.abs(np.linalg.norm(points - CENTER, axis=1) - RADIUS).mean() < 0.05
    assert footprints.mean() == pytest.approx(2.7 / (1.4 * 72), rel=0.1)


@pytest.mark.parametrize("depth", ["median", "mean"])
def test_cameras_that_see_nothing_are_an_error(depth):
    options, views = fusing.MeshOptions(depth=depth), cameras(ALL_SIDES[:2])
    nothing = Gaussians(*(t[:0] for t in ball().tensors().values()))
    for gaussians in (dataclasses.replace(ball(), logit_opacities=torch.full((3000,), -9.0)), nothing):
        with pytest.raises(DataError, match="no training view shows a surface"):
            fusing.fuse(gaussians, views, RENDER, options)
    with pytest.raises(UsageError, match="at least one camera"):
        fusing.fuse(ball(), [], RENDER, options)
    with pytest.raises(DataError, match="no depth of a training view is confirmed by another"):  # front and back
        fusing.fuse(ball(), cameras(ALL_SIDES[[0, 3]]), RENDER, fusing.MeshOptions(voxel=0.07, depth=depth))


@pytest.fixture
def stored(monkeypatch, tmp_path_factory):
    views = {f"{i}.png": c for i, c in enumerate(cameras(ALL_SIDES))}
    folder = tmp_path_factory.mktemp("run")
    (folder / METRICS_FILE).touch()
    run = StoredRun(
        ball(), Normalization(np.array([10.0, 20, 30]), 0.5), views, tuple(views)[:9], tuple(views)[9:], "exact", (0, 0, 0), 7,
        folder, {"scene": {"path": None}},
    )  # fmt: skip
    monkeypatch.setattr(run_mesh, "open_run", lambda folder, device: run)
    return run


def test_the_command_writes_in_units_of_the_files(stored, tmp_path, capsys):
    """A box is six numbers, as of `warpgs export`; with holes filled."""
    assert main(["mesh", "run", "--out", str(tmp_path / "a.ply"), "--voxel", "0.16", "--device", "cpu"]) == 0
    text = capsys.readouterr().out
    assert text.index("voxel 0.16 units") < text.index("fusing depth: view 1 of 9")
    assert "was not observed by the 9 training views; the mesh is open there; try --crop auto and --fill-holes\n" in text
    assert "triangles extracted" in text

    def vertices():
        head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
        return np.frombuffer(body, [("x", "<f4", 3), ("c", "u1", 3)], int(head.split(b"element vertex ")[1].split()[0]))["x"]

    away = (vertices() - [10, 20, 30]) * 0.5 - CENTER
    assert np.abs(np.linalg.norm(away, axis=1) - RADIUS).mean() < 0.05
    assert sorted(p.name for p in tmp_path.iterdir() if not p.name.startswith(".")) == ["a.ply"]
    low, high = (np.array([10, 20, 30]) + (CENTER + s) / 0.5 for s in ([-2, -2, -2], [0, 2, 2]))
    words = ["--crop", ",".join(f"{v:g}" for v in (*low, *high)), "--fill-holes", "--voxel", "0.16", "--device", "cpu"]
    assert main(["mesh", "run", "--out", str(tmp_path / "a.glb"), *words]) == 0
    assert "the mesh is open there\n" in capsys.readouterr().out
    assert main(["mesh", "run", "--out", str(tmp_path / "a.ply"), *words]) == 0
    assert len(vertices()) > 100 and (vertices() >= low).all() and (vertices() <= high).all()
    assert b"TEXCOORD_0" in (tmp_path / "a.glb").read_bytes()


def test_upright_where_the_cameras_agree(stored, tmp_path, capsys):
    """A .glb file turns their mean upward direction to +y; cameras that are turned all ways have none, which is said."""
    views = [c for c, d in zip(cameras(ALL_SIDES), ALL_SIDES) if abs(d[1]) < 0.9]
    assert common_up(views) @ [0, -1, 0] > 0.7
    half = np.diag([-1.0, -1, 1, 1])
    assert common_up([*views, *(dataclasses.replace(c, viewmat=half @ c.viewmat) for c in views)]) is None
    for upside_down in (False, True):
        for name in stored.train[1::2] if upside_down else ():
            c = stored.scene_cameras[name]
            stored.scene_cameras[name] = dataclasses.replace(c, viewmat=half @ c.viewmat)
        assert main(["mesh", "run", "--out", str(tmp_path / "a.glb"), "--resolution", "24", "--device", "cpu"]) == 0
        assert ("may be tilted in a viewer" in capsys.readouterr().out) == upside_down


def test_the_front_faces_the_viewer_where_coordinates_are_made_up(stored, tmp_path):
    """Cameras on the +z side of a .glb file, if their poses were found from photographs; given coordinates keep their axes."""
    sides, turns = cameras(np.array([[1, 0, 0.2], [1, 0, -0.2], [1, 0, 0]])), []
    stored.scene_cameras.update(zip(stored.train, 3 * sides))
    for made_up in (False, True):
        if made_up:
            (stored.folder / "scene").mkdir()
            (stored.folder / "scene" / "poses.json").touch()
        assert main(["mesh", "run", "--out", str(tmp_path / "a.glb"), "--resolution", "24", "--device", "cpu"]) == 0
        x, y, z, w = json.loads((tmp_path / "a.glb").read_bytes()[20:].partition(b"BIN\0")[0][:-4])["nodes"][0]["rotation"]
        turns.append(rotation_matrices(torch.tensor([[w, x, y, z]], dtype=torch.float64))[0].numpy())
    assert all(np.allclose(turn @ [0, -1, 0], [0, 1, 0]) for turn in turns)
    assert np.allclose(turns[0] @ [-1, 0, 0], [-1, 0, 0]) and np.allclose(turns[1] @ [-1, 0, 0], [0, 0, -1])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "a.obj"], r"format \.obj is not supported; use \.ply or \.glb"),
        (["--out", "a.ply", "--max-faces", "3"], "--max-faces must be at least 4"),
        (["--out", "a.ply", "--depth", "mode"], "median, mean"),
    ],
)
def test_flags_that_cannot_be_honoured(stored, tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    assert main(["mesh", "run", *words, "--device", "cpu"]) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and re.search(message, error)
    assert not [p for p in tmp_path.iterdir() if not p.name.startswith(".")]


CPU = torch.device("cpu")


def points(count=20_000):
    rng = np.random.default_rng(0)
    x = rng.uniform((-1, 0, 2), (1, 0.5, 6), (count, 3))
    x[: count // 50] *= 100
    return x


def test_a_voxel_is_what_is_asked_for():
    x, pixel = points(), np.full(20_000, 1e-4)
    longest = float(np.ptp(fusing.find_box(x), axis=0).max())
    assert fusing.plan_grid(x, pixel, voxel=0.05).voxel == 0.05
    assert fusing.plan_grid(x, pixel, resolution=100).voxel == longest / 100
    assert fusing.plan_grid(x, pixel).voxel == longest / 256 and fusing.plan_grid(x, np.full(20_000, 0.2)).voxel == 0.1
    plan = fusing.plan_grid(x, pixel, voxel=0.05)
    first, last = np.array(plan.origin), np.array(plan.origin) + 0.05 * (np.array(plan.shape) - 1)
    low, high = fusing.find_box(x)
    assert (low - first >= 4 * 0.05 - 1e-9).all() and (last - high >= 4 * 0.05 - 1e-9).all()
    assert plan.points == np.prod(plan.shape) and 0.97 < plan.inside < 1 and plan.truncation == 0.2
    assert (low > [-3.6, -0.1, 1.9]).all() and (low <= [-0.98, 0.01, 2.04]).all()
    assert (high < [3.6, 1.2, 11.2]).all() and (high >= [0.98, 0.49, 5.9]).all()


def test_grids_that_make_no_sense_or_do_not_fit_are_refused(monkeypatch):
    nan = float("nan")
    for options, words in (
        ({"voxel": 0.0}, "above 0"), ({"voxel": nan}, "above 0"), ({"voxel": 1e-9}, "at least a millionth"),
        ({"voxel": 1.0, "resolution": 9}, "one of them"), ({"resolution": 7}, "8, 4096"), ({"resolution": 4097}, "8, 4096"),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=words):
            fusing.plan_grid(points(), np.full(20_000, 1e-4), fusing.MeshOptions(**options).voxel)
    plan = fusing.GridPlan((0, 0, 0), 1.0, (1000, 1000, 100), 1.0)
    monkeypatch.setattr(fusing, "available_bytes", lambda _: 3 * 10**9)
    assert fusing.check_memory(plan, CPU) == "2.0 GiB"
    monkeypatch.setattr(fusing, "available_bytes", lambda _: 2 * 10**9)
    with pytest.raises(ResourceError, match=r"takes 2\.0 GiB of 1\.9 GiB free; give a larger"):
        fusing.check_memory(plan, CPU)
    monkeypatch.setattr(fusing, "available_bytes", lambda _: 10**15)
    with pytest.raises(ResourceError, match="kernels can index"):
        fusing.check_memory(fusing.GridPlan((0, 0, 0), 1.0, (1300, 1300, 1300), 1.0), CPU)


ORIGIN, VOXEL = (-1.5, -1.4, -1.6), 0.1


def grid_of(distance, seen=None, shape=(31, 29, 33)):
    """Return a grid of a distance function of points [..., 3], in units of four voxels, seen where ``seen`` says."""
    x = np.array(ORIGIN) + VOXEL * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    weights = np.ones(shape) if seen is None else seen(x).astype(float)
    values = np.clip(distance(x) / (4 * VOXEL), -1, 1)
    return fusing.GridPlan(ORIGIN, VOXEL, shape, 1.0), torch.tensor(values).float(), torch.tensor(weights).float()


def sphere(x):
    return np.linalg.norm(x, axis=-1) - 1


def areas_and_normals(mesh: Mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a) / 2
    return np.linalg.norm(normals, axis=1), normals, (a + b + c) / 3


def test_a_sphere_is_closed_and_faces_outwards():
    mesh = fusing.extract(*grid_of(sphere))
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 0.02 * VOXEL
    area, normals, middles = areas_and_normals(mesh)
    assert area.sum() == pytest.approx(4 * np.pi, rel=0.01)
    assert (normals * middles).sum() / 3 == pytest.approx(4 / 3 * np.pi, rel=0.01)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all() and parts(mesh)[0] == 1
    assert mesh.faces.dtype == np.int32 and mesh.colors.shape == mesh.vertices.shape
    # a fifth of the triangles: at most a tenth of a voxel off, the same open edge, the same bits twice; few stay as they are
    mesh = fusing.extract(*grid_of(sphere, lambda x: x[..., 0] < 0.33))
    fewer = fusing.decimate(mesh, len(mesh.faces) // 5)
    assert 0.15 * len(mesh.faces) < len(fewer.faces) <= 0.2 * len(mesh.faces) + 1
    assert np.abs(np.linalg.norm(fewer.vertices, axis=1) - 1).max() < 0.1 * VOXEL
    assert fewer.vertices[:, 0].max() == pytest.approx(mesh.vertices[:, 0].max(), abs=VOXEL / 2)
    _, normals, middles = areas_and_normals(fewer)
    assert (normals * middles).sum() > 0
    assert fusing.decimate(mesh, len(mesh.faces)) is mesh
    assert np.array_equal(fewer.vertices, fusing.decimate(mesh, len(mesh.faces) // 5).vertices)


def test_what_was_not_seen_stays_open_without_skirts_and_small_parts_go():
    mesh = fusing.extract(*grid_of(sphere, lambda x: x[..., 0] < 0.33))
    assert 0.2 < mesh.vertices[:, 0].max() < 0.33
    _, normals, middles = areas_and_normals(mesh)
    assert ((normals * middles).sum(1) > 0).all()  # a lid would face another way than outwards
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)
    for limit in (9, 1.2):  # nothing seen at all, and nothing but emptiness
        with pytest.raises(DataError, match="no surface inside the grid"):
            fusing.extract(*grid_of(sphere, lambda x, limit=limit: x[..., 0] > limit))
    # no skirt between two surfaces
    mesh = fusing.extract(*grid_of(lambda x: np.where(x[..., 0] < 0.05, x[..., 2] + 0.53, x[..., 2] - 0.53)))
    assert (np.abs(np.abs(mesh.vertices[:, 2]) - 0.53) < 1.2 * VOXEL).all() and parts(mesh)[0] == 2
    # small parts go
    alone = fusing.extract(*grid_of(sphere))
    both = fusing.extract(*grid_of(lambda x: np.minimum(sphere(x), np.linalg.norm(x - [1.2, 1.1, 1.3], axis=-1) - 0.12)))
    assert parts(both)[0] == 2
    mesh, removed = fusing.remove_small_parts(both, 0.05)
    assert removed == 1 and len(mesh.faces) == len(alone.faces) and np.allclose(mesh.vertices, alone.vertices)
    kept, none = fusing.remove_small_parts(both, 0.0)
    assert none == 0 and len(kept.faces) == len(both.faces)


WIDTH, HEIGHT = 48, 32
K = np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])


def wall(x: float, depth: float = 4.0) -> SurfaceView:
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    z = torch.full((HEIGHT, WIDTH), depth)
    return SurfaceView(Camera(viewmat, K, WIDTH, HEIGHT), z, torch.ones_like(z), torch.zeros(HEIGHT, WIDTH, 3))


def test_depth_stays_where_another_view_confirms_it_or_none_looks():
    view = wall(0.0)
    view.depth[:4] = torch.inf
    for depth, kept in ((4.0, True), (4.07, True), (4.09, False), (3.9, False)):
        found = agreed(view, [depth_map(wall(0.5, depth), 2)])
        assert bool((found.depth[4:, 8:] > 0).all()) == kept and bool((found.weights[4:, 8:] > 0).all()) == kept
        assert torch.equal(found.depth[:4], view.depth[:4]) and torch.equal(found.weights[:4], view.weights[:4])
    found = agreed(wall(0.0), [depth_map(wall(x, d), 3) for x, d in ((0.5, 6.0), (-0.5, 4.0))])
    assert bool((found.depth[:, :40] == 4).all()) and not bool(found.depth[:, -3:].any())
    view = wall(0.0)
    found = agreed(view, [depth_map(wall(2.4, 9.0), 2)])
    beside = round(40 * 2.4 / 4)  # the columns that the other image shows begin here
    assert bool((found.depth[:, : beside - 1] == 4).all()) and not bool(found.depth[:, beside:].any())
    empty = dataclasses.replace(wall(0.5), depth=torch.zeros(HEIGHT, WIDTH))
    for others in ([], [depth_map(empty, 2)]):
        assert torch.equal(agreed(view, others).depth, view.depth)
    sky = dataclasses.replace(wall(0.5), depth=torch.full((HEIGHT, WIDTH), torch.inf))
    maps = [depth_map(v, 2) for v in (wall(0.0), sky)]
    assert neighbours(maps) == [[1], [0]] and torch.equal(agreed(wall(0.0), maps[1:]).depth, wall(0.0).depth)
    assert torch.equal(agreed(sky, maps[:1]).depth, sky.depth) and maps[1][3] == pytest.approx((1.0, 1.01))


def test_thinned_maps_say_the_same(monkeypatch):
    view, other = wall(0.0), wall(0.3)
    for v in (view, other):
        x = (torch.arange(WIDTH) + 0.5 - 24) / 40
        v.depth[:] = (4 + 0.1 * float(v.camera.center[0])) / (1 - 0.1 * x)  # z = 4 + x / 10
    monkeypatch.setattr(views, "MAX_PIXELS", 2 * WIDTH * HEIGHT / 7)
    thin = depth_map(other, 2)
    assert thin[2] == 3 and thin[1].shape == (11, 16) and torch.equal(thin[1], other.depth[1::3, 1::3])
    assert torch.equal(agreed(view, [thin]).depth, view.depth)
    assert not bool(agreed(dataclasses.replace(view, depth=view.depth * 1.1), [thin]).depth[:, 8:].any())
    # neighbours share sight
    maps = [depth_map(wall(x), 5) for x in (0.0, 0.5, 1.0, 1.5, 90.0)]
    monkeypatch.setattr(views, "NEIGHBOURS", 2)
    assert neighbours(maps)[0] == [1, 2] and sorted(neighbours(maps)[2]) == [1, 3]
    assert neighbours(maps[:1]) == [[]]


FRONT = Camera(np.eye(4), K, 48, 32)


def layer(depth: float, slope: float = 0.0, opacity: float = 3.0, spacing: float = 0.3) -> Gaussians:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-6, 6, spacing), np.arange(-4, 4, spacing)))
    turn = -np.arctan(slope) / 2  # about the y axis
    quat = torch.tensor([np.cos(turn), 0.0, np.sin(turn), 0.0])
    scales = torch.tensor([0.8 * spacing, 0.8 * spacing, 1e-3]).log()
    means = torch.tensor(np.stack([x, y, depth + slope * x], 1))
    count = len(means)
    return Gaussians(
        means.float(), quat.float().expand(count, 4).contiguous(), scales.float().expand(count, 3).contiguous(),
        torch.full((count,), opacity), torch.zeros(count, 1, 3),
    )  # fmt: skip


def joined(*parts: Gaussians) -> Gaussians:
    return Gaussians(*(torch.cat(t) for t in zip(*(p.tensors().values() for p in parts))))


def test_the_median_by_weight():
    depths = torch.tensor([[3.0, 1.0, 2.0, 0.1], [5.0, 4.0, 9.0, 9.0], [7.0, 7.0, 7.0, 7.0]])
    weights = torch.tensor([[0.2, 0.2, 0.3, 0.0], [0.3, 0.2, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    assert weighted_median(depths, weights).tolist() == [2.0, 5.0, 7.0]


def test_depths_of_slanted_layered_and_extreme_gaussians(monkeypatch):
    """Wide Gaussians on a slanted plane: depth is the plane's to 0.1 %; that of their means is off 20 times as far."""
    plane = layer(4.0, 0.4)
    view = surface_view(plane, FRONT, RasterizeOptions())
    true = 4 / (1 - 0.4 * (torch.arange(48) + 0.5 - 24) / 40)
    inside = (slice(6, -6), slice(6, -6))
    error = (view.depth / true - 1).abs()[inside]
    means = (rasterize(plane, FRONT, RasterizeOptions(median_depth=True)).median_depth / true - 1).abs()[inside]
    assert float(error.max()) < 1e-3 and float(means.mean()) > 20 * float(error.mean())
    # three layers, none with half of the weight: depth 0 and trust 0; one opaque layer before them is known again
    layers = [layer(depth, opacity=-1.9) for depth in (3.0, 4.0, 5.0, 6.0)]
    view = surface_view(joined(*layers, layer(8.0)), FRONT, RasterizeOptions())
    middle = (slice(8, -8), slice(8, -8))
    assert float((view.depth[middle] == 0).float().mean()) > 0.9 and not bool(view.weights[view.depth == 0].any())
    view = surface_view(joined(layer(2.5), *layers), FRONT, RasterizeOptions())
    assert torch.allclose(view.depth[middle], torch.tensor(2.5), atol=0.01)
    # axes of 1e-9 and 1e9 give finite depths; pixels without a Gaussian have none; blocks of pixels give the same bits
    g = layer(4.0)
    needles = dataclasses.replace(g, log_scales=g.log_scales + torch.tensor([-20.0, 20.0, 0.0]))
    r = rasterize(g, FRONT, RasterizeOptions(heaviest=8))
    depth, share = surface_depth(needles, FRONT, r.heaviest_ids, r.heaviest_weights)
    assert bool(torch.isfinite(depth).all()) and bool(((share >= 0) & (share <= 1 + 1e-6)).all())
    nothing = torch.full((32, 48, 4), -1, dtype=torch.int32)
    assert not any(bool(t.any()) for t in surface_depth(g, FRONT, nothing, torch.zeros(32, 48, 4)))
    whole = surface_depth(g, FRONT, r.heaviest_ids, r.heaviest_weights)
    monkeypatch.setattr(views, "BLOCK", 100)
    parts = surface_depth(g, FRONT, r.heaviest_ids, r.heaviest_weights)
    assert all(torch.equal(a, b) for a, b in zip(whole, parts))
