"""Programs of the suite run on tiny sizes, their peers agree, and the kept results are of one format."""

import sys

import pytest
import torch

import warpgs
from bench import __main__ as bench_main
from bench.lib import result_file, training
from bench.lib.inputs import camera as bench_camera
from bench.lib.inputs import gaussians, image
from bench.lib.naive import rasterize
from tests.gaussians import camera, cloud
from warpgs.scene import Gaussians

CPU = torch.device("cpu")


def test_everything_that_can_be_run_is_listed(capsys, monkeypatch):
    """A line for each program with the first sentence of its docstring; another name is an error."""
    monkeypatch.setattr(sys, "argv", ["bench", "--help"])
    assert bench_main.main() == 0
    text = capsys.readouterr().out
    for name in ("document", "kernels.ops", "peers.against_others", "fits.presets"):
        assert f"\n  {name} " in text
    assert all(line.endswith((".", ":")) or line[:2] != "  " for line in text.splitlines()), text
    monkeypatch.setattr(sys, "argv", ["bench", "nothing"])
    assert bench_main.main() == 2 and "--help" in capsys.readouterr().err


@pytest.mark.parametrize("path", sorted(result_file.FOLDER.glob("*")), ids=lambda p: p.name)
def test_kept_results_are_of_one_format(path):
    """JSON with what, command, commit, machine, versions and rows; else a table or chart drawn from one."""
    if path.suffix != ".json":
        assert path.suffix in (".md", ".svg") and list(path.parent.glob(f"{path.stem}*.json"))
        return
    values = result_file.read(path)
    assert values["rows"] and all(isinstance(row, dict) for row in values["rows"])
    assert {"device", "name"} <= set(values["machine"]) and {"torch", "warp"} <= set(values["versions"])


def test_a_result_says_what_it_was_made_by(tmp_path, monkeypatch):
    """The keys of the format, then facts, then rows; folders of the machine are left out of the command."""
    monkeypatch.setattr(sys, "argv", ["x", "/data/fern", "--out", "a.json"])
    made = result_file.result("w", CPU, [{"a": 1}], size=3)
    assert made["command"].endswith("fern --out a.json") and "/data" not in made["command"]
    assert list(made) == ["what", "command", "commit", "date", "machine", "versions", "size", "rows"]
    result_file.write(tmp_path / "a.json", made)
    assert result_file.read(tmp_path / "a.json") == made
    with pytest.raises(ValueError, match="versions"):
        result_file.write(tmp_path / "b.json", {k: v for k, v in made.items() if k != "versions"})


def test_steps_of_given_gaussians_train(device):
    """The same step over and over lowers the loss; with a learning rate of next to nothing all stays as it was."""
    g, view, target = gaussians(200, device, 1), bench_camera(48, 32, device), image(48, 32, device)
    losses = []
    for lr in (1e-2, 1e-12):
        steps = training.Steps(g, view, target, "exact", lr)
        for _ in range(20):
            steps.eager()
        losses.append(float(steps.buffers.history[0, 0]))
    assert losses[0] < 0.95 * losses[1]
    assert all(torch.equal(t, g.tensors()[n]) for n, t in steps.table.params.items() if n == "quats")


def test_naive_kernels_equal_the_real_ones(device):
    """Image and gradients of the peer with a thread a pixel: two cameras, an image that is no multiple of a tile."""
    cam = camera(45, 37, cameras=2, dtype=torch.float32, device=device)
    tensors = cloud(300, torch.float32, device).tensors()
    tensors["logit_opacities"] += 3  # some alphas are clamped, some pixels stop
    leaves = [t.requires_grad_() for t in tensors.values()]
    ours, theirs = warpgs.rasterize(Gaussians(*leaves), cam).rgb, rasterize(Gaussians(*leaves), cam)
    v_rgb = torch.randn(ours.shape, generator=torch.Generator().manual_seed(2)).to(device)
    pairs = zip(torch.autograd.grad(theirs, leaves, v_rgb), torch.autograd.grad(ours, leaves, v_rgb))
    # an alpha within a rounding of the cut may be drawn by one and not by the other
    for found, wanted in [(theirs.detach(), ours.detach()), *pairs]:
        assert float((found - wanted).norm()) <= 1e-4 * float(wanted.norm())
