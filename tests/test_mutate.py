"""The mutation check checked: its mutants, its samples, its claims, and how it reads the end of a test run."""

import ast
import io
import os
import tokenize

import pytest

from tests.mutate import claims, report, rules
from tests.mutate.__main__ import all_tests, arguments, check_unmutated, job_of, run
from tests.mutate.candidates import KERNELS, ROOT, Candidate, all_candidates, candidates_of, draw
from tests.mutate.edit import Edit
from tests.mutate.native import native_edits
from tests.mutate.process import Job, Outcome, run_jobs
from tests.mutate.python import python_edits

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="the check forks, which Windows cannot")

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
    return _native("""
        x[i] += a * 2.0f;
        return -x[0] < 1;
    """) if n else n
'''

WANTED = {
    "2 to 3", "0.0 to 1.0", "range one shorter", "2 to 1", ">= to >", ">= to <=", "- dropped", "0.5 to 0.505", "and to or",
    "not dropped", "== to !=", "statement dropped", "+= to -=", "min to max", "1.5 to 1.515", "* to /", "0.01 to 0.0101",
    "< to <=", "< to >", "1 to 2", "2.0f to 2.02f", "0 to 1",
}  # fmt: skip


def tokens(text: str) -> list[str]:
    skipped = (tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    return [t.string for t in tokenize.generate_tokens(io.StringIO(text).readline) if t.type not in skipped]


def test_mutants_of_a_small_source():
    """Each kind of change once where it applies; docstrings, annotations, errors, hints and portions have none."""
    edits = python_edits(PYTHON.encode(), "some.py")
    assert {e.change for e in edits} == WANTED
    lines = {PYTHON.encode().count(b"\n", 0, e.start) + 1 for e in edits}
    assert lines == {5, 6, 7, 8, 9, 10, 14, 15}
    assert all(e.function == "kernel" for e in edits)


def test_a_mutant_differs_in_one_token_and_parses():
    """Or in one statement, where one is dropped; the rest of the file is the same bytes."""
    before = tokens(PYTHON)
    for e in python_edits(PYTHON.encode(), "some.py"):
        mutated = e.apply(PYTHON.encode()).decode()
        ast.parse(mutated)
        after = tokens(mutated)
        head = next(i for i, (a, b) in enumerate(zip(before, after)) if a != b)
        tail = next(i for i, (a, b) in enumerate(zip(reversed(before), reversed(after))) if a != b)
        if e.change not in ("statement dropped", "range one shorter"):
            assert len(before) - head - tail <= 1 and len(after) - head - tail <= 1, e


def test_mutants_of_a_cuda_body():
    """Binary operators stand between blanks; types, comments, assembler and masks are left alone."""
    body = b"float4* p = q; // a + b\nfloat v = -x * 2.0f + fminf(a[2], 0.0f);\nif (!(m & 0xffu) && i < n)\n    s += v;\n"
    found = [(body[e.start : e.end].decode(), e.new) for e in native_edits(body)]
    assert found == [
        ("-", ""), ("*", "/"), ("2.0f", "2.02f"), ("+", "-"), ("fminf", "fmaxf"), ("2", "1"), ("0.0f", "1.0f"),
        ("!", ""), ("&", "|"), ("&&", "||"), ("<", "<="), ("<", ">"), ("s += v;", ";"), ("+=", "-="),
    ]  # fmt: skip


def test_what_only_cuda_runs():
    """Files, functions, branches and native bodies."""
    source = (
        b'def launch():\n    if device.type == "cuda":\n        a = 1\n    else:\n        a = 2\n    b = 3 if native else 4\n'
    )
    assert {e.change: e.cuda for e in python_edits(source, "some.py")} == {
        "== to !=": False, "1 to 2": True, "2 to 3": False, "3 to 4": True, "4 to 5": False
    }  # fmt: skip
    assert all(e.cuda for e in python_edits(source, "blend_cuda.py"))
    assert all(c.cuda for c in all_candidates() if c.file.endswith(".cu"))
    source = b"def blend(a=1, *, block_dim=2, deterministic=True, keep=False):\n    launch(a, 3, block_dim=4, keep=5)\n"
    assert {e.change: e.cuda for e in python_edits(source, "some.py")} == {
        "1 to 2": False, "2 to 3": True, "True to False": True, "False to True": False,
        "3 to 4": False, "4 to 5": True, "5 to 6": False,
    }  # fmt: skip


@pytest.fixture(scope="module")
def candidates():
    return all_candidates()


def test_every_kernel_file_has_mutants_and_tests(candidates):
    """All files but the empty package; every mutant has a key of its own, and its tests exist."""
    assert len(candidates) > 4000 and len({c.key for c in candidates}) == len({c.id for c in candidates}) == len(candidates)
    files = {p.relative_to(ROOT / KERNELS).as_posix() for p in (ROOT / KERNELS).rglob("*") if p.suffix in (".py", ".cu")}
    assert files - {c.file for c in candidates} == {"__init__.py"}
    for file in files - {"__init__.py"}:
        assert all((ROOT / test).is_file() for cuda in (False, True) for test in rules.tests_of(file, cuda))
    assert all((ROOT / test.split("::")[0]).is_file() for test in rules.SKIPPED)


def test_every_python_mutant_parses(candidates):
    """Of a tenth of them."""
    for c in candidates[::10]:
        if c.file.endswith(".py"):
            ast.parse(c.edit.apply((ROOT / KERNELS / c.file).read_bytes()))


def test_samples_are_repeatable_and_nested(candidates):
    """Each file in proportion; a larger sample holds the smaller one; another seed draws others."""
    small, large = draw(candidates, 200, 0), draw(candidates, 400, 0)
    assert draw(candidates, 200, 0) == small and set(small) < set(large) and set(draw(candidates, 200, 1)) != set(small)
    assert 200 <= len(small) <= 240 and {c.file for c in small} == {c.file for c in candidates}


def test_keys_survive_edits_elsewhere():
    """A line added above, or to another function, changes no number; a change of the line itself does."""
    source = (ROOT / KERNELS / "dropout.py").read_bytes()
    ids = {c.id for c in candidates_of("dropout.py", source)}
    moved = source.replace(b"import torch\n", b"import torch\n\nMORE = 5 + 6\n", 1)
    assert ids < {c.id for c in candidates_of("dropout.py", moved)}
    changed = source.replace(b"1.0 / (1.0 - p)", b"1.0 / (1.0 - p + 0.0)")
    assert not ids <= {c.id for c in candidates_of("dropout.py", changed)}


def test_claims_name_mutants_that_exist(candidates):
    """A claim that no mutant answers to is out of date."""
    assert claims.unknown(claims.load(), candidates) == []


def test_claims_are_refused(tmp_path):
    """Without a reason, or twice."""
    entry = '[[equivalent]]\nfile = "a.py"\nfunction = "f"\nreason = "{}"\ncases = [["x + 1", "+ to -"]]\n'
    path = tmp_path / "claims.toml"
    path.write_text(entry.format("short"))
    with pytest.raises(ValueError, match="needs file, function, reason and cases"):
        claims.load(path)
    path.write_text(2 * entry.format("the sum is never read after this"))
    with pytest.raises(ValueError, match="claimed twice"):
        claims.load(path)


def test_ends_of_a_test_run(tmp_path):
    """A planted module under planted tests: passes, fails, does not import, crashes, never ends, has no test for a device."""
    tree = tmp_path / "tree"
    (tree / "tests").mkdir(parents=True)
    (tree / "warpgs").mkdir()
    (tree / "warpgs/__init__.py").write_text("")
    (tree / "warpgs/value.py").write_text("VALUE = 1\n")
    body = "from warpgs.value import VALUE\n\ndef test_value():\n    assert VALUE == 1\n"
    (tree / "tests/test_value.py").write_text(body)
    sources = {
        "survived": "VALUE = 2 - 1\n", "killed": "VALUE = 2\n", "import": "VALUE = = 1\n",
        "crash": "import os\nos.abort()\n", "timeout": "while True:\n    pass\n",
        "slow": "class Slow:\n    def __eq__(self, other):\n        while True:\n            pass\n\nVALUE = Slow()\n",
    }  # fmt: skip
    never = {"timeout": 0.05, "slow": 0.05}  # what does end has time on the busiest machine
    jobs = [
        Job(n, ("tests/test_value.py",), False, "warpgs/value.py", s.encode(), patience=never.get(n, 1))
        for n, s in sources.items()
    ]
    head = "import pytest\nfrom warpgs.value import VALUE\n\n@pytest.mark.{}\ndef test_value():\n    assert VALUE == 1\n"
    (tree / "tests/test_cuda.py").write_text(head.format("cuda"))
    (tree / "tests/test_skipped.py").write_text(head.format("skip").replace("\ndef", "\n@pytest.mark.cuda\ndef"))
    mixed, two = ("tests/test_value.py", "tests/test_cuda.py"), b"VALUE = 2\n"
    jobs += [
        Job("unmutated", ("tests/test_value.py",), False), Job("no file", ("tests/test_none.py",), False),
        # mutants that every other test would notice: of those not meant for the device none may run
        Job("deselected", ("tests/test_value.py",), True, "warpgs/value.py", two),
        Job("skipped", ("tests/test_value.py", "tests/test_skipped.py"), True, "warpgs/value.py", two),
        Job("no test left", (), True, "warpgs/value.py", two),
        Job("mixed", mixed, True), Job("mixed, killed", mixed, True, "warpgs/value.py", two),
        Job("patient", ("tests/test_value.py",), False, patience=0.001),
    ]  # fmt: skip
    outcomes = {o.name: o.status for o in run_jobs(jobs, tree, tmp_path / "cache", workers=2, timeout=120, test_timeout=60)}
    assert outcomes == {
        "survived": "survived", "killed": "killed", "import": "killed", "crash": "killed", "timeout": "timeout",
        "slow": "timeout",
        "unmutated": "survived", "no file": "broken", "deselected": "untested", "skipped": "untested",
        "no test left": "untested", "mixed": "survived", "mixed, killed": "killed", "patient": "timeout",
    }  # fmt: skip
    assert (tree / "warpgs/value.py").read_text() == "VALUE = 1\n"


def test_score_counts_no_claims(candidates):
    """Killed and timed out count, claimed mutants are left out, what was not run is said; the score stands last."""
    drawn = candidates[:6]
    words = ["killed", "killed", "timeout", "survived"]
    text = report.summary(drawn, {c.id: w for c, w in zip(drawn, words)}, {drawn[4].id: "no one reads it"})
    assert text.splitlines()[-1] == "mutation score 75.0 %: 3 killed of 4 (6 drawn, 1 claimed equivalent, 1 not run)"
    assert "SURVIVED" in text and "no one reads it" in text and report.difference(drawn[3]) in text
    text = report.summary(drawn[:2], {drawn[0].id: "killed", drawn[1].id: "untested"}, {})
    assert "UNTESTED" in text and text.endswith("mutation score 50.0 %: 1 killed of 2 (2 drawn, 0 claimed equivalent)")


def plan(*files_on_cuda):
    """A mutant of each file, of what CUDA runs or not."""
    return [Candidate(file, Edit(0, 0, "", "", cuda=cuda), 1, "", "") for file, cuda in files_on_cuda]


def test_which_tests_run_where(monkeypatch):
    """Of each device that a mutant is tested on; a file without a test for the device is no failure, and is left out later."""
    drawn = plan(("knn.py", False), ("bridge.py", True))
    found = all_tests(drawn, "cpu")
    assert ("tests/kernels/test_knn.py", False) in found and ("tests/kernels/test_knn.py", True) not in found
    assert ("tests/kernels/test_bridge.py", True) in found
    assert ("tests/kernels/test_knn.py", True) in all_tests(drawn, "both")
    ends = {"tests/kernels/test_bridge.py on CUDA": "untested"}

    def instead(jobs, *_, **__):
        return [Outcome(j.name, ends.get(j.name, "survived"), 0, "") for j in jobs]

    monkeypatch.setattr("tests.mutate.__main__.run_jobs", instead)
    untested = check_unmutated(found, arguments([]))
    assert untested == ["tests/kernels/test_bridge.py on CUDA"]
    assert "tests/kernels/test_bridge.py" in rules.tests_of("bridge.py", True)
    assert "tests/kernels/test_bridge.py" not in job_of(drawn[1], True, untested).tests
    assert "tests/kernels/test_bridge.py" in job_of(drawn[1], False, untested).tests
    ends |= {f"{test} on CUDA": "untested" for test, _ in found}
    with pytest.raises(SystemExit, match="do they see the device"):
        check_unmutated(found, arguments([]))
    ends["tests/kernels/test_knn.py on the CPU"] = "broken"
    with pytest.raises(SystemExit, match=r"fail without a mutant: .*test_knn"):
        check_unmutated(found, arguments([]))


def test_a_full_device_kills_no_mutant(candidates, monkeypatch, tmp_path):
    """Who met it among others runs again by itself, and that counts; who meets it alone is killed."""
    drawn, seen = [(c, True) for c in candidates[:3]], []
    full, fails = "Warp CUDA error 2: out of memory", "E   assert False"
    words = {c.id: w for (c, _), w in zip(drawn, ([full, ""], [fails, "not asked"], [full, full]))}

    def instead(jobs, root, cache, *, workers, **_):
        seen.append((workers, [j.name for j in jobs]))
        for j in jobs:
            output = words[j.name][len(seen) - 1]
            yield Outcome(j.name, "killed" if output else "survived", 1.0, output)

    monkeypatch.setattr("tests.mutate.__main__.run_jobs", instead)
    kept = {"mutants": {}, "untested": []}
    run(drawn, kept, arguments(["--workers", "8", "--json", str(tmp_path / "m.json")]))
    a, b, c = words
    assert seen == [(8, [a, b, c]), (1, [a, c])]
    assert {k: v["status"] for k, v in kept["mutants"].items()} == {a: "survived", b: "killed", c: "killed"}
