"""The documents: names exist, code runs, and quoted messages are printed."""

import ast
import dataclasses
import json
import re
import shutil
import subprocess
from collections import defaultdict
from pathlib import Path
from typing import get_type_hints

import pytest
import torch
from PIL import Image

from bench.lib import result_file
from tests.scenes import view_stub
from tools.run_docs import collect, main, pages, prepare, run_blocks, shortened
from warpgs import PRESETS, read_ply
from warpgs.app.cli import ASKING
from warpgs.pipeline.train import settings as by_views
from warpgs.pipeline.train.settings import MEANS_LR, FitConfig, settings_by_views
from warpgs.synthetic.demo import write_demo

ROOT = Path(__file__).parent.parent


def text_of(name: str) -> str:
    return (ROOT / name).read_text("utf-8")


PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
"""Decisions and the changelog are left out: they tell what was, too."""
GONE_FLAGS = {"fused-adam"}
"""Flags that a decision tells of as gone."""
HOMES = [ROOT, ROOT / "tests", ROOT / "warpgs", ROOT / "warpgs/pipeline"]


def named_files(text: str) -> set[tuple[str, str]]:
    """Return the paths of a text that end with .py, each with the test behind ``::``; placeholders such as X.py left out."""
    found = re.findall(r"(?<![\w./-])((?:\w+/)+\w+\.py)(?:::(test_\w+))?", text)
    return {(name, test) for name, test in found if not name.endswith(("/X.py", "_X.py"))}


def test_named_files_and_tests_are_there():
    """Every path of code leads to a file, every test named behind it is in that file, and links lead to files."""
    missing = []
    for page, (name, test) in ((p, named) for p in PAGES for named in sorted(named_files(p.read_text("utf-8")))):
        found = [home / name for home in HOMES if (home / name).is_file()]
        if not found:
            missing.append(f"{page.name}: {name}")
        elif test and f"def {test}(" not in found[0].read_text("utf-8"):
            missing.append(f"{page.name}: {name}::{test}")
    assert not missing, f"pages name what is not there: {', '.join(missing)}"
    for document in ("README.md", "docs/architecture.md", "CONTRIBUTING.md"):
        for target in re.findall(r"\]\((?!http)([^)#]+)\)", text_of(document)):
            assert ((ROOT / document).parent / target).exists(), f"{document}: {target}"


def test_named_flags_are_there():
    """Every flag in code font or in a command has a name that the code knows, and --no- only where the parser takes it."""
    folders = ("warpgs", "bench", "tools", "tests", "examples")
    known = {w for folder in folders for p in (ROOT / folder).rglob("*.py") for w in re.findall(r"\w+", p.read_text("utf-8"))}
    known |= {flag.strip("-").replace("-", "_") for flag in ASKING}
    missing, settings = [], get_type_hints(FitConfig)
    for page in [*PAGES, *sorted((ROOT / "docs/decisions").glob("*.md"))]:
        flags = set(re.findall(r"(?<![\w-])--([a-z][a-z0-9.-]*[a-z0-9])", page.read_text("utf-8"))) - GONE_FLAGS
        parts = {flag: [part.replace("-", "_") for part in flag.split(".")] for flag in flags}
        off = [(f, *names) for f, names in parts.items() if len(names) == 2 and names[1].startswith("no_")]
        missing += [f"{page.name}: --{f}" for f, group, name in off if get_type_hints(settings[group])[name[3:]] is not bool]
        unknown = [f for f, names in sorted(parts.items()) if not {n.removeprefix("no_") for n in names} <= known]
        missing += [f"{page.name}: --{f}" for f in unknown]
    assert not missing, f"pages name flags that no command has: {', '.join(missing)}"


def test_the_page_on_presets_says_what_the_rule_chooses():
    text = text_of("docs/presets.md")
    rows = [[c.strip() for c in line.split("|")[3:-1]] for line in text[text.index("| setting | rule |") :].splitlines()[:13]]
    counts = [int(cell.split()[0]) for cell in rows[0]]
    assert len(counts) >= 5
    for column, views in enumerate(counts):
        train = [view_stub(8, 6)] * views
        config, _ = settings_by_views(PRESETS["default"], train, "cuda")
        chosen = (
            config.steps, config.sh_degree, round(config.optimizer.means_lr / MEANS_LR, 1), config.optimizer.scales_lr,
            config.optimizer.opacities_lr, config.optimizer.opacities_decay,
            config.init.extrapolate, config.loss.smooth_weight, 1 + config.method.hier,
            config.half_resolution, config.optimizer.average_last,
        )  # fmt: skip
        assert tuple(float(row[column].replace(",", "")) for row in rows[2:]) == chosen, views


BY_HAND = {
    ("conventions.md", "| | `exact`"): "constants of other programs, each with its source",
    ("dependencies.md", "| needed for"): "versions in names of licences",
    ("evaluation.md", "| key | definition"): "definitions",
    ("presets.md", "| setting | rule"): "compared with the rule itself, below",
    ("results.md", "| cited | networks"): "published scores, each with its source",
    ("tiles.md", "| bound | margin"): "derived margins",
}
"""Tables with numbers that no file of results holds: page, first words, reason."""


GONE = "Run it at commit 8a2863c12747"
"""Words of the source line of a table whose program is no longer part of `bench`."""


def is_sourced(text: str) -> bool:
    """Whether a text begins, after one block at most, with the source line of a kept file whose program is gone."""
    lines = [block for block in text.strip().split("\n\n")[:2] if block.startswith("Source: `")]
    for line in lines[:1]:
        kept, programs = re.findall(r"^Source: `(\w+)\.json`", line), re.findall(r"\bbench\.(\w+)\.(\w+)`?", line)
        here = any((ROOT / "bench" / group / f"{name}.py").is_file() for group, name in programs)
        return bool(kept and programs) and not here and GONE in line and line.startswith(result_file.source(kept[0]).strip())
    return False


def test_tables_of_numbers_are_generated():
    """Each table of a page with numbers in most rows is made by `python -m bench.document`, has a source, or is named here."""
    broken = []
    for page in PAGES:
        text = re.sub(r"<!-- [\w ]+: written by.*?<!-- end of", "", page.read_text("utf-8"), flags=re.DOTALL)
        for table in re.finditer(r"(?:^\|.*\n)+", text, re.MULTILINE):
            rows = table[0].splitlines()[2:]
            numbers = [r for r in rows if re.search(r"\d\.\d|\d,\d{3}|\d (?:ms|s|dB|[KMG]i?B|%)", r)]
            named = any(name == page.name and table[0].startswith(words) for name, words in BY_HAND)
            if len(rows) > 1 and 2 * len(numbers) > len(rows) and not named and not is_sourced(text[table.end() :]):
                broken.append(f"{page.name}: {table[0].splitlines()[0]}")
    assert not broken, "\n".join(broken)


RESULT_PAGES = ("results.md", "method.md", "presets.md")
NAMED_NUMBERS = {
    ("method.md", "0.45"): "the square root of 0.2, the variance of Mip-Splatting",
    ("method.md", "1.5"): "`EXACT` of warpgs/priors/given_depth.py",
    ("method.md", "4.1"): "section of a paper",
}
"""Numbers of prose that stand in no table and in no preset: page, number, what it is."""


def numbers_in(text: str) -> set[str]:
    return set(re.findall(r"(?<![\d.])\d+\.\d+(?![\d.]*\d)", text))


def values_in(settings: object) -> set[float]:
    if isinstance(settings, dict):
        return set().union(*map(values_in, settings.values()))
    if isinstance(settings, (list, tuple)):
        return set().union(*map(values_in, settings))
    return {float(settings)} if isinstance(settings, (int, float)) else set()


def test_numbers_of_result_pages_stand_in_a_table_or_a_preset():
    """Prose repeats a number of the page's tables, which files hold, or names a setting or a constant of the rule by views."""
    rules = {name: value for name, value in vars(by_views).items() if name.isupper()}
    settings, broken, used = set().union(values_in(rules), *(values_in(c.to_json()) for c in PRESETS.values())), [], set()
    for name in RESULT_PAGES:
        text = (ROOT / "docs" / name).read_text("utf-8")
        generated = "".join(re.findall(r"written by bench\.document -->(.*?)<!-- end of", text, re.DOTALL))
        tables = numbers_in(generated + "".join(line for line in text.splitlines() if line.startswith("|")))
        prose = re.sub(r"<!-- ([\w ]+): written by.*?<!-- end of \1 -->", "", text, flags=re.DOTALL)
        prose = "\n".join(line for line in prose.splitlines() if not line.startswith("|"))
        prose = re.sub(r"```.*?```|`[^`]*`|\$\$.*?\$\$|\$[^$]*\$|\]\([^)]*\)", "", prose, flags=re.DOTALL)
        for number in sorted(numbers_in(prose) - tables):
            used.add((name, number))
            if float(number) not in settings and (name, number) not in NAMED_NUMBERS:
                broken.append(f"{name}: {number}")
    assert not broken, "\n".join(broken)
    assert {*NAMED_NUMBERS} <= used


SLOW_TO_READ = re.compile(
    r"\b(?:is|are) of (?:one|a|the|--)|\bis no \w+|\bwho(?:ever|se)\b|\b(?:is|are) (?:said|told)\b|\bnobody\b|\bstrangers?\b"
    r"|\b[Ww]hat (?:is|was|are|they|it|no|one|only|all|falls|comes|stands|varies|became)\b"
    r"|\bwhere there (?:is|are) (?:any|none|some)\b"
    r"|\b(?:photographs?|views?|images?|scenes?|numbers?|it|EXIF) (?:say|says|tell|tells|know|knows|contradict)\b"
)
"""Phrases that readers from the field have to read twice; a few may be right where they stand."""


def test_pages_are_plain():
    """Fewer than one such phrase in 1,000 words of any page, code left out."""
    others = [ROOT / name for name in ("SECURITY.md", "CHANGELOG.md", "bench/README.md")]
    pages, broken = [*PAGES, *others, *(ROOT / "docs/decisions").glob("*.md")], []
    for page in pages:
        text = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.DOTALL)
        found = [m[0] for m in SLOW_TO_READ.finditer(text)]
        if 1000 * len(found) >= max(1000, len(text.split())):
            broken.append(f"{page.name}: {', '.join(map(repr, found))}")
    assert not broken, "\n".join(broken)


def test_the_way_of_one_photograph_names_functions_that_exist():
    """Each row of its table names a file of the package and a function in it; no function comes twice."""
    text = text_of("docs/architecture.md")
    hops = re.findall(r"^\| `([\w/]+\.py)` \| `([\w.]+)` \|", text[text.index("## The way of one photograph") :], re.M)
    assert len(hops) == len(set(hops)) > 20
    for file, function in hops:
        found = ast.parse((ROOT / "warpgs" / file).read_text("utf-8")).body
        for name in function.split("."):
            found = [n for n in found if getattr(n, "name", None) == name]
            assert found, f"{file}: there is no {function}"
            found = found[0].body
    # each row of the security page names at least one test, which is there
    text = text_of("SECURITY.md")
    rows = [line for line in text.splitlines() if line.startswith("|") and not re.match(r"\|(---|.* \| test \|$)", line)]
    assert len(rows) > 20
    for row in rows:
        named = re.findall(r"`([\w/]+\.py)::(\w+)`", row)
        assert named, row
        for path, name in named:
            assert re.search(rf"^def {name}\(", (ROOT / "tests" / path).read_text("utf-8"), re.M), f"{path}::{name}"


def named_results(text: str) -> set[str]:
    """Return the names of result files in a text; patterns such as ``ops_MACHINE.json`` are left out."""
    kept, spelled = r"\b\w+_(?:h[12]00|cpu\d*)\.(?:json|md|svg|csv)\b", r"(?<=bench/results/)\w+\.\w+"
    return {name for name in re.findall(f"{kept}|{spelled}", text) if "MACHINE" not in name}


def gone_presets(command: str) -> set[str]:
    """Return the presets of a command that are gone; ``default:setting=value`` and ``pruned/default`` count as default."""
    names, taking = set(), False
    for word in command.split():
        if word.startswith("--"):
            taking = word in ("--preset", "--presets", "--trials")
        elif taking:
            names |= {part.split(":")[0].split("/")[-1] for part in word.split(",") if "=" not in part.split(":")[0]}
    return names - set(PRESETS) - {"gsplat", ""}


def test_pages_and_kept_results_agree():
    """Named files are there; no result is of uncommitted code; no file is unnamed; gone presets are noted."""
    pages = [*PAGES, ROOT / "bench/README.md", *sorted((ROOT / "docs/decisions").glob("*.md"))]
    kept = {p.name: p for p in (ROOT / "bench/results").iterdir()}
    results = {name: json.loads(p.read_text("utf-8")) for name, p in kept.items() if p.suffix == ".json"}
    texts = {page: page.read_text("utf-8") for page in pages}
    broken = [f"{page.name}: no {name}" for page, text in texts.items() for name in sorted(named_results(text) - kept.keys())]
    broken += [f"{name} is -dirty" for name, values in results.items() if (values["commit"] or "").endswith("-dirty")]
    named = {Path(name).stem for text in texts.values() for name in named_results(text)}
    broken += [f"{name}: no page names it" for name in sorted(kept) if Path(name).stem not in named]
    for name, values in results.items():
        gone = gone_presets(values["command"] or "")
        broken += [f"{name}: preset {preset} is gone" for preset in sorted(gone) if preset not in values.get("note", "")]
    assert not broken, "\n".join(broken)


# The examples of the README and of the page on Python do what they say.


def snippets(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", text_of(page), re.DOTALL)


def test_the_examples_fit_a_scene_and_an_image(tmp_path, monkeypatch, capsys):
    """Run as printed, the rasterizer's ends near its target; that of a scene, with fewer steps, writes a PLY in file units."""
    write_demo(tmp_path / "scene", views=8, width=48, height=36)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PRESETS._made, "quick", dataclasses.replace(PRESETS["quick"], steps=5))
    exec(compile(snippets("README.md")[0], "README.md", "exec"), {})
    ours, runs = (read_ply(tmp_path / name) for name in ("model.ply", "fitted/point_cloud.ply"))
    assert torch.equal(ours.means, runs.means)
    text = next(t for t in snippets("docs/rasterizer.md") if "rasterize(" in t and "backward()" in t)
    assert len(text.splitlines()) <= 28
    exec(compile(text, "docs/rasterizer.md", "exec"), {})
    assert float(capsys.readouterr().out.split()[-1]) < 0.06


def test_picture_and_scores_of_the_readme_and_the_quickstart():
    """It comes before all text, at 640 px or more, in at most 300 kB; scores are those of results, as means over seeds."""
    name = re.match(r"# warpgs\n\n!\[[^]]+\]\(([^)]+)\)", text_of("README.md"))[1]
    with Image.open(ROOT / name) as picture:
        assert min(picture.size) >= 640
    assert (ROOT / name).stat().st_size <= 300_000
    # the quickstart's commands, as `bench.fits.presets` runs them
    rows = json.loads(text_of("bench/results/quickstart_cpu2.json"))["rows"]
    (row,) = (r for r in rows if r["preset"] == "default" and r["row"].endswith("@every:8"))
    said = re.findall(r"held-out PSNR ([\d.]+) dB, SSIM ([\d.]+),", text_of("docs/quickstart.md"))
    assert said == [(f"{row['psnr']:.2f}", f"{row['ssim']:.3f}")]
    groups: dict[tuple, list[float]] = defaultdict(list)
    for path in (ROOT / "bench/results").glob("*.json"):
        for r in json.loads(path.read_text("utf-8"))["rows"]:
            scene = "fern llff:3" if r.get("scene") == "fern" and "_llff3_" in path.name else r.get("scene")
            if (r.get("row") == "fern:3" or scene == "fern llff:3") and not r.get("left_out") and "psnr" in r:
                groups[path.name, r.get("preset", r.get("side"))].append(r["psnr"])
    means = {f"{sum(v) / len(v):.1f}" for v in groups.values()}
    stated = re.findall(r"(\d+\.\d+) dB", text_of("README.md"))
    assert len(stated) >= 2 and {*stated} <= means


def test_the_hosted_checks_are_those_of_the_readme():
    text = text_of(".github/workflows/test.yml")
    commands = re.findall(r"^(make \w+) ", text_of("README.md"), re.MULTILINE)
    assert re.findall(r"- run: (make \w+)", text) == commands == ["make demo", "make test"]
    assert all(f"{system}-latest" in text for system in ("ubuntu", "macos", "windows"))
    low, high = re.search(r'requires-python = ">=3\.(\d+),<3\.(\d+)"', text_of("pyproject.toml")).groups()
    assert re.search(r"python: \[(.*)\]", text)[1] == ", ".join(f'"3.{n}"' for n in range(int(low), int(high)))


@pytest.mark.skipif(shutil.which("make") is None, reason="there is no make")
@pytest.mark.parametrize(("system", "folder"), [("Windows_NT", "Scripts"), ("", "bin")])
def test_the_commands_call_what_a_virtual_environment_has(tmp_path, system, folder):
    """On Windows programs lie in another folder."""
    command = ["make", "-n", "-f", str(ROOT / "Makefile"), "demo", "test", f"OS={system}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert f".venv/{folder}/warpgs fit" in done.stdout and f".venv/{folder}/python -m pytest" in done.stdout
    assert ("/bin/" in done.stdout) == (folder == "bin")


# Every message that docs/troubleshooting.md quotes is one that the code can print.


def messages() -> list[str]:
    found = []
    for path in sorted((ROOT / "warpgs").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.JoinedStr):
                found.append("".join(p.value if isinstance(p, ast.Constant) else "..." for p in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return found


def test_quoted_messages_are_there():
    quoted = re.findall(r"^\*\*`(.+)`\*\*", text_of("docs/troubleshooting.md"), re.MULTILINE)
    assert len(quoted) > 30
    known, missing = messages(), []
    for message in quoted:
        pattern = re.compile(".*?".join(re.escape(p.strip()) for p in message.split("...") if p.strip()), re.DOTALL)
        if not any(map(pattern.search, known)):
            missing.append(message)
    assert not missing, f"docs/troubleshooting.md quotes what nothing says: {missing}"


# The commands of the pages are found, left out with a reason, and their failures seen.

PAGE = """Words.

```bash
echo first > a
ssh -L 8080:127.0.0.1:8080 you@there
```

<!-- docs-run: needs a GPU -->
```bash
echo never > b
```

```
$ warpgs export run --to a.ply
warpgs fit scene --out x --device cuda
```

```{math}
1 + 1
```

```python
open("p", "w").write("python")
```

```
a table without a language
```
"""


def test_blocks_of_pages_are_found_shortened_and_prepared(capsys, tmp_path):
    first, marked, bare, python = collect("x.md", PAGE)
    assert (first.line, first.code) == (4, "echo first > a")
    assert first.left_out == (("ssh -L 8080:127.0.0.1:8080 you@there", "another machine"),)
    assert (marked.code, marked.left_out) == ("", (("echo never > b", "needs a GPU"),))
    assert (bare.code, bare.left_out[0][1]) == ("warpgs export run --to a.ply", "GPU")
    assert python.python and python.code.startswith("open(") and not first.python
    # a marker says why
    with pytest.raises(ValueError, match="line 3"):
        collect("x.md", "<!-- docs-run:  -->\n```bash\necho a\n```\n")
    # only what is long is made short
    assert shortened(["fit", "s", "--out", "r"])[-2:] == ["--steps", "40"]
    assert shortened(["compare", "s", "--seeds", "5", "--steps=9"]) == ["compare", "s", "--seeds", "1", "--steps=9"]
    assert shortened(["fit", "s", "--steps=3", "--view"])[2:] == ["--steps=3", "--view", "--view-port", "0"]
    for words in (["fit", "s", "--steps=3"], ["fit", "--help"], ["export", "run"], []):
        assert shortened(words) == words
    # no marker lacks its reason, and hardly anything is left out
    blocks = [b for p in pages() for b in collect(p, text_of(p))]
    assert sum(bool(b.code) for b in blocks) > 20
    assert sum(len(b.left_out) for b in blocks) <= 26
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    assert "--install" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main(["docs/no.md"])
    assert "no such page: docs/no.md" in capsys.readouterr().err
    # a page gets what it uses and does not make
    made, folder = tmp_path / "made", tmp_path / "page"
    for name in ("scene", "run", "photographs"):
        (made / name).mkdir(parents=True)
    folder.mkdir()
    prepare(folder, "warpgs fit scene/ --out run/\nwarpgs render run/", made)
    assert [p.name for p in folder.iterdir()] == ["scene"]


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_blocks_run_in_order_and_failures_are_named(tmp_path):
    """The next block runs where the last one ended, as in the reader's shell after `cd`."""
    text = "```python\nopen('a', 'w')\n```\n```bash\ncat a\nfalse\ntouch late\n```\n```bash\ncp a b\n```\n"
    (line,) = run_blocks(collect("x.md", text), tmp_path, tmp_path)
    assert line.startswith("x.md, line 5: exit code 1") and (tmp_path / "b").exists() and not (tmp_path / "late").exists()
    text = "```bash\nmkdir tour && cd tour\n```\n```bash\ntouch a\n```\n```python\nopen('b', 'w')\n```\n"
    assert run_blocks(collect("x.md", text), tmp_path, tmp_path) == []
    assert (tmp_path / "tour" / "a").exists() and (tmp_path / "tour" / "b").exists()
