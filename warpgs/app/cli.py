"""The command line: finds the command, runs it, and turns errors into sentences and exit codes."""

import importlib
import os
import sys

from warpgs import __version__
from warpgs.app.failures import report_defect, report_no_memory
from warpgs.errors import UsageError, WarpgsError
from warpgs.runtime.device_memory import is_out_of_memory
from warpgs.runtime.imports import fast_imports
from warpgs.runtime.stop_signals import ignored_signals, interrupting_signals
from warpgs.runtime.terminal import accept_all_letters, say

COMMANDS = {
    "fit": "fit Gaussians to a scene folder and fill a run folder",
    "eval": "score a run again on its held-out views",
    "render": "render a run as a film: along a path that suits it, through its views, or along keyframes",
    "plot": "show a run's cameras and Gaussians in one image",
    "mesh": "make a mesh of the surfaces that a run's training views see, as .ply or .glb",
    "view": "look at a run, a PLY file or a fit that goes on, in a browser",
    "export": "write a run's Gaussians to a file of any format that viewers read, or to an HTML page that shows them",
    "convert": "write a file of Gaussians in another format: .ply, .spz, .sog, .glb, .splat and others",
    "prune": "shrink a finished model as far as its training views allow, into a new run folder",
    "poses": "find camera poses of photographs or a video, and write them as a scene folder",
    "priors": "look at what is known before a fit (priors show), or write networks as ONNX (priors export)",
    "compare": "fit presets to scenes with several seeds; tables, plot and figure of the differences",
    "ablate": "fit a preset with its parts off one at a time; the same tables, plot and figure",
    "convert-lpips": "join published LPIPS weights into the file that --lpips-weights takes",
    "demo": "write a synthetic scene to try things with",
    "doctor": "say what this machine has, what is missing, and how to get it",
}


def _help() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {text}" for name, text in COMMANDS.items())
    return (
        f"warpgs {__version__}: from a handful of posed photographs to a 3D Gaussian scene\n\n"
        f"usage: warpgs COMMAND [flags]\n\n{rows}\n\n"
        "`warpgs COMMAND --help` lists a command's flags. First steps: warpgs demo scene && warpgs fit scene --out run\n"
    )


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns its exit code: 0 done, 2 usage, 3 data, 4 resources, 5 internal, 130 interrupted."""
    accept_all_letters()
    with interrupting_signals():
        return _run(sys.argv[1:] if arguments is None else arguments)


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
            raise UsageError(f"there is no command {name!r}; choose one of {', '.join(COMMANDS)}")
        with fast_imports():
            command = importlib.import_module(f"warpgs.app.commands.{name.replace('-', '_')}")
        code: int = command.run(arguments[1:], COMMANDS[name])
        return code
    except WarpgsError as e:
        say(f"warpgs: {e}", error=True)
        return e.exit_code
    except KeyboardInterrupt:
        with ignored_signals():
            say("warpgs: interrupted; --resume continues from the last checkpoint", error=True)
        return 130
    except BrokenPipeError:  # the reader, `head` for one, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as e:
        return report_no_memory(e) if is_out_of_memory(e) else report_defect(e, arguments)


if __name__ == "__main__":
    sys.exit(main())
