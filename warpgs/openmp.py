"""OpenMP's idle threads: they sleep if warpgs is imported before torch, else they spin."""

import functools
import os
import sys
import warnings

VARIABLE = "OMP_WAIT_POLICY"
"""Environment variable that OpenMP reads once, when torch is imported."""

SPINNING = "torch" in sys.modules and VARIABLE not in os.environ
"""True where torch was imported before warpgs, and the environment does not set the variable."""


def let_idle_threads_sleep() -> None:
    """Let OpenMP's idle threads sleep in this process, if torch is not imported yet, and in its children."""
    # Between loops, OpenMP's threads spin on cores that our own launches need. On two busy cores a backward pass then
    # took six times as long. A variable that is already set is not changed.
    os.environ.setdefault(VARIABLE, "passive")


@functools.cache
def warn_if_spinning() -> None:
    """Warn once if torch was imported before warpgs. The warning names the line that called the package."""
    if SPINNING:
        frame, level = sys._getframe(), 1
        while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in ("warpgs", "torch"):
            frame, level = frame.f_back, level + 1
        fix = f"set {VARIABLE}=passive, call torch.set_num_threads(1), or import warpgs before torch"
        warnings.warn(f"idle threads of torch slow down rendering on a CPU: {fix}", RuntimeWarning, stacklevel=level)
