"""`warpgs compare`: presets against each other. Parses, calls, prints; no logic."""

from dataclasses import dataclass

from warpgs.app.commands.study import run_study_of, study_flags
from warpgs.app.flags import parse_flags


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` heads its help."""
    from warpgs.pipeline.train.config import PRESETS

    base = study_flags()

    @dataclass(frozen=True, kw_only=True)
    class Compare(base):
        presets: str = ",".join(PRESETS)
        """Names of presets with commas between; the others are compared with the first."""

    a = parse_flags(Compare, arguments, "warpgs compare", about)
    from warpgs.pipeline.study.compare import preset_variants

    names = [n.strip() for n in a.presets.split(",") if n.strip()]
    return run_study_of(a, preset_variants(names, a.steps), {})
