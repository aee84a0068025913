"""Presets: named settings that a fit starts from.

Built-in presets are TOML files; a user may add others. Importing this module is fast, since the short help reads only the
names. The settings are loaded when a preset is requested.
"""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warpgs.errors import UsageError, expect, explained
from warpgs.files import is_within, read_file
from warpgs.plugins import load_object, module_digest, module_of
from warpgs.process import Detail
from warpgs.schema import check_depth

if TYPE_CHECKING:
    from warpgs.pipeline.train.settings import FitConfig

FOLDER = Path(__file__).parent / "preset_files"
"""Folder of the presets of warpgs."""
SUFFIX = ".toml"
"""Suffix of preset files."""
MAX_BYTES = 2**16
"""Size of the largest file that is read [bytes]."""
MAX_DEPTH = 8
"""Largest depth of nested tables and lists."""
MAX_DOTS = 100
"""Largest number of dots in a line: the time of Python's TOML reader is quadratic in the number of parts of a key."""
MAX_BASES = 8
"""Longest chain of preset files, each the base of the next one."""
DEFAULT_PRESET = "default"
"""Preset if the user gives none."""
NO_BASE = "none"
"""Name of the base for a preset that starts from the defaults of `FitConfig`."""
OWN_KEYS = ("base", "about")
"""Keys of a preset that are not settings."""


class Presets(Mapping[str, "FitConfig"]):
    """Settings of every preset by name."""

    def __init__(self, folder: Path):
        """Find the files of a folder; they are read when they are requested."""
        self._files = {p.stem: p for p in sorted(folder.glob(f"*{SUFFIX}"), key=lambda p: (p.stem != DEFAULT_PRESET, p.stem))}
        self._made: dict[str, FitConfig] = {}
        self._about: dict[str, str] = {}

    def register(self, name: str, config: FitConfig, about: str = "") -> None:
        """Add a preset.

        Args:
            name: Its name.
            config: Its settings.
            about: A line about it for the help.

        Raises:
            UsageError: A built-in preset has that name, or the name is not possible in a flag.
        """
        if name in self._files or ":" in name or name.endswith(SUFFIX) or not name.strip():
            raise UsageError(f"a preset cannot be registered as {name!r}; choose a new name without a colon or .toml")
        self._made[name], self._about[name] = config, about

    def described(self) -> dict[str, str]:
        """Return a line about each preset, by name."""
        return {name: str(_read(path)[0].get("about", "")) for name, path in self._files.items()} | self._about

    def __getitem__(self, name: str) -> FitConfig:
        if name not in self._made:
            self._made[name] = _config_of_file(self._files[name], name)[0]
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter([*self._files, *(n for n in self._made if n not in self._files)])

    def __len__(self) -> int:
        return sum(1 for _ in self)  # a list would ask for its length first


PRESETS = Presets(FOLDER)
"""Presets by name."""


def preset_settings(preset: FitConfig | Mapping[str, Any] | str | Path | None) -> tuple[FitConfig, str]:
    """Return the settings of a preset, and a note on their source.

    It is the name of a preset; the path of a .toml file; ``module:NAME`` or ``path/to/file.py:NAME`` of a `FitConfig` or a
    mapping (this runs the code); a `FitConfig` or mapping itself; or None for the default preset. The keys of a mapping or a
    file are the names of flags; the key ``base`` names the preset to start from, by default the default preset.
    """
    from warpgs.pipeline.train.settings import FitConfig

    if isinstance(preset, FitConfig):
        return preset, f"a FitConfig of preset {preset.preset}"
    if isinstance(preset, Mapping):
        return _config_of(preset, "preset", 0)
    if isinstance(preset, Path) or (isinstance(preset, str) and preset.endswith(SUFFIX)):
        return _config_of_file(Path(preset), Path(preset).name)
    name = DEFAULT_PRESET if preset is None else preset
    if not isinstance(name, str):
        raise UsageError(f"{name!r} is not a preset; give a name, a path, a FitConfig or a mapping")
    if ":" not in name:
        return _named(name)
    found = load_object("preset", name)
    if not isinstance(found, (FitConfig, Mapping)):
        raise UsageError(f"the preset {name!r} is of type {type(found).__name__}; make it a FitConfig or a mapping of settings")
    where = name.rpartition(":")[0]
    folder = Path(where).parent if where.endswith(".py") else None
    config, origin = preset_settings(found) if isinstance(found, FitConfig) else _config_of(found, name, 0, folder)
    digest = module_digest(module_of(where))
    return config, f"{name}{f' (SHA-256 {digest[:12]})' if digest else ''}, {origin}"


def chosen_settings(
    preset: FitConfig | Mapping[str, Any] | str | Path | None, overrides: Mapping[str, object]
) -> tuple[FitConfig, list[str]]:
    """Return the settings of a preset, some of them replaced, and a note on their source; arguments are as in `warpgs.fit`."""
    from warpgs.pipeline.train.settings import FitConfig, with_settings

    start, origin = preset_settings(preset)
    config = with_settings(start, overrides, "warpgs.fit", keywords=True)
    return config, [] if isinstance(preset, FitConfig) and not overrides else [origin_note(origin, start, config)]


def origin_note(origin: str, start: FitConfig, config: FitConfig) -> str:
    """Return a note on the source of the settings: ``origin``, and the changes to it."""
    from warpgs.pipeline.train.settings import changed_settings

    changed = changed_settings(start, config)
    return Detail(f"settings: {origin}" + (f"; then given: {', '.join(changed)}" if changed else ""))


def preset_word(preset: str) -> str:
    """Return a short name of a user's preset for folders and tables: its own name, or the name of its file or object."""
    return Path(preset).stem if preset.endswith(SUFFIX) else preset.rpartition(":")[2]


def _named(name: str) -> tuple[FitConfig, str]:
    if name not in PRESETS:
        raise UsageError(f"preset {name!r} is not one of {', '.join(PRESETS)}, a {SUFFIX} file, module:NAME or file.py:NAME")
    return PRESETS[name], f"preset {name}"


def _read(path: Path) -> tuple[dict[str, Any], str]:
    """Return the values of a TOML file, and the first digits of its SHA-256."""
    remedy = "give a file of settings such as `steps = 300` (docs/presets.md)"
    data = read_file(path, most=MAX_BYTES, fix=remedy)
    what = f"{path}: not valid TOML of at most {MAX_DEPTH} nested tables and lists"
    with explained(what, remedy, (ValueError, RecursionError)):  # no TOML, no UTF-8, or too deep
        expect(all(line.count(b".") <= MAX_DOTS for line in data.split(b"\n")), f"more than {MAX_DOTS} dots in a line")
        values = tomllib.loads(data.decode("utf-8"))
        check_depth(values, MAX_DEPTH)
    return values, hashlib.sha256(data).hexdigest()[:12]


def _config_of_file(path: Path, name: str, above: int = 0) -> tuple[FitConfig, str]:
    """Return the settings of a file, and a note on their source; ``above`` is the number of files that build on it."""
    import dataclasses

    values, digest = _read(path)
    config, origin = _config_of(values, str(path), above + 1, path.parent)
    return dataclasses.replace(config, preset=name), f"preset {path.absolute()} (SHA-256 {digest}) from {origin}"


def _config_of(values: Mapping[str, Any], place: str, above: int, folder: Path | None = None) -> tuple[FitConfig, str]:
    """Return the settings of a mapping, and a note on their source; a base that is a file lies below ``folder``."""
    from warpgs.pipeline.train.settings import FitConfig, changed_settings, with_settings

    for key in OWN_KEYS:
        if not isinstance(values.get(key, ""), str):
            raise UsageError(f"{place}: {key} must be text, not {values[key]!r:.60}")
    base = values.get("base", DEFAULT_PRESET)
    if base == NO_BASE:
        start, origin = FitConfig(), "the defaults of FitConfig"
    elif base.endswith(SUFFIX):
        path = (Path() if folder is None else folder) / base
        if folder is not None and not is_within(path, folder):
            raise UsageError(f"{place}: base {base!r:.200} is outside the folder of the file; put the base beside it")
        if above >= MAX_BASES:
            raise UsageError(f"{place}: base {base!r} is circular, or a chain of over {MAX_BASES} files; give another base")
        start, origin = _config_of_file(path, path.name, above)
    elif ":" in base:
        raise UsageError(f"{place}: base {base!r} is code; a preset file never loads code; give the name of a preset")
    elif base not in PRESETS:
        raise UsageError(f"{place}: base {base!r} is not one of {', '.join(PRESETS)}; choose one, a {SUFFIX} file or {NO_BASE}")
    else:
        start, origin = _named(base)
    config = with_settings(start, {k: v for k, v in values.items() if k not in OWN_KEYS}, place)
    return config, f"{origin} with {', '.join(changed_settings(start, config)) or 'no change'}"
