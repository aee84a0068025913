"""Mutants of a CUDA body, by a tokenizer that relies on our style: only binary operators are between blanks."""

import bisect
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

from tools.mutation import rules
from tools.mutation.edit import NAMES, Edit, Place, fingerprint, other_number, swaps

TOKEN = re.compile(
    rb"(?P<comment>//[^\n]*|\#[^\n]*)"
    rb"|(?P<skip>asm\([^;]*;|0x[0-9a-fA-F]+u?)"
    rb"|(?P<number>(?<![\w.])(?:\d+\.\d+(?:e-?\d+)?f?|\d+e-?\d+f?|\d+(?:ll|u)?)(?![\w.]))"
    rb"|(?P<word>[A-Za-z_]\w*)"
    rb"|(?P<operator><<|>>|<=|>=|==|!=|&&|\|\||[-+*/&]=|->|\+\+|--|[-+*/%<>&|!])"
    rb"|(?P<other>.)",
    re.DOTALL,
)
ACCUMULATION = re.compile(rb"(?:^|;)[ \t]*([\w.]+(?:\[[^\n;=]*\])? [+-]= [^;\n]*;)", re.MULTILINE)
FUNCTION = re.compile(r"(?:auto (\w+) = \[[^\]]*\]|(\w+)) \([^()]*\)")
KEYWORDS = ("for", "if", "else", "while", "return")


def native_edits(source: bytes) -> list[Edit]:
    """Return all mutants of a body. Masks in hexadecimal, assembler, comments and pragmas are left alone."""
    tokens = list(TOKEN.finditer(source))
    edits = [e for token in tokens for e in _of_token(source, token)]
    position = 0
    while found := ACCUMULATION.search(source, position):
        if found[1].count(b"(") == found[1].count(b")"):  # else the head of a loop
            edits.append(Edit(found.start(1), found.end(1), ";", "statement dropped"))
        position = found.end(1) - 1
    starts, places = _statements(tokens)
    edits = [replace(e, place=places[bisect.bisect(starts, e.start) - 1]) for e in edits]
    return sorted(edits, key=lambda e: (e.start, e.end, e.change))


def _statements(tokens: list[re.Match]) -> tuple[list[int], list[Place]]:
    """Return the start of each statement of a body, and its place. The head of a block is a separate statement."""
    starts, places, blocks, counts = [], [], [Place(cuda=True)], Counter()
    for head, end in _heads(tokens):
        words, place = [t[0].decode() for t in head], blocks[-1]
        if words:
            names: dict[str, str] = {}
            shape = [names.setdefault(w, f"_{len(names)}") if t.lastgroup == "word" else w for t, w in zip(head, words)]
            kind = words[0].title() if words[0] in KEYWORDS else "Statement"
            place = place.below(kind, counts, fingerprint(" ".join(shape)))
            starts.append(head[0].start())
            places.append(place)
        if end == "{":
            found = FUNCTION.search(" ".join(words)) if words and words[0] not in KEYWORDS else None
            blocks.append(place.inside(found[1] or found[2]) if found else place)
        elif end == "}" and len(blocks) > 1:
            blocks.pop()
    return starts, places


def _heads(tokens: list[re.Match]) -> Iterator[tuple[list[re.Match], str]]:
    """Yield the tokens up to each end of a statement, or brace of a block, and that end."""
    head, depth = [], 0
    for token in tokens:
        text = token[0].decode()
        if token.lastgroup == "comment" or text.isspace():
            continue
        if not depth and (text in ";}" or (text == "{" and not (head and head[-1][0] == b"="))):  # after = a list of numbers
            yield head, text
            head = []
            continue
        head.append(token)
        depth = max(0, depth + (text in "([{") - (text in ")]}"))  # the text of assembler hides a bracket that opens
    yield head, ""


def _of_token(source: bytes, token: re.Match) -> list[Edit]:
    kind, text, (start, end) = token.lastgroup, token[0].decode(), token.span()
    before, after = source[start - 1 : start] if start else b" ", source[end : end + 1]
    line = source[source.rfind(b"\n", 0, start) + 1 : source.find(b"\n", start) % (len(source) + 1)].decode()
    if kind == "number" and not rules.native_number_left_out(line):
        new = other_number(text, index=before == b"[" and after == b"]")
        return [Edit(start, end, new, f"{text} to {new}")]
    if kind == "word" and text in NAMES:
        return [Edit(start, end, NAMES[text], f"{text} to {NAMES[text]}")]
    if kind == "operator" and before.isspace() and after.isspace():
        return [Edit(start, end, new, f"{text} to {new}") for new in swaps(text)]
    if kind == "operator" and text in "-!" and not after.isspace() and not re.match(rb"[\w\])]", before):
        return [Edit(start, end, "", f"{text} dropped")]
    return []
