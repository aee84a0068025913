"""Report of a run: the survivors, the claims, a table by file, and last the score."""

import difflib
from collections import Counter

from tools.mutation.candidates import ROOT, Candidate

KILLED = ("killed", "timeout")
NOTICED_BY_NONE = ("survived", "untested", "broken")


def difference(candidate: Candidate) -> str:
    """Return the change as a diff without context."""
    source = (ROOT / candidate.file).read_bytes()
    new = candidate.edit.apply(source)
    lines = difflib.unified_diff(source.decode().splitlines(), new.decode().splitlines(), n=0, lineterm="")
    return "\n".join(line for line in list(lines)[3:])


def describe(candidate: Candidate) -> str:
    """Return the place and the change in one line."""
    return f"{candidate.id}  {candidate.file}:{candidate.number}  {candidate.change}"


def summary(sampled: list[Candidate], status: dict[str, str], reasons: dict[str, str]) -> str:
    """Return the whole report.

    Args:
        sampled: The sample.
        status: Status by number of the mutant: killed, timeout, survived, untested, broken; mutants that were not run are
            missing.
        reasons: Reasons of claims by number of the mutant.
    """
    parts = []
    for c in sampled:
        if status.get(c.id) in NOTICED_BY_NONE:
            parts.append(f"{status[c.id].upper()}  {describe(c)}\n{difference(c)}")
    claimed = [c for c in sampled if c.id in reasons]
    parts += [f"CLAIMED  {describe(c)}\n    {reasons[c.id]}" for c in claimed]
    table = [f"{'file':<40}{'sampled':>9}{'killed':>8}{'timeout':>9}{'survived':>10}{'claimed':>9}"]
    for file in sorted({c.file for c in sampled}):
        own = [c for c in sampled if c.file == file]
        n = Counter("claimed" if c.id in reasons else status.get(c.id, "not run") for c in own)
        table.append(
            f"{file:<40}{len(own):>9}{n['killed']:>8}{n['timeout']:>9}{sum(n[w] for w in NOTICED_BY_NONE):>10}{n['claimed']:>9}"
        )
    parts.append("\n".join(table))
    run = [c for c in sampled if c.id in status and c.id not in reasons]
    killed = sum(status[c.id] in KILLED for c in run)
    missing = len(sampled) - len(run) - len(claimed)
    note = f", {missing} not run" if missing else ""
    share = f"{100 * killed / len(run):.1f} %" if run else "none run"
    counts = f"{len(sampled)} sampled, {len(claimed)} claimed equivalent{note}"
    parts.append(f"mutation score {share}: {killed} killed of {len(run)} ({counts})")
    return "\n\n".join(parts)
