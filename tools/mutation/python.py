"""Mutants of a Python source: found in its syntax tree, and made by replacing one token."""

import ast
import io
import itertools
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

from tools.mutation import rules
from tools.mutation.edit import NAMES, Edit, Place, fingerprint, other_number, swaps

COMPARISONS = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=", ast.Is: "is", ast.IsNot: "is not",
}  # fmt: skip
OPERATORS = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "//", ast.Mod: "%", ast.Pow: "**",
    ast.LShift: "<<", ast.RShift: ">>", ast.BitOr: "|", ast.BitAnd: "&",
}  # fmt: skip


def python_edits(source: bytes, file: str) -> list[Edit]:
    """Return all mutants of a file, in their order in the file."""
    return sorted(_Walker(source, file).edits, key=lambda e: (e.start, e.end, e.change))


def shape_of(node: ast.AST) -> str:
    """Return the syntax of a statement without the statements in its body; names are numbered in order of appearance."""
    names: dict[str, str] = {}

    def text(part) -> str:
        if isinstance(part, ast.AST):
            return f"{type(part).__name__}({','.join(text(value) for _, value in ast.iter_fields(part))})"
        if isinstance(part, list):
            return f"[{','.join(text(p) for p in part if not isinstance(p, ast.stmt))}]"
        return names.setdefault(part, f"_{len(names)}") if isinstance(part, str) else repr(part)

    return fingerprint(text(node))


class _Walker:
    def __init__(self, source: bytes, file: str):
        self.source, self.file = source, file
        starts = [0]
        for line in source.splitlines(keepends=True):
            starts.append(starts[-1] + len(line))
        self.starts = starts
        self.bare = bytearray(source)  # without comments, so that an operator found between two operands is the operator
        for token in tokenize.generate_tokens(io.StringIO(source.decode()).readline):
            if token.type == tokenize.COMMENT:
                begin = starts[token.start[0] - 1] + len(token.line[: token.start[1]].encode())
                length = len(token.string.encode())
                self.bare[begin : begin + length] = b" " * length
        self.edits: list[Edit] = []
        self.statement: ast.stmt | None = None
        self.indices: set[int] = set()  # numbers that stand alone in brackets
        self.counts: Counter = Counter()
        self.walk(ast.parse(source), Place(cuda=file in rules.CUDA_FILES))

    def begin(self, node) -> int:
        return self.starts[node.lineno - 1] + node.col_offset

    def end(self, node) -> int:
        return self.starts[node.end_lineno - 1] + node.end_col_offset

    def walk(self, node, place: Place) -> None:
        """Collect the edits of a node and of its descendants, except those that a rule leaves out."""
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            place = place.inside(node.name)
            place = replace(place, cuda=place.cuda or place.function in rules.CUDA_FUNCTIONS.get(self.file, ()))
        elif isinstance(node, ast.stmt):
            place = place.below(type(node).__name__, self.counts, shape_of(node))
        self.statement = node if isinstance(node, ast.stmt) else self.statement
        if rules.left_out(node):
            return
        self.edits += [Edit(*edit, place) for edit in self.of(node)]
        if isinstance(node, ast.Dict):
            for key, value in zip(node.keys, node.values):
                if not rules.is_hint(key):
                    self.walk(value, place)
            return
        if isinstance(node, ast.arguments):
            named = [*zip([*node.posonlyargs, *node.args][::-1], node.defaults[::-1])][::-1]
            for argument, default in [*named, *zip(node.kwonlyargs, node.kw_defaults)]:
                if default is not None:
                    cuda = place.cuda or argument.arg in rules.CUDA_ARGUMENTS
                    self.walk(default, replace(place.below("Default", self.counts, shape_of(default)), cuda=cuda))
            return
        cuda = place.cuda or (isinstance(node, ast.keyword) and node.arg in rules.CUDA_ARGUMENTS)
        body_cuda, else_cuda = rules.sides(node)
        for field, child in ast.iter_fields(node):
            children = [c for c in (child if isinstance(child, list) else [child]) if isinstance(c, ast.AST)]
            if field in ("annotation", "returns", "decorator_list", "type_params"):
                continue
            side = cuda or (field == "body" and body_cuda) or (field == "orelse" and else_cuda)
            for part in children:
                self.walk(part, replace(place, cuda=side))
                side = side or rules.ends_cpu(part)

    def between(self, left, right, operator: str) -> tuple[int, int]:
        """Return the position of an operator between two operands."""
        words = operator.encode().split()
        start = self.bare.index(words[0], self.end(left), self.begin(right))
        return start, self.bare.index(words[-1], start, self.begin(right)) + len(words[-1])

    def of(self, node) -> Iterator[tuple[int, int, str, str]]:
        """Yield start, end, new text and description of the mutants of one node."""
        match node:
            case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
                for new in swaps(old := OPERATORS[type(op)]):
                    yield *self.between(left, right, old), new, f"{old} to {new}"
            case ast.Compare(left=left, ops=ops, comparators=comparators):
                for a, op, b in zip([left, *comparators], ops, comparators):
                    old = COMPARISONS.get(type(op))
                    for new in {"is": ["is not"], "is not": ["is"]}.get(old) or swaps(old or ""):
                        yield *self.between(a, b, old), new, f"{old} to {new}"
            case ast.BoolOp(op=op, values=values):
                old = "and" if isinstance(op, ast.And) else "or"
                for a, b in itertools.pairwise(values):
                    yield *self.between(a, b, old), swaps(old)[0], f"{old} to {swaps(old)[0]}"
            case ast.UnaryOp(op=ast.USub() | ast.Not() as op):
                word = "-" if isinstance(op, ast.USub) else "not"
                yield self.begin(node), self.begin(node) + len(word), "" if word == "-" else " " * 3, f"{word} dropped"
            case ast.AugAssign(target=target, op=op, value=value) if type(op) in OPERATORS:
                old = OPERATORS[type(op)] + "="
                for new in swaps(old):
                    yield *self.between(target, value, old), new, f"{old} to {new}"
                yield self.begin(node), self.end(node), "pass", "statement dropped"
            case ast.Constant(value=bool() as value):
                yield self.begin(node), self.end(node), str(not value), f"{value} to {not value}"
            case ast.Constant(value=int() | float()) if not rules.number_left_out(self.statement):
                old = self.source[self.begin(node) : self.end(node)].decode()
                new = other_number(old.replace("_", ""), index=id(node) in self.indices)
                yield self.begin(node), self.end(node), new, f"{old} to {new}"
            case ast.Subscript(slice=index):
                self.indices.update(map(id, index.elts if isinstance(index, ast.Tuple) else [index]))
            case ast.Call(func=func, args=args):
                word = func.attr if isinstance(func, ast.Attribute) else getattr(func, "id", "")
                if word in NAMES:
                    yield self.end(func) - len(word), self.end(func), NAMES[word], f"{word} to {NAMES[word]}"
                if word == "range" and args:
                    last = args[1] if len(args) > 1 else args[0]
                    yield self.end(last), self.end(last), " - 1", "range one shorter"
