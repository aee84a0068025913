"""Settings of a fit: presets, files, mappings and keywords, all checked; those chosen for the user; those of old versions."""

import copy
import dataclasses
import functools
import inspect
import itertools
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

import warpgs
from tests.example_terms import DepthCorrelation, NormalSmoothness
from tests.scenes import photos, seeds, view_stub
from warpgs.app.cli import main
from warpgs.app.fit import request_of
from warpgs.errors import DataError, UsageError
from warpgs.pipeline.model.limits import LimitConfig
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.paper.strategy import PaperConfig
from warpgs.pipeline.run.fit import fit
from warpgs.pipeline.run.folder import CONFIG, check_same, open_run, read_record, stored_request
from warpgs.pipeline.run.request import SceneRequest
from warpgs.pipeline.train.loss import AlphaDifference, LossConfig, SmoothDepth, built_in_terms
from warpgs.pipeline.train.presets import MAX_BYTES, MAX_DOTS, PRESETS, preset_settings
from warpgs.pipeline.train.schedule import OptimizerConfig, plan_phases
from warpgs.pipeline.train.settings import (
    AVERAGED_VIEWS,
    EXTRAPOLATED_VIEWS,
    ONE_LAYER_VIEWS,
    REMOVED,
    SMOOTH_STEPS,
    FitConfig,
    first_points,
    keyword,
    removed_note,
    setting_names,
    settings_by_views,
    step_times,
    steps_by_views,
    upgraded,
    with_settings,
)
from warpgs.pipeline.train.stopping import StoppingConfig
from warpgs.pipeline.train.strategies.mcmc import MCMCConfig
from warpgs.pipeline.train.view_modules import Exposure, RefinePoses
from warpgs.scene import Scene
from warpgs.schema import SchemaError

NAN = math.nan

# Presets and settings from outside: files, objects, mappings and keywords, all of them checked and typed.

OWN = """
from warpgs.pipeline.train.settings import FitConfig
PLAIN = FitConfig(steps=5)
SOME = {"base": "quick", "init": {"opacity": 0.5}}
BESIDE = {"base": "my.toml", "steps": 7}
NUMBER = 3
"""


@pytest.fixture
def own(own_file):
    return own_file("own.py", OWN)


def written(folder, text, name="my.toml"):
    (folder / name).write_text(text)
    return folder / name


def test_a_file_starts_from_another(tmp_path):
    """From a preset by name, or a file beside it; numbers are of the type of their fields, open settings are none."""
    first = written(
        tmp_path, 'base = "3dgs"\nsteps = 40\nmemory-limit = "2GiB"\n[init]\nopacity = 1e-1\nmerge-px = 3\n', "a.toml"
    )
    second = written(tmp_path, 'base = "a.toml"\nabout = "mine"\nsteps = "none"\nsh_degree = "none"\n')
    config, origin = preset_settings(str(first))
    assert config == dataclasses.replace(
        PRESETS["3dgs"], preset="a.toml", steps=40, memory_limit=2 * 2**30,
        init=dataclasses.replace(PRESETS["3dgs"].init, opacity=0.1, merge_px=3.0),
    )  # fmt: skip
    assert type(config.init.merge_px) is float and str(first) in origin and "SHA-256" in origin
    config, origin = preset_settings(second)
    assert (config.preset, config.steps, config.sh_degree, config.init.opacity) == ("my.toml", None, None, 0.1)
    assert all(word in origin for word in (str(first), str(second), "preset 3dgs", "init.merge-px", "sh-degree"))
    assert preset_settings(written(tmp_path, "steps = 7"))[0].strategy == PRESETS["default"].strategy
    # settings of the strategy and of loss terms
    path = written(
        tmp_path,
        'strategy = "mcmc"\nloss-terms = "alpha"\n[mcmc]\nnoise-lr = 1e4\n[alpha]\nweight = 0.5\n',
    )
    config, _ = preset_settings(path)
    assert config.strategy_config == MCMCConfig(noise_lr=1e4) and config.loss_terms == (AlphaDifference(weight=0.5),)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("stpes = 3", "my.toml: unknown setting 'stpes'; did you mean steps?"),
        ("[init]\nopacty = 3", "unknown setting 'init.opacty'; did you mean init.opacity?"),
        ("[init]\nmerge-pix = 3", "unknown setting 'init.merge-pix'; did you mean init.merge-px?"),
        ("merge-px = 3", "unknown setting 'merge-px'; did you mean init.merge-px?"),
        ('strategy = "mcmc"\n[densty]\nevery = 3', "unknown setting 'densty.every'; did you mean density.every?"),
        ("steps = 3.5", "steps must be a whole number of 64 bits, not 3.5"),
        ("steps = 0", "my.toml: steps must be at least 1, not 0"),
        ("seed = 99999999999999999999999", "seed must be a whole number"),
        ("steps = 2024-01-01", "steps must be a whole number of 64 bits, not date"),
        ("dropout = nan", "dropout must be a finite number, not nan"),
        ('cuda-graph = "yes"', "cuda_graph must be true or false"),
        ('memory-limit = "2 cows"', "memory limit '2 cows' is not a size"),
        ("init = 3", "init is a group of settings"),
        ("depth-mean = [0.1, 0.2, 0.3]", "the setting depth-mean was removed: give it in FILE.onnx.json"),
        ('strategy = "best"', "my.toml: unknown strategy 'best'"),
        ('strategy = "json:JSONDecoder"', "name it by flag, .py preset"),
        ('loss-terms = "json:JSONDecoder"', "does not load your code"),
        ('base = "json:dumps"', "is code; a preset file never loads code"),
        ('base = "../a.toml"', "is outside the folder of the file"),
        ("init.random-count = 99999999", "init.random-count must be in [1, 1e+07]"),
        ("base = 3", "base must be text, not 3"),
        ('base = "my.toml"', "is circular"),
        ('preset = "quick"', "unknown setting 'preset'"),
    ],
)
def test_a_wrong_setting_is_named(tmp_path, text, said):
    with pytest.raises(UsageError) as error:
        preset_settings(written(tmp_path, text))
    assert said in str(error.value) and str(tmp_path) in str(error.value)
    assert len(str(error.value)) < 400


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"steps = ", "not valid TOML"),
        (b"steps = 1\nseed = = 2", "at line 2"),
        (b"\xff\xfe", "not valid TOML"),
        (b"x = " + b"[" * 5000 + b"]" * 5000, "nested tables"),
        (b"#" * (MAX_BYTES + 1), "larger than"),
        (b"a = 1\n" + b"a." * (MAX_DOTS + 1) + b"a = 1", "more than 100 dots in a line"),
        (None, "cannot be read"),
    ],
)
def test_a_file_that_is_none_is_refused(tmp_path, data, said):
    if data is not None:
        (tmp_path / "my.toml").write_bytes(data)
    with pytest.raises(DataError, match=said) as error:
        preset_settings(tmp_path / "my.toml")
    assert str(tmp_path / "my.toml") in str(error.value) and len(str(error.value)) < 400


def test_objects_mappings_and_registered_names_are_presets(own, monkeypatch):
    assert preset_settings(f"{own}:PLAIN")[0] == FitConfig(steps=5)
    config, origin = preset_settings(f"{own}:SOME")
    assert config.init.opacity == 0.5 and config.max_steps == 300 and "), preset quick" in origin
    assert origin.startswith(f"{own}:SOME (SHA-256 ")
    assert preset_settings({"base": "quick", "init.opacity": 0.5})[0] == config
    written(Path(own).parent, "init.opacity = 0.5")
    beside = preset_settings(f"{own}:BESIDE")[0]  # a file beside the code, not in the current folder
    assert (beside.steps, beside.init.opacity) == (7, 0.5)
    for wrong, said in (
        (f"{own}:NUMBER", "is of type int"),
        (f"{own}:NONE", "does not exist"),
        ("no.such:X", "cannot be imported"),
    ):
        with pytest.raises(UsageError, match=said):
            preset_settings(wrong)
    with pytest.raises(UsageError, match="3 is not a preset"):
        preset_settings(3)
    assert list(warpgs.PRESETS) == ["default", "3dgs", "mcmc", "paper-literal", "quick"]
    monkeypatch.setattr(PRESETS, "_made", dict(PRESETS._made))
    PRESETS.register("mine", FitConfig(steps=3), "three steps")
    assert preset_settings("mine")[0].steps == 3 and "mine" in PRESETS and PRESETS.described()["mine"] == "three steps"
    for name in ("default", "a:b", "a.toml", ""):
        with pytest.raises(UsageError, match="cannot be registered"):
            PRESETS.register(name, FitConfig())


@pytest.mark.parametrize(
    ("kind", "bad", "said"),
    [
        *((LossConfig, {n: v}, "loss.{} must be in") for n, v in (("depth_weight", -1), ("normal_weight", NAN))),
        *((LossConfig, {n: v}, "loss.{} must be in") for n, v in (("smooth_weight", 1001), ("alpha_weight", NAN))),
        (AlphaDifference, {"weight": -1.0}, "alpha.{} must be in"), (SmoothDepth, {"weight": NAN}, "{} must be in"),
        (NormalSmoothness, {"growth": 0}, "{}"), (DepthCorrelation, {"until": 2}, "{}"),
        (FitConfig, {"half_resolution": NAN}, "{} must be in"),
        *((InitConfig, {"random_count": v}, "init.{} must be in") for v in (0, 10**9)),
        *((StoppingConfig, {"min_gain_db": v}, "stopping.{} must be at least 0 and finite") for v in (math.inf, NAN)),
        *((OptimizerConfig, b, "optimizer.{} must be in") for b in ({"opacities_decay": 0.2}, {"average_last": -0.1})),
        *((LimitConfig, b, "limits.{} must be in") for b in ({"max_size": -1}, {"max_reach": -1}, {"max_size": NAN})),
        (LimitConfig, {"max_ratio": 0.5}, "limits.{} must be"), (MCMCConfig, {"every": 0}, "mcmc.{} must be at least 1"),
        *((MCMCConfig, b, "mcmc.{} must be in") for b in ({"growth": -1.0}, {"noise_lr": NAN}, {"min_opacity": 0.9})),
        (PaperConfig, {"residual": "error"}, "paper.{} must be one of length, gain, not"),
        (PaperConfig, {"depth": "mean"}, "paper.{} must be one of"),
        (PaperConfig, {"gate_quantile": 1}, r"paper.{} must be in \[0, 1\), not"),
        *((Exposure, b, "exposure.{} must be in") for b in ({"lr": 0.0}, {"decay": 2e6}, {"weight": -1.0}, {"weight": 1001})),
        *((RefinePoses, b, "refine-poses.{} must be in") for b in ({"rotation_lr": NAN}, {"start": 1.0})),
    ],
)  # fmt: skip
def test_a_value_out_of_range_is_refused_by_its_flag(kind, bad, said):
    ((name, value),) = bad.items()
    with pytest.raises(UsageError, match=rf"{said.format(name.replace('_', '-'))}.*{value}"):
        kind(**bad)


def test_keywords_replace_settings():
    # as the flag, with underscores; none is an argument of the fit or an option of reading
    for config in (FitConfig(), PRESETS["mcmc"], dataclasses.replace(PRESETS["default"], loss_terms=(AlphaDifference(2.0),))):
        names = setting_names(config)
        assert len({*map(keyword, names)}) == len(names) > 60
        assert not {*map(keyword, names)} & {*inspect.signature(fit).parameters}
    assert {"steps", "sh_degree", "init.opacity", "depth_model", "method.sampler.fraction"} <= {*setting_names(FitConfig())}
    # numbers of numpy are numbers; classes stand for themselves
    made = with_settings(
        FitConfig(),
        {"steps": np.int64(30), "sh_degree": 1, "init_opacity": 0.3, "dropout": np.float32(0.5), "density": {"every": 7}},
        "x",
    )
    assert (made.steps, made.sh_degree, made.init.opacity, made.dropout, made.density.every) == (30, 1, 0.3, 0.5, 7)
    assert type(made.steps) is int and type(made.dropout) is float
    made = with_settings(FitConfig(), {"init": InitConfig(opacity=0.3), "loss_terms": (AlphaDifference(0.2),)}, "x")
    assert made.init.opacity == 0.3 and made.loss_terms == (AlphaDifference(0.2),)
    made = with_settings(made, {"alpha_weight": 0.25, "strategy": "mcmc", "mcmc_every": 9}, "x")
    assert made.loss_terms[0].weight == 0.25 and made.strategy_config.every == 9
    assert with_settings(made, {"steps": None}, "x").steps is None
    for wrong, said in (
        ({3: 1}, "3 is not a setting's name"),
        ({"loss_terms": 3}, "must be names"),
        ({"opacity": 0.3}, "mean init.opacity"),
    ):
        with pytest.raises(UsageError, match=said):
            with_settings(FitConfig(), wrong, "x")
    config = with_settings(
        PRESETS["default"], {"exposure": True, "refine_poses_start": 0.5, "refine_poses": True}, "here", keywords=True
    )
    assert {m.name: m for m in config.view_modules}["refine_poses"].start == 0.5
    assert [m.name for m in config.view_modules] == ["exposure", "refine_poses"]
    assert [m.name for m in with_settings(config, {"exposure": False}, "here").view_modules] == ["refine_poses"]
    assert with_settings(config, {"view_modules": "none"}, "here").view_modules == ()
    with pytest.raises(UsageError, match="exposure"):
        with_settings(config, {"exposure": 3}, "here")


def test_a_fit_takes_keywords_and_records_where_settings_come_from(tmp_path):
    """The bits are those of the same settings given whole; config.json has them resolved, with a note."""
    scene = Scene("memory", "none", tuple(photos(3)), points=seeds())
    path = written(tmp_path, 'base = "3dgs"\nsteps = 9\ninit.source = "points"\n')
    options = {"device": "cpu", "verbose": False}
    result = warpgs.fit(scene, path, steps=3, sh_degree=1, out=tmp_path / "run", **options)
    whole = dataclasses.replace(PRESETS["3dgs"], steps=3, init=InitConfig(source="points"), sh_degree=1)
    again = warpgs.fit(scene, whole, **options)
    assert result.gaussians().means.equal(again.gaussians().means) and result.config == dataclasses.replace(
        whole, preset="my.toml"
    )
    record = json.loads((tmp_path / "run" / "config.json").read_text())
    (note,) = (n for n in record["notes"] if n.startswith("settings: "))
    assert str(path) in note and "SHA-256" in note and note.endswith("then given: steps, sh-degree")
    assert record["config"]["preset"] == "my.toml" and record["config"]["steps"] == 3
    for wrong, said in (
        ({"step": 3}, r"warpgs.fit: unknown setting 'step'; did you mean steps\?"),
        ({"steps": "3"}, "warpgs.fit: steps must be a whole number of 64 bits, not '3'"),
        ({"init_opacity": float("nan")}, "init_opacity must be a finite number"),
        ({"opacity": 0.3}, "did you mean init_opacity"),
        ({"sh_degree": 5}, r"sh-degree must be in \[0, 4\], not 5"),
        ({"downscale": 2}, "downscale is an option for reading a scene"),
    ):
        with pytest.raises(UsageError, match=said):
            warpgs.fit(scene, "quick", out=tmp_path / "x", **wrong, **options)
    assert not (tmp_path / "x").exists()


def test_the_command_line_takes_files_and_objects(own, tmp_path, capsys):
    path = written(tmp_path, "steps = 9\nseed = 4\n")
    base = ["scene", "--out", "run"]
    request = request_of([*base, "--preset", str(path), "--steps", "3"], "")
    assert (request.config.steps, request.config.seed, request.config.preset) == (3, 4, "my.toml")
    assert str(path) in request.notes[0] and request.notes[0].endswith("then given: steps")
    assert request_of([*base, "--preset", f"{own}:PLAIN"], "").config == FitConfig(steps=5)
    (tmp_path / "broken.py").write_text("1 / 0\n")
    (tmp_path / "wrong.py").write_text("X = {'stepz': 3}\n")
    (tmp_path / "open.py").write_text("X = {\n")
    for preset, said in (
        (f"{tmp_path}/wrong.py:X", f"{tmp_path}/wrong.py:X: unknown setting 'stepz'; did you mean steps?"),
        (f"{tmp_path}/open.py:X", f"SyntaxError: '{{' was never closed ({tmp_path}/open.py, line 1); correct that code"),
        (f"{tmp_path}/broken.py:X", "ZeroDivisionError: division by zero"),
        (str(written(tmp_path, "stepz = 3", "b.toml")), "did you mean steps?"),
        ("best", "preset 'best' is not one of"),
    ):
        assert main(["fit", *base, "--preset", preset]) == 2
        text = capsys.readouterr().err
        assert said in text and len(text.splitlines()) == 1
    assert main(["compare", *base, "--presets", f"default,{tmp_path}/broken.py:X"]) == 2
    assert f"the preset '{tmp_path}/broken.py:X' cannot be loaded" in capsys.readouterr().err


# Settings and sizes of images that are chosen for the user.


PARTLY, FULL, DARK = np.eye(6, 8) > 0, np.ones((6, 8), bool), np.zeros((6, 8, 3))
DARK[3, 3] = 1
OPAQUE, CUT, ESTIMATED = {}, {"alpha": 1.0}, {"alpha": 1.0, "alpha_estimated": True}
LAYERS, UNSEEN, DECAY, SMOOTH = "method.hier", "init.extrapolate", "optimizer.opacities_decay", "loss.smooth_weight"
LAST, GAIN, MEANS, SH = "optimizer.average_last", "stopping.min_gain_db", "optimizer.means_lr", "optimizer.sh_lr"


def chosen(views: int, device: str = "cuda", view=OPAQUE, preset: str = "default", **given):
    config = with_settings(PRESETS[preset], given, "here", keywords=True)
    config, notes = settings_by_views(config, [view_stub(**view)] * views, device)
    return config, " ".join(notes)


def value(config: FitConfig, name: str):
    return functools.reduce(getattr, name.split("."), config)


@pytest.mark.parametrize(
    ("views", "view", "device", "given", "wanted"),
    [
        # up to 54 views have one layer and decay, up to 4 opaque ones points where no view looks, and more decay with them
        (1, OPAQUE, "cuda", {}, {UNSEEN: False, DECAY: 0.001, LAYERS: False}),
        *((n, OPAQUE, "cuda", {}, {UNSEEN: True, DECAY: 0.0015}) for n in (2, EXTRAPOLATED_VIEWS)),
        (EXTRAPOLATED_VIEWS + 1, OPAQUE, "cuda", {}, {UNSEEN: False, DECAY: 0.001, LAYERS: False}),
        *((ONE_LAYER_VIEWS, v, "cuda", {}, {DECAY: 0.001, LAYERS: False}) for v in (OPAQUE, CUT)),
        *((ONE_LAYER_VIEWS + 1, v, "cuda", {}, {DECAY: 0.0, LAYERS: True}) for v in (OPAQUE, CUT)),
        (3, CUT, "cuda", {}, {UNSEEN: False, DECAY: 0.001, LAYERS: False}), (3, OPAQUE, "cpu", {}, {UNSEEN: False}),
        # not where a part of a view does not count, nor where no depth is searched for; decay, even where points are asked for
        (3, {"mask": FULL}, "cuda", {}, {UNSEEN: True, DECAY: 0.0015}),
        *((3, v, "cuda", {}, {UNSEEN: False, DECAY: 0.001}) for v in ({"mask": PARTLY}, {"image": DARK})),
        *((3, v, "cuda", {"init_extrapolate": True}, {DECAY: 0.001}) for v in ({"mask": PARTLY}, {"image": DARK})),
        *((n, OPAQUE, "cuda", {"init_source": s} | asked, {DECAY: 0.001, UNSEEN: bool(asked)})
          for n, s in ((3, "hull"), (1, "sweep")) for asked in ({}, {"init_extrapolate": True})),
        (3, OPAQUE, "cuda", {"init_extrapolate": False}, {DECAY: 0.001, UNSEEN: False}),
        # few views have smooth depth, in fits of at least 3000 steps, so not where a CPU limits them
        (4, OPAQUE, "cuda", {}, {SMOOTH: 1.0, "steps": 4500}),
        (5, OPAQUE, "cuda", {}, {SMOOTH: 0.0, "steps": steps_by_views(5)}),
        (8, CUT, "cuda", {}, {SMOOTH: 0.5}), (9, CUT, "cuda", {}, {SMOOTH: 0.0}),
        # an alpha channel, but not opacity that was estimated, has twice the steps, and a mean of the last ones
        *((n, CUT, "cuda", {}, {LAST: 0.05, "steps": most}) for n, most in ((3, 6000), (8, 10_091), (300, 30_000))),
        *((n, ESTIMATED, "cuda", {}, {LAST: 0.0, "steps": most}) for n, most in ((3, 3000), (8, 5045))),
        (8, CUT, "cuda", {"max_steps": 500}, {LAST: 0.05, "steps": 500}),
        (4, OPAQUE, "cuda", {"steps": SMOOTH_STEPS - 1}, {SMOOTH: 0.0}),
        (4, OPAQUE, "cpu", {}, {SMOOTH: 0.0}), (4, OPAQUE, "cpu", {"cpu_limit": False}, {SMOOTH: 1.0}),
        *((4, OPAQUE, "cuda", {"preset": name}, {SMOOTH: 0.0}) for name in ("quick", "3dgs")),
        # many views have a mean of the last steps
        *((n, OPAQUE, "cuda", {}, {LAST: 0.0}) for n in (3, AVERAGED_VIEWS - 1)),
        *((n, OPAQUE, "cuda", {}, {LAST: 0.05}) for n in (AVERAGED_VIEWS, 300)),
        # rates rise with more than nine views, at once where the time of a CPU limits them; then nothing is held out
        *((9, OPAQUE, d, {}, {MEANS: 1.6e-4, SH: 2.5e-3}) for d in ("cpu", "cuda")),
        *((n, OPAQUE, "cpu", {}, {MEANS: 4e-4, SH: 6.25e-3}) for n in (10, 60)),
        *((n, OPAQUE, "cuda", {}, {MEANS: m, SH: h}) for n, m, h in ((18, 3.2e-4, 5e-3), (27, 4.8e-4, 7.5e-3))),
        (99, OPAQUE, "cuda", {}, {MEANS: 4.8e-4, SH: 7.5e-3}),
        # and steps grow more slowly with more than twelve views
        *((n, OPAQUE, "cuda", {}, {"steps": most}) for n, most in ((9, 5511), (12, 6839), (54, 12_481), (1000, 30_000))),
        *((n, OPAQUE, d, {}, {GAIN: gain}) for n in (3, 12) for d, gain in (("cpu", 0.0), ("cuda", 0.1))),
        (12, OPAQUE, "cpu", {"steps": 100}, {GAIN: 0.1, "sh_every": 500}),
        # nor for objects on black, whose blocks are mostly empty
        *((n, v, "cuda", {}, {GAIN: gain}) for n in (3, 12) for v, gain in ((ESTIMATED, 0.0), (CUT, 0.1))),
        (12, ESTIMATED, "cuda", {"stopping_min_gain_db": 0.1}, {GAIN: 0.1}),
        # nor where views have half size until growth ends, since nothing could end it
        *((n, OPAQUE, "cuda", {"preset": "quick"}, {GAIN: 0.0, "sh_every": every}) for n, every in ((3, 500), (40, 20))),
        # from ten views on, a fifth of the steps has half size, fewer where the time of a CPU limits them
        (40, OPAQUE, "cpu", {}, {"half_resolution": 0.05}),
        (40, OPAQUE, "cuda", {"half_resolution": 0.0}, {"half_resolution": 0.0}),
        *((n, OPAQUE, "cuda", {}, {"half_resolution": h}) for n, h in ((4, 0.5), (8, 0.25), (10, 0.2), (300, 0.2))),
        *((12, OPAQUE, "cuda", {"steps": 1000, "half_resolution": h}, {GAIN: g}) for h, g in ((0.7, 0.0), (0.69, 0.1))),
    ],
)  # fmt: skip
def test_settings_are_chosen_by_the_views(views, view, device, given, wanted):
    config, notes = chosen(views, device, view, **given)
    assert {name: value(config, name) for name in wanted} == wanted
    if not given:
        assert f"method.hier {config.method.hier}" in notes and f"init.extrapolate {config.init.extrapolate}" in notes
        assert f"optimizer.average-last {config.optimizer.average_last}" in notes
    smooth = ["smooth_depth"] * (config.loss.smooth_weight > 0)
    assert [t.name for t in built_in_terms(config.loss)] == ["photometric", *smooth]


@pytest.mark.parametrize(
    ("name", "given"),
    [
        (DECAY, 0.02),
        (LAST, 0.5),
        (SMOOTH, 0.2),
        (MEANS, 1e-3),
        (SH, 2e-3),
        (GAIN, 0.2),
        (UNSEEN, True),
        (LAYERS, True),
        ("steps", 700),
    ],
)
def test_what_is_given_holds(name, given):
    for views, device, preset in itertools.product((3, 12, 60), ("cpu", "cuda"), ("default", "quick")):
        assert value(chosen(views, device, preset=preset, **{keyword(name): given})[0], name) == given
    assert chosen(12, "cpu", stopping_min_gain_db=0.2)[0].sh_every == 500


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize(("views", "width", "height"), [(3, 126, 94), (3, 504, 378), (10, 900, 1600), (54, 504, 378)])
def test_quick_is_never_slower_than_default(device, views, width, height):
    """At most 300 steps, and on a CPU at most as many as half a minute has; a number that is given holds."""
    train, pixels = [view_stub(width, height)] * views, width * height
    made = [settings_by_views(PRESETS[name], train, device)[0] for name in ("quick", "default")]
    times = [step_times(c, views, pixels, min(c.max_gaussians, first_points(c, views, pixels)))[0].sum() for c in made]
    assert 0 < times[0] <= times[1]
    assert made[0].steps == 300 or (0 < made[0].steps < 300 and device == "cpu" and views > 3)
    given = dataclasses.replace(PRESETS["quick"], steps=700)
    assert settings_by_views(given, train, device)[0].steps == 700


@pytest.mark.parametrize(("preset", "views", "width", "height", "start", "seconds"), [
    ("quick", 30, 1333, 1000, 200_000, 30),
    ("quick", 40, 967, 541, 180_000, 30), ("quick", 40, 800, 450, 106_000, 30), ("quick", 300, 800, 600, 225_000, 30),
    ("default", 26, 970, 543, 200_000, 135), ("default", 43, 800, 450, 112_000, 220), ("default", 9, 504, 378, 34_302, 50),
    ("default", 3, 504, 378, 16_936, 20),
])  # fmt: skip
def test_the_time_of_a_cpu_holds_for_the_gaussians_that_will_be_there(preset, views, width, height, start, seconds):
    """Their number is limited so that the steps end in time; the choice is said, and a smaller number that is given holds."""
    train = [view_stub(width, height)] * views
    made, notes = settings_by_views(PRESETS[preset], train, "cpu")
    start = min(start, made.max_gaussians)  # as first points are
    assert 0.8 * seconds < step_times(made, views, width * height, start)[0].sum() < 1.15 * seconds
    unlimited = step_times(dataclasses.replace(made, max_gaussians=10**6), views, width * height, start)[0].sum()
    assert f"takes {made.steps:,} of" in notes[-1] or f"the fit has at most {made.max_gaussians:,} Gaussians;" in notes[-1]
    said = f"has at most {made.max_gaussians:,} Gaussians" in notes[-1]
    assert said == (made.max_gaussians < 10**6) and (said or unlimited < 1.15 * seconds)
    fewer = dataclasses.replace(PRESETS[preset], max_gaussians=5000)
    assert settings_by_views(fewer, train, "cpu")[0].max_gaussians == 5000
    for free in ({"cpu_limit": False}, {"steps": 200}):
        assert settings_by_views(dataclasses.replace(PRESETS[preset], **free), train, "cpu")[0].max_gaussians == 10**6


@pytest.mark.parametrize(("preset", "steps", "views", "width", "height", "start", "most", "seconds"), [
    ("quick", 300, 3, 504, 378, 16_936, 10**6, 6.7), ("quick", 293, 40, 450, 800, 104_000, 104_000, 25.3),
    ("default", 674, 3, 504, 378, 16_936, 10**6, 18.2), ("default", 287, 9, 504, 378, 34_302, 10**6, 16.2),
    ("default", 222, 8, 450, 800, 44_459, 10**6, 20.2), ("default", 646, 6, 400, 300, 4_441, 10**6, 10.8),
    ("default", 179, 4, 640, 480, 5_494, 10**6, 3.6), ("default", 120, 24, 180, 320, 12_994, 44_000, 2.6),
    # small images have so many steps that most Gaussians come from growth by gradients: measured on a slower machine, times the
    # 18.2 s above over its 30.2 s
    ("default", 1941, 6, 320, 240, 6_957, 10**6, 33.0), ("default", 3024, 6, 252, 189, 5_585, 10**6, 55.8),
    ("default", 1820, 4, 320, 240, 1_611, 10**6, 18.0), ("default", 4797, 8, 135, 240, 4_249, 10**6, 73.9),
    ("default", 2400, 3, 249, 186, 4_469, 10**6, 24.6),
])  # fmt: skip
def test_times_of_steps_are_those_that_were_measured(preset, steps, views, width, height, start, most, seconds):
    """Within a quarter, on fern, fox, DTU, temple, the demo and room (docs/decisions/025)."""
    config = dataclasses.replace(PRESETS[preset], steps=steps, max_gaussians=most)
    made, _ = settings_by_views(config, [view_stub(width, height)] * views, "cpu")
    times, counts = step_times(made, views, width * height, start, growing=True)
    assert 0.8 < seconds / times.sum() < 1.25 and counts.max() <= most


@pytest.mark.parametrize(("views", "width", "height", "first"), [
    (3, 504, 378, 16_936), (9, 504, 378, 34_302), (8, 450, 800, 44_459), (30, 225, 400, 26_633), (40, 450, 800, 104_000),
])  # fmt: skip
def test_steps_and_gaussians_share_the_time_of_a_cpu(views, width, height, first):
    """First points are estimated to a quarter; Gaussians that take most of a step are limited, and more steps are taken."""
    assert abs(first_points(PRESETS["default"], views, width * height) / first - 1) < 0.25
    made, _ = settings_by_views(PRESETS["default"], [view_stub(width, height)] * views, "cpu")
    assert (made.max_gaussians < 10**6) == (views > 8)
    times, counts = step_times(made, views, width * height, first)
    bare = step_times(dataclasses.replace(made, max_gaussians=1), views, width * height, 1)[0]
    assert views <= 8 or (counts[-1] == made.max_gaussians and 0.7 < 1 - bare[-1] / times[-1] < 0.8)


def test_the_time_of_a_cpu_limits_steps_and_images():
    """All degrees of the harmonics are in use when growth begins; the loss of quality is said."""
    for views in (3, 12):
        limited, whole = (chosen(views, device)[0] for device in ("cpu", "cuda"))
        assert limited.steps < SMOOTH_STEPS <= whole.steps and whole.sh_every == 500
        assert limited.sh_degree * limited.sh_every <= plan_phases(limited.phases, limited.steps).refine
    assert "--no-cpu-limit lifts this, takes about 7 min, and raised PSNR by 0.3 to 1.6 dB" in chosen(10, "cpu")[1]
    nearly = settings_by_views(PRESETS["quick"], [view_stub(610, 850)] * 30, "cpu")[1][-1]
    assert re.search("takes 29[0-9] of 300 steps and has at most [0-9,]+ Gaussians; --no-cpu-limit .* 1 min$", nearly), nearly
    # from the first points to three times as many at the events, which take longer; views of half size take less time
    asked = dataclasses.replace(PRESETS["default"], steps=600, half_resolution=0.05)
    made, _ = settings_by_views(asked, [view_stub(800, 450)] * 40, "cpu")
    events = plan_phases(made.phases, 600).events
    times, counts = step_times(made, 40, 360_000, 100_000)
    assert counts[0] == counts[events[0] - 2] == 100_000 and counts[-1] == 300_000 and bool((np.diff(counts) >= 0).all())
    assert times[-1] > 2 * times[events[0] - 2] > 2.2 * times[0] and all(times[e - 1] > 2 * times[e] for e in events)
    removal = plan_phases(made.phases, 600).stable_start
    assert times[removal - 1] > 30 * times[removal]
    capped = step_times(dataclasses.replace(made, max_gaussians=150_000), 40, 360_000, 100_000)
    assert capped[1][-1] == 150_000 and capped[0].sum() < times.sum()
    assert step_times(dataclasses.replace(made, batch=2), 40, 360_000, 100_000)[0].sum() > 1.5 * times.sum()
    # a side or a factor that is given holds on both devices, and a run that remembers its size keeps it
    for device, side in (("cpu", 800), ("cuda", 1600)):
        request = SceneRequest("scene").with_scale(device)
        assert (request.downscale, request.max_side) == (1, side)
        assert SceneRequest("scene", max_side=1200).with_scale(device).max_side == 1200
        assert SceneRequest("scene", downscale=2).with_scale(device).max_side == 0
        assert request.with_scale("cpu") == request == request.with_scale("cuda")


# Settings of earlier versions: what replaces them, and runs that were stored with them.


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


def test_old_flags_settings_and_strategies_are_named(capsys):
    assert upgraded(FitConfig().to_json() | {"checkpoint_seconds": 0.0}) == (FitConfig().to_json(), [])
    for flag, words in (("--density.no-morton-order", "morton-order was removed"), ("--no-cache", "WARPGS_CACHE"),
                        ("--method.no-events", "--strategy clone_split")):  # fmt: skip
        assert main(["fit", "scene", "--out", "run", flag]) == 2
        assert words in capsys.readouterr().err
    with pytest.raises(UsageError, match="now sampling, or paper"):
        with_settings(FitConfig(), {"strategy": "importance_sampling"}, "x")
    # scores, a gate, rendered depth or no protection were the paper's; without events it was clone_split
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
