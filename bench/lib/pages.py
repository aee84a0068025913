"""Pages with generated parts, each between two comments with the name of the part; the rest is written by hand."""

from __future__ import annotations

import re
from collections.abc import Callable

from bench.lib import accuracy_page, performance_page, result_file, results_page, rivals_page, use_pages

DOCS = result_file.ROOT / "docs"
PARTS: dict[str, Callable[[], dict[str, str]]] = {
    "numerics.md": accuracy_page.parts,
    "farm.md": lambda: {"packing": use_pages.packing()},
    "formats.md": lambda: {"formats": use_pages.formats(), "programs": use_pages.programs()},
    "many-gpus.md": lambda: {"ranks": use_pages.ranks()},
    "method.md": lambda: {"scores": results_page.scores()},
    "performance.md": performance_page.parts,
    "results.md": lambda: {
        "ablation": results_page.ablation(),
        "views": results_page.views(),
        "untouched": results_page.untouched(),
        "papers": rivals_page.papers(),
        "reruns": rivals_page.reruns(),
        "dtu": rivals_page.dtu(),
        "ladder of default": rivals_page.ladder_of_default(),
    },
}
"""Functions that return the generated parts of each page by name."""


def filled(page: str, parts: dict[str, str]) -> str:
    """Return a page with its generated parts replaced."""
    marks = re.compile(r"(<!-- ([\w ]+): written by bench\.document -->\n).*?(<!-- end of \2 -->)", re.DOTALL)
    names = [match[2] for match in marks.finditer(page)]
    if sorted(names) != sorted(parts):
        raise ValueError(f"the page has markers for {', '.join(names)}, but the parts are {', '.join(parts)}; make them equal")
    return marks.sub(lambda match: f"{match[1]}\n{parts[match[2]]}\n{match[3]}", page)


def files() -> dict[str, str]:
    """Return all pages with generated parts, and the charts, by their path under docs/."""
    pages = {name: filled((DOCS / name).read_text("utf-8"), parts()) for name, parts in PARTS.items()}
    return pages | performance_page.plots(result_file.stored("ops")) | performance_page.time_to_score()
