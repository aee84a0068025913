"""`python -m tools.mutation`: change the kernels in many small ways, one at a time, and check that tests fail."""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tools.mutation import claims, report, rules
from tools.mutation.candidates import ROOT, Candidate, all_candidates, sample
from tools.mutation.process import COPIED, Job, Outcome, preload, run_jobs


def arguments(args: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="python -m tools.mutation", description=__doc__.split(": ", 1)[1])
    parser.add_argument("--sample", type=int, default=200, help="mutants to sample (default 200)")
    parser.add_argument("--seed", type=int, default=0, help="of the sample (default 0)")
    parser.add_argument("--files", nargs="+", default=None, help="only of these, such as tiles.py cuda/blend_forward.cu")
    parser.add_argument("--device", choices=["cpu", "cuda", "both"], default="cpu", help="whose code is mutated (default cpu)")
    parser.add_argument("--workers", type=int, default=max(1, (os.cpu_count() or 2) - 2), help="mutants at a time")
    parser.add_argument("--timeout", type=float, default=120.0, help="time limit of one mutant in seconds (default 120)")
    parser.add_argument("--test-timeout", type=float, default=45.0, help="time limit of one test in seconds (default 45)")
    parser.add_argument(
        "--json", type=Path, default=Path("runs/mutants.json"), help="file of results, from which the same command continues"
    )
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "warpgs-mutant-kernels")
    parser.add_argument("--only", nargs="+", default=None, help="run just these mutants, by number")
    parser.add_argument("--claims", action="store_true", help="run the claimed equivalents instead: none may be killed")
    parser.add_argument("--list", action="store_true", help="list the sampled mutants, as claims name them, and run none")
    return parser.parse_args(args)


def chosen(options: argparse.Namespace, pool: list[Candidate], claimed: dict[str, str]) -> list[Candidate]:
    """Return the sampled mutants; or all claimed ones, if these are requested."""
    if options.claims:
        pool = [c for c in pool if c.id in claimed]
        options.sample = len(pool)
    if options.only:
        return [c for c in pool if c.id in options.only]
    if options.device != "both":
        pool = [c for c in pool if c.cuda == (options.device == "cuda")]
    if options.files:
        pool = [c for c in pool if c.file.endswith(tuple(f"/{file}" for file in options.files))]
    return sample(pool, options.sample, options.seed) if pool else []


CUDA_PATIENCE = 3.0
"""Factor of the time limits: compiling a CUDA body takes up to a minute if many compile, which must not count as a timeout."""


def has_cuda() -> bool:
    """Return whether there is a CUDA device, by a separate process: a process that has used CUDA cannot fork."""
    code = "import sys, torch; sys.exit(not torch.cuda.is_available())"
    return subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def job_of(candidate: Candidate, cuda: bool, untested: list[str]) -> Job:
    """Return the job of a mutant: the tests of its op on CUDA or on the CPU, without files that have none for it."""
    source = candidate.edit.apply((ROOT / candidate.file).read_bytes())
    tests = tuple(test for test in rules.tests_of(candidate.file, cuda) if named(test, cuda) not in untested)
    patience = CUDA_PATIENCE if cuda else 1.0
    return Job(candidate.id, tests, cuda, candidate.file, source, patience)


def named(test: str, cuda: bool) -> str:
    """Return a test file and its device as text."""
    return f"{test} on {'CUDA' if cuda else 'the CPU'}"


def all_tests(sampled: list[Candidate], device: str) -> list[tuple[str, bool]]:
    """Return the test files of a sample, each with True to run on CUDA."""
    where = [(c.file, cuda) for c in sampled for cuda in {c.cuda, device == "both" or c.cuda}]
    return sorted({(test, cuda) for file, cuda in where for test in rules.tests_of(file, cuda)})


def check_unmutated(tests: list[tuple[str, bool]], options: argparse.Namespace) -> list[str]:
    """Run the tests on the code as it is, which also compiles its kernels; exit if any of them fails.

    Returns the files that have no test for the device, as text.
    """
    untested = []
    jobs = [Job(named(test, cuda), (test,), cuda) for test, cuda in tests]
    for outcome in run_jobs(jobs, ROOT, options.cache, workers=options.workers, timeout=600):
        if outcome.status not in ("survived", "untested"):
            sys.exit(f"the tests fail without a mutant: {outcome.name} ({outcome.status})\n{outcome.output}")
        if outcome.status == "untested":
            untested.append(outcome.name)
        found = f"passes in {outcome.seconds:.0f} s" if outcome.status == "survived" else "has no test"
        print(f"unmutated: {outcome.name} {found}", flush=True)
    on_cuda = {named(test, cuda) for test, cuda in tests if cuda}
    if on_cuda and on_cuda <= set(untested):
        sys.exit(f"none of {len(on_cuda)} test files has a test that runs on CUDA; do they see the device?")
    return untested


def tree_digest(tests: list[tuple[str, bool]]) -> str:
    """Return a digest of all sources and tests, and of the assignment of tests to devices."""
    digest = hashlib.sha256(repr(tests).encode())
    for path in sorted(p for room in COPIED for p in (ROOT / room).rglob("*") if p.suffix in (".py", ".cu", ".toml")):
        digest.update(path.as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def run(mutants: list[tuple[Candidate, bool]], kept: dict, options: argparse.Namespace) -> None:
    """Run mutants, each on CUDA or on the CPU, and store each result.

    A mutant that runs out of device memory while others run is run again alone.
    """
    by_id = {c.id: c for c, _ in mutants}
    jobs = [job_of(c, cuda, kept["untested"]) for c, cuda in mutants]
    limits = {"workers": options.workers, "timeout": options.timeout, "test_timeout": options.test_timeout}
    crowded = []

    def outcomes() -> Iterator[Outcome]:
        for o in run_jobs(jobs, ROOT, options.cache, **limits):
            if options.workers > 1 and o.status == "killed" and "out of memory" in o.output:
                crowded.append(next(j for j in jobs if j.name == o.name))
            else:
                yield o
        yield from run_jobs(crowded, ROOT, options.cache, **limits | {"workers": 1})

    for i, o in enumerate(outcomes(), 1):
        c = by_id[o.name]
        kept["mutants"][o.name] = {
            "file": c.file, "line": c.number, "function": c.edit.place.function, "source": c.line, "change": c.change,
            "status": o.status, "seconds": o.seconds, "output": o.output,
        }  # fmt: skip
        fresh = options.json.with_name(f"{options.json.name}.{os.getpid()}")
        fresh.write_text(json.dumps(kept, indent=1))
        fresh.replace(options.json)
        print(f"{i}/{len(jobs)}  {o.status:<8} {o.seconds:5.1f} s  {report.describe(c)}", flush=True)


def main() -> None:
    """Sample, run, report."""
    options = arguments()
    pool, claimed = all_candidates(), claims.load()
    reasons, lost = claims.match(claimed, pool)
    for message in lost:
        print(message, file=sys.stderr)
    sampled = chosen(options, pool, reasons)
    if options.list:
        for c in sampled:
            print(f"{report.describe(c)}\n{claimed.text(c.key)}\n{report.difference(c)}\n")
        return
    reasons = {} if options.claims else reasons
    if (options.device == "both" or any(c.cuda for c in sampled)) and not has_cuda():
        sys.exit("mutants of CUDA code need a CUDA device, but torch finds none; use --device cpu")
    preload()
    options.json.parent.mkdir(parents=True, exist_ok=True)
    kept = json.loads(options.json.read_text()) if options.json.exists() else {"unmutated": "", "mutants": {}}
    kept.setdefault("untested", [])
    done, tests = kept["mutants"], all_tests(sampled, options.device)
    state = tree_digest(tests)
    # a survivor is run again, since a test may have been added; what was killed stays so
    left = [c for c in sampled if c.id not in reasons and done.get(c.id, {}).get("status") not in report.KILLED]
    begun = time.monotonic()
    if left and kept["unmutated"] != state:
        kept["untested"] = check_unmutated(tests, options)
        kept["unmutated"] = state
    # CUDA mutants compile longest: first, so that none of them is alone at the end; else in no order, so that the score of a
    # run that was cut short is that of a random part
    left.sort(key=lambda c: (not c.cuda, c.id))
    run([(c, c.cuda) for c in left], kept, options)
    if options.device == "both":
        # what no CPU test notices may still matter on CUDA, which runs the shared code too
        run([(c, True) for c in left if not c.cuda and done[c.id]["status"] in report.NOTICED_BY_NONE], kept, options)
    if options.claims:
        refuted = [c for c in sampled if done.get(c.id, {}).get("status") in report.KILLED]
        print("\n".join(f"REFUTED  {report.describe(c)}" for c in refuted))
        sys.exit(f"{len(refuted)} of {len(sampled)} claims are refuted by a test" if refuted else 0)
    print()
    print(report.summary(sampled, {n: r["status"] for n, r in done.items()}, reasons))
    if left:
        print(f"({time.monotonic() - begun:.0f} s, {options.workers} at a time)", file=sys.stderr)


if __name__ == "__main__":
    main()
