"""The flags of `warpgs fit`: derived from the settings, with those of plug-ins, and safe where code of others is named."""

import dataclasses
import json
import os
import subprocess
import sys

import pytest

from warpgs.app.cli import main
from warpgs.app.fit import request_of, tell_preset
from warpgs.app.flags import flags_of, settings_of
from warpgs.errors import field_docs
from warpgs.pipeline.train.loss import AlphaDifference
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.mcmc import MCMCConfig
from warpgs.synthetic.demo import split_spec, write_demo

BASE = ["scene", "--out", "run", "--device", "cpu"]
PLUG_INS = '''
from dataclasses import dataclass

import warpgs.io.folder as readers
import warpgs.pipeline.train.loss as loss
import warpgs.pipeline.train.strategies.base as base


@dataclass(frozen=True)
class Settings:
    rate: float = 0.5
    """Rate of nothing,
    on two lines."""


class Folder(readers.Reader):
    def probe(self, folder):
        return readers.Probe("everything")

    def read(self, folder, options):
        return readers.READERS.find("colmap")().read(folder, options)


class SlowGrowth(base.Strategy):
    Config = Settings


@dataclass(frozen=True)
class Opaque(loss.LossTerm):
    weight: float = 0.25
    """Weight of the mean alpha."""

    needs_outputs = ("alpha",)

    def __call__(self, inputs):
        return self.weight * inputs.outputs["alpha"].mean()
'''


def parsed(*flags):
    return request_of([*BASE, *flags], "").config


def squeezed(text):
    return "".join(text.replace("│", "").split())


def leaves(kind, prefix=""):
    """Every flag that a settings dataclass stands for, with the docstring of its field."""
    docs = field_docs(kind)
    for f in dataclasses.fields(kind):
        default = f.default_factory() if f.default_factory is not dataclasses.MISSING else f.default
        if dataclasses.is_dataclass(default):
            yield from leaves(type(default), "" if f.name == "priors" else f"{prefix}{f.name.replace('_', '-')}.")
        elif f.name != "strategy_config":
            yield f"--{prefix}{f.name.replace('_', '-')}", docs[f.name]


def test_every_setting_is_a_flag_with_its_own_help(capsys, monkeypatch):
    """Whatever FitConfig and its parts hold is in the help, word for word, without a second text."""
    monkeypatch.setenv("COLUMNS", "110")
    with pytest.raises(SystemExit) as end:
        request_of(["--help-all", "--strategy", "mcmc", "--loss-terms", "alpha"], "")
    text = squeezed(capsys.readouterr().out)
    flags = [*leaves(FitConfig), *leaves(MCMCConfig, "mcmc."), *leaves(AlphaDifference, "alpha.")]
    assert end.value.code == 0 and len(flags) > 70
    for flag, doc in flags:
        assert flag in text and squeezed(doc) in text, flag
    assert "--strategy-config" not in text


@pytest.mark.parametrize("preset", PRESETS)
def test_without_flags_the_settings_are_the_presets(preset):
    found = parsed("--preset", preset)
    assert found == PRESETS[preset] and found.fingerprint() == PRESETS[preset].fingerprint()
    assert type(found) is FitConfig and type(found.init) is type(PRESETS[preset].init)
    assert settings_of(FitConfig, flags_of(FitConfig, found)[1]) == found


def test_flags_change_what_they_name(capsys):
    found = parsed("--memory-limit", "2GiB", "--init.source=random", "--no-cuda-graph", "--max-gaussians", "900")
    assert (found.memory_limit, found.init.source, found.cuda_graph, found.max_gaussians) == (2 * 2**30, "random", False, 900)
    tell_preset([], found)
    assert found.preset == "default" and "preset default: any capture" in capsys.readouterr().out
    found = parsed("--strategy=mcmc", "--mcmc.noise-lr", "1e4", "--loss-terms", "alpha", "--alpha.weight", "0.5")
    assert found.strategy_config == MCMCConfig(noise_lr=1e4) and found.loss_terms == (AlphaDifference(0.5),)
    assert parsed("--preset", "mcmc", "--mcmc.every", "7").strategy_config.every == 7
    assert parsed("--preset", "mcmc", "--strategy", "clone_split").strategy_config is None


def test_mistakes_are_named_before_anything_starts(tmp_path, capsys):
    (tmp_path / "broken.py").write_text("x = 1\ny = 1 / 0\n")
    (tmp_path / "crooked.py").write_text("def f(:\n")
    (tmp_path / "clash.py").write_text(PLUG_INS.replace("SlowGrowth", "Init"))
    (tmp_path / "needy.py").write_text(PLUG_INS.replace(" = 0.25", ""))
    for flags, message in [
        (["--memory-limit", "2 cows"], "2 cows"),
        (["--strategy", "best"], "unknown strategy 'best'; choose one of"),
        (["--loss-terms", "alpha,alpha"], "two of these names define the flags --alpha"),
        (["--strategy", f"{tmp_path}/none.py:A"], "there is no file"),
        (["--strategy", "json:JSONDecoder"], "must be a class that derives from"),
        (["--strategy", f"{tmp_path}/broken.py:A"], "ZeroDivisionError: division by zero"),
        (["--strategy", f"{tmp_path}/broken.py:A"], "broken.py, line 2"),
        (["--strategy", f"{tmp_path}/crooked.py:A"], "crooked.py, line 1"),
        (["--strategy", f"{tmp_path}/clash.py:Init"], "the plug-in name init is taken by a flag"),
        (["--loss-terms", f"{tmp_path}/needy.py:Opaque"], "has a setting without a default"),
    ]:
        assert main(["fit", *BASE, *flags]) == 2
        text = capsys.readouterr().err
        assert message in text and "Traceback" not in text and len(text.splitlines()) == 1, (flags, text)


@pytest.fixture(scope="module")
def plugged(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plugged")
    (folder / "mine.py").write_text(PLUG_INS)
    write_demo(folder / "scene", views=8, width=32, height=32)
    flags = ["--steps", "3", "--device", "cpu", "--preset", "3dgs", "--init.source", "random", "--init.random-count", "40"]
    command = ["fit", str(folder / "scene"), "--split", split_spec(8), "--out", str(folder / "run"), *flags]
    named = ["--strategy", f"{folder}/mine.py:SlowGrowth", "--slow-growth.rate", "0.75", "--loss-terms"]
    named.append(f"{folder}/mine.py:Opaque")
    assert main([*command, *named, "--reader", f"{folder}/mine.py:Folder"]) == 0
    return folder, command, named


def test_settings_of_plug_ins_reach_the_run(plugged, capsys):
    folder, command, named = plugged
    config = json.loads((folder / "run" / "config.json").read_text())["config"]
    assert config["strategy"].endswith("mine.py:SlowGrowth") and config["strategy_config"] == {"rate": 0.75}
    (term,) = config["loss_terms"]
    assert term["name"].endswith("mine.py:Opaque") and term["weight"] == 0.25
    with pytest.raises(SystemExit):
        main([*command, *named, "--help-all"])
    text = capsys.readouterr().out
    assert "slow-growth options" in text and "Rate of nothing, on two lines." in text and "--opaque.weight" in text


@pytest.mark.slow
def test_a_run_folder_never_decides_what_code_is_loaded(plugged):
    """In a new process: eval asks for the reader by name, --resume for strategy and term, and go on once they are named."""
    folder, command, named = plugged
    reader = f"{folder}/mine.py:Folder"
    score = ["eval", str(folder / "run"), "--device", "cpu"]
    commands = [
        score, [*command, "--resume"], [*command, "--resume", *named[:4]], [*score, "--reader", reader],
        [*command, "--resume", *named],
    ]  # fmt: skip
    probe = (
        "import contextlib, io, json, sys\nfrom warpgs.app.cli import main\nfor words in json.load(sys.stdin):\n"
        "    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:\n"
        "        code = main(words)\n"
        "    loaded = any('mine' in n.rpartition('_warpgs_')[2] and '_warpgs_' in n for n in sys.modules)\n"
        "    print(json.dumps([code, loaded, out.getvalue(), err.getvalue()]))"
    )
    done = subprocess.run([sys.executable, "-c", probe], input=json.dumps(commands), capture_output=True, text=True, check=True)
    unread, unnamed, half, scored, resumed = map(json.loads, done.stdout.splitlines())
    assert unread[:2] == [2, False] and f"--reader {reader}" in unread[3]
    assert unnamed[:2] == [2, False] and f"--strategy {named[1]}" in unnamed[3]
    assert half[:2] == [2, True] and f"--loss-terms {named[5]}" in half[3]
    assert scored[0] == 0 and resumed[0] == 0 and "continued from step 3" in resumed[2]


@pytest.mark.parametrize("found", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_current_folder_is_not_searched(plugged, found):
    """`python -m warpgs` finds module:Class on PYTHONPATH, where its user put it, and not by standing beside it."""
    folder, _, _ = plugged
    command = [sys.executable, "-m", "warpgs", "fit", *BASE, "--strategy", "mine:SlowGrowth", "--help-all"]
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    environment = {**os.environ, "PYTHONPATH": f"{root}{os.pathsep}{folder}" if found else root}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert ("--slow-growth.rate" in done.stdout) == found and (done.returncode == 0) == found, done.stderr
    assert found or "'mine:SlowGrowth' cannot be imported" in done.stderr
