"""The rules of public docstrings and of words, which a machine can check.

As a script, with files or folders as arguments, it prints what it finds there: ``python tests/test_docstrings.py warpgs/io``.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("warpgs", "examples")
DOCUMENTS = ("README.md", "CONTRIBUTING.md", "docs")

FRAGMENTS = set(
    "what how whether that those this these of as where which whatever who whose whom from in its for with by at to on "
    "until when while without under after before between into beside not until since than".split()
)
"""First words that begin a relative clause, a prepositional phrase or a riddle."""

ARTICLES = {"a", "an", "the", "one", "all", "each", "every", "both", "no", "some", "two", "three"}

VERBS = set(
    "absorb accept accumulate adapt add adjust advance align allocate allow anneal announce append apply arrange ask "
    "assemble assert assign attach average back-project backpropagate begin bin bind blend blur bound bring broadcast "
    "build cache calculate call cap capture carry cast centre change check choose clamp clean clear clip clone close "
    "collect colour combine commit compare compile complete composite compress compute concatenate configure connect "
    "consume continue contract convert copy correlate count cover create crop cull cut decide declare decode decompose "
    "deduplicate defer define delegate delete denormalize densify derive describe deserialize detect determine "
    "differentiate discard discover dispatch display distribute divide download downsample draw drop dump embed emit "
    "empty encode end enlarge ensure enter enumerate estimate evaluate evict exclude execute exit expand export extend "
    "extract fail fetch fill filter finalize find finish fit fix flatten flush follow forget format free freeze gather "
    "generate get give group grow guard halve hand handle hash have hide highlight hold import include initialize insert "
    "inspect integrate interleave interpolate interpret invert iterate join keep label launch lay leave lend let lift "
    "limit link list listen load locate lock log look lower make map mark mask match measure merge mirror move multiply "
    "name negate normalize note open optimize order orient pack pad pair parse partition pass patch pause permute "
    "perturb pick place plan play plot point pool predict prefer prepare preview print probe produce project propagate "
    "prune push put query quote raise randomize rank reach read reassign rebuild recolour reconstruct record recover "
    "rectify redistribute reduce refine refuse register reject relate release relocate remove rename render reorder "
    "repeat replace replay report reproject request resample rescale reserve reset reshape resize resolve restore resume "
    "retain retrieve retry return reuse reverse rewrite rotate round round-trip route run sample save scale scan scatter "
    "schedule score search see seed select send separate serialize set shade shorten show shrink shuffle sign simulate "
    "skip smooth solve sort split spread square stack start state step stop store stream strip subsample subtract sum "
    "summarize suppress swap sweep switch sync synchronize take tell test tile time trace track train transform "
    "translate transpose triangulate trim try turn undistort undo unite unpack unproject update upload upsample use "
    "validate verify view visit wait wake walk warm warn wrap write yield".split()
)
"""Imperatives that may open the docstring of a function or method; add yours where it is a plain verb."""

THIRD_PERSON = set(
    "decides says has is are does means holds gives makes takes keeps tells returns writes reads computes lets sets asks "
    "knows stands goes comes must may can will should depends belongs needs runs draws counts".split()
)
"""Finite verbs without a subject: no noun phrase begins with them."""
NOUNS = {"means", "counts", "needs", "runs", "sets"}
"""Those of them that are plural nouns, too."""

BANNED = {
    r"pictures?": "image, render",
    r"drawn": "rendered (Gaussians), sampled (random numbers)",
    r"mend(?:s|ed|ing)?": "fix",
    r"splats": "projected Gaussians",
    r"foretold|foretells?": "predicted",
    r"rehears(?:al|als|e|es|ed)": "warmup",
    r"twins?": "reference, coincident view",
    r"judg(?:e|es|ed|ing)": "holdout",
    r"shares? of": "fraction of",
    r"room for": "capacity for",
    r"guess(?:es|ed)?": "baseline, estimate",
    r"knobs?": "setting",
    r"painters?": "render worker",
    r"bridges?": "interop",
}
"""Quaint words as regular expressions, and the field's word for each."""

ALLOWED = ((r"\bgolden gate bridge\b", "a place"),)
"""Phrases in which a banned word is the right one, and why."""

ARRAY = re.compile(r"\b(?:Tensor|ndarray|NDArray|array)\b")
SHAPE = re.compile(
    r"\[[^\]]*\]|\bscalars?\b|\bany shape\b|\b(?:same|equal) shapes?\b|\bshape of\b|\bshaped like\b|\bzero-dimensional\b"
)
SENTENCE = re.compile(r"^.+?[^\s.]\.(?=\s|$|[\"')])|\.\.\.$", re.DOTALL)


class Finding(NamedTuple):
    """One breach of a rule."""

    path: Path
    line: int
    name: str
    rule: str
    text: str

    def __str__(self) -> str:
        shown = self.path.relative_to(ROOT) if self.path.is_relative_to(ROOT) else self.path
        return f"{shown}:{self.line}: {self.name}: {self.rule}: {self.text}"


def opening(text: str, kind: str) -> str | None:
    """Return what is wrong with the first sentence of a docstring of that kind, or None.

    Args:
        text: The docstring, without indentation.
        kind: function, value (constants, fields, properties), class or module.
    """
    paragraph = text.strip().split("\n\n")[0]
    if not SENTENCE.match(paragraph):
        return "the first sentence does not end with a period in the first paragraph"
    first = re.sub(r"^[`'\"(\[*]+|[`'\",.;:)\]*]+$", "", paragraph.split()[0])
    lower = first.lower()
    if lower in FRAGMENTS:
        return f"opens with {first!r}, a fragment"
    quoted = paragraph.lstrip()[0] in "`'\"(" or any(c in first for c in "_()./0123456789")
    if first[:1].islower() and not quoted and kind != "value":  # a field may open with one of its words: "auto, cpu or cuda."
        return f"the first word {first!r} is not capitalised"
    if kind == "function":
        if quoted or lower in ARTICLES or (lower.endswith("ing") and lower != "bring"):
            return f"opens with {first!r}, not with an imperative verb"
        if lower not in VERBS:
            return f"opens with {first!r}, not with an imperative verb (of the list VERBS in tests/test_docstrings.py)"
    elif kind == "value" and lower in THIRD_PERSON | {"return", "returns"}:
        return f"opens with the verb {first!r}, not with a noun phrase"
    elif kind in ("class", "module") and lower in (THIRD_PERSON | {"return"}) - NOUNS:
        return f"opens with the verb {first!r}, not with a noun phrase"
    return None


def sections(text: str) -> dict[str, str]:
    """Return the body of each Google-style section of a docstring by its name."""
    parts = re.split(r"^(Args|Returns|Yields|Raises|Attributes):\s*$", text, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2]))


def entries(body: str) -> dict[str, str]:
    """Return the text of each name in an Args section; names that share an entry each get it."""
    found: dict[str, str] = {}
    depth = min((len(line) - len(line.lstrip()) for line in body.splitlines() if line.strip()), default=0)
    names: list[str] = []
    for line in body.splitlines():
        match = re.match(rf"\s{{{depth}}}([*\w`, ]+?)(?:\s*\([^)]*\))?:(.*)", line)
        if match and not line[depth : depth + 1].isspace():
            names = [n.strip(" *`") for n in match[1].split(",")]
            found.update(dict.fromkeys(names, match[2]))
        else:
            found.update({n: f"{found[n]} {line.strip()}" for n in names})
    return found


def is_array(annotation: ast.expr | None) -> bool:
    """Return whether an annotation is an array, an optional one, or a tuple or list of some."""
    text = "" if annotation is None else ast.unparse(annotation).strip("'\"")
    return bool(ARRAY.search(text)) and not re.match(r"(?:dict|Callable|Mapping|Iterator|Sequence|type)\b", text)


def shapes(node: ast.FunctionDef, text: str) -> str | None:
    """Return what is missing of the shapes of a function's arrays, or None."""
    arguments = [a for a in node.args.posonlyargs + node.args.args + node.args.kwonlyargs if is_array(a.annotation)]
    returned = is_array(node.returns)
    if not arguments and not returned:
        return None
    parts = sections(text)
    documented = entries(parts["Args"]) if "Args" in parts else {}
    missing = [a.arg for a in arguments if a.arg in documented and not SHAPE.search(documented[a.arg])]
    if missing:
        return f"no shape in brackets for {', '.join(missing)}"
    summary = re.split(r"^(?:Args|Returns|Raises):", text, flags=re.MULTILINE)[0]
    if returned and not SHAPE.search(parts.get("Returns", summary)):
        return "no shape in brackets for what is returned"
    if arguments and not documented and not SHAPE.search(text):
        return "no shape in brackets for any of its arrays"
    return None


def raised(node: ast.AST) -> set[str]:
    """Return the names of the classes that leave the body itself: nested functions and what its own handlers catch left out."""
    found: set[str] = set()
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)):
            continue
        if isinstance(child, ast.Raise) and child.exc is not None:
            target = child.exc.func if isinstance(child.exc, ast.Call) else child.exc
            name = ast.unparse(target).split(".")[-1]
            if name[:1].isupper() and name not in ("NotImplementedError", "StopIteration"):
                found.add(name)
        found |= raised(child)
    if isinstance(node, ast.Try):
        caught = {n for h in node.handlers if h.type for n in re.findall(r"\w+", ast.unparse(h.type))}
        after = raised(ast.Module([*node.handlers, *node.orelse, *node.finalbody], []))
        found = after | ({n for n in found if n not in caught} if "Exception" not in caught else set())
    return found


def decorated(node: ast.FunctionDef, *names: str) -> bool:
    """Return whether one of these decorators stands above a function."""
    return any(ast.unparse(d).split("(")[0].split(".")[-1] in names for d in node.decorator_list)


def documented_values(body: list[ast.stmt]):
    """Yield the name, line and docstring of each public value that has a string below it."""
    for statement, below in pairwise(body):
        if not isinstance(statement, (ast.Assign, ast.AnnAssign)):
            continue
        if not (isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str)):
            continue
        target = statement.targets[0] if isinstance(statement, ast.Assign) else statement.target
        if not ast.unparse(target).startswith("_"):
            yield ast.unparse(target), below.lineno, below.value.value


def docstrings(path: Path) -> list[Finding]:
    """Return what breaks the rules of public docstrings in one file."""
    tree = ast.parse(path.read_text("utf-8"))
    found: list[Finding] = []

    def check(name: str, line: int, text: str | None, kind: str, node: ast.FunctionDef | None = None) -> None:
        if text is None:
            found.append(Finding(path, line, name, "has no docstring", ""))
            return
        clean = ast.get_docstring(node) if node else text.strip()
        rules = [opening(clean, kind)]
        if node is not None and not clean.startswith("See "):  # an override that points to the method it stands for
            rules.append(shapes(node, clean))
            absent = sorted(c for c in raised(node) if not re.search(rf"\b{c}\b", sections(clean).get("Raises", "")))
            rules.append(f"raises {', '.join(absent)}, not named under Raises:" if absent else None)
        first = clean.splitlines()[0] if clean else ""
        found.extend(Finding(path, line, name, rule, first) for rule in rules if rule)

    def visit(body: list[ast.stmt], prefix: str) -> None:
        for name, line, text in documented_values(body):
            check(prefix + name, line, text, "value")
        for node in body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                check(prefix + node.name, node.lineno, ast.get_docstring(node), "class")
                visit(node.body, f"{prefix}{node.name}.")
            elif isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                text = ast.get_docstring(node)
                if text is None and decorated(node, "overload", "setter", "override"):
                    continue
                value = decorated(node, "property", "cached_property")
                check(prefix + node.name, node.lineno, text, "value" if value else "function", node)
            elif isinstance(node, (ast.If, ast.Try)):
                visit(node.body, prefix)

    check("module", 1, ast.get_docstring(tree), "module")
    visit(tree.body, "")
    return found


def banned_in(path: Path, line: int, where: str, text: str) -> list[Finding]:
    """Return the quaint words of one piece of text."""
    for phrase, _reason in ALLOWED:
        text = re.sub(phrase, lambda m: " " * len(m[0]), text, flags=re.IGNORECASE)
    found = []
    for word, better in BANNED.items():
        for match in re.finditer(rf"(?<![\w.-])(?:{word})(?![\w-])", text, re.IGNORECASE):
            at = line + text.count("\n", 0, match.start())
            shown = text.splitlines()[text.count("\n", 0, match.start())].strip()
            found.append(Finding(path, at, where, f"says {match[0]!r}, the field says {better}", shown))
    return found


def quaint_words(path: Path) -> list[Finding]:
    """Return the quaint words in the docstrings, comments and messages of one Python file, or in a whole document.

    A message is a string with a space in it; keys, file names and identifiers are left alone.
    """
    text = path.read_text("utf-8")
    if path.suffix != ".py":
        return banned_in(path, 1, "text", text)
    found = []
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            found += banned_in(path, token.start[0], "comment", token.string)
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            found += banned_in(path, node.lineno, "string", node.value)
    return sorted(set(found), key=lambda f: f[1:])


def files_of(places: list[Path], *suffixes: str) -> list[Path]:
    """Return the files with one of the suffixes, in order, that are or lie in these places."""
    found = [p for place in places for p in ([place] if place.is_file() else sorted(place.rglob("*")))]
    return [p for p in found if p.suffix in suffixes and ".venv" not in p.parts and p.is_file()]


PRODUCT = files_of([ROOT / f for f in FOLDERS if (ROOT / f).exists()], ".py")


@pytest.mark.parametrize("folder", sorted({p.parent for p in PRODUCT}), ids=lambda p: p.relative_to(ROOT).as_posix())
def test_public_docstrings_follow_the_rules(folder):
    """They open with a verb or a noun phrase, state shapes and name what is raised."""
    found = [f for p in PRODUCT if p.parent == folder for f in docstrings(p)]
    assert not found, "\n".join(map(str, found))


@pytest.mark.parametrize("folder", sorted({p.parent for p in PRODUCT}), ids=lambda p: p.relative_to(ROOT).as_posix())
def test_code_speaks_with_the_words_of_the_field(folder):
    """No quaint word stands in a docstring, a comment or a message."""
    found = [f for p in PRODUCT if p.parent == folder for f in quaint_words(p)]
    assert not found, "\n".join(map(str, found))


def test_documents_speak_with_the_words_of_the_field():
    """No quaint word stands in the documents."""
    found = [f for p in files_of([ROOT / d for d in DOCUMENTS], ".md") for f in quaint_words(p)]
    assert not found, "\n".join(map(str, found))


BAD = '''
"""What a module holds."""
LIMIT = 3
"""Decides how many."""

def f(x: torch.Tensor) -> torch.Tensor:
    """Sums of rows.

    Args:
        x: Rows.
    """
    if x is None:
        raise ValueError("no picture")  # mend it
    return x

def g():
    """The widths"""

class C:
    """How it is done."""
    def go(self):
        """Returning rows."""
'''

GOOD = '''
"""Sums."""
LIMIT = 3
"""Largest number of rows."""

def f(x: torch.Tensor) -> torch.Tensor:
    """Sum rows.

    Args:
        x: Rows, shape [N, 3].

    Returns:
        Sums, shape [N].

    Raises:
        ValueError: No rows.
    """
    if x is None:
        raise ValueError("no image")

def _private():
    """What nobody reads."""
'''


def test_the_rules_find_breaches_and_nothing_else(tmp_path):
    """Each rule fires on a file that breaks it, once, and none on a file that keeps them."""
    bad, good = tmp_path / "bad.py", tmp_path / "good.py"
    bad.write_text(BAD, "utf-8")
    good.write_text(GOOD, "utf-8")
    assert docstrings(good) == [] and quaint_words(good) == []
    found = Counter((f.name, f.rule.split()[0]) for f in docstrings(bad))
    assert found == {
        ("module", "opens"): 1, ("LIMIT", "opens"): 1, ("f", "opens"): 1, ("f", "no"): 1, ("f", "raises"): 1,
        ("g", "the"): 1, ("C", "opens"): 1, ("C.go", "opens"): 1,
    }  # fmt: skip
    assert [(f.name, f.rule.split("'")[1]) for f in quaint_words(bad)] == [("comment", "mend"), ("string", "picture")]


def main(arguments: list[str]) -> int:
    """Print the findings of files and folders, then their number in each folder; return 1 where there are any."""
    places = files_of(
        [Path(a).resolve() for a in arguments] or [ROOT / f for f in FOLDERS if (ROOT / f).exists()], ".py", ".md"
    )
    found = [f for p in places for f in [*(docstrings(p) if p.suffix == ".py" else []), *quaint_words(p)]]
    print("\n".join(map(str, found)))
    for folder, count in sorted(Counter(str(f.path.parent) for f in found).items()):
        print(f"{count:5d}  {folder}")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
