"""`warpgs fit --help` on one screen, without importing settings or torch; tests compare the text with the code."""

from warpgs.pipeline.train.presets import DEFAULT_PRESET, PRESETS

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

SCENE = (
    "folder with cameras, in a format that --help-all lists;",
    "or photographs or a video; fit then finds the poses",
)
"""Description of the positional argument."""


def wants_help(arguments: list[str]) -> bool:
    """Return whether the arguments after `fit` request the short help."""
    return any(word in ("-h", "--help") for word in arguments)


def help_lines(about: str) -> list[str]:
    """Return the help of `warpgs fit` in at most 45 lines of 80 columns.

    Args:
        about: Description of the command.
    """

    def rows(pairs: list[tuple[str, str]]) -> list[str]:
        width = max(len(left) for left, _ in pairs)
        return [f"  {left:<{width}}  {right}".rstrip() for left, right in pairs]

    flags = [("SCENE", SCENE[0]), ("", SCENE[1])]
    for name, word, default, text in FLAGS:
        stated = f" [{default}]" if default not in ("", "False") else ""
        flags.append((f"{name} {word}".strip(), text + stated))
    return [
        f"warpgs fit: {about}", "", "usage: warpgs fit SCENE --out RUN [flags]", "",
        "flags most fits need, and their [defaults]:", *rows(flags), "",
        "presets (--preset):", *rows([*PRESETS.described().items()]), "", "splits (--split):", *rows([*SPLITS.items()]), "",
        "examples:", *(f"  {line}" for line in EXAMPLES), "", "`warpgs fit --help-all` lists every flag by topic.",
    ]  # fmt: skip
