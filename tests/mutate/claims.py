"""The claimed equivalents: read, checked against the mutants that there are, and looked up."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

from tests.mutate.candidates import Candidate

CLAIMS = Path(__file__).with_name("equivalents.toml")


@dataclass(frozen=True)
class Claims:
    """Reason by key of the mutant."""

    reasons: dict[tuple[str, str, str, str], str]

    def reason(self, candidate: Candidate) -> str | None:
        """Why no test can see this mutant; None where that is not claimed."""
        return self.reasons.get(candidate.key)


def load(path: Path = CLAIMS) -> Claims:
    """Read the file; ValueError names an entry that is incomplete or claimed twice."""
    reasons: dict[tuple[str, str, str, str], str] = {}
    for entry in tomllib.loads(path.read_text("utf-8")).get("equivalent", []):
        if set(entry) != {"file", "function", "reason", "cases"} or len(entry["reason"]) < 20:
            raise ValueError(f"{path.name}: an entry needs file, function, reason and cases: {entry}")
        for line, *changes in entry["cases"]:
            for change in changes:
                key = (entry["file"], entry["function"], line, change)
                if key in reasons:
                    raise ValueError(f"{path.name}: claimed twice: {key}")
                reasons[key] = entry["reason"]
    return Claims(reasons)


def unknown(claims: Claims, candidates: list[Candidate]) -> list[tuple[str, str, str, str]]:
    """Claims that name no mutant, because the code has changed: they must be looked at again."""
    return sorted(set(claims.reasons) - {c.key for c in candidates})
