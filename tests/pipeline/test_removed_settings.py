"""Settings of earlier versions: what replaces them, and runs that were stored with them."""

import copy
import json

import pytest

import warpgs
from tests.scenes import photos, seeds
from warpgs.app.cli import main
from warpgs.app.fit import request_of
from warpgs.errors import UsageError
from warpgs.pipeline.paper.strategy import PaperConfig
from warpgs.pipeline.run.folder import CONFIG, check_same, open_run, read_record, stored_request
from warpgs.pipeline.train.presets import PRESETS, preset_settings
from warpgs.pipeline.train.settings import REMOVED, FitConfig, keyword, removed_note, setting_names, upgraded, with_settings
from warpgs.scene import Scene
from warpgs.schema import SchemaError


def old(config: FitConfig, **method) -> dict:
    """Stored settings as version 0.2.0 wrote them, with the values that every fit has now, but for those of ``method``."""
    values = copy.deepcopy(config.to_json())
    for name, (value, _) in REMOVED.items():
        *path, last = name.split(".")
        group = values
        for part in path:
            group = group.setdefault(part, {})
        group[last] = value
    if config.strategy in ("sampling", "paper"):
        values |= {"strategy": "importance_sampling", "strategy_config": None}
    for name, value in method.items():
        group, _, last = name.rpartition("__")
        (values["method"][group] if group else values["method"])[last] = value
    return values


@pytest.mark.parametrize("name", REMOVED)
def test_a_removed_setting_names_what_replaces_it(name, tmp_path):
    """The same sentence for a flag, a key of a TOML file, a mapping and a keyword; no present setting has the name."""
    short = name.removeprefix("priors.")
    note = removed_note(short)
    assert short.replace("_", "-") in note and short not in setting_names(PRESETS["default"])
    group, _, last = short.rpartition(".")
    (tmp_path / "my.toml").write_text(f"[{group}]\n{last} = 1\n" if group else f"{last} = 1\n")
    for given in (lambda: preset_settings(tmp_path / "my.toml"), lambda: preset_settings({short: 1}),
                  lambda: with_settings(FitConfig(), {keyword(short): 1}, "x", keywords=True)):  # fmt: skip
        with pytest.raises(UsageError) as error:
            given()
        assert note in str(error.value)
    with pytest.raises(UsageError) as error:
        request_of(["scene", "--out", "run", f"--{short.replace('_', '-')}", "1"], "")
    assert note in str(error.value)


def test_a_time_between_checkpoints_changes_no_result():
    assert upgraded(FitConfig().to_json() | {"checkpoint_seconds": 0.0}) == (FitConfig().to_json(), [])


def test_flags_that_switched_off_and_the_old_strategy_are_named(capsys):
    for flag, words in (("--density.no-morton-order", "morton-order was removed"), ("--no-cache", "WARPGS_CACHE"),
                        ("--method.no-events", "--strategy clone_split")):  # fmt: skip
        assert main(["fit", "scene", "--out", "run", flag]) == 2
        assert words in capsys.readouterr().err
    with pytest.raises(UsageError, match="now sampling, or paper"):
        with_settings(FitConfig(), {"strategy": "importance_sampling"}, "x")


@pytest.mark.parametrize("preset", ["default", "3dgs", "mcmc"])
def test_stored_settings_are_those_of_the_preset(preset):
    """Without loss, and with the same fingerprint; of a strategy that sampled uniformly, nothing else is left."""
    config = PRESETS[preset]
    values, lost = upgraded(old(config))
    assert not lost and values == config.to_json() and FitConfig.from_json(values) == config
    assert upgraded(config.to_json()) == (config.to_json(), []) and FitConfig.from_json(old(config)) == config
    values["method"]["colour"] = 1
    with pytest.raises(UsageError, match="another version"):
        FitConfig.from_json(values)


def test_strategies_follow_from_the_switches():
    """Scores, a gate, rendered depth or no protection were the paper's; without events it was clone_split."""
    base = PRESETS["paper-literal"]
    paper = {
        "s_render": True,
        "s_semantic": True,
        "s_geometry": True,
        "sampler__depth": "rendered",
        "sampler__gate_quantile": 0.6,
    }
    assert upgraded(old(base, **paper)) == (base.to_json(), [])
    values, lost = upgraded(old(PRESETS["default"], pm=False, importance__residual="gain"))
    config = FitConfig.from_json(values)
    uniform = {"s_render": False, "s_semantic": False, "s_geometry": False, "depth": "consistent", "gate_quantile": 0.0}
    assert (
        not lost and config.strategy == "paper" and config.strategy_config == PaperConfig(**uniform, pm=False, residual="gain")
    )
    values, lost = upgraded(old(PRESETS["default"], events=False))
    assert (values["strategy"], values["strategy_config"], lost) == ("clone_split", None, [])


@pytest.mark.parametrize("value", [None, 5, "x", []])
@pytest.mark.parametrize("group", ["method", "method.importance", "method.sampler", "loss", "priors", "strategy"])
def test_malformed_settings_of_an_earlier_version_are_refused_in_words(group, value):
    """Whatever stands in the place of a group; the stored values stay as they are."""
    values = old(PRESETS["default"])
    *path, last = group.split(".")
    (values[path[0]] if path else values)[last] = value
    before = copy.deepcopy(values)
    with pytest.raises((UsageError, SchemaError)):
        FitConfig.from_json(values)
    assert values == before


def test_other_values_open_with_a_note_and_do_not_resume(tmp_path):
    """A stored value that no fit has now: the model opens, and --resume names the setting."""
    scene = Scene("memory", "none", tuple(photos(3)), points=seeds())
    run = tmp_path / "run"
    warpgs.fit(scene, "quick", steps=3, init_source="points", out=run, device="cpu", verbose=False)
    record = json.loads((run / CONFIG).read_text())
    same = read_record(run)
    record["config"] = old(FitConfig.from_json(record["config"]))
    (run / CONFIG).write_text(json.dumps(record))
    stored = read_record(run)
    assert stored == same and not open_run(run).notes()
    check_same(same, stored, run)
    record["config"]["optimizer"]["quats_lr"] = 0.5
    (run / CONFIG).write_text(json.dumps(record))
    (note,) = open_run(run).notes()
    assert "optimizer.quats-lr 0.5" in note
    for resumed in (lambda: stored_request(run), lambda: check_same(same, read_record(run), run)):
        words = r"--resume: .* does not have: optimizer\.quats-lr 0\.5\. Resume it with the code that began it \(warpgs \d"
        with pytest.raises(UsageError, match=words):
            resumed()
