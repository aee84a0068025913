"""The benches that are programs of their own still run on tiny sizes; how long things take is nobody's test."""

from pathlib import Path

import numpy as np
import pytest
import torch

from bench import accuracy, many, needles, step, training
from tests.scenes import photos, seeds
from warpgs.pipeline.model.init import InitConfig
from warpgs.pipeline.train.config import FitConfig


def test_stages_of_a_step(device):
    """Every stage has a positive time, the whole step among them."""
    trainer = training.make_trainer(photos(2), seeds(), FitConfig(init=InitConfig(source="points")), device)
    rows, instances = step.stages(trainer)
    assert instances > 0 and len(rows) == 9 and all(row["median_ms"] > 0 for row in rows)


def points(folder: Path) -> str:
    """A file as `bench.garden` reads it, of 400 points."""
    generator = np.random.default_rng(0)
    path = folder / "points.npz"
    K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]], np.float32)
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[2, 3] = 3
    np.savez(
        path, means3d=generator.uniform(-1, 1, (400, 3)).astype(np.float32), colors=generator.integers(0, 255, (400, 3)),
        viewmats=viewmat[None], Ks=K[None], width=64, height=48,
    )  # fmt: skip
    return str(path)


@pytest.mark.cuda
def test_many_gaussians_train(tmp_path):
    """The program that trains ten million trains a few hundred too: the loss falls."""
    result = many.train(points(tmp_path), 300, 64, 48, 120)
    assert result["loss_last"] < result["loss_first"] and result["gaussians"] == 300


def test_the_smooth_picture_is_a_picture():
    """Colours in [0, 1] that change slowly."""
    picture = many.smooth_image(40, 30, torch.device("cpu"))
    assert picture.shape == (30, 40, 3) and 0 <= picture.min() and picture.max() <= 1
    assert float((picture[:, 1:] - picture[:, :-1]).abs().max()) < 0.15


def test_the_accuracy_page_is_that_of_the_committed_results():
    """docs/accuracy.md is what `python -m bench.accuracy` writes."""
    page = accuracy.PAGE.read_text("utf-8")
    assert accuracy.filled(page) == page, "docs/accuracy.md is stale: run python -m bench.accuracy"
    assert "| cloud |" in page and "| 300 |" in page


def test_needles_err_less_in_the_factor_form(device):
    """At 300 px the largest error of the weight is a hundredth of the conic's, also of the one with the same factor."""
    e = needles.weight_errors(300, device)
    assert all(e[n]["max"] >= 100 * e["factor"]["max"] for n in ("conic", "plain")), e
