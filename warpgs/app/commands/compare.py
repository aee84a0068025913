"""`warpgs compare`: presets against each other. Parses, calls, prints; no logic."""

import functools
from dataclasses import dataclass

from warpgs.app.commands.study import run_study_of, study_flags
from warpgs.app.flags import listed, parse_flags
from warpgs.app.own_code import load_own


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    from warpgs.pipeline.train.presets import PRESETS

    base = study_flags()

    @dataclass(frozen=True, kw_only=True)
    class Compare(base):
        presets: str = ",".join(PRESETS)
        """Presets as for `warpgs fit --preset`, separated by commas; the others are compared with the first."""

    a = parse_flags(Compare, arguments, "warpgs compare", f"{about}\n\n{listed('presets', PRESETS.described())}")
    from warpgs.pipeline.study.compare import preset_variants
    from warpgs.pipeline.train.presets import preset_settings

    names = [n.strip() for n in a.presets.split(",") if n.strip()]
    for name in names:  # so that an error names its preset
        load_own("preset", name, functools.partial(preset_settings, name))
    return run_study_of(a, preset_variants(names, a.steps), {})
