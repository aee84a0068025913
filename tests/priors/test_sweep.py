"""The plane sweep: planes, costs and paths as defined, depth of a known scene, and the same on any device."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.priors.rigs import rig, still_life
from tests.reference.sweep import best_inverse, matching_costs, scanline_costs
from warpgs.geometry import back_project, project_points
from warpgs.kernels.sweep import NEUTRAL
from warpgs.priors import sweep
from warpgs.priors.flow import pixel_grid
from warpgs.priors.sweep import (
    UNIT,
    complete,
    consistent_depth,
    inverse_depths_cpu,
    plane_homographies,
    plane_homography,
    plane_inverses,
    project_inverse,
    sweep_depths,
)
from warpgs.scene import Camera, View

CPU, PLANES = torch.device("cpu"), np.linspace(1 / 12, 1 / 2, 40)


def test_homographies_and_planes():
    """A plane's homography, the inverse-depth formula and plain geometry put a pixel in the same place."""
    a, b, _ = rig()
    pixels = pixel_grid(a)
    wanted = project_points(b, back_project(a, pixels, np.full(len(pixels), 3.7)))[0]
    assert np.allclose(project_inverse(a, b, pixels, np.full(len(pixels), 1 / 3.7)), wanted, atol=1e-9)
    # whole numbers are the centres there
    p = np.concatenate([pixels - 0.5, np.ones((len(pixels), 1))], 1) @ plane_homography(a, b, 1 / 3.7).T
    assert np.allclose(p[:, :2] / p[:, 2:] + 0.5, wanted, atol=1e-9)
    several = plane_homographies(a, [b], np.array([0.2, 1 / 3.7]))
    assert several.shape == (2, 1, 3, 3) and np.allclose(several[1, 0], plane_homography(a, b, 1 / 3.7), rtol=1e-12, atol=1e-12)
    assert np.isnan(project_inverse(a, b, pixels[:1], np.array([1e3]))).all() or b.viewmat[2, 3] > 0
    # no match inside both images moves farther; fewer planes where they are capped or needless
    a, b, _ = rig()
    inverses = plane_inverses(a, [b], (2.5, 6.0))
    assert inverses[0] == pytest.approx(1 / 6) and inverses[-1] == pytest.approx(1 / 2.5) and 8 < len(inverses) < 256
    pixels = pixel_grid(a)
    at = np.stack([project_inverse(a, b, pixels, np.full(len(pixels), w)) for w in inverses])
    inside = ((at >= 0) & (at < [64, 48])).all(2)
    steps = np.linalg.norm(np.diff(at, axis=0), axis=2)[inside[1:] & inside[:-1]]
    assert 0.4 < steps.max() < 0.55
    assert len(plane_inverses(a, [b], (2.5, 6.0), 20)) == 20 and len(plane_inverses(a, [], (2.5, 6.0))) == 8


def test_depths_are_the_same_bits_on_any_number_of_threads():
    views, _ = still_life()
    found, before = [], torch.get_num_threads()
    for threads in (1, 3):
        torch.set_num_threads(threads)
        found.append(inverse_depths_cpu(views[1], [views[0], views[2]], PLANES))
    torch.set_num_threads(before)
    assert np.array_equal(*found)


def test_only_consistent_depth_counts():
    """True depths pass where a second view sees them, a wrong patch does not, nor does anything without parallax."""
    views, depths = still_life()
    inverses = [1 / d for d in depths]
    right = consistent_depth(views, inverses, 1, (0, 2))
    assert right.valid.mean() > 0.85 and np.allclose(right.depth[right.valid], depths[1][right.valid], rtol=1e-5)
    wrong = [i.copy() for i in inverses]
    wrong[1][40:60, 60:90] *= 1.2
    patch = consistent_depth(views, wrong, 1, (0, 2))
    assert not patch.valid[42:58, 62:88].any() and np.array_equal(patch.valid[:38], right.valid[:38])
    assert np.isinf(patch.sensitivity[~patch.valid]).all() and (patch.depth[~patch.valid] == 0).all()
    still = consistent_depth([views[0], views[0]], [inverses[0]] * 2, 0, (1,))
    assert still.valid.mean() == 0 and "agrees" in still.notes[0]
    # a change of depth by it moves the match by a pixel, in the view where it moves most
    views, depths = still_life()
    found = consistent_depth(views, [1 / d for d in depths], 1, (0, 2))
    pixels, z = pixel_grid(views[1].camera), depths[1].ravel()
    moved = []
    for j in (0, 2):
        ends = [project_points(views[j].camera, back_project(views[1].camera, pixels, z + s))[0] for s in (1e-4, -1e-4)]
        moved.append(np.linalg.norm(ends[0] - ends[1], axis=1) / 2e-4)
    product = found.sensitivity.ravel() * np.maximum(*moved)
    valid = found.valid.ravel()
    # where only the other view is consistent, that one decides
    assert np.median(np.abs(product[valid] - 1)) < 1e-3 and product[valid].min() > 0.999


def test_depth_of_a_known_scene(monkeypatch):
    """Three quarters are consistent; half of these err by at most 0.8 %. Reduced images, with a note, still give 1.5 %."""
    views, depths = still_life()
    for found, true in zip(sweep_depths(views, [(2, 12)] * 3), depths):
        error = np.abs(found.depth / true - 1)[found.valid]
        assert found.valid.mean() > 0.75 and np.quantile(error, 0.5) < 0.008 and np.quantile(error, 0.9) < 0.05
    monkeypatch.setattr(sweep, "MAX_PIXELS", 10_000)
    mask = np.broadcast_to(np.arange(160) >= 50, (120, 160))
    found = sweep_depths([dataclasses.replace(v, mask=mask) for v in views], [(2, 12)] * 3)
    assert found[0].depth.shape == (120, 160) and "swept at 115 x 86 px" in found[0].notes
    assert not any(f.valid[:, :50].any() for f in found)
    error = np.abs(found[1].depth / depths[1] - 1)[found[1].valid]
    assert found[1].valid[:, 50:].mean() > 0.6 and np.median(error) < 0.015


def test_of_many_views_some_are_swept(monkeypatch):
    """No more views than allowed are swept; the others say so and are valid nowhere; progress is told."""
    views, told = still_life(5)[0], []
    monkeypatch.setattr(sweep, "MAX_VIEWS", 3)
    monkeypatch.setattr(sweep, "MAX_PIXELS", 5_000)
    found = sweep_depths(views, [(2, 12)] * 5, progress=lambda *counts: told.append(counts))
    assert told == [(1, 3), (2, 3), (3, 3)]
    left = [f for f in found if f.notes[0].startswith("not swept: the 3 swept views (of 5) see")]
    assert len(left) == 2 and all(f.valid.mean() == 0 and not f.depth.any() and np.isinf(f.sensitivity).all() for f in left)
    assert sum(f.valid.mean() > 0.5 for f in found) == 3


def test_completion_follows_the_image_and_keeps_planes():
    """Flat regions take the depth of their few valid pixels up to the edge between them; a slanted plane stays linear."""
    image = np.zeros((40, 60, 3), np.float32)
    image[:, 30:] = 0.8
    true = np.where(np.arange(60) < 30, 2.0, 5.0)[None].repeat(40, 0).astype(np.float32)
    valid = np.zeros((40, 60), bool)
    valid[5:10, 5:10] = valid[30:35, 45:55] = True
    filled = complete(np.where(valid, true, 0), valid, image)
    assert np.abs(filled / true - 1).max() < 0.02 and np.array_equal(filled[valid], true[valid])
    true = (1 / (0.1 + 0.004 * np.arange(60)[None].repeat(40, 0))).astype(np.float32)
    valid[:], image[:] = True, 0.5
    valid[14:26, 24:36] = False
    filled = complete(np.where(valid, true, 0), valid, image)
    assert np.abs(filled / true - 1).max() < 0.05
    assert filled.min() >= true.min() - 1e-5 and filled.max() <= true.max() + 1e-5
    assert not complete(true, np.zeros_like(valid), image).any()
    assert np.array_equal(complete(true, np.ones_like(valid), image), true)


# The sweep in torch finds what the one on the CPU does, step by step; its code is the same on any device.


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request):
    return torch.device(request.param)


def computed(view: View, others: list[View], inverses: np.ndarray, device: torch.device, window: int = 7) -> np.ndarray:
    """Return costs in the layout of the reference, [D, H, W]."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep, "WINDOW", window)
        found = sweep.matching_costs_cuda(view, others, inverses, device)
    return found.cpu().numpy().transpose(2, 0, 1) / UNIT


def test_costs_agree(device):
    """Costs agree to half a unit and the rounding of correlations; neutral costs are neutral in both."""
    views, _ = still_life()
    wanted = matching_costs(views[1], [views[0], views[2]], PLANES, 7)
    found = computed(views[1], [views[0], views[2]], PLANES, device)
    off = np.abs(found - wanted)
    assert off.max() < 2e-3 and np.quantile(off, 0.999) < 2e-4 + 0.5 / UNIT and off.mean() < 5e-6 + 0.25 / UNIT
    masked = dataclasses.replace(views[0], mask=np.hypot(*np.mgrid[-60:60, -80:80]) > 40)
    silenced = matching_costs(views[1], [masked, views[2]], PLANES, 7)
    off = np.abs(computed(views[1], [masked, views[2]], PLANES, device) - silenced)
    # positions on the edge of a pixel may be rounded to either
    assert np.quantile(off, 0.999) < 2e-4 + 0.5 / UNIT and off.mean() < 5e-5 + 0.25 / UNIT and (silenced != wanted).mean() > 0.1
    silent = wanted == NEUTRAL
    assert 0.001 < silent.mean() < 0.5 and (found[silent] == NEUTRAL).mean() > 0.999
    # planes behind the other camera are neutral in both
    generator = np.random.default_rng(0)
    texture = generator.uniform(0.1, 0.9, (30, 60, 3)).astype(np.float32)
    K = np.array([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]])
    behind = np.eye(4)
    behind[:3, 3] = [-0.5, 0.1, -3.0]
    views = [View("a", Camera(np.eye(4), K, 40, 30), texture[:, :40]), View("b", Camera(behind, K, 60, 30), texture)]
    inverses = np.array([0.15, 0.25, 0.5, 1.0])
    wanted = matching_costs(views[0], views[1:], inverses, 5)
    found = computed(views[0], views[1:], inverses, device, 5)
    assert np.abs(found - wanted).max() < 1e-4 + 0.5 / UNIT and (wanted != NEUTRAL).mean() > 0.3


def test_paths_and_parabolas_are_those_of_the_definition(device):
    """Paths agree to the last unit with the recursion written pixel by pixel; an edge of the image lets depth jump."""
    generator = np.random.default_rng(1)
    costs = generator.integers(0, UNIT + 1, (9, 7, 12)).astype(np.int16)
    image = generator.uniform(0.4, 0.55, (9, 7, 3)).astype(np.float32)

    def limits(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.rint(np.maximum(0.6 * np.exp(-np.abs(a - b).max(2).astype(float) / 0.06), 1.5 * 0.05) * UNIT).astype(int)

    down, across = limits(image[1:], image[:-1]), limits(image[:, 1:], image[:, :-1])
    found = sweep.path_costs(torch.from_numpy(costs).to(device), image, 0.05, 0.6)
    assert np.array_equal(found.cpu().numpy(), scanline_costs(costs, down, across, round(0.05 * UNIT))) and np.ptp(down) > 500
    assert 4 * (1 + sweep.LARGE_STEP) * UNIT + 4 < 2**15  # no sum of four paths overflows
    # between planes, at the first and last plane, and where costs are flat
    generator = np.random.default_rng(2)
    costs = generator.integers(0, 1000, (6, 5, 40)).astype(np.float32)
    costs[0], costs[1, :, 0], costs[2, :, -1] = 7.0, -1.0, -1.0
    wanted = best_inverse(costs, PLANES)
    assert np.allclose(sweep.best_inverse(torch.from_numpy(costs).to(device), PLANES).cpu(), wanted, rtol=1e-12)


def test_depths_agree(device):
    views, depths = still_life()
    others = [views[0], views[2]]
    planes = plane_inverses(views[1].camera, [o.camera for o in others], (2, 12))
    wanted = inverse_depths_cpu(views[1], others, planes)
    found = sweep.inverse_depths_cuda(views[1], others, planes, device).cpu().numpy()
    assert found.shape == depths[1].shape and np.quantile(np.abs(found / wanted - 1), 0.95) < 2e-4
    error = np.abs(1 / (found * depths[1]) - 1)
    assert np.median(error) < 0.008


def test_a_small_gpu_leaves_it_to_the_cpu(monkeypatch):
    """Depths are those of the CPU, and one note names the memory that since a GPU needs."""
    views, _ = still_life()
    monkeypatch.setattr(sweep, "installed_bytes", lambda _: 2**20)
    monkeypatch.setattr(sweep, "MAX_PIXELS", 5_000)
    found = sweep_depths(views, [(2, 12)] * 3, torch.device("cuda"))
    for a, b in zip(found, sweep_depths(views, [(2, 12)] * 3)):
        assert np.array_equal(a.depth, b.depth) and len(b.notes) == 1
    assert "since a GPU needs" in found[0].notes[0] and "MiB" in found[0].notes[0] and len(found[1].notes) == 1


@pytest.mark.parametrize("size", [(40, 3), (3, 40), (1, 1)])
def test_tiny_images_are_left_to_the_cpu(size, monkeypatch):
    """Images narrower than half a window are swept on the CPU: torch mirrors no border there."""
    width, height = size
    K = np.array([[40.0, 0, width / 2], [0, 40, height / 2], [0, 0, 1]])
    aside = np.eye(4)
    aside[0, 3] = -0.5
    image = np.random.default_rng(0).random((height, width, 3), np.float32)
    views = [View("a", Camera(np.eye(4), K, width, height), image), View("b", Camera(aside, K, width, height), image)]
    monkeypatch.setattr(sweep, "installed_bytes", lambda _: 2**40)
    found = sweep_depths(views, [(2, 12)] * 2, torch.device("cuda"))
    assert [f.depth.shape for f in found] == [(height, width)] * 2


@pytest.mark.cuda
def test_the_gpu_takes_no_more_than_it_says():
    """Peak memory of a view is below `needed_bytes`, with masks, too."""
    views = [dataclasses.replace(v, mask=np.ones((120, 160), bool)) for v in still_life()[0]]
    device, planes = torch.device("cuda"), np.linspace(1 / 12, 1 / 2, 200)
    sweep.inverse_depths_cuda(views[1], [views[0], views[2]], planes, device)
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device)
    sweep.inverse_depths_cuda(views[1], [views[0], views[2]], planes, device)
    assert torch.cuda.max_memory_allocated(device) - before < sweep.needed_bytes(views[1], len(planes))


@pytest.mark.cuda
def test_a_gpu_finds_as_much_consistent_depth():
    views, _ = still_life()
    for a, b in zip(*(sweep_depths(views, [(2, 12)] * 3, d) for d in (CPU, torch.device("cuda")))):
        assert abs(a.valid.mean() - b.valid.mean()) < 0.005
