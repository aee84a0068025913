"""A ball of Gaussians becomes a mesh of a ball: place, colours, open backs, files in the units of the scene's files."""

import dataclasses
import re

import numpy as np
import pytest
import torch

from tests.mesh.balls import ALL_SIDES, CENTER, RADIUS, RED, ball, cameras
from warpgs.app.cli import main
from warpgs.errors import DataError, UsageError
from warpgs.mesh.fuse import MeshOptions, fuse, vertex_colors
from warpgs.mesh.views import SurfaceViews, sample_surface, surface_view
from warpgs.pipeline.films.paths import common_up
from warpgs.pipeline.run import export as run_mesh
from warpgs.pipeline.run.folder import METRICS_FILE, StoredRun
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Gaussians, Normalization

RENDER = RasterizeOptions()


@pytest.fixture(scope="module")
def fused():
    return fuse(ball(), cameras(ALL_SIDES), RENDER, MeshOptions(voxel=0.07))


def test_the_ball_is_found(fused):
    """Its vertices lie around the sphere, closer on average than half a voxel, on every side; its inside was not seen."""
    away = fused.mesh.vertices - CENTER
    distances = np.abs(np.linalg.norm(away, axis=1) - RADIUS)
    assert distances.mean() < 0.035 and np.quantile(distances, 0.99) < 0.14
    assert (np.abs(away).max(0) > 0.95).all() and fused.plan.voxel == 0.07 and 0.02 < fused.unseen < 0.5
    assert fused.extracted >= len(fused.mesh.faces) > 500


def test_colors_are_those_of_the_renders(fused):
    """Red on one side and blue on the other."""
    x = fused.mesh.vertices[:, 0] - CENTER[0]
    red = fused.mesh.colors[:, 0] > fused.mesh.colors[:, 2]
    assert (red == (x > 0))[np.abs(x) > 0.15].all()
    assert np.abs(fused.mesh.colors[x > 0.3] - RED).mean() < 0.05


def test_a_vertex_that_nobody_sees_has_its_neighbours_colour(fused):
    """The middle of the ball, and a point far behind every camera."""
    hidden = CENTER + np.array([[0.2, 0, 0], [-99, 0, 0]])
    more = dataclasses.replace(fused.mesh, vertices=np.concatenate([fused.mesh.vertices, hidden]))
    colors, count = vertex_colors(more, SurfaceViews(ball(), cameras(ALL_SIDES), RENDER, "median"), fused.plan.truncation)
    assert count == fused.uncolored + 2 and np.array_equal(colors[:-2], fused.mesh.colors)
    assert colors[-2, 0] > 0.5 > colors[-2, 2] and colors[-1, 2] > 0.5 > colors[-1, 0]


def test_the_back_that_nobody_saw_stays_open():
    """With cameras on one side alone; and the same bits on another number of threads."""
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        found.append(fuse(ball(), cameras(np.array([[0, 0, -1], [0.3, 0, -1], [0, 0.3, -1]])), RENDER, MeshOptions(voxel=0.07)))
    away = found[0].mesh.vertices - CENTER
    assert away[:, 2].max() < 0.5 and away[:, 2].min() < -0.9
    assert np.array_equal(found[0].mesh.vertices, found[1].mesh.vertices)
    assert np.array_equal(found[0].mesh.colors, found[1].mesh.colors)


def test_what_a_view_knows():
    """Depth of the ball's front, emptiness beside it, trust that falls towards the edge; the mean depth on request."""
    c = cameras(np.array([[0, 0, -1.0]]))[0]
    view, mean = surface_view(ball(), c, RENDER), surface_view(ball(), c, RENDER, "mean")
    assert float(view.depth[36, 36]) == pytest.approx(2.5, abs=0.05) and bool(torch.isinf(view.depth[0]).all())
    assert float(view.weights[36, 36]) > 0.8 and bool((view.weights[0] == 1).all())
    near_edge = view.weights[36, 7:10].mean()
    assert float(near_edge) < 0.7 and not torch.equal(view.depth, mean.depth)
    points, footprints = sample_surface(view, 1000)
    assert 200 < len(points) < 1200 and np.abs(np.linalg.norm(points - CENTER, axis=1) - RADIUS).mean() < 0.05
    assert footprints.mean() == pytest.approx(2.7 / (1.4 * 72), rel=0.1)
    with pytest.raises(UsageError, match="median, mean"):
        surface_view(ball(), c, RENDER, "mode")


@pytest.mark.parametrize("depth", ["median", "mean"])
def test_cameras_that_see_nothing_are_an_error(depth):
    """Of a transparent ball and of no Gaussians; also without cameras."""
    options, views = MeshOptions(depth=depth), cameras(ALL_SIDES[:2])
    nothing = Gaussians(*(t[:0] for t in ball().tensors().values()))
    for gaussians in (dataclasses.replace(ball(), logit_opacities=torch.full((3000,), -9.0)), nothing):
        with pytest.raises(DataError, match="no training view shows a surface"):
            fuse(gaussians, views, RENDER, options)
    with pytest.raises(UsageError, match="at least one camera"):
        fuse(ball(), [], RENDER, options)


def test_views_that_confirm_no_depth_are_an_error():
    """Front and back: each sees its own side, and neither confirms the other."""
    with pytest.raises(DataError, match="no depth of a training view is confirmed by another"):
        fuse(ball(), cameras(ALL_SIDES[[0, 3]]), RENDER, MeshOptions(voxel=0.07))


@pytest.fixture
def stored(monkeypatch, tmp_path_factory):
    """A finished run whose scene units are half of its files' units, and elsewhere."""
    views = {f"{i}.png": c for i, c in enumerate(cameras(ALL_SIDES))}
    folder = tmp_path_factory.mktemp("run")
    (folder / METRICS_FILE).touch()
    run = StoredRun(
        ball(), Normalization(np.array([10.0, 20, 30]), 0.5), views, tuple(views)[:9], tuple(views)[9:], "exact", (0, 0, 0), 7,
        folder, {},
    )  # fmt: skip
    monkeypatch.setattr(run_mesh, "open_run", lambda folder, device: run)
    return run


def test_the_command_writes_in_units_of_the_files(stored, tmp_path, capsys):
    """What was chosen comes first; the voxel is in units of the files, and what no view saw is said."""
    assert main(["mesh", "run", "--out", str(tmp_path / "a.ply"), "--voxel", "0.16", "--device", "cpu"]) == 0
    text = capsys.readouterr().out
    assert text.index("voxel 0.16 in units of the scene's files") < text.index("fusing depth: view 1 of 9")
    assert "was not observed by the 9 training views" in text and "triangles extracted" in text
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    count = int(head.split(b"element vertex ")[1].split()[0])
    vertices = np.frombuffer(body, [("x", "<f4", 3), ("c", "u1", 3)], count)["x"]
    away = (vertices - [10, 20, 30]) * 0.5 - CENTER
    assert np.abs(np.linalg.norm(away, axis=1) - RADIUS).mean() < 0.05
    assert sorted(p.name for p in tmp_path.iterdir() if not p.name.startswith(".")) == ["a.ply"]


def test_upright_where_the_cameras_agree(stored, tmp_path, capsys):
    """A .glb file turns their mean upward direction to +y; cameras that are turned all ways have none, which is said."""
    views = [c for c, d in zip(cameras(ALL_SIDES), ALL_SIDES) if abs(d[1]) < 0.9]
    assert common_up(views) @ [0, -1, 0] > 0.7
    half = np.diag([-1.0, -1, 1, 1])
    assert common_up([*views, *(dataclasses.replace(c, viewmat=half @ c.viewmat) for c in views)]) is None
    for upside_down in (False, True):
        kept = {n: c for n, c in stored.scene_cameras.items() if n in stored.train}
        for i, name in enumerate(kept if upside_down else ()):
            kept[name] = dataclasses.replace(
                kept[name], viewmat=np.diag([-1.0, -1, 1, 1] if i % 2 else np.ones(4)) @ kept[name].viewmat
            )
        stored.scene_cameras.update(kept)
        assert main(["mesh", "run", "--out", str(tmp_path / "a.glb"), "--resolution", "24", "--device", "cpu"]) == 0
        assert ("may be tilted in a viewer" in capsys.readouterr().out) == upside_down


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "a.obj"], r"format \.obj is not supported; use \.ply or \.glb"),
        (["--out", "a.ply", "--max-faces", "3"], "--max-faces must be at least 4"),
        (["--out", "a.ply", "--voxel", "-1"], "--voxel must be a number above 0, not -1"),
        (["--out", "a.ply", "--voxel", "1e-9"], "--voxel must be at least a millionth of the longest side of the scene"),
        (["--out", "a.ply", "--depth", "mode"], "median, mean"),
    ],
)
def test_flags_that_cannot_be_honoured(stored, tmp_path, monkeypatch, capsys, words, message):
    """One sentence, exit code 2, and no file."""
    monkeypatch.chdir(tmp_path)
    assert main(["mesh", "run", *words, "--device", "cpu"]) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and re.search(message, error)
    assert not [p for p in tmp_path.iterdir() if not p.name.startswith(".")]
