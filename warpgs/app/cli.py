"""The command line: finds the command, runs it, and reports errors in one line with an exit code."""

import contextlib
import importlib
import os
import sys

from warpgs.app.failures import report_defect, report_no_memory
from warpgs.app.fit_help import help_lines, wants_help
from warpgs.errors import UsageError, WarpgsError
from warpgs.report.progress import waiting
from warpgs.runtime.device_memory import is_out_of_memory
from warpgs.runtime.file_names import use_utf8_names
from warpgs.runtime.imports import fast_imports
from warpgs.runtime.output_streams import careful_output
from warpgs.runtime.ranks import last_words
from warpgs.runtime.stop_signals import ignored_signals, interrupting_signals
from warpgs.runtime.terminal import accept_all_letters, say
from warpgs.suggestion import did_you_mean
from warpgs.temporary import system_folder
from warpgs.version import __version__

COMMANDS = {
    "demo": "write a synthetic scene",
    "poses": "find the poses of photographs or a video; writes a scene folder",
    "fit": "fit Gaussians to a scene folder and fill a run folder",
    "view": "show a run, a PLY file or a running fit in a browser",
    "render": "render a run as a film: along a path, its views, or keyframes",
    "plot": "show a run's cameras and Gaussians in one image",
    "priors": "show depth and saliency before a fit, or write networks as ONNX",
    "export": "write a run's Gaussians to a file or a web page",
    "convert": "write a file of Gaussians or cameras in another format",
    "mesh": "make a mesh of a run's surfaces: .ply, .glb",
    "prune": "shrink a finished model within a PSNR budget",
    "eval": "score a run again on its held-out views",
    "compare": "fit presets to scenes with several seeds; tables and plots",
    "ablate": "fit a preset with one part changed at a time; tables and plots",
    "convert-lpips": "convert LPIPS weights for --lpips-weights",
    "farm": "fit many scenes: on all GPUs, with Ray, or on Slurm",
    "doctor": "check this machine: devices, packages, fixes",
}
"""Commands by name, in the order of the help, each with a line about it."""

GROUPS = {
    "start": ("demo", "poses", "fit"),
    "look": ("view", "render", "plot", "priors"),
    "share": ("export", "convert", "mesh", "prune"),
    "measure": ("eval", "compare", "ablate", "convert-lpips"),
    "many scenes": ("farm",),
    "this machine": ("doctor",),
}
"""Names of the commands by purpose."""


PRINTING = ("doctor", "compare", "ablate")
"""Commands that print their result on the terminal."""
ASKING = {"-h", "--help", "--help-all", "help", "--version", "-V"}
"""Arguments for which a command only prints text."""


def _help() -> str:
    width = max(map(len, COMMANDS))
    groups = (
        "\n".join([f"{purpose}:", *(f"  {name:<{width}}  {COMMANDS[name]}" for name in names)])
        for purpose, names in GROUPS.items()
    )
    return (
        f"warpgs {__version__}: from a handful of photographs to a 3D Gaussian scene\n\n"
        "usage: warpgs COMMAND [flags]\n\n" + "\n\n".join(groups) + "\n\n"
        "`warpgs COMMAND --help` lists a command's flags.\n"
        "First steps: warpgs demo scene && warpgs fit scene --out run\n"
    )


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns its exit code: 0 done, 2 usage, 3 data, 4 resources, 5 defect or NaN, 130 interrupted.

    Raises:
        SystemExit: A command has printed its help.
    """
    if arguments is None:
        use_utf8_names()
    with contextlib.suppress(OSError):  # no folder for temporary files: a command that needs one raises the error
        system_folder()
    words = sys.argv[1:] if arguments is None else arguments
    prints = words[:1] in ([], *([name] for name in PRINTING)) and "--warm" not in words
    with careful_output(prints or bool(ASKING & {*words})) as output:
        accept_all_letters()
        try:
            with interrupting_signals():
                return output.exit_code(_run(words))
        except SystemExit as e:  # after the help of a command
            if e.code or not (code := output.exit_code(0)):
                raise
            raise SystemExit(code) from e


def _run(arguments: list[str]) -> int:
    """Run one command; an error becomes one line and an exit code."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        for line in _help().splitlines():
            say(line)
        return 0 if arguments else 2
    if arguments[0] in ("--version", "-V"):
        say(f"warpgs {__version__}")
        return 0
    name = arguments[0]
    try:
        if name not in COMMANDS:
            hint = did_you_mean(name, COMMANDS) or f"choose one of {', '.join(COMMANDS)}"
            raise UsageError(f"unknown command {name!r}; {hint}")
        if name == "fit" and wants_help(arguments[1:]):  # before the import, which costs seconds
            for line in help_lines(COMMANDS[name]):
                say(line)
            return 0
        with waiting() as wait:
            if not ASKING & {*arguments} and os.environ.get("RANK", "0") == "0":  # until the command reports its own progress
                wait(f"starting {name}")
            with fast_imports():
                command = importlib.import_module(f"warpgs.app.commands.{name.replace('-', '_')}")
            code: int = command.run(arguments[1:], COMMANDS[name])
        return code
    except WarpgsError as e:
        return last_words(f"warpgs: {e}", e.exit_code)
    except KeyboardInterrupt as e:
        with ignored_signals():
            return last_words("; ".join(["warpgs: interrupted", *map(str, e.args)]), 130)
    except Exception as e:
        return report_no_memory(e, name) if is_out_of_memory(e) else report_defect(e, arguments)


if __name__ == "__main__":
    sys.exit(main())
