"""Claims that mutants are equivalent: reading, and matching with the existing mutants."""

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

from tools.mutation.candidates import Candidate

CLAIMS = Path(__file__).with_name("equivalents.toml")
PATTERN = re.compile(r"(?P<name>\w+)(\.(?P<function>[\w.]+))? (?P<path>\S+) (?P<shape>[0-9a-f]{4}): (?P<changes>.+)")


@dataclass(frozen=True)
class Claims:
    """The file of claims."""

    files: dict[str, str]
    """Path by the name that claims use."""
    reasons: dict[tuple[str, str, str, str, str], str]
    """Reason by key of the mutant."""

    def text(self, key: tuple[str, str, str, str, str]) -> str:
        """Return a key as it is written in the file."""
        file, function, path, shape, change = key
        name = next((name for name, path in self.files.items() if path == file), f"?{file}")
        return f"{name}{'.' * bool(function)}{function} {path} {shape}: {change}"


def load(path: Path = CLAIMS) -> Claims:
    """Read the file.

    Raises:
        ValueError: An entry is incomplete, unreadable or claimed twice; the message names it.
    """
    table = tomllib.loads(path.read_text("utf-8"))
    claims = Claims(table["files"], {})
    for reason, mutants in table["equivalent"].items():
        if len(reason) < 20:
            raise ValueError(f"{path.name}: '{reason}' is too short for a reason; explain in 20 letters why no test can fail")
        for text in mutants:
            if not (found := PATTERN.fullmatch(text)) or found["name"] not in claims.files:
                raise ValueError(f"{path.name}: write '<name in [files]>.<function> <path> <shape>: <changes>', not '{text}'")
            for change in found["changes"].split(", "):
                key = (claims.files[found["name"]], found["function"] or "", found["path"], found["shape"], change)
                if key in claims.reasons:
                    raise ValueError(f"{path.name}: claimed twice: {text}")
                claims.reasons[key] = reason
    return claims


def match(claims: Claims, candidates: list[Candidate]) -> tuple[dict[str, str], list[str]]:
    """Return the reason of each claimed mutant by its number, and a message for each claim without a mutant.

    A statement that has moved within its function is found by its shape, if this shape is unique in the function.
    """
    exact = {c.key: c for c in candidates}
    alike: dict[tuple[str, ...], list[Candidate]] = {}
    for c in candidates:
        alike.setdefault((*c.key[:2], *c.key[3:]), []).append(c)
    reasons, lost = {}, []
    for key, reason in claims.reasons.items():
        near = alike.get((*key[:2], *key[3:]), [])
        found = exact.get(key) or (near[0] if len(near) == 1 else None)
        if found is None or found.id in reasons:
            lost.append(f"{CLAIMS.name}: no mutant answers to '{claims.text(key)}': {_advice(claims, key, candidates)}")
        else:
            reasons[found.id] = reason
    return reasons, lost


def _advice(claims: Claims, key: tuple[str, str, str, str, str], candidates: list[Candidate]) -> str:
    file, function, path, _, change = key
    if not (own := [c for c in candidates if c.file == file]):
        return f"{file} has no mutants; edit its line in [files]"
    if there := [c for c in own if c.key[1:3] == (function, path) and c.change == change]:
        return f"that statement has changed; if the reason still holds, write '{claims.text(there[0].key)}'"
    if moved := [c for c in own if c.key[3:] == key[3:]] or [c for c in candidates if c.key[3:] == key[3:]]:
        return "such a statement stands at " + " or ".join(f"'{claims.text(c.key)}'" for c in moved[:3])
    return "the statement is gone; remove the claim, or write what `python -m tools.mutation --list` gives for its successor"
