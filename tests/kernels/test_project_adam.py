"""Projection's backward pass with Adam in one kernel, against the two one after the other."""

import pytest
import torch

from tests.splats import SMOOTH, camera, cloud, hand_placed, leaves
from warpgs.constants import RULES
from warpgs.kernels.adam import adam_step, scheduled_rates
from warpgs.kernels.project import project
from warpgs.kernels.project_adam import project_adam
from warpgs.scene import Gaussians

RATES = {"means": 3e-3, "quats": 2e-3, "log_scales": 1e-2, "logit_opacities": 5e-2, "sh": 1e-3}
HEAD_RATE = 0.02
"""Learning rate of the constant coefficient."""


class State:
    """Parameters and moments, and the two ways to take a step from given gradients of the records."""

    def __init__(self, gaussians, cam, degree, rule=SMOOTH):
        self.params = {n: t.detach().clone() for n, t in gaussians.tensors().items()}
        generator = torch.Generator().manual_seed(5)
        self.means, self.squares = {}, {}
        for n, t in self.params.items():  # moments as of some steps before, so that what is not seen moves too
            self.means[n] = (0.01 * torch.randn(t.shape, generator=generator)).to(t)
            self.squares[n] = (0.01 * torch.rand(t.shape, generator=generator)).to(t)
        self.cam, self.degree, self.rule = cam, degree, rule

    def copy(self):
        other = State(Gaussians(**self.params), self.cam, self.degree, self.rule)
        for mine, its in ((self.means, other.means), (self.squares, other.squares)):
            its.update({n: t.clone() for n, t in mine.items()})
        return other

    def all(self):
        return {f"{kind}.{n}": t for kind in ("params", "means", "squares") for n, t in getattr(self, kind).items()}

    def project(self, gaussians):
        size = {"width": self.cam.width, "height": self.cam.height, "degree": self.degree, "rule": self.rule}
        return project(*gaussians.tensors().values(), self.cam.viewmat, self.cam.K, **size)

    def upstream(self, step):
        shape, like = (1, len(self.params["means"]), 12), self.params["means"]
        return torch.randn(shape, generator=torch.Generator().manual_seed(step), dtype=torch.float64).to(like)

    def apart(self, step, share=None):
        """Autograd, then Adam tensor by tensor."""
        gaussians, before = leaves(Gaussians(**self.params)), self.params["means"].clone()
        splats, counts = self.project(gaussians)
        gradients = torch.autograd.grad(splats, list(gaussians.tensors().values()), self.upstream(step))
        for (n, p), g in zip(self.params.items(), gradients):
            head = {"head": 3, "head_lr": HEAD_RATE} if n == "sh" else {}
            adam_step(p, g, self.means[n], self.squares[n], lr=RATES[n], step=step, **head)
        if share is not None:
            means = self.params["means"]
            means.copy_(torch.where(share[:, None] == 1, means, before + share[:, None] * (means - before)))
        return counts

    def fused(self, step, share=None, skip=0, **changes):
        like = self.params["means"]
        splats, counts = self.project(Gaussians(**self.params))
        rates = [scheduled_rates(r, step, head_lr=HEAD_RATE if n == "sh" else None) for n, r in RATES.items()]
        how = {
            "width": self.cam.width, "height": self.cam.height, "degree": self.degree, "rule": self.rule, "share": share,
            "rates": torch.tensor(rates, dtype=torch.float64).view(-1).to(like),
            "skip": torch.tensor([skip], dtype=torch.int32, device=like.device),
        }  # fmt: skip
        project_adam(
            self.params, self.means, self.squares, self.cam.viewmat, self.cam.K, splats, counts, self.upstream(step),
            **(how | changes),
        )  # fmt: skip


def agree(found: State, wanted: State, before: State):
    """Up to rounding: compilers fuse products with sums in one kernel and not in another, on CUDA those of gradients too."""
    for name, a in found.all().items():
        b, old = wanted.all()[name], before.all()[name]
        if a.is_cuda:  # float32 over 20 steps: 1.7e-4 of the way (1400 eps); float64 was not measured, only held to it
            assert float((a - b).norm()) <= 8400 * torch.finfo(a.dtype).eps * float((b - old).norm()), name
        else:  # measured: 1.0 ulp
            size = torch.maximum(b.abs(), old.abs())
            if name.startswith("params"):
                size = size + (b - old).abs().max()
            assert bool(((a - b).abs() <= 4 * torch.finfo(a.dtype).eps * size).all()), name


@pytest.mark.parametrize("degree, stored", [(0, 0), (0, 1), (1, 1), (2, 2), (1, 3), (3, 3)])
def test_steps_equal_gradients_and_then_adam(device, dtype, degree, stored):
    """Several steps from the same state: all tensors, all moments, among them those of Gaussians that no pixel shows."""
    gaussians, cam = cloud(300, dtype, device, degree=stored), camera(96, 80, 1, dtype, device)
    state = State(gaussians, cam, degree, RULES["exact"])
    for step in range(1, 6):
        before, fused = state.copy(), state.copy()
        fused.fused(step)
        counts = state.apart(step)
        assert 20 < int((counts > 0).sum()) < 280
        agree(fused, state, before)
        unseen = counts[0] == 0
        assert not torch.equal(fused.params["means"][unseen], before.params["means"][unseen])


@pytest.mark.parametrize("count", [1, 127, 129])
def test_every_row_of_a_block_is_updated(device, dtype, count):
    """Sets that end within a block, and rows of 27 numbers, which cross pieces of four."""
    gaussians, cam = cloud(count, dtype, device, degree=2), camera(40, 32, 1, dtype, device)
    state = State(gaussians, cam, 2)
    before, fused = state.copy(), state.copy()
    fused.fused(1)
    state.apart(1)
    agree(fused, state, before)


def test_means_take_their_share_of_a_step(device, dtype):
    """None, half and all of it; and all of it to the bit where the share is 1."""
    gaussians, cam = cloud(300, dtype, device), camera(40, 32, 1, dtype, device)
    share = torch.tensor([0.0, 0.5, 1.0], dtype=dtype, device=device).repeat(100)
    state = State(gaussians, cam, 1)
    before, fused, whole = state.copy(), state.copy(), state.copy()
    fused.fused(2, share)
    whole.fused(2)
    state.apart(2, share)
    agree(fused, state, before)
    assert torch.equal(fused.params["means"][0::3], before.params["means"][0::3])
    assert torch.equal(fused.params["means"][2::3], whole.params["means"][2::3])
    assert not torch.equal(fused.params["means"][1::3], whole.params["means"][1::3])


def test_skipped_step_changes_nothing(device, dtype):
    """Any flag but 0 leaves all as it was, to the bit."""
    state = State(cloud(200, dtype, device), camera(40, 32, 1, dtype, device), 1)
    for flag in (1, 2):
        other = state.copy()
        other.fused(1, skip=flag)
        assert all(torch.equal(t, state.all()[n]) for n, t in other.all().items())


def test_only_coefficients_have_a_head(device, dtype):
    """The first of the three rates of the other tensors is not looked at."""
    state = State(cloud(150, dtype, device), camera(40, 32, 1, dtype, device), 1)
    found, wanted = state.copy(), state.copy()
    rates = torch.tensor([scheduled_rates(0.01, 1) for _ in RATES], dtype=dtype, device=device)
    wanted.fused(1, rates=rates.view(-1))
    rates[:4, 0] = torch.nan
    found.fused(1, rates=rates.view(-1))
    assert all(torch.equal(t, wanted.all()[n]) for n, t in found.all().items())


def test_clamped_colours_and_jacobians(device, dtype):
    """Where the colour is clamped at zero or the mean lies far outside the image, the gradients are still those."""
    gaussians = hand_placed(dtype, device)
    gaussians.sh[:3, 0] = -3
    state = State(gaussians, camera(40, 32, 1, dtype, device), 3)
    before, fused = state.copy(), state.copy()
    fused.fused(1)
    counts = state.apart(1)
    assert bool((counts > 0).all())
    agree(fused, state, before)


def test_gradient_that_is_no_number_is_not_hidden(device):
    """A NaN in a record's gradient reaches the parameters, as it does apart."""
    state = State(cloud(64, device=device), camera(40, 32, 1, torch.float32, device), 1)
    state.upstream = lambda step: torch.full((1, 64, 12), torch.nan, device=device)
    fused = state.copy()
    fused.upstream = state.upstream
    fused.fused(1)
    state.apart(1)
    for name, t in fused.all().items():
        assert torch.equal(t.isnan(), state.all()[name].isnan()), name
    assert bool(fused.params["means"].isnan().any())


def test_threads_do_not_change_the_bits():
    """One thread and two give the same."""
    state = State(cloud(3000), camera(40, 32, 1, torch.float32), 1)
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        results.append(state.copy())
        results[-1].fused(1)
    assert all(torch.equal(t, results[1].all()[n]) for n, t in results[0].all().items())


def test_empty_and_bad_input():
    """No Gaussians are fine; a wrong shape, an odd layout or too high a degree is refused, and names what it is about."""
    State(cloud(0), camera(40, 32, 1, torch.float32), 1).fused(1)
    state = State(cloud(8), camera(40, 32, 1, torch.float32), 1)
    with pytest.raises(ValueError, match="rates"):
        state.fused(1, rates=torch.zeros(14))
    with pytest.raises(ValueError, match="share"):
        state.fused(1, share=torch.ones(7))
    with pytest.raises(ValueError, match="degree 2 needs 9"):
        state.fused(1, degree=2)
    state.means["quats"] = torch.zeros(4, 8).T
    with pytest.raises(ValueError, match="quats of exp_avgs is updated in place and must be contiguous"):
        state.fused(1)
