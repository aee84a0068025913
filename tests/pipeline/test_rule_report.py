"""What a fit says it traded: errors that are true, the same for the same seed, and quick to find."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.gaussians import cloud
from tests.scenes import photos, seeds, three_gaussians
from warpgs.constants import RULES, TILE_SIZE
from warpgs.errors import UsageError
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.results import rule_report_of
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import TrainingView, half_size
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Gaussians, View

CPU = torch.device("cpu")
BACKGROUND = torch.tensor([0.2, 0.4, 0.6])
EXACT = RasterizeOptions(background=BACKGROUND)


def views(count: int = 5, width: int = 150, height: int = 100) -> list[View]:
    return photos(count, width, height)


def crowd(device) -> Gaussians:
    """Three Gaussians that the cameras see, and many faint ones about them, so that a cut-off leaves something out."""
    base, many = three_gaussians(), cloud(800, degree=0)
    means = (many.means - torch.tensor([0.0, 0, 4.0])) * 0.3
    many = dataclasses.replace(many, means=means, logit_opacities=many.logit_opacities - 2)
    tensors = {n: torch.cat([t, many.tensors()[n]]).to(device) for n, t in base.tensors().items()}
    return Gaussians(**tensors)


def test_error_is_the_difference_of_the_pictures(device):
    """For a coarse rule the figures are those of its pictures and exact's, whole pictures in float32, within float32."""
    g, seen = crowd(device), views(2, 60, 48)  # smaller than a part: the parts are the pictures
    for rule in ("fast", "gsplat-1.5"):
        found = rule_report_of(g, seen, RasterizeOptions(rule=rule, background=BACKGROUND), seed=0)
        options = EXACT
        pairs = [
            [rasterize(g, v.camera, dataclasses.replace(options, rule=r)).rgb.flatten() for r in (rule, "exact")] for v in seen
        ]
        off = torch.cat([(a - b).abs() for a, b in pairs]).cpu()
        assert found["mean"] == pytest.approx(float(off.mean()), rel=1e-2, abs=2e-6)
        assert found["max"] == pytest.approx(float(off.max()), rel=1e-2, abs=2e-5)
        assert found["psnr"] == pytest.approx(-10 * math.log10(float((off**2).mean())), abs=0.2)
        assert found["render_ms"] > 0 and found["exact_ms"] > 0 and f"images by rule {rule} differ" in found["summary"]
    assert float(off.max()) > 0


def test_nothing_traded_is_said_and_is_as_small_as_float32(device):
    """Rule exact: the arithmetic alone, and no second time."""
    found = rule_report_of(crowd(device), views(), EXACT, seed=3)
    assert 0 < found["mean"] < 2e-6 and "exact_ms" not in found and found["psnr"] > 90
    assert "has no cut-offs" in found["summary"] and "random training views" in found["summary"]


def test_the_seed_draws_views_and_parts():
    """Three views, parts of 64 px on tile edges or the picture's, others for another seed."""
    g, seen = crowd(CPU), views(6)
    first, again, other = (rule_report_of(g, seen, EXACT, seed=s) for s in (0, 0, 1))
    assert first["views"] == again["views"] and first["mean"] == again["mean"] and first["views"] != other["views"]
    assert len(first["views"]) == 3
    for x, y, w, h in first["views"].values():
        assert x % TILE_SIZE == y % TILE_SIZE == 0 and x + w <= 150 and y + h <= 100 and 0 < w <= 64 and 0 < h <= 64
        assert all(side % TILE_SIZE == 0 or end == whole for side, end, whole in ((w, x + w, 150), (h, y + h, 100)))


def test_a_gaussian_that_is_no_number_changes_nothing():
    """The kernels leave it out, and so does the truth."""
    g = crowd(CPU)
    bad = g.means.clone()
    bad[5] = float("nan")
    found = rule_report_of(dataclasses.replace(g, means=bad), views(1), EXACT, seed=0)
    assert found["mean"] < 2e-6


@pytest.mark.parametrize("size", [(40, 32), (41, 33), (1, 1)])
def test_halved_views(size):
    """Means of the pixels covered, a camera that sees the same, and a mask that counts whole pixels alone."""
    width, height = size
    image = np.random.default_rng(0).random((height, width, 3)).astype(np.float32)
    mask = np.ones((height, width), bool)
    mask[0, -1] = False
    camera = dataclasses.replace(views(1, width, height)[0].camera, model="fisheye")
    view = TrainingView.of(View("a", camera, image, mask), CPU)
    half = half_size(view)
    assert view.camera.model == half.camera.model == "fisheye"
    h, w = max(1, height // 2), max(1, width // 2)
    assert half.image.shape == (h, w, 3) and half.mask.shape == (h, w) and (half.camera.width, half.camera.height) == (w, h)
    if size == (40, 32):
        assert torch.allclose(half.image[3, 5], view.image[6:8, 10:12].mean((0, 1)))
        assert half.mask.sum() == w * h - 1 and half.mask[0, -1] == 0
    corner = torch.tensor([width, height, 1.0], dtype=torch.float64)
    ray = torch.linalg.solve(view.camera.K.double(), corner)
    # entries of K are rounded once each, so at most 2^-24 of a side, twice
    assert torch.allclose(half.camera.K.double() @ ray, torch.tensor([w, h, 1.0], dtype=torch.float64), rtol=1e-6)


def test_a_fit_starts_at_half_size_and_ends_whole(device):
    """The first steps see halved views; the share decides when; without it everything is as before."""
    config = FitConfig(steps=8, init=InitConfig(source="points"), half_resolution=0.5)
    fit = Trainer(photos(3), seeds(), config, device)
    assert [fit.plan_of(s).half_size for s in range(1, 9)] == [True] * 4 + [False] * 4
    sizes = []
    for _ in range(8):
        number = fit.next_view()
        fit.order.append(number)
        kind, _ = fit.places[number + fit.plan_of(fit.step + 1).half_size * len(fit.views)]
        sizes.append(fit.stacks[kind].size[0])
        (report,) = fit.advance()
        assert math.isfinite(report.loss)
    assert sizes == [20] * 4 + [40] * 4
    assert len(fit.stacks) == 2 and len(fit.places) == 6
    plain = Trainer(photos(3), seeds(), dataclasses.replace(config, half_resolution=0.0), device)
    assert len(plain.stacks) == 1 and len(plain.places) == 3
    with pytest.raises(UsageError, match="half-resolution"):
        dataclasses.replace(config, half_resolution=float("nan"))


def test_every_rule_can_be_asked_of_a_fit():
    """And a name that is none is refused with the names there are."""
    assert all(FitConfig(rule=name).rule == name for name in RULES)
    with pytest.raises(UsageError, match=", ".join(RULES)):
        FitConfig(rule="quick")
