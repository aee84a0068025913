"""Mutants of a CUDA body, by a tokenizer: house style sets binary operators between blanks and nothing else."""

import re

from tests.mutate import rules
from tests.mutate.edit import NAMES, Edit, other_number, swaps

TOKEN = re.compile(
    rb"(?P<skip>//[^\n]*|\#[^\n]*|asm\([^;]*;|0x[0-9a-fA-F]+u?)"
    rb"|(?P<number>(?<![\w.])(?:\d+\.\d+(?:e-?\d+)?f?|\d+e-?\d+f?|\d+(?:ll|u)?)(?![\w.]))"
    rb"|(?P<word>[A-Za-z_]\w*)"
    rb"|(?P<operator><<|>>|<=|>=|==|!=|&&|\|\||[-+*/&]=|->|\+\+|--|[-+*/%<>&|!])"
    rb"|(?P<other>.)",
    re.DOTALL,
)
ACCUMULATION = re.compile(rb"(?:^|;)[ \t]*([\w.]+(?:\[[^\n;=]*\])? [+-]= [^;\n]*;)", re.MULTILINE)


def native_edits(source: bytes) -> list[Edit]:
    """All mutants of a body. Masks in hexadecimal, assembler, comments and pragmas are left alone."""
    edits: list[Edit] = []
    for token in TOKEN.finditer(source):
        edits.extend(_of_token(source, token))
    position = 0
    while found := ACCUMULATION.search(source, position):
        if found[1].count(b"(") == found[1].count(b")"):  # else the head of a loop
            edits.append(Edit(found.start(1), found.end(1), ";", "statement dropped"))
        position = found.end(1) - 1
    return sorted(edits, key=lambda e: (e.start, e.end, e.change))


def _of_token(source: bytes, token: re.Match) -> list[Edit]:
    kind, text, (start, end) = token.lastgroup, token[0].decode(), token.span()
    before, after = source[start - 1 : start] if start else b" ", source[end : end + 1]
    line = source[source.rfind(b"\n", 0, start) + 1 : source.find(b"\n", start) % (len(source) + 1)].decode()
    if kind == "number" and rules.native_number_left_out(line):
        return []
    if kind == "number":
        new = other_number(text, index=before == b"[" and after == b"]")
        return [Edit(start, end, new, f"{text} to {new}")]
    if kind == "word" and text in NAMES:
        return [Edit(start, end, NAMES[text], f"{text} to {NAMES[text]}")]
    if kind == "operator" and before.isspace() and after.isspace():
        return [Edit(start, end, new, f"{text} to {new}") for new in swaps(text)]
    if kind == "operator" and text in "-!" and not after.isspace() and not re.match(rb"[\w\])]", before):
        return [Edit(start, end, "", f"{text} dropped")]
    return []
