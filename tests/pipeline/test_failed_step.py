"""A loss that is not finite: the state before it is kept, and the error names step, view, term and tensors."""

import dataclasses

import pytest
import torch

import warpgs
from tests.pipeline.test_trainer import BUSY
from tests.scenes import photos, seeds
from warpgs.errors import NotFiniteError
from warpgs.pipeline.run.fit import non_finite_parts
from warpgs.pipeline.run.folder import load_checkpoint
from warpgs.pipeline.train.loss import LossTerm, register
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.view_modules import Exposure, RefinePoses
from warpgs.scene import Scene

CPU = torch.device("cpu")


@register("nan_later")
@dataclasses.dataclass(frozen=True)
class NanLater(LossTerm):
    """A term on depth that is no number from some step on, by the number on the device."""

    needs_outputs = ("depth",)
    first: int = 15

    def __call__(self, inputs):
        return inputs.outputs["depth"].mean() * torch.where(inputs.step < self.first, 0.0, float("nan"))


def test_the_state_before_is_kept_and_the_error_names_the_term(tmp_path):
    """Checkpoint of the step before, the same end where the run is continued, and the same words without a folder."""
    views = tuple(photos(5))
    scene = Scene("", "made", views, seeds(), fingerprint="x", pixels="as made")
    config = dataclasses.replace(BUSY, loss_terms=(NanLater(),), half_resolution=0.5, dropout=0.1)
    split = f"train={','.join(v.name for v in views[:4])};test={views[4].name}"
    run = {"split": split, "device": "cpu", "verbose": False}
    told = r"nan at step 15, on .*\.png, in the loss term nan_later; all of its inputs and renders are finite\."
    with pytest.raises(NotFiniteError, match=told + r" .* saved in .*--resume would fail .* correct nan_later") as found:
        warpgs.fit(scene, config, out=tmp_path / "run", **run)
    assert load_checkpoint(tmp_path / "run")[1]["step"] == 14
    assert not list((tmp_path / "run").glob("not_finite*"))
    with pytest.raises(NotFiniteError) as again:
        warpgs.fit(scene, config, out=tmp_path / "run", resume=True, **run)
    assert str(again.value) == str(found.value)
    with pytest.raises(NotFiniteError, match=told + r" To fix it, correct nan_later, and fit again$"):
        warpgs.fit(scene, config, **run)


@pytest.mark.parametrize("learned", [False, True], ids=["", "with poses and exposures"])
def test_tensors_that_are_not_finite_are_counted(learned):
    """Nothing in a sound step; then a NaN in the image of one view alone, and one in a parameter."""
    modules = (RefinePoses(rotation_lr=0.01), Exposure(lr=0.05)) if learned else ()
    fit = Trainer(photos(4), seeds(), dataclasses.replace(BUSY, dropout=0.3, view_modules=modules), CPU)
    for _ in range(3):
        fit.advance()
    before = fit.state()[0]
    assert non_finite_parts(fit, 1, 0) == ([], [])
    kind, row = fit.places[1 + fit.plan_of(4).half_size * len(fit.views)]
    image = fit.stacks[kind].images[row]
    image[:2, :3] = torch.nan
    terms, tensors = non_finite_parts(fit, 1, 0)
    assert terms == ["the loss term photometric"] and tensors == [f"image (18 of {image.numel():,} values)"]
    assert non_finite_parts(fit, 2, 0) == ([], [])
    assert all(torch.equal(t, before[n]) for n, t in fit.state()[0].items())
    if learned:
        fit.learned.views.table.params["exposure_affine"].data[2] = torch.nan
        terms, tensors = non_finite_parts(fit, 2, 0)
        assert "the loss term photometric" in terms and "the view module exposure" in terms
        assert {t.split(" (")[0] for t in tensors} == {"views.exposure_affine", "rendered rgb"}
