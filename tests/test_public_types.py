"""Whoever imports warpgs gets types, and the checker looks at every module that defines a public name."""

import tomllib
from pathlib import Path

import warpgs

ROOT = Path(__file__).parent.parent


def test_every_module_of_a_public_name_is_type_checked():
    """The homes of the public names are among mypy's files, and the package says that it carries types."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["mypy"]
    homes = {f"{module.replace('.', '/')}.py" for module in warpgs._HOMES.values()} - {
        "warpgs/render/graphed.py",  # clear_graph_cache alone is public there, and returns nothing
    }
    assert settings["strict"] and homes <= set(settings["files"])
    assert (ROOT / "warpgs/py.typed").exists()
