"""`warpgs doctor`: check this machine. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import parse_flags
from warpgs.errors import UsageError
from warpgs.report.progress import Stages, waiting
from warpgs.runtime.imports import fast_imports
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help.

    Raises:
        UsageError: Flags exclude each other, or a value is invalid.
    """

    @dataclass(frozen=True)
    class Doctor:
        warm: bool = False
        """Compile the kernels of a fit with pinhole cameras for this machine's devices, and skip the checks."""
        repeat: Path | None = None
        """File not_finite.safetensors of a run: repeat the saved step, name the non-finite values, and skip the checks."""
        device: str = "auto"
        """Device for --repeat: auto, cpu or cuda."""

    a = parse_flags(Doctor, arguments, "warpgs doctor", about)
    if a.repeat is None and a.device != "auto":
        raise UsageError("--device requires --repeat")
    if a.repeat is not None:
        from warpgs.pipeline.runs.commands import repeat_failed_step

        for line in repeat_failed_step(a.repeat, a.device):
            say(line)
        return 0
    if a.warm:
        with fast_imports():
            from warpgs.pipeline.runs.precompile import print_warming
        waiting()("compiling kernels")
        print_warming()
        return 0
    from warpgs.app.doctor import diagnose, print_report

    stages = Stages()
    stages("checking this machine")
    with fast_imports():
        findings = diagnose(waiting())
    stages.clear()
    return print_report(findings)
