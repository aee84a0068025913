"""Held-out blocks, and when a gain on them is more than noise."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.scenes import photos, three_gaussians
from warpgs.pipeline.train.stopping import FLOOR, SIDES, block_errors, decibels, gain, hide, sample_blocks
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize

CPU = torch.device("cpu")


def views(count: int = 3, width: int = 160, height: int = 128, mask=None) -> list[TrainingView]:
    return [TrainingView.of(dataclasses.replace(v, mask=mask), CPU) for v in photos(count, width, height)]


def test_growth_that_may_have_bought_something_goes_on():
    """Made-up errors of ten blocks: a level bought nothing only where no gain can hide in the spread between blocks."""
    errors = torch.full((10,), 0.02, dtype=torch.float64)
    steady, mixed = 0.9 * errors, errors * torch.tensor([0.5, 1.9] * 5)
    assert gain(errors, steady).mean == pytest.approx(10 * math.log10((0.02 + FLOOR) / (0.018 + FLOOR)))
    assert not gain(errors, steady).upper_bound_below(0.02, 1) and gain(errors, steady).upper_bound_below(0.5, 1)
    g = gain(errors, mixed)
    each = 10 * np.log10((0.02 + FLOOR) / (np.array([0.01, 0.038] * 5) + FLOOR))
    assert g.mean == pytest.approx(each.mean()) and g.noise == pytest.approx(each.std(ddof=1) / math.sqrt(10))
    assert 0 < g.mean < g.noise and not g.upper_bound_below(g.mean, 1) and g.upper_bound_below(g.mean + 1.01 * g.noise, 1)
    assert gain(errors, errors).upper_bound_below(0.02, 1) and gain(steady, errors).upper_bound_below(0.02, 1)


def test_no_evidence_is_no_gain():
    """One block tells nothing, so growth goes on; an error that is no number ends it."""
    one, none = torch.tensor([0.5]), torch.zeros(0)
    assert not gain(0.1 * one, one).upper_bound_below(0.02, 1) and gain(none, none).upper_bound_below(0.02, 1)
    assert gain(torch.tensor([0.5, 0.5]), torch.tensor([0.1, math.nan])).upper_bound_below(0.02, 1)


def test_what_nobody_sees_buys_nothing():
    """A hundredfold fall below two levels of a photograph counts for less than a tenth of one from what is seen."""
    below, seen = torch.full((8,), 0.1 * FLOOR), torch.full((8,), 1e-2)
    assert gain(below, 0.01 * below).mean < 0.5 and gain(seen, 0.01 * seen).mean > 15


def test_blocks_do_not_overlap_and_keep_to_the_picture():
    """Their number, side and place for a picture of usual size; masked-out blocks are no evidence; a seed decides them."""
    drawn = sample_blocks(views(), 0.1, 5)
    for blocks in drawn:
        cover = torch.zeros(128, 160)
        cover[blocks.pixels(CPU)] += 1
        assert blocks.side == SIDES[0] == 16 and int(cover.sum()) == len(blocks) * 256 == 256 * round(0.1 * 80)
    again, other = sample_blocks(views(), 0.1, 5), sample_blocks(views(), 0.1, 6)
    assert all(torch.equal(a.corners, b.corners) for a, b in zip(drawn, again))
    assert not all(torch.equal(a.corners, b.corners) for a, b in zip(drawn, other))
    assert not torch.equal(drawn[0].corners, drawn[1].corners)
    mask = np.zeros((128, 160), bool)
    mask[:, 80:] = True
    for blocks in sample_blocks(views(mask=mask), 0.5, 0):
        assert len(blocks) > 10 and bool((blocks.corners[:, 1] + blocks.side / 2 >= 80).all())
    assert sample_blocks(views(1, 40, 32), 0.1, 0)[0].side == 4
    assert [len(b) for b in sample_blocks(views(3), 0.01, 0)] == [4] * 3 and len(sample_blocks(views(1), 0.01, 0)[0]) == 8
    assert sample_blocks(views(1, 1600, 1200), 0.1, 0)[0].side == SIDES[1]


def test_hidden_blocks_and_their_errors():
    """A view without its blocks keeps its other pixels; the errors are those of the blocks' pixels that count."""
    mask = np.ones((128, 160), bool)
    mask[:, :7] = False
    seen = views(mask=mask)
    blocks = sample_blocks(seen, 0.3, 1)
    hidden = hide(seen[0], blocks[0])
    assert float(seen[0].mask.sum()) == mask.sum()
    assert not bool(hidden.mask[blocks[0].pixels(CPU)].any()) and 0.6 < float(hidden.mask.sum()) / mask.sum() < 0.8
    gaussians = dataclasses.replace(three_gaussians(), sh=0.5 * three_gaussians().sh)
    found = block_errors(gaussians, seen, blocks, RasterizeOptions())
    at = 0
    for v, held in zip(seen, blocks):
        squares = ((rasterize(gaussians, v.camera).rgb.clamp(0, 1) - v.image) ** 2).numpy().mean(2)
        for row, column in held.corners.tolist():
            where = np.s_[row : row + held.side, column : column + held.side]
            assert float(found[at]) == pytest.approx(squares[where][mask[where]].mean(), rel=1e-4, abs=1e-9)
            at += 1
    assert at == len(found) and float(found.max()) > 1e-3
    assert decibels(found) == pytest.approx(-10 * math.log10(float(found.mean()) + FLOOR))
