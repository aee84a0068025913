"""`warpgs ablate`: a preset with one part changed at a time. Parses, calls, prints; no logic."""

from dataclasses import dataclass

from warpgs.app.commands.study import run_study_of, study_flags
from warpgs.app.flags import listed, parse_flags
from warpgs.app.own_code import load_own


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    from warpgs.pipeline.train.presets import DEFAULT_PRESET, PRESETS

    base = study_flags()

    @dataclass(frozen=True, kw_only=True)
    class Ablate(base):
        preset: str = DEFAULT_PRESET
        """Preset, as for `warpgs fit --preset`; one part is changed at a time."""

    a = parse_flags(Ablate, arguments, "warpgs ablate", f"{about}\n\n{listed('presets', PRESETS.described())}")
    from warpgs.pipeline.study.compare import ablation_variants, preset_variants

    (config,) = load_own("preset", a.preset, lambda: preset_variants([a.preset], a.steps)).values()
    return run_study_of(a, *ablation_variants(config))
