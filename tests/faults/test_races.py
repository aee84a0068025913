"""Two commands that want one folder at the same time: one gets it, the other says whose it is, and nothing is mixed.

Both processes are ready before either may go, and who has got the folder waits at its first step until the other has ended: no
clock decides anything. `make test-fault` runs one such pair, WARPGS_KILLS=200 twenty.
"""

import json
import os
import subprocess
import sys

import pytest

from tests.faults.tiny_runs import Reference, check_whole, digests, environment, leftovers, words_of
from warpgs.pipeline.run.export import export

pytestmark = pytest.mark.fault
RACES = max(1, int(os.environ.get("WARPGS_KILLS", "0")) // 10)
PAIRS = (("fit", "fit"), ("resume", "resume"), ("fit", "resume"))
CASES = [(*PAIRS[i % 3], i) for i in range(RACES)]
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
        env=environment(), text=True, encoding="utf-8",
    )  # fmt: skip


def go(process: subprocess.Popen) -> None:
    process.stdin.write("go\n")
    process.stdin.flush()


@pytest.mark.parametrize("one, other, index", CASES)
def test_one_of_two_gets_the_folder(reference: Reference, tmp_path, one, other, index):
    work = tmp_path / "work"
    reference.before("fit" if one == other == "fit" else "resume", work)
    # of two seeds, so that what is mixed shows; a continued run has the seed it was started with
    seeds = ["1", "2"] if one == other == "fit" else ["0", "0"]
    processes = [started([*words_of(c, reference.scene, work), "--seed", s]) for c, s in zip((one, other), seeds)]
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
            assert loser is processes[0] and loser.wait() == 4 and "choose another folder" in said, said
        go(winner)
        _, errors = winner.communicate()
        assert winner.returncode == 0, errors
    finally:
        for p in processes:
            p.kill()
            p.communicate()
    check_one_run(work, int(seeds[fitting.index(True)]))
    if one != other or one == "resume":
        assert digests(work)["run/point_cloud.ply"] == reference.after["fit"]["run/point_cloud.ply"]


def check_one_run(work, seed: int) -> None:
    """Settings, scores, checkpoint, log and PLY are of one run."""
    run = work / "run"
    assert leftovers(work) == []
    check_whole(work, ended=True)
    record, metrics = (json.loads((run / n).read_text("utf-8")) for n in ("config.json", "metrics.json"))
    assert record["config"]["seed"] == metrics["seed"] == seed and record["config_hash"] == metrics["config_hash"]
    export(run, work / "of_checkpoint.ply")
    assert (work / "of_checkpoint.ply").read_bytes() == (run / "point_cloud.ply").read_bytes()
    last = json.loads((run / "metrics.jsonl").read_bytes().splitlines()[-1])
    assert last["count"] == metrics["gaussians"]
