"""The command line: finds the command, runs it, and reports errors in one line with an exit code."""

import contextlib
import importlib
import os
import sys
from collections.abc import Sequence

import warpgs.clock  # noqa: F401, imported first: its time stands for the start of the process
from warpgs import process
from warpgs.device import is_out_of_memory, keep_all_freed_memory, no_memory_message, wake_gpu
from warpgs.errors import ResourceError, UsageError, WarpgsError, did_you_mean, explained
from warpgs.folders import system_folder
from warpgs.pipeline.train.presets import DEFAULT_PRESET, PRESETS
from warpgs.plugins import own_frame
from warpgs.ranks import last_words
from warpgs.report.progress import waiting
from warpgs.version import __version__


def report_defect(error: Exception, arguments: list[str]) -> int:
    """Store the traceback in a file for a bug report, and print one line; return the exit code."""
    import tempfile
    import traceback

    gone = isinstance(error, ModuleNotFoundError) and not own_frame(error) and (error.name or "").partition(".")[0]
    if gone and gone != "warpgs":
        line = f"warpgs: this command needs the Python package {gone}, which is missing; reinstall warpgs with pip"
        return last_words(line, UsageError.exit_code)
    details = f"warpgs {__version__} {' '.join(arguments)}\n\n{''.join(traceback.format_exception(error))}"
    try:
        with tempfile.NamedTemporaryFile(prefix="warpgs-error-", suffix=".txt", delete=False) as f:
            f.write(details.encode("utf-8", "backslashreplace"))
        where = f"in {f.name}"
    except OSError:  # no folder can be written
        process.say_lines(details.splitlines(), error=True)
        where = "above"
    said = f"{type(error).__name__}: {error}"
    if own := own_frame(error):
        return last_words(f"warpgs: {said} (in your own code, {own}; the details are {where})", UsageError.exit_code)
    more = f"This is a bug in warpgs; please report it with the details {where}"
    return last_words(f"warpgs: internal error, {said}. {more}", WarpgsError.exit_code)


FLAGS = (
    ("--out", "RUN", "", "run folder to fill; new or empty"),
    ("--split", "SPEC", "", "views to hold out for scores; default: none"),
    ("--preset", "NAME", DEFAULT_PRESET, "a preset listed below, or a .toml file"),
    ("--steps", "N", "", "number of optimisation steps; default: from the preset"),
    ("--device", "NAME", "auto", "auto, cpu or cuda"),
    ("--downscale", "F", "", "divide both sides of the images by F"),
    ("--max-side", "N", "", "longest side [px]; default: 1600, CPU 800; 0: no limit"),
    ("--seed", "N", "0", "seed of all random numbers"),
    ("--background", "COLOR", "auto", "auto, mean, scene, black, white, #rrggbb or r,g,b"),
    ("--masks", "HOW", "ignore", "masked-out pixels: ignore or cutout (transparent)"),
    ("--depths", "FOLDER", "", "depth maps, named like the images (docs/scenes.md)"),
    ("--exposure", "", "False", "learn brightness and colour of each photograph"),
    ("--refine-poses", "", "False", "correct slightly wrong poses while training"),
    ("--resume", "", "False", "continue the run in --out from its last checkpoint"),
    ("--view", "", "False", "watch in a browser while it trains"),
)
"""Flags that most fits need: name, placeholder of the value, default (empty for none; False for a switch), description."""

SPLITS = {
    "every:N": "hold out every Nth view",
    "llff:K, mip360:K": "hold out every 8th, train on K of the rest",
    "dtu:3|6|9, blender:8": "the published ids of these data sets",
    "train=NAMES;test=NAMES": "by name, with commas; either part alone is enough",
    "all": "hold out no view: no scores",
}
"""Kinds of splits, each in a line."""

EXAMPLES = (
    "warpgs fit scene --out run --preset quick",
    "warpgs fit scene --out run --split every:8 --max-side 800",
    "warpgs fit scene --out run --resume",
)
"""Commands to begin with."""

SCENE = ("folder with cameras, in a format that --help-all lists;", "or photographs or a video; fit then finds the poses")
"""Description of the positional argument."""


def _rows(pairs: Sequence[tuple[str, str]], width: int = 0) -> list[str]:
    """Return pairs in two columns."""
    width = width or max(len(left) for left, _ in pairs)
    return [f"  {left:<{width}}  {right}".rstrip() for left, right in pairs]


def help_lines(about: str) -> list[str]:
    """Return the help of `warpgs fit` in at most 45 lines of 80 columns."""
    flags = [("SCENE", SCENE[0]), ("", SCENE[1])]
    for name, word, default, text in FLAGS:
        flags.append((f"{name} {word}".strip(), text if default in ("", "False") else f"{text} [{default}]"))
    return [
        f"warpgs fit: {about}", "", "usage: warpgs fit SCENE --out RUN [flags]", "",
        "flags most fits need, and their [defaults]:", *_rows(flags), "",
        "presets (--preset):", *_rows([*PRESETS.described().items()]), "", "splits (--split):", *_rows([*SPLITS.items()]), "",
        "examples:", *(f"  {line}" for line in EXAMPLES), "", "`warpgs fit --help-all` lists every flag by topic.",
    ]  # fmt: skip


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
    "level": "set the scale, ground and place of a run by points or GPS",
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
    "share": ("level", "export", "convert", "mesh", "prune"),
    "measure": ("eval", "compare", "ablate", "convert-lpips"),
    "many scenes": ("farm",),
    "this machine": ("doctor",),
}
"""Names of the commands by purpose."""


OTHER_WORDS = {"run": "fit", "train": "fit", "video": "render", "movie": "render", "clean": "prune", "ply": "export"}
"""Commands by other words for them."""
PRINTING = ("doctor", "compare", "ablate")
"""Commands that print their result on the terminal."""
OWN_FILES = ("fit", "farm", "doctor")
"""Commands with a file of their own, so that their imports delay no other command."""
ASKING = {"-h", "--help", "--help-all", "help", "--version", "-V"}
"""Arguments for which a command only prints text."""


def _help() -> str:
    width = max(map(len, COMMANDS))
    groups = ["\n".join([f"{title}:", *_rows([(n, COMMANDS[n]) for n in names], width)]) for title, names in GROUPS.items()]
    return (
        f"warpgs {__version__}: from a handful of photographs to a 3D Gaussian scene\n\n"
        "usage: warpgs COMMAND [flags]\n\n" + "\n\n".join(groups) + "\n\n"
        "`warpgs COMMAND --help` lists a command's flags.\n"
        "First steps: warpgs demo scene && warpgs fit scene --out run\n"
    )


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns its exit code: 0 done, 2 usage, 3 data, 4 resources, 5 defect or NaN, 130 interrupted."""
    with contextlib.suppress(OSError):  # no folder for temporary files: a command that needs one raises the error
        system_folder()
    words = sys.argv[1:] if arguments is None else arguments
    if arguments is None and words[:1] == ["fit"]:
        keep_all_freed_memory()
    prints = words[:1] in ([], *([name] for name in PRINTING)) and "--warm" not in words
    with process.careful_output(prints or bool(ASKING & {*words})) as exit_code:
        process.accept_all_letters()
        try:
            with process.interrupting_signals():
                code = exit_code(_run(words))
        except SystemExit as e:  # after the help of a command
            if e.code or not (code := exit_code(0)):
                raise
            raise SystemExit(code) from e
    if arguments is None and words[:1] == ["fit"] and sys.getprofile() is sys.gettrace() is None:  # which report at the end
        process.leave(code)
    return code


def _run(arguments: list[str]) -> int:
    """Run one command; an error becomes one line and an exit code."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        process.say_lines(_help().splitlines())
        return 0 if arguments else 2
    if arguments[0] in ("--version", "-V"):
        process.say(f"warpgs {__version__}")
        return 0
    name = arguments[0]
    try:
        with explained("the current folder was deleted", "change to another one", kind=UsageError):
            os.getcwd()  # torch's libraries end the process there
        if name not in COMMANDS:
            hint = did_you_mean(OTHER_WORDS.get(name.lower(), name), COMMANDS, 0.8) or f"choose one of {', '.join(COMMANDS)}"
            raise UsageError(f"unknown command {name!r}; {hint}")
        if name == "fit" and {"-h", "--help"} & {*arguments}:  # before the import, which costs seconds
            process.say_lines(help_lines(COMMANDS[name]))
            return 0
        with waiting() as wait:
            if not ASKING & {*arguments} and os.environ.get("RANK", "0") == "0":  # until the command reports its own progress
                wait(f"starting {name}")
                chosen = any(a.startswith(("--device", "--resume")) for a in arguments)
                if name == "fit" and "torch" not in sys.modules and not chosen:
                    wake_gpu()
            own = name in OWN_FILES
            with process.fast_imports():
                module = importlib.import_module(f"warpgs.app.{name if own else 'commands'}")
            code: int = module.run(*(() if own else (name,)), arguments[1:], COMMANDS[name])
        return code
    except WarpgsError as e:
        return last_words(f"warpgs: {e}", e.exit_code)
    except KeyboardInterrupt as e:
        with process.ignored_signals():
            return last_words("; ".join(["warpgs: interrupted", *map(str, e.args)]), 130)
    except Exception as e:
        if is_out_of_memory(e):
            return last_words(f"warpgs: {no_memory_message(e)}", ResourceError.exit_code)
        return report_defect(e, arguments)
