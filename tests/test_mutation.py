"""The mutation check: its mutants, its claims, and how it reads the end of a test run."""

import ast
import re

import pytest

from tools.mutation import claims, report, rules
from tools.mutation.__main__ import arguments, check_unmutated
from tools.mutation.candidates import ROOT, all_candidates, candidates_of, sample
from tools.mutation.native import native_edits
from tools.mutation.process import Job, Outcome, run_jobs
from tools.mutation.python import python_edits

PYTHON = '''
"""A docstring with 1 + 1; it is left alone."""
SEGMENT = 4096

def kernel(a: wp.array(dtype=3), n: int = 2):
    total = 0.0
    for i in range(n):
        if a[i, 2] >= -0.5 and not a[i] == n:  # a - b
            total += min(a[i], 1.5) * 0.01
    if n < 1:
        raise ValueError(f"{n + 1} is below 1")
    launch(total, cost=7)
    x[i] += a * 2.0
    return -x[0] < 1
'''

WANTED = {
    "2 to 3", "0.0 to 1.0", "range one shorter", "2 to 1", ">= to >", ">= to <=", "- dropped", "0.5 to 0.505", "and to or",
    "not dropped", "== to !=", "statement dropped", "+= to -=", "min to max", "1.5 to 1.515", "* to /", "0.01 to 0.0101",
    "< to <=", "< to >", "1 to 2", "2.0 to 2.02", "0 to 1",
}  # fmt: skip


@pytest.fixture(scope="module")
def candidates():
    return all_candidates()


def test_mutants_of_a_small_source():
    """Each kind of change once where it applies, in one line; docstrings, annotations, errors, hints and portions have none."""
    edits = python_edits(PYTHON.encode(), "some.py")
    assert {e.change for e in edits} == WANTED and all(e.place.function == "kernel" for e in edits)
    before = PYTHON.splitlines()
    changed = set()
    for e in edits:
        after = e.apply(PYTHON.encode()).decode()
        ast.parse(after)
        lines = [i for i, (old, new) in enumerate(zip(before, after.splitlines(), strict=True), 1) if old != new]
        assert len(lines) == 1, e
        changed |= set(lines)
    assert changed == {5, 6, 7, 8, 9, 10, 13, 14}


def test_mutants_of_a_cuda_body():
    """Binary operators stand between blanks; types, comments, assembler and masks are left alone."""
    body = b"float4* p = q; // a + b\nfloat v = -x * 2.0f + fminf(a[2], 0.0f);\nif (!(m & 0xffu) && i < n)\n    s += v;\n"
    found = [(body[e.start : e.end].decode(), e.new) for e in native_edits(body)]
    assert found == [
        ("-", ""), ("*", "/"), ("2.0f", "2.02f"), ("+", "-"), ("fminf", "fmaxf"), ("2", "1"), ("0.0f", "1.0f"),
        ("!", ""), ("&", "|"), ("&&", "||"), ("<", "<="), ("<", ">"), ("s += v;", ";"), ("+=", "-="),
    ]  # fmt: skip
    body = b"""
        struct Splat { __device__ bool far(float x) const { const float m[2] = {1.0f, 2.0f}; return x > m[0]; } };
        auto next = [&](int a, auto b) { while (a < 3) { if (b) { a += 1; } } };
        for (int i = 0; i < 4; ++i)
            total += f(i, [&](int k) { return k / 2; });
    """
    places = {(e.place.function, e.place.path) for e in native_edits(body)}
    assert places == {
        ("far", "Statement1"), ("far", "Return1"), ("next", "While1"), ("next", "While1.If1.Statement1"), ("", "For1")
    }  # fmt: skip


def test_what_only_cuda_runs():
    """Branches, arguments and files."""
    source = (
        b'def launch(a=1, *, block_dim=2, deterministic=True, keep=False):\n    if device.type == "cuda":\n        a = 11\n'
        b"    else:\n        a = 12\n    b = 13 if native else 14\n    launch(a, 15, block_dim=16, keep=17)\n"
    )
    cuda = {e.change for e in python_edits(source, "some.py") if e.place.cuda}
    assert cuda == {"2 to 3", "True to False", "11 to 12", "13 to 14", "16 to 17"}
    assert all(e.place.cuda for e in python_edits(source, "warpgs/kernels/blend_cuda.py"))
    source = b"def step(t):\n    if {}:\n        run(t, 3)\n        return\n    run(t, 4)\n\ndef other():\n    run(5)\n"
    for test, cuda in {b"t.device.type == 'cpu'": {"4 to 5"}, b"not t.type == 'cpu'": set(), b"t": set()}.items():
        edits = python_edits(source.replace(b"{}", test), "some.py")
        assert {e.change for e in edits if e.place.cuda} == cuda and {"3 to 4", "5 to 6"} < {e.change for e in edits}


def test_every_kernel_file_has_mutants_and_tests(candidates):
    """All files but packages, a call and names; mutants have numbers of their own; samples nest."""
    assert len(candidates) > 4000 and len({c.key for c in candidates}) == len({c.id for c in candidates}) == len(candidates)
    found = {pattern: [p.relative_to(ROOT).as_posix() for p in ROOT.glob(pattern)] for pattern in rules.MUTATED}
    assert all(found.values())
    files = {file for files in found.values() for file in files}
    without = {"warpgs/kernels/__init__.py"}
    without |= {f"warpgs/kernels/cuda/{name}.cu" for name in ("native_broadcast", "blend_settings")}
    assert files - {c.file for c in candidates} == without
    tests = {test for file in {c.file for c in candidates} for cuda in (False, True) for test in rules.tests_of(file, cuda)}
    assert [t for t in sorted(tests) + [t.split("::")[0] for t in rules.SKIPPED] if not (ROOT / t).is_file()] == []
    for c in candidates[::50]:
        if c.file.endswith(".py"):
            ast.parse(c.edit.apply((ROOT / c.file).read_bytes()))
    small, large = sample(candidates, 200, 0), sample(candidates, 400, 0)
    assert sample(candidates, 200, 0) == small and set(small) < set(large) and set(sample(candidates, 200, 1)) != set(small)
    every = {c.file for c in candidates}  # each file has one at least
    assert 200 <= len(small) <= 200 + len(every) and {c.file for c in small} == every


def functions_of(file):
    """File and dotted name of each function and class of a module, and of those in its classes."""
    inside = [("", ast.parse((ROOT / file).read_text()))]
    for prefix, node in inside:
        for child in node.body:
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                yield file, prefix + child.name
            if isinstance(child, ast.ClassDef):
                inside.append((f"{prefix}{child.name}.", child))


def test_rules_name_what_exists(candidates):
    """A file, function or variable of another name would be mutated, or run on the wrong device, unseen."""
    text = {file: (ROOT / file).read_text() for file in {c.file for c in candidates} | set(rules.CUDA_FILES)}
    named = {(file, name) for file, names in rules.CUDA_FUNCTIONS.items() for name in names}
    named |= {tuple(test.split("::")) for test in rules.SKIPPED}
    assert named - {found for file, _ in named for found in functions_of(file)} == set()
    assigned = set(re.findall(r"(\w+) =", " ".join(text.values())))
    assert sorted((rules.SPEED | rules.SLACK) - assigned) == []
    words = set(re.findall(r"\w+", " ".join(text.values())))
    assert sorted((rules.HINTS | rules.CUDA_ARGUMENTS) - words) == []


LOOP = """def kernel(a, n):
    total = 0.0
    for i in range(n):
        if a[i] >= n:
            total = total * a[i]
    return total
"""
BODY = "float total = x;\nfor (int i = 0; i < n; ++i) {\n    if (a[i] >= n)\n        total = total * a[i];\n}\n"
FILES = '[files]\nsome = "some.py"\nbody_cu = "cuda/body.cu"\n\n[equivalent]\n'


def claims_of(path, file, source, changes=(">= to >", "* to /")):
    """A file that claims some changes of a source."""
    empty = claims.Claims({"some": "some.py", "body_cu": "cuda/body.cu"}, {})
    texts = [empty.text(c.key) for c in candidates_of(file, source.encode()) if c.change in changes]
    assert len(texts) == len(changes)
    path.write_text(f'{FILES}"the product is never read after this" = {texts}\n')
    return claims.load(path)


@pytest.mark.parametrize(
    "after",
    [
        LOOP.replace("total", "product").replace("a", "values"),
        LOOP.replace("a[i] >= n", "(a[i] >=  # a >= b\n            n)"),
        "MORE = 5 >= 6\n\ndef first(a):\n    return a >= 2\n\n" + LOOP,
        LOOP.replace("        if", "        if n >= 3:\n            continue\n        if"),
        BODY.replace("total", "product").replace("a[", "values["),
        BODY.replace(" >= n)\n", " >=  // a >= b\n  n) "),
        "if (n >= 4)\n    return;\n" + BODY.replace("    if", "    if (n >= 3)\n        continue;\n    if"),
    ],
    ids=["names", "layout", "elsewhere", "moved", "cuda names", "cuda layout", "cuda moved"],
)
def test_a_claim_keeps_its_mutant(after, tmp_path):
    """Other names, line breaks and comments, edits elsewhere and statements before it do not matter."""
    file, before = ("some.py", LOOP) if "def" in after else ("cuda/body.cu", BODY)
    found = candidates_of(file, after.encode())
    reasons, lost = claims.match(claims_of(tmp_path / "claims.toml", file, before), found)
    assert not lost
    assert sorted(c.change for c in found if c.id in reasons and "[i]" in c.line) == ["* to /", ">= to >"]


@pytest.mark.parametrize(
    "after, advice",
    [
        (LOOP.replace(">= n", ">= n + 1"), "has changed; if the reason still holds, write 'some.kernel For1.If1 "),
        (LOOP.replace("def kernel", "def other"), "such a statement stands at 'some.other For1.If1 "),
        (LOOP.replace(">=", "<"), "the statement is gone; remove the claim"),
        ("", "some.py has no mutants; edit its line in [files]"),
    ],
    ids=["changed", "function renamed", "gone", "file moved"],
)
def test_a_claim_without_a_mutant_says_what_to_do(after, advice, tmp_path):
    """The message quotes the claim, and its successor where there is one."""
    claimed = claims_of(tmp_path / "claims.toml", "some.py", LOOP, [">= to >"])
    reasons, lost = claims.match(claimed, candidates_of("some.py", after.encode()))
    assert not reasons and len(lost) == 1
    assert "no mutant answers to 'some.kernel For1.If1 " in lost[0] and advice in lost[0]


def test_claims_are_refused(tmp_path):
    """Without a reason, of a file that is not listed, or twice."""
    for mutants, message in {
        '"short" = ["some.f Assign1 0000: + to -"]': "too short for a reason",
        '"the sum is never read after this" = ["none.f Assign1 0000: + to -"]': "write '<name in",
        '"the sum is never read after this" = ["some.f Assign1 0000: + to -, + to -"]': "claimed twice",
    }.items():
        (tmp_path / "claims.toml").write_text(FILES + mutants)
        with pytest.raises(ValueError, match=message):
            claims.load(tmp_path / "claims.toml")


@pytest.mark.audit
def test_ends_of_a_test_run(tmp_path, monkeypatch):
    """A planted module under planted tests: passes, fails, does not import, crashes, never ends, has no test for a device.

    Processes that tests start find the mutant, and packages wherever this process finds them.
    """
    tree = tmp_path / "tree"
    (tree / "tests").mkdir(parents=True)
    (tree / "warpgs").mkdir()
    (tree / "warpgs/__init__.py").write_text("")
    (tree / "warpgs/value.py").write_text("VALUE = 1\n")
    test = "import pytest\nfrom warpgs.value import VALUE\n\n{}def test_value():\n    assert VALUE == 1\n"
    cuda, skip = "@pytest.mark.cuda\n", "@pytest.mark.skip\n"
    for name, marks in {"value": "", "cuda": cuda, "skipped": cuda + skip}.items():
        (tree / f"tests/test_{name}.py").write_text(test.format(marks))

    (tmp_path / "packages").mkdir()
    (tmp_path / "packages/elsewhere.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path / "packages")
    started = "import subprocess, sys\n\ndef test_process():\n    subprocess.run([sys.executable, '-c', {!r}], check=True)\n"
    (tree / "tests/test_process.py").write_text(started.format("import elsewhere, warpgs.value as v; assert v.VALUE == 1"))

    def job(name, source=None, tests=("value",), cuda=False, patience=1.0):
        file, source = ("warpgs/value.py", source.encode()) if source else (None, b"")
        return Job(name, tuple(f"tests/test_{t}.py" for t in tests), cuda, file, source, patience=patience)

    endless = "class Slow:\n    def __eq__(self, other):\n        while True:\n            pass\n\nVALUE = Slow()\n"
    forever, two, device = "while True:\n    pass\n", "VALUE = 2\n", True
    jobs = {
        "survived": [job("unmutated"), job("equivalent", "VALUE = 2 - 1\n"), job("both", None, ("value", "cuda"), device),
                     job("in a process", None, ("process",))],
        "killed": [
            job("fails", two), job("no import", "VALUE = = 1\n"), job("crash", "import os\nos.abort()\n"),
            job("fails on CUDA", two, ("value", "cuda"), device), job("fails in a process", two, ("process",)),
        ],
        # limits that a mutant which ends would keep on the busiest machine
        "timeout": [job("endless import", forever, patience=0.05), job("endless test", endless, patience=0.05)],
        # mutants that every other test would notice: of those not meant for the device none may run
        "untested": [
            job("deselected", two, cuda=device), job("none left", two, (), device),
            job("skipped", two, ("value", "skipped"), device),
        ],
        "broken": [job("no file", None, ("none",))],
    }  # fmt: skip
    every = [j for group in jobs.values() for j in group]
    outcomes = {o.name: o.status for o in run_jobs(every, tree, tmp_path / "cache", workers=2, timeout=120, test_timeout=60)}
    assert outcomes == {j.name: status for status, group in jobs.items() for j in group}
    assert (tree / "warpgs/value.py").read_text() == "VALUE = 1\n"


def test_score_counts_no_claims(candidates):
    """Killed and timed out count, claimed mutants are left out, what was not run is said; the score stands last."""
    sampled = candidates[:6]
    words = ["killed", "killed", "timeout", "survived"]
    text = report.summary(sampled, {c.id: w for c, w in zip(sampled, words)}, {sampled[4].id: "no one reads it"})
    assert text.splitlines()[-1] == "mutation score 75.0 %: 3 killed of 4 (6 sampled, 1 claimed equivalent, 1 not run)"
    assert "SURVIVED" in text and "no one reads it" in text and report.difference(sampled[3]) in text
    text = report.summary(sampled[:2], {sampled[0].id: "killed", sampled[1].id: "untested"}, {})
    assert "UNTESTED" in text and text.endswith("mutation score 50.0 %: 1 killed of 2 (2 sampled, 0 claimed equivalent)")


def test_tests_must_pass_without_a_mutant(monkeypatch):
    """A file without a test for the device is left out, unless none is left; one that fails ends the run."""
    cuda, cpu = ("tests/kernels/test_launch.py", True), ("tests/kernels/test_neighbours.py", False)
    ends = {"tests/kernels/test_launch.py on CUDA": "untested"}

    def instead(jobs, *_, **__):
        return [Outcome(j.name, ends.get(j.name, "survived"), 0, "") for j in jobs]

    monkeypatch.setattr("tools.mutation.__main__.run_jobs", instead)
    assert check_unmutated([cuda, ("tests/kernels/test_sh.py", True), cpu], arguments([])) == list(ends)
    with pytest.raises(SystemExit, match="do they see the device"):
        check_unmutated([cuda, cpu], arguments([]))
    ends["tests/kernels/test_neighbours.py on the CPU"] = "broken"
    with pytest.raises(SystemExit, match=r"fail without a mutant: .*test_neighbours"):
        check_unmutated([cuda, cpu], arguments([]))
