"""Maths of the documents as MathML, which browsers render without a script and without a network."""

from __future__ import annotations

import html
import logging
import re

from latex2mathml.converter import convert

log = logging.getLogger("mkdocs.hooks.mathml")
MATHS = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
"""Formulas as the extension arithmatex leaves them: inline in parentheses, displayed ones in brackets."""


def simplified(tex: str) -> str:
    """Return a formula without the commands that the converter does not know, for which it knows another way."""
    tex = re.sub(r"\\(begin|end)\{aligned\}", lambda m: r"\begin{array}{rl}" if m[1] == "begin" else r"\end{array}", tex)
    tex = re.sub(r"\\\\\[\d+pt\]", r"\\\\", tex)
    tex = re.sub(r"\\operatorname\{([^}]*)\}", lambda m: rf"\text{{{m[1].replace(chr(92) + ',', '')}}}", tex)
    return re.sub(r"\\text(?:tt)?\{([^}]*)\}", lambda m: m[0].replace(r"\_", "_"), tex)


def on_page_content(content: str, page, **_) -> str:
    """Replace each formula of a page by MathML; a warning, which fails a strict build, where a command is not known."""

    def formula(match: re.Match) -> str:
        tex = html.unescape(match[3])
        maths = convert(simplified(tex), display="block" if match[2] == "[" else "inline")
        unknown = re.findall(r"\\[A-Za-z_]+|<mi>&</mi>|\$", maths)
        if unknown:
            log.warning("%s: unknown TeX %s in %s", page.file.src_uri, ", ".join(unknown), tex)
        return maths

    return MATHS.sub(formula, content)
