"""A step that runs out of memory is tried once more with less, and what cannot go on is saved."""

import contextlib
import copy
import dataclasses

import numpy as np
import pytest
import torch

from tests.pipeline.test_trainer import BUSY, fitted
from tests.scenes import photos, seeds
from warpgs.errors import OutOfMemoryError, ResourceError
from warpgs.pipeline.train import batch
from warpgs.pipeline.train import trainer as trainer_module
from warpgs.pipeline.train.trainer import Trainer, run

CPU = torch.device("cpu")
CUDA = torch.device("cuda", 0)


def no_memory(*_, **__):
    raise RuntimeError("[enforce fail at alloc_cpu.cpp:124] DefaultCPUAllocator: can't allocate memory: 1 bytes")


def failing(monkeypatch, owner, name: str, calls: set[int]):
    """Have some calls of a function, counted from 1, find no memory."""
    honest, count = getattr(owner, name), []

    def scarce(*arguments, **keywords):
        count.append(1)
        return no_memory() if len(count) in calls else honest(*arguments, **keywords)

    monkeypatch.setattr(owner, name, scarce)


def saved(fit: Trainer) -> tuple[dict, dict]:
    """A state in memory of its own on the host, as a file has it: the device may be full."""
    tensors, plain = fit.state()
    return {n: t.to("cpu", copy=True) for n, t in tensors.items()}, copy.deepcopy(plain)


def finished(fit: Trainer, states: list) -> list[int]:
    """Take the remaining steps, save the state every 10 steps and after the last, and return the numbers of steps reported."""
    seen = []

    def on_step(report):
        seen.append(report.step)
        if report.step % 10 == 0:
            states.append(saved(fit))

    def restore(_):
        if not states:
            return False
        fit.load(*states[-1])
        return True

    run(fit, on_step, lambda f: states.append(saved(f)), lambda: False, restore)
    return seen


def same(a: Trainer, b: Trainer) -> bool:
    tensors, others = a.state()[0], b.state()[0]
    return tensors.keys() == others.keys() and all(torch.equal(tensors[k], others[k]) for k in tensors)


def test_a_step_is_tried_again_and_nothing_else_changes(monkeypatch):
    """The same bits as without the lack; it is said once for each."""
    reference = fitted(BUSY, 60)
    fit = fitted(BUSY, 0)
    failing(monkeypatch, batch, "step", {3, 30})
    assert finished(fit, []) == list(range(1, 61))
    assert same(fit, reference)
    assert len(fit.messages) == 2 and "step 3 ran out of memory" in fit.messages[0]


def test_a_step_that_fails_twice_ends_the_fit_and_is_saved(monkeypatch):
    """The state saved is that before the step, with its view still to come; a fit that continues from it is the same."""
    reference, fit, states = fitted(BUSY, 60), fitted(BUSY, 0), []
    failing(monkeypatch, batch, "step", {26, 27})
    with pytest.raises(OutOfMemoryError, match=r"step 26 .*--memory-limit.*--downscale.*--resume") as found:
        finished(fit, states)
    assert found.value.exit_code == 4 and states[-1][1]["step"] == 25
    again = fitted(BUSY, 0)
    again.load(*states[-1])
    finished(again, [])
    assert same(again, reference)


def test_where_not_even_the_smallest_step_fits_the_state_is_saved(monkeypatch):
    """Nothing is free when the step is to be tried again."""
    fit, states = fitted(BUSY, 0), []
    failing(monkeypatch, batch, "step", {26})
    monkeypatch.setattr(trainer_module, "available_bytes", lambda _: 0)
    with pytest.raises(ResourceError, match="smallest step needs") as found:
        finished(fit, states)
    assert found.value.exit_code == 4 and states[-1][1]["step"] == 25


@pytest.mark.parametrize(("calls", "ends"), [({2}, False), ({2, 3}, True)])
def test_a_change_of_the_set_starts_from_the_last_saved_state(monkeypatch, calls, ends):
    """Half a change is nothing to go on from: steps since the last save are taken again; a second lack there ends the fit."""
    reference, fit, states = fitted(BUSY, 60), fitted(BUSY, 0), []
    failing(monkeypatch, fit.table, "apply", calls)
    if ends:
        with pytest.raises(OutOfMemoryError) as found:
            finished(fit, states)
        assert not found.value.intact
        return
    seen = finished(fit, states)
    assert set(seen) == set(range(1, 61)) and len(seen) >= 60
    assert same(fit, reference)


def test_a_change_with_nothing_saved_before_ends_the_fit(monkeypatch):
    fit = fitted(BUSY, 0)
    failing(monkeypatch, fit.table, "apply", {1})
    with pytest.raises(OutOfMemoryError):
        run(fit, lambda _: None, lambda _: None, lambda: False)


def test_other_errors_pass(monkeypatch):
    fit = fitted(BUSY, 0)

    def broken(*_):
        raise RuntimeError("something else")

    monkeypatch.setattr(batch, "step", broken)
    with pytest.raises(RuntimeError, match="something else"):
        finished(fit, [])


class OtherProgram:
    """A program beside the fit that takes memory of the device and gives it back, as this process sees it.

    torch is limited to what would be left, and is told so: other tests on the device see nothing of it, and it nothing of them.
    """

    def __init__(self, monkeypatch):
        self.held, self.free, self.limit = [], torch.cuda.mem_get_info, 0
        self.total = torch.cuda.get_device_properties(CUDA).total_memory
        monkeypatch.setattr(torch.cuda, "mem_get_info", self.left)

    def left(self, device):
        """Return free and installed bytes, as torch.cuda.mem_get_info does."""
        if not self.limit:
            return self.free(device)
        return max(0, self.limit - torch.cuda.memory_reserved(device)), self.total

    def take_all_but(self, mib: int):
        """Leave so many MiB free, beside what torch holds."""
        torch.cuda.empty_cache()
        self.limit = torch.cuda.memory_reserved(CUDA) + mib * 2**20
        torch.cuda.set_per_process_memory_fraction(self.limit / self.total, CUDA)

    def take_what_torch_holds(self):
        """Take what torch keeps for later, too: some of it lies in pieces that it cannot give back."""
        for mib in (64, 8, 1):
            with contextlib.suppress(torch.OutOfMemoryError):
                while True:
                    self.held.append(torch.empty(mib * 2**20, dtype=torch.uint8, device=CUDA))

    def give_back(self):
        self.held, self.limit = [], 0
        torch.cuda.set_per_process_memory_fraction(1.0, CUDA)


@pytest.fixture
def other(monkeypatch):
    """Such a program, which ends with the test."""
    program = OtherProgram(monkeypatch)
    yield program
    program.give_back()


@pytest.mark.cuda
def test_a_full_device_is_noticed_and_the_fit_goes_on(other):
    """Steps go on in chunks, one by one, and end as they should."""
    fit, states = Trainer(photos(4, 1600, 1200), seeds(), BUSY, CUDA), []
    fit.advance()
    other.take_all_but(300)
    seen = finished(fit, states)
    assert seen == list(range(2, 61))
    assert any("ran out of memory" in m for m in fit.messages), fit.messages
    assert all(bool(torch.isfinite(t).all()) for t in fit.gaussians.tensors().values())


@pytest.mark.cuda
def test_a_device_without_memory_ends_the_fit_which_goes_on_later(other):
    """Class 4 with the state saved; once the other program has ended, a fit continued from it comes to its end."""
    fit, states = Trainer(photos(4, 1600, 1200), seeds(), BUSY, CUDA), []
    states.append(saved(fit))
    other.take_all_but(2)
    other.take_what_torch_holds()
    with pytest.raises(ResourceError) as found:
        finished(fit, states)
    assert found.value.exit_code == 4
    other.give_back()
    again = Trainer(photos(4, 1600, 1200), seeds(), BUSY, CUDA)
    again.load(*states[-1])
    finished(again, [])
    assert all(bool(torch.isfinite(t).all()) for t in again.gaussians.tensors().values())


@pytest.mark.cuda
def test_2000_steps_beside_a_program_that_comes_and_goes(other):
    """All but 8 MiB to 1 GiB is taken for half of each 100 steps. The fit goes on, or ends with class 4 and is continued from
    what it saved; each of the 2000 steps is reported, and the end is finite.
    """
    density = dataclasses.replace(BUSY.density, every=25, stop_fraction=0.9)
    config = dataclasses.replace(BUSY, steps=2000, density=density, max_gaussians=30_000)
    random, states, seen, ended, said = np.random.default_rng(0), [], set(), 0, []

    def on_step(report):
        seen.add(report.step)
        if report.step % 50 == 0:
            states[:] = [saved(fit)]
            other.give_back()
            if report.step % 100 == 50:
                other.take_all_but(int(2 ** random.uniform(3, 10)))

    def restore(_):
        fit.load(*states[-1])
        return True

    fit = Trainer(photos(4, 1200, 900), seeds(), config, CUDA)
    states.append(saved(fit))
    while fit.step < config.steps:
        try:
            run(fit, on_step, lambda f: states.append(saved(f)), lambda: False, restore)
        except ResourceError as e:
            assert e.exit_code == 4
            ended += 1
            other.give_back()
            said += fit.messages
            fit = Trainer(photos(4, 1200, 900), seeds(), config, CUDA)  # as --resume does
            fit.load(*states[-1])
    said += fit.messages
    print(f"ended {ended} times with class 4, went on {len(said)} times")
    assert ended + len(said) > 0
    assert seen == set(range(1, 2001))
    assert all(bool(torch.isfinite(t).all()) for t in fit.gaussians.tensors().values())
