"""Ctrl-C, SIGTERM and SIGHUP: one sentence and one exit code wherever they come, and none where they are ignored."""

import signal
import threading

import pytest

from warpgs.app.cli import main
from warpgs.pipeline.run.folder import load_checkpoint
from warpgs.process import ignored_signals, interrupting_signals, noted_signals
from warpgs.synthetic.demo import split_spec, write_demo

SIGNALS = [pytest.param(s, id=n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if (s := getattr(signal, n, None))]
CONTEXTS = [interrupting_signals, noted_signals, ignored_signals]
SENTENCE = "warpgs: interrupted; --resume continues from the last checkpoint\n"
UNSAVED = "warpgs: interrupted; no step was saved: run the same command again\n"


@pytest.fixture(autouse=True)
def handlers():
    """The handlers that a program starts with; whatever a test sets, those of pytest are back after it."""
    before = {s.values[0]: signal.getsignal(s.values[0]) for s in SIGNALS}
    for number in before:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("signals") / "scene"
    write_demo(folder, views=8, width=32, height=32)
    return folder


def fit(scene, out, *more):
    flags = ["--steps", "3", "--device", "cpu", "--preset", "3dgs", "--init.source", "random", "--init.random-count", "50"]
    return main(["fit", str(scene), "--split", split_spec(8), "--out", str(out), *flags, *more])


@pytest.mark.parametrize("context", CONTEXTS)
@pytest.mark.parametrize("number", SIGNALS)
def test_an_ignored_signal_stays_ignored(context, number):
    """As nohup and a shell's `&` leave it: neither noted, nor raised, nor handled in any other way afterwards."""
    signal.signal(number, signal.SIG_IGN)
    with context() as came:
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt:  # which would end pytest
            pytest.fail("the signal was raised")
        assert signal.getsignal(number) is signal.SIG_IGN and (came is None or not came())
    assert signal.getsignal(number) is signal.SIG_IGN


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_during_a_destructor_is_not_lost(number):
    """Python throws away what a destructor raises: the first Ctrl-C would do nothing."""

    class Thing:
        def __del__(self):
            signal.raise_signal(number)
            raised.append("not in the destructor")

    raised = []
    with pytest.raises(KeyboardInterrupt), interrupting_signals():
        Thing()
        threading.Event().wait(60)  # ended by the signal that comes again
        raised.append("not at all")
    assert raised == []


@pytest.mark.parametrize("context", CONTEXTS)
def test_other_threads_leave_signals_alone(context):
    """Python lets the main thread alone set handlers."""
    found = []

    def work():
        with context():
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [signal.default_int_handler]


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_is_noted_and_the_second_raised(number):
    with noted_signals() as came:
        signal.raise_signal(number)
        assert came()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


STAGES = [
    "fit.read_scene", "fit.Trainer", "fit.background_warmup", "fit.write_ply", "fit.evaluate_run", "fit.rule_report_of",
    "fit.write_report", "results.render_overview", "results.write_page",
]  # fmt: skip


@pytest.mark.parametrize(("stage", "number"), [(s, SIGNALS[i % len(SIGNALS)].values[0]) for i, s in enumerate(STAGES)])
def test_outside_the_steps_the_end_is_the_same(scene, tmp_path, capsys, monkeypatch, stage, number):
    """While the scene is read, priors are made, results are scored and written: code 130, and nothing but the sentence."""
    monkeypatch.setattr(f"warpgs.pipeline.run.{stage}", lambda *_, **__: signal.raise_signal(number))
    assert fit(scene, tmp_path / "run") == 130
    early = STAGES.index(stage) < 3
    assert capsys.readouterr().err == (UNSAVED if early else SENTENCE)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert (tmp_path / "run").exists() is not early  # nothing to continue


@pytest.mark.parametrize("number", SIGNALS)
def test_within_the_steps_the_one_in_progress_is_saved(scene, tmp_path, capsys, monkeypatch, number):
    """And a second signal in the same step ends the fit without it."""
    from warpgs.report.progress import EventLog

    write, times = EventLog.write, [1]

    def signalled(log, **values):
        write(log, **values)
        for _ in range(times[0]):
            signal.raise_signal(number)

    monkeypatch.setattr(EventLog, "write", signalled)
    assert fit(scene, tmp_path / "run") == 130 and load_checkpoint(tmp_path / "run")[1]["step"] == 1
    times[0] = 2
    assert fit(scene, tmp_path / "run", "--resume") == 130 and load_checkpoint(tmp_path / "run")[1]["step"] == 1
    assert capsys.readouterr().err == 2 * SENTENCE
    monkeypatch.undo()
    assert main(["fit", "--out", str(tmp_path / "run"), "--resume"]) == 0  # all else is as the run was started
    assert "continuing the run: preset 3dgs, 3 steps" in capsys.readouterr().out
    assert load_checkpoint(tmp_path / "run")[1]["step"] == 3


def test_more_signals_while_the_program_ends(monkeypatch, capsys):
    """One while it tidies up, one while it says its last words."""

    def tidy(*_):
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(signal.SIGINT)

    from warpgs.app import cli

    monkeypatch.setattr("warpgs.pipeline.run.export.export", tidy)
    say = cli.say
    monkeypatch.setattr(cli, "say", lambda *a, **k: (signal.raise_signal(signal.SIGINT), say(*a, **k)))
    try:
        code = main(["export", "run", "--to", "x.ply"])
    except KeyboardInterrupt:  # which would end pytest
        pytest.fail("the command does not end in good order")
    assert code == 130
    assert capsys.readouterr().err == "warpgs: interrupted\n"
