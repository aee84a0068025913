"""A fit of several processes: what they write, and what they say when one is lost."""

import json
import os
import signal
import socket
import subprocess
import sys

import pytest

from tests.app import rank_that_dies
from warpgs import ranks
from warpgs.app.cli import main
from warpgs.errors import UsageError
from warpgs.pipeline.run.fit import fit
from warpgs.ranks import is_loopback, loopback_interface
from warpgs.report import progress


def started(count: int, *command: str) -> list[subprocess.Popen]:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = str(s.getsockname()[1])
    shared = os.environ | {"WORLD_SIZE": str(count), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "OMP_NUM_THREADS": "1"}
    return [
        subprocess.Popen(
            [sys.executable, *command], env=shared | {"RANK": str(rank), "LOCAL_RANK": str(rank)}, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )
        for rank in range(count)
    ]  # fmt: skip


def ended(processes: list[subprocess.Popen]) -> list[tuple[int, str, str]]:
    found = []
    try:
        for process in processes:
            out, errors = process.communicate(timeout=300)
            found.append((process.returncode, out, errors))
    finally:
        for process in processes:
            process.kill()
    return found


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no such signal")
@pytest.mark.parametrize(
    ("first", "then"), [pytest.param(2, 1, marks=pytest.mark.slow), pytest.param(3, 2, marks=pytest.mark.fault)]
)
def test_any_number_of_processes_fits_the_same_model(demo, tmp_path, capsys, first, then):
    """Some, of which one is killed; fewer that go on; and one alone, uninterrupted: the same PLY and the same state."""
    flags = [
        str(demo), "--device", "cpu", "--preset", "3dgs", "--steps", "8", "--batch", "5", "--dropout", "0.3",
        "--init.source", "random", "--init.random-count", "60", "--density.start", "1", "--density.every", "3",
        "--density.gradient", "1e-6", "--checkpoint-every", "2",
        "--optimizer.average-last", "0.75",
    ]  # fmt: skip
    shared = ["--out", str(tmp_path / "shared")]
    lost = started(first, rank_that_dies.__file__, str(first - 1), "5", *flags, *shared)
    lost[-1].wait(300)
    found = ended(lost)
    assert [code for code, _, _ in found] == [4] * (first - 1) + [-signal.SIGKILL]
    lines = [line for _, _, errors in found for line in errors.splitlines() if line.startswith("warpgs")]
    assert lines == [f"warpgs: rank {first - 1} of {first} was lost: the fit stops; --resume it, with any number of ranks"]

    if then == 1:
        assert main(["fit", *flags, *shared, "--resume"]) == 0
        out = capsys.readouterr().out
    else:
        (code, out, _), (other, silent, _) = ended(started(2, "-m", "warpgs", "fit", *flags, *shared, "--resume"))
        assert (code, other, silent) == (0, 0, "") and "ranks: 2 processes (gloo)" in out
    assert "continued from step 4" in out
    assert main(["fit", *flags, "--out", str(tmp_path / "alone")]) == 0
    for name in ("point_cloud.ply", "checkpoint.safetensors"):
        assert len({(tmp_path / run / name).read_bytes() for run in ("shared", "alone")}) == 1, name
    for run, count in (("shared", then), ("alone", 1)):
        assert f'"ranks": {count}' in (tmp_path / run / "metrics.json").read_text()


def test_variables_that_are_no_numbers_are_named_and_a_process_alone_joins_nobody(monkeypatch):
    monkeypatch.delenv("RANK", raising=False)
    assert ranks.join("cpu") is ranks.ALONE and ranks.ALONE.first
    for key, value in (("RANK", "0"), ("WORLD_SIZE", "1")):
        monkeypatch.setenv(key, value)
    assert ranks.join("cpu") is ranks.ALONE
    for name, value in (("RANK", "2"), ("RANK", "-1"), ("WORLD_SIZE", "two"), ("MASTER_PORT", "")):
        usual = {"RANK": "0", "WORLD_SIZE": "2", "LOCAL_RANK": "0", "MASTER_PORT": "29500"}
        for key, set_to in (usual | {name: value}).items():
            monkeypatch.setenv(key, set_to)
        with pytest.raises(UsageError, match=f"the environment variable {name} must be"):
            ranks.join("cpu")
    # interfaces are named for ranks of this machine alone, and not over those that the user named
    for name in ("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    assert ranks._stay_home("192.0.2.1") is None and "GLOO_SOCKET_IFNAME" not in os.environ
    monkeypatch.setenv("NCCL_SOCKET_IFNAME", "mine")
    assert ranks._stay_home("127.0.0.1") == "127.0.0.1"
    if sys.platform != "win32":
        assert os.environ["GLOO_SOCKET_IFNAME"] == loopback_interface() and os.environ["NCCL_SOCKET_IFNAME"] == "mine"


class Store(dict):
    def set(self, key, value):
        self[key] = value.encode()

    def check(self, keys):
        return all(k in self for k in keys)

    def add(self, key, number):
        self[key] = self.get(key, 0) + number
        return self[key]


def test_silence_of_another_machine_is_a_loss_after_a_while(unwatched, monkeypatch, capsys):
    """Not at once, nor where the process has said goodbye; and of two that find it one alone says so."""
    now = [100.0]
    monkeypatch.setattr(ranks.time, "monotonic", lambda: now[0])
    store = Store()
    first, second = (ranks.RankWatch(rank, 3, store, store) for rank in (0, 1))
    assert not first.is_lost(2)  # it is still to come
    store.set("beat/2", "7|1234|another machine")
    for seconds, lost in ((0, False), (ranks.LOST_SECONDS - 1, False), (2, True)):
        now[0] += seconds
        assert first.is_lost(2) is lost
    first.fail("warpgs: rank 2 is gone")
    second.fail("warpgs: rank 2 is gone")
    assert capsys.readouterr().err.splitlines() == ["warpgs: rank 2 is gone"]
    store.set("left/2", "")
    assert not first.is_lost(2)


@pytest.fixture
def unwatched(monkeypatch):
    """Watches without a thread, and no time passes; returns the times [s] that they would have slept."""
    slept = []
    monkeypatch.setattr(ranks.time, "sleep", slept.append)
    monkeypatch.setattr(ranks.threading.Thread, "start", lambda self: None)
    return slept


def test_the_first_rank_keeps_the_store_until_all_have_read_the_error(unwatched, monkeypatch):
    """Another rank has printed why all end. Without the store, a third one would print that rank 0 is gone."""
    monkeypatch.setattr(ranks, "BEAT_SECONDS", 0.001)
    monkeypatch.setattr(ranks.os, "_exit", sys.exit)
    store = Store(spoke=1)
    for rank, waits in ((0, [3 * 0.001]), (1, [])):
        unwatched.clear()
        with pytest.raises(SystemExit):
            ranks.RankWatch(rank, 3, store, store)._watch()
        assert unwatched == waits
    store = Store()  # all ranks read the texts of all
    watches = [ranks.RankWatch(rank, 3, store, store) for rank in range(3)]
    for rank in (1, 2):
        store.set(f"text/{rank}", f"of {rank}")
    assert watches[0].texts("of 0") == ["of 0", "of 1", "of 2"] and ranks.ALONE.texts("own") == ["own"]


def test_the_lowest_rank_of_a_machine_reports_the_loss_of_the_store(unwatched, monkeypatch, capsys):
    """Its process, rank 0, was killed, and no rank can ask the others; rank 3 is on another machine."""
    store, gone = Store(), subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    watches = [ranks.RankWatch(rank, 4, store, store) for rank in range(4)]
    store.set("beat/0", f"1|{gone.pid}|{watches[0].here}")
    store.set("beat/3", f"1|{os.getpid()}|another machine")
    watches[3].here = "another machine"
    for watch in watches[1:]:
        for other in range(4):
            watch.is_lost(other)

    def broken(*_):
        raise RuntimeError("Connection reset by peer")

    monkeypatch.setattr(Store, "add", broken)
    for watch, printed in zip(watches[1:], (1, 0, 1), strict=True):
        unwatched.clear()
        watch.fail("warpgs: rank 0 is gone")
        assert len(capsys.readouterr().err.splitlines()) == printed
        assert len(unwatched) == printed  # it stays while the others look for it


class Two(ranks.Ranks):
    count = 2

    def __init__(self, changed: str):
        self.changed = changed

    def texts(self, own: str) -> list[str]:
        return [own, json.dumps(json.loads(own) | {self.changed: "of the other"})]


@pytest.mark.parametrize(
    "changed",
    ["the version of warpgs", "the scene", "the split", "the settings or the code", "the checkpoint"],
)
def test_ranks_that_do_not_fit_the_same_are_refused(demo, tmp_path, changed):
    """Each would take its part of other steps, and the model would be that of no fit; nothing is written."""
    with pytest.raises(UsageError, match=f"rank 1 differs from rank 0 in {changed}: "):
        fit(demo, out=tmp_path / "run", device="cpu", steps=1, batch=2, ranks=Two(changed), verbose=False)
    assert not (tmp_path / "run" / "config.json").exists()


def test_the_error_of_a_rank_is_printed_whole(monkeypatch):
    """Signals are ignored meanwhile: torchrun sends SIGTERM to all once one has ended."""
    handlers = []
    watch = type("Watch", (), {"fail": lambda self, line: handlers.append(signal.getsignal(signal.SIGTERM))})()
    monkeypatch.setattr(ranks, "_joined", ranks.Group(0, 2, "gloo", watch))
    monkeypatch.setattr(ranks.os, "_exit", sys.exit)
    with pytest.raises(SystemExit):
        ranks.last_words("warpgs: no", 2)
    assert handlers == [signal.SIG_IGN]


def test_the_end_of_a_process_is_seen(monkeypatch):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    if hasattr(os, "waitid"):
        os.waitid(os.P_PID, ended.pid, os.WEXITED | os.WNOWAIT)  # it has ended, and stays for its parent to ask
    else:
        ended.wait()
    assert ranks.is_gone(ended.pid) and not ranks.is_gone(os.getpid())
    ended.wait()

    def none(*_):
        raise FileNotFoundError

    monkeypatch.setattr(ranks.Path, "read_text", none)  # every system has a name
    assert ranks.machine() == ranks.platform.node()


LISTENING = """
import json, sys
from warpgs.ranks import listening_at
from warpgs.ranks import join
import torch
ranks = join("cpu")
ranks.gather(torch.ones(1), torch.empty(2))
found = listening_at()
ranks.part(); ranks.leave()
print(json.dumps(found))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="torch takes no socket of ours there")
def test_ranks_of_one_machine_listen_there_alone():
    """The store and gloo, on both ranks; and nothing is said about it."""
    for code, out, errors in ended(started(2, "-c", LISTENING)):
        assert code == 0, errors
        (line,) = out.splitlines()
        assert json.loads(line) and all(is_loopback(ip) for ip, _ in json.loads(line)), line


@pytest.mark.parametrize("rank, shown", [("0", ["starting eval"]), ("1", [])])
def test_a_terminal_shows_the_start_of_the_first_rank_only(monkeypatch, capsys, rank, shown):
    lines = []
    monkeypatch.setenv("RANK", rank)
    monkeypatch.setattr(progress, "is_live", lambda: True)
    monkeypatch.setattr(progress._STATUS, "show", lines.append)
    assert main(["eval", "nowhere"]) == 3 and lines == shown
