"""Scores, what guessing would score, and camera paths."""

import math

import numpy as np
import pytest
import torch

from tests.scenes import photos, ring
from warpgs.geometry import back_project, camera_extent, focus_point, in_image, project_points
from warpgs.pipeline.metrics.scores import baselines, counted_region, psnr, score, summarize, to_8_bit, variants
from warpgs.scene import View


def test_psnr_of_known_errors():
    """An error of 0.1 everywhere is 20 dB; equal images are infinitely good; a region counts alone."""
    a = np.full((8, 9, 3), 0.5, np.float32)
    assert psnr(a + 0.1, a) == pytest.approx(20, abs=1e-4) and psnr(a, a) == math.inf
    region = np.zeros((8, 9), bool)
    region[:4] = True
    b = a.copy()
    b[4:] = 1
    assert psnr(b, a, region) == math.inf and psnr(b, a) < 10
    for wrong, error, message in (
        (region.astype(int), TypeError, "region must be bool, not int64; give region > 0"),
        (region[1:], ValueError, "region must have shape"),
    ):
        with pytest.raises(error, match=message):
            psnr(b, a, wrong)
    with pytest.raises(ValueError, match="both images must have one shape"):
        psnr(b[:1], a)  # which numpy would broadcast


def test_scores_are_of_the_saved_picture():
    """Clamping and rounding to 8 bits happen before scoring."""
    view = photos(1)[0]
    m = score(view, view.image + 1e-4)
    assert m.psnr > 50 and m.ssim > 0.999 and m.ssim_skimage > 0.999
    assert np.array_equal(to_8_bit(np.array([-1.0, 0.5, 2.0])), np.float32([0, 128 / 255, 1]))


def test_counted_region():
    """A mask counts first; an object on black counts by its bright pixels; an ordinary photo counts whole."""
    view = photos(1)[0]
    bright = View("a", view.camera, np.full_like(view.image, 0.5))
    assert counted_region(bright) == (None, "all")
    dark = np.zeros_like(view.image)
    dark[10:20, 10:20] = 0.7
    region, name = counted_region(View("a", view.camera, dark))
    assert name == "foreground" and int(region.sum()) == 100
    mask = np.zeros(view.image.shape[:2], bool)
    mask[0] = True
    assert counted_region(View("a", view.camera, dark, mask))[1] == "mask"


class Witness:
    """Stands in for LPIPS and keeps what it was given."""

    def measure(self, image, target):
        self.seen = (image, target)
        return {"lpips_vgg_legacy": 0.25, "lpips_vgg_standard": float("nan")}


@pytest.mark.parametrize("kind", ["mask", "score_mask"])
def test_masked_view_is_scored_by_the_dtu_recipe(kind):
    """PSNR over the mask alone; SSIM and LPIPS on both images with white outside, so what stands there cannot matter."""
    view = photos(1)[0]
    mask = np.zeros(view.image.shape[:2], bool)
    mask[8:24, 10:30] = True
    rng = np.random.default_rng(0)
    image = view.image + 0.1 * mask[..., None].astype(np.float32)
    scores = []
    for filling in (0.0, 1.0):
        truth, render = view.image.copy(), image.copy()
        truth[~mask], render[~mask] = filling, rng.random((int((~mask).sum()), 3))
        witness = Witness()
        scores.append(score(View("a", view.camera, truth, **{kind: mask}), render, witness))
        assert all((i[~mask] == 1).all() for i in witness.seen)
        assert np.array_equal(witness.seen[1][mask], to_8_bit(view.image)[mask])
    a, b = scores
    assert (a.psnr, a.ssim, a.ssim_skimage) == (b.psnr, b.ssim, b.ssim_skimage) and a.region == kind.replace("_", " ")
    expected = np.mean((to_8_bit(image)[mask].astype(float) - to_8_bit(view.image)[mask]) ** 2)
    assert a.psnr == pytest.approx(-10 * math.log10(expected), abs=1e-4) and a.ssim < 1
    from tests.reference.ssim import ssim_reference  # the same figure, from images composited here

    pair = [torch.from_numpy(np.where(mask[..., None], to_8_bit(i), 1)).double() for i in (image, view.image)]
    assert a.ssim == pytest.approx(float(ssim_reference(*pair).mean()), abs=1e-5)


def test_score_mask_wins_over_the_mask_of_the_fit():
    """The protocol's mask decides the score, whatever the fit was allowed to see."""
    view = photos(1)[0]
    left, right = np.zeros((2, *view.image.shape[:2]), bool)
    left[:, :20], right[:, 20:] = True, True
    image = view.image.copy()
    image[:, :20] = 1
    assert score(View("a", view.camera, view.image, left, right), image).psnr == math.inf


def test_lpips_joins_the_figures():
    """Measured: in the row and the means, by variant; not measured: no figure, and the words say so."""
    view = photos(1)[0]
    m = score(view, view.image, Witness())
    assert m.row()["lpips_vgg_legacy"] == 0.25 and "lpips" not in m.row()
    assert summarize([m, m])["lpips_vgg_legacy"] == 0.25
    assert "lpips_vgg_legacy" not in summarize([score(view, view.image)])
    assert "not measured" in variants(None)["lpips"]


def test_guesses():
    """The mean photo and the nearest photo are scored as predictions; other sizes are left out."""
    views = photos(3)
    g = baselines([views[0], views[2]], [views[1]])
    mean = to_8_bit((views[0].image + views[2].image) / 2)
    region, _ = counted_region(views[1])
    assert g["mean_photo"] == pytest.approx(psnr(mean, views[1].image, region))
    assert baselines(photos(2, 20, 16), [views[1]]) == {}
    assert summarize([]) == {}


def test_geometry_round_trip():
    """Back-projection undoes projection; extent and focus are those of an arc around the origin."""
    cameras = ring(5)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3))
    for c in cameras:
        pixels, z = project_points(c, points)
        assert np.allclose(back_project(c, pixels, z), points, atol=1e-12) and (z > 0).all()
        assert in_image(c, np.zeros((1, 3)))[0] and not in_image(c, 3 * c.center[None])[0]
    assert np.linalg.norm(focus_point(cameras)) < 1e-4
    assert 1.0 < camera_extent(cameras) < 2.2 and camera_extent(cameras[:1]) == 0
