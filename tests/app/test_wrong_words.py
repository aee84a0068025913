"""A command line that cannot be read ends in one line that names the word and the fix, with exit code 2."""

import dataclasses

import pytest

from warpgs.app.cli import main
from warpgs.app.flags import parse_flags, refuse
from warpgs.errors import UsageError

WHOLE = "expected an integer, got"


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ("fit --ouut run", "unknown flag --ouut; did you mean --out?"),
        ("render run --views 3", "unknown flag --views; `warpgs render --help-all` lists the flags"),
        ("convert a.ply --to b.spz", "unknown flag --to; `warpgs convert --help-all` lists the flags"),
        ("fit scene -out run", "unknown flag -out; did you mean --out?"),
        ("fit scene run", "run is an extra argument; did you mean --out run?"),
        ("fit", "SCENE and --out PATH are missing; `warpgs fit --help` lists its arguments"),
        ("fit scene --out", "--out needs a value; `warpgs fit --help` lists its arguments"),
        ("fit scene --out --steps 3", "--out needs a value; `warpgs fit --help` lists its arguments"),
        ("fit scene --out run --steps abc", f"--steps: {WHOLE} 'abc'; `warpgs fit --help` lists its arguments"),
        (f"fit scene --out run --steps {2**63}", "--steps: expected an integer of at most 2^63 - 1, got '9223372036854775808'"),
        ("fit scene --out run --time-budget inf", "--time-budget: expected a finite number, got 'inf'"),
        ("fit scene --out run --time-budget 1e39", "--time-budget: expected a finite number of at most 3e+38, got '1e39'"),
        ("fit scene --out run --seed 1.5", f"--seed: {WHOLE} '1.5'; `warpgs fit --help` lists its arguments"),
        ("fit scene --out run --method.hier x", "--method.hier: expected true, false or none, got 'x'"),
        ("fit scene --out run --depth-mean 1 2", "unknown flag --depth-mean; the setting depth-mean was removed: give it in"),
        ("mesh run", "--out PATH is missing; `warpgs mesh --help` lists its arguments"),
        ("convert a", "TARGET is missing; `warpgs convert --help` lists its arguments"),
        ("demo", "FOLDER is missing; `warpgs demo --help` lists its arguments"),
        ("view --port x run", f"--port: {WHOLE} 'x'; `warpgs view --help` lists its arguments"),
        ("farm", "JOBS and --out PATH are missing; `warpgs farm --help` lists its arguments"),
    ],
)
def test_a_wrong_command_line_is_one_line(words, error, tmp_path, capsys, monkeypatch):
    """Nothing is made."""
    monkeypatch.chdir(tmp_path)
    assert main(words.split()) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"warpgs: {error}") and len(output.err.splitlines()) == 1 and not output.out
    assert not any(tmp_path.iterdir())


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


@pytest.mark.parametrize(("columns", "box"), [("30", True), ("30", False), ("100", True)])
def test_the_terminal_does_not_matter(columns, box, capsys, monkeypatch):
    """Narrow or wide, with or without the letters of a box."""
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setattr("tyro._fmtlib._FORCE_UTF8_BOXES", box)
    assert [main(words.split()) for words in ("mesh run", "view --port x run", "doctor x")] == [2, 2, 2]
    missing, wrong, stray = capsys.readouterr().err.splitlines()
    assert "--out PATH is missing; " in missing and f"--port: {WHOLE} 'x'; " in wrong and "x is an extra argument" in stray


def test_a_complaint_in_other_words_is_passed_on_in_one_line():
    """As another version of the parser may have them."""
    box = "╭─ Fault ────╮\n│ Something  │\n│ is wrong.  │\n│ ────────── │\n│ For more.. │\n╰────────────╯\n"
    with pytest.raises(UsageError, match=r"^Something is wrong.; `warpgs fit --help` lists its arguments$"):
        refuse(dataclasses.make_dataclass("Flags", []), [], "warpgs fit", box)
