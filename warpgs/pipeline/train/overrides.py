"""Settings by the names of their flags: for presets in files, for mappings, and for keywords of `warpgs.fit`."""

from __future__ import annotations

import dataclasses
import numbers
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any

from warpgs.errors import UsageError
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.loss import LOSS_TERMS, LossTerm
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.pipeline.train.view_modules.base import VIEW_MODULES, ViewModule
from warpgs.plugins import Registry, flag_group
from warpgs.runtime.byte_units import parse_bytes
from warpgs.schema import SchemaError, of_type
from warpgs.suggestion import did_you_mean

Path = tuple[str, ...]
"""Path from a `FitConfig` to a setting, as names of fields; a number is the index of a loss term or a view module."""
WITHOUT_PREFIX = "priors"
"""Group without a prefix in its flags."""
PARTS: dict[str, Registry[Any]] = {"loss_terms": LOSS_TERMS, "view_modules": VIEW_MODULES}
"""Fields that hold parts of a registry, each with settings of its own."""
OTHERS = ("preset", "strategy", "strategy_config", *PARTS)
"""Fields whose values are converted in their own way, such as by looking up a name."""


def setting_names(config: FitConfig) -> list[str]:
    """Return the names of all settings, such as ``init.opacity``, including those of strategy, loss terms and view modules."""
    return ["strategy", *PARTS, *VIEW_MODULES.names(), *_leaves(config)]


def keyword(name: str) -> str:
    """Return the keyword of a setting: ``init_opacity`` for ``init.opacity``."""
    return name.replace(".", "_")


def flag(name: str) -> str:
    """Return the flag of a setting without its leading dashes: ``init.random-count`` for ``init.random_count``."""
    return name.replace("_", "-")


def with_settings(config: FitConfig, values: Mapping[str, Any], place: str, *, keywords: bool = False) -> FitConfig:
    """Return settings with some of them replaced.

    Args:
        config: Settings to start from.
        values: New values by name of the flag (``init.opacity``), by names in nested mappings, or by keyword
            (``init_opacity``).
        place: Source of the values, for messages: a file, or the function that was called.
        keywords: True for keywords of a call in Python. Only then may ``strategy``, ``loss_terms`` and ``view_modules`` name
            ``module:Class`` or ``file.py:Class``, which is imported.

    Raises:
        UsageError: A name is unknown, or a value has the wrong type or is out of range; the message names the setting.
    """
    given = {name.replace("-", "_"): value for name, value in _flat(values, place)}
    try:
        config = _with_parts(config, given, keywords)
    except (UsageError, SchemaError) as e:
        raise UsageError(f"{place}: {e}") from e
    leaves = _leaves(config)
    names = {keyword(n): n for n in leaves} | {n: n for n in leaves}
    changes: dict[str, Any] = {}
    for name, value in given.items():
        if name == "strategy" or name in PARTS or name in VIEW_MODULES.names():
            continue
        if name not in names:
            raise UsageError(_unknown(name, place, config, keywords))
        path, hint = leaves[names[name]]
        try:
            _put(changes, path, _typed(value, hint, name))
        except (UsageError, SchemaError) as e:
            raise UsageError(f"{place}: {e}") from e
    try:
        changed: FitConfig = _replaced(config, changes)
    except UsageError as e:
        raise UsageError(f"{place}: {e}") from e
    return changed


def changed_settings(before: FitConfig, after: FitConfig) -> list[str]:
    """Return the names of the settings in which two configurations differ, in the form of flags."""
    old, new = (dict(_values(c)) for c in (before, after))
    return [flag(n) for n, value in new.items() if n not in old or old[n] != value]


def _values(config: FitConfig) -> Iterator[tuple[str, Any]]:
    yield "strategy", config.strategy
    for field in PARTS:
        yield field, [part.name for part in getattr(config, field)]
    for name, (path, _) in _leaves(config).items():
        yield name, _value(config, path)


def _flat(values: Mapping[str, Any], place: str, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield values by their dotted names."""
    for name, value in values.items():
        if not isinstance(name, str):
            raise UsageError(f"{place}: {name!r} is not a setting's name; write names as text")
        if isinstance(value, Mapping):
            yield from _flat(value, place, f"{prefix}{name}.")
        elif dataclasses.is_dataclass(value) and not isinstance(value, (type, LossTerm, ViewModule)):
            yield from _flat({f.name: getattr(value, f.name) for f in dataclasses.fields(value)}, place, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _with_parts(config: FitConfig, given: Mapping[str, Any], own_code: bool) -> FitConfig:
    """Return settings with the named strategy, loss terms and view modules, which have their default settings."""
    strategy = given.get("strategy")
    if strategy is not None and strategy != config.strategy:
        kind = _found(STRATEGIES, strategy, own_code)
        config = dataclasses.replace(
            config, strategy=STRATEGIES.name_of(kind), strategy_config=None if kind.Config is None else kind.Config()
        )
    for field, registry in PARTS.items():
        if field in given:
            changes: dict[str, Any] = {field: _parts(registry, field, given[field], own_code)}
            config = dataclasses.replace(config, **changes)
    for name in VIEW_MODULES.names():
        if name in given:
            of_type(bool)(given[name], name)
            others = tuple(m for m in config.view_modules if m.name != name)
            own = tuple(m for m in config.view_modules if m.name == name) or (VIEW_MODULES.find(name)(),)
            config = dataclasses.replace(config, view_modules=(*others, *own) if given[name] else others)
    return config


def _parts(registry: Registry[Any], field: str, names: Any, own_code: bool) -> tuple[Any, ...]:
    """Return the given parts: objects unchanged, names as parts with default settings."""
    if isinstance(names, str):
        names = [n.strip() for n in names.split(",") if n.strip() not in ("", "none")]
    if not isinstance(names, (list, tuple)):
        raise UsageError(f"{field} must be names separated by commas, not {names!r}")
    return tuple(p if isinstance(p, registry.base) else _found(registry, p, own_code)() for p in names)


def _found(registry: Registry[Any], name: Any, own_code: bool) -> type[Any]:
    if not isinstance(name, (str, type)):
        raise UsageError(f"{name!r} is not a {registry.kind}; give one of {', '.join(registry.names())}")
    return registry.load(name) if own_code and isinstance(name, str) else registry.find(name)


def _leaves(config: FitConfig) -> dict[str, tuple[Path, Any]]:
    """Return path and type hint of each setting by the name of its flag, with underscores."""
    found = dict(_below(FitConfig, "", ()))
    if config.strategy_config is not None:
        found |= _below(type(config.strategy_config), f"{flag_group(config.strategy)}.", ("strategy_config",))
    for field in PARTS:
        for i, part in enumerate(getattr(config, field)):
            found |= _below(type(part), f"{flag_group(part.name)}.", (field, str(i)))
    return found


def _below(kind: type, prefix: str, path: Path) -> Iterator[tuple[str, tuple[Path, Any]]]:
    hints = typing.get_type_hints(kind)
    for f in dataclasses.fields(kind):
        hint, here = hints[f.name], (*path, f.name)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            yield from _below(hint, prefix if f.name == WITHOUT_PREFIX else f"{prefix}{f.name}.", here)
        elif path or f.name not in OTHERS:
            yield prefix + f.name, (here, hint)


def _value(part: Any, path: Path) -> Any:
    for name in path:
        part = part[int(name)] if isinstance(part, tuple) else getattr(part, name)
    return part


def _put(changes: dict[str, Any], path: Path, value: Any) -> None:
    """Put a value at a path into nested dictionaries."""
    for name in path[:-1]:
        changes = changes.setdefault(name, {})
    changes[path[-1]] = value


def _replaced(part: Any, changes: dict[str, Any]) -> Any:
    """Return a dataclass, or a tuple of dataclasses, with fields replaced; each is built once, with all its changes."""
    if isinstance(part, tuple):
        return tuple(_replaced(p, changes.get(str(i), {})) for i, p in enumerate(part))
    new = {n: _replaced(getattr(part, n), v) if isinstance(v, dict) else v for n, v in changes.items()}
    return dataclasses.replace(part, **new) if new else part


def _typed(value: Any, hint: Any, name: str) -> Any:
    """Return a value converted to the type of its field; SchemaError if the type does not match."""
    if name == "memory_limit" and isinstance(value, str) and value.lower() != "none":
        return parse_bytes(value)
    parts = typing.get_args(hint)
    if typing.get_origin(hint) in (typing.Union, types.UnionType) and type(None) in parts:
        if value is None or (isinstance(value, str) and value.lower() == "none"):
            return None
        (hint,) = (p for p in parts if p is not type(None))
    if isinstance(value, numbers.Integral) and not isinstance(value, bool):
        value = int(value)
    elif isinstance(value, numbers.Real) and not isinstance(value, (bool, int)):
        value = float(value)
    if typing.get_origin(hint) is tuple:
        of_type(hint)(list(value) if isinstance(value, tuple) else value, name)
        kinds = typing.get_args(hint)
        return tuple(_typed(v, kinds[0], name) for v in value)
    of_type(hint)(value, name)
    return float(value) if hint is float else value


def _unknown(name: str, place: str, config: FitConfig, keywords: bool) -> str:
    """Return the message on an unknown setting, with the most similar name in the user's spelling."""
    known = {keyword(n) if keywords else n: n for n in setting_names(config)}
    groups = {n.partition(".")[0] for n in known.values() if "." in n}
    if name in groups:
        return (
            f"{place}: {name} is a group of settings; give a mapping such as {{{name}: {{...}}}}, or name one of its settings"
        )
    last = [k for k, n in known.items() if n.rpartition(".")[2] == name.rpartition(".")[2]]  # `opacity` for `init.opacity`
    if "." in name:  # `other.every` for `mcmc.every`, but only if `other` is not similar to a group
        own = {n for n, (path, _) in _leaves(config).items() if path[0] in ("strategy_config", *PARTS)}
        last = [k for k in last if known[k] in own and not did_you_mean(name.partition(".")[0], groups)]
    hint = f"did you mean {last[0]}?" if last else did_you_mean(name, known) or "`warpgs fit --help-all` lists all"
    return f"{place}: unknown setting {name[:60]!r}; {hint}"
