"""The examples run as printed, on small defaults, and show what they promise."""

import dataclasses
import importlib.util
import re
import runpy
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import warpgs
from warpgs.app.fit import request_of
from warpgs.constants import rule_named
from warpgs.synthetic.demo import write_demo

EXAMPLES = Path(__file__).parent.parent / "examples"
SMALL = {
    "01_fit_image": (["--steps", "40", "--count", "150", "--size", "40"], "fitted.png", lambda gain: gain > 3),
    "02_fit_scene": (["--steps", "20", "--frames", "3", "--width", "48"], "turntable/0001.png", lambda gain: gain > -6),
    "03_camera_pose": (["--steps", "100"], "pose.png", lambda left: left < 0.2),
    "04_own_loss": (["--steps", "20", "--width", "48", "--weight", "5"], "smooth.png", lambda left: left < 0.9),
    "05_own_strategy": (["--steps", "200", "--width", "48", "--start", "100"], "sprout.png", lambda gain: gain > 0.2),
    "07_rasterizer_in_another_trainer": (["--steps", "40", "--width", "48"], "render.png", lambda gain: gain > 1),
    "08_feature_field": (["--steps", "40", "--count", "150", "--size", "40"], "features.png", lambda gain: gain > 0.7),
    "11_cor_gs": (["--steps", "12", "--width", "48"], "cor_gs.png", lambda gain: abs(gain) < 3),
    "10_depth_and_normals": (["--size", "64"], "normals.png", lambda degrees: degrees < 6),
    "13_gsplat_rasterization": (["--steps", "40", "--count", "150", "--size", "40"], "rings.png", lambda gain: gain > 3),
}
"""Flags for a test, an image that is written, and what the returned figure must fulfil."""


def run(name: str, arguments: list[str]) -> float:
    """Run an example's main as a script of its own."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name=f"example_{name}")["main"](arguments)


@pytest.mark.parametrize("name", SMALL)
def test_examples_show_what_they_promise(name, tmp_path, monkeypatch, capsys):
    """A figure that shows it worked is printed, and an image is written that is not of one colour."""
    flags, image, promised = SMALL[name]
    monkeypatch.setenv("WARPGS_CACHE", str(tmp_path / "cache"))
    out = tmp_path if "/" in image else tmp_path / image
    figure = run(name, [*flags, "--out", str(out)])
    printed = capsys.readouterr().out
    assert promised(figure), printed
    assert re.search(r"\d\.\d", printed)
    assert np.asarray(Image.open(tmp_path / image)).std() > 5


class StandIn:
    """gsplat's protocol of a strategy where gsplat is not installed: it reads the same values, and duplicates once."""

    def __init__(self, **options):
        self.options = options

    def check_sanity(self, params, optimizers):
        assert set(params) == set(optimizers) >= {"means", "scales", "quats", "opacities"}

    def initialize_state(self, scene_scale=1.0):
        return {}

    def step_pre_backward(self, params, optimizers, state, step, info):
        info["means2d"].retain_grad()

    def step_post_backward(self, params, optimizers, state, step, info, packed=False, lr=None):
        means2d, seen = info["means2d"], (info["radii"] > 0).all(-1)
        assert means2d.shape == means2d.grad.shape == info["radii"].shape == (info["n_cameras"], len(params["means"]), 2)
        assert {"width", "height", "gaussian_ids"} <= set(info) and bool(means2d.grad[seen].any())
        values = means2d.absgrad if "absgrad" in self.options else means2d.grad
        if step == 20:
            chosen = (values.norm(dim=-1).sum(0) > values.norm(dim=-1).sum(0).median()).nonzero()[:, 0]
            for name, old in params.items():
                params[name] = torch.nn.Parameter(torch.cat([old, old[chosen]]).detach())
                optimizers[name].param_groups[0]["params"] = [params[name]]


@pytest.mark.parametrize("strategy", ["DefaultStrategy", "MCMCStrategy"])
def test_strategies_of_gsplat_are_driven(strategy, tmp_path, monkeypatch, capsys):
    """Gaussians are added where gradients are large. The real classes are used where they are installed, and run."""
    if importlib.util.find_spec("gsplat") is None or (strategy == "MCMCStrategy" and not torch.cuda.is_available()):
        monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(**{strategy: StandIn}))
    flags = ["--strategy", strategy, "--steps", "50", "--size", "40", "--out", str(tmp_path / "fitted.png")]
    assert run("09_gsplat_strategy", flags) > 3
    before, after = re.match(r"(\d+) -> (\d+) Gaussians", capsys.readouterr().out).groups()
    assert int(after) > int(before)


@pytest.fixture(scope="module")
def rasterization():
    """The function of the example, with two cameras and 40 Gaussians filled in; any argument may be replaced."""
    function = runpy.run_path(str(EXAMPLES / "13_gsplat_rasterization.py"))["rasterization"]
    n, turned = 40, torch.eye(4)
    turned[0, 3] = 0.2
    generator = torch.Generator().manual_seed(0)
    given = {
        "means": torch.rand(n, 3, generator=generator) + torch.tensor([-0.5, -0.5, 2.0]),
        "quats": torch.randn(n, 4, generator=generator),
        "scales": 0.1 * torch.rand(n, 3, generator=generator) + 0.02,
        "opacities": torch.rand(n, generator=generator),
        "colors": torch.rand(n, 3, generator=generator),
        "viewmats": torch.stack([torch.eye(4), turned]),
        "Ks": torch.tensor([[32.0, 0, 20], [0, 32, 15], [0, 0, 1]]).expand(2, 3, 3),
        "width": 40,
        "height": 30,
    }
    return lambda **other: function(**given | other), given


@pytest.mark.parametrize(
    ("arguments", "camera_options", "options"),
    [
        ({"packed": False, "radius_clip": 0.0, "channel_chunk": 32, "global_z_order": True, "rays": None}, {}, {}),
        ({"eps2d": 0.1}, {}, {"rule": dataclasses.replace(rule_named("gsplat-1.6"), low_pass=0.1)}),
        ({"near_plane": 2.4, "far_plane": 2.8, "tile_size": 8}, {}, {"near": 2.4, "far": 2.8, "tile_size": 8}),
        ({"backgrounds": torch.eye(2, 3)}, {}, {"background": torch.eye(2, 3)}),
        ({"rasterize_mode": "antialiased"}, {}, {"antialiased": True}),
        ({"colors": torch.ones(40, 4, 3), "sh_degree": 0}, {}, {"colors": None, "sh_degree": 0}),
        ({"camera_model": "ortho"}, {"model": "orthographic"}, {}),
        ({"camera_model": "fisheye"}, {"model": "fisheye", "distortion": torch.zeros(4)}, {}),
        ({"camera_model": "fisheye", "radial_coeffs": torch.full((2, 4), 0.1)},
         {"model": "fisheye", "distortion": torch.full((4,), 0.1)}, {}),
        ({"radial_coeffs": torch.tensor([[0.01, 0.02, 0.05, 0.06, 0.07, 0.08]] * 2),
          "tangential_coeffs": torch.tensor([[0.03, 0.04]] * 2)},
         {"model": "opencv", "distortion": torch.tensor([0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08])}, {}),
        ({"tangential_coeffs": torch.full((2, 2), 0.01)},
         {"model": "opencv", "distortion": torch.tensor([0, 0, 0.01, 0.01, 0, 0, 0, 0])}, {}),
    ],
)  # fmt: skip
def test_arguments_of_gsplat_become_ours(rasterization, arguments, camera_options, options):
    """Images, depths, alphas and info equal those of `warpgs.rasterize`, bit for bit."""
    call, given = rasterization
    given = given | arguments
    camera = warpgs.Camera(given["viewmats"], given["Ks"], 40, 30, **camera_options)
    options = warpgs.RasterizeOptions(**{"rule": "gsplat-1.6", "colors": given["colors"]} | options)
    sh = given["colors"] if "sh_degree" in arguments else None
    kinds = (given[name] for name in ("means", "quats", "scales", "opacities"))
    wanted = warpgs.rasterize(warpgs.ActivatedGaussians(*kinds, sh), camera, options)
    images, alphas, info = call(render_mode="RGB+ED", **arguments)
    assert torch.equal(images, torch.cat([wanted.rgb, wanted.depth[..., None]], -1)) and bool(images.any())
    assert torch.equal(alphas, wanted.alpha[..., None]) and torch.equal(info["means2d"], wanted.means2d)
    assert torch.equal(info["depths"], wanted.projected[..., 9]) and torch.equal(info["tiles_per_gauss"], wanted.tile_counts)
    assert torch.equal(info["radii"], wanted.projected[..., 10:12].ceil()) and info["gaussian_ids"] is None
    assert [info[name] for name in ("width", "height", "n_cameras")] == [40, 30, 2]


def test_every_render_mode_of_gsplat(rasterization):
    """Modes have the colours and the depth that they name; D is ED times alpha."""
    call, _ = rasterization
    found = {mode: call(render_mode=mode)[0] for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED")}
    alpha = call()[1]
    assert torch.equal(found["D"], found["ED"] * alpha) and found["D"].shape == (2, 30, 40, 1)
    assert torch.equal(found["RGB+D"], torch.cat([found["RGB"], found["D"]], -1))
    assert torch.equal(found["RGB+ED"], torch.cat([found["RGB"], found["ED"]], -1))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"packed": True, "with_ut": True, "sparse_grad": False, "covars": torch.eye(3)},
            "arguments: packed, with_ut, covars;",
        ),
        ({"radius_clip": 3.0, "global_z_order": False}, "arguments: radius_clip;"),
        ({"render_mode": "d"}, r"render_mode must be one of RGB, D, ED, RGB\+D, RGB\+ED, not 'd'"),
        ({"rasterize_mode": "smooth"}, "rasterize_mode must be classic or antialiased, not 'smooth'"),
        ({"camera_model": "ftheta"}, "camera_model must be one of pinhole, ortho, fisheye, not 'ftheta'"),
        ({"camera_model": "ortho", "radial_coeffs": torch.zeros(2, 4)}, "'ortho' does not support radial_coeffs"),
        ({"camera_model": "fisheye", "tangential_coeffs": torch.zeros(2, 2)}, "'fisheye' does not support tangential_coeffs"),
    ],
)
def test_arguments_that_are_missing_are_refused_by_name(rasterization, arguments, message):
    """None, False and values that change nothing are allowed."""
    with pytest.raises(ValueError, match=message):
        rasterization[0](**arguments)


@pytest.mark.parametrize("mode", ["RGB", "ED", "RGB+D"])
def test_results_may_be_edited_in_place(rasterization, mode):
    """The backward pass then has the gradients of a product with the mask, and sets absgrad."""
    call, given = rasterization
    mask, gradients = torch.rand(2, 30, 40, generator=torch.Generator().manual_seed(1)) > 0.5, []
    for in_place in (True, False):
        means = given["means"].clone().requires_grad_()
        images, alphas, info = call(means=means, render_mode=mode, absgrad=True)
        if in_place:
            images[~mask] = 0
            alphas[~mask] = 0
        else:
            images, alphas = images * mask[..., None], alphas * mask[..., None]
        (images.square().sum() + alphas.square().sum()).backward()
        gradients.append((means.grad, info["means2d"].absgrad))
    for edited, multiplied in zip(*gradients, strict=True):
        assert torch.equal(edited, multiplied) and bool(edited.any())


def test_the_splatfacto_example_densifies_and_mends_its_cameras(tmp_path, capsys):
    """Gaussians are added, and cameras that were turned come back most of the way."""
    flags = ["--steps", "80", "--width", "48", "--count", "200", "--pose-noise", "1", "--out", str(tmp_path / "out.png")]
    assert run("12_splatfacto", flags) > 4 and np.asarray(Image.open(tmp_path / "out.png")).std() > 5
    printed = capsys.readouterr().out
    before, after, first, last = map(float, re.match(r"(\d+) -> (\d+) G.*cameras (\S+) -> (\S+) degrees", printed).groups())
    assert after > 1.2 * before and last < 0.6 * first, printed


@pytest.mark.parametrize("name", ["02_fit_scene", "04_own_loss"])
def test_examples_take_a_scene(name, tmp_path, monkeypatch, capsys):
    """A folder that is given is fitted, with views held out to score."""
    monkeypatch.setenv("WARPGS_CACHE", str(tmp_path / "cache"))
    write_demo(tmp_path / "scene", views=8, width=48, height=36)
    flags = ["--steps", "5"] + (["--frames", "2"] if name == "02_fit_scene" else [])
    run(name, [str(tmp_path / "scene"), *flags, "--out", str(tmp_path / ("out" if "scene" in name else "out.png"))])
    assert "held-out PSNR" in capsys.readouterr().out


def test_every_example_says_how_it_is_run():
    """Numbered files whose docstrings show their command, and which take --out, and --steps where they optimise."""
    for path in sorted(EXAMPLES.glob("*.py")):
        text = path.read_text("utf-8")
        assert re.match(r"\d\d_\w+\.py$", path.name) and f"python examples/{path.name}" in text.split('"""')[1], path.name
        assert '"--out"' in text and ('"--steps"' in text or "optim" not in text), path.name


@pytest.mark.parametrize("path", sorted((EXAMPLES / "loss_terms").glob("*.py")), ids=lambda p: p.stem)
def test_loss_terms_are_taken_from_their_files(path, monkeypatch):
    """By the command that the docstring shows, with a setting as a flag."""
    monkeypatch.chdir(EXAMPLES.parent)
    (command,) = re.findall(r"^ +warpgs fit (.*)$", path.read_text("utf-8").split('"""')[1], re.MULTILINE)
    (term,) = request_of(command.split(), "").config.loss_terms
    assert f"examples/loss_terms/{path.name}:{type(term).__name__}" in command and term.weight == float(command.split()[-1])
