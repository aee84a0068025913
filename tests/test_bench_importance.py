"""The study on importance: gains against finite differences, ranks, and a fit by an oracle."""

import dataclasses

import pytest
import torch

from bench.lib import placed_by_score
from bench.lib.importance_scores import best_opacity_gain, lift, opacity_slopes, ranks, spearman
from bench.lib.one_fit import plan
from tests.scenes import photos, three_gaussians
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Gaussians
from warpgs.synthetic.demo import split_spec, write_demo

CPU = torch.device("cpu")


def test_ranks_and_lift():
    """Equal values share a rank; the order alone counts; the top of a good score holds more than the mean."""
    values = torch.tensor([3.0, 1.0, 3.0, 7.0])
    assert ranks(values).tolist() == [2.5, 1, 2.5, 4]
    assert spearman(values, values.exp()) == pytest.approx(1) and spearman(values, -values) == pytest.approx(-1)
    assert spearman(torch.ones(4), values) == 0
    truth = torch.tensor([0.0, 0.0, 1.0, 3.0])
    assert lift(truth, truth, 0.25) == 3 and lift(-truth, truth, 0.25) == 0
    assert lift(torch.ones(4), truth, 0.25) == 1
    assert lift(torch.tensor([5.0, 1.0, 1.0, 1.0]), truth, 0.5) == pytest.approx(2 / 3)


def test_slopes_are_those_of_the_squared_error():
    """-slope and curvature of every opacity, against the squared error of two views with each opacity moved."""
    model, shown = three_gaussians(), [TrainingView.of(v, CPU) for v in photos(2)]
    shown = [dataclasses.replace(v, image=(v.image + 0.1).clamp(0, 1)) for v in shown]
    black = torch.zeros(3)

    def errors(i: int, change: float) -> torch.Tensor:
        opacity = torch.sigmoid(model.logit_opacities)
        opacity[i] += change
        moved = Gaussians(**(model.tensors() | {"logit_opacities": torch.logit(opacity)}))
        renders = [rasterize(moved, v.camera, RasterizeOptions(background=black)).rgb for v in shown]
        return torch.stack([(r.double() - v.image).square().sum() for r, v in zip(renders, shown)])

    down, bend = opacity_slopes(model, None, shown, black, torch.Generator().manual_seed(0))
    for i in range(3):
        high, low, here = errors(i, 0.02), errors(i, -0.02), errors(i, 0.0)
        assert torch.allclose(-down[:, i].double(), (high - low) / 0.04, rtol=0.03, atol=0.02)
        assert torch.allclose(bend[:, i].double(), (high + low - 2 * here) / (2 * 0.02**2), rtol=1.0)  # four signs estimate it
    gain = best_opacity_gain(torch.tensor([2.0, -1.0, 9.0]), torch.tensor([2.0, 1.0, 3.0]))
    assert gain.tolist() == [0.5, 0.0, 6.0]


def test_an_arm_places_by_its_score_and_logs_what_it_is_worth(tmp_path):
    """A fit by an oracle is scored on the view left out and on held-out ones; its log compares each score with the gains."""
    spec, folder = split_spec(8), str(tmp_path / "scene")
    write_demo(tmp_path / "scene", views=8, width=64, height=48)
    arm = "oracle gain+log/default:steps=24,phases.least=1"
    row = placed_by_score.measure(plan(f"{folder}@{spec}", arm, 0, folder, (spec, 1), 1, "cpu")[0])
    assert 5 < row["psnr"] < 40 and 5 < row["test_psnr"] < 40 and row["psnr"] != row["test_psnr"]
    by_score = {e["score"]: e["spearman"] for e in row["log"] if e["truth"] == "oracle best"}
    assert by_score["uniform"] == 0 and by_score["oracle gain"] > 0.5 and {"warped", "gain", "residual"} <= set(by_score)
