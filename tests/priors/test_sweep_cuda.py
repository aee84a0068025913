"""The sweep in torch finds what the one on the CPU does, step by step; its code is the same on any device."""

import numpy as np
import pytest
import torch

from tests.priors.rigs import still_life
from tests.reference.plane_costs import matching_costs
from tests.reference.plane_depths import best_inverse
from tests.reference.scanlines import scanline_costs
from warpgs.kernels.sweep import NEUTRAL
from warpgs.priors import sweep
from warpgs.priors.sweep import UNIT, SweepConfig, plane_inverses, step_limits, sweep_depths
from warpgs.scene import Camera, View

CPU = torch.device("cpu")
PLANES = np.linspace(1 / 12, 1 / 2, 40)


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request):
    """Return the device of torch."""
    return torch.device(request.param)


def computed(view: View, others: list[View], inverses: np.ndarray, window: int, device: torch.device) -> np.ndarray:
    """Return costs in the layout of the reference, [D, H, W]."""
    found = sweep.matching_costs_cuda(view, others, inverses, window, device)
    return found.cpu().numpy().transpose(2, 0, 1) / UNIT


def test_costs_agree(device):
    """Costs agree to half a unit and the rounding of correlations; neutral costs are neutral in both."""
    views, _ = still_life()
    wanted = matching_costs(views[1], [views[0], views[2]], PLANES, 7)
    found = computed(views[1], [views[0], views[2]], PLANES, 7, device)
    off = np.abs(found - wanted)
    assert off.max() < 2e-3 and np.quantile(off, 0.999) < 2e-4 + 0.5 / UNIT and off.mean() < 5e-6 + 0.25 / UNIT
    silent = wanted == NEUTRAL
    assert 0.001 < silent.mean() < 0.5 and (found[silent] == NEUTRAL).mean() > 0.999


def test_costs_of_another_size_agree(device):
    """The other view has another size, and planes behind its camera are neutral in both."""
    generator = np.random.default_rng(0)
    texture = generator.uniform(0.1, 0.9, (30, 60, 3)).astype(np.float32)
    K = np.array([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]])
    behind = np.eye(4)
    behind[:3, 3] = [-0.5, 0.1, -3.0]
    views = [View("a", Camera(np.eye(4), K, 40, 30), texture[:, :40]), View("b", Camera(behind, K, 60, 30), texture)]
    inverses = np.array([0.15, 0.25, 0.5, 1.0])
    wanted = matching_costs(views[0], views[1:], inverses, 5)
    found = computed(views[0], views[1:], inverses, 5, device)
    assert np.abs(found - wanted).max() < 1e-4 + 0.5 / UNIT and (wanted != NEUTRAL).mean() > 0.3


def test_paths_agree(device):
    """Paths agree to the last unit, in an image with edges."""
    generator = np.random.default_rng(1)
    costs = generator.integers(0, UNIT + 1, (9, 7, 12)).astype(np.int16)
    image = generator.uniform(0.4, 0.55, (9, 7, 3)).astype(np.float32)
    limits = [step_limits(colors, 0.05, 0.6) for colors in (image, image.swapaxes(0, 1))]
    wanted = scanline_costs(costs, limits[0], limits[1].T, round(0.05 * UNIT))
    found = sweep.path_costs(torch.from_numpy(costs).to(device), image, 0.05, 0.6)
    assert np.array_equal(found.cpu().numpy(), wanted)


def test_parabola_agrees(device):
    """Inverse depths agree between planes, at the first and last plane, and where costs are flat."""
    generator = np.random.default_rng(2)
    costs = generator.integers(0, 1000, (6, 5, 40)).astype(np.float32)
    costs[0], costs[1, :, 0], costs[2, :, -1] = 7.0, -1.0, -1.0
    wanted = best_inverse(costs, PLANES)
    assert np.allclose(sweep.best_inverse(torch.from_numpy(costs).to(device), PLANES), wanted, rtol=1e-12)


def test_depths_agree(device):
    """Depths of a view of the still life are nearly all the same, with the same error."""
    views, depths = still_life()
    config, others = SweepConfig(), [views[0], views[2]]
    planes = plane_inverses(views[1].camera, [o.camera for o in others], (2, 12), config.spacing, config.max_planes)
    wanted = sweep.inverse_depths_cpu(views[1], others, planes, config)
    found = sweep.inverse_depths_cuda(views[1], others, planes, config, device)
    assert found.shape == depths[1].shape and np.quantile(np.abs(found / wanted - 1), 0.95) < 2e-4
    error = np.abs(1 / (found * depths[1]) - 1)
    assert np.median(error) < 0.008


def test_a_small_gpu_leaves_it_to_the_cpu(monkeypatch):
    """Depths are those of the CPU, and one note names the memory that since a GPU needs."""
    views, _ = still_life()
    monkeypatch.setattr(sweep, "installed_bytes", lambda _: 2**20)
    found = sweep_depths(views, [(2, 12)] * 3, SweepConfig(), torch.device("cuda"))
    for a, b in zip(found, sweep_depths(views, [(2, 12)] * 3, SweepConfig())):
        assert np.array_equal(a.depth, b.depth) and not b.notes
    assert "since a GPU needs" in found[0].notes[0] and "MiB" in found[0].notes[0] and not found[1].notes


@pytest.mark.parametrize("size", [(40, 3), (3, 40), (3, 3), (40, 1), (1, 1)])
def test_tiny_images_are_left_to_the_cpu(size, monkeypatch):
    """Images narrower than half a window are swept on the CPU: torch mirrors no border there."""
    width, height = size
    K = np.array([[40.0, 0, width / 2], [0, 40, height / 2], [0, 0, 1]])
    aside = np.eye(4)
    aside[0, 3] = -0.5
    image = np.random.default_rng(0).random((height, width, 3), np.float32)
    views = [View("a", Camera(np.eye(4), K, width, height), image), View("b", Camera(aside, K, width, height), image)]
    monkeypatch.setattr(sweep, "installed_bytes", lambda _: 2**40)
    found = sweep_depths(views, [(2, 12)] * 2, SweepConfig(), torch.device("cuda"))
    assert [f.depth.shape for f in found] == [(height, width)] * 2


@pytest.mark.cuda
def test_the_gpu_takes_no_more_than_it_says():
    """Peak memory of a view is below `needed_bytes`."""
    views, _ = still_life()
    device, planes = torch.device("cuda"), np.linspace(1 / 12, 1 / 2, 200)
    sweep.inverse_depths_cuda(views[1], [views[0], views[2]], planes, SweepConfig(), device)
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device)
    sweep.inverse_depths_cuda(views[1], [views[0], views[2]], planes, SweepConfig(), device)
    assert torch.cuda.max_memory_allocated(device) - before < sweep.needed_bytes(views[1], len(planes))


@pytest.mark.cuda
def test_a_gpu_finds_as_much_consistent_depth():
    """Coverage of the still life agrees within half a per cent of the pixels."""
    views, _ = still_life()
    for a, b in zip(*(sweep_depths(views, [(2, 12)] * 3, SweepConfig(), d) for d in (CPU, torch.device("cuda")))):
        assert abs(a.coverage - b.coverage) < 0.005
