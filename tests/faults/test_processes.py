"""Commands that die, and commands that want one folder at the same time: nothing is lost, half or mixed."""

import json
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import lock_descriptor

from tests.faults import tiny_runs
from warpgs.files import LOCK
from warpgs.folders import NAMES as OWN_NAMES
from warpgs.pipeline.run.export import export

# Commands that die before one of their calls: nothing is lost, nothing is half, and the next command goes on from there.
#
# A process kills itself before a call of a known number, so that no clock decides where it dies. `make test-fault` kills one;
# WARPGS_KILLS=200 spreads that many kills over all, those between the opening of a file and its removal first. What each kill
# came before is a property of its test in pytest's `--junit-xml` (`-o junit_family=xunit1`).

pytestmark = pytest.mark.fault
KILLS = int(os.environ.get("WARPGS_KILLS", "0"))
SHARES = {
    "fit": 0.2, "resume": 0.14, "eval": 0.08, "render": 0.076, "prune": 0.06, "export": 0.026, "convert": 0.024, "mesh": 0.026,
    "view": 0.026, "compare": 0.1, "worker": 0.1, "farm": 0.02, "poses": 0.092, "level": 0.03,
}  # fmt: skip
"""Parts of all kills by command: more for those with many calls, fewer for those that take long."""
CASES = [(c, i) for c in tiny_runs.COMMANDS for i in range(round(SHARES[c] * KILLS))] or [("fit", 0)]


def chosen(calls: list[tuple[str, str, str]], count: int) -> list[int]:
    """Return numbers of calls to die before: two in three while a temporary file is there, the others anywhere; each once."""
    inside, there = [], set()
    for number, (kind, path, _) in enumerate(calls, 1):
        if there:
            inside.append(number)
        if OWN_NAMES.fullmatch(Path(path).name):
            {"open": there.add, "mkdir": there.add, "unlink": there.discard}.get(kind, lambda _: None)(path)
    draw = random.Random(0)
    draw.shuffle(inside)
    taken = inside[: (2 * count + 2) // 3]
    others = [n for n in range(1, len(calls) + 1) if n not in taken]
    draw.shuffle(others)
    return taken + others[: count - len(taken)]


def check_after_kill(reference: tiny_runs.Reference, command: str, work: Path, before: dict[str, str]) -> None:
    """Look at what a killed command left: all that was there before, as it was or as the command makes it, and all whole."""
    tiny_runs.check_whole(work, ended=False)
    now = tiny_runs.digests(work)
    assert before.keys() <= now.keys(), "lost"
    made = set(reference.after[command].values())
    if command != "level":  # others write some files several times
        made |= {digest for _, _, digest in reference.calls[command]}
    for path, digest in now.items():
        if tiny_runs.is_temporary(path):
            continue
        if not path.startswith(tiny_runs.OWN[command]):
            assert digest == before[path], f"{path} is not of this command"
        elif path.endswith(tiny_runs.SAME_BYTES) or command == "level":
            assert digest == before.get(path) or digest in made, f"{path} is neither the old file nor the new one"


def go_on(reference: tiny_runs.Reference, command: str, work: Path) -> tiny_runs.Done:
    """Run the command that a user would run next."""
    if command == "fit" and (work / "run" / "config.json").is_file():
        command = "resume"
    made = {"prune": work / "run-pruned", "poses": work / "posed"}.get(command)
    if made is not None and made.is_dir():  # it would be refused a second time
        source = made if command == "prune" else work / "run"
        done = tiny_runs.child(work, ["export", str(source), "--to", str(work / "b.ply")])
        (work / "b.ply").unlink()
        return done
    return tiny_runs.child(work, tiny_runs.words_of(command, reference.scene, work))


@pytest.mark.parametrize("command, index", CASES)
def test_nothing_is_lost_or_half_after_a_kill(reference, tmp_path, record_property, command, index):
    if not tiny_runs.can_run(command):
        pytest.skip(f"{tiny_runs.NEEDS[command]} is not installed")
    work = tmp_path / "work"
    reference.before(command, work)
    before, calls = tiny_runs.digests(work), reference.calls[command]
    numbers = chosen(calls, sum(c == command for c, _ in CASES))
    if index >= len(numbers):
        pytest.skip(f"{command} has {len(calls)} calls, and each has its kill")
    number = numbers[index]
    done = tiny_runs.child(work, tiny_runs.words_of(command, reference.scene, work), kill_at=number)
    while done.code == 0 and (number := min(number - 1, len(done.calls[command]))):  # a farm notes the state now and then
        shutil.rmtree(work)
        reference.before(command, work)
        done = tiny_runs.child(work, tiny_runs.words_of(command, reference.scene, work), kill_at=number)
    assert done.code not in range(6), done.said
    (made,) = done.calls.values()
    assert len(made) == number
    record_property("killed", f"{command} {made[-1][0]}")
    check_after_kill(reference, command, work, before)
    for path in work.rglob(LOCK):
        with path.open("r+b") as file:
            assert lock_descriptor(file.fileno(), blocking=False), f"{path} is still held"

    tiny_runs.succeeded(go_on(reference, command, work))
    assert tiny_runs.leftovers(work) == []
    tiny_runs.check_whole(work, ended=True)
    now, wanted = tiny_runs.digests(work), reference.after[command]
    assert {p for p in now if p.startswith(tiny_runs.OWN[command])} == {
        p for p in wanted if p.startswith(tiny_runs.OWN[command])
    }
    for path, digest in now.items():
        if not path.startswith(tiny_runs.OWN[command]):
            assert digest == before[path], path
        elif path.endswith(tiny_runs.SAME_BYTES):
            assert digest == wanted[path], path


GROWING = ("metrics.jsonl", "log.txt")
"""Files that grow by lines."""


def test_calls_are_seen(reference):
    """A kind of call that a command is known to make and that is not numbered would never be killed at."""
    kinds = {c: {kind for kind, _, _ in calls} for c, calls in reference.calls.items()}
    assert kinds["fit"] >= {"open", "write", "fsync", "replace", "unlink", "mkdir", "lock", "truncate", "step"}
    assert all(k >= {"open", "write", "fsync", "replace", "unlink"} for k in kinds.values())
    for command, calls in reference.calls.items():
        replaced = {path for kind, path, _ in calls if kind == "replace"}
        assert sum(kind == "fsync" for kind, _, _ in calls) >= len(replaced) > 0, command
    # each file that is there at the end was put there as a whole, under a name of ours, those of libraries in C too
    placed = {path for calls in reference.calls.values() for kind, path, _ in calls if kind == "replace"}
    assert placed >= {"made", "run-pruned"}  # folders, which take their files along
    for command, beginnings in tiny_runs.OWN.items():
        opened = {path for kind, path, _ in reference.calls.get(command, ()) if kind == "open"} - {"tmp"}  # nameless
        assert not [p for p in opened if not tiny_runs.is_temporary(p) and Path(p).name not in GROWING], command
        for path in (p for p in reference.after.get(command, ()) if p.startswith(beginnings)):
            there = {path, *(p.as_posix() for p in Path(path).parents)}
            assert there & placed or Path(path).name in GROWING, path
    # a checkpoint comes after the images of events before it: a fit that goes on from it does not write them
    placed = [Path(path).name for kind, path, _ in reference.calls["fit"] if kind == "replace"]
    checkpoints = [i for i, name in enumerate(placed) if name == "checkpoint.safetensors"]
    for event in (n for n in placed if n.startswith("0000")):
        assert placed.index(event) < checkpoints[int(event[:6]) // 10], placed


# Two commands that want one folder at the same time: one gets it, the other says whose it is, nothing is mixed. Both are ready
# before either may go, and who has got the folder waits at its first step until the other has ended: no clock decides anything.
# `make test-fault` runs one such pair, WARPGS_KILLS=200 twenty.

RACES = max(1, int(os.environ.get("WARPGS_KILLS", "0")) // 10)
PAIRS = (("fit", "fit"), ("resume", "resume"), ("fit", "resume"))
RACES_CASES = [(*PAIRS[i % 3], i) for i in range(RACES)]
GO = """
import sys
import warpgs.pipeline.run.fit
from warpgs.app.cli import main
from warpgs.pipeline.run import results
from warpgs.report.progress import EventLog

def at_first_step(log, **values):
    EventLog.write = write
    print("fitting", flush=True)
    sys.stdin.readline()
    write(log, **values)

write, EventLog.write = EventLog.write, at_first_step
results.render_overview = lambda *_: None
print("ready", flush=True)
sys.stdin.readline()
sys.exit(main(sys.argv[1:]))
"""


def started(words: list[str]) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-P", "-c", GO, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env=tiny_runs.environment(), text=True, encoding="utf-8",
    )  # fmt: skip


def go(process: subprocess.Popen) -> None:
    process.stdin.write("go\n")
    process.stdin.flush()


@pytest.mark.parametrize("one, other, index", RACES_CASES)
def test_one_of_two_gets_the_folder(reference: tiny_runs.Reference, tmp_path, one, other, index):
    work = tmp_path / "work"
    reference.before("fit" if one == other == "fit" else "resume", work)
    # with two seeds, mixed results are visible; a continued run has the seed it was started with
    seeds = ["1", "2"] if one == other == "fit" else ["0", "0"]
    processes = [started([*tiny_runs.words_of(c, reference.scene, work), "--seed", s]) for c, s in zip((one, other), seeds)]
    try:
        for p in processes:
            assert "ready\n" in iter(p.stdout.readline, "")
        for p in processes[:: 1 if index % 2 else -1]:
            go(p)
        fitting = ["fitting\n" in iter(p.stdout.readline, "") for p in processes]
        assert sorted(fitting) == [False, True], [p.communicate() for p in processes]
        winner, loser = processes[fitting.index(True)], processes[fitting.index(False)]
        said = loser.stderr.read()
        if one == other:
            assert loser.wait() == 4 and "choose another folder" in said, said
            assert f"process {winner.pid} on" in said or "another process is writing" in said, said  # before it has signed
        else:  # a fit takes no folder that holds a run; while somebody writes there, resuming is no way out
            words = {4: "choose another folder", 2: "exists already; choose another --out, or continue that run with --resume"}
            assert loser is processes[0] and words[loser.wait()] in said, said  # 2: it looked before the other locked
        go(winner)
        _, errors = winner.communicate()
        assert winner.returncode == 0, errors
    finally:
        for p in processes:
            p.kill()
            p.communicate()
    check_one_run(work, int(seeds[fitting.index(True)]))
    if one != other or one == "resume":
        assert tiny_runs.digests(work)["run/point_cloud.ply"] == reference.after["fit"]["run/point_cloud.ply"]


def check_one_run(work, seed: int) -> None:
    run = work / "run"
    assert tiny_runs.leftovers(work) == []
    tiny_runs.check_whole(work, ended=True)
    record, metrics = (json.loads((run / n).read_text("utf-8")) for n in ("config.json", "metrics.json"))
    assert record["config"]["seed"] == metrics["seed"] == seed and record["config_hash"] == metrics["config_hash"]
    export(run, work / "of_checkpoint.ply")
    assert (work / "of_checkpoint.ply").read_bytes() == (run / "point_cloud.ply").read_bytes()
    last = json.loads((run / "metrics.jsonl").read_bytes().splitlines()[-1])
    assert last["count"] == metrics["gaussians"]
