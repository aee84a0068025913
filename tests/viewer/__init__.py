"""Tests of the viewer."""

import time


def wait_shown(live) -> None:
    """Wait until a viewer of a fit has shown a first state."""
    until = time.monotonic() + 60
    while live._window is None:
        assert time.monotonic() < until
        time.sleep(0.02)
