"""Refinement of training poses: the increments, a fit that finds poses back, and runs that keep them."""

import dataclasses
import json

import numpy as np
import pytest
import torch

import warpgs
from tests import scenes
from warpgs.app.cli import main
from warpgs.geometry import matmul
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.view_modules import (
    CAMERA_NUMBER,
    FOCAL,
    ROTATION,
    TRANSLATION,
    RefinePoses,
    increments,
    moved,
    pose_figures,
    refined_cameras,
    similarity,
    zoomed,
)
from warpgs.pipeline.train.views import current
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, View
from warpgs.synthetic.demo import split_spec, write_demo

CPU = torch.device("cpu")


def noisy(views, degrees=0.6, shift=0.02, seed=0):
    """The views with every pose but the first turned by an angle and moved by a distance [u], in random directions."""
    generator = np.random.default_rng(seed)
    found = [views[0]]
    for v in views[1:]:
        w, t = (x / np.linalg.norm(x) for x in generator.standard_normal((2, 3)))
        w = 2 * np.tan(np.radians(degrees) / 2) * w
        motion = increments(torch.tensor(w), torch.tensor(shift * t)).numpy()
        found.append(dataclasses.replace(v, camera=dataclasses.replace(v.camera, viewmat=matmul(motion, v.camera.viewmat))))
    return found


def errors(views, truth):
    """Mean angle [degrees] and distance of centres [u] between the poses of views."""
    rows = pose_figures(
        {v.name: v.camera for v in truth}, {v.name: v.camera for v in views}, [v.name for v in views], False, 1.0
    )
    return np.mean([(r["degrees"], r["units"]) for r in rows["views"][1:]], axis=0)


def test_increments_are_rigid_and_their_gradients_are_right():
    """Against the matrix exponential of the same angle and axis; against differences; the first view never moves."""
    generator = torch.Generator().manual_seed(0)
    w, t, V = (torch.randn(*s, generator=generator, dtype=torch.float64) for s in ((3, 3), (3, 3), (3, 4, 4)))
    motion = increments(w, t)
    for m, a, b in zip(motion, w, t):
        x, y, z = (2 * torch.atan(a.norm() / 2) * a / a.norm()).tolist()
        expected = torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64))
        torch.testing.assert_close(m[:3, :3], expected)
        assert torch.equal(m[:3, 3], b) and m[3].tolist() == [0, 0, 0, 1]
    w[1] = 0
    w.requires_grad_(), t.requires_grad_()

    def rendered_from(w, t):
        values = RefinePoses().values({ROTATION: w, TRANSLATION: t}, torch.tensor([0, 1, 2]))
        return RefinePoses().before_render(Camera(V, None, 1, 1), values).viewmat

    assert torch.autograd.gradcheck(rendered_from, (w, t))
    assert torch.equal(rendered_from(w, t)[0], V[0])
    torch.testing.assert_close(rendered_from(w, t)[1:], increments(w, t)[1:] @ V[1:])


def test_a_gradient_through_the_rasterizer_is_that_of_differences():
    gaussians, camera = scenes.three_gaussians(), scenes.ring(2)[1]
    gaussians = dataclasses.replace(gaussians, **{n: x.double() for n, x in gaussians.tensors().items()})
    V, K = (torch.tensor(x, dtype=torch.float64) for x in (camera.viewmat, camera.K))
    weights = torch.rand(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def value(p):
        now = moved(V[None], p[None, :3], p[None, 3:])[0]
        return (rasterize(gaussians, dataclasses.replace(camera, viewmat=now, K=K)).rgb * weights).sum()

    p = torch.tensor([0.01, -0.02, 0.015, 0.02, 0.01, -0.03], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(value(p), p)
    eye = 1e-6 * torch.eye(6, dtype=torch.float64)
    differences = torch.stack([(value(p.detach() + e) - value(p.detach() - e)) / 2e-6 for e in eye])
    torch.testing.assert_close(gradient, differences, rtol=1e-4, atol=1e-4)


def test_a_focal_length_s_gradient_is_right_and_shared_by_the_views_of_a_camera():
    """Against differences, in the module and through the rasterizer; a second camera has a factor of its own."""
    views = [
        dataclasses.replace(v, camera=dataclasses.replace(v.camera, K=v.camera.K * k))
        for v, k in zip(scenes.photos(3), (1, 2, 1))
    ]
    module = RefinePoses(focal_lr=1e-3)
    params = {n: t.double() for n, t in module.parameters(views).items()}
    assert params[CAMERA_NUMBER][:, 0].tolist() == [0, 1, 0]
    z = torch.tensor([[0.1], [-0.2], [0.1]], dtype=torch.float64, requires_grad=True)
    K = torch.stack([torch.tensor(v.camera.K, dtype=torch.float64) for v in views])

    def intrinsics(z):
        values = module.values(params | {FOCAL: z}, torch.arange(3))
        return module.before_render(Camera(torch.eye(4).double().expand(3, 4, 4), K, 1, 1), values).K

    assert torch.autograd.gradcheck(intrinsics, (z,))
    s = torch.tensor([2.1 / 1.9, 1.8 / 2.2, 2.1 / 1.9], dtype=torch.float64)
    torch.testing.assert_close(intrinsics(z)[:, :2, :2], K[:, :2, :2] * s[:, None, None])
    assert torch.equal(intrinsics(z)[:, :, 2], K[:, :, 2])
    (gradient,) = torch.autograd.grad(intrinsics(z)[0].sum(), z)
    assert gradient[0] == gradient[2] != 0 and gradient[1] == 0

    gaussians, camera = scenes.three_gaussians(), scenes.ring(2)[1]
    gaussians = dataclasses.replace(gaussians, **{n: x.double() for n, x in gaussians.tensors().items()})
    V, K = (torch.tensor(x, dtype=torch.float64) for x in (camera.viewmat, camera.K))
    weights = torch.rand(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def value(s):
        return (rasterize(gaussians, dataclasses.replace(camera, viewmat=V, K=zoomed(K[None], s)[0])).rgb * weights).sum()

    s = torch.tensor([1.02], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(value(s), s)
    differences = (value(s.detach() + 1e-6) - value(s.detach() - 1e-6)) / 2e-6
    torch.testing.assert_close(gradient[0], differences, rtol=1e-4, atol=1e-4)


def test_held_out_cameras_have_the_focal_length_of_their_camera():
    """Of the training views with the same intrinsics; of none of them: the mean factor. The summary names what changed."""
    cameras = {f"{i}": dataclasses.replace(c, K=c.K * [[k, 1, 1], [1, k, 1], [1, 1, 1]])
               for i, (c, k) in enumerate(zip(scenes.ring(6), (1, 2, 1, 1, 2, 3)))}  # fmt: skip
    train, test = ("0", "1", "2"), ("3", "4", "5")
    params = RefinePoses(focal_lr=1e-3).parameters([View(n, cameras[n], None) for n in train])
    params[FOCAL] = torch.tensor([[0.0], [0.2], [0.0]])
    found = refined_cameras(cameras, train, test, params)
    factors = [found[n].K[0, 0] / cameras[n].K[0, 0] for n in (*train, *test)]
    np.testing.assert_allclose(factors, [1, 11 / 9, 1, 1, 11 / 9, (2 + 11 / 9) / 3], rtol=1e-6)
    assert all(np.array_equal(found[n].K[:, 2], cameras[n].K[:, 2]) for n in found)
    figures = pose_figures(cameras, found, train, True, 1.0)
    assert [c["views"] for c in figures["cameras"]] == [2, 1] and "(+22.2%)" in figures["summary"]
    assert "cameras" not in pose_figures(cameras, cameras, train, True, 1.0)


TURN = increments(torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64), torch.zeros(3, dtype=torch.float64)).numpy()[:3, :3]


def similar(camera):
    """The camera after the world is turned, made larger and moved."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = camera.viewmat[:3, :3] @ TURN.T
    viewmat[:3, 3] = -viewmat[:3, :3] @ (1.1 * TURN @ camera.center + np.array([0.3, -0.2, 0.1]))
    return dataclasses.replace(camera, viewmat=viewmat)


def fitted_config(steps):
    return FitConfig(steps=steps, half_resolution=0.25, view_modules=(RefinePoses(rotation_lr=2e-3, translation_lr=2e-3),))


def fitted(views, steps=240):
    trainer = Trainer(views, scenes.seeds(), fitted_config(steps), CPU)
    while trainer.step < steps:
        trainer.advance()
    return trainer


@pytest.mark.slow
def test_a_fit_finds_poses_back(tmp_path):
    """Of a ray-cast scene with poses that are off, a good part of the error goes, at the rates of the default."""
    write_demo(tmp_path, views=8, width=64, height=48)
    scene = warpgs.load_scene(tmp_path)
    truth = list(scene.views)
    given, names = noisy(truth), [v.name for v in truth]
    trainer = Trainer(given, scene.points, FitConfig(steps=400, half_resolution=0.25, view_modules=(RefinePoses(),)), CPU)
    while trainer.step < 400:
        trainer.advance()
    cameras = refined_cameras({v.name: v.camera for v in given}, names, (), trainer.learned.views.table.params)
    assert np.array_equal(cameras[names[0]].viewmat, given[0].camera.viewmat)
    found = [dataclasses.replace(v, camera=cameras[v.name]) for v in given]
    before, after = errors(given, truth), errors(found, truth)
    assert (after < 0.8 * before).all(), (before, after)
    for name in (ROTATION, TRANSLATION):
        assert not trainer.learned.views.table.params[name][0].any()


@pytest.mark.slow
def test_a_fit_finds_a_focal_length_back(tmp_path):
    """Cameras around a ray-cast scene, with a focal length 5 % too long; its exact one ends 1.1 % too long."""
    write_demo(tmp_path, views=8, width=64, height=48)
    scene = warpgs.load_scene(tmp_path)
    longer = [[1.05, 1, 1], [1, 1.05, 1], [1, 1, 1]]
    given = [dataclasses.replace(v, camera=dataclasses.replace(v.camera, K=v.camera.K * longer)) for v in scene.views]
    config = FitConfig(steps=400, half_resolution=0.25, view_modules=(RefinePoses(focal_lr=1e-3),))
    trainer = Trainer(given, scene.points, config, CPU)
    while trainer.step < 400:
        trainer.advance()
    names = [v.name for v in given]
    cameras = refined_cameras({v.name: v.camera for v in given}, names, (), trainer.learned.views.table.params)
    ratios = {float(cameras[v.name].K[0, 0] / v.camera.K[0, 0]) for v in scene.views}
    assert len(ratios) == 1 and abs(ratios.pop() - 1) < 0.03


def test_steps_on_any_number_of_threads_and_continued_ones_have_the_same_bits():
    views, whole = noisy(scenes.photos(4)), None
    before = torch.get_num_threads()
    for threads in (1, 2):
        torch.set_num_threads(threads)
        try:
            found = fitted(views, 40).state()[0]
        finally:
            torch.set_num_threads(before)
        whole = whole or found
        assert all(torch.equal(t, found[n]) for n, t in whole.items())
    first, second = (Trainer(views, scenes.seeds(), fitted_config(40), CPU) for _ in range(2))
    while first.step < 20:
        first.advance()
    second.load(*first.state())
    while second.step < 40:
        second.advance()
    assert all(torch.equal(t, whole[n]) for n, t in second.state()[0].items())


def test_strategies_see_the_poses_of_now_and_steps_count_from_the_given_ones():
    """Views that are set again, as a strategy or a lack of memory asks for, do not get their increments twice."""
    given = noisy(scenes.photos(4))
    trainer = fitted(given, 30)
    trainer.show_learned()
    shown = [v.camera.viewmat.clone() for v in trainer.views]
    first = torch.stack([torch.as_tensor(v.camera.viewmat, dtype=torch.float32) for v in given])
    assert torch.equal(shown[0], first[0]) and not torch.equal(shown[1], first[1])
    trainer.set_views(trainer.views)
    for stack in trainer.stacks.values():
        assert torch.equal(stack.viewmats, first[stack.numbers])
        now = current(stack, trainer.learned.views)  # by which a captured step finds its capacity
        assert torch.equal(now.viewmats, torch.stack(shown)[stack.numbers])
    trainer.show_learned()
    assert all(torch.equal(v.camera.viewmat, a) for v, a in zip(trainer.views, shown))


def test_held_out_cameras_follow_the_similarity_of_the_training_cameras():
    """Where refinement moved the world as a whole, a held-out camera sees the moved world as it saw the given one."""
    cameras = {f"{i}": c for i, c in enumerate(scenes.ring(5))}
    train = ("0", "1", "2", "4")
    generator = np.random.default_rng(1)
    w = torch.tensor(generator.normal(0, 0.02, (4, 3)))
    w[0] = 0
    tensors = {ROTATION: w, TRANSLATION: 0 * w}
    found = refined_cameras(cameras, train, ("3",), tensors)
    assert np.array_equal(found["0"].viewmat, cameras["0"].viewmat)
    # cameras that turn about their own centres leave the similarity a mean turn: between none and the largest
    row = pose_figures(cameras, found, ["3"], False, 1.0)["views"][0]
    assert 0 < row["degrees"] < max(r["degrees"] for r in pose_figures(cameras, found, train, False, 1.0)["views"])
    R, scale, t = similarity(list(cameras.values()), [similar(c) for c in cameras.values()])
    np.testing.assert_allclose(R, TURN, atol=1e-12)
    np.testing.assert_allclose([scale, *t], [1.1, 0.3, -0.2, 0.1], atol=1e-12)


def test_runs_keep_refined_poses(tmp_path):
    """The report's figures, a run opened, scored again, continued and pruned: all have the cameras that were found."""
    write_demo(tmp_path / "scene", views=8, width=32, height=32)
    flags = ["--preset", "3dgs", "--steps", "8", "--init.source", "random", "--init.random-count", "60", "--device", "cpu"]
    words = ["fit", str(tmp_path / "scene"), "--out", str(tmp_path / "run"), *flags, "--split", split_spec(8), "--refine-poses"]
    assert main(words) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    rows, summary = (metrics["view_modules"]["refine_poses"][key] for key in ("views", "summary"))
    assert rows[0]["degrees"] < 1e-9 and rows[0]["units"] < 1e-9 and all(r["degrees"] > 0 for r in rows[1:])
    assert "moved by the similarity that best maps" in summary
    assert summary in (tmp_path / "run" / "report.html").read_text()
    run, scene = warpgs.open_run(tmp_path / "run", "cpu"), warpgs.load_scene(tmp_path / "scene")
    given = {v.name: v.camera for v in scene.views}
    again = pose_figures(given, run.scene_cameras, run.train, True, run.normalization.scale)
    assert again["views"] == rows
    assert main(["eval", str(tmp_path / "run"), "--device", "cpu"]) == 0
    scores = json.loads((tmp_path / "run" / "eval.json").read_text())
    assert scores["test"] == metrics["test"] and scores["train"] == metrics["train"]
    assert main(["prune", str(tmp_path / "run"), "--out", str(tmp_path / "pruned"), "--device", "cpu"]) == 0
    pruned = warpgs.open_run(tmp_path / "pruned", "cpu").scene_cameras
    assert all(np.array_equal(pruned[n].viewmat, c.viewmat) for n, c in run.scene_cameras.items())
    assert main([*words, "--resume"]) == 0
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["view_modules"]["refine_poses"]["views"] == rows
