"""Images and figures of sampling events: they show what the event saw, and say what it did."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from tests.scenes import photos, priors, seeds
from warpgs.errors import ResourceError
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.paper.strategy import PaperConfig
from warpgs.pipeline.run import results
from warpgs.pipeline.run.folder import load_checkpoint, save_checkpoint
from warpgs.pipeline.run.results import SHEET_WIDTH, event_figures, images_kept, sampling_report_of, shown_steps, view_sheet
from warpgs.pipeline.train.schedule import PhaseConfig, plan_phases
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies import sampling
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.sampling import MethodConfig, SamplerConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.report.images import CONTACT_GAP, CONTACT_HEAD, CONTACT_MARGIN, DOT, TITLE_SIZE, colored, webp

CPU = torch.device("cpu")
NAMES = ["00.png", "01.png", "02.png"]
METHOD = MethodConfig(hier=True, sampler=SamplerConfig(fraction=0.01))
CONFIG = FitConfig(
    steps=40, sh_every=10, dropout=0.2, init=InitConfig(source="points"), sh_degree=1, strategy="paper",
    density=DensityConfig(start=2, every=8, gradient=1e-5), phases=PhaseConfig(160, 240), method=METHOD,
)  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def tiny():
    """Three Gaussians are hardly opaque, and fits of 40 steps have no time for long protection."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampling, "MIN_ALPHA", 0.05)
        patch.setattr(sampling, "PROTECTED_STEPS", 10)
        yield


def fitted(config: FitConfig, steps: int) -> Trainer:
    """Some steps of a fit of three views."""
    views = photos(3)
    fit = Trainer(views, seeds(), config, CPU, priors=priors(views))
    for _ in range(steps):
        fit.advance()
    return fit


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished fit with its folder, and the first event."""
    out, seen = tmp_path_factory.mktemp("run"), []
    views = photos(3)
    fit = Trainer(views, seeds(), CONFIG, CPU, priors=priors(views))
    with images_kept(fit, NAMES, out):
        draw = fit.strategy.on_event
        fit.strategy.on_event = lambda step, event: (draw(step, event), seen.append((step, event)))
        while fit.step < CONFIG.steps:
            fit.advance()
    return fit, out, seen


def tile(sheet: np.ndarray, index: int, view, text: float = 1.25, width: int = 320) -> np.ndarray:
    """The pixels of one tile of a sheet of five columns."""
    height = round(width * view.camera.height / view.camera.width)
    head, top = round(text * CONTACT_HEAD), CONTACT_MARGIN + round(text * TITLE_SIZE) + 18
    x, y = CONTACT_MARGIN + index % 5 * (width + CONTACT_GAP), top + head + index // 5 * (head + height + CONTACT_GAP)
    return sheet[y : y + height, x : x + width]


def test_two_events_are_shown_steps():
    """The first, and the first of the second half of phase 2; the same one where there is but one; none without events."""
    phases = plan_phases(PhaseConfig(2000, 3000), 10_000)
    first, middle = sorted(shown_steps(phases))
    assert first == 2000 and 4500 <= middle < 4800 and middle in phases.events
    assert shown_steps(dataclasses.replace(phases, events=(2000,))) == {2000}
    assert shown_steps(dataclasses.replace(phases, events=())) == set()


def test_pictures_lie_in_the_run_folder(run):
    """A picture per pictured event with a sheet for each of the three views, and no other file."""
    fit, out, _ = run
    files = sorted((out / "sampling").iterdir())
    assert [int(f.stem) for f in files] == sorted(shown_steps(fit.phases)) and len(files) == 2
    first = cv2.imread(str(files[0]))
    assert first.shape[0] % 3 == 0 and first.shape[1] == 2 * CONTACT_MARGIN + 5 * 320 + 4 * CONTACT_GAP


def test_tiles_show_what_the_event_saw(run):
    """Each map in its place, values as colours; dots at the drawn pixels and nowhere else; the gate in two colours."""
    fit, _, seen = run
    step, event = seen[0]
    drawn, view = event.views[1], fit.views[1]
    sheet = view_sheet("01.png", step, view, fit.disparities[1], drawn, fit.strategy)
    big = {i: tile(sheet, i, view) for i in range(9)}
    H, W = view.camera.height, view.camera.width
    rows, columns = (((np.arange(n) + 0.5) * big[0].shape[i] / n).astype(int) for i, n in ((0, H), (1, W)))
    small = {i: t[rows][:, columns] for i, t in big.items()}
    np.testing.assert_allclose(small[0], drawn.rendered.numpy().clip(0, 1), atol=0.02)
    np.testing.assert_allclose(small[1], view.image.numpy(), atol=0.02)
    for i, score in zip((5, 6, 7, 8), drawn.scores.values(), strict=True):
        assert np.abs(small[i] - colored(score.numpy(), "INFERNO")).mean() < 0.02, i
    assert np.abs(small[2] - colored(fit.disparities[1], "TURBO")).mean() < 0.03
    gate = drawn.gate.numpy()
    assert 0.05 < gate.mean() < 0.95 and np.array_equal(small[3].mean(-1) > 0.5, gate)
    marked = np.abs(small[4] - np.float32(DOT) / 255).max(-1) < 0.02
    wanted = np.zeros((H, W), bool)
    wanted[tuple(drawn.at.T.numpy())] = True
    assert wanted.sum() == len(drawn.at) > 5 and np.array_equal(marked, wanted)


def test_uniform_events_show_no_scores(tmp_path):
    """Nor a disparity, as no prior was made; the words say that nothing was scored."""
    fit, seen = Trainer(photos(3), seeds(), dataclasses.replace(CONFIG, strategy="sampling"), CPU), []
    with images_kept(fit, NAMES, tmp_path):
        fit.strategy.on_event = lambda step, event: seen.append(event)
        while not seen:
            fit.advance()
    drawn, view = seen[0].views[1], fit.views[1]
    assert fit.disparities == [] and not drawn.scores
    sheet = view_sheet("01.png", 8, view, None, drawn, fit.strategy)
    one_row = (
        tile(np.zeros((10**4, 10**4)), 0, view).shape[0]
        + round(1.25 * CONTACT_HEAD)
        + 2 * CONTACT_MARGIN
        + round(1.25 * TITLE_SIZE)
        + 18
    )
    assert sheet.shape[0] == one_row  # render, image, gate, pixels, words
    words = sampling_report_of(fit, tmp_path).words
    assert "uniformly at random" in words and "All scores have weight 0, so no score is shown." in words


def test_figures_add_up(run):
    """Counts are those of the fit's own list; layers make up the set."""
    fit, _, seen = run
    figures = event_figures(fit)
    assert figures["events"] == {
        "count": len(seen), "added": sum(len(e.change.parents) for _, e in seen), "evicted": sum(e.evicted for _, e in seen),
        "samplings": 3 * len(seen), "widened": sum(v.quantile < 0.6 for _, e in seen for v in e.views),
    }  # fmt: skip
    assert figures["events"]["added"] > 0 and sum(figures["layers"].values()) == len(fit.gaussians)
    assert figures["layers"]["fine"] == int(fit.strategy.fine.sum()) > 0


def test_story_follows_the_switches(run, tmp_path):
    """What is said of gate, draw and depth is what was asked for, and a widened gate is told; no events, no story."""
    fit, out, _ = run
    (out / "sampling" / "own.png").write_bytes(b"an image of the user's own")
    story = sampling_report_of(fit, out)
    (out / "sampling" / "own.png").unlink()
    assert "sampled at random" in story.words and "above its 0.6 quantile" in story.words and "rendered depth" in story.words
    assert [c for c, _ in story.images] == [f"sampling after step {s}" for s in sorted(shown_steps(fit.phases))]
    assert story.images[0][1] == webp(next(iter(sorted((out / "sampling").iterdir()))).read_bytes(), SHEET_WIDTH, 70)
    assert dict(zip(*story.table))["sampling events"] == str(len(fit.strategy.events))
    method = dataclasses.replace(METHOD, sampler=dataclasses.replace(METHOD.sampler, fraction=0.2))
    base, own = dataclasses.replace(CONFIG, method=method), PaperConfig(agp=False, depth="consistent")
    other = fitted(dataclasses.replace(base, strategy_config=own), steps=8)
    words = sampling_report_of(other, tmp_path).words
    assert "the highest in S_importance" in words and "other views confirm and with S_geometry" in words
    assert "In 3 of 3 samplings the gate was widened" in words and "widened" not in story.words
    free = fitted(dataclasses.replace(base, strategy_config=dataclasses.replace(own, ra=False)), steps=8)
    assert "all pixels that Gaussians cover" in sampling_report_of(free, tmp_path).words
    alike = PaperConfig(s_render=False, s_semantic=False, s_geometry=False)
    words = sampling_report_of(fitted(dataclasses.replace(CONFIG, strategy_config=alike), steps=8), tmp_path).words
    assert "sampled uniformly at random" in words and "All scores have weight 0" in words
    assert (
        sampling_report_of(fitted(dataclasses.replace(CONFIG, strategy="clone_split", strategy_config=None), steps=1), tmp_path)
        is None
    )


def test_first_picture_outlives_a_continuation(run, tmp_path):
    """Stopped after the first event and continued: the same pictures, byte for byte, as of the fit that never stopped."""
    views = photos(3)

    def go_on(until: int, begin=None) -> Trainer:
        fit = Trainer(views, seeds(), CONFIG, CPU, priors=priors(views))
        if begin is not None:
            fit.load(*begin)
        with images_kept(fit, NAMES, tmp_path) as images_written:
            while fit.step < until:
                fit.advance()
            images_written()
            assert len(list((tmp_path / "sampling").glob("*.png"))) == (1 if begin is None else 2)
        return fit

    save_checkpoint(tmp_path, *go_on(10).state())
    assert len(list((tmp_path / "sampling").iterdir())) == 1
    go_on(CONFIG.steps, load_checkpoint(tmp_path))
    straight, continued = ({f.name: f.read_bytes() for f in (d / "sampling").iterdir()} for d in (run[1], tmp_path))
    assert straight == continued and len(straight) == 2


@pytest.mark.parametrize("cause", ["folder", "disk"])
def test_images_that_cannot_be_written_end_no_fit(tmp_path, monkeypatch, cause):
    """A file stands where their folder should be, or the disk is full: said once, and the fit takes all its steps."""

    def full(path, data):
        raise ResourceError(f"{path.name}: no space left")

    if cause == "disk":
        monkeypatch.setattr(results, "write_bytes", full)
    else:
        (tmp_path / "sampling").write_text("in the way")
    views = photos(3)
    fit = Trainer(views, seeds(), CONFIG, CPU, priors=priors(views))
    with images_kept(fit, NAMES, tmp_path):
        while fit.step < CONFIG.steps:
            fit.advance()
    assert fit.strategy.on_event is None and len(fit.messages) == 1
    assert "images of sampling events are missing from the report" in fit.messages[0]
    assert ("no space left" if cause == "disk" else "cannot be created") in fit.messages[0]


def test_an_error_of_ours_in_an_image_is_not_hidden(tmp_path, monkeypatch):
    """Only what the disk does is a note."""
    monkeypatch.setattr(results, "write_bytes", lambda path, data: 1 / 0)
    views = photos(3)
    fit = Trainer(views, seeds(), CONFIG, CPU, priors=priors(views))
    with pytest.raises(ZeroDivisionError), images_kept(fit, NAMES, tmp_path):
        while fit.step < CONFIG.steps:
            fit.advance()
