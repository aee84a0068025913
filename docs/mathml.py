"""Maths of the documents as MathML, which browsers render without a script and without a network."""

from __future__ import annotations

import re

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.util import logging

log = logging.getLogger(__name__)


def simplified(tex: str) -> str:
    """Return a formula without the commands that the converter does not know, for which it knows another way."""
    tex = re.sub(r"\\(begin|end)\{aligned\}", lambda m: r"\begin{array}{rl}" if m[1] == "begin" else r"\end{array}", tex)
    tex = re.sub(r"\\\\\[\d+pt\]", r"\\\\", tex)
    tex = re.sub(r"\\operatorname\{([^}]*)\}", lambda m: rf"\text{{{m[1].replace(chr(92) + ',', '')}}}", tex)
    return re.sub(r"\\text(?:tt)?\{([^}]*)\}", lambda m: m[0].replace(r"\_", "_"), tex)


def write_formula(translator, node: nodes.math | nodes.math_block) -> None:
    """Write a formula as MathML; a warning, which fails a strict build, where a command is not known."""
    tex = node.astext()
    maths = convert(simplified(tex), display="block" if isinstance(node, nodes.math_block) else "inline")
    unknown = re.findall(r"\\[A-Za-z_]+|<mi>&</mi>|\$", maths)
    if unknown:
        log.warning("unknown TeX %s in %s", ", ".join(unknown), tex, location=node)
    translator.body.append(maths)
    raise nodes.SkipNode


def setup(app) -> dict[str, bool]:
    """Make this the renderer of formulas in HTML."""
    app.add_html_math_renderer("mathml", (write_formula, None), (write_formula, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
