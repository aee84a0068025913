"""The examples run as printed, on small defaults, and show what they promise."""

import importlib.util
import json
import os
import re
import runpy
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from warpgs.app.fit import request_of

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


NOTEBOOK = EXAMPLES / "first_scene.ipynb"


def test_a_notebook_is_stored_without_outputs():
    cells = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    code = [c for c in cells if c["cell_type"] == "code"]
    assert code and not any(c["outputs"] or c["execution_count"] for c in code)


@pytest.mark.slow
def test_the_notebook_shows_photographs_film_and_page(tmp_path, monkeypatch):
    """Executed as a user does, but with fewer and smaller photographs; it opens no port but those of Jupyter."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    pytest.importorskip("viser")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    text = NOTEBOOK.read_text("utf-8").replace("demo scene", "demo scene --views 8 --width 64 --height 48")
    notebook = nbformat.reads(text, as_version=4)
    nbformat.validate(notebook)
    nbclient.NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute()
    data = [dict(o.get("data", {})) for c in notebook.cells if c.cell_type == "code" for o in c.outputs]
    assert {"image/png", "image/webp"} <= {kind for d in data for kind in d}
    texts = [d["text/html"] for d in data if "text/html" in d]
    assert (
        len(texts) == 1 and "__VISER_EMBED_DATA__" in texts[0] and any("held-out PSNR" in d.get("text/plain", "") for d in data)
    )
    assert all((tmp_path / name).is_file() for name in ("run/report.html", "film.webp", "scene.html"))


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


def test_the_splatfacto_example_densifies_and_mends_its_cameras(tmp_path, capsys):
    """Gaussians are added, and cameras that were turned come back most of the way."""
    flags = ["--steps", "80", "--width", "48", "--count", "200", "--pose-noise", "1", "--out", str(tmp_path / "out.png")]
    assert run("12_splatfacto", flags) > 4 and np.asarray(Image.open(tmp_path / "out.png")).std() > 5
    printed = capsys.readouterr().out
    before, after, first, last = map(float, re.match(r"(\d+) -> (\d+) G.*cameras (\S+) -> (\S+) degrees", printed).groups())
    assert after > 1.2 * before and last < 0.6 * first, printed


@pytest.mark.parametrize("name", ["02_fit_scene", "04_own_loss"])
def test_examples_take_a_scene(name, demo, tmp_path, monkeypatch, capsys):
    """A folder that is given is fitted, with views held out to score."""
    monkeypatch.setenv("WARPGS_CACHE", str(tmp_path / "cache"))
    flags = ["--steps", "5"] + (["--frames", "2"] if name == "02_fit_scene" else [])
    run(name, [str(demo), *flags, "--out", str(tmp_path / ("out" if "scene" in name else "out.png"))])
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
