"""A fault at one call of a whole command: its exit code, its last words, and the next command.

`make test-fault` tries a few; WARPGS_KILLS=200 tries 100, spread over the calls of all commands.
"""

import os
import random

import pytest

from tests.faults.calls import Call, numbered
from tests.faults.test_save_faults import FAULTS, REMEDY, Fault
from tests.faults.tiny_runs import OWN, SAME_BYTES, Reference, check_whole, digests, is_temporary, leftovers, words_of
from warpgs.app.cli import main
from warpgs.errors import ResourceError

pytestmark = pytest.mark.fault
COUNT = int(os.environ.get("WARPGS_KILLS", "0")) // 2
COMMANDS = ("fit", "fit", "fit", "resume", "resume", "render", "eval", "prune", "export", "convert", "mesh")
FEW = [("render", 5), ("eval", 6), ("prune", 7), ("convert", 9), ("mesh", 10)]
CASES = [(COMMANDS[i % len(COMMANDS)], i) for i in range(COUNT)] or FEW


def drawn(reference: Reference, command: str, index: int) -> tuple[int, Fault]:
    """Return the number of a call and a fault that it can have."""
    calls = reference.calls[command]
    draw = random.Random(index)
    while True:
        number, fault = draw.randrange(len(calls)), draw.choice(FAULTS)
        kind, path, _ = calls[number]
        on_log = fault.name == "lost" and path.endswith(".jsonl")  # nobody can tell what a file system lost of a log
        if kind != "step" and (kind == "write" or fault.name not in ("short", "lost")) and not on_log:
            return number + 1, fault


@pytest.mark.parametrize("command, index", CASES)
def test_a_command_with_a_fault(reference, tmp_path, capfd, record_property, command, index):
    work = tmp_path / "work"
    reference.before(command, work)
    before = digests(work)
    number, fault = drawn(reference, command, index)
    hit: list[Call] = []

    def faulty(call: Call) -> int | None:
        if call.number != number or call.kind == "step":
            return None
        hit.append(call)
        return fault(call)

    with numbered(work, faulty):
        code = main(words_of(command, reference.scene, work))
    said = capfd.readouterr().err
    what = f"{command}: {fault.name} at call {number}, {hit and (hit[0].kind, hit[0].path)}: {code}, {said}"
    record_property("fault", f"{command} {fault.name} {hit[0].kind if hit else 'none'}")
    assert code in (0, ResourceError.exit_code, *([130] if fault.name == "interrupt" else [])), what
    assert "defect" not in said and "Traceback" not in said and (code != 4 or REMEDY.search(said)), what
    # the checkpoints of a fit that lacks an image of an event hold a note on it
    same = tuple(s for s in SAME_BYTES if s != ".safetensors" or not hit or "sampling" not in hit[0].path.parts)
    check_after_fault(reference, command, work, before, hit[0].kind if hit else "", code, same, what)

    again = "resume" if command == "fit" and (work / "run" / "config.json").is_file() else command
    if command == "prune" and (work / "run-pruned").exists():
        return
    assert main(words_of(again, reference.scene, work)) == 0, what
    check_result(reference, command, work, before, same, what)


def check_after_fault(reference, command, work, before, kind, code, same, what) -> None:
    """Nothing is lost or half; only a file whose removal failed is left over, or a lock file that may be another's."""
    check_whole(work, ended=False)
    now = digests(work)
    left = [p for p in now if is_temporary(p)]
    assert not left or (kind in ("unlink", "lock") and len(left) == 1), f"{left} is left over; {what}"
    assert before.keys() <= now.keys(), what
    made = {digest for _, _, digest in reference.calls[command]} | set(reference.after[command].values())
    for path in now.keys() - set(left):
        if not path.startswith(OWN[command]):
            assert now[path] == before[path], f"{path}; {what}"
        elif path.endswith(same):
            assert now[path] == before.get(path) or now[path] in made, f"{path}; {what}"
    if code == 0 and kind != "unlink":
        check_result(reference, command, work, before, same, what)


def check_result(reference, command, work, before, same, what) -> None:
    """The command's results are there, and nothing else has changed."""
    assert leftovers(work) == [], what
    check_whole(work, ended=True)
    now, wanted = digests(work), reference.after[command]
    missing = {p for p in wanted if p.startswith(OWN[command])} - now.keys()
    assert all(p.startswith("run/sampling/") for p in missing), what  # a fit goes on without these, and says so
    for path, digest in now.items():
        if not path.startswith(OWN[command]):
            assert digest == before[path], f"{path}; {what}"
        elif path.endswith(same):
            assert digest == wanted[path], f"{path}; {what}"
