"""What a fit leaves: scores in the order of the views, a picture of each, and errors that are said."""

import pytest

from tests.scenes import photos, seeds
from warpgs.errors import ResourceError
from warpgs.pipeline.metrics.scores import options_for, render_view, score
from warpgs.pipeline.model.start import InitConfig, initial_gaussians
from warpgs.pipeline.run import results
from warpgs.pipeline.run.results import evaluate_run, result_lines

BLACK = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def scene():
    """Gaussians, and more views than there are threads and pictures at a time."""
    import torch

    return initial_gaussians(seeds(), InitConfig(), 3, 1.0, torch.device("cpu")), photos(12)


def test_scores_are_those_of_their_views(scene, tmp_path):
    """Each row is the score of its view, whoever finished first; means are over these; every held-out view has its files."""
    gaussians, views = scene
    test, train = views[:10], views[10:]
    found = evaluate_run(tmp_path, gaussians, train, test, options_for("exact", BLACK, gaussians))
    options = options_for("exact", BLACK, gaussians)
    wanted = [score(v, render_view(gaussians, v, options)[0]).row() for v in views]
    assert found["views"] == wanted[:10] and len({r["psnr"] for r in wanted}) == 12
    assert found["train"]["psnr"] == pytest.approx(sum(r["psnr"] for r in wanted[10:]) / 2)
    assert found["test"]["psnr"] == pytest.approx(sum(r["psnr"] for r in wanted[:10]) / 10)
    for folder in ("renders", "depth"):
        assert sorted(p.stem for p in (tmp_path / folder).iterdir()) == sorted(v.name.removesuffix(".png") for v in test)


def test_without_held_out_views_training_views_are_pictured(scene, tmp_path):
    """And no score is called held-out."""
    gaussians, views = scene
    found = evaluate_run(tmp_path, gaussians, views[:2], [], options_for("exact", BLACK, gaussians))
    assert found["test"] == {} and found["views"] == [] and found["baselines"] == {} and found["train"]["psnr"] > 5
    assert len(list((tmp_path / "renders").iterdir())) == 2


def test_a_picture_that_cannot_be_written_is_said(scene, tmp_path, monkeypatch):
    """A full disk ends the evaluation with its error, although another thread met it."""

    def full(path, data):
        raise ResourceError(f"{path.name}: no space left")

    monkeypatch.setattr(results, "write_bytes", full)
    with pytest.raises(ResourceError, match="no space left"):
        evaluate_run(tmp_path, scene[0], scene[1][:1], scene[1][1:3], options_for("exact", BLACK, scene[0]))


def test_a_fit_ends_with_its_score_its_size_its_time_and_what_to_do_next(tmp_path):
    """The commands name the run as a shell takes it; time for kernels is told where there was some."""
    metrics = {
        "test": {"psnr": 24.5, "ssim": 0.8}, "train": {"psnr": 30.25}, "views": [{}, {}], "coverage": {"summary": "all seen"},
        "baselines": {"mean_photo": 12.0, "nearest_photo": 13.5}, "gaussians": 1234, "complexity": {"bytes": 2**20},
        "seconds": {"total": 75.0, "compiling": 20.0},
    }  # fmt: skip
    lines = result_lines(metrics, tmp_path / "my run")
    assert lines[0].startswith("held-out PSNR 24.50 dB, SSIM 0.800") and lines[0].endswith("(2 views)")
    assert "the nearest photograph 13.50 dB" in lines[1] and "all seen" in lines[2]
    assert lines[3] == "1,234 Gaussians, 1.0 MiB, in 1 min 15 s, of which 20 s to compile kernels, once on this machine"
    assert lines[4] == f"report: {tmp_path / 'my run' / 'report.html'}"
    assert [line.split("  ")[1] for line in lines[6:]] == [
        f"warpgs {words}" for words in (
            f"view '{tmp_path}/my run'", f"render '{tmp_path}/my run'", f"export '{tmp_path}/my run' --to scene.html"
        )
    ]  # fmt: skip
    unscored = result_lines(metrics | {"test": {}, "seconds": {"total": 5.0}}, None)
    assert unscored[0] == "training PSNR 30.25 dB (no score of new views: no view is held out)"
    assert unscored[1].endswith("1.0 MiB, in 5 s")
    assert "held-out" not in " ".join(unscored) and "next:" not in unscored
