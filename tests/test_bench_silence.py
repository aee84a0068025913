"""Silences in a terminal are measured right."""

import sys

from bench.silence import Watch, watch


def test_a_frame_that_is_drawn_again_without_a_change_is_silence():
    """Escape sequences are no text; the longest silence is found with what stood before it."""
    seen = Watch()
    for now, data in ((1.0, "\x1b[?25l"), (2.0, "\x1b[2Kone 1 s"), (3.0, "\rone 1 s"), (7.0, "one 2 s"), (8.0, "\x1b[1A")):
        seen.write(now, data)
    seen.end(9.0)
    assert seen.first == 2.0 and max(seen.silences) == (5.0, 2.0, "one 1 s")


def test_a_command_runs_in_a_terminal(tmp_path):
    """It sees a terminal of 100 characters; its exit code is told."""
    code = "import os, sys; print(sys.stdout.isatty(), os.get_terminal_size().columns); sys.exit(3)"
    found = watch([sys.executable, "-c", code], tmp_path, {})
    assert found["after_text"] in ("", "True 100") and found["exit_code"] == 3
    assert 0 < found["first_text_s"] <= found["seconds"] and found["longest_silence_s"] <= found["seconds"]
