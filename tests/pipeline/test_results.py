"""What a fit leaves: scores in the order of the views, a picture of each, and errors that are said."""

import pytest

from tests.scenes import photos, seeds
from warpgs.errors import ResourceError
from warpgs.pipeline.metrics.evaluate import options_for, render_view, score
from warpgs.pipeline.model.init import InitConfig, initial_gaussians
from warpgs.pipeline.runs import results
from warpgs.pipeline.runs.results import evaluate_run

BLACK = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def scene():
    """Gaussians, and more views than there are threads and pictures at a time."""
    import torch

    return initial_gaussians(seeds(), InitConfig(), 1.0, torch.device("cpu")), photos(12)


def test_scores_are_those_of_their_views(scene, tmp_path):
    """Each row is the score of its view, whoever finished first; means are over these; every held-out view has its files."""
    gaussians, views = scene
    test, train = views[:10], views[10:]
    found = evaluate_run(tmp_path, gaussians, train, test, "exact", BLACK)
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
    found = evaluate_run(tmp_path, gaussians, views[:2], [], "exact", BLACK)
    assert found["test"] == {} and found["views"] == [] and found["baselines"] == {} and found["train"]["psnr"] > 5
    assert len(list((tmp_path / "renders").iterdir())) == 2


def test_a_picture_that_cannot_be_written_is_said(scene, tmp_path, monkeypatch):
    """A full disk ends the evaluation with its error, although another thread met it."""

    def full(path, data):
        raise ResourceError(f"{path.name}: no space left")

    monkeypatch.setattr(results, "write_bytes", full)
    with pytest.raises(ResourceError, match="no space left"):
        evaluate_run(tmp_path, scene[0], scene[1][:1], scene[1][1:3], "exact", BLACK)
