"""Faults of photographs: what is injected is named, and nothing else is."""

import dataclasses

import cv2
import numpy as np
import pytest

from tests.scenes import ring, textured_photos as photos
from warpgs.priors.photo_checks import check_photos, photo_notes
from warpgs.process import Task

GAIN = np.array([1.25, 1.0, 0.8], np.float32)


def _print(x: np.ndarray, y: np.ndarray, place: float) -> np.ndarray:
    """Colours of a card with detail at every size, without tones that a gain of 1.4 would clip."""
    noise = np.random.default_rng(0).integers(0, 2, (3, 96, 128)).astype(np.float32)
    layers = [cv2.resize(n[: 96 // k, : 128 // k], (512, 384), interpolation=cv2.INTER_CUBIC) for n, k in zip(noise, (1, 2, 4))]
    gray = np.clip(0.15 + 0.16 * sum(layers), 0.1, 0.65)
    at = [np.clip(v / (2 * half) + 0.5, 0, 1) * (n - 1) for v, half, n in ((y, 0.9, 384), (x, 1.2, 512))]
    rows, columns = (np.rint(a).astype(int) for a in at)
    return gray[rows, columns][..., None] * [1.0, 0.9, 0.8]


@pytest.fixture(scope="module")
def sharp():
    return photos(_print, width=160, height=120, half=(1.2, 0.9), cameras=ring(9, 160, 120)[2:7])


def _named(checks, views, fault):
    """Return the names of the views in the notes on a fault."""
    return [v.name for note in photo_notes(checks) if fault in note for v in views if v.name in note]


def _with(views, index, image):
    changed = list(views)
    changed[index] = dataclasses.replace(views[index], image=np.clip(image, 0, 1).astype(np.float32))
    return changed


@pytest.mark.parametrize("index", [0, 2])
def test_a_blurred_photograph_is_named_alone(sharp, index):
    """A shake of 3 px, at the end of the row and in the middle."""
    kernel = np.diag([1 / 3] * 3).astype(np.float32)
    (note,) = photo_notes(check_photos(_with(sharp, index, cv2.filter2D(sharp[index].image, -1, kernel))))
    assert "blurred" in note and [v.name for v in sharp if v.name in note] == [sharp[index].name]


@pytest.mark.parametrize("gain", [0.7, 1.4])
def test_exposure_is_measured(sharp, gain):
    """The factor is found, also where only three photographs are there, and only that photograph is named."""
    for views in (sharp, sharp[1:4]):
        changed = _with(views, 1, views[1].image * gain)
        checks = check_photos(changed)
        assert checks[1].brightness == pytest.approx(gain, rel=0.05)
        assert _named(checks, views, "exposure differs") == [views[1].name]
        assert all(c.brightness == pytest.approx(1, abs=0.05) for c in checks if c.name != views[1].name)
        (note,) = photo_notes(checks)
        assert f"{views[1].name} ({checks[1].brightness:.2f} x as bright)" in note


def test_faults_are_told_apart_and_what_cannot_be_compared_is_said(sharp):
    """All are compared with two others or more, and all figures lie near 1 without a fault."""
    checks = check_photos(sharp)
    assert not any(c.compared_with for c in check_photos(sharp, lambda: True))  # a fit that ends does not wait
    assert photo_notes(checks) == []
    assert [c.name for c in checks] == [v.name for v in sharp]
    assert all(c.compared_with >= 2 for c in checks)
    assert all(0.9 < c.sharpness < 1.12 and 0.95 < c.brightness < 1.05 for c in checks)
    # a warmer photograph of the same brightness
    checks = check_photos(_with(sharp, 3, sharp[3].image * GAIN))
    assert _named(checks, sharp, "white balance") == [sharp[3].name] and not _named(checks, sharp, "exposure differs")
    assert checks[3].channels == pytest.approx(tuple(GAIN), rel=0.05)
    # an even image matches nothing: no figure is made up for it, nor lost for the others
    checks = check_photos(_with(sharp, 4, np.full_like(sharp[4].image, 0.5)))
    assert (checks[4].compared_with, checks[4].sharpness, checks[4].brightness, checks[4].channels) == (0, None, None, None)
    assert photo_notes(checks) == [f"blur and exposure not checked, too few matches: {sharp[4].name}"]


@pytest.mark.parametrize("mistake", ["inverse", "axes", "focal length"])
def test_cameras_that_do_not_fit_the_photographs_are_doubted(sharp, mistake):
    """Right ones are not: poses from world to camera, the axes of OpenGL, a focal length in millimetres."""

    def wrong(camera):
        viewmat, K = camera.viewmat, camera.K
        if mistake == "inverse":
            viewmat = np.linalg.inv(viewmat)
        elif mistake == "axes":
            viewmat = np.diag([1, -1, -1, 1]) @ viewmat
        else:
            K = K * np.array([[0.07, 1, 1], [1, 0.07, 1], [1, 1, 1]])
        return dataclasses.replace(camera, viewmat=viewmat, K=K)

    checks = check_photos([dataclasses.replace(v, camera=wrong(v.camera)) for v in sharp])
    (note, *_) = photo_notes(checks)
    assert isinstance(note, Task) and "the cameras do not fit the photographs" in note and "not checked" not in note
    right = check_photos(sharp)
    assert [c.matches for c in checks] == [c.matches for c in right] and all(c.agreeing > 0.5 * c.matches for c in right)


def test_photographs_that_stand_close_together_are_compared():
    """A third of a degree apart: too little for depth, and enough to see the same places."""
    views = photos(_print, width=160, height=120, half=(1.2, 0.9), cameras=ring(400, 160, 120)[196:204:2])
    checks = check_photos(_with(views, 1, views[1].image * 0.7))
    assert all(c.compared_with == 3 for c in checks)
    assert _named(checks, views, "exposure differs") == [views[1].name]
