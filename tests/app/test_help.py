"""Help on one screen: what it says is what the code does, and it imports nothing that takes time."""

import dataclasses
import re
import subprocess
import sys

import pytest

from warpgs.app import cli
from warpgs.app.cli import COMMANDS, GROUPS, main
from warpgs.app.fit import request_of
from warpgs.app.flags import REMOVED, parse_flags
from warpgs.io.folder import READERS, Reader
from warpgs.io.load import SPECS
from warpgs.kernels.cameras import CAMERA_MODELS, CameraModel
from warpgs.pipeline.train.loss import LOSS_TERMS, LossTerm
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.base import STRATEGIES, Strategy
from warpgs.pipeline.train.view_modules import VIEW_MODULES

BASE = ["SCENE", "--out", "RUN"]
SCENE_FIELDS = {"split", "downscale", "max_side", "masks", "depths"}


def printed(capsys, *words):
    assert main(list(words)) == 0
    return capsys.readouterr().out.splitlines()


@pytest.mark.parametrize("words", [["fit", "scene", "-h"], ["--help"]])
def test_help_fits_one_screen(capsys, words):
    lines = printed(capsys, *words)
    assert 20 < len(lines) <= 45 and max(map(len, lines)) <= 80


def test_the_two_parts_of_priors_are_named(capsys):
    text = "\n".join(printed(capsys, "priors", "--help"))
    assert "warpgs priors show SCENE" in text and "warpgs priors export --model" in text and "--help" in text


def test_the_help_of_a_command_is_that_of_the_parser(capsys):
    """Every flag with its description and default, by either word."""
    for name, stated in {
        "farm": ["--per-gpu INT", "share a GPU. (default: 1)"],
        "plot": ["--cameras, --no-cameras", "Show the cameras. (default: True)", "(default: 1600 1000)"],
        "compare": ["Scene folders.", "--out PATH", "--black-is-empty", "quick: a first look"],
        "convert": ["File of Gaussians to read", "--spz.version INT", "--no-clean"],
        "export": ["File to write", "  .html: a page"],
        "priors show": ["--depth-model", "Folder for PNG sheets"],
        "priors export": ["--model", "ONNX file to write"],
    }.items():
        for word in ("-h", "--help-all"):
            with pytest.raises(SystemExit) as end:
                main([*name.split(), word])
            text = capsys.readouterr().out
            assert end.value.code == 0 and [part for part in stated if part not in text] == [], name


@dataclasses.dataclass(frozen=True)
class Open:
    """Settings that may be left open."""

    switch: bool | None = True
    whole: int | None = 1
    number: float | None = 1.0


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("--switch none --whole none --number None", Open(None, None, None)),
        ("--switch true --whole 3", Open(True, 3)),
        ("--switch False --number 2", Open(False, 1, 2.0)),
    ],
)
def test_open_settings_take_none_and_switches_in_any_case(words, found):
    assert parse_flags(Open, words.split(), "warpgs fit", "") == found


def test_a_removed_flag_names_what_replaces_it(capsys, monkeypatch):
    monkeypatch.setitem(REMOVED, "--old-name", "use --new-name")
    assert main(["demo", "d", "--old_name=3"]) == 2
    assert capsys.readouterr().err == "warpgs: --old-name was removed: use --new-name\n"


def test_the_help_of_fit_imports_nothing_heavy():
    heavy = "{'torch', 'warp', 'numpy', 'tyro'}"
    code = f"import sys; from warpgs.app.cli import main; main(['fit', '--help']); print({heavy} & {{*sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "set()"


def test_all_flags_are_one_word_further(capsys):
    """--help-all is the help of the parser, with every flag of the short one and those of the groups."""
    help_all = "--help-all"
    with pytest.raises(SystemExit) as end:
        main(["fit", help_all])
    text = capsys.readouterr().out
    assert end.value.code == 0 and all(name in text for name, *_ in cli.FLAGS)
    assert "--stopping.min-gain-db" in text and len(text.splitlines()) > 200


def test_every_command_has_one_purpose(capsys):
    assert sorted(name for names in GROUPS.values() for name in names) == sorted(COMMANDS)
    text = "\n".join(printed(capsys, "--help"))
    assert all(f"\n{purpose}:\n" in text for purpose in GROUPS) and all(about in text for about in COMMANDS.values())


@pytest.mark.parametrize(("flag", "word", "default"), [f[:3] for f in cli.FLAGS if f[0] != "--out"])
def test_flags_and_their_defaults_are_those_of_the_parser(flag, word, default):
    """A flag is a switch where it has no value, and what it does not say of itself is None."""
    request = request_of(BASE, "")
    name = flag.removeprefix("--").replace("-", "_")
    owner = request.scene if name in SCENE_FIELDS else request if name in ("device", "resume") else request.config
    if name == "view":
        value = request.view_port is not None
    elif name in VIEW_MODULES.names():
        value = name in [m.name for m in request.config.view_modules]
    else:
        value = getattr(owner, name)
    assert default == ("" if value is None else str(value)) and (word == "") == isinstance(value, bool)
    if not word:
        assert request_of([*BASE, flag], "") != request


def test_steps_that_a_preset_s_line_names_are_its_own():
    for name, line in PRESETS.described().items():
        stated, config = re.search(r"([0-9]+) steps", line), PRESETS[name]
        assert (int(stated[1]) if stated else FitConfig().max_steps) == (config.steps or config.max_steps)


def test_what_is_registered_is_in_the_help(capsys, monkeypatch):
    """Presets on one screen; these, strategies, loss terms, readers and camera models where every flag is."""
    monkeypatch.setattr(PRESETS, "_made", dict(PRESETS._made))
    monkeypatch.setattr(PRESETS, "_about", dict(PRESETS._about))
    PRESETS.register("mine", PRESETS["quick"], "one of my own")
    assert "  mine           one of my own" in printed(capsys, "fit", "--help")
    kinds = {STRATEGIES: Strategy, LOSS_TERMS: LossTerm, READERS: Reader, CAMERA_MODELS: CameraModel}
    for registry, base in kinds.items():
        registry.names()
        monkeypatch.setattr(registry, "_classes", dict(registry._classes))
        registry.register("my_" + registry.kind.replace(" ", "_"))(type("Mine", (base,), {"__doc__": "A part of mine. More."}))
    with pytest.raises(SystemExit):
        main(["fit", "--help-all"])
    text = capsys.readouterr().out
    for registry in kinds:
        lines = registry.described()
        assert lines["my_" + registry.kind.replace(" ", "_")] == "A part of mine" and all(lines.values())
        assert all(" ".join(f"{name}: {about}".split()) in " ".join(text.split()) for name, about in lines.items())
    assert all(f"{name}: {about}" in " ".join(text.split()) for name, about in PRESETS.described().items())


def test_splits_are_those_of_the_code():
    kinds = ", ".join(cli.SPLITS).split(", ")
    assert sorted(kinds) == sorted(re.split(r", (?:or )?", SPECS))


def test_choices_are_those_of_the_code():
    text = {f[0]: f[3] for f in cli.FLAGS}
    fields = request_of(BASE, "").config
    for color in re.findall(r"auto|mean|scene|black|white", text["--background"]):
        dataclasses.replace(fields, background=color)
    for how in ("ignore", "cutout"):
        assert how in text["--masks"] and request_of([*BASE, "--masks", how], "").scene.masks == how


@pytest.mark.parametrize("line", cli.EXAMPLES)
def test_examples_parse(line):
    program, command, *words = line.split()
    assert (program, command) == ("warpgs", "fit") and request_of(words, "").out.name == "run"
