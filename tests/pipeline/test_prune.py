"""Shrinking: shares by bisection, the order in which Gaussians go, and the promise of `warpgs prune`."""

import json
import math
from pathlib import Path

import pytest
import torch

from tests.gaussians import camera, cloud
from tests.scenes import ring
from warpgs.app.cli import main
from warpgs.errors import UsageError
from warpgs.export.ply import read_ply
from warpgs.pipeline.model.edit import (
    ViewSet,
    keep_last,
    largest_fraction,
    needed_degrees,
    prune_order,
    rows_of,
    stored_degrees,
)
from warpgs.pipeline.run.commands import _new_folder, prune
from warpgs.pipeline.run.folder import load_checkpoint, open_run
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera
from warpgs.synthetic.demo import split_spec, write_demo

CPU = torch.device("cpu")


def test_largest_share():
    """Within the last interval of what is accepted, never above it; all and nothing are found; what comes back was accepted."""
    for limit in (0.3, 0.77, 0.0001):
        fraction = largest_fraction(limit.__ge__, rounds=10)
        assert limit - 2**-10 <= fraction <= limit
    assert largest_fraction(lambda s: True) == 1 and largest_fraction(lambda s: False) == 0
    asked = []
    odd = largest_fraction(lambda s: asked.append(s) or int(s * 32) % 3 == 0)
    assert odd == 0 or (odd in asked and int(odd * 32) % 3 == 0)


def test_one_goes_only_where_both_scores_agree():
    """The later of the two places decides: neither the faint that matters nor the strong that does not goes first."""
    maxima = torch.tensor([0.0, 0.9, 0.1, 0.8, 0.2])
    sensitivity = torch.tensor([9.0, 0.0, 0.2, 8.0, 0.1])
    assert prune_order(maxima, sensitivity)[:2].tolist() == [2, 4] and set(prune_order(maxima, sensitivity).tolist()) == set(
        range(5)
    )
    assert keep_last(torch.tensor([3, 1, 0, 2]), 0.5).tolist() == [0, 2]
    assert keep_last(torch.tensor([3, 1, 0, 2]), 1.0).tolist() == [2]


def test_what_contributes_nothing_goes_first():
    """Without the transparent and the hidden tenth the picture is the same to the bit."""
    g = cloud(100)
    g.logit_opacities[:10] = -9
    view_set = RasterizeOptions(contributions=True)
    c = camera(dtype=torch.float32)
    order = prune_order(rasterize(g, c, view_set).weight_maxima[0], torch.zeros(100))
    assert float(rasterize(g, c, view_set).weight_maxima[0][:10].max()) == 0
    thin = rows_of(g, keep_last(prune_order(rasterize(g, c, view_set).weight_maxima[0], torch.arange(100.0)), 0.1))
    assert len(order) == 100 and torch.equal(rasterize(g, c).rgb, rasterize(thin, c).rgb)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("prune")
    write_demo(folder / "scene", views=8, width=64, height=48)
    flags = ["--split", split_spec(8), "--steps", "80", "--device", "cpu", "--preset", "3dgs", "--sh-every", "20"]
    flags += ["--init.random-count", "600"]
    assert main(["fit", str(folder / "scene"), "--out", str(folder / "run"), *flags]) == 0
    return folder / "run"


def test_prune_keeps_its_promise(run, tmp_path, capsys):
    """Smaller by more than a little, no more than the allowed loss, the old run untouched, the new one whole and usable."""
    before = {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    assert main(["prune", str(run), "--keep-psnr", "0.2", "--out", str(tmp_path / "a small one"), "--device", "cpu"]) == 0
    words = capsys.readouterr().out
    assert "Gaussians, mean SH degree" in words and "times smaller" in words and "held-out PSNR" in words
    assert f"`warpgs eval '{tmp_path}/a small one'` scores it" in words and f"`warpgs render '{tmp_path}/a small one'`" in words
    assert "trying smaller models: number 1" in words and "scoring the smaller model" in words
    assert before == {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    record = json.loads((tmp_path / "a small one" / "config.json").read_text())["pruned"]
    whole, small = (open_run(f, CPU).gaussians() for f in (run, tmp_path / "a small one"))
    assert record["count"] == [len(whole), len(small)] and record["bytes"][1] < 0.6 * record["bytes"][0]
    assert record["train_psnr"][1] >= record["train_psnr"][0] - 0.2
    assert json.loads((run / "metrics.json").read_text())["train"]["psnr"] == pytest.approx(record["train_psnr"][0])

    degrees = stored_degrees(small.sh)
    assert bool((degrees.diff() >= 0).all()), "not sorted by degree"
    tensors, _ = load_checkpoint(tmp_path / "a small one")
    stored = sum(t.numel() * t.element_size() for n, t in tensors.items() if n.startswith("params."))
    assert stored == record["bytes"][1]
    ply = read_ply(tmp_path / "a small one" / "point_cloud.ply")
    assert len(ply) == len(small) and torch.equal(ply.sh, small.sh)

    assert main(["eval", str(tmp_path / "a small one"), "--device", "cpu"]) == 0
    scores = json.loads((tmp_path / "a small one" / "eval.json").read_text())
    assert scores["train"]["psnr"] == pytest.approx(record["train_psnr"][1], abs=1e-9)
    assert scores["test"]["psnr"] == pytest.approx(record["test_psnr"][1], abs=1e-9)


@pytest.mark.slow
def test_more_loss_allowed_more_goes(run, tmp_path):
    """A hundredth of a decibel keeps more than two."""
    counts = []
    for keep in (0.01, 2.0):
        prune(run, keep, tmp_path / str(keep), "cpu")
        counts.append(json.loads((tmp_path / str(keep) / "config.json").read_text())["pruned"]["bytes"][1])
    assert counts[1] < 0.7 * counts[0]


@pytest.mark.parametrize("keep", [0, -0.1, math.nan, math.inf])
def test_loss_that_makes_no_sense(run, keep):
    with pytest.raises(UsageError, match="keep-psnr"):
        prune(run, keep, None, "cpu")


def test_a_run_is_pruned_from_within(run, monkeypatch):
    monkeypatch.chdir(run)
    assert _new_folder(Path("."), None) == run.parent / f"{run.name}-pruned"


def test_bad_input_is_named(run, tmp_path, capsys):
    """No run, an existing folder, a folder nowhere: one line each, exit codes of their kind, and nothing is left behind."""
    (tmp_path / "there").mkdir()
    cases = [
        ([str(tmp_path / "none")], 3, "no such folder"),
        ([str(run), "--out", str(tmp_path / "there")], 2, "exists already"),
        ([str(run), "--out", str(tmp_path / "no" / "where")], 2, "is not a folder"),
        ([str(run), "--out", str(run)], 2, "exists already"),
    ]
    for words, code, message in cases:
        assert main(["prune", *words, "--device", "cpu"]) == code
        assert message in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["there"]


def test_a_pruned_run_cannot_be_continued(run, tmp_path, capsys):
    """Its optimizer's state is gone; the message names the run to continue instead."""
    prune(run, 1.0, tmp_path / "small", "cpu")
    scene = json.loads((run / "config.json").read_text())["scene"]["path"]
    flags = ["--split", split_spec(8), "--steps", "80", "--device", "cpu", "--preset", "3dgs", "--sh-every", "20"]
    flags += ["--init.random-count", "600"]
    assert main(["fit", scene, "--out", str(tmp_path / "small"), "--resume", *flags]) == 2
    assert str(run) in capsys.readouterr().err


def test_only_the_mirror_keeps_its_harmonics():
    """Left matt, right as bright as the direction it is seen from: after lowering degrees, only the right has any."""
    generator = torch.Generator().manual_seed(0)
    count = 60
    g = cloud(count, degree=1)
    g.means[:] = torch.cat([2 * torch.rand(count, 2, generator=generator) - 1, torch.zeros(count, 1)], 1)
    g.means.mul_(torch.tensor([0.8, 0.5, 1]))
    g.log_scales[:] = math.log(0.08)
    g.logit_opacities[:] = 2.0
    right = g.means[:, 0] > 0.1
    g.sh[:, 1:] = 1e-4 * torch.randn(count, 3, 3, generator=generator)  # what noise leaves in a coefficient
    g.sh[right, 3] = 1.5
    cameras = [
        Camera(torch.from_numpy(c.viewmat).float(), torch.from_numpy(c.K).float(), c.width, c.height) for c in ring(6, 80, 60)
    ]
    photos = [rasterize(g, c).rgb for c in cameras]
    view_set = ViewSet(cameras, RasterizeOptions(), 0)

    def accepted(model) -> bool:
        return all(float((rasterize(model, c).rgb - p).square().mean()) < 1e-6 for c, p in zip(cameras, photos))

    degrees = needed_degrees(g, view_set, accepted)
    assert bool((degrees[~right] == 0).all()) and float(degrees[right].float().mean()) > 0.8
