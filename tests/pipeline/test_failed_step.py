"""A loss that is not finite: the state before it is kept, and a small file computes it again without the scene."""

import dataclasses

import pytest
import torch

import warpgs
from tests.pipeline.test_trainer import BUSY
from tests.scenes import photos, seeds
from warpgs.app.cli import main
from warpgs.errors import DataError, NotFiniteError
from warpgs.pipeline.run.failed_step import FILE, broken_terms, failed_step, findings, read_failed_step, save_failed_step
from warpgs.pipeline.run.folder import TENSORS, load_checkpoint
from warpgs.pipeline.train.loss import LOSS_TERMS, LossTerm, register
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


def test_the_state_before_is_kept_and_the_step_repeats(tmp_path):
    """Checkpoint of the step before, a file that names the term, and the same end where the run is continued."""
    views = tuple(photos(5))
    scene = Scene("", "made", views, seeds(), fingerprint="x", pixels="as made")
    config = dataclasses.replace(BUSY, loss_terms=(NanLater(),), half_resolution=0.5, dropout=0.1)
    split = f"train={','.join(v.name for v in views[:4])};test={views[4].name}"
    run = {"split": split, "device": "cpu", "verbose": False}
    told = r"nan at step 15, on .*\.png, in the loss term nan_later\. .*doctor --repeat .*not_finite.* correct nan_later"
    with pytest.raises(NotFiniteError, match=told) as found:
        warpgs.fit(scene, config, out=tmp_path / "run", **run)
    assert load_checkpoint(tmp_path / "run")[1]["step"] == 14
    bundle = read_failed_step(tmp_path / "run" / FILE, CPU)
    assert (tmp_path / "run" / FILE).stat().st_size < 2 * (tmp_path / "run" / TENSORS).stat().st_size
    lines = findings(bundle)
    assert "loss term nan_later: nan" in "\n".join(lines) and not any("NOT FINITE" in line for line in lines)
    assert any(line.startswith("  loss term photometric: 0.") for line in lines)
    assert any(line.startswith("  rendered depth: ") for line in lines) and not any("rendered alpha" in line for line in lines)
    assert any("gradient with respect to means: not finite" in line for line in lines)
    with pytest.raises(NotFiniteError) as again:
        warpgs.fit(scene, config, out=tmp_path / "run", resume=True, **run)
    assert str(again.value) == str(found.value)


def test_a_term_whose_code_is_not_loaded_is_named(monkeypatch):
    """The step is repeated without it, as in another process than that of the fit."""
    fit = Trainer(photos(4), seeds(), dataclasses.replace(BUSY, loss_terms=(*BUSY.loss_terms, NanLater(first=0))), CPU)
    bundle = failed_step(fit, 0, "x")
    assert broken_terms(bundle) == ["nan_later"]
    monkeypatch.delitem(LOSS_TERMS._classes, "nan_later")
    lines = findings(bundle)
    assert any(line.startswith("  loss term photometric: 0.") for line in lines) and broken_terms(bundle) == []
    assert lines[-1] == "  loss term nan_later: not computed, because it is your own code, which this command does not load"


@pytest.mark.parametrize("learned", [False, True], ids=["", "with poses and exposures"])
def test_the_loss_is_that_of_the_fit(learned):
    """The file's loss is the loss that the next step reports: with the poses and exposures of now, where they are learned."""
    modules = (RefinePoses(rotation_lr=0.01), Exposure(lr=0.05)) if learned else ()
    config = dataclasses.replace(BUSY, dropout=0.3, view_modules=modules)
    fit = Trainer(photos(4), seeds(), config, CPU)
    for _ in range(20):
        fit.advance()
    while not fit.order or fit.order[-1] == 0:  # the first view's pose is not refined
        fit.advance()
    bundle = failed_step(fit, fit.order[-1], "x")
    terms = [line for line in findings(bundle) if "loss term" in line or "view module" in line]
    (report,) = fit.advance()
    assert len(terms) == 1 + learned and sum(float(t.split(": ")[1]) for t in terms) == pytest.approx(report.loss, rel=1e-5)


def test_what_is_not_finite_is_counted(tmp_path, capsys):
    """A NaN in the image, shown by the command that the message names, and a file of another kind."""
    fit = Trainer(photos(4), seeds(), BUSY, CPU)
    bundle = failed_step(fit, 0, "x")
    bundle[0]["image"] = bundle[0]["image"].clone()
    bundle[0]["image"][:2, :3] = torch.nan
    save_failed_step(tmp_path / FILE, bundle)
    assert main(["doctor", "--repeat", str(tmp_path / FILE), "--device", "cpu"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line == "  image: 18 of 3,840 NOT FINITE" for line in lines)
    assert any("photometric: nan" in line for line in lines)
    (tmp_path / "other").write_bytes(b"12345678")
    for name, what in (("other", "not the inputs of a failed step"), ("none", "cannot be read")):
        with pytest.raises(DataError, match=what):
            read_failed_step(tmp_path / name, CPU)
    del bundle[0]["K"]
    with pytest.raises(DataError, match="incomplete"):
        findings(bundle)
