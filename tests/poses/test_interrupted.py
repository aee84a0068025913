"""Ctrl-C while the process that calls pycolmap runs."""

import os
import signal
import subprocess
import sys

import pytest


@pytest.mark.skipif(sys.platform == "win32", reason="there are no process groups")
@pytest.mark.parametrize("everyone", [False, True], ids=["warpgs alone", "its group, as a terminal does"])
def test_ctrl_c_ends_both_processes_and_leaves_nothing(sfm, tmp_path, photographs, everyone):
    """One sentence, exit code 130, no process and no file left."""
    # tests may run in the background, where a shell has Ctrl-C ignored and their children inherit that
    heeding = (
        "import signal, sys; signal.signal(2, signal.default_int_handler); from warpgs.app.cli import main; sys.exit(main())"
    )
    command = [sys.executable, "-c", heeding, "poses", str(photographs), "--out", str(tmp_path / "deep" / "scene")]
    process = subprocess.Popen(
        [*command, "--threads", "1"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    lines = []
    for line in process.stdout:
        lines.append(line)
        if "finding features" in line:
            break
    (os.killpg if everyone else os.kill)(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, "warpgs: interrupted\n"), lines
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
    assert not list(tmp_path.rglob("*.tmp")) and not list(tmp_path.rglob("scene"))
