"""Error messages and exit codes of commands that failed."""

from warpgs.errors import ResourceError, UsageError, WarpgsError
from warpgs.plugins import own_frame
from warpgs.runtime.device_memory import no_memory_message
from warpgs.runtime.ranks import last_words
from warpgs.runtime.terminal import say
from warpgs.version import __version__

FITTING = ("fit", "farm", "compare", "ablate")
"""Commands that fit, and take the flags of a fit."""


def report_no_memory(error: Exception, command: str) -> int:
    """Print that the memory is exhausted, and the fix; return the exit code."""
    return last_words(f"warpgs: {no_memory_message(error, fitting=command in FITTING)}", ResourceError.exit_code)


def missing_package(error: Exception) -> str:
    """Return the package that an import of warpgs's own code did not find; empty for other errors."""
    name = error.name or "" if isinstance(error, ModuleNotFoundError) and not own_frame(error) else ""
    package = name.partition(".")[0]
    return "" if package == "warpgs" else package


def report_defect(error: Exception, arguments: list[str]) -> int:
    """Store the traceback in a file for a bug report, and print one line; return the exit code.

    An uninstalled dependency is not a defect of warpgs: the line then only names the package.
    """
    import tempfile
    import traceback

    gone = missing_package(error)
    if gone:
        line = f"warpgs: this command needs the Python package {gone}, which is missing; reinstall warpgs with pip"
        return last_words(line, UsageError.exit_code)
    details = f"warpgs {__version__} {' '.join(arguments)}\n\n{''.join(traceback.format_exception(error))}"
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="warpgs-error-", suffix=".txt", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as f:
            f.write(details)
        where = f"in {f.name}"
    except OSError:  # no folder can be written
        for line in details.splitlines():
            say(line, error=True)
        where = "above"
    own = own_frame(error)
    if own:
        line = f"warpgs: {type(error).__name__}: {error} (in your own code, {own}; the details are {where})"
        return last_words(line, UsageError.exit_code)
    line = (
        f"warpgs: internal error, {type(error).__name__}: {error}. This is a bug in warpgs; please report it with the "
        f"details {where}"
    )
    return last_words(line, WarpgsError.exit_code)
