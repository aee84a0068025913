"""One-line errors for a wrong command line: an unknown flag, a wrong value, a missing or an extra argument."""

import re
import textwrap
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import NoReturn

from warpgs.app.command_help import flag_names, positional_names
from warpgs.errors import UsageError
from warpgs.suggestion import did_you_mean

TARGETS = ("--to", "--out")
"""Flags that name the file to write."""
MAX_SHOWN = 40
"""Largest number of letters of a wrong argument that a message repeats."""


def refuse(kind: type, arguments: list[str], program: str, complaint: str) -> NoReturn:
    """Raise an error in one line for a command line that tyro has rejected.

    Args:
        kind: The dataclass of flags.
        arguments: Arguments after the name of the command.
        program: Name of the program and the command.
        complaint: Text that tyro printed: a box with a title, the reason and, below a line, a hint on the help.

    Raises:
        UsageError: Always; the message names the wrong, missing or extra argument, and the fix.
    """
    _refuse_unknown_flag(kind, arguments, program)
    _refuse_lone_side(kind, arguments)
    text = re.sub(r"\x1b\[[0-9;]*m", "", complaint)
    _, *rows = [row for row in re.sub(r"(?m)^│|│$", "", text).splitlines() if row.strip()]  # without the title
    _refuse_stray_word(kind, arguments, program, rows)
    drawn = re.compile(r"[ ─╰╯-]+").fullmatch  # a line, with the hint on the help below
    rows = [*takewhile(lambda row: not drawn(row), dropwhile(drawn, rows))]
    reason = _missing(kind, rows) or _wrong_value(" ".join(" ".join(rows).split()))
    raise UsageError(f"{reason}; `{program} --help` lists its arguments")


def _refuse_unknown_flag(kind: type, arguments: list[str], program: str) -> None:
    """Raise UsageError for the first word that looks like a flag but is not one of a dataclass of flags."""
    known = {*flag_names(kind), "--help"}
    for word in arguments:
        flag = word.partition("=")[0].replace("_", "-")
        if re.match(r"--|-[A-Za-z]", flag) and flag not in known:
            hint = did_you_mean(flag, known) or f"`{program} --help-all` lists the flags"
            raise UsageError(f"unknown flag {flag}; {hint}")


def _refuse_lone_side(kind: type, arguments: list[str]) -> None:
    """Raise UsageError for a size that is not two whole numbers."""
    for flag in {"--size"} & {*flag_names(kind)}:
        at = next((i for i, word in enumerate(arguments) if word.partition("=")[0] == flag), None)
        if at is not None and not ("=" not in arguments[at] and _are_whole(arguments[at + 1 : at + 3])):
            raise UsageError(f"{flag} needs two numbers: width height, such as {flag} 1280 720")


def _are_whole(words: list[str]) -> bool:
    """Return whether words are two whole numbers."""
    return len(words) == 2 and all(re.fullmatch(r"[+-]?[0-9]+", word) for word in words)


def _refuse_stray_word(kind: type, arguments: list[str], program: str, rows: list[str]) -> None:
    """Raise UsageError for the first word that tyro calls unrecognized; its flag, such as --out, may be missing."""
    words = " ".join(rows).partition("Unrecognized options:")[2].split()
    if not words or words[0] not in arguments:
        return
    known, given = {*flag_names(kind)}, {word.partition("=")[0] for word in arguments}
    target = next((flag for flag in TARGETS if flag in known - given), None)
    missing = target and any(row.strip().startswith(f"{target} ") for row in rows)
    hint = (
        f"did you mean {target} {words[0]}?"
        if target and (missing or Path(words[0]).suffix)
        else f"`{program} --help` lists its arguments"
    )
    raise UsageError(f"{words[0]} is an extra argument; {hint}")


def _missing(kind: type, rows: list[str]) -> str:
    """Return the message on missing arguments, which tyro lists after four spaces; empty for another error."""
    if not rows or not rows[0].strip().startswith("Missing from "):
        return ""
    found = [row.strip() for row in textwrap.dedent("\n".join(rows)).splitlines()[1:] if re.match(r" {4}\S", row)]
    flags, others = ([name for name in found if name.startswith("--") == is_flag] for is_flag in (True, False))
    if len(known := positional_names(kind)) >= len(others):  # tyro names some by their type; the last ones are missing
        others = known[len(known) - len(others) :]
    names = [*others, *flags]
    return f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} missing"


def _wrong_value(reason: str) -> str:
    """Return tyro's reason as one line, in the wording of our errors."""
    if found := re.match(r"Missing value for argument '(.+?)'\. Expected (\d+)", reason):
        flag, count = found.groups()
        return f"{flag} needs {'a value' if count == '1' else f'{count} values'}"
    if found := re.match(r"invalid choice '(.*)' for argument '(.+?)'\. Expected one of \((.*)\)", reason):
        value, flag, choices = found.groups()
        listed = re.findall(r"'([^']*)'", choices)
        return f"{flag}: {value[:MAX_SHOWN]!r} is not one of {', '.join(listed)}"
    if found := re.match(r"Error parsing (.+?): .*input length (\d+) did not match expected argument count (\d+)", reason):
        flag, given, count = found.groups()
        return f"{flag} needs {count} values, got {given}"
    if found := re.match(r"Error parsing (.+?): (.*)", reason):
        flag, why = found.groups()
        one = re.search(r"expected .*?, got .*?(?= - <class|$)", why)  # tyro gives a reason for each type that the flag accepts
        return f"{flag}: {one[0] if one else why}"
    return reason
