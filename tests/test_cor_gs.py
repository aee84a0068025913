"""The baseline of docs/add-a-baseline.md: two models, pruned and regularised where they disagree."""

import dataclasses
import re
import sys
from pathlib import Path

import pytest
import torch

from tests.pipeline.train.fits import advanced
from tests.scenes import photos, seeds
from warpgs import rasterize
from warpgs.errors import UsageError
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train.presets import preset_settings
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer

CPU = torch.device("cpu")
FILE = Path(__file__).parent.parent / "examples" / "11_cor_gs.py"
NAME = f"{FILE}:CorGS"


pytestmark = pytest.mark.usefixtures("registries_as_they_were")


def test_the_files_of_the_page_are_a_preset(tmp_path, monkeypatch):
    """A loss term and a strategy in one preset, each with a setting; the fit takes a step in which the strategy acts."""
    monkeypatch.chdir(tmp_path)
    page = (FILE.parent.parent / "docs" / "add-a-baseline.md").read_text("utf-8")
    for kind, name in (("toml", "rule.toml"), ("python", "my.py")):
        (code,) = re.findall(rf"^```{kind}\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
        Path(name).write_text(code, "utf-8")
    config, _ = preset_settings("my.py:mine")
    (term,) = config.loss_terms
    assert (config.init.source, config.strategy_config.every, term.weight) == ("sweep", 50, 0.02)
    own = dataclasses.replace(config.strategy_config, every=2, min_opacity=0.09)
    init = InitConfig(source="points")
    config = dataclasses.replace(config, steps=4, init=init, sh_degree=0, background="black", strategy_config=own)
    trainer = Trainer(photos(3), seeds(), config, CPU)
    count = len(trainer.gaussians)
    assert 0 < len(advanced(trainer, 4).gaussians) < count


@pytest.fixture
def module():
    return sys.modules[STRATEGIES.load(NAME).__module__]


def fit(module, steps: int = 12, views: int = 3, gradient: float = 1e-5, **own) -> Trainer:
    """Return a fit at step 0 that refines every 4 steps and co-prunes every 6."""
    config = FitConfig(
        steps=steps, init=InitConfig(source="points"), sh_degree=0, strategy=NAME,
        density=DensityConfig(start=2, every=4, stop_fraction=1.0, gradient=gradient),
        strategy_config=module.CorConfig(**({"every": 6} | own)),
    )  # fmt: skip
    return Trainer(photos(views), seeds(), config, CPU)


def test_a_continued_fit_equals_an_uninterrupted_one(module):
    """Both models, bit for bit: their Gaussians, moments and statistics, and the random cameras to come."""
    whole, half = advanced(fit(module), 10), advanced(fit(module), 5)
    again = fit(module)
    again.load(*half.state())
    (tensors, plain), (others, rest) = whole.state(), advanced(again, 10).state()
    assert plain == rest and tensors.keys() == others.keys()
    assert all(torch.equal(t, others[n]) for n, t in tensors.items())
    assert any(n.startswith("twin.") for n in tensors)


def error(trainer: Trainer, table) -> float:
    options = trainer.context.render_options()
    with torch.no_grad():
        return sum(float((rasterize(table.gaussians, v.camera, options).rgb - v.image).abs().mean()) for v in trainer.views)


def test_models_differ_and_learn(module):
    """Both are trained on the same views, in an order of their own; the term is zero where models agree, as at first."""
    trainer = fit(module, steps=40, gradient=1.0)
    ours, twin = trainer.table, trainer.strategy.twin.table
    before = error(trainer, ours)
    assert error(trainer, twin) == before
    advanced(trainer, 40)
    assert len(twin) == len(ours) and not torch.equal(twin.params["means"], ours.params["means"])
    assert max(error(trainer, ours), error(trainer, twin)) < 0.8 * before
    trainer = fit(module)
    assert float(trainer.strategy.regularisation(False, trainer.gaussians).detach()) == pytest.approx(0, abs=1e-6)
    with torch.no_grad():
        trainer.strategy.twin.table.params["sh"] += 0.5
    assert float(trainer.strategy.regularisation(False, trainer.gaussians).detach()) > 0.01


def test_gaussians_without_a_neighbour_are_pruned_in_both_models(module):
    """One that stands alone in either model is gone after co-pruning, and no other is."""
    trainer = fit(module)
    strategy, table = trainer.strategy, trainer.table
    counts = len(table), len(strategy.twin.table)
    with torch.no_grad():
        table.params["means"][3] += 100 * trainer.context.extent
        strategy.twin.table.params["means"][5] -= 100 * trainer.context.extent
    for change in strategy.update(6):
        table.apply(change)
    assert strategy.prunes(6) and not strategy.prunes(4)
    assert (len(table), len(strategy.twin.table)) == (counts[0] - 1, counts[1] - 1)
    for means in (t.params["means"].detach() for t in (table, strategy.twin.table)):
        assert float(means.abs().max()) < 50 * trainer.context.extent


def test_random_cameras_stay_near_the_training_cameras(module):
    """Rotations are rotations; without noise the position is that of a training camera."""
    views = fit(module).views
    centers = torch.stack([torch.as_tensor(v.camera.center) for v in views]).double()
    for viewmat in module.random_cameras(views, 0.0, 5, torch.Generator().manual_seed(1)):
        R, t = viewmat[:3, :3], viewmat[:3, 3]
        torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), atol=1e-6, rtol=0)
        assert float(torch.det(R)) > 0 and float((centers + R.T @ t).norm(dim=1).min()) < 1e-5
    near, far = (module.random_cameras(views, n, 50, torch.Generator().manual_seed(1))[:, :3, 3] for n in (0.1, 1.0))
    assert far.std() > near.std()
    # one view has no neighbour; transparent views have a random background, which two renders would not share
    with pytest.raises(UsageError, match="at least two opaque"):
        fit(module, views=1)
    config = fit(module).config
    cut_out = [dataclasses.replace(v, alpha=v.image[..., 0]) for v in photos(3)]
    with pytest.raises(UsageError, match="at least two opaque"):
        Trainer(cut_out, seeds(), config, CPU)
