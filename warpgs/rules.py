"""Rules found by name, with one error for names that are unknown."""

from warpgs.constants import RULES, Rule
from warpgs.errors import UsageError


def rule_named(name: str) -> Rule:
    """Return the rule of a name.

    Raises:
        UsageError: The name is unknown.
    """
    if name in RULES:
        return RULES[name]
    versions = [known for known in RULES if known.startswith(f"{name}-")]
    if versions:
        raise UsageError(f"rule {name!r} needs a version, because its cut-offs changed: choose {' or '.join(versions)}")
    raise UsageError(f"unknown rule {name!r}: choose one of {', '.join(RULES)}")
