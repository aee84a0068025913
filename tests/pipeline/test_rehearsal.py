"""A rehearsal uses what a fit of the same settings uses, says what goes wrong, and leaves no trace in the fit."""

import dataclasses

import pytest
import torch

from tests.scenes import photographs, priors, seeds
from warpgs.pipeline import rehearsal as rehearsals
from warpgs.pipeline.config import PRESETS
from warpgs.pipeline.fit import Fit, run
from warpgs.pipeline.rehearsal import POINTS, STEPS, rehearsal, rehearse

CPU = torch.device("cpu")


@pytest.mark.parametrize("preset", PRESETS)
def test_every_part_of_a_fit_is_used(preset, monkeypatch):
    """Every step is taken, Gaussians are added by refinement, events sample where the preset has any, and a view is scored."""
    scored, config = [], PRESETS[preset]
    score = rehearsals.score
    monkeypatch.setattr(rehearsals, "score", lambda view, image: scored.append(score(view, image)))
    fit = rehearse(config, CPU)
    assert fit.step == STEPS and len(fit.events) == config.method.events and len(fit.gaussians) > POINTS
    assert len(scored) == 1 and 0 < scored[0].psnr < 30 and not fit.graphs


def test_limits_of_the_real_fit_do_not_stop_it():
    """A memory limit is for the real fit alone; a bound on Gaussians holds."""
    bound = dataclasses.replace(PRESETS["quick"].density, max_gaussians=50)
    fit = rehearse(dataclasses.replace(PRESETS["quick"], memory_limit=1, half_resolution=0.5, density=bound), CPU)
    assert fit.step == STEPS and len(fit.gaussians) <= 50


def test_only_a_free_gpu_rehearses(monkeypatch):
    """Nothing is begun on a CPU, nor where networks for priors run on the GPU."""
    monkeypatch.setattr(rehearsals, "rehearse", lambda *_: pytest.fail("begun"))
    networks = dataclasses.replace(PRESETS["paper"].priors, onnx_provider="cuda")
    assert rehearsal(PRESETS["paper"], CPU)() is None
    assert rehearsal(dataclasses.replace(PRESETS["paper"], priors=networks), torch.device("cuda"))() is None


def test_what_goes_wrong_is_raised(monkeypatch):
    """By what waits for the end, in the thread that waits."""

    def fail(*_):
        raise RuntimeError("out of order")

    monkeypatch.setattr(rehearsals, "rehearse", fail)
    monkeypatch.setattr(torch.cuda, "device", lambda _: torch.no_grad())  # there may be none here
    wait = rehearsal(PRESETS["paper"], torch.device("cuda"))
    with pytest.raises(RuntimeError, match="out of order"):
        wait()


@pytest.mark.cuda
def test_a_fit_is_the_same_after_a_rehearsal():
    """Bit for bit that of a fit without one."""
    device, views = torch.device("cuda"), photographs(3)
    config = dataclasses.replace(PRESETS["quick"], steps=20)
    fits = []
    for begin in (lambda *_: lambda: None, rehearsal):
        fit = Fit(views, seeds(), config, device, priors=priors(views), ready=begin(config, device))
        run(fit, lambda _: None, lambda _: None, lambda: False)
        fits.append(fit.gaussians.tensors())
    assert all(torch.equal(fits[0][n], fits[1][n]) for n in fits[0])
