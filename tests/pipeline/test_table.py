"""The table of what training learns: everything that goes by row stays together, whatever happens to the rows."""

import pytest
import torch

from tests.gaussians import cloud
from tests.pipeline.tables import adam_step
from warpgs.errors import DataError, UsageError
from warpgs.pipeline.model.table import Column, DensityUpdate, Table
from warpgs.scene import Gaussians

AGE, SEEN = Column(-1, torch.int32), Column(0.5, inherited=False)


def table(count: int = 5, gaussians: Gaussians | None = None) -> Table:
    """A table after one step, so that all moments differ from 0, with a number of its own in each row of two columns."""
    made = Table.of_gaussians(cloud(count) if gaussians is None else gaussians, {"age": AGE, "seen": SEEN})
    generator = torch.Generator().manual_seed(1)
    adam_step(made, {n: torch.randn(t.shape, generator=generator) for n, t in made.params.items()})
    made.columns["age"] = torch.arange(10, 10 + len(made), dtype=torch.int32)
    made.columns["seen"] = torch.arange(0.0, len(made))
    return made


def snapshot(made: Table) -> dict[str, torch.Tensor]:
    return {n: t.clone() for n, t in made.state().items()}


def update(keep, added: dict, parents, **more) -> DensityUpdate:
    return DensityUpdate(torch.tensor(keep, dtype=torch.int64), added, torch.tensor(parents, dtype=torch.int64), **more)


def test_a_step_that_is_skipped_changes_no_bit():
    """Neither parameters nor moments; the step itself changes all of them."""
    made = table()
    before = snapshot(made)
    gradients = {n: torch.ones_like(t) for n, t in made.params.items()}
    adam_step(made, gradients, step=2, skip=1)
    assert all(torch.equal(t, before[n]) for n, t in made.state().items())
    adam_step(made, gradients, step=2)
    assert not any(torch.equal(t, before[n]) for n, t in made.state().items() if not n.startswith("columns"))


def test_kept_rows_keep_everything_and_new_rows_start_anew():
    """Survivors keep parameters, moments and columns bit for bit; new rows have the given parameters and moments of 0."""
    made = table()
    before, keep = snapshot(made), [0, 3, 4]
    added = {n: t[:2] + 1 for n, t in cloud(5).tensors().items()}
    made.apply(update(keep, added, [-1, -1]))
    assert len(made) == 5
    for name, t in made.state().items():
        assert torch.equal(t[:3], before[name][keep]), name
        group, _, short = name.partition(".")
        if group == "params":
            assert torch.equal(t[3:], added[short])
        elif group != "columns":
            assert bool(before[name].any()) and not bool(t[3:].any())
    assert all(t.requires_grad and t.is_leaf and t.is_contiguous() for t in made.params.values())


def test_rows_are_dropped_without_new_ones():
    """A change that only keeps rows needs nothing else."""
    made = table()
    adam_step(made, {n: torch.ones_like(t) for n, t in made.params.items()})
    before = snapshot(made)
    made.apply(DensityUpdate(torch.tensor([0, 3])))
    assert len(made) == 2 and all(torch.equal(t, before[n][[0, 3]]) for n, t in snapshot(made).items())


def test_columns_are_inherited_or_filled():
    """By the parent where there is one and the column is inherited, else by what the change says, else by the fill."""
    made = table()
    added = {n: t[:3] for n, t in cloud(5).tensors().items()}
    made.apply(update([4, 0], added, [3, -1, 0]))
    assert made.columns["age"].tolist() == [14, 10, 13, -1, 10]
    assert made.columns["seen"].tolist() == [4, 0, 0.5, 0.5, 0.5]
    made.apply(update([0], added, [2, -1, -1], columns={"age": 99, "seen": 7}))
    assert made.columns["age"].tolist() == [14, 13, 99, 99] and made.columns["seen"].tolist() == [4, 7, 7, 7]
    assert made.columns["age"].dtype is torch.int32 and made.columns["seen"].dtype is torch.float32


def test_overwritten_rows_start_again_before_rows_come_and_go():
    """Numbers are those before the change; what is not named stays as it is, all moments of the row are 0, columns stay."""
    made = table()
    before = snapshot(made)
    means = torch.full((2, 3), 7.0)
    nothing = {n: t[:0] for n, t in cloud(5).tensors().items()}
    change = update([0, 2, 3, 4], nothing, [], overwritten=torch.tensor([1, 3]), values={"means": means})
    made.apply(change)
    after, kept = made.state(), [0, 2, 3, 4]
    assert after["params.means"][2].tolist() == [7, 7, 7]
    for name, t in after.items():
        same = [0, 1, 3] if name == "params.means" or name.startswith("exp_avg") else [0, 1, 2, 3]
        assert torch.equal(t[same], before[name][kept][same]), name
        if name.startswith("exp_avg"):
            assert bool(before[name][3].any()) and not bool(t[2].any()), name


def test_rows_are_reordered_together():
    """Parameters, moments and columns, by an order that is no sort of its own."""
    made = table()
    before, order = snapshot(made), torch.tensor([3, 0, 4, 2, 1])
    made.reorder(order)
    assert all(torch.equal(t, before[n][order]) for n, t in made.state().items())
    assert all(t.requires_grad and t.is_leaf for t in made.params.values())


def test_opacity_reset_caps_and_forgets():
    """No opacity stays above the cap, lower ones stay, and the moments of opacities, and of nothing else, are zero."""
    g = cloud(2)
    g.logit_opacities[:] = torch.logit(torch.tensor([0.9, 0.004]))
    made = table(gaussians=g)
    before = snapshot(made)
    made.reset_opacities(0.01)
    opacities = made.params["logit_opacities"].detach().sigmoid()
    assert abs(float(opacities[0]) - 0.01) < 1e-6 and float(opacities[1]) < 0.0045
    for name, t in made.state().items():
        if name.endswith("logit_opacities"):
            assert name.startswith("params") or not bool(t.any())
        else:
            assert torch.equal(t, before[name])


def test_state_comes_back_bit_for_bit():
    """Into a table of another number of rows, and the next step is the same; a missing tensor is an error, not a default."""
    made, again = table(7), table(3)
    state = snapshot(made)
    again.load(state)
    assert len(again) == 7 and again.state().keys() == state.keys() and len(state) == 15 + 2
    for each in (made, again):
        adam_step(each, {n: torch.ones_like(t) for n, t in each.params.items()}, step=2)
    assert all(torch.equal(t, again.state()[n]) for n, t in made.state().items())
    assert all(t.requires_grad and t.is_leaf for t in again.params.values())
    del state["columns.age"]
    with pytest.raises(DataError, match=r"columns\.age"):
        again.load(state)


def test_a_table_may_have_no_parameters():
    """That of views, where no loss term asks for any: a number of rows and nothing to step, save or load."""
    empty = Table({}, {}, torch.device("cpu"), 3)
    adam_step(empty, {})
    empty.load(empty.state())
    assert len(empty) == 3 and empty.state() == {}


def test_a_change_that_is_not_whole_is_refused():
    """A row without a parent's number, or a parameter without rows: said before anything changes."""
    made = table(4)
    before = snapshot(made)
    added = {n: t.detach()[:2] for n, t in made.params.items()}
    for bad, parents in ((added, 1), ({n: t for n, t in added.items() if n != "sh"}, 2)):
        with pytest.raises(UsageError, match="one row for each entry of parents"):
            made.apply(DensityUpdate(torch.arange(4), bad, torch.full((parents,), -1)))
    assert all(torch.equal(t, before[n]) for n, t in made.state().items()) and len(made) == 4
